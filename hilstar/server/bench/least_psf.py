"""The least PSF that a tolerance allows: a Gaussian, one PSF for all stars, Gaussians over the
field, few basis images, or all.

Candidates are compared with the whole glass at places all over the field, for two spectra: by a
star's light and centroid, in all of its pixels and in a Gaussian window as wide as the star.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
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
        return "; ".join(part for part in (f"{self.part}: {self.choice}", error, self.note) if part)


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
    last: tuple[Psf, Choice | None] | None = None
    for last in found:
        choice = last[1]
        if choice is None or (choice.error_mag <= tolerance[0] and choice.error_px <= tolerance[1]):
            break
    if last is None:
        raise AssertionError("the PSF itself is always among them")
    return last


def psf_errors(psf: SampledPsf, other: Psf, places_px: FloatArray) -> PsfErrors:
    """The largest errors of stars at places (n, 2) that are drawn by another PSF."""
    # where a field's corner has no light, nothing but the whole will do
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted, measured = (_measured(candidate, psf, places_px) for candidate in (psf, other))
        mag = MAG_PER_SHARE * float(np.abs(measured[..., 0] / wanted[..., 0] - 1).max())
    return PsfErrors(
        mag, float(np.hypot(*np.moveaxis(measured[..., 1:] - wanted[..., 1:], 2, 0)).max())
    )


def _measured(one: Psf, psf: SampledPsf, places_px: FloatArray) -> FloatArray:
    """Flux and centroid, px from the star (windows, n, 3), of stars of each spectrum at places,
    drawn by `one`.
    """
    side, x, y = psf.footprint_px, *np.repeat(places_px, len(SPECTRA_K), axis=0).T
    fraction = np.stack([place - np.floor(place + 0.5) for place in (x, y)])
    if one.by_colour:
        stamps = one.stamps_at(x, y, np.tile(_spectra(one), (len(places_px), 1)))
        whole = stamps.shape[1]
        cut = max(0, (whole - side) // 2)
        more = max(0, (side - whole) // 2)
        stamps = np.pad(
            stamps[:, cut : cut + side, cut : cut + side], ((0, 0), (more, more), (more, more))
        )
    else:
        stamps = np.moveaxis(one.stamps(fraction, np.ones(len(x)), side), 2, 0)
    light = stamps.astype(np.float64)
    pixel = np.arange(side) - side // 2
    across = pixel - fraction[0][:, None]
    down = pixel - fraction[1][:, None]
    far = (
        across[:, None, :] ** 2 / psf.variance_px2[0] + down[:, :, None] ** 2 / psf.variance_px2[1]
    )
    moments = []
    for window in (np.ones_like(far), np.exp(-far / 2)):
        inside = light * window
        flux = inside.sum(axis=(1, 2))
        sums = [(inside.sum(axis=axis) * at).sum(axis=1) for axis, at in ((1, across), (2, down))]
        moments.append(np.stack([flux, *(part / flux for part in sums)], axis=1))
    return np.array(moments)


def _spectra(psf: Psf) -> FloatArray:
    nm = psf.wavelengths_nm
    if len(nm) == 1:
        return np.ones((len(SPECTRA_K), 1))
    shares = psf.mean_shares * nm * blackbody_exitance_w_m2_m(nm, np.array(SPECTRA_K)[:, None])
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))
