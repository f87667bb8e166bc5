"""Where a star field stands within a pixel, and functions that repeat with it.

A star of direction r is at f (R r)_x / (R r)_z on the detector, px from its middle. All stars near it move alike, so one
direction gives the phase of the field, as far as the camera does not roll. Two families of functions are tried, and the one
that explains more for what it costs is kept: harmonics of one direction's phase, the same over the whole run (the usual
directions: where the boresight was at the start, in the middle, on average; and the turn from the start as angles), or
harmonics of the phase of the place's own direction, with amplitudes that change from place to place, as they do where
stars enter and leave the field.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from hilstar.arrays import FloatArray
from hilstar.campaign.budget.places import axes_of, centres_of, places_of, weights_at
from hilstar.campaign.budget.scale import Scale
from hilstar.campaign.budget.star_search import MIN_FORWARD
from hilstar.rotation import conjugate, multiply, to_rotation_vector

HARMONICS = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2))  # cycles per pixel along x and y
SHARP_HARMONICS = (*HARMONICS, (3, 0), (0, 3), (4, 0), (0, 4), (5, 0), (0, 5))  # of a saw's power, 89 %; two have 76 %
LOCAL_HARMONICS = ((1, 0), (0, 1))
MAX_EDGES = 12
EDGE_STEPS = 1024  # of a pixel, at which an edge is sought
# What an edge has to explain, in units of the noise's variance: in 300 runs of noise alone the best of all places explained 33.
SURE_OF_EDGE = 50.0


@dataclass(frozen=True)
class Phases:
    """A star's place (n, 2), px, by which the field's place within a pixel is told; `name` says which star's."""

    name: str
    place_px: FloatArray

    def columns(self, harmonics: tuple[tuple[int, int], ...] = HARMONICS) -> FloatArray:
        """Cosines and sines (n, 2 k) of the harmonics."""
        angle = 2 * np.pi * (self.place_px @ np.array(harmonics, dtype=float).T)
        return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def edges_of(phases: Phases, base: FloatArray, about: FloatArray) -> FloatArray:
    """Saws (n, m) of the place within a pixel that explain most of residuals (n, 3) beyond a base (n, k) of harmonics.

    One after another (orthogonal matching pursuit: Pati et al. 1993), as long as each is sure. A jump anywhere is a saw and
    something smooth, so a few saws and harmonics make every function that is smooth but for a few jumps.
    """
    columns = base
    n = len(about)
    spectrum = np.fft.rfft((np.arange(EDGE_STEPS) + 0.5) / EDGE_STEPS - 0.5)
    highest = max(SHARP_HARMONICS if base.shape[1] == 2 * len(SHARP_HARMONICS) else HARMONICS)[0]
    spectrum[: highest + 1] = 0.0  # the base has these
    power = float((np.fft.irfft(spectrum, EDGE_STEPS) ** 2).mean())
    bin_of = [np.minimum((EDGE_STEPS * (u % 1)).astype(np.int64), EDGE_STEPS - 1) for u in phases.place_px.T]
    for _ in range(MAX_EDGES):
        fitted = columns @ np.linalg.lstsq(columns, about, rcond=None)[0]
        left = (about - fitted) / np.maximum((about - fitted).std(axis=0), 1e-12)
        best = (SURE_OF_EDGE, 0, 0)
        for axis, bins in enumerate(bin_of):
            sums = np.stack([np.bincount(bins, value, minlength=EDGE_STEPS) for value in left.T])
            met = np.fft.irfft(np.fft.rfft(sums) * np.conj(spectrum), EDGE_STEPS)
            gain = (met**2).sum(axis=0) / (n * power)
            place = int(np.argmax(gain))
            best = max(best, (float(gain[place]), axis, place))
        gain_there, axis, place = best
        if gain_there <= SURE_OF_EDGE:
            break
        edge = (phases.place_px[:, axis] - place / EDGE_STEPS) % 1 - 0.5
        columns = np.concatenate([columns, edge[:, None]], axis=1)
    return columns[:, base.shape[1] :]


def phases_of(direction: FloatArray, axes: FloatArray, scale: Scale, name: str = "") -> Phases:
    """The phases of a direction (3,), ICRS."""
    seen = axes @ direction
    return Phases(name, scale.focal_px * seen[:, :2] / seen[:, 2:])


def global_phases(q_icrs_to_cam: FloatArray, axes: FloatArray, scale: Scale) -> Iterator[Phases]:
    """The phases that hold over the whole run, of attitudes (n, 4) with axes (n, 3, 3)."""
    mean = axes[:, 2].mean(axis=0)
    directions = [("the mean boresight", mean / max(float(np.linalg.norm(mean)), 1e-9))]
    directions += [("the first boresight", axes[0, 2]), ("the boresight in the middle of the run", axes[len(axes) // 2, 2])]
    for name, direction in directions:
        if (axes[:, 2] @ direction).min() > MIN_FORWARD:
            yield phases_of(direction, axes, scale, name)
    turn = to_rotation_vector(multiply(q_icrs_to_cam, conjugate(q_icrs_to_cam[0])))
    yield Phases("the turn from the start", scale.focal_px * np.stack([-turn[:, 1], turn[:, 0]], axis=1))
    yield Phases("the boresight's right ascension and declination", _on_the_sky(axes, scale))


def _on_the_sky(axes: FloatArray, scale: Scale) -> FloatArray:
    """Right ascension times the cosine of the mean declination, and declination, px (n, 2)."""
    boresight = axes[:, 2]
    ra = np.unwrap(np.arctan2(boresight[:, 1], boresight[:, 0]))
    dec = np.arcsin(np.clip(boresight[:, 2], -1, 1))
    return scale.focal_px * np.stack([(ra - ra[0]) * np.cos(dec.mean()), dec], axis=1)


def local_columns(q_icrs_to_cam: FloatArray, scale: Scale, spacing_px: float) -> sparse.csr_matrix:
    """Bumps times the harmonics of the phase of each bump's own direction: (n, 4 p)."""
    axes = axes_of(q_icrs_to_cam)
    place = places_of(axes, scale.focal_px, scale.roll_px)
    centre = centres_of(place, spacing_px)
    direction = centre[:, :3] / np.linalg.norm(centre[:, :3], axis=1, keepdims=True)
    i, j, value = weights_at(place, centre, spacing_px)
    seen = np.einsum("nij,nj->ni", axes[i], direction[j])
    phase = Phases("", scale.focal_px * seen[:, :2] / seen[:, 2:]).columns(LOCAL_HARMONICS)
    parts = [sparse.csr_matrix((value * column, (i, j)), shape=(len(place), len(centre))) for column in phase.T]
    return sparse.csr_matrix(sparse.hstack(parts))
