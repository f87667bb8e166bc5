"""The figures of a run's report from its records: a short run of which every record differs, all of
it against figures by hand and by NumPy, however the records are cut into blocks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.record.answer_figures import AnswerTally
from hilstar.server.record.ledger_records import (
    LOST,
    AnswerRecord,
    CountRecord,
    EventRecord,
    FaultRecord,
    FrameRecord,
    PacketForm,
    ProcessRecord,
    RunRecord,
)
from hilstar.server.record.run_figures import (
    COUNTS,
    METRICS,
    Keyframes,
    RunFigures,
    _turns_rad,
    summarise,
    table_rows,
)
from tests.support.benches import SMALL_BENCH

BEGIN_NS = 10**12
BIN = 2e-3  # a percentile is known to a bin of 0.2 %
ROTATION_RAD = 1e-12  # of the closed form against SciPy's, some roundings of 1 rad


class Shown(NamedTuple):
    """A frame: its swap, ms after BEGIN_NS; predicted, begun and received so many ms before that;
    and the rest of its record.
    """

    swap_ms: float
    late_ms: float | None
    draw_ms: float
    age_ms: float | None
    prediction_ms: float
    packet_ms: float | None
    rest: dict[str, Any]


BLANK: dict[str, Any] = {"q": None, "stale": True}
FRAMES = (
    Shown(0.0, 0.5, 4.0, 7.0, 1.0, 9.0, {"stars_drawn": 30, "below_step": 2}),
    Shown(16.0, None, 5.0, 8.5, 2.0, 11.0, {"stars_drawn": 50, "clipped": 3, "capped": 1}),
    Shown(33.0, -0.25, 3.0, None, 0.0, None, BLANK),
    # two refreshes late, and stale
    Shown(85.0, 2.0, 9.0, 90.0, 40.0, 95.0, {"stale": True, "missed_before": 2, "missed": 2}),
    Shown(100.0, 0.125, 6.0, 3.0, 4.0, 5.0, {"operator": "grid", "missed": 2, "below_step": 7}),
    Shown(119.0, 0.25, 7.5, 4.0, 0.5, 6.0, {"hidden": "covered", "missed": 2, "capped": 4}),
    Shown(136.0, 1.0, 8.0, 5.0, 3.0, 7.0, {"missed": 2, "stars_drawn": 40, "clipped": 1}),
    Shown(152.5, 1.5, 2.0, 6.0, 2.5, 8.0, {"missed": 2}),
)
# the turn from one attitude to the next that is shown, rad about x, y, z
TURNS_RAD = np.array([[1e-3, 0, 0], [0, 2e-3, 0], [0, 0, -4e-3], [3e-3, 1e-3, 0]] * 2)[:7]


def host_ns(ms: float) -> int:
    """A host time of the run."""
    return BEGIN_NS + round(ms * NS_PER_MS)


def frames() -> list[FrameRecord]:
    """The frames of the run, whose sky turns; its timeline goes at half of the host's speed."""
    attitudes = [Rotation.from_euler("xyz", [0.3, -0.4, 0.5])]
    for turn in TURNS_RAD:
        attitudes.append(Rotation.from_rotvec(turn) * attitudes[-1])
    records = []
    for number, (shown, attitude) in enumerate(zip(FRAMES, attitudes, strict=True)):
        x, y, z, w = attitude.as_quat().tolist()
        swap_ns = host_ns(shown.swap_ms)
        record = FrameRecord(
            frame=number,
            t_ns=round(shown.swap_ms / 2 * NS_PER_MS) + 77,
            light_ns=0,
            draw_ns=swap_ns - round(shown.draw_ms * NS_PER_MS),
            swap_ns=swap_ns,
            q=(w, x, y, z),
            timestamp_source="GLX",
            prediction_ns=round(shown.prediction_ms * NS_PER_MS),
        )
        if shown.late_ms is not None:
            record.predicted_swap_ns = swap_ns - round(shown.late_ms * NS_PER_MS)
        if shown.age_ms is not None:
            record.age_ns = round(shown.age_ms * NS_PER_MS)
        if shown.packet_ms is not None:
            record.receive_ns = swap_ns - round(shown.packet_ms * NS_PER_MS)
        for name, value in shown.rest.items():
            setattr(record, name, value)
        records.append(record)
    return records


