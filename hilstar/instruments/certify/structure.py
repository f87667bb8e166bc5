"""What is left of structure in a fit's residuals: how much of their variance is correlated, in
place or in time, and how far.

A fit's residuals are noise, of each reading by itself, and perhaps a part whose correlation falls
with distance: as
exp(-d^2 / 2 L^2) in place, as exp(-t / T) in time. Ratio of the variances and length are those of a
grid, each by its restricted likelihood (Patterson and Thompson 1971), which takes the fit's own
terms out. All points of the grid count by their likelihood: a structure whose length is unsure is
so in what it does. Where none is more likely, there is none.

In place readings are averaged over cells of a lattice, whose correlations are products of rows and
columns, so that one grid of ratios costs no more than the squares of a few terms.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray

# of the structure's variance to that of the noise of one reading
RATIOS = np.geomspace(1e-3, 3e3, 20)
LENGTH_STEP = 1.6  # from one length to the next
MAX_CELLS = 1000
# share of cells that are filled in the rectangle by which structure is told; its least cells
ENOUGH, MIN_CELLS = 0.97, 64
MIN_FILLED = 0.5  # relative to a full cell: a cell with fewer readings is taken as empty
TINY = 1e-300
MIN_DOF = 3.0
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

    @property
    def mean_length(self) -> float:
        """The mean of the lengths by their variances."""
        return float(self.length @ self.variance) / max(self.total, TINY)


@dataclass(frozen=True, slots=True)
class Spread:
    """Residuals in the basis in which their correlation is diagonal: values (m,) and terms (m, p),
    in one reading's noise.

    `square` and `dof` are what is known of the noise beside them.
    """

    value: FloatArray
    terms: FloatArray
    square: float = 0.0
    dof: float = 0.0


def weighed(lengths: FloatArray, spreads: list[tuple[FloatArray, Spread]]) -> Structure:
    """The structure by spreads at each length, each with its eigenvalues (m,) of correlation
    relative to the noise's.
    """
    likelihood = np.zeros((len(lengths), len(RATIOS) + 1))
    noise = np.zeros_like(likelihood)
    ratios = np.append(0.0, RATIOS)
    for row, (eigen, spread) in enumerate(spreads):
        dof = len(spread.value) - spread.terms.shape[1] + spread.dof
        for column, ratio in enumerate(ratios):
            weight = 1 / (1 + ratio * eigen)
            normal = spread.terms.T @ (weight[:, None] * spread.terms)
            towards = spread.terms.T @ (weight * spread.value)
            unexplained = (
                float(
                    spread.value @ (weight * spread.value)
                    - towards @ np.linalg.solve(normal, towards)
                )
                + spread.square
            )
            sizes = float(np.linalg.slogdet(normal)[1] - np.log(weight).sum())
            likelihood[row, column] = -0.5 * (sizes + dof * math.log(max(unexplained, TINY)))
            noise[row, column] = unexplained / dof
    finer = _finer(lengths, FINE_LENGTH), _finer(RATIOS, FINE_RATIO)
    of_some = _between(lengths, likelihood[:, 1:], finer)
    noise_of_some = np.exp(_between(lengths, np.log(np.maximum(noise[:, 1:], TINY)), finer))
    none = likelihood[:, 0].mean()  # the same for all lengths
    share = np.exp(of_some - max(float(of_some.max()), none))
    # No structure and some are as likely beforehand; of some, each ratio and length.
    share /= share.size
    nothing = math.exp(none - max(float(of_some.max()), none))
    if nothing >= float(share.sum()):
        return Structure(lengths, np.zeros(len(lengths)), float(noise[0, 0]), math.inf)
    share /= share.sum()
    # As of a variance by few readings, whose Student's t has the geometric mean for its scale,
    # nearly.
    evidence = noise_of_some * finer[1]
    middle = float((share * np.log(evidence)).sum())
    dof = max(2 / max(float((share * (np.log(evidence) - middle) ** 2).sum()), TINY), MIN_DOF)
    variance = (share * evidence).sum(axis=1)
    return Structure(
        finer[0],
        variance * math.exp(middle) / variance.sum(),
        float((share * noise_of_some).sum()),
        dof,
    )


def _finer(values: FloatArray, step: float) -> FloatArray:
    """Values between the first and the last, by a smaller step."""
    count = math.ceil(math.log(values[-1] / values[0]) / math.log(step)) + 1
    return np.asarray(np.geomspace(values[0], values[-1], count))


def _between(
    lengths: FloatArray, values: FloatArray, finer: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Values (lengths, ratios), smooth in the logarithms of both, on a finer grid."""
    spline = RectBivariateSpline(
        np.log(lengths), np.log(RATIOS), values, kx=min(3, len(lengths) - 1), ky=3, s=0
    )
    return np.asarray(spline(np.log(finer[0]), np.log(finer[1])))


