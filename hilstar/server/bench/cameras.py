"""The two cameras of a bench file: the monitor behind its collimator, and the tracker.

The fields of view tell a length in the wrong unit: no lens and no pixel is ten times as large as
the others imply.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.geometry import load_distortion, load_geometry, monitor_camera
from hilstar.optics.camera import Camera, bounded
from hilstar.optics.glass.glass_psf import regridded
from hilstar.optics.psf import ONE_PSF, GaussianPsf, Psf, SampledPsf, read_psf
from hilstar.server.bench.config import DEFAULT_PSF_SIGMA_PX, GAUSSIAN, BenchConfig, Tracker
from hilstar.server.bench.glass import (
    Onto,
    bench_glass_psf,
    decentre_px,
    glass_in,
    say_once,
    through_glass,
)
from hilstar.server.bench.least_psf import (
    WHOLE,
    Choice,
    first_within,
    least_psf,
    psf_choices,
)

NO_MISALIGNMENT = np.array([1.0, 0.0, 0.0, 0.0])
# Share of the screen that the tracker sees, and of the tracker's field that the screen fills. A
# bench may have 2 % of the one, or a field of ten screens; a length in another unit changes them a
# hundred times.
MIN_SEEN, MIN_FILLED = 0.015, 0.08
MAX_PIXELS = 10.0  # tracker pixels to a monitor pixel, or the reverse
# Limits of any bench: lenses are f/0.5 to f/21 (a factor of ten in one length mostly leaves this),
# the widest sees 100 degrees, collimators are not shorter than a microscope's objective and not
# longer than a room, pixels are those of the smallest sensors and of LED walls.
F_NUMBERS, MAX_FIELD_DEG, APERTURES_MM, COLLIMATORS_MM = (
    (0.5, 21.0),
    100.0,
    (0.3, 2000.0),
    (2.0, 50_000.0),
)
TRACKER_PITCHES_UM, MONITOR_PITCHES_UM = (0.5, 100.0), (1.0, 10_000.0)
TRUE_RATIOS = (0.5, 2.0)  # a length of [verify] to the same length elsewhere in the file
LENGTHS = (
    ("tracker", "aperture_mm"),
    ("tracker", "focal_length_mm"),
    ("tracker", "pixel_pitch_um"),
    ("monitor", "pixel_pitch_um"),
    ("collimator", "focal_length_mm"),
    ("verify", "true_focal_length_mm"),
    ("verify", "true_pixel_pitch_um"),
)
MM = {"um": 1e-3, "cm": 10.0, "inches": 25.4, "m": 1000.0}
UM = {"nm": 1e-3, "mm": 1e3, "cm": 1e4, "m": 1e6}
GRID = 64  # places along each side
MAX_MENDS = 3
# A unit is named where it leaves nothing implausible; where none does, one that takes away three
# quarters of it (in decades), if no other takes away much more.
MAX_LEFT, AS_GOOD = 0.25, 0.6
# along each side of the detector, where the PSFs that a display may draw are compared
FIELD_PLACES = 5
OBLIQUE, UM_PER_MM = 1e-3, 1e3
TINY = 1e-12  # a share of none, so that it has a logarithm
# far under a monitor pixel on the detector, by whose own squares light is spread
NO_OBJECTIVE_PX = 1e-3, 1e-3


def bench_camera(config: BenchConfig, folder: Path) -> Camera:
    """The monitor behind its collimator, by its geometry file where it has one. Raises
    InputError.
    """
    if config.collimator.geometry is None:
        return ideal_monitor(config)
    return real_monitor(config, folder, config.collimator.geometry)


def ideal_monitor(config: BenchConfig) -> Camera:
    """The monitor behind an ideal collimator, whatever geometry file the bench has."""
    return monitor_camera(
        config.monitor.resolution_px,
        config.monitor.pixel_pitch_um,
        config.collimator.focal_length_mm,
        np.array(config.collimator.q_cam_to_mon),
        config.collimator.principal_point_px,
    )


def display_psf(config: BenchConfig, folder: Path, display: Camera) -> Psf:
    """How a star is drawn on the monitor; where the tolerance decides, as if all of it were the
    PSF's. Raises InputError.
    """
    render = config.render
    tolerance = render.tolerance_mag, render.tolerance_px
    return first_within(display_psfs(config, folder, display), tolerance)[0]


def display_psfs(
    config: BenchConfig, folder: Path, display: Camera
) -> Iterator[tuple[Psf, Choice | None]]:
    """How a star may be drawn on the monitor, from the cheapest to the file's own; None where there
    is no choice.

    Raises InputError.
    """
    render = config.render
    if render.psf == GAUSSIAN:
        yield GaussianPsf(render.sprite_sigma_px), None
        return
    tracker = replace(config.tracker, effort="full")
    optics = tracker.optics
    camera = tracker_camera(tracker, folder)
    tracker_own = tracker_psf(tracker, folder)
    onto = Onto(display, camera)
    x_px, y_px = camera.grid_px(FIELD_PLACES)
    places_px = onto.places_px(np.stack([x_px, y_px], axis=1))
    if not np.isfinite(places_px).all():
        raise InputError(
            '[render] psf = "tracker": the tracker looks past the display; check [collimator]'
            " q_cam_to_mon"
        )
    try:
        if isinstance(tracker_own, GaussianPsf):
            spread = onto.matrix @ np.diag(np.square(tracker_own.sigma_px)) @ onto.matrix.T
            if abs(spread[0, 1]) > OBLIQUE * spread.trace():
                raise InputError(
                    "its Gaussian is oval and lies obliquely on the display; give [tracker.optics]"
                    " psf a file"
                )
            yield GaussianPsf((math.sqrt(spread[0, 0]), math.sqrt(spread[1, 1]))), None
            return
        if isinstance(tracker_own, SampledPsf) and tracker_own.pixel_integrated:
            raise InputError(
                "it has the tracker's pixel in it (PIXINT), which the detector adds again; give one"
                " without"
            )
        glass = glass_in(tracker, folder)
        if glass is not None:
            drawn: SampledPsf = bench_glass_psf(glass, tracker, folder, onto)
        else:
            image = read_psf(folder / optics.psf)
            samples, per_px = regridded(image.samples[None], image.per_px, onto.matrix)
            drawn = SampledPsf(samples[0], per_px)
        if render.effort == "auto":
            among = None
        else:
            among = frozenset((ONE_PSF, WHOLE))
        yield from psf_choices(drawn, places_px, among)
    except InputError as error:
        raise InputError(f'[render] psf = "tracker", with {optics.psf}: {error}') from error


def before_detector(config: BenchConfig, folder: Path, display: Camera) -> Psf:
    """How what lies between display and detector spreads a point, tracker pixels: the collimator,
    and the tracker's optics.

    A display that draws the tracker's PSF has a detector without its objective before it.
    """
    psf: Psf = GaussianPsf(NO_OBJECTIVE_PX)
    if config.render.psf == GAUSSIAN:
        psf = tracker_psf(config.tracker, folder)
    tracker = tracker_camera(config.tracker, folder)
    blur_px = config.collimator.psf_sigma_px * tracker.focal_length_px / display.focal_length_px
    if blur_px:
        return psf.blurred(blur_px)
    return psf


def tracker_psf(tracker: Tracker, folder: Path) -> Psf:
    """How the tracker's optics spread a star over its detector. Raises InputError for a file
    that is no PSF.
    """
    if tracker.optics.psf == GAUSSIAN:
        return GaussianPsf(tracker.psf_sigma_px)
    if tracker.psf_sigma_px != DEFAULT_PSF_SIGMA_PX:
        say_once(
            f"psf_sigma_px is not used: [tracker.optics] psf is {tracker.optics.psf}", "[tracker]"
        )
    glass = glass_in(tracker, folder)
    if glass is None:
        whole_psf = read_psf(folder / tracker.optics.psf)
    else:
        whole_psf = bench_glass_psf(glass, tracker, folder)
    if tracker.effort == "full":
        return whole_psf
    tolerance = tracker.tolerance_mag, tracker.tolerance_px
    least, choice = least_tracker_psf(whole_psf, tracker.resolution_px, tolerance)
    say_once(choice.line(), "[tracker] effort")
    return least


@lru_cache(maxsize=4)
def least_tracker_psf(
    own: SampledPsf, size_px: tuple[int, int], tolerance: tuple[float, float]
) -> tuple[Psf, Choice]:
    """The least PSF that `[tracker] effort = "auto"` allows, and why."""
    width, height = size_px
    x_px = np.linspace(0, width - 1, FIELD_PLACES)
    y_px = np.linspace(0, height - 1, FIELD_PLACES)
    columns, rows = np.meshgrid(x_px, y_px)
    places_px = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return least_psf(own, places_px, tolerance)


def real_monitor(config: BenchConfig, folder: Path, path: str) -> Camera:
    """The monitor as a geometry file has it, bounded to what sprites on it need. Raises
    InputError.
    """
    camera = load_geometry(folder / path, config.monitor.resolution_px)
    if config.render.psf == GAUSSIAN:
        footprint_px = GaussianPsf(config.render.sprite_sigma_px).footprint_px
    else:
        tracker = config.tracker
        tracker_focal_px = tracker.focal_length_mm * UM_PER_MM / tracker.pixel_pitch_um
        ratio = camera.focal_length_px / tracker_focal_px
        footprint_px = math.ceil(ratio * tracker_psf(tracker, folder).footprint_px) + 1
    return _bounded(camera, footprint_px / 2 + 1, folder / path)


def tracker_camera(tracker: Tracker, folder: Path) -> Camera:
    """The tracker, with its flight model where it has one, else its glass's distortion. Raises
    InputError.
    """
    optics = tracker.optics
    if optics.focus_um_per_k and optics.psf == GAUSSIAN:
        raise InputError(
            "[tracker.optics] focus_um_per_k: a Gaussian has no focus; give psf a file, or leave"
            " it out"
        )
    longer = 1 + optics.focal_length_ppm_per_k * 1e-6 * optics.warmer_k
    camera = monitor_camera(
        tracker.resolution_px,
        tracker.pixel_pitch_um,
        tracker.focal_length_mm * longer,
        NO_MISALIGNMENT,
        tracker.principal_point_px,
    )
    right, down = decentre_px(tracker)
    if right or down:
        x, y = camera.principal_point_px
        camera = dataclasses.replace(camera, principal_point_px=(x + right, y + down))
    path = folder / (tracker.distortion or tracker.optics.psf)
    if tracker.distortion is not None:
        camera = load_distortion(path, camera)
    camera = through_glass(camera, tracker, folder)
    if camera.lens is None:
        return camera
    footprint_px = tracker_psf(tracker, folder).footprint_px
    return _bounded(camera, footprint_px / 2 + 1, path)


def flight_camera(tracker: Tracker, folder: Path, true: Camera) -> Camera:
    """The `true` tracker as its software knows it: at the reference temperature, the lens in its
    place. Raises InputError.
    """
    optics = replace(
        tracker.optics,
        temperature_k=tracker.optics.reference_temperature_k,
        decentre_x_um=0.0,
        decentre_y_um=0.0,
    )
    if optics == tracker.optics:
        return true
    return tracker_camera(replace(tracker, optics=optics), folder)


def _bounded(camera: Camera, margin_px: float, path: Path) -> Camera:
    try:
        return bounded(camera, margin_px)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


@dataclass(frozen=True, slots=True)
class FieldsOfView:
    """Width and height of what screen and tracker see, the monitor's pixel in the tracker's, the
    parts that they share.

    `screen_seen` is the share of the screen in the tracker's field, `field_on_screen` that of the
    field on the screen. `warning` says which length cannot be right; None where all may be.
    """

    screen_deg: tuple[float, float]
    tracker_deg: tuple[float, float]
    tracker_px_a_monitor_px: float
    screen_seen: float
    field_on_screen: float
    warning: str | None = None

    def line(self) -> str:
        """ "screen 18.0 x 10.2 deg, tracker 10.9 deg, 0.89 tracker px a monitor px"."""
        screen = " x ".join(map(figure, self.screen_deg))
        width, height = map(figure, self.tracker_deg)
        tracker = width if width == height else f"{width} x {height}"
        pixel = figure(self.tracker_px_a_monitor_px)
        return f"screen {screen} deg, tracker {tracker} deg, {pixel} tracker px a monitor px"

    def keys(self) -> dict[str, Any]:
        """The fields of view as --json has them."""
        return asdict(self)


def fields_of_view(config: BenchConfig, folder: Path) -> FieldsOfView:
    """The fields of view of a bench's screen and tracker, with a warning where a length cannot
    be right. Raises InputError.
    """
    fields = _measured(config, folder)
    odd = list(_oddities(config, fields))
    if not odd:
        return fields
    decades = sum(oddity.decades for oddity in odd)
    mends = _mends(config, folder, decades)[:MAX_MENDS]
    if mends:
        advice = f"is {', or '.join(mends)}?"
    else:
        advice = "check the units of its lengths (_mm, _um) and its resolutions"
    return dataclasses.replace(fields, warning=f"{odd[0].text}; {advice}")


def _measured(config: BenchConfig, folder: Path) -> FieldsOfView:
    screen = bench_camera(config, folder)
    tracker = tracker_camera(config.tracker, folder)
    return FieldsOfView(
        screen_deg=_sides_deg(screen),
        tracker_deg=_sides_deg(tracker),
        tracker_px_a_monitor_px=tracker.focal_length_px / screen.focal_length_px,
        screen_seen=_share(screen, tracker),
        field_on_screen=_share(tracker, screen),
    )


def _sides_deg(camera: Camera) -> tuple[float, float]:
    """The angles between the middles of the left and right, and of the top and bottom edge."""
    width, height = camera.resolution_px
    x = (width - 1) / 2
    y = (height - 1) / 2
    x_px = np.array([-0.5, width - 0.5, x, x])
    y_px = np.array([y, y, -0.5, height - 0.5])
    left, right, top, bottom = camera.rays(x_px, y_px)
    across_deg = _angle_deg(left, right)
    down_deg = _angle_deg(top, bottom)
    # Beyond the directions that a lens is known for, those of a pinhole stand for its own.
    if math.isnan(across_deg):
        across_deg = math.degrees(2 * math.atan(width / 2 / camera.focal_length_px))
    if math.isnan(down_deg):
        down_deg = math.degrees(2 * math.atan(height / 2 / camera.focal_length_px))
    return across_deg, down_deg


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    sine = np.linalg.norm(np.cross(a, b))
    return math.degrees(math.atan2(sine, float(a @ b)))


def _share(of: Camera, within: Camera) -> float:
    """The share of an image's pixels whose directions are on the image of another camera."""
    middles = (np.arange(GRID) + 0.5) / GRID
    width, height = of.resolution_px
    columns, rows = np.meshgrid(middles * width - 0.5, middles * height - 0.5)
    rays = of.rays(columns.ravel(), rows.ravel())
    with np.errstate(invalid="ignore", over="ignore"):
        inside = within.contains_px(*within.project(rays @ within.cam_to_image.T))
    return float(inside.mean())


