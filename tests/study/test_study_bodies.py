"""What bodies cost and how exact they are: the study's tables hold what its findings say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.study import bodies
from hilstar.instruments.study.bodies import (
    PHASES_DEG,
    QUICK_BENCHES,
    QUICK_RADII_PX,
    SCENES,
    BodyCost,
)
from hilstar.optics.camera import Camera

TABLES = ("bodies_cost", "bodies_size", "bodies_limits")  # and the charts of each


@pytest.fixture(scope="module")
def bodies_study(whole_study):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "QUICK_ROUNDS", 1)  # no claim here is of a time
        measured = bodies.measure(quick=True)
    return whole_study.reported("bodies", TABLES, measured)


def test_each_scene_is_timed_against_the_same_frame_without_bodies(bodies_study):
    rows = {row["scene"]: row for row in bodies_study.rows("bodies_cost")}
    assert list(rows) == [scene.name for scene in SCENES if scene.bench in QUICK_BENCHES]
    shown = {name: row["discs"].split() for name, row in rows.items() if row["discs"]}
    assert shown["Moon in view, 55 px"] == ["Moon"]
    assert shown["Earth fills the field"] == ["Earth"]
    assert not any("not in view" in name or "none in view" in name for name in shown)
    for row in rows.values():
        assert float(row["cost_ms"]) == pytest.approx(
            float(row["frame_ms"]) - float(row["without_ms"])
        )


def test_discs_are_within_a_percent_and_a_tenth_of_a_pixel_and_a_point_is_not(bodies_study):
    rows = bodies_study.rows("bodies_size")
    assert len(rows) == len(PHASES_DEG) * len(QUICK_RADII_PX)
    assert max(abs(float(row["flux_off"])) for row in rows) < 0.01
    limbs = [float(row["limb_off_px"]) for row in rows if row["limb_off_px"] != "nan"]
    assert limbs and max(limbs) < 0.1
    large = [row for row in rows if float(row["radius_px"]) > 1]
    assert all(float(row["point_pixel_off"]) > 10 * float(row["pixel_off"]) for row in large)


def test_near_a_body_all_light_is_finite_and_what_is_over_white_is_white(bodies_study):
    lines, rows = bodies_study.findings, bodies_study.rows("bodies_limits")
    assert {row["body"] for row in rows} == {"Moon", "Sun", "Earth"}
    assert all(row["finite"] == row["white_is_white"] == "True" for row in rows)
    assert max(float(row["over_white_mag"]) for row in rows if row["body"] == "Sun") > 15
    assert len(lines) == 3 and "NOT" not in lines[2]


def test_unseen_bodies_cost_what_they_do_between_steps_of_the_orbit():
    def cost(scene: str, cpu_ms: float, discs: str = "") -> BodyCost:
        assert scene in {known.name for known in SCENES}
        return BodyCost(scene, 9.0, 8.0, 1.0, cpu_ms, discs, 5)

    costs = [
        cost("Moon, not in view", 0.7),
        cost("planets, none in view", 0.4),
        cost("Moon in view, 55 px", 3.0, "Moon"),
        cost("the same, at a step of the orbit", 20.0),
    ]
    assert bodies.unseen_ms(costs) == 0.7
    assert "20 ms once in 2 s" not in bodies.cost_line(costs[:3])
    assert "20.0 ms once in 2 s" in bodies.cost_line(costs)


NORTH = np.array([0.0, 0.0, 1.0])


def camera_of(radius_px):
    """The study's camera about a disc, and the middle of its image."""
    half = int(np.ceil(radius_px)) + bodies.MARGIN_PX
    side_px = 2 * half + 1
    return Camera((side_px, side_px), bodies.FOCAL_PX, (half, half), np.eye(3)), half


@pytest.mark.parametrize(("radius_px", "phase_deg"), [(3.0, 0.0), (6.0, 60.0), (6.0, 150.0)])
def test_a_traced_moon_has_its_light_at_its_place_and_towards_the_sun(radius_px, phase_deg):
    disc = bodies.moon(radius_px, phase_deg)
    assert disc.radius_rad == pytest.approx(radius_px / 6000, rel=1e-6)
    # the phase is the angle at the Moon between the Sun and the camera
    assert -disc.direction @ disc.sun == pytest.approx(math.cos(math.radians(phase_deg)))
    camera, half = camera_of(radius_px)
    truth = bodies.traced(disc, camera)
    # of a million electrons a second none is over the margin; rays on a lattice: 1e-3
    assert truth.sum() == pytest.approx(1e6, rel=2e-3)
    rows, columns = np.indices(truth.shape)
    middle = np.array([(truth * columns).sum(), (truth * rows).sum()]) / truth.sum()
    off_px = middle - (half + 0.2, half - 0.3)
    sun_px = disc.sun[:2] / np.linalg.norm(disc.sun[:2]) if phase_deg else np.zeros(2)
    if not phase_deg:
        np.testing.assert_allclose(off_px, 0, atol=1e-3)
        assert np.abs(bodies.edges_px(truth, radius_px, 0.0)).max() < 0.5
        return
    # along the Sun's direction alone, further where less is lit
    assert np.linalg.norm(off_px) == pytest.approx(off_px @ sun_px, rel=1e-3)
    share = (off_px @ sun_px) / radius_px
    low, high = {60.0: (0.1, 0.5), 150.0: (0.7, 1.0)}[phase_deg]
    assert low < share < high


