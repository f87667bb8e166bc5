"""Several heads beside one source: what arrives goes to a process for each head, which is restarted
where it ends early.

A head reports as a systemd service does (sd_notify): ready once it draws, then a sign of life each
second while frames go on.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec
from msgspec.structs import replace

from hilstar.attitude.receiver import BackChannel, Traffic
from hilstar.attitude.wire.links import Arrival, StreamLink
from hilstar.attitude.wire.packet import Event, TimeRequest
from hilstar.attitude.wire.zmq_links import Feed
from hilstar.basics.errors import InputError
from hilstar.basics.files import temporary_folder
from hilstar.basics.process.interrupts import stop_on_signal
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff
from hilstar.basics.reading import NOT_JSON
from hilstar.basics.units import NS_PER_S
from hilstar.server.bench.bench_file import HeadsFile
from hilstar.server.bench.config import BenchConfig

STALLED_S = 3.0  # without a sign of life; it sends one each second
STARTS_S = 60.0  # a head that has not begun by then is started again
MIN_BACK_OFF_S, MAX_BACK_OFF_S = 0.2, 5.0
STEADY_S = 50.0  # a head that ran for longer was well before it ended
US_PER_S = 1_000_000
MAX_LINE = 2000
MAX_OUTPUT = 10_000_000  # bytes of a head's own summary
NOTHING: Mapping[str, str] = {}
Command = Callable[[int, float], Sequence[str]]
Say = Callable[[str], None]
POLL_MS = 10
TEND_NS = NS_PER_S // 20
MIN_DURATION_S = 0.05  # for a head that is restarted at the end
ENDS_S = 5.0  # what a head may take to end in order
MAX_FOLDER_BYTES = 95  # a socket's path has 107 bytes, of which its name takes 12
SOCKET = "body"
BODY = (1.0, 0.0, 0.0, 0.0)


class HeadProcess:
    """A head's process, restarted whenever it ends early or gives no sign of life.

    `command(number, drawn_s)` is the command of its start `number`, `drawn_s` after it first drew
    (0 where it never did). It sends its signs of life to the socket `life`.
    """

    def __init__(
        self,
        name: str,
        command: Command,
        say: Say,
        life: Path,
        secrets: Mapping[str, str] = NOTHING,
    ) -> None:
        self.name = name
        self.restarts = 0
        self.code: int | None = None  # None before its end
        self.output = b""  # what it wrote to stdout, the last time
        # not on a command line, which all users see
        self._command = command
        self._say = say
        self._secrets = secrets
        self._address = str(life)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.bind(self._address)
        self._socket.setblocking(False)
        self._again = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, HOST_CLOCK)
        self._process: subprocess.Popen[bytes] | None = None
        self._readers: list[threading.Thread] = []
        self._ready = False
        self._first_ready_s = 0.0
        self._begin()

    def _begin(self) -> None:
        environment = {name: value for name, value in os.environ.items() if name != "WATCHDOG_PID"}
        environment |= {
            **self._secrets,
            "NOTIFY_SOCKET": self._address,
            "WATCHDOG_USEC": str(int(STALLED_S * US_PER_S)),
        }
        self._drain()  # what the last one still said
        self._ready = False
        self._begun_s = time.monotonic()
        self._heard_s = self._begun_s
        self._process = subprocess.Popen(
            list(self._command(self.restarts, self.drawn_s)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # a Ctrl-C is this process's to pass on
        )
        self._readers = [
            threading.Thread(target=self._pass_on, args=(self._process.stderr,), daemon=True),
            threading.Thread(target=self._keep, args=(self._process.stdout,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _pass_on(self, stream: IO[bytes]) -> None:
        with stream:
            for line in iter(lambda: stream.readline(MAX_LINE), b""):
                self._say(f"{self.name}: {line.decode(errors='replace').rstrip()}")

    def _keep(self, stream: IO[bytes]) -> None:
        with stream:
            self.output = stream.read(MAX_OUTPUT)
            # further output is discarded, so that the head does not block on it
            while stream.read(MAX_LINE):
                pass

    def _drain(self) -> bool:
        heard = False
        with contextlib.suppress(BlockingIOError):
            while True:
                line_bytes = self._socket.recv(4096)
                heard = True
                if b"READY=1" in line_bytes:
                    self._ready = True
                    self._first_ready_s = self._first_ready_s or time.monotonic()
        return heard

    @property
    def drawn_s(self) -> float:
        """How long ago it drew its first frame, 0 where it never did."""
        if self._first_ready_s:
            return time.monotonic() - self._first_ready_s
        return 0.0

    def tend(self) -> bool:
        """Begin it again where it ended in error or stalled; whether it still has something to
        do. Never waits.
        """
        if self.code is not None:
            return False
        now_s = time.monotonic()
        if self._process is None:
            if self._again.over:
                self.restarts += 1
                self._begin()
            return True
        code = self._process.poll()
        # after the look at its end: what it said until then is heard
        if self._drain():
            self._heard_s = now_s
        if code is not None:
            return self._ended(code, now_s)
        limit_s = STALLED_S if self._ready else STARTS_S
        if now_s - self._heard_s > limit_s:
            self._say(
                f"{self.name}: no frame for {now_s - self._heard_s:.1f} s; it is started again"
            )
            self._kill()
            self._wait_to_begin(now_s)
        return True

    def _ended(self, code: int, now_s: float) -> bool:
        for reader in self._readers:
            reader.join(1.0)
        # A head ended by a signal or an unforeseen error is restarted; one that exits with 0 to 4
        # has finished.
        if 0 <= code <= 4 and (self._ready or code != 0):
            self.code = code
            return False
        if code < 0:
            how = f"signal {-code}"
        else:
            how = f"exit code {code}"
        self._say(f"{self.name}: its process ended ({how}); it is started again")
        self._wait_to_begin(now_s)
        return True

    def _wait_to_begin(self, now_s: float) -> None:
        self._process = None
        self._again.put_off(anew=now_s - self._begun_s > STEADY_S)

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def interrupt(self) -> None:
        """Ask it to end in order; a head that waits for its restart is done."""
        if self._process is None:
            self.code = 0 if self.code is None else self.code
        elif self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def close(self, patience_s: float) -> None:
        """Wait for its end for at most `patience_s`, then kill it."""
        if self._process is not None:
            try:
                self.code = self._process.wait(patience_s)
            except subprocess.TimeoutExpired:
                self._kill()
                self.code = -signal.SIGKILL
            for reader in self._readers:
                reader.join(1.0)
        self._socket.close()


@dataclass(frozen=True, slots=True)
class HeadsRun:
    """What a run of heads is asked for: `options` go to each head's `serve`, with its own ledger
    beside `ledger`.

    `consoles` are the addresses of their pages, if any, which a browser is let into by `token`.
    """

    heads: HeadsFile
    options: tuple[str, ...]
    duration_s: float | None
    ledger: Path | None
    consoles: tuple[str, ...] = ()
    token: str | None = None


def source_config(heads: HeadsFile) -> BenchConfig:
    """The configuration that the common source is opened with: it gives the body's attitude."""
    config = heads.files[0].config
    return replace(config, tracker=replace(config.tracker, q_body_to_cam=BODY))


