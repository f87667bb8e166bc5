"""Frames of dots, each of which blinks its own code: a dot in the tracker's image identifies itself.

Every dot is lit in the same number of frames, which shows lost and false centroids. Two codes differ in as many frames as the
number of dots allows.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.arrays import BoolArray, FloatArray
from hilstar.bench.config import Monitor
from hilstar.charts import write_csv
from hilstar.csv_tables import read_rows
from hilstar.errors import InputError

LIT_SHARE = 0.4  # share of the frames that a dot is lit in
MIN_LIT, MAX_LIT = 3, 10  # frames that a dot is lit in
MIN_FRAMES = 8
MAX_PLAN_BYTES = 20_000_000
DOT_PX = 3  # side of a dot, monitor px
EDGE_PX = 6  # from a dot's centre to the edge of the screen
TRIES = 400  # random codes for each dot, at each distance
PLAN_COLUMNS = ("frame", "dot", "x_px", "y_px")
GOLDEN = 1.32471795724474602596  # the plastic number: its powers spread points evenly over a square (Roberts 2018)
PLAN_ADVICE = "give the plan.csv that `hilstar calibrate dots` wrote"


@dataclass(frozen=True, slots=True)
class DotPlan:
    """Dots on the monitor: places (n,), whole px, and the frames in which each is lit (n, frames)."""

    x_px: FloatArray
    y_px: FloatArray
    lit: BoolArray

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.lit.shape[1])

    def __len__(self) -> int:
        return len(self.x_px)


def plan_dots(resolution_px: tuple[int, int], frames: int, dots_per_frame: int, rng: np.random.Generator) -> DotPlan:
    """Plan dots over the whole screen, about `dots_per_frame` lit in each frame. Raises InputError where that is impossible."""
    if frames < MIN_FRAMES:
        raise InputError(f"--frames {frames}: the dots' codes need {MIN_FRAMES} frames or more")
    weight = int(np.clip(round(LIT_SHARE * frames), MIN_LIT, MAX_LIT))
    count = round(dots_per_frame * frames / weight)
    # Codes of one weight, as far apart as random search finds them.
    tried = (_codes_apart(count, frames, weight, distance, rng) for distance in range(2 * weight, 0, -2))
    lit = next((codes for codes in tried if codes is not None), None)
    if lit is None:
        raise InputError(
            f"--dots: {count} dots are more than the codes of {frames} frames; write more --frames or fewer --dots"
        )
    x_px, y_px = _places(resolution_px, count)
    return DotPlan(x_px, y_px, lit)


def _codes_apart(count: int, frames: int, weight: int, distance: int, rng: np.random.Generator) -> BoolArray | None:
    codes = np.zeros((count, frames), dtype=bool)
    load = np.zeros(frames)
    for k in range(count):
        for _ in range(TRIES):
            # Frames with few dots so far are more likely to be chosen.
            chosen = np.argsort(load + rng.uniform(0.0, 2.0 + k / frames, frames))[:weight]
            code = np.zeros(frames, dtype=bool)
            code[chosen] = True
            if k == 0 or int((codes[:k] != code).sum(axis=1).min()) >= distance:
                break
        else:
            return None
        codes[k] = code
        load[chosen] += 1
    return codes


def _places(resolution_px: tuple[int, int], count: int) -> tuple[FloatArray, FloatArray]:
    """Whole pixels spread evenly over the screen, its corners first, so that no corner is extrapolated."""
    k = np.arange(max(count - 4, 0))
    spread = np.column_stack([(0.5 + k / GOLDEN) % 1.0, (0.5 + k / GOLDEN**2) % 1.0])
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    unit = np.concatenate([corners, spread])[:count]
    size = np.array(resolution_px) - 1 - 2 * EDGE_PX
    if (size < 1).any():
        raise InputError(f"a screen of {resolution_px[0]} x {resolution_px[1]} px is too small for dots")
    places = np.rint(EDGE_PX + unit * size)
    return places[:, 0], places[:, 1]


def dot_image(plan: DotPlan, frame: int, resolution_px: tuple[int, int], white: int) -> npt.NDArray[np.uint16]:
    """Code values (h, w) of a frame: each lit dot is a square of DOT_PX of `white` about its place."""
    width, height = resolution_px
    image = np.zeros((height, width), dtype=np.uint16)
    for x, y in zip(plan.x_px[plan.lit[:, frame]].astype(int), plan.y_px[plan.lit[:, frame]].astype(int), strict=True):
        image[y - DOT_PX // 2 :, x - DOT_PX // 2 :][:DOT_PX, :DOT_PX] = white
    return image


def write_plan(path: Path, plan: DotPlan) -> None:
    """Write plan.csv, a row for each lit dot of each frame."""
    places = np.stack([plan.x_px, plan.y_px], axis=1).astype(int).tolist()
    lit = ((frame, dot) for frame in range(plan.frames) for dot in np.flatnonzero(plan.lit[:, frame]).tolist())
    write_csv(path, PLAN_COLUMNS, ((frame, dot, *places[dot]) for frame, dot in lit))


def read_plan(path: Path) -> DotPlan:
    """Read plan.csv. Raises InputError with the line that is wrong."""
    rows: list[tuple[int, int, float, float]] = []
    for line, cells in read_rows(path, PLAN_COLUMNS, PLAN_ADVICE, MAX_PLAN_BYTES, ()):
        try:
            frame, dot, x, y = int(cells[0]), int(cells[1]), float(cells[2]), float(cells[3])
            if min(frame, dot) < 0 or max(frame, dot) > 10**6:
                raise ValueError
        except ValueError as error:
            wanted = "whole numbers frame and dot, and x_px and y_px are wanted"
            raise InputError(f"{path}:{line}: {','.join(cells)[:80]!r}; {wanted}") from error
        rows.append((frame, dot, x, y))
    if not rows:
        raise InputError(f"{path}: has no dot; {PLAN_ADVICE}")
    place = {dot: k for k, dot in enumerate(sorted({dot for _, dot, _, _ in rows}))}
    x_px, y_px = np.full(len(place), np.nan), np.full(len(place), np.nan)
    lit = np.zeros((len(place), max(frame for frame, *_ in rows) + 1), dtype=bool)
    for frame, dot, x, y in rows:
        k = place[dot]
        if lit[k].any() and (x_px[k], y_px[k]) != (x, y):
            raise InputError(f"{path}: dot {dot} is at two places; {PLAN_ADVICE}")
        x_px[k], y_px[k], lit[k, frame] = x, y, True
    if not (np.isfinite(x_px).all() and np.isfinite(y_px).all()):
        raise InputError(f"{path}: a dot's place is no number; {PLAN_ADVICE}")
    return DotPlan(x_px, y_px, lit)


log = logging.getLogger(__name__)


def show_dots(plan: DotPlan, monitor: Monitor, seconds: float | None, *, windowed: bool) -> int:
    """Show each frame until space is pressed, or for `seconds`; q quits. Returns how many were shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not there.
    """
    # Here, for `calibrate dots` without --show draws nothing and starts without OpenGL.
    from hilstar.bench.build import orientation_of
    from hilstar.calibrate.plan import stays_until_key
    from hilstar.monitor.window.window import Window, WindowSettings
    from hilstar.render.backend import ScreenView
    from hilstar.render.presenter import Presenter, level_texture, window_context

    orientation = orientation_of(monitor)
    screen_px = orientation.screen_px(monitor.resolution_px)
    white = 2**monitor.bits - 1
    triples = np.array([[0, 0, 0], [white, white, white]], dtype=np.uint16)
    with Window(WindowSettings(screen_px, monitor.bits, None if windowed else monitor.display)) as window:
        view = ScreenView(monitor.resolution_px, window.size_px, monitor.bits, orientation, triples=triples)
        context = window_context()
        for frame in range(plan.frames):
            levels = dot_image(plan, frame, monitor.resolution_px, 1).astype(np.uint8)
            texture = level_texture(context, levels)
            log.warning("frame %d of %d (frame_%03d)", frame + 1, plan.frames, frame)
            if not stays_until_key(window, Presenter(texture, view), seconds):
                return frame
            texture.release()
    return plan.frames
