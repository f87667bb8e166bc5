"""On a busy machine times name no winner: what the others take is measured, and said."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from hilstar.instruments.study import sweep
from hilstar.instruments.study.chain.run import headline
from hilstar.instruments.study.speed.report import Aim, Machine, Result, lines
from hilstar.instruments.study.sweep import BUSY_SHARE, NOT_JUDGED, Load, OtherWork
from tests.support.waiting import wait_for

CORES = os.cpu_count() or 1
MACHINE = Machine("a processor", CORES, 0.0, "3", "2")


def test_processes_that_are_not_this_one_s_are_counted_while_they_run():
    work = OtherWork()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(CORES)]
    try:
        # a child counts as its own only once it has ended
        wait_for(lambda: Load(work.cores()).busy, "nothing else ran")
    finally:
        for process in busy:
            process.kill()
            process.wait()


def test_what_this_process_does_itself_is_not_other_work():
    work, before = OtherWork(), os.times()
    while os.times().user - before.user < 0.3:
        sum(range(100_000))  # to ask for the time is the system's work
    spent_s, passed_s = os.times().user - before.user, os.times().elapsed - before.elapsed
    # All of the machine less what this process had is the most that there can be of others.
    assert work.cores() <= CORES - spent_s / passed_s + 0.1


def test_children_that_have_ended_are_not_others(tmp_path, monkeypatch):
    """The machine's own count stands still here, so that all that changes is this process's."""
    stat = tmp_path / "stat"
    stat.write_text("cpu 1000000 0 0 0 0 0 0 0\n", encoding="ascii")
    monkeypatch.setattr(sweep, "STAT", stat)
    all_before_s, others_before_s = OtherWork._times_s()
    code = "import time\nwhile time.process_time() < 0.2: pass"
    subprocess.run([sys.executable, "-S", "-c", code], check=True)
    all_s, others_s = OtherWork._times_s()
    assert all_s == all_before_s
    assert others_before_s - others_s >= 0.2


def test_other_work_is_all_but_idling_and_waiting_less_this_process_s_own(tmp_path, monkeypatch):
    """proc(5): user, nice, system, idle, iowait, irq, softirq and steal, in ticks, then guests,
    whose time is in user's.
    """
    stat = tmp_path / "stat"
    monkeypatch.setattr(sweep, "STAT", stat)
    stat.write_text("cpu  10000 2000 3000 40000 5000 600 70 8 900 90\ncpu0 1 1 1 1\n")
    tick_s = 1 / os.sysconf("SC_CLK_TCK")
    times = os.times()
    own_s = times.user + times.system + times.children_user + times.children_system
    all_s, others_s = OtherWork._times_s()
    assert all_s == pytest.approx(60678 * tick_s)
    assert others_s + own_s == pytest.approx(15678 * tick_s, abs=0.5)
    stat.write_text("intr 1 2 3\n")
    assert OtherWork._times_s() == (0.0, 0.0)
    # a core of four is more than 15 %, half of one is not
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert [Load(cores).busy for cores in (0.5, 0.6, 0.7, 1.0)] == [False, False, True, True]


def test_a_busy_machine_is_said_and_no_aim_is_judged():
    others = CORES * BUSY_SHARE * 2
    told = list(lines(Result(MACHINE, aims=[Aim("frame", 1.0, 2.0, None)], others_cores=others)))
    assert Load(others).caution in told
    assert any(line.startswith("aim not judged") for line in told)
    idle = list(lines(Result(MACHINE, aims=[Aim("frame", 1.0, 2.0, False)])))
    assert not any("busy" in line for line in idle)
    assert any(line.startswith("aim NOT reached") for line in idle)
    assert NOT_JUDGED in headline([], Load(others))
