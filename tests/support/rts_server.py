"""A serial port behind a real socket (RFC 2217, by pyserial's own server), that keeps when its
line RTS went up and down.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from itertools import pairwise
from types import TracebackType
from typing import Self

import serial
import serial.rfc2217
from serial.urlhandler.protocol_loop import Serial as LoopSerial

from tests.support.waiting import PATIENCE_S


class KeptLine(LoopSerial):
    """A port whose RTS is looped to its CTS; `edges` has the host time (ns) and level of each
    change.
    """

    def __init__(self, port: str | None = "loop://") -> None:
        self.edges: list[tuple[int, bool]] = []
        super().__init__(None, timeout=0)
        self.rts = False
        if port is not None:
            self.port = port
            self.open()

    def _update_rts_state(self) -> None:
        if not self.edges or self.edges[-1][1] != bool(self._rts_state):
            self.edges.append((time.monotonic_ns(), bool(self._rts_state)))


class RtsServer:
    """One port for one client at a time at `url`; `cut` breaks the connection, and refuses
    others until `mend`.
    """

    def __init__(self) -> None:
        self.line = KeptLine()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._port = self._listener.getsockname()[1]
        self.url = f"rfc2217://127.0.0.1:{self._port}"
        self._client: socket.socket | None = None
        self._ends = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def pulses(self) -> list[tuple[int, int]]:
        """When each pulse rose and fell, ns."""
        edges = self.line.edges
        return [(up, down) for (up, level), (down, _) in pairwise(edges) if level]

    def write(self, data: bytes) -> None:
        """Send to the client; the manager calls it."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.sendall(data)

    def _serve(self) -> None:
        while not self._ends:
            try:
                client, _ = self._listener.accept()
            except OSError:  # it is closed, or cut
                time.sleep(0.01)
                continue
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client
            manager = serial.rfc2217.PortManager(self.line, self)
            with contextlib.suppress(OSError):
                while data := client.recv(1024):
                    b"".join(manager.filter(data))
            client.close()
            self._client = None

    def cut(self) -> None:
        """Break the connection, as a cable that is pulled; nobody listens any more."""
        with contextlib.suppress(OSError):  # closing alone would not wake who accepts
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.shutdown(socket.SHUT_RDWR)

    def mend(self) -> None:
        """Listen again."""
        self._listener = socket.create_server(("127.0.0.1", self._port))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ends = True
        self.cut()
        self._thread.join(PATIENCE_S)
