"""Angles between heads, solved from what their trackers would see."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply
from hilstar.instruments.simulate import heads as heads_module
from hilstar.instruments.simulate.heads import (
    HeadsErrors,
    _apart_arcsec,
    _Head,
    body_attitude,
    verify_heads,
)
from hilstar.instruments.simulate.star_finder import star_finder
from hilstar.instruments.simulate.twin import Twin
from hilstar.server.bench.bench_file import read_heads
from tests.support.benches import ORION_Q
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


def apart_arcsec(by_field, first: int, second: int, kind: int) -> list[float]:
    """The angles between two heads' solutions of a kind of light, in the fields that both have."""
    angles = []
    for solved in by_field:
        if solved[first] is not None and solved[second] is not None:
            turn = rotation_of(solved[first][kind]) * rotation_of(solved[second][kind]).inv()
            angles.append(3600 * np.degrees(turn.magnitude()))
    return angles


def test_each_head_is_shown_the_body_s_attitude_through_its_own_mounting(
    tmp_path, monkeypatch
) -> None:
    shown = []
    field = Twin.field

    def seen(twin: Twin, q: FloatArray, first_frame: int) -> object:
        shown.append((rotation_of(q), first_frame))
        return field(twin, q, first_frame)

    monkeypatch.setattr(Twin, "field", seen)
    solutions = []
    solved = _Head.solved

    def told(head: _Head, q: FloatArray, first_frame: int) -> object:
        solutions.append(solved(head, q, first_frame))
        return solutions[-1]

    monkeypatch.setattr(_Head, "solved", told)
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
    # by the pairs' own solutions of one kind of light, field by field
    by_field = (solutions[:3], solutions[3:])
    for pair, (first, second) in zip(pairs, combinations(range(3), 2), strict=True):
        for kind, found in enumerate((pair.linear_arcsec, pair.codes_arcsec)):
            assert found == pytest.approx(apart_arcsec(by_field, first, second, kind), abs=1e-6)


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


def test_a_head_is_solved_by_three_stars_and_more_that_are_drawn_whole_and_are_alone(
    tmp_path, monkeypatch
) -> None:
    file = read_heads(heads_file(tmp_path, 5599, SMALL)).files[0]
    solved_by = []

    def recorded(q_body_to_cam, q_icrs_to_body, measured, wanted, weights):
        solved_by.append((len(measured), len(wanted), weights.tolist()))
        return body_attitude(q_body_to_cam, q_icrs_to_body, measured, wanted, weights)

    monkeypatch.setattr(heads_module, "body_attitude", recorded)
    with Twin(file) as twin:
        head = _Head(twin)
        usual = star_finder(twin.bench, twin.monitor_px_per_px).settings
        assert head.finder.settings.window_sigma_px == pytest.approx(1.5 * usual.window_sigma_px)
        q_icrs_to_body = multiply(conjugate(head.mounting.q_body_to_cam), np.array(ORION_Q))
        seen = twin.field(np.array(ORION_Q), 0)
        fields = []
        monkeypatch.setattr(twin, "field", lambda q, first_frame: fields[-1])

        def solved(truth: np.ndarray, **places: np.ndarray) -> list[float]:
            """The light of the stars by which codes are solved; none where there are too few."""
            fields.append(replace(seen, truth=truth, **places))
            solved_by.clear()
            if head.solved(q_icrs_to_body, 0) is None:
                assert not solved_by
                return []
            (count, same, alike), (codes_count, codes_same, light) = solved_by
            assert count == same == codes_count == codes_same == len(light)
            # linear light places all stars alike
            assert alike == [1.0] * count
            return light

        every = solved(seen.truth)
        light = seen.truth["electrons_per_s"]
        usable = np.flatnonzero(np.isin(light, every))
        assert len(usable) == len(every) > 4
        for name, value in (("drawn", False), ("clipped", True)):
            for kept, wanted in ((3, 3), (2, 0)):
                truth = seen.truth.copy()
                truth[name][np.setdiff1d(np.arange(len(truth)), usable[:kept])] = value
                assert len(solved(truth)) == wanted
        # a star next to nothing in the place of another: one of them was found
        truth = seen.truth.copy()
        first, other = usable[:2]
        truth["electrons_per_s"][other] = 1e-6
        places = {"x_px": seen.x_px.copy(), "y_px": seen.y_px.copy()}
        for place in places.values():
            place[other] = place[first]
        assert solved(truth, **places) == [rate for rate in every if rate not in light[usable[:2]]]


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
