"""A run as a service: what systemd is told, by a socket in its place; and that a run killed is
soon back.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.benches import LIVE_BENCH, attitude_table
from tests.support.forks import HILSTAR, Started
from tests.support.pages import children, gone
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.e2e
WATCHDOG_S = 0.4
RESTART_S = 0.2  # RestartSec of the unit
BACK_S = 3.0


class Systemd:
    """The other end of NOTIFY_SOCKET, and what is started again there."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "notify"))
        self._socket.settimeout(PATIENCE_S)

    def close(self) -> None:
        self._socket.close()

    @contextmanager
    def started(self) -> Iterator[subprocess.Popen[str]]:
        own = {
            "NOTIFY_SOCKET": str(self._folder / "notify"),
            "WATCHDOG_USEC": str(round(WATCHDOG_S * 1e6)),
        }
        command = [
            *HILSTAR,
            "serve",
            str(self._folder / "bench.toml"),
            "--headless",
            "--console",
            "127.0.0.1:0",
        ]
        with Started(
            command, env=os.environ | own, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        ) as process:
            try:
                yield process
            finally:
                pages = children(process.pid, "hilstar.server.console.server")
                process.kill()
                wait_for(lambda: all(gone(pid) for pid in pages))

    def told(self, word: str) -> str:
        """The next datagram with that word."""
        while True:
            text = self._socket.recv(4096).decode()
            if word in text.splitlines():
                return text

    def silent_for(self, seconds: float) -> bool:
        """Whether nothing comes for so long, once what had come before is read."""
        self._socket.settimeout(0.0)
        with contextlib.suppress(BlockingIOError):
            while self._socket.recv(4096):
                pass
        self._socket.settimeout(seconds)
        try:
            return not self._socket.recv(4096)
        except TimeoutError:
            return True
        finally:
            self._socket.settimeout(PATIENCE_S)


@pytest.fixture
def systemd(tmp_path):
    (tmp_path / "bench.toml").write_text(LIVE_BENCH + attitude_table(free_port(), "bind = true"))
    found = Systemd(tmp_path)
    yield found
    found.close()


def process_cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_run_is_ready_with_its_first_frame_and_alive_while_frames_go_on(systemd):
    with systemd.started() as process:
        assert "STATUS=attitude none yet" in systemd.told("READY=1")
        for _ in range(2):
            assert "frames" in systemd.told("WATCHDOG=1")
        process.send_signal(signal.SIGSTOP)
        assert systemd.silent_for(2 * WATCHDOG_S)  # systemd would kill it now
        process.send_signal(signal.SIGCONT)
        systemd.told("WATCHDOG=1")
        process.send_signal(signal.SIGTERM)
        systemd.told("STOPPING=1")
        wait_for(lambda: process.poll() is not None)


@pytest.mark.timing
def test_killed_and_started_again_it_shows_frames_within_three_seconds(systemd):
    """In time of a free core: on a busy machine everything takes longer. docs/console.md
    has what the clock says.
    """
    with systemd.started() as process:
        systemd.told("READY=1")
        process.send_signal(signal.SIGKILL)
    time.sleep(RESTART_S)
    with systemd.started() as process:
        systemd.told("READY=1")
        back_s = process_cpu_s(process.pid) + RESTART_S
    assert back_s < BACK_S
