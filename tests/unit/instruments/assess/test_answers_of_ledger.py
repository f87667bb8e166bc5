"""Where a ledger's own answers and a file's lie on the run's clock, in which axes they are, and what
of their noise is not the tracker's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_rotation_vector
from hilstar.instruments.assess import assessment
from hilstar.instruments.assess.assessment import (
    CLOCK_SET,
    AssessSettings,
    RunLedger,
    TimedAnswers,
    matched,
    read_answers,
    read_ledger,
)
from hilstar.instruments.assess.bench_effects import DisplayCost, glass_cost
from hilstar.instruments.assess.budget import Axes
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.record.commanded_run import read_commanded
from hilstar.server.record.ledger_records import AnswerRecord
from tests.support.assessments import RIGHT, VALID, a_budget, a_run, an_assessment
from tests.support.benches import bench_text
from tests.support.glass import SIDE_PX, stack
from tests.support.planted_run import NS_PER_S, write_ledger, write_run, write_telemetry
from tests.support.planted_tracker import Planted, Sizes, attitude, plant, scalar_first, scan

FRAMES_S = np.arange(0.0, 10.0, 0.5)
AHEAD_NS = 7_000_000_000  # of the tracker's clock to the sender's
LIGHT_NS, LATE_NS = 30_000_000, 200_000_000  # light after the live estimate; arrival after it
SHIFT_S = 3.5


def record(at_ns: int, **changes: object) -> AnswerRecord:
    """A right answer of an exposure that the run believed to be at a host time."""
    facts: dict[str, object] = {
        "host_ns": at_ns + LATE_NS,
        "raw": "",
        "t_ns": at_ns + LIGHT_NS + AHEAD_NS,
        "q": (1.0, 0.0, 0.0, 0.0),
        "verdict": "right",
        "middle_ns": at_ns,
        "light_ns": at_ns + LIGHT_NS,
    }
    return AnswerRecord(**(facts | changes))  # type: ignore[arg-type]


def ledger_of(folder: Path, records: list[AnswerRecord]) -> Path:
    q = scalar_first(attitude(scan, FRAMES_S))
    return write_ledger(folder / "run.mcap", FRAMES_S, q, start_ns=0, records=records)


def test_answers_are_sorted_by_their_stamps_and_each_keeps_what_it_has(tmp_path: Path) -> None:
    """The third was overtaken by the fourth, the fifth comes twice, and the sixth has no attitude;
    nobody judged the second, which came as late as the others.
    """
    at_ns = [NS_PER_S * k for k in range(1, 7)]
    records = [record(at) for at in at_ns]
    records[1] = record(at_ns[1], verdict="unjudged", middle_ns=at_ns[1] + LATE_NS, light_ns=None)
    records[2] = record(at_ns[2], host_ns=at_ns[3] + LATE_NS + 1, rate=(0.1, 0.2, 0.3))
    records[3] = record(at_ns[3], centroids=((1.0, 2.0, 3.0, 4),))
    records.insert(5, record(at_ns[4], host_ns=at_ns[4] + LATE_NS + 1, q=(0.0, 1.0, 0.0, 0.0)))
    records[6] = record(at_ns[5], q=None, verdict="invalid")
    told = read_answers(ledger_of(tmp_path, records), "end")
    telemetry = told.telemetry
    assert (told.stamp, told.out_of_order, told.clock_set) == ("end", 1, False)
    assert telemetry.t_ns.tolist() == [at + LIGHT_NS + AHEAD_NS for at in at_ns]
    # numbers of the answers as they came, from 1
    assert telemetry.line.tolist() == [1, 2, 4, 3, 5, 7]
    assert telemetry.valid.tolist() == [True] * 5 + [False]
    assert np.isnan(telemetry.q[5]).all()
    assert telemetry.q[4].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert telemetry.rate_cam_rad_s is not None
    assert telemetry.rate_cam_rad_s[2].tolist() == [0.1, 0.2, 0.3]
    assert list(told.centroids)[3] == [ReportedStar(1.0, 2.0, 3.0, 4)]
    assert told.ahead_ns == AHEAD_NS
    assert telemetry.of_lines is False


def test_answers_without_stamps_are_where_the_run_placed_them(tmp_path: Path) -> None:
    at_ns = [NS_PER_S * k for k in range(1, 5)]
    records = [record(at) for at in at_ns]
    records[2] = record(at_ns[2], t_ns=None)
    # as late as the others by its arrival
    records[3] = record(at_ns[3], verdict="unjudged", middle_ns=0, light_ns=None)
    ledger = ledger_of(tmp_path, records)
    told = read_answers(ledger, "start")
    assert told.telemetry.t_ns.tolist() == [at + LIGHT_NS for at in at_ns]
    assert (told.stamp, told.ahead_ns) == ("middle", 0)
    by_arrival = read_answers(ledger_of(tmp_path, [record(at) for at in at_ns]), "arrival")
    assert by_arrival.telemetry.t_ns.tolist() == [at + LIGHT_NS for at in at_ns]
    assert by_arrival.stamp == "middle"


def test_answers_that_came_after_a_later_one_are_counted_each(tmp_path: Path) -> None:
    """Stamps of 1, 4, 2, 3 and 5 s: two were overtaken by the second."""
    at_ns = [NS_PER_S * k for k in (1, 4, 2, 3, 5)]
    records = [record(at, host_ns=9 * NS_PER_S + k) for k, at in enumerate(at_ns)]
    assert read_answers(ledger_of(tmp_path, records), "middle").out_of_order == 2


# Eleven answers to a block, 200 s apart: a drift of 1e-3 is 2.2 s from one block to the next, a step
# is one beyond 1 s and twice that.
@pytest.mark.parametrize(
    ("drift", "step_s", "is_set"),
    [
        (1e-3, 0.0, False),
        (-1e-3, 0.0, False),
        (1.9e-3, 0.0, False),
        (0.0, 6.0, True),
        (0, -6, True),
    ],
)
def test_blocks_that_are_long_apart_may_drift_as_far(drift, step_s, is_set) -> None:
    host_ns = 200 * NS_PER_S * np.arange(33)
    t_ns = host_ns + np.rint(drift * host_ns).astype(np.int64)
    t_ns[11:] += round(step_s * NS_PER_S)
    assert assessment._clock_was_set(t_ns, host_ns) is is_set


@pytest.mark.parametrize(("step_s", "is_set"), [(0.0, False), (0.2, False), (5.0, True)])
def test_a_clock_that_steps_for_good_was_set_and_one_that_drifts_was_not(
    tmp_path: Path, step_s: float, is_set: bool
) -> None:
    """Of 44 answers in 9 s; a drift of a thousandth is no step."""
    records = []
    for k in range(44):
        at_ns = round((0.2 + 0.2 * k) * NS_PER_S)
        own_ns = at_ns + LIGHT_NS + AHEAD_NS + round(1e-3 * at_ns)
        records.append(record(at_ns, t_ns=own_ns + round(step_s * NS_PER_S) * (k >= 22)))
    told = read_answers(ledger_of(tmp_path, records), "start")
    assert told.clock_set is is_set
    assert told.stamp == ("middle" if is_set else "start")
    run = a_run()
    timed = TimedAnswers(run.path, told.telemetry, np.zeros(44), 0.0, clock_set=is_set)
    assert (CLOCK_SET in assessment._notes(run, a_budget(), timed)) is is_set


def test_a_ledger_s_answers_without_an_attitude_are_refused(tmp_path: Path) -> None:
    records = [record(NS_PER_S, valid=False), record(2 * NS_PER_S, q=None)]
    with pytest.raises(InputError, match="has 2 answers, none of them with an attitude"):
        read_answers(ledger_of(tmp_path, records), "middle")


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunLedger, Planted, Path]:
    """A minute of two answers a second, without wild ones."""
    folder = tmp_path_factory.mktemp("short")
    rng = np.random.default_rng(11)
    planted = plant(scan, Sizes(wild=0), rng, seconds=60.0, rate_hz=2.0)
    ledger, telemetry = write_run(folder, planted)
    return read_ledger(ledger), planted, telemetry


@pytest.mark.parametrize(
    ("rotvec_deg", "words"),
    [
        (
            [180, 0, 0],
            "turned by 180 degrees about -1.000,0.000,0.000 (cam)...x = +x, y = -y, z = -z",
        ),
        (
            [0, 0, 90],
            "turned by 90... degrees about 0.000,0.000,1.000 (cam)...x = -y, y = +x, z = +z",
        ),
        ([69.282, 69.282, 69.282], "turned by 120 degrees...x = +z, y = +x, z = +y"),
        ([0, 0, 30], "another frame or mounting; turn them back by the quaternion 0.9659"),
    ],
)
def test_answers_in_other_axes_are_refused_with_how_they_are_turned(
    short, rotvec_deg, words
) -> None:
    run, planted, path = short
    turn = Rotation.from_rotvec(np.radians(rotvec_deg))
    q = scalar_first(turn * Rotation.from_quat(np.roll(planted.reported, -1, axis=1)))
    with pytest.raises(InputError) as refused:
        matched(run, read_telemetry(path), planted.tau_s, q)
    line = str(refused.value)
    for part in words.split("..."):
        assert part in line
    if "turn them back" in words:
        numbers = line.partition("quaternion ")[2].partition(" ")[0]
        back = np.array([float(number) for number in numbers.split(",")])
        rotation = Rotation.from_quat(np.roll(back, -1)) * turn
        # within the planted bias of 20 arcsec an axis and more about the boresight
        assert rotation.magnitude() < np.radians(60 / 3600)


def test_answers_of_a_clock_of_its_own_are_where_their_attitudes_say(short) -> None:
    run, planted, path = short
    turn = Rotation.from_rotvec(np.radians([0, 3, 0]))
    q = scalar_first(turn * Rotation.from_quat(np.roll(planted.reported, -1, axis=1)))
    coarse = matched(run, read_telemetry(path), planted.tau_s + SHIFT_S, q)
    assert coarse.offset_s == pytest.approx(-SHIFT_S, abs=0.3)
    assert np.degrees(to_rotation_vector(coarse.rotation)) == pytest.approx([0, 3, 0], abs=0.05)


def test_a_display_s_variance_is_subtracted_by_the_square_of_the_share_that_is_seen() -> None:
    """Of noise of variances 0.25, 1 and 9: a share of 0.9 of 0.5 arcsec across and 1 about."""
    found = a_budget()
    display = DisplayCost(0.5, 1.0, 9, seen=0.9, sigma_seen=0.1)
    noise, (note,) = assessment._without_display(found, display)
    assert noise.cross == pytest.approx(np.sqrt(0.625 - 0.81 * 0.25))
    assert noise.roll == pytest.approx(np.sqrt(9.0 - 0.81))
    assert "81 % of its variance are subtracted" in note
    unsure, (note,) = assessment._without_display(found, replace(display, sigma_seen=0.4))
    assert (unsure.cross, unsure.roll) == pytest.approx((np.sqrt(0.625), 3.0))
    assert "nothing is subtracted" in note
    small = replace(display, cross_arcsec=0.2, roll_arcsec=0.5)
    assert assessment._without_display(found, small)[1] == []
    assert assessment._without_display(found, None) == (found.noise_arcsec, [])


def timed(run: RunLedger, **changes: object) -> TimedAnswers:
    facts: dict[str, object] = {"tau_s": np.zeros(12), "base_s": 0.0}
    return TimedAnswers(run.path, an_assessment().telemetry, **(facts | changes))  # type: ignore[arg-type]


def test_notes_say_what_the_motion_does_not_tell() -> None:
    run = a_run()
    found = replace(a_budget(), rate_rad_s=np.zeros((8, 3)))
    assert assessment._notes(run, found, timed(run)) == []
    still = replace(found, clock=replace(found.clock, drift_told=False))
    (note,) = assessment._notes(run, still, timed(run))
    assert note.startswith("the run has no motion that tells the clock")
    constant = replace(found, clock=replace(found.clock, offset_told=False))
    (note,) = assessment._notes(run, constant, timed(run))
    assert "is taken to be 1.25 ms beside the rough one" in note
    (note,) = assessment._notes(run, found, timed(run, base_s=-12.5, overlap=False))
    assert note.startswith("the telemetry's times, 12.5 s from the run's, do not overlap it")
    wide = replace(found.intervals, fov=np.array([[0.0, 7.0], [3.75, 8.5]]))
    (note,) = assessment._notes(run, replace(found, intervals=wide), timed(run))
    assert "is not shown and at most 3.8 arcsec" in note
    wide = replace(found.intervals, fov=np.array([[1.5, 7.0], [4.0, 8.5]]))
    (note,) = assessment._notes(run, replace(found, intervals=wide), timed(run))
    assert "is at least 1.5 and at most 4 arcsec" in note
    none = replace(found, fov_arcsec=Axes(None, None), intervals=wide)
    assert assessment._notes(run, none, timed(run)) == []


def test_noise_that_lasts_for_many_answers_is_said_to(rng: np.random.Generator) -> None:
    """Twenty in a row that share a third of the variance."""
    run = a_run()
    found = replace(a_budget(), rate_rad_s=np.zeros((8, 3)))
    blocks = 60
    shared = np.repeat(rng.standard_normal((blocks, 3)), 20, axis=0)
    white = rng.standard_normal((20 * blocks, 3))
    sizes = np.array([1.0, 1.0, 4.0])
    for share, count in ((0.0, 0), (1 / 3, 1)):
        left = sizes * (np.sqrt(share) * shared + np.sqrt(1 - share) * white)
        parts = replace(found.components, left=left, noise_variance=sizes**2)
        notes = assessment._notes(run, replace(found, components=parts), timed(run))
        assert len(notes) == count
    size = float(notes[0].split("not white: ")[1].split()[0])
    # of 60 blocks a sigma is known to 9 %
    assert size == pytest.approx(np.sqrt(1 / 3), rel=0.3)


def test_a_mean_over_an_exposure_is_off_by_acceleration_times_its_square_over_24() -> None:
    """Over 2 s of a rate that grows by 0.01 rad/s each second."""
    t_s = np.arange(0.0, 8.0, 0.25)
    rates = np.zeros((len(t_s), 3))
    rates[:, 1] = 0.01 * t_s
    clock = replace(a_budget().clock, t_s=t_s)
    found = replace(a_budget(), clock=clock, row=np.arange(len(t_s)), rate_rad_s=rates)
    bent_arcsec = assessment._bent_arcsec(found, 2.0)
    assert bent_arcsec == pytest.approx(np.degrees(0.01) * 3600 * 4 / 24)


def test_what_a_file_of_a_psf_costs_is_split_by_place_and_colour(tmp_path: Path) -> None:
    """Lateral colour and coma in closed form, which grow with the cube of the radius and with it:
    most of 0.16 px, of which a distortion takes all but a quarter, and colour most of that.
    """
    write_glass(tmp_path / "psf.fits", glass_of(stack()))
    tracker = {"resolution_px": [SIDE_PX, SIDE_PX], "focal_length_mm": 12, "transmission": None}
    text = bench_text({"tracker": tracker, "tracker.optics": {"psf": "psf.fits"}})
    q = scalar_first(attitude(scan, np.linspace(0.0, 400.0, 14)))
    cost = glass_cost(bench_file_of(tmp_path / "bench.toml", text), q)
    assert cost is not None
    assert (cost.source, cost.centroider, cost.attitudes) == ("PSF file", "window", 14)
    px = cost.rms_px
    # of u and v of 0.58 rms: 0.15 (u^3 + u v^2) and 0.125 u of the wider Gaussian, each way
    assert 0.1 < px["total"] < 0.25
    assert px["without_distortion"] < 0.4 * px["total"]
    assert px["without_both"] < 0.5 * px["without_distortion"]
    assert px["without_both"] < px["without_colour"] < px["total"]
    plain = bench_text({"tracker": tracker})
    assert glass_cost(bench_file_of(tmp_path / "bench.toml", plain), q) is None


@pytest.mark.parametrize(
    ("ahead_s", "overlap"),
    [(0.0, True), (50.0, True), (-50.0, True), (70.0, False), (-70.0, False)],
)
def test_a_file_s_times_count_from_the_run_s_zero_where_they_meet_it(
    short, tmp_path: Path, ahead_s: float, overlap: bool
) -> None:
    """A run of a minute, and answers from 0.3 s on; of an exposure's start, late by 0.25 s."""
    run, planted, _ = short
    path = write_telemetry(tmp_path / "t.csv", planted.tau_s, planted.reported, 5.0 + ahead_s)
    settings = AssessSettings(stamp="start", latency_s=0.25)
    timed = assessment._answers_of_file(run, path, settings)
    assert timed.overlap is overlap
    first_s = float(planted.tau_s[0]) + ahead_s
    assert timed.base_s == pytest.approx(0.0 if overlap else first_s)
    middle_s = run.config.tracker.exposure_s / 2 - 0.25
    expected = planted.tau_s + ahead_s - timed.base_s + middle_s
    assert timed.tau_s == pytest.approx(expected, abs=1e-6)


