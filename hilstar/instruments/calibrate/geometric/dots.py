"""Frames of dots, each of which blinks its own code: a dot in the tracker's image identifies
itself.

Every dot is lit in the same number of frames, which shows lost and false centroids. Two codes
differ in as many frames as the number of dots allows. Dots stand where the tracker sees the screen:
a tracker before a large screen may see 2 % of it.
"""

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.charts import write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.text_tables import read_rows
from hilstar.instruments.calibrate.geometric.dot_shape import DotShape
from hilstar.instruments.calibrate.geometric.observed import dot_centroids
from hilstar.optics.camera import Camera
from hilstar.server.bench.config import Monitor

LIT_SHARE = 0.4  # share of the frames that a dot is lit in
MIN_LIT, MAX_LIT = 3, 10  # frames that a dot is lit in
MIN_FRAMES = 8
MAX_PLAN_BYTES = 20_000_000
DOT_PX = 3  # side of a dot, monitor px
EDGE_PX = 6  # from a dot's centre to the edge of the screen
TRIES = 400  # random codes for each dot, at each distance
PLAN_COLUMNS = ("frame", "dot", "x_px", "y_px")
# the plastic number: its powers spread points evenly over a square (Roberts 2018)
GOLDEN = 1.32471795724474602596
PLAN_ADVICE = "give the plan.csv that `hilstar calibrate dots` wrote"
# Tracker px between neighbouring dots of a frame: the dots' own side so many times, and room for
# their wings. They stand by chance, so that half of them have a neighbour at half of it: 9 sigmas,
# for two windows of 4 and a little light beyond.
MIN_APART_PX, APART_SIDES, WINGS_PX, WINGS_SIGMAS = 40.0, 2.5, 20.0, 18.0
MIN_DOTS = 12  # that the fit of a geometry needs
MIN_LIT_DOTS, MAX_LIT_DOTS = 8, 60  # in a frame: three frames in eight light 21 dots or more
# A geometry that was not measured: the bench file's lens may look past the screen's middle by so
# much of the tracker's field.
UNSURE_SHARE = 0.15
# places along each side of the screen and of the tracker, by which the part that is seen is found
GRID = 65
# places of the even sequence that are tried for each dot: the part seen may be a thin strip of its
# box
TRIED = 40
# of the distance between dots: to those of another plan, between which there is less room
TAKEN_SHARE = 0.6
# in which the outermost place that is seen has a dot, so that no corner is extrapolated
BORDER_DIRECTIONS = 8


@dataclass(frozen=True, slots=True)
class DotPlan:
    """Dots on the monitor: places (n,), whole px, and the frames in which each is lit (n,
    frames).
    """

    x_px: FloatArray
    y_px: FloatArray
    lit: BoolArray

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.lit.shape[1])

    @property
    def sites(self) -> IntArray:
        """The first dot at each dot's place (n,): pixels of the detector do the same to both."""
        places = np.stack([self.x_px, self.y_px], axis=1)
        _, first, site = np.unique(places, axis=0, return_index=True, return_inverse=True)
        return np.asarray(first[site.ravel()], dtype=np.intp)

    @property
    def extent_px(self) -> float:
        """The longer side of the part of the screen that the dots stand on, monitor px."""
        return float(max(np.ptp(self.x_px), np.ptp(self.y_px)))

    def __len__(self) -> int:
        return len(self.x_px)


def plan_dots(
    resolution_px: tuple[int, int], frames: int, dots_per_frame: int, rng: np.random.Generator
) -> DotPlan:
    """Plan dots over the whole screen, about `dots_per_frame` lit in each frame. Raises
    InputError where that is impossible.
    """
    count = dots_of_frames(frames, dots_per_frame)
    lit = _codes(count, frames, rng)
    x_px, y_px = _places(resolution_px, count)
    return DotPlan(x_px, y_px, lit)


def dots_of_frames(frames: int, dots_per_frame: int) -> int:
    """How many dots there are where so many are lit in each of the frames. Raises InputError for
    too few frames.
    """
    if frames < MIN_FRAMES:
        raise InputError(f"--frames {frames}: the dots' codes need {MIN_FRAMES} frames or more")
    return round(dots_per_frame * frames / _weight(frames))


