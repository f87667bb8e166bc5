"""Figures of single stars that answers report against those that were lit:

place error = a smooth map over the detector + noise; signal against B-V; a logistic curve of
detection against V
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import optimize, special, stats

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.assess.bounded_figures import (
    BoundedFigure,
    TooFewCases,
    drawn_limits,
)
from hilstar.instruments.assess.case_fits import (
    SILENT,
    CaseFit,
    fit_by_cases,
    largest_size,
    numbered,
    refuse_few,
    root_mean,
    root_of,
    summed,
)
from hilstar.optics.camera import field_terms

MAP_DEGREE = 5  # of the polynomials of a star's place error over the detector
WILD_SIGMAS = 6.0
WILD_SIGNALS = 4.0  # scatters from the fit: a star that saturates, or that another brightens
SIGNAL_ROUNDS = 3
LIGHT_DEGREE = 2  # of the signal's error over the magnitude of the light
NO_SIGNAL = (
    "the reported signals fall as the stars' light rises: give DN, or 10^(-0.4 m) of a magnitude m"
)
TURN_ROUNDS, FEW_TO_TURN = 3, 2
LIMIT_BIN_MAG = 0.05
LIMIT_DRAWS = 200  # of the bootstrap of a detection curve
MIN_SLOPE_MAG = 0.01  # width of a detection curve: a sharper one cannot be told from its bins


@dataclass(frozen=True, slots=True)
class StarTable:
    """Lit stars (n,), each with its `case` (n,), and their reports; NaN where not reported."""

    case: IntArray
    x_px: FloatArray
    y_px: FloatArray
    v_mag: FloatArray
    bv: FloatArray
    dx_px: FloatArray
    dy_px: FloatArray
    signal_mag: FloatArray
    lit_mag: FloatArray

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which stars (n,) were reported."""
        return np.isfinite(self.dx_px)


@dataclass(frozen=True, slots=True)
class PlaceFit:
    """The map of stars' place errors: polynomials (terms, 2), the stars in it (n,) by their case,
    their terms (n, terms) and errors (n, 2), px.
    """

    solution: FloatArray
    case: IntArray
    terms: FloatArray
    offsets_px: FloatArray

    def by_cases(self) -> list[CaseFit]:
        """The same fit of each axis, with the case as the unit that is independent of others: at
        rest a star's error comes again in each frame.
        """
        return [fit_by_cases(self.terms, axis, self.case) for axis in self.offsets_px.T]


@dataclass(frozen=True, slots=True)
class PlaceOffsets:
    """Places (n,) on the detector and how far reported stars are off there, px."""

    x_px: FloatArray
    y_px: FloatArray
    dx_px: FloatArray
    dy_px: FloatArray


def fitted_places(stars: StarTable, resolution_px: tuple[int, int]) -> PlaceFit:
    """The map of reported stars' place errors; wild ones do not count. Raises TooFewCases."""
    reported = np.flatnonzero(stars.found)
    offsets = np.stack([stars.dx_px, stars.dy_px], axis=1)[reported]
    terms = field_terms(stars.x_px[reported], stars.y_px[reported], resolution_px, MAP_DEGREE)
    needed = 4 * terms.shape[1]
    near = np.ones(len(reported), dtype=np.bool_)
    for _ in range(3):
        if near.sum() < needed:
            raise TooFewCases(f"{int(near.sum())} stars, and {needed} are needed for a map", 0)
        found_terms = np.linalg.lstsq(terms[near], offsets[near], rcond=None)[0]
        solution = np.asarray(found_terms, dtype=np.float64)
        residual = offsets - terms @ solution
        distance = np.abs(residual)
        spread = MAD_TO_SIGMA * np.median(distance[near], axis=0)
        close = distance <= WILD_SIGMAS * np.maximum(spread, 1e-9)
        near = np.asarray(close.all(axis=1), dtype=np.bool_)
    return PlaceFit(solution, stars.case[reported][near], terms[near], offsets[near])