def others() -> list[tuple[float, RunRecord]]:
    """The run's other records, and when they were written, ms."""
    return [
        (1.0, PacketForm(True, None, host_ns(1.0))),
        (2.0, PacketForm(True, None, host_ns(2.0))),
        (3.0, PacketForm(False, "crc", host_ns(3.0))),
        (4.0, PacketForm(False, "format: no packet", host_ns(4.0))),
        (5.0, PacketForm(False, None, host_ns(5.0))),
        (20.0, CountRecord(host_ns=host_ns(20.0), kind="packet", reason="accepted", count=40)),
        (21.0, CountRecord(host_ns=host_ns(21.0), kind="packet", reason="crc", count=5)),
        (22.0, CountRecord(host_ns=host_ns(22.0), kind="lost", reason=LOST, count=6)),
        (23.0, CountRecord(host_ns=host_ns(23.0), kind="lost", reason=LOST, count=1)),
        (24.0, CountRecord(host_ns=host_ns(24.0), kind="pulse", reason="sent", count=9)),
        (25.0, CountRecord(host_ns=host_ns(25.0), kind="pulse", reason="lost", count=2)),
        (26.0, CountRecord(host_ns=host_ns(26.0), kind="frame", reason="no room", count=99)),
        (40.0, EventRecord(host_ns=host_ns(40.0), kind="stale", detail="it is")),
        (41.0, EventRecord(host_ns=host_ns(41.0), kind="stale", detail="it was")),
        (42.0, EventRecord(host_ns=host_ns(42.0), kind="fresh", detail="again")),
        # found at the end, and true from the swap of the one but last on
        (
            152.75,
            EventRecord(
                host_ns=host_ns(152.75), kind="rates-wrong", detail="twice", since_ns=host_ns(119.0)
            ),
        ),
    ]


def in_order() -> list[RunRecord]:
    """All records in the order of the ledger."""
    timed: list[tuple[float, RunRecord]] = [*others()]
    for shown, record in zip(FRAMES, frames(), strict=True):
        timed.append((shown.swap_ms, record))
    return [record for _, record in sorted(timed, key=lambda entry: entry[0])]


@pytest.fixture(params=[1, 3, 100])
def figures(request) -> RunFigures:
    """The figures of the run, its records in blocks."""
    made = RunFigures({"calibration": "mine", "gl_renderer": "llvmpipe"})
    records = in_order()
    for first in range(0, len(records), request.param):
        made.add(*records[first : first + request.param])
    return made


WANTED_MS = {
    # not the first, and not over the two that were missed
    "interval": [16.0, 17.0, 15.0, 19.0, 17.0, 16.5],
    "late": [shown.late_ms for shown in FRAMES if shown.late_ms is not None],
    "draw": [shown.draw_ms for shown in FRAMES],
    "age": [shown.age_ms for shown in FRAMES if shown.age_ms is not None],
    "prediction": [shown.prediction_ms for shown in FRAMES],
    "packet": [shown.packet_ms for shown in FRAMES if shown.packet_ms is not None],
}


def test_each_time_of_the_report_is_that_of_its_frames(figures):
    report = summarise(figures)
    for name, key in METRICS.items():
        values = WANTED_MS[name]
        spread = getattr(report, key)
        median, most = np.percentile(values, [50, 99], method="inverted_cdf")
        assert spread.p50 == pytest.approx(median, rel=BIN), name
        assert spread.p99 == pytest.approx(most, rel=BIN), name
        assert spread.max == pytest.approx(max(values)), name
    assert report.pacing_jitter_ms == pytest.approx(np.std(WANTED_MS["interval"]))
    assert report.duration_s == 0.1525


def test_each_count_of_the_report_is_that_of_its_records(figures):
    report = summarise(figures)
    assert (report.frames, report.missed_frames, report.timestamp_source) == (8, 2, "GLX")
    assert (report.stale_frames, report.blank_frames) == (2, 1)
    assert (report.operator_frames, report.hidden_frames, report.capped_frames) == (1, 1, 2)
    # the hidden one and the last two are of a wrong sky; plain ones are the first two
    assert (report.wrong_frames, report.right_frames) == (3, 2)
    assert report.wrong_sky.seconds == pytest.approx(0.0335, abs=1e-3)
    assert (report.stars_drawn, report.clipped, report.below_step) == (50, 3, 7)
    assert report.packets == {"accepted": 42, "crc": 6, "format": 2}
    assert report.lost_packets == 7
    assert report.pulses == {"sent": 9, "skipped": 0, "lost": 2}
    assert report.events == {"stale": 2, "fresh": 1, "rates-wrong": 1}
    assert (report.calibration, report.gl_renderer, report.certificate) == (
        "mine",
        "llvmpipe",
        None,
    )
    assert figures.counted["late"] == 1  # stale, with an attitude


