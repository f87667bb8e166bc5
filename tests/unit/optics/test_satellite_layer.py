"""The layer of satellites against light that is summed up moment by moment: rows that light one
after the other, a mounting that turns, discs and what they hide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import brentq

from hilstar.basics.rotation import from_rotation_vector, propagate, to_matrix
from hilstar.display.render.reference import extended_image, linear_image
from hilstar.optics.camera import Camera
from hilstar.optics.layers.layers import Sources, light_of, seen_in, sky_layers
from hilstar.optics.layers.satellites import FRAME_SPRITES, SatelliteLayer
from hilstar.optics.layers.view import POINT_PX, Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.sky.bodies.passes import Cone
from hilstar.sky.stars import Stars
from tests.support.satellites import V0_E_PER_S, element_set, lit_moment, looking_at
from tests.support.stars import sprites_at, stars_at

SIZE_PX, PSF = (150, 110), GaussianPsf((0.7, 0.9))
# neither in the middle, nor upright, nor along the attitude's axis
MOUNTED = to_matrix(from_rotation_vector(np.array([0.01, -0.02, 1.2])))
CAMERA = Camera(SIZE_PX, 3000.0, (60.0, 70.5), MOUNTED)
NORTH = np.array([0.0, 0.0, 1.0])
MOMENTS = 40
# tests/unit/optics/test_trails.py: 1e-3 of the light, and that of fewer moments
PIXEL_LIMIT, FLUX_LIMIT = 2e-3, 1e-3
DISC_FLUX = 0.02  # a crescent by five rays across a pixel
COVERED = 0.06  # a quarter of a radius is a step of discs (STEPS_A_RADIUS)
LIST = "OTHER\n" + element_set(7, (97.0, 252.0, 130.0, 322.0), 0.001, 15.0)
WIDE_KM, HOLD_S = 1.0, 1.2  # it passes a star in the third of that time
WIDE = f"norad,size_m\n7,{1000 * WIDE_KM}\n"
RATE = np.radians((0.6, -1.1, 4.0))
SLOW_RATE = RATE / 10


@dataclass(frozen=True)
class Scene:
    """A sky of one satellite, stars beside it, and an attitude that has it on the image."""

    sky: object
    stars: Stars
    t_ns: int
    q: np.ndarray

    def direction(self, seconds: float) -> np.ndarray:
        """As the stars of that moment are aberrated: by the observer's velocity at `t_ns`."""
        seen = self.sky.passing(Cone(NORTH, np.pi, 0.0), self.t_ns + round(seconds * 1e9))
        velocity_km_s = self.sky.seen(self.stars, self.t_ns).velocity_km_s
        return seen.directions(slice(None), np.zeros(1), velocity_km_s)[0]

    def place_px(self, rate: np.ndarray, seconds: float) -> tuple[float, float]:
        turned = MOUNTED @ to_matrix(propagate(self.q, rate, seconds)) @ self.direction(seconds)
        x, y = CAMERA.project(turned[None])
        return float(x[0]), float(y[0])

    def mean_light(self, rate: np.ndarray, begin_s: float, length_s: float) -> np.ndarray:
        """The mean image (height, width) of a time, each moment from a pass of its own."""
        image = np.zeros(SIZE_PX[::-1])
        half = np.array([length_s / MOMENTS / 2])
        for part in (np.arange(MOMENTS) + 0.5) / MOMENTS:
            seconds = begin_s + part * length_s
            seen = self.sky.passing(Cone(NORTH, np.pi, 0.0), self.t_ns + round(seconds * 1e9))
            light = seen.rates_e_per_s(np.array([0]), -half, half) / MOMENTS
            at_px = np.array([self.place_px(rate, seconds)])
            sprite = sprites_at(at_px, light, PSF.footprint_px)
            image += linear_image(sprite, SIZE_PX, PSF)
        return image

    def light(self, view: View, faintest_e_per_s: float = 0.0, canvas: Canvas | None = None):
        canvas = canvas or Canvas(CAMERA, PSF)
        stars = seen_in(view, self.stars, self.sky)
        layer = SatelliteLayer(self.sky, canvas, faintest_e_per_s)
        return layer.add(light_of(canvas, (), stars, view), stars, view), stars


