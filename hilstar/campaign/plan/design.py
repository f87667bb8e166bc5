"""The design: a point of the unit cube for each case, by the plan's sampling and seed alone."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.campaign.plan.tables import Sampling
from hilstar.errors import InputError

if TYPE_CHECKING:
    from scipy.stats.qmc import Sobol

ATTITUDE_STREAM = 1  # of a case's seed: where a grid's case looks
SOBOL_BITS = 30
MAX_HYPERCUBE_VALUES = 200_000_000  # 1.6 GB: a Latin hypercube is made as a whole


class Design:
    """Points (n, dimensions) in [0, 1) of the cases: first the attitude's, then one of each varied key.

    A grid's keys have `levels` values each; they come in order, the last key fastest, and again from the first case after
    the last. Raises InputError for a Latin hypercube too large to be held.
    """

    def __init__(self, sampling: Sampling, seed: int, cases: int, attitude_dimensions: int, levels: Sequence[int]) -> None:
        self.sampling, self.seed, self.cases = sampling, seed, cases
        self.attitude_dimensions, self.levels = attitude_dimensions, tuple(levels)
        self.dimensions = attitude_dimensions + len(levels)
        self._cube: FloatArray | None = None
        self._engine: Sobol | None = None
        if sampling == "latin-hypercube":
            if cases * self.dimensions > MAX_HYPERCUBE_VALUES:
                most = MAX_HYPERCUBE_VALUES // self.dimensions
                raise InputError(
                    f"cases = {cases}: a Latin hypercube is made as a whole, of at most {most} cases with"
                    f' {self.dimensions} dimensions; write sampling = "sobol"'
                )
            from scipy.stats import qmc

            self._cube = qmc.LatinHypercube(self.dimensions, rng=np.random.default_rng(seed)).random(cases)

    def points(self, begin: int, end: int) -> FloatArray:
        """The points of the cases from `begin` to before `end`."""
        if self._cube is not None:
            return self._cube[begin:end]
        if self.sampling == "sobol":
            return self._sobol(begin, end)
        return np.array([self._grid_point(case) for case in range(begin, end)]).reshape(end - begin, self.dimensions)

    def _sobol(self, begin: int, end: int) -> FloatArray:
        from scipy.stats import qmc

        if self._engine is None or self._engine.num_generated > begin:
            rng = np.random.default_rng(self.seed)
            self._engine = qmc.Sobol(self.dimensions, scramble=True, bits=SOBOL_BITS, rng=rng)
        if begin > self._engine.num_generated:
            self._engine.fast_forward(begin - self._engine.num_generated)
        with warnings.catch_warnings():  # of a number of points that is no power of two: the plan's number counts
            warnings.simplefilter("ignore", UserWarning)
            return np.asarray(self._engine.random(end - begin))

    def _grid_point(self, case: int) -> FloatArray:
        place, rest = [], case % max(1, math.prod(self.levels))
        for count in reversed(self.levels):
            place.append((rest % count + 0.5) / count)
            rest //= count
        rng = np.random.default_rng((self.seed, case, ATTITUDE_STREAM))
        return np.concatenate([rng.random(self.attitude_dimensions), place[::-1]])