@pytest.mark.parametrize(
    ("radius_px", "phase_deg"), [(0.05, 60.0), (6.0, 120.0), (6.0, 60.0), (4.0, 90.0)]
)
def test_a_disc_is_drawn_as_its_rays_and_a_point_is_not_a_disc(radius_px, phase_deg):
    size = bodies.exactness(radius_px, phase_deg)
    assert (size.body, size.radius_px, size.phase_deg) == ("Moon", radius_px, phase_deg)
    assert abs(size.flux_off) < 0.01 and size.middle_off_px < 0.02
    assert 0 < size.pixel_off < 0.02
    if radius_px < 0.1:
        # smaller than DISC_PX it is drawn as the point
        assert size.point_pixel_off < 0.02
    else:
        assert size.point_pixel_off > 0.1
    # a small disc's edge falls from no middle, and a crescent's from none
    assert math.isnan(size.limb_off_px) == (radius_px < 4 or phase_deg > 90)
    assert not size.limb_off_px > 0.1


@pytest.fixture(scope="module")
def benches():
    with bodies.opened(("nothing", "Moon", "Earth")) as opened:
        yield opened


def disc_of(bench, name, t_ns):
    (disc,) = (d for d in bench.moving.discs(NORTH, np.pi, 0.0, t_ns) if d.name == name)
    return disc


@pytest.mark.parametrize("off_deg", [0.0, 0.5, 40.0])
def test_the_moon_is_aimed_at_by_its_middle_and_along_declination(benches, off_deg):
    q = bodies.attitude(benches["Moon"], "Moon", off_deg, 0)
    boresight, moon = to_matrix(q)[2], disc_of(benches["Moon"], "Moon", 0).direction
    assert math.degrees(math.acos(min(boresight @ moon, 1.0))) == pytest.approx(off_deg, abs=2e-6)
    # towards the equator and beyond, on the meridian
    across = np.cross(moon, NORTH)
    assert boresight @ across == pytest.approx(0, abs=1e-9)
    assert (boresight[2] - moon[2]) * np.sign(moon[2]) <= 1e-12


@pytest.mark.parametrize("off_deg", [8.0, 0.0, -20.0])
def test_the_earth_is_aimed_at_by_its_lit_limb(benches, off_deg):
    t_ns = bodies.DAY_SIDE_NS
    q = bodies.attitude(benches["Earth"], "Earth", off_deg, t_ns)
    boresight, earth = to_matrix(q)[2], disc_of(benches["Earth"], "Earth", t_ns)
    angle_deg = math.degrees(math.acos(boresight @ earth.direction))
    assert angle_deg == pytest.approx(math.degrees(earth.radius_rad) + off_deg, abs=1e-6)
    # from the Earth's centre towards the Sun, in their plane
    across = np.cross(earth.direction, earth.sun)
    assert boresight @ across == pytest.approx(0, abs=1e-9)
    assert (boresight - (boresight @ earth.direction) * earth.direction) @ earth.sun > 0


def test_a_frame_with_a_body_is_timed_beside_the_same_without(benches, monkeypatch):
    """The first bench's frames are those without bodies; of some the fastest counts, each time by
    itself.
    """
    spent = {"nothing": [(5.0, 9.0), (4.0, 8.0)], "bodies": [(7.0, 20.0), (8.0, 12.0)]}
    seen = []

    def in_turn(works, rounds):
        seen.extend(work(1) for work in works.values())
        return {name: [bodies.Spent(*times) for times in spent[name]] for name in works}

    monkeypatch.setattr(bodies, "in_turn", in_turn)
    scene = next(scene for scene in SCENES if scene.name == "Moon in view, 55 px")
    cost = bodies.measure_cost(benches, scene, 2)
    without, shown = seen
    assert shown.sum() > without.sum() > 0
    assert (cost.frame_ms, cost.without_ms, cost.cost_ms, cost.cpu_ms) == (7.0, 4.0, 3.0, 4.0)
    assert (cost.scene, cost.discs) == (scene.name, "Moon")
    near = bodies.approach(benches, "Moon", 0.5, 2)
    assert (near.frame_ms, near.cpu_ms, near.without_ms) == (7.0, 12.0, 4.0)
    assert (near.body, near.off_deg) == ("Moon", 0.5)
    assert near.finite and near.white_is_white and near.stars > 0
    # a full Moon of V = -12.7 over 2400 px is 8 mag over the peak of a star of V = 2, a fifth of it
    assert 4 < near.over_white_mag < 9
    assert bodies.approach(benches, "Moon", 40.0, 1).over_white_mag < 3


