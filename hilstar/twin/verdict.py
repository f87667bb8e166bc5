"""What the digital twin found, against the limits of the bench file; its figures, its table and its charts."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import chart, write_csv
from hilstar.monitor.calibration import BUILT_IN, Calibration, load_calibration

if TYPE_CHECKING:
    from hilstar.twin.verify import Tally, Twin

SMALLEST_FIT = 6  # stars for a scale, a rotation and a shift: twelve residuals, four unknowns
# A fit that leaves more of the residuals' squares than this is no cause of them: chance matches leave nearly all.
MOST_LEFT = 0.5
# A cause is named where it accounts for most of what was looked for.
MOST = 0.5
MIRROR_WORDS = {"x": "its columns reversed", "y": "its rows reversed", "swap": "its axes swapped"}
ARROW_SHARE = 0.06  # of the chart's width, for the residual that 95 % of stars are within


@dataclass(frozen=True, slots=True)
class Star:
    """One star at its place on the tracker, px: errors of the display, + too faint, right and down, magnitudes and px.

    `codes_mag`, `codes_px` are what the codes would cost on the monitor that the bench assumes, NaN where that star would
    be lost; `floor_mag`, `floor_px` are the estimator's own, of the linear image against catalogue and sky.
    """

    hip: int
    v_mag: float
    x_px: float
    y_px: float
    flux_mag: float
    dx_px: float
    dy_px: float
    codes_mag: float
    codes_px: float
    floor_mag: float
    floor_px: float


@dataclass(frozen=True, slots=True)
class Fit:
    """What a scale, a rotation about the detector's middle and a shift explain of the centroids' residuals.

    `left` is the share of the residuals' mean square that they do not explain, for as many residuals as unknowns are over.
    """

    scale_error: float
    rotation_rad: float
    offset_px: tuple[float, float]
    left: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """The stars with their common zero point taken out, those lost with NaN for errors, and every reason against the bench.

    `codes_zero_point_mag` is the zero point that the codes alone would have; `fit` is None with too few stars.
    """

    stars: list[Star]
    lost: list[Star]
    zero_point_mag: float
    codes_zero_point_mag: float
    fit: Fit | None
    reasons: list[str]

    @property
    def passed(self) -> bool:
        """True without any reason against it."""
        return not self.reasons

    def flux_mag(self) -> FloatArray:
        """Flux errors (n,), magnitudes, positive too faint."""
        return np.array([star.flux_mag for star in self.stars])

    def centroid_px(self) -> FloatArray:
        """Centroid errors (n,), tracker pixels."""
        return np.array([math.hypot(star.dx_px, star.dy_px) for star in self.stars])

    def codes_mag(self) -> FloatArray:
        """Flux errors (n,) of the codes alone, magnitudes, NaN where the codes alone lose the star."""
        return np.array([star.codes_mag for star in self.stars])

    def codes_px(self) -> FloatArray:
        """Centroid errors (n,) of the codes alone, tracker pixels."""
        return np.array([star.codes_px for star in self.stars])

    def summary(self, field_count: int, tally: Tally, twin: Twin) -> dict[str, Any]:
        """The JSON object of `hilstar verify`."""
        centroid = self.centroid_px()
        arcsec = twin.arcsec_per_px
        return {
            "fields": field_count,
            "stars": len(self.stars),
            "flux_error_mag": spread(np.abs(self.flux_mag())),
            "centroid_error_px": spread(centroid),
            "centroid_error_arcsec": spread(centroid * arcsec),
            "lost": len(self.lost),
            "passed": self.passed,
            "reasons": self.reasons,
            "blended": tally.blended,
            "clipped": tally.clipped,
            "not_shown": tally.not_shown,
            "at_edge": tally.at_edge,
            "zero_point_mag": finite(self.zero_point_mag),
            "scale_error": self.fit and self.fit.scale_error,
            "rotation_arcsec": self.fit and math.degrees(self.fit.rotation_rad) * 3600,
            "offset_px": self.fit and self.fit.offset_px,
            "black_e_per_s_px": {"assumed": twin.assumed_glow_e_per_s_px, "seen": twin.seen_glow_e_per_s_px},
            "estimator_floor": {
                "flux_mag": spread(np.abs([star.floor_mag for star in self.stars])),
                "centroid_px": spread(np.array([star.floor_px for star in self.stars])),
            },
            "codes_alone": self.codes_alone(),
            "noisy": {
                "stars": len(tally.noisy_px),
                "flux_mag": spread(np.abs(np.array(tally.noisy_mag) - self.zero_point_mag)),
                "centroid_px": spread(np.array(tally.noisy_px)),
            },
            "by_magnitude": self.by_magnitude(),
            "calibration": {"name": twin.bench.calibration.name, "sha256": twin.bench.calibration.sha256},
            "gl_renderer": twin.bench.renderer.gl_renderer,
        }

    def codes_alone(self) -> dict[str, Any]:
        """What the codes would cost were everything as assumed."""
        return {
            "flux_mag": spread(np.abs(self.codes_mag())),
            "centroid_px": spread(self.codes_px()),
            "zero_point_mag": finite(self.codes_zero_point_mag),
        }

    def by_magnitude(self) -> list[dict[str, Any]]:
        """Errors of the stars of each whole magnitude."""
        rows = []
        v_mag, flux, centroid = np.array([star.v_mag for star in self.stars]), self.flux_mag(), self.centroid_px()
        for low in range(math.floor(v_mag.min(initial=0.0)), math.ceil(v_mag.max(initial=0.0)) + 1):
            there = (v_mag >= low) & (v_mag < low + 1)
            if there.any():
                errors = {"flux_error_mag": spread(np.abs(flux[there])), "centroid_error_px": spread(centroid[there])}
                rows.append({"v_from": low, "v_to": low + 1, "stars": int(there.sum()), **errors})
        return rows


def spread(errors: FloatArray) -> dict[str, float | None]:
    """Root mean square, 95th percentile and greatest of some errors; nulls without any."""
    errors = np.asarray(errors, dtype=np.float64)
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return {"rms": None, "p95": None, "max": None}
    return {
        "rms": float(np.sqrt(np.mean(errors**2))),
        "p95": float(np.percentile(errors, 95)),
        "max": float(errors.max()),
    }


def finite(value: float) -> float | None:
    """The value, or None for what JSON cannot hold."""
    return value if math.isfinite(value) else None


def judge(twin: Twin, tally: Tally) -> Verdict:
    """The verdict over all fields."""
    zero_point = median([star.flux_mag for star in tally.stars])
    codes_zero_point = median([star.codes_mag for star in tally.stars])
    stars = [
        replace(star, flux_mag=star.flux_mag - zero_point, codes_mag=star.codes_mag - codes_zero_point) for star in tally.stars
    ]
    verdict = Verdict(stars, tally.lost, zero_point, codes_zero_point, fit_geometry(stars, twin.camera.principal_point_px), [])
    verdict.reasons.extend(reasons(verdict, twin, tally))
    return verdict


def median(values: list[float]) -> float:
    """The median of the finite values, 0 without any."""
    finite_values = [value for value in values if math.isfinite(value)]
    return float(np.median(finite_values)) if finite_values else 0.0


def fit_geometry(stars: list[Star], middle_px: tuple[float, float]) -> Fit | None:
    """Scale, rotation and shift of the centroids by least squares; None with too few stars."""
    if len(stars) < SMALLEST_FIT:
        return None
    x, y = np.array([star.x_px for star in stars]) - middle_px[0], np.array([star.y_px for star in stars]) - middle_px[1]
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    design = np.concatenate([np.stack([x, -y, ones, zeros], axis=1), np.stack([y, x, zeros, ones], axis=1)])
    residual = np.array([*(star.dx_px for star in stars), *(star.dy_px for star in stars)])
    found = np.linalg.lstsq(design, residual, rcond=None)[0]
    scale, rotation, right, down = (float(value) for value in found)
    total = float(residual @ residual)
    spare = design.shape[0] / (design.shape[0] - design.shape[1])
    left = float(np.square(residual - design @ found).sum()) / total * spare if total else 0.0
    return Fit(scale, rotation, (right, down), left)


def reasons(verdict: Verdict, twin: Twin, tally: Tally) -> list[str]:
    """A line for each limit that is passed, and for what seems to be its cause."""
    looked_for = len(verdict.stars) + len(verdict.lost)
    if not looked_for:
        return ["no star could be measured: the fields have none that is shown, unclipped and alone"]
    lost = _lost(verdict, twin, tally)
    mostly_lost = len(verdict.lost) > MOST * looked_for
    centroid = _centroids(verdict, twin)
    geometry = _geometry(verdict, twin) if lost or centroid else []
    # What few stars are found by chance, or off the middle of their windows, says nothing of light.
    light = [] if mostly_lost else [*_light(verdict, twin), *_codes(verdict, twin)]
    return [*lost, *centroid, *geometry, *light, *_black(twin), *_floor(verdict, twin)]


def _lost(verdict: Verdict, twin: Twin, tally: Tally) -> list[str]:
    lost, looked_for = len(verdict.lost), len(verdict.stars) + len(verdict.lost)
    limit = twin.config.verify.lost_share
    if lost <= limit * looked_for:
        return []
    cause = "look at focal lengths, pixel pitches and q_cam_to_mon"
    if tally.vanished > MOST * lost:
        cause = "they are too faint to be seen: look at the monitor's response, and at what the codes leave of faint stars"
    for mirror, count in tally.mirrored.items():
        if count > MOST * looked_for:
            cause = f"{count} are where a mirrored screen with {MIRROR_WORDS[mirror]} would show them: look at its mounting"
    return [f"{lost} of {looked_for} stars are not where the sky has them (limit {limit:.1%}): {cause}"]


def _centroids(verdict: Verdict, twin: Twin) -> list[str]:
    limit, seen = twin.config.verify.centroid_px, p95(verdict.centroid_px())
    return [f"centroids are {seen:.3f} px off at 95 % (limit {limit:g})"] if seen > limit else []


def _geometry(verdict: Verdict, twin: Twin) -> list[str]:
    """What part of the geometry is off by more than the centroids' limit somewhere in the field."""
    fit, limit = verdict.fit, twin.config.verify.centroid_px
    if fit is None or fit.left > MOST_LEFT:
        return []
    reach_px, found = math.hypot(*twin.camera.resolution_px) / 2, []
    if abs(fit.scale_error) * reach_px > limit:
        found.append(f"the plate scale is {fit.scale_error:+.2%} off: look at focal_length_mm and pixel_pitch_um")
    if abs(fit.rotation_rad) * reach_px > limit:
        found.append(f"the field is turned by {math.degrees(fit.rotation_rad):+.3f} deg: look at q_cam_to_mon")
    if math.hypot(*fit.offset_px) > limit:
        right, down = fit.offset_px
        found.append(f"the field is shifted by ({right:+.2f}, {down:+.2f}) px: look at q_cam_to_mon and principal_point_px")
    return found


