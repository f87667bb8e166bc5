"""Which model the data ask for: the one whose error on dots that were held out is smallest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.fit import Fit, Matched, Problem, fit, residuals_px
from hilstar.calibrate.geometric.model import BROWN_CONRADY, PINHOLE, RADIAL, Model
from hilstar.units import ARCSEC_PER_RAD

FOLDS = 5
FIELD_DEGREES = (3, 4, 5, 6, 7)
GAIN = 0.98  # a larger model is taken where it brings the held-out error below this share of the smaller one's
CENTROIDS_PER_NUMBER = 3.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A model, what it is called, and how far off it is on dots that were held out of its fit.

    `off_arcsec` (dots, 2) is the mean error of each dot in `dot` (dots,); lengths of it include the centroids' noise.
    """

    name: str
    model: Model
    field_degree: int
    dot: IntArray
    off_arcsec: FloatArray

    @property
    def rms_arcsec(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt((self.off_arcsec**2).sum(axis=1).mean()))

    @property
    def max_arcsec(self) -> float:
        """The farthest dot."""
        return float(np.hypot(*self.off_arcsec.T).max())


def candidates(problem: Problem, data: Matched, tracker_names: tuple[str, ...]) -> list[Candidate]:
    """Every model that the number of centroids allows, simplest first, each held against dots that it was not fitted to."""
    poses = len(problem.q_poses)
    wanted = [("pinhole", PINHOLE, 0), ("pinhole + k1", RADIAL, 0), ("Brown-Conrady + tilt", BROWN_CONRADY, 0)]
    wanted += [(f"Brown-Conrady + tilt + field of degree {n}", BROWN_CONRADY, n) for n in FIELD_DEGREES]
    found: list[Candidate] = []
    for name, names, degree in wanted:
        model = Model(names, tracker_names if names is BROWN_CONRADY else (), poses)
        numbers = model.size + (degree + 1) * (degree + 2)
        if 2 * len(data) >= CENTROIDS_PER_NUMBER * numbers and len(np.unique(data.dot)) > numbers / 2:
            found.append(held_out(problem, name, model, degree, data))
        if len(found) > 4 and found[-1].rms_arcsec > found[-2].rms_arcsec > found[-3].rms_arcsec:
            break  # larger fields follow the noise
    return found


def held_out(problem: Problem, name: str, model: Model, degree: int, data: Matched) -> Candidate:
    """A model held against each dot by a fit to the others, a fifth of the dots at a time."""
    dots = np.unique(data.dot)
    fold = np.zeros(int(dots.max()) + 1, dtype=np.intp)
    fold[dots] = np.arange(len(dots)) % FOLDS
    start = fit(problem, model, degree, data).numbers
    off = np.full((len(data), 2), np.nan)
    for k in range(FOLDS):
        out = fold[data.dot] == k
        if out.any() and not out.all():
            trained = fit(problem, model, degree, data.at(np.flatnonzero(~out)), start)
            off[out] = np.stack(residuals_px(problem, trained.geometry, data.at(np.flatnonzero(out))), axis=1)
    arcsec = np.nan_to_num(off, nan=np.inf) * ARCSEC_PER_RAD / problem.nominal.tracker.focal_length_px
    count = np.bincount(data.dot, minlength=len(fold))[dots]
    means = np.stack([np.bincount(data.dot, arcsec[:, k], minlength=len(fold))[dots] / count for k in (0, 1)], axis=1)
    return Candidate(name, model, degree, dots, means)


def best_of(found: list[Candidate]) -> Candidate:
    """The simplest whose held-out error no larger model brings clearly down."""
    best = found[0]
    for candidate in found[1:]:
        if candidate.rms_arcsec < GAIN * best.rms_arcsec:
            best = candidate
    return best


def final_fit(problem: Problem, chosen: Candidate, data: Matched) -> Fit:
    """The chosen model on all of the data."""
    return fit(problem, chosen.model, chosen.field_degree, data)
