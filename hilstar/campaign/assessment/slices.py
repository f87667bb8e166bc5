"""The error by how fast the field moves, and by how bright it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import bench_stars
from hilstar.bench.cameras import tracker_camera
from hilstar.campaign.budget.places import axes_of
from hilstar.units import flux_ratio, magnitude

BINS, MIN_IN_BIN = 5, 20
FIELDS = 400  # attitudes at which the field's light is summed; answers between take the nearest one's


@dataclass(frozen=True, slots=True)
class Slice:
    """Answers between two values: their number, noise (one sigma) and whole error (rms about the bias), arcsec."""

    low: float
    high: float
    answers: int
    noise_cross_arcsec: float
    noise_roll_arcsec: float
    rms_cross_arcsec: float
    rms_roll_arcsec: float


def slices_of(value: FloatArray, left: FloatArray, error: FloatArray, freedom: float) -> tuple[Slice, ...]:
    """Up to five slices of equal numbers of answers by a value (n,), with noise (n, 3) and errors about the bias (n, 3).

    `freedom` is what the fits took of the answers'.
    """
    known = np.isfinite(value)
    value, left, error = value[known], left[known], error[known]
    count = len(value)
    if count < MIN_IN_BIN:
        return ()
    growth = len(known) / max(len(known) - freedom, 1.0)
    spread = float(np.ptp(value))
    bins = min(BINS, count // MIN_IN_BIN) if spread > 1e-3 * max(abs(float(np.median(value))), 1e-6) else 1
    edges = np.unique(np.quantile(value, np.linspace(0, 1, bins + 1)))
    if len(edges) < 2:
        edges = np.array([value.min(), value.max()])
    place = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    found = []
    for k in range(len(edges) - 1):
        rows = place == k
        if rows.sum() >= MIN_IN_BIN:
            noise, whole = growth * (left[rows] ** 2).mean(axis=0), (error[rows] ** 2).mean(axis=0)
            axes = [float(np.sqrt(part)) for each in (noise, whole) for part in ((each[0] + each[1]) / 2, each[2])]
            found.append(Slice(float(edges[k]), float(edges[k + 1]), int(rows.sum()), *axes))
    return tuple(found)


def field_magnitudes(file: BenchFile, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The V magnitude of all catalogued light in the field at attitudes (n, 4), sampled along them; NaN for no star.

    How well an attitude is known grows with the light of all stars together. Raises InputError for a catalogue that is wrong.
    """
    stars = bench_stars(file.config, file.folder)
    camera = tracker_camera(file.config.tracker, file.folder)
    width, height = camera.resolution_px
    some = np.unique(np.linspace(0, len(q_icrs_to_cam) - 1, FIELDS).astype(int))
    axes = axes_of(q_icrs_to_cam[some])
    reach = 2 * np.sin(min(camera.field_radius_rad(0.0), np.pi / 2) / 2)
    light = np.zeros(len(some))
    near: list[IntArray] = [
        np.array(each, dtype=np.intp) for each in cKDTree(stars.vectors).query_ball_point(axes[:, 2], reach)
    ]
    for k, each in enumerate(near):
        x_px, y_px = camera.project(stars.vectors[each] @ axes[k].T)
        inside = (x_px > -0.5) & (x_px < width - 0.5) & (y_px > -0.5) & (y_px < height - 0.5)
        light[k] = float(flux_ratio(stars.v_mag[each][inside]).sum())
    field = np.where(light > 0, magnitude(np.maximum(light, 1e-30)), np.nan)
    nearest = np.abs(np.searchsorted(some, np.arange(len(q_icrs_to_cam))).clip(0, len(some) - 1))
    return np.asarray(field[nearest])
