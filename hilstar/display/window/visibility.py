"""Whether an X11 window is seen: a thread with its own connection listens, so that no frame ever
asks the server.
"""

import ctypes
import os
import select
import threading
from dataclasses import dataclass
from typing import Any, Self

from hilstar.display.window.x11 import INT, NUMBER, POINTER, Survival, load_library, xlib

# X.h
VISIBILITY_CHANGES, STRUCTURE_CHANGES = 1 << 16, 1 << 17
VISIBILITY_NOTIFY, DESTROY_NOTIFY, UNMAP_NOTIFY, MAP_NOTIFY = 15, 17, 18, 19
COVERED = ("", "covered in part", "covered")  # by VisibilityNotify's state
DPMS_ON = 0  # dpmsconst.h
# interval of what sends no events: the position of a window's parents, and the display's sleep
LOOK_AGAIN_S = 0.5


@dataclass(frozen=True, slots=True)
class ScreenArea:
    """A rectangle of the whole screen, px: its top left corner and its size."""

    corner_px: tuple[int, int]
    size_px: tuple[int, int]


# XVisibilityEvent of Xlib, and the beginning of every other event
class _VisibilityEvent(ctypes.Structure):
    _fields_ = (
        *(("type", INT), ("serial", NUMBER), ("send_event", INT)),
        *(("display", POINTER), ("window", NUMBER), ("state", INT)),
    )


class _Event(ctypes.Union):  # XEvent of Xlib
    _fields_ = (("visibility", _VisibilityEvent), ("pad", ctypes.c_long * 24))


class WindowView:
    """What events of the X server say of a window: whether it is on the screen, wholly seen, and
    there at all. It begins as one that is seen.
    """

    def __init__(self) -> None:
        self._covered = 0
        self.is_mapped = True
        self.is_there = True

    def take(self, kind: int, state: int) -> None:
        """Take an event of this type (X.h), with the state that one of visibility has."""
        if kind == VISIBILITY_NOTIFY:
            self._covered = state
        elif kind in {MAP_NOTIFY, UNMAP_NOTIFY}:
            self.is_mapped = kind == MAP_NOTIFY
        elif kind == DESTROY_NOTIFY:
            self.is_there = False

    def why_hidden(self, misplaced: str, is_asleep: bool) -> str:
        """Why the window is not wholly seen, "" where it is; `misplaced` says that of its
        place.
        """
        if not self.is_mapped:
            return "not on the screen"
        # X11 also calls covered what is off the screen
        covered = misplaced or COVERED[self._covered]
        if covered:
            return covered
        return "on a display that sleeps" if is_asleep else ""


def off_place(area: ScreenArea, wanted: ScreenArea | None, screen_px: tuple[int, int]) -> str:
    """Why an area is not where it should be: the one that is wanted, or wholly on the screen where
    none is; "" where it is.
    """
    if wanted is not None:
        return "" if area == wanted else "moved off its display"
    axes = zip(area.corner_px, area.size_px, screen_px, strict=True)
    if all(at >= 0 and at + long <= end for at, long, end in axes):
        return ""
    return "off the screen, in part or wholly"


