"""The least PSF that a tolerance allows: a Gaussian, one PSF for all stars, Gaussians over the
field, few basis images, or all.

Candidates are compared with the whole glass at places all over the field, for two spectra: by a
star's light and centroid, in all of its pixels and in a Gaussian window as wide as the star.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.optics.psf import ONE_PSF, GaussianPsf, Psf, SampledPsf
from hilstar.sky.spectrum import blackbody_exitance_w_m2_m

MAG_PER_SHARE = 2.5 / math.log(10)
SPECTRA_K = (3000.0, 20_000.0)
GAUSSIAN_PSF, WHOLE = "a Gaussian", "each star by its place and spectrum"


@dataclass(frozen=True, slots=True)
class Choice:
    """One choice of a part of a frame: its largest errors, its time in a frame of an average field,
    and what that saves.

    `note` is what else there is to know of it, "" for nothing.
    """

    part: str
    choice: str
    error_mag: float
    error_px: float
    ms: float = 0.0
    saved_ms: float = 0.0
    note: str = ""

    def line(self) -> str:
        """The choice as one line of text."""
        error = "exact"
        if self.error_mag or self.error_px:
            error = f"{self.error_mag:.2g} mag and {self.error_px:.2g} px off at most"
        line = f"{self.part}: {self.choice}; {error}"
        if self.note:
            line += f"; {self.note}"
        return line


@dataclass(frozen=True, slots=True)
class PsfErrors:
    """How far stars drawn by another PSF are from those of a glass, at most: of their light and
    of their centroid.
    """

    mag: float
    px: float

    def line(self) -> str:
        """ "0.0021 mag and 0.0034 px"."""
        return f"{self.mag:.2g} mag and {self.px:.2g} px"


def candidates(psf: SampledPsf) -> Iterator[tuple[str, Callable[[], Psf]]]:
    """PSFs that may stand for `psf`, the cheapest first and `psf` itself last: the name of each,
    and a function that makes it.
    """
    yield GAUSSIAN_PSF, lambda: GaussianPsf(psf.width_px)
    yield from psf.simpler()
    name = WHOLE if psf.by_colour else ONE_PSF
    yield name, lambda: psf


def psf_choices(
    psf: SampledPsf, places_px: FloatArray, among: frozenset[str] | None = None
) -> Iterator[tuple[Psf, Choice]]:
    """Each of `candidates` (by name those `among` them) with its errors at places (n, 2) of the
    field, itself at last.

    A choice's note says how far off those before it are.
    """
    before: list[str] = []
    for name, make in candidates(psf):
        if among is not None and name not in among:
            continue
        try:
            other = make()
        except InputError:  # negative lobes or noise, which only the whole sum makes up for
            continue
        if other is psf:
            errors = PsfErrors(0.0, 0.0)
        else:
            errors = psf_errors(psf, other, places_px)
        note = "; ".join(before) or "more would gain no more than that"
        yield other, Choice("PSF", name, errors.mag, errors.px, note=note)
        before.append(f"{name} would be {errors.line()} off")


def least_psf(
    psf: SampledPsf,
    places_px: FloatArray,
    tolerance: tuple[float, float],
    among: frozenset[str] | None = None,
) -> tuple[Psf, Choice]:
    """The first of `psf_choices` within a tolerance, mag and px; the last where none is."""
    least, choice = first_within(psf_choices(psf, places_px, among), tolerance)
    if choice is None:
        raise AssertionError("each of them has its errors")
    return least, choice


def first_within(
    found: Iterator[tuple[Psf, Choice]] | Iterator[tuple[Psf, Choice | None]],
    tolerance: tuple[float, float],
) -> tuple[Psf, Choice | None]:
    """The first PSF whose errors are within a tolerance, mag and px, or that is the bench's own
    (without a Choice); the last one where none is.
    """
    max_mag, max_px = tolerance
    last: tuple[Psf, Choice | None] | None = None
    for last in found:
        _, choice = last
        if choice is None:
            break
        if choice.error_mag <= max_mag and choice.error_px <= max_px:
            break
    if last is None:
        raise AssertionError("the PSF itself is always among them")
    return last


def psf_errors(psf: SampledPsf, other: Psf, places_px: FloatArray) -> PsfErrors:
    """The largest errors of stars at places (n, 2) that are drawn by another PSF."""
    # where a field's corner has no light, nothing but the whole will do
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = _measured(psf, psf, places_px)
        measured = _measured(other, psf, places_px)
        light_error = measured[..., 0] / wanted[..., 0] - 1
        mag = MAG_PER_SHARE * float(np.abs(light_error).max())
    off_px = measured[..., 1:] - wanted[..., 1:]
    distance_px = np.hypot(off_px[..., 0], off_px[..., 1])
    return PsfErrors(mag, float(distance_px.max()))


def _measured(drawn_by: Psf, psf: SampledPsf, places_px: FloatArray) -> FloatArray:
    """Flux and centroid, px from the star (windows, n, 3), of stars of each spectrum at places,
    drawn by a PSF, in the stamps and windows of the whole `psf`.
    """
    side = psf.footprint_px
    star_px = np.repeat(places_px, len(SPECTRA_K), axis=0).T  # each place with each spectrum
    x_px, y_px = star_px
    fraction = star_px - np.floor(star_px + 0.5)
    if drawn_by.by_colour:
        spectra = np.tile(_spectra(drawn_by), (len(places_px), 1))
        stamps = _with_side(drawn_by.stamps_at(x_px, y_px, spectra), side)
    else:
        unit_light = np.ones(len(x_px))
        stamps = np.moveaxis(drawn_by.stamps(fraction, unit_light, side), 2, 0)
    light = stamps.astype(np.float64)
    pixel = np.arange(side) - side // 2
    across = pixel - fraction[0][:, None]
    down = pixel - fraction[1][:, None]
    variance_x, variance_y = psf.variance_px2
    far = across[:, None, :] ** 2 / variance_x + down[:, :, None] ** 2 / variance_y
    moments = []
    for window in (np.ones_like(far), np.exp(-far / 2)):
        inside = light * window
        flux = inside.sum(axis=(1, 2))
        column_sums = inside.sum(axis=1)
        row_sums = inside.sum(axis=2)
        x = (column_sums * across).sum(axis=1) / flux
        y = (row_sums * down).sum(axis=1) / flux
        moments.append(np.stack([flux, x, y], axis=1))
    return np.array(moments)


def _with_side(stamps: Float32Array, side: int) -> Float32Array:
    """Stamps (n, s, s) cut, or widened by zeros, to (n, side, side) about their middle."""
    whole = stamps.shape[1]
    cut = max(0, (whole - side) // 2)
    more = max(0, (side - whole) // 2)
    middle = stamps[:, cut : cut + side, cut : cut + side]
    return np.pad(middle, ((0, 0), (more, more), (more, more)))


def _spectra(psf: Psf) -> FloatArray:
    """Shares of light (spectra, L) by wavelength of black bodies of SPECTRA_K."""
    nm = psf.wavelengths_nm
    if len(nm) == 1:
        return np.ones((len(SPECTRA_K), 1))
    exitance = blackbody_exitance_w_m2_m(nm, np.array(SPECTRA_K)[:, None])
    shares = psf.mean_shares * nm * exitance  # of photons
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))
