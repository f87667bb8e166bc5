"""The worst errors of a quantisation: over a catalogue's magnitudes, and over places within a
pixel; at rest, and along the paths of a turn.

An error rises towards faint stars, and jumps from one magnitude to the next: `exact` leaves half a
step of a star's light at one, and nothing at the next. So the magnitudes are cut into SPANS, and
each star of a span has its own magnitude and its own phase. The spans are looked at in three steps:
every COARSE-th, then all about the worst, then stars ever nearer to the worst star of all: codes
jump, and the worst is in a corner of phases and magnitudes that no grid of them meets.
"""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import flux_ratio
from hilstar.display.balance import Balance, Seen
from hilstar.display.panel import Panel
from hilstar.display.phases import MARGIN_PX, WHITE, fainter, phase_image, shown_by
from hilstar.display.quantise import Quantisation
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.response import Response
from hilstar.optics.frame_motion import NODES_PER_SIGMA, POINT_SIGMA
from hilstar.optics.paths import node_counts, nodes_of
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight, pack_sprites
from hilstar.tracker.centroiders import Centroider
from hilstar.tracker.star_errors import Judge, spread_phases

PHASES = 12  # along each axis of a grid
# The first phases of the grids along x and y, in steps of 1 / PHASES px: no star is another's
# mirror image
GRIDS = ((0.25, 0.375), (0.75, 0.125), (0.5, 0.625), (0.05, 0.875))
# The way of the paths of each grid, as an angle: along columns, rows, and between them
WAYS_RAD = (0.05, 1.7, 0.8, 2.4)
ROUNDED: Quantisation = "round"
SPANS, COARSE, ABOUT = 60, 6, 3
GOLDEN = 0.6180339887498949  # its multiples, modulo 1, are spread evenly
# Where each star of a grid is in its span: the first and the last are its ends
IN_SPAN = np.append((np.arange(PHASES**2 - 1) * GOLDEN) % 1.0, 1.0)
# How far stars about the worst one are from its phase, px, round by round; and from its magnitude,
# in spans
NEARER_PX = (0.08, 0.03, 0.01)
NEARER_SPANS = (1.0, 0.4, 0.15)
ACROSS = np.linspace(-1.0, 1.0, PHASES)
# A pixel at the threshold of a box falls in or out by any change of light: 0.01 px of a box of 5
# that no display takes away (0.013 px at 16 bits, in place of 0.002).
NO_THRESHOLD = 0.0
# What a search misses, light and place, by the largest errors of 3200 other stars on six benches.
# Rounding pixel by pixel at rest is smooth between its jumps, and no star was beyond the corner
# that was found. Codes that are chosen together, and paths of any direction, have errors beyond it:
# 0.5 to 1.15 times those found of light and 0.71 to 1.19 times of place.
# tests/authority/test_effort.py holds the claim.
BEYOND_ROUNDED, BEYOND = (1.05, 1.1), (1.15, 1.2)


