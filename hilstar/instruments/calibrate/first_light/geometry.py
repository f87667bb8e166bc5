"""The steps of first light that find where the tracker sees the monitor's pixels: the orientation
of the screen, and the geometry.
"""

import itertools
import math
from dataclasses import astuple, dataclass, replace
from operator import ne
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import DARK, ORANGE, TEXT_PT, chart
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.basics.rotation import from_matrix
from hilstar.instruments.calibrate.first_light.context import (
    SEEN_FOCAL,
    SEEN_Q,
    DarkSubtracted,
    Figure,
    FittedFigure,
    KeyChange,
    StepContext,
    StepNumber,
    StepOutcome,
    with_changes,
)
from hilstar.instruments.calibrate.first_light.focus import PLAN_SEED, dot_code, first_dots
from hilstar.instruments.calibrate.first_light.image_sources import Pattern, black
from hilstar.instruments.calibrate.geometric.dots import (
    DotPlan,
    dot_image,
    joined,
    lit_for,
    plan_seen_dots,
    write_plan,
)
from hilstar.instruments.calibrate.geometric.fit import FIELD_DEGREES
from hilstar.instruments.calibrate.geometric.geometry_fit import (
    Calibrated,
    calibrate_seen,
    dot_sigma_px,
    notes_for_a_person,
    parameters_of,
    rough_geometry,
    write_calibrated,
)
from hilstar.instruments.calibrate.geometric.observed import Observed, measure_images
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background, squares

# An orientation: a matrix (2, 2), row by row, whose columns are the directions (x right, y down) in
# which the screen's right and its down appear to the tracker.
Way = tuple[int, int, int, int]
# half the figure's side, relative to the smallest side of the screen and of the tracker's field
FIGURE_REACH = 0.25
SQUARE_TRACKER_PX = 2.5  # side of the smallest square in the tracker's image
# sides of the squares at the corner, to its right and below it, in sides of the smallest
SQUARES = (3, 2, 1)
THRESHOLD_SIGMA = 8.0
MIN_PIXELS = 3
MAX_STRETCH = 1.25  # of the figure's one side to its other: a tilt of 35 degrees
# Error of a square's centroid in the tracker's image, because of the threshold and the lens.
SPOT_ERROR_PX = 0.1
MAX_SCALE = 2.0  # largest ratio of the figure's size to the expected one, or the inverse
# Smallest ratio of the light of one square to that of the next. The squares have 9, 4 and 1 parts
# of light, however wide the PSF is.
MIN_LIGHT_STEP = 1.3
WINDOW_SIDES = 0.75  # half the side of a square's window, in sides of the largest spot
DRAWN_PX = 1460  # along the longer side of an image in a chart: twice its width
MAX_SPOTS = 12  # the largest, of which the three brightest are the squares
UPRIGHT = (1, 0, 0, 1)
QUARTER_TURNS_DEG = {(0, -1, 1, 0): 90.0, (0, 1, -1, 0): -90.0}
OBLIQUE_DEG = 40.0  # a figure turned by more from the nearest right angle is oblique
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
CORNERS = {
    (-1, -1): "top left",
    (1, -1): "top right",
    (-1, 1): "bottom left",
    (1, 1): "bottom right",
}
SIDES = {(1, 0): "to its right", (-1, 0): "to its left", (0, 1): "below it", (0, -1): "above it"}
NOT_SEEN = (
    "show the monitor to the whole of the tracker's field, expose longer, and look at the focus"
)
FRAMES = 16  # of dots in the field that the tracker sees, by the fit to the first dots
MAX_TILT_DEG = 60.0  # the largest that a geometry file may state
FAR = 1.5  # a lens model does not fit where held-out dots are off by more, in units of their noise
SQUARE_NAMES = ("corner", "right", "below")


