"""The steps that find where the tracker sees each pixel: orientation, focus, geometry."""

import itertools
import math
from dataclasses import astuple, dataclass, replace
from operator import ne
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from hilstar.arrays import FloatArray
from hilstar.calibrate.effective_psf import dots_of_image, draw_effective, fit_effective
from hilstar.calibrate.first_light.context import (
    DarkSubtracted,
    Figure,
    KeyChange,
    StepContext,
    StepNumber,
    StepOutcome,
    with_changes,
)
from hilstar.calibrate.first_light.image_sources import Pattern, black
from hilstar.calibrate.geometric.calibration import calibrate_files, notes_for_a_person, parameters_of, write_calibrated
from hilstar.calibrate.geometric.dots import DOT_PX, DotPlan, dot_image, plan_dots, write_plan
from hilstar.charts import DARK, ORANGE, TEXT_PT, chart
from hilstar.errors import InputError
from hilstar.files import make_directory
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background
from hilstar.twin.optics import BenchGeometry
from hilstar.units import ERROR_OF_MEDIAN

FIGURE_REACH = 0.25  # half the figure's side, relative to the smaller side of what both screen and tracker have
SQUARE_TRACKER_PX = 2.5  # side of its smallest square as the tracker sees it
SQUARES = (3, 2, 1)  # sides of the squares at the corner, to its right and below it, in those of the smallest


@dataclass(frozen=True, slots=True)
class OrientationFigure:
    """An asymmetric figure: squares of three sizes at a corner, to its right and below it, (3,) monitor px."""

    x_px: FloatArray
    y_px: FloatArray
    side_px: int
    reach_px: float

    def pattern(self, name: str, resolution_px: tuple[int, int], code: int) -> Pattern:
        """The figure in squares of `code`."""
        codes = black(resolution_px)
        for x, y, sides in zip(self.x_px, self.y_px, SQUARES, strict=True):
            half = self.side_px * sides / 2
            codes[round(y - half) : round(y + half), round(x - half) : round(x + half)] = code
        return Pattern(name, codes)


def figure_for(geometry: BenchGeometry) -> OrientationFigure:
    """The figure in the middle of what the bench file's ideal lens shows the tracker. Raises InputError without space."""
    monitor, tracker = geometry.monitor, geometry.tracker
    ratio = monitor.focal_length_px / tracker.focal_length_px
    reach = FIGURE_REACH * min(*monitor.resolution_px, *(ratio * size for size in tracker.resolution_px))
    side = max(3, math.ceil(SQUARE_TRACKER_PX * ratio))
    if reach < SQUARES[0] * side:
        raise InputError("the tracker sees too little of the monitor for a figure; look at the focal lengths and pixel pitches")
    (middle_x,), (middle_y,) = geometry.to_monitor(*(np.array([(size - 1) / 2]) for size in tracker.resolution_px))
    width, height = monitor.resolution_px
    if not (abs(middle_x - width / 2) < width / 4 and abs(middle_y - height / 2) < height / 4):
        middle_x, middle_y = (width - 1) / 2, (height - 1) / 2
    x_px, y_px = middle_x + reach * np.array([-1.0, 1.0, -1.0]), middle_y + reach * np.array([-1.0, -1.0, 1.0])
    return OrientationFigure(x_px, y_px, side, reach)


THRESHOLD_SIGMA = 8.0
MIN_PIXELS = 3
MAX_MISFIT = 0.5  # from the nearest of the eight orientations; half way to another one is 1
MAX_SCALE = 2.0
MIN_SIZE_STEP = 1.3  # between the pixels of one square and the next
UPRIGHT = (1, 0, 0, 1)
WAYS = {
    UPRIGHT: "upright",
    (-1, 0, 0, 1): "mirrored left to right",
    (1, 0, 0, -1): "mirrored top to bottom",
    (-1, 0, 0, -1): "turned by 180 degrees",
    (0, -1, 1, 0): "turned by 90 degrees clockwise",
    (0, 1, -1, 0): "turned by 270 degrees clockwise",
    (0, 1, 1, 0): "with columns and rows swapped",
    (0, -1, -1, 0): "with columns and rows swapped, and turned by 180 degrees",
}
CORNERS = {(-1, -1): "top left", (1, -1): "top right", (-1, 1): "bottom left", (1, 1): "bottom right"}
SIDES = {(1, 0): "to its right", (-1, 0): "to its left", (0, 1): "below it", (0, -1): "above it"}
NOT_SEEN = "show the monitor to the whole of the tracker's field, expose longer, and look at the focus"


