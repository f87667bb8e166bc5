"""What the report says of a tracker's answers, and of each fault's effect on them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from hilstar.basics.running_statistics import Percentiles
from hilstar.server.record.answer_figures import AnswerSpan, AnswerTally, SpanTally, answer_rows
from hilstar.server.record.ledger_records import AnswerRecord, FaultRecord, FrameRecord
from hilstar.server.record.run_figures import figures_of, summarise
from tests.support.commands import run_hilstar_here
from tests.support.planted_run import NS_PER_S, write_ledger

START_NS = 5 * NS_PER_S
CYCLE_S, LATE_S = 0.1, 0.15
FAULT_S = (20.0, 30.0)
WRONG_S, LOST_S, BACK_S = (22.0, 23.0), (24.0, 32.0), 32.0
SIGMA_ARCSEC, IN_FAULT = np.array([2.0, 3.0, 10.0]), 3.0


def records_of_a_run(seconds: float = 60.0) -> list[AnswerRecord | FaultRecord]:
    """Answers with a noise that triples in the fault, wrong for a second, then lost until two
    seconds after its end.
    """
    rng = np.random.default_rng(5)
    found: list[AnswerRecord | FaultRecord] = []
    for t_s in np.arange(0.3, seconds - 0.5, CYCLE_S).tolist():
        middle_ns = START_NS + round(t_s * NS_PER_S)
        record = AnswerRecord(
            host_ns=middle_ns + round(LATE_S * NS_PER_S),
            raw="01",
            middle_ns=middle_ns,
            verdict="right",
        )
        faulty = FAULT_S[0] <= t_s < FAULT_S[1]
        record.residual_arcsec = tuple(
            (SIGMA_ARCSEC * rng.standard_normal(3) * (IN_FAULT if faulty else 1)).tolist()
        )
        if WRONG_S[0] <= t_s < WRONG_S[1]:
            record.verdict, record.residual_arcsec = "wrong", (7200.0, 0.0, 0.0)
        if LOST_S[0] <= t_s < LOST_S[1]:
            record.verdict, record.residual_arcsec, record.valid = "invalid", None, False
        found.append(record)
    for event, t_s in zip(("start", "end"), FAULT_S, strict=True):
        at_ns = START_NS + round(t_s * NS_PER_S)
        found.append(
            FaultRecord(
                host_ns=at_ns,
                event=event,
                number=3,
                name="sunlit",
                kind="stray",
                who="file",
                t_ns=0,
                table="",
            )
        )
    return found


@pytest.fixture(scope="module")
def answers_ledger(tmp_path_factory) -> Path:
    times_s = np.arange(0.0, 60.0, 0.1)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(times_s), 1))
    return write_ledger(
        tmp_path_factory.mktemp("run") / "run.mcap", times_s, q, START_NS, records_of_a_run()
    )


def test_a_run_without_answers_says_nothing_of_them(tmp_path):
    times_s = np.arange(0.0, 2.0, 0.1)
    plain = write_ledger(tmp_path / "plain.mcap", times_s, np.tile([1.0, 0.0, 0.0, 0.0], (20, 1)))
    assert not summarise(figures_of(plain)).answers


def test_a_fault_is_reported_with_the_answers_before_during_and_after_it(answers_ledger):
    found = summarise(figures_of(answers_ledger)).answers
    assert (found.wrong, found.invalid, found.unpaired) == (10, 80, 0)
    assert found.rate_hz == pytest.approx(1 / CYCLE_S, rel=2e-3)
    assert found.availability == pytest.approx(1 - 90 / found.answers, abs=2e-3)
    assert found.latency_ms.p50 == pytest.approx(150.0, rel=1e-2)
    (fault,) = found.faults
    assert (fault.name, fault.start_s, fault.end_s) == ("sunlit", *FAULT_S)
    assert (fault.before.availability, fault.before.wrong) == (1.0, 0)
    # Right for two seconds and one more of ten, then lost; after its end lost for two seconds of
    # ten.
    assert (fault.during.availability, fault.during.wrong, fault.during.invalid) == pytest.approx(
        (0.3, 10, 60), abs=0.011
    )
    assert (fault.after.availability, fault.after.invalid) == pytest.approx((0.8, 20), abs=0.011)
    # 100 and 30 answers: the rms of each axis within four of its own sigmas, rms / sqrt(2 n).
    assert fault.before.rms_arcsec == pytest.approx(SIGMA_ARCSEC.tolist(), rel=4 / np.sqrt(200))
    assert fault.during.rms_arcsec == pytest.approx(
        (IN_FAULT * SIGMA_ARCSEC).tolist(), rel=4 / np.sqrt(60)
    )
    assert fault.during.largest_arcsec == 7200.0
    assert fault.first_wrong_s == pytest.approx(WRONG_S[0] - FAULT_S[0], abs=CYCLE_S)
    assert fault.recovered_s == pytest.approx(BACK_S - FAULT_S[1], abs=CYCLE_S)


def test_the_reports_page_and_text_have_the_answers(answers_ledger, tmp_path):
    run = run_hilstar_here("report", answers_ledger, "-o", tmp_path, "--json")
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)["answers"]
    assert told["faults"][0]["recovered_s"] == pytest.approx(2.0, abs=CYCLE_S)
    assert told == json.loads((tmp_path / "report.json").read_text())["answers"]
    text = run_hilstar_here("report", answers_ledger, "-o", tmp_path).stdout
    assert (
        "fault sunlit" in text
        and "first wrong after 2.0" in text
        and "tracker's availability" in text
    )


def tallied(verdicts: str, residuals=None, faults=()) -> AnswerTally:
    """Answers every CYCLE_S by the first letters of their verdicts, and faults from and to, s."""
    tally = AnswerTally()
    names = {"r": "right", "w": "wrong", "u": "unpaired"}
    events = [(k * CYCLE_S, letter, k) for k, letter in enumerate(verdicts)]
    for begin_s, end_s in faults:
        events += [(begin_s, "start", 0), (end_s, "end", 0)]
    for t_s, what, k in sorted(events):
        at_ns = START_NS + round(t_s * NS_PER_S)
        if what in names:
            residual = None if residuals is None else tuple(residuals[k])
            tally.answer(
                AnswerRecord(
                    host_ns=at_ns,
                    raw="01",
                    middle_ns=at_ns,
                    verdict=names[what],
                    residual_arcsec=residual,
                )
            )
        else:
            tally.fault(
                FaultRecord(
                    host_ns=at_ns,
                    event=what,
                    number=1,
                    name="glint",
                    kind="stray",
                    who="file",
                    t_ns=0,
                    table="",
                )
            )
    return tally


def test_a_fault_that_the_tracker_bears_is_recovered_from_at_its_end():
    """The next right answer comes up to a cycle later: that is no time to recover."""
    borne = tallied("r" * 60, faults=[(2.0, 3.97)]).report(START_NS)
    assert borne.faults[0].recovered_s == 0.0
    late = tallied("r" * 35 + "w" * 10 + "r" * 15, faults=[(2.0, 3.97)]).report(START_NS)
    assert late.faults[0].recovered_s == pytest.approx(4.5 - 3.97)


def test_three_sigma_is_that_of_a_sample():
    residuals = np.random.default_rng(3).normal(1.0, 2.0, (4, 3))
    found = tallied("rrrr", residuals).report(START_NS)
    assert found.sigma3_arcsec == pytest.approx(3 * residuals.std(axis=0, ddof=1), abs=2e-3)
    assert found.rms_arcsec == pytest.approx(np.sqrt((residuals**2).mean(axis=0)), abs=2e-3)


@pytest.mark.parametrize(("repeated", "availability"), [(0, 1.0), (3, 1.0)])
def test_no_more_answers_are_available_than_are_due(repeated, availability):
    """Ten answers a second, the last ones twice: ten cycles have eleven answers."""
    tally = AnswerTally()
    whole = SpanTally()
    for k in [*range(11), *[10] * repeated]:
        at_ns = START_NS + round(k * CYCLE_S * NS_PER_S)
        record = AnswerRecord(host_ns=at_ns, raw="01", middle_ns=at_ns, verdict="right")
        tally.answer(record)
        whole.add(record)
    assert tally.report(START_NS).availability == availability
    assert whole.span(11 * CYCLE_S, CYCLE_S).availability == availability
    assert whole.span(22 * CYCLE_S, CYCLE_S).availability == pytest.approx(
        (11 + repeated) / 22, abs=1e-4
    )


def test_answers_with_one_error_have_no_sigma():
    """Whose squares are by rounding less than their mean's: 3.7 three times."""
    found = tallied("rrr", np.full((3, 3), 3.7)).report(START_NS)
    assert found.sigma3_arcsec == [0.0, 0.0, 0.0]


