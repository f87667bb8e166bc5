"""The light of faults on a camera by closed forms: places, times, shares, and what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.optics.camera import Camera
from hilstar.optics.extended import LightMap
from hilstar.optics.layers import fault_light
from hilstar.optics.layers.fault_kinds import CosmicRays, Gradient, Now, fault_of
from hilstar.optics.layers.fault_light import FaultCamera, FaultView, Lines, tracks
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.star_layer import StarLayer, no_light
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.sky.stars import with_bodies
from tests.support.refusals import refusal
from tests.support.stars import sprites_at, stars_at

MONITOR = Camera((320, 240), 1000.0, (159.5, 119.5), np.eye(3))
TRACKER = Camera((100, 60), 400.0, (49.5, 29.5), np.eye(3))
PSF = GaussianPsf((2.0, 0.5))
EXPOSURE_S = 0.25
RAYS = {"kind": "cosmic-rays", "name": "rays", "number": 3, "electrons": 4000}
LIGHT = {"name": "x", "electrons_per_s": 50.0}


def view_of(seed: int = 7, lasting=frozenset()) -> FaultView:
    """The faults of a screen before a small tracker: V = 0 is 1000 e-/s times 10^B-V."""
    canvas = Canvas(MONITOR, PSF)
    stars = with_bodies(stars_at(np.eye(3), np.ones(3)), ("Moon",), np.zeros(1))
    camera = FaultCamera(
        canvas,
        MONITOR,
        TRACKER,
        EXPOSURE_S,
        StarLayer(canvas),
        lambda directions: directions,
        lambda bv_mag: 1000.0 * 10**bv_mag,
        stars,
    )
    return FaultView(camera, seed, lasting=lasting)


def test_a_burst_without_an_end_is_one_exposure_and_another_as_long_as_it_says():
    view = view_of()
    assert view.prepare(fault_of(RAYS)).for_s == EXPOSURE_S
    assert view.prepare(fault_of(RAYS | {"for_s": 3.0})).for_s == 3.0


def test_light_is_said_as_a_rate_in_an_exposure_or_as_a_magnitude():
    view = view_of()
    for keys, rate in (
        ({"electrons_per_s": 30.0}, 30.0),
        ({"electrons": 30.0}, 120.0),
        ({"v_mag": 2.5, "bv_mag": 1.0}, 1000.0),
    ):
        fault = fault_of({"kind": "false-star", "name": "x", "screen_px": [3, 4]} | keys)
        assert view.light_e_per_s(fault) == pytest.approx(rate)
    without = fault_of({"kind": "light-map", "name": "x", "file": "x.npy"})
    assert view.light_e_per_s(without) == 1.0


def test_a_fault_s_chance_is_the_seed_s_its_name_s_and_the_number_s():
    def draws(seed: int, name: str, *numbers: int) -> list[float]:
        return view_of(seed).rng(name, *numbers).random(3).tolist()

    first = draws(7, "ab", 1, 2)
    assert draws(7, "ab", 1, 2) == first
    for other in (draws(8, "ab", 1, 2), draws(7, "ba", 1, 2), draws(7, "ab", 1, 3)):
        assert not set(other) & set(first)


@pytest.mark.parametrize(("down", "along"), [((0, 1), 1), ((0, -1), 1), ((1, 0), 0)])
def test_a_point_that_moves_on_a_screen_is_where_it_is_while_its_own_row_is_lit(down, along):
    """Its row by its place when the middle row lights up; its mean is that of half of the hold."""
    scan = Scan(down, scanout_s=0.016, hold_s=0.01)
    rate = np.array([900.0, -400.0])
    fault = fault_of(
        {"kind": "false-star", "screen_px": [200.0, 180.0], "rate_px_s": rate.tolist()} | LIGHT
    )
    now = Now(1, fault, 50_000_000, 0.5)
    (chain,), (light,) = view_of().camera_points([now], scan)
    at_first = np.array([200.0, 180.0]) + rate * 0.05
    size, middle = MONITOR.resolution_px[along], (159.5, 119.5)[along]
    late_s = down[along] * (at_first[along] - middle) / size * 0.016
    wanted = at_first + rate * (late_s + 0.005)
    assert (chain.x_px.mean(), chain.y_px.mean()) == pytest.approx(tuple(wanted))
    assert np.ptp(chain.x_px) > 0.8 * 900 * 0.01
    assert chain.electrons_per_s.sum() == pytest.approx(25.0)
    assert light.electrons_per_s == 25.0
    (still,), _ = view_of().camera_points([now], None)
    assert (still.x_px.tolist(), still.y_px.tolist()) == (
        [pytest.approx(at_first[0])],
        [pytest.approx(at_first[1])],
    )


def test_tracks_have_the_share_of_their_frame_and_a_magnitude_of_their_own():
    """4000 electrons in a quarter of a second, of which half are shown: 8000 e-/s."""
    view = view_of()
    fault = view.prepare(fault_of(RAYS | {"length_px": 0.0}))
    (chain,), lights = view.camera_points([Now(1, fault, 0, 0.5)], None)
    assert chain.electrons_per_s.tolist() == [8000.0] * 3
    rows = [(light.electrons_per_s, light.v_mag, light.bv_mag) for light in lights]
    assert rows == [(8000.0, pytest.approx(-2.5 * np.log10(8.0)), 0.0)] * 3


def test_stray_light_is_kept_as_one_object_and_has_the_share_of_its_frame():
    """The renderer knows the same light by it."""
    view = view_of()
    gradient = fault_of({"kind": "gradient"} | LIGHT)
    glow = fault_of({"kind": "glow", "tracker_px": [10.0, 12.0]} | LIGHT)
    attitude = np.array([1.0, 0.0, 0.0, 0.0])

    def light_of(fault, share: float):
        (light,) = view.surfaces([Now(1, fault, 0, share)], attitude)
        return light

    whole, whole_glow = light_of(gradient, 1.0), light_of(glow, 1.0)
    assert whole.times == 50.0
    assert light_of(gradient, 0.5).times == 25.0
    assert light_of(gradient, 1.0) is whole
    assert light_of(glow, 1.0) is whole_glow
    # a monitor pixel is 0.4 of a tracker pixel on a side
    assert whole_glow.peak_e_per_s == pytest.approx(50.0 * 0.4**2)
    assert light_of(glow, 0.25).peak_e_per_s == pytest.approx(50.0 * 0.4**2 / 4)
    direction = np.array([(10.0 - 49.5) / 400, (12.0 - 29.5) / 400, 1.0])
    assert whole_glow.direction_image == pytest.approx(direction / np.linalg.norm(direction))


@pytest.mark.parametrize(
    "keys",
    [
        {"kind": "false-star", "tracker_px": [10.0, 12.0]} | LIGHT,
        {"kind": "flash", "tracker_px": [10.0, 12.0], "for_s": 1.0} | LIGHT,
        {"kind": "gradient"} | LIGHT,
        {"kind": "glow", "tracker_px": [10.0, 12.0]} | LIGHT,
        {"kind": "light-map", "file": "stray.npy"} | LIGHT,
    ],
    ids=lambda keys: keys["kind"],
)
def test_light_without_a_colour_has_the_sun_s(keys):
    """B-V = 0.65 (Ramirez et al. 2012, ApJ 752, 5: 0.653)."""
    assert fault_of(keys).bv_mag == 0.65
    assert fault_of(keys | {"bv_mag": -0.2}).bv_mag == -0.2


@pytest.mark.parametrize(
    ("light", "brightest"),
    [({}, 8.0), ({"electrons_per_s": 50.0}, 50.0), ({"electrons": 50.0}, 50.0 / EXPOSURE_S)],
)
def test_a_map_s_brightest_pixel_has_the_light_that_is_said_or_its_own(tmp_path, light, brightest):
    """Electrons per second in a tracker pixel, of which a monitor pixel has 0.4 by 0.4."""
    np.save(tmp_path / "stray.npy", np.array([[2.0, 4.0], [8.0, 6.0]]))
    fault = fault_of({"kind": "light-map", "name": "x", "file": "stray.npy"} | light)
    view = FaultView(view_of().by, 7, folder=tmp_path)
    (found,) = view.surfaces([Now(1, fault, 0, 1.0)], np.array([1.0, 0.0, 0.0, 0.0]))
    assert found.times * found.image.max() == pytest.approx(brightest * 0.4**2, rel=1e-3)


@pytest.mark.parametrize(
    ("frame", "lit_px", "brightest"),
    [("tracker", 250 * 150, 8.0 * 0.4**2), ("screen", 320 * 240, 8.0)],
)
def test_a_map_lies_over_the_whole_of_the_tracker_s_image_or_of_the_screen(
    tmp_path, frame, lit_px, brightest
):
    """A tracker pixel is 2.5 monitor pixels on a side."""
    np.save(tmp_path / "stray.npy", np.array([[2.0, 4.0], [8.0, 6.0]]))
    fault = fault_of({"kind": "light-map", "name": "x", "file": "stray.npy", "frame": frame})
    view = FaultView(view_of().by, 7, folder=tmp_path)
    (found,) = view.surfaces([Now(1, fault, 0, 1.0)], np.array([1.0, 0.0, 0.0, 0.0]))
    assert np.count_nonzero(found.image) == pytest.approx(lit_px, rel=0.02)
    assert found.times * found.image.max() == pytest.approx(brightest, rel=1e-3)


def test_of_more_maps_than_are_kept_the_one_used_longest_ago_goes(monkeypatch):
    """But for those that last."""
    monkeypatch.setattr(fault_light, "KEPT_MAPS", 2)
    lasting, *others = (
        fault_of({"kind": "gradient", "towards_deg": 10.0 * k} | LIGHT) for k in range(5)
    )
    view = view_of(lasting=frozenset({lasting}))

    def map_of(fault: Gradient):
        (light,) = view.surfaces([Now(1, fault, 0)], np.array([1.0, 0.0, 0.0, 0.0]))
        return light

    first = {fault: map_of(fault) for fault in (lasting, *others[:2])}
    map_of(others[0])
    first[others[2]] = map_of(others[2])
    for fault in (lasting, others[0], others[2]):
        assert map_of(fault) is first[fault]
    assert map_of(others[1]) is not first[others[1]]


def test_a_line_has_points_a_sigma_and_a_half_apart_along_its_own_direction():
    """Of 30 px: across, of a sigma of 2 px, 10 parts and one more; down, of 0.5 px, 40 and one.
    Each point is in the middle of its part, with its part of the light.
    """
    begin = np.array([[100.0, 100.0], [50.0, 60.0], [20.0, 20.0]])
    end = begin + np.array([[30.0, 0.0], [0.0, 30.0], [0.0, 0.0]])
    chain = Lines(begin, end, np.array([22.0, 82.0, 5.0])).seen_by(MONITOR, MONITOR, PSF)
    assert np.bincount(chain.line).tolist() == [11, 41, 1]
    assert chain.electrons_per_s.tolist() == [2.0] * 52 + [5.0]
    first = chain.line == 0
    assert chain.x_px[first] == pytest.approx(100 + 30 * (np.arange(11) + 0.5) / 11)
    assert (chain.y_px[first] == 100.0).all()
    assert (chain.x_px[-1], chain.y_px[-1], chain.lines) == (20.0, 20.0, 3)


def test_tracks_lie_anywhere_on_the_detector_in_any_direction():
    """1000 of them, by five sigmas of a mean of even chances."""
    burst = fault_of(RAYS | {"number": 1000, "length_px": 8.0})
    assert isinstance(burst, CosmicRays)
    lines = tracks(burst, (100, 60), EXPOSURE_S, np.random.default_rng(5))
    middle = (lines.begin_px + lines.end_px) / 2
    along = lines.end_px - lines.begin_px
    assert np.hypot(*along.T) == pytest.approx(8.0)
    for axis, size in ((0, 100), (1, 60)):
        assert middle[:, axis].min() >= -0.5
        assert middle[:, axis].max() < size - 0.5
        assert np.ptp(middle[:, axis]) > 0.98 * size
        assert abs(middle[:, axis].mean() - (size - 1) / 2) < 5 * size / np.sqrt(12 * 1000)
        assert abs(along[:, axis].mean()) < 5 * 8.0 / np.sqrt(2 * 1000)
    assert (lines.electrons_per_s == 4000 / EXPOSURE_S).all()


@pytest.mark.parametrize(
    ("table", "change", "words"),
    [
        ({"kind": "attitude-step", "turn_deg": [0, -180, 0]}, {"turn_deg": [0, -180.1, 0]}, "180 deg at most"),
        ({"kind": "attitude-step", "turn_arcsec": [0, 0, 648_000]}, {"turn_arcsec": [0, 0, 648_001]}, "turns by 180 deg"),
        (RAYS | {"number": 2500, "length_px": 8}, {"number": 2501}, "length_px = 8 are 20008 px"),
        ({"kind": "false-star", "icrs": [0, 0.9991, 0]} | LIGHT, {"icrs": [0, 0.9989, 0]}, "its norm is 0.9989"),
        ({"kind": "false-star", "icrs": [0, 1.0009, 0]} | LIGHT, {"icrs": [0, -1.0009, 0.06]}, "its norm is 1.0027"),
        ({"kind": "false-star", "radec_deg": [1, 2]} | LIGHT, {"rate_px_s": [0, 3]}, "not radec_deg"),
        ({"kind": "light-map", "file": "x"}, {"electrons": 1, "electrons_per_s": 1}, "electrons_per_s and electrons"),
        ({"kind": "light-map", "file": "x", "electrons": 1}, {"electrons_per_s": 1}, "electrons_per_s and electrons"),
        ({"kind": "light-map", "file": "x", "electrons_per_s": 1}, {"electrons": 1}, "electrons_per_s and electrons"),
    ],
)  # fmt: skip
def test_a_limit_is_on_either_side_of_what_is_still_drawn(table, change, words):
    assert fault_of({"name": "x"} | table)
    assert words in refusal(fault_of, {"name": "x"} | table | change)


def test_a_point_that_is_given_by_a_star_is_where_that_star_is_or_refused():
    """Bodies by their names, stars by their numbers; a camera at rest sees none of them."""
    view = view_of()
    stars = view.by.stars
    stars.vectors[-1] = [0.6, 0.0, 0.8]
    for key, place in (({"star": "Moon"}, 3), ({"hip": 2}, 2), ({"star": "HIP 1"}, 1)):
        fault = fault_of({"kind": "star-gone", "name": "x"} | key)
        wanted = int(np.flatnonzero(stars.hip == place)[0]) if place < 3 else 3
        assert view.gone([Now(1, fault, 0, 0.75)], stars) == [(wanted, 0.25)]
        assert view.star_direction(fault) == pytest.approx(stars.vectors[wanted])
    no_exposure = FaultView(replace(view.by, exposure_s=0.0))
    said = refusal(no_exposure.prepare, fault_of({"kind": "gradient", "name": "x", "electrons": 1}))
    assert said.startswith("electrons: [tracker] exposure_s is 0")


@pytest.mark.parametrize(
    "table",
    [{"kind": "star-gone"}, {"kind": "flash", "electrons": 1, "for_s": 0.1}],
    ids=["gone", "flash"],
)
@pytest.mark.parametrize(
    ("known", "unknown", "words"),
    [
        ({"hip": 2}, {"hip": 9}, "hip = 9: not among the 4 stars and bodies"),
        ({"star": "Moon"}, {"star": "Mars"}, 'star = "Mars": not among the 4 stars and bodies'),
    ],
    ids=["hip", "star"],
)
def test_a_fault_of_a_star_that_is_not_there_is_refused_before_it_begins(
    table, known, unknown, words
):
    view = view_of()
    named = table | {"name": "x"}
    assert view.prepare(fault_of(named | known))
    assert words in refusal(view.prepare, fault_of(named | unknown))


def test_each_sprite_of_faults_is_of_the_light_whose_name_it_has():
    """Two tracks, and two false stars that stand on the sky."""
    view = view_of()
    tables = (
        {"kind": "false-star", "name": "right", "icrs": [0.05, 0.0, 0.99874922], "electrons": 10},
        {"kind": "false-star", "name": "below", "icrs": [0.0, 0.05, 0.99874922], "electrons": 20},
        {"kind": "false-star", "name": "fixed", "tracker_px": [20.0, 30.0], "electrons": 30},
        RAYS | {"number": 2, "length_px": 0.0},
        {"kind": "false-star", "name": "last", "tracker_px": [60.0, 30.0], "electrons": 40},
    )
    now = [Now(k, view.prepare(fault_of(table)), 0) for k, table in enumerate(tables, 1)]
    attitude = View(np.array([1.0, 0.0, 0.0, 0.0]))
    before = replace(no_light(PSF.footprint_px), rate_cam_rad_s=np.ones(3))
    light = FaultLayer(view, tuple(now)).add(before, view.by.stars, attitude)
    placed = {}
    for star, x_px, y_px, rate in zip(
        light.star, light.x_px, light.y_px, light.data["electrons_per_s"], strict=True
    ):
        added = light.added[-1 - star]
        assert rate == pytest.approx(added.electrons_per_s)
        placed[added.name] = (x_px, y_px, rate)
    offset_px = 1000 * 0.05 / 0.99874922
    assert placed["right"] == pytest.approx((159.5 + offset_px, 119.5, 40.0))
    assert placed["below"] == pytest.approx((159.5, 119.5 + offset_px, 80.0))
    assert len(placed) == 5 and placed["fixed"][2] < placed["last"][2]
    # a blank frame's camera turns as before
    blank = Now(9, fault_of({"kind": "blank", "name": "dark"}), 0)
    dark = FaultLayer(view, (*now, blank)).add(before, view.by.stars, attitude)
    assert (len(dark), dark.added) == (0, ())
    assert dark.rate_cam_rad_s is before.rate_cam_rad_s


def test_a_star_that_is_gone_for_a_part_of_a_frame_is_dimmed_there_alone():
    """The light of the layers before stays as it is: it may be another image's, too."""
    view = view_of()
    row = int(np.flatnonzero(view.by.stars.hip > 0)[0])
    stars = view.by.stars
    places = np.full((2, 2), 20.0)
    before = sprites_at(places, np.full(2, 8.0), PSF.footprint_px)
    before = replace(before, star=np.array([row, row + 1]))
    table = {"kind": "star-gone", "name": "gone", "hip": int(stars.hip[row])}
    now = (Now(1, fault_of(table), 0, 0.75),)
    light = FaultLayer(view, now).add(before, stars, View(np.array([1.0, 0.0, 0.0, 0.0])))
    assert light.data["electrons_per_s"].tolist() == [2.0, 8.0]
    assert before.data["electrons_per_s"].tolist() == [8.0, 8.0]


@pytest.mark.parametrize(("share", "left"), [(1.0, ("Mars",)), (0.25, ("Moon", "Mars"))])
def test_a_body_that_is_gone_takes_its_share_of_its_disc_and_its_name_with_it(share, left):
    """Its map stays, for what is behind it stays hidden."""
    view = view_of()
    image = np.ones((2, 2), np.float32)
    maps = tuple(LightMap(image, times=2.0, name=name) for name in ("Moon", "Mars", ""))
    names = ("Moon", "Mars")
    before = replace(no_light(5), extended=maps, discs=names, over_white=names)
    gone = Now(1, fault_of({"kind": "star-gone", "name": "gone", "star": "Moon"}), 0, share)
    light = FaultLayer(view, (gone,)).add(
        before, view.by.stars, View(np.array([1.0, 0.0, 0.0, 0.0]))
    )
    assert [part.times for part in light.extended] == [2 * (1 - share), 2.0, 2.0]
    assert (light.discs, light.over_white) == (left, left)
