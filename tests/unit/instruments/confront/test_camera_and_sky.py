"""The camera of photographs by the places of their stars, the attitude of one of which nothing is
known, and what a photograph's stars and sources say of clouds: each planted in closed form.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import binom

from hilstar.basics.rotation import from_matrix, from_rotation_vector, multiply, to_matrix
from hilstar.instruments.confront import lost_in_space
from hilstar.instruments.confront.camera_fit import (
    GAIN,
    CameraFit,
    Places,
    Pointing,
    _with_zenith,
    fit_camera,
    refracted,
    with_values,
)
from hilstar.instruments.confront.judge import _dim_regions, _Explanation
from hilstar.instruments.confront.lost_in_space import (
    CIRCLE,
    MAX_CHANCE,
    STARS_A_CIRCLE,
    SourceField,
    _by_hypothesis,
    _Proof,
    _triangles_of_sky,
    nearest_once,
    solve_lost,
    turned,
)
from hilstar.instruments.confront.photographed_sky import DatedSky
from hilstar.instruments.confront.session import _solve
from hilstar.optics.camera import Camera, Lens
from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import AirAbove
from tests.support.confrontations import a_shot, sources_at
from tests.support.planted_sky import rotation_of
from tests.unit.instruments.confront.test_parts import row_of

WIDE_PX, HIGH_PX = SIZE_PX = (640, 480)
FOCAL_PX, K1, CENTRE_PX = 1500.0, 0.3, (326.0, 234.0)
NOISE_PX = 0.02
POINTINGS_DEG = ((40.0, 20.0, 10.0), (43.0, 24.0, -60.0), (38.0, 17.0, 130.0))
ARCSEC = np.radians(1 / 3600)


def seen_px(cam: np.ndarray) -> np.ndarray:
    """Places (n, 2) of directions (n, 3) through the planted lens: a radial law of the tangents."""
    tangents = cam[:, :2] / cam[:, 2:]
    squares = (tangents**2).sum(axis=1, keepdims=True)
    return np.array(CENTRE_PX) + FOCAL_PX * tangents * (1 + K1 * squares)


def photographed(rng, pointing_deg, stars: int = 40) -> tuple[np.ndarray, Places]:
    """The turn of a photograph, ICRS to cam, and stars all over it, to NOISE_PX."""
    turn = rotation_of(*pointing_deg)
    tangents = rng.uniform([-0.2, -0.15], [0.2, 0.15], (stars, 2))
    cam = np.column_stack([tangents, np.ones(stars)])
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    x_px, y_px = (seen_px(cam) + NOISE_PX * rng.standard_normal((stars, 2))).T
    return turn, Places(x_px, y_px, np.full(stars, NOISE_PX), cam @ turn)


def fitted(rng, base: Camera, *, fixed: bool) -> tuple[CameraFit, list[np.ndarray], list[Places]]:
    """The camera by all photographs, whose attitudes begin a tenth of a degree off."""
    turns, photographs, pointings = [], [], []
    for pointing_deg in POINTINGS_DEG:
        turn, places = photographed(rng, pointing_deg)
        off = from_rotation_vector(np.radians([0.06, -0.08, 0.1]))
        turns.append(turn)
        photographs.append(places)
        # an air that bends nothing: refraction is not looked for
        air = AirAbove(np.array([0.0, 0.0, 1.0]), (0.0, 0.0))
        pointings.append(Pointing(multiply(off, from_matrix(turn)), air=air))
    return fit_camera(base, pointings, photographs, fixed=fixed, last=True), turns, photographs


def test_a_planted_camera_and_its_attitudes_come_back(rng):
    """Of 120 stars to 0.02 px: five sigmas of each figure by the fit's own errors."""
    base = Camera(SIZE_PX, 1.03 * FOCAL_PX, (319.5, 239.5), np.eye(3))
    fit, turns, photographs = fitted(rng, base, fixed=False)
    assert fit.model.startswith("k1")
    # of 240 residuals, those of 20 % held out by fits of the others: more by their freedom
    assert fit.held_out_px[fit.model] == pytest.approx(NOISE_PX, rel=0.2)
    camera = fit.camera
    assert camera.focal_length_px == pytest.approx(
        FOCAL_PX, abs=5 * FOCAL_PX * fit.sigma["log_focal"]
    )
    assert 0 < fit.sigma["log_focal"] < 1e-3
    assert camera.lens.radial[0] == pytest.approx(K1, abs=5 * fit.sigma["k1"])
    for found, true, name in zip(
        camera.principal_point_px, CENTRE_PX, ("centre_x", "centre_y"), strict=True
    ):
        assert found == pytest.approx(true, abs=5 * fit.sigma[name])
    for off_px in fit.residuals_px(photographs):
        assert off_px.std() == pytest.approx(NOISE_PX, rel=0.3)
    for pointing, turn in zip(fit.pointings, turns, strict=True):
        # the principal point's error turns the boresight with it: the middle of the image stays
        ray = camera.rays(np.array([319.5]), np.array([239.5])) @ to_matrix(pointing.q_icrs_to_cam)
        true_px = seen_px(ray / np.linalg.norm(ray) @ turn.T)
        assert true_px[0] == pytest.approx([319.5, 239.5], abs=0.05)


