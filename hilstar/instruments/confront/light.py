"""The light of photographs: zero point, colour, vignetting and linearity by stars; gain, pedestal
and noise by pixels.

Magnitudes are compared with what hilstar computes of each star's spectrum through the tracker's
curves. A residual is a star's instrument magnitude less the fitted one: positive where the
photograph has less light.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA, flux_ratio
from hilstar.instruments.confront.star_psf import MEAN_BV_MAG

MAG = 2.5 / math.log(10)
# A quantum efficiency is corrected by exp(tilt x + bow x^2), x = ln(wavelength / 550 nm): the
# largest of both, the stars that each takes, and the spread of B-V that they need.
MAX_CORRECTION, STARS_FOR_CORRECTION, MIN_COLOURS_MAG = np.array([10.0, 30.0]), (15, 30), 0.2
CORRECTION_PRIOR = np.array([3.0, 10.0])
CORRECTION_ROUNDS, CORRECTION_STEP, CORRECTION_FLOOR_MAG, CORRECTION_HUBER = 8, 0.05, 0.05, 1.5
# of a step, the largest that lessens the loss; and by how much less a further step has to make it
CORRECTION_SHARES, CORRECTION_GAIN = (1.0, 0.4, 0.15, 0.05), 0.01
NO_CORRECTION = (0.0, 0.0)
FOLDS, GAIN = 5, 0.985
BRIGHT_V_MAG = 6.5  # to which rms errors are stated
TRUSTED_SNR = 20.0
PATTERN_CLIP, ROUNDS = 3.5, 8
MIN_STARS = 8
# air masses that tell extinction, and by how much skies differ beside it
MIN_MASSES, CLOUD_MAG = 0.3, 0.01


# by how much a power differs from 1 where a tone curve is stated
LINEAR_OFF, LINEAR_SIGMAS = 0.04, 4.0

Correction = tuple[float, float]
Magnitudes = Callable[[Correction], FloatArray]


@dataclass(frozen=True, slots=True)
class StarLight:
    """Stars (n,) of all photographs: which one, flux with one sigma, DN, V, B-V, the square of the
    radius, and whether clean.

    The radius is in half diagonals from the principal point. `plane` is 1, 2, 3 for red, green and
    blue of a mosaic, else 0.
    """

    image: IntArray
    dn: FloatArray
    sigma_dn: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    radius2: FloatArray
    clean: BoolArray
    plane: IntArray

    @property
    def instrument_mag(self) -> FloatArray:
        """-2.5 log10 of DN."""
        return np.asarray(-2.5 * np.log10(np.maximum(self.dn, 1e-9)))

    @property
    def sigma_mag(self) -> FloatArray:
        """One sigma of it by noise."""
        return np.asarray(MAG * self.sigma_dn / np.maximum(self.dn, 1e-9))


@dataclass(frozen=True, slots=True)
class LightFit:
    """Zero points (images,) of DN, mag, about the tracker's own magnitudes, vignetting (mag at r^2,
    r^4 = 1).

    `correction` is that of the quantum efficiency: tilt and bow. `zero_point_mag` and `colour_term`
    are
    about Johnson V: -2.5 log10(DN) = V + colour_term (B-V) - zero point. DN go as light to the
    power `linearity`. `sigma` has one sigma of figures by name. `mag` (n,) is what each star should
    have, without the photograph's offset. `masses` are each photograph's air masses where known,
    and `extinction_mag` what offsets grow by with one, beyond the site's own table. `colours`
    (images,) are what a plane of a mosaic adds, mag a magnitude of B-V, and `colour_terms` those of
    planes about V.
    """

    offsets_mag: FloatArray
    vignetting_mag: tuple[float, float]
    correction: Correction
    zero_point_mag: float
    colour_term: float
    linearity: float
    sigma: dict[str, float] = field(default_factory=dict)
    mag: FloatArray = field(default_factory=lambda: np.empty(0))
    masses: tuple[float | None, ...] = ()
    extinction_mag: float | None = None
    colours: FloatArray = field(default_factory=lambda: np.zeros(1))
    colour_terms: dict[str, float] = field(default_factory=dict)

    @property
    def is_linear(self) -> bool:
        """Whether DN go as light, to within what a tone curve is stated from on."""
        limit = max(LINEAR_OFF, LINEAR_SIGMAS * self.sigma["linearity"])
        return abs(self.linearity - 1) <= limit

    def illumination(self, radius2: FloatArray) -> FloatArray:
        """Light relative to the axis at squares of radii."""
        a, b = self.vignetting_mag
        return np.asarray(flux_ratio(a * radius2 + b * radius2**2))

    def shares(self, offset_mag: float | None = None) -> FloatArray:
        """Light of each photograph (images,) relative to one of an offset, by default to one of the
        mean offset.
        """
        if offset_mag is None:
            offset_mag = float(self.offsets_mag.mean())
        return np.asarray(flux_ratio(self.offsets_mag - offset_mag))


def join_light(parts: Sequence[StarLight]) -> StarLight:
    """The stars of several photographs in one row of each quantity."""
    columns = []
    for quantity in fields(StarLight):
        columns.append(np.concatenate([getattr(part, quantity.name) for part in parts]))
    return StarLight(*columns)


def fit_light(
    stars: StarLight, images: int, magnitudes: Magnitudes, held: LightFit | None = None
) -> LightFit:
    """The light of stars; `magnitudes` are theirs (n,) through a quantum efficiency of a tilt.

    With `held` the camera is that one's, and each photograph's offset (the air, the exposure) alone
    is fitted.
    """
    if held is not None:
        return _offsets_alone(stars, images, magnitudes(NO_CORRECTION), held)
    ones = np.eye(images)[stars.image]
    use = _trusted(stars, ones)
    correction = _correction(stars, magnitudes, np.column_stack([ones, stars.radius2]), use)
    base = magnitudes(correction)
    off_mag = stars.instrument_mag - base
    vignetting = _vignetting(stars, ones, off_mag, use)
    # a mosaic's planes have a colour each beside the one quantum efficiency
    bv_mag = np.nan_to_num(stars.bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG
    planes = np.unique(stars.plane)
    colour_columns = []
    if len(planes) > 1:
        colour_columns = [bv_mag * (stars.plane == plane) for plane in planes]
    design = np.column_stack([ones, *vignetting, *colour_columns])
    solution = _robust(design, off_mag, stars.sigma_mag, use)
    offsets_mag = solution.values[:images]
    first_colour = images + len(vignetting)
    r2_mag, r4_mag = (*solution.values[images:first_colour].tolist(), 0.0, 0.0)[:2]
    colours = np.zeros(images)
    colour_terms = {}
    for k in range(len(colour_columns)):
        plane = planes[k]
        in_plane = stars.plane == plane
        colours[np.unique(stars.image[in_plane])] = solution.values[first_colour + k]
        plane_use = use & in_plane
        plane_ones = ones[:, ones[plane_use].any(axis=0)]
        about_v = _about_v(stars, base, plane_use, plane_ones, ())
        colour_terms[" rgb"[plane]] = float(about_v.values[1])
    about_v = _about_v(stars, base, use, ones, vignetting)
    zero_points = slice(2, 2 + images)
    sigma = {
        "linearity": about_v.sigma[0],
        "colour_term": about_v.sigma[1],
        "zero_point_mag": float(about_v.sigma[zero_points].mean()),
    }
    mag = base + solution.model - ones @ offsets_mag
    return LightFit(
        offsets_mag=offsets_mag,
        vignetting_mag=(r2_mag, r4_mag),
        correction=correction,
        zero_point_mag=-float(about_v.values[zero_points].mean()),
        colour_term=float(about_v.values[1]),
        linearity=float(about_v.values[0]),
        sigma=sigma,
        mag=mag,
        colours=colours,
        colour_terms=colour_terms,
    )


def _vignetting(
    stars: StarLight, ones: FloatArray, off_mag: FloatArray, use: BoolArray
) -> list[FloatArray]:
    """Columns (n,) of the vignetting that held-out stars ask for: none, r^2, or r^2 and r^4."""
    choices: list[list[FloatArray]] = [[]]
    if use.sum() >= MIN_STARS + ones.shape[1]:
        r2 = stars.radius2
        choices += [[r2], [r2, r2**2]]
    chosen = choices[0]
    best = math.inf
    for columns in choices:
        design = np.column_stack([ones, *columns])
        held_out_mag = _held_out(design, off_mag, stars.sigma_mag, use)
        if held_out_mag < GAIN * best:
            best = held_out_mag
            chosen = columns
    return chosen


def with_extinction(
    light: LightFit, stars: StarLight, masses: Sequence[float | None], *, known: bool
) -> LightFit:
    """The light with the slope of the photographs' offsets over their air masses, where these span
    MIN_MASSES.

    A photograph's offset counts by its stars' scatter and by CLOUD_MAG, by which skies differ. With
    a `known` extinction the slope is what is left of it.
    """
    known_masses = replace(light, masses=tuple(masses))
    x = np.array([math.nan if mass is None else mass for mass in masses])
    if not np.isfinite(x).all() or len(x) < 3 or np.ptp(x) < MIN_MASSES:
        return known_masses
    off_mag = light.offsets_mag[stars.image] + light.mag - stars.instrument_mag
    count = np.bincount(stars.image[stars.clean], minlength=len(x))
    spread_mag = MAD_TO_SIGMA * float(np.median(np.abs(off_mag[stars.clean])))
    error_mag = spread_mag / np.sqrt(np.maximum(count, 1))
    sigma_mag = np.hypot(error_mag, CLOUD_MAG)
    design = np.column_stack([x, np.ones(len(x))]) / sigma_mag[:, None]
    slope, _ = np.linalg.lstsq(design, light.offsets_mag / sigma_mag, rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design)
    if known:
        name = "extinction_beyond_table_mag_per_air_mass"
    else:
        name = "extinction_mag_per_air_mass"
    slope_sigma = math.sqrt(float(covariance[0, 0]))
    sigma = light.sigma | {name: slope_sigma}
    return replace(known_masses, extinction_mag=float(slope), sigma=sigma)


def _trusted(stars: StarLight, ones: FloatArray) -> BoolArray:
    """Clean stars that should have TRUSTED_SNR by their V: of fainter ones only those are found
    that came out bright.
    """
    clean = stars.clean & (stars.dn > 0)
    bright = clean & (stars.dn > TRUSTED_SNR * stars.sigma_dn)
    if not bright.any():
        return clean
    zero_points = _robust(ones, stars.instrument_mag - stars.v_mag, stars.sigma_mag, bright)
    expected_dn = flux_ratio(stars.v_mag + ones @ zero_points.values)
    minimum_dn = TRUSTED_SNR * np.median(stars.sigma_dn[bright])
    is_trusted = clean & (expected_dn > minimum_dn)
    if is_trusted.sum() >= MIN_STARS:
        return is_trusted
    return clean


@dataclass(frozen=True, slots=True)
class _CorrectionLoss:
    """The loss of a correction: its value, residuals (n,) in sigmas, and their weights."""

    value: float
    off: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class _CorrectionFit:
    """What a correction is fitted to: `target` (n,) magnitudes of the used stars with one sigma,
    `plain` columns (n, k) that are fitted beside it, and how many of tilt and bow are free.

    `magnitudes` gives those of the used stars with a correction.
    """

    target: FloatArray
    sigma: FloatArray
    plain: FloatArray
    magnitudes: Magnitudes
    free: int

    def loss(self, values: FloatArray) -> _CorrectionLoss:
        """Huber's loss and a weak prior, with the plain columns' coefficients following."""
        off = self.target - self.magnitudes(_pair(values))
        weights = np.ones(len(self.target))
        for _ in range(CORRECTION_ROUNDS):
            root = np.sqrt(weights)
            design = self.plain * (root / self.sigma)[:, None]
            coefficients = np.linalg.lstsq(design, off * root / self.sigma, rcond=None)[0]
            residual = (off - self.plain @ coefficients) / self.sigma
            size = np.maximum(np.abs(residual), CORRECTION_HUBER)
            weights = np.minimum(1.0, CORRECTION_HUBER / size)
        size = np.abs(residual)
        linear = CORRECTION_HUBER * (size - CORRECTION_HUBER / 2)
        huber = np.where(size < CORRECTION_HUBER, size**2 / 2, linear)
        prior = ((values / CORRECTION_PRIOR) ** 2).sum() / 2
        return _CorrectionLoss(float(huber.sum() + prior), residual, weights)

    def step(self, values: FloatArray, loss: _CorrectionLoss) -> FloatArray:
        """A Gauss-Newton step of tilt and bow (2,), by differences."""
        free = self.free
        columns = self.plain.shape[1]
        base = self.magnitudes(_pair(values))
        slopes = [*self.plain.T]
        for difference in CORRECTION_STEP * np.eye(2)[:free]:
            moved = self.magnitudes(_pair(values + difference))
            slopes.append((moved - base) / CORRECTION_STEP)
        design = np.column_stack(slopes) / self.sigma[:, None]
        prior = np.zeros(design.shape[1])
        prior[columns:] = 1 / CORRECTION_PRIOR[:free] ** 2
        downhill = design.T @ (loss.weight * loss.off)
        downhill[columns:] -= values[:free] * prior[columns:]
        normal = design.T @ (loss.weight[:, None] * design)
        step = np.zeros(2)
        step[:free] = np.linalg.solve(normal + np.diag(prior + 1e-9), downhill)[columns:]
        return step


def _correction(
    stars: StarLight, magnitudes: Magnitudes, plain: FloatArray, use: BoolArray
) -> Correction:
    """Tilt and bow of the quantum efficiency by which stars of all colours fit best; beside them
    the `plain` columns are fitted.
    """
    columns = plain.shape[1]
    free = sum(int(use.sum()) >= stars_for + columns for stars_for in STARS_FOR_CORRECTION)
    if not free or np.std(np.nan_to_num(stars.bv_mag[use])) < MIN_COLOURS_MAG:
        return NO_CORRECTION
    sigma = np.hypot(stars.sigma_mag, CORRECTION_FLOOR_MAG)[use]

    def used_magnitudes(correction: Correction) -> FloatArray:
        return magnitudes(correction)[use]

    fit = _CorrectionFit(stars.instrument_mag[use], sigma, plain[use], used_magnitudes, free)
    values: FloatArray = np.zeros(2)
    best = fit.loss(values)
    for _ in range(CORRECTION_ROUNDS):
        step = fit.step(values, best)
        for share in CORRECTION_SHARES:
            trial = np.clip(values + share * step, -MAX_CORRECTION, MAX_CORRECTION)
            trial_loss = fit.loss(trial)
            if trial_loss.value < best.value:
                break
        else:
            break
        gain = best.value - trial_loss.value
        values = trial
        best = trial_loss
        if gain < CORRECTION_GAIN:
            break
    return _pair(values)


def _pair(values: FloatArray) -> Correction:
    return float(values[0]), float(values[1])


def _about_v(
    stars: StarLight,
    base: FloatArray,
    use: BoolArray,
    ones: FloatArray,
    vignetting: Sequence[FloatArray],
) -> "_Robust":
    """The power of the light that DN follow, and about V the colour term and zero points: values
    and sigmas in this order.
    """
    bv_mag = np.nan_to_num(stars.bv_mag)
    by_magnitude = np.column_stack([base, ones, *vignetting])
    power = _robust(by_magnitude, stars.instrument_mag, stars.sigma_mag, use)
    # a zero point at V = 0 of a line with a free slope lies far from the stars: that of slope 1 is
    # stated
    by_colour = np.column_stack([bv_mag, ones, *vignetting])
    about_v_mag = stars.instrument_mag - stars.v_mag
    about_v = _robust(by_colour, about_v_mag, stars.sigma_mag, use)
    values = np.concatenate([power.values[:1], about_v.values])
    sigma = np.concatenate([power.sigma[:1], about_v.sigma])
    return replace(power, values=values, sigma=sigma)


def _offsets_alone(stars: StarLight, images: int, base: FloatArray, held: LightFit) -> LightFit:
    """The light of a camera that is held: each photograph's offset is fitted alone."""
    r2_mag, r4_mag = held.vignetting_mag
    shade_mag = r2_mag * stars.radius2 + r4_mag * stars.radius2**2
    ones = np.eye(images)[stars.image]
    off_mag = stars.instrument_mag - base - shade_mag
    solution = _robust(ones, off_mag, stars.sigma_mag, _trusted(stars, ones))
    colours = np.zeros(images)
    return replace(held, offsets_mag=solution.values, mag=base + shade_mag, colours=colours)