def test_a_small_study_of_bodies_draws_its_rows(small_run):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("QUICK_ROUNDS", 1),
            ("QUICK_BENCHES", ("nothing", "Moon")),
            ("QUICK_DEG", {"Moon": (40.0, 0.5)}),
            ("QUICK_RADII_PX", (0.1, 4.0)),
            ("PHASES_DEG", (0.0, 60.0)),
        ):
            patch.setattr(bodies, name, value)
        run = small_run(bodies.run, True)
    sizes, nears = run.rows("bodies_size"), run.rows("bodies_limits")
    assert [(row["phase_deg"], row["radius_px"]) for row in sizes] == [
        ("0.0", "0.1"),
        ("0.0", "4.0"),
        ("60.0", "0.1"),
        ("60.0", "4.0"),
    ]
    for panel, columns in enumerate(
        [("flux_off",), ("limb_off_px", "middle_off_px"), ("pixel_off", "point_pixel_off")]
    ):
        drawn = [(x, y) for _, x, y in run.lines("bodies_size", panel)]
        for phase in ("0.0", "60.0"):
            own = [row for row in sizes if row["phase_deg"] == phase]
            for column in columns:
                wanted = [max(abs(float(row[column])), 1e-6) for row in own]
                assert any(x == [0.1, 4.0] and np.array_equal(y, wanted, True) for x, y in drawn)
    for panel, column in enumerate(("cpu_ms", "over_white_mag")):
        drawn = [(x, y) for _, x, y in run.lines("bodies_limits", panel)]
        assert ([40.0, 0.5], [float(row[column]) for row in nears]) in drawn
    # a frame has 1/60 s, and white is 0 mag over white
    assert run.levels("bodies_limits", 0) == {"60 Hz": pytest.approx(1000 / 60)}
    assert run.levels("bodies_limits", 1) == {"white": 0.0}
    # a percent of light, a tenth of a pixel, and a point under 0.2 px across
    assert [run.levels("bodies_size", panel) for panel in range(2)] == [
        {"limit": 0.01},
        {"limit": 0.1},
    ]
    assert run.places("bodies_size", 2) == [0.1]
    cost, size, limit = run.told[0]
    largest = max(abs(float(row["flux_off"])) for row in sizes)
    limb_px = max(float(row["limb_off_px"]) for row in sizes if row["limb_off_px"] != "nan")
    assert f"within {100 * largest:.2g} % and their limb within {limb_px:.3f} px" in size
    assert size.startswith("discs of 0.1 to 4 px") and size[1:] == run.title("bodies_size")[1:]
    slowest = max(nears, key=lambda row: float(row["cpu_ms"]))
    assert f"{float(slowest['cpu_ms']):.0f} ms of processor time a frame (Moon at" in limit
    assert limit.endswith("finite, and white where it is over white")
    (axes,) = run.charts["bodies_cost"].axes
    costs = run.rows("bodies_cost")
    widths = [max(float(row["cpu_ms"]), 0.0) for row in costs]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], widths, atol=0.006)
    assert "the dearest:" in cost


def test_a_full_moon_s_traced_light_is_within_its_circle_and_a_half_moon_s_is_half_of_it():
    disc = bodies.moon(6.0, 0.0)
    camera = Camera((31, 31), bodies.FOCAL_PX, (15.0, 15.0), np.eye(3))
    image = bodies.traced(disc, camera)
    y, x = np.indices(image.shape)
    reach = np.hypot(x - 15 - bodies.MIDDLE_PX[0], y - 15 - bodies.MIDDLE_PX[1])
    assert image[reach > 6 + 5 * max(bodies.SIGMA_PX)].max() < 1e-3 * image.max()
    # half of its light is lost at quarter phase and more, as less of it is lit
    half = bodies.moon(6.0, 90.0)
    lit = bodies.traced(replace(half, normal_e_per_s_sr=disc.normal_e_per_s_sr), camera)
    assert lit.sum() < 0.5 * image.sum()


