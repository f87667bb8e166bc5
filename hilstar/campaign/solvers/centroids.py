"""The centroider alone: its errors against the truth, and the attitude of its stars, each of which the truth names."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.campaign.plan.tables import Centroiding
from hilstar.campaign.solvers.answer import Answer, StarErrors, Tracker
from hilstar.rotation import from_matrix, multiply, normalise
from hilstar.tracker.centroids import Centroids, CentroidSettings, find_stars
from hilstar.twin.simulator import Exposure
from hilstar.twin.verify.star_finder import crowded, nearest

MIN_STARS = 2  # that give an attitude


class CentroidSolver:
    """Finds stars, and takes the nearest one of the truth, the brightest first, within 3 px for each."""

    def __init__(self, settings: Centroiding) -> None:
        self._wanted = settings

    def solve(self, exposure: Exposure, tracker: Tracker) -> Answer:
        """Centroid errors, and the attitude by the stars that were matched; no star has to be identified."""
        settings = self._settings(tracker)
        found = find_stars(exposure.dn, settings)
        truth = _on_detector(exposure)
        index = _matched(found, truth["x_px"], truth["y_px"])
        is_matched = index >= 0
        good = is_matched & ~truth["clipped"] & ~found.at_edge[index] if len(found) else is_matched
        sigma_px = tracker.config.tracker.psf_sigma_px
        flux = truth["electrons_per_s"]
        if len(truth):
            good &= ~crowded(truth["x_px"], truth["y_px"], flux, settings.radius_px, sigma_px)
        x_px, y_px = truth["x_px"][good], truth["y_px"][good]
        errors = StarErrors(
            stars=len(truth),
            found=len(found),
            matched=int(is_matched.sum()),
            false=len(found) - int(is_matched.sum()),
            dx_px=found.x_px[index[good]] - x_px,
            dy_px=found.y_px[index[good]] - y_px,
            x_px=x_px,
            y_px=y_px,
            v_mag=truth["v_mag"][good],
        )
        if len(x_px) < MIN_STARS:
            return Answer(None, f"{len(x_px)} stars stand alone, and an attitude takes {MIN_STARS}", errors)
        turn = _turn(tracker, errors, flux[good])
        return Answer(multiply(turn, exposure.motion.q_icrs_to_cam), "", errors)

    def _settings(self, tracker: Tracker) -> CentroidSettings:
        wanted, psf = self._wanted, tracker.config.tracker.psf_sigma_px
        return CentroidSettings(
            threshold_sigma=wanted.threshold_sigma,
            minimum_pixels=wanted.minimum_pixels,
            window=wanted.window,
            window_sigma_px=wanted.window_sigma_px or max(1.0, *psf),
            psf_sigma_px=psf if wanted.remove_s_curve else None,
        )


def _on_detector(exposure: Exposure) -> np.ndarray:
    """The truth's rows whose places lie on the detector, brightest first."""
    truth, (height, width) = exposure.truth, exposure.dn.shape
    with np.errstate(invalid="ignore"):
        inside = (np.abs(truth["x_px"] - (width - 1) / 2) <= width / 2) & (
            np.abs(truth["y_px"] - (height - 1) / 2) <= height / 2
        )
    return np.asarray(truth[inside & truth["drawn"]])


def _matched(found: Centroids, x_px: FloatArray, y_px: FloatArray) -> IntArray:
    """For each star (n,), brightest first, its find; -1 for none, or where a brighter star has it."""
    index = nearest(found, x_px, y_px)
    _, first = np.unique(index, return_index=True)
    alone = np.zeros(len(index), dtype=np.bool_)
    alone[first] = True
    return np.where(alone, index, -1)


def _turn(tracker: Tracker, errors: StarErrors, weight: FloatArray) -> FloatArray:
    """The rotation (4,) from the true attitude's cam to that of the centroids: Wahba's problem by SVD (Markley 1988).

    Weighted by the light, as the variance of photon noise has it.
    """
    true, seen = (
        normalise(tracker.camera.rays(errors.x_px + dx_px, errors.y_px + dy_px))
        for dx_px, dy_px in ((np.zeros(len(weight)), np.zeros(len(weight))), (errors.dx_px, errors.dy_px))
    )
    u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weight / weight.sum(), seen, true))
    return from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)
