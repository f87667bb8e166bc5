"""What is left of structure in a fit's residuals: how much of their variance is correlated, in
place or in time, and how far.

A fit's residuals are noise, of each reading by itself, and perhaps a part whose correlation falls
with distance: as
exp(-d^2 / 2 L^2) in place, as exp(-t / T) in time. Ratio of the variances and length are those of a
grid, each by its restricted likelihood (Patterson and Thompson 1971), which takes the fit's own
terms out. All points of the grid count by their likelihood, and so does it that there is none: a
structure that is unsure is so in what it does.

In place readings are averaged over cells of a lattice, whose correlations are products of rows and
columns, so that one grid of ratios costs no more than the squares of a few terms.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray

# of the structure's variance to that of the noise of one reading
RATIOS = np.geomspace(1e-3, 3e3, 20)
LENGTH_STEP = 1.6  # from one length to the next
MAX_CELLS = 1000
LONGEST = 1 / 4  # of a structure relative to the field: longer ones follow a fit's polynomials
# share of cells that are filled in the rectangle by which structure is told; its least cells
ENOUGH, MIN_CELLS = 0.97, 64
MIN_FILLED = 0.5  # relative to a full cell: a cell with fewer readings is taken as empty
TINY = 1e-300
MIN_DOF = 3.0
UNLIKELY = 0.01  # less likely structure is none
# steps between which the likelihood, which is smooth, is interpolated
FINE_LENGTH, FINE_RATIO = 1.08, 1.12


@dataclass(frozen=True, slots=True)
class Structure:
    """Variances in the square of the readings' unit: of the structure (lengths,) at each `length`,
    and of one reading's noise.

    `dof` is the freedom of the structure's variance as a whole. Nothing but zeros where there is
    none.
    """

    length: FloatArray
    variance: FloatArray
    noise_variance: float
    dof: float

    @property
    def total(self) -> float:
        """The variance of the structure."""
        return float(self.variance.sum())

    def parts(self) -> Iterator[tuple[float, float]]:
        """Length and variance of each part of the structure that has one."""
        for length, variance in zip(self.length, self.variance, strict=True):
            if variance:
                yield float(length), float(variance)

    @property
    def mean_length(self) -> float:
        """The mean of the lengths by their variances."""
        return float(self.length @ self.variance) / max(self.total, TINY)


@dataclass(frozen=True, slots=True)
class Spread:
    """Residuals in the basis in which their correlation is diagonal: values (m,) and terms (m, p),
    in one reading's noise, and the correlation's eigenvalues (m,) relative to that noise.

    `square` and `dof` are what is known of the noise beside them.
    """

    eigen: FloatArray
    value: FloatArray
    terms: FloatArray
    square: float = 0.0
    dof: float = 0.0

    def likelihoods(self, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The logarithm of the restricted likelihood of each ratio of variances (r,), and the
        noise's variance by it.
        """
        weight = 1 / (1 + ratios[:, None] * self.eigen)
        weighted = weight[:, :, None] * self.terms
        normal = self.terms.T @ weighted
        towards = weighted.transpose(0, 2, 1) @ self.value
        solved = np.linalg.solve(normal, towards[:, :, None])
        explained = (towards * solved[:, :, 0]).sum(axis=1)
        total = (weight * self.value) @ self.value
        unexplained = total - explained + self.square
        dof = len(self.value) - self.terms.shape[1] + self.dof
        _, log_of_normal = np.linalg.slogdet(normal)
        sizes = log_of_normal - np.log(weight).sum(axis=1)
        of_noise = dof * np.log(np.maximum(unexplained, TINY))
        return -0.5 * (sizes + of_noise), unexplained / dof


def weighed(lengths: FloatArray, spreads: list[Spread]) -> Structure:
    """The structure by spreads at each length."""
    likelihood = np.zeros((len(lengths), len(RATIOS)))
    noise = np.zeros_like(likelihood)
    for row, spread in enumerate(spreads):
        likelihood[row], noise[row] = spread.likelihoods(RATIOS)
    # the same for all lengths
    of_none, noises_of_none = spreads[0].likelihoods(np.zeros(1))
    none, noise_of_none = float(of_none[0]), float(noises_of_none[0])
    finer = _finer(lengths, FINE_LENGTH), _finer(RATIOS, FINE_RATIO)
    of_some = _between(lengths, likelihood, finer)
    log_noise = np.log(np.maximum(noise, TINY))
    noise_of_some = np.exp(_between(lengths, log_noise, finer))
    largest = max(float(of_some.max()), none)
    # No structure and some are as likely beforehand; of some, each ratio and length.
    share = np.exp(of_some - largest) / of_some.size
    some = float(share.sum())
    likely = some / (some + math.exp(none - largest))
    if likely < UNLIKELY:
        return Structure(lengths, np.zeros(len(lengths)), noise_of_none, math.inf)
    share /= some
    # As of a variance by few readings, whose Student's t has the geometric mean for its scale,
    # nearly.
    evidence = noise_of_some * finer[1]
    middle = float((share * np.log(evidence)).sum())
    scatter = float((share * (np.log(evidence) - middle) ** 2).sum())
    variance = (share * evidence).sum(axis=1)
    # What the residuals hardly show may still move a fit: its variance counts by how likely it is.
    variance *= likely * math.exp(middle) / variance.sum()
    noise_variance = likely * float((share * noise_of_some).sum())
    noise_variance += (1 - likely) * noise_of_none
    dof = max(2 / max(scatter, TINY), MIN_DOF)
    return Structure(finer[0], variance, noise_variance, dof)


