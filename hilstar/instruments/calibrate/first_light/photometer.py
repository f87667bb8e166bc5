"""The tracker as a photometer: dots on lattices that do not saturate it, each reading with its
standard error.

A reading is the sum of an image over a field of dots, less that of a black screen, over the number
of dots and the exposure. Codes differ by three decades and more, an image holds two. Bright codes
are read on sparse lattices and faint ones on dense lattices; those that are still faint there are
exposed longer. A lattice and an exposure are a `Range`. Neighbouring ranges are compared by one
code that both of them hold, in pairs of images.

The standard errors come from the images themselves. Repeats of one image tell the noise of its sum,
pixel by pixel. What several readings have in common is told apart (`Readings.common`): the ratios
of ranges, and the ADC's rounding, which is alike in all pixels of one light where too little noise
spreads it over the steps.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.files import write_whole
from hilstar.instruments.calibrate.first_light.context import HOT_FILL, MAX_FILL, StepContext
from hilstar.instruments.calibrate.first_light.image_sources import CodeImage, Pattern, black
from hilstar.instruments.calibrate.measurements import COMMON
from hilstar.instruments.calibrate.plan import Patch, in_channel
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.monitor import bench_calibration
from hilstar.tracker.rounding import (
    STEP_PHASES,
    before_adc_dn,
    cut_light,
    rounded_light,
    rounding_rms,
)

SHARE = 0.5  # relative to the smaller side of what both screen and tracker have
MAX_SIDE_TRACKER_PX = 200.0
APART_TRACKER_PX = 8.0  # distance of the sparsest lattice's dots: their wings do not add up
# of what is cut off at code 0: the noise of a detector is stated to about a fifth
CUT_UNKNOWN = 0.3
MIN_DOTS = 4  # along a side of the sparsest lattice
MARGIN_SIGMAS, MARGIN_PX = 6.0, 3.0
PHASES = 24
FILL = 0.5  # peak that a range is chosen for, relative to the tracker's range
LESS = 4.0  # by which the exposure is shortened while white saturates
LONGER = 4  # by which it is lengthened from range to range for faint codes
LONGEST_S = 10.0
FAINT_DN = 32.0  # a peak below this is exposed longer: half a step of the ADC is over 1 % of it
MAX_PROBES = 10
BLACK = Patch(0, "w")
HALF_STEP_DN = 0.5  # of the ADC
SMALL_MODE = 0.01  # of each reading's own error: modes of the rounding below it are not written


@dataclass(frozen=True, slots=True)
class DotField:
    """A square of the monitor (left, top, side; px) and the part of the tracker's image with its
    light (slices).

    `monitor_px` is the number of monitor pixels seen in that part, each by its light relative to
    that of the square's.
    """

    left: int
    top: int
    side: int
    rows: slice
    columns: slice
    monitor_px: float

    @property
    def tracker_px(self) -> int:
        """The number of the tracker's pixels in that part."""
        height: int = self.rows.stop - self.rows.start
        width: int = self.columns.stop - self.columns.start
        return height * width

    def lattice(self, resolution_px: tuple[int, int], period: int, patch: Patch) -> CodeImage:
        """Every `period`-th pixel of the square, across and down, in a patch's code and channel."""
        codes = black(resolution_px)
        first = period // 2
        rows = slice(self.top, self.top + self.side)
        columns = slice(self.left, self.left + self.side)
        codes[rows, columns][first::period, first::period] = patch.code
        return in_channel(codes, patch.channel)

    def lit(self, period: int) -> int:
        """The number of lit pixels of a lattice of this period."""
        return (self.side // period) ** 2


def field_for(
    geometry: BenchGeometry, sigma_px: float, even: Float32Array | None = None
) -> tuple[DotField, tuple[int, ...]]:
    """The square for lattices, and their periods from dense to sparse; `sigma_px` is the tracker's
    PSF, `even` (h, w) the screen's relative light.

    Raises InputError where too little of the monitor is seen.
    """
    width, height = geometry.monitor.resolution_px
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    smaller_side_px = min(ratio * width, ratio * height, *geometry.tracker.resolution_px)
    side = min(SHARE * smaller_side_px, MAX_SIDE_TRACKER_PX) / ratio
    sparsest = 2 ** math.ceil(math.log2(max(APART_TRACKER_PX / ratio, 1.0)))
    cells = int(side // sparsest)
    if cells < MIN_DOTS:
        raise InputError(
            "the tracker sees too little of the monitor for the response; look at focal lengths and"
            " pixel pitches"
        )
    square_px = cells * sparsest
    first_column, first_row = _corner(geometry, square_px)
    margin = MARGIN_PX + MARGIN_SIGMAS * math.hypot(sigma_px, ratio / math.sqrt(12))
    rows, columns = _seen(geometry, (first_column, first_row), square_px, margin)
    powers = range(int(math.log2(sparsest)) + 1)
    periods = tuple(2**power for power in powers)
    area_px = monitor_area(geometry, rows, columns, even)
    if even is not None:
        square_rows = slice(first_row, first_row + square_px)
        square_columns = slice(first_column, first_column + square_px)
        square_light = even[square_rows, square_columns]
        area_px /= float(square_light.mean())
    field = DotField(first_column, first_row, square_px, rows, columns, area_px)
    return field, periods


def _corner(geometry: BenchGeometry, square_px: int) -> tuple[int, int]:
    """The left top of a square about the middle of what is seen, kept on the screen, monitor px."""
    width, height = geometry.tracker.resolution_px
    middle_x = np.array([(width - 1) / 2])
    middle_y = np.array([(height - 1) / 2])
    (x,), (y,) = geometry.to_monitor(middle_x, middle_y)
    monitor_width, monitor_height = geometry.monitor.resolution_px
    first_column = _first_px(x, monitor_width, square_px)
    first_row = _first_px(y, monitor_height, square_px)
    return first_column, first_row


def _first_px(middle: float, size: int, square_px: int) -> int:
    """The first pixel of a square about a place on an axis of `size` pixels; about the middle of
    these where the place is NaN.
    """
    if not math.isfinite(middle):
        middle = (size - 1) / 2
    first = round(middle - (square_px - 1) / 2)
    return int(np.clip(first, 0, size - square_px))


def _seen(
    geometry: BenchGeometry, corner: tuple[int, int], side: int, margin: float
) -> tuple[slice, slice]:
    """The rows and columns of the tracker's image that the square and its wings cover."""
    along = np.linspace(0, side - 1, 33)
    low = np.zeros_like(along)
    high = np.full_like(along, side - 1)
    x = corner[0] + np.concatenate([along, along, low, high])
    y = corner[1] + np.concatenate([low, high, along, along])
    place = geometry.to_tracker(x, y)
    if not all(np.isfinite(part).all() for part in place):
        raise InputError("the middle of the tracker's field sees no screen; run the geometry again")
    ends = []
    for part, size in zip(place, geometry.tracker.resolution_px, strict=True):
        first = math.floor(part.min() - margin)
        last = math.ceil(part.max() + margin) + 1
        if first < 0 or last > size:
            raise InputError(
                "the dots are not whole in the tracker's field; look at [collimator] and run the"
                " geometry again"
            )
        ends.append(slice(first, last))
    return ends[1], ends[0]


def monitor_area(
    geometry: BenchGeometry, rows: slice, columns: slice, even: Float32Array | None = None
) -> float:
    """The number of monitor pixels that a part of the tracker's image sees, those beyond the
    screen's edge not counted; each counts by `even` (h, w) where that is known.

    Each tracker pixel is a quadrangle on the monitor. A tilted screen and a wide field make them
    differ by several percent.
    """
    y, x = np.mgrid[rows.start : rows.stop + 1, columns.start : columns.stop + 1] - 0.5
    seen_x, seen_y = geometry.to_monitor(x.ravel(), y.ravel())
    corner_x = seen_x.reshape(y.shape)
    corner_y = seen_y.reshape(y.shape)
    down_x, up_x = _diagonals(corner_x)
    down_y, up_y = _diagonals(corner_y)
    # Half the cross product of a quadrangle's diagonals.
    area = np.nan_to_num(np.abs(down_x * up_y - down_y * up_x)) / 2
    width, height = geometry.monitor.resolution_px
    middle_x = _middles(corner_x)
    middle_y = _middles(corner_y)
    from_middle_x = np.abs(middle_x - (width - 1) / 2)
    from_middle_y = np.abs(middle_y - (height - 1) / 2)
    on_screen = (from_middle_x <= width / 2) & (from_middle_y <= height / 2)
    area = area[on_screen]
    if even is not None:
        # A black screen glows over the whole part, whose edges are darker than the dots' square.
        row = np.clip(np.rint(middle_y[on_screen]), 0, height - 1).astype(np.intp)
        column = np.clip(np.rint(middle_x[on_screen]), 0, width - 1).astype(np.intp)
        area = area * even[row, column]
    return float(area.sum())


def _diagonals(corner: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Diagonals (h, w) of quadrangles along one axis, down to the right and up to the right, by
    that axis of their corners (h + 1, w + 1).
    """
    down = corner[1:, 1:] - corner[:-1, :-1]
    up = corner[:-1, 1:] - corner[1:, :-1]
    return down, up


def _middles(corner: FloatArray) -> FloatArray:
    """Middles (h, w) of quadrangles along one axis, by their corners (h + 1, w + 1)."""
    return np.asarray((corner[1:, 1:] + corner[:-1, :-1]) / 2)


def lattice_profile(period: int, ratio: float, sigma_px: float) -> FloatArray:
    """The share of a lit pixel's light along one axis, at PHASES places of a tracker pixel between
    two of a lattice's dots.

    `ratio` is tracker px per monitor px. A monitor pixel counts as a Gaussian of its own variance.
    """
    sigma = math.hypot(sigma_px, ratio / math.sqrt(12))
    step = period * ratio
    neighbours = math.ceil(MARGIN_SIGMAS * sigma / step) + 1
    reach = np.arange(-neighbours, neighbours + 1) * step
    place = np.linspace(-0.5, 0.5, PHASES)[:, None] * step + reach
    beyond = ndtr((place + 0.5) / sigma)
    before = ndtr((place - 0.5) / sigma)
    return np.asarray((beyond - before).sum(axis=1))


def peak_shares(periods: tuple[int, ...], ratio: float, sigma_px: float) -> FloatArray:
    """The share of a lit pixel's light in the brightest tracker pixel, per lattice; `ratio` is
    tracker px per monitor px.
    """
    shares = []
    for period in periods:
        profile = lattice_profile(period, ratio, sigma_px)
        # the profile is the same along both axes
        shares.append(float(profile.max()) ** 2)
    return np.array(shares)


class Range(NamedTuple):
    """A lattice, every `period`-th pixel lit, and how many times longer than the exposure for white
    it is exposed.
    """

    period: int
    times: int = 1


@dataclass(frozen=True, slots=True)
class LatticeRatio:
    """A lit pixel's light on a dense lattice relative to a sparse one, both of one code: 1 where
    light is additive.

    `ratio` is the mean of `pairs`, of one pair of images each, and `error` its standard error.
    Where `times` is not (1, 1), the dense lattice was exposed so many times longer, and then the
    sparse one.
    """

    patch: Patch
    dense: int
    sparse: int
    ratio: float
    pairs: tuple[float, ...] = ()
    error: float = 0.0
    times: tuple[int, int] = (1, 1)

    @property
    def sigmas(self) -> float:
        """How far the ratio is from 1, in its standard errors."""
        if self.error:
            return abs(self.ratio - 1) / self.error
        return 0.0

    @property
    def words(self) -> str:
        """The ratio for a person."""
        dense, sparse = self.times
        ratio = f"{self.ratio:.5f} +- {self.error:.5f} times"
        code = f"code {self.patch.code} of {self.patch.channel}"
        return (
            f"{code}: a pixel of every {self.dense}{_exposed(dense)} is {ratio} one of every"
            f" {self.sparse}{_exposed(sparse)}"
        )


def _exposed(times: int) -> str:
    if times > 1:
        return f", exposed {times} times longer"
    return ""


@dataclass(frozen=True, slots=True)
class Readings:
    """Light (n,) of a lit pixel for each patch, black level included, DN/s; the exposure; how
    lattices agree.

    `above_black` (n,) is without it, and may be negative by noise, which `light` is not. `period`
    (n,) is each one's lattice. `black_known` says whether the black level was measured; else it is
    the bench file's. `sigma` (n,) is each reading's own standard error, DN/s. `common` (n, causes)
    is what one standard error of a cause does to all of them, DN/s: of the ratios of ranges, of
    rounding, of the black level.
    """

    patches: list[Patch]
    light: FloatArray
    exposure_s: float
    links: list[LatticeRatio]
    black_known: bool
    images: tuple[Path, ...]
    above_black: FloatArray
    period: IntArray
    sigma: FloatArray
    common: FloatArray

    def write(self, path: Path) -> None:
        """MEASURED.csv, as `calibrate photometric` reads it. Raises InputError."""
        light = "light of one monitor pixel in the tracker, DN/s, by dots on lattices"
        lines = [f"# {light}; exposed for {self.exposure_s:.6g} s"]
        for link in self.links:
            lines.append(f"# {link.words}")
        columns = ["order", "code", "channel", "value", "sigma"]
        for cause in range(self.common.shape[1]):
            columns.append(f"{COMMON}{cause + 1}")
        lines.append(",".join(columns))
        for order, patch in enumerate(self.patches):
            value = float(self.light[order])
            cells = [str(order + 1), str(patch.code), patch.channel, repr(value)]
            for error in (self.sigma[order], *self.common[order]):
                cells.append(f"{error:.5g}")
            lines.append(",".join(cells))
        write_whole(path, "\n".join(lines) + "\n")


@dataclass(frozen=True, slots=True)
class Assumed:
    """The bench file's light above black by channel and code (2^bits,), relative to white, and its
    black level.
    """

    light: dict[str, FloatArray]
    black: float


class Look(NamedTuple):
    """The sum over a lattice's field, DN, and its brightest pixel relative to full scale."""

    sum_dn: float
    fill: float


@dataclass
class PixelScatter:
    """The noise of sums over the field, from images of one pattern that were taken again.

    The variance of a black image's sum, DN^2, is known for each exposure; light adds `dn_per_e` to
    it for each DN of its sum. `default_dn_per_e` stands in where no lit pattern was repeated.
    """

    default_dn_per_e: float
    _before: dict[tuple[Patch, Range], FloatArray] = field(default_factory=dict)
    _squares: dict[tuple[Patch, Range], list[float]] = field(default_factory=dict)
    _sums: dict[tuple[Patch, Range], float] = field(default_factory=dict)

    def add(self, patch: Patch, at: Range, image: FloatArray) -> None:
        """Take in an image (h, w), DN."""
        if patch.code:
            place = (patch, at)
        else:
            place = (BLACK, Range(1, at.times))
        before = self._before.get(place)
        if before is not None:
            # Half the square of a difference is the variance of each of the two, where pixels'
            # noise is their own.
            variance = float(((image - before) ** 2).sum()) / 2
            self._squares.setdefault(place, []).append(variance)
        self._before[place] = image
        self._sums[place] = float(image.sum())

    def dark_dn2(self, times: int) -> float:
        """The variance of the sum of a black image, exposed so many times longer."""
        squares = self._squares.get((BLACK, Range(1, times)), [])
        if not squares:
            # of any exposure
            for (patch, _), others in self._squares.items():
                if not patch.code:
                    squares = squares + others
        if squares:
            return sum(squares) / len(squares)  # of a handful NumPy's mean takes ten times as long
        return 0.0

    def dark_sum_dn(self, times: int) -> float:
        """The sum of the last black image, DN, exposed so many times longer, else of another."""
        sums = {}
        for (patch, at), total in self._sums.items():
            if not patch.code:
                sums[at.times] = total
        return sums.get(times, max(sums.values(), default=0.0))

    @property
    def dn_per_e(self) -> float:
        """DN an electron, as the variance of light over the light: by repeated images of lit
        patterns, and as the detector is stated where none was repeated.
        """
        variance = 0.0
        light = 0.0
        for (patch, at), squares in self._squares.items():
            dark = self._sums.get((BLACK, Range(1, at.times)))
            if not patch.code or dark is None:
                continue
            variance += sum(squares) - len(squares) * self.dark_dn2(at.times)
            light += len(squares) * (self._sums[patch, at] - dark)
        if light > 0:
            return max(variance / light, 0.0)
        return self.default_dn_per_e

    def sum_dn2(self, light_dn: float, times: int, blacks: float = 1.0) -> float:
        """The variance of a sum above black; `blacks` is the variance of the black sum relative to
        that of one image.
        """
        return self.dn_per_e * max(light_dn, 0.0) + (1 + blacks) * self.dark_dn2(times)


class _Reading(NamedTuple):
    """A lit patch as it was read: its range, and its light above black, DN, summed over the field
    in that range's exposure.

    `blacks` is the variance of the black sum under it relative to that of one image.
    """

    patch: Patch
    at: Range
    light_dn: float
    blacks: float


class _Values(NamedTuple):
    """Light of each patch above black (n,) and its own standard error (n,), DN/s, and what one DN
    of a lit patch's sum is in DN/s (n,).
    """

    light: FloatArray
    sigma: FloatArray
    per_dn: FloatArray


class _Pair(NamedTuple):
    """One code read in two neighbouring ranges, and the means of its light over the pairs of
    images, as in `_Reading`.
    """

    patch: Patch
    more: Range
    less: Range
    light_dn: tuple[float, float]
    ratios: tuple[float, ...]


class Photometer:
    """The tracker as a photometer. Raises InputError where the lattices are not whole in its field.

    Ranges are compared by `pairs` pairs of images. Faint codes are exposed for up to `longest_s`,
    where the source of images sets exposures.
    """

    def __init__(
        self,
        context: StepContext,
        sigma_px: float,
        assumed: Assumed,
        pairs: int = 1,
        longest_s: float = 0.0,
    ) -> None:
        geometry = context.real_geometry()
        self.context = context
        self.assumed = assumed
        self.pairs = pairs
        self.longest_s = longest_s
        light_map = bench_calibration(context.file.config, context.file.folder)
        even = light_map.uniformity_map(context.resolution_px)
        self._even_relative = light_map.uniformity_relative or 0.0
        self.field, self.periods = field_for(geometry, sigma_px, even)
        self.ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
        self.shares = peak_shares(self.periods, self.ratio, sigma_px)
        self.profiles: dict[int, FloatArray] = {}
        for period in self.periods:
            self.profiles[period] = lattice_profile(period, self.ratio, sigma_px)
        self.exposure_s = context.exposure_s
        self.scatter = PixelScatter(1 / context.detector.gain_e_per_dn)
        self._dark_screen = context.take(self._black_screen(0))
        self.images = [self._dark_screen]
        self._cold = self._part(self._dark_screen) < HOT_FILL * context.full_dn

    def read(self, planned: list[Patch]) -> Readings:
        """Show and read the planned patches. Raises InputError where white saturates the
        tracker.
        """
        peaks = self._peaks(planned, self._expose())
        chosen = {patch: self._range(peaks[patch]) for patch in planned if patch.code}
        blacks, sums = self._sums(planned, chosen)
        pairs: list[_Pair] = []
        for channel in self.assumed.light:
            pairs += self._pairs(channel, chosen, peaks)
        links = [self._link(pair) for pair in pairs]
        lit = _lit(planned, chosen, blacks, sums)
        values = self._values(planned, lit, blacks[1], self._factors(links))
        of_ratios = self._of_ratios(values.light, lit, links)
        of_rounding = self._of_rounding(values, lit, pairs, links)
        causes = [of_ratios, of_rounding]
        cut = self._of_cut(values, lit, pairs, links)
        if (np.abs(cut) > SMALL_MODE * values.sigma).any():
            values = values._replace(light=values.light - cut)
            causes.append(CUT_UNKNOWN * cut[:, None])
        with_black, black_error = self._with_black(planned, values.light)
        if black_error is not None:
            causes.append(np.full((len(planned), 1), black_error))
        period = np.full(len(planned), self.periods[-1], dtype=np.intp)
        for order, reading in lit.items():
            period[order] = reading.at.period
        return Readings(
            patches=planned,
            light=np.maximum(with_black, 0.0),
            exposure_s=self.exposure_s,
            links=links,
            black_known=black_error is not None,
            images=tuple(self.images),
            above_black=values.light,
            period=period,
            sigma=values.sigma,
            common=np.hstack(causes),
        )

    def _expose(self) -> float:
        """Choose an exposure in which white does not saturate, first the bench file's; returns a
        white dot's peak, DN.
        """
        assumed = self.assumed.light
        brightest = max(assumed, key=lambda name: float(assumed[name][-1]))
        white = Patch(self.context.white, brightest)
        sparsest = Range(self.periods[-1])
        for probe in range(MAX_PROBES):
            # Another exposure is no repeat: it tells nothing of the scatter.
            part = self._part(self._take(f"white_{probe:02}", sparsest, white))
            fill = self._filled(part)
            if fill <= MAX_FILL:
                break
            if not self.context.source.sets_exposure:
                raise InputError(
                    f"one pixel at white saturates the tracker in {self.exposure_s:g} s: let --grab"
                    " set the exposure ({exposure_s}), turn the monitor's brightness down, or"
                    " use a photometer (hilstar calibrate plan)"
                )
            self.exposure_s /= LESS
        else:
            raise InputError(
                f"one pixel at white saturates the tracker even in {self.exposure_s:.2g} s; look at"
                " stray light"
            )
        if probe:
            self.exposure_s *= FILL / fill
        dark = self._part(self._take("black", Range(1), BLACK))
        bright = self._part(self._take("white", sparsest, white))
        share = float(assumed[white.channel][white.code])
        above_dn = (bright - dark)[self._cold]
        return float(above_dn.max(initial=1.0)) / share

    def _peaks(self, planned: list[Patch], white_dn: float) -> dict[Patch, FloatArray]:
        """The brightest pixel (periods,), DN, of each lit patch on each lattice, by the bench
        file's response.
        """
        peaks: dict[Patch, FloatArray] = {}
        for patch in planned:
            if patch.code:
                light = self.assumed.light[patch.channel][patch.code]
                peaks[patch] = white_dn * light * self.shares / self.shares[-1]
        return peaks

    def _range(self, peaks: FloatArray) -> Range:
        """The densest lattice that does not saturate by `peaks` (periods,), DN; a longer exposure
        where it is faint there.
        """
        highest_dn = FILL * self.context.full_dn
        fits = np.flatnonzero(peaks <= highest_dn)
        place = len(peaks) - 1
        if len(fits):
            place = int(fits[0])
        longest_s = 0.0
        if self.context.source.sets_exposure:
            longest_s = self.longest_s
        times = 1
        while peaks[place] * times < FAINT_DN and self.exposure_s * times * LONGER <= longest_s:
            times *= LONGER
        return Range(self.periods[place], times)

    def _sums(
        self,
        planned: list[Patch],
        chosen: dict[Patch, Range],
    ) -> tuple[dict[int, FloatArray], dict[int, float]]:
        """Sums over the field, DN: of the black images, in turn (images,), by how many times longer
        they are exposed, and of each lit patch by its place in the plan.
        """
        longer = sorted({at.times for at in chosen.values()} | {1})
        blacks: dict[int, list[float]] = {times: [] for times in longer}
        sums: dict[int, float] = {}
        fixed: set[Patch] = set()
        for order, patch in enumerate(planned):
            if not patch.code:
                for times in longer:
                    look = self._look(f"patch_{order:03}_1", Range(1, times), patch)
                    blacks[times].append(look.sum_dn)
                continue
            while True:
                at = chosen[patch]
                total, fill = self._look(f"patch_{order:03}_{at.period}", at, patch)
                if patch in fixed or fill <= MAX_FILL or at == Range(self.periods[-1]):
                    break
                # Brighter than the bench file says.
                if at.times > 1:
                    chosen[patch] = Range(at.period)
                else:
                    chosen[patch] = Range(2 * at.period)
            fixed.add(patch)
            sums[order] = total
        black_sums = {times: np.array(of_times) for times, of_times in blacks.items()}
        return black_sums, sums

    def _pairs(
        self,
        channel: str,
        chosen: dict[Patch, Range],
        peaks: dict[Patch, FloatArray],
    ) -> Iterator[_Pair]:
        """Compare each two neighbouring ranges of a channel by one code shown in both."""
        ranges = {patch: at for patch, at in chosen.items() if patch.channel == channel}
        used = {*ranges.values(), Range(self.periods[-1])}
        ladder = sorted(used, key=_ladder_place)
        for step, (more, less) in enumerate(itertools.pairwise(ladder)):
            patch = self._brightest(f"link_{channel}_{step}", ranges, peaks, more)
            scale = self._dots(less) / self._dots(more)
            lights: list[tuple[float, float]] = []
            ratios = []
            for pair in range(self.pairs):
                name = f"link_{channel}_{step}_{pair}"
                more_dn, less_dn = self._both(name, patch, more, less)
                lights.append((more_dn, less_dn))
                ratios.append(more_dn / less_dn * scale)
            mean_more_dn, mean_less_dn = np.mean(lights, axis=0).tolist()
            yield _Pair(patch, more, less, (mean_more_dn, mean_less_dn), tuple(ratios))

    def _both(self, name: str, patch: Patch, more: Range, less: Range) -> tuple[float, float]:
        """A patch's light in two ranges, DN, as in `_Reading`."""
        # Each pair has black images of its own: the noise of one for all would be in no scatter of
        # the pairs.
        dark: dict[int, float] = {}
        for times in sorted({more.times, less.times}):
            dark[times] = self._look(f"{name}_black", Range(1, times), BLACK).sum_dn
        lights: list[float] = []
        for at in (more, less):
            look = self._look(f"{name}_{at.period}", at, patch)
            lights.append(look.sum_dn - dark[at.times])
        if lights[1] <= 0:
            raise InputError(
                f"dots of code {patch.code} have no light in the tracker; look at what the screen"
                " shows"
            )
        return lights[0], lights[1]

    def _brightest(
        self,
        name: str,
        ranges: dict[Patch, Range],
        peaks: dict[Patch, FloatArray],
        at: Range,
    ) -> Patch:
        """The patch with the most light that a range holds: by the bench file's response, then by
        an image.
        """
        place = self.periods.index(at.period)
        highest_dn = FILL * self.context.full_dn
        highest = max(patch for patch, its in ranges.items() if its == at)
        for patch in sorted(ranges, reverse=True):
            if patch <= highest or peaks[patch][place] * at.times > highest_dn:
                continue
            if self._look(f"{name}_{patch.code}", at, patch).fill <= MAX_FILL:
                return patch
        return highest

    def _values(
        self,
        planned: list[Patch],
        lit: dict[int, _Reading],
        blacks: FloatArray,
        factors: dict[tuple[str, Range], float],
    ) -> _Values:
        """Light of each patch above black, DN/s, and the standard error by its own images."""
        count = len(planned)
        light = np.zeros(count)
        per_dn = np.zeros(count)
        # On a black screen every pixel glows alike; the repeats tell how well that is known.
        to_black = 1 / (self.field.monitor_px * self.exposure_s)
        sigma = np.full(count, math.sqrt(self.scatter.dark_dn2(1)) * to_black)
        dark = [order for order in range(count) if order not in lit]
        light[dark] = (blacks - blacks.mean()) * to_black
        for order, reading in lit.items():
            dots = self._dots(reading.at) * factors[reading.patch.channel, reading.at]
            per_dn[order] = 1 / (dots * self.exposure_s)
            light[order] = reading.light_dn * per_dn[order]
            # Light that rounding hides has shot noise, too.
            rounded_dn = self._rounded(reading.at, reading.light_dn)
            hidden_dn = float(np.sqrt((rounded_dn**2).mean()))
            known_dn = max(reading.light_dn, 0.0) + hidden_dn
            variance = self.scatter.sum_dn2(known_dn, reading.at.times, reading.blacks)
            sigma[order] = math.sqrt(variance) * per_dn[order]
        return _Values(light, sigma, per_dn)

    def _dots(self, at: Range) -> int:
        """Lit pixels times exposures of a range: what a sum is divided by for a pixel's light."""
        return self.field.lit(at.period) * at.times

    def _link(self, pair: _Pair) -> LatticeRatio:
        """A ratio of ranges with its standard error."""
        more, less = pair.light_dn
        dark_more = self.scatter.dark_dn2(pair.more.times)
        dark_less = self.scatter.dark_dn2(pair.less.times)
        # relative variances of both sums, and of the black ones under them
        dn_per_e = self.scatter.dn_per_e
        variance = (dn_per_e * more + dark_more) / more**2
        variance += (dn_per_e * less + dark_less) / less**2
        if pair.more.times == pair.less.times:  # one black image is under both
            variance += dark_more * (1 / more - 1 / less) ** 2
        else:
            variance += dark_more / more**2 + dark_less / less**2
        ratio = float(np.mean(pair.ratios))
        error = ratio * math.sqrt(variance / len(pair.ratios))
        return LatticeRatio(
            patch=pair.patch,
            dense=pair.more.period,
            sparse=pair.less.period,
            ratio=ratio,
            pairs=pair.ratios,
            error=error,
            times=(pair.more.times, pair.less.times),
        )

    def _factors(self, links: list[LatticeRatio]) -> dict[tuple[str, Range], float]:
        """A lit pixel's light in each channel and range, relative to that in the range of the
        sparsest lattice.
        """
        factors = {(channel, Range(self.periods[-1])): 1.0 for channel in self.assumed.light}
        for link in reversed(links):
            more = Range(link.dense, link.times[0])
            less = Range(link.sparse, link.times[1])
            channel = link.patch.channel
            factors[channel, more] = factors[channel, less] * link.ratio
        return factors

    def _of_ratios(
        self,
        light: FloatArray,
        lit: dict[int, _Reading],
        links: list[LatticeRatio],
    ) -> FloatArray:
        """Changes (n, ratios) of light (n,) by one sigma of each ratio. Light of a range is divided
        by all ratios below it.
        """
        effects = np.zeros((len(light), len(links)))
        for place, link in enumerate(links):
            for order, reading in lit.items():
                if _passes(reading.patch, reading.at, link):
                    effects[order, place] = -light[order] * link.error / link.ratio
        return effects

    def _of_rounding(
        self,
        values: _Values,
        lit: dict[int, _Reading],
        pairs: list[_Pair],
        links: list[LatticeRatio],
    ) -> FloatArray:
        """What the ADC's rounding does to light where too little noise spreads it: (n, modes).

        Pixels of one light are rounded alike, by where their dark level is between two steps. That
        is not known. It is taken at STEP_PHASES places, on its own for each exposure, and the
        covariance of readings over them is split into modes.
        """
        longer = sorted({reading.at.times for reading in lit.values()})
        effects = np.zeros((len(values.light), len(longer), STEP_PHASES))
        for order, reading in lit.items():
            place = longer.index(reading.at.times)
            rounded_dn = self._rounded(reading.at, reading.light_dn)
            effects[order, place] = rounded_dn * values.per_dn[order]
        for pair, link in zip(pairs, links, strict=True):
            off = np.zeros((len(longer), STEP_PHASES))
            more_dn, less_dn = pair.light_dn
            for at, light_dn, sign in ((pair.more, more_dn, 1), (pair.less, less_dn, -1)):
                if at.times in longer:
                    rounded = self._rounded(at, light_dn) / light_dn
                    off[longer.index(at.times)] += sign * rounded
            for order, reading in lit.items():
                if _passes(reading.patch, reading.at, link):
                    effects[order] -= values.light[order] * off
        flat = effects.reshape(len(values.light), -1) / math.sqrt(STEP_PHASES)
        vectors, sizes, _ = np.linalg.svd(flat, full_matrices=False)
        modes = vectors * sizes
        is_large = np.abs(modes) > SMALL_MODE * values.sigma[:, None]
        return np.asarray(modes[:, is_large.any(axis=0)])

    def _of_cut(
        self,
        values: _Values,
        lit: dict[int, _Reading],
        pairs: list[_Pair],
        links: list[LatticeRatio],
    ) -> FloatArray:
        """The light (n,) that the ADC's lowest code adds where it cuts off the noise of dark
        pixels.
        """
        effect = np.zeros(len(values.light))
        for order, reading in lit.items():
            cut_dn = self._cut_dn(reading.at, reading.light_dn)
            effect[order] = cut_dn * values.per_dn[order]
        for pair, link in zip(pairs, links, strict=True):
            more, less = pair.light_dn
            more_off = self._cut_dn(pair.more, more) / more
            less_off = self._cut_dn(pair.less, less) / less
            for order, reading in lit.items():
                if _passes(reading.patch, reading.at, link):
                    effect[order] -= values.light[order] * (more_off - less_off)
        return effect

    def _cut_dn(self, at: Range, light_dn: float) -> float:
        """The DN that the cut at code 0 adds to the sum of a lattice's image above black."""
        detector = self.context.detector
        pixels = self.field.tracker_px
        stated_dn = detector.electronics_e / detector.gain_e_per_dn
        read_dn = before_adc_dn(self.scatter.dark_dn2(at.times) / pixels, math.inf)
        # What is cut off scatters less than it would: the stated noise counts where it is larger.
        noise_dn = max(stated_dn, read_dn)
        dark_dn = self.scatter.dark_sum_dn(at.times) / pixels
        dots = self.field.lit(at.period)
        level_dn = max(light_dn, 0.0) / dots * self._pixel_shares(at)
        cut_dn = cut_light(level_dn, dark_dn, noise_dn, self.scatter.dn_per_e)
        return dots * self._cell_px(at) * cut_dn

    def _pixel_shares(self, at: Range) -> FloatArray:
        """Shares (PHASES^2,) of a dot's light in pixels at places within a lattice's cell."""
        profile = self.profiles[at.period]
        return np.outer(profile, profile).ravel()

    def _cell_px(self, at: Range) -> float:
        """The tracker's pixels in a cell of a lattice."""
        return float((at.period * self.ratio) ** 2)

    def _noise_dn(self, variance_dn2: float, sum_dn: float) -> float:
        """The noise of a pixel before the ADC, DN, by the variance of the field's sum and that
        sum.
        """
        detector = self.context.detector
        pixels = self.field.tracker_px
        # How far a level is above the offset, rounding tells to half a step.
        light_dn = max(sum_dn / pixels - detector.offset_dn - HALF_STEP_DN, 0.0)
        read_dn2 = (detector.electronics_e / detector.gain_e_per_dn) ** 2
        stated_dn = math.sqrt(read_dn2 + light_dn / detector.gain_e_per_dn)
        return before_adc_dn(variance_dn2 / pixels, stated_dn)

    def _rounded(self, at: Range, light_dn: float) -> FloatArray:
        """The DN (STEP_PHASES,) that the ADC's rounding adds to the sum of a lattice's image above
        black, by where the dark level lies between two codes.
        """
        black_dn2 = self.scatter.dark_dn2(at.times)
        noise_dn = self._noise_dn(black_dn2, self.scatter.dark_sum_dn(at.times))
        dots = self.field.lit(at.period)
        shares = self._pixel_shares(at)
        # Dots that are rounded away may have a peak of half a step.
        hidden_dn = HALF_STEP_DN / float(shares.max())
        level_dn = max(light_dn / dots, hidden_dn) * shares
        rounding_dn = rounded_light(level_dn, noise_dn, self.scatter.dn_per_e)
        return dots * self._cell_px(at) * rounding_dn

    def _with_black(
        self, planned: list[Patch], light: FloatArray
    ) -> tuple[FloatArray, float | None]:
        """Light (n,) with the black level, DN/s, and that level's standard error, None where it was
        not measured.
        """
        unlit = self.context.unlit()
        if unlit is None:
            whites = []
            for name in self.assumed.light:
                white = Patch(self.context.white, name)
                is_white = [patch == white for patch in planned]
                whites.append(light[is_white].mean())
            return light + self.assumed.black * float(np.sum(whites)), None
        # A black screen minus one that is switched off. Both are in the bench file's exposure. Its
        # noise is not that of the lattices' exposure: the black screen is taken again.
        again = self.context.take(self._black_screen(1))
        self.images += [again, unlit]
        first = self._part(self._dark_screen)
        second = self._part(again)
        glowing_dn = float(np.mean([first.sum(), second.sum()]))
        dark_dn = float(self._part(unlit).sum())
        more_dn = glowing_dn - dark_dn
        seconds = self.field.monitor_px * self.context.exposure_s
        # The screen that is switched off has the noise of the other, less that of the glow.
        glowing_dn2 = float(((first - second) ** 2).sum()) / 2
        dark_dn2 = max(glowing_dn2 - self.scatter.dn_per_e * max(more_dn, 0.0), 0.0)
        variance = glowing_dn2 / 2 + dark_dn2
        # Each of the two levels is rounded, and the one without glow has less noise to spread it.
        for image_dn2, sum_dn in ((glowing_dn2, glowing_dn), (dark_dn2, dark_dn)):
            rounding_dn = rounding_rms(self._noise_dn(image_dn2, sum_dn))
            variance += (self.field.tracker_px * rounding_dn) ** 2
        # The glow is over more of the screen than the dots are, by a map that has its error.
        variance += (self._even_relative * more_dn) ** 2
        return light + max(more_dn / seconds, 0.0), math.sqrt(variance) / seconds

    def _black_screen(self, number: int) -> Pattern:
        return Pattern(f"black_screen_{number}", black(self.context.resolution_px))

    def _look(self, name: str, at: Range, patch: Patch) -> Look:
        """Show a lattice in a patch's code and look at it."""
        part = self._part(self._take(name, at, patch))
        self.scatter.add(patch, at, part)
        return Look(float(part.sum()), self._filled(part))

    def _filled(self, part: FloatArray) -> float:
        """The brightest pixel of a part of an image relative to full scale, hot ones aside."""
        return float(part[self._cold].max(initial=0.0)) / self.context.full_dn

    def _take(self, name: str, at: Range, patch: Patch) -> Path:
        """Take an image of a lattice in a patch's code; its file."""
        if at.times > 1:
            name = f"{name}_{at.times}"
        codes = self.field.lattice(self.context.resolution_px, at.period, patch)
        path = self.context.take(Pattern(name, codes), self.exposure_s * at.times)
        self.images.append(path)
        return path

    def _part(self, path: Path) -> FloatArray:
        """The field's part (h, w) of an image, DN."""
        # A copy: a slice would keep its whole image, and the scatter keeps parts of a hundred.
        return self.context.pixels(path)[self.field.rows, self.field.columns].copy()


def _ladder_place(at: Range) -> tuple[int, int]:
    """The order of ranges, from those that show the most of faint light."""
    return -at.times, at.period


def _passes(patch: Patch, at: Range, link: LatticeRatio) -> bool:
    """Whether the light of a patch is divided by a ratio: that of its own range, or of one with
    less light.
    """
    if patch.channel != link.patch.channel:
        return False
    return _ladder_place(at) <= _ladder_place(Range(link.dense, link.times[0]))


def _lit(
    planned: list[Patch],
    chosen: dict[Patch, Range],
    blacks: dict[int, FloatArray],
    sums: dict[int, float],
) -> dict[int, _Reading]:
    """The lit patches by their order, above the black images before and after them."""
    black_orders = np.flatnonzero([patch.code == 0 for patch in planned])
    lit: dict[int, _Reading] = {}
    for order, total in sums.items():
        patch = planned[order]
        at = chosen[patch]
        black_dn, variance = _between(order, black_orders, blacks[at.times])
        lit[order] = _Reading(patch, at, total - black_dn, variance)
    return lit


def _between(order: int, orders: IntArray, values: FloatArray) -> tuple[float, float]:
    """A value between those at `orders` (n,), and its variance relative to that of one of them."""
    if len(orders) == 1:
        return float(values[0]), 1.0
    after = int(np.clip(np.searchsorted(orders, order), 1, len(orders) - 1))
    before = after - 1
    elapsed = (order - orders[before]) / (orders[after] - orders[before])
    share = float(np.clip(elapsed, 0, 1))
    value = (1 - share) * values[before] + share * values[after]
    variance = (1 - share) ** 2 + share**2
    return float(value), variance