def test_a_camera_that_is_fixed_keeps_its_lens_and_finds_its_attitudes(rng):
    base = Camera(SIZE_PX, FOCAL_PX, CENTRE_PX, np.eye(3), lens=Lens((K1, 0.0, 0.0)))
    fit, turns, _ = fitted(rng, base, fixed=True)
    assert (fit.camera.focal_length_px, fit.camera.principal_point_px) == (FOCAL_PX, CENTRE_PX)
    for pointing, turn in zip(fit.pointings, turns, strict=True):
        error = to_matrix(pointing.q_icrs_to_cam) @ turn.T
        off_rad = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0]]) / 2
        # 40 stars of 0.02 px: 0.003 px of 1500 px, and five sigmas
        assert np.abs(off_rad).max() < 5 * NOISE_PX / np.sqrt(40) / FOCAL_PX


def test_values_count_from_the_camera_s_own_focal_length_and_point():
    lens = Lens((0.1, 0.2, 0.3), (0.01, 0.02))
    base = Camera(SIZE_PX, 1000.0, (300.0, 200.0), np.eye(3), lens=lens)
    changed = with_values(base, {"log_focal": np.log(1.1), "centre_y": -3.0, "k2": 0.5})
    assert changed.focal_length_px == pytest.approx(1100.0)
    assert changed.principal_point_px == (300.0, 197.0)
    assert (changed.lens.radial, changed.lens.tangential) == ((0.1, 0.5, 0.3), (0.01, 0.02))
    tangential = with_values(base, {"p1": 0.03, "p2": -0.04, "k1": 0.5}).lens
    assert (tangential.radial, tangential.tangential) == ((0.5, 0.2, 0.3), (0.03, -0.04))
    assert with_values(base, {}).lens == base.lens


@pytest.mark.parametrize("zenith_deg", [20.0, 45.0, 60.0])
def test_air_lifts_a_star_by_58_arcsec_times_the_tangent_of_its_zenith_distance(zenith_deg):
    """The boresight, with the zenith along the image's x."""
    zenith = np.array([[np.tan(np.radians(zenith_deg)), 0.0]])
    bent = refracted(np.array([[0.0, 0.0, 1.0]]), zenith)
    lifted_arcsec = np.arctan2(bent[0, 0], bent[0, 2]) / ARCSEC
    # 58.3 arcsec (Saastamoinen's first term), whose second is a thousandth of it here
    assert lifted_arcsec == pytest.approx(58.3 * np.tan(np.radians(zenith_deg)), rel=5e-3)
    assert bent[0, 1] == 0.0