@dataclass(frozen=True, slots=True)
class OrientationFigure:
    """An asymmetric figure: three squares of different sizes, at a corner, to its right and below
    it. `x_px` and `y_px` (3,) are their middles as they are drawn, `side_px` is the side of the
    smallest, and `reach_px` is about half the distance between the corner and the next square; all
    in monitor pixels.
    """

    x_px: FloatArray
    y_px: FloatArray
    side_px: int
    reach_px: float

    def pattern(self, name: str, resolution_px: tuple[int, int], code: int) -> Pattern:
        """The pattern `name` with the figure on black, its squares at `code`."""
        codes = black(resolution_px)
        for x, y, sides in zip(self.x_px, self.y_px, SQUARES, strict=True):
            size = self.side_px * sides
            row = round(y - (size - 1) / 2)
            column = round(x - (size - 1) / 2)
            codes[row : row + size, column : column + size] = code
        return Pattern(name, codes)

    @property
    def axes_px(self) -> FloatArray:
        """From the corner to the square at its right and to that below it: columns (2, 2)."""
        corner, right, below = np.stack([self.x_px, self.y_px], axis=1)
        return np.column_stack([right - corner, below - corner])


def figure_for(geometry: BenchGeometry) -> OrientationFigure:
    """The figure in the middle of the tracker's field by the bench file's ideal lens, or in the
    middle of the screen where that lies far away. Raises InputError where there is no space for
    it.
    """
    monitor = geometry.monitor
    tracker = geometry.tracker
    ratio = monitor.focal_length_px / tracker.focal_length_px
    tracker_width, tracker_height = tracker.resolution_px
    smaller_side = min(*monitor.resolution_px, ratio * tracker_width, ratio * tracker_height)
    reach = FIGURE_REACH * smaller_side
    side = max(3, math.ceil(SQUARE_TRACKER_PX * ratio))
    if reach < SQUARES[0] * side:
        raise InputError(
            "the tracker sees too little of the monitor for a figure; look at the focal lengths and"
            " pixel pitches"
        )
    tracker_x = np.array([(tracker_width - 1) / 2])
    tracker_y = np.array([(tracker_height - 1) / 2])
    (middle_x,), (middle_y,) = geometry.to_monitor(tracker_x, tracker_y)
    width, height = monitor.resolution_px
    # Where by the bench file the tracker looks far from the screen's middle, the file may well be
    # wrong, so the figure is shown in the middle.
    is_near_middle = abs(middle_x - width / 2) < width / 4
    is_near_middle = is_near_middle and abs(middle_y - height / 2) < height / 4
    if not is_near_middle:
        middle_x = (width - 1) / 2
        middle_y = (height - 1) / 2
    x_px = middle_x + reach * np.array([-1.0, 1.0, -1.0])
    y_px = middle_y + reach * np.array([-1.0, -1.0, 1.0])
    sizes = side * np.array(SQUARES)
    return OrientationFigure(_whole(x_px, sizes), _whole(y_px, sizes), side, reach)


def _whole(middles_px: FloatArray, sizes: IntArray) -> FloatArray:
    """The middles (n,) nearest to these of squares of whole pixels, `sizes` (n,)."""
    half = (sizes - 1) / 2
    return np.asarray(np.rint(middles_px - half) + half)


@dataclass(frozen=True, slots=True)
class SeenFigure:
    """The figure in the tracker's image: its orientation `way`, its `scale` relative to the
    expected size, the turn that remains after the orientation, degrees, and the places of its
    squares, `x_px` and `y_px` (3,), tracker pixels, the largest first.

    The turn's error is half the difference of the turns of the figure's two sides, with the error
    of the spots. `focal_length_px` of the monitor and `q_cam_to_mon` (4,) are those by which the
    figure is where the tracker sees it.
    """

    way: Way
    scale: float
    turn_deg: float
    turn_error_deg: float
    x_px: FloatArray
    y_px: FloatArray
    focal_length_px: float
    q_cam_to_mon: FloatArray

    @property
    def whole_turn_deg(self) -> float:
        """The turn of the screen in the tracker's image, degrees: the quarter turns of its
        orientation and the remaining angle.
        """
        return self.turn_deg + QUARTER_TURNS_DEG.get(self.way, 0.0)


Measurement = tuple[SeenFigure, DarkSubtracted]


class SquaresAlike(InputError):
    """Raised where the figure's squares have about the same light: they saturate the tracker, or
    other light is among them.
    """


