"""A tracker in the loop: a stub of it in a process of its own, on a serial line, before a real
run with its page and ledger.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.server.record.ledger_records import answer_records
from tests.support.benches import ROOT, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.pages import live, page_of
from tests.support.servers import bound
from tests.support.stub_tracker import Stub
from tests.support.waiting import wait_for
from tests.support.wire.ptys import serial_line

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("without_charts")]
SHOWN_WITHIN_S = 0.2
ANSWERS = 45  # `assess` wants 30, and a busy machine holds some up
STUB = {"wild": 0.06, "swing_deg": 1.0, "seed": 4}
# Frames of 100 ms: at 60 Hz a busy machine misses one before almost every answer, and `assess` is
# right to refuse such a run.
SLOW_FRAMES = bench_text({"render": {"quantisation": "round"}, "monitor": {"refresh_hz": 10}})


@contextlib.contextmanager
def stub_tracker(port: int, line: int, **planted: object) -> Iterator[subprocess.Popen[str]]:
    """The stub while this is open."""
    told = json.dumps({"port": port, "line": line} | planted)
    command = [sys.executable, "-m", "tests.support.stub_tracker", told]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=[line]
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_trackers_answers_are_judged_shown_and_recorded_while_it_answers(tmp_path: Path) -> None:
    ledger = tmp_path / "run.mcap"
    with serial_line() as (line, name):
        answers = (
            f'[answers]\nsource = "serial"\nformat = "json"\nport = "{name}"\nwrong_arcsec = 600'
        )
        options = ("--console", "127.0.0.1:0", "--ledger", str(ledger))
        with bound(
            tmp_path,
            *options,
            attitude=f'bind = true\nclock = "shared"\n{answers}',
            text=SLOW_FRAMES,
        ) as served:
            page = page_of(served)
            with stub_tracker(served.port, line, **STUB) as stub:
                delays_s, told = follow(page, ANSWERS)
                assert stub.stdin is not None and stub.stdout is not None
                stub.stdin.close()
                planted = json.loads(stub.stdout.readline())
            # A machine that stands still delays some: what the program does is the rule.
            assert np.median(delays_s) < SHOWN_WITHIN_S
            assert told["stars"] == 9
            # a stub that a busy machine holds up answers less often than it is due
            assert told["availability"] > 0.5
            wait_for(
                lambda: any("has not answered" in why for why in page.json("/health")["reasons"])
            )
            summary = served.summary()
    records = list(answer_records(ledger))
    assert [record.raw[:2] for record in records] == ["7b"] * len(records)  # {
    assert len(records) == summary["answers"]["answers"] >= ANSWERS
    assert summary["answers"]["silent"]
    wrong = [number for number, record in enumerate(records) if record.verdict == "wrong"]
    starved = planted["starved"]
    assert summary["answers"]["wrong"] == len(wrong) == len(planted["wild"]) > 0
    assert {record.verdict for record in records} <= {"right", "wrong", "unpaired"}
    assessed = run_hilstar_here(
        "assess", ledger, "-o", tmp_path / "budget", "--json", "--display-attitudes", "0"
    )
    assert assessed.returncode == 0, assessed.stderr
    found = json.loads(assessed.stdout)
    # Four sigmas of the mean of so many answers, and of 2 ms of a clock at 1 deg/s.
    sigma = 4 * np.array(Stub(0, 0).noise_arcsec) / np.sqrt(len(records)) + 7
    assert (np.abs(np.array(found["bias_arcsec"]) - Stub(0, 0).bias_arcsec) < sigma).all()
    # The stub reports what it commands, and not what was lit: a sender that a busy machine held up
    # had another sky shown.
    rows = {each["row"] for each in found["wrong"]}
    planted_rows, starved_rows = ({number + 1 for number in kind} for kind in (wrong, starved))
    assert planted_rows <= rows <= planted_rows | starved_rows


def follow(page: Any, count: int) -> tuple[list[float], dict[str, Any]]:
    """How long after its writing each of so many answers reached the page, s, and the last one's
    figures.
    """
    delays_s: list[float] = []
    with live(page) as link:
        for message in link.messages():
            if isinstance(message, dict) and (told := message.get("answer")) is not None:
                delays_s.append((time.monotonic_ns() - int(told["mode"])) / 1e9)
                if len(delays_s) == count:
                    return delays_s, told
    raise AssertionError("the page was closed")
