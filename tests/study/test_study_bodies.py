"""What bodies cost and how exact they are: the study's tables hold what its findings say."""

from __future__ import annotations

import pytest

from hilstar.instruments.study import bodies
from hilstar.instruments.study.bodies import (
    PHASES_DEG,
    QUICK_BENCHES,
    QUICK_RADII_PX,
    SCENES,
    BodyCost,
)

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
