"""Latency by a photodiode: the edges that it saw, set against the frames of the ledger that caused them."""

from __future__ import annotations

import csv
import io
import re
import tomllib
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.attitude.clock.one_way import OneWayFilter
from hilstar.attitude.wire.serial_lines import read_lines
from hilstar.bench.config import BenchConfig
from hilstar.calibrate.toml_key import with_key
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import MAX_TOML_BYTES, read_text
from hilstar.run.record.records import NO_FRAMES, FrameRecord, RunRecord
from hilstar.units import NS_PER_MS, NS_PER_US

INT64 = range(-(2**63), 2**63)
MAX_EDGE_BYTES = 20_000_000  # a day of toggles
LONGEST_LATENCY_NS = 500 * NS_PER_MS
EARLIEST_NS = 5 * NS_PER_MS  # a clock that is read after the swap may say when later than the light came
BIN_NS = NS_PER_MS
FEWEST_EDGES = 20
LIKELY_SHARE = 0.9  # of the best peak: with a square that toggles the latency comes again every two frames
AGREEING_SHARE = 0.5  # of the edges that must find their frames
NO_BEAT = 1e-3
EDGE_FORM = "write lines of host_ns,level"
DEVICE_FORM = "send a line 0 or 1 at each edge, or 0,MICROSECONDS by the device's own clock"


@dataclass(frozen=True, slots=True)
class Edges:
    """What a photodiode saw: host time, ns, and the level after it, 0 or 1, (n,) each."""

    host_ns: IntArray
    level: IntArray


def parse_edges(lines: Iterable[tuple[int, bytes]], name: str) -> Edges:
    """Edges from a device's lines with their arrival (see DEVICE_FORM); noise between them is passed over.

    Device times are carried to the host's clock by the lower hull of their delays: the least delay stays in the latency.
    Raises InputError where there are too few.
    """
    found = [(host_ns, match) for host_ns, line in lines if (match := re.fullmatch(rb"([01])(?:,(\d{1,18}))?", line))]
    if len(found) < FEWEST_EDGES:
        raise InputError(f"{name}: {len(found)} edges came; {DEVICE_FORM}, for {FEWEST_EDGES} edges at least")
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
    """The edges that a device on a serial port tells of within `seconds`. Raises InputError."""
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
        raise InputError(f"{where}: is no file of edges ({shortened(repr(error))}); {EDGE_FORM} under that header") from error
    if len(rows) < FEWEST_EDGES or any(level not in {0, 1} for _, level in rows):
        raise InputError(f"{path}: {FEWEST_EDGES} edges of level 0 or 1 are wanted; {EDGE_FORM}")
    table = np.array(rows, dtype=np.int64)
    return Edges(table[:, 0], table[:, 1])


def save_edges(path: Path, edges: Edges) -> None:
    """Write edges as `read_edges` reads them. Raises InputError where that cannot be done."""
    lines = (f"{host},{level}" for host, level in zip(edges.host_ns.tolist(), edges.level.tolist(), strict=True))
    write_whole(path, "\n".join(["host_ns,level", *lines]) + "\n")


