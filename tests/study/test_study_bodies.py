"""What bodies cost and how exact they are: the study's tables hold what its findings say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.instruments.study import bodies
from hilstar.instruments.study.bodies import (
    PHASES_DEG,
    QUICK_BENCHES,
    QUICK_RADII_PX,
    SCENES,
    BodyCost,
)
from hilstar.instruments.study.sweep import Spent
from hilstar.optics.camera import Camera

TABLES = ("bodies_cost", "bodies_size", "bodies_limits")  # and the charts of each


@pytest.fixture(scope="module")
def bodies_study(whole_study):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "QUICK_ROUNDS", 1)  # no claim here is of a time
        return whole_study("bodies", TABLES)


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
        cost("planets, none in view", 0.4),
        cost("Moon, not in view", 0.7),
        cost("Moon in view, 55 px", 3.0, "Moon"),
        cost("the same, at a step of the orbit", 20.0),
    ]
    assert bodies.unseen_ms(costs) == 0.7
    assert "20 ms once in 2 s" not in bodies.cost_line(costs[:3])
    assert "20.0 ms once in 2 s" in bodies.cost_line(costs)


@pytest.mark.parametrize(("radius_px", "phase_deg"), [(0.4, 0.0), (6.0, 0.0), (6.0, 60.0)])
def test_a_disc_is_drawn_as_rays_have_it(radius_px, phase_deg):
    found = bodies.exactness(radius_px, phase_deg)
    assert (found.body, found.radius_px, found.phase_deg) == ("Moon", radius_px, phase_deg)
    assert abs(found.flux_off) < 0.01
    assert found.middle_off_px < 0.05
    if radius_px > 1:
        assert found.limb_off_px < 0.1
        assert found.point_pixel_off > 10 * found.pixel_off
    else:
        assert np.isnan(found.limb_off_px)


def test_a_full_moon_s_traced_light_is_its_rate_in_its_circle():
    """A million electrons a second; a disc of one brightness near its middle."""
    disc = bodies.moon(6.0, 0.0)
    camera = Camera((31, 31), bodies.FOCAL_PX, (15.0, 15.0), np.eye(3))
    image = bodies.traced(disc, camera)
    assert image.sum() == pytest.approx(1e6, rel=5e-3)
    y, x = np.indices(image.shape)
    middle = [15 + at for at in bodies.MIDDLE_PX]
    assert (image * x).sum() / image.sum() == pytest.approx(middle[0], abs=0.02)
    assert (image * y).sum() / image.sum() == pytest.approx(middle[1], abs=0.02)
    reach = np.hypot(x - middle[0], y - middle[1])
    assert image[reach > 6 + 5 * max(bodies.SIGMA_PX)].max() < 1e-3 * image.max()
    # half of its light is lost at quarter phase and more, as less of it is lit
    half = bodies.moon(6.0, 90.0)
    lit = bodies.traced(replace(half, normal_e_per_s_sr=disc.normal_e_per_s_sr), camera)
    assert lit.sum() < 0.5 * image.sum()


def test_a_level_is_crossed_between_its_steps():
    steps = np.linspace(-3.0, 3.0, 7)
    profile = np.array(
        [
            [8.0, 8.0, 8.0, 6.0, 2.0, 0.0, 0.0],  # half of 8 lies midway from 0 to 1
            [4.0, 4.0, 1.0, 0.0, 0.0, 0.0, 0.0],  # two thirds of the way from -2 to -1
            [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0],
        ]
    )
    found = bodies.half_level_px(profile, steps)
    assert found[:2] == pytest.approx([0.5, -2 + 2 / 3])
    assert np.isnan(found[2])
    shortest = bodies.shortest([Spent(3.0, 9.0), Spent(4.0, 7.0)])
    assert shortest == (3.0, 7.0)