@dataclass(frozen=True, slots=True)
class SeenFigure:
    """The figure in the tracker's image: its orientation (a 2 x 2 matrix, row by row), scale, remaining turn and squares.

    The turn's error is half of what the figure's two sides disagree by.
    """

    way: tuple[int, int, int, int]
    scale: float
    turn_deg: float
    turn_error_deg: float
    x_px: FloatArray
    y_px: FloatArray


def see_figure(image: FloatArray, figure: OrientationFigure, geometry: BenchGeometry) -> SeenFigure:
    """Find the figure in a tracker's image (h, w) above its dark frame, by the bench file's lens.

    Raises InputError where it is not there, or not as large as the focal lengths say.
    """
    settings = CentroidSettings(threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=MIN_PIXELS)
    found = find_stars(image, settings, noisiest_background(image))
    if len(found) < len(figure.x_px):
        raise InputError(f"{len(found)} of the figure's three squares are in the image; {NOT_SEEN}")
    largest = np.argsort(-found.pixels, kind="stable")[:3]
    sizes = found.pixels[largest]
    if (sizes[:-1] < MIN_SIZE_STEP * sizes[1:]).any():
        counts = ", ".join(map(str, sizes))
        raise InputError(
            f"the three largest spots have {counts} pixels and cannot be told apart; look at focus and stray light"
        )
    x_px, y_px = found.x_px[largest], found.y_px[largest]
    shown_x, shown_y = geometry.to_monitor(x_px, y_px)
    corner, right, below = np.stack([shown_x, shown_y], axis=1)
    seen = np.column_stack([right - corner, below - corner]) / (2 * figure.reach_px)
    scale = float(np.sqrt(abs(np.linalg.det(seen))))
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        raise InputError(f"the figure is {scale:.2f} times as large as the bench file says; look at focal lengths and pitches")
    ways = {way: np.array(way, dtype=np.float64).reshape(2, 2) for way in WAYS}
    way = max(ways, key=lambda each: float((ways[each] * seen).sum()))
    left = np.linalg.inv(ways[way]) @ seen / scale
    if np.linalg.norm(left - np.eye(2)) > MAX_MISFIT:
        raise InputError("the figure is turned by no right angle; turn the tracker or the screen to within 15 degrees")
    turn = float(np.degrees(np.arctan2(left[1, 0] - left[0, 1], left[0, 0] + left[1, 1])))
    sides = np.degrees([np.arctan2(left[1, 0], left[0, 0]), np.arctan2(-left[0, 1], left[1, 1])])
    return SeenFigure(way, scale, turn, abs(float(sides[0] - sides[1])) / 2, x_px, y_px)


def keys_of_ways() -> dict[str, tuple[int, int, int, int]]:
    """The key to press for each orientation; the first is upright."""
    return {str(number): way for number, way in enumerate(WAYS, start=1)}


def look_of(way: tuple[int, int, int, int]) -> str:
    """Where the figure's squares appear in this orientation, in words."""
    right, below = (way[0], way[2]), (way[1], way[3])
    corner = CORNERS[-right[0] - below[0], -right[1] - below[1]]
    return f"the largest square {corner}, the next one {SIDES[right]}, the smallest {SIDES[below]} ({WAYS[way]})"


