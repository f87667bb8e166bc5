"""The monitor of a bench file: how its image lies and lights, its response, and the light of its
primaries.
"""

from __future__ import annotations

from pathlib import Path

from hilstar.display.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.display.primaries import chromatic_primaries, read_primaries
from hilstar.optics.scan import Orientation, Scan
from hilstar.server.bench.config import (
    BenchConfig,
    Monitor,
)
from hilstar.sky.spectrum import Curve

S_PER_MS = 1e-3


def bench_calibration(config: BenchConfig, folder: Path) -> Calibration:
    """The light of the bench file's monitor. Raises InputError."""
    source = calibration_source(config.monitor, folder)
    return load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)


def calibration_source(monitor: Monitor, folder: Path) -> str | Path:
    """What `[monitor] calibration` names: a built-in curve, or the path of a file."""
    if monitor.calibration in BUILT_IN:
        return monitor.calibration
    return folder / monitor.calibration


def bench_primaries(monitor: Monitor, folder: Path) -> tuple[Curve, ...] | None:
    """The spectra of a monitor's primaries, None where they are not known. Raises InputError."""
    primaries = monitor.primaries
    if primaries.file is not None:
        return read_primaries(folder / primaries.file)
    given = [
        chromaticity
        for chromaticity in (primaries.xy_r, primaries.xy_g, primaries.xy_b)
        if chromaticity is not None
    ]
    if given:
        return chromatic_primaries(given, primaries.width_nm)
    return None


def orientation_of(monitor: Monitor) -> Orientation:
    """How the image lies on the screen, as the bench file has it."""
    return Orientation(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


def scan_of(monitor: Monitor) -> Scan:
    """When the rows light, and for how long."""
    return Scan(
        orientation_of(monitor).down,
        monitor.panel_scanout_ms * S_PER_MS,
        monitor.panel_hold_ms * S_PER_MS,
    )
