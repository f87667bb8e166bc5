"""How a photograph is judged, part by part: noise of light, what explains a source, what is missing
and where it is dim, and what moves between photographs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.confront.background import SkyLevel
from hilstar.instruments.confront.camera_fit import CameraFit, Pointing
from hilstar.instruments.confront.judge import (
    Expected,
    StarRow,
    _dim_regions,
    _Explanation,
    _judged_cell,
    _star_row,
    background_of,
    boresights_moved_px,
    chi2_of,
    dated_by,
    in_sigmas,
    missing_stars,
    planets_on,
    utc_of,
)
from hilstar.instruments.confront.photographed_sky import DatedSky
from hilstar.instruments.confront.session import MATCH_PX
from hilstar.optics.camera import Camera
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import unit_vectors_icrs
from tests.support.confrontations import a_shot, a_star, seen_shot, sources_at

SIZE_PX = (800, 400)
FOCAL_PX = 3000.0
CAMERA = Camera(SIZE_PX, FOCAL_PX, (410.0, 190.0), np.eye(3), None)


def test_a_residual_is_in_sigmas_of_background_and_shot_noise():
    """4 DN of background and 100 DN of light at 4 e- a DN, which has a variance of 25 DN^2; light
    below 0 has none.
    """
    off_dn = np.array([10.0, 10.0, -6.0])
    light_dn = np.array([0.0, 100.0, -100.0])
    found = in_sigmas(off_dn, light_dn, np.full(3, 16.0), 4.0)
    assert found == pytest.approx([2.5, 10 / math.sqrt(41), -1.5])


def test_a_background_s_chi_square_is_without_what_is_no_background():
    assert chi2_of(np.array([1.0, -2.0, 4.99, -5.01, 80.0])) == pytest.approx((1 + 4 + 4.99**2) / 3)
    assert math.isnan(chi2_of(np.array([9.0])))


def test_a_photograph_s_time_is_kept_to_the_millisecond():
    t_ns = int(np.datetime64("2026-03-20T21:34:56.789", "ns").astype(np.int64))
    assert utc_of(t_ns + 999_999) == "2026-03-20T21:34:56.789Z"


def pointing(ra_deg: float, dec_deg: float) -> Pointing:
    return Pointing(from_radec_roll_deg(ra_deg, dec_deg, 0.0))


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0)])
def test_photographs_have_moved_by_the_largest_part_of_their_boresights(along):
    """0.01 rad along one axis of the sky, of 3000 px a radian."""
    turn_deg = math.degrees(0.01)
    turned = [pointing(part * along[0], part * along[1]) for part in (0, turn_deg, turn_deg / 2)]
    assert boresights_moved_px(CameraFit(CAMERA, tuple(turned), "")) == pytest.approx(30, rel=1e-3)


def test_planets_beside_the_image_have_their_places_and_those_behind_none():
    """Jupiter and Saturn stood 6.1 arcmin apart, at RA 302.6 and Dec -20.5, on 2020-12-21; Neptune
    47 degrees to the east, and Uranus 97.
    """
    t_ns = int(np.datetime64("2020-12-21T18:20:00", "ns").astype(np.int64))
    places = planets_on(t_ns, pointing(302.6, -20.5), CAMERA)
    jupiter_px, saturn_px = np.array(places["Jupiter"]), np.array(places["Saturn"])
    assert math.dist(jupiter_px, CAMERA.principal_point_px) < FOCAL_PX * math.radians(0.2)
    apart_px = FOCAL_PX * math.radians(6.1 / 60)
    assert math.dist(jupiter_px, saturn_px) == pytest.approx(apart_px, rel=0.03)
    neptune_px = CAMERA.principal_point_px[0] - FOCAL_PX * math.tan(math.radians(47))
    assert places["Neptune"][0] == pytest.approx(neptune_px, rel=0.1)
    assert "Uranus" not in places
    assert planets_on(None, pointing(302.6, -20.5), CAMERA) == {}


def expected(places_px: list[tuple[float, float]], dn: list[float]) -> Expected:
    x_px, y_px = np.array(places_px, dtype=float).T
    return Expected(10 + np.arange(len(dn)), x_px, y_px, np.array(dn))


def explanation(stars: Expected, snr: float, length_px: float) -> _Explanation:
    """One source at (100, 50), of pixels with a noise of 2 DN."""
    sources = sources_at([(100.0, 50.0)], snr=snr, length_px=length_px)
    return _Explanation(
        shot=replace(a_shot(0), sources=sources),
        expected=stars,
        tree=cKDTree(np.column_stack([stars.x_px, stars.y_px])),
        planets={},
        satellites={},
        near_saturated=lambda x_px, y_px: False,
        hot=np.zeros((9, 9), dtype=bool),
        light_sigma=np.zeros((9, 9)),
        pixel_dn=2.0,
        focal_length_px=FOCAL_PX,
    )


def test_a_source_is_the_brightest_of_the_stars_beside_it_if_these_have_light_enough():
    """A signal of 50 is 50 x 2 x sqrt(4 pi) = 354 DN, of which 15 % are 53: of all stars together."""
    stars = expected([(101.0, 50.0), (100.0, 51.5), (100.0, 49.0), (140.0, 50.0)], [9, 30, 20, 999])
    assert explanation(stars, 50.0, 3.0)._brightest_star(0, (100.0, 50.0)) == 11
    assert explanation(stars, 60.0, 3.0)._brightest_star(0, (100.0, 50.0)) is None
    # half of a long source is beside it
    assert explanation(stars, 50.0, 90.0)._brightest_star(0, (100.0, 50.0)) == 13
    alone = expected([(103.6, 50.0)], [999.0])
    is_near = MATCH_PX + 0.5 >= 3.6
    found = explanation(alone, 50.0, 3.0)._brightest_star(0, (100.0, 50.0))
    assert (found == 10) is is_near


def test_missing_stars_are_bright_alone_and_within_the_image():
    """Of ten pixels' noise of 1 DN a star of 60 DN stands out: those beside a source, an identified
    or a saturated star, at the edge, or with half of their light, are not missing.
    """
    edge_px = 2 * MATCH_PX
    places = [(100.0, 100.0), (200.0, 100.0), (300.0, 100.0), (edge_px - 0.5, 200.0)]
    places += [(500.0, 100.0), (600.0, 100.0), (700.0, 100.0), (edge_px + 0.5, 300.0)]
    stars = expected(places, [60, 60, 60, 60, 60, 60, 50, 60])
    above_dn = np.zeros((400, 800))
    above_dn[100, 500] = 30.5
    above_dn[99, 600] = 29.5
    flat = np.zeros_like(above_dn)
    shot = seen_shot(
        [(330.0, 100.0), (305.0, 100.0)],
        [99, 98],
        photo=replace(a_shot(0).photo, dn=above_dn),
        level=SkyLevel(flat, flat + 1.0, 16),
        saturated=np.array([False, True]),
        sources=sources_at([(200.0, 100.0 + edge_px - 0.1)]),
    )
    assert list(missing_stars(shot, stars, 1.0)) == [10, 15, 17]
    shot.star = np.array([10, 98])
    assert list(missing_stars(shot, stars, 1.0)) == [15, 17]


def row_at(x_px: float, y_px: float, off_mag: float, **changes: Any) -> StarRow:
    """A star of 1000 DN that is too faint by so much."""
    light = {"dn": 1000 * 10 ** (-0.4 * off_mag), "dn_predicted": 1000.0, "sigma_dn": 1.0}
    return a_star("", 1, 4.0, (x_px, y_px), **(light | changes))


def test_a_star_s_row_has_what_was_measured_beside_what_the_catalogue_foretells():
    """Of the third expected star, which is the second row of a catalogue in another order."""
    columns = {
        "hip": np.array([71, 72, 73, 74], dtype=np.int32),
        "v_mag": np.array([1.5, 2.5, 3.5, 4.5]),
        "bv_mag": np.array([0.1, 0.2, 0.3, 0.4]),
        "ra_deg": np.zeros(4),
        "dec_deg": np.zeros(4),
    }
    order = np.array([3, 0, 1, 2])
    sky = DatedSky(plain_catalog("HIP", 4, columns), 2020.0, None, np.zeros((4, 3)), order)
    stars = Expected(
        star=np.array([0, 1, 2, 3]),
        x_px=np.array([10.0, 20.0, 30.0, 40.0]),
        y_px=np.array([11.0, 21.0, 31.0, 41.0]),
        dn=np.array([100.0, 200.0, 300.0, 400.0]),
    )
    shot = replace(a_shot(0), sky=sky)
    seen = _star_row(shot, stars, 2, np.array([30.5, 30.25, 280.0, 7.0]), ("double",))
    assert seen == StarRow(
        star=2,
        hip=72,
        name="HIP 72",
        x_px=30.5,
        y_px=30.25,
        x_predicted_px=30.0,
        y_predicted_px=31.0,
        dn=280.0,
        sigma_dn=7.0,
        dn_predicted=300.0,
        v_mag=2.5,
        b_v_mag=0.2,
        flags=("double",),
    )


def missing_at(x_px: float, y_px: float) -> StarRow:
    return row_at(x_px, y_px, 0.0, dn=math.nan, flags=("missing",))


@pytest.mark.parametrize(
    ("rows", "is_dim"),
    [
        ([missing_at(1.0, 1.0)], False),  # one star says nothing
        ([missing_at(1.0, 1.0)] * 2, True),
        ([missing_at(1.0, 1.0), row_at(2.0, 2.0, 0.0)], True),
        ([missing_at(1.0, 1.0), *[row_at(2.0, 2.0, 0.0)] * 2], False),
        ([row_at(2.0, 2.0, 0.26)] * 2, True),
        ([row_at(2.0, 2.0, 0.24)] * 2, False),
        ([row_at(2.0, 2.0, 0.9)], False),
    ],
)
def test_a_part_of_an_image_is_dim_by_two_stars_or_more(rows, is_dim):
    cell, found = _judged_cell(rows, 0.01)
    assert found is is_dim
    assert (cell.count, cell.missing) == (len(rows), sum("missing" in row.flags for row in rows))
    # stars that scatter by 0.2 mag are dim only beyond four sigmas of their mean
    assert not _judged_cell([row_at(2.0, 2.0, 0.5)] * 2, 0.2)[1]


@pytest.mark.parametrize(
    ("x_px", "y_px", "name"),
    [
        (399.0, 199.0, "upper left"),
        (401.0, 199.0, "upper right"),
        (399.0, 201.0, "lower left"),
        (401.0, 201.0, "lower right"),
        (799.4, 399.4, "lower right"),
        (-2.0, -2.0, "upper left"),
    ],
)
def test_dim_parts_are_named_by_the_quarter_of_an_image_that_is_no_square(x_px, y_px, name):
    elsewhere = [row_at(x, y, 0.0) for x in (150.0, 650.0) for y in (150.0, 250.0)] * 4
    dim = [missing_at(x_px, y_px), missing_at(x_px, y_px), row_at(x_px, y_px, 0.8)]
    texts, is_dim = _dim_regions([*elsewhere, *dim], SIZE_PX)
    assert texts == [
        f"{name}: 2 of 3 stars are missing, those seen 0.80 mag too faint: cloud, an obstacle, or"
        " vignetting"
    ]
    # a faint star beside the part is in it, one with all of its light is not
    assert is_dim(row_at(x_px, y_px, 0.5))
    assert not is_dim(row_at(x_px, y_px, 0.1))


@pytest.mark.parametrize(("floor_px", "used_px"), [(0.3, 0.3), (0.001, 0.02)])
def test_a_date_is_told_by_the_stars_that_move_and_by_their_places_errors(floor_px, used_px):
    """Four stars move by 0.4 px a year to the east, which is left, and are 0.8 px on: two years
    late, by places that are known to 0.4 px each and to the camera's floor. The fifth is not clean.
    """
    places_deg = np.array([[359.9, 0.1], [0.3, -0.2], [0.2, 0.4], [0.0, 0.0], [1.0, 1.0]])
    ra_deg, dec_deg = places_deg.T
    mas_yr = math.degrees(0.4 / FOCAL_PX) * 3.6e6
    columns = {"ra_deg": ra_deg, "dec_deg": dec_deg, "v_mag": np.full(5, 4.0)}
    catalog = plain_catalog("HIP", 5, columns | {"pm_ra_cosdec_mas_yr": np.full(5, mas_yr)})
    order = np.array([4, 3, 2, 1, 0])
    vectors = unit_vectors_icrs(catalog, 2020.0)[order]
    camera = CameraFit(CAMERA, (pointing(0.0, 0.0),), "", floor_px=floor_px)
    star = [3, 0, 4, 1, 2]
    now_px = np.column_stack(camera.pointings[0].places_px(CAMERA, vectors[star]))
    blended = np.array([False, True, False, False, False])
    sky = DatedSky(catalog, 2020.0, None, vectors, order)
    shot = seen_shot(now_px - [0.8, 0.0], star, sky=sky, blended=blended)
    shot.found.sigma_px[:] = 0.4
    shot.found.x_px[1] += 50.0
    found = dated_by(shot, camera.pointings[0], camera)
    assert found is not None
    # along the image's plane a degree from its middle is 1.0003 times as long
    assert found.years == pytest.approx(2.0, rel=1e-3)
    assert found.sigma == pytest.approx(math.hypot(0.4, used_px) / (0.4 * 2), rel=1e-3)
    shot.blended = np.ones(5, dtype=bool)
    assert dated_by(shot, camera.pointings[0], camera) is None


def test_a_background_has_neither_light_nor_sources_nor_defects():
    """A hot pixel and a dead one, stars' light of over a tenth of a sigma, and a source with its
    neighbours.
    """
    shot = a_shot(0)
    height, width = shot.photo.dn.shape
    hot = np.zeros((height, width), dtype=bool)
    dead = hot.copy()
    hot[3, 4] = dead[50, 60] = True
    light_sigma = np.zeros((height, width))
    light_sigma[10, 20] = 0.11
    light_sigma[10, 40] = 0.09
    background = background_of(shot, light_sigma, hot, dead)
    left_out = np.argwhere(~background).tolist()
    assert left_out == [[3, 4], [10, 20], [50, 60]]
    shot.sources = sources_at([(30.0, 30.0)])
    with_source = background_of(shot, light_sigma, hot, dead)
    assert not with_source[30, 30]
    assert with_source.sum() < background.sum()