def sky_of(rng, count: int = 300) -> np.ndarray:
    """Stars evenly over a cap about a direction, ICRS."""
    middle = rotation_of(40.0, 20.0, 0.0)
    tangents = rng.uniform(-0.4, 0.4, (count, 2))
    cam = np.column_stack([tangents, np.ones(count)])
    return (cam / np.linalg.norm(cam, axis=1, keepdims=True)) @ middle


def field_of(vectors: np.ndarray, turn: np.ndarray) -> tuple[SourceField, np.ndarray]:
    """The sources of a photograph so turned, and the row of the star of each."""
    cam = vectors @ turn.T
    places_px = FOCAL_PX * cam[:, :2] / cam[:, 2:]
    inside = (np.abs(places_px) < [WIDE_PX / 2, HIGH_PX / 2]).all(axis=1) & (cam[:, 2] > 0)
    return SourceField(places_px[inside], WIDE_PX, HIGH_PX), np.flatnonzero(inside)


def assert_turned(found, turn: np.ndarray) -> None:
    assert found is not None
    error = to_matrix(found.q_icrs_to_cam) @ turn.T
    assert np.abs(error - np.eye(3)).max() < 1e-3


@pytest.mark.parametrize("scale", [1.0, 1.2, 1 / 1.2])
def test_an_attitude_is_found_of_a_field_whose_scale_is_known_to_a_fifth(rng, scale):
    """Among stars of the whole sky, of which only those about the direction are looked at."""
    about = sky_of(rng)
    vectors = np.empty((2 * len(about), 3))
    vectors[1::2] = about
    vectors[::2] = -about
    turn = rotation_of(40.0, 20.0, 77.0)
    field, rows = field_of(vectors, turn)
    noise_px = 0.1 * rng.standard_normal(field.places_px.shape)
    sources_px = np.delete(field.places_px + noise_px, 3, axis=0)
    rows = np.delete(rows, 3)
    field = replace(field, places_px=sources_px)
    found = solve_lost(field, scale * FOCAL_PX, vectors, np.array(turn[2]))
    assert_turned(found, turn)
    assert found.focal_length_px == pytest.approx(FOCAL_PX, rel=1e-3)
    assert np.array_equal(rows[found.source], found.star)
    # nearly all of the 60 brightest sources, which prove it
    assert len(found.star) > 55
    if scale == 1.0:
        # mirrored, it is no part of this sky
        mirrored = replace(field, places_px=sources_px * np.array([-1, 1]))
        assert solve_lost(mirrored, FOCAL_PX, vectors, np.array(turn[2])) is None


def test_an_attitude_is_looked_for_everywhere_where_it_is_not_near_the_one_given(rng):
    """In a sky that has as many stars as the one before, and its brightest, too."""
    base = Camera(SIZE_PX, FOCAL_PX, CENTRE_PX, np.eye(3))
    turn = rotation_of(40.0, 20.0, 77.0)
    starts_deg = ((220.0, -20.0, 0.0), (41.0, 21.0, 0.0))
    first, second = sky_of(rng), sky_of(rng)
    second[0] = first[0]
    for start_deg, vectors in zip(starts_deg, (first, second), strict=True):
        sky = DatedSky(load_catalog(), 2020.0, None, vectors, np.arange(len(vectors)))
        field, _ = field_of(vectors, turn)
        assert_turned(_solve(field, base, sky, from_matrix(rotation_of(*start_deg))), turn)
        assert_turned(solve_lost(field, FOCAL_PX, vectors), turn)


def test_a_turn_by_two_stars_is_no_reflection(rng):
    """Two directions leave the third axis to the handedness alone."""
    for _ in range(8):
        cam = rng.standard_normal((2, 3))
        cam /= np.linalg.norm(cam, axis=1, keepdims=True)
        turn = rotation_of(*rng.uniform(0, 90, 3))
        np.testing.assert_allclose(turned(cam, cam @ turn), turn, atol=1e-12)