def _light(verdict: Verdict, twin: Twin) -> list[str]:
    """Errors over the field's stars against each other, then the one that all have."""
    limit, found = twin.config.verify.flux_mag, []
    seen, alone = p95(np.abs(verdict.flux_mag())), p95(np.abs(verdict.codes_mag()))
    if seen > limit:
        response = math.sqrt(max(seen**2 - alone**2, 0.0)) > limit
        cause = (
            ": light does not follow the codes as assumed, look at the monitor's response and uniformity" if response else ""
        )
        found.append(f"flux is {seen:.3f} mag off at 95 % (limit {limit:g}){cause}")
    offset, of_codes = verdict.zero_point_mag, verdict.codes_zero_point_mag
    if abs(offset) > limit:
        cause = f"the codes alone make {of_codes:+.3f}" if abs(of_codes) > limit else "look at flux_at_white_e_per_s"
        # A wrong response moves the median star too: then white may well be right.
        if not (found and abs(of_codes) <= limit and twin.config.verify.true_flux_at_white_e_per_s is None):
            found.append(f"all stars are {offset:+.3f} mag off (limit {limit:g}): {cause}")
    return found


def _black(twin: Twin) -> list[str]:
    glow, assumed, limit = twin.seen_glow_e_per_s_px, twin.assumed_glow_e_per_s_px, twin.black_limit_e_per_s_px()
    if abs(glow - assumed) <= limit:
        return []
    return [
        f"the screen's black gives {glow:.4g} e-/s in a tracker pixel where {assumed:.4g} are assumed"
        f" (limit {limit:.3g}): calibrate the black level"
    ]


