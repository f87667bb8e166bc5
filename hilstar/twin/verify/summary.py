"""The figures of `hilstar verify`, for a program and for a person. The fields are the keys of its JSON object."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from hilstar.error_spread import ErrorSpread, error_spread
from hilstar.tracker.centroiders import Centroider
from hilstar.twin.verify.display_errors import DisplayErrors
from hilstar.twin.verify.faulty_fields import FaultSeen, fault_lines
from hilstar.twin.verify.star_finder import USUAL
from hilstar.twin.verify.verdict import Verdict
from hilstar.units import ARCSEC_PER_RAD


@dataclass(frozen=True, slots=True)
class BlackLevel:
    """The glow of the screen's black, electrons per second in a tracker pixel."""

    assumed: float
    seen: float


@dataclass(frozen=True, slots=True)
class EstimatorFloor:
    """The estimator's own errors, of the linear image against the catalogue."""

    flux_mag: ErrorSpread
    centroid_px: ErrorSpread


@dataclass(frozen=True, slots=True)
class CodesAlone:
    """What the codes would cost if everything were as assumed."""

    flux_mag: ErrorSpread
    centroid_px: ErrorSpread
    zero_point_mag: float | None


@dataclass(frozen=True, slots=True)
class Noisy:
    """The same with all of the detector's noise."""

    stars: int
    flux_mag: ErrorSpread
    centroid_px: ErrorSpread


@dataclass(frozen=True, slots=True)
class OneMagnitude:
    """The errors of the stars of one whole magnitude."""

    v_from: int
    v_to: int
    stars: int
    flux_error_mag: ErrorSpread
    centroid_error_px: ErrorSpread


@dataclass(frozen=True, slots=True)
class CalibrationName:
    """The calibration that the bench assumes."""

    name: str
    sha256: str


@dataclass(frozen=True, slots=True)
class VerifySummary:
    """The figures of a verdict; centroids in tracker pixels, and arcsec in the middle of its field.

    They are as `centroider` finds the stars; `centroid_error_px_by` has those of each kind.
    """

    fields: int
    stars: int
    flux_error_mag: ErrorSpread
    centroid_error_px: ErrorSpread
    centroid_error_arcsec: ErrorSpread
    centroider: Centroider
    centroid_error_px_by: dict[Centroider, ErrorSpread]
    lost: int
    passed: bool
    reasons: list[str]
    blended: int
    clipped: int
    not_shown: int
    at_edge: int
    summed: int
    zero_point_mag: float | None
    scale_error: float | None
    rotation_arcsec: float | None
    offset_px: tuple[float, float] | None
    tilt_deg: tuple[float, float] | None
    k1: float | None
    distortion_px: float | None
    black_e_per_s_px: BlackLevel
    estimator_floor: EstimatorFloor
    codes_alone: CodesAlone
    noisy: Noisy
    by_magnitude: list[OneMagnitude]
    calibration: CalibrationName
    gl_renderer: str
    drawn_as_discs: list[str]
    faults: list[FaultSeen] = field(default_factory=list)


