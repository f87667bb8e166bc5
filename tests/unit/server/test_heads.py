"""The processes of several heads: when one is begun again and when it has done, with which command;
and what it said at its end.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import pytest

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import TimeRequest
from hilstar.server import heads
from hilstar.server.bench.bench_file import read_heads
from hilstar.server.heads import HeadProcess, HeadsRun, _hand_on, head_command, summary_of
from tests.support.damage import NO_JSON
from tests.support.heads import heads_file
from tests.support.waiting import wait_for

# What a head does as a service that draws: it says that it is ready.
READY = (
    "import os, socket;"
    " socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b'READY=1', os.environ['NOTIFY_SOCKET']);"
)


@pytest.mark.parametrize("output", NO_JSON)
def test_a_head_whose_output_is_no_json_has_no_summary(output):
    assert summary_of(output) is None


def test_a_summary_is_told():
    assert summary_of(b'{"frames": 3}\n') == {"frames": 3}


def python(code: str) -> list[str]:
    """A process that runs a line of Python, without what takes long to import."""
    return [sys.executable, "-S", "-c", code]


def ended(head: HeadProcess) -> tuple[int | None, int]:
    """Tend a head until it has done; its exit code, and how often it was begun again."""
    try:
        wait_for(lambda: not head.tend(), "it has done", poll_s=0.01)
    finally:
        head.close(1.0)
    return head.code, head.restarts


@pytest.mark.parametrize(
    ("first", "restarts", "said"),
    [
        # nothing was shown: no end in order
        ("", 1, "head: its process ended (exit code 0); it is started again"),
        ("import os; os.kill(os.getpid(), 9)", 1, "head: its process ended (signal 9)"),
        (f"{READY} os._exit(77)", 1, "head: its process ended (exit code 77)"),
    ],
)
def test_a_head_that_ends_in_no_order_is_begun_again(tmp_path, first, restarts, said):
    lines: list[str] = []

    def command(number: int, drawn_s: float) -> list[str]:
        return python(f"{READY} print(7)") if number else python(first)

    head = HeadProcess("head", command, lines.append, tmp_path / "life")
    assert ended(head) == (0, restarts)
    assert head.output == b"7\n"
    assert said in lines[0]


def says_ready(life: Path) -> None:
    """What a head's process says once it draws."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as head:
        head.sendto(b"READY=1", str(life))


def test_what_a_head_s_last_process_said_is_not_the_next_one_s(tmp_path, monkeypatch):
    """One that is ready is stalled at once here; one that begins has its time."""
    monkeypatch.setattr(heads, "STALLED_S", -1.0)
    lines: list[str] = []
    life = tmp_path / "life"
    codes = (
        "import os; os.kill(os.getpid(), 9)",
        "import time; time.sleep(0.1); raise SystemExit(3)",
    )
    head = HeadProcess("head", lambda number, drawn_s: python(codes[number]), lines.append, life)
    wait_for(lambda: head.tend() and lines, "its process has ended", poll_s=0.01)
    says_ready(life)
    assert ended(head) == (3, 1)


def test_a_head_has_drawn_since_its_first_process_was_ready(tmp_path):
    life = tmp_path / "life"
    waits = python("import time; time.sleep(60)")
    head = HeadProcess("head", lambda number, drawn_s: waits, print, life)
    try:
        assert head.tend() and head.drawn_s == 0.0
        says_ready(life)
        wait_for(lambda: head.tend() and head.drawn_s > 0.02, "20 ms have passed", poll_s=0.01)
        says_ready(life)
        assert head.tend() and head.drawn_s > 0.02
    finally:
        head.close(0.0)


@pytest.mark.parametrize(
    ("code", "exit_code"), [("raise SystemExit(3)", 3), (f"{READY} raise SystemExit(1)", 1)]
)
def test_a_head_that_a_command_s_exit_code_ends_has_done(tmp_path, code, exit_code):
    head = HeadProcess("head", lambda number, drawn_s: python(code), print, tmp_path / "life")
    assert ended(head) == (exit_code, 0)


