"""What the operator's page costs a run: missed frames and pacing with nobody looking, with two
pages open, and under siege.

`python -m tests.benchmarks.bench_console [SECONDS]` measures all three in one run under Xvfb, turn
by turn, so that whatever else the machine does falls on all of them. Xvfb stands for the display,
at real-time priority where that is allowed, and the frames are drawn by the frame loop's own thread
(LP_NUM_THREADS=0), which is at real-time priority too: other programs then hold up neither. Without
a screen's own refresh the pacing is the program's. It says the machine's load.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.server.record.ledger_records import FrameRecord, frame_records
from tests.support.benches import attitude_table, bench_text
from tests.support.pages import PageAddress, children, live, page_of
from tests.support.senders import connected, free_port, talking
from tests.support.servers import Served
from tests.support.waiting import real_time
from tests.support.x11.screens import Screen, xvfb

BENCH = bench_text({"monitor": {"resolution_px": [640, 480]}, "render": {"quantisation": "round"}})
TURN_S = 10.0
MS = 1e-6


@contextmanager
def nobody(page: PageAddress) -> Iterator[None]:
    """Nobody looks."""
    yield


@contextmanager
def two_pages(page: PageAddress) -> Iterator[None]:
    """Two pages with pictures at 8 Hz, the grid and the charts, as a browser takes them."""
    stop = threading.Event()

    def look() -> None:
        with live(page) as link, contextlib.suppress(OSError, ValueError):
            link.want(picture=True, hz=8, grid=True)
            for _ in link.messages():
                if stop.is_set():
                    return

    threads = [threading.Thread(target=look) for _ in range(2)]
    for thread in threads:
        thread.start()
    yield
    stop.set()
    for thread in threads:
        thread.join()


@contextmanager
def siege(page: PageAddress) -> Iterator[None]:
    """Two hundred connections: half idle, half that send what is no request, and come again when
    they are closed.
    """
    stop = threading.Event()

    def attack(k: int) -> None:
        while not stop.is_set():
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", page.port), timeout=1.0) as one,
            ):
                if k % 2:
                    one.sendall(b"GET / HTTP/1.1\r\nHost: evil\r\n" + b"x" * 2000)
                one.settimeout(1.0)
                one.recv(100)
            stop.wait(0.5)

    threads = [threading.Thread(target=attack, args=(k,)) for k in range(200)]
    for thread in threads:
        thread.start()
    yield
    stop.set()
    for thread in threads:
        thread.join()


KINDS = {"nobody": nobody, "two pages": two_pages, "200 connections": siege}


class Turn(NamedTuple):
    """What there was from when to when (host time, ns), and what the run and its page took of a
    core meanwhile, s.
    """

    kind: str
    begin_ns: int
    end_ns: int
    run_s: float
    page_s: float


def cpu_s(pid: int) -> float:
    """What a process has had of a core so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(screen: Screen, folder: Path, seconds: float) -> tuple[list[FrameRecord], list[Turn]]:
    """The frames of a run, and its turns."""
    port = free_port()
    (folder / "bench.toml").write_text(BENCH + attitude_table(port, "bind = true"))
    command = [
        sys.executable,
        "-m",
        "hilstar",
        "serve",
        str(folder / "bench.toml"),
        "--windowed",
        "--force",
        "--json",
    ]
    command += ["--ledger", str(folder / "run.mcap"), "--console", "127.0.0.1:0"]
    turns: list[Turn] = []
    with subprocess.Popen(
        command,
        env=screen.env | {"LP_NUM_THREADS": "0"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        served = Served(process, port)
        page = page_of(served)
        pids = (process.pid, children(process.pid, "hilstar.server.console.server")[0])
        with connected(port) as sender, talking(sender, 100.0):
            time.sleep(3.0)
            while len(turns) < len(KINDS) * max(round(seconds / TURN_S), 1):
                for name, kind in KINDS.items():
                    with kind(page):
                        time.sleep(1.0)
                        begin_ns, before = time.monotonic_ns(), [cpu_s(pid) for pid in pids]
                        time.sleep(TURN_S)
                        took = [cpu_s(pid) - then for pid, then in zip(pids, before, strict=True)]
                        turns.append(Turn(name, begin_ns, time.monotonic_ns(), *took))
        served.summary()
    return list(frame_records(folder / "run.mcap")), turns


def main() -> None:
    """Measure, and print a table."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        with real_time():
            screen = stack.enter_context(xvfb(Path(name)))
        frames, turns = measure(screen, Path(name), seconds)
    swaps_ns = np.array([frame.swap_ns for frame in frames])
    missed = np.array([frame.missed_before for frame in frames])
    print(
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.2f} at the end; turns of {TURN_S:g} s"
    )
    print(
        f"{'':18}{'frames':>8}{'missed':>8}{'SD of the interval, ms':>26}{'run, % of a core':>20}{'page, % of a core':>20}"
    )
    for kind in KINDS:
        intervals_ms, lost, count = [], 0, 0
        mine = [turn for turn in turns if turn.kind == kind]
        for turn in mine:
            within = np.flatnonzero((swaps_ns >= turn.begin_ns) & (swaps_ns < turn.end_ns))
            lost, count = lost + int(missed[within].sum()), count + len(within)
            steps = np.diff(swaps_ns[within]) * MS
            intervals_ms.append(steps[missed[within][1:] == 0])
        lasted_s = sum(turn.end_ns - turn.begin_ns for turn in mine) * 1e-9
        shares = (
            100 * sum(took) / lasted_s
            for took in ([turn.run_s for turn in mine], [turn.page_s for turn in mine])
        )
        print(
            f"{kind:18}{count:8}{lost:8}{np.concatenate(intervals_ms).std():26.3f}"
            + "".join(f"{s:20.1f}" for s in shares)
        )


if __name__ == "__main__":
    main()