def test_the_chart_along_the_run_has_each_frame_s_values(figures):
    spans = figures.spans
    assert spans.begin == pytest.approx([shown.swap_ms * 1e-3 for shown in FRAMES])
    columns = [*METRICS, *COUNTS]
    totals = {
        "missed": [0, 0, 0, 2, 0, 0, 0, 0],
        "stars": [30, 50, 0, 0, 0, 0, 40, 0],
        "clipped": [0, 3, 0, 0, 0, 0, 1, 0],
        "below_step": [2, 0, 0, 0, 7, 0, 0, 0],
        "stale": [0, 0, 1, 1, 0, 0, 0, 0],
        "blank": [0, 0, 1, 0, 0, 0, 0, 0],
    }
    for name, total in totals.items():
        assert spans.column(columns.index(name)).total.tolist() == total, name
    none = np.nan
    ages = [none if shown.age_ms is None else shown.age_ms for shown in FRAMES]
    np.testing.assert_allclose(spans.column(columns.index("age")).low, ages)
    intervals = [none, 16.0, 17.0, none, 15.0, 19.0, 17.0, 16.5]
    np.testing.assert_allclose(spans.column(columns.index("interval")).high, intervals)


def test_the_path_of_the_sky_has_its_times_attitudes_and_the_turns_so_far(figures):
    shown = [k for k, record in enumerate(frames()) if record.q is not None]
    run_s, t_s, *q_and_turned = figures.path.rows.T
    assert run_s == pytest.approx([FRAMES[k].swap_ms * 1e-3 for k in shown])
    assert t_s == pytest.approx([FRAMES[k].swap_ms / 2 * 1e-3 for k in shown])
    attitudes = np.array([frames()[k].q for k in shown])
    np.testing.assert_allclose(np.column_stack(q_and_turned[:4]), attitudes, rtol=0, atol=1e-15)
    # over the blank frame the sky turned on: from the frame before it to that behind it
    rotations = Rotation.from_quat(attitudes[:, [1, 2, 3, 0]])
    # a rate is the camera's: the sky's components turn the other way
    steps = -(rotations[1:] * rotations[:-1].inv()).as_rotvec()
    turned = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    np.testing.assert_allclose(np.column_stack(q_and_turned[4:]), turned, atol=ROTATION_RAD)


