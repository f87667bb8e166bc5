"""What a quantisation is, and those that look at pixels alone: `round` and `dither` (`exact` and
`temporal` look at stars).

A pixel's light lies between those of two levels, k and k + 1. `round` shows the nearer one.
`dither` works in light, not
in code: k + 1 has the probability (L - L_k) / (L_k+1 - L_k), so that the mean light is the light
wanted.
All compute in float32 like the renderer, which has to give every pixel the same level.

Counting thresholds is fast by a table: the bits of a positive float rise with its value, so its
leading bits are an index.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.panel import Panel
from hilstar.display.response import Levels, Response, encode
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

Quantisation = Literal["round", "dither", "temporal", "exact"]

MASK_FILE = Path(__file__).parent / "data" / "blue-noise.npy"  # made by tools/make_blue_noise.py

# over which `temporal` is judged unless a bench says otherwise: 100 ms at 60 Hz
EXPOSURE_FRAMES = 6
MASK_TURNS = 4096  # the mask has no more distinct thresholds
MANTISSA_BITS = 23
MAX_FINER = 4  # times as many bins as thresholds to an octave, so that no bin holds two
# a whole frame of 2500 to 5000 stars, for each: 1080p over 31 deg at 1 to 15 deg/s, two llvmpipe
# cores
MS_A_STAR = 0.002


@dataclass(frozen=True, slots=True)
class UnquantisedFrame:
    """The light of one frame: its sprites (None: black), and functions that draw it all, and its
    discs and stray light alone.

    Those give float32 (height, width), electrons per second, when a quantiser asks. `number` counts
    the frames shown.
    """

    sprites: FrameLight | None
    linear: Callable[[], Float32Array]
    extended: Callable[[], Float32Array]
    number: int = 0


@dataclass(frozen=True, slots=True)
class LevelCost:
    """The time of a whole frame for each of its stars, ms, and why it is long ("" where it is
    not).
    """

    a_star_ms: float
    why: str = ""


class Quantiser(ABC):
    """A quantisation: its class says what it needs, costs and means; an instance is its NumPy
    oracle for one panel.

    `words` describe it in the bench file's reference. `shader` is its own part of the GL pass (in
    shaders/, "" for none). `other_codes` is the largest share of a frame's lit pixels whose codes
    may be one off where another renderer, or the other way of drawing stars, draws the same
    light. Measured with light that is off by 2e-7, as by another exp2: none to 3e-6 of `round`, and
    in the worst frame 5e-3 of `exact`. A choice of `exact` has ties that the last bit decides, and
    takes a star's other pixels with it. In `temporal` all later frames of that star go on from
    there: of a still sky 0.2 to 0.3 of the lit pixels after 120 frames.
    """

    words: ClassVar[str]
    shader: ClassVar[str] = ""
    other_codes: ClassVar[float] = 1e-4

    def __init__(
        self, panel: Panel, resolution_px: tuple[int, int], psf: Psf, seen: Seen = AS_USUAL
    ) -> None:
        """For images of `resolution_px`, sprites of `psf`, and a tracker that sees the monitor
        as `seen`.
        """
        self._panel = panel

    @abstractmethod
    def draw(self, light: UnquantisedFrame) -> Levels:
        """The levels of the next frame (height, width); the next call may overwrite them."""

    @abstractmethod
    def begin_anew(self) -> None:
        """Forget the frames so far: the next one is the first of a sequence."""

    @classmethod
    @abstractmethod
    def by_pixel(cls) -> "type[PixelQuantiser]":
        """The quantiser that the GL draws before it looks at stars: a PixelQuantiser itself,
        `round` for the others.
        """

    @classmethod
    def cost(cls, psf: Psf, gl_version: int) -> LevelCost:
        """Its cost on two cores without a GPU, by OpenGL `gl_version` (such as 430)."""
        return LevelCost(MS_A_STAR)

    @classmethod
    def lit_from_e_per_s(cls, panel: Panel) -> float:
        """The light that a star needs in a pixel to light it from a level of 0; 0 where any may
        do.
        """
        return float(panel.response.threshold[0]) * panel.flux_at_white_e_per_s

    @classmethod
    def faintest_e_per_s(cls, panel: Panel, psf: Psf) -> float:
        """The rate below which a single star lights no pixel at any phase; 0 where it always
        may.
        """
        return 0.0

    @classmethod
    def exposure(cls, before: int, count: int) -> range:
        """The frames of a still sky whose mean an exposure of `count` frames after `before`
        others shows: the first for all.
        """
        return range(1)


class PixelQuantiser(Quantiser):
    """Looks at each pixel alone: a table counts the `edges_e_per_s` at or below its light, and that
    is its level.

    A `shader` may add one: `bool rises(ivec2 pixel, float light, float low, float high)`, of the
    edges about the light.
    """

    @abstractmethod
    def levels(self, linear_e_per_s: Float32Array, number: int = 0) -> Levels:
        """The levels of a linear image (height, width), which is that of frame `number`."""

    def draw(self, light: UnquantisedFrame) -> Levels:
        """The levels of the next frame."""
        return self.levels(light.linear(), light.number)

    def begin_anew(self) -> None:
        """No frame knows of another."""

    @classmethod
    def by_pixel(cls) -> "type[PixelQuantiser]":
        """Itself."""
        return cls

    @classmethod
    def edges_e_per_s(cls, panel: Panel) -> Float32Array:
        """The rising lights of levels 1, 2, ... or what else pixels are counted by, float32
        (levels - 1,).
        """
        return panel.light_e_per_s()[1:]

    @classmethod
    def masks(cls) -> dict[str, Float32Array]:
        """The float32 textures (height, width) of its shader, by name."""
        return {}

    @classmethod
    def uniforms(cls, number: int) -> dict[str, float]:
        """The uniforms of its shader in frame `number`, by name."""
        return {}


class RoundQuantiser(PixelQuantiser):
    """The nearest level of each pixel."""

    words = "the nearest code."

    def levels(self, linear_e_per_s: Float32Array, number: int = 0) -> Levels:
        """See `round_levels`."""
        return round_levels(linear_e_per_s, self._panel)

    @classmethod
    def edges_e_per_s(cls, panel: Panel) -> Float32Array:
        """The thresholds."""
        return panel.response.thresholds_e_per_s(panel.flux_at_white_e_per_s)

    @classmethod
    def faintest_e_per_s(cls, panel: Panel, psf: Psf) -> float:
        """The rate whose middle pixel reaches the first threshold at the best phase."""
        return cls.lit_from_e_per_s(panel) / psf.peak_share


class DitherQuantiser(PixelQuantiser):
    """One of the two levels about each pixel's light, by a blue-noise mask."""

    words = "blue noise, exact in the mean over pixels."
    shader = "dither.glsl"

    def levels(self, linear_e_per_s: Float32Array, number: int = 0) -> Levels:
        """See `dither_levels`."""
        return dither_levels(linear_e_per_s, self._panel)

    @classmethod
    def lit_from_e_per_s(cls, panel: Panel) -> float:
        """0: any light may."""
        return 0.0

    @classmethod
    def masks(cls) -> dict[str, Float32Array]:
        """Blue noise."""
        return {"mask": blue_noise()}

    @classmethod
    def uniforms(cls, number: int) -> dict[str, float]:
        """The mask stands still."""
        return {"shift": 0.0}


