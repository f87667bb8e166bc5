"""The tally of a case: its exposures and answers, and what of them its row has."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.campaign.case_motion import AXES
from hilstar.instruments.campaign.cases import (
    FALSE_STARS,
    FRAME_ERRORS,
    FRAME_RATE_ERRORS,
    FRAME_RATES,
    FURTHER,
    REPORTED_FRAMES,
    STAR_LISTS,
    Q,
)
from hilstar.instruments.campaign.plan import Further
from hilstar.instruments.campaign.planted import lit_stars
from hilstar.instruments.campaign.solver_answer import CentroidErrors, SolverAnswer
from hilstar.instruments.campaign.store import Row
from hilstar.instruments.simulate.simulator import Exposure
from hilstar.optics.frame_motion import CameraTurn
from hilstar.server.answers.stars import StarResiduals, judge_stars


def spread_row(errors_arcsec: list[FloatArray]) -> Row:
    """The mean of a case's errors (3,), and their standard deviation where there are several."""
    row: Row = {}
    if errors_arcsec:
        errors = np.array(errors_arcsec)
        for axis, value in zip(AXES, errors.mean(axis=0).tolist(), strict=True):
            row[f"error_{axis}_arcsec"] = value
        if len(errors) > 1:
            scatter = errors.std(axis=0, ddof=1).tolist()
            for axis, value in zip(AXES, scatter, strict=True):
                row[f"scatter_{axis}_arcsec"] = value
    return row


@dataclass(slots=True)
class FrameLists:
    """Rates, errors and errors of the reported rate of frames with a right answer, each (3,), cam;
    NaN where no rate is reported.
    """

    rates_deg_s: list[FloatArray] = field(default_factory=list)
    errors_arcsec: list[FloatArray] = field(default_factory=list)
    rate_errors_deg_s: list[FloatArray] = field(default_factory=list)

    def add(
        self, rate_rad_s: FloatArray, error_arcsec: FloatArray, reported_rad_s: FloatArray | None
    ) -> None:
        """Add a frame: its rate, its error, and the rate that was reported (None: none)."""
        self.rates_deg_s.append(np.degrees(rate_rad_s))
        self.errors_arcsec.append(error_arcsec)
        error_deg_s = np.full(3, np.nan)
        if reported_rad_s is not None:
            error_deg_s = np.degrees(reported_rad_s - rate_rad_s)
        self.rate_errors_deg_s.append(error_deg_s)

    def into(self, further: tuple[Further, ...]) -> Row:
        """The columns that a plan asks for."""
        row: Row = {}
        names = {name for part in further for name in FURTHER[part]}
        for columns_of, values in (
            (FRAME_RATES, self.rates_deg_s),
            (FRAME_ERRORS, self.errors_arcsec),
            (FRAME_RATE_ERRORS, self.rate_errors_deg_s),
        ):
            table = np.array(values).reshape(-1, len(AXES))
            for k, name in enumerate(columns_of):
                if name in names:
                    row[name] = table[:, k].tolist()
        return row


@dataclass(slots=True)
class StarLists:
    """Stars of a case's frames against their reports."""

    judged: list[StarResiduals] = field(default_factory=list)

    def into(self) -> Row:
        """The columns of stars; None where no frame reported stars."""
        if not self.judged:
            return dict.fromkeys((REPORTED_FRAMES, FALSE_STARS, *STAR_LISTS))
        row: Row = {REPORTED_FRAMES: len(self.judged)}
        row[FALSE_STARS] = sum(residuals.false for residuals in self.judged)
        for name in STAR_LISTS:
            key = name.removeprefix("star_")
            parts = [
                getattr(residuals if hasattr(residuals, key) else residuals.lit, key)
                for residuals in self.judged
            ]
            row[name] = np.concatenate(parts).tolist()
        return row


