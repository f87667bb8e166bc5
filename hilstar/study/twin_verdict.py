"""What the digital twin found, against the limits of the bench file; its figures, its table and its charts."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.study.charts import chart, write_csv

if TYPE_CHECKING:
    from hilstar.study.twin import Tally, Twin

SMALLEST_FIT = 10  # stars for a scale and a rotation
STRAY_SCALE = 1e-3  # a plate scale off by more is named as a cause
STRAY_ROTATION_RAD = 1e-3
QUIVER_PX = 60.0  # on the chart, for the 95 % residual


@dataclass(frozen=True, slots=True)
class Star:
    """One star: what the display adds to its magnitude and place (tracker px), and the estimator's own error beside it."""

    hip: int
    v_mag: float
    x_px: float
    y_px: float
    flux_mag: float
    dx_px: float
    dy_px: float
    floor_mag: float
    floor_px: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """The stars with their common zero point taken out, the limits, and every reason against the bench."""

    stars: list[Star]
    zero_point_mag: float
    scale_error: float | None
    rotation_rad: float | None
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
            "lost": tally.lost,
            "passed": self.passed,
            "reasons": self.reasons,
            "blended": tally.blended,
            "clipped": tally.clipped,
            "not_shown": tally.not_shown,
            "zero_point_mag": finite(self.zero_point_mag),
            "scale_error": self.scale_error,
            "rotation_arcsec": None if self.rotation_rad is None else math.degrees(self.rotation_rad) * 3600,
            "black_e_per_s_px": {"assumed": twin.assumed_glow_e_per_s_px, "seen": twin.seen_glow_e_per_s_px},
            "estimator_floor": {
                "flux_mag": spread(np.abs([star.floor_mag for star in self.stars])),
                "centroid_px": spread(np.array([star.floor_px for star in self.stars])),
            },
            "noisy": {"flux_mag": spread(np.abs(tally.noisy_mag)), "centroid_px": spread(np.array(tally.noisy_px))},
            "by_magnitude": self.by_magnitude(),
            "calibration": {"name": twin.bench.calibration.name, "sha256": twin.bench.calibration.sha256},
            "gl_renderer": twin.bench.renderer.gl_renderer,
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
    zero_point = float(np.median([star.flux_mag for star in tally.stars])) if tally.stars else 0.0
    stars = [Star(**{**_as_dict(star), "flux_mag": star.flux_mag - zero_point}) for star in tally.stars]
    scale, rotation = fit_scale(stars, twin)
    verdict = Verdict(stars, zero_point, scale, rotation, [])
    verdict.reasons.extend(reasons(verdict, twin, tally))
    return verdict


def _as_dict(star: Star) -> dict[str, Any]:
    return dict(zip((entry.name for entry in fields(star)), astuple(star), strict=True))


def fit_scale(stars: list[Star], twin: Twin) -> tuple[float | None, float | None]:
    """Relative error of the plate scale and rotation (rad) of the centroids about the detector's middle, least squares."""
    if len(stars) < SMALLEST_FIT:
        return None, None
    cx, cy = twin.camera.principal_point_px
    x, y = np.array([star.x_px for star in stars]) - cx, np.array([star.y_px for star in stars]) - cy
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    design = np.concatenate([np.stack([x, -y, ones, zeros], axis=1), np.stack([y, x, zeros, ones], axis=1)])
    residual = np.array([*(star.dx_px for star in stars), *(star.dy_px for star in stars)])
    scale, rotation, *_ = np.linalg.lstsq(design, residual, rcond=None)[0]
    return float(scale), float(rotation)


def reasons(verdict: Verdict, twin: Twin, tally: Tally) -> list[str]:
    """A line for each limit that is passed, and for what seems to be its cause."""
    limits = twin.config.verify
    found: list[str] = []
    looked_for = len(verdict.stars) + tally.lost
    if looked_for == 0:
        return ["no star could be measured: the fields have none that is shown, unclipped and alone"]
    if tally.lost > limits.lost_share * looked_for:
        found.append(
            f"{tally.lost} of {looked_for} stars lost (limit {limits.lost_share:.1%}): they are not where the sky has them;"
            " look at focal lengths, pixel pitches, and an axis that is mirrored or swapped"
        )
    flux, centroid = spread(np.abs(verdict.flux_mag()))["p95"], spread(verdict.centroid_px())["p95"]
    if flux is not None and flux > limits.flux_mag:
        found.append(f"flux is {flux:.3f} mag off at 95 % (limit {limits.flux_mag:g}): look at the monitor's response")
    if centroid is not None and centroid > limits.centroid_px:
        found.append(f"centroids are {centroid:.3f} px off at 95 % (limit {limits.centroid_px:g})")
    if verdict.scale_error is not None and abs(verdict.scale_error) > STRAY_SCALE and found:
        found.append(f"the plate scale is {verdict.scale_error:+.2%} off: look at focal_length_mm and pixel_pitch_um")
    if verdict.rotation_rad is not None and abs(verdict.rotation_rad) > STRAY_ROTATION_RAD and found:
        found.append(f"the field is turned by {math.degrees(verdict.rotation_rad):+.3f} deg: look at q_cam_to_mon")
    glow, assumed = twin.seen_glow_e_per_s_px, twin.assumed_glow_e_per_s_px
    if abs(glow - assumed) > twin.black_limit_e_per_s_px():
        found.append(
            f"the screen's black gives {glow:.4g} e-/s in a tracker pixel where {assumed:.4g} are assumed"
            f" (limit {twin.black_limit_e_per_s_px():.3g}): calibrate the black level"
        )
    if abs(verdict.zero_point_mag) > limits.flux_mag:
        found.append(
            f"all stars are {verdict.zero_point_mag:+.3f} mag off (limit {limits.flux_mag:g}): look at flux_at_white_e_per_s"
        )
    return found


def write_report(directory: Path, verdict: Verdict, twin_limits: tuple[float, float], resolution_px: tuple[int, int]) -> None:
    """stars.csv, flux.png and centroids.png; `twin_limits` are magnitudes and tracker pixels."""
    write_csv(directory / "stars.csv", [entry.name for entry in fields(Star)], [astuple(star) for star in verdict.stars])
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
            for line in (limit, -limit) if label.startswith("flux") else (limit,):
                axis.axhline(line, color="tab:red", linestyle="--", linewidth=1)
            axis.set_ylabel(label)
        axes[1].set_xlabel("V [mag]")
    _draw_field(directory / "field.png", verdict, resolution_px)


def _draw_field(path: Path, verdict: Verdict, resolution_px: tuple[int, int]) -> None:
    x, y, dx, dy = (np.array([getattr(star, name) for star in verdict.stars]) for name in ("x_px", "y_px", "dx_px", "dy_px"))
    longest = max(float(np.percentile(np.hypot(dx, dy), 95)), 1e-9)
    finding = f"Centroid errors over the tracker's field, an arrow of {QUIVER_PX:g} px is {longest:.3g} px"
    with chart(path, finding) as (axis,):
        axis.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=longest / QUIVER_PX, width=0.002)
        axis.set_xlim(0, resolution_px[0])
        axis.set_ylim(resolution_px[1], 0)
        axis.set_aspect("equal")
        axis.set_xlabel("x [tracker px]")
        axis.set_ylabel("y [tracker px]")