def _weight(frames: int) -> int:
    """In how many of so many frames a dot is lit."""
    return int(np.clip(round(LIT_SHARE * frames), MIN_LIT, MAX_LIT))


def _codes(count: int, frames: int, rng: np.random.Generator) -> BoolArray:
    """Codes (count, frames) of one weight, as far apart as random search finds them. Raises
    InputError for too many.
    """
    weight = _weight(frames)
    for distance in range(2 * weight, 0, -2):
        lit = _codes_apart(count, frames, weight, distance, rng)
        if lit is not None:
            return lit
    raise InputError(
        f"--dots: {count} dots are more than the codes of {frames} frames; write more --frames"
        " or fewer --dots"
    )


@dataclass(frozen=True, slots=True)
class SeenScreen:
    """The part of a screen that a tracker sees: `monitor` and `tracker` map cam to their pixels.

    `is_sure` says that this is known: by a fit, or by the figure of the step `orientation`. Else a
    wider part is taken. `psf_sigma_px` is how wide the tracker sees a point: the window of a dot
    near the detector's edge would leave the image.
    """

    monitor: Camera
    tracker: Camera
    is_sure: bool
    psf_sigma_px: float

    @property
    def tracker_px_a_monitor_px(self) -> float:
        """Tracker pixels per monitor pixel, on the axis."""
        return self.tracker.focal_length_px / self.monitor.focal_length_px

    @property
    def dot_sigma_px(self) -> float:
        """The sigma of a dot in the tracker's image: the PSF's and a square's."""
        square_sigma_px = DOT_PX * self.tracker_px_a_monitor_px / math.sqrt(12)
        return math.hypot(self.psf_sigma_px, square_sigma_px)

    @property
    def dot_shape(self) -> DotShape:
        """A dot in the tracker's image, as it is on the axis."""
        side_px = DOT_PX * self.tracker_px_a_monitor_px
        monitor_to_tracker = self.tracker.cam_to_image @ self.monitor.cam_to_image.T
        right = monitor_to_tracker[:, 0]
        turn_deg = math.degrees(math.atan2(right[1], right[0]))
        return DotShape(self.psf_sigma_px, side_px, turn_deg)

    @property
    def turn_deg(self) -> float:
        """By how much a monitor pixel is turned in the tracker's image, in the middle of what is
        seen. Raises InputError.
        """
        low, high = self.box()
        x_px, y_px = (low + high) / 2
        # a pixel and the next one to its right
        u, v = self._in_tracker(np.array([x_px, x_px + 1]), np.array([y_px, y_px]))
        across = u[1] - u[0]
        down = v[1] - v[0]
        return math.degrees(math.atan2(down, across))

    def _in_tracker(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the tracker sees monitor pixels (n,): its pixels x and y (n,)."""
        rays = self.monitor.rays(x_px, y_px)
        return self.tracker.project(rays @ self.tracker.cam_to_image.T)

    def shows(self, x_px: FloatArray, y_px: FloatArray) -> BoolArray:
        """Whether a whole dot at monitor pixels (n,) is on the screen and in the tracker's field
        (n,).
        """
        u, v = self._in_tracker(x_px, y_px)
        margin_px = -UNSURE_SHARE * max(self.tracker.resolution_px)
        if self.is_sure:
            # A dot whose window leaves the image has a biased centroid, and is dropped by who
            # measures it.
            half_dot_px = DOT_PX / 2 * self.tracker_px_a_monitor_px
            window_px = dot_centroids(self.dot_sigma_px).radius_px + 1
            margin_px = max(half_dot_px + EDGE_PX, window_px)
        on_screen = _is_inside(x_px, y_px, self.monitor.resolution_px, EDGE_PX)
        in_field = _is_inside(u, v, self.tracker.resolution_px, margin_px)
        return on_screen & in_field

    def box(self) -> tuple[FloatArray, FloatArray]:
        """The lower and upper corner (2,) of the part of the screen that is seen, monitor px.
        Raises InputError for none.
        """
        wide, high = self.tracker.resolution_px
        reach = UNSURE_SHARE * max(wide, high)
        u_ends = (-reach, wide - 1 + reach)
        v_ends = (-reach, high - 1 + reach)
        u, v = _grid(u_ends, v_ends)
        rays = self.tracker.rays(u, v)
        of_field = np.stack(self.monitor.project(rays @ self.monitor.cam_to_image.T), axis=1)
        has_place = np.isfinite(of_field).all(axis=1)
        width, height = self.monitor.resolution_px
        x_ends = (EDGE_PX, width - 1 - EDGE_PX)
        y_ends = (EDGE_PX, height - 1 - EDGE_PX)
        screen_x, screen_y = _grid(x_ends, y_ends)
        of_screen = np.stack([screen_x, screen_y], axis=1)
        places = np.concatenate([of_field[has_place], of_screen])
        visible_px = places[self.shows(*places.T)]
        if not len(visible_px):
            raise InputError(
                "the tracker sees no place of the screen: look at [collimator] q_cam_to_mon, focal"
                " lengths and pixel pitches"
            )
        return visible_px.min(axis=0), visible_px.max(axis=0)


def _is_inside(
    x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], margin_px: float
) -> BoolArray:
    """Which places (n,) are within an image's outermost pixels, by a margin or more."""
    width, height = resolution_px
    with np.errstate(invalid="ignore"):
        across = (x_px >= margin_px) & (x_px <= width - 1 - margin_px)
        down = (y_px >= margin_px) & (y_px <= height - 1 - margin_px)
    return np.asarray(across & down)


def _grid(
    x_ends: tuple[float, float], y_ends: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Places (GRID^2,) between these ends, x and y."""
    columns = np.linspace(*x_ends, GRID)
    rows = np.linspace(*y_ends, GRID)
    x, y = np.meshgrid(columns, rows)
    return x.ravel(), y.ravel()


def lit_for(seen: SeenScreen) -> int:
    """How many dots of a frame the tracker can tell apart on the part of the screen that it
    sees, through its PSF.
    """
    ratio = seen.tracker_px_a_monitor_px
    wings_px = max(WINGS_PX, WINGS_SIGMAS * seen.psf_sigma_px)
    apart_px = max(MIN_APART_PX, APART_SIDES * DOT_PX * ratio + wings_px)
    low, high = seen.box()
    x, y = _grid((low[0], high[0]), (low[1], high[1]))
    shown_share = float(seen.shows(x, y).mean())
    area_px = float(np.prod(high - low)) * shown_share * ratio**2
    return int(np.clip(area_px / apart_px**2, MIN_LIT_DOTS, MAX_LIT_DOTS))


def plan_seen_dots(
    seen: SeenScreen,
    frames: int,
    dots_per_frame: int,
    rng: np.random.Generator,
    beside: DotPlan | None = None,
) -> DotPlan:
    """Plan dots over the part of the screen that the tracker sees, between those of the plan
    `beside`. Raises InputError where that is impossible.
    """
    count = dots_of_frames(frames, dots_per_frame)
    if count < MIN_DOTS:
        raise InputError(
            f"--dots {dots_per_frame}: {frames} frames then hold {count} dots, and {MIN_DOTS} are"
            " needed; write more --dots or --frames, or no --dots for as many as the field holds"
        )
    lit = _codes(count, frames, rng)
    taken = np.empty((0, 2))
    if beside is not None:
        taken = np.stack([beside.x_px, beside.y_px], axis=1)
    x_px, y_px = _seen_places(seen, count, taken)
    return DotPlan(x_px, y_px, lit[: len(x_px)])


def _seen_places(seen: SeenScreen, count: int, taken: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whole pixels (n,) spread evenly over what is seen between those `taken` (m, 2), the
    outermost first; at most `count`. Raises InputError for few.
    """
    low, high = seen.box()
    size = high - low
    tried = TRIED * count
    places = np.rint(low + np.concatenate([_even(tried), _rim()]) * size)
    is_seen = seen.shows(*places.T)
    inside = places[:tried][is_seen[:tried]]
    turns = 2 * np.pi * (np.arange(BORDER_DIRECTIONS) + 0.5) / BORDER_DIRECTIONS
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    directions = circle / np.maximum(size, 1.0)
    seen_places = places[is_seen]
    outermost = seen_places[(seen_places @ directions.T).argmax(axis=0)]
    # Two dots at nearly one place would be taken for one dot that blinks both codes, and have the
    # errors of the same pixels.
    area_px = float(np.prod(size)) * len(inside) / tried
    apart_px = 0.5 * math.sqrt(area_px / count)
    chosen = np.unique(outermost, axis=0)
    chosen = chosen[_distances(chosen, taken) > TAKEN_SHARE * apart_px][:count]
    is_apart = _distances(inside, chosen) > apart_px
    is_apart &= _distances(inside, taken) > TAKEN_SHARE * apart_px
    chosen = np.concatenate([chosen, inside[is_apart]])[:count]
    if len(chosen) < MIN_DOTS:
        raise InputError(
            f"the part of the screen that the tracker sees holds {len(chosen)} dots and {MIN_DOTS}"
            " are needed: a shorter [tracker] or a longer [collimator] focal length shows it more"
        )
    return chosen[:, 0], chosen[:, 1]


def _distances(places: FloatArray, others: FloatArray) -> FloatArray:
    """The distance of each place (n, 2) to the nearest of others (m, 2), infinite without any."""
    apart = places[:, None] - others[None]
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]).min(axis=1, initial=np.inf))