def in_time(t: FloatArray, value: FloatArray, terms: FloatArray) -> Structure:
    """The structure in time of values (n,) with equal noise, whose fit has `terms` (n, p)."""
    step = float(np.median(np.diff(np.sort(t)))) or 1.0
    lengths = step * np.geomspace(0.5, 1.0 * len(t), 10)
    basis = np.linalg.qr(terms)[0]
    spreads = []
    for length in lengths:
        eigen, vectors = np.linalg.eigh(np.exp(-np.abs(t[:, None] - t) / length))
        spreads.append((np.maximum(eigen, 0.0), Spread(vectors.T @ value, vectors.T @ basis)))
    return weighed(lengths, spreads)


def lasting_root(t: FloatArray, found: Structure) -> FloatArray:
    """A root (n, k) of the covariance of a structure in time at moments (n,)."""
    if not found.total:
        return np.zeros((len(t), 0))
    apart = np.abs(t[:, None] - t)
    covariance = np.zeros((len(t), len(t)))
    for length, variance in zip(found.length, found.variance, strict=True):
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
            if len(places) > 1:
                step = float(np.median(np.diff(places)))
            else:
                step = 1.0
            number = np.rint((at - places[0]) / step).astype(np.intp) // group
            count = int(number.max()) + 1
            self.middle.append(places[0] + step * (group * np.arange(count) + (group - 1) / 2))
            self.side.append(group * step)
            index = index * count + number
        self.index: IntArray = index
        self.size = len(self.middle[0]) * len(self.middle[1])
        counts = np.bincount(index, minlength=self.size)
        self.filled: BoolArray = counts >= MIN_FILLED * group**2
        self.count = counts
        self.typical = float(counts[self.filled].mean())

    def lengths(self) -> FloatArray:
        """Lengths that the lattice can tell, px: from half of a cell to half of its extent."""
        low = min(self.side) / 2
        high = max(float(np.ptp(middles)) for middles in self.middle) / 2
        return np.asarray(
            np.geomspace(low, high, max(round(math.log(high / low) / math.log(LENGTH_STEP)) + 1, 2))
        )

    def means(self, values: FloatArray) -> FloatArray:
        """The means (cells, ...) of values (n, ...); 0 in empty cells."""
        sums = np.zeros((self.size, *values.shape[1:]))
        np.add.at(sums, self.index, values)
        return np.asarray(sums / np.maximum(self.count, 1).reshape(-1, *[1] * (values.ndim - 1)))

    def basis(self, length_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The correlation of cells' means: eigenvalues (cells,), and the vectors of rows and of
        columns.
        """
        parts = []
        for middle, side in zip(self.middle, self.side, strict=True):
            wide = length_px**2 + side**2 / 6  # a mean over a cell: its own variance twice
            between = (middle[:, None] - middle) ** 2
            eigen, vectors = np.linalg.eigh(
                length_px / math.sqrt(wide) * np.exp(-between / (2 * wide))
            )
            parts.append((np.maximum(eigen, 0.0), vectors))
        (down, rows), (along, columns) = parts
        return np.outer(down, along).ravel(), rows, columns

    def turned(self, rows: FloatArray, columns: FloatArray, values: FloatArray) -> FloatArray:
        """Values (cells, k) in the basis of rows and columns."""
        square = values.reshape(len(rows), len(columns), -1)
        half = np.tensordot(rows.T, square, axes=1)
        return np.asarray(np.einsum("jc,rjk->rck", columns, half).reshape(self.size, -1))

    def towards(self, x_px: FloatArray, y_px: FloatArray, length_px: float) -> FloatArray:
        """The correlation of places (n,) with cells' means (n, cells)."""
        parts = []
        for at, middle, side in zip((y_px, x_px), self.middle, self.side, strict=True):
            wide = length_px**2 + side**2 / 12
            parts.append(
                length_px / math.sqrt(wide) * np.exp(-((at[:, None] - middle) ** 2) / (2 * wide))
            )
        return np.asarray((parts[0][:, :, None] * parts[1][:, None]).reshape(len(x_px), -1))


def in_place(
    x_px: FloatArray, y_px: FloatArray, values: FloatArray, terms: FloatArray
) -> Structure:
    """The structure in place of residuals (axes, n) at places (n,), whose fit has `terms` (axes,
    n, p) common to all axes.
    """
    inside = _rectangle(x_px, y_px)
    cells = Cells(x_px[inside], y_px[inside])
    values = values[:, inside]
    terms = terms[:, inside]
    means = [cells.means(column) for column in values]
    of_terms = [cells.means(column) for column in terms]
    scale = math.sqrt(cells.typical)
    within = float(
        sum(
            ((column - mean[cells.index]) ** 2).sum()
            for column, mean in zip(values, means, strict=True)
        )
    )
    free = float(len(values) * (len(cells.index) - (cells.count > 0).sum()))
    empty = np.flatnonzero(~cells.filled)
    hidden = np.zeros((cells.size, len(empty)))
    # a term of its own takes an empty cell out of the fit
    hidden[empty, np.arange(len(empty))] = 1.0
    spreads = []
    for length in (lengths := cells.lengths()):
        eigen, rows, columns = cells.basis(length)
        own_turned = cells.turned(rows, columns, hidden)
        blank = np.zeros_like(own_turned)
        value = [scale * cells.turned(rows, columns, column[:, None])[:, 0] for column in means]
        term = []
        for axis, column in enumerate(of_terms):
            alone = [own_turned if other == axis else blank for other in range(len(means))]
            term.append(
                np.concatenate([scale * cells.turned(rows, columns, column), *alone], axis=1)
            )
        basis = np.linalg.qr(np.concatenate(term))[0]
        eigens = np.tile(cells.typical * eigen, len(means))
        spreads.append((eigens, Spread(np.concatenate(value), basis, within, free)))
    return weighed(lengths, spreads)


def _rectangle(x_px: FloatArray, y_px: FloatArray) -> BoolArray:
    """The readings (n,) within a rectangle of cells that are nearly all filled: the field may
    stand obliquely on the screen.
    """
    cells = Cells(x_px, y_px)
    filled = cells.filled.reshape(len(cells.middle[0]), len(cells.middle[1]))
    low = [0, 0]
    high = list(filled.shape)
    while (
        not (part := filled[low[0] : high[0], low[1] : high[1]]).mean() > ENOUGH
        and part.size > MIN_CELLS
    ):
        edges = [
            (float(np.take(part, end, axis=axis).mean()), axis, end)
            for axis in (0, 1)
            for end in (0, -1)
        ]
        _, axis, end = min(edges)
        low[axis] += end == 0
        high[axis] += end
    row, column = np.divmod(cells.index, filled.shape[1])
    return np.asarray((row >= low[0]) & (row < high[0]) & (column >= low[1]) & (column < high[1]))