@dataclass(frozen=True, slots=True)
class ScreenMounting:
    """How the screen is mounted: keys of [monitor]."""

    flip_x: bool
    flip_y: bool
    rotate_deg: int

    @property
    def matrix(self) -> FloatArray:
        """The matrix (2, 2) from the image's axes to the screen's, x right and y down."""
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), self.rotate_deg // 90)
        return np.asarray(np.diag([-1.0 if self.flip_x else 1.0, -1.0 if self.flip_y else 1.0]) @ turn)


def corrected(mounting: ScreenMounting, way: tuple[int, int, int, int]) -> ScreenMounting:
    """The mounting that turns an image seen in orientation `way` upright, with the fewest keys changed."""
    wanted = mounting.matrix @ np.linalg.inv(np.array(way, dtype=np.float64).reshape(2, 2))
    flips = (False, True)
    all_ways = [ScreenMounting(x, y, turn) for x, y, turn in itertools.product(flips, flips, (0, 90, 180, 270))]
    right = [each for each in all_ways if np.allclose(each.matrix, wanted)]
    return min(right, key=lambda each: (sum(map(ne, astuple(each), astuple(mounting))), each.flip_y, each.rotate_deg))


MIN_DOTS = 5
ROUNDS = 40
RADIUS_PX = 10
START_SIGMA_PX = 1.5
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.25, 5.0
MODEL_SIGMAS_PX = np.geomspace(0.15, 6.0, 28)
MODEL_PHASES = 4  # places of a dot within a tracker pixel, along each axis
MODEL_POINTS = 9  # in a dot, along each axis


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Dots in the tracker's image: places (n,), the sigma of each (n,), and the PSF's sigma by each (n,), tracker px.

    The dot's own width is removed from the PSF's sigma; `psf_sigma_px` is the median.
    """

    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray
    each_psf_sigma_px: FloatArray
    psf_sigma_px: float
    dot_side_px: float


def sharpness(image: FloatArray, dot_side_px: float) -> Sharpness:
    """Measure the sharpness of dots in an image (h, w) above its dark frame; a dot is a square of `dot_side_px` tracker px.

    Raises InputError where too few dots are there.
    """
    settings = CentroidSettings(threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=2, window_sigma_px=1.5)
    found = find_stars(image, settings, noisiest_background(image))
    kept = ~found.at_edge
    x_px, y_px = found.x_px[kept], found.y_px[kept]
    if len(x_px) < MIN_DOTS:
        raise InputError(f"{len(x_px)} dots are in the image and {MIN_DOTS} are needed; expose longer, or look at the focus")
    level = float(np.median(image))
    sigma_px = _sigmas(np.pad(image - level, RADIUS_PX), x_px, y_px)
    expected = [_model_sigma(float(psf), dot_side_px) for psf in MODEL_SIGMAS_PX]
    each = np.interp(sigma_px, np.maximum.accumulate(expected), MODEL_SIGMAS_PX)
    return Sharpness(x_px, y_px, sigma_px, each, float(np.median(each)), dot_side_px)


def _model_sigma(psf_sigma_px: float, dot_side_px: float) -> float:
    """The sigma measured of a square dot under a PSF of `psf_sigma_px`, averaged over places within a pixel."""
    side = 4 * RADIUS_PX + 1
    phase = (np.arange(MODEL_PHASES) + 0.5) / MODEL_PHASES - 0.5
    point = ((np.arange(MODEL_POINTS) + 0.5) / MODEL_POINTS - 0.5) * dot_side_px
    edge = np.arange(side + 1) - 2 * RADIUS_PX - 0.5 - phase[:, None, None] - point[:, None]
    profile = np.diff(ndtr(edge / psf_sigma_px), axis=2).mean(axis=1)  # (phases, side)
    tiles = profile[:, None, :, None] * profile[None, :, None, :]
    strip = tiles.reshape(-1, side, side).transpose(1, 0, 2).reshape(side, -1)
    down, right = (part.ravel() for part in np.meshgrid(phase, phase, indexing="ij"))
    x_px = np.arange(MODEL_PHASES**2) * side + 2 * RADIUS_PX + right
    return float(np.median(_sigmas(np.pad(strip, RADIUS_PX), x_px, 2 * RADIUS_PX + down)))


def _sigmas(padded: FloatArray, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The sigma (n,) of each spot by its second moment under a Gaussian window of that same sigma, found by repetition.

    Under a window of its own width a Gaussian's moment is half of its variance (Bernstein and Jarvis 2002, section 3).
    """
    reach = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    column, row = (np.rint(place).astype(np.intp)[:, None] + reach for place in (x_px, y_px))
    values = padded[row[:, :, None] + RADIUS_PX, column[:, None, :] + RADIUS_PX]
    r2 = (column - x_px[:, None])[:, None, :] ** 2 + (row - y_px[:, None])[:, :, None] ** 2
    variance = np.full(len(x_px), START_SIGMA_PX**2)
    for _ in range(ROUNDS):
        weighted = values * np.exp(-0.5 * r2 / variance[:, None, None])
        total = np.maximum(weighted.sum(axis=(1, 2)), 1e-9)
        # The windowed moment over both axes is twice that of one axis, which is half of the variance.
        found = (weighted * r2).sum(axis=(1, 2)) / total
        variance = np.clip(found, MIN_SIGMA_PX**2, MAX_SIGMA_PX**2)
    return np.asarray(np.sqrt(variance))