def _finer(values: FloatArray, step: float) -> FloatArray:
    """Values between the first and the last, by a smaller step."""
    first, last = values[0], values[-1]
    steps = math.ceil(math.log(last / first) / math.log(step))
    return np.geomspace(first, last, steps + 1)


def _between(
    lengths: FloatArray, values: FloatArray, finer: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Values (lengths, ratios), smooth in the logarithms of both, on a finer grid."""
    degree = min(3, len(lengths) - 1)
    spline = RectBivariateSpline(np.log(lengths), np.log(RATIOS), values, kx=degree, ky=3, s=0)
    return np.asarray(spline(np.log(finer[0]), np.log(finer[1])))


def in_time(t: FloatArray, value: FloatArray, terms: FloatArray) -> Structure:
    """The structure in time of values (n,) with equal noise, whose fit has `terms` (n, p)."""
    step = float(np.median(np.diff(np.sort(t)))) or 1.0
    lengths = step * np.geomspace(0.5, 1.0 * len(t), 10)
    basis = np.linalg.qr(terms)[0]
    spreads = []
    for length in lengths:
        eigen, vectors = _diagonal_in_time(t, length)
        spreads.append(Spread(eigen, vectors.T @ value, vectors.T @ basis))
    return weighed(lengths, spreads)


def _diagonal_in_time(t: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (n,) and vectors (n, n) of the correlation of moments (n,)."""
    apart = np.abs(t[:, None] - t)
    eigen, vectors = np.linalg.eigh(np.exp(-apart / length))
    return np.maximum(eigen, 0.0), vectors


def lasting_root(t: FloatArray, structure: Structure) -> FloatArray:
    """A root (n, k) of the covariance of a structure in time at moments (n,)."""
    if not structure.total:
        return np.zeros((len(t), 0))
    apart = np.abs(t[:, None] - t)
    covariance = np.zeros((len(t), len(t)))
    for length, variance in structure.parts():
        covariance += variance * np.exp(-apart / length)
    size, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(size, 0.0)))