def test_answers_of_no_sky_are_not_due():
    found = tallied("rrrruurrrw").report(START_NS)
    assert found.availability == pytest.approx(7 / 8)


def test_answers_that_are_not_judged_say_nothing_of_the_interval():
    """Of a fast tracker most are not: those that are judged come every CYCLE_S."""
    judged = tallied("r" * 19 + "w").report(START_NS)
    flooded = AnswerTally()
    for k in range(20):
        at_ns = START_NS + round(k * CYCLE_S * NS_PER_S)
        verdict = "wrong" if k == 19 else "right"
        flooded.answer(AnswerRecord(host_ns=at_ns, raw="", middle_ns=at_ns, verdict=verdict))
        for late_ns in (1_000_000, 2_000_000, 3_000_000):
            late = AnswerRecord(host_ns=at_ns + late_ns, raw="", verdict="unjudged")
            late.middle_ns = at_ns
            flooded.answer(late)
    found = flooded.report(START_NS)
    assert (found.unjudged, found.rate_hz) == (60, judged.rate_hz)
    assert (found.availability, found.latency_ms) == (judged.availability, judged.latency_ms)


def fault_record(at_s: float, event: str, number: int, name: str) -> FaultRecord:
    """An event of a fault."""
    return FaultRecord(
        host_ns=START_NS + round(at_s * NS_PER_S),
        event=event,
        number=number,
        name=name,
        kind="flash",
        who="file",
        t_ns=0,
        table="",
    )


