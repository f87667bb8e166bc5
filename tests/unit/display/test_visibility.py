"""The thread that watches whether a window is seen, before a server whose answers are set. No X
server is asked: tests/screen has real ones.
"""

from __future__ import annotations

import ctypes
import os
import select
import threading
from collections import deque
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from hilstar.display.window import visibility
from hilstar.display.window.visibility import (
    DESTROY_NOTIFY,
    MAP_NOTIFY,
    UNMAP_NOTIFY,
    VISIBILITY_NOTIFY,
    ScreenArea,
    Visibility,
)
from tests.support.waiting import wait_for

ROOT, WINDOW = 1, 2
SCREEN_PX, WINDOW_PX = (1920, 1080), (800, 600)
PLACE = ScreenArea((100, 50), WINDOW_PX)
FULLY_OBSCURED = 2  # X.h
LONG_S, SOON_S = 60.0, 0.01


class Server:
    """Xlib's functions that `Visibility` calls, for one window at `corner_px`."""

    def __init__(self) -> None:
        self.corner_px = PLACE.corner_px
        self.closed = 0
        self.answers = threading.Event()
        self.answers.set()
        self.is_asked = False  # and does not answer
        self._waiting: deque[tuple[int, int]] = deque()
        self._here, self._far = os.pipe()

    def tells(self, kind: int, state: int = 0) -> None:
        """Send an event."""
        self._waiting.append((kind, state))
        os.write(self._far, b"!")

    def ends(self) -> None:
        """Close its end of the connection."""
        os.close(self._far)
        self._far = -1

    def free(self) -> None:
        """Close its own descriptors."""
        os.close(self._here)
        if self._far >= 0:
            os.close(self._far)

    def XSelectInput(self, *_: int) -> None:
        """Every event comes."""

    def XSync(self, *_: int) -> None:
        """Nothing waits."""

    def XConnectionNumber(self, _: int) -> int:
        return self._here

    def XDefaultRootWindow(self, _: int) -> int:
        return ROOT

    def XPending(self, _: int) -> int:
        return len(self._waiting)

    def XNextEvent(self, _: int, event) -> None:
        os.read(self._here, 1)
        # the pointed-to XEvent
        seen = event._obj.visibility
        seen.type, seen.state = self._waiting.popleft()

    def XGetGeometry(self, _: int, drawable: int, *parts) -> int:
        self.is_asked = not self.answers.is_set()
        self.answers.wait()
        # after the root and the corner
        parts[3]._obj.value, parts[4]._obj.value = SCREEN_PX if drawable == ROOT else WINDOW_PX
        return 1

    def XTranslateCoordinates(self, _: int, window: int, root: int, *parts) -> int:
        assert (window, root, parts[:2]) == (WINDOW, ROOT, (0, 0))
        parts[2]._obj.value, parts[3]._obj.value = self.corner_px
        return 1

    def XCloseDisplay(self, _: int) -> None:
        self.closed += 1


class Sleep:
    """Whether the display sleeps."""

    is_on = False

    def __call__(self) -> bool:
        return self.is_on


@pytest.fixture
def sleep(monkeypatch) -> Sleep:
    """How the display sleeps, without libXext."""
    sleep = Sleep()
    monkeypatch.setattr(visibility, "_sleep_of", lambda connection: sleep)
    # `close` waits this long for the thread, which a busy machine may wake late
    monkeypatch.setattr(visibility, "LOOK_AGAIN_S", LONG_S)
    return sleep


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.free()


@pytest.fixture
def watch(server, sleep) -> Iterator[Visibility]:
    watch = Visibility(server, 3, WINDOW, PLACE)
    yield watch
    watch.close()


def test_a_watch_says_what_hides_its_window_and_that_nothing_does_any_more(watch, server, sleep):
    for kind, state, back, why in (
        (VISIBILITY_NOTIFY, FULLY_OBSCURED, VISIBILITY_NOTIFY, "covered"),
        (UNMAP_NOTIFY, 0, MAP_NOTIFY, "not on the screen"),
    ):
        server.tells(kind, state)
        wait_for(lambda why=why: watch.hidden == why, why, poll_s=0.002)
        server.tells(back)
        wait_for(lambda: not watch.hidden, "seen again", poll_s=0.002)


