"""Angles between heads, solved from what their trackers would see."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.simulate.heads import (
    HeadsErrors,
    _apart_arcsec,
    _inside,
    body_attitude,
    verify_heads,
)
from hilstar.instruments.simulate.twin import Twin
from hilstar.server.bench.bench_file import read_heads
from tests.support.claims import holds
from tests.support.heads import MOUNTINGS, heads_file

# The README's bench at half the pixels of a side: fewer stars, so half as near.
BENCH = {
    "tracker": {"resolution_px": [512, 512], "transmission": None},
    "monitor": {"resolution_px": [640, 480]},
    "collimator": {"focal_length_mm": 175},
    "render": {"quantisation": "exact"},
}

# One that takes a tenth of a second.
SMALL = {
    "tracker": {"resolution_px": [200, 150], "focal_length_mm": 20, "transmission": None},
    "monitor": {"resolution_px": [400, 300]},
    "collimator": {"focal_length_mm": 120},
    "sky": {"faintest_v_mag": 6.0},
}
TURN_ARCSEC = np.array([30.0, -50.0, 400.0])


def rotation_of(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1))


def quaternion_of(rotation: Rotation) -> FloatArray:
    return np.roll(rotation.as_quat(), 1)


def test_stars_that_a_head_sees_turned_are_the_body_turned_about_the_head_s_axes(rng) -> None:
    body, mounting = Rotation.random(2, random_state=rng)
    turn = Rotation.from_rotvec(np.radians(TURN_ARCSEC / 3600))
    wanted = np.stack([*rng.uniform(-0.1, 0.1, (2, 7)), np.ones(7)], axis=1)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    solved = rotation_of(
        body_attitude(
            quaternion_of(mounting),
            quaternion_of(body),
            turn.apply(wanted),
            wanted,
            np.arange(1.0, 8.0),
        )
    )
    off = solved * body.inv()
    assert off.as_rotvec() == pytest.approx(mounting.inv().apply(turn.as_rotvec()), abs=1e-12)
    apart_arcsec = _apart_arcsec(quaternion_of(solved), quaternion_of(body))
    assert apart_arcsec == pytest.approx(np.linalg.norm(TURN_ARCSEC))


def test_each_head_is_shown_the_body_s_attitude_through_its_own_mounting(
    tmp_path, monkeypatch
) -> None:
    shown = []
    field = Twin.field

    def seen(twin: Twin, q: FloatArray, first_frame: int) -> object:
        shown.append((rotation_of(q), first_frame))
        return field(twin, q, first_frame)

    monkeypatch.setattr(Twin, "field", seen)
    done: list[int] = []
    heads = read_heads(heads_file(tmp_path, 5599, SMALL))
    pairs = verify_heads(heads, 2, np.random.default_rng(3), done.append)
    assert done == [1, 2]
    assert len(shown) == 2 * len(MOUNTINGS)
    for three in (shown[:3], shown[3:]):
        bodies = []
        for (to_cam, _), q_body_to_cam in zip(three, MOUNTINGS.values(), strict=True):
            bodies.append(rotation_of(np.array(q_body_to_cam)).inv() * to_cam)
        for body in bodies[1:]:
            assert (body * bodies[0].inv()).magnitude() < 1e-12
        assert len({first_frame for _, first_frame in three}) == 1
    for pair in pairs:
        # a fiftieth of a pixel of 134 arcsec, where linear light has no quantisation
        assert all(error < 3.0 for error in pair.linear_arcsec)
        assert len(pair.linear_arcsec) == len(pair.codes_arcsec)
    assert any(pair.codes_arcsec for pair in pairs)


def test_a_pair_s_summary_has_the_rms_and_the_largest_of_each() -> None:
    pair = HeadsErrors("a", "b", [3.0, 4.0], [6.0, 8.0, 0.0])
    rms = pytest.approx(np.sqrt(12.5)), pytest.approx(np.sqrt(100 / 3))
    assert pair.summary() == {
        "heads": ["a", "b"],
        "fields": 3,
        "linear_arcsec": {"rms": rms[0], "max": 4.0},
        "codes_arcsec": {"rms": rms[1], "max": 8.0},
    }
    none = HeadsErrors("a", "b").summary()
    assert (none["fields"], none["linear_arcsec"], none["codes_arcsec"]) == (0, None, None)


def test_places_are_inside_by_the_margin_of_each_axis() -> None:
    x_px = np.array([2.0, 2.1, 96.9, 97.0, 50.0, 50.0, 50.0, 50.0])
    y_px = np.array([20.0, 20.0, 20.0, 20.0, 2.0, 2.1, 46.9, 47.0])
    expected = [False, True, True, False, False, True, True, False]
    assert _inside(x_px, y_px, (100, 50), 2.0).tolist() == expected


@pytest.mark.gpu
def test_heads_agree_on_the_body_from_linear_light_and_nearly_from_codes(tmp_path, rng):
    pairs = verify_heads(read_heads(heads_file(tmp_path, 5599, BENCH)), 2, rng)
    assert [(pair.first, pair.second) for pair in pairs] == [("a", "b"), ("a", "c"), ("b", "c")]
    for pair in pairs:
        told = pair.summary()
        assert told["fields"] == 2
        linear, codes = (told[name]["max"] for name in ("linear_arcsec", "codes_arcsec"))
        holds("heads-linear", linear)
        holds("heads-codes", codes)
        assert linear < codes
