"""Star directions against Astropy (ERFA), and aberration against its textbook figures."""

from __future__ import annotations

import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from astropy.wcs import WCS

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, LIGHT_KM_S
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.frame_files import world_coordinates
from hilstar.server.bench.star_light import bench_moving, bench_stars
from hilstar.sky.catalog import Catalog, load_catalog, plain_catalog
from hilstar.sky.stars import aberrate, unit_vectors_icrs
from tests.support.benches import bench_text
from tests.support.claims import holds

MAS = np.pi / (180 * 3600 * 1000)
ARCSEC = 1000 * MAS
# Of stars beside a pole, which the catalogue does not have.
LIMIT_MAS = 1.0
# Two boosts one after the other are one boost and a rotation by half of beta x beta': 1.4e-9 rad
# for the Earth and an orbit about it. Of 1041 px to a radian that is 1.4e-6 px.
ORBIT_LIMIT_PX = 2e-6
J2000_JD, ALPHA_CENTAURI_HIP = 2_451_545.0, 71_683
# Of a parallax: bent light at another angle to the Sun, and DE421 against ERFA's series.
PARALLAX_SHARE = 1e-3
FAR_FROM_THE_SUN_AU = 1e6  # ERFA bends light by the Sun's potential too
# 2 GM/c^2 of the Sun, 2e-8 AU, over that distance, times beta, is 2e-18 rad: rounding is more
SUN_FAR_AWAY_RAD = 1e-14


def separation_rad(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1))


def moved_by_astropy(catalog: Catalog, epoch_jyear: float) -> np.ndarray:
    """Parallax and radial velocity zero, as Astropy takes them when they are not given."""
    coordinates = SkyCoord(
        ra=catalog.ra_deg * u.deg,
        dec=catalog.dec_deg * u.deg,
        pm_ra_cosdec=catalog.pm_ra_cosdec_mas_yr * u.mas / u.yr,
        pm_dec=catalog.pm_dec_mas_yr * u.mas / u.yr,
        obstime=Time(1991.25, format="jyear", scale="tcb"),
        frame="icrs",
    )
    moved = coordinates.apply_space_motion(
        new_obstime=Time(epoch_jyear, format="jyear", scale="tcb")
    )
    ra, dec = moved.ra.rad, moved.dec.rad
    return np.column_stack((np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)))


# pmsafe's word for a zero parallax, which is meant
@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
@pytest.mark.parametrize("epoch_jyear", [1950.0, 2000.0, 2026.0])
def test_every_star_is_where_astropy_puts_it(epoch_jyear):
    catalog = load_catalog()
    ours = unit_vectors_icrs(catalog, epoch_jyear)
    error_mas = separation_rad(ours, moved_by_astropy(catalog, epoch_jyear)) / MAS
    holds("star-places", error_mas.max())
    # The motion itself is far larger: a catalogue left at its epoch would fail.
    assert separation_rad(ours, unit_vectors_icrs(catalog, 1991.25)).max() / MAS > 50_000


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
def test_stars_within_an_arcsecond_of_a_pole_move_as_well_as_any():
    dec = np.array([90.0, -90.0, 90 - 1e-4, -90 + 1e-4, 90 - 1e-7])
    columns = {
        "v_mag": np.zeros(5),
        "ra_deg": np.array([0.0, 77.0, 200.0, 300.0, 10.0]),
        "dec_deg": dec,
        "pm_ra_cosdec_mas_yr": np.array([1000.0, -500.0, 2000.0, 100.0, -3000.0]),
        "pm_dec_mas_yr": np.array([-300.0, 800.0, 2000.0, -100.0, 3000.0]),
    }
    catalog = plain_catalog("HIP", 5, columns)
    error_mas = (
        separation_rad(unit_vectors_icrs(catalog, 2026.0), moved_by_astropy(catalog, 2026.0)) / MAS
    )
    assert error_mas.max() < LIMIT_MAS


def test_the_axes_of_j2000_are_so_far_from_the_icrs():
    bias = erfa.bp06(J2000_JD, 0.0)[0]
    off_diagonal = [bias[2, 1] - bias[1, 2], bias[0, 2] - bias[2, 0], bias[1, 0] - bias[0, 1]]
    holds("frame-bias", np.linalg.norm(off_diagonal) / 2 / MAS)