@dataclass(slots=True)
class CaseTally:
    """The exposures and answers of a case so far."""

    with_centroids: bool
    wrong_above_arcsec: float
    turn_at: Callable[[float], CameraTurn]  # commanded, by the seconds after the case's begin
    fault_end_s: float | None = None
    first_attitude_s: float | None = None
    recovery_s: float | None = None
    frames: int = 0
    stars_in_view: int = 0
    errors_arcsec: list[FloatArray] = field(default_factory=list)
    why: str = ""
    star_errors: list[CentroidErrors] = field(default_factory=list)
    wrong: int = 0
    first_q: FloatArray | None = None
    further: tuple[Further, ...] = ()
    frames_told: FrameLists = field(default_factory=FrameLists)
    star_lists: StarLists = field(default_factory=StarLists)
    _digest: Any = field(default_factory=hashlib.sha256)

    def see(self, exposure: Exposure) -> None:
        """Count an exposure."""
        self.frames += 1
        self.stars_in_view += len(exposure.rows)
        self._digest.update(np.ascontiguousarray(exposure.dn))

    def hear(self, exposure: Exposure, answer: SolverAnswer, at_s: float) -> None:
        """Count the answer to an exposure whose middle is `at_s` after the case's begin, which is
        the middle of the first exposure.
        """
        if answer.star_errors is not None:
            self.star_errors.append(answer.star_errors)
        if answer.stars is not None and "stars" in self.further:
            height, width = exposure.dn.shape
            residuals = judge_stars(answer.stars, lit_stars(exposure), (width, height))
            self.star_lists.judged.append(residuals)
        if answer.q_icrs_to_cam is None:
            self.why = self.why or answer.why
            return
        # an answer is of the time that its stamp says
        turn = self.turn_at(at_s + answer.stamp_s)
        error = attitude_error_arcsec(turn.q_icrs_to_cam, answer.q_icrs_to_cam)
        if self.frames == 1:
            self.first_q = answer.q_icrs_to_cam
        if np.linalg.norm(error) > self.wrong_above_arcsec:
            self.wrong += 1
            return
        self.errors_arcsec.append(error)
        self.frames_told.add(turn.rate_cam_rad_s, error, answer.rate_cam_rad_s)
        exposure_s = exposure.view.exposure_s
        if self.first_attitude_s is None:
            self.first_attitude_s = at_s + exposure_s
        end_s = self.fault_end_s
        if end_s is not None and self.recovery_s is None and at_s >= end_s:
            self.recovery_s = at_s + exposure_s / 2 - end_s

    def into(self, row: Row) -> Row:
        """The case's row with its results. Errors are those of answers that are not wrong."""
        row = row | {
            "why": self.why,
            "image_sha256": self._digest.hexdigest(),
            "frames": self.frames,
        }
        row |= {
            "stars_in_view": self.stars_in_view,
            "solved": self.wrong + len(self.errors_arcsec),
            "wrong": self.wrong,
        }
        row["first_attitude_s"] = self.first_attitude_s
        if "recovery_s" in row:
            row |= {"fault_end_s": self.fault_end_s, "recovery_s": self.recovery_s}
        if self.first_q is not None:
            row |= dict(zip((f"solved_{name}" for name in Q), self.first_q.tolist(), strict=True))
        row |= spread_row(self.errors_arcsec)
        row |= self.frames_told.into(self.further)
        if "stars" in self.further:
            row |= self.star_lists.into()
        if self.with_centroids and self.star_errors:
            return row | self._centroids()
        return row

    def _centroids(self) -> Row:
        dx_px = np.concatenate([errors.dx_px for errors in self.star_errors])
        dy_px = np.concatenate([errors.dy_px for errors in self.star_errors])
        v_mag = np.concatenate([errors.v_mag for errors in self.star_errors])
        row: Row = {}
        for name in ("stars", "found", "matched", "false"):
            row[name] = sum(getattr(errors, name) for errors in self.star_errors)
        row["measured"] = len(dx_px)
        if len(dx_px):
            row |= {"centroid_dx_px": float(dx_px.mean()), "centroid_dy_px": float(dy_px.mean())}
            row["limit_v_mag"] = float(v_mag.max())
        if len(dx_px) > 1:
            row |= {
                "centroid_sigma_x_px": float(dx_px.std(ddof=1)),
                "centroid_sigma_y_px": float(dy_px.std(ddof=1)),
            }
        return row


def attitude_error_arcsec(q_commanded: FloatArray, q_reported: FloatArray) -> FloatArray:
    """The rotation vector (3,), arcsec, cam axes, from the commanded to the reported attitude."""
    return to_rotation_vector(multiply(q_reported, conjugate(q_commanded))) * ARCSEC_PER_RAD