@dataclass(frozen=True, slots=True)
class CodeErrors:
    """The worst errors of a quantisation, and by whom a place is measured; infinite for a dark
    star.

    `centroider` is None where the flux alone was looked at. `by_span` are the same of the spans
    that were looked at: the brighter end of each, mag, with its flux and place. `still_px` is the
    worst place at rest, where stars on paths were looked at too; `turns` says whether one of those
    is the worst.
    """

    flux_mag: float
    place_px: float
    centroider: Centroider | None
    by_span: tuple[tuple[float, float, float], ...] = ()
    still_px: float | None = None
    turns: bool = False

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
    `path_px` is how far a star moves in a frame that turns, 0 where none does. `tables` are the
    response's arrays, by whose content two benches' stars are the same.
    """

    psf: Psf
    seen: Seen
    frames: int
    kinds: tuple[Centroider, ...]
    spans: tuple[tuple[float, float], ...]
    tables: tuple[bytes, ...]
    response: Response = field(compare=False)
    path_px: float = 0.0


@dataclass(frozen=True, slots=True)
class Phases:
    """Where the stars of a grid are: x of each column and y of each row (PHASES,) within a monitor
    pixel, `seen_x` and `seen_y` within the tracker's, and the way of their paths.
    """

    x_px: FloatArray
    y_px: FloatArray
    seen_x: FloatArray
    seen_y: FloatArray
    way_rad: float

    def near(self, star: int, radius_px: float) -> "Phases":
        """Phases about those of a star of the grid."""
        row, column = divmod(star, PHASES)
        return Phases(
            self.x_px[column] + radius_px * ACROSS,
            self.y_px[row] + radius_px * ACROSS,
            self.seen_x[column] + radius_px * np.roll(ACROSS, PHASES // 2),
            self.seen_y[row] + radius_px * np.roll(ACROSS, PHASES // 3),
            self.way_rad,
        )


@dataclass(frozen=True, slots=True)
class PhaseGrid:
    """Stars as bright as full scale at sub-pixel phases, their light, and the tracker that looks
    at them.
    """

    phases: Phases
    sprites: FrameLight
    bright: FloatArray
    tile_px: int
    judge: Judge


@dataclass(frozen=True, slots=True)
class Corner:
    """The star with the largest error so far: its error, who finds it, its grid, place in the grid
    and magnitude, and its span.
    """

    error: float
    centroider: Centroider | None
    phases: Phases
    star: int
    mag: float
    span: int


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
    if len(shown):
        mags = np.unique(np.maximum(-2.5 * np.log10(shown), 0.0))
    else:
        mags = np.zeros(1)
    begins = mags
    ends = mags
    if len(mags) > SPANS:
        edges = np.linspace(mags[0], mags[-1], SPANS + 1)
        begins = edges[:-1]
        ends = edges[1:]
    spans = tuple(zip(begins.tolist(), ends.tolist(), strict=True))
    if response.rgb is None:
        rgb = b""
    else:
        rgb = response.rgb.tobytes()
    tables = response.light.tobytes(), response.threshold.tobytes(), rgb
    return CodeStars(psf, seen, frames, kinds, spans, tables, response)


@lru_cache(maxsize=32)
def _grid(psf: Psf, seen: Seen, path_px: float, number: int) -> PhaseGrid:
    steps = np.arange(PHASES)
    spread = spread_phases(PHASES)
    first_x, first_y = GRIDS[number]
    x_px = (steps + first_x) / PHASES - 0.5
    y_px = (steps + first_y) / PHASES - 0.5
    phases = Phases(x_px, y_px, spread, spread, WAYS_RAD[number])
    return _grid_of(psf, seen, path_px, phases)


def _grid_of(psf: Psf, seen: Seen, path_px: float, phases: Phases) -> PhaseGrid:
    """A grid of stars at phases, each on a path of `path_px`: drawn as `frame_motion` draws paths,
    as sprites at Gauss-Legendre nodes.
    """
    sigmas = path_px / np.mean(psf.width_px)
    nodes = nodes_of(node_counts(np.array([sigmas]), NODES_PER_SIGMA, 1, POINT_SIGMA))
    along = nodes.place * path_px / 2
    tile = psf.footprint_px + MARGIN_PX + 2 * math.ceil(path_px / 2)
    middles = (np.arange(PHASES) + 0.5) * tile - 0.5
    places = middles + phases.x_px, middles + phases.y_px
    middle_x, middle_y = np.meshgrid(*places)
    x_px = middle_x[..., None] + along * math.cos(phases.way_rad)
    y_px = middle_y[..., None] + along * math.sin(phases.way_rad)
    flux = np.full(PHASES**2, WHITE / psf.peak_share)[:, None] * nodes.share
    star = np.repeat(np.arange(PHASES**2), len(along))
    size_px = PHASES * tile, PHASES * tile
    sprites = pack_sprites(
        x_px.ravel(), y_px.ravel(), flux.ravel(), star, size_px, psf.footprint_px
    )
    sprites = replace(sprites, per_star=len(along))
    bright = np.zeros(size_px)
    for first in range(len(along)):
        bright += phase_image(_every(sprites, first, len(along)), psf, tile)
    judge = Judge(
        bright,
        places,
        psf.width_px,
        seen.blur_px,
        seen.pixel_px,
        box_share=NO_THRESHOLD,
        phases=(phases.seen_x, phases.seen_y),
    )
    return PhaseGrid(phases, sprites, bright, tile, judge)


def _every(sprites: FrameLight, first: int, step: int) -> FrameLight:
    """The sprites of one node of each path."""
    some = slice(first, None, step)
    return FrameLight(
        sprites.data[some],
        sprites.footprint_px,
        sprites.star[some],
        sprites.x_px[some],
        sprites.y_px[some],
    )


@lru_cache(maxsize=64)  # the benches of a campaign, a verdict or a study have few monitors
def worst_errors(
    stars: CodeStars, method: Quantisation, limit: tuple[float, float] = (math.inf, math.inf)
) -> CodeErrors:
    """The worst errors of a method for stars at rest and, where a frame may turn, on paths.

    The search ends at the first errors that exceed the limit (mag, px): those are then given.
    """
    still = _worst(replace(stars, path_px=0.0), method, limit)
    if not stars.path_px or not still.within(limit):
        return still
    turning = _worst(stars, method, limit)
    further = max(still, turning, key=lambda one: one.place_px)
    return CodeErrors(
        max(still.flux_mag, turning.flux_mag),
        further.place_px,
        further.centroider,
        still.by_span + turning.by_span,
        still.place_px,
        further is turning or turning.flux_mag > still.flux_mag,
    )


def _worst(stars: CodeStars, method: Quantisation, limit: tuple[float, float]) -> CodeErrors:
    search = _Search(stars, method, limit)
    search.run()
    return search.worst()


class _Search:
    """The errors of the stars that were looked at so far."""

    def __init__(self, stars: CodeStars, method: Quantisation, limit: tuple[float, float]) -> None:
        self._stars = stars
        self._method = method
        self._limit = limit
        self._panel = Panel(stars.response, WHITE)
        self._balance = Balance(stars.psf, stars.seen)
        smooth = method == ROUNDED and not stars.path_px
        self._beyond = BEYOND_ROUNDED if smooth else BEYOND
        self._by_grid: dict[tuple[int, int], bool] = {}
        self._by_span: dict[int, tuple[float, float]] = {}
        self._of_flux: Corner | None = None
        self._of_place: Corner | None = None

    def run(self) -> None:
        """Look for the worst star, and end at the first that is over the limit."""
        # Steps are coarsest for faint stars: they are tried first, over a few spans of brightness.
        faintest_first = range(len(self._stars.spans) - 1, -1, -1)
        for span in faintest_first[::COARSE]:
            if self._is_over(span, span):
                return
        # then every span about the worst
        worst = self._corners()
        for span in faintest_first:
            near = min(abs(span - corner.span) for corner in worst) <= ABOUT
            if near and (self._is_over(span, span) or self._is_over(span, span + 1)):
                return
        # then phases ever nearer to the worst
        for radius_px, spans in zip(NEARER_PX, NEARER_SPANS, strict=True):
            for corner in self._corners():
                if self._is_over_near(corner, radius_px, spans):
                    return

    def worst(self) -> CodeErrors:
        """The largest errors so far, flux and place each by itself."""
        flux = self._of_flux
        place = self._of_place
        if flux is None:
            raise AssertionError("a span was looked at")
        by_span = tuple(
            (self._stars.spans[span][0], *errors) for span, errors in self._by_span.items()
        )
        if place is None:
            return CodeErrors(flux.error, math.inf, None, by_span)
        return CodeErrors(flux.error, place.error, place.centroider, by_span)

    def _corners(self) -> list[Corner]:
        return [corner for corner in (self._of_flux, self._of_place) if corner is not None]

    def _is_over(self, span: int, phases: int) -> bool:
        """Whether the errors of a span are over the limit, by the grid of a number."""
        key = span, phases % len(GRIDS)
        if key not in self._by_grid:
            begin, end = self._stars.spans[span]
            mags = begin + (end - begin) * IN_SPAN
            grid = _grid(self._stars.psf, self._stars.seen, self._stars.path_px, key[1])
            self._by_grid[key] = self._look(grid, mags, span)
        return self._by_grid[key]

    def _is_over_near(self, corner: Corner, radius_px: float, spans: float) -> bool:
        """Whether a star near the worst so far, in phase and brightness within its span, exceeds
        the limit.
        """
        stars = self._stars
        phases = corner.phases.near(corner.star, radius_px)
        begin, end = stars.spans[corner.span]
        reach_mag = spans * (end - begin)
        mags = np.clip(corner.mag + reach_mag * (IN_SPAN - 0.5), begin, end)
        grid = _grid_of(stars.psf, stars.seen, stars.path_px, phases)
        return self._look(grid, mags, corner.span)

    def _look(self, grid: PhaseGrid, mags: FloatArray, span: int) -> bool:
        """Whether the errors of stars of magnitudes (PHASES^2,) at the phases of a grid are over
        the limit.
        """
        stars = self._stars
        share = flux_ratio(mags)
        tile = np.ones((grid.tile_px, grid.tile_px))
        of_tiles = np.kron(share.reshape(PHASES, PHASES), tile)
        linear = (grid.bright * of_tiles).astype(np.float32)
        sprites = fainter(grid.sprites, np.repeat(mags, grid.sprites.per_star))
        quantiser = QUANTISERS[self._method]
        image = shown_by(quantiser, stars.frames, self._panel, linear, sprites, self._balance)
        beyond_flux, beyond_place = self._beyond
        max_mag, max_px = self._limit
        # Light first, without a centroider: it is quick, and may end the search.
        light_errors = grid.judge.errors(image, share, ())
        flux_mag = beyond_flux * np.abs(light_errors.flux_mag)
        star = int(flux_mag.argmax())
        of_flux = Corner(float(flux_mag[star]), None, grid.phases, star, float(mags[star]), span)
        if self._of_flux is None or of_flux.error > self._of_flux.error:
            self._of_flux = of_flux
        if of_flux.error > max_mag:
            self._note(span, of_flux.error, math.inf)
            return True
        errors = grid.judge.errors(image, share, stars.kinds)
        kind = errors.worst()
        x_px, y_px = errors.off_px[kind]
        off_px = beyond_place * np.hypot(x_px, y_px)
        star = int(off_px.argmax())
        of_place = Corner(float(off_px[star]), kind, grid.phases, star, float(mags[star]), span)
        if self._of_place is None or of_place.error > self._of_place.error:
            self._of_place = of_place
        self._note(span, of_flux.error, of_place.error)
        return of_place.error > max_px

    def _note(self, span: int, flux_mag: float, place_px: float) -> None:
        flux, place = self._by_span.get(span, (0.0, 0.0))
        self._by_span[span] = max(flux, flux_mag), max(place, place_px)
