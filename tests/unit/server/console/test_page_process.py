"""The page's process as the run sees it: a shell stands for the page."""

from __future__ import annotations

import time
from dataclasses import dataclass

import msgspec
import pytest

from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import BackOff
from hilstar.server.console import page_process
from hilstar.server.console.messages import RunEvent, RunState, SharedMemory
from hilstar.server.console.page_process import Listeners, PageProcess
from tests.support.waiting import wait_for


@dataclass
class Setup:
    """What the shell is given, and has no use for."""

    token: str = "the page's own"


@pytest.fixture
def page_of(monkeypatch):
    """A page's process that is a script of the shell's; gives its shared memory."""
    opened = []

    def started(script: str):
        monkeypatch.setattr(page_process, "PAGE", ("/bin/sh", "-c", script, "page"))
        memory = SharedMemory.make(24)
        page = PageProcess(
            Setup(),
            memory,
            Listeners(None),
            lambda: RunState(host_ns=time.monotonic_ns()),
            Notices(),
            do=lambda order: None,
        )
        opened.append(page)
        return memory

    yield started
    for page in opened:
        page.close()


def events_of(memory: SharedMemory) -> list[RunEvent]:
    return [msgspec.json.decode(event, type=RunEvent) for _, event in memory.events.after(0)]


def test_a_page_that_ends_is_told_with_its_time_of_day_and_started_again(page_of, tmp_path):
    beginnings = tmp_path / "beginnings"
    memory = page_of(f"echo >> {beginnings}; exit 7")
    wait_for(lambda: beginnings.exists() and beginnings.read_text().startswith("\n\n"))
    wait_for(lambda: events_of(memory))
    lost = events_of(memory)[0]
    assert lost.kind == "console-lost"
    assert "page ended (exit code 7)" in lost.line
    assert abs(lost.unix_s - time.time()) < 30


@pytest.mark.parametrize(("steady_s", "anew"), [(-1.0, True), (3600.0, False)])
def test_a_page_that_ran_steadily_is_started_again_sooner(page_of, monkeypatch, steady_s, anew):
    put_off = []

    class Recorder(BackOff):
        def put_off(self, *, anew: bool = False) -> None:
            put_off.append(anew)
            super().put_off(anew=anew)

    monkeypatch.setattr(page_process, "BackOff", Recorder)
    monkeypatch.setattr(page_process, "STEADY_S", steady_s)
    page_of("exit 7")
    wait_for(lambda: put_off)
    assert put_off[0] is anew


def test_a_page_inherits_neither_the_run_s_token_nor_its_place_to_report(
    page_of, tmp_path, monkeypatch
):
    monkeypatch.setenv("HILSTAR_TOKEN", "0123456789abcdef")
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
    monkeypatch.setenv("HILSTAR_TEST", "stays")
    told = tmp_path / "environment"
    page_of(f"env > {told}.part; mv {told}.part {told}")
    wait_for(told.exists)
    names = {line.partition("=")[0] for line in told.read_text().splitlines()}
    assert {"HILSTAR_TEST", "PYTHONPATH"} <= names
    assert not names & {"HILSTAR_TOKEN", "NOTIFY_SOCKET"}
