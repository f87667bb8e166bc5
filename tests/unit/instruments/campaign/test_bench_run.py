"""The laws of a campaign before a real tracker, on a clock of the test's own: when a case is over,
whose an answer is, and what a tracker that falls silent is waited for.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.campaign import bench_run
from hilstar.instruments.campaign.bench_run import NO_ANSWER, BenchOrder, BenchRun
from hilstar.instruments.campaign.cases import CaseMaker, bench_columns
from hilstar.instruments.campaign.plan import Design, parse_plan
from hilstar.instruments.campaign.store import Directory
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.answers.judge import AnswerJudge, AnswerRules
from hilstar.server.answers.pairing import LitFrames
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.operator import OnScreen
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


def lit_at(cases, swap_ns: int, predicted: bool, **on_screen) -> Shown:
    """A frame of the case on the display as a screen shows it, or as a headless run does."""
    attitude = Attitude(cases.shown, 0, False, rate_cam_rad_s=np.array([0.1, -0.2, 0.3]))
    drawn = SimpleNamespace(rate_cam_rad_s=None)
    keys = {"predicted_swap_ns": swap_ns, "swap_ns": swap_ns} if predicted else {}
    return Shown(
        cases.number, 0, attitude, drawn, light_ns=cases.now_ns, fades=True, **keys, **on_screen
    )


@pytest.mark.parametrize("predicted", [True, False])
def test_a_case_begins_with_the_light_of_its_first_frame_on_a_screen_after_its_swap(
    cases, predicted
):
    cases.run._light_ns = 7_000_000
    cases.begin(1)
    swap_ns = START_NS + 50_000_000
    cases.now_ns = swap_ns
    cases.run._lit(lit_at(cases, swap_ns, predicted))
    now = cases.run._now
    assert now.begun_ns == swap_ns + 7_000_000 * predicted
    told = json.loads((cases.directory.path / "now.json").read_text())
    assert told["light_ns"] == now.begun_ns
    assert (told["case"], told["order"]) == (1, 1)
    assert told["q_icrs_to_cam"] == cases.shown.tolist()
    assert told["rate_cam_rad_s"] == [0.1, -0.2, 0.3]
    assert told["begun_utc"] == now.begun_utc
    # the next frame begins nothing
    cases.number += 1
    cases.run._lit(lit_at(cases, swap_ns + FRAME_NS, predicted))
    assert now.begun_ns == swap_ns + 7_000_000 * predicted


def test_a_frame_that_an_operator_changed_begins_no_case(cases):
    cases.begin(0)
    on_screen = OnScreen(operator="grid")
    cases.run._lit(lit_at(cases, START_NS, True, on_screen=on_screen))
    assert cases.run._now.begun_ns is None
    on_screen = OnScreen(hidden="minimised")
    cases.run._lit(lit_at(cases, START_NS, True, on_screen=on_screen))
    assert cases.run._now.begun_ns is None


def test_a_row_has_what_was_counted_of_its_case(cases):
    """A wrong answer, then a right one: of the first is the row's attitude, of the second its
    error.
    """
    cases.run._plan = msgspec.structs.replace(cases.run._plan, answers=2)
    cases.run._file_sha256 = "abc"
    cases.begin(2)
    cases.pass_s(0.3)
    cases.answer(cases.shown, off_arcsec=3600.0 * 20)
    cases.pass_s(0.2)
    right = cases.shown
    cases.answer(right, off_arcsec=-30.0)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert (row["case"], row["order"], row["run"], row["bench_sha256"]) == (2, 2, 1, "abc")
    assert (row["received"], row["solved"], row["wrong"], row["late"]) == (2, 2, 1, 0)
    assert row["frames"] == 2
    assert row["wrong_deg"] == pytest.approx(20.0, abs=1e-6)
    assert row["error_x_arcsec"] == pytest.approx(-30.0, abs=1e-6)
    assert row["first_attitude_s"] == pytest.approx(0.49, abs=0.011)
    assert row["stars"] == 7.0
    assert [row[f"lit_q{axis}"] for axis in "wxyz"] == pytest.approx(right.tolist())
    turn = from_rotation_vector(np.array([np.radians(20.0), 0.0, 0.0]))
    first = [row[f"solved_q{axis}"] for axis in "wxyz"]
    assert first == pytest.approx(multiply(turn, right).tolist())
    assert row["begun_utc"].endswith("Z")


def test_a_signal_is_the_light_of_the_brightest_five_stars_and_black_ones_are_none(cases):
    stars = [ReportedStar(1.0, 2.0, dn) for dn in (5.0, 100.0, 20.0, None, 0.0, 40.0, 10.0, 30.0)]
    cases.begin(0)
    cases.pass_s(0.3)
    cases.answer(cases.shown)
    cases.tracker.answers[0] = dataclasses.replace(cases.tracker.answers[0], centroids=stars)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert row["signal_mag"] == pytest.approx(-2.5 * math.log10(100 + 40 + 30 + 20 + 10))


def test_a_display_is_dark_between_cases_and_a_run_that_goes_on_is_the_next(cases):
    cases.begin(0)
    cases.pass_s(0.3)
    cases.answer(cases.shown)
    cases.pass_s(0.01)
    assert cases.run._now is None
    blank_ns = round(cases.run._plan.blank_s * NS_PER_S)
    assert cases.run._dark_until_ns == cases.now_ns + blank_ns
    assert cases.run._view(cases.now_ns) is None
    runs = (cases.directory.path / "runs.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in runs] == ["run", "1"]


def test_an_exposure_that_began_before_a_case_s_last_row_was_lit_is_not_its_own(cases):
    """A screen that takes 0.12 s from its middle row to its last: an exposure of 0.1 s whose middle
    is at 0.15 s began at 0.1 s.
    """
    cases.run._last_row_ns = 120_000_000
    cases.begin(0)
    cases.pass_s(0.16)
    cases.answer(cases.shown)
    cases.pass_s(0.02)
    assert cases.run._now.received == 0
    cases.answer(cases.shown)
    cases.pass_s(0.02)
    assert cases.rows()[0]["received"] == 1


def test_an_answer_that_fits_its_own_case_better_is_not_that_of_the_case_before(cases):
    """The case before stood 100 arcsec beside this one: both would be right."""
    cases.begin(0)
    cases.pass_s(0.3)
    turn = from_rotation_vector(np.array([100.0, 0.0, 0.0]) / ARCSEC_PER_RAD)
    cases.run._before_q = multiply(turn, cases.shown)
    cases.answer(cases.shown, off_arcsec=60.0)
    cases.pass_s(0.02)
    assert cases.run._now.late == 1
    cases.answer(cases.shown, off_arcsec=40.0)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert (row["received"], row["late"], row["wrong"]) == (1, 1, 0)


def test_a_first_attitude_is_that_of_the_first_right_answer_and_stays(cases):
    """The farthest of the wrong answers is the first."""
    cases.run._plan = msgspec.structs.replace(cases.run._plan, answers=4)
    cases.begin(0)
    for seconds, off_arcsec in ((0.2, 36_000.0), (0.2, 10.0), (0.2, 7200.0), (0.2, -20.0)):
        cases.pass_s(seconds)
        cases.answer(cases.shown, off_arcsec=off_arcsec)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert (row["received"], row["wrong"]) == (4, 2)
    assert row["wrong_deg"] == pytest.approx(10.0, abs=1e-6)
    assert row["first_attitude_s"] == pytest.approx(0.39, abs=0.011)


def test_a_display_is_that_of_the_cases_it_shows_though_a_check_case_is_the_first(
    tmp_path, monkeypatch
):
    """Two renderers by what they draw, with a check case before each case; a renderer's cases stand
    together.
    """
    path = write_campaign(
        tmp_path,
        {"key": "sky.faintest_v_mag", "values": [3.0, 4.0]},
        attitudes=ANY_SKY,
        through="bench",
        sampling="grid",
        cases=6,
        check_every=1,
    )
    plan, file = parse_plan(path, path.read_text()), read_bench_file(tmp_path / "bench.toml")
    maker = CaseMaker(plan, file, tmp_path)
    order = BenchOrder(plan, 6, maker, Design("grid", plan.seed, 6, maker.attitude_dimensions, [2]))
    directory = Directory(tmp_path / "out")
    run = BenchRun(
        order,
        bench_columns(maker.parameters),
        directory,
        source=Tracker(),
        rules=RULES,
        notices=Notices(),
        on_done=lambda done: None,
    )
    drawn = []

    @contextlib.contextmanager
    def display(shown_file):
        yield shown_file.config.sky.faintest_v_mag

    def show(turns, faintest_v_mag):
        drawn.append((faintest_v_mag, [number for number, _ in turns]))
        return True

    monkeypatch.setattr(run, "show", show)
    assert run.run(display)
    run.journal.close()
    directory.close()
    assert sorted(faintest for faintest, _ in drawn) == [3.0, 4.0]
    for faintest_v_mag, numbers in drawn:
        assert numbers[0] >= 6  # a check case
        shown = [number for number in numbers if number < 6]
        assert {order.case(number).values["sky.faintest_v_mag"] for number in shown} == {
            faintest_v_mag
        }
    assert sorted(number for _, numbers in drawn for number in numbers) == list(range(13))


def test_an_answer_without_an_attitude_counts_once_its_case_has_one(cases):
    cases.run._plan = msgspec.structs.replace(cases.run._plan, answers=2)
    cases.begin(0)
    cases.pass_s(0.3)
    cases.answer(None)
    cases.pass_s(0.1)
    cases.answer(cases.shown, off_arcsec=5.0)
    cases.pass_s(0.1)
    cases.answer(None)
    cases.pass_s(0.02)
    (row,) = cases.rows()
    assert (row["received"], row["solved"], row["wrong"]) == (2, 1, 0)


def test_a_tracker_whose_messages_are_all_refused_is_not_silent(cases):
    cases.begin(0)
    for _ in range(11):
        cases.tracker.refused += 1
        cases.pass_s(0.1)
    (row,) = cases.rows()
    assert (row["status"], row["why"]) == (NO_ANSWER, "the tracker had no attitude")


def test_a_recovery_is_by_an_exposure_after_the_fault_s_end_and_until_its_answer_comes(cases):
    """Answers come 50 ms after the middle of their exposures: that of 0.28 s comes after the
    fault's end.
    """
    cases.run._plan = msgspec.structs.replace(cases.run._plan, answers=3)
    cases.begin(0)
    cases.run._now.fault_end_s = 0.3
    cases.pass_s(0.2)
    begun_ns = cases.run._now.begun_ns
    for answered_s in (0.33, 0.4, 0.5):
        cases.pass_s(answered_s - (cases.now_ns - begun_ns) / NS_PER_S)
        cases.answer(cases.shown)
        late = dataclasses.replace(cases.tracker.answers[0], t_ns=cases.now_ns - 50_000_000)
        cases.tracker.answers[0] = late
    now = cases.run._now
    cases.pass_s(0.02)
    assert now.recovery_s == pytest.approx(0.1, abs=0.011)


def test_a_change_over_a_run_is_that_from_its_first_check_to_its_last():
    """Of 0.1 a second over 30 s, though the first check has no value; three on a line are sure."""
    at_s = np.array([0.0, 10.0, 20.0, 30.0])
    change, sigma = bench_run._line(at_s, [None, 1.0, 2.0, 3.0])
    assert (change, sigma) == (pytest.approx(3.0), pytest.approx(0.0, abs=1e-9))
    assert bench_run._line(at_s, [None, 1.0, 2.0, None]) == (pytest.approx(3.0), None)
    assert bench_run._line(at_s, [None, 1.0, None, None]) is None
    # residuals of 1, -2 and 1: 6 over one degree of freedom, and 200 s^2 about the middle
    change, sigma = bench_run._line(at_s, [None, 1.0, -1.0, 3.0])
    assert (change, sigma) == (pytest.approx(3.0), pytest.approx(math.sqrt(6 / 200) * 30))
