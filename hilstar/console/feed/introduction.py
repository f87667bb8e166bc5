"""What a page's process is told at its start that runs and sessions have in common."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hilstar import __version__
from hilstar.console.feed.messages import Pace, Setup
from hilstar.errors import printable

if TYPE_CHECKING:
    from hilstar.bench.bench_file import BenchFile
    from hilstar.console.feed.door import Door


@dataclass(frozen=True, slots=True)
class Told:
    """What the page says of a run: the command, where attitudes come from, and how frames come."""

    command: str
    kind: str
    endpoint: str
    pace: Pace = "clock"


def introduced(door: Door, control: bool, told: Told, file: BenchFile, picture_bytes: int) -> Setup:
    """The page of a bench file behind a door; a run adds to `hello`."""
    monitor = file.config.monitor
    hello = {
        "version": __version__,
        "command": f"hilstar {told.command}",
        "bench": printable(file.path.name),
        "renderer": "",
        "started_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "resolution_px": list(monitor.resolution_px),
        "white_level": 2**monitor.bits - 1,
        "bits": monitor.bits,
        "refresh_hz": monitor.refresh_hz,
        "faults": [],
    }
    return Setup(
        hello=hello,
        source={"kind": told.kind, "endpoint": printable(told.endpoint)},
        hosts=door.hosts,
        names=[name.lower() for name in door.names],
        any_address=door.any_address,
        port=door.port,
        token=door.token,
        control=control,
        picture_bytes=picture_bytes,
        refresh_hz=monitor.refresh_hz,
        pace=told.pace,
    )
