"""Published rigs: what pixels, camera and centroiders predict of the figures that their authors
state.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.instruments.study import rigs

# An even error of a pixel's width: its rms is within 10 % of a twelfth's root, of 80 stars
PIXEL_ARCSEC = 57.65109021605092e-3 / 350 * 206264.806 / math.sqrt(12)
EVEN = 0.1
# hilstar's codes on the same panel, measured outside by another centroider: 0.082 arcsec
CODES_ARCSEC, CODES_MAG = 0.082, 0.0054
# A scatter by 40 exposures has 11 % of error, the fit of the light as much; the rig's frames have
# a background of their own, whose centre of mass scatters twice as much.
FACTOR = 2.5
GRID_PX = 1e-9


@pytest.fixture(scope="module")
def rigs_study(whole_study):
    found = whole_study("rigs", {"rigs"})
    return found.folder, found.findings, {row["figure"]: row for row in found.rows("rigs")}


def figures(rigs_study, figure):
    row = rigs_study[2][figure]
    return tuple(float(row[name]) for name in ("published", "predicted", "with_hilstar"))


def test_one_pixel_a_star_leaves_a_pixel_s_own_error_and_hilstar_s_codes_a_hundredth(rigs_study):
    _, lines, rows = rigs_study
    assert len(lines) == 1 + len(rows)
    published, predicted, after = figures(rigs_study, "places, one pixel a star")
    assert predicted == pytest.approx(PIXEL_ARCSEC, rel=EVEN)
    assert published == pytest.approx(PIXEL_ARCSEC, rel=EVEN)
    assert after < CODES_ARCSEC
    assert figures(rigs_study, "light, hilstar's codes")[1] < CODES_MAG


def test_one_light_of_a_star_predicts_all_static_scatters(rigs_study):
    for name in rigs.SCATTER_ARCSEC:
        for what in ("about", "across"):
            fitted = " (fitted)" if (name, what) == (rigs.FITTED, "across") else ""
            published, predicted, after = figures(
                rigs_study, f"static scatter {what}, {name}{fitted}"
            )
            assert 1 / FACTOR < predicted / published < FACTOR
            # a display that stands still scatters nothing: it is the camera's own
            assert after == pytest.approx(predicted, rel=0.5)
    assert figures(rigs_study, "constant error of an attitude, across")[1] > 1.0
    assert figures(rigs_study, "constant error of an attitude, across")[2] < 0.05


def test_pixels_explain_naples_s_tracking(rigs_study):
    for what in ("about", "across"):
        published, predicted, _ = figures(rigs_study, f"precision of tracking {what}")
        assert published / 2 < predicted < published


def test_a_gaussian_on_no_background_is_found_exactly_by_its_grid():
    at = np.arange(21)
    x, y = 10.31, 9.77
    image = 1e6 * np.exp(-((at[None] - x) ** 2 + (at[:, None] - y) ** 2) / 2 / 0.85**2)
    found_x, found_y = rigs.gaussian_grid(image, np.array([10]), np.array([10]))
    inside = rigs.stamps_at(image, np.array([10]), np.array([10]), rigs.GRID_HALF_PX)
    assert inside.min() > 1.0  # nothing is cut at 1
    assert found_x[0] == pytest.approx(x, abs=GRID_PX)
    assert found_y[0] == pytest.approx(y, abs=GRID_PX)


def test_the_rig_s_field_is_a_pinhole_s_before_whole_pixels_of_its_panel():
    """The celestial pole, by the camera's own focal length; each star in the middle of a pixel."""
    field = rigs.rig_field()
    slopes = (field.directions[:, :2] / field.directions[:, 2:]).T
    middle_px = np.array(rigs.PRINCIPAL_PX)[:, None]
    np.testing.assert_allclose(field.true_px, rigs.FOCAL_PX * slopes + middle_px, rtol=1e-12)
    pixel_px = rigs.FOCAL_PX * rigs.PIXEL_MM / rigs.LENS_MM
    off = (field.pixel_px - field.true_px) / pixel_px
    assert (np.abs(off) <= 0.5 + 1e-9).all()
    # an even error: its rms is a twelfth's root
    assert np.sqrt((off**2).mean()) == pytest.approx(math.sqrt(1 / 12), rel=0.35)
    # each place is the middle of a pixel of the panel, whose middle is between two
    panel = (field.pixel_px - middle_px) / pixel_px
    np.testing.assert_allclose(panel - np.floor(panel), 0.5, atol=1e-6)
    width, height = rigs.CAMERA_PX
    assert (field.pixel_px > rigs.EDGE_PX).all()
    assert (field.pixel_px[0] < width - rigs.EDGE_PX).all()
    assert (field.pixel_px[1] < height - rigs.EDGE_PX).all()
    assert np.linalg.norm(field.directions, axis=1) == pytest.approx(1.0)
    assert field.directions.shape[0] == field.true_px.shape[1] > 5


def test_a_scatter_falls_with_light_and_is_largest_about_the_boresight():
    """About it the lever is the stars' distance from it, across it the focal length."""
    field = rigs.rig_field()
    faint, bright = (
        rigs.scatter_arcsec(field, field.pixel_px, star_dn, exposures=8)
        for star_dn in (60.0, 200.0)
    )
    assert list(faint) == list(rigs.SCATTER_ARCSEC)
    for name in faint:
        about, *across = bright[name]
        assert about > 3 * max(across)
    assert (bright["network"] < faint["network"]).all()
    # three times the light, against noise that is mostly of reading and background
    ratio = np.mean(faint["network"] / bright["network"])
    assert 1.5 < ratio < 6


def test_a_pixel_a_star_leaves_its_own_error_and_codes_less():
    rounded, placed, light = rigs.place_rows(2)
    assert rounded.predicted == pytest.approx(PIXEL_ARCSEC, rel=0.15)
    assert rounded.with_hilstar == placed.predicted < 2 * CODES_ARCSEC
    assert light.predicted < 2 * CODES_MAG
    assert rounded.difference == pytest.approx(rounded.published - rounded.predicted)
    assert [row.unit for row in (rounded, placed, light)] == [
        "arcsec rms an axis",
        "arcsec rms an axis",
        "mag rms",
    ]


def test_a_star_s_corner_is_its_area_s_middle_rounded_down():
    """Of areas of two by two and of three by three, one lit as the threshold, one of three pixels
    and one at the edge of what is read.
    """
    width, height = rigs.CAMERA_PX
    image = np.full((height, width), rigs.DARK_DN)
    lit = rigs.DARK_DN + rigs.THRESHOLD_DN + 0.1
    image[100:102, 51:53] = lit
    image[200:203, 70:73] = [[lit, lit, lit], [lit, 1000.0, lit], [lit, lit, 5000.0]]
    image[300:304, 80:84] = rigs.DARK_DN + rigs.THRESHOLD_DN
    image[50, 40:43] = lit
    image[101:103, width - rigs.EDGE_PX : width - rigs.EDGE_PX + 2] = lit
    columns, rows = rigs.found_stars(image)
    assert (columns.tolist(), rows.tolist()) == ([51, 71], [100, 201])