def _squares_of(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The x and y (3,), tracker pixels, of the figure's squares in an image (height, width), DN,
    the largest square first. Raises InputError where fewer than three are there, SquaresAlike where
    they have about the same light.
    """
    settings = CentroidSettings(threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=MIN_PIXELS)
    background = noisiest_background(image)
    stars = find_stars(image, settings, background)
    if len(stars) < len(SQUARES):
        raise InputError(f"{len(stars)} of the figure's three squares are in the image; {NOT_SEEN}")
    largest = np.argsort(-stars.pixels, kind="stable")[:MAX_SPOTS]
    # The squares are sorted by their light: with a wide PSF, squares of three sizes become spots of
    # nearly one size.
    radius_px = math.ceil(WINDOW_SIDES * math.sqrt(stars.pixels.max()))
    x_px = stars.x_px[largest]
    y_px = stars.y_px[largest]
    values, dx, dy = squares(image, background.level, x_px, y_px, radius_px)
    light = values.sum(axis=(1, 2))
    brightest = np.argsort(-light, kind="stable")[: len(SQUARES)]
    square_light = light[brightest]
    step = square_light[:-1] / np.maximum(square_light[1:], 1e-9)
    if (step < MIN_LIGHT_STEP).any():
        light_text = ", ".join(f"{light_dn:.3g}" for light_dn in square_light)
        raise SquaresAlike(
            f"the three brightest spots have {light_text} DN in all and cannot be told apart, where"
            " squares of three sizes have 9, 4 and 1 parts; look at stray light and reflections,"
            " or expose shorter"
        )
    right_px = (values * dx).sum(axis=(1, 2)) / light
    down_px = (values * dy).sum(axis=(1, 2)) / light
    return (x_px + right_px)[brightest], (y_px + down_px)[brightest]


def see_figure(image: FloatArray, figure: OrientationFigure, geometry: BenchGeometry) -> SeenFigure:
    """Find the figure in a tracker's image (height, width), DN above its dark frame, by the bench
    file's lens.

    Raises InputError where it is not there, is no square, or is not of about the size that the
    focal lengths give; SquaresAlike where its squares have about the same light.
    """
    x_px, y_px = _squares_of(image)
    monitor_px = geometry.monitor.focal_length_px / geometry.tracker.focal_length_px
    shown_x, shown_y = geometry.to_monitor(x_px, y_px)
    corner, right, below = np.stack([shown_x, shown_y], axis=1)
    side_px = 2 * figure.reach_px
    shown_axes_px = np.column_stack([right - corner, below - corner])
    # as seen over as drawn
    figure_px = shown_axes_px @ np.linalg.inv(figure.axes_px)
    scale = float(np.sqrt(abs(np.linalg.det(figure_px))))
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        raise InputError(
            f"the figure is {scale:.2f} times as large as the bench file says; look at focal"
            " lengths and pitches"
        )
    way = max(WAYS, key=lambda each_way: float((_matrix_of(each_way) * figure_px).sum()))
    remaining = np.linalg.inv(_matrix_of(way)) @ figure_px / scale
    longest, shortest = np.linalg.svd(remaining, compute_uv=False)
    if longest > MAX_STRETCH * shortest:
        raise InputError(
            f"the figure is no square: {longest / shortest:.2f} times as long one way as the other;"
            " look at stray light, and at how far the screen is tilted"
        )
    (right_x, below_x), (right_y, below_y) = remaining
    turn = float(np.degrees(np.arctan2(right_y - below_x, right_x + below_y)))
    turn_of_right = np.degrees(np.arctan2(right_y, right_x))
    turn_of_below = np.degrees(np.arctan2(-below_x, below_y))
    by_spots = math.degrees(SPOT_ERROR_PX * monitor_px / side_px)
    turn_error = math.hypot(float(turn_of_right - turn_of_below) / 2, by_spots)
    # The rotation that turns the directions of the spots into those of the figure. The monitor's
    # focal length is such that the figure has the size in which it is seen.
    focal_length_px = geometry.monitor.focal_length_px / scale
    camera = replace(geometry.monitor, focal_length_px=focal_length_px)
    u, v = camera.tangents(figure.x_px, figure.y_px)
    figure_rays = _unit(np.column_stack([u, v, np.ones(3)]))
    spot_rays = _unit(geometry.tracker.rays(x_px, y_px))
    aligned, _ = Rotation.align_vectors(figure_rays, spot_rays)
    return SeenFigure(
        way=way,
        scale=scale,
        turn_deg=turn,
        turn_error_deg=turn_error,
        x_px=x_px,
        y_px=y_px,
        focal_length_px=focal_length_px,
        q_cam_to_mon=from_matrix(aligned.as_matrix()),
    )


def _matrix_of(way: Way) -> FloatArray:
    """The matrix (2, 2) of an orientation: its columns are the directions in which the screen's
    right and down appear.
    """
    return np.array(way, dtype=np.float64).reshape(2, 2)


def _unit(rays: FloatArray) -> FloatArray:
    """The directions (n, 3) of `rays` (n, 3), scaled to norm 1."""
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def keys_of_ways() -> dict[str, Way]:
    """The orientation for each key that a person may press; the first is upright."""
    return {str(number): way for number, way in enumerate(WAYS, start=1)}


def look_of(way: Way) -> str:
    """A text that says where the figure's squares appear in an orientation."""
    right = (way[0], way[2])
    below = (way[1], way[3])
    # the corner lies opposite to both other squares
    corner_x = -right[0] - below[0]
    corner_y = -right[1] - below[1]
    corner = CORNERS[corner_x, corner_y]
    return (
        f"the largest square {corner}, the next one {SIDES[right]}, the smallest {SIDES[below]}"
        f" ({WAYS[way]})"
    )


@dataclass(frozen=True, slots=True)
class ScreenMounting:
    """How the screen is mounted, by three keys of [monitor] in the bench file."""

    flip_x: bool
    flip_y: bool
    rotate_deg: int

    @property
    def matrix(self) -> FloatArray:
        """The matrix (2, 2) that turns components along the image's axes into those along the
        screen's; x is right, y is down.
        """
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), self.rotate_deg // 90)
        x_sign = -1.0 if self.flip_x else 1.0
        y_sign = -1.0 if self.flip_y else 1.0
        return np.asarray(np.diag([x_sign, y_sign]) @ turn)


