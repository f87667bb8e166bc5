"""What a bench's lengths mean together: how wide screen and tracker see, and whether one of them has another unit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from hilstar.bench.cameras import bench_camera, tracker_camera
from hilstar.bench.config import BenchConfig
from hilstar.errors import InputError
from hilstar.scene.camera import Camera

MIN_SEEN, MIN_FILLED = 0.1, 0.5  # of the screen by the tracker; of the tracker's field by the screen
MAX_PIXELS = 10.0  # a pixel of one in pixels of the other
# What no bench is beyond: lenses are f/0.5 to f/10 (a factor of ten in one length leaves this), the widest sees 100 degrees,
# pixels are those of the smallest sensors and of LED walls.
F_NUMBERS, MAX_FIELD_DEG, APERTURES_MM = (0.5, 10.0), 100.0, (1.0, 2000.0)
TRACKER_PITCHES_UM, MONITOR_PITCHES_UM = (0.5, 100.0), (1.0, 10_000.0)
TRUE_RATIOS = (0.5, 2.0)  # of what [verify] says to what the rest of the file says
LENGTHS = (
    ("tracker", "aperture_mm"),
    ("tracker", "focal_length_mm"),
    ("tracker", "pixel_pitch_um"),
    ("monitor", "pixel_pitch_um"),
    ("collimator", "focal_length_mm"),
    ("verify", "true_focal_length_mm"),
    ("verify", "true_pixel_pitch_um"),
)
MM = {"um": 1e-3, "cm": 10.0, "inches": 25.4, "m": 1000.0}  # of a length that stands under a key in mm
UM = {"nm": 1e-3, "mm": 1e3, "cm": 1e4, "m": 1e6}
GRID = 64  # places along each side
MAX_MENDS = 3


@dataclass(frozen=True, slots=True)
class FieldsOfView:
    """Width and height of what screen and tracker see, the monitor's pixel in the tracker's, the parts that they share.

    `screen_seen` is the share of the screen in the tracker's field, `field_on_screen` that of the field on the screen.
    `warning` says which length cannot be right; None where all may be.
    """

    screen_deg: tuple[float, float]
    tracker_deg: tuple[float, float]
    tracker_px_a_monitor_px: float
    screen_seen: float
    field_on_screen: float
    warning: str | None = None

    def line(self) -> str:
        """ "screen 18.0 x 10.2 deg, tracker 10.9 deg, 0.89 tracker px a monitor px"."""
        screen, tracker = ([_figure(side) for side in sides] for sides in (self.screen_deg, self.tracker_deg))
        across = tracker[0] if tracker[0] == tracker[1] else " x ".join(tracker)
        pixel = _figure(self.tracker_px_a_monitor_px)
        return f"screen {' x '.join(screen)} deg, tracker {across} deg, {pixel} tracker px a monitor px"

    def keys(self) -> dict[str, Any]:
        """The same as --json has it."""
        return asdict(self)


def fields_of_view(config: BenchConfig, folder: Path) -> FieldsOfView:
    """What a bench's screen and tracker see, with a warning where a length cannot be right. Raises InputError."""
    found = _measured(config, folder)
    odd = list(_oddities(config, found))
    return found if not odd else _with_warning(found, f"{odd[0]}; {_advice(config, folder)}")


def _measured(config: BenchConfig, folder: Path) -> FieldsOfView:
    screen, tracker = bench_camera(config, folder), tracker_camera(config.tracker, folder)
    return FieldsOfView(
        screen_deg=_sides_deg(screen),
        tracker_deg=_sides_deg(tracker),
        tracker_px_a_monitor_px=tracker.focal_length_px / screen.focal_length_px,
        screen_seen=_share(screen, tracker),
        field_on_screen=_share(tracker, screen),
    )


def _with_warning(found: FieldsOfView, warning: str) -> FieldsOfView:
    return FieldsOfView(**{**asdict(found), "warning": warning})


def _sides_deg(camera: Camera) -> tuple[float, float]:
    """The angles between the middles of the left and right, and of the top and bottom edge."""
    width, height = camera.resolution_px
    x, y = (width - 1) / 2, (height - 1) / 2
    places = np.array([(-0.5, y), (width - 0.5, y), (x, -0.5), (x, height - 0.5)])
    rays = camera.rays(*places.T)
    angles = [math.atan2(np.linalg.norm(np.cross(a, b)), float(a @ b)) for a, b in (rays[:2], rays[2:])]
    sides = [2 * math.atan(size / 2 / camera.focal_length_px) for size in (width, height)]  # beyond a lens that is known so far
    across, down = (math.degrees(side if math.isnan(angle) else angle) for angle, side in zip(angles, sides, strict=True))
    return across, down


