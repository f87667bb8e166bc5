"""When packets are stamped while a display draws: python -m tests.benchmarks.bench_arrivals
[SECONDS] [zmq] [serial] [udp].

One-way latency (the sender's CLOCK_MONOTONIC in the packet to hilstar's stamp, one machine, one
clock) of 100 packets a second from a process of its own, for ZeroMQ, a serial line (a pty) and UDP,
while 1000 stars are drawn 60 times a second: with the link read by a thread of the process that
draws, and by a process of its own as `serve` has it, in turns; each beside a bare loop that
receives the same packets and does nothing else. Then the same beside a busy process on each core.
`--unprivileged` takes the right to real-time priority (CAP_SYS_NICE) from the process that serves,
not from the sender.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.basics.process.scheduling import PromptWhileLight
from hilstar.server.bench.build import load
from hilstar.server.loop import Limit
from hilstar.server.open_link import open_link
from hilstar.server.record.ledger import LedgerSwitch
from hilstar.server.serve import Outlet, serve
from tests.support.benches import ROOT

RATE_HZ = 100
T_NS = struct.Struct("<q")
T_AT = 8  # where t_ns stands in the packet
CRC = struct.Struct("<I")
WARM_UP_S = 1.5
ROUNDS = 2
ROADS = ("zmq", "serial", "udp")
SENDER_PRIORITY = 30
NO_RIGHT = ("setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice", "--")


def bench_text(attitude: str) -> str:
    """The demo's bench with 1000 stars: a wider collimator, and every star of the catalogue."""
    text = (ROOT / "configs" / "demo.toml").read_text()
    before, _, after = text.partition("[attitude]")
    text = before + "[render]" + after.partition("[render]")[2]
    text = text.replace("focal_length_mm = 350", "focal_length_mm = 250").replace(
        "faintest_v_mag = 7.5", "faintest_v_mag = 14"
    )
    return f'{text}\n[attitude]\nclock = "shared"\n{attitude}\n'


class Packets:
    """Packets whose t_ns is put in last, at a microsecond's cost; a slow turn about the
    boresight.
    """

    def __init__(self) -> None:
        self._number = 0

    def next(self) -> tuple[bytes, bytes]:
        angle = 1e-5 * self._number
        q = np.array([0.5, 0.5, -0.5, 0.5]) + angle * np.array([0.5, -0.5, 0.5, 0.5])
        body = encode(AttitudeSample(0, q / np.linalg.norm(q), None, self._number))
        self._number += 1
        return body[:T_AT], body[T_AT + T_NS.size : -CRC.size]


def stamped(head: bytes, rest: bytes) -> bytes:
    whole = head + T_NS.pack(time.monotonic_ns()) + rest
    return whole + CRC.pack(zlib.crc32(whole))


def framed(packet: bytes) -> bytes:
    from cobs import cobs

    return bytes(cobs.encode(packet)) + b"\0"


def send(road: str, seconds: float) -> None:
    """Open both roads, say where they are, wait for a line, send."""
    with ExitStack() as stack:
        puts, told = _opened(road, stack)
        print(json.dumps(told), flush=True)
        where = json.loads(sys.stdin.readline())
        _priority()
        packets, due_s = Packets(), time.monotonic()
        for k in range(round(seconds * RATE_HZ)):
            head, rest = packets.next()
            due_s += 1 / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            # the second is quicker: the first has woken the kernel for it
            for put in puts if k % 2 else reversed(puts):
                put(stamped(head, rest), where)
        sys.stdin.read()  # the roads stay open while there is somebody to read them


def _opened(
    road: str, stack: ExitStack
) -> tuple[list[Callable[[bytes, Any], object]], dict[str, str]]:
    if road == "zmq":
        publisher = stack.enter_context(stack.enter_context(zmq.Context()).socket(zmq.PUB))
        port = publisher.bind_to_random_port("tcp://127.0.0.1")
        endpoint = f"tcp://127.0.0.1:{port}"
        return [lambda data, _: publisher.send(data)], {
            "attitude": f'endpoint = "{endpoint}"',
            "floor": endpoint,
        }
    if road == "udp":
        made = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        puts = [
            lambda data, where, k=k: made.sendto(data, ("127.0.0.1", where[k])) for k in range(2)
        ]
        return puts, {"attitude": 'source = "udp"\nbind = "127.0.0.1:0"', "floor": "udp"}
    (host, slave), (floor, floor_slave) = os.openpty(), os.openpty()
    for each in (slave, floor_slave):
        tty.setraw(each)
    line = f'source = "serial"\nport = "{os.ttyname(slave)}"\nbaud = 921600'
    put = [lambda data, _, file=file: os.write(file, framed(data)) for file in (host, floor)]
    return put, {"attitude": line, "floor": os.ttyname(floor_slave)}


def _priority() -> None:
    """The sender stands for another machine: it must not wait for this one's cores."""
    for thread in Path("/proc/self/task").iterdir():
        try:
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(SENDER_PRIORITY))
        except OSError:
            return


def floor(road: str, where: str) -> None:
    """A bare loop: stamps what comes, until a second without any; prints the latencies, ns."""
    PromptWhileLight()
    found: list[int] = []
    if road == "zmq":
        with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
            subscriber.subscribe(b"")
            subscriber.connect(where)
            print(0, flush=True)
            _loop(lambda ms: bool(subscriber.poll(ms)), subscriber.recv, found)
    elif road == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
            made.bind(("127.0.0.1", 0))
            print(made.getsockname()[1], flush=True)
            _loop(
                lambda ms: bool(select.select([made], [], [], ms / 1000)[0]),
                lambda: made.recv(100),
                found,
            )
    else:
        from cobs import cobs

        file = os.open(where, os.O_RDWR | os.O_NOCTTY)
        print(0, flush=True)

        def whole() -> bytes:
            data = b""
            while not data.endswith(b"\0"):
                select.select([file], [], [])
                data += os.read(file, 100)
            return data.split(b"\0")[-2]

        _loop(
            lambda ms: bool(select.select([file], [], [], ms / 1000)[0]), whole, found, cobs.decode
        )
    print(json.dumps(found), flush=True)


