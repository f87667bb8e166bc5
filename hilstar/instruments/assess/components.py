"""The parts of residuals: field-of-view error, pixel error, and noise.

Of residuals e_i (3 axes, arcsec) about their mean, the part that repeats with the star field's
place in the field of view is a sum of bumps F c (see `places`). The part that repeats with its
place within a pixel is a sum of waves P d. Both are fitted in turns until they hold, and the rest
is noise. With r the rest, and p_F, p_P the degrees of freedom of the fits,

    sigma^2 = |r|^2 / (n - 1 - p_F - p_P),
    fov^2 = (|F c|^2 - p_F sigma^2) / n,    pixel^2 = (|P d|^2 - p_P sigma^2) / n:

a fit takes up its degrees of freedom's share of the noise. That share is subtracted, so that none
of the three depends on how many functions were tried.

**Waves.** A star of direction r is at f (R r)_x / (R r)_z on the detector, px from its middle. All
stars near it move alike, so one direction gives the phase of the field, as far as the camera does
not roll. Two families of functions are tried, and the one that explains more for its degrees of
freedom is kept. The first is the harmonics of one direction's phase, the same over the whole run.
Directions tried are the boresight at the start, in the middle and on average, the turn from the
start as angles, and one that is searched for. The second is the harmonics of the phase of each
place's own direction, with amplitudes that change from place to place, as they do where stars enter
and leave the field.

**Search for the direction.** The phase of one direction makes a wave; that of another direction,
eta px away, has another frequency as soon as the camera rolls. So short stretches of the run, in
which the roll changes little, are correlated with the waves of a coarse grid of directions, and
their powers are added. Grid and stretches are then refined by halves, until the whole run is one
stretch.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import conjugate, multiply, normalise, to_matrix, to_rotation_vector
from hilstar.instruments.assess.places import (
    Projector,
    Scale,
    bumps_at,
    centres_of,
    places_of,
    spread_rows,
)

MIN_ROWS = 30
TURNS = 3  # fits of bumps and waves by turns
SURE = 6.0  # standard deviations above what noise alone would explain
SURE_OF_MANY = 12.0  # the same for the best of thousands of directions
ROWS_A_BUMP = 8
NOTHING = np.zeros(3)
# Bumps.
FINEST_PX = 20.0  # between bumps: what repeats over four of them is fitted
COARSEST_SHARE = 0.25  # largest spacing, in sides of the detector
MAX_BUMPS = 1500
MIN_EXTENT_PX = 40.0
# Waves.
Harmonics = tuple[tuple[int, int], ...]  # cycles per pixel along x and y
HARMONICS: Harmonics = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2))
# 89 % of a saw's power; two harmonics have 76 %
SHARP_HARMONICS: Harmonics = (*HARMONICS, (3, 0), (0, 3), (4, 0), (0, 4), (5, 0), (0, 5))
LOCAL_HARMONICS = ((1, 0), (0, 1))
LOCAL_SPACINGS_PX = (160.0, 80.0, 40.0, 20.0)
MAX_LOCAL = 3000
MIN_EXTENT_OF_PIXEL_PX = 2.0
# share of the waves' power that bumps must not explain, for pixel and field-of-view error to be
# told apart
APART = 0.5
HOPELESS = 0.5  # local waves below this share of the best are not refined
SOUGHT = "the phase of the direction that the error follows best"
SHARP = ", to its fifth harmonic"
EDGES = "jumps within a pixel"
LOCAL = "phases from place to place"
MAX_EDGES = 12
EDGE_STEPS = 1024  # places within a pixel at which an edge is tried
# Power that an edge must explain, in units of the noise's variance: the best of all places
# explained 33 in 300 runs of noise.
SURE_OF_EDGE = 50.0
# Search for a direction.
MIN_FORWARD = 0.3  # smallest component along the boresight, for a place on the detector's plane
GRID = 40  # directions along each side
KEPT = 4  # directions kept from one grid to the next
LEVELS, FOUND_TO_PX = 14, 0.02  # the search ends after so many grids, or at this spacing
PHASE_CYCLES = 0.25  # largest change of phase in a stretch, at the edge of a grid's cell
MIN_STRETCH, MAX_STRETCH = 16, 256  # answers
COARSE_ANSWERS, FINE_ANSWERS = 3000, 8000  # answers used, spread over the run


@dataclass(frozen=True)
class Component:
    """A part of the error: its variance (3,), arcsec^2, the fit (n, 3), arcsec, and the fit's
    degrees of freedom.

    `reason` says why the part cannot be told, `detail` how it was found.
    """

    variance: FloatArray
    fitted: FloatArray
    freedom: float
    reason: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Components:
    """The parts of residuals (n, 3), arcsec: mean (3,), two parts that repeat, noise variance
    (3,), the rest `left` (n, 3); `bumps` are the functions that fitted the first.
    """

    mean: FloatArray
    fov: Component
    pixel: Component
    noise_variance: FloatArray
    left: FloatArray
    extent_px: float
    bumps: Projector | None = None


def components_of(
    residual_arcsec: FloatArray, q_icrs_to_cam: FloatArray, scale: Scale
) -> Components:
    """The parts of residuals (n, 3), cam, at the commanded attitudes (n, 4)."""
    mean = residual_arcsec.mean(axis=0)
    about = residual_arcsec - mean
    place = places_of(to_matrix(q_icrs_to_cam), scale.focal_px, scale.roll_px)
    extent = float(np.linalg.norm(np.ptp(place, axis=0)))
    bumps, bumps_note = _bumps(place, extent, scale)
    pixel = Component(NOTHING, np.zeros_like(about), 0.0)
    waves = None
    if bumps is not None:
        fov = pixel
    else:
        fov = replace(pixel, reason=bumps_note)
    for turn in range(TURNS):
        if bumps is not None:
            fov = _component(bumps, about - pixel.fitted, pixel.freedom)
            fov = replace(fov, detail=bumps_note)
        without_fov = about - fov.fitted
        if turn == 0:
            waves, pixel = _waves(without_fov, q_icrs_to_cam, scale, extent, bumps)
        if waves is None:
            break
        fit = _component(waves, without_fov, fov.freedom)
        pixel = replace(fit, detail=pixel.detail)
    residual = about - fov.fitted - pixel.fitted
    freedom = len(residual) - 1 - fov.freedom - pixel.freedom
    noise = (residual**2).sum(axis=0) / max(freedom, 1.0)
    return Components(mean, fov, pixel, noise, residual, extent, bumps)


def _component(functions: Projector, wanted: FloatArray, other_freedom: float) -> Component:
    """The fit of functions to (n, 3), and its variance less the noise in it."""
    n = len(wanted)
    fitted = functions.fit(wanted)
    freedom = functions.freedom
    free_rows = n - 1 - freedom - other_freedom
    noise = ((wanted - fitted) ** 2).sum(axis=0) / max(free_rows, 1.0)
    variance = ((fitted**2).sum(axis=0) - freedom * noise) / n
    return Component(np.maximum(variance, 0.0), fitted, freedom)


def _bumps(place: FloatArray, extent_px: float, scale: Scale) -> tuple[Projector | None, str]:
    """The finest bumps that the samples can tell apart and how they are spaced, or None and the
    reason.
    """
    n = len(place)
    if extent_px < MIN_EXTENT_PX:
        moved = f"the star field moved by {extent_px:.3g} px only"
        return None, f"{moved}: field-of-view error cannot be told from bias"
    spacing = FINEST_PX
    while spacing <= COARSEST_SHARE * min(scale.resolution_px):
        centre = centres_of(place, spacing)
        if 2 < len(centre) <= min(MAX_BUMPS, n // ROWS_A_BUMP):
            detail = f"what repeats over {4 * spacing:.0f} px or more of the field"
            return Projector(bumps_at(place, centre, spacing)), detail
        spacing *= 1.25
    return None, "the attitudes are too far apart: field-of-view error cannot be told from noise"


def _waves(
    about: FloatArray,
    q_icrs_to_cam: FloatArray,
    scale: Scale,
    extent_px: float,
    bumps: Projector | None,
) -> tuple[Projector | None, Component]:
    """The waves that explain most of residuals (n, 3) beyond noise, or the reason why none can
    be told.
    """
    none = Component(NOTHING, np.zeros_like(about), 0.0)
    if extent_px < MIN_EXTENT_OF_PIXEL_PX:
        reason = (
            f"the star field moved by {extent_px:.3g} px only: pixel error cannot be told from bias"
        )
        return None, replace(none, reason=reason)
    tried = list(global_phases(about, q_icrs_to_cam, scale))
    freedom = 0.0
    if bumps is not None:
        freedom = bumps.freedom
        largest_share = max(_apart(phases.columns(), bumps) for phases in tried)
        if largest_share < APART:
            reason = (
                "each place within a pixel was seen at one place in the field only: pixel error"
                " cannot be told from it"
            )
            return None, replace(none, reason=reason)
    waves, component, best = _best_of(tried, about, freedom)
    power = _surely(component, about, freedom, 0.0)
    for spacing in LOCAL_SPACINGS_PX:
        columns = local_columns(q_icrs_to_cam, scale, spacing)
        if columns.shape[1] > min(MAX_LOCAL, len(about) // ROWS_A_BUMP):
            break
        local = Projector(columns)
        fit = _component(local, about, freedom)
        fit = replace(fit, detail=f"{LOCAL}, {spacing:.0f} px apart")
        explained = _surely(fit, about, freedom, SURE)
        if explained > power:
            power = explained
            waves = local
            component = fit
            best = None
        elif explained < HOPELESS * power:
            break
    if waves is None:
        return None, replace(none, detail="nothing repeats with the place within a pixel")
    if best is None:
        return waves, component
    return _with_edges(best, waves, component, about, freedom)


def _with_edges(
    phases: "Phases", waves: Projector, component: Component, about: FloatArray, freedom: float
) -> tuple[Projector, Component]:
    """The waves with the jumps within a pixel that they leave unexplained."""
    base = np.asarray(waves.value.todense())
    edges = edges_of(phases, base, about)
    edge_count = edges.shape[1]
    if not edge_count:
        return waves, component
    columns = np.concatenate([base, edges], axis=1)
    with_edges = Projector(sparse.csr_matrix(columns))
    detail = f"{component.detail}, with {edge_count} {EDGES}"
    return with_edges, replace(_component(with_edges, about, freedom), detail=detail)


def _best_of(
    tried: "list[Phases]", about: FloatArray, freedom: float
) -> "tuple[Projector | None, Component, Phases | None]":
    """Of the waves of one direction those that explain most of residuals (n, 3) beyond noise;
    None where none does.
    """
    power = 0.0
    waves = None
    best = None
    component = Component(NOTHING, np.zeros_like(about), 0.0)
    # With answers enough those of an error that jumps from pixel to pixel are tried as well.
    kinds = [(HARMONICS, "")]
    if len(about) >= 2 * len(SHARP_HARMONICS) * ROWS_A_BUMP:
        kinds.append((SHARP_HARMONICS, SHARP))
    for phases in tried:
        sure = SURE
        if phases.name == SOUGHT:
            sure = SURE_OF_MANY
        for harmonics, sharp in kinds:
            columns = phases.columns(harmonics)
            functions = Projector(sparse.csr_matrix(columns))
            fit = _component(functions, about, freedom)
            fit = replace(fit, detail=f"{phases.name}{sharp}")
            explained = _surely(fit, about, freedom, sure)
            if explained > power:
                power = explained
                waves = functions
                component = fit
                best = phases
    return waves, component, best


def _apart(columns: FloatArray, bumps: Projector) -> float:
    """The share of the power of some waves that no bump explains."""
    columns = columns - columns.mean(axis=0)
    power = float((columns**2).sum())
    if power > 0:
        rest = columns - bumps.fit(columns)
        return float((rest**2).sum()) / power
    return 0.0


def _surely(found: Component, about: FloatArray, other_freedom: float, sure: float) -> float:
    """The power explained beyond noise, in units of the noise's variance; 0 where noise alone
    may explain as much.
    """
    n = len(about)
    freedom = max(found.freedom, 1.0)
    free_rows = n - freedom - other_freedom
    noise = ((about - found.fitted) ** 2).sum(axis=0) / max(free_rows, 1.0)
    variance_to_noise = found.variance / np.maximum(noise, 1e-12)
    excess = n * float(variance_to_noise.sum())
    chance = float(np.sqrt(2 * 3 * freedom))
    if excess <= sure * chance:
        return 0.0
    return excess - 2 * float(np.sqrt(chance**2 + 4 * excess))


@dataclass(frozen=True)
class Phases:
    """The place (n, 2), px, of a direction that stands for the field's place within a pixel, and
    its name in words.
    """

    name: str
    place_px: FloatArray

    def columns(self, harmonics: Harmonics = HARMONICS) -> FloatArray:
        """Cosines and sines (n, 2 k) of the harmonics."""
        angle = 2 * np.pi * (self.place_px @ np.array(harmonics, dtype=float).T)
        return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def edges_of(phases: Phases, base: FloatArray, about: FloatArray) -> FloatArray:
    """Saws (n, m) of the place within a pixel that explain most of residuals (n, 3) beyond a base
    (n, k) of harmonics.

    They are added one after another (orthogonal matching pursuit: Pati et al. 1993) while each is
    above SURE_OF_EDGE. A jump is a saw and something smooth, so a few saws and harmonics make any
    function that is smooth but for a few jumps.
    """
    columns = base
    n = len(about)
    saw = (np.arange(EDGE_STEPS) + 0.5) / EDGE_STEPS - 0.5
    spectrum = np.fft.rfft(saw)
    harmonics = HARMONICS
    if base.shape[1] == 2 * len(SHARP_HARMONICS):
        harmonics = SHARP_HARMONICS
    highest, _ = max(harmonics)
    spectrum[: highest + 1] = 0.0  # these are in the base
    sharp_saw = np.fft.irfft(spectrum, EDGE_STEPS)
    power = float((sharp_saw**2).mean())
    bin_of = []
    for u in phases.place_px.T:
        bins = (EDGE_STEPS * (u % 1)).astype(np.int64)
        bin_of.append(np.minimum(bins, EDGE_STEPS - 1))
    for _ in range(MAX_EDGES):
        coefficients, *_ = np.linalg.lstsq(columns, about, rcond=None)
        rest = about - columns @ coefficients
        standardised = rest / np.maximum(rest.std(axis=0), 1e-12)
        best = (SURE_OF_EDGE, 0, 0)
        for axis, bins in enumerate(bin_of):
            sums = []
            for value in standardised.T:
                sums.append(np.bincount(bins, value, minlength=EDGE_STEPS))
            product = np.fft.rfft(np.stack(sums)) * np.conj(spectrum)
            met = np.fft.irfft(product, EDGE_STEPS)
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
    direction_in_cam = axes @ direction
    place_px = scale.focal_px * direction_in_cam[:, :2] / direction_in_cam[:, 2:]
    return Phases(name, place_px)


def global_phases(about: FloatArray, q_icrs_to_cam: FloatArray, scale: Scale) -> Iterator[Phases]:
    """The phases tried for the whole run, of attitudes (n, 4) with residuals (n, 3)."""
    axes = to_matrix(q_icrs_to_cam)
    boresight = axes[:, 2]
    mean = boresight.mean(axis=0)
    for name, direction in (
        ("the phase of the mean boresight", mean / max(float(np.linalg.norm(mean)), 1e-9)),
        ("the phase of the first boresight", boresight[0]),
        ("the phase of the boresight in the middle of the run", boresight[len(boresight) // 2]),
    ):
        if (boresight @ direction).min() > MIN_FORWARD:
            yield phases_of(direction, axes, scale, name)
    from_start = multiply(q_icrs_to_cam, conjugate(q_icrs_to_cam[0]))
    turn = to_rotation_vector(from_start)
    turned_px = scale.focal_px * np.stack([-turn[:, 1], turn[:, 0]], axis=1)
    yield Phases("the phase of the turn from the start", turned_px)
    # Right ascension times the cosine of the mean declination, and declination.
    ra = np.unwrap(np.arctan2(boresight[:, 1], boresight[:, 0]))
    dec = np.arcsin(np.clip(boresight[:, 2], -1, 1))
    along_ra = (ra - ra[0]) * np.cos(dec.mean())
    place_px = scale.focal_px * np.stack([along_ra, dec], axis=1)
    yield Phases("the phase of the boresight's right ascension and declination", place_px)
    direction = best_direction(about, axes, scale)
    if direction is not None:
        yield phases_of(direction, axes, scale, SOUGHT)


def local_columns(q_icrs_to_cam: FloatArray, scale: Scale, spacing_px: float) -> sparse.csr_matrix:
    """Each bump times the harmonics of the phase of its own direction: (n, 4 p)."""
    axes = to_matrix(q_icrs_to_cam)
    place = places_of(axes, scale.focal_px, scale.roll_px)
    centre = centres_of(place, spacing_px)
    direction = centre[:, :3] / np.linalg.norm(centre[:, :3], axis=1, keepdims=True)
    near = bumps_at(place, centre, spacing_px).tocoo()
    direction_in_cam = np.einsum("nij,nj->ni", axes[near.row], direction[near.col])
    place_px = scale.focal_px * direction_in_cam[:, :2] / direction_in_cam[:, 2:]
    waves = Phases("", place_px).columns(LOCAL_HARMONICS)
    indices = (near.row, near.col)
    parts = []
    for column in waves.T:
        entries = (near.data * column, indices)
        parts.append(sparse.csr_matrix(entries, shape=near.shape))
    return sparse.csr_matrix(sparse.hstack(parts))


def best_direction(
    residual_arcsec: FloatArray, axes: FloatArray, scale: Scale
) -> FloatArray | None:
    """The direction (3,), ICRS, whose waves explain most of residuals (n, 3); None if the
    boresights share no half sky.
    """
    boresight = axes[:, 2]
    mean = boresight.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if size < MIN_FORWARD or (boresight @ mean).min() < 2 * MIN_FORWARD * size:
        return None
    # Directions are points (k, 2) in the tangent plane of the mean boresight.
    z = mean / size
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(z, x), z])
    in_frame = boresight @ frame.T
    trace = in_frame[:, :2] / in_frame[:, 2:]
    margin = 0.5 * max(scale.resolution_px) / scale.focal_px
    low = trace.min(axis=0) - margin
    high = trace.max(axis=0) + margin
    step = (high - low) / (GRID - 1)
    along_x = np.linspace(low[0], high[0], GRID)
    along_y = np.linspace(low[1], high[1], GRID)
    best = np.stack(np.meshgrid(along_x, along_y), axis=-1).reshape(-1, 2)
    neighbours = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2)
    value = residual_arcsec / np.maximum(residual_arcsec.std(axis=0), 1e-9)
    steps = axes[1:] @ np.swapaxes(axes[:-1], 1, 2)
    roll_rad = np.concatenate([[0.0], np.cumsum(np.abs(steps[:, 0, 1]))])
    for level in range(LEVELS):
        answers = COARSE_ANSWERS
        if level:
            answers = FINE_ANSWERS
        cell_px = float(np.max(step)) * scale.focal_px
        start, rows = _stretches(roll_rad, cell_px, answers)
        directions = normalise(np.c_[best, np.ones(len(best))] @ frame)
        score = _wave_power(value[rows], axes[rows], directions, scale, start)
        best = best[np.argsort(-score)]
        if level < LEVELS - 1:
            best = best[:KEPT]
        else:
            best = best[:1]
        if cell_px < FOUND_TO_PX:
            break
        step = step / 2
        best = (best[:, None] + neighbours * step).reshape(-1, 2)
    return normalise(np.append(best[0], 1.0) @ frame)


def _wave_power(
    value: FloatArray, axes: FloatArray, directions: FloatArray, scale: Scale, start: IntArray
) -> FloatArray:
    """The power (k,) of each direction's waves in values (n, 3), summed over stretches that
    begin at `start` (m,).
    """
    power = np.zeros(len(directions))
    # Components lie one after the other, each of all rows: products and sums of 3000 rows take a
    # quarter less. Phases are taken to within a turn in double precision, and waves in single: a
    # power is 1e-7 off, and a direction takes a fifth of the time.
    value = np.ascontiguousarray(value.T, dtype=np.float32)
    waves = np.empty((4, len(axes)), dtype=np.float32)
    axes = axes.reshape(-1, 3)
    for k, direction in enumerate(directions):
        direction_in_cam = (axes @ direction).reshape(-1, 3).T
        turns = scale.focal_px * (direction_in_cam[:2] / direction_in_cam[2])
        turns -= np.rint(turns)
        angle = (2 * np.pi * turns).astype(np.float32)
        np.cos(angle, out=waves[:2])
        np.sin(angle, out=waves[2:])
        sums = np.add.reduceat(value[:, None] * waves, start, axis=-1, dtype=np.float64)
        power[k] = float((sums**2).sum())
    return power


def _stretches(roll_rad: FloatArray, cell_px: float, answers: int) -> tuple[IntArray, IntArray]:
    """Stretches whose phase holds over a cell, spread over the run with about so many answers
    together.

    Their first answers (m,) among the rows (n,) that they have.
    """
    total = len(roll_rad)
    by_roll = np.floor(roll_rad / (PHASE_CYCLES / cell_px)).astype(np.int64)
    longest = MAX_STRETCH
    if cell_px < 1:
        longest = total
    by_count = np.arange(total) // longest
    changes = np.diff(by_roll, prepend=-1) | np.diff(by_count, prepend=-1)
    borders = [0]
    for border in np.flatnonzero(changes)[1:].tolist():
        if border - borders[-1] >= MIN_STRETCH:
            borders.append(border)
    start = np.array(borders)
    if answers >= total:
        return start, np.arange(total)
    end = np.append(start[1:], total)
    stretches = len(start)
    some = max(4, round(stretches * answers / total))
    chosen = spread_rows(stretches, some)
    rows = np.concatenate([np.arange(start[k], end[k]) for k in chosen])
    counts = (end - start)[chosen]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return first, rows