@dataclass(frozen=True, slots=True)
class _Robust:
    """A robust fit: values (k,) of the columns and their sigmas, the model (n,), and target less
    model (n,).
    """

    values: FloatArray
    sigma: FloatArray
    model: FloatArray
    off: FloatArray


def _robust(design: FloatArray, target: FloatArray, sigma: FloatArray, use: BoolArray) -> _Robust:
    """Least squares without what lies far off; its errors by the scatter that is left."""
    columns = design.shape[1]
    is_near = use & np.isfinite(target)
    floor = 0.05
    values: FloatArray = np.zeros(columns)
    covariance = np.full((columns, columns), np.nan)
    for _ in range(ROUNDS):
        count = is_near.sum()
        if count <= columns:
            break
        weight = 1 / np.hypot(sigma, floor)[is_near]
        rows = design[is_near] * weight[:, None]
        weighted_target = target[is_near] * weight
        values = np.linalg.lstsq(rows, weighted_target, rcond=None)[0].astype(np.float64)
        off = target - design @ values
        median_off = float(np.median(np.abs(off[is_near])))
        spread = MAD_TO_SIGMA * median_off * math.sqrt(count / (count - columns))
        noise = float(np.median(sigma[is_near]))
        # what the scatter has beyond noise is each star's own: catalogue, blends, flat field
        floor = math.sqrt(max(spread**2 - noise**2, 1e-6))
        covariance = np.linalg.pinv(rows.T @ rows)
        limit = PATTERN_CLIP * np.hypot(sigma, max(spread, 0.01))
        is_near = use & (np.abs(off) < limit)
    model = design @ values
    value_sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
    return _Robust(values, value_sigma, model, target - model)


def _held_out(design: FloatArray, target: FloatArray, sigma: FloatArray, use: BoolArray) -> float:
    """Rms of stars that were held out, mag, each counted up to 0.5."""
    off = np.full(len(target), np.nan)
    number = np.cumsum(use)
    for fold in range(FOLDS):
        is_held_out = use & (number % FOLDS == fold)
        fit = _robust(design, target, sigma, use & ~is_held_out)
        off[is_held_out] = fit.off[is_held_out]
    clipped_mag = np.clip(off[use], -0.5, 0.5)
    if len(clipped_mag):
        return math.sqrt(float((clipped_mag**2).mean()))
    return math.nan