def _loop(
    ready: Callable[[int], bool],
    get: Callable[[], bytes],
    found: list[int],
    meaning: Callable[[bytes], bytes] = bytes,
) -> None:
    patience_ms = 60_000
    while ready(patience_ms):
        data = get()
        host_ns = time.monotonic_ns()
        found.append(host_ns - T_NS.unpack_from(meaning(data), T_AT)[0])
        patience_ms = 1000


class Noting(LedgerSwitch):
    """Notes how late each packet was stamped; no ledger."""

    def __init__(self) -> None:
        super().__init__()
        self.late_ns: list[int] = []

    def packet(
        self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: object
    ) -> None:
        if sample is not None and refusal is None:
            self.late_ns.append(host_ns - sample.t_ns)


def show(bench_file: str, way: str, seconds: float) -> None:
    """Draw for so long; print where packets are awaited, then the latencies and what the frames
    did.
    """
    with (
        load(bench_file) as bench,
        open_link(bench.config, Path(bench_file).parent, apart=way == "process") as link,
    ):
        print(link.endpoint, flush=True)
        noting = Noting()
        summary = serve(
            bench,
            link,
            Limit(slots=round(seconds * bench.config.monitor.refresh_hz)),
            outlet=Outlet(ledger=noting),
        )
    told = {"fps": summary.fps, "missed": summary.missed_frames, "stars": summary.stars_drawn.mean}
    print(json.dumps(told | {"late_ns": noting.late_ns}), flush=True)


@contextmanager
def process(*arguments: str, before: tuple[str, ...] = ()) -> Iterator[subprocess.Popen[str]]:
    command = [*before, sys.executable, "-m", "tests.benchmarks.bench_arrivals", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as made:
        try:
            yield made
        finally:
            made.kill()


def run(
    road: str, way: str, seconds: float, before: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Latencies of hilstar and of the bare loop, ms, and what the frames did."""
    with (
        tempfile.TemporaryDirectory() as folder,
        process("send", road, str(seconds + WARM_UP_S)) as sender,
    ):
        told = json.loads(sender.stdout.readline())
        file = Path(folder) / "bench.toml"
        file.write_text(bench_text(told["attitude"]))
        with (
            process("floor", road, told["floor"]) as bare,
            process("show", str(file), way, str(seconds + 2 * WARM_UP_S), before=before) as shown,
        ):
            where = [
                (
                    int(shown.stdout.readline().strip().rpartition(":")[2].partition("@")[0] or 0)
                    if road == "udp"
                    else 0
                )
            ]
            if road != "udp":
                shown.stdout.readline()
            where.append(int(bare.stdout.readline()))
            time.sleep(WARM_UP_S)
            sender.stdin.write(json.dumps(where) + "\n")
            sender.stdin.flush()
            summary = json.loads(shown.stdout.readline())
            from_bare = json.loads(bare.stdout.readline())
    skipped = round(WARM_UP_S * RATE_HZ)
    return (
        np.array(summary.pop("late_ns")[skipped:]) / 1e6,
        np.array(from_bare[skipped:]) / 1e6,
        summary,
    )


def percentiles(found_ms: list[np.ndarray]) -> str:
    whole = np.concatenate(found_ms)
    p50, p99, most = np.percentile(whole, [50, 99, 100])
    return f"{p50:.3f} / {p99:.3f} / {most:.3f} ({len(whole)})"


def table(seconds: float, busy: int, roads: tuple[str, ...], before: tuple[str, ...]) -> None:
    print(f"\n{busy} busy processes on {os.cpu_count()} cores; ms, p50 / p99 / max (packets)")
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    try:
        for road in roads:
            found: dict[str, list[np.ndarray]] = {"thread": [], "process": [], "bare": []}
            frames = []
            for _ in range(ROUNDS):
                for way in ("process",) if road == "udp" else ("thread", "process"):
                    late_ms, bare_ms, told = run(road, way, seconds / ROUNDS, before)
                    found[way].append(late_ms)
                    found["bare"].append(bare_ms)
                    frames.append(told)
            names = {
                "thread": "read by a thread",
                "process": "stamped by the kernel" if road == "udp" else "apart",
                "bare": "bare",
            }
            for way, latencies in found.items():
                if latencies:
                    print(f"{road:7} {names[way]:22} {percentiles(latencies)}")
            fps, stars = (
                np.mean([each["fps"] for each in frames]),
                np.mean([each["stars"] for each in frames]),
            )
            print(f"{'':7} {stars:.0f} stars, {fps:.1f} frames a second", flush=True)
    finally:
        for each in spinning:
            each.kill()
            each.wait()


def main() -> None:
    role, *rest = sys.argv[1:] or ["30"]
    if role == "send":
        send(rest[0], float(rest[1]))
    elif role == "floor":
        floor(*rest)
    elif role == "show":
        show(rest[0], rest[1], float(rest[2]))
    else:
        seconds = float(next((each for each in sys.argv[1:] if each.isdecimal()), 30))
        before = NO_RIGHT if "--unprivileged" in sys.argv else ()
        roads = tuple(road for road in ROADS if road in sys.argv) or ROADS
        for busy in (0, os.cpu_count() or 1):
            table(seconds, busy, roads, before)


if __name__ == "__main__":
    assert threading.active_count() == 1
    main()
