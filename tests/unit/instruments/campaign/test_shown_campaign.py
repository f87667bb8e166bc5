"""A whole campaign before a real tracker, from its plan to its tables, on a clock that stands still
while a frame is drawn. The tracker sees each frame, and answers with an error that is planted.
"""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.campaign import run
from hilstar.instruments.campaign.bench_run import OpenDisplay
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.store import Directory
from hilstar.server.answers import reader
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.pairing import LitFrame, LitFrames
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.pacer import Shown
from tests.support.benches import bench_text
from tests.support.campaigns import plan_text, read_columns
from tests.support.fake_clock import FakeClock
from tests.support.tables import csv_rows

FRAME_NS = 10_000_000  # 100 Hz
BIAS_ARCSEC = (30.0, -20.0, 50.0)
FAULT_S = 0.05
CASES, EVERY = 4, 3
FIELD = {"kind": "field", "radec_deg": [80.0, 20.0], "radius_deg": 1.5, "roll_deg": [0.0, 0.0]}
# between two frames of 10 ms, with a clock that stamps none of its answers
EXACT_ARCSEC = 1e-6


class SeeingTracker:
    """Answers each frame when the next one is shown: what was lit, turned by BIAS_ARCSEC."""

    def __init__(self, clock: FakeClock, now: Path, until: int = 0) -> None:
        self._clock, self._now, self.until = clock, now, until
        self._turn = from_rotation_vector(np.array(BIAS_ARCSEC) / ARCSEC_PER_RAD)
        self._lit: tuple[int, FloatArray] | None = None
        self._answers: list[Answer] = []
        self.frames: list[tuple[int, bool]] = []  # the case of each lit frame, and faulty or not

    def see(self, shown: Shown) -> None:
        """Take a frame; the last of `until` is a Ctrl-C."""
        attitude = shown.attitude
        if self.until and len(self.frames) == self.until:
            signal.raise_signal(signal.SIGINT)
        if self._lit is not None:
            middle_ns, q = self._lit
            answer = multiply(self._turn, q)
            self._answers.append(Answer(self._clock.now_ns(), b"", middle_ns, answer, star_count=9))
        self._lit = None
        if attitude is not None:
            case = json.loads(self._now.read_text())["case"]
            self.frames.append((case, bool(shown.faults)))
            self._lit = shown.moment_ns, attitude.q_icrs_to_cam

    def await_ready(self) -> None:
        """It reads at once."""

    def refusals(self) -> dict[str, int]:
        return {}

    def take(self) -> list[Answer]:
        answers, self._answers = self._answers, []
        return answers


@dataclass
class ShownRun:
    """A run's tracker, the bench files that were opened, the counts of finished cases, and whether
    all were shown.
    """

    tracker: SeeingTracker
    files: list[BenchFile]
    counts: list[int]
    is_whole: bool


def campaign_of(folder: Path, **keys: Any) -> Campaign:
    """The campaign of a plan of `keys` in a folder."""
    answers = {
        "source": "udp",
        "bind": "127.0.0.1:5000",
        "format": "json",
        "clock": "host",
        "wrong_arcsec": 10.0,  # the plan's limit counts
    }
    tables = {
        "tracker": {"exposure_s": 0.004},
        "monitor": {"refresh_hz": 1e9 / FRAME_NS},
        "answers": answers,
        "render": {"quantisation": "round"},
    }
    (folder / "bench.toml").write_text(bench_text(tables))
    plan = {"through": "bench", "timeout_s": 1.0, "blank_s": 0.02, "attitudes": FIELD} | keys
    vary = plan.pop("vary", ())
    (folder / "plan.toml").write_text(plan_text(*vary, **plan))
    return Campaign(folder / "plan.toml", folder / "out", "centroids", 1.0, False)


def shown_campaign(
    folder: Path, monkeypatch: pytest.MonkeyPatch, until: int = 0, **keys: Any
) -> ShownRun:
    """Run the plan of `keys` in a folder."""
    campaign = campaign_of(folder, **keys)
    clock = FakeClock()
    tracker = SeeingTracker(clock, folder / "out" / "now.json", until)
    files: list[BenchFile] = []
    counts: list[int] = []

    @contextlib.contextmanager
    def display(file: BenchFile) -> Iterator[OpenDisplay]:
        files.append(file)
        with open_bench(file) as bench:
            yield OpenDisplay(bench, sink=tracker.see, clock=clock)

    monkeypatch.setattr(reader, "open_answers", lambda *_: contextlib.nullcontext(tracker))
    with contextlib.closing(Directory(folder / "out")) as directory:
        is_whole = campaign.show(directory, display, Notices(), counts.append)
    return ShownRun(tracker, files, counts, is_whole)


