"""FITS keywords of a bent image, as Astropy reads them from the file, against the geometry
file's own formulas.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.optics.camera import Lens, ResidualField, bounded
from hilstar.server.bench.frame_files import MAX_SIP_PX, world_coordinates, write_frame_fits
from tests.support.claims import holds
from tests.support.real_lens import SIZE, true_places_px

ATTITUDES = [(84.0, -1.2, 30.0), (283.0, 89.2, -170.0), (359.9, -60.0, 100.0)]
# The header's own figure is of 25 places along each side.
BETWEEN_PLACES = 1.25


def sky_of(camera, q, x_px, y_px):
    """Right ascension and declination, degrees, of pixels, and the directions in cam."""
    cam = camera.rays(x_px, y_px)
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    icrs = cam @ to_matrix(q)
    return np.degrees(np.arctan2(icrs[:, 1], icrs[:, 0])), np.degrees(np.arcsin(icrs[:, 2])), cam


def whole_screen():
    x, y = np.meshgrid(np.linspace(-0.5, SIZE[0] - 0.5, 97), np.linspace(-0.5, SIZE[1] - 0.5, 55))
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("radec_roll", ATTITUDES)
def test_a_fits_file_of_a_bent_sky_is_read_within_what_it_says(
    lens_bench, lens_folder, tmp_path, radec_roll
):
    q = from_radec_roll_deg(*radec_roll)
    write_frame_fits(tmp_path / "f.fits", lens_bench, lens_bench.frame(q))
    header = fits.getheader(tmp_path / "f.fits")
    assert (header["CTYPE1"], header["LENS"]) == ("RA---TAN-SIP", True)
    assert header["LENSERR"] < MAX_SIP_PX
    ra_deg, dec_deg, cam = sky_of(lens_bench.camera, q, *whole_screen())
    true = np.column_stack(true_places_px(lens_folder, cam))
    wcs = WCS(header)
    # SIP alone finds the pixel by iteration; the polynomials AP and BP do so at once.
    flat = np.column_stack(wcs.wcs_world2pix(ra_deg, dec_deg, 0)) - (wcs.wcs.crpix - 1)
    inverse = [
        flat[:, k] + _polynomial(header, name, flat) + wcs.wcs.crpix[k] - 1
        for k, name in enumerate(("AP", "BP"))
    ]
    ways = {"iterated": wcs.all_world2pix(ra_deg, dec_deg, 0), "inverse": inverse}
    for way, (x_px, y_px) in ways.items():
        off = np.hypot(x_px - true[:, 0], y_px - true[:, 1]).max()
        # to 1e-4 px Astropy iterates
        assert off < BETWEEN_PLACES * header["LENSERR"] + 1e-4, way
        holds("sip", off)
    plain = WCS(
        {
            key: header[key]
            for key in header
            if not key.startswith(("A_", "B_", "AP_", "BP_", "LENS"))
        }
    )
    plain.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    x_px, y_px = plain.all_world2pix(ra_deg, dec_deg, 0)
    # what the polynomials are worth
    plain_px = np.hypot(x_px - true[:, 0], y_px - true[:, 1]).max()
    holds("tan-alone", plain_px)


def _polynomial(header, name, at):
    order = header[f"{name}_ORDER"]
    powers = [(p, q) for p in range(order + 1) for q in range(order + 1 - p)]
    return sum(
        header.get(f"{name}_{p}_{q}", 0.0) * at[:, 0] ** p * at[:, 1] ** q for p, q in powers
    )


def test_a_bent_image_s_keywords_lead_to_the_lens_s_own_places_either_way():
    """By Astropy's iteration and by the header's inverse, as far off as the header says."""
    lens = Lens(radial=(-0.4, 0.1, 0.0), tangential=(0.02, -0.03))
    straight = monitor_camera(SIZE, 57.65, 350.0, np.array([1.0, 0.0, 0.0, 0.0]))
    bent = bounded(replace(straight, lens=lens), 6.0)
    q = from_radec_roll_deg(*ATTITUDES[2])
    keywords = world_coordinates(bent, q)
    assert keywords["CTYPE2"] == "DEC--TAN-SIP"
    ra_deg, dec_deg, _ = sky_of(bent, q, *whole_screen())
    wcs = WCS({"NAXIS": 2} | keywords)
    at_x, at_y = whole_screen()
    flat = np.column_stack(wcs.wcs_world2pix(ra_deg, dec_deg, 0)) - (wcs.wcs.crpix - 1)
    x_px = flat[:, 0] + _polynomial(keywords, "AP", flat) + wcs.wcs.crpix[0] - 1
    y_px = flat[:, 1] + _polynomial(keywords, "BP", flat) + wcs.wcs.crpix[1] - 1
    inverse_px = np.hypot(x_px - at_x, y_px - at_y).max()
    iterated = np.array(wcs.all_world2pix(ra_deg, dec_deg, 0)) - whole_screen()
    iterated_px = np.hypot(*iterated).max()
    largest_px = max(inverse_px, iterated_px)
    assert largest_px < BETWEEN_PLACES * keywords["LENSERR"] + 1e-4
    # the lens itself is a polynomial of directions
    assert inverse_px < 1e-6 and largest_px > keywords["LENSERR"] / BETWEEN_PLACES


def test_a_lens_that_no_sip_fits_leaves_tan_and_says_how_far_it_is_off(rng):
    camera = monitor_camera(SIZE, 57.65, 350.0, np.array([1.0, 0.0, 0.0, 0.0]))
    x, y = np.zeros((16, 16)), np.zeros((16, 16))
    x[15, 0] = y[0, 15] = 0.4  # a ripple of degree 15
    bent = bounded(replace(camera, lens=Lens(field=ResidualField(x, y, SIZE))), 6.0)
    q = from_radec_roll_deg(*ATTITUDES[0])
    keywords = world_coordinates(bent, q)
    assert keywords["CTYPE1"] == "RA---TAN" and "A_ORDER" not in keywords
    ra_deg, dec_deg, _ = sky_of(bent, q, *whole_screen())
    x_px, y_px = WCS({"NAXIS": 2} | keywords).all_world2pix(ra_deg, dec_deg, 0)
    at_x, at_y = whole_screen()
    off = np.hypot(x_px - at_x, y_px - at_y).max()
    assert MAX_SIP_PX < off < BETWEEN_PLACES * keywords["LENSERR"]


def test_a_pinhole_has_tan_alone():
    camera = monitor_camera(SIZE, 57.65, 350.0, np.array([1.0, 0.0, 0.0, 0.0]))
    keywords = world_coordinates(camera, from_radec_roll_deg(*ATTITUDES[1]))
    assert keywords["CTYPE1"] == "RA---TAN"
    assert not {"LENS", "A_ORDER"} & set(keywords)
