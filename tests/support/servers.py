"""`hilstar serve` in a process of its own, and its summary."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.benches import LIVE_BENCH, SMALL_BENCH, TWIN, attitude_table, bench_text
from tests.support.forks import HILSTAR, Started
from tests.support.senders import await_subscriber_of, free_port
from tests.support.waiting import PATIENCE_S, wait_for

STATUS_EACH_S = 0.05
STATUS = re.compile(r"(\d+) frames, \d+ missed; (\d+) packets, (\d+) refused")


class Run(Started):
    """A command that shows frames, and what it says of itself to whoever runs it as a service
    (sd_notify).
    """

    def __init__(self, command: list[str]) -> None:
        self._told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._told.bind("")  # a name that the kernel chooses
        self._told.setblocking(False)
        address = "@" + self._told.getsockname()[1:].decode()
        own = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(2 * STATUS_EACH_S * 1e6))}
        self._counts = (0, 0, 0)
        super().__init__(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | own
        )

    def counts(self) -> tuple[int, int, int]:
        """How many frames it has shown so far, how many packets it has received, and how many of
        those it refused.
        """
        with contextlib.suppress(BlockingIOError):
            while told := self._told.recv(4096):
                if found := STATUS.search(told.decode()):
                    self._counts = (int(found[1]), int(found[2]), int(found[3]))
        return self._counts

    def _await(self, holds: Callable[[], object], what: str) -> None:
        wait_for(lambda: holds() or self.poll() is not None, what)
        assert holds(), (what, self.counts(), "it has ended")

    def shows(self, frames: int = 1) -> None:
        """Wait until so many frames have been shown."""
        self._await(lambda: self.counts()[0] >= frames, f"{frames} frames")

    def has_received(self, packets: int) -> None:
        """Wait until it has counted so many packets: at its end those that it has not read yet
        are lost.
        """
        self._await(lambda: self.counts()[1] >= packets, f"{packets} packets")

    def has_refused(self, packets: int) -> None:
        """Wait until it has refused so many packets."""
        self._await(lambda: self.counts()[2] >= packets, f"{packets} packets refused")

    def accepted(self) -> int:
        """How many packets it has taken for attitudes so far."""
        _, received, refused = self.counts()
        return received - refused

    def has_accepted(self, packets: int) -> None:
        """Wait until it has taken so many packets for attitudes."""
        self._await(lambda: self.accepted() >= packets, f"{packets} packets accepted")

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        self._told.close()


@contextmanager
def listening(bench: Path, first_words: str, *options: str) -> Iterator[Run]:
    """`hilstar serve --headless --json` of a bench file, once its first line says these words."""
    with Run([*HILSTAR, "serve", str(bench), "--headless", "--json", *options]) as process:
        try:
            assert process.stderr is not None
            first = process.stderr.readline()
            # a sender that is there already may be met before
            while first and first_words not in first:
                first = process.stderr.readline()
            assert first_words in first, first
            yield process
        finally:
            process.kill()


@contextmanager
def serving(
    tmp_path: Path, port: int, *options: str, attitude: str = "", monitor: str = ""
) -> Iterator[Run]:
    """`hilstar serve` of the small bench on a port, once it has subscribed to the publisher
    there, if there is one.
    """
    bench = tmp_path / "serve.toml"
    text = SMALL_BENCH if "[render]" in attitude else LIVE_BENCH
    bench.write_text(
        text.replace("[collimator]", f"{monitor}\n[collimator]") + attitude_table(port, attitude)
    )
    with listening(bench, f"127.0.0.1:{port}", *options) as process:
        await_subscriber_of(port)
        yield process


def children_of(process: int) -> list[int]:
    """The processes that a process's main thread has started, and that run."""
    return list(map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split()))


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """The workers of a command's pool, which a fork server of its own starts."""
    servers = (
        child
        for child in children_of(process.pid)
        if b"forkserver" in Path(f"/proc/{child}/cmdline").read_bytes()
    )
    return [worker for server in servers for worker in children_of(server)]


def summary_of(process: subprocess.Popen[str], timeout: float = PATIENCE_S, code: int = 0) -> dict:
    """What it prints at its end, with that exit code."""
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == code, err
    return json.loads(out)


def interrupted(process: subprocess.Popen[str]) -> dict:
    """Its summary after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    return summary_of(process)


def until_said(process: subprocess.Popen[str], words: str) -> None:
    """Read its stderr until a line says these words."""
    assert process.stderr is not None
    while words not in (line := process.stderr.readline()):
        assert line, f"it ended without {words!r}"


class Served:
    """`hilstar serve`, bound to a port, its stderr read as it comes."""

    def __init__(self, process: Run, port: int) -> None:
        self.process, self.port = process, port
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        # A test that has killed the run closes the pipe, perhaps between two lines.
        with contextlib.suppress(ValueError):
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
            Path(f"/proc/{each}")
            for task in (own / "task").iterdir()
            for each in (task / "children").read_text().split()
        ]
        return [
            own,
            *(
                each
                for each in children
                if b"attitude.wire.apart" in (each / "cmdline").read_bytes()
            ),
        ]

    def summary(self) -> dict:
        """What it prints at its end, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.stdout is not None
        out = self.process.stdout.read()
        assert self.process.wait(PATIENCE_S) == 0, self.lines
        return json.loads(out)


@contextmanager
def bound(
    tmp_path: Path,
    *options: str,
    attitude: str = "bind = true",
    files: int | None = None,
    text: str = LIVE_BENCH,
) -> Iterator[Served]:
    """`hilstar serve` of a bench file's `text` that binds, once its port answers; it may open so
    many `files`.
    """
    port = free_port()
    bench = tmp_path / "serve.toml"
    bench.write_text(text + attitude_table(port, attitude))
    command = [*HILSTAR, "serve", str(bench), "--headless", "--json", *options]
    if files is not None:
        command = ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", *command]
    with Run(command) as process:
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


@contextmanager
def sending_replay(folder: Path, log: Path) -> Iterator[tuple[Path, str]]:
    """A replay of a log that sends its frames: its bench file, the twin's, and its endpoint."""
    bench, endpoint = folder / "bench.toml", f"tcp://127.0.0.1:{free_port()}"
    bench.write_text(bench_text(TWIN, {"render": {"quantisation": "round"}}))
    command = [*HILSTAR, "replay", str(bench), str(log), "--headless", "--feed", endpoint]
    with Started(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        yield bench, endpoint
        process.terminate()
        process.wait(PATIENCE_S)