def _floor(verdict: Verdict, twin: Twin) -> list[str]:
    """The linear image against the catalogue: where it is off by the limits, the differences above say nothing."""
    limits = twin.config.verify
    mag, px = p95(np.array([abs(s.floor_mag) for s in verdict.stars])), p95(np.array([s.floor_px for s in verdict.stars]))
    if mag <= limits.flux_mag and px <= limits.centroid_px:
        return []
    return [
        f"the linear image itself is measured {mag:.3f} mag and {px:.3f} px off the catalogue at 95 %: the tracker's PSF is too"
        " narrow or too wide for its pixels, so no display can be told from that"
    ]


def _codes(verdict: Verdict, twin: Twin) -> list[str]:
    """What the codes cost were everything as assumed, and what makes them finer."""
    limits, render = twin.config.verify, twin.config.render
    mag, px = p95(np.abs(verdict.codes_mag())), p95(verdict.codes_px())
    if mag <= limits.flux_mag and px <= limits.centroid_px:
        return []
    ways = ['quantisation = "exact"'] if render.quantisation != "exact" else []
    calibrations = _calibrations(twin)
    ways += ["bit_stealing = true"] if not render.bit_stealing and all(c.can_steal_bits for c in calibrations) else []
    ways += ["more bits" if all(c.is_formula for c in calibrations) else "a monitor calibrated on more bits"]
    ways += ["a larger brightest_v_mag", "a smaller faintest_v_mag"]
    return [f"the codes alone cost {mag:.3f} mag and {px:.3f} px at 95 %; try {', '.join(ways[:-1])} or {ways[-1]}"]