def scene(table: str = "norad\n") -> Scene:
    sky, t_ns = lit_moment(LIST, table)
    towards = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    beside = towards + 0.01 * np.array([[0.3, -0.5, 0.2], [-0.4, 0.1, 0.3]])
    stars = sky.among(stars_at(np.vstack([towards[None], beside]), np.full(3, 5e3)))
    # off the boresight of the attitude, so that neither its rate nor the mounting's turn is idle
    off = from_rotation_vector(np.array([0.004, 0.003, 0.0]))
    q = looking_at(to_matrix(off) @ towards)
    return Scene(sky, stars, t_ns, q)


def row_is_lit_at(one: Scene, rate: np.ndarray, scan: Scan) -> float:
    """When the satellite's own row begins to light: that row's time is that of its place then."""

    def early_s(seconds: float) -> float:
        x, y = one.place_px(rate, seconds)
        return float(scan.late_s(np.array([x]), np.array([y]), SIZE_PX)[0]) - seconds

    return float(brentq(early_s, -scan.scanout_s, scan.scanout_s))


@pytest.mark.parametrize("down", [(0, 1), (-1, 0)], ids=["down", "to the left"])
def test_a_streak_on_a_screen_is_lit_while_its_own_rows_are(down):
    one = scene()
    scan = Scan(down, scanout_s=0.12, hold_s=0.08)
    light, stars = one.light(View(one.q, RATE, one.t_ns, scan=scan))
    begin_s = row_is_lit_at(one, RATE, scan)
    assert abs(begin_s) > 0.005
    wanted = one.mean_light(RATE, begin_s, scan.hold_s)
    assert np.abs(linear_image(light, SIZE_PX, PSF) - wanted).max() < PIXEL_LIMIT * wanted.sum()
    assert set(light.star.tolist()) == {3}
    assert stars.designations(np.array([3])) == ["OTHER"]
    assert stars.electrons_per_s[3] == pytest.approx(wanted.sum(), rel=FLUX_LIMIT)
    v_mag = -2.5 * np.log10(wanted.sum() / V0_E_PER_S)
    assert stars.v_mag[3] == pytest.approx(v_mag, abs=FLUX_LIMIT)
    middle = one.direction(begin_s + scan.hold_s / 2)
    assert (
        np.linalg.norm(stars.directions(np.array([3]))[0] - middle) * CAMERA.focal_length_px < 0.01
    )


def test_an_exposure_is_half_before_and_half_after_its_attitude_and_a_still_one_turns_not():
    one = scene()
    for view, rate in (
        (View.exposure(one.q, RATE, 0.2, one.t_ns), RATE),
        (View(one.q, None, one.t_ns, scan=Scan(scanout_s=0.1, hold_s=0.2)), np.zeros(3)),
    ):
        light, _ = one.light(view)
        wanted = one.mean_light(rate, -0.1, 0.2)
        assert np.abs(linear_image(light, SIZE_PX, PSF) - wanted).max() < PIXEL_LIMIT * wanted.sum()


@pytest.mark.parametrize("is_exposed", [False, True])
def test_a_turn_beyond_what_a_frame_draws_takes_a_satellite_where_it_takes_the_stars(is_exposed):
    """45 degrees in a frame: its paths are those of a slower turn, and an exposure's are not. The
    star stood where the satellite does, which moves by a pixel meanwhile.
    """
    one = scene()
    fast = np.radians((900.0, 0.0, 0.0))
    view = View(one.q, fast, one.t_ns, scan=Scan(scanout_s=0.005, hold_s=0.05))
    if is_exposed:
        view = View.exposure(one.q, fast / 100, 0.05, one.t_ns)
    canvas = Canvas(CAMERA, PSF)
    stars = seen_in(view, one.stars, one.sky)
    light = light_of(canvas, sky_layers(canvas, Sources(one.sky)), stars, view)
    places = []
    for star in (0, 3):
        of_star = light.star == star
        rate = light.data["electrons_per_s"][of_star]
        places.append([np.average(at[of_star], weights=rate) for at in (light.x_px, light.y_px)])
    assert len(places) == 2
    assert np.hypot(*np.subtract(*places)) < 3


