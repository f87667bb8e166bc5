"""What the report says of a tracker's answers, and of each fault's effect on them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hilstar.server.record.answer_figures import AnswerTally
from hilstar.server.record.ledger_records import AnswerRecord, FaultRecord
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


def test_answers_of_no_sky_are_not_due():
    found = tallied("rrrruurrrw").report(START_NS)
    assert found.availability == pytest.approx(7 / 8)