def place_map(found: StarTable, resolution_px: tuple[int, int], side: int) -> PlaceOffsets:
    """The map at `side` by `side` places of the detector, less its mean. Raises TooFewCases."""
    fit = fitted_places(found, resolution_px)
    width, height = resolution_px
    centres = np.arange(side) + 0.5
    # the first pixel's middle is 0
    along_px = centres * width / side - 0.5
    down_px = centres * height / side - 0.5
    columns_px, rows_px = np.meshgrid(along_px, down_px)
    x_px, y_px = columns_px.ravel(), rows_px.ravel()
    terms = field_terms(x_px, y_px, resolution_px, MAP_DEGREE)
    offsets = terms @ fit.solution
    offsets = offsets - offsets.mean(axis=0)
    dx_px, dy_px = offsets.T
    return PlaceOffsets(x_px, y_px, dx_px, dy_px)


def without_turns(stars: StarTable, frame: IntArray, resolution_px: tuple[int, int]) -> StarTable:
    """The stars with places less the shift and the roll that those of one `frame` (n,) share about
    the map: they are of the attitude and of the time at which the tracker looked. Raises
    TooFewCases.

    What the turns take of the scatter is given back.
    """
    found = np.flatnonzero(stars.found)
    number = numbered(frame[found])
    reported = summed(np.ones(len(found)), number)
    places = np.stack([stars.x_px, stars.y_px], axis=1)[found]
    terms = field_terms(stars.x_px[found], stars.y_px[found], resolution_px, MAP_DEGREE)
    offsets = np.stack([stars.dx_px, stars.dy_px], axis=1)
    raw = offsets[found]
    turned = np.zeros_like(raw)
    for _ in range(TURN_ROUNDS):
        offsets[found] = raw - turned
        table = replace(stars, dx_px=offsets[:, 0], dy_px=offsets[:, 1])
        by_map = terms @ fitted_places(table, resolution_px).solution
        turned = _turns_px(places, raw - by_map, number, reported)
    # of an axis' places a turn takes one and a half, where there is one
    is_turned = reported > FEW_TO_TURN
    growth = np.ones(len(reported))
    growth[is_turned] = np.sqrt(reported[is_turned] / (reported[is_turned] - 1.5))
    offsets[found] = by_map + growth[number, None] * (raw - by_map - turned)
    return replace(stars, dx_px=offsets[:, 0], dy_px=offsets[:, 1])


def _turns_px(
    places: FloatArray, offsets: FloatArray, number: IntArray, reported: FloatArray
) -> FloatArray:
    """The part (n, 2) of offsets at places (n, 2), px, that the stars of one frame share: a shift
    and a turn about their middle, to the least squares. `reported` counts each frame's stars; of
    two or fewer nothing is taken.
    """
    shift = _means(offsets, number, reported)
    x, y = (places - _means(places, number, reported)).T
    across = np.stack([-y, x], axis=1)
    moment = summed((across * (offsets - shift)).sum(axis=1), number)
    angle_rad = moment / np.maximum(summed(x**2 + y**2, number), 1e-9)
    turned = shift + angle_rad[number, None] * across
    turned[reported[number] <= FEW_TO_TURN] = 0.0
    return np.asarray(turned)


def _means(values: FloatArray, number: IntArray, counts: FloatArray) -> FloatArray:
    """The mean of values (n, 2) over those of the same number, for each (n, 2)."""
    columns = [summed(column, number) / counts for column in values.T]
    return np.stack(columns, axis=1)[number]


