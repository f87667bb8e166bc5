"""The laws of a campaign before a real tracker, on a clock of the test's own: when a case is over,
whose an answer is, and what a tracker that falls silent is waited for.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.campaign.bench_run import NO_ANSWER, BenchOrder, BenchRun
from hilstar.instruments.campaign.cases import CaseMaker, bench_columns
from hilstar.instruments.campaign.plan import Design, parse_plan
from hilstar.instruments.campaign.store import Directory
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.judge import AnswerJudge, AnswerRules
from hilstar.server.answers.pairing import LitFrames
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.pacer import Shown
from tests.support.campaigns import write_campaign

START_NS = 10**12
FRAME_NS = 10_000_000  # 100 Hz
LIMIT_S, SILENT_S, EXPOSURE_S = 1.0, 4.0, 0.1
RULES = AnswerRules(EXPOSURE_S, clock="host", latency_s=0.0)
ANY_SKY = {"kind": "field", "radec_deg": [80.0, 20.0], "radius_deg": 1.5, "roll_deg": [0.0, 0.0]}


class Tracker:
    """What a tracker sent, and how many of its messages were refused."""

    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.refused = 0

    def refusals(self) -> dict[str, int]:
        return {"format": self.refused}

    def take(self) -> list[Answer]:
        answers, self.answers = self.answers, []
        return answers


class ShownCases:
    """A run whose frames and moments a test chooses; each case asks for one answer."""

    def __init__(self, folder: Path) -> None:
        path = write_campaign(
            folder,
            {"key": "time_s", "values": [0.0]},
            attitudes=ANY_SKY,
            through="bench",
            cases=3,
            answers=1,
            timeout_s=LIMIT_S,
            silent_s=SILENT_S,
        )
        plan, file = parse_plan(path, path.read_text()), read_bench_file(folder / "bench.toml")
        maker = CaseMaker(plan, file, folder)
        design = Design("sobol", plan.seed, 3, maker.attitude_dimensions, [1])
        self.tracker = Tracker()
        self.directory = Directory(folder / "out")
        self.notices = Notices()
        self.run = BenchRun(
            BenchOrder(plan, 3, maker, design),
            bench_columns(maker.parameters),
            self.directory,
            source=self.tracker,
            rules=RULES,
            notices=self.notices,
            on_done=lambda done: None,
        )
        frames = LitFrames(FRAME_NS, FRAME_NS / NS_PER_S)
        self.run._frames, self.run._judge = frames, AnswerJudge(RULES, frames)
        self.number = 0
        self.now_ns = START_NS

    @property
    def shown(self):
        """The attitude of the case that is on the display."""
        return self.run._now.case.first.q_icrs_to_cam

    def begin(self, case: int) -> None:
        self.run._begin(case, case)

    def pass_s(self, seconds: float) -> None:
        """Frames of the present case for a time, and a look at the tracker beside each."""
        for _ in range(round(seconds * NS_PER_S / FRAME_NS)):
            self.now_ns += FRAME_NS
            if self.run._now is not None:
                attitude = Attitude(self.shown, 0, False)
                drawn = SimpleNamespace(rate_cam_rad_s=None)
                self.run._lit(
                    Shown(self.number, 0, attitude, drawn, light_ns=self.now_ns, fades=True)
                )
                self.number += 1
            self.run._listen(self.now_ns)

    def answer(self, q, off_arcsec: float = 0.0) -> None:
        """An answer of an exposure whose middle is now, off about x."""
        turn = from_rotation_vector(np.array([off_arcsec, 0.0, 0.0]) / ARCSEC_PER_RAD)
        q_icrs_to_cam = None if q is None else multiply(turn, q)
        valid = q is not None
        self.tracker.answers.append(
            Answer(self.now_ns, b"", None, q_icrs_to_cam, None, valid, "", 7, None, [])
        )

    def rows(self) -> list[dict]:
        rows = []
        for path in sorted(self.directory.path.glob("journal/*.jsonl")):
            # each line begins with its checksum
            rows += [json.loads(line.partition(" ")[2]) for line in path.read_text().splitlines()]
        return rows

    def close(self) -> None:
        self.run.journal.close()
        self.directory.close()


@pytest.fixture
def cases(tmp_path):
    made = ShownCases(tmp_path)
    yield made
    made.close()


def test_a_case_is_over_with_its_answer_and_that_has_its_error(cases):
    cases.begin(0)
    cases.pass_s(0.3)
    cases.answer(cases.shown, off_arcsec=20.0)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert (row["status"], row["received"], row["solved"], row["wrong"]) == ("done", 1, 1, 0)
    assert row["error_x_arcsec"] == pytest.approx(20.0, abs=1e-6)
    assert row["first_attitude_s"] == pytest.approx(0.29, abs=0.011)


def test_an_exposure_that_began_before_the_case_is_not_its_own(cases):
    cases.begin(0)
    cases.pass_s(0.04)
    cases.answer(cases.shown)
    cases.pass_s(0.3)
    assert cases.run._now.received == 0
    cases.answer(cases.shown)
    cases.pass_s(0.02)
    assert cases.rows()[0]["received"] == 1


def test_a_tracker_that_looks_and_sees_nothing_ends_a_case_at_its_time(cases):
    cases.begin(0)
    for _ in range(11):
        cases.answer(None)
        cases.pass_s(0.1)
    (row,) = cases.rows()
    assert (row["status"], row["why"]) == (NO_ANSWER, "the tracker had no attitude")
    assert cases.run._done == 1


@pytest.mark.parametrize("refused", [0, 3])
def test_a_tracker_that_falls_silent_is_waited_for_also_where_it_was_refused_before(cases, refused):
    """Law 4: up to SILENT_S after its last message, whatever came before."""
    cases.tracker.refused = refused
    cases.begin(0)
    cases.pass_s(LIMIT_S + 1.0)
    assert cases.rows() == [] and cases.run._waiting
    cases.pass_s(SILENT_S - LIMIT_S - 1.0 - 0.1)
    assert cases.rows() == []
    cases.pass_s(0.2)
    (row,) = cases.rows()
    assert (row["status"], row["received"]) == (NO_ANSWER, 0)


def test_the_case_of_a_tracker_that_is_back_begins_again(cases):
    cases.begin(0)
    cases.pass_s(LIMIT_S + 1.0)
    cases.answer(cases.shown)
    cases.pass_s(0.01)
    assert cases.rows() == []
    assert (cases.run._now.case.number, cases.run._now.received) == (0, 0)
    cases.pass_s(0.3)
    cases.answer(cases.shown)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert row["status"] == "done" and row["first_attitude_s"] < 0.4


def test_an_answer_of_the_case_before_is_late_and_counts_for_neither(cases):
    cases.begin(0)
    cases.pass_s(0.3)
    before = cases.shown
    cases.answer(before)
    cases.pass_s(0.01)
    cases.begin(1)
    cases.pass_s(0.3)
    cases.answer(before)
    cases.pass_s(0.02)
    assert (cases.run._now.late, cases.run._now.received) == (1, 0)
    cases.answer(cases.shown)
    cases.pass_s(0.02)
    first, second = cases.rows()
    assert (first["late"], second["late"]) == (0, 1)
    assert (second["received"], second["wrong"]) == (1, 0)
