"""Xvfb, whose screen is read back from its own frame buffer, and a run of hilstar in a window on
it.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hilstar.server.record.ledger_records import FrameRecord, frame_records
from tests.support.benches import ATTITUDE
from tests.support.commands import run_hilstar_here
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S

SCREEN = "640x480x24"


@dataclass
class Screen:
    """An X server: its process, what to put into DISPLAY, and the file of its screen (X window
    dump).
    """

    process: subprocess.Popen[bytes]
    display: str
    file: Path

    @property
    def env(self) -> dict[str, str]:
        """The environment of a command that is to show on it."""
        env = {**os.environ, "DISPLAY": self.display}
        env.pop("WAYLAND_DISPLAY", None)
        return env

    def pixels(self) -> np.ndarray:
        """What is on the screen: (height, width, 3) uint8."""
        data = self.file.read_bytes()
        head = np.frombuffer(data[:100], ">u4")
        begin, width, height, row_bytes, colours = (int(head[k]) for k in (0, 4, 5, 12, 19))
        pixels = np.frombuffer(
            data, np.uint8, count=row_bytes * height, offset=begin + 12 * colours
        )
        return pixels.reshape(height, row_bytes // 4, 4)[:, :width, 2::-1]


@contextmanager
def xvfb(folder: Path, screen: str = SCREEN) -> Iterator[Screen]:
    """An X server whose screen is in a file of `folder`, on the first display number that is
    free.
    """
    read, write = os.pipe()
    command = [
        "Xvfb",
        "-displayfd",
        str(write),
        "-screen",
        "0",
        screen,
        "-fbdir",
        str(folder),
        "-nolisten",
        "tcp",
        "-noreset",
    ]
    with (folder / "server.log").open("wb") as told:
        process = subprocess.Popen(command, pass_fds=(write,), stdout=told, stderr=told)
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()  # the server dies if its newline finds nobody
        file = folder / "Xvfb_screen0"
        deadline_s = time.monotonic() + PATIENCE_S
        while not (number and file.exists()):
            assert process.poll() is None and time.monotonic() < deadline_s, "no X server comes up"
            time.sleep(0.02)
        yield Screen(process, f":{number}", file)
    finally:
        process.kill()
        process.wait()


class Shown:
    """`hilstar replay` of one attitude in a window, until it is stopped."""

    def __init__(self, screen: Screen, bench_file: Path, *options: str) -> None:
        command = [
            *HILSTAR,
            "replay",
            str(bench_file),
            str(bench_file.parent / "still.csv"),
            "--json",
            *options,
        ]
        self._process = Started(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=screen.env
        )
        self._screen = screen

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def wait_for(self, wanted: np.ndarray) -> np.ndarray:
        """The screen, once it shows what is wanted; as it is when that takes too long. An
        AssertionError with what the run said where it has ended.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            pixels = self._screen.pixels()
            if pixels.shape == wanted.shape and (pixels == wanted).all():
                return pixels
            code = self._process.poll()
            assert code is None, (
                f"the run ended with {code}, {difference(pixels, wanted)}:"
                f" {self._process.communicate()[1]}"
            )
            time.sleep(0.05)
        return self._screen.pixels()

    def stop(self) -> dict:
        """End it in order; its summary."""
        self._process.send_signal(signal.SIGTERM)
        return self.ended()

    def ended(self) -> dict:
        """Its summary, once it has ended in order."""
        out, err = self._process.communicate(timeout=PATIENCE_S)
        assert self._process.returncode == 0, err
        return json.loads(out)


def difference(pixels: np.ndarray, wanted: np.ndarray) -> str:
    """Where and by how much a screen is not what was wanted of it."""
    if pixels.shape != wanted.shape:
        return f"the screen {pixels.shape}, not {wanted.shape}"
    rows, columns = np.nonzero((pixels != wanted).any(axis=2))
    if not len(rows):
        return "as wanted at last"
    shown, asked = pixels[rows[0], columns[0]], wanted[rows[0], columns[0]]
    return (
        f"{len(rows)} pixels other in rows {rows.min()} to {rows.max()}, columns {columns.min()} to"
        f" {columns.max()}, the first {shown} for {asked}"
    )


def recorded(ledger: Path) -> list[FrameRecord]:
    """The frames of a ledger that may be growing, or not yet begun."""
    return list(frame_records(ledger)) if ledger.exists() and ledger.stat().st_size else []


def codes_of(bench_file: Path) -> np.ndarray:
    """The code values of the attitude, by another command and without a window; (height, width,
    3).
    """
    path = bench_file.parent / "codes.png"
    assert (
        run_hilstar_here("frame", bench_file, "--quaternion", ATTITUDE, "--codes", path).returncode
        == 0
    )
    with Image.open(path) as picture:
        codes = np.array(picture)
    return codes if codes.ndim == 3 else np.repeat(codes[:, :, None], 3, axis=2)


def lines_over(codes: np.ndarray, keys: str) -> np.ndarray:
    """The codes with a grid of 100 px about the boresight, and the crosshair through it, of
    code 96.
    """
    rows, columns = np.mgrid[0 : codes.shape[0], 0 : codes.shape[1]]
    # The middle of 640 x 480 is at 319.5, 239.5; the screen has its lines at whole pixels, half
    # rounded to even.
    dx, dy = columns - 320, rows - 240
    wanted = codes.copy()
    if "g" in keys:
        wanted[(dx % 100 == 0) | (dy % 100 == 0)] = np.maximum(
            96, wanted[(dx % 100 == 0) | (dy % 100 == 0)]
        )
    if "c" in keys:
        wanted[(dx == 0) | (dy == 0)] = np.maximum(96, wanted[(dx == 0) | (dy == 0)])
    return wanted