def test_a_source_is_the_brightest_of_its_stars_alone():
    """Stars are in the order of their light; a source beyond the radius is none's."""
    tree = cKDTree(np.array([[10.0, 0.0], [0.0, 0.0], [30.0, 0.0]]))
    stars = np.array([[0.4, 0.0], [0.1, 0.0], [13.0, 0.0], [9.5, 0.5]])
    star, source = nearest_once(tree, stars, 2.0)
    assert (star.tolist(), source.tolist()) == ([0, 3], [1, 0])


def at(x_px: float, y_px: float, off_mag: float = 0.0, **changes):
    """A star at a place, fainter than predicted."""
    dn = 100 * 10 ** (-0.4 * off_mag)
    return row_of(dn, x_predicted_px=x_px, y_predicted_px=y_px, sigma_dn=0.5, **changes)


def test_a_cloud_dims_the_part_of_an_image_that_it_covers():
    """Four by four stars in each of four by four cells; the cell of the lower left is covered."""
    rows = []
    for y_px in np.arange(15.0, HIGH_PX, 30.0):
        for x_px in np.arange(20.0, WIDE_PX, 40.0):
            covered = x_px < WIDE_PX / 4 and y_px > 3 * HIGH_PX / 4
            scatter = 0.02 * (-1) ** round(x_px / 40 + y_px / 30)
            rows.append(at(x_px, y_px, 0.8 * covered + scatter))
    words, is_dim = _dim_regions(rows, SIZE_PX)
    assert len(words) == 1
    assert words[0].startswith("lower left: 0 of 16 stars are missing, those seen 0.80 mag")
    assert is_dim(at(100.0, 470.0, 0.8))
    assert not is_dim(at(100.0, 470.0, 0.02))
    assert not is_dim(at(600.0, 10.0, 0.8))
    assert _dim_regions([row for row in rows if row.off_mag < 0.5], SIZE_PX)[0] == []


def test_missing_stars_tell_of_an_obstacle():
    gone = {"flags": ("missing",)}
    rows = [at(600.0, 20.0, **gone), at(610.0, 30.0, **gone), at(620.0, 40.0), at(20.0, 20.0)]
    assert _dim_regions(rows, SIZE_PX)[0] == [
        "upper right: 2 of 3 stars are missing, those seen 0.00 mag too faint: cloud, an obstacle,"
        " or vignetting"
    ]


def explained(**changes) -> str:
    """What a source at (35, 12) is, in an image of 50 x 30 pixels with nothing that explains it."""
    sources = sources_at([(35.0, 12.0)], snr=20.0, length_px=3.0)
    sources = replace(sources, **changes.pop("source", {}))
    parts = {
        "shot": replace(a_shot(0), sources=sources),
        "expected": None,
        "tree": None,
        "planets": {},
        "satellites": {},
        "near_saturated": lambda x_px, y_px: False,
        "hot": np.zeros((30, 50), dtype=bool),
        "light_sigma": np.zeros((30, 50)),
        "pixel_dn": 1.0,
        "focal_length_px": 1000.0,
    }
    return _Explanation(**(parts | changes)).of(0)


def image_with(value) -> np.ndarray:
    """An image that has a value in the source's pixel alone, row 12 and column 35."""
    image = np.zeros((30, 50), dtype=type(value))
    image[12, 35] = value
    return image


def test_what_explains_a_source_is_looked_for_at_its_own_row_and_column():
    assert explained() == ""
    assert explained(hot=image_with(True)) == "a hot pixel"
    assert explained(light_sigma=image_with(6.0)) == "light of a bright star"
    assert explained(light_sigma=image_with(4.0)) == ""  # a quarter of the source's 20 is 5
    assert explained(source={"single": np.array([True])}).startswith("one pixel: hot")
    assert explained(near_saturated=lambda x_px, y_px: (x_px, y_px) == (35.0, 12.0)) == (
        "light of a bright star"
    )
    # 3 px, or 3 arcmin of 1000 px, which are 0.9
    assert explained(planets={"Mars": (37.0, 13.0)}) == "Mars"
    assert explained(planets={"Mars": (38.0, 13.0)}) == ""


