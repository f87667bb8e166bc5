"""The attitudes of the demo: a slew between rests, and the jitter of a good satellite."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from PIL import Image

from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    propagate,
    slerp,
    to_radec_roll_deg,
)
from hilstar.server import demo
from hilstar.server.demo import (
    REST_S,
    Demo,
    _jittered,
    scan_samples,
    slew_samples,
    write_pictures,
)

DURATION_S = 10.0


@pytest.fixture
def still(monkeypatch) -> None:
    """Without jitter."""
    monkeypatch.setattr(demo, "JITTER_ARCSEC", (0.0, 0.0, 0.0))


@pytest.mark.usefixtures("still")
def test_a_slew_rests_at_the_end_of_each_of_its_legs(rng):
    """Each of two legs of 5 s turns for 85 % of its time, by a quintic."""
    samples = slew_samples(DURATION_S, rng)
    assert len(samples) == round((DURATION_S + REST_S) * 100) + 1
    assert [sample.t_ns for sample in samples[:3]] == [0, 10_000_000, 20_000_000]
    points = [np.array(from_radec_roll_deg(*place)) for place in demo.WAYPOINTS_DEG]
    for first_s, last_s, point in ((0.0, 0.0, 0), (4.25, 5.0, 1), (9.25, 15.0, 2)):
        for sample in samples[round(first_s * 100) : round(last_s * 100) + 1]:
            assert angle_between_rad(sample.q_icrs_to_cam, points[point]) < 1e-7
    for leg, before_s in ((0, 0.0), (1, 5.0)):
        for t_s in (1.0, 2.0, 3.0):
            s = t_s / 4.25
            wanted = slerp(points[leg], points[leg + 1], s**3 * (10 - 15 * s + 6 * s**2))
            found = samples[round((before_s + t_s) * 100)].q_icrs_to_cam
            assert angle_between_rad(found, wanted) < 1e-7
    rates = np.array([sample.rate_cam_rad_s for sample in samples])
    assert np.abs(rates[430:495]).max() < 1e-9 < np.abs(rates[212]).max()


@pytest.mark.usefixtures("still")
def test_a_scan_is_to_and_fro_about_its_place(rng):
    samples = scan_samples(12.0, rng)
    for t_s in (0.0, 11.75, 16.75):
        turns = [
            middle + size * np.sin(2 * np.pi * t_s / period)
            for middle, (size, period) in zip(demo.WAYPOINTS_DEG[0], demo.SCAN, strict=True)
        ]
        ra_deg, dec_deg, roll_deg = to_radec_roll_deg(samples[round(t_s * 100)].q_icrs_to_cam)
        assert (ra_deg, dec_deg) == pytest.approx(turns[:2], abs=1e-6)
        assert (roll_deg - turns[2] + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-6)


@pytest.mark.usefixtures("still")
def test_each_rate_is_that_of_the_turn_from_the_first_sample_to_the_last(rng):
    rate = np.array([0.02, -0.05, 0.3])
    begin = np.array(from_radec_roll_deg(10.0, 20.0, 30.0))
    samples = _jittered(lambda t_s: propagate(begin, rate, t_s), 1.0, rng)
    rates = np.array([sample.rate_cam_rad_s for sample in samples])
    assert rates == pytest.approx(np.tile(rate, (len(samples), 1)), abs=1e-9)
    assert [sample.sequence for sample in samples] == list(range(len(samples)))


def test_jitter_is_as_large_as_stated_about_each_axis_and_forgets_in_its_time(rng):
    """About the camera's axes, of a camera at rest whose axes are the sky's."""
    at_rest = np.array([1.0, 0.0, 0.0, 0.0])
    samples = _jittered(lambda t_s: at_rest, 45.0, rng)
    off_arcsec = np.degrees([2 * np.array(sample.q_icrs_to_cam[1:]) for sample in samples]) * 3600
    # 60 independent values: 9 % of each sigma
    assert off_arcsec.std(axis=0) == pytest.approx([1.5, 1.5, 6.0], rel=0.35)
    later = (off_arcsec[40:] * off_arcsec[:-40]).mean(axis=0) / off_arcsec.var(axis=0)
    assert later == pytest.approx(np.exp(-1.0), abs=0.4)
    steps = np.diff(off_arcsec, axis=0).std(axis=0)
    # a step of 10 ms in 0.4 s: sqrt(2 (1 - e^-0.025)) of a sigma
    assert steps == pytest.approx(np.array([1.5, 1.5, 6.0]) * 0.2222, rel=0.1)


def test_a_kept_frame_is_two_pictures_of_its_codes_and_each_is_told(tmp_path):
    codes = np.arange(12, dtype=np.uint16).reshape(3, 4) * 90
    told = []
    kept = {7: codes, 1200: codes[::-1]}
    summary: Any = None
    write_pictures(tmp_path, Demo(summary, kept, bits=10), told.append)
    assert told == [1, 2, 3, 4]
    names = {
        f"frame_{number}_{kind}.png" for number in ("0007", "1200") for kind in ("codes", "preview")
    }
    assert {path.name for path in tmp_path.iterdir()} == names
    first, last = (
        np.asarray(Image.open(tmp_path / f"frame_{n}_codes.png")) for n in ("0007", "1200")
    )
    assert np.array_equal(first, last[::-1]) and first.shape == (3, 4)
    assert np.array_equal(np.argsort(first, axis=None), np.arange(12))