def test_the_largest_parallax_of_a_bright_star_is_that_of_alpha_centauri():
    catalog = load_catalog()
    (nearest,) = catalog.parallax_mas[catalog.hip == ALPHA_CENTAURI_HIP]
    holds("alpha-centauri", nearest / 1000)
    assert nearest == catalog.parallax_mas[catalog.v_mag < 6].max()


def test_aberration_at_right_angles_is_20_5_arcsec_at_the_earth_s_speed():
    star = np.array([[1.0, 0.0, 0.0]])
    seen = aberrate(star, (0.0, 29.8, 0.0))
    angle_arcsec = separation_rad(star, seen)[0] / ARCSEC
    # sin = beta, exactly
    assert angle_arcsec == pytest.approx(np.arcsin(29.8 / LIGHT_KM_S) / ARCSEC, rel=1e-9)
    assert angle_arcsec == pytest.approx(20.5, abs=0.01)
    assert seen[0, 1] > 0  # towards the motion


def test_aberration_is_the_exact_formula_at_any_speed(rng):
    """tan(theta'/2) = sqrt((1-b)/(1+b)) tan(theta/2), the half-angle form (Einstein 1905)."""
    for beta in (1e-4, 0.1, 0.9, 0.999):
        velocity = rng.normal(size=3)
        velocity /= np.linalg.norm(velocity)
        stars = rng.normal(size=(200, 3))
        stars /= np.linalg.norm(stars, axis=1, keepdims=True)
        before = np.arccos(np.clip(stars @ velocity, -1, 1))
        seen = aberrate(stars, tuple(velocity * beta * LIGHT_KM_S))
        after = np.arccos(np.clip(seen @ velocity, -1, 1))
        expected = 2 * np.arctan(np.sqrt((1 - beta) / (1 + beta)) * np.tan(before / 2))
        assert np.abs(after - expected).max() < 1e-7  # arccos near its ends knows an angle to 1e-8
        # The star, its image and the velocity lie in one plane.
        assert np.abs(np.einsum("ij,ij->i", seen, np.cross(stars, velocity))).max() < 1e-12


def test_stars_of_a_frame_stand_where_erfa_sees_them_from_a_spacecraft_about_the_earth(
    bench_with, rng
):
    """The Earth's velocity in the bench file, the spacecraft's with each frame; another frame's
    is not left behind.
    """
    earth_km_s, orbit_km_s = np.array([-18.3, 21.4, 9.3]), np.array([3.0, -6.5, 2.5])
    bench = bench_with(f"[sky]\nobserver_velocity_km_s = {earth_km_s.tolist()}\n")
    still = bench_with("")
    q = from_radec_roll_deg(200.0, 35.0, 10.0)
    rotation = bench.camera.cam_to_image @ to_matrix(q)
    for velocity_km_s in (orbit_km_s, -orbit_km_s):
        sprites = bench.light(bench.view(q, velocity_km_s=velocity_km_s))
        assert sprites is not None
        rows = {int(hip): row for row, hip in enumerate(still.shown_stars.hip)}
        natural = np.array(
            [
                still.shown_stars.vectors[rows[int(hip)]]
                for hip in bench.shown_stars.hip[sprites.star]
            ]
        )
        beta = (earth_km_s + velocity_km_s) / LIGHT_KM_S
        seen = erfa.ab(natural, beta, FAR_FROM_THE_SUN_AU, np.sqrt(1 - beta @ beta))
        x_px, y_px = bench.camera.project(seen @ rotation.T)
        assert len(sprites) > 30
        # Two boosts one after the other are one boost and a rotation by half of beta x beta':
        # 1.4e-9 rad for the Earth and an orbit about it. Of 1041 px to a radian that is 1.4e-6 px.
        holds("orbit-stars", np.hypot(x_px - sprites.x_px, y_px - sprites.y_px).max())
    # The orbit's own 5 arcsec are 0.025 px.
    plain = bench.light(bench.view(q))
    assert plain is not None
    assert np.abs(plain.x_px[:30] - sprites.x_px[:30]).max() > 0.01