@pytest.mark.parametrize("passes_s", [-0.07, 0.06])
def test_a_satellite_that_a_turn_brings_into_an_exposure_and_out_of_it_is_drawn(passes_s):
    """The field is 2 degrees to a corner, and at the attitude's own moment it is beyond that."""
    one = scene()
    rate = np.radians((0.0, 120.0, 0.0))
    away = replace(one, q=propagate(one.q, rate, -passes_s))
    light, _ = away.light(View.exposure(away.q, rate, 0.2, away.t_ns))
    assert not (0 < away.place_px(rate, 0.0)[0] < SIZE_PX[0])
    wanted = away.mean_light(rate, passes_s - 0.02, 0.04).sum() * 0.04 / 0.2
    assert linear_image(light, SIZE_PX, PSF).sum() == pytest.approx(wanted, rel=0.1)


def test_satellites_fainter_than_the_faintest_are_neither_drawn_nor_written():
    one = scene()
    view = View.exposure(one.q, RATE, 0.05, one.t_ns)
    light, stars = one.light(view)
    rate = float(stars.electrons_per_s[3])
    assert len(one.light(view, 0.99 * rate)[0])
    light, _ = one.light(view, 1.01 * rate)
    assert len(light) == 0
    # as a bench builds its layers
    canvas = Canvas(CAMERA, PSF)
    for share, is_drawn in ((0.99, True), (1.01, False)):
        stars = seen_in(view, one.stars, one.sky)
        layers = sky_layers(canvas, Sources(one.sky), share * rate, paths=False)
        assert (3 in light_of(canvas, layers, stars, view).star) is is_drawn
    away = View.exposure(looking_at(-one.direction(0.0)), RATE, 0.05, one.t_ns)
    assert len(one.light(away)[0]) == 0


def test_a_wide_satellite_is_a_disc_that_hides_the_star_behind_it_and_no_other():
    """A kilometre wide: its light is that of its path, and the star that it passes is hidden for the
    share of the time that the disc is before it.
    """
    one = scene(WIDE)
    view = View(one.q, SLOW_RATE, one.t_ns, scan=Scan(scanout_s=0.12, hold_s=HOLD_S))
    canvas = Canvas(CAMERA, PSF)
    stars = seen_in(view, one.stars, one.sky)
    before = light_of(canvas, sky_layers(canvas, paths=False), stars, view)
    begin_s = row_is_lit_at(one, SLOW_RATE, view.scan)
    wanted = one.mean_light(SLOW_RATE, begin_s, HOLD_S)
    for white_e_per_s, over in ((wanted.sum(), ()), (1e-3 * wanted.max(), ("OTHER",))):
        layer = SatelliteLayer(one.sky, replace(canvas, white_e_per_s=white_e_per_s))
        light = layer.add(before, stars, view)
        assert light.over_white == over
        assert light.discs == ("OTHER",)
    image = extended_image(light.extended, SIZE_PX)
    assert image.sum() == pytest.approx(wanted.sum(), rel=DISC_FLUX)
    assert stars.electrons_per_s[3] == pytest.approx(wanted.sum(), rel=FLUX_LIMIT)
    seen_km = one.sky.passing(Cone(NORTH, np.pi, 0.0), one.t_ns).seen_km[0, 0]
    radius_rad = WIDE_KM / 2 / np.linalg.norm(seen_km)
    # a crescent leans to its Sun
    lean_px = radius_rad * CAMERA.focal_length_px
    assert np.hypot(*(middle_px(image) - middle_px(wanted))) < lean_px
    before_e_per_s, after_e_per_s = (
        dict(zip(each.star.tolist(), each.data["electrons_per_s"].tolist(), strict=True))
        for each in (before, light)
    )
    first, last = (one.direction(seconds) for seconds in (begin_s, begin_s + HOLD_S))
    part = np.linspace(0, 1, 2000)[:, None]
    path = (1 - part) * first + part * last
    covered = (np.linalg.norm(path - stars.directions(np.array([0])), axis=1) < radius_rad).mean()
    assert 0.1 < covered < 0.9
    assert after_e_per_s[0] / before_e_per_s[0] == pytest.approx(1 - covered, abs=COVERED)
    assert [after_e_per_s[k] for k in (1, 2)] == [before_e_per_s[k] for k in (1, 2)]