def test_each_bench_has_the_bodies_of_its_name_and_aims_at_those_that_it_knows():
    planets = {"Mercury", "Venus", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune"}
    wanted = {
        "nothing": set(),
        "observer": set(),
        "planets": planets,
        "Sun": {"Sun"},
        "low orbit": set(),
        "Earth": {"Earth"},
        "all": {*planets, "Moon", "Sun", "Earth"},
    }
    scenes = {scene.name: scene for scene in SCENES}
    with bodies.opened(tuple(wanted)) as opened:
        for name, known in wanted.items():
            moving = opened[name].moving
            shown = set() if moving is None else set(moving.names)
            assert shown == known, name
        for name, aiming in (
            ("from the Earth's centre, no body", "all"),
            ("from a low orbit, no body", "all"),
            ("Earth, not in view", "Earth"),
            ("the same, at a step of the orbit", "all"),
        ):
            assert bodies.aiming_bench(opened, scenes[name]) is opened[aiming], name


def test_each_frame_that_is_timed_is_a_step_later_than_the_one_before(benches):
    """And the frame without bodies has no time."""
    q = bodies.attitude(benches["Moon"], "Moon", 0.5, 0)
    pair, begin_ns, step_ns = (benches["nothing"], benches["Moon"]), 10**9, 600 * NS_PER_S
    works = bodies.frame_works(pair, q, begin_ns, step_ns)
    seen = []
    for number in range(3):
        seen.append(works["bodies"](number).copy())
        wanted = benches["Moon"].draw(q, t_ns=begin_ns + number * step_ns)
        np.testing.assert_array_equal(seen[-1], wanted.levels)
        np.testing.assert_array_equal(works["nothing"](number), benches["nothing"].draw(q).levels)
    assert (seen[0] != seen[1]).any() and (seen[1] != seen[2]).any()


def near(light, levels):
    """A frame near the Moon, of this light and these levels, whose white is 100 e-/s and 255."""
    found = bodies.against_white(np.array([light]), np.array([levels]), 100.0, 255)
    light_of = (found.over_white_mag, found.finite, found.white_is_white)
    return bodies.Near("Moon", 0.5, 5.0, 3.0, 2.0, *light_of, 3)


def test_light_near_a_body_is_held_against_white_pixel_by_pixel():
    """A pixel over white by little that has another code is no white one."""
    right = near([50.0, 100.0, 250.0], [180, 255, 255])
    assert right.over_white_mag == pytest.approx(2.5 * math.log10(2.5))
    assert right.finite and right.white_is_white
    wrong = near([50.0, 100.0, 150.0], [180, 255, 254])
    assert not wrong.white_is_white and wrong.finite
    endless = near([50.0, np.inf, 150.0], [180, 255, 255])
    assert not endless.finite and endless.white_is_white
    assert bodies.light_words([right, right]) == "finite, and white where it is over white"
    for nears in ([right, wrong], [endless, right]):
        assert bodies.light_words(nears) == "NOT finite, or over white and not white"


def test_discs_are_told_by_their_largest_errors_of_either_sign():
    def size(radius_px, flux_off, limb_off_px):
        return bodies.Exactness("Moon", 0.0, radius_px, flux_off, 0.0, limb_off_px, 0.0, 0.0)

    sizes = [size(0.05, -0.012, math.nan), size(80.0, 0.003, 0.02), size(4.0, 0.001, 0.031)]
    assert bodies.size_line(sizes) == (
        "discs of 0.05 to 80 px in radius have their light within 1.2 % and their limb within 0.031"
        " px of rays in float64"
    )


def test_a_wide_disc_s_light_is_by_the_solid_angle_of_its_rays(monkeypatch):
    """Through a short lens a square of the image plane is a smaller angle by the cube of its ray's
    cosine to the axis: of 17 degrees a square would leave 2 % too much.
    """
    monkeypatch.setattr(bodies, "FOCAL_PX", 20.0)
    disc = bodies.moon(6.0, 0.0)
    camera = Camera((31, 31), 20.0, (15.0, 15.0), np.eye(3))
    assert bodies.traced(disc, camera).sum() == pytest.approx(1e6, rel=5e-3)


@pytest.mark.parametrize("phase_deg", [60.0, 90.0])
def test_a_limb_is_sought_on_the_side_of_the_sun(phase_deg):
    """There light falls within half a pixel of the true edge, on the other side before it."""
    camera, _ = camera_of(12.0)
    truth = bodies.traced(bodies.moon(12.0, phase_deg), camera)
    edges_px = bodies.edges_px(truth, 12.0, phase_deg)
    assert len(edges_px) == bodies.PLACES and np.abs(edges_px).max() < 0.5
