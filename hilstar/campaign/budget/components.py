"""What residuals consist of: field-of-view error, pixel error, and noise.

Of residuals e_i (3 axes, arcsec) about their mean, those that repeat with the star field's place in the field of view are
a sum of bumps F c (see `places`), those that repeat with its place within a pixel a sum of waves P d (see `phases`), fitted
by turns until both hold. Noise is the rest. With r what is left, and p_F, p_P the degrees of freedom of the fits,

    sigma^2 = |r|^2 / (n - 1 - p_F - p_P),    fov^2 = (|F c|^2 - p_F sigma^2) / n,    pixel^2 = (|P d|^2 - p_P sigma^2) / n:

a fit takes up its degrees of freedom's share of the noise, which is subtracted, so that none of the three depends on how many
functions were tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from hilstar.arrays import FloatArray
from hilstar.campaign.budget.phases import SHARP_HARMONICS, Phases, edges_of, global_phases, local_columns, phases_of
from hilstar.campaign.budget.places import Projector, axes_of, bumps_at, centres_of, places_of
from hilstar.campaign.budget.scale import Scale
from hilstar.campaign.budget.star_search import best_direction

MIN_ROWS = 30
FINEST_PX = 20.0  # between bumps: what repeats over four of them is met
MAX_BUMPS = 1500
ROWS_A_BUMP = 8
COARSEST_SHARE = 0.25  # of the detector's side
MIN_EXTENT_PX = 40.0
MIN_EXTENT_OF_PIXEL_PX = 2.0
LOCAL_SPACINGS_PX = (160.0, 80.0, 40.0, 20.0)
MAX_LOCAL = 3000
SOUGHT = "the phase of the direction that the error follows best"
SHARP = ", to its fifth harmonic"
EDGES = "jumps within a pixel"
SURE = 6.0  # standard deviations of what noise alone would explain
SURE_OF_MANY = 12.0  # of thousands of directions the best
APART = 0.5  # of the power of the waves that no bump explains, for pixel and field-of-view error to be told apart
HOPELESS = 0.5  # of the best: finer local waves explain no more then
TURNS = 3
LOCAL = "phases from place to place"
NOTHING = np.zeros(3)


@dataclass(frozen=True)
class Component:
    """A part of the error: its variance (3,), arcsec^2, what was fitted (n, 3) and what that took of the freedom.

    `reason` says why it cannot be told, and `detail` how it was found.
    """

    variance: FloatArray
    fitted: FloatArray
    freedom: float
    reason: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Components:
    """The parts of residuals (n, 3), arcsec: their mean, two that repeat, and noise (`variance` (3,), `left` (n, 3))."""

    mean: FloatArray
    fov: Component
    pixel: Component
    noise_variance: FloatArray
    left: FloatArray
    extent_px: float


def components_of(residual_arcsec: FloatArray, q_icrs_to_cam: FloatArray, scale: Scale) -> Components:
    """The parts of residuals (n, 3), cam, at the commanded attitudes (n, 4)."""
    mean = residual_arcsec.mean(axis=0)
    about = residual_arcsec - mean
    axes = axes_of(q_icrs_to_cam)
    place = places_of(axes, scale.focal_px, scale.roll_px)
    extent = float(np.linalg.norm(np.ptp(place, axis=0)))
    nothing = Component(NOTHING, np.zeros_like(about), 0.0)
    bumps, spacing, reason = _bumps(place, extent, scale)
    fov, waves, pixel = replace(nothing, reason=reason), None, nothing
    for turn in range(TURNS):
        if bumps is not None:
            fov = _component(bumps, about - pixel.fitted, pixel.freedom)
            fov = replace(fov, detail=f"what repeats over {4 * spacing:.0f} px or more of the field")
        if turn == 0:
            waves, pixel = _waves(about - fov.fitted, (q_icrs_to_cam, axes, scale), extent, bumps)
        if waves is None:
            break
        pixel = replace(_component(waves, about - fov.fitted, fov.freedom), detail=pixel.detail)
    left = about - fov.fitted - pixel.fitted
    noise = (left**2).sum(axis=0) / max(len(left) - 1 - fov.freedom - pixel.freedom, 1.0)
    return Components(mean, fov, pixel, noise, left, extent)


def _component(functions: Projector, wanted: FloatArray, other_freedom: float) -> Component:
    """The variance of what functions explain of (n, 3), less the noise in it."""
    n, fitted = len(wanted), functions.fit(wanted)
    noise = ((wanted - fitted) ** 2).sum(axis=0) / max(n - 1 - functions.freedom - other_freedom, 1.0)
    variance = ((fitted**2).sum(axis=0) - functions.freedom * noise) / n
    return Component(np.maximum(variance, 0.0), fitted, functions.freedom)


def _bumps(place: FloatArray, extent_px: float, scale: Scale) -> tuple[Projector | None, float, str]:
    """The finest bumps that the samples can tell apart, their spacing, or why there are none."""
    n = len(place)
    if extent_px < MIN_EXTENT_PX:
        return None, 0.0, f"the star field moved by {extent_px:.3g} px only: field-of-view error cannot be told from bias"
    spacing = FINEST_PX
    while spacing <= COARSEST_SHARE * min(scale.resolution_px):
        centre = centres_of(place, spacing)
        if 2 < len(centre) <= min(MAX_BUMPS, n // ROWS_A_BUMP):
            return Projector(bumps_at(place, centre, spacing).value), spacing, ""
        spacing *= 1.25
    return None, 0.0, "the attitudes are too far apart: field-of-view error cannot be told from noise"


def _waves(
    about: FloatArray, seen: tuple[FloatArray, FloatArray, Scale], extent_px: float, bumps: Projector | None
) -> tuple[Projector | None, Component]:
    """The waves that explain most of residuals (n, 3) for sure, or why none can be told."""
    none = Component(NOTHING, np.zeros_like(about), 0.0)
    if extent_px < MIN_EXTENT_OF_PIXEL_PX:
        reason = f"the star field moved by {extent_px:.3g} px only: pixel error cannot be told from bias"
        return None, replace(none, reason=reason)
    freedom = 0.0 if bumps is None else bumps.freedom
    best: tuple[float, Projector | None, Component, Phases | None] = (0.0, None, none, None)
    apart = 0.0 if bumps is not None else 1.0
    for name, columns, phases in _families(about, *seen):
        waves = Projector(columns)
        if bumps is not None and not name.startswith(LOCAL) and not name.endswith(SHARP):
            apart = max(apart, _apart(columns, bumps))
        if name.startswith(LOCAL) and columns.shape[1] > len(about) // ROWS_A_BUMP:
            break
        found = _component(waves, about, freedom)
        power = _surely(found, about, freedom, SURE_OF_MANY if name.startswith(SOUGHT) else SURE)
        if power > best[0]:
            best = (power, waves, replace(found, detail=name), phases)
        elif name.startswith(LOCAL) and power < HOPELESS * best[0]:
            break
    if apart < APART:
        reason = "each place within a pixel was seen at one place in the field only: pixel error cannot be told from it"
        return None, replace(none, reason=reason)
    _, chosen, found, phases = best
    if chosen is not None and phases is not None:
        return _with_edges(chosen, found, phases, about, freedom)
    return chosen, replace(found, detail=found.detail or "nothing repeats with the place within a pixel")


def _with_edges(
    waves: Projector, found: Component, phases: Phases, about: FloatArray, freedom: float
) -> tuple[Projector, Component]:
    """Waves, and the jumps that they leave, where there are any."""
    base = np.asarray(waves.value.todense())
    edges = edges_of(phases, base, about)
    if not edges.shape[1]:
        return waves, found
    both = Projector(sparse.csr_matrix(np.concatenate([base, edges], axis=1)))
    return both, replace(_component(both, about, freedom), detail=f"{found.detail}, with {edges.shape[1]} {EDGES}")


def _surely(found: Component, about: FloatArray, other_freedom: float, sure: float) -> float:
    """What is explained for sure beyond noise, in units of the noise's variance; 0 where noise alone may explain as much."""
    n, freedom = len(about), max(found.freedom, 1.0)
    noise = ((about - found.fitted) ** 2).sum(axis=0) / max(n - freedom - other_freedom, 1.0)
    excess = n * float((found.variance / np.maximum(noise, 1e-12)).sum())
    chance = float(np.sqrt(2 * 3 * freedom))
    if excess <= sure * chance:
        return 0.0
    return excess - 2 * float(np.sqrt(chance**2 + 4 * excess))


