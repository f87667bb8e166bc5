"""Crosshair, grid, blank and patch over the levels of a frame: `present.frag` in NumPy."""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import IntArray
from hilstar.display.response import Codes, Levels, Response

CROSSHAIR, GRID, BLANK, PATCH = 1, 2, 4, 8
GRID_PX = 100
LINE_SHARE = 96 / 255  # share of white: visible, but darker than a star's core


def level_of_code(response: Response, code: int) -> int:
    """The level whose codes are `code` in all three channels."""
    if response.rgb is None:
        return code
    away = np.abs(response.rgb.astype(np.int64) - code).sum(axis=1)
    return int(np.argmin(away))


def lay_over(
    levels: Levels | Codes,
    overlay: int,
    patch_level: int,
    line_level: int,
    cross_px: tuple[int, int],
) -> None:
    """Change levels (height, width), or codes (height, width, 3), in place; `cross_px` is the
    crosshair's pixel.
    """
    blank = bool(overlay & BLANK)
    on_patch = bool(overlay & PATCH) and not blank
    if blank or on_patch:
        levels[...] = patch_level if on_patch else 0
    dark = on_patch and patch_level >= line_level  # on a patch as bright as a line
    height, width = levels.shape[:2]
    x, y = cross_px
    columns = _lines(np.arange(width) - x, overlay)
    rows = _lines(np.arange(height) - y, overlay)
    for lines in (np.s_[:, columns], np.s_[rows, :]):
        if dark:
            levels[lines] = 0
        else:
            levels[lines] = np.maximum(levels[lines], line_level)


def _lines(offset_px: IntArray, overlay: int) -> IntArray:
    """Which columns or rows, by their offsets (n,) from the crosshair's, have a line of its or of
    the grid.
    """
    is_line = np.zeros(len(offset_px), dtype=np.bool_)
    if overlay & GRID:
        is_line |= offset_px % GRID_PX == 0
    if overlay & CROSSHAIR:
        is_line |= offset_px == 0
    return np.flatnonzero(is_line)


@dataclass(frozen=True, slots=True)
class AidLevels:
    """The levels of aids on a monitor with codes of `bits` bits; the crosshair goes through
    pixel `cross_px`.
    """

    response: Response
    bits: int
    cross_px: tuple[int, int]

    def laid_over(self, levels: Levels, overlay: int, patch_share: float) -> Levels:
        """Levels with what is on over them, a patch of so much of white: the same array where
        nothing is, else a copy.
        """
        if not overlay:
            return levels
        levels = levels.copy()
        white = 2**self.bits - 1
        patch = level_of_code(self.response, round(patch_share * white))
        line = level_of_code(self.response, int(LINE_SHARE * white))
        lay_over(levels, overlay, patch, line, self.cross_px)
        return levels