# of each second: its verdict, and its error about x, y and z where it was compared
BY_SECOND = {
    0: ("right", (1.0, 2.0, 10.0)),
    1: ("right", (3.0, -2.0, 30.0)),
    2: ("right", (2.0, 4.0, -10.0)),
    3: ("wrong", (3000.0, 4000.0, 0.0)),
    4: ("invalid", None),
    5: ("right", (0.0, 1.0, 20.0)),
    6: ("right", (5.0, 2.0, 40.0)),
    7: ("unpaired", None),
    8: ("wrong", (0.0, 8000.0, 0.0)),
    9: ("right", (1.0, 0.0, 0.0)),
}


def judged_run(*faults: FaultRecord, late_ms: int = 250) -> AnswerTally:
    """The answers of BY_SECOND, each a quarter of a second late, and one that was not judged; the
    tracker's stamps of the seconds 5 and 6 are swapped.
    """
    tally = AnswerTally()
    events = [(fault.host_ns, fault) for fault in faults]
    for second, (verdict, residual) in BY_SECOND.items():
        middle_ns = START_NS + second * NS_PER_S
        record = AnswerRecord(
            host_ns=middle_ns + late_ms * 1_000_000,
            raw="01",
            t_ns={5: 600, 6: 500}.get(second, 100 * second),
            middle_ns=middle_ns,
            verdict=verdict,
            residual_arcsec=residual,
        )
        events.append((middle_ns, record))
    flood = AnswerRecord(host_ns=START_NS + 4 * NS_PER_S, raw="01", verdict="unjudged")
    flood.middle_ns = flood.host_ns
    events.append((flood.host_ns, flood))
    for _, record in sorted(events, key=lambda event: event[0]):
        if isinstance(record, FaultRecord):
            tally.fault(record)
        else:
            tally.answer(record)
    return tally


