"""The commanded attitude between the frames of a run."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.commanded_run import read_commanded
from hilstar.server.record.ledger_records import FrameRecord
from tests.support.planted_run import write_records
from tests.support.planted_tracker import ARCSEC_PER_RAD, attitude, scalar_first, scan


def test_a_jump_between_frames_is_not_taken_for_a_motion() -> None:
    t_s = np.arange(0.0, 10.0, 0.1)
    angle = np.where(t_s < 5.05, 0.0, np.radians(0.5)) / 2
    commanded = Commanded(t_s, np.stack([np.cos(angle), np.sin(angle), 0 * t_s, 0 * t_s], axis=1))
    assert np.flatnonzero(~commanded.joined).tolist() == [50]
    assert commanded.at(np.array([4.95, 5.05, 5.15])).known.tolist() == [True, False, True]


def test_between_frames_the_commanded_attitude_is_that_of_the_motion() -> None:
    """The scan's third derivative is 3 deg (2 pi / 271 s)^3 = 0.13 arcsec/s^3 at most: dt^3 / 15
    of it is 1e-5 arcsec.
    """
    t_s = np.arange(0.0, 100.0, 0.1)
    commanded = Commanded(t_s, scalar_first(attitude(scan, t_s)))
    between = t_s[5:-5] + 0.037
    moments = commanded.at(between)
    truth = scalar_first(attitude(scan, between))
    assert moments.known.all()
    sine = np.abs(np.cross(moments.q[:, 1:], truth[:, 1:]))
    assert 2 * ARCSEC_PER_RAD * sine.max() < 1e-3
    ahead = commanded.at(between + 0.01)
    step = (attitude(scan, between + 0.01) * attitude(scan, between).inv()).as_rotvec()
    assert ahead.known.all()
    np.testing.assert_allclose(-step / 0.01, moments.rate_rad_s, atol=1e-6)


AXIS = np.array([0.48, -0.6, 0.64])
START = Rotation.from_euler("xyz", [0.2, -0.5, 1.1])
EXACT = 1e-9  # rad and rad/s: some thousand roundings of 1


def turned(angle_rad) -> Rotation:
    """The camera turned by angles (n,) about AXIS: the sky's components turn the other way."""
    return Rotation.from_rotvec(-np.multiply.outer(angle_rad, AXIS)) * START


def test_an_even_acceleration_is_met_between_frames_that_are_unevenly_apart():
    """A cubic through four frames has no error where the turn is a square of time."""
    rate_rad_s, acceleration_rad_s2 = 2e-3, 3e-3
    t_s = np.cumsum(np.array([0.0, 0.1, 0.13, 0.1, 0.15, 0.11, 0.1, 0.14, 0.12]))
    angle = rate_rad_s * t_s + acceleration_rad_s2 * t_s**2 / 2
    commanded = Commanded(t_s, scalar_first(turned(angle)))
    between_s = np.linspace(t_s[1], t_s[-2], 41)
    moments = commanded.at(between_s)
    assert moments.known.all()
    wanted = turned(rate_rad_s * between_s + acceleration_rad_s2 * between_s**2 / 2)
    reached = Rotation.from_quat(np.roll(moments.q, -1, axis=1))
    assert (reached * wanted.inv()).magnitude().max() < EXACT
    rate = np.multiply.outer(rate_rad_s + acceleration_rad_s2 * between_s, AXIS)
    np.testing.assert_allclose(moments.rate_rad_s, rate, atol=EXACT)


def test_beside_an_interval_of_another_length_the_turn_is_even():
    t_s = np.array([0.0, 0.1, 0.3, 0.4])
    angle = np.array([0.0, 1e-4, 9e-4, 1.6e-3])
    commanded = Commanded(t_s, scalar_first(turned(angle)))
    moments = commanded.at(np.array([0.12, 0.2, 0.28]))
    even = np.outer(np.full(3, 8e-4 / 0.2), AXIS)
    np.testing.assert_allclose(moments.rate_rad_s, even, atol=EXACT)
    # the first and the last interval have no neighbour of their length either
    ends = commanded.at(np.array([0.05, 0.35]))
    np.testing.assert_allclose(ends.rate_rad_s, np.outer([1e-3, 7e-3], AXIS), atol=EXACT)


