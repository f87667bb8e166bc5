"""No screen saver and no standby (DPMS) on an X server while a window is shown there; what was set
comes back after it.

A process of its own does it, for a run that is killed can restore nothing. It begins with the
window, ends when its stdin does, and nobody's child: what kills a run's children spares it. Twice a
second it looks whether somebody has set blanking again, such as another run that has ended: it
prevents that too, and restores it instead.

This file is also that process's program, by its path and without hilstar's other modules: it takes
20 ms to begin.
"""

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
from typing import Any, NamedTuple

MAX_WAIT_S = 5.0  # for a machine that is busy; the word comes within 20 ms on an idle one
LOOK_S = 0.5
DONT_PREFER_BLANKING, SCREEN_SAVER_RESET, DPMS_ON = 0, 0, 0  # X.h, dpmsconst.h


class Awake:
    """Keeps the X server of DISPLAY from blanking until `close`; without such a server it does
    nothing.
    """

    def __init__(self) -> None:
        program = [sys.executable, "-I", "-S", __file__]
        self._process = subprocess.Popen(
            program,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            self._word()  # GLFW sets a screen saver of its own aside, and must not be the first
        except BaseException:  # a signal ends the run while it waits
            self.close()
            raise

    def close(self) -> None:
        """Restore what was set before. Twice does nothing."""
        if self._process.stdin is None or self._process.stdin.closed:
            return
        self._process.stdin.close()
        while self._word():  # one that nobody has read yet is not the end
            pass
        # the one that was begun closes its files a moment before it can be waited for
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(MAX_WAIT_S)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _word(self) -> bytes:
        """The process's next word; nothing at its end, or where it says none in time."""
        word = b""
        stdout = self._process.stdout
        if stdout is not None and select.select([stdout], [], [], MAX_WAIT_S)[0]:
            word = os.read(stdout.fileno(), 1)
        self._process.poll()  # the one that was begun ends at once, and leaves the other behind
        return word


class Blanking(NamedTuple):
    """What an X server does when nobody types: after how many seconds, how, and whether monitors
    go to standby.
    """

    timeout_s: int
    interval_s: int
    prefer: int
    allow: int
    dpms: bool

    @property
    def happens(self) -> bool:
        """Whether a monitor goes dark by it: by the screen saver, or by standby."""
        return self.timeout_s != 0 or self.dpms


class SetAside:
    """The blanking that was set aside, for the time after."""

    def __init__(self) -> None:
        self._before: Blanking | None = None

    def takes(self, now: Blanking) -> bool:
        """Whether what is set now has to be set aside; it is then what comes back."""
        if now.happens:
            self._before = now
        return now.happens

    def to_restore(self, now: Blanking) -> Blanking | None:
        """What comes back at the end; None for nothing, or where somebody has set blanking
        again.
        """
        return None if now.happens else self._before


class _Server:
    """A connection to the X server of DISPLAY. Raises OSError without one."""

    def __init__(self) -> None:
        self._x11, self._xext = (ctypes.CDLL(name) for name in ("libX11.so.6", "libXext.so.6"))
        self._x11.XOpenDisplay.restype = ctypes.c_void_p
        opened = self._x11.XOpenDisplay(None)
        if not opened:
            raise OSError("no X server")
        self._display: Any = ctypes.c_void_p(opened)
        number = ctypes.c_int()
        query = self._xext.DPMSQueryExtension(
            self._display, ctypes.byref(number), ctypes.byref(number)
        )
        self._has_dpms = bool(query and self._xext.DPMSCapable(self._display))

    def blanking(self) -> Blanking:
        parts = [ctypes.c_int() for _ in range(4)]
        self._x11.XGetScreenSaver(self._display, *(ctypes.byref(part) for part in parts))
        level = ctypes.c_ushort()
        on = ctypes.c_ubyte()
        if self._has_dpms:
            self._xext.DPMSInfo(self._display, ctypes.byref(level), ctypes.byref(on))
        timeout_s, interval_s, prefer, allow = (part.value for part in parts)
        return Blanking(timeout_s, interval_s, prefer, allow, bool(on.value))

    def prevent(self, found: Blanking) -> None:
        """Light what is dark, and keep it so."""
        if found.dpms:
            self._xext.DPMSForceLevel(self._display, DPMS_ON)
            self._xext.DPMSDisable(self._display)
        self._x11.XForceScreenSaver(self._display, SCREEN_SAVER_RESET)
        self._x11.XSetScreenSaver(
            self._display, 0, found.interval_s, DONT_PREFER_BLANKING, found.allow
        )
        self._x11.XSync(self._display, 0)

    def restore(self, before: Blanking) -> None:
        self._x11.XSetScreenSaver(self._display, *before[:4])
        if before.dpms:
            self._xext.DPMSEnable(self._display)
        self._x11.XSync(self._display, 0)


def _keep() -> None:
    """The process: from its first word on nothing blanks, until its stdin ends."""
    server = _Server()
    aside = SetAside()
    is_reported = False
    while True:
        blanking = server.blanking()
        if aside.takes(blanking):
            server.prevent(blanking)
        if not is_reported:
            os.write(1, b".")
            is_reported = True
        if select.select([0], [], [], LOOK_S)[0]:
            break
    before = aside.to_restore(server.blanking())
    if before is not None:
        server.restore(before)


def _main() -> None:
    """Leave the run, whose signals are not meant for this process, and keep the screen awake."""
    if os.fork():
        os._exit(0)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        _keep()


if __name__ == "__main__":
    _main()