def head_ledger(ledger: Path, name: str, number: int = 0) -> Path:
    """A head's ledger: RUN.NAME.mcap, and RUN.NAME.again1.mcap where it was restarted."""
    again = f".again{number}" if number else ""
    return ledger.with_name(f"{ledger.stem}.{name}{again}{ledger.suffix}")


def run_heads(asked: HeadsRun, link: StreamLink, say: Say) -> dict[str, Any]:
    """Show each head until its end, or until a signal; what each one said of itself (--json), by
    its name. Raises InputError where the temporary folder is too deep for a socket.
    """
    stop = threading.Event()
    with temporary_folder("heads") as folder, stop_on_signal(stop):
        if len(os.fsencode(folder)) > MAX_FOLDER_BYTES:
            raise InputError(
                f"TMPDIR {folder.parent}: too deep for the heads' sockets; set TMPDIR to a folder"
                " whose path is shorter"
            )
        endpoint = f"ipc://{folder}/{SOCKET}"
        with Feed(endpoint) as feed:
            processes = []
            for k in range(len(asked.heads.names)):
                processes.append(_head(asked, k, endpoint, folder, say))
            try:
                _hand_on(link, feed.give, processes, stop)
                for process in processes:
                    process.interrupt()
            finally:
                for process in processes:
                    process.close(ENDS_S)
    ended = {}
    for process in processes:
        ended[process.name] = {
            "exit_code": process.code,
            "restarts": process.restarts,
            "summary": summary_of(process.output),
        }
    return ended


def _head(asked: HeadsRun, k: int, endpoint: str, folder: Path, say: Say) -> HeadProcess:
    name = asked.heads.names[k]

    def command(number: int, drawn_s: float) -> list[str]:
        return head_command(asked, k, endpoint, number, drawn_s)

    if asked.token is None:
        secrets = {}
    else:
        secrets = {"HILSTAR_TOKEN": asked.token}
    return HeadProcess(name, command, say, folder / f"life-{k}", secrets)


def head_command(asked: HeadsRun, k: int, endpoint: str, number: int, drawn_s: float) -> list[str]:
    """The command of head `k`'s start `number`, fed by `endpoint`, `drawn_s` after it first drew:
    a head that is started again runs for the rest of the duration, with a ledger of its own.
    """
    file = asked.heads.files[k]
    command = [sys.executable, "-m", "hilstar", "serve", str(file.path), "--json"]
    command += ["--head-of", str(asked.heads.path), "--fed-by", f"{endpoint},{os.getpid()}"]
    command += asked.options
    if asked.duration_s is not None:
        command += ["--duration", f"{max(asked.duration_s - drawn_s, MIN_DURATION_S):.6g}"]
    if asked.ledger is not None:
        command += ["--ledger", str(head_ledger(asked.ledger, asked.heads.names[k], number))]
    if asked.consoles:
        command += ["--console", asked.consoles[k]]
    return command


def _hand_on(
    link: StreamLink,
    give: Callable[[Arrival[Event]], object],
    processes: Sequence[HeadProcess],
    stop: threading.Event,
) -> None:
    """Give what arrives to the heads but for questions of the time, which are answered, and tend
    the heads, until all have ended or a signal comes.
    """
    back = BackChannel(link, Traffic())
    tended_ns = 0
    while not stop.is_set():
        for arrival in link.receive(POLL_MS):
            if isinstance(arrival.event, TimeRequest):
                if link.two_way:
                    back.answer(arrival.event, arrival)
            else:
                give(arrival)
        if time.monotonic_ns() - tended_ns > TEND_NS:
            tended_ns = time.monotonic_ns()
            busy = [process.tend() for process in processes]
            if not any(busy):
                return


def summary_of(output: bytes) -> Any:
    """The JSON that a head printed; None where that is none."""
    with contextlib.suppress(*NOT_JSON):
        if output.strip():
            return msgspec.json.decode(output)
    return None
