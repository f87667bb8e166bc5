"""A real X.Org server with the dummy driver: monitors with names and refresh rates, gamma ramps,
and plugs to pull.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.support.waiting import PATIENCE_S

XA_ATOM, XA_INTEGER = 4, 19  # Xatom.h
SERVER_CONFIG = """
Section "ServerFlags"
  Option "AutoAddDevices" "false"
  Option "AutoAddGPU" "false"
EndSection
Section "Device"
  Identifier "card"
  Driver "dummy"
  VideoRam 256000
EndSection
Section "Monitor"
  Identifier "first"
  HorizSync 5-1000
  VertRefresh 5-200
  Modeline "640x480" 25.175 640 656 752 800 480 490 492 525
  Modeline "640x480_120" 50.35 640 656 752 800 480 490 492 525
  Modeline "800x600" 40.0 800 840 968 1056 600 601 605 628
EndSection
Section "Screen"
  Identifier "screen"
  Device "card"
  Monitor "first"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Modes "640x480" "800x600" "640x480_120"
    Virtual 1440 600
  EndSubSection
EndSection
"""


@dataclass
class Xorg:
    """Its DISPLAY, and what xrandr does to it."""

    display: str

    @property
    def env(self) -> dict[str, str]:
        """The environment of a command that is to show on it."""
        env = {**os.environ, "DISPLAY": self.display}
        env.pop("WAYLAND_DISPLAY", None)
        return env

    def xrandr(self, *words: str) -> str:
        """What xrandr says to these words."""
        result = subprocess.run(
            ["xrandr", *words],
            env=self.env,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert result.returncode == 0, result.stderr
        if "--output" in words:
            self.xrandr()  # a query makes the driver look at its plugs
        return result.stdout

    def refresh_hz(self, output: str) -> float:
        """The rate at which an output runs, as xrandr marks it."""
        part = self.xrandr().split(f"{output} connected")[1].split("connected")[0]
        match = re.search(r"([\d.]+)\*", part)
        assert match is not None, part
        return float(match[1])

    @contextmanager
    def property(
        self, output: str, name: str, value: str | bytes | tuple[int, ...]
    ) -> Iterator[None]:
        """An output with a property, as a driver gives it: a word (an atom), bytes, or integers
        of 32 bits.
        """
        x11, xrandr = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXrandr.so.2")
        pointer, number = ctypes.c_void_p, ctypes.c_ulong
        x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = pointer, [ctypes.c_char_p]
        x11.XInternAtom.restype, x11.XInternAtom.argtypes = (
            number,
            [pointer, ctypes.c_char_p, ctypes.c_int],
        )
        x11.XSync.argtypes, x11.XCloseDisplay.argtypes = [pointer, ctypes.c_int], [pointer]
        xrandr.XRRConfigureOutputProperty.argtypes = [
            pointer,
            number,
            number,
            *[ctypes.c_int] * 3,
            pointer,
        ]
        xrandr.XRRChangeOutputProperty.argtypes = [
            pointer,
            number,
            number,
            number,
            *[ctypes.c_int] * 2,
            pointer,
            ctypes.c_int,
        ]
        xrandr.XRRDeleteOutputProperty.argtypes = [pointer, number, number]
        identifier = int(
            self.xrandr("--verbose")
            .split(f"{output} connected")[1]
            .split("Identifier:")[1]
            .split()[0],
            16,
        )
        display = x11.XOpenDisplay(self.display.encode())
        atom = x11.XInternAtom(display, name.encode(), 0)
        match value:
            case str():
                kind, form, items = (
                    XA_ATOM,
                    32,
                    (ctypes.c_long * 1)(x11.XInternAtom(display, value.encode(), 0)),
                )
            case bytes():
                kind, form, items = XA_INTEGER, 8, (ctypes.c_ubyte * len(value))(*value)
            case _:
                kind, form, items = XA_INTEGER, 32, (ctypes.c_long * len(value))(*value)
        xrandr.XRRConfigureOutputProperty(display, identifier, atom, 0, 0, 0, None)
        xrandr.XRRChangeOutputProperty(display, identifier, atom, kind, form, 0, items, len(items))
        x11.XSync(display, 0)
        try:
            yield
        finally:
            xrandr.XRRDeleteOutputProperty(display, identifier, atom)
            x11.XSync(display, 0)
            x11.XCloseDisplay(display)

    def gamma(self, output: str) -> tuple[float, ...]:
        """The exponents of an output's ramp, as xrandr reads them back from the server."""
        part = self.xrandr("--verbose").split(f"{output} connected")[1]
        match = re.search(r"Gamma:\s+([\d.]+):([\d.]+):([\d.]+)", part)
        assert match is not None
        return tuple(float(value) for value in match.groups())


@contextmanager
def xorg(folder: Path) -> Iterator[Xorg]:
    """An X server with one monitor DUMMY0 of 640 x 480 at 59.94 Hz, also 119.88, and a second,
    DUMMY1, to be switched on.
    """
    config, log = folder / "xorg.conf", folder / "xorg.log"
    config.write_text(SERVER_CONFIG)
    read, write = os.pipe()
    command = [
        "Xorg",
        "-displayfd",
        str(write),
        "-config",
        str(config),
        "-logfile",
        str(log),
        "-noreset",
        "-novtswitch",
    ]
    with (folder / "xorg.out").open("wb") as told:
        process = subprocess.Popen(
            [*command, "-nolisten", "tcp"], pass_fds=(write,), stdout=told, stderr=told
        )
    os.close(write)
    try:
        with os.fdopen(read) as number:
            name = number.readline().strip()
        assert name, log.read_text() if log.exists() else (folder / "xorg.out").read_text()
        time.sleep(0.2)
        server = Xorg(f":{name}")
        for mode in ("640x480", "800x600"):
            server.xrandr("--addmode", "DUMMY1", mode)
        yield server
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE_S)