@pytest.mark.parametrize(
    ("gap_s", "turn_rad", "is_known"),
    [
        (0.45, 1e-4, True),
        (0.55, 1e-4, False),  # longer than half a second and than three intervals
        (90.0, 0.0, True),  # the same attitude stands
        (90.0, 1e-4, False),
        (0.1, 0.036, False),  # over two degrees
    ],
)
def test_what_was_shown_in_a_gap_is_known_where_little_can_have_happened(gap_s, turn_rad, is_known):
    t_s = np.append(np.arange(0.0, 1.0, 0.1), 0.9 + gap_s + np.arange(0.0, 1.0, 0.1))
    angle = np.where(t_s < 0.95, 0.0, turn_rad)
    commanded = Commanded(t_s, scalar_first(turned(angle)))
    moments = commanded.at(np.array([0.9 + gap_s / 2, 0.55, -0.01, t_s[-1] + 0.01]))
    assert moments.known.tolist() == [is_known, True, False, False]
    assert np.isfinite(moments.q[:, 0]).tolist() == moments.known.tolist()
    assert commanded.at(t_s[[0, -1]]).known.all()


def test_long_intervals_are_no_gaps_where_all_are_long():
    t_s = 2.0 * np.arange(6)
    t_s[4:] += 3.9  # 5.9 s, under three of 2 s
    commanded = Commanded(t_s, scalar_first(turned(1e-4 * t_s)))
    assert commanded.joined.tolist() == [True] * 5
    assert commanded.interval_s == 2.0


def test_a_moment_in_which_a_frame_stood_says_for_how_long():
    t_s = np.arange(0.0, 2.0, 0.1)
    held_s = np.array([[0.5, 0.7], [0.9, 1.3], [1.6, 1.7]])
    commanded = Commanded(t_s, scalar_first(turned(1e-4 * t_s)), held_s)
    at_s = np.array([0.45, 0.5, 0.6, 0.75, 1.2, 1.45, 1.6, 1.75])
    wanted_s = [0.0, 0.2, 0.2, 0.0, 0.4, 0.0, 0.1, 0.0]
    # until the next frame is there
    assert commanded.at(held_s[:, 1]).held_s == pytest.approx([0.2, 0.4, 0.1])
    assert commanded.at(at_s).held_s == pytest.approx(wanted_s)
    # seen from 0.12 s away the first two are one
    wide = commanded.over_exposures(0.12)
    wanted_s = [0.4, 0.4, 0.4, 0.4, 0.4, 0.0, 0.1, 0.1]
    assert wide.at(at_s).held_s == pytest.approx(wanted_s)


def frame(number: int, light_s: float, angle_rad: float, **more) -> FrameRecord:
    """A frame of the turned camera."""
    q = tuple(scalar_first(turned(np.array([angle_rad])))[0].tolist())
    at_ns = round((100.0 + light_s) * NS_PER_S)
    known = {"t_ns": 1, "light_ns": at_ns, "draw_ns": number, "swap_ns": number, "q": q}
    return FrameRecord(frame=number, **(known | more))


def test_a_run_s_commanded_attitudes_are_those_that_its_screen_showed(tmp_path):
    ledger = write_records(
        tmp_path / "run.mcap",
        [
            frame(0, 0.0, 0.0, missed_before=4),
            frame(1, 0.1, 0.1),
            frame(2, 0.2, 0.2, q=None),
            frame(3, 0.3, 0.3, operator="grid"),
            frame(4, 0.4, 0.4, hidden="covered"),
            frame(5, 0.7, 0.7, missed_before=2),
            # the sender's clock was read anew: two frames of one moment, of which the last counts
            frame(6, 0.8, 0.8),
            frame(7, 0.8, 0.9, missed_before=1),
        ],
    )
    run = read_commanded(ledger)
    assert (run.zero_ns, run.changed, run.missed, run.held) == (100 * NS_PER_S, 2, 7, 2)
    assert run.commanded.t_s == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.7, 0.8])
    assert run.commanded.shown.tolist() == [True, True, False, False, False, True, True]
    shown = turned(np.array([0.0, 0.1, 0.7, 0.9]))
    np.testing.assert_allclose(run.commanded.q[run.commanded.shown], scalar_first(shown))
    np.testing.assert_allclose(run.commanded.held_s, [[0.4, 0.7], [0.7, 0.8]])
    assert run.missed_share == pytest.approx(7 / 14)
    assert run.seconds(np.array([100_250_000_000])) == pytest.approx([0.25])


@pytest.mark.parametrize(("count", "words"), [(0, "has no frames"), (1, "has one frame")])
def test_a_run_of_one_frame_commands_nothing(tmp_path, count, words):
    ledger = write_records(tmp_path / "run.mcap", [frame(0, 0.0, 0.0)] * count)
    with pytest.raises(InputError, match=words):
        read_commanded(ledger)