def test_what_a_head_says_is_told_with_its_name_and_secrets_are_in_its_environment(tmp_path):
    lines: list[str] = []
    code = (
        f"{READY} import sys; print(os.environ['HILSTAR_TOKEN'], file=sys.stderr);"
        " print(os.environ['WATCHDOG_USEC'], file=sys.stderr)"
    )
    token = {"HILSTAR_TOKEN": "secret"}
    head = HeadProcess(
        "head", lambda number, drawn_s: python(code), lines.append, tmp_path / "life", token
    )
    assert ended(head) == (0, 0)
    assert lines == ["head: secret", f"head: {1e6 * heads.STALLED_S:.0f}"]
    assert "HILSTAR_TOKEN" not in os.environ


def test_a_head_begun_again_runs_for_the_rest_of_the_time_with_a_ledger_of_its_own(tmp_path):
    file = read_heads(heads_file(tmp_path, 5599))
    pages = tuple(f"127.0.0.1:{9000 + k}" for k in range(3))
    asked = HeadsRun(file, ("--headless",), 60.0, tmp_path / "run.mcap", pages)

    def words(number: int, drawn_s: float) -> dict[str, str]:
        command = head_command(asked, 1, "ipc:///feed", number, drawn_s)
        assert command[:6] == [
            sys.executable,
            "-m",
            "hilstar",
            "serve",
            str(tmp_path / "b.toml"),
            "--json",
        ]
        assert "--headless" in command
        return dict(pairwise(command))

    first, again, late = words(0, 0.0), words(2, 12.5), words(3, 61.0)
    assert [each["--duration"] for each in (first, again, late)] == ["60", "47.5", "0.05"]
    ledgers = [Path(each["--ledger"]).name for each in (first, again)]
    assert ledgers == ["run.b.mcap", "run.b.again2.mcap"]
    assert first["--console"] == "127.0.0.1:9001"
    assert first["--head-of"] == str(file.path)
    assert first["--fed-by"] == f"ipc:///feed,{os.getpid()}"


@pytest.mark.parametrize(("steady_s", "anew"), [(1000.0, False), (0.0, True)])
def test_only_a_head_that_was_well_for_long_is_begun_again_after_the_shortest_pause(
    tmp_path, monkeypatch, steady_s, anew
):
    pauses = []

    class Noted:
        """A pause that is over at once, with what it was asked for."""

        over = True

        def __init__(self, *limits: object) -> None:
            pass

        def put_off(self, *, anew: bool = False) -> None:
            pauses.append(anew)

    monkeypatch.setattr(heads, "BackOff", Noted)
    monkeypatch.setattr(heads, "STEADY_S", steady_s)
    codes = ["raise SystemExit(70)"] * 2 + ["raise SystemExit(1)"]
    head = HeadProcess(
        "head", lambda number, drawn_s: python(codes[number]), lambda line: None, tmp_path / "life"
    )
    assert ended(head) == (1, 2)
    assert pauses == [anew] * 2


def arrived(event: Any) -> Arrival[Any]:
    """What came 5 ns after this machine was started."""
    return Arrival(5, event, b"")


class Source:
    """A link that has something at each look, and does not speak back."""

    two_way = False

    def __init__(self) -> None:
        self.numbers: Iterator[Any] = count()

    def receive(self, timeout_ms: int) -> list[Arrival[Any]]:
        return [arrived(next(self.numbers))]

    def send(self, packet: object) -> None:
        """Nobody listens."""