def test_a_run_s_answers_have_these_figures():
    tally = judged_run()
    found = tally.report(START_NS)
    counts = (found.answers, found.right, found.wrong, found.invalid, found.unpaired)
    assert counts == (11, 6, 2, 1, 1)
    assert (found.unjudged, found.out_of_order) == (1, 1)
    assert found.rate_hz == pytest.approx(1.0, rel=2e-3)
    assert found.latency_ms.max == 250.0
    assert found.availability == pytest.approx(6 / 9, abs=1e-4)  # ten were due, one of no sky
    right = np.array([error for verdict, error in BY_SECOND.values() if verdict == "right"])
    assert found.mean_arcsec == pytest.approx(right.mean(axis=0), abs=1e-3)
    assert found.rms_arcsec == pytest.approx(np.sqrt((right**2).mean(axis=0)), abs=1e-3)
    assert found.sigma3_arcsec == pytest.approx(3 * right.std(axis=0, ddof=1), abs=1e-3)
    assert [(at_ns - START_NS) / NS_PER_S for at_ns in tally.wrong_ns] == [3, 8]


def test_a_fault_s_spans_are_cut_where_the_run_begins_and_ends():
    """From 2.5 s to 5.7 s of a run whose answers stand for 0 to 10 s."""
    tally = judged_run(fault_record(2.5, "start", 1, "flash"), fault_record(5.7, "end", 1, "flash"))
    (fault,) = tally.report(START_NS).faults
    one = {"rms_arcsec": None, "largest_arcsec": None}
    assert (fault.start_s, fault.end_s, fault.kind) == (2.5, 5.7, "flash")
    before = [BY_SECOND[second][1] for second in (0, 1, 2)]
    assert fault.before == AnswerSpan(
        length_s=2.5,
        right=3,
        wrong=0,
        invalid=0,
        availability=1.0,
        **one
        | {
            "rms_arcsec": np.sqrt(np.square(before).mean(axis=0)).round(3).tolist(),
            "largest_arcsec": round(float(np.linalg.norm(before[1])), 3),
        },
    )
    assert fault.during == AnswerSpan(
        length_s=3.2,
        right=1,
        wrong=1,
        invalid=1,
        availability=round(1 / 3, 4),
        rms_arcsec=[0.0, 1.0, 20.0],
        largest_arcsec=5000.0,
    )
    after = np.array([BY_SECOND[second][1] for second in (6, 9)])
    assert fault.after == AnswerSpan(
        length_s=pytest.approx(4.3, abs=2e-3),
        right=2,
        wrong=1,
        invalid=0,
        availability=0.5,  # four were due
        rms_arcsec=np.sqrt((after**2).mean(axis=0)).round(3).tolist(),
        largest_arcsec=8000.0,
    )
    assert (fault.first_wrong_s, fault.recovered_s) == (0.5, 0.0)


def test_what_was_ten_seconds_before_a_fault_has_nothing_to_do_with_it():
    tally = tallied("w" * 145 + "r" * 150, faults=[(25.0, 26.0)])
    (fault,) = tally.report(START_NS).faults
    assert (fault.before.length_s, fault.before.right, fault.before.wrong) == (10.0, 100, 0)


def test_an_answer_is_due_in_a_span_of_over_half_a_cycle():
    tally = SpanTally()
    tally.add(AnswerRecord(host_ns=1, raw="01", middle_ns=1, verdict="right"))
    shares = [tally.span(cycles * CYCLE_S, CYCLE_S).availability for cycles in (0.4, 0.6, 1.6)]
    assert shares == [None, 1.0, 0.5]
    assert tally.span(9.0, None).availability is None