def _star_noise(
    found: StarTable,
    resolution_px: tuple[int, int],
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """The noise of stars' places about their map, px an axis."""
    fit = fitted_places(found, resolution_px)
    count = len(fit.case)
    even_px = np.stack([axis.even for axis in fit.by_cases()], axis=1)
    squares = (even_px**2).mean(axis=1)
    return root_mean(squares, np.ones(count), fit.case, confidence, rng, _map_method(count))


def _map_method(stars: int) -> str:
    return f"map of degree {MAP_DEGREE} over {stars} stars, bootstrap over cases"


def _star_map(
    found: StarTable,
    resolution_px: tuple[int, int],
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """The rms of the map of stars' places, px an axis."""
    fit = fitted_places(found, resolution_px)
    count = len(fit.case)
    free = len(fit.solution) - 1
    middled = fit.terms - fit.terms.mean(axis=0)
    fitted = middled @ fit.solution
    # what the noise alone puts into so many terms, and the spread of that
    gram = middled.T @ middled / count
    put = [gram @ axis.covariance for axis in fit.by_cases()]
    taken = float(np.mean([np.trace(power) for power in put]))
    spread = math.sqrt(2 * sum(float((power * power.T).sum()) for power in put)) / len(put)
    number = numbered(fit.case)
    squares = (fitted**2).mean(axis=1)
    sums = summed(squares, number)
    counts = summed(np.ones(count), number)
    low, high = drawn_limits(sums, counts, rng, confidence).tolist()
    power = float(sums.sum() / counts.sum()) - taken
    mixed = max(power, 0.0) * taken / (2 * free)
    hidden = float(stats.norm.ppf(confidence)) * spread + 2 * math.sqrt(mixed)
    upper = max(high - taken, power) + hidden
    lower = min(low - taken, power) - hidden
    return BoundedFigure(
        root_of(power), root_of(lower), root_of(upper), len(counts), _map_method(count)
    )


def _star_colour(found: StarTable, confidence: float) -> BoundedFigure:
    """How a star's signal goes with its B-V, magnitudes a magnitude.

    A signal that is not linear in the light, by saturation or a threshold, goes with B-V too: red
    stars are not as bright as blue ones. So the magnitude of the light is fitted beside it.
    """
    known = np.isfinite(found.signal_mag) & np.isfinite(found.bv)
    refuse_few(found.case[known], "stars' signal")
    signal = found.signal_mag[known]
    lit = found.lit_mag[known]
    reported = signal + lit
    # signals that are all alike, or of one light, have no rank
    has_ranks = len(signal) > 2 and np.ptp(reported) > 0 and np.ptp(lit) > 0
    if has_ranks and stats.spearmanr(reported, lit).statistic < 0:
        raise TooFewCases(NO_SIGNAL, 0)
    bv = found.bv[known]
    fainter = lit - np.median(lit)
    terms = [np.ones(len(bv)), bv]
    for power in range(1, LIGHT_DEGREE + 1):
        terms.append(fainter**power)
    design = np.stack(terms, axis=1)
    near = _near(signal - np.median(signal), WILD_SIGMAS)
    for _ in range(SIGNAL_ROUNDS):
        solution = np.linalg.lstsq(design[near], signal[near], rcond=None)[0]
        residual = signal - design @ solution
        near = _near(residual, WILD_SIGNALS, residual[near])
    fit = fit_by_cases(design[near], signal[near], found.case[known][near])
    method = f"linear fit over B-V of {int(near.sum())} stars, Student's t"
    return largest_size([fit], 1, confidence, method)


def _near(off: FloatArray, sigmas: float, usual: FloatArray | None = None) -> npt.NDArray[np.bool_]:
    """Which values (n,) are within so many scatters of 0, by the median size of `usual` ones (by
    default all).
    """
    middle = float(np.median(np.abs(off if usual is None else usual)))
    within = np.abs(off) <= sigmas * MAD_TO_SIGMA * max(middle, 1e-9)
    return np.asarray(within, dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class DetectionBins:
    """Stars by their V: the middles of bins (b,), and how many stars of each case were lit and were
    reported in each bin (cases, b).
    """

    middle_mag: FloatArray
    lit: IntArray
    reported: IntArray

    @classmethod
    def of(cls, stars: StarTable) -> "DetectionBins":
        """Those of a table, from the bin of its brightest star to that of its faintest."""
        place = np.floor(stars.v_mag / LIMIT_BIN_MAG).astype(np.int64)
        first = int(place.min())
        bins = int(place.max()) - first + 1
        number = numbered(stars.case)
        cases = int(number.max()) + 1
        shape = (cases, bins)
        size = cases * bins
        index = number * bins + place - first
        lit = np.bincount(index, minlength=size).reshape(shape)
        reported = np.bincount(index[stars.found], minlength=size).reshape(shape)
        middles = np.arange(bins) + first + 0.5
        return cls(np.asarray(middles * LIMIT_BIN_MAG, dtype=np.float64), lit, reported)

    def half_seen(self, chosen: IntArray | None = None) -> float:
        """The V at which half of the stars are reported, of all cases, or of chosen ones."""
        rows = slice(None) if chosen is None else chosen
        return half_seen(
            self.middle_mag, self.reported[rows].sum(axis=0), self.lit[rows].sum(axis=0)
        )


def _star_limit(found: StarTable, confidence: float, rng: np.random.Generator) -> BoundedFigure:
    """The V at which half of the stars are reported."""
    refuse_few(found.case, "single stars")
    counts = DetectionBins.of(found)
    cases = len(counts.lit)
    value = counts.half_seen()
    drawn = []
    for _ in range(LIMIT_DRAWS):
        chosen = rng.integers(0, cases, cases)
        drawn.append(counts.half_seen(chosen))
    low, high = np.quantile(drawn, [1 - confidence, confidence])
    # a curve that is sharper than a bin is known to within one
    low = min(float(low), value) - LIMIT_BIN_MAG / 2
    high = max(float(high), value) + LIMIT_BIN_MAG / 2
    method = f"logistic curve over {int(counts.lit.sum())} stars, bootstrap over cases"
    if high >= counts.middle_mag[-1]:
        high = math.inf
        method += "; sky.faintest_v_mag bounds it"
    return BoundedFigure(value, low, high, cases, method)


def half_seen(v_mag: FloatArray, seen: IntArray, lit: IntArray) -> float:
    """The magnitude at which a logistic curve of detection falls to a half: counts of stars seen
    (n,) of those lit (n,) at magnitudes (n,).
    """

    unseen = lit - seen

    def loss(parameters: FloatArray) -> float:
        limit_mag, log_width = parameters
        width = MIN_SLOPE_MAG + math.exp(log_width)
        share = special.expit((limit_mag - v_mag) / width)
        share = np.clip(share, 1e-9, 1 - 1e-9)
        log_likelihood = seen * np.log(share) + unseen * np.log1p(-share)
        return -float(log_likelihood.sum())

    # begun where the counts split best by one magnitude
    faintest_mag = v_mag[-1]
    missed = np.concatenate([[0], np.cumsum(unseen)])
    from_faint = np.cumsum(seen[::-1])
    beyond = np.concatenate([from_faint[::-1], [0]])
    cut = int(np.argmin(missed + beyond))
    half_bin_mag = LIMIT_BIN_MAG / 2
    edges = np.concatenate([v_mag - half_bin_mag, [faintest_mag + half_bin_mag]])
    start = np.array([edges[cut], math.log(0.1)])
    # Unbounded, the logarithm of a sharp curve's width runs away, in thrice as many steps.
    bounds = ((None, None), (math.log(MIN_SLOPE_MAG / 100), None))
    fitted = optimize.minimize(
        loss, start, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3}
    )
    half_mag = max(fitted.x[0], v_mag[0])
    return float(min(half_mag, faintest_mag))


def star_figure(
    quantity: str,
    stars: StarTable,
    resolution_px: tuple[int, int],
    confidence: float,
    rng: np.random.Generator,
) -> BoundedFigure:
    """A figure of single stars but `false-stars`. Raises TooFewCases."""
    if quantity == "star-noise":
        return _star_noise(stars, resolution_px, confidence, rng)
    if quantity == "star-fov-error":
        return _star_map(stars, resolution_px, confidence, rng)
    if quantity == "star-colour":
        return _star_colour(stars, confidence)
    return _star_limit(stars, confidence, rng)


def false_stars(
    false: FloatArray, frames: FloatArray, confidence: float, rng: np.random.Generator
) -> BoundedFigure:
    """False stars a frame, by their number (n,) in the frames (n,) of each case that had reported
    stars. Raises TooFewCases.
    """
    count = len(frames)
    if not count:
        raise TooFewCases(SILENT.format("single stars"), 0)
    total = float(false.sum())
    exposed = float(frames.sum())
    c = confidence
    low = 0.0
    if total:
        low = float(stats.gamma.ppf(1 - c, total)) / exposed
    high = float(stats.gamma.ppf(c, total + 1)) / exposed
    drawn_low, drawn_high = drawn_limits(false, frames, rng, c).tolist()
    method = "Poisson, or the bootstrap over cases where that is wider"
    return BoundedFigure(total / exposed, min(low, drawn_low), max(high, drawn_high), count, method)
