"""The random part of a frame, from random words by arithmetic alone: normal pairs, and Poisson
counts by inversion.

A frame is drawn in blocks of rows, each from a stream of its own: the frame's key and the block's
number seed it. So one seed gives one frame on any number of threads. A pixel takes one word of 64
bits. It becomes two independent normal numbers (Box and Muller 1958): the first makes the
electrons, the second the read noise.

Electrons are the smallest count whose cumulative probability reaches that of the normal number.
Below EXACT_BELOW_E that is exact (to float32's rounding of the number): a table or an expansion
gives the count, and where either leaves a doubt, scipy's distribution decides. From there on the
expansion alone decides (Giles, ACM TOMS 42 (2016) 5, eq. 8: of Cornish and Fisher's kind, with the
1/3 of a discrete law): its errors are in `tests/unit/tracker/test_frame_noise.py`.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, IntArray

Word64Array = npt.NDArray[np.int64]

PART_PX = 1 << 15  # two parts are drawn at once: their arrays stay in a core's cache

EXACT_BELOW_E = 64.0
TABLE_BELOW_E = 8.0
ROWS_PER_E, COLUMNS, COLUMNS_PER_SIGMA = 64, 2048, 150.0  # 2048 / 150 sigmas hold every number
MARGIN_COLUMNS = 0.1  # float32 places a number this well
UNSURE = 64  # a table's flag: this count or the next one
ONE_STEP_SIGMAS = 3.0  # within it, a doubt is between two counts
# Above this mean, the number of a step is straight between rows to 1.7e-3 sigmas.
STRAIGHT_ABOVE_E, STEP_NUMBER_ERROR = 0.1, 2e-3
# The expansion's error, e-, is at most ERROR_PER_BEND2 times the square of its last term ("bend"),
# plus ERROR_E_TIMES_MEAN / mean; with the next term, FINER_ERROR_PER_BEND3 times its cube, plus
# FINER_ERROR_E / mean^1.5.
ERROR_PER_BEND2, ERROR_E_TIMES_MEAN = 3.0, 0.03
FINER_ERROR_PER_BEND3, FINER_ERROR_E = 7.5, 0.03


def normal_pairs(
    words: Word64Array, which: IntArray | None = None
) -> tuple[Float32Array, Float32Array]:
    """Two independent standard normal numbers for each random word: two arrays of its shape, up to
    6.77 sigmas.

    Of words (n,), or of each part of words (parts, rows, width), the first half makes radii and the
    second angles. `which` (k,) asks for some alone, by their places in the flat array: arrays (k,).
    """
    parts = words.shape[0] if words.ndim == 3 else 1
    halves = words.view(np.uint32).reshape(parts, 2, -1)
    shape = words.shape
    if which is not None:
        part, place = np.divmod(which, halves.shape[2])
        halves = np.stack([halves[part, 0, place], halves[part, 1, place]])[None]
        shape = which.shape
    radius = halves[:, 0].astype(np.float32).reshape(shape)
    radius += np.float32(0.5)
    radius *= np.float32(2.0**-32)
    np.log(radius, out=radius)
    radius *= np.float32(-2.0)
    np.sqrt(radius, out=radius)
    angle = halves[:, 1].view(np.int32).astype(np.float32).reshape(shape)
    angle *= np.float32(2.0**-31 * np.pi)
    sine = np.sin(angle)
    np.cos(angle, out=angle)
    sine *= radius
    angle *= radius
    return angle, sine


def poisson(
    mean_e: Float32Array, normal: Float32Array, smallest_e: float | None = None
) -> Float32Array:
    """Poisson counts of `mean_e` at the quantiles of standard normal numbers; all of one shape.

    `smallest_e` is the smallest mean beside which these stand (None: of these alone).
    """
    bright = mean_e != 0
    if np.count_nonzero(bright) < mean_e.size / 2:
        lit = np.flatnonzero(bright)
        counts = np.zeros_like(mean_e)
        counts.ravel()[lit] = poisson(mean_e.ravel()[lit], normal.ravel()[lit], 0.0)
        return counts
    is_large = mean_e >= TABLE_BELOW_E
    large_count = np.count_nonzero(is_large)
    if not large_count:
        return _by_table(mean_e, normal)
    if large_count == mean_e.size:
        if smallest_e is None:
            smallest_e = float(mean_e.min())
        return _by_expansion(mean_e, normal, max(TABLE_BELOW_E, smallest_e))
    # The many all at once, and the few again by themselves.
    if large_count < mean_e.size / 2:
        large = np.flatnonzero(is_large)
        below = np.nextafter(np.float32(TABLE_BELOW_E), np.float32(0))
        counts = _by_table(np.minimum(mean_e, below), normal)
        large_e = mean_e.ravel()[large]
        counts.ravel()[large] = _by_expansion(large_e, normal.ravel()[large], TABLE_BELOW_E)
        return counts
    counts = _by_expansion(np.maximum(mean_e, np.float32(TABLE_BELOW_E)), normal, TABLE_BELOW_E)
    small = np.flatnonzero(~is_large)
    counts.ravel()[small] = _by_table(mean_e.ravel()[small], normal.ravel()[small])
    return counts


def _by_table(mean_e: Float32Array, normal: Float32Array) -> Float32Array:
    """Counts of means under TABLE_BELOW_E, by cells of mean and normal number; where a cell has
    several, by the step between two, or exactly.
    """
    table = _count_table()
    place = mean_e * np.float32(ROWS_PER_E)
    np.floor(place, out=place)
    place *= np.float32(COLUMNS)
    place += normal * np.float32(COLUMNS_PER_SIGMA)
    place += np.float32(COLUMNS / 2)
    cells = table.cells.take(place.astype(np.intp))
    counts = (cells & (UNSURE - 1)).astype(np.float32)
    doubts = np.flatnonzero(cells >= UNSURE)
    numbers = normal.ravel()[doubts]
    rows = mean_e.ravel()[doubts] * ROWS_PER_E
    step = rows.astype(np.intp) * UNSURE + counts.ravel()[doubts].astype(np.intp)
    low = table.step_number.take(step)
    high = table.step_number.take(step + UNSURE)
    step_number = low + (rows - np.floor(rows)) * (high - low)
    above = numbers - step_number
    is_straight = rows > STRAIGHT_ABOVE_E * ROWS_PER_E
    is_one_step = np.abs(numbers) < ONE_STEP_SIGMAS
    sure = (np.abs(above) > STEP_NUMBER_ERROR) & is_straight & is_one_step
    counts.ravel()[doubts] += (above > 0) & sure
    _decide(counts, mean_e, normal, doubts[~sure])
    return counts


def _by_expansion(mean_e: Float32Array, normal: Float32Array, smallest_e: float) -> Float32Array:
    """Counts of means from `smallest_e` up, by Cornish and Fisher's expansion of the quantile in
    the root of the mean; where that may be off by one, by its next term, or exactly.
    """
    root = np.sqrt(mean_e)
    square = normal * normal
    bend = square + np.float32(2.0)
    bend *= normal
    bend /= root
    bend *= np.float32(1 / 72)
    quantile = root
    quantile *= normal
    quantile += mean_e
    square *= np.float32(1 / 6)
    quantile += square
    quantile -= bend
    if smallest_e >= EXACT_BELOW_E:
        quantile += np.float32(1 / 3)
        return np.floor(quantile, out=quantile)
    quantile += np.float32(1 / 3 - 0.5)
    counts = np.rint(quantile)
    quantile -= counts  # near +-1/2, it may be either of two counts
    np.abs(quantile, out=quantile)
    bend *= bend
    bend *= np.float32(ERROR_PER_BEND2)
    quantile += bend
    doubts = np.flatnonzero(quantile > 0.5 - ERROR_E_TIMES_MEAN / smallest_e)
    means = mean_e.ravel()[doubts].astype(np.float64)
    numbers = normal.ravel()[doubts].astype(np.float64)
    square = numbers**2
    root = np.sqrt(means)
    bends = numbers * (2 + square) / (72 * root)
    finer = (
        means
        + numbers * root
        + square / 6
        - bends
        + 1 / 3
        + (square * (7 / 810 + square / 270) - 8 / 405) / means
    )
    counts.ravel()[doubts] = np.floor(finer)
    off = np.abs(finer - np.rint(finer))
    error = FINER_ERROR_PER_BEND3 * np.abs(bends) ** 3 + FINER_ERROR_E / root**3
    near = off < error
    counts.ravel()[doubts[near]] = np.rint(finer[near]) - 1
    _decide(counts, mean_e, normal, doubts[near])
    return counts


def _decide(
    counts: Float32Array, mean_e: Float32Array, normal: Float32Array, doubts: npt.NDArray[np.intp]
) -> None:
    """Raise the counts of the pixels `doubts`, lower bounds so far, to where the cumulative
    probability is reached.
    """
    from scipy.special import ndtr, pdtr

    numbers = normal.ravel()[doubts]
    means = mean_e.ravel()[doubts].astype(np.float64)
    counted = np.maximum(counts.ravel()[doubts], 0.0).astype(np.float64)
    low = pdtr(counted, means) < ndtr(numbers.astype(np.float64))
    counted += low
    climbing = np.flatnonzero(low & (np.abs(numbers) > ONE_STEP_SIGMAS))
    while len(climbing):
        reached = ndtr(numbers[climbing].astype(np.float64))
        short = pdtr(counted[climbing], means[climbing]) < reached
        climbing = climbing[short]
        counted[climbing] += 1
    counts.ravel()[doubts] = counted


class CountTable(NamedTuple):
    """Counts by mean and normal number.

    `cells` (rows * COLUMNS,) holds the smallest count of a cell, with UNSURE where there are more;
    `step_number` ((rows + 1) * UNSURE,) the number above which a count gives way to the next, at
    the means between rows.
    """

    cells: npt.NDArray[np.uint8]
    step_number: Float32Array


@cache
def _count_table() -> CountTable:
    """The table for means under TABLE_BELOW_E, made once."""
    from scipy.special import ndtri, pdtr

    mean_e = np.arange(int(TABLE_BELOW_E) * ROWS_PER_E + 1) / ROWS_PER_E
    number = ndtri(pdtr(np.arange(UNSURE), mean_e[:, None])).clip(-6.8, 6.8)
    edge = number * COLUMNS_PER_SIGMA + COLUMNS / 2

    row = np.arange(len(mean_e))[:, None]

    def counts(margin: float) -> npt.NDArray[np.intp]:
        steps = np.zeros((len(mean_e), COLUMNS), dtype=np.intp)
        column = np.ceil(edge + margin).astype(np.intp)
        np.add.at(steps, (row, column), number < 6.8)
        return steps.cumsum(axis=1)

    smallest = counts(MARGIN_COLUMNS)[:-1]
    largest = counts(-1 - MARGIN_COLUMNS)[1:]
    cells = np.where(largest > smallest, smallest | UNSURE, smallest)
    return CountTable(cells.astype(np.uint8).ravel(), number.astype(np.float32).ravel())


def draw_blocks(
    shape: tuple[int, int], rng: np.random.Generator, draw: Callable[[slice, Word64Array], None]
) -> None:
    """Call `draw` for the rows of each block of an image (height, width) with random words, on
    every core.

    Words are (parts, rows, width): two parts, or at the image's end what is left of each. One seed
    gives each block the same words on any number of threads. `OMP_NUM_THREADS` bounds them.
    """
    height, width = shape
    rows = max(1, PART_PX // width)
    key = int(rng.integers(2**63))

    def draw_block(first: int) -> None:
        seed = np.random.SeedSequence((key, first))
        stream = np.random.Generator(np.random.SFC64(seed))
        # A whole block is drawn at once, as two parts; the image's end part by part.
        end = min(first + 2 * rows, height)
        if end == first + 2 * rows:
            parts, step = 2, 2 * rows
        else:
            parts, step = 1, rows
        for top in range(first, end, step):
            part = slice(top, min(top + step, height))
            size = (part.stop - top) * width
            words = stream.integers(-(2**63), 2**63, size=size, dtype=np.int64)
            draw(part, words.reshape(parts, -1, width))

    blocks = range(0, height, 2 * rows)
    max_threads = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    threads = len(os.sched_getaffinity(0))
    if max_threads.isdecimal() and int(max_threads):
        threads = int(max_threads)
    threads = min(len(blocks), threads)
    if threads == 1:
        for first in blocks:
            draw_block(first)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(draw_block, blocks))