def _calibrations(twin: Twin) -> list[Calibration]:
    """That of the bench, and the true one where it is another: what is proposed has to suit both."""
    bench, name = twin.bench, twin.config.verify.true_calibration
    if name is None:
        return [bench.calibration]
    source = name if name in BUILT_IN else bench.file.folder / name
    return [bench.calibration, load_calibration(source, twin.config.monitor.bits)]


def p95(errors: FloatArray) -> float:
    """The 95th percentile of some errors, 0 without any."""
    return spread(errors)["p95"] or 0.0


def write_report(directory: Path, verdict: Verdict, twin_limits: tuple[float, float], resolution_px: tuple[int, int]) -> None:
    """stars.csv, errors.png and field.png; `twin_limits` are magnitudes and tracker pixels."""
    write_csv(directory / "stars.csv", [entry.name for entry in fields(Star)], map(astuple, verdict.stars + verdict.lost))
    _draw_field(directory / "field.png", verdict, resolution_px)
    if not verdict.stars:
        return
    v_mag, flux, centroid = np.array([star.v_mag for star in verdict.stars]), verdict.flux_mag(), verdict.centroid_px()
    word = "passes" if verdict.passed else "does not pass"
    finding = f"The bench {word}: flux within {np.percentile(np.abs(flux), 95):.3f} mag, centroids within "
    with chart(directory / "errors.png", f"{finding}{np.percentile(centroid, 95):.3f} px, for 95 % of stars", 2) as axes:
        for axis, values, limit, label in (
            (axes[0], flux, twin_limits[0], "flux error [mag], + too faint"),
            (axes[1], centroid, twin_limits[1], "centroid error [tracker px]"),
        ):
            axis.plot(v_mag, values, ".", markersize=4, alpha=0.6)
            axis.axhline(limit, color="tab:red", linestyle="--", linewidth=1, label="limit, for 95 % of stars")
            if label.startswith("flux"):
                axis.axhline(-limit, color="tab:red", linestyle="--", linewidth=1)
            axis.set_ylabel(label)
        axes[0].legend(loc="upper left")
        axes[1].set_xlabel("V [mag]")


def _draw_field(path: Path, verdict: Verdict, resolution_px: tuple[int, int]) -> None:
    x, y, dx, dy = (np.array([getattr(star, name) for star in verdict.stars]) for name in ("x_px", "y_px", "dx_px", "dy_px"))
    longest, arrow_px = max(p95(np.hypot(dx, dy)), 1e-9), ARROW_SHARE * resolution_px[0]
    finding = f"Centroid errors of {len(x)} stars over the tracker's field; {len(verdict.lost)} stars are lost"
    with chart(path, finding) as (axis,):
        axis.plot(x, y, ".", color="C0", markersize=3)
        arrows = axis.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=longest / arrow_px, width=0.002, color="C0")
        axis.quiverkey(arrows, 1.12, 0.95, longest, f"{longest:.2g} px", labelpos="S")
        if verdict.lost:
            axis.plot([s.x_px for s in verdict.lost], [s.y_px for s in verdict.lost], "x", color="tab:red", label="lost")
            axis.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
        axis.set_xlim(0, resolution_px[0])
        axis.set_ylim(resolution_px[1], 0)
        axis.set_aspect("equal")
        axis.set_xlabel("x [tracker px]")
        axis.set_ylabel("y [tracker px]")