def _families(
    about: FloatArray, q_icrs_to_cam: FloatArray, axes: FloatArray, scale: Scale
) -> Iterator[tuple[str, sparse.csr_matrix, Phases | None]]:
    """What may repeat with the place within a pixel, by name: the same over the run, then from place to place, ever finer."""
    for each in global_phases(q_icrs_to_cam, axes, scale):
        yield from _with_sharp(f"the phase of {each.name}", each)
    direction = best_direction(about, axes, scale)
    if direction is not None:
        yield from _with_sharp(SOUGHT, phases_of(direction, axes, scale))
    for spacing in LOCAL_SPACINGS_PX:
        columns = local_columns(q_icrs_to_cam, scale, spacing)
        if columns.shape[1] > MAX_LOCAL:
            break
        yield f"{LOCAL}, {spacing:.0f} px apart", columns, None


def _with_sharp(name: str, phases: Phases) -> Iterator[tuple[str, sparse.csr_matrix, Phases]]:
    """Its smooth waves, and, of answers enough, those with the harmonics of an error that jumps from pixel to pixel."""
    yield name, sparse.csr_matrix(phases.columns()), phases
    if len(phases.place_px) >= 2 * len(SHARP_HARMONICS) * ROWS_A_BUMP:
        yield f"{name}{SHARP}", sparse.csr_matrix(phases.columns(SHARP_HARMONICS)), phases


def _apart(columns: sparse.csr_matrix, bumps: Projector) -> float:
    """The share of the power of some waves that no bump explains."""
    dense = np.asarray(columns.todense())
    dense = dense - dense.mean(axis=0)
    power = float((dense**2).sum())
    return float(((dense - bumps.fit(dense)) ** 2).sum()) / power if power > 0 else 0.0
