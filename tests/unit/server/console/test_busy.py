"""What a terminal shows while a command computes, and while it waits."""

from __future__ import annotations

import io
import sys
import threading
import time

import pytest

from hilstar.server.console.terminal import BUSY_THREAD, busy, print_states, progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


SOON_S = 0.01
LATE_S = 20.0


@pytest.fixture
def on_terminal(monkeypatch):
    """Sets a terminal as stderr: called within the test, as pytest sets its own before it."""

    def begun():
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.delenv("NO_COLOR", raising=False)
        stream = Terminal()
        monkeypatch.setattr(sys, "stderr", stream)
        return stream

    return begun


def wait_for(stream, text):
    until_s = time.monotonic() + LATE_S
    while text not in stream.getvalue() and time.monotonic() < until_s:
        time.sleep(SOON_S)
    assert text in stream.getvalue()


def test_what_takes_long_is_named_on_a_terminal(on_terminal):
    terminal = on_terminal()
    with busy("computing the catalogue", after_s=SOON_S):
        wait_for(terminal, "computing the catalogue")


def test_nothing_of_a_wait_runs_on_when_it_is_over(on_terminal):
    """Else its line would be erased after the result stands on stdout."""
    terminal = on_terminal()
    with busy("computing the catalogue", after_s=SOON_S):
        wait_for(terminal, "computing the catalogue")
    assert BUSY_THREAD not in [thread.name for thread in threading.enumerate()]


def test_what_ends_soon_is_not(on_terminal):
    terminal = on_terminal()
    with busy("computing the catalogue", after_s=LATE_S):
        pass
    assert terminal.getvalue() == ""


def test_an_error_comes_through_and_ends_it(on_terminal):
    terminal = on_terminal()
    with pytest.raises(ValueError, match="no star"), busy("computing", after_s=SOON_S):
        wait_for(terminal, "computing")
        raise ValueError("no star")
    shown = terminal.getvalue()
    time.sleep(0.5)  # two refreshes
    assert terminal.getvalue() == shown


def test_no_terminal_gets_nothing(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with busy("computing", after_s=0.0):
        time.sleep(SOON_S)
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    "shown", [lambda: busy("computing", after_s=SOON_S), lambda: progress("sending", 3)]
)
def test_results_stay_on_stdout(on_terminal, capsys, shown):
    terminal = on_terminal()
    with shown():
        wait_for(terminal, "ing")
        print("the result")
    assert capsys.readouterr().out == "the result\n"
    assert "the result" not in terminal.getvalue()


LINES = ["ok      python      3.11", "MISSING opengl      none", "        what mends it"]


def test_states_have_colours_on_a_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = Terminal()
    monkeypatch.setattr(sys, "stdout", stream)
    print_states(LINES)
    ok, missing, remedy = stream.getvalue().splitlines()
    assert ok == "\x1b[32mok      \x1b[0m\x1b[1;36mpython\x1b[0m      3.11"
    assert missing.startswith("\x1b[1;31mMISSING")
    assert remedy == LINES[2]


@pytest.mark.parametrize("colour", ["", "1"])
def test_states_have_none_elsewhere(monkeypatch, colour):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", colour)
    stream = Terminal() if colour else io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    print_states(LINES)
    assert stream.getvalue().splitlines() == LINES


def test_a_terminal_that_cannot_erase_gets_no_bar(on_terminal, monkeypatch):
    terminal = on_terminal()
    monkeypatch.setenv("TERM", "dumb")
    with busy("computing", after_s=0.0), progress("sending", 3):
        time.sleep(SOON_S)
    assert terminal.getvalue() == ""


def test_a_bar_has_the_steps_that_are_done_however_often_it_is_told(on_terminal):
    terminal = on_terminal()
    with progress("sending", 10) as advance:
        for done in (1, 2, 5):
            advance(done)
    assert " 5/10" in terminal.getvalue()
    with progress("waiting", float("inf")) as advance:
        advance(3)
    assert "m3/?" in terminal.getvalue()