def _share(of: Camera, within: Camera) -> float:
    """The share of one image's pixels whose directions are on the other."""
    middles = (np.arange(GRID) + 0.5) / GRID
    columns, rows = np.meshgrid(*(middles * size - 0.5 for size in of.resolution_px))
    rays = of.rays(columns.ravel(), rows.ravel())
    with np.errstate(invalid="ignore", over="ignore"):
        x, y = within.project(rays @ within.cam_to_image.T)
        width, height = within.resolution_px
        inside = (np.abs(2 * x - (width - 1)) <= width) & (np.abs(2 * y - (height - 1)) <= height)
    return float(inside.mean())


def _oddities(config: BenchConfig, found: FieldsOfView) -> Iterator[str]:
    """What cannot be, the plainest first."""
    tracker, monitor, verify = config.tracker, config.monitor, config.verify
    pixels = found.tracker_px_a_monitor_px
    if found.field_on_screen < MIN_FILLED:
        yield f"the tracker sees past the screen: {_percent(found.field_on_screen)} of its field is on it ({found.line()})"
    if found.screen_seen < MIN_SEEN:
        yield f"the tracker sees {_percent(found.screen_seen)} of the screen ({found.line()})"
    if not 1 / MAX_PIXELS <= pixels <= MAX_PIXELS:
        yield f"a monitor pixel is {_figure(pixels)} of the tracker's ({found.line()})"
    for name, value, (low, high), unit in (
        ("the tracker's lens", tracker.focal_length_mm / tracker.aperture_mm, F_NUMBERS, "f/"),
        ("[tracker] aperture_mm", tracker.aperture_mm, APERTURES_MM, ""),
        ("[tracker] pixel_pitch_um", tracker.pixel_pitch_um, TRACKER_PITCHES_UM, ""),
        ("[monitor] pixel_pitch_um", monitor.pixel_pitch_um, MONITOR_PITCHES_UM, ""),
    ):
        if not low <= value < high:
            yield f"{name} is {unit}{_figure(value)}, and none is known outside {unit}{low:g} to {unit}{high:g}"
    widest_deg = max(*found.screen_deg, *found.tracker_deg)
    if widest_deg > MAX_FIELD_DEG:
        yield f"{_figure(widest_deg)} deg is wider than a lens sees ({found.line()})"
    for key, true, said in (
        ("true_focal_length_mm", verify.true_focal_length_mm, config.collimator.focal_length_mm),
        ("true_pixel_pitch_um", verify.true_pixel_pitch_um, monitor.pixel_pitch_um),
    ):
        if true is not None and not TRUE_RATIOS[0] <= true / said <= TRUE_RATIOS[1]:
            yield f"[verify] {key} is {true:.6g}, and elsewhere this file says {said:.6g}"


def _advice(config: BenchConfig, folder: Path) -> str:
    """Which length in another unit would explain it."""
    mends = list(_mends(config, folder))[:MAX_MENDS]
    named = ", or ".join(
        f"[{table}] {key} = {value:.6g} in {unit}, which is {mended:.6g}" for table, key, value, unit, mended in mends
    )
    return f"is {named}?" if mends else "check the units of its lengths (_mm, _um) and its resolutions"


def _mends(config: BenchConfig, folder: Path) -> Iterator[tuple[str, str, float, str, float]]:
    """Each length that makes the bench plausible if it stands there in another unit: table, key, value, unit, value then."""
    for table, key in LENGTHS:
        settings = getattr(config, table)
        value = getattr(settings, key)
        for unit, factor in (MM if key.endswith("_mm") else UM).items():
            if value is None:
                continue
            changed = replace(config, **{table: replace(settings, **{key: value * factor})})
            try:
                mended = next(_oddities(changed, _measured(changed, folder)), None) is None
            except InputError:  # such a lens leaves the screen
                mended = False
            if mended:
                yield table, key, value, unit, value * factor


def _figure(value: float) -> str:
    """One digit after the point, two figures of a small number, four of a large one."""
    return f"{value:.1f}" if 0.95 <= value < 1000 else f"{value:.2g}" if value < 1 else f"{value:.4g}"


def _percent(share: float) -> str:
    return "none" if share == 0 else f"{100 * share:.2g} %"