class _Oddity(NamedTuple):
    """A length or ratio of a bench that cannot be right, in words, and by how many decades it is
    off.
    """

    text: str
    decades: float


def _decades_outside(value: float, limits: tuple[float, float]) -> float:
    """How far a value is outside limits, in decades; 0 within them."""
    low, high = limits
    positive = max(value, TINY)
    return max(0.0, math.log10(low / positive), math.log10(positive / high))


def _oddities(config: BenchConfig, found: FieldsOfView) -> Iterator[_Oddity]:
    """Lengths that cannot be right, the plainest first."""
    tracker = config.tracker
    monitor = config.monitor
    verify = config.verify
    pixels = found.tracker_px_a_monitor_px
    widest_deg = max(*found.screen_deg, *found.tracker_deg)
    line = found.line()
    on_screen = _percent(found.field_on_screen)
    past = f"the tracker sees past the screen: {on_screen} of its field is on it ({line})"
    part = f"the tracker sees {_percent(found.screen_seen)} of the screen ({line})"
    pixel = f"a monitor pixel is {figure(pixels)} of the tracker's ({line})"
    judged = [
        (past, found.field_on_screen, (MIN_FILLED, 1.0)),
        (part, found.screen_seen, (MIN_SEEN, 1.0)),
        (pixel, pixels, (1 / MAX_PIXELS, MAX_PIXELS)),
    ]
    for name, value, (low, high), unit in (
        ("the tracker's lens", tracker.focal_length_mm / tracker.aperture_mm, F_NUMBERS, "f/"),
        ("[tracker] aperture_mm", tracker.aperture_mm, APERTURES_MM, ""),
        ("[tracker] pixel_pitch_um", tracker.pixel_pitch_um, TRACKER_PITCHES_UM, ""),
        ("[monitor] pixel_pitch_um", monitor.pixel_pitch_um, MONITOR_PITCHES_UM, ""),
        ("[collimator] focal_length_mm", config.collimator.focal_length_mm, COLLIMATORS_MM, ""),
    ):
        text = (
            f"{name} is {unit}{figure(value)}, and none is known outside {unit}{low:g} to"
            f" {unit}{high:g}"
        )
        judged.append((text, value, (low, high)))
    text = f"{figure(widest_deg)} deg is wider than a lens sees ({line})"
    # Fields are compared as a flat screen has them: by the tangent of the half angle.
    widest = math.tan(math.radians(widest_deg) / 2)
    max_field = math.tan(math.radians(MAX_FIELD_DEG) / 2)
    judged.append((text, widest, (TINY, max_field)))
    for key, true, stated in (
        ("true_focal_length_mm", verify.true_focal_length_mm, config.collimator.focal_length_mm),
        ("true_pixel_pitch_um", verify.true_pixel_pitch_um, monitor.pixel_pitch_um),
    ):
        if true is not None:
            text = f"[verify] {key} is {true:.6g}, and elsewhere this file says {stated:.6g}"
            judged.append((text, true / stated, TRUE_RATIOS))
    for text, value, limits in judged:
        decades = _decades_outside(value, limits)
        if decades > 0:
            yield _Oddity(text, decades)


