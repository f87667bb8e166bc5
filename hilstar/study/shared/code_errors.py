"""What each way from light to levels does to a star, as centroiders of every kind see it through a tracker's optics."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hilstar.monitor.balance import AS_USUAL, Balance
from hilstar.monitor.phases import SIGMA_PX, WHITE, fainter, line_places, phase_grid, phase_image, shown_by
from hilstar.monitor.quantise import Panel
from hilstar.study.shared.codes import Way, response_of
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge, StarErrors
from hilstar.units import flux_ratio

JUDGE: Centroider = "fit"  # what most trackers do
ERROR_COLUMNS = (
    "flux_rms_mag",
    "flux_max_mag",
    "centroid_rms_px",
    "centroid_max_px",
    *(f"axis_rms_px_{kind}" for kind in FAMILY),
    *(f"max_px_{kind}" for kind in FAMILY),
)


def code_errors(bits: int, way: Way, phases: int, mags: Iterable[float]) -> list[StarErrors]:
    """The errors of phases^2 stars, so many magnitudes under white, on an sRGB panel; the tracker is as usual."""
    panel, balance = Panel(response_of(bits, way), WHITE), Balance(SIGMA_PX, AS_USUAL)
    sprites, _ = phase_grid(phases, SIGMA_PX)
    bright = phase_image(sprites, SIGMA_PX)
    judge = Judge(bright, line_places(sprites), SIGMA_PX, AS_USUAL.blur_px, AS_USUAL.pixel_px)
    errors = []
    for mag in mags:
        wanted = (bright * flux_ratio(mag)).astype(np.float32)
        errors.append(
            judge.errors(shown_by(way.method, way.frames, panel, wanted, fainter(sprites, mag), balance), flux_ratio(mag))
        )
    return errors


def error_cells(errors: StarErrors) -> tuple[float, ...]:
    """The values of ERROR_COLUMNS; `centroid_...` are distances by the plain moment, `axis_rms_...` along one axis."""
    distance_px = np.sqrt(2) * errors.axis_rms_px("moment")
    return (
        errors.flux_rms_mag,
        errors.flux_max_mag,
        float(distance_px),
        errors.max_px("moment"),
        *(errors.axis_rms_px(kind) for kind in FAMILY),
        *(errors.max_px(kind) for kind in FAMILY),
    )