class Tended:
    """A head that has something to do for so many looks; `left` are those that are yet to come."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    def tend(self) -> bool:
        self.left -= 1
        return self.left > 0


def test_heads_are_fed_until_the_last_of_them_has_done(monkeypatch):
    monkeypatch.setattr(heads, "TEND_NS", -1)  # at each look
    given: list[int] = []
    early, late = Tended(1), Tended(5)

    def give(arrival: Arrival[Any]) -> None:
        given.append(arrival.event)

    _hand_on(Source(), give, [early, late], threading.Event())
    assert late.left == 0
    assert given == [0, 1, 2, 3, 4]


def test_a_signal_ends_the_feeding_of_heads_that_have_more_to_do():
    stop, source = threading.Event(), Source()
    source.numbers = iter([TimeRequest(7, 11), "an attitude"])
    given: list[object] = []

    def give(arrival: Arrival[Any]) -> None:
        given.append(arrival.event)
        stop.set()

    _hand_on(source, give, [Tended(10**9)], stop)
    assert given == ["an attitude"]  # a question is for none of the heads


def test_a_run_of_heads_is_what_each_said_and_a_question_that_came_in_is_answered(
    tmp_path, monkeypatch
):
    """The first two end by themselves, in order and by an error that no restart mends; the third
    waits for Ctrl-C, which a signal to this run is to it.
    """
    file = read_heads(heads_file(tmp_path, 5599))
    asked = HeadsRun(file, (), None, None, ("a:1", "b:1", "c:1"), "token")
    ends = [
        f"{READY} print(len(os.environ['HILSTAR_TOKEN']))",
        f"{READY} print('no JSON'); raise SystemExit(4)",
        f"{READY} import time, signal; signal.signal(2, lambda *_: (print(3, flush=True), os._exit(0)));"
        " print('waits', file=__import__('sys').stderr, flush=True); time.sleep(60)",
    ]
    made: list[tuple[object, ...]] = []

    def command(*words: object) -> list[str]:
        made.append(words[1:])
        return python(ends[int(str(words[1]))])

    begun: list[HeadProcess] = []

    class Noted(HeadProcess):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            begun.append(self)

    monkeypatch.setattr(heads, "HeadProcess", Noted)
    monkeypatch.setattr(heads, "head_command", command)
    said: list[str] = []
    answered: list[object] = []

    class Link(Source):
        """Asks for the time, and gives a signal once the third head waits."""

        two_way = True
        looks = 0

        def receive(self, timeout_ms: int) -> list[Arrival[Any]]:
            self.looks += 1
            if self.looks == 1:
                return [arrived(TimeRequest(7, 11))]
            if "c: waits" in said and None not in (head.code for head in begun[:2]):
                os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
            return []

        def send(self, packet: object, *_: object) -> None:
            answered.append(packet)

    told = heads.run_heads(asked, Link(), said.append)
    assert [(reply.sequence, reply.t1_ns) for reply in answered] == [(7, 11)]
    assert list(told) == list(file.names)
    assert [each["exit_code"] for each in told.values()] == [0, 4, 0]
    assert [each["restarts"] for each in told.values()] == [0, 0, 0]
    assert [each["summary"] for each in told.values()] == [5, None, 3]
    assert [words[0] for words in made] == [0, 1, 2]
    assert len({words[1] for words in made}) == 1


def test_the_common_source_gives_the_body_s_attitude(tmp_path):
    """Whatever the mounting of the first head."""
    file = read_heads(heads_file(tmp_path, 5599, names="bc"))
    config = heads.source_config(file)
    assert file.files[0].config.tracker.q_body_to_cam != (1.0, 0.0, 0.0, 0.0)
    assert config.tracker.q_body_to_cam == (1.0, 0.0, 0.0, 0.0)
    assert config.attitude == file.files[0].config.attitude


def test_a_head_that_has_not_drawn_yet_has_the_time_of_a_start(tmp_path, monkeypatch):
    lines: list[str] = []
    head = HeadProcess(
        "head", lambda *words: python("import time; time.sleep(60)"), lines.append, tmp_path / "l"
    )
    monkeypatch.setattr(heads, "STALLED_S", -1.0)  # any time is too long
    assert head.tend() and lines == []
    monkeypatch.setattr(heads, "STARTS_S", -1.0)
    assert head.tend() and "it is started again" in lines[0]
    head.close(1.0)


def test_a_head_without_a_sign_of_life_is_killed_and_begun_again(tmp_path, monkeypatch):
    """Before it drew it has longer than after."""
    monkeypatch.setattr(heads, "STALLED_S", 0.1)
    monkeypatch.setattr(heads, "STARTS_S", 60.0)
    waits = f"{READY} import time; time.sleep(60)"
    lines: list[str] = []

    def command(number: int, drawn_s: float) -> list[str]:
        if number:
            monkeypatch.setattr(heads, "STALLED_S", 60.0)
        return python(f"{READY} print(5)" if number else waits)

    head = HeadProcess("head", command, lines.append, tmp_path / "life")
    assert ended(head) == (0, 1)
    assert head.output == b"5\n" and len(lines) == 1
    assert lines[0].startswith("head: no frame for 0.") and "it is started again" in lines[0]


def test_a_head_that_does_not_end_in_time_is_killed(tmp_path):
    code = f"import signal; signal.signal(2, signal.SIG_IGN); {READY} import time; time.sleep(60)"
    head = HeadProcess("head", lambda number, drawn_s: python(code), print, tmp_path / "life")
    wait_for(lambda: head.tend() and head.drawn_s > 0, "it draws", poll_s=0.01)
    head.interrupt()
    head.close(0.1)
    assert head.code == -signal.SIGKILL
