"""Stars that the tracker cannot part: one star of the sum, at the centre of their light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.twin.verify.twin import Field
from hilstar.units import magnitude

# Two equal Gaussians have one peak up to 2 sigmas, and a faint one disappears beside a bright one farther out. The windowed
# centroid of a pair is off the centre of its light by 0.02 sigma at 1 sigma, 0.06 at 1.4 (tests/unit/twin/test_blends.py).
BLEND_SIGMAS = 1.5


def with_blends_as_one(seen: Field, sigma_px: tuple[float, float]) -> Field:
    """The field with each star that stands within BLEND_SIGMAS of a brighter one (`sigma_px` of the tracker) added to that.

    The brighter one keeps its name; its light, magnitude and places become those of the sum.
    """
    owner = _owners(np.column_stack([seen.x_px, seen.y_px]) / sigma_px, seen.truth["electrons_per_s"])
    own = np.arange(len(owner))
    if np.array_equal(owner, own):
        return seen
    light = seen.truth["electrons_per_s"]
    total = np.bincount(owner, light, len(owner))
    stars = np.flatnonzero(owner == own)

    def centre(places_px: FloatArray) -> FloatArray:
        moment = np.bincount(owner, light * (places_px - places_px[owner]), len(owner))[stars]
        return np.asarray(places_px[stars] + moment / total[stars])

    truth = seen.truth[stars].copy()
    truth["x_px"], truth["y_px"] = centre(seen.truth["x_px"]), centre(seen.truth["y_px"])
    truth["electrons_per_s"] = total[stars]
    truth["v_mag"] += magnitude(np.asarray(total[stars] / light[stars]))
    truth["clipped"] = np.bincount(owner, seen.truth["clipped"], len(owner))[stars] > 0
    return replace(seen, truth=truth, x_px=centre(seen.x_px), y_px=centre(seen.y_px))


def _owners(places: FloatArray, light: FloatArray) -> IntArray:
    """For each star (n,) at places (n, 2), in sigmas, the one that it is added to: itself, or a brighter one."""
    from scipy.spatial import cKDTree

    owner = np.arange(len(light))
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(known):
        return owner
    near: dict[int, list[int]] = {}
    for a, b in known[cKDTree(places[known]).query_pairs(BLEND_SIGMAS, output_type="ndarray")].tolist():
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    for star in sorted(near, key=lambda star: (-light[star], star)):
        if owner[star] == star:
            for other in near[star]:
                if owner[other] == other and (light[other], -other) < (light[star], -star):
                    owner[other] = star
    return owner