def _even(count: int) -> FloatArray:
    """Places (count, 2) spread evenly over the unit square, each next one where space is left."""
    k = np.arange(count)
    x = (0.5 + k / GOLDEN) % 1.0
    y = (0.5 + k / GOLDEN**2) % 1.0
    return np.column_stack([x, y])


def _rim() -> FloatArray:
    """Places (n, 2) along the edges of the unit square."""
    edge = np.linspace(0.0, 1.0, GRID)
    top = np.column_stack([edge, np.zeros(GRID)])
    bottom = np.column_stack([edge, np.ones(GRID)])
    horizontal = np.concatenate([top, bottom])
    return np.concatenate([horizontal, horizontal[:, ::-1]])


def joined(first: DotPlan, second: DotPlan) -> DotPlan:
    """One plan of two: the frames and the dots of the first, then those of the second."""
    dots = len(first) + len(second)
    frames = first.frames + second.frames
    lit = np.zeros((dots, frames), dtype=bool)
    lit[: len(first), : first.frames] = first.lit
    lit[len(first) :, first.frames :] = second.lit
    x_px = np.concatenate([first.x_px, second.x_px])
    y_px = np.concatenate([first.y_px, second.y_px])
    return DotPlan(x_px, y_px, lit)


def _codes_apart(
    count: int, frames: int, weight: int, distance: int, rng: np.random.Generator
) -> BoolArray | None:
    """Codes (count, frames) that differ in so many frames, each by random search; None where that
    finds none.
    """
    codes = np.zeros((count, frames), dtype=bool)
    load = np.zeros(frames)
    for k in range(count):
        for _ in range(TRIES):
            # Frames with few dots so far are more likely to be chosen.
            chance = rng.uniform(0.0, 2.0 + k / frames, frames)
            chosen = np.argsort(load + chance)[:weight]
            code = np.zeros(frames, dtype=bool)
            code[chosen] = True
            differing = (codes[:k] != code).sum(axis=1)
            if k == 0 or int(differing.min()) >= distance:
                break
        else:
            return None
        codes[k] = code
        load[chosen] += 1
    return codes