def test_turns_are_the_shortest_ones_whatever_the_sign_of_a_quaternion(rng):
    a, b = Rotation.random(50, random_state=1), Rotation.random(50, random_state=2)
    b[:5] = Rotation.from_rotvec(rng.normal(size=(5, 3)) * 1e-10) * a[:5]
    signs = rng.choice([-1.0, 1.0], size=(50, 1))
    turns = _turns_rad(a.as_quat()[:, [3, 0, 1, 2]], signs * b.as_quat()[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(turns, -(b * a.inv()).as_rotvec(), rtol=1e-6, atol=ROTATION_RAD)


def process(at_s: float, megabytes: float, cpu_s: float) -> ProcessRecord:
    """A second of the process."""
    return ProcessRecord(
        host_ns=BEGIN_NS + round(at_s * NS_PER_S),
        resident_bytes=round(megabytes * 1e6),
        cpu_s=cpu_s,
    )


def test_memory_grows_from_the_end_of_the_first_minute_on():
    made = RunFigures({})
    seconds = [(0.0, 100.0, 1.0), (59.0, 300.0, 2.0), (60.0, 310.0, 3.5), (61.0, 290.0, 4.0)]
    for k in range(3):
        made.add(process(*seconds[k]))
    assert made.memory_growth_mb is None  # a minute, and none after it
    made.add(process(*seconds[3]), process(75.0, 312.5, 4.25))
    assert made.memory_growth_mb == 2.5
    rows = [(BEGIN_NS * 1e-9 + at_s, megabytes, cpu_s) for at_s, megabytes, cpu_s in seconds]
    assert made.process.rows[:4] == pytest.approx(np.array(rows))


def test_the_rows_of_a_report_say_its_figures_with_their_units():
    made = RunFigures({"calibration": "mine", "certificate": "C-1", "gl_renderer": "llvmpipe"})
    made.add(*in_order())
    rows = dict(table_rows(summarise(made)))
    assert rows["frames"] == "8 in 0.2 s, 2 missed, 2 stale, 1 blank"
    assert rows["not the plain sky"] == "1 by an operator's keys, 1 hidden"
    assert rows["coarser paths"] == "2 frames, because the turn was too fast"
    assert rows["packets"] == "42 accepted, 8 refused, 7 lost"
    assert rows["pulses"] == "9 at their frames, 0 skipped, losses of the line: 2"
    assert rows["stars"] == "at most 50 drawn, 3 clipped, 7 too faint"
    assert rows["events"] == "stale 2, fresh 1, rates-wrong 1"
    assert rows["rates-wrong"] == "0.0 s: twice"
    assert rows["certificate"] == "C-1"
    assert rows["renderer"] == "llvmpipe, OpenGL -; levels by -"
    assert rows["time stamps"] == "GLX; the bench file's refresh rate is -"
    age, in_frames = rows["age of the attitude at light"].split(" = ")
    assert age.startswith("6.00 / ") and age.endswith(" / 90.00 ms (p50 / p99 / max)")
    assert in_frames == "- / - / - frames (p50 / p99 / max)"


def test_an_age_in_frames_is_by_the_bench_s_refresh_rate():
    made = RunFigures({"bench_text": SMALL_BENCH})
    made.add(*in_order())
    report = summarise(made)
    assert report.refresh_hz == 60.0
    assert report.attitude_age_frames.max == pytest.approx(90.0 * 60 / 1000)


def test_a_run_of_nothing_has_no_figures():
    report = summarise(RunFigures({}))
    assert (report.frames, report.duration_s, report.missed_frames) == (0, 0.0, 0)
    assert report.interval_ms.p50 is None


def test_of_the_frames_that_are_the_worst_the_first_is_drawn():
    every = [
        FrameRecord(frame=k, t_ns=k, light_ns=k, draw_ns=k, swap_ns=host_ns(10.0 * k))
        for k in range(6)
    ]
    keyframes = Keyframes()
    for part, worths in ((slice(0, 3), [1, 3, 3]), (slice(3, 6), [3, 0, 2])):
        keyframes.add(every[part], {"oldest": np.array(worths), "none": np.zeros(3, dtype=int)})
    drawn = {frame.frame: why for frame, why in keyframes.chosen(every[-1]) if why}
    assert drawn == {1: "oldest"}


def test_the_residuals_of_a_chart_are_those_of_right_answers():
    """A wrong one of degrees would leave no room for the others; one of no sky has none."""
    figures = RunFigures({})
    for k, verdict in enumerate(("right", "wrong", "invalid", "unpaired", "unjudged", "right")):
        answer = AnswerRecord(host_ns=host_ns(k), raw="", verdict=verdict)
        answer.middle_ns = k * NS_PER_S
        answer.residual_arcsec = None if verdict == "unpaired" else (k + 0.1, k + 0.2, k + 0.3)
        figures.add(answer)
    assert figures.residuals.rows.tolist() == [[0.0, 0.1, 0.2, 0.3], [5.0, 5.1, 5.2, 5.3]]


@pytest.mark.parametrize("block", [1, 4, 100])
def test_the_faults_of_a_replayed_run_are_those_of_its_frames_however_records_are_cut(block):
    """Of ten frames, a second apart, three have one; an answer follows each."""
    figures = RunFigures({})
    figures.answers = AnswerTally(BEGIN_NS)
    flash = FaultRecord(
        host_ns=BEGIN_NS - 1, event="start", number=4, name="sun", kind="flash", who="", t_ns=0,
        table="",
    )  # fmt: skip
    records: list[RunRecord] = [flash]
    for k in range(10):
        swap_ns = host_ns(1000.0 * k)
        frame = FrameRecord(frame=k, t_ns=k, light_ns=swap_ns, draw_ns=swap_ns, swap_ns=swap_ns)
        if 3 <= k < 6:
            frame.faults = (4,)
        middle_ns = swap_ns + NS_PER_S // 2
        verdict = "wrong" if frame.faults else "right"
        records.append(frame)
        records.append(
            AnswerRecord(host_ns=middle_ns, raw="", middle_ns=middle_ns, verdict=verdict)
        )
    for first in range(0, len(records), block):
        figures.add(*records[first : first + block])
    answers = summarise(figures).answers
    assert answers is not None
    (fault,) = answers.faults
    assert (fault.name, fault.start_s, fault.end_s) == ("sun", 3.0, 6.0)
    wrong = [span.wrong for span in (fault.before, fault.during, fault.after)]
    assert wrong == [0, 3, 0]