def corrected(mounting: ScreenMounting, way: Way) -> ScreenMounting:
    """The mounting by which an image that now appears in the orientation `way` is upright; of two
    such, the one in which fewer keys differ from `mounting`.
    """
    wanted = mounting.matrix @ np.linalg.inv(_matrix_of(way))
    flips = (False, True)
    upright = []
    for flip_x, flip_y, rotate_deg in itertools.product(flips, flips, (0, 90, 180, 270)):
        candidate = ScreenMounting(flip_x, flip_y, rotate_deg)
        if np.allclose(candidate.matrix, wanted):
            upright.append(candidate)

    def cost(candidate: ScreenMounting) -> tuple[int, bool, int]:
        changed_keys = sum(map(ne, astuple(candidate), astuple(mounting)))
        return changed_keys, candidate.flip_y, candidate.rotate_deg

    return min(upright, key=cost)


def orientation(context: StepContext) -> StepOutcome:
    """The step that finds how the screen is mounted, sets the bench file's keys, and checks that
    the figure is then upright. Raises InputError where it is not, or cannot be found.
    """
    monitor = context.monitor
    before = ScreenMounting(monitor.flip_x, monitor.flip_y, monitor.rotate_deg)
    first, measured = _way(context, "figure_000")
    after = corrected(before, first)
    changes: tuple[KeyChange, ...] = ()
    for key in ("flip_x", "flip_y", "rotate_deg"):
        changes += tuple(context.change("monitor", key, getattr(after, key)))
    if (before.rotate_deg - after.rotate_deg) % 180:
        width, height = monitor.resolution_px
        turned_size = KeyChange(
            table="monitor", key="resolution_px", before=[width, height], after=[height, width]
        )
        changes += (turned_size,)
    way = "upright"
    if changes:
        way = f"first {WAYS[first]}, now upright"
        mounted = replace(context, file=with_changes(context.file, changes))
        now, measured = _way(mounted, "figure_001")
        # A screen turned by nearly 45 degrees may now appear nearer to 90. The fit of the geometry
        # works from either.
        is_quarter_off = now in QUARTER_TURNS_DEG and _is_oblique(measured)
        if now != UPRIGHT and not is_quarter_off:
            made = "; ".join(change.line for change in changes)
            raise InputError(f"after {made} the figure is {WAYS[now]}; is it the same screen?")
    if measured is None:
        figures: dict[str, Figure] = {"seen": WAYS[first], "told_by": "a key"}
        return StepOutcome("done", f"{way}, as a person saw it", figures, changes=changes)
    seen_figure, looked = measured
    turn_deg = seen_figure.whole_turn_deg
    picture = context.session / "orientation.svg"
    finding = f"the figure as the tracker sees it: {way}"
    draw_spots(picture, looked.image, seen_figure.x_px, seen_figure.y_px, finding)
    figures = {
        "seen": WAYS[first],
        "scale": seen_figure.scale,
        "turn_deg": turn_deg,
        "turn_error_deg": seen_figure.turn_error_deg,
        SEEN_FOCAL: seen_figure.focal_length_px,
        **dict(zip(SEEN_Q, seen_figure.q_cam_to_mon.tolist(), strict=True)),
    }
    line = f"{way}, {seen_figure.scale:.4f} of the expected size, turned by {turn_deg:+.2f} deg"
    number = StepNumber(
        turn_deg, seen_figure.turn_error_deg, "deg", "turn of the figure that is left"
    )
    files = (looked.path, picture)
    return StepOutcome("done", line, figures, files, (picture,), changes, number)