def test_a_moment_within_an_exposure_and_a_refresh_of_a_held_frame_is_held(tmp_path: Path) -> None:
    """An exposure of 0.3 s on a display of 10 Hz: 0.25 s before the missed frames, and after them."""
    frames_s = np.arange(0.0, 10.0, 0.1)
    frames_s = frames_s[(frames_s < 3.95) | (frames_s > 4.45)]
    missed = [0] * len(frames_s)
    missed[40] = 5
    q = scalar_first(attitude(scan, frames_s))
    text = bench_text({"tracker": {"exposure_s": 0.3}, "monitor": {"refresh_hz": 10.0}})
    path = write_ledger(
        tmp_path / "run.mcap", frames_s, q, start_ns=0, bench=text, missed_before=missed
    )
    run = read_ledger(path)
    ((begin_s, end_s),) = read_commanded(path).commanded.held_s.tolist()
    reach_s = 0.3 / 2 + 0.1
    ends_s = np.repeat([begin_s - reach_s, end_s + reach_s], 2)
    moments_s = ends_s + np.tile([-1e-3, 1e-3], 2)
    assert (run.commanded.at(moments_s).held_s > 0).tolist() == [False, True, True, False]


def test_answers_at_held_frames_came_and_were_not_wrong() -> None:
    """Of twelve rows the valid ones are numbered among themselves: the eighth of these is right,
    the sixth was held, the fourth is wrong.
    """
    valid = np.flatnonzero(VALID)
    right, wrong = assessment._right_and_wrong(a_budget(), valid, len(VALID))
    assert np.flatnonzero(right).tolist() == sorted([*valid[RIGHT].tolist(), int(valid[5])])
    assert np.flatnonzero(wrong).tolist() == [valid[3]]