PLAN_SEED = 0
FRAMES = 20
MIN_LIT, MAX_LIT = 12, 60  # dots in a frame
TRACKER_PX_A_DOT = 40.0  # tracker px between neighbouring dots of a frame
OVERSAMPLING = 4  # for the effective PSF
BLURRED = 1.3  # times the bench file's sigma
BLURRED_BY_PX = 0.1


def orientation(context: StepContext) -> StepOutcome:
    """Find how the screen is mounted, set the bench file's keys, and check that the figure is upright. Raises InputError."""
    monitor = context.file.config.monitor
    before = ScreenMounting(monitor.flip_x, monitor.flip_y, monitor.rotate_deg)
    first, measured = _way(context, "figure_000")
    after = corrected(before, first)
    keys = ("flip_x", "flip_y", "rotate_deg")
    changes = tuple(change for key in keys for change in context.change("monitor", key, getattr(after, key)))
    if (before.rotate_deg - after.rotate_deg) % 180:
        width, height = monitor.resolution_px
        changes += (KeyChange(table="monitor", key="resolution_px", before=[width, height], after=[height, width]),)
    if changes:
        now, measured = _way(replace(context, file=with_changes(context.file, changes)), "figure_001")
        if now != UPRIGHT:
            made = "; ".join(change.line for change in changes)
            raise InputError(f"after {made} the figure is {WAYS[now]}; is it the same screen?")
    way = f"first {WAYS[first]}, now upright" if changes else "upright"
    if measured is None:
        figures: dict[str, Figure] = {"seen": WAYS[first], "told_by": "a key"}
        return StepOutcome("done", f"{way}, as a person saw it", figures, changes=changes)
    found, looked = measured
    picture = context.session / "orientation.svg"
    draw_spots(picture, looked.image, found.x_px, found.y_px, f"the figure as the tracker sees it: {way}")
    figures = {"seen": WAYS[first], "scale": found.scale, "turn_deg": found.turn_deg, "turn_error_deg": found.turn_error_deg}
    line = f"{way}, {found.scale:.4f} of the expected size, turned by {found.turn_deg:+.2f} deg"
    number = StepNumber(found.turn_deg, found.turn_error_deg, "deg", "turn of the figure that is left")
    return StepOutcome("done", line, figures, (looked.path, picture), (picture,), changes, number)