def changes(records: Iterable[RunRecord]) -> Edges:
    """The frames of a run whose photodiode square differs from that of the frame before: swap times and levels.

    Raises InputError for a run without a frame, or without a square.
    """
    swap_ns, level, last = array("q"), array("b"), None
    seen = False
    for record in records:
        if not isinstance(record, FrameRecord):
            continue
        seen = True
        if record.marker is None:
            continue
        if last is not None and record.marker != last:
            swap_ns.append(record.swap_ns)
            level.append(record.marker)
        last = record.marker
    if not seen:
        raise InputError(f"the run {NO_FRAMES}")
    if last is None:
        raise InputError("the run has no photodiode square; set [monitor] photodiode_px and run it on a screen")
    return Edges(np.array(swap_ns, dtype=np.int64), np.array(level, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class Paired:
    """Latencies from swap to edge, ns, of the edges that found their frames, and those edges' levels; (n,) each.

    `unmatched` counts the other edges of the run's time, and `ambiguous` says that the latency is known but for whole pairs
    of frames.
    """

    latency_ns: FloatArray
    level: IntArray
    unmatched: int
    ambiguous: bool


def pair(seen: Edges, shown: Edges, period_ns: float) -> Paired:
    """Each edge with the frame that caused it: the latency that most edges agree on, within half a refresh period.

    Raises InputError where too few agree.
    """
    inside = (seen.host_ns >= shown.host_ns[0] - EARLIEST_NS) & (seen.host_ns <= shown.host_ns[-1] + LONGEST_LATENCY_NS)
    host_ns, level = seen.host_ns[inside], seen.level[inside]
    guess_ns, ambiguous = _likely_latency_ns(Edges(host_ns, level), shown)
    latency, kept = [], []
    for value in (0, 1):
        causes, mine = shown.host_ns[shown.level == value], host_ns[level == value]
        if len(causes) and len(mine):
            delay = mine - nearest_of(causes, mine - guess_ns)
            good = np.abs(delay - guess_ns) < period_ns / 2
            latency.append(delay[good].astype(np.float64))
            kept.append(np.full(int(good.sum()), value))
    found = np.concatenate(latency) if latency else np.zeros(0)
    if len(found) < max(FEWEST_EDGES, AGREEING_SHARE * len(host_ns)):
        fit = f"{len(found)} of {len(host_ns)} edges fit the run's frames"
        raise InputError(f"{fit}; record edges while the run goes on, on the same machine")
    return Paired(found, np.concatenate(kept), len(host_ns) - len(found), ambiguous)


def nearest_of(moments: IntArray, wanted: FloatArray) -> IntArray:
    """The member of sorted `moments` (m,) that is nearest to each of `wanted` (n,)."""
    after = np.minimum(np.searchsorted(moments, wanted), len(moments) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(moments[after] - wanted) < np.abs(moments[before] - wanted)
    return np.asarray(moments[np.where(closer, after, before)])


def _likely_latency_ns(seen: Edges, shown: Edges) -> tuple[float, bool]:
    """The commonest delay from a change to an edge of its level, and whether others are about as common."""
    bins = (LONGEST_LATENCY_NS + EARLIEST_NS) // BIN_NS
    counts = np.zeros(bins, dtype=np.int64)
    for value in (0, 1):
        causes, mine = shown.host_ns[shown.level == value], seen.host_ns[seen.level == value]
        begin = np.searchsorted(causes, mine - LONGEST_LATENCY_NS)
        end = np.searchsorted(causes, mine + EARLIEST_NS, side="right")
        for edge_ns, a, b in zip(mine, begin, end, strict=True):
            np.add.at(counts, np.minimum((edge_ns - causes[a:b] + EARLIEST_NS) // BIN_NS, bins - 1), 1)
    smooth = np.convolve(counts, np.ones(3, dtype=np.int64), mode="same")
    likely = np.flatnonzero(smooth >= LIKELY_SHARE * smooth.max())
    first = likely[likely <= likely[0] + 2]
    best = int(first[np.argmax(smooth[first])])
    return (best + 0.5) * BIN_NS - EARLIEST_NS, bool((likely > likely[0] + 4).any())


def summarise(paired: Paired, config: BenchConfig) -> dict[str, Any]:
    """The figures of a latency measurement, and the panel's own delay for the bench file.

    The square is at the foot of the screen, so it lights nearly a scan-out after the swap: that is taken off.
    """
    ms = paired.latency_ns / NS_PER_MS
    monitor, exposure_s = config.monitor, config.tracker.exposure_s
    rows = monitor.resolution_px[0 if monitor.rotate_deg % 180 else 1]
    to_square_ms = monitor.panel_scanout_ms * (1 - monitor.photodiode_px / 2 / rows)
    p1, p50, p99 = np.percentile(ms, [1, 50, 99])
    rise, fall = ms[paired.level == 1], ms[paired.level == 0]
    return {
        "edges": len(ms),
        "unmatched": paired.unmatched,
        "ambiguous": paired.ambiguous,
        "latency_ms": {"p1": float(p1), "p50": float(p50), "p99": float(p99), "max": float(ms.max())},
        "jitter_ms": float(ms.std()),
        "rise_ms": float(np.median(rise)) if len(rise) else None,
        "fall_ms": float(np.median(fall)) if len(fall) else None,
        "swap_to_square_ms": to_square_ms,
        "panel_delay_ms": float(p50) - to_square_ms,
        "beat": beat(monitor.refresh_hz, exposure_s),
    }


def beat(refresh_hz: float, exposure_s: float) -> dict[str, float | None]:
    """How refresh and exposure beat: refreshes in an exposure, how often their phases come round, and what that costs.

    In an exposure of n + f refreshes (f under 1) a star that moves is off by at most f (1 - f) / 2 of one refresh's path,
    over n + f, whatever the display does: it cannot know when the tracker's exposure begins.
    """
    refreshes = refresh_hz * exposure_s
    rest = refreshes - round(refreshes)
    part = refreshes % 1.0
    if refreshes <= 0:
        return {"refreshes_per_exposure": refreshes, "period_s": None, "worst_arcsec_per_deg_s": None}
    off_frames = part * (1 - part) / 2 / refreshes
    return {
        "refreshes_per_exposure": refreshes,
        "period_s": exposure_s / abs(rest) if abs(rest) > NO_BEAT else None,
        "worst_arcsec_per_deg_s": off_frames / refresh_hz * 3600.0,
    }


def write_panel_delay(path: Path, panel_delay_ms: float) -> None:
    """Set `[monitor] panel_delay_ms` in a bench file and leave the rest as it is.

    Raises InputError where the light came before the scan-out that the file assumes, and for a file that cannot be changed.
    """
    if panel_delay_ms < 0:
        raise InputError(
            f"the square lit {-panel_delay_ms:.2f} ms before the scan-out could reach it; set [monitor] scanout_ms to what the "
            "panel needs (0 where all rows light at once)"
        )
    value = round(panel_delay_ms, 3)
    try:
        text = read_text(path, "give the path of a bench file", MAX_TOML_BYTES)
        changed = with_key(text, "monitor", "panel_delay_ms", value)
        if tomllib.loads(changed).get("monitor", {}).get("panel_delay_ms") != value:
            raise InputError(f"{path}: write panel_delay_ms = {value} into its [monitor] yourself: its form is not plain")
        write_whole(path, changed)
    except OSError as error:
        raise InputError(f"{path}: cannot be changed ({error.strerror}); write panel_delay_ms = {value} yourself") from error
    except ValueError as error:  # tomllib's own, and that of an integer of thousands of digits
        raise InputError(f"{path}: not TOML: {shortened(error)}") from error