def test_a_fault_that_does_not_end_has_nothing_after_it():
    tally = judged_run(fault_record(6.5, "start", 2, "haze"))
    (fault,) = tally.report(START_NS).faults
    assert (fault.end_s, fault.recovered_s) == (None, None)
    assert fault.during.length_s == pytest.approx(3.5, abs=2e-3)
    assert (fault.during.right, fault.during.wrong, fault.first_wrong_s) == (1, 1, 1.5)
    assert (fault.after.length_s, fault.after.right, fault.after.availability) == (0.0, 0, None)


def test_a_wrong_answer_after_the_recovery_is_not_the_fault_s():
    tally = judged_run(fault_record(4.2, "start", 1, "a"), fault_record(4.6, "end", 1, "a"))
    (fault,) = tally.report(START_NS).faults
    assert (fault.first_wrong_s, fault.recovered_s) == (None, pytest.approx(0.4))


def test_the_faults_of_a_replayed_run_are_on_as_its_frames_say():
    """They stand before the ledger's begin; two overlap."""
    tally = AnswerTally(begun_ns=START_NS)
    for number, name in ((1, "haze"), (2, "flash")):
        tally.fault(fault_record(-4.0, "start", number, name))
        tally.fault(fault_record(-2.0, "end", number, name))
    on_by_second = {2: (1,), 3: (1, 2), 4: (1, 2), 5: (2,), 6: (), 7: ()}
    for second in range(10):
        at_ns = START_NS + second * NS_PER_S
        faults = on_by_second.get(second, ())
        record = FrameRecord(frame=second, t_ns=0, light_ns=0, draw_ns=0, swap_ns=at_ns - 1)
        record.faults = faults
        tally.frame(record)
        verdict = "wrong" if 2 in faults else "right"
        tally.answer(AnswerRecord(host_ns=at_ns, raw="", middle_ns=at_ns, verdict=verdict))
    found = {fault.name: fault for fault in tally.report(START_NS).faults}
    spans = {name: (fault.start_s, fault.end_s) for name, fault in found.items()}
    assert spans == {
        "haze": (pytest.approx(2.0), pytest.approx(5.0)),
        "flash": (pytest.approx(3.0), pytest.approx(6.0)),
    }
    assert (found["haze"].during.right, found["haze"].during.wrong) == (1, 2)
    assert (found["flash"].before.right, found["flash"].during.wrong) == (3, 3)
    assert found["flash"].after.right == 4


def test_the_rows_of_a_report_say_the_answers_figures():
    tally = judged_run(
        fault_record(2.5, "start", 1, "flash"),
        fault_record(5.7, "end", 1, "flash"),
        fault_record(9.5, "start", 2, "haze"),
    )
    report = tally.report(START_NS)
    rows = dict(answer_rows(report))
    assert rows["tracker's answers"] == (
        "11: 6 right, 2 wrong, 1 without an attitude, 1 of no sky, 1 not judged; 1 came out of"
        " order"
    )
    late = replace(report, latency_ms=Percentiles(12.0, 34.5, 40.0))
    late_rows = dict(answer_rows(late))
    assert late_rows["tracker's availability"] == "66.7 %, 12.0 / 34.5 ms late (p50 / p99)"
    assert rows["residual x, y, z, rms"] == "2.6 2.2 22.7 arcsec; mean 2.0 1.2 15.0"
    assert rows["fault flash"] == (
        "before 100.0 %, 2.2 2.8 19.1 arcsec; during 33.3 %, 0.0 1.0 20.0 arcsec; after 50.0 %,"
        " 3.6 1.4 28.3 arcsec; first wrong after 0.50 s; recovered in 0.00 s"
    )
    assert rows["fault haze"].endswith("after -, - arcsec; none wrong; not recovered")
    assert answer_rows(None) == []