def _way(context: StepContext, name: str) -> tuple[tuple[int, int, int, int], tuple[SeenFigure, DarkSubtracted] | None]:
    """The figure's orientation, and its measurement; None where a person pressed a key instead."""
    geometry = context.geometry()
    figure = figure_for(geometry)
    pattern, keys = figure.pattern(name, context.resolution_px, context.white), keys_of_ways()
    told = context.take_or_key(pattern, {key: look_of(way) for key, way in keys.items()})
    if isinstance(told, str):
        return keys[told], None
    looked = context.looked(told, context.read(context.dark()))
    found = see_figure(looked.image, figure, geometry)
    return found.way, (found, looked)


def dots_for(context: StepContext) -> DotPlan:
    """Plan as many dots as this tracker can tell apart on this screen. Raises InputError."""
    geometry = context.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    seen = [min(ratio * wide, size) for wide, size in zip(context.resolution_px, geometry.tracker.resolution_px, strict=True)]
    lit = int(np.clip(seen[0] * seen[1] / TRACKER_PX_A_DOT**2, MIN_LIT, MAX_LIT))
    return plan_dots(context.resolution_px, FRAMES, lit, np.random.default_rng(PLAN_SEED))


def focus(context: StepContext) -> StepOutcome:
    """Measure the PSF by dots of the brightest code that does not saturate the tracker. Raises InputError."""
    code, found, looked = sharp_dots(context)
    wanted = float(np.hypot(*context.tracker_psf.width_px) / np.sqrt(2))
    picture, sigma = context.session / "focus.svg", found.psf_sigma_px
    finding = f"PSF sigma {sigma:.3f} px (median of {len(found.x_px)} dots), [tracker] psf_sigma_px is {wanted:g}"
    with chart(picture, finding, height_inch=6.0) as (axes,):
        dots = axes.scatter(found.x_px, found.y_px, c=found.each_psf_sigma_px, cmap="viridis", s=60)
        axes.figure.colorbar(dots, ax=axes, label="PSF sigma [tracker px]")
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()
    figures: dict[str, Figure] = {
        "psf_sigma_px": sigma,
        "psf_sigma_error_px": ERROR_OF_MEDIAN * float(np.std(found.each_psf_sigma_px)) / math.sqrt(len(found.x_px)),
        "dot_sigma_px": float(np.median(found.sigma_px)),
        "dots": len(found.x_px),
        "dot_code": code,
    }
    files: tuple[Path, ...] = looked.path, picture
    pictures: tuple[Path, ...] = (picture,)
    line = f"PSF sigma {sigma:.3f} px, the bench file says {wanted:g}; dots at code {code}"
    try:
        effective = fit_effective(dots_of_image(looked.image, found.x_px, found.y_px, found.dot_side_px), OVERSAMPLING)
    except InputError:  # too few dots stand alone: the width alone is known
        pass
    else:
        drawn = context.session / "psf.svg"
        draw_effective(drawn, effective)
        files, pictures = (*files, drawn), (picture, drawn)
        figures["effective_psf_rms"] = effective.chosen.rms
        line += f"; {'more than' if effective.asks_for_more else 'no more than'} a Gaussian over the field"
    number = StepNumber(sigma, float(figures["psf_sigma_error_px"]), "px", f"PSF sigma; the bench file says {wanted:g}")
    if sigma > BLURRED * wanted + BLURRED_BY_PX:
        cure = "turn the focus until this figure is smallest (--again focus), or write [tracker] psf_sigma_px as it is"
        return StepOutcome("failed", f"{line}: {cure}", figures, files, pictures, number=number)
    return StepOutcome("done", line, figures, files, pictures, number=number)


class SharpDots(NamedTuple):
    """The brightest code that does not saturate the tracker, how sharp dots of it are, and their image."""

    code: int
    sharpness: Sharpness
    looked: DarkSubtracted