def _mends(config: BenchConfig, folder: Path, decades: float) -> list[str]:
    """Each length that makes the bench plausible, or nearly so, if it is another quantity, or in
    another unit, with that.

    What else is odd of a bench may stay: the length that takes most away is named, and those that
    take as much.
    """
    rest_decades: dict[str, float] = {}
    for text, changed in _readings(config):
        try:
            fields = _measured(changed, folder)
        except InputError:  # such a lens leaves the screen
            continue
        rest_decades[text] = sum(oddity.decades for oddity in _oddities(changed, fields))
    smallest = min(rest_decades.values(), default=math.inf)
    if smallest == 0:
        limit = 0.0
    else:
        limit = min(MAX_LEFT * decades, smallest + AS_GOOD)
    return [text for text, rest in rest_decades.items() if rest <= limit]


def _readings(config: BenchConfig) -> Iterator[tuple[str, BenchConfig]]:
    """The bench with one length read as another quantity or in another unit, and what was
    written then.
    """
    tracker = config.tracker
    if F_NUMBERS[0] <= tracker.aperture_mm < F_NUMBERS[1]:
        written = f"[tracker] aperture_mm = {tracker.aperture_mm:.6g}"
        aperture_mm = tracker.focal_length_mm / tracker.aperture_mm
        text = f"{written} the f-number, which is {aperture_mm:.6g}"
        yield text, replace(config, tracker=replace(tracker, aperture_mm=aperture_mm))
    for table, key in LENGTHS:
        settings = getattr(config, table)
        value = getattr(settings, key)
        for unit, factor in (MM if key.endswith("_mm") else UM).items():
            if value is None:
                continue
            text = f"[{table}] {key} = {value:.6g} in {unit}, which is {value * factor:.6g}"
            yield text, replace(config, **{table: replace(settings, **{key: value * factor})})


def figure(value: float) -> str:
    """One digit after the point, two figures of a small number, four of a large one."""
    if 0.95 <= value < 1000:
        return f"{value:.1f}"
    if value < 1:
        return f"{value:.2g}"
    return f"{value:.4g}"


def _percent(share: float) -> str:
    return "none" if share == 0 else f"{100 * share:.2g} %"