@pytest.mark.parametrize(
    ("x_px", "y_px", "row", "column"),
    [(35.0, 29.6, 29, 35), (49.7, 12.0, 12, 49), (35.0, -0.7, 0, 35), (-0.8, 12.0, 12, 0)],
)
def test_a_source_beyond_an_edge_is_explained_by_the_edge_s_pixel(x_px, y_px, row, column):
    hot = np.zeros((30, 50), dtype=bool)
    hot[row, column] = True
    source = {"x_px": np.array([x_px]), "y_px": np.array([y_px])}
    assert explained(source=source, hot=hot) == "a hot pixel"


@pytest.mark.parametrize(("off_px", "words"), [(24.5, "beside a trail"), (25.5, "")])
def test_what_is_beside_a_trail_is_within_half_its_length_and_five_pixels(off_px, words):
    """A trail of 40 px to the right."""
    source = {
        "x_px": np.array([10.0, 10.0 + off_px]),
        "y_px": np.array([12.0, 12.0]),
        "snr": np.array([20.0, 90.0]),
        "length_px": np.array([3.0, 40.0]),
        "width_px": np.array([2.0, 2.0]),
        "single": np.array([False, False]),
    }
    assert explained(source=source) == words


def test_a_trail_has_the_name_of_a_satellite_within_its_length_and_two_tenths_of_a_degree():
    trail = {"width_px": np.array([1.0]), "length_px": np.array([20.0])}
    # 10 px and 0.2 deg of 1000 px, 3.5 px
    assert explained(source=trail, satellites={"ISS": (48.0, 12.0)}) == "ISS, 20 px long"
    assert explained(source=trail, satellites={"ISS": (49.0, 12.0)}) == "a trail, 20 px long"


@pytest.mark.parametrize("tangents", [(1.2, 0.7), (-0.4, 1.5), (0.9, -1.1)])
def test_a_zenith_is_told_by_how_the_air_squeezes_a_field(rng, tangents):
    """Directions are drawn towards the zenith by 58.3 arcsec times the tangent of their distance
    from it; of its sign a wide field tells what is of third order.
    """
    zenith = np.append(tangents, 1.0) / np.linalg.norm([*tangents, 1.0])
    across = rng.uniform([-0.4, -0.3], [0.4, 0.3], (200, 2))
    cam = np.column_stack([across, np.ones(len(across))])
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    bent = cam + 58.3 * ARCSEC * (zenith / (cam @ zenith)[:, None] - cam)
    camera = Camera(SIZE_PX, FOCAL_PX, CENTRE_PX, np.eye(3))
    x_px, y_px = (np.array(CENTRE_PX) + FOCAL_PX * bent[:, :2] / bent[:, 2:]).T
    turn = rotation_of(*POINTINGS_DEG[0])
    places = Places(x_px, y_px, np.full(len(x_px), 1e-4), cam @ turn)
    found = _with_zenith(camera, Pointing(from_matrix(turn)), places, 1e-4)
    assert found.zenith == pytest.approx(tangents, rel=0.03, abs=0.03)
    # the attitude is that without air
    error = to_matrix(found.q_icrs_to_cam) @ turn.T
    assert np.abs(error - np.eye(3)).max() < 3 * ARCSEC


