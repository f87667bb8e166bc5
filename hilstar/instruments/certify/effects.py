"""What an input of the budget does to a bench's deviations: its slopes."""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.certify.budget import Input


@dataclass(frozen=True, slots=True)
class Effect:
    """An input and its slopes: on relative light at the model's levels (size, levels) and at stars
    (size, stars), places (size, stars, 2), delay and lateness (size,), ms, and on what the sky adds
    to each star (size, 3, stars).
    """

    input: Input
    levels: FloatArray | None = None
    even: FloatArray | None = None
    place: FloatArray | None = None
    delay: FloatArray | None = None
    late: FloatArray | None = None
    sky: FloatArray | None = None


def of_all_stars(count: int, relative: float) -> FloatArray:
    """Slopes (1, stars) of an error of light that is one for all stars."""
    return np.full((1, count), relative)


def smooth_root(correlation: FloatArray) -> FloatArray:
    """Slopes (k, n) by independent variables of errors (n,) of unit variance that correlate as
    (n, n).
    """
    size, vectors = np.linalg.eigh(correlation)
    return np.asarray((vectors * np.sqrt(np.maximum(size, 0.0))).T)


def root_mean_square(values: FloatArray) -> float:
    """The root of the mean of the squares of values."""
    return float(np.sqrt((values**2).mean()))
