"""Serial lines without hardware: a pty, and two of them that are joined, so that both ends open a
device.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.support.waiting import real_time


@contextlib.contextmanager
def serial_line() -> Iterator[tuple[int, str]]:
    """A line that stands for a device's: the device's end (a descriptor), and the name of the
    port.
    """
    device, port = os.openpty()
    tty.setraw(port)
    try:
        yield device, os.ttyname(port)
    finally:
        os.close(device)
        os.close(port)


class Cable:
    """`sender` and `host` are paths to open; `pull` takes the line away, `plug` brings it back
    under the same paths.
    """

    def __init__(self, folder: Path) -> None:
        self.sender, self.host = folder / "ttySender", folder / "ttyHost"
        self._masters: list[int] = []
        self._slaves: list[int] = []
        self.plug()

    def plug(self) -> None:
        """Two new ptys, and a thread that carries bytes between them."""
        pairs = [os.openpty() for _ in range(2)]
        self._masters = [master for master, _ in pairs]
        self._slaves = [slave for _, slave in pairs]
        for (_, slave), path in zip(pairs, (self.sender, self.host), strict=True):
            tty.setraw(slave)
            path.unlink(missing_ok=True)
            path.symlink_to(os.ttyname(slave))
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._relay, args=(*self._masters, self._stop), daemon=True
        )
        self._thread.start()

    @staticmethod
    def _relay(a: int, b: int, stop: threading.Event) -> None:
        with real_time():
            while not stop.is_set():
                for ready in select.select([a, b], [], [], 0.02)[0]:
                    with contextlib.suppress(OSError):
                        os.write(b if ready == a else a, os.read(ready, 4096))

    def pull(self) -> None:
        """Both devices vanish: whoever has one open gets an error."""
        self._stop.set()
        self._thread.join()
        for path in (self.sender, self.host):
            path.unlink(missing_ok=True)
        for fd in (*self._masters, *self._slaves):
            os.close(fd)
        self._masters, self._slaves = [], []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._masters:
            self.pull()
