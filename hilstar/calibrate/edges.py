"""The edges that a photodiode saw, and those that a run's square made: from a device, a file, or a ledger."""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import IntArray
from hilstar.attitude.clock.one_way import OneWayFilter
from hilstar.attitude.wire.serial_lines import read_lines
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import read_text
from hilstar.run.record.ledger_reader import NO_FRAMES
from hilstar.run.record.ledger_records import FrameRecord, RunRecord
from hilstar.units import NS_PER_US

INT64 = range(-(2**63), 2**63)
MAX_EDGE_BYTES = 20_000_000  # a day of toggles
MIN_EDGES = 20
EDGE_FORM = "write lines of host_ns,level"
DEVICE_FORM = "send a line 0 or 1 at each edge, or 0,MICROSECONDS by the device's own clock"


@dataclass(frozen=True, slots=True)
class Edges:
    """What a photodiode saw: host time, ns, and the level after it, 0 or 1, (n,) each."""

    host_ns: IntArray
    level: IntArray


def parse_edges(lines: Iterable[tuple[int, bytes]], name: str) -> Edges:
    """Edges from a device's lines with the host time, ns, of their arrival (see DEVICE_FORM); noise between them is skipped.

    Device times are carried to the host's clock by the lower hull of their delays: the minimum delay stays in the latency.
    Raises InputError where there are too few.
    """
    found = [(host_ns, match) for host_ns, line in lines if (match := re.fullmatch(rb"([01])(?:,(\d{1,18}))?", line))]
    if len(found) < MIN_EDGES:
        raise InputError(f"{name}: {len(found)} edges came, and at least {MIN_EDGES} are needed; {DEVICE_FORM}")
    host_ns = np.array([host for host, _ in found], dtype=np.int64)
    level = np.array([int(match[1]) for _, match in found], dtype=np.int64)
    if all(match[2] is not None for _, match in found):
        host_ns = _by_device(host_ns, np.array([int(match[2]) * NS_PER_US for _, match in found], dtype=np.int64))
    return Edges(host_ns, level)


def _by_device(host_ns: IntArray, device_ns: IntArray) -> IntArray:
    clock = OneWayFilter()
    for host, device in zip(host_ns.tolist(), device_ns.tolist(), strict=True):
        clock.observe(host, host - device)
    line = clock.line
    if line is None:
        return host_ns
    return np.array([d + round(line.at(h)) for h, d in zip(host_ns.tolist(), device_ns.tolist(), strict=True)])


def capture_edges(port: str, baud: int, seconds: float) -> Edges:
    """The edges that a device on a serial port reports within `seconds`. Raises InputError."""
    return parse_edges(read_lines(port, baud, seconds), f"serial:{port}@{baud}")


def read_edges(path: Path) -> Edges:
    """Edges of a CSV file with the columns host_ns and level. Raises InputError."""
    text = read_text(path, "give a file of edges", MAX_EDGE_BYTES)
    rows, reader = [], csv.DictReader(io.StringIO(text, newline=""))
    try:
        for row in reader:
            rows.append((int(row["host_ns"]), int(row["level"])))
            if rows[-1][0] not in INT64:
                raise ValueError("host_ns does not fit 64 bits")
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        where = f"{path}:{reader.line_num}"
        raise InputError(f"{where}: not a file of edges ({shortened(repr(error))}); {EDGE_FORM} under that header") from error
    if len(rows) < MIN_EDGES or any(level not in {0, 1} for _, level in rows):
        raise InputError(f"{path}: at least {MIN_EDGES} edges are needed, each of level 0 or 1; {EDGE_FORM}")
    table = np.array(rows, dtype=np.int64)
    return Edges(table[:, 0], table[:, 1])


def save_edges(path: Path, edges: Edges) -> None:
    """Write edges as `read_edges` reads them. Raises InputError where that cannot be done."""
    lines = (f"{host},{level}" for host, level in zip(edges.host_ns.tolist(), edges.level.tolist(), strict=True))
    write_whole(path, "\n".join(["host_ns,level", *lines]) + "\n")


def square_edges(records: Iterable[RunRecord]) -> Edges:
    """The frames of a run whose photodiode square differs from that of the frame before: swap times and levels.

    Raises InputError for a run without a frame, or without a square.
    """
    swap_ns, level = array("q"), array("b")
    seen = False
    for record in records:
        if not isinstance(record, FrameRecord):
            continue
        seen = True
        if record.marker is not None:
            swap_ns.append(record.swap_ns)
            level.append(record.marker)
    if not seen:
        raise InputError(f"the run {NO_FRAMES}")
    if not level:
        raise InputError("the run has no photodiode square; set [monitor] photodiode_px and run it on a screen")
    return edges_of(np.array(swap_ns, dtype=np.int64), np.array(level, dtype=np.int64))


def edges_of(swap_ns: IntArray, level: IntArray) -> Edges:
    """Of frames, their swaps and the square's levels (n,) each, those that differ from the frame before."""
    changed = np.flatnonzero(np.diff(level)) + 1
    return Edges(swap_ns[changed], level[changed])
