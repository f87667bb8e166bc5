"""A photodiode: a watcher of the X server's real frame buffer that tells of edges on a serial
line.
"""

from __future__ import annotations

import mmap
import os
import threading
import time
from pathlib import Path
from typing import Self

import numpy as np

from tests.support.waiting import real_time
from tests.support.x11.screens import Screen


class Diode:
    """Watches the screen's bottom left pixel and tells of its edges on a serial line, `added_ms`
    late.
    """

    def __init__(
        self, screen: Screen, line: Path, added_ms: float = 0.0, device_clock: bool = False
    ) -> None:
        self._file, self._line, self._added_s, self._device = (
            screen.file,
            line,
            added_ms / 1e3,
            device_clock,
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        with real_time():
            self._watch()

    def _watch(self) -> None:
        with (
            self._file.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as frame,
        ):
            head = np.frombuffer(frame[:100], ">u4")
            begin, height, row_bytes, colours = (int(head[k]) for k in (0, 5, 12, 19))
            place = begin + 12 * colours + (height - 4) * row_bytes + 4 * 4
            out = os.open(self._line, os.O_WRONLY | os.O_NOCTTY)
            level, started_s = frame[place] > 127, time.monotonic()
            while not self._stop.is_set():
                if (frame[place] > 127) != level:
                    seen_s = time.monotonic()
                    level = not level
                    stamp = (
                        f",{(seen_s - started_s + 1000 + self._added_s) * 1e6:.0f}"
                        if self._device
                        else ""
                    )
                    # the line itself is late, the stamp is not
                    time.sleep(0.001 if self._device else self._added_s)
                    os.write(out, f"{int(level)}{stamp}\n".encode())
                time.sleep(0.0001)
            os.close(out)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
