"""The light of photographs: zero point, colour, vignetting and linearity by stars; gain, pedestal
and noise by pixels.

Magnitudes are compared with what hilstar computes of each star's spectrum through the tracker's
curves. A residual is a star's instrument magnitude less the fitted one: positive where the
photograph has less light.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.confront.star_psf import MEAN_BV_MAG

MAG = 2.5 / math.log(10)
# A quantum efficiency is corrected by exp(tilt x + bow x^2), x = ln(wavelength / 550 nm): the
# largest of both, the stars that each takes, and the spread of B-V that they need.
MAX_CORRECTION, STARS_FOR_CORRECTION, MIN_COLOURS_MAG = np.array([10.0, 30.0]), (15, 30), 0.2
CORRECTION_PRIOR = np.array([3.0, 10.0])
CORRECTION_ROUNDS, CORRECTION_STEP, CORRECTION_FLOOR_MAG, CORRECTION_HUBER = 8, 0.05, 0.05, 1.5
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

    def illumination(self, radius2: FloatArray) -> FloatArray:
        """Light relative to the axis at squares of radii."""
        a, b = self.vignetting_mag
        return np.asarray(10 ** (-0.4 * (a * radius2 + b * radius2**2)))


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
    r2 = stars.radius2
    use = _trusted(stars, ones)
    vignetting: dict[str, list[FloatArray]] = {"even": []}
    if use.sum() >= MIN_STARS + images:
        vignetting |= {"r^2": [r2], "r^2, r^4": [r2, r2**2]}
    correction = _correction(stars, magnitudes, np.column_stack([ones, r2]), use)
    base = magnitudes(correction)
    off = stars.instrument_mag - base
    chosen = "even"
    best = math.inf
    for name, columns in vignetting.items():
        held_out = _held_out(np.column_stack([ones, *columns]), off, stars.sigma_mag, use)
        if held_out < GAIN * best:
            best = held_out
            chosen = name
    # a mosaic's planes have a colour each beside the one quantum efficiency
    bv = np.nan_to_num(stars.bv_mag, nan=MEAN_BV_MAG) - MEAN_BV_MAG
    planes = np.unique(stars.plane)
    own_columns = [bv * (stars.plane == plane) for plane in planes if len(planes) > 1]
    solution = _robust(
        np.column_stack([ones, *vignetting[chosen], *own_columns]), off, stars.sigma_mag, use
    )
    terms = (*solution.values[images : len(solution.values) - len(own_columns)].tolist(), 0.0, 0.0)[
        :2
    ]
    colours = np.zeros(images)
    colour_terms = {}
    for k, plane in enumerate(planes if own_columns else ()):
        colours[np.unique(stars.image[stars.plane == plane])] = solution.values[
            len(solution.values) - len(own_columns) + k
        ]
        here = use & (stars.plane == plane)
        colour_terms[" rgb"[plane]] = float(
            _about_v(stars, base, here, ones[:, ones[here].any(axis=0)], ()).values[1]
        )
    about_v = _about_v(stars, base, use, ones, vignetting[chosen])
    sigma = {name: about_v.sigma[k] for k, name in enumerate(("linearity", "colour_term"))}
    sigma |= {"zero_point_mag": float(about_v.sigma[2 : 2 + images].mean())}
    return LightFit(
        offsets_mag=solution.values[:images],
        vignetting_mag=(terms[0], terms[1]),
        correction=correction,
        zero_point_mag=-float(about_v.values[2 : 2 + images].mean()),
        colour_term=float(about_v.values[1]),
        linearity=float(about_v.values[0]),
        sigma=sigma,
        mag=base + solution.model - ones @ solution.values[:images],
        colours=colours,
        colour_terms=colour_terms,
    )


def with_extinction(
    light: LightFit, stars: StarLight, masses: Sequence[float | None], *, known: bool
) -> LightFit:
    """The light with the slope of the photographs' offsets over their air masses, where these span
    MIN_MASSES.

    A photograph's offset counts by its stars' scatter and by CLOUD_MAG, by which skies differ. With
    a `known` extinction the slope is what is left of it.
    """
    light_found = replace(light, masses=tuple(masses))
    x = np.array([np.nan if air_mass is None else air_mass for air_mass in masses])
    if not np.isfinite(x).all() or len(x) < 3 or np.ptp(x) < MIN_MASSES:
        return light_found
    off = light.offsets_mag[stars.image] + light.mag - stars.instrument_mag
    count = np.bincount(stars.image[stars.clean], minlength=len(x))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(off[stars.clean])))
    sigma = np.hypot(spread / np.sqrt(np.maximum(count, 1)), CLOUD_MAG)
    design = np.column_stack([x, np.ones(len(x))]) / sigma[:, None]
    slope, _ = np.linalg.lstsq(design, light.offsets_mag / sigma, rcond=None)[0]
    error = math.sqrt(float(np.linalg.inv(design.T @ design)[0, 0]))
    if known:
        name = "extinction_beyond_table"
    else:
        name = "extinction"
    return replace(
        light_found,
        extinction_mag=float(slope),
        sigma=light.sigma | {f"{name}_mag_per_air_mass": error},
    )


def _trusted(stars: StarLight, ones: FloatArray) -> BoolArray:
    """Clean stars that should have TRUSTED_SNR by their V: of fainter ones only those are found
    that came out bright.
    """
    clean = stars.clean & (stars.dn > 0)
    bright = clean & (stars.dn > TRUSTED_SNR * stars.sigma_dn)
    if not bright.any():
        return clean
    plain = _robust(ones, stars.instrument_mag - stars.v_mag, stars.sigma_mag, bright)
    expected_dn = 10 ** (-0.4 * (stars.v_mag + ones @ plain.values))
    is_trusted = clean & (expected_dn > TRUSTED_SNR * np.median(stars.sigma_dn[bright]))
    return is_trusted if is_trusted.sum() >= MIN_STARS else clean


def _correction(
    stars: StarLight, magnitudes: Magnitudes, plain: FloatArray, use: BoolArray
) -> Correction:
    """Tilt and bow of the quantum efficiency by which stars of all colours fit best."""
    count = sum(int(use.sum()) >= least + plain.shape[1] for least in STARS_FOR_CORRECTION)
    if not count or np.std(np.nan_to_num(stars.bv_mag[use])) < MIN_COLOURS_MAG:
        return NO_CORRECTION
    weight = np.hypot(stars.sigma_mag, CORRECTION_FLOOR_MAG)[use]
    target = stars.instrument_mag[use]
    plain = plain[use]

    def loss(values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Huber's loss and a weak prior; the residuals in sigmas, and the other columns'
        coefficients.
        """
        off = target - magnitudes(_pair(values))[use]
        weights = np.ones(len(target))
        for _ in range(CORRECTION_ROUNDS):
            rows = plain * (np.sqrt(weights) / weight)[:, None]
            residual = (
                off - plain @ np.linalg.lstsq(rows, off * np.sqrt(weights) / weight, rcond=None)[0]
            ) / weight
            weights = np.minimum(
                1.0, CORRECTION_HUBER / np.maximum(np.abs(residual), CORRECTION_HUBER)
            )
        size = np.abs(residual)
        huber = np.where(
            size < CORRECTION_HUBER, size**2 / 2, CORRECTION_HUBER * (size - CORRECTION_HUBER / 2)
        )
        return float(huber.sum() + ((values / CORRECTION_PRIOR) ** 2).sum() / 2), residual, weights

    values: FloatArray = np.zeros(2)
    best, off, kept = loss(values)
    for _ in range(CORRECTION_ROUNDS):
        base = magnitudes(_pair(values))[use]
        moved = [
            magnitudes(_pair(values + step))[use] for step in CORRECTION_STEP * np.eye(2)[:count]
        ]
        slopes = (
            np.column_stack(
                [*plain.T, *((moved_loss - base) / CORRECTION_STEP for moved_loss in moved)]
            )
            / weight[:, None]
        )
        prior = np.zeros(slopes.shape[1])
        prior[plain.shape[1] :] = 1 / CORRECTION_PRIOR[:count] ** 2
        downhill = slopes.T @ (kept * off)
        downhill[plain.shape[1] :] -= values[:count] * prior[plain.shape[1] :]
        step = np.zeros(2)
        step[:count] = np.linalg.solve(
            slopes.T @ (kept[:, None] * slopes) + np.diag(prior + 1e-9), downhill
        )[plain.shape[1] :]
        for share in (1.0, 0.4, 0.15, 0.05):
            trial = np.clip(values + share * step, -MAX_CORRECTION, MAX_CORRECTION)
            new = loss(trial)
            if new[0] < best:
                break
        else:
            break
        done = best - new[0] < 0.01
        values, (best, off, kept) = trial, new
        if done:
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
    """The power of the light that DN follow, and about V the colour term and zero points."""
    bv = np.nan_to_num(stars.bv_mag)
    both = _robust(
        np.column_stack([base, ones, *vignetting]), stars.instrument_mag, stars.sigma_mag, use
    )
    # a zero point at V = 0 of a line with a free slope lies far from the stars: that of slope 1 is
    # stated
    plain = _robust(
        np.column_stack([bv, ones, *vignetting]),
        stars.instrument_mag - stars.v_mag,
        stars.sigma_mag,
        use,
    )
    return replace(
        both,
        values=np.concatenate([both.values[:1], plain.values]),
        sigma=np.concatenate([both.sigma[:1], plain.sigma]),
    )