@pytest.mark.parametrize("axis", range(3))
def test_a_velocity_along_one_axis_moves_all_stars_as_erfa_does(bench_with, axis):
    velocity_km_s = np.zeros(3)
    velocity_km_s[axis] = -29.8
    moving = bench_with(f"[sky]\nobserver_velocity_km_s = {velocity_km_s.tolist()}\n").stars
    still = bench_with("").stars
    rows = {hip: row for row, hip in enumerate(still.hip.tolist())}
    natural = still.vectors[[rows[hip] for hip in moving.hip.tolist()]]
    beta = velocity_km_s / LIGHT_KM_S
    seen = erfa.ab(natural, beta, FAR_FROM_THE_SUN_AU, np.sqrt(1 - beta @ beta))
    assert np.abs(moving.vectors - seen).max() < SUN_FAR_AWAY_RAD


def test_near_stars_are_seen_from_where_the_earth_is(tmp_path):
    """Alpha Centauri (742 mas) and 61 Cygni, against where they are seen without parallax: by
    ERFA's place of the Earth.
    """
    tables = {
        "sky": {"epoch_utc": "2026-11-21T00:00:00Z", "faintest_v_mag": 6.0},
        "spacecraft": {"orbit": "geocentre"},
    }
    file = bench_file_of(tmp_path / "bench.toml", bench_text(tables))
    moving = bench_moving(file.config, file.folder)
    stars = bench_stars(file.config, file.folder, moving)
    vectors = unit_vectors_icrs(stars.catalog, file.config.sky.epoch_jyear)
    far = moving.stars_seen(vectors, np.zeros(len(vectors)))
    _, from_barycentre = erfa.epv00(2_461_365.5, 0.0)  # of that day, midnight
    earth_au = from_barycentre["p"]
    for hip in (71683, 104214):
        star = int(np.flatnonzero(stars.hip == hip)[0])
        direction = far[stars.row[star]]
        parallax_rad = stars.catalog.parallax_mas[stars.row[star]] * 1e-3 / ARCSEC_PER_RAD
        across_au = earth_au - (earth_au @ direction) * direction
        off_rad = stars.vectors[star] - direction + parallax_rad * across_au
        assert np.linalg.norm(off_rad) < PARALLAX_SHARE * parallax_rad


def test_a_spacecraft_s_velocity_joins_that_of_the_earth_by_the_ephemeris(bench_with):
    """As Basilisk's does about the Earth: from its centre, and from there aberrated once more."""
    bench = bench_with(
        '[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\n[spacecraft]\norbit = "geocentre"\n'
    )
    velocity_km_s, q = np.array([3.0, -6.5, 2.5]), from_radec_roll_deg(200.0, 35.0, 10.0)
    sprites = bench.light(bench.view(q, velocity_km_s=velocity_km_s))
    assert sprites is not None
    beta = velocity_km_s / LIGHT_KM_S
    seen = erfa.ab(
        bench.shown_stars.vectors[sprites.star], beta, FAR_FROM_THE_SUN_AU, np.sqrt(1 - beta @ beta)
    )
    x_px, y_px = bench.camera.project(seen @ (bench.camera.cam_to_image @ to_matrix(q)).T)
    assert len(sprites) > 30
    assert np.hypot(x_px - sprites.x_px, y_px - sprites.y_px).max() < ORBIT_LIMIT_PX


def test_pixels_are_those_of_astropy_s_tangent_projection(bench_with, rng):
    """Our camera against WCSLIB's TAN, alignment and principal point included."""
    bench = bench_with(
        "q_cam_to_mon = [0.99, 0.05, -0.1, 0.0854]\nprincipal_point_px = [140.0, 130.5]\n"
    )
    for ra, dec, roll in ((84.0, -1.2, 0.0), (0.001, 89.7, 33.0), (359.9, -60.0, 250.0)):
        q = from_radec_roll_deg(ra, dec, roll)
        sprites = bench.sprites(q)
        vectors = bench.stars.vectors[sprites.star]
        star_ra, star_dec = np.arctan2(vectors[:, 1], vectors[:, 0]), np.arcsin(vectors[:, 2])
        wcs = WCS({"NAXIS": 2} | world_coordinates(bench.camera, q))
        x, y = wcs.all_world2pix(np.degrees(star_ra), np.degrees(star_dec), 0)
        assert len(sprites) > 50
        # Degrees in float64 know a direction to 5e-14 deg; arcsin near the pole to 1e-8 rad, 1e-5
        # px here.
        assert np.hypot(x - sprites.x_px, y - sprites.y_px).max() < 2e-5
        normal = (bench.camera.cam_to_image @ to_matrix(q))[2]
        assert wcs.wcs.crval[1] == pytest.approx(np.degrees(np.arcsin(normal[2])), abs=1e-6)
