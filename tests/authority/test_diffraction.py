"""`hilstar optics zernike` against closed forms, poppy's own optical system, and rays."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.special import j1

from hilstar.basics.errors import InputError
from hilstar.optics.glass.glass_psf import NodeSpline, glass_psf
from hilstar.optics.glass.psf_file import glass_of
from hilstar.optics.glass.zernike import Pupil, PupilField, Term, diffracted, psf_of
from hilstar.sky.spectrum import blackbody_exitance_w_m2_m
from tests.support.claims import holds

# A pupil of 256 samples across has grey edges: measured 3e-4 of the peak against 1024 samples of
# poppy.
EDGE = 1e-3
BASE = {
    "aperture_mm": 30.0,
    "focal_length_mm": 60.0,
    "pixel_pitch_um": 5.0,
    "resolution_px": (512, 512),
    "wavelengths_nm": (550.0,),
    "points": 1,
    "half_px": 4,
}


@pytest.fixture(scope="module", autouse=True)
def poppy() -> Any:
    """Every test here needs it; to import it takes 0.3 s, which no other test has to wait for."""
    return pytest.importorskip("poppy")


def diffraction_image(per_px: int = 8, **keys) -> np.ndarray:
    found = diffracted(Pupil(**(BASE | keys)), per_px).images[0]
    return found / found.sum()


def airy(nm: float, obstruction: float, per_px: int = 8) -> tuple[np.ndarray, float]:
    """Born and Wolf, 8.6.2, eq. 24: an annular pupil; and the sum of its samples where all of
    its light is counted.
    """
    at_um = (np.arange(-4 * per_px, 4 * per_px + 1)) * 5.0 / per_px
    v = np.maximum(np.pi * np.hypot(at_um[None], at_um[:, None]) / (nm * 1e-3 * 2.0), 1e-9)
    e = obstruction
    light = (2 * j1(v) / v - (e * e * 2 * j1(e * v) / (e * v) if e else 0)) ** 2
    whole = 4 * np.pi * (1 - e * e) * (nm * 1e-3 * 2.0 / np.pi) ** 2 / (5.0 / per_px) ** 2
    return light, whole


@pytest.mark.parametrize("obstruction", [0.0, 0.4])
def test_a_round_pupil_has_the_airy_pattern_and_its_share_outside_the_stamp(obstruction):
    stack = diffracted(Pupil(**(BASE | {"obstruction": obstruction})), 8)
    light, whole = airy(550.0, obstruction)
    off = np.abs(stack.images[0] / stack.images[0].max() - light / light.max())
    holds("annular-pupil", off.max())
    assert stack.facts[0, 1] == pytest.approx(1 - light.sum() / whole, abs=EDGE)


TERMS = {5: 60.0, 7: 80.0, 8: -50.0, 11: 40.0}


def test_zernike_terms_are_those_of_poppy_s_own_optical_system(poppy):
    """poppy turns an image of its own right side up; here y is down, and with it the terms'
    sines.
    """
    # which takes each worker that collects this file half a second
    poppy = pytest.importorskip("poppy")
    terms = tuple(Term(kind="zernike", noll=noll, nm=nm) for noll, nm in TERMS.items())
    found = diffraction_image(terms=terms, obstruction=0.3, spiders=4, spider_width_mm=0.6)
    coefficients = np.zeros(11)
    for noll, nm in TERMS.items():
        coefficients[noll - 1] = nm * 1e-9
    system = poppy.OpticalSystem(pupil_diameter=0.03, npix=1024, oversample=1)
    system.add_pupil(poppy.CircularAperture(radius=0.015))
    system.add_pupil(
        poppy.SecondaryObscuration(secondary_radius=0.0045, n_supports=4, support_width=0.0006)
    )
    system.add_pupil(poppy.ZernikeWFE(radius=0.015, coefficients=coefficients))
    step_arcsec = np.degrees(5e-6 / 8 / 0.06) * 3600
    system.add_detector(pixelscale=step_arcsec, fov_pixels=65)
    wanted = system.calc_psf(550e-9)[0].data
    # poppy's spiders have sharp edges on samples of 0.03 mm: 2.5 % of the spiders' 8 % of the
    # pupil, in amplitude.
    holds("zernike-poppy", np.abs(found / found.max() - wanted / wanted.max()).max())


@cache
def variance_px2(focus_nm: float, sphere_nm: float) -> float:
    """Along x, of the light within a stamp of 24 px."""
    terms = (Term(kind="W020", nm=focus_nm), Term(kind="W040", nm=sphere_nm))
    light = diffraction_image(half_px=12, terms=terms)
    at_px = (np.arange(len(light)) - len(light) // 2) / 8
    core = np.abs(at_px) < 12
    return float(light.sum(axis=0)[core] @ at_px[core] ** 2 / light.sum())


@pytest.mark.parametrize(
    ("focus_nm", "sphere_nm"), [(1500.0, 0.0), (0.0, 1500.0), (-2000.0, 1500.0)]
)
def test_large_aberrations_have_the_second_moments_of_rays(focus_nm, sphere_nm):
    """Rays land at -R/a dW/dx: of W020 = a and W040 = b the mean square of the slope along x is
    a^2 + 8 a b / 3 + 2 b^2, smallest at a = -4/3 b. Diffraction adds a tail whose variance grows
    with the stamp, equal with and without it.
    """
    square_nm2 = focus_nm**2 + 8 * focus_nm * sphere_nm / 3 + 2 * sphere_nm**2
    rays_px2 = (2 * 60.0 / 30.0 * 1e-3 / 5.0) ** 2 * square_nm2
    spread_px2 = variance_px2(focus_nm, sphere_nm) - variance_px2(0.0, 0.0)
    assert spread_px2 == pytest.approx(rays_px2, rel=0.1)


def test_coma_leads_to_the_axis_and_turns_with_the_field():
    """W131 leads: rays go against its slope, towards the axis; their mean is at -R/a dW/dx, 2 F
    W131 / 2 along the field.
    """
    stack = diffracted(
        Pupil(**(BASE | {"points": 3, "half_px": 8, "terms": (Term(kind="W131", nm=600.0),)})), 8
    )
    at_px = (np.arange(129) - 64) / 8
    for light, (x, y, *_) in zip(stack.images, stack.at, strict=True):
        off = np.array([x, y]) - 255.5
        mean = np.array([light.sum(axis=0) @ at_px, light.sum(axis=1) @ at_px]) / light.sum()
        # the mean of rho^2 (1 + 2 cos^2) is 1
        wanted = -off / np.hypot(255.5, 255.5) * 2 * 60 / 30 * 0.6 / 5.0
        assert mean == pytest.approx(wanted, abs=0.01)


def test_focus_and_field_curvature_cancel_where_the_image_is():
    """W020 of focus is focus / 8 N^2: at N = 2 a lag of 550 nm is in focus 17.6 um behind."""
    sharp = diffraction_image(terms=(Term(kind="W020", nm=-550.0),), focuses_um=(17.6,))
    assert sharp == pytest.approx(diffraction_image(), abs=1e-6)


TEMPERATURES_K = (3300.0, 4500.0, 5800.0, 9600.0, 20_000.0)
RADIUS_PX = 4  # within which moments are compared


def in_pixels(light: np.ndarray, per_px: int) -> np.ndarray:
    """Samples of a stamp, integrated over the pixels of a star in a pixel's middle by the
    trapezoid rule.
    """
    kernel = np.ones(per_px + 1) / per_px
    kernel[[0, -1]] /= 2
    spread = np.apply_along_axis(
        np.convolve, 1, np.apply_along_axis(np.convolve, 0, light, kernel, "same"), kernel, "same"
    )
    middle = len(light) // 2
    return spread[middle % per_px :: per_px, middle % per_px :: per_px]


def moments(light: np.ndarray) -> np.ndarray:
    at = np.arange(len(light)) - len(light) // 2
    near = np.hypot(at[None], at[:, None]) <= RADIUS_PX
    light = np.where(near, light, 0.0)
    flux, x, y = (
        light.sum(),
        light.sum(axis=0) @ at / light.sum(),
        light.sum(axis=1) @ at / light.sum(),
    )
    return np.array(
        [
            flux,
            x,
            y,
            light.sum(axis=0) @ (at - x) ** 2 / flux,
            light.sum(axis=1) @ (at - y) ** 2 / flux,
        ]
    )


def test_stars_of_five_spectra_over_field_and_focus_are_as_poppy_diffracts_them(rng):
    """At places that are not the file's, by 13 wavelengths where the file has 5: flux 1e-3,
    centroid 0.003 px, widths 1 %.
    """
    terms = (
        Term(kind="W131", nm=300.0),
        Term(kind="W222", nm=150.0),
        Term(kind="W220", nm=120.0),
        Term(kind="W040", nm=80.0),
    )
    # axial colour; decentred
    terms += (Term(kind="W020", nm=0.0, per_nm=0.8), Term(kind="zernike", noll=7, nm=40.0))
    nodes_nm, fine_nm = (450.0, 525.0, 600.0, 675.0, 750.0), np.linspace(450, 750, 13)
    keys = BASE | {
        "points": 5,
        "wavelengths_nm": nodes_nm,
        "half_px": 6,
        "terms": terms,
        "focuses_um": (0.0, 8.0),
    }
    keys |= {"pixel_pitch_um": 3.0}
    pupil = Pupil(**keys)
    glass, field = glass_of(diffracted(pupil, 8), 3e-4), PupilField(pupil)
    focuses_um = (0.0, 8.0)
    psfs = [glass_psf(glass, focus_um, np.full(5, 0.2)) for focus_um in focuses_um]
    places = rng.integers(0, 512, (5, 2)).astype(float)
    for number, (temperature_k, place) in enumerate(zip(TEMPERATURES_K, places, strict=True)):
        psf, focus_um = psfs[number % 2], focuses_um[number % 2]
        exitance = blackbody_exitance_w_m2_m(fine_nm, np.array([temperature_k])[:, None])[0]
        light = exitance * fine_nm / (exitance @ fine_nm)
        by_node = light @ NodeSpline(np.array(nodes_nm))(fine_nm)
        found = psf.stamps_at(*place[:, None], by_node, np.ones(1))[0]
        wanted = 0.0
        for share, nm in zip(light, fine_nm, strict=True):
            image, outside = psf_of(pupil, field(place - 255.5, nm, focus_um), nm, 24)
            wanted = wanted + share * (1 - outside) * 24**2 * image / image.sum()
        slope2 = (3e-3 / 60) ** 2 * ((place - 255.5) @ (place - 255.5))
        own, oracle = moments(found * (1 + slope2) ** 2), moments(in_pixels(wanted, 24))
        assert own[0] == pytest.approx(oracle[0], abs=1e-3)
        assert own[1:3] == pytest.approx(oracle[1:3], abs=3e-3)
        assert own[3:] == pytest.approx(oracle[3:], rel=1e-2)


def test_what_cannot_be_sampled_is_refused():
    with pytest.raises(InputError, match="write smaller coefficients"):
        diffracted(Pupil(**(BASE | {"terms": (Term(kind="W040", nm=90_000.0),)})), 8)
    with pytest.raises(InputError, match="write --oversampling 10"):
        diffracted(Pupil(**BASE), 1)
