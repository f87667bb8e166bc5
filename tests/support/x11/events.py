"""Keys and the close button as an X client sends them to hilstar's window."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

KEY_PRESS, KEY_RELEASE, CLIENT_MESSAGE = 2, 3, 33
KEY_MASKS = {KEY_PRESS: 1 << 0, KEY_RELEASE: 1 << 1}


class KeyEvent(ctypes.Structure):
    """XKeyEvent of Xlib."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("root", ctypes.c_ulong),
        ("subwindow", ctypes.c_ulong),
        ("time", ctypes.c_ulong),
        ("place", ctypes.c_int * 4),
        ("state", ctypes.c_uint),
        ("keycode", ctypes.c_uint),
        ("same_screen", ctypes.c_int),
    ]


class ClientMessage(ctypes.Structure):
    """XClientMessageEvent of Xlib, of format 32."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("message_type", ctypes.c_ulong),
        ("format", ctypes.c_int),
        ("data", ctypes.c_long * 5),
    ]


class Event(ctypes.Union):
    """XEvent of Xlib."""

    _fields_ = [("key", KeyEvent), ("client", ClientMessage), ("pad", ctypes.c_long * 24)]


class Client:
    """A connection to a display, and the only window on it."""

    def __init__(self, x11: ctypes.CDLL, display: int) -> None:
        self._x11, self._display = x11, display
        self._root = x11.XDefaultRootWindow(display)

    def window(self) -> int:
        """hilstar's window: the root's last child."""
        root, parent, count = ctypes.c_ulong(), ctypes.c_ulong(), ctypes.c_uint()
        children = ctypes.POINTER(ctypes.c_ulong)()
        pointers = (ctypes.byref(part) for part in (root, parent, children, count))
        assert self._x11.XQueryTree(self._display, self._root, *pointers)
        assert count.value
        return children[count.value - 1]

    def press(self, key: str) -> None:
        """Press and release a key by its X name: "g", "space"."""
        code = self._x11.XKeysymToKeycode(self._display, self._x11.XStringToKeysym(key.encode()))
        for kind in (KEY_PRESS, KEY_RELEASE):
            event = Event()
            event.key = KeyEvent(
                kind, 0, 1, self._display, self.window(), self._root, 0, 0, (1, 1, 1, 1), 0, code, 1
            )
            self._send(event, KEY_MASKS[kind])

    def close_window(self) -> None:
        """As a window manager's close button does (ICCCM, WM_DELETE_WINDOW)."""
        protocols, delete = (
            self._x11.XInternAtom(self._display, name, 0)
            for name in (b"WM_PROTOCOLS", b"WM_DELETE_WINDOW")
        )
        event = Event()
        event.client = ClientMessage(
            CLIENT_MESSAGE, 0, 1, self._display, self.window(), protocols, 32, (delete, 0, 0, 0, 0)
        )
        self._send(event, 0)

    def composite(self) -> None:
        """Say that a compositing manager runs on screen 0: it owns this selection (EWMH)."""
        manager = self._x11.XInternAtom(self._display, b"_NET_WM_CM_S0", 0)
        self._x11.XSetSelectionOwner(self._display, manager, self.cover(1, 1), 0)
        self._x11.XSync(self._display, 0)

    def unmap(self) -> None:
        """Take hilstar's window off the screen."""
        self._x11.XUnmapWindow(self._display, self.window())
        self._x11.XSync(self._display, 0)

    def map(self) -> None:
        """And put it back."""
        self._x11.XMapWindow(self._display, self.window())
        self._x11.XSync(self._display, 0)

    def move(self, x: int, y: int) -> None:
        """Move hilstar's window."""
        self._x11.XMoveWindow(self._display, self.window(), x, y)
        self._x11.XSync(self._display, 0)

    def cover(self, width: int, height: int) -> int:
        """A window of ours over the corner of the screen."""
        window = self._x11.XCreateSimpleWindow(
            self._display, self._root, 0, 0, width, height, 0, 0, 0
        )
        self._x11.XMapRaised(self._display, window)
        self._x11.XSync(self._display, 0)
        return window

    def uncover(self, window: int) -> None:
        """Take it away again."""
        self._x11.XDestroyWindow(self._display, window)
        self._x11.XSync(self._display, 0)

    def destroy_window(self) -> None:
        """As a program does that takes hilstar's window for its own."""
        self._x11.XDestroyWindow(self._display, self.window())
        self._x11.XSync(self._display, 0)

    def kill_client(self) -> None:
        """As xkill does."""
        self._x11.XKillClient(self._display, self.window())
        self._x11.XSync(self._display, 0)

    def _send(self, event: Event, mask: int) -> None:
        assert self._x11.XSendEvent(self._display, self.window(), 0, mask, ctypes.byref(event))
        self._x11.XSync(self._display, 0)


@contextmanager
def client(display: str) -> Iterator[Client]:
    """A client of a display."""
    x11 = ctypes.CDLL("libX11.so.6")
    pointer, number = ctypes.c_void_p, ctypes.c_ulong
    for name, result, arguments in (
        ("XOpenDisplay", pointer, [ctypes.c_char_p]),
        ("XCloseDisplay", ctypes.c_int, [pointer]),
        ("XDefaultRootWindow", number, [pointer]),
        ("XQueryTree", ctypes.c_int, [pointer, number, *[pointer] * 4]),
        ("XStringToKeysym", number, [ctypes.c_char_p]),
        ("XKeysymToKeycode", ctypes.c_ubyte, [pointer, number]),
        ("XInternAtom", number, [pointer, ctypes.c_char_p, ctypes.c_int]),
        ("XSendEvent", ctypes.c_int, [pointer, number, ctypes.c_int, ctypes.c_long, pointer]),
        ("XDestroyWindow", ctypes.c_int, [pointer, number]),
        ("XUnmapWindow", ctypes.c_int, [pointer, number]),
        ("XMapWindow", ctypes.c_int, [pointer, number]),
        ("XMapRaised", ctypes.c_int, [pointer, number]),
        ("XMoveWindow", ctypes.c_int, [pointer, number, ctypes.c_int, ctypes.c_int]),
        (
            "XCreateSimpleWindow",
            number,
            [pointer, number, *[ctypes.c_int] * 2, *[ctypes.c_uint] * 3, *[number] * 2],
        ),
        ("XKillClient", ctypes.c_int, [pointer, number]),
        ("XSetSelectionOwner", ctypes.c_int, [pointer, *[number] * 3]),
        ("XSync", ctypes.c_int, [pointer, ctypes.c_int]),
    ):
        function = getattr(x11, name)
        function.restype, function.argtypes = result, arguments
    connection = x11.XOpenDisplay(display.encode())
    assert connection, f"no display {display}"
    try:
        yield Client(x11, connection)
    finally:
        x11.XCloseDisplay(connection)
