"""One-way latency of both roads, beside the bare ones: python -m tests.benchmarks.bench_link
[SECONDS].
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zmq

from tests.support.benches import ROOT
from tests.support.commands import run_hilstar
from tests.support.wire.ptys import Cable

RATE_HZ = 200
FAULTS = ("--lose", "10%", "--corrupt", "5%", "--reorder")


def latencies_ms(
    put: Callable[[bytes], object], get: Callable[[], bytes], seconds: float
) -> np.ndarray:
    """64 bytes that carry the time at which they left, from one thread to another."""
    count = round(seconds * RATE_HZ)
    found = []

    def listen() -> None:
        for _ in range(count):
            message = get()
            found.append((time.monotonic_ns() - int.from_bytes(message[:8], "little")) / 1e6)

    listener = threading.Thread(target=listen)
    listener.start()
    for _ in range(count):
        put(time.monotonic_ns().to_bytes(8, "little") + bytes(56))
        time.sleep(1 / RATE_HZ)
    listener.join()
    return np.array(found)


def bare_pty(seconds: float) -> np.ndarray:
    master, slave = os.openpty()
    tty.setraw(slave)
    return latencies_ms(lambda data: os.write(master, data), lambda: os.read(slave, 64), seconds)


def bare_zmq(seconds: float) -> np.ndarray:
    context = zmq.Context()
    with context.socket(zmq.PUB) as sender, context.socket(zmq.SUB) as receiver:
        port = sender.bind_to_random_port("tcp://127.0.0.1")
        receiver.subscribe(b"")
        receiver.connect(f"tcp://127.0.0.1:{port}")
        time.sleep(0.3)
        return latencies_ms(sender.send, receiver.recv, seconds)


def served(attitude: str, to: str, seconds: float, options: tuple[str, ...]) -> tuple[dict, dict]:
    """What `send` and `serve` say after so many seconds of a spin."""
    with tempfile.TemporaryDirectory() as folder:
        bench = Path(folder) / "bench.toml"
        bench.write_text(
            (ROOT / "configs" / "demo.toml").read_text().split("[attitude]")[0]
            + f"[attitude]\n{attitude}\n"
        )
        command = [
            sys.executable,
            "-m",
            "hilstar",
            "serve",
            str(bench),
            "--headless",
            "--json",
            "--duration",
            str(seconds + 4),
        ]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stderr is not None
            process.stderr.readline()
            time.sleep(0.5)
            sent = run_hilstar(
                f"send --spin z,1 --rate {RATE_HZ} --duration {seconds} --json --to {to}", *options
            )
            return json.loads(sent.stdout), json.loads(process.communicate(timeout=60)[0])


def tell(name: str, sent: dict, summary: dict, bare_ms: np.ndarray) -> None:
    latency, packets, clock = summary["receive_latency_ms"], summary["packets"], summary["clock"]
    # both processes have one clock
    least_ms = clock["offset_ms"] if clock["mode"] == "one-way" else 0.0
    print(
        f"{name:24} sent {sent['sent']} of {sent['packets']} (corrupted {sent['corrupted']},"
        f" reordered {sent['reordered']}), accepted {packets['accepted']}, refused"
        f" {packets['refused_by']}\n{'':24} latency p50 {latency['p50'] + least_ms:.3f}, p99"
        f" {latency['p99'] + least_ms:.3f} ms; bare road p50 {np.percentile(bare_ms, 50):.3f}, p99"
        f" {np.percentile(bare_ms, 99):.3f} ms; clock {clock['mode']} {clock['offset_ms']:.3f} +-"
        f" {clock['uncertainty_ms']:.3f} ms, {clock['drift_ppm']:.2f} ppm;"
        f" {summary['missed_frames']} frames of {summary['frames']} missed"
    )


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    bare_seconds = min(seconds, 10.0)
    for options in ((), FAULTS):
        endpoint = "tcp://127.0.0.1:5599"
        bare = bare_zmq(bare_seconds)
        tell(
            "ZeroMQ " + " ".join(options),
            *served(f'endpoint = "{endpoint}"', endpoint, seconds, options),
            bare,
        )
        bare = bare_pty(bare_seconds)
        with tempfile.TemporaryDirectory() as folder, Cable(Path(folder)) as cable:
            line = f'source = "serial"\nport = "{cable.host}"\nbaud = 921600'
            tell(
                "pty " + " ".join(options),
                *served(line, f"serial:{cable.sender}@921600", seconds, options),
                bare,
            )


if __name__ == "__main__":
    main()