class Visibility:
    """Watches one window, which has to fill `place` if given; `hidden` says why it is not wholly
    seen, "" where it is.
    """

    def __init__(self, x11: Any, connection: int, window: int, place: ScreenArea | None) -> None:
        self._x11 = x11
        self._connection = connection
        self._window = window
        self.place = place
        self._view = WindowView()
        self._asleep = _sleep_of(connection)
        self.hidden = ""
        self._stop, self._stopped = os.pipe()
        x11.XSelectInput(connection, window, VISIBILITY_CHANGES | STRUCTURE_CHANGES)
        x11.XSync(connection, 0)
        self._thread = threading.Thread(target=self._run, name="hilstar-visibility", daemon=True)
        self._thread.start()

    @classmethod
    def of(cls, window: int, place: ScreenArea | None, survival: Survival) -> Self | None:
        """Watch a window that has to fill `place` (None: that may be anywhere); None without a
        connection to the server.
        """
        try:
            x11 = xlib()
        except (OSError, AttributeError):
            return None
        connection = x11.XOpenDisplay(None)
        if not connection:
            return None
        survival.cover(connection)
        return cls(x11, connection, window, place)

    def _run(self) -> None:
        """The thread: look at events, and at times at what sends none, until `close` or the end of
        the window or its server.
        """
        descriptor = self._x11.XConnectionNumber(self._connection)
        view = self._view
        while view.is_there:
            misplaced = self._off_place() if view.is_mapped else ""
            while self._x11.XPending(self._connection) > 0:
                event = _Event()
                self._x11.XNextEvent(self._connection, ctypes.byref(event))
                view.take(event.visibility.type, event.visibility.state)
            if view.is_there:
                self.hidden = view.why_hidden(misplaced, self._asleep())
            ready = select.select([descriptor, self._stop], [], [], LOOK_AGAIN_S)[0]
            # A readable connection without an event has ended.
            if self._stop in ready or (
                ready and self._x11.XPending(self._connection) <= 0 and _ended(descriptor)
            ):
                return

    def _off_place(self) -> str:
        """Why the window is not where it should be: on its display, or wholly on the screen; ""
        where it is.
        """
        root = self._x11.XDefaultRootWindow(self._connection)
        size = self._geometry(self._window)
        screen = self._geometry(root)
        x = ctypes.c_int()
        y = ctypes.c_int()
        child = ctypes.c_ulong()
        pointers = (ctypes.byref(part) for part in (x, y, child))
        if size is None or screen is None:
            return ""
        self._x11.XTranslateCoordinates(self._connection, self._window, root, 0, 0, *pointers)
        return off_place(ScreenArea((x.value, y.value), size), self.place, screen)

    def _geometry(self, drawable: int) -> tuple[int, int] | None:
        """The size of a window, px; None where it is gone."""
        root = ctypes.c_ulong()
        x = ctypes.c_int()
        y = ctypes.c_int()
        width, height, border, depth = (ctypes.c_uint() for _ in range(4))
        pointers = (ctypes.byref(part) for part in (root, x, y, width, height, border, depth))
        if not self._x11.XGetGeometry(self._connection, drawable, *pointers):
            return None
        return width.value, height.value

    def close(self) -> None:
        """Stop watching. Twice does nothing."""
        if self._stopped < 0:
            return
        os.write(self._stopped, b"\0")
        self._thread.join(LOOK_AGAIN_S)
        if self._thread.is_alive():
            return
        if self._view.is_there:
            self._x11.XCloseDisplay(self._connection)
        os.close(self._stop)
        os.close(self._stopped)
        self._stop = self._stopped = -1


def is_dark(is_enabled: bool, level: int) -> bool:
    """Whether a display is dark by DPMS, at a level of dpmsconst.h: 0 is on, the others are not. A
    level says nothing where DPMS is off.
    """
    return is_enabled and level != DPMS_ON


def _ended(descriptor: int) -> bool:
    """Whether the far end of a connection is closed."""
    poll = select.poll()
    poll.register(descriptor, 0)
    return bool(poll.poll(0))  # without requested events, it still reports a hang-up


def _sleep_of(connection: int) -> Any:
    """A function that tells whether the display sleeps (DPMS); always false where that is not
    known.
    """
    try:
        library = load_library(
            "libXext.so.6", DPMSCapable=(INT, POINTER), DPMSInfo=(INT, POINTER, POINTER, POINTER)
        )
        parts = (ctypes.byref(ctypes.c_int()) for _ in range(3))
        # Asked for a missing extension, Xlib prints to stderr.
        if not xlib().XQueryExtension(connection, b"DPMS", *parts) or not library.DPMSCapable(
            connection
        ):
            return bool
    except (OSError, AttributeError):
        return bool

    def asleep() -> bool:
        level = ctypes.c_ushort()
        enabled = ctypes.c_ubyte()
        known = library.DPMSInfo(connection, ctypes.byref(level), ctypes.byref(enabled))
        return bool(known) and is_dark(bool(enabled.value), level.value)

    return asleep
