"""`hilstar serve` in a process of its own, and its summary."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.benches import LIVE_BENCH, SMALL_BENCH, attitude_table
from tests.support.commands import HILSTAR
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S, wait_for

# ZeroMQ's subscription crosses the socket: nothing tells a sender of ours that it has come, and no packet may be lost.
SUBSCRIBED_S = 0.3


@contextmanager
def listening(bench: Path, first_words: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`hilstar serve --headless --json` of a bench file, once its first line says these words."""
    command = [*HILSTAR, "serve", str(bench), "--headless", "--json", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ) as process:
        try:
            assert process.stderr is not None
            first = process.stderr.readline()
            assert first_words in first, first
            yield process
        finally:
            process.kill()


@contextmanager
def serving(tmp_path: Path, port: int, *options: str, attitude: str = "", monitor: str = "") -> Iterator[subprocess.Popen[str]]:
    """`hilstar serve` of the small bench on a port, once it hears."""
    bench = tmp_path / "serve.toml"
    text = SMALL_BENCH if "[render]" in attitude else LIVE_BENCH
    bench.write_text(text.replace("[collimator]", f"{monitor}\n[collimator]") + attitude_table(port, attitude))
    with listening(bench, f"127.0.0.1:{port}", *options) as process:
        time.sleep(SUBSCRIBED_S)
        yield process


def summary_of(process: subprocess.Popen[str], timeout: float = 30, code: int = 0) -> dict:
    """What it prints at its end, with that exit code."""
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == code, err
    return json.loads(out)


def interrupted(process: subprocess.Popen[str]) -> dict:
    """Its summary after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    return summary_of(process)


class Served:
    """`hilstar serve`, bound to a port, its stderr read as it comes."""

    def __init__(self, process: subprocess.Popen[str], port: int) -> None:
        self.process, self.port = process, port
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.lines.extend(self.process.stderr)

    def count(self, words: str) -> int:
        """How many lines so far say these words."""
        return sum(words in line for line in list(self.lines))

    def await_line(self, words: str) -> None:
        """Wait until a line says these words."""
        wait_for(lambda: self.count(words), (words, self.lines))

    def used_mb(self) -> float:
        """Its resident memory, and that of its reader."""
        pages = [int((folder / "statm").read_text().split()[1]) for folder in self._folders()]
        return sum(pages) * resource.getpagesize() / 1e6

    def files(self) -> int:
        """How many files and sockets it and its reader have open."""
        return sum(len(list((folder / "fd").iterdir())) for folder in self._folders())

    def _folders(self) -> list[Path]:
        """The process and the one that reads the link for it, as Linux shows them."""
        own = Path(f"/proc/{self.process.pid}")
        children = [
            Path(f"/proc/{each}") for task in (own / "task").iterdir() for each in (task / "children").read_text().split()
        ]
        return [own, *(each for each in children if b"attitude.wire.apart" in (each / "cmdline").read_bytes())]

    def summary(self) -> dict:
        """What it prints at its end, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.stdout is not None
        out = self.process.stdout.read()
        assert self.process.wait(PATIENCE_S) == 0, self.lines
        return json.loads(out)


@contextmanager
def bound(tmp_path: Path, *options: str, attitude: str = "bind = true", files: int | None = None) -> Iterator[Served]:
    """`hilstar serve` that binds, once its port answers; it may open so many `files`."""
    port = free_port()
    bench = tmp_path / "serve.toml"
    bench.write_text(LIVE_BENCH + attitude_table(port, attitude))
    command = [*HILSTAR, "serve", str(bench), "--headless", "--json", *options]
    if files is not None:
        command = ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", *command]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        served = Served(process, port)
        try:
            served.await_line("bound to")
            wait_for(lambda: _can_connect(port), "the port")
            yield served
        finally:
            process.kill()


def _can_connect(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False