def level_dtype(response: Response) -> type[np.uint8] | type[np.uint16]:
    """uint8 up to 256 levels, uint16 beyond."""
    if len(response.light) <= 256:
        return np.uint8
    return np.uint16


def _wanted(linear_e_per_s: Float32Array, panel: Panel) -> Float32Array:
    """The light to ask of a pixel, by its gain."""
    gain = panel.gain()
    if gain is None:
        return linear_e_per_s
    return linear_e_per_s * gain


def round_levels(linear_e_per_s: Float32Array, panel: Panel) -> Levels:
    """The nearest level of each pixel, (height, width) as `linear_e_per_s`; light over white
    becomes white.
    """
    return encode(_wanted(linear_e_per_s, panel), panel.response, panel.flux_at_white_e_per_s)


def dither_levels(linear_e_per_s: Float32Array, panel: Panel, shift: float = 0.0) -> Levels:
    """One of the two levels about each pixel's light, as a blue-noise mask turned by `shift` (0
    to 1) decides.

    The mean light over all thresholds of the mask is the wanted light within 1/8192 of a step of
    levels.
    """
    light = panel.light_e_per_s()
    white = panel.response.white
    place = np.flatnonzero(linear_e_per_s)  # `np.nonzero` takes six times as long
    wanted = linear_e_per_s.ravel()[place]
    gain = panel.gain()
    mask = turned_mask(shift)
    if gain is not None:
        wanted = wanted * gain.ravel()[place]
    lower = ThresholdCounter(light[1:]).count(wanted)
    rows, columns = np.divmod(place, linear_e_per_s.shape[1])
    threshold = mask[rows % len(mask), columns % len(mask)]
    step = light[np.minimum(lower + 1, white)] - light[lower]
    more = (lower < white) & (wanted - light[lower] > threshold * step)
    levels = np.zeros(linear_e_per_s.shape, dtype=level_dtype(panel.response))
    levels.ravel()[place] = lower + more
    return Levels(levels)


