"""The virtual tracker of a case: what a solver finds, as a tracker reports it, with the faults that
a plan plants.

A solver that tells no rate gets that of its last two attitudes, half a step old.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import (
    from_radec_roll_deg,
    from_rotation_vector,
    multiply,
    random_attitude,
    rate_between_rad_s,
    to_matrix,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, LIGHT_KM_S, flux_ratio
from hilstar.instruments.campaign.case_motion import CaseMotion
from hilstar.instruments.campaign.plan import PlantedFaults
from hilstar.instruments.campaign.solver_answer import SolverAnswer
from hilstar.instruments.simulate.simulator import Exposure
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.stars import LitStars, lit_by_report

PLANTED_STREAM = 5  # stream of a case's noise seed for what is planted
HEALTHY = PlantedFaults()
FALSE_DN = 1000.0  # signal of a planted false star


@dataclass(frozen=True, slots=True)
class CaseConditions:
    """What a case's planted faults depend on: the observer's velocity, km/s, ICRS, how the case
    moves, the detector's false stars, the angle from a body (`Case.body_deg`), the end of the
    motion or of the last fault, s (None: none), and the turn (3,), rad, cam, by places of stars
    that are old.
    """

    velocity_km_s: FloatArray
    motion: CaseMotion
    false_stars: int = 0
    body_deg: float = 180.0
    fault_end_s: float | None = None
    old_places_rad: FloatArray = field(default_factory=lambda: np.zeros(3))


class CaseTracker:
    """Reports a case's answers, in the order of its frames."""

    def __init__(
        self,
        planted: PlantedFaults | None,
        noise_seed: int,
        conditions: CaseConditions,
        with_rate: bool,
    ) -> None:
        self._planted = HEALTHY if planted is None else planted
        self._rng = np.random.default_rng((noise_seed, PLANTED_STREAM))
        self._conditions = conditions
        self._with_rate = with_rate
        self._last: deque[tuple[float, FloatArray]] = deque(maxlen=2)

    def reported(self, solved: SolverAnswer, exposure: Exposure, at_s: float) -> SolverAnswer:
        """What the tracker reports of an exposure whose middle is `at_s` after the case's
        begin.
        """
        answer = self._with_stars(self._with_own_rate(solved, at_s), exposure)
        why = self._silence(exposure, at_s)
        if why:
            return replace(answer, q_icrs_to_cam=None, why=why, rate_cam_rad_s=None)
        q = answer.q_icrs_to_cam
        if q is None:
            return answer
        planted = self._planted
        stamp_s = answer.stamp_s + planted.stamp_bias_s
        stamp_s += planted.stamp_jitter_s * float(self._rng.standard_normal())
        reported_q = self._turned(q)
        rate_rad_s = self._rate(answer.rate_cam_rad_s, at_s)
        return replace(answer, q_icrs_to_cam=reported_q, rate_cam_rad_s=rate_rad_s, stamp_s=stamp_s)

    def _with_own_rate(self, solved: SolverAnswer, at_s: float) -> SolverAnswer:
        q = solved.q_icrs_to_cam
        if q is None:
            return solved
        self._last.append((at_s, q))
        if not self._with_rate or solved.rate_cam_rad_s is not None or len(self._last) < 2:
            return solved
        (before_s, before_q), (now_s, now_q) = self._last
        rate_rad_s = rate_between_rad_s(before_q, now_q, now_s - before_s)
        return replace(solved, rate_cam_rad_s=rate_rad_s)

    def _silence(self, exposure: Exposure, at_s: float) -> str:
        """Why the tracker reports no attitude by a planted fault; "" where it reports one."""
        planted = self._planted
        conditions = self._conditions
        end_s = conditions.fault_end_s
        lit_s = at_s + exposure.view.exposure_s / 2  # since the first exposure's begin
        since_s = math.inf
        if end_s is not None:
            since_s = at_s - end_s
        rate_rad_s = float(np.linalg.norm(exposure.view.turn.rate_cam_rad_s))
        rate_deg_s = math.degrees(rate_rad_s)
        fastest, most = planted.max_rate_deg_s, planted.max_false_stars
        silent = {
            "missing": self._rng.random() < planted.missing,
            "acquisition_s": lit_s < planted.acquisition_s,
            "recovery_s": 0 <= since_s < planted.recovery_s,
            "max_rate_deg_s": fastest is not None and rate_deg_s > fastest,
            "max_false_stars": most is not None and conditions.false_stars > most,
            "exclusion_deg": conditions.body_deg < planted.exclusion_deg,
        }
        for name, is_silent in silent.items():
            if is_silent:
                return f"planted: {name}"
        return ""

    def _turned(self, q: FloatArray) -> FloatArray:
        planted = self._planted
        if self._rng.random() < planted.wrong:
            return random_attitude(self._rng)
        if planted.lost_roll:
            ra_deg, dec_deg, _ = to_radec_roll_deg(q)
            q = from_radec_roll_deg(ra_deg, dec_deg, float(self._rng.uniform(0, 360)))
        noise = np.array(planted.noise_arcsec) * self._rng.standard_normal(3)
        error_rad = (np.array(planted.bias_arcsec) + noise) / ARCSEC_PER_RAD
        turn_rad = aberration_rad(q, self._conditions.velocity_km_s)
        error_rad = error_rad + planted.aberration * turn_rad
        error_rad = error_rad + self._conditions.old_places_rad
        return multiply(from_rotation_vector(error_rad), q)

    def _rate(self, rate_rad_s: FloatArray | None, at_s: float) -> FloatArray | None:
        if rate_rad_s is None:
            return None
        planted = self._planted
        noise = planted.rate_noise_deg_s * self._rng.standard_normal(3)
        error_rad_s = np.radians(np.array(planted.rate_bias_deg_s) + noise)
        error_rad_s -= planted.rate_lag_s * self._conditions.motion.acceleration_at(at_s)
        return np.asarray((1 + planted.rate_scale) * rate_rad_s + error_rad_s)

    def _with_stars(self, answer: SolverAnswer, exposure: Exposure) -> SolverAnswer:
        """The answer with planted faults of its stars."""
        if answer.stars is None or self._planted == HEALTHY:
            return answer
        planted = self._planted
        height, width = exposure.dn.shape
        limit = planted.star_limit_v_mag
        v_mag = bv_mag = np.full(len(answer.stars), np.nan)
        if limit is not None or planted.star_colour:
            lit = lit_stars(exposure)
            matched = lit_by_report(answer.stars, lit, (width, height))
            # -1, no star, is the last: one more than there are
            v_mag = np.append(lit.v_mag, np.nan)[matched]
            bv_mag = np.append(lit.bv, np.nan)[matched]
        stars = []
        for star, its_v_mag, its_bv_mag in zip(answer.stars, v_mag, bv_mag, strict=True):
            if limit is not None and not its_v_mag <= limit:
                continue
            wave = math.sqrt(2) * planted.star_fov_px
            wave_x_px = wave * math.sin(2 * math.pi * star.x_px / width)
            wave_y_px = wave * math.sin(2 * math.pi * star.y_px / height)
            noise_px = planted.star_noise_px * self._rng.standard_normal(2)
            dn = star.dn
            if dn is not None and np.isfinite(its_bv_mag):
                dn *= flux_ratio(planted.star_colour * float(its_bv_mag))
            x_px = star.x_px + float(noise_px[0]) + wave_x_px
            y_px = star.y_px + float(noise_px[1]) + wave_y_px
            stars.append(ReportedStar(x_px, y_px, dn, star.hip))
        for _ in range(int(self._rng.poisson(planted.false_stars))):
            x_px = float(self._rng.uniform(0, width - 1))
            y_px = float(self._rng.uniform(0, height - 1))
            stars.append(ReportedStar(x_px, y_px, FALSE_DN))
        return replace(answer, stars=tuple(stars))