def _places(resolution_px: tuple[int, int], count: int) -> tuple[FloatArray, FloatArray]:
    """Whole pixels spread evenly over the screen, its corners first, so that no corner is
    extrapolated.
    """
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    spread = _even(max(count - len(corners), 0))
    unit = np.concatenate([corners, spread])[:count]
    size = np.array(resolution_px) - 1 - 2 * EDGE_PX
    if (size < 1).any():
        raise InputError(
            f"a screen of {resolution_px[0]} x {resolution_px[1]} px is too small for dots"
        )
    places = np.rint(EDGE_PX + unit * size)
    return places[:, 0], places[:, 1]


def dot_image(
    plan: DotPlan, frame: int, resolution_px: tuple[int, int], white: int
) -> npt.NDArray[np.uint16]:
    """Code values (h, w) of a frame: each lit dot is a square of DOT_PX of `white` about its
    place.
    """
    width, height = resolution_px
    image = np.zeros((height, width), dtype=np.uint16)
    lit = plan.lit[:, frame]
    first_columns = plan.x_px[lit].astype(int) - DOT_PX // 2
    first_rows = plan.y_px[lit].astype(int) - DOT_PX // 2
    for column, row in zip(first_columns, first_rows, strict=True):
        image[row:, column:][:DOT_PX, :DOT_PX] = white
    return image