@lru_cache(maxsize=1)
def blue_noise() -> Float32Array:
    """Thresholds strictly between 0 and 1, float32 (64, 64): the middles of 4096 equal parts,
    each once.
    """
    ranks = np.load(MASK_FILE)
    mask = ((ranks + 0.5) / ranks.size).astype(np.float32)
    mask.setflags(write=False)
    return np.asarray(mask)


def turned_mask(shift: float) -> Float32Array:
    """The blue-noise mask plus `shift`, modulo 1; float32, exact for shifts in 4096ths."""
    turned = blue_noise() + np.float32(shift)
    return np.asarray(turned - np.floor(turned))


def mask_turn(frame: int) -> float:
    """The mask's turn in a frame, for extended light in `temporal`: van der Corput's sequence in
    base 2.

    The turns of each aligned block of 2^m frames divide [0, 1) evenly; after MASK_TURNS frames it
    begins again.
    """
    place = frame % MASK_TURNS
    turn = 0.0
    weight = 0.5
    while place:
        turn += weight * (place & 1)
        place >>= 1
        weight /= 2
    return turn


def shown_light(levels: Levels, panel: Panel) -> FloatArray:
    """The light of levels (height, width) on a monitor: electrons per second above the black level,
    float64.

    Of levels (height, width, 3) it is the sum of the primaries'.
    """
    if levels.ndim == 3:
        return np.asarray(sum(primary_lights(levels, panel)))
    lit = lit_light(levels, panel)
    light = np.zeros(levels.shape)
    light.ravel()[lit.place] = lit.e_per_s
    return light


class LitLight(NamedTuple):
    """The pixels of an image that have light: their places in the flat image and their electrons
    per second, (n,) each.
    """

    place: IntArray
    e_per_s: FloatArray

    @classmethod
    def of(cls, image: FloatArray | Float32Array) -> "LitLight":
        """That of an image (height, width)."""
        place = np.flatnonzero(image != 0)  # `np.nonzero` takes six times as long
        return cls(place, image.ravel()[place].astype(np.float64))

    def part(self, begin: int, end: int) -> "LitLight":
        """Some of them."""
        return LitLight(self.place[begin:end], self.e_per_s[begin:end])


def lit_light(levels: Levels, panel: Panel) -> LitLight:
    """`shown_light` of levels (height, width) where they are not 0, which has no light above
    black.
    """
    place = np.flatnonzero(levels)
    light = panel.response.light[levels.ravel()[place]] * panel.flux_at_white_e_per_s
    if panel.uniformity is not None:
        light = light * panel.uniformity.ravel()[place]
    return LitLight(place, light)