def test_a_camera_at_rest_has_discs_of_wide_satellites_alone():
    narrow, one = scene(), scene(WIDE)
    view = View(one.q, None, one.t_ns)
    assert SatelliteLayer(narrow.sky, Canvas(CAMERA, PSF)).discs(narrow.stars, view) == []
    stars = seen_in(view, one.stars, one.sky)
    (disc,) = SatelliteLayer(one.sky, Canvas(CAMERA, PSF)).discs(stars, view)
    seen_km = one.sky.passing(Cone(NORTH, np.pi, 0.0), one.t_ns).seen_km[0, 0]
    assert disc.name == "OTHER"
    assert disc.direction == pytest.approx(one.direction(0.0), abs=1e-12)
    assert disc.radius_rad == pytest.approx(WIDE_KM / 2 / np.linalg.norm(seen_km), rel=1e-6)
    # a disc hides stars however faint it is
    faint = SatelliteLayer(one.sky, Canvas(CAMERA, PSF), faintest_e_per_s=1e30)
    assert [disc.name for disc in faint.discs(stars, view)] == ["OTHER"]
    away = replace(view, q_icrs_to_cam=looking_at(-one.direction(0.0)))
    assert SatelliteLayer(one.sky, Canvas(CAMERA, PSF)).discs(stars, away) == []


@pytest.mark.parametrize(("share", "is_wide"), [(0.97, False), (1.03, True)])
def test_a_satellite_is_a_disc_from_a_fifth_of_a_pixel_on(share, is_wide):
    """By its diameter; beside it a pinhole has as many pixels to a radian everywhere."""
    seen_km = scene().sky.passing(Cone(NORTH, np.pi, 0.0), scene().t_ns).seen_km[0, 0]
    size_m = share * POINT_PX / CAMERA.focal_length_px * np.linalg.norm(seen_km) * 1000
    sized = scene(f"norad,size_m\n7,{size_m}\n")
    light, stars = sized.light(View(sized.q, None, sized.t_ns, scan=Scan(hold_s=1e-3)))
    assert light.discs == (("OTHER",) if is_wide else ())
    layer = SatelliteLayer(sized.sky, Canvas(CAMERA, PSF))
    assert len(layer.discs(stars, View(sized.q, None, sized.t_ns))) == is_wide


def test_an_exposure_s_streak_is_finer_than_a_frame_may_cost():
    """Of a PSF of a tenth of a pixel, over some hundred pixels."""
    long = scene()
    canvas = Canvas(CAMERA, GaussianPsf((0.1, 0.1)))
    exposed, _ = long.light(View.exposure(long.q, RATE, 1.5, long.t_ns), canvas=canvas)
    assert (exposed.per_star > FRAME_SPRITES, exposed.capped) == (True, 0)


def test_discs_are_drawn_the_farthest_first():
    """Two of one orbit, a degree of it apart, on a camera with a wide field."""
    both = LIST + "NEXT\n" + element_set(8, (97.0, 252.0, 130.0, 323.0), 0.001, 15.0)
    sky, t_ns = lit_moment(both, "norad,size_m\n7,90000\n8,90000\n")
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns)
    q = looking_at(seen.directions(slice(None), np.zeros(2))[0])
    canvas = Canvas(Camera(SIZE_PX, 200.0, (74.5, 54.5), np.eye(3)), PSF)
    view = View(q, None, t_ns, scan=Scan(hold_s=1e-3))
    stars = seen_in(
        view, sky.among(stars_at(-seen.directions(slice(None), np.zeros(2))[:1], np.ones(1))), sky
    )
    drawn = SatelliteLayer(sky, canvas).add(light_of(canvas, (), stars, view), stars, view).discs
    far_km = np.linalg.norm(seen.seen_km[0], axis=1)
    assert abs(far_km[1] - far_km[0]) > 1
    assert list(drawn) == [("OTHER", "NEXT")[k] for k in np.argsort(-far_km)]


def middle_px(image: np.ndarray) -> np.ndarray:
    y, x = np.indices(image.shape)
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
