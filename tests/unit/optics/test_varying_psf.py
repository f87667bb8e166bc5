"""What every PSF offers to those who draw, and that one that varies is drawn by it alone."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from scipy import constants

from hilstar.basics.errors import InputError
from hilstar.display.footprints import FootprintMap
from hilstar.display.render.backend import as_maps
from hilstar.display.render.numpy_backend import NumpyBackend
from hilstar.display.render.target import Target
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf, SampledPsf
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.least_psf import (
    ONE_PSF,
    WHOLE,
    Choice,
    candidates,
    first_within,
    psf_errors,
)
from tests.support.psfs import gaussian, sampled

SIDE_PX = 64
SIZE_PX = (SIDE_PX, SIDE_PX)
X_PX, Y_PX = np.array([12.3, 40.8]), np.array([20.6, 31.2])
RATES_E_PER_S = np.array([1e3, 2e4])
ONE_WAVELENGTH = np.ones(1)


class Vignetted(GaussianPsf):
    """A Gaussian that has half the light in the right half of the image: no glass of any file."""

    by_place, by_colour = True, True
    footprint_px = 11

    @staticmethod
    def _light(x_px):
        return np.where(x_px > SIDE_PX / 2, 0.5, 1.0)

    def stamps_at(self, x_px, y_px, spectra, electrons_per_s=None):
        """Half of the light on the right."""
        stamps = super().stamps_at(x_px, y_px, spectra, electrons_per_s)
        return stamps * self._light(x_px).astype(np.float32)[:, None, None]

    def image(self, x_px, y_px, spectra, electrons_per_s, resolution_px):
        """Half of the light on the right."""
        rates = electrons_per_s * self._light(x_px)
        return super().image(x_px, y_px, spectra, rates, resolution_px)


class Even(Vignetted):
    """The same in a square that has no middle pixel."""

    footprint_px = 10


def sprites_of(psf):
    """Two stars with a spectrum, one on each side."""
    none = np.zeros(2, int)
    sprites = pack_sprites(X_PX, Y_PX, RATES_E_PER_S, none, SIZE_PX, psf.footprint_px)
    return replace(sprites, spectra=ONE_WAVELENGTH)


def test_a_psf_of_any_class_that_varies_is_drawn_as_a_map_of_its_own_light():
    """After all other light; stars of one PSF, and those without spectra, stay sprites."""
    psf = Vignetted((0.8, 0.8))
    before = LightMap(np.ones(SIZE_PX, np.float32))
    sprites = replace(sprites_of(psf), extended=(before,))
    light = as_maps(sprites, Target(SIZE_PX, psf))
    kept, made = light.extended
    assert kept is before
    assert (len(light), made.lasting) == (0, False)
    plain = replace(sprites, spectra=None)
    assert as_maps(plain, Target(SIZE_PX, psf)) is plain
    assert as_maps(sprites, Target(SIZE_PX, GaussianPsf((0.8, 0.8)))) is sprites
    image = made.image
    assert image[:, : SIDE_PX // 2].sum() == pytest.approx(1e3, rel=1e-5)
    assert image[:, SIDE_PX // 2 :].sum() == pytest.approx(1e4, rel=1e-5)


def test_without_opengl_a_psf_of_any_class_that_varies_is_drawn_by_its_place():
    psf = Vignetted((0.8, 0.8))
    with closing(NumpyBackend(Target(SIZE_PX, psf))) as backend:
        backend.draw(sprites_of(psf))
        image = backend.linear()
    assert image[:, : SIDE_PX // 2].sum() == pytest.approx(1e3, rel=1e-5)
    assert image[:, SIDE_PX // 2 :].sum() == pytest.approx(1e4, rel=1e-5)


def test_a_psf_of_any_class_that_varies_has_footprints_of_its_own_light():
    psf = Vignetted((0.8, 0.8))
    footprints = FootprintMap(SIZE_PX, psf).find(sprites_of(psf))
    plain = FootprintMap(SIZE_PX, psf).find(replace(sprites_of(psf), spectra=None))
    assert footprints.light == pytest.approx(plain.light * [1.0, 0.5], rel=1e-4, abs=1e-6)
    assert (footprints.place == plain.place).all()


def test_a_varying_psf_of_an_even_footprint_is_refused_where_pixels_are_chosen():
    psf = Even((0.8, 0.8))
    with pytest.raises(InputError, match="footprint of 10 px, not odd"):
        FootprintMap(SIZE_PX, psf).find(sprites_of(psf))


@pytest.mark.parametrize(
    "psf", [GaussianPsf((0.7, 0.9)), SampledPsf(sampled(gaussian(0.8, 0.8), 8, 5), 8)]
)
def test_a_psf_that_is_the_same_everywhere_keeps_the_contract(psf):
    stamps = psf.stamps_at(X_PX, Y_PX, psf.mean_shares)
    image = psf.image(X_PX, Y_PX, psf.mean_shares, RATES_E_PER_S, SIZE_PX)
    before_px = stamps.shape[1] // 2
    summed = np.zeros((SIDE_PX, SIDE_PX))
    for x_px, y_px, rate, stamp in zip(X_PX, Y_PX, RATES_E_PER_S, stamps, strict=True):
        left, top = round(x_px) - before_px, round(y_px) - before_px
        place = (slice(top, top + len(stamp)), slice(left, left + len(stamp)))
        summed[place] += rate * stamp
    assert image == pytest.approx(summed, abs=1e-4 * RATES_E_PER_S.max())
    assert image.sum() == pytest.approx(RATES_E_PER_S.sum(), rel=1e-4)
    x_px, y_px, light = psf.centroids_px(X_PX, Y_PX, psf.mean_shares)
    assert (x_px.tolist(), y_px.tolist()) == (X_PX.tolist(), Y_PX.tolist())
    assert light.tolist() == [1.0, 1.0]
    assert psf.in_the_middle is psf
    assert [name for name, _ in candidates(psf)] == ["a Gaussian", ONE_PSF]


def test_what_may_stand_for_a_varying_psf_ends_with_itself_by_that_name():
    psf = Vignetted((0.8, 0.8))
    name, make = list(candidates(psf))[-1]
    assert name == WHOLE
    assert make() is psf


# A Gaussian's light in a pixel is nearly that of one a twelfth of a px^2 wider in its middle.
PIXEL_VARIANCE_PX2 = 1 / 12
CLOSE_MAG, CLOSE_PX = 2e-3, 2e-3
# 0.4 % of a star's light is beyond a square two pixels smaller than its footprint, 3 px away
CUT_MAG, CUT_PX = 0.01, 0.02
PLACES_PX = np.array([[12.3, 40.8], [20.6, 31.2], [7.0, 9.5]])


def gaussian_samples(sigma_x, sigma_y, x_px=0.0, y_px=0.0) -> SampledPsf:
    return SampledPsf(sampled(gaussian(sigma_x, sigma_y, x_px, y_px), 5, 9), 5)


@pytest.mark.parametrize("off_px", [(0.03, 0.0), (0.0, -0.04), (-0.03, 0.04)])
def test_a_psf_beside_its_place_is_off_by_its_distance(off_px):
    found = psf_errors(gaussian_samples(0.9, 1.5), gaussian_samples(0.9, 1.5, *off_px), PLACES_PX)
    assert found.px == pytest.approx(np.hypot(*off_px), abs=CLOSE_PX)


@pytest.mark.parametrize("other", [(0.9, 1.7), (1.1, 1.5)])
def test_a_psf_of_another_width_is_off_by_the_light_in_a_window_as_wide_as_the_star(other):
    """Through it, of a Gaussian of variance v, passes sqrt(w / (w + v)) along each axis."""
    own = np.square([0.9, 1.5]) + PIXEL_VARIANCE_PX2
    wider = np.square(other) + PIXEL_VARIANCE_PX2
    share = np.sqrt((own + own) / (own + wider)).prod()
    found = psf_errors(gaussian_samples(0.9, 1.5), gaussian_samples(*other), PLACES_PX)
    assert found.mag == pytest.approx(2.5 / np.log(10) * (1 - share), abs=CLOSE_MAG)
    assert found.px < CLOSE_PX


class Coloured(GaussianPsf):
    """A Gaussian with half of its light at 1000 nm, where it has half the throughput of 500 nm."""

    by_colour = True
    wavelengths_nm = np.array([500.0, 1000.0])
    mean_shares = np.array([0.5, 0.5])
    side_px = 1

    def stamps_at(self, x_px, y_px, spectra, electrons_per_s=None):
        """By the spectrum of each star, in squares of its own side."""
        fraction_px = np.stack([x_px - np.rint(x_px), y_px - np.rint(y_px)])
        return np.moveaxis(self.stamps(fraction_px, spectra @ [1.0, 0.5], self.side_px), 2, 0)


@pytest.mark.parametrize("wider_px", [-2, 2])
def test_a_coloured_psf_s_light_is_counted_in_photons_of_a_cool_and_a_hot_star(wider_px):
    """Planck's law in photons at 3000 K; a hot star has less of its light at 1000 nm."""
    wavelengths_m = Coloured.wavelengths_nm * 1e-9
    energies = constants.h * constants.c / (wavelengths_m * constants.k * 3000.0)
    photons = 1 / (wavelengths_m**4 * np.expm1(energies))
    wanted_mag = 2.5 / np.log(10) * 0.5 * photons[1] / photons.sum()
    own, other = gaussian_samples(0.7, 0.8), Coloured((0.7, 0.8))
    other.side_px = own.footprint_px + wider_px
    found = psf_errors(own, other, PLACES_PX)
    assert found.mag == pytest.approx(wanted_mag, abs=CUT_MAG)
    assert found.px < CUT_PX


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ([(0.02, 0.05), (0.005, 0.2), (0.01, 0.1), (0.0, 0.0)], 2),
        ([(0.011, 0.0), (0.0, 0.11)], 1),  # the last where none is within it
        ([(0.02, 0.2), None, (0.0, 0.0)], 1),  # the bench's own has no errors
    ],
)
def test_the_first_psf_within_both_tolerances_is_chosen(errors, chosen):
    every = []
    for k, error in enumerate(errors):
        choice = None if error is None else Choice("PSF", str(k), *error)
        every.append((GaussianPsf((1.0 + k, 1.0)), choice))
    assert first_within(iter(every), (0.01, 0.1)) == every[chosen]


@pytest.mark.parametrize(
    ("errors", "note", "told"),
    [
        ((0.0, 0.0), "", "exact"),
        ((0.0, 0.021), "", "0 mag and 0.021 px off at most"),
        ((0.0123, 0.0), "", "0.012 mag and 0 px off at most"),
        ((0.004, 0.25), "as asked", "0.004 mag and 0.25 px off at most; as asked"),
    ],
)
def test_a_choice_s_line_has_each_of_its_errors(errors, note, told):
    assert Choice("PSF", "a Gaussian", *errors, note=note).line() == f"PSF: a Gaussian; {told}"