def primary_levels(levels: Levels, panel: Panel) -> list[tuple[Levels, Panel]]:
    """The levels (height, width) of each primary of levels (height, width, 3) with its panel;
    others as they are.
    """
    if levels.ndim == 2:
        return [(levels, panel)]
    return [(Levels(levels[..., k]), primary) for k, primary in enumerate(panel.primaries)]


def primary_lights(levels: Levels, panel: Panel) -> list[FloatArray]:
    """The light (height, width) of each primary of levels (height, width, 3); of levels (height,
    width) all light together.
    """
    return [shown_light(*primary_level) for primary_level in primary_levels(levels, panel)]


@dataclass(frozen=True, slots=True)
class CodeTable:
    """Thresholds, and the code at the lower edge of each bin of the light's leading bits (see
    encode.frag).
    """

    threshold: Float32Array
    first_code: npt.NDArray[np.uint32]
    bin_shift: int
    first_bin: int

    def steps(self) -> npt.NDArray[np.uint32] | None:
        """Each bin in a word: its first code, and the lower bits of its only threshold in
        `bin_shift` + 1 bits.

        Those are 1 << bin_shift where it has none, which no light reaches. Before the first bin
        there is an empty one, for all light below it. None where a bin has several thresholds.
        """
        bits = self.threshold.view(np.uint32)
        none = np.uint32(1 << self.bin_shift)
        place = (bits >> np.uint32(self.bin_shift)).astype(np.intp) - self.first_bin
        lower = bits & (none - 1)
        # the first code of a later bin counts a threshold at its very edge
        asked = (lower > 0) | (place == 0)
        place = place[asked]
        lower = lower[asked]
        if (place[1:] == place[:-1]).any():  # thresholds rise
            return None
        bins = np.full(len(self.first_code), none)
        bins[place] = lower
        bins |= self.first_code << np.uint32(self.bin_shift + 1)
        return np.concatenate([[none], bins])


def code_table(thresholds: Float32Array) -> CodeTable:
    """The table for rising, positive `thresholds`.

    There are as many bins per octave as thresholds, at most 4096, so that few bins hold more than
    one threshold; up to MAX_FINER times as many where then none does.
    """
    bits = min(12, len(thresholds).bit_length())
    coarsest = _table(thresholds, MANTISSA_BITS - bits)
    table = coarsest
    for finer in range(1, MAX_FINER.bit_length()):
        if table.steps() is not None:
            return table
        table = _table(thresholds, MANTISSA_BITS - bits - finer)
    return coarsest if table.steps() is None else table


def _table(thresholds: Float32Array, shift: int) -> CodeTable:
    """The table whose bins are the lights of the same leading bits, all but `shift` of them."""
    bits = thresholds.view(np.int32)
    first_bin = int(bits[0]) >> shift
    last_bin = int(bits[-1]) >> shift
    # the first bin that begins at or above each threshold
    first_edge = ((bits + ((1 << shift) - 1)) >> shift) - first_bin
    edges_of_bin = np.bincount(first_edge)[: last_bin - first_bin + 1]
    first_code = np.cumsum(edges_of_bin).astype(np.uint32)
    first_code[0] = 0
    return CodeTable(thresholds, first_code, shift, first_bin)


class ThresholdCounter:
    """Counts thresholds by a CodeTable, as encode.frag does: ten times as fast as a binary
    search of unsorted light.
    """

    def __init__(self, thresholds: Float32Array) -> None:
        table = code_table(thresholds)
        self._shift = table.bin_shift
        self._first_bin = table.first_bin
        self._first = table.first_code.astype(np.intp)
        self._threshold = np.append(thresholds, np.float32(np.inf))

    def count(self, light: Float32Array) -> IntArray:
        """How many thresholds are at or below each light, which is finite; same shape."""
        place = np.clip(
            (light.view(np.int32) >> self._shift) - self._first_bin, 0, len(self._first) - 1
        )
        count: IntArray = self._first[place]
        while (more := light >= self._threshold[count]).any():
            count += more
        return count