def test_a_cube_s_doubt_is_half_of_the_bias_s_interval(monkeypatch) -> None:
    told = []
    monkeypatch.setattr(assessment, "cube_to_boresight", lambda *given: told.append(given))
    found = a_budget()
    assessment._cube_of("file", "certificate", found)  # type: ignore[arg-type]
    ((file, certificate, turned),) = told
    assert (file, certificate) == ("file", "certificate")
    assert turned.bias_arcsec.tolist() == [-3.0, 4.0, -11.0]
    assert turned.half_arcsec.tolist() == [0.5, 0.75, 2.0]


@pytest.mark.parametrize(
    ("lasting_arcsec", "told_arcsec"), [(0.0, None), (0.35, None), (0.45, 0.38), (0.9, 0.85)]
)
def test_noise_that_lasts_counts_beyond_what_white_noise_leaves_in_a_mean(
    lasting_arcsec, told_arcsec
) -> None:
    """Of one arcsec from answer to answer a mean of twenty has a twentieth of the variance."""
    blocks = 40
    alone = np.tile([1.0, -1.0], 10 * blocks)
    lasting = np.repeat(np.tile([1.0, -1.0], blocks // 2), 20) * lasting_arcsec
    left = (alone + lasting)[:, None] * np.ones(3)
    found = a_budget()
    variance = np.full(3, 1 + lasting_arcsec**2)
    components = replace(found.components, left=left, noise_variance=variance)
    timed = TimedAnswers(Path("x.csv"), an_assessment().telemetry, np.zeros(1), 0.0)
    notes = assessment._notes(a_run(), replace(found, components=components), timed)
    slow = [note for note in notes if "the noise is not white" in note]
    assert len(slow) == (told_arcsec is not None)
    if told_arcsec is not None:
        assert (
            f"{told_arcsec:.2g} arcsec across the boresight and {told_arcsec:.2g} about" in slow[0]
        )