class Cells:
    """The cells of readings at places (n,) on a lattice, px: cell by reading, and how their
    means correlate.
    """

    def __init__(self, x_px: FloatArray, y_px: FloatArray) -> None:
        group = max(math.ceil(math.sqrt(len(x_px) / MAX_CELLS)), 1)
        self.middle: list[FloatArray] = []
        self.side: list[float] = []
        index = np.zeros(len(x_px), dtype=np.intp)
        for at in (y_px, x_px):
            places = np.unique(at)
            step = 1.0
            if len(places) > 1:
                step = float(np.median(np.diff(places)))
            number = np.rint((at - places[0]) / step).astype(np.intp)
            number //= group
            count = int(number.max()) + 1
            first = places[0] + step * (group - 1) / 2
            self.middle.append(first + step * group * np.arange(count))
            self.side.append(group * step)
            index = index * count + number
        self.index: IntArray = index
        self.size = len(self.middle[0]) * len(self.middle[1])
        self.count = np.bincount(index, minlength=self.size)
        self.filled: BoolArray = self.count >= MIN_FILLED * group**2
        self.typical = float(self.count[self.filled].mean())

    def lengths(self, longest: float) -> FloatArray:
        """Lengths that the lattice can tell, px: from half of a cell to the share `longest` of its
        extent.

        Structure that is longer follows the terms of a fit, and no residual tells it.
        """
        low = min(self.side) / 2
        high = longest * max(float(np.ptp(middles)) for middles in self.middle)
        steps = round(math.log(high / low) / math.log(LENGTH_STEP))
        return np.geomspace(low, high, max(steps, 1) + 1)

    def means(self, values: FloatArray) -> FloatArray:
        """The means (cells, ...) of values (n, ...); 0 in empty cells."""
        sums = np.zeros((self.size, *values.shape[1:]))
        np.add.at(sums, self.index, values)
        count = np.maximum(self.count, 1)
        means = sums.reshape(self.size, -1) / count[:, None]
        return np.asarray(means.reshape(sums.shape))

    def empty(self) -> FloatArray:
        """A term of its own (cells, k) for each empty cell, which takes it out of a fit."""
        return np.asarray(np.eye(self.size)[:, ~self.filled])

    def basis(self, length_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The correlation of cells' means: eigenvalues (cells,), and the vectors of rows and of
        columns.
        """
        parts = []
        for middle, side in zip(self.middle, self.side, strict=True):
            wide = length_px**2 + side**2 / 6  # a mean over a cell: its own variance twice
            correlation = _falling(middle[:, None] - middle, wide)
            eigen, vectors = np.linalg.eigh(length_px / math.sqrt(wide) * correlation)
            parts.append((np.maximum(eigen, 0.0), vectors))
        (down, rows), (along, columns) = parts
        return np.outer(down, along).ravel(), rows, columns

    def turned(self, rows: FloatArray, columns: FloatArray, values: FloatArray) -> FloatArray:
        """Values (cells, k) in the basis of rows and columns."""
        square = values.reshape(len(rows), len(columns), -1)
        half = np.tensordot(rows.T, square, axes=1)
        return np.asarray((columns.T @ half).reshape(self.size, -1))

    def towards(self, x_px: FloatArray, y_px: FloatArray, length_px: float) -> FloatArray:
        """The correlation of places (n,) with cells' means (n, cells)."""
        parts = []
        for at, middle, side in zip((y_px, x_px), self.middle, self.side, strict=True):
            wide = length_px**2 + side**2 / 12
            correlation = _falling(at[:, None] - middle, wide)
            parts.append(length_px / math.sqrt(wide) * correlation)
        down, along = parts
        both = down[:, :, None] * along[:, None]
        return np.asarray(both.reshape(len(x_px), -1))


def _falling(apart_px: FloatArray, variance_px2: float) -> FloatArray:
    """exp(-d^2 / 2 L^2) of distances, by the square of L."""
    return np.asarray(np.exp(-(apart_px**2) / (2 * variance_px2)))


def in_place(
    x_px: FloatArray,
    y_px: FloatArray,
    values: FloatArray,
    terms: FloatArray,
    longest: float = LONGEST,
) -> Structure:
    """The structure in place of residuals (axes, n) at places (n,), whose fit has `terms` (axes,
    n, p) common to all axes; up to lengths of the share `longest` of their extent.
    """
    inside = _rectangle(x_px, y_px)
    cells = Cells(x_px[inside], y_px[inside])
    means = cells.means(values[:, inside].T)
    of_terms = cells.means(terms[:, inside].transpose(1, 0, 2))
    about_means = values[:, inside].T - means[cells.index]
    within = float((about_means**2).sum())
    more_readings = len(cells.index) - int((cells.count > 0).sum())
    free = float(len(values) * more_readings)
    scale = math.sqrt(cells.typical)
    lengths = cells.lengths(longest)
    empty = cells.empty()
    shape = of_terms.shape
    spreads = []
    for length in lengths:
        eigen, rows, columns = cells.basis(length)
        value = scale * cells.turned(rows, columns, means)
        turned = scale * cells.turned(rows, columns, of_terms.reshape(cells.size, -1))
        by_axis = turned.reshape(shape).transpose(1, 0, 2)
        of_fit = by_axis.reshape(-1, shape[2])
        hidden = np.kron(np.eye(len(values)), cells.turned(rows, columns, empty))
        basis = np.linalg.qr(np.concatenate([of_fit, hidden], axis=1))[0]
        eigens = np.tile(cells.typical * eigen, len(values))
        spreads.append(Spread(eigens, value.T.ravel(), basis, within, free))
    return weighed(lengths, spreads)


def _rectangle(x_px: FloatArray, y_px: FloatArray) -> BoolArray:
    """The readings (n,) within a rectangle of cells that are nearly all filled: the field may
    stand obliquely on the screen.
    """
    cells = Cells(x_px, y_px)
    filled = cells.filled.reshape(len(cells.middle[0]), len(cells.middle[1]))
    height, width = filled.shape
    rows = slice(0, height)
    columns = slice(0, width)
    while filled[rows, columns].mean() <= ENOUGH and filled[rows, columns].size > MIN_CELLS:
        part = filled[rows, columns]
        up = part[0].mean()
        down = part[-1].mean()
        at_left = part[:, 0].mean()
        at_right = part[:, -1].mean()
        emptiest = min(up, down, at_left, at_right)
        if emptiest == down:
            rows = slice(rows.start, rows.stop - 1)
        elif emptiest == up:
            rows = slice(rows.start + 1, rows.stop)
        elif emptiest == at_right:
            columns = slice(columns.start, columns.stop - 1)
        else:
            columns = slice(columns.start + 1, columns.stop)
    row, column = np.divmod(cells.index, width)
    in_rows = (row >= rows.start) & (row < rows.stop)
    in_columns = (column >= columns.start) & (column < columns.stop)
    return np.asarray(in_rows & in_columns)
