"""The worst errors of a quantisation: over a catalogue's magnitudes, and over places within a
pixel.

An error rises towards faint stars, and jumps from one magnitude to the next: `exact` leaves half a
step of a star's light at one, and nothing at the next. So the magnitudes are cut into SPANS, and
each star of a span has its own magnitude and its own phase. The spans are looked at in two steps:
every COARSE-th, then all about the worst.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import flux_ratio
from hilstar.display.balance import Balance, Seen
from hilstar.display.phases import WHITE, fainter, line_places, phase_grid, phase_image, shown_by
from hilstar.display.quantise import Panel
from hilstar.display.quantisers import Quantisation
from hilstar.display.response import Response
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight
from hilstar.tracker.centroiders import Centroider
from hilstar.tracker.star_errors import Judge

PHASES = 12  # along each axis of a grid
# The first phases of the grids along x and y, in steps of 1 / PHASES px: no star is another's
# mirror image
GRIDS = ((0.25, 0.375), (0.75, 0.125), (0.5, 0.625), (0.05, 0.875))
SPANS, COARSE, ABOUT = 60, 6, 3
GOLDEN = 0.6180339887498949  # its multiples, modulo 1, are spread evenly
# Where each star of a grid is in its span: the first and the last are its ends
IN_SPAN = np.append((np.arange(PHASES**2 - 1) * GOLDEN) % 1.0, 1.0)
# A pixel at the threshold of a box falls in or out by any change of light: 0.01 px of a box of 5
# that no display takes away (0.013 px at 16 bits, in place of 0.002).
NO_THRESHOLD = 0.0
# What 2000 to 5000 stars miss of the worst: on nine benches the largest error of 27 000 was 0.8 to
# 1.5
# times theirs of light and 0.95 to 1.4 times of place. tests/authority/test_effort.py holds the
# claim.
BEYOND_MAG, BEYOND_PX = 1.4, 1.3


@dataclass(frozen=True, slots=True)
class CodeErrors:
    """The worst errors of a quantisation, and by whom a place is measured; infinite for a dark
    star.

    `centroider` is None where the flux alone was looked at. `by_span` are the same of the spans
    that were looked at: the brighter end of each, mag, with its flux and place.
    """

    flux_mag: float
    place_px: float
    centroider: Centroider | None
    by_span: tuple[tuple[float, float, float], ...] = ()

    def within(self, limit: tuple[float, float]) -> bool:
        """Whether both are within their limits, mag and px."""
        return self.flux_mag <= limit[0] and self.place_px <= limit[1]

    def brighter_than(self, mag: float) -> tuple[float, float]:
        """The worst flux and place of stars up to a magnitude: of the spans up to the next
        beyond it.
        """
        fainter = [begin for begin, _, _ in self.by_span if begin >= mag]
        last = min(fainter, default=math.inf)
        among = [
            (flux_mag, place_px) for begin, flux_mag, place_px in self.by_span if begin <= last
        ]
        return max((flux for flux, _ in among), default=0.0), max(
            (place for _, place in among), default=0.0
        )


@dataclass(frozen=True, slots=True)
class CodeStars:
    """The stars of a bench by their magnitudes below full scale, and the tracker that looks at
    them.

    `spans` are the ends of each span of magnitudes, the brighter first, by rising magnitudes.
    `tables` are the response's arrays, by whose content two benches' stars are the same.
    """

    psf: Psf
    seen: Seen
    frames: int
    kinds: tuple[Centroider, ...]
    spans: tuple[tuple[float, float], ...]
    tables: tuple[bytes, ...]
    response: Response = field(compare=False)


@dataclass(frozen=True, slots=True)
class PhaseGrid:
    """Stars as bright as full scale at sub-pixel phases, their light, and the tracker that looks
    at them.
    """

    sprites: FrameLight
    bright: FloatArray
    tile_px: int
    judge: Judge


def code_stars(
    psf: Psf,
    seen: Seen,
    frames: int,
    kinds: tuple[Centroider, ...],
    response: Response,
    peaks: FloatArray,
) -> CodeStars:
    """The stars of a catalogue for `worst_errors`, by what their brightest pixels have of white,
    `peaks` (n,).

    Those brighter than white clip, which is told elsewhere. Up to SPANS magnitudes are looked at as
    they are; more are many stars, which have any magnitude between the first and the last.
    """
    shown = peaks[peaks <= 1.0]
    mags = np.unique(np.maximum(-2.5 * np.log10(shown), 0.0)) if len(shown) else np.zeros(1)
    begins, ends = mags, mags
    if len(mags) > SPANS:
        edges = np.linspace(mags[0], mags[-1], SPANS + 1)
        begins, ends = edges[:-1], edges[1:]
    spans = tuple(zip(begins.tolist(), ends.tolist(), strict=True))
    rgb = b"" if response.rgb is None else response.rgb.tobytes()
    tables = response.light.tobytes(), response.threshold.tobytes(), rgb
    return CodeStars(psf, seen, frames, kinds, spans, tables, response)


@lru_cache(maxsize=16)
def _grid(psf: Psf, seen: Seen, number: int) -> PhaseGrid:
    sprites, tile_px = phase_grid(PHASES, psf, GRIDS[number])
    bright = phase_image(sprites, psf)
    places = line_places(sprites)
    judge = Judge(bright, places, psf.width_px, seen.blur_px, seen.pixel_px, box_share=NO_THRESHOLD)
    return PhaseGrid(sprites, bright, tile_px, judge)


@lru_cache(maxsize=64)  # the benches of a campaign, a verdict or a study have few monitors
def worst_errors(
    stars: CodeStars, method: Quantisation, limit: tuple[float, float] = (math.inf, math.inf)
) -> CodeErrors:
    """The worst errors of a method; of one beyond the limit (mag, px) the first that are over
    it.
    """
    search = _Search(stars, method, limit)
    faintest_first = range(len(stars.spans) - 1, -1, -1)
    for place in faintest_first[::COARSE]:
        if search.is_over(place):
            return search.worst()
    of_flux, of_place = search.worst_places()
    for place in faintest_first:
        near = min(abs(place - of_flux), abs(place - of_place)) <= ABOUT
        if near and (search.is_over(place) or search.is_over(place, place + 1)):
            break
    return search.worst()


class _Search:
    """The errors of the spans that were looked at so far."""

    def __init__(self, stars: CodeStars, method: Quantisation, limit: tuple[float, float]) -> None:
        self._stars, self._method, self._limit = stars, method, limit
        self._panel = Panel(stars.response, WHITE)
        self._balance = Balance(stars.psf, stars.seen)
        self._found: dict[tuple[int, int], CodeErrors] = {}

    def is_over(self, place: int, phases: int | None = None) -> bool:
        """Whether the errors of the span at a place are over the limit, by its own or another
        grid.
        """
        key = place, (place if phases is None else phases) % len(GRIDS)
        if key not in self._found:
            self._found[key] = self._errors(*key)
        return not self._found[key].within(self._limit)

    def worst(self) -> CodeErrors:
        """The largest errors so far, flux and place each by itself."""
        flux_mag = max(one.flux_mag for one in self._found.values())
        furthest = max(self._found.values(), key=lambda one: one.place_px)
        spans = self._stars.spans
        by_span = tuple(
            (spans[key[0]][0], one.flux_mag, one.place_px) for key, one in self._found.items()
        )
        return CodeErrors(flux_mag, furthest.place_px, furthest.centroider, by_span)

    def worst_places(self) -> tuple[int, int]:
        """The places of the spans with the largest errors of flux and of place."""
        of_flux = max(self._found, key=lambda key: self._found[key].flux_mag)
        of_place = max(self._found, key=lambda key: self._found[key].place_px)
        return of_flux[0], of_place[0]

    def _errors(self, place: int, number: int) -> CodeErrors:
        stars = self._stars
        grid = _grid(stars.psf, stars.seen, number)
        begin, end = stars.spans[place]
        mags = begin + (end - begin) * IN_SPAN
        share = flux_ratio(mags)
        of_tiles = np.kron(share.reshape(PHASES, PHASES), np.ones((grid.tile_px, grid.tile_px)))
        linear = (grid.bright * of_tiles).astype(np.float32)
        sprites = fainter(grid.sprites, mags)
        image = shown_by(self._method, stars.frames, self._panel, linear, sprites, self._balance)
        flux_mag = BEYOND_MAG * grid.judge.errors(image, share, ()).flux_max_mag
        if flux_mag > self._limit[0]:
            return CodeErrors(flux_mag, math.inf, None)
        errors = grid.judge.errors(image, share, stars.kinds)
        kind = errors.worst()
        return CodeErrors(flux_mag, BEYOND_PX * errors.max_px(kind), kind)