def _is_oblique(measured: Measurement | None) -> bool:
    """Whether the figure is turned nearly half-way between two right angles; False without a
    measurement.
    """
    if measured is None:
        return False
    seen_figure, _ = measured
    return abs(seen_figure.turn_deg) > OBLIQUE_DEG


def _way(context: StepContext, name: str) -> tuple[Way, Measurement | None]:
    """The figure's orientation, and its measurement, or None for that where a person pressed the
    orientation's key instead. Where the squares saturate, it is shown again, darker.
    """
    geometry = context.geometry()
    figure = figure_for(geometry)
    keys = keys_of_ways()
    code = context.white
    tries = 0
    looks = {key: look_of(way) for key, way in keys.items()}
    while True:
        shown = name
        if tries:
            shown = f"{name}_dim{tries}"
        pattern = figure.pattern(shown, context.resolution_px, code)
        answer = context.take_or_key(pattern, looks)
        if isinstance(answer, str):
            return keys[answer], None
        looked = context.looked(answer, context.read(context.dark()))
        try:
            seen_figure = see_figure(looked.image, figure, geometry)
        except SquaresAlike:
            # Squares that saturate the tracker look alike; darker ones do not.
            if not context.is_too_bright(looked):
                raise
            code = context.darker(code)
            tries = tries + 1
        else:
            return seen_figure.way, (seen_figure, looked)


def draw_spots(
    path: Path, image: FloatArray, x_px: FloatArray, y_px: FloatArray, finding: str
) -> None:
    """Draw an image of the tracker (height, width), with a ring about each spot at `x_px` and
    `y_px` (n,), as a chart titled `finding`.
    """
    height, width = image.shape
    # Matplotlib makes 1 GB of colours for 16 million pixels, so the image is reduced; by maxima, so
    # that a spot of one pixel stays bright.
    step = max(math.ceil(max(height, width) / DRAWN_PX), 1)
    rows = height // step
    columns = width // step
    whole = image[: rows * step, : columns * step]
    drawn = whole.reshape(rows, step, columns, step).max(axis=(1, 3))
    edges = (-0.5, columns * step - 0.5, rows * step - 0.5, -0.5)
    low, high = np.percentile(drawn, (5, 99.9)).tolist()
    grey = np.sqrt(np.clip(drawn - low, 0, None))
    with chart(path, finding, height_inch=6.4) as (axes,):
        axes.imshow(grey, cmap="gray", vmax=np.sqrt(max(high - low, 1.0)), extent=edges)
        axes.scatter(x_px, y_px, s=260, facecolors="none", edgecolors=DARK[ORANGE], linewidths=1.8)
        # a plate behind the text, readable over stars and on black
        plate = {"facecolor": "black", "edgecolor": "none", "boxstyle": "round,pad=0.25"}
        look: dict[str, Any] = {"color": DARK[ORANGE], "size": TEXT_PT + 1, "bbox": plate}
        for name, x, y in zip(SQUARE_NAMES, x_px[:3], y_px[:3], strict=False):
            side = "left"
            away = (14, 16)
            if x > width / 2:
                side = "right"
                away = (-14, 16)
            axes.annotate(name, (x, y), away, textcoords="offset points", ha=side, **look)
        axes.grid(visible=False)
        axes.set(xlabel="tracker x [px]", ylabel="tracker y [px]")


