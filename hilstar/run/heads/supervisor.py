"""The run of several heads: one source handed on to a process for each, which is begun again where it ends early."""

from __future__ import annotations

import os
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from hilstar.attitude.receiver import BackChannel, Traffic
from hilstar.attitude.wire.links import StreamLink
from hilstar.attitude.wire.packet import TimeRequest
from hilstar.attitude.wire.zmq_links import Feed
from hilstar.bench.config import BenchConfig
from hilstar.bench.heads_file import HeadsFile
from hilstar.files import temporary_folder
from hilstar.process.interrupts import stop_on_signal
from hilstar.reading import NOT_JSON
from hilstar.run.heads.head_process import HeadProcess, Say
from hilstar.units import NS_PER_S

POLL_MS = 10
TEND_NS = NS_PER_S // 20
MIN_DURATION_S = 0.05  # of a head that is begun again at the end
ENDS_S = 5.0  # what a head may take to end in order
SOCKET = "body"
BODY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class HeadsRun:
    """What a run of heads is asked for: `options` go to each head's `serve`, with its own ledger beside `ledger`.

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
    """A head's ledger: RUN.NAME.mcap, and RUN.NAME.again1.mcap where it was begun again."""
    again = f".again{number}" if number else ""
    return ledger.with_name(f"{ledger.stem}.{name}{again}{ledger.suffix}")


def run_heads(asked: HeadsRun, link: StreamLink, say: Say) -> dict[str, Any]:
    """Show each head until its end, or until a signal; what each one said of itself (--json), by its name."""
    stop = threading.Event()
    with temporary_folder("heads") as folder, stop_on_signal(stop):
        endpoint = f"ipc://{folder}/{SOCKET}"
        with Feed(endpoint) as feed:
            processes = [_head(asked, k, endpoint, folder, say) for k in range(len(asked.heads.names))]
            try:
                _hand_on(link, feed, processes, stop)
                for process in processes:
                    process.interrupt()
            finally:
                for process in processes:
                    process.close(ENDS_S)
    return {process.name: _told(process) for process in processes}


def _head(asked: HeadsRun, k: int, endpoint: str, folder: Path, say: Say) -> HeadProcess:
    name, file = asked.heads.names[k], asked.heads.files[k]

    def command(number: int, drawn_s: float) -> list[str]:
        made = [sys.executable, "-m", "hilstar", "serve", str(file.path), "--json"]
        made += ["--head-of", str(asked.heads.path), "--fed-by", f"{endpoint},{os.getpid()}", *asked.options]
        if asked.duration_s is not None:
            made += ["--duration", f"{max(asked.duration_s - drawn_s, MIN_DURATION_S):.6g}"]
        if asked.ledger is not None:
            made += ["--ledger", str(head_ledger(asked.ledger, name, number))]
        if asked.consoles:
            made += ["--console", asked.consoles[k]]
        return made

    secrets = {} if asked.token is None else {"HILSTAR_TOKEN": asked.token}
    return HeadProcess(name, command, say, folder / f"life-{k}", secrets)


def _hand_on(link: StreamLink, feed: Feed, processes: list[HeadProcess], stop: threading.Event) -> None:
    """Give what arrives to the heads, and tend them, until all have ended or a signal comes."""
    back = BackChannel(link, Traffic(0, time_requests=False, shared_clock=False))
    tended_ns = 0
    while not stop.is_set():
        for arrival in link.receive(POLL_MS):
            if isinstance(arrival.event, TimeRequest):
                if link.two_way:
                    back.answer(arrival.event, arrival)
            else:
                feed.give(arrival)
        if time.monotonic_ns() - tended_ns > TEND_NS:
            tended_ns = time.monotonic_ns()
            busy = [process.tend() for process in processes]
            if not any(busy):
                return


def _told(process: HeadProcess) -> dict[str, Any]:
    try:
        summary = msgspec.json.decode(process.output) if process.output.strip() else None
    except NOT_JSON:
        summary = None
    return {"exit_code": process.code, "restarts": process.restarts, "summary": summary}
