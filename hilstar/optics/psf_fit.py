"""Gaussians over a field, fitted to the images of points or small squares.

A point's light is an elliptical Gaussian, integrated over pixels; of a square it is also integrated
over the square's side. A covariance is xx, yy, xy, px^2, and over the field a polynomial of the
place. Each image is fitted by Gauss-Newton steps: its light, its background, its place and its
covariance, whose derivatives are in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray

NODES = 9  # of a quadrature over a pixel and a square, along each axis
# A Gaussian is smooth over a cell, a pixel with its square: from a sigma on, in cells, so many
# nodes are right to 1e-7 of a peak.
NODES_FROM = ((2.0, 3), (0.7, 5), (0.0, NODES))
SIDE_STEPS = 600  # of the weight of a pixel convolved with a square's side
MIN_VARIANCE_PX2 = 0.15**2
MAX_CORRELATION = 0.95  # a Gaussian of 1 is a line, whose density has no bound
FIT_ROUNDS = 8
MAX_STEP_PX, MAX_STEP_SHARE = 0.3, 0.6  # of a place, and of a variance, in one round
RIDGE = 1e-9  # on unit columns: two that are alike share the light
# residuals of more than so many medians count less, anew in each round
FIELD_ROUNDS, OUTLIER_MEDIANS = 5, 2.0
SMALLEST = 1e-300  # in place of 0 where a column or a flux is divided by
XY = 2  # the column of a covariance (n, 3) that follows xx and yy


@lru_cache(maxsize=1024)
def cell_quadrature(side_px: float, count: int = NODES) -> tuple[FloatArray, FloatArray]:
    """Gauss's nodes, px, and weights (count,) over a pixel convolved with a square's side.

    The method is Golub and Welsch's (1969).
    """
    if side_px == 0:
        nodes, weights = np.polynomial.legendre.leggauss(count)
        return nodes / 2, weights / 2
    width_px = 1 + side_px
    at = (np.arange(SIDE_STEPS) + 0.5) / SIDE_STEPS * width_px - width_px / 2
    weight = np.clip(width_px / 2 - np.abs(at), 0, min(1.0, side_px))
    weight /= weight.sum()
    before = np.zeros_like(at)
    now = np.ones_like(at)
    norm = 1.0
    ratio = 0.0
    ratios: list[float] = []
    for _ in range(count - 1):
        before, now = now, at * now - ratio * before
        ratio = float(weight @ now**2) / norm
        norm *= ratio
        ratios.append(ratio)
    root = np.sqrt(ratios)
    nodes, vectors = np.linalg.eigh(np.diag(root, 1) + np.diag(root, -1))
    return nodes, vectors[0] ** 2


def node_count(sigma_cells: float) -> int:
    """How many nodes a Gaussian of this sigma needs along each axis of a cell."""
    return next(count for least, count in NODES_FROM if sigma_cells >= least)


class PixelGaussians:
    """Gaussians of covariance (n, 3) in pixels at offsets (n, w) and (n, h) from their middles.

    `side_px` (n,) is the side of the square whose light they are, 0 for a point.
    """

    def __init__(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        covariance: FloatArray,
        side_px: FloatArray,
        nodes: int = NODES,
    ) -> None:
        xx, yy, xy = bounded(covariance).T
        self._xx = xx[:, None, None]
        self._yy = yy[:, None, None]
        self._xy = xy[:, None, None]
        determinant = xx * yy - xy**2
        self._determinant = determinant[:, None, None]
        places = []
        weights = []
        for side in np.round(side_px, 3):
            rule_places, rule_weights = cell_quadrature(float(side), nodes)
            places.append(rule_places)
            weights.append(rule_weights)
        at = np.stack(places)
        self._weight = np.stack(weights)
        self._nodes = nodes
        self._x = x_px[:, :, None] + at[:, None]
        self._y = y_px[:, :, None] + at[:, None]
        self._size = (len(at), y_px.shape[1], x_px.shape[1])
        x = self._x.reshape(len(at), 1, -1)
        y = self._y.reshape(len(at), -1)[:, :, None]
        scale = (-0.5 / determinant)[:, None, None]
        light = -2 * scale * self._xy * y * x
        light += scale * self._xx * (y * y)
        light += scale * self._yy * (x * x)
        np.exp(light, out=light)
        self._light = light.reshape(len(at), y.shape[1], self._size[2], nodes)
        self._peak = (2 * np.pi * np.sqrt(determinant))[:, None, None]

    @property
    def shares(self) -> FloatArray:
        """Shares of light (n, h, w)."""
        return self._moment(self._over_x(0), 0)

    def slopes(self, shape: bool = False) -> list[FloatArray]:
        """Shares (n, h, w), and their derivatives by the middle's x and y; with `shape` also by xx,
        yy and xy.
        """
        by_x0 = self._over_x(0)
        by_x1 = self._over_x(1)
        share = self._moment(by_x0, 0)
        x = self._moment(by_x1, 0)
        y = self._moment(by_x0, 1)
        xx = self._xx
        yy = self._yy
        xy = self._xy
        determinant = self._determinant
        by_x = (yy * x - xy * y) / determinant
        by_y = (xx * y - xy * x) / determinant
        first = [share, by_x, by_y]
        if not shape:
            return first
        x2 = self._moment(self._over_x(2), 0)
        x1y1 = self._moment(by_x1, 1)
        y2 = self._moment(by_x0, 2)
        square = determinant**2
        weighted_u2 = yy * yy * x2 - 2 * yy * xy * x1y1 + xy * xy * y2
        weighted_v2 = xx * xx * y2 - 2 * xx * xy * x1y1 + xy * xy * x2
        weighted_uv = -yy * xy * x2 + (xx * yy + xy * xy) * x1y1 - xx * xy * y2
        u2 = weighted_u2 / square
        v2 = weighted_v2 / square
        uv = weighted_uv / square
        by_xx = (u2 - share * yy / determinant) / 2
        by_yy = (v2 - share * xx / determinant) / 2
        by_xy = uv + share * xy / determinant
        return [*first, by_xx, by_yy, by_xy]

    def _over_x(self, power: int) -> FloatArray:
        """The light times x to a power, mean over each pixel's width: (n, h nodes, w)."""
        if power == 0:
            mean = self._light @ self._weight[:, None, :, None]
            return np.asarray(mean[..., 0])
        weight = self._weight[:, None] * self._x**power
        return np.asarray(np.einsum("nrwk,nwk->nrw", self._light, weight))

    def _moment(self, over_x: FloatArray, power: int) -> FloatArray:
        """The mean of y^power times the Gaussian over each pixel's height: (n, h, w)."""
        count, height, width = self._size
        rows = over_x.reshape(count, height, self._nodes, width)
        weight = self._weight[:, None] * self._y**power
        mean = (weight[:, :, None] @ rows)[:, :, 0]
        return np.asarray(mean / self._peak)