def test_a_campaign_is_shown_from_its_plan_to_its_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two renderers by their scenario; a fault drops the sky of one's cases for FAULT_S, and that
    of no check case.
    """
    (tmp_path / "faults.toml").write_text(
        f'[[fault]]\nkind = "blank"\nname = "dark"\nat_s = 0.0\nfor_s = {FAULT_S}\n'
    )
    scenario = {"key": "scenario", "values": ["faults.toml", ""]}
    numbers = []
    add = LitFrames.add

    def numbered(frames: LitFrames, frame: LitFrame) -> None:
        numbers.append(frame.number)
        add(frames, frame)

    monkeypatch.setattr(LitFrames, "add", numbered)
    shown = shown_campaign(
        tmp_path,
        monkeypatch,
        vary=(scenario,),
        cases=CASES,
        sampling="grid",
        answers=2,
        check_every=EVERY,
    )
    assert shown.is_whole
    checks = -(-CASES // EVERY) + 1
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    assert rows["case"] == list(range(CASES))
    assert sorted(rows["order"]) == list(range(CASES))
    assert rows["status"] == ["done"] * CASES
    assert rows["frames"] == rows["received"] == rows["solved"] == [2] * CASES
    assert rows["wrong"] == [0] * CASES
    assert rows["stars"] == [9.0] * CASES
    for axis, bias_arcsec in zip("xyz", BIAS_ARCSEC, strict=True):
        errors = rows[f"error_{axis}_arcsec"]
        assert errors == pytest.approx([bias_arcsec] * CASES, abs=EXACT_ARCSEC)
    for named, end_s, recovery_s, first_s in zip(
        *(rows[k] for k in ("vary.scenario", "fault_end_s", "recovery_s", "first_attitude_s")),
        strict=True,
    ):
        if named:
            assert end_s == pytest.approx(FAULT_S)
            assert first_s == pytest.approx(FAULT_S + recovery_s)
            assert 0 < recovery_s < 3 * FRAME_NS / 1e9
        else:
            assert (end_s, recovery_s) == (None, None)
            assert 0 < first_s < 3 * FRAME_NS / 1e9
    told = csv_rows(tmp_path / "out" / "checks.csv")
    assert [row["check"] for row in told] == [str(k) for k in range(checks)]
    for axis, bias_arcsec in zip("xyz", BIAS_ARCSEC, strict=True):
        for row in told:
            assert float(row[f"error_{axis}_arcsec"]) == pytest.approx(bias_arcsec, abs=1e-6)
    faulty = {
        case for case, named in zip(rows["case"], rows["vary.scenario"], strict=True) if named
    }
    frames = shown.tracker.frames
    assert {case for case, is_faulty in frames if is_faulty} <= faulty
    assert {case for case, _ in frames} == set(range(CASES + checks))
    assert len(shown.files) == 2
    # they go on from one renderer to the next, as an answer's exposure may
    assert (np.diff(numbers) > 0).all()
    assert shown.counts == list(range(CASES + checks + 1))
    assert not (tmp_path / "out" / "journal").exists()
    assert not (tmp_path / "out" / "now.json").exists()
    about = pq.read_schema(tmp_path / "out" / "cases.parquet").metadata
    assert about[b"hilstar.solver"] == b"answers"
    assert json.loads(about[b"hilstar.plan"])["check_every"] == EVERY


def test_a_campaign_that_a_signal_ended_goes_on_and_says_in_which_run_each_case_was_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two lit frames are a case's first answer: the fourth lit frame is the second case's."""
    keys = {"cases": 3, "answers": 1}
    ended = shown_campaign(tmp_path, monkeypatch, until=4, **keys)
    kept = ended.counts[-1]
    assert not ended.is_whole and 0 < kept < 3
    assert not (tmp_path / "out" / "cases.parquet").exists()
    went_on = shown_campaign(tmp_path, monkeypatch, **keys)
    assert went_on.is_whole and went_on.counts == list(range(kept, 4))
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    by_order = [number for _, number in sorted(zip(rows["order"], rows["run"], strict=True))]
    assert by_order == [1] * kept + [2] * (3 - kept)
    runs = csv_rows(tmp_path / "out" / "runs.csv")
    assert [row["run"] for row in runs] == ["1", "2"]
    assert not (tmp_path / "out" / "checks.csv").exists()


def test_a_bench_is_shown_as_many_cases_as_the_limit_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "MAX_BENCH_CASES", 3)
    assert campaign_of(tmp_path, cases=3).cases == 3
    with pytest.raises(InputError, match=r'cases = 4: through = "bench" takes at most 3$'):
        campaign_of(tmp_path, cases=4)