def write_plan(path: Path, plan: DotPlan) -> None:
    """Write plan.csv, a row for each lit dot of each frame."""
    places = np.stack([plan.x_px, plan.y_px], axis=1).astype(int).tolist()
    rows = []
    for frame in range(plan.frames):
        for dot in np.flatnonzero(plan.lit[:, frame]).tolist():
            rows.append((frame, dot, *places[dot]))
    write_csv(path, PLAN_COLUMNS, rows)


def read_plan(path: Path) -> DotPlan:
    """Read plan.csv. Raises InputError with the line that is wrong."""
    rows: list[tuple[int, int, float, float]] = []
    for line, cells in read_rows(path, PLAN_COLUMNS, PLAN_ADVICE, MAX_PLAN_BYTES, ()):
        try:
            frame = int(cells[0])
            dot = int(cells[1])
            x = float(cells[2])
            y = float(cells[3])
            if min(frame, dot) < 0 or max(frame, dot) > 10**6:
                raise ValueError
        except ValueError as error:
            wanted = "whole numbers frame and dot, and x_px and y_px are wanted"
            raise InputError(f"{path}:{line}: {','.join(cells)[:80]!r}; {wanted}") from error
        rows.append((frame, dot, x, y))
    if not rows:
        raise InputError(f"{path}: has no dot; {PLAN_ADVICE}")
    dots = sorted({dot for _, dot, _, _ in rows})
    place = {dot: k for k, dot in enumerate(dots)}
    frames = max(frame for frame, *_ in rows) + 1
    x_px = np.full(len(dots), np.nan)
    y_px = np.full(len(dots), np.nan)
    lit = np.zeros((len(dots), frames), dtype=bool)
    for frame, dot, x, y in rows:
        k = place[dot]
        if lit[k].any() and (x_px[k], y_px[k]) != (x, y):
            raise InputError(f"{path}: dot {dot} is at two places; {PLAN_ADVICE}")
        x_px[k] = x
        y_px[k] = y
        lit[k, frame] = True
    if not (np.isfinite(x_px).all() and np.isfinite(y_px).all()):
        raise InputError(f"{path}: a dot's place is no number; {PLAN_ADVICE}")
    return DotPlan(x_px, y_px, lit)


log = logging.getLogger(__name__)


def show_dots(plan: DotPlan, monitor: Monitor, seconds: float | None, *, windowed: bool) -> int:
    """Show each frame until space is pressed, or for `seconds`; q quits. Returns how many were
    shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not
    there.
    """
    # Here, for `calibrate dots` without --show draws nothing and starts without OpenGL.
    from hilstar.display.render.backend import ScreenView
    from hilstar.display.render.presenter import Presenter, level_texture, window_context
    from hilstar.display.window.window import Window, WindowSettings
    from hilstar.instruments.calibrate.until_key import stays_until_key
    from hilstar.server.bench.monitor import orientation_of

    orientation = orientation_of(monitor)
    screen_px = orientation.screen_px(monitor.resolution_px)
    white = 2**monitor.bits - 1
    triples = np.array([[0, 0, 0], [white, white, white]], dtype=np.uint16)
    display = None if windowed else monitor.display
    with Window(WindowSettings(screen_px, monitor.bits, display)) as window:
        view = ScreenView(
            monitor.resolution_px, window.size_px, monitor.bits, orientation, triples=triples
        )
        context = window_context()
        for frame in range(plan.frames):
            levels = dot_image(plan, frame, monitor.resolution_px, 1).astype(np.uint8)
            texture = level_texture(context, levels)
            log.warning("frame %d of %d (frame_%03d)", frame + 1, plan.frames, frame)
            if not stays_until_key(window, Presenter(texture, view), seconds):
                return frame
            texture.release()
    return plan.frames