def bounded(covariance: FloatArray) -> FloatArray:
    """Covariances (n, 3), px^2, kept to those of a Gaussian: variances of MIN_VARIANCE_PX2 or more,
    a correlation of up to MAX_CORRELATION.
    """
    xx, yy = np.maximum(covariance[:, :XY], MIN_VARIANCE_PX2).T
    most = MAX_CORRELATION * np.sqrt(xx * yy)
    xy = np.clip(covariance[:, XY], -most, most)
    return np.stack([xx, yy, xy], axis=1)


def normal_equations(
    columns: FloatArray, weight: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The normal matrices (n, c, c) and right sides (n, c) of columns (n, c, p) against values
    (n, p), whose weights (n, p) are one over their variance.
    """
    weighted = columns * weight[:, None]
    normal = weighted @ columns.transpose(0, 2, 1)
    right = (weighted @ values[:, :, None])[:, :, 0]
    return normal, np.asarray(right)


def amplitudes(columns: Sequence[FloatArray], weight: FloatArray, images: FloatArray) -> FloatArray:
    """The factors (n, c) by which columns (n, h, w) add up to images (n, h, w), by weighted least
    squares.
    """
    count = len(images)
    flat = np.stack(columns, axis=1).reshape(count, len(columns), -1)
    flat_weight = weight.reshape(count, -1)
    flat_images = images.reshape(count, -1)
    normal, right = normal_equations(flat, flat_weight, flat_images)
    squares = np.einsum("nkk->nk", normal)
    size = np.sqrt(np.maximum(squares, SMALLEST))
    unit = normal / size[:, :, None] / size[:, None, :]
    ridge = RIDGE * np.eye(len(columns))
    unit_right = (right / size)[:, :, None]
    solution = np.linalg.solve(unit + ridge, unit_right)
    return np.asarray(solution[:, :, 0] / size)


@dataclass(frozen=True, slots=True)
class PointImages:
    """Images (n, s, s) of points or squares, one over the variance of their pixels, their middle
    pixels and the sides (n,) of the squares, px.

    `has_level` says that each stands on a background of its own.
    """

    images: FloatArray
    weight: FloatArray
    column: FloatArray | IntArray
    row: FloatArray | IntArray
    side_px: FloatArray
    has_level: bool = True

    def offsets(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels' places less the points' (n,), along x and y (n, s)."""
        side = self.images.shape[1]
        reach = np.arange(side) - side // 2
        across = (self.column - x_px)[:, None] + reach
        down = (self.row - y_px)[:, None] + reach
        return across, down


@dataclass(frozen=True, slots=True)
class PointGaussians:
    """Places (n,), px, and covariances (n, 3), px^2, of points."""

    x_px: FloatArray
    y_px: FloatArray
    covariance: FloatArray


def fit_each(
    points: PointImages, start: PointGaussians, rounds: int = FIT_ROUNDS, alike: bool = False
) -> PointGaussians:
    """The Gaussian of each image; where all are `alike`, one covariance for all: its steps are the
    medians of theirs.
    """
    x_px = start.x_px
    y_px = start.y_px
    covariance = start.covariance
    cell_px = 1 + float(points.side_px.max(initial=0.0))
    for _ in range(rounds):
        sigma_px = float(np.sqrt(bounded(covariance)[:, :XY].min()))
        count = node_count(sigma_px / cell_px)
        offsets = points.offsets(x_px, y_px)
        gaussians = PixelGaussians(*offsets, covariance, points.side_px, count)
        slopes = gaussians.slopes(shape=True)
        if points.has_level:
            slopes.append(np.ones_like(slopes[0]))
        solution = amplitudes(slopes, points.weight, points.images)
        flux = np.maximum(np.abs(solution[:, :1]), SMALLEST)
        steps = solution[:, 1:6] / flux
        moves = np.clip(steps[:, :2], -MAX_STEP_PX, MAX_STEP_PX)
        growth = steps[:, 2:]
        if alike:
            growth = np.median(growth, axis=0, keepdims=True)
        xx, yy, _ = bounded(covariance).T
        mean_variance = np.sqrt(xx * yy)
        most = MAX_STEP_SHARE * mean_variance[:, None]
        covariance = bounded(covariance + np.clip(growth, -most, most))
        x_px = x_px + moves[:, 0]
        y_px = y_px + moves[:, 1]
    return PointGaussians(x_px, y_px, covariance)


def place_terms(u: FloatArray, v: FloatArray) -> FloatArray:
    """Terms (n, 6) of scaled places (n,): 1, u, v, u^2, u v, v^2."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


def over_field(terms: FloatArray, covariance: FloatArray) -> FloatArray:
    """Coefficients (T, 3) of covariances (n, 3) by terms (n, T) of their places.

    It is robust: a point with a neighbour or a hot pixel has another covariance.
    """
    weight = np.ones((len(terms), 1))
    for _ in range(FIELD_ROUNDS):
        solution, *_ = np.linalg.lstsq(terms * weight, covariance * weight, rcond=None)
        off = np.abs(covariance - terms @ solution).max(axis=1, keepdims=True)
        usual = max(OUTLIER_MEDIANS * float(np.median(off)), RIDGE)
        weight = 1 / np.maximum(1.0, off / usual)
    return np.asarray(solution, dtype=np.float64)
