"""SPICE CK: attitudes and rates of every type of segment against SciPy's motion and against
SPICE, in frames of all kinds.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import spiceypy
from scipy.spatial.transform import Rotation

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs import ck_spice
from hilstar.attitude.logs.ck import broken_off, reading_of
from hilstar.attitude.logs.ck_spice import (
    Segment,
    _attitudes,
    _packets,
    _Piece,
    _Structure,
    answer,
)
from hilstar.attitude.logs.entries import Stated, log_joins
from hilstar.attitude.logs.log_file import log_timeline, open_log
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    from_matrix,
    from_rotation_vectors,
    to_matrix,
)
from hilstar.basics.units import NS_PER_S
from tests.support.claims import holds
from tests.support.refusals import refusal
from tests.support.sources import spice_kernels as ck

MAS = np.radians(1.0 / 3_600_000)
# A quaternion of 16 digits twice through a matrix: a few roundings of 1 are 1e-15 rad, 2e-7 mas.
READ_BACK_RAD = 1e-5 * MAS
# Read back through the clock: a double of ephemeris time near 6e8 s is even to 2^-23 s, and ticks
# of 2^-16 s are exact in it.
J2000_NS = 946_728_000 * NS_PER_S
# What is read holds the rate as it was written, turned once (1e-16); the motion's own rate is good
# to 1e-13.
RATE_RAD_S = 1e-12
# A rate by difference over h = step / 16 of an interpolating segment: its pieces join with a kink
# in the rate of 1e-4 rad/s.
DIFFERENCE_RAD_S = 1e-3
# Between samples, 1 mas is the target, and a time off by 2^-23 s is 1.8 mas at this motion's 0.075
# rad/s, twice.
BETWEEN_RAD = 4.7 * MAS
ALL = Policy(max_extrapolation_ns=0, stale_after_ns=0)
TIMES = np.arange(0.0, 6.0, 0.25)


def read_ck(path, body=None, kernels=("leap.tls", "clock.tsc")):
    """What the process of its own would answer, in this one; the kernels that are loaded do not
    stay.
    """
    with spiceypy.KernelPool([]):
        return answer(path, [path.parent / name for name in kernels], body)


@pytest.fixture
def motion():
    return ck.Motion(np.random.default_rng(84))


@pytest.fixture
def kernels_folder(tmp_path):
    ck.write_texts(tmp_path)
    return tmp_path


def seconds_of(found):
    return (found.t_ns - J2000_NS - round(ck.START_S) * NS_PER_S) / NS_PER_S


# Types


@pytest.mark.parametrize("rates", [True, False])
@pytest.mark.parametrize("kind", [1, 3])
def test_instances_are_read_back_with_their_rates(kernels_folder, motion, kind, rates):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, kind, motion, TIMES, rates=rates)
    found, said = read_ck(kernels_folder / "a.bc")
    assert said == {"structure": "-82000", "references": ["J2000"]}
    assert seconds_of(found).tolist() == TIMES.tolist()
    for second, q, rate in zip(TIMES, found.q, found.rate, strict=True):
        assert angle_between_rad(q, motion.quaternion(second)) < READ_BACK_RAD
        assert rate == pytest.approx(
            motion.rate(second) if rates else [np.nan] * 3, abs=RATE_RAD_S, nan_ok=True
        )


def spice_at(path, second):
    """SPICE's own attitude, and its rate turned into the structure's components."""
    matrix, rate, _ = spiceypy.ckgpav(ck.BODY, second * ck.TICKS_PER_S, 0, "J2000")
    return from_matrix(matrix), matrix @ rate


def write_kind(path, motion, kind, subtype, rates):
    with ck.new_ck(path) as handle:
        if kind == 2:
            turns = [
                (t, t + 0.5, motion.turn(t), motion.reference_rate(t))
                for t in np.arange(0.0, 6.0, 0.5)
            ]
            ck.write_type_2(handle, turns)
        elif kind == 6:
            ck.write_type_6(handle, motion, [TIMES[:13], TIMES[12:]], rates=rates, subtype=subtype)
        else:
            times = TIMES if rates else TIMES[:7]  # rates by difference take five times as long
            ck.write_segment(handle, kind, motion, times, rates=rates, subtype=subtype)


@pytest.mark.parametrize(
    ("kind", "subtype", "rates"),
    [(2, 0, True), (5, 0, True), (5, 1, False), (5, 2, True), (6, 0, True)],
)
def test_functions_of_time_are_read_in_steps_whose_error_is_the_one_stated(
    kernels_folder, motion, kind, subtype, rates
):
    path = kernels_folder / "a.bc"
    write_kind(path, motion, kind, subtype, rates)
    found, _ = read_ck(path)
    samples = [AttitudeSample(t, q, rate, 0, b) for t, q, rate, b in zip(found.t_ns.tolist(), found.q, found.rate, found.breaks, strict=True)]  # fmt: skip
    timeline = log_timeline(samples, ALL, log_joins(samples))
    assert found.step_s is not None
    assert found.error_rad < BETWEEN_RAD
    rng = np.random.default_rng(kind)
    off_most_rad = 0.0
    with spiceypy.KernelPool(
        [str(kernels_folder / name) for name in ("leap.tls", "clock.tsc", "a.bc")]
    ):
        for second in rng.uniform(0.0, seconds_of(found)[-1], 60):
            matrix = spiceypy.ckgp(ck.BODY, second * ck.TICKS_PER_S, 0, "J2000")[0]
            shown = timeline.at(J2000_NS + round((ck.START_S + second) * NS_PER_S))
            off_rad = angle_between_rad(shown.q_icrs_to_cam, from_matrix(matrix))
            holds("ck-between", off_rad / MAS)
            off_most_rad = max(off_most_rad, off_rad)
            if kind != 2:  # whose intervals do not join
                assert shown.rate_cam_rad_s == pytest.approx(
                    motion.rate(second), abs=DIFFERENCE_RAD_S
                )
    if kind != 2:  # the largest at 200 places is about the largest at 60 others
        assert 0.7 * off_most_rad < found.error_rad


# Frames


OBLIQUITY_ARCSEC = 84381.448  # of J2000, IAU 1976: SPICE's ECLIPJ2000


def test_the_ecliptic_is_turned_by_the_obliquity(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES, reference="ECLIPJ2000")
    found, said = read_ck(kernels_folder / "a.bc")
    assert said["references"] == ["ECLIPJ2000"]
    ecliptic_to_icrs = Rotation.from_euler("x", OBLIQUITY_ARCSEC / 3600, degrees=True)
    for second, q, rate in zip(TIMES, found.q, found.rate, strict=True):
        icrs_to_body = (ecliptic_to_icrs * motion.turn(second)).inv().as_matrix()
        assert angle_between_rad(q, from_matrix(icrs_to_body)) < READ_BACK_RAD
        # of a frame that does not turn, in the body
        assert rate == pytest.approx(motion.rate(second), abs=RATE_RAD_S)


@pytest.mark.parametrize("reference", ["FK4", "GALACTIC", "PROBE_TABLE", "IAU_EARTH"])
def test_other_frames_are_turned_as_spice_turns_vectors(kernels_folder, motion, reference):
    ck.write_texts(kernels_folder, frames_tf=ck.frame_kernel(), earth_tpc=ck.EARTH)
    kernels = ("leap.tls", "clock.tsc", "frames.tf", "earth.tpc")
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES, reference="J2000")
    with (
        ck.new_ck(kernels_folder / "b.bc") as handle,
        spiceypy.KernelPool([str(kernels_folder / kernel) for kernel in kernels]),
    ):
        ck.write_segment(handle, 3, motion, TIMES, reference=reference)
    found, _ = read_ck(kernels_folder / "b.bc", kernels=kernels)
    with spiceypy.KernelPool([str(kernels_folder / kernel) for kernel in kernels]):
        for second, q, rate in zip(TIMES, found.q, found.rate, strict=True):
            change = spiceypy.sxform("J2000", reference, ck.START_S + second)
            to_body = motion.turn(second).inv().as_matrix()
            off_rad = angle_between_rad(q, from_matrix(to_body @ change[:3, :3]))
            holds("ck-frames", off_rad / MAS)
            # d(to frame)/dt = -[w]x (to frame), w the frame's rate in its own components.
            spin = -change[3:, :3] @ change[:3, :3].T
            turning = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            assert rate == pytest.approx(motion.rate(second) + to_body @ turning, abs=RATE_RAD_S)


def test_the_rate_carries_the_attitude_on(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, np.array([0.0, 1.0 / 1024]), reference="J2000")
    found, _ = read_ck(kernels_folder / "a.bc")
    turned = to_matrix(found.q[1]) @ to_matrix(found.q[0]).T
    # v' = -w x v over h = 1e-3 s, by the mean rate: h^3 w^3 / 12 = 1e-14.
    by_rate = Rotation.from_rotvec(-found.rate.mean(axis=0) / 1024).as_matrix()
    assert turned == pytest.approx(by_rate, abs=1e-9)


# Coverage


def test_the_attitude_is_held_between_intervals_of_interpolation(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES, starts=[0.0, 2.0, 4.0])
    found, _ = read_ck(kernels_folder / "a.bc")
    assert TIMES[found.breaks].tolist() == [2.0, 4.0]
    assert found.gaps_s == pytest.approx([0.25, 0.25], abs=1e-6)


def test_segments_that_touch_join_where_they_agree_and_break_where_they_do_not(
    kernels_folder, motion
):
    other = ck.Motion(np.random.default_rng(5))
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        for mover, times in ((motion, [0.0, 1.0, 2.0]), (motion, [2.0, 3.0]), (other, [3.0, 4.0])):
            ck.write_segment(handle, 3, mover, np.array(times))
    found, _ = read_ck(kernels_folder / "a.bc")
    seconds = seconds_of(found)
    assert seconds == pytest.approx([0.0, 1.0, 2.0, 3.0, 3.0, 4.0], abs=1e-5)
    assert found.breaks.tolist() == [False] * 4 + [True, False]
    assert found.gaps_s == []
    # The attitude 2 us from the boundary: at 0.1 rad/s, 41 mas.
    assert angle_between_rad(found.q[3], motion.quaternion(3.0)) < 60 * MAS
    assert angle_between_rad(found.q[4], other.quaternion(3.0)) < 60 * MAS


def test_an_instant_at_the_end_of_another_segment_is_there_once(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES[:5])
        ck.write_segment(handle, 3, motion, TIMES[4:5])
    found, _ = read_ck(kernels_folder / "a.bc")
    assert seconds_of(found) == pytest.approx(TIMES[:5], abs=1e-6)
    assert not found.breaks.any()


def test_where_two_segments_touch_the_rate_is_the_later_one_s(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES[:5], rates=False)
        ck.write_segment(handle, 3, motion, TIMES[4:9])
    found, _ = read_ck(kernels_folder / "a.bc")
    assert seconds_of(found) == pytest.approx(TIMES[:9], abs=1e-6)
    assert np.isfinite(found.rate).all(axis=1).tolist() == [False] * 4 + [True] * 5


def test_the_later_segment_has_priority_where_two_overlap(kernels_folder, motion):
    other = ck.Motion(np.random.default_rng(5))
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES, rates=False)
        ck.write_segment(handle, 3, other, np.array([2.0, 2.25, 2.5]))
    found, _ = read_ck(kernels_folder / "a.bc")
    for second, q, rate in zip(seconds_of(found), found.q, found.rate, strict=True):
        inside = 2.0 <= second <= 2.5
        mover = other if inside else motion
        assert angle_between_rad(q, mover.quaternion(second)) < 60 * MAS
        assert np.isfinite(rate).all() == inside
    # where each of the later two pieces begins, a little to its side of it
    assert seconds_of(found)[found.breaks] == pytest.approx([2.0, 2.5], abs=1e-4)


def test_the_attitudes_of_all_pieces_are_counted(kernels_folder, motion, monkeypatch):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES[:8], starts=[0.0, 1.0])
    monkeypatch.setattr(ck_spice, "MAX_SAMPLES", 8)
    found, _ = read_ck(kernels_folder / "a.bc")
    assert len(found.t_ns) == 8
    monkeypatch.setattr(ck_spice, "MAX_SAMPLES", 7)
    assert "more than 7 attitudes" in refusal(read_ck, kernels_folder / "a.bc")


def test_a_ck_counts_before_another_one_that_is_given_as_a_kernel(kernels_folder, motion):
    """SPICE takes the attitude of what it has loaded last."""
    other = ck.Motion(np.random.default_rng(5))
    for name, mover in (("a.bc", motion), ("other.bc", other)):
        with ck.new_ck(kernels_folder / name) as handle:
            ck.write_segment(handle, 3, mover, TIMES[:5])
    kernels = ("leap.tls", "clock.tsc", "other.bc")
    found, _ = read_ck(kernels_folder / "a.bc", kernels=kernels)
    for second, q in zip(TIMES[:5], found.q, strict=True):
        assert angle_between_rad(q, motion.quaternion(second)) < READ_BACK_RAD


def test_a_long_pause_that_an_interval_covers_is_no_gap(kernels_folder, motion):
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, np.array([0.0, 0.25, 0.5, 0.75, 1.0, 5.0]), rates=False)
    found, _ = read_ck(kernels_folder / "a.bc")
    samples = [AttitudeSample(t, q) for t, q in zip(found.t_ns.tolist(), found.q, strict=True)]
    assert not log_joins(samples).held_ns
    assert not found.breaks.any()


def test_a_gap_of_the_later_segment_is_filled_by_the_earlier_one(kernels_folder, motion):
    other = ck.Motion(np.random.default_rng(5))
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES, rates=False)
        ck.write_segment(handle, 3, other, np.array([1.0, 1.5, 3.0, 3.5]), starts=[1.0, 3.0])
    found, _ = read_ck(kernels_folder / "a.bc")
    between = [
        q for second, q in zip(seconds_of(found), found.q, strict=True) if 1.6 < second < 2.9
    ]
    assert len(between) == 5  # the earlier segment's own times: 1.75 to 2.75 s
    assert angle_between_rad(between[2], motion.quaternion(2.25)) < READ_BACK_RAD
    assert found.gaps_s == []


@pytest.mark.parametrize(("kind", "count"), [(1, 101), (1, 250), (3, 101), (5, 101)])
def test_a_segment_with_a_directory_is_read(kernels_folder, motion, kind, count):
    """From 101 records on a segment has a directory, which each type makes in its own way."""
    times = np.arange(count) * 0.25
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, kind, motion, times)
    found, _ = read_ck(kernels_folder / "a.bc")
    assert seconds_of(found)[[0, -1]] == pytest.approx(times[[0, -1]], abs=1e-6)
    assert angle_between_rad(found.q[-1], motion.quaternion(float(times[-1]))) < READ_BACK_RAD


def test_functions_of_time_with_a_directory_are_read(kernels_folder, motion):
    starts_s = [0.5 * k for k in range(101)]
    steps = [
        (start_s, start_s + 0.4, motion.turn(start_s), [0.0, 0.0, 0.1]) for start_s in starts_s
    ]
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_type_2(handle, steps)
    found, _ = read_ck(kernels_folder / "a.bc")
    assert len(found.gaps_s) == 100


@pytest.mark.parametrize("count", [1, 100, 101, 200, 1000, 1001, 1100, 100_001])
def test_functions_of_time_are_counted_by_the_words_of_their_segment(count):
    """The CK Required Reading, "Data Type 2": a packet has eight words and two times, and every
    hundredth packet before the last one has its start in the directory, too.
    """
    segment = Segment(1, 0.0, 1.0, ck.BODY, 1, 2, has_rate=True, first_word=1, last_word=1)
    words = np.zeros(count * (8 + 2) + (count - 1) // 100)
    assert _packets(words, segment) == (count, 8)


@pytest.mark.parametrize(("kind", "count"), [(1, 1), (3, 3), (5, 8)])
def test_single_instants_are_read_and_held(kernels_folder, motion, kind, count):
    """A CK that forbids interpolation begins an interval with each record."""
    times = np.arange(count) * 1.0
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, kind, motion, times, starts=times)
    found, _ = read_ck(kernels_folder / "a.bc")
    assert seconds_of(found) == pytest.approx(times, abs=1e-6)
    assert found.breaks[1:].all()
    for second, q in zip(times.tolist(), found.q, strict=True):
        assert angle_between_rad(q, motion.quaternion(second)) < READ_BACK_RAD


def test_of_numbered_kernels_beside_the_ck_the_last_by_number_counts(kernels_folder, motion):
    (kernels_folder / "clock.tsc").unlink()
    for number, start_s in ((9, ck.START_S), (10, ck.START_S + 60.0)):
        (kernels_folder / f"clock_{number}.tsc").write_text(ck.clock_kernel(start_s=start_s))
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES)
    log = open_log(kernels_folder / "a.bc")
    assert log.samples[0].t_ns == J2000_NS + round(ck.START_S + 60.0) * NS_PER_S
    line = (
        "kernels from beside the CK: leap.tls, clock_9.tsc, clock_10.tsc; where they differ, the"
        " last counts (clock_10.tsc)"
    )
    assert ("kernels", f"{line}; --kernel names others") in log.told


# The whole way: another process, the kernels beside the file, the mounting, names


def test_a_ck_is_read_with_the_kernels_beside_it_and_the_mounting(kernels_folder, motion):
    ck.write_texts(kernels_folder, frames_tf=ck.frame_kernel())
    with ck.new_ck(kernels_folder / "a.bc") as handle:
        ck.write_segment(handle, 3, motion, TIMES)
        ck.write_segment(handle, 3, ck.Motion(np.random.default_rng(9)), TIMES, body=-82001)
    with pytest.raises(
        InputError, match=r"several structures, -82001, -82000 \(PROBE_BUS\); choose one: --body ID"
    ):
        open_log(kernels_folder / "a.bc")
    mounting = Mounting((0.6, 0.0, 0.8, 0.0))
    log = open_log(kernels_folder / "a.bc", Stated(mounting, body="PROBE_BUS"))
    to_cam = Rotation.from_quat([0.0, 0.8, 0.0, 0.6])
    for second, sample in zip(TIMES, log.samples, strict=True):
        camera = (to_cam * motion.turn(second).inv()).as_matrix()
        assert angle_between_rad(sample.q_icrs_to_cam, from_matrix(camera)) < READ_BACK_RAD
        assert sample.rate_cam_rad_s == pytest.approx(
            to_cam.apply(motion.rate(second)), abs=RATE_RAD_S
        )
    assert (
        "kernels",
        "kernels from beside the CK: leap.tls, clock.tsc, frames.tf; --kernel names others",
    ) in log.told
    lines = log.conventions.lines(mounting)
    assert "structure -82000 (PROBE_BUS)" in lines[0]
    assert log.conventions.of_body


def test_times_are_tdb_whatever_the_clock_counts_and_one_log_leaves_nothing_to_the_next(
    kernels_folder, motion
):
    for name, system in (("tdb", 1), ("tt", 2)):
        place = kernels_folder / name
        place.mkdir()
        ck.write_texts(place, clock_tsc=ck.clock_kernel(system))
        with ck.new_ck(place / "a.bc") as handle:
            ck.write_segment(handle, 1, motion, TIMES)
    tdb, tt = (open_log(kernels_folder / name / "a.bc").samples[0].t_ns for name in ("tdb", "tt"))
    assert tdb == J2000_NS + 600_000_000 * NS_PER_S
    with spiceypy.KernelPool([str(kernels_folder / "leap.tls")]):
        offset_s = spiceypy.unitim(ck.START_S, "TT", "TDB") - ck.START_S
        assert spiceypy.str2et("1970 JAN 01 00:00:00 TDB") == -J2000_NS / NS_PER_S
    assert abs(offset_s) > 1e-5  # so that the clocks differ
    assert (tt - tdb) / NS_PER_S == pytest.approx(offset_s, abs=3e-7)
    assert spiceypy.ktotal("ALL") == 0


@pytest.mark.parametrize(
    ("kind", "has_rate", "whose"),
    [(2, True, "own"), (5, True, "own"), (3, True, "own"), (2, False, "turn"), (5, False, "turn"),
     (3, False, "none")],
)  # fmt: skip
def test_a_function_of_time_without_rates_has_those_of_its_turn(kind, has_rate, whose):
    """A turn about z by 0.01 t^2, ticks of a second: differences to second order are exact. The
    segment's own rates are others, and are kept; attitudes between which nothing is stated have
    none.
    """
    own = np.array([0.1, -0.2, 0.3])
    structure = SimpleNamespace(
        t_s=float,
        t_ns=lambda tick: round(tick * NS_PER_S),
        q_icrs_to_body=lambda tick: from_rotation_vectors(np.array([[0, 0, 0.01 * tick**2]]))[0],
    )
    structure.attitude = lambda tick, rates: (
        structure.q_icrs_to_body(tick),
        own if rates else None,
    )
    structure.rate_by_difference = partial(_Structure.rate_by_difference, structure)
    piece = _Piece(Segment(1, 0.0, 8.0, -1000, 1, kind, has_rate, 1, 2), 0.0, 8.0, np.array([4.0]))
    ticks = np.array([0.0, 4.0, 8.0])
    t_ns, q, rates = _attitudes(structure, piece, ticks)
    assert t_ns.tolist() == [0, 4 * NS_PER_S, 8 * NS_PER_S]
    assert q[1] == pytest.approx(structure.q_icrs_to_body(4.0), abs=1e-15)
    wanted = {
        "own": np.tile(own, (3, 1)),
        "turn": np.outer(0.02 * ticks, [0, 0, -1]),
        "none": np.full((3, 3), np.nan),
    }
    assert rates == pytest.approx(wanted[whose], abs=RATE_RAD_S, nan_ok=True)


def test_what_the_process_answers_becomes_a_log_with_its_breaks_and_notices():
    q = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.6, 0.8]])
    rate = np.array([[0.1, -0.2, 0.3], [np.nan] * 3, [0.0, 0.0, 0.5]])
    arrays = {
        "t_ns": np.array([1, 2, 4]) * NS_PER_S,
        "q": q,
        "rate": rate,
        "breaks": np.array([False, False, True]),
        "tick": np.array([65_536.0, 131_072.5, 262_144.0]),
    }
    # 2e-8 rad are 4.1253 mas
    reply = {"step_s": 0.03125, "error_rad": 2e-8, "gaps_s": [0.5, 12.25, 2.0]}
    said = {"structure": "-82000 (CASSINI)", "references": ["B1950", "J2000"]}
    reading = reading_of(arrays, reply | said, [("kernels", "some")])
    entries = list(reading.entries)
    assert [entry.where for entry in entries] == [
        ", tick 65536",
        ", tick 131072.5",
        ", tick 262144",
    ]
    samples = [entry.event for entry in entries]
    assert [sample.t_ns for sample in samples] == [NS_PER_S, 2 * NS_PER_S, 4 * NS_PER_S]
    assert np.array([sample.q_icrs_to_cam for sample in samples]).tolist() == q.tolist()
    assert samples[0].rate_cam_rad_s.tolist() == [0.1, -0.2, 0.3]
    assert samples[1].rate_cam_rad_s is None
    assert [sample.discontinuity for sample in samples] == [False, False, True]
    assert reading.told == [
        ("kernels", "some"),
        (
            "ck-step",
            "read every 0.03125 s where the CK is a function of time; off by 4.1 mas between",
        ),
        ("log-gap", "the CK has 3 gaps, the longest 12.25 s; the attitude is held there"),
    ]
    assert reading.conventions.source == "SPICE CK, structure -82000 (CASSINI)"
    assert "components of B1950, J2000 (by SPICE: J2000" in reading.conventions.turns
    assert reading.conventions.of_body and reading.conventions.scale == "TDB"
    whole = reading_of(arrays, said | {"step_s": None, "error_rad": 0.0, "gaps_s": [3.0]})
    assert whole.told == [
        ("log-gap", "the CK has 1 gap, the longest 3 s; the attitude is held there")
    ]


@pytest.mark.parametrize(
    ("error_output", "last"),
    [
        (b"Toolkit version: N0067\n\nSPICE(DAFBEGGTEND)\n", "SPICE(DAFBEGGTEND)"),
        (b"  \n", "no word"),
    ],
)
def test_a_process_that_broke_off_is_refused_with_its_last_line(error_output, last):
    assert broken_off(Path("a.bc"), error_output) == (
        f"a.bc: SPICE broke off with it ({last}); is it, or a kernel, damaged?"
    )