def geometry(context: StepContext) -> StepOutcome:
    """The step that fits lens, tilt and alignment to dots, writes the geometry file, and names it
    in the bench file. Raises InputError where the dots do not allow a fit.
    """
    code = dot_code(context)
    make_directory(context.folder)
    dark = context.dark()
    first = first_dots(context.seen_screen)
    paths, observed = _frames_of(context, first, 0, code, dark)
    rough = rough_geometry(context.file, first, observed)
    rng = np.random.default_rng(PLAN_SEED)
    second = plan_seen_dots(rough, FRAMES, lit_for(rough), rng, beside=first)
    more_paths, more_seen = _frames_of(context, second, first.frames, code, dark)
    plan = joined(first, second)
    paths = [*paths, *more_paths]
    write_plan(context.folder / "plan.csv", plan)
    ideal = context.file.config.tracker.distortion is None
    centroids = observed.joined(more_seen)
    context.stage(f"fits lenses to {len(centroids)} centroids")
    calibrated = calibrate_seen(
        context.file,
        plan,
        centroids,
        tracker_is_ideal=ideal,
        psf_sigma_px=context.agreed_psf_sigma_px,
    )
    output = context.session / "geometry.toml"
    picture = context.session / "geometry.svg"
    write_calibrated(output, calibrated, picture, context.source.monitor)
    chosen = calibrated.chosen
    error = calibrated.uncertainty
    line = (
        f"{chosen.name}: held-out dots {chosen.rms_arcsec:.2f} arcsec rms, {chosen.max_arcsec:.2f}"
        f" max; a star's place is known to {error.rms_arcsec:.2f} arcsec rms"
    )
    number = StepNumber(
        chosen.rms_arcsec,
        chosen.rms_error_arcsec,
        "arcsec",
        "rms distance of held-out dots from where the fit has them",
    )
    return StepOutcome(
        "done",
        line,
        _geometry_figures(calibrated),
        files=(output, picture, context.folder / "plan.csv", dark, *paths),
        pictures=(picture,),
        changes=context.names("collimator", "geometry", output),
        number=number,
        fitted=_ends_of(calibrated),
    )


def _geometry_figures(found: Calibrated) -> dict[str, Figure]:
    """A fitted geometry's figures for the report: its model and errors, the counts of dots and
    centroids, and the lens's parameters.
    """
    chosen = found.chosen
    error = found.uncertainty
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
    }
    # Rotations are left out: they are relative to the bench file's, which the geometry file
    # replaces.
    for name, parameter in parameters_of(found).items():
        if "rotation" not in name:
            figures[name] = parameter.value
    figures["notes"] = "; ".join(notes_for_a_person(found)) or "none"
    return figures


def _frames_of(
    context: StepContext, plan: DotPlan, first: int, code: int, dark: Path
) -> tuple[list[Path], Observed]:
    """The tracker's images of a plan's frames, with names that are numbered from `first`, and the
    centroids in them. Raises InputError for images that cannot be measured.
    """
    paths = []
    for frame in range(plan.frames):
        codes = dot_image(plan, frame, context.resolution_px, code)
        paths.append(context.take(Pattern(f"frame_{first + frame:03}", codes)))
    size_px = context.file.config.tracker.resolution_px
    context.stage(f"measures the dots of {len(paths)} images")
    return paths, measure_images(paths, dark, size_px, dot_sigma_px(context.file))


def _ends_of(found: Calibrated) -> tuple[FittedFigure, ...]:
    """Fitted figures with their limits, so that one at a limit can be reported: the tilts, and,
    where held-out dots are farther off than FAR times their noise, the degree of the lens's field,
    of which no larger one was tried.
    """
    parameters = parameters_of(found)
    figures = []
    for name in ("tilt_x_deg", "tilt_y_deg"):
        figures.append(FittedFigure(name, parameters[name].value, -MAX_TILT_DEG, MAX_TILT_DEG))
    if found.chosen.rms_arcsec > FAR * found.held_out_noise_arcsec:
        name = "the degree of the lens's field"
        figures.append(FittedFigure(name, found.chosen.field_degree, -1.0, max(FIELD_DEGREES)))
    return tuple(figures)