def test_triangles_of_the_sky_are_of_two_and_a_half_times_the_stars_that_a_circle_takes(rng):
    """Of a sky of even stars, brightest first. A circle takes the brightest of its own: in the
    poorest one that is nearly the last, and in no circle one beyond.
    """
    vectors = rng.standard_normal((3000, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    smaller_rad = 0.5
    circles = 4 * np.pi / (2 * np.pi * (1 - np.cos(CIRCLE * smaller_rad)))
    sky = _triangles_of_sky(vectors, smaller_rad)
    stars = 2.5 * STARS_A_CIRCLE * circles
    assert stars < len(vectors)
    assert 0.75 * stars < sky.triples.max() < stars + 1


@pytest.mark.parametrize("matched", [12, 13, 14, 15])
def test_an_attitude_is_proved_by_more_than_its_own_three_pairs(matched):
    """Sixty stars on a grid, of which some have a source and the others one 20 px aside: by how
    probable it is that so many more of 57 have one by chance.
    """
    x_px, y_px = np.meshgrid(np.linspace(-290, 290, 10), np.linspace(-200, 200, 6))
    stars_px = np.column_stack([x_px.ravel(), y_px.ravel()])
    sources_px = stars_px.copy()
    sources_px[matched:, 0] += 20.0
    cam = np.column_stack([stars_px / FOCAL_PX, np.ones(60)])
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    turn = rotation_of(*POINTINGS_DEG[0])
    proof = _Proof(SourceField(sources_px, WIDE_PX, HIGH_PX), cam @ turn)
    # circles of 0.006 diagonals of 800 px
    chance = 60 * np.pi * 4.8**2 / (WIDE_PX * HIGH_PX)
    is_proved = binom.sf(matched - 4, 57, chance) <= MAX_CHANCE
    three = np.array([0, 4, 11])
    solution = proof.of(three, three, FOCAL_PX)
    assert (solution is not None) is bool(is_proved)
    if solution is not None:
        assert np.sort(solution.star).tolist() == list(range(matched))
        assert solution.source.tolist() == solution.star.tolist()
        assert to_matrix(solution.q_icrs_to_cam) == pytest.approx(turn, abs=1e-9)


@pytest.mark.parametrize(
    ("lift_arcsec", "is_nearer", "is_taken"),
    [(0.0, False, False), (13.6, True, False), (58.3, True, True)],
)
def test_refraction_is_taken_where_it_foretells_places_better_by_a_gain(
    rng, lift_arcsec, is_nearer, is_taken
):
    """A camera whose zenith is 56 degrees from its boresight, its places by so much of the air's 58.3
    arcsec: with a fourth of it a whole one is nearer by less than a hundredth.
    """
    zenith = np.array([1.2, 0.9, 1.0]) / np.linalg.norm([1.2, 0.9, 1.0])
    across = rng.uniform([-0.3, -0.2], [0.3, 0.2], (60, 2))
    cam = np.column_stack([across, np.ones(60)])
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    bent = cam + lift_arcsec * ARCSEC * (zenith / (cam @ zenith)[:, None] - cam)
    x_px, y_px = (np.array(CENTRE_PX) + FOCAL_PX * bent[:, :2] / bent[:, 2:]).T
    turn = rotation_of(*POINTINGS_DEG[0])
    places = Places(x_px, y_px, np.full(60, NOISE_PX), cam @ turn)
    camera = Camera(SIZE_PX, FOCAL_PX, CENTRE_PX, np.eye(3))
    fit = fit_camera(camera, [Pointing(from_matrix(turn))], [places], fixed=True, last=True)
    plain_px, bent_px = fit.held_out_px["fixed"], fit.held_out_px["fixed, refraction"]
    assert (bent_px < plain_px) is is_nearer
    assert (bent_px < GAIN * plain_px) is is_taken
    assert fit.model == ("fixed, refraction" if is_taken else "fixed")
    assert (fit.pointings[0].zenith is not None) is is_taken


def test_a_hypothesis_is_given_up_after_so_many_candidates(rng, monkeypatch):
    """Of triangles by chance, none of which is proved."""
    tried = []
    monkeypatch.setattr(_Proof, "of", lambda proof, *candidate: tried.append(candidate))
    vectors = rng.standard_normal((2000, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    sky = _triangles_of_sky(vectors, 0.5)
    places_px = rng.uniform([-320, -240], [320, 240], (30, 2))
    field = SourceField(places_px, WIDE_PX, HIGH_PX)
    for most in (5, 9):
        monkeypatch.setattr(lost_in_space, "MAX_CANDIDATES", most)
        assert _by_hypothesis(field, 900.0, vectors, sky) is None
        assert len(tried) == most
        del tried[:]