def summarise(verdict: Verdict) -> VerifySummary:
    """The figures of a verdict."""
    measured, errors = verdict.measured, verdict.errors
    tally, fit, centroid_px = measured.tally, errors.geometry, errors.centroid_px()
    noisy_mag = np.abs(np.array(tally.noisy_mag) - errors.zero_point_mag)
    return VerifySummary(
        fields=measured.field_count,
        stars=len(errors.stars),
        flux_error_mag=error_spread(np.abs(errors.flux_mag())),
        centroid_error_px=error_spread(centroid_px),
        centroid_error_arcsec=error_spread(centroid_px * ARCSEC_PER_RAD / measured.camera.focal_length_px),
        centroider=measured.config.verify.centroider or USUAL,
        centroid_error_px_by={kind: error_spread(np.array(off_px)) for kind, off_px in tally.off_px.items()},
        lost=len(errors.lost),
        passed=verdict.passed,
        reasons=verdict.reasons,
        blended=tally.blended,
        clipped=tally.clipped,
        not_shown=tally.not_shown,
        at_edge=tally.at_edge,
        summed=tally.summed,
        zero_point_mag=_finite(errors.zero_point_mag),
        scale_error=None if fit is None else fit.scale_error,
        rotation_arcsec=None if fit is None else fit.rotation_rad * ARCSEC_PER_RAD,
        offset_px=None if fit is None else fit.offset_px,
        tilt_deg=None if fit is None else (math.degrees(fit.tilt_rad[0]), math.degrees(fit.tilt_rad[1])),
        k1=None if fit is None else fit.k1,
        distortion_px=None if fit is None else fit.distortion_px,
        black_e_per_s_px=BlackLevel(measured.glow.assumed_e_per_s_px, measured.glow.seen_e_per_s_px),
        estimator_floor=EstimatorFloor(error_spread(errors.floor_mag()), error_spread(errors.floor_px())),
        codes_alone=CodesAlone(
            error_spread(np.abs(errors.codes_mag())), error_spread(errors.codes_px()), _finite(errors.codes_zero_point_mag)
        ),
        noisy=Noisy(len(tally.noisy_px), error_spread(noisy_mag), error_spread(np.array(tally.noisy_px))),
        by_magnitude=_by_magnitude(errors),
        calibration=CalibrationName(measured.calibration.name, measured.calibration.sha256),
        gl_renderer=measured.gl_renderer,
        drawn_as_discs=measured.wide_bodies,
        faults=verdict.faults,
    )


def _finite(value: float) -> float | None:
    """The value, or None for what JSON cannot hold."""
    return value if math.isfinite(value) else None


def _by_magnitude(errors: DisplayErrors) -> list[OneMagnitude]:
    rows = []
    v_mag, flux, centroid = np.array([star.v_mag for star in errors.stars]), np.abs(errors.flux_mag()), errors.centroid_px()
    for low in range(math.floor(v_mag.min(initial=0.0)), math.ceil(v_mag.max(initial=0.0)) + 1):
        there = (v_mag >= low) & (v_mag < low + 1)
        if there.any():
            rows.append(OneMagnitude(low, low + 1, int(there.sum()), error_spread(flux[there]), error_spread(centroid[there])))
    return rows


def summary_lines(summary: VerifySummary) -> list[str]:
    """The figures for a person."""

    def three(errors: ErrorSpread) -> str:
        return " / ".join(_number(value) for value in (errors.rms, errors.p95, errors.max))

    noisy = summary.noisy
    rest = f"{summary.lost} lost, {summary.blended} blended, {summary.clipped} clipped"
    rest += f", {summary.not_shown} not shown, {summary.at_edge} at edge"
    rest += f", {summary.summed} part of a blend" if summary.summed else ""
    centroid = f"{three(summary.centroid_error_px)} px, {three(summary.centroid_error_arcsec)} arcsec, by {summary.centroider}"
    each = ", ".join(f"{kind} {_number(errors.rms)}" for kind, errors in summary.centroid_error_px_by.items())
    return [
        f"{'stars':20}{summary.stars} in {summary.fields} fields; {rest}",
        f"{'flux error':20}{three(summary.flux_error_mag)} mag (rms / 95 % / max)",
        f"{'centroid error':20}{centroid}",
        f"{'by each centroider':20}{each} px rms",
        f"{'with detector noise':20}{three(noisy.flux_mag)} mag, {three(noisy.centroid_px)} px",
        *(
            f"{f'V {row.v_from} to {row.v_to}':>17}   {row.flux_error_mag.rms:.4f} mag rms,"
            f" {row.centroid_error_px.rms:.4f} px rms, {row.stars} stars"
            for row in summary.by_magnitude
        ),
        *(f"{'':20}{line}" for line in summary.drawn_as_discs),
        *fault_lines(summary.faults),
        *(f"{'':20}{reason}" for reason in summary.reasons),
        f"{'verdict':20}{'passed' if summary.passed else 'NOT passed'}",
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