def aberration_rad(q_icrs_to_cam: FloatArray, velocity_km_s: FloatArray) -> FloatArray:
    """The rotation vector (3,), cam, by which an attitude is off that takes the aberration of this
    velocity (3,), ICRS, for none: stars on the boresight move by v / c towards it.
    """
    v_cam = to_matrix(q_icrs_to_cam) @ velocity_km_s / LIGHT_KM_S
    return np.array([-v_cam[1], v_cam[0], 0.0])


def lit_stars(exposure: Exposure) -> LitStars:
    """The stars that an exposure has within its detector, without those of faults."""
    truth = exposure.rows
    height, width = exposure.dn.shape
    with np.errstate(invalid="ignore"):
        off_x = np.abs(truth["x_px"] - (width - 1) / 2)
        off_y = np.abs(truth["y_px"] - (height - 1) / 2)
        inside = (off_x <= width / 2) & (off_y <= height / 2)
    chosen = inside & truth["drawn"] & (truth["electrons_per_s"] > 0)
    if exposure.faults:
        chosen &= ~np.isin(truth["name"], exposure.faults)
    lit = truth[chosen]
    columns = []
    for name in ("x_px", "y_px", "v_mag", "bv", "electrons_per_s"):
        columns.append(np.asarray(lit[name], dtype=np.float64))
    return LitStars(*columns)