def test_what_sends_no_event_is_looked_at_again(watch, server, sleep, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(visibility, "LOOK_AGAIN_S", SOON_S)
        server.tells(MAP_NOTIFY)  # ends the long wait
        server.corner_px = (101, 50)
        wait_for(lambda: watch.hidden == "moved off its display", "moved", poll_s=0.002)
        server.corner_px = PLACE.corner_px
        sleep.is_on = True
        wait_for(lambda: watch.hidden == "on a display that sleeps", "asleep", poll_s=0.002)


def test_a_second_close_touches_nothing_that_was_opened_since(watch, server):
    watch.close()
    assert server.closed == 1
    # the numbers that the watch has given back
    opened = [os.pipe() for _ in range(2)]
    try:
        watch.close()
        for here, far in opened:
            assert not select.select([here], [], [], 0)[0]
            os.write(far, b"!")
            assert os.read(here, 1) == b"!"
    finally:
        for end in (end for pipe in opened for end in pipe):
            os.close(end)
    assert server.closed == 1


def test_the_connection_of_a_window_that_is_gone_is_left_to_its_end(watch, server, monkeypatch):
    monkeypatch.setattr(visibility, "LOOK_AGAIN_S", SOON_S)  # after the event it waits once more
    server.tells(DESTROY_NOTIFY)
    wait_for(lambda: not watch._thread.is_alive(), "the thread's end", poll_s=0.002)
    watch.close()
    assert server.closed == 0


def test_a_watch_ends_with_its_connection(watch, server):
    server.ends()
    wait_for(lambda: not watch._thread.is_alive(), "the thread's end", poll_s=0.002)


def test_a_connection_that_the_thread_still_uses_is_not_closed(watch, server, monkeypatch):
    server.answers.clear()
    server.tells(MAP_NOTIFY)
    wait_for(lambda: server.is_asked, "the thread's question", poll_s=0.002)
    with monkeypatch.context() as patch:
        patch.setattr(visibility, "LOOK_AGAIN_S", SOON_S)
        watch.close()
    assert server.closed == 0
    server.answers.set()
    watch.close()
    assert server.closed == 1


@pytest.mark.parametrize(
    ("has_dpms", "is_capable", "is_known", "level", "is_asleep"),
    [
        (1, 1, 1, 3, True),
        (1, 1, 1, 0, False),
        (1, 1, 0, 3, False),
        (1, 0, 1, 3, False),
        (0, 1, 1, 3, False),
    ],
    ids=["off", "on", "not told", "not capable", "no extension"],
)
def test_a_display_sleeps_where_its_server_knows_of_it(
    has_dpms, is_capable, is_known, level, is_asleep, monkeypatch
):
    """Levels of dpmsconst.h: 0 is on, 3 is off."""

    def info(_: int, level_at, enabled_at) -> int:
        level_at._obj.value, enabled_at._obj.value = level, 1
        return is_known

    server = SimpleNamespace(XQueryExtension=lambda *_: has_dpms)
    library = SimpleNamespace(DPMSCapable=lambda *_: is_capable, DPMSInfo=info)
    monkeypatch.setattr(visibility, "xlib", lambda: server)
    monkeypatch.setattr(visibility, "load_library", lambda *_, **types: library)
    assert visibility._sleep_of(3)() is is_asleep


def test_an_event_is_read_as_xlib_lays_it_out():
    """XVisibilityEvent of 64 bits: type, serial, send_event, display, window, state."""
    event = visibility._Event()
    words = (ctypes.c_int * (ctypes.sizeof(event) // 4)).from_buffer(event)
    words[0], words[10] = VISIBILITY_NOTIFY, FULLY_OBSCURED
    assert (event.visibility.type, event.visibility.state) == (VISIBILITY_NOTIFY, FULLY_OBSCURED)
    assert ctypes.sizeof(event) == 24 * ctypes.sizeof(ctypes.c_long)