def sharp_dots(context: StepContext) -> SharpDots:
    """Lower the dots' code until they do not saturate the tracker, and measure them. Raises InputError."""
    geometry, plan, code = context.geometry(), dots_for(context), context.white
    dark = context.read(context.dark())
    for number in range(context.file.config.monitor.bits * 2):
        codes = dot_image(plan, 0, context.resolution_px, code)
        looked = context.look(Pattern(f"dots_{number:03}", codes), dark)
        if not context.is_too_bright(looked):
            break
        code = context.darker(code)
    side = DOT_PX * geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    return SharpDots(code, sharpness(looked.image, side), looked)


SQUARE_NAMES = ("corner", "right", "below")


def draw_spots(path: Path, image: FloatArray, x_px: FloatArray, y_px: FloatArray, finding: str) -> None:
    """Draw an image of the tracker (h, w) with a ring about each spot found."""
    with chart(path, finding, height_inch=6.4) as (axes,):
        low, high = (float(value) for value in np.percentile(image, (5, 99.9)))
        axes.imshow(np.sqrt(np.clip(image - low, 0, None)), cmap="gray", vmax=np.sqrt(max(high - low, 1.0)))
        axes.scatter(x_px, y_px, s=260, facecolors="none", edgecolors=DARK[ORANGE], linewidths=1.8)
        plate = {"facecolor": "black", "edgecolor": "none", "boxstyle": "round,pad=0.25"}  # readable over stars and on black
        for name, x, y in zip(SQUARE_NAMES, x_px[:3], y_px[:3], strict=False):
            side = "right" if x > image.shape[1] / 2 else "left"
            away = -14 if side == "right" else 14
            axes.annotate(
                name, (x, y), (away, 16), textcoords="offset points", ha=side, color=DARK[ORANGE], size=TEXT_PT + 1, bbox=plate
            )
        axes.grid(visible=False)
        axes.set(xlabel="tracker x [px]", ylabel="tracker y [px]")


def geometry(context: StepContext) -> StepOutcome:
    """Fit lens, tilt and alignment to dots, and name the geometry file in the bench file. Raises InputError."""
    code = int(context.known.get("focus.dot_code", 0)) or sharp_dots(context).code
    plan = dots_for(context)
    make_directory(context.folder)
    write_plan(context.folder / "plan.csv", plan)
    dark = context.dark()
    paths = [
        context.take(Pattern(f"frame_{frame:03}", dot_image(plan, frame, context.resolution_px, code)))
        for frame in range(plan.frames)
    ]
    ideal = context.file.config.tracker.distortion is None
    found = calibrate_files(context.file, paths, context.folder / "plan.csv", dark, tracker_is_ideal=ideal)
    output, picture = context.session / "geometry.toml", context.session / "geometry.svg"
    write_calibrated(output, found, picture, context.source.monitor)
    chosen, error = found.chosen, found.uncertainty
    figures: dict[str, Figure] = {
        "model": chosen.name,
        "held_out_rms_arcsec": chosen.rms_arcsec,
        "held_out_max_arcsec": chosen.max_arcsec,
        "error_rms_arcsec": error.rms_arcsec,
        "error_max_arcsec": error.max_arcsec,
        "noise_px": found.problem.noise_px,
        "dots_recognised": found.recognised,
        "dots_planned": len(found.plan),
        "centroids_lost": int(found.lost),
        "centroids_false": int(found.false),
        **{name: each.value for name, each in parameters_of(found).items() if "rotation" not in name},
        "notes": "; ".join(notes_for_a_person(found)) or "none",
    }
    line = (
        f"{chosen.name}: held-out dots {chosen.rms_arcsec:.2f} arcsec rms, {chosen.max_arcsec:.2f} max;"
        f" a star's place is known to {error.rms_arcsec:.2f} arcsec rms"
    )
    files = (output, picture, context.folder / "plan.csv", dark, *paths)
    rms, points = chosen.rms_arcsec, len(found.data)
    number = StepNumber(rms, rms / math.sqrt(4 * points), "arcsec", "rms distance of held-out dots from where the fit has them")
    return StepOutcome("done", line, figures, files, (picture,), context.names("collimator", "geometry", output), number)
