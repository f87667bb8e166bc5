"""What a session shows: codes over the monitor's image, before they are turned as the screen is mounted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.calibrate.measurements import PRIMARIES
from hilstar.errors import InputError
from hilstar.render.presenter import Orientation
from hilstar.twin.bench_geometry import BenchGeometry

CodeImage = npt.NDArray[np.uint16]
FIGURE_REACH = 0.25  # of the smaller side of what both screen and tracker have: the figure's corners about the middle
SQUARE_TRACKER_PX = 2.5  # side of its smallest square as the tracker sees it
SQUARES = (3, 2, 1)  # sides of the squares at the corner, to its right and below it, in those of the smallest


@dataclass(frozen=True, slots=True)
class Pattern:
    """Code values (h, w), or (h, w, 3), over the monitor's image, and the name of the tracker's image of them.

    `later` are frames that follow, one a refresh, before it begins again.
    """

    name: str
    codes: CodeImage
    later: tuple[CodeImage, ...] = ()

    @property
    def frames(self) -> tuple[CodeImage, ...]:
        """All frames of one turn."""
        return (self.codes, *self.later)


@dataclass(frozen=True, slots=True)
class Figure:
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


def figure_for(geometry: BenchGeometry) -> Figure:
    """The figure in the middle of what the bench file's ideal lens shows the tracker. Raises InputError without room."""
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
    return Figure(x_px, y_px, side, reach)


def black(resolution_px: tuple[int, int]) -> CodeImage:
    """Code 0 everywhere."""
    width, height = resolution_px
    return np.zeros((height, width), dtype=np.uint16)


def in_channel(codes: CodeImage, channel: str) -> CodeImage:
    """Codes (h, w) in one primary (h, w, 3); in all of them, as they are, for w."""
    if channel == "w":
        return codes
    colours = np.zeros((*codes.shape, 3), dtype=np.uint16)
    colours[..., PRIMARIES.index(channel)] = codes
    return colours


def on_screen(codes: CodeImage, orientation: Orientation) -> CodeImage:
    """An image as it lies on the screen (as shaders/present.frag turns it)."""
    screen = np.rot90(codes, -orientation.quarter_turns)
    screen = screen[:, ::-1] if orientation.flip_x else screen
    return screen[::-1] if orientation.flip_y else screen


def off_screen(screen: CodeImage, orientation: Orientation) -> CodeImage:
    """The image that lies on the screen so: the inverse of `on_screen`."""
    screen = screen[::-1] if orientation.flip_y else screen
    screen = screen[:, ::-1] if orientation.flip_x else screen
    return np.rot90(screen, orientation.quarter_turns)