def _offsets_alone(stars: StarLight, images: int, base: FloatArray, held: LightFit) -> LightFit:
    shape = held.vignetting_mag[0] * stars.radius2 + held.vignetting_mag[1] * stars.radius2**2
    off = stars.instrument_mag - base - shape
    ones = np.eye(images)[stars.image]
    solution = _robust(ones, off, stars.sigma_mag, _trusted(stars, ones))
    return replace(held, offsets_mag=solution.values, mag=base + shape, colours=np.zeros(images))


@dataclass(frozen=True, slots=True)
class _Robust:
    values: FloatArray
    sigma: FloatArray
    model: FloatArray
    off: FloatArray


def _robust(design: FloatArray, target: FloatArray, sigma: FloatArray, use: BoolArray) -> _Robust:
    """Least squares without what lies far off; its errors by the scatter that is left."""
    is_kept = use & np.isfinite(target)
    floor = 0.05
    values: FloatArray = np.zeros(design.shape[1])
    covariance = np.full((design.shape[1],) * 2, np.nan)
    for _ in range(ROUNDS):
        if is_kept.sum() <= design.shape[1]:
            break
        weight = 1 / np.hypot(sigma, floor)[is_kept]
        rows = design[is_kept] * weight[:, None]
        values = np.asarray(
            np.linalg.lstsq(rows, target[is_kept] * weight, rcond=None)[0], dtype=np.float64
        )
        off = target - design @ values
        spread = (
            MAD_TO_SIGMA
            * float(np.median(np.abs(off[is_kept])))
            * math.sqrt(is_kept.sum() / (is_kept.sum() - design.shape[1]))
        )
        floor = math.sqrt(max(spread**2 - float(np.median(sigma[is_kept])) ** 2, 1e-6))
        covariance = np.linalg.pinv(rows.T @ rows)
        is_kept = use & (np.abs(off) < PATTERN_CLIP * np.hypot(sigma, max(spread, 0.01)))
    model = design @ values
    return _Robust(values, np.sqrt(np.maximum(np.diag(covariance), 0)), model, target - model)


def _held_out(design: FloatArray, target: FloatArray, sigma: FloatArray, use: BoolArray) -> float:
    """Rms of stars that were held out, mag, each counted up to 0.5."""
    off = np.full(len(target), np.nan)
    number = np.cumsum(use)
    for fold in range(FOLDS):
        out = use & (number % FOLDS == fold)
        off[out] = _robust(design, target, sigma, use & ~out).off[out]
    clipped_mag = np.clip(off[use], -0.5, 0.5)
    if len(clipped_mag):
        return math.sqrt(float((clipped_mag**2).mean()))
    return math.nan
