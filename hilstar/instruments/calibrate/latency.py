"""Latency by a photodiode: the edges that it saw, paired with the frames of the ledger that
caused them.
"""

import math
import re
from array import array
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.attitude.clock.sender_clock import OneWayFilter
from hilstar.attitude.wire.serial_link import read_lines
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import BLUE, ORANGE, chart, write_csv
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import make_directory, write_whole
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.text_tables import read_rows
from hilstar.basics.units import ERROR_OF_MEDIAN, NS_PER_MS, NS_PER_S, NS_PER_US
from hilstar.server.bench.bench_file import with_key
from hilstar.server.bench.config import BenchConfig, Monitor
from hilstar.server.record.ledger_records import (
    NO_FRAMES,
    FrameRecord,
    config_of,
    read_head,
    run_records,
)
from hilstar.server.sync import beat, exposures_of

INT64 = range(-(2**63), 2**63)
MAX_EDGE_BYTES = 20_000_000  # a day of toggles
MIN_EDGES = 20
EDGE_COLUMNS = ("host_ns", "level")
EDGE_FORM = "write lines of host_ns,level"
EDGE_ADVICE = f"{EDGE_FORM} under that header"
DEVICE_FORM = "send a line 0 or 1 at each edge, or 0,MICROSECONDS by the device's own clock"
DEVICE_LINE = re.compile(rb"([01])(?:,(\d{1,18}))?")
MAX_LATENCY_NS = 500 * NS_PER_MS
# a clock that is read after the swap may give a time later than that of the light
MAX_EARLY_NS = 5 * NS_PER_MS
BIN_NS = NS_PER_MS
# relative to the best peak: with a square that toggles, the latency repeats every two frames
LIKELY_SHARE = 0.9
AGREEING_SHARE = 0.5  # share of the edges that must find their frames
BINS = 80
LEVEL_NAMES = {1: "dark to light", 0: "light to dark"}


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a photodiode: host time, ns, and the level after each, 0 or 1, (n,) each."""

    host_ns: IntArray
    level: IntArray


def capture_edges(port: str, baud: int, seconds: float) -> Edges:
    """Record the edges that a device on a serial port reports within `seconds` (see DEVICE_FORM);
    other lines are skipped.

    Device times are converted to the host's clock by the lower hull of their delays, so the minimum
    delay stays in the latency. Raises InputError where there are too few.
    """
    return edges_in(read_lines(port, baud, seconds), f"serial:{port}@{baud}")


def edges_in(lines: Iterable[tuple[int, bytes]], source: str) -> Edges:
    """The edges among a device's lines and their times, host ns (see `capture_edges`)."""
    host: list[int] = []
    levels: list[int] = []
    device_us: list[int] = []
    for line_ns, line in lines:
        match = DEVICE_LINE.fullmatch(line)
        if match is None:
            continue
        host.append(line_ns)
        levels.append(int(match[1]))
        if match[2] is not None:
            device_us.append(int(match[2]))
    if len(host) < MIN_EDGES:
        raise InputError(
            f"{source}: {len(host)} edges came, and at least {MIN_EDGES} are needed; {DEVICE_FORM}"
        )
    host_ns = np.array(host, dtype=np.int64)
    if len(device_us) == len(host):
        host_ns = _on_host(host_ns, NS_PER_US * np.array(device_us, dtype=np.int64))
    return Edges(host_ns, np.array(levels, dtype=np.int64))


def _on_host(host_ns: IntArray, device_ns: IntArray) -> IntArray:
    """Device times (n,) on the host's clock, by when they came (n,)."""
    clock = OneWayFilter()
    for arrival_ns, stamp_ns in zip(host_ns.tolist(), device_ns.tolist(), strict=True):
        clock.observe(arrival_ns, arrival_ns - stamp_ns)
    if clock.line is None:
        return host_ns
    offset_ns = [round(clock.line.at(arrival_ns)) for arrival_ns in host_ns.tolist()]
    return np.asarray(device_ns + offset_ns)


def read_edges(path: Path) -> Edges:
    """Read edges from a CSV file with the columns host_ns and level. Raises InputError."""
    rows = []
    for line, cells in read_rows(path, EDGE_COLUMNS, EDGE_ADVICE, MAX_EDGE_BYTES, ()):
        try:
            host_ns = int(cells[0])
            level = int(cells[1])
            if host_ns not in INT64:
                raise ValueError("host_ns does not fit 64 bits")
        except ValueError as error:
            fault = f"not a file of edges ({shortened(repr(error))}); {EDGE_ADVICE}"
            raise InputError(f"{path}:{line}: {fault}") from error
        rows.append((host_ns, level))
    are_levels_known = all(level in {0, 1} for _, level in rows)
    if len(rows) < MIN_EDGES or not are_levels_known:
        raise InputError(
            f"{path}: at least {MIN_EDGES} edges are needed, each of level 0 or 1; {EDGE_FORM}"
        )
    table = np.array(rows, dtype=np.int64)
    return Edges(table[:, 0], table[:, 1])


def save_edges(path: Path, edges: Edges) -> None:
    """Write edges as `read_edges` reads them. Raises InputError where that cannot be done."""
    columns = (edges.host_ns.tolist(), edges.level.tolist())
    write_csv(path, EDGE_COLUMNS, zip(*columns, strict=True))


def edges_of(swap_ns: IntArray, level: IntArray) -> Edges:
    """The changes of the square, from the swaps and levels of frames (n,)."""
    changed = np.flatnonzero(np.diff(level)) + 1
    return Edges(swap_ns[changed], level[changed])


@dataclass(frozen=True, slots=True)
class Paired:
    """Latencies from swap to edge, ns, of the edges matched to frames, and their levels; (n,) each.

    `unmatched` counts the other edges during the run. `ambiguous`: the latency is known only up to
    whole pairs of frames.
    """

    latency_ns: FloatArray
    level: IntArray
    unmatched: int
    ambiguous: bool


def pair(seen: Edges, shown: Edges, period_ns: float) -> Paired:
    """Match each edge to its frame by the most frequent latency, within half a period. Raises
    InputError if too few agree.
    """
    first_ns = shown.host_ns[0] - MAX_EARLY_NS
    last_ns = shown.host_ns[-1] + MAX_LATENCY_NS
    in_run = (seen.host_ns >= first_ns) & (seen.host_ns <= last_ns)
    host_ns = seen.host_ns[in_run]
    level = seen.level[in_run]
    guess_ns, ambiguous = _likely_latency_ns(Edges(host_ns, level), shown)
    latencies = [np.zeros(0)]
    levels = [np.zeros(0, dtype=np.int64)]
    for value in (0, 1):
        causes = shown.host_ns[shown.level == value]
        edges_ns = host_ns[level == value]
        if len(causes) and len(edges_ns):
            delay_ns = edges_ns - nearest_of(causes, edges_ns - guess_ns)
            agrees = np.abs(delay_ns - guess_ns) < period_ns / 2
            latencies.append(delay_ns[agrees].astype(np.float64))
            levels.append(np.full(int(agrees.sum()), value))
    latency_ns = np.concatenate(latencies)
    if len(latency_ns) < max(MIN_EDGES, AGREEING_SHARE * len(host_ns)):
        raise InputError(
            f"{len(latency_ns)} of {len(host_ns)} edges fit the run's frames; record the edges"
            " during the run, on the same machine"
        )
    unmatched = len(host_ns) - len(latency_ns)
    return Paired(latency_ns, np.concatenate(levels), unmatched, ambiguous)


def nearest_of(moments: IntArray, wanted: FloatArray) -> IntArray:
    """The member of sorted `moments` (m,) nearest to each of `wanted` (n,)."""
    after = np.minimum(np.searchsorted(moments, wanted), len(moments) - 1)
    before = np.maximum(after - 1, 0)
    to_after = np.abs(moments[after] - wanted)
    to_before = np.abs(moments[before] - wanted)
    nearest = np.where(to_after < to_before, after, before)
    return np.asarray(moments[nearest])


def _likely_latency_ns(seen: Edges, shown: Edges) -> tuple[float, bool]:
    """The most frequent delay from a change to an edge of the same level, and whether others are
    about as frequent.
    """
    bins = (MAX_LATENCY_NS + MAX_EARLY_NS) // BIN_NS
    counts = np.zeros(bins, dtype=np.int64)
    for value in (0, 1):
        causes = shown.host_ns[shown.level == value]
        edges_ns = seen.host_ns[seen.level == value]
        first = np.searchsorted(causes, edges_ns - MAX_LATENCY_NS)
        end = np.searchsorted(causes, edges_ns + MAX_EARLY_NS, side="right")
        for k, edge_ns in enumerate(edges_ns):
            delay_ns = edge_ns - causes[first[k] : end[k]]
            place = (delay_ns + MAX_EARLY_NS) // BIN_NS
            np.add.at(counts, np.minimum(place, bins - 1), 1)
    smooth = np.convolve(counts, np.ones(3, dtype=np.int64), mode="same")
    likely = np.flatnonzero(smooth >= LIKELY_SHARE * smooth.max())
    # bins of one peak are next to each other
    first_peak = likely[likely <= likely[0] + 2]
    best = int(first_peak[np.argmax(smooth[first_peak])])
    has_others = bool((likely > likely[0] + 4).any())
    return (best + 0.5) * BIN_NS - MAX_EARLY_NS, has_others


def summarise(paired: Paired, config: BenchConfig) -> dict[str, Any]:
    """The figures of a latency measurement, by the keys of `hilstar latency --json`.

    The square is at the foot of the screen and lights almost a scan-out after the swap,
    `swap_to_square_ms`, which is subtracted from the median: the rest is the panel's own,
    `panel_delay_ms`.
    """
    ms = paired.latency_ns / NS_PER_MS
    to_square_ms = swap_to_square_ms(config.monitor)
    p1, p50, p99 = np.percentile(ms, [1, 50, 99]).tolist()
    jitter_ms = float(ms.std())
    latency_ms = {"p1": p1, "p50": p50, "p99": p99, "max": float(ms.max())}
    median_error_ms = ERROR_OF_MEDIAN * jitter_ms / math.sqrt(len(ms))
    return {
        "edges": len(ms),
        "unmatched": paired.unmatched,
        "ambiguous": paired.ambiguous,
        "latency_ms": latency_ms,
        "jitter_ms": jitter_ms,
        "rise_ms": _median(ms[paired.level == 1]),
        "fall_ms": _median(ms[paired.level == 0]),
        "swap_to_square_ms": to_square_ms,
        "panel_delay_ms": p50 - to_square_ms,
        "panel_delay_u_ms": median_error_ms,
        "beat": asdict(beat(exposures_of(config))),
    }


def _median(values: FloatArray) -> float | None:
    if len(values):
        return float(np.median(values))
    return None


def swap_to_square_ms(monitor: Monitor) -> float:
    """Time from the first row's light to that of the square's middle, at the foot of the screen,
    by the scan-out.
    """
    width, height = monitor.resolution_px
    # a screen that stands on its side is scanned along the image's width
    rows = height
    if monitor.rotate_deg % 180:
        rows = width
    middle_row_share = 1 - monitor.photodiode_px / 2 / rows
    return monitor.panel_scanout_ms * middle_row_share


def checked_delay_ms(panel_delay_ms: float) -> float:
    """The delay rounded for a bench file. Raises InputError where light came before the scan-out
    that the file assumes.
    """
    if panel_delay_ms < 0:
        raise InputError(
            f"the square lit {-panel_delay_ms:.2f} ms before the scan-out could reach it; set"
            " [monitor] scanout_ms to what the panel needs (0 where all rows light at once)"
        )
    return round(panel_delay_ms, 3)


def write_panel_delay(path: Path, panel_delay_ms: float, error_ms: float) -> None:
    """Set `[monitor] panel_delay_ms` and `[certify] panel_delay_u_ms` in a bench file and leave the
    rest unchanged.

    Raises InputError where the light came before the scan-out that the file assumes, and for a file
    that cannot be changed.
    """
    value = checked_delay_ms(panel_delay_ms)
    text = read_text(path, "give the path of a bench file", MAX_TOML_BYTES)
    text = with_key(text, "monitor", "panel_delay_ms", value)
    text = with_key(text, "certify", "panel_delay_u_ms", float(f"{error_ms:.3g}"))
    written = parse_toml(path, text).get("monitor", {})
    if written.get("panel_delay_ms") != value:
        raise InputError(
            f"{path}: write panel_delay_ms = {value} into its [monitor] yourself: the table is not"
            " in plain form"
        )
    write_whole(path, text)


def measure_latency(ledger: Path, edges: Edges, directory: Path | None) -> dict[str, Any]:
    """The figures of `hilstar latency`, and the chart `latency` in a directory where one is given.

    Raises InputError for a ledger or edges that do not fit each other.
    """
    config = config_of(read_head(ledger))
    if config is None:
        raise InputError(
            f"{ledger}: its header has no bench file that can be read; record the run again"
        )
    swap_ns = array("q")
    level = array("b")
    is_lit = False
    for record in run_records(ledger):
        if isinstance(record, FrameRecord):
            is_lit = True
            if record.marker is not None:
                swap_ns.append(record.swap_ns)
                level.append(record.marker)
    if not is_lit:
        raise InputError(f"the run {NO_FRAMES}")
    if not level:
        raise InputError(
            "the run has no photodiode square; set [monitor] photodiode_px and run it on a screen"
        )
    shown = edges_of(np.array(swap_ns, dtype=np.int64), np.array(level, dtype=np.int64))
    if not len(shown.host_ns):
        raise InputError(f"{ledger}: its photodiode square never changed; record a longer run")
    paired = pair(edges, shown, NS_PER_S / config.monitor.refresh_hz)
    summary = summarise(paired, config)
    if directory is not None:
        draw_latency(make_directory(directory) / "latency", paired, summary)
    return summary


def latency_lines(summary: dict[str, Any]) -> list[str]:
    """The figures as lines of text."""
    latency = summary["latency_ms"]
    turn = summary["beat"]
    period = "none"
    if turn["period_s"] is not None:
        period = f"every {turn['period_s']:.3g} s"
    cost = "-"
    worst = turn["worst_arcsec_per_deg_s"]
    if worst is not None:
        cost = f"at most {worst:.2g} arcsec at 1 deg/s"
    rise = _milliseconds(summary["rise_ms"])
    fall = _milliseconds(summary["fall_ms"])
    figures = {
        "edges": f"{summary['edges']} paired, {summary['unmatched']} without a frame",
        "swap to light": (
            f"{latency['p1']:.2f} / {latency['p50']:.2f} / {latency['p99']:.2f} ms (p1 / p50 / p99)"
        ),
        "rise, fall": f"{rise}, {fall} ms (medians)",
        "jitter": f"{summary['jitter_ms']:.3f} ms (standard deviation)",
        "beat with the exposure": (
            f"{turn['refreshes_per_exposure']:.3f} refreshes in one; {period}; {cost}"
        ),
        "of this, scan-out": f"{summary['swap_to_square_ms']:.2f} ms to the square",
        "panel_delay_ms": f"{summary['panel_delay_ms']:.3f} +- {summary['panel_delay_u_ms']:.3f}",
    }
    if summary["ambiguous"]:
        figures["note"] = (
            'a latency longer by whole pairs of frames fits too; [monitor] photodiode = "code"'
            " tells which"
        )
    return [f"{name:24}{text}" for name, text in figures.items()]


def _milliseconds(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}"


def draw_latency(path: Path, paired: Paired, summary: dict[str, Any]) -> None:
    """Draw a histogram of the latencies by level."""
    middle = summary["latency_ms"]["p50"]
    jitter = summary["jitter_ms"]
    ms = paired.latency_ns / NS_PER_MS
    widest_ms = max(ms.max(), ms.min() + 1e-3)
    bins = np.linspace(ms.min(), widest_ms, BINS).tolist()
    with chart(path, f"From swap to light: {middle:.2f} ms, jitter {jitter:.3f} ms") as (axes,):
        for (level, name), colour in zip(LEVEL_NAMES.items(), (BLUE, ORANGE), strict=True):
            of_level = ms[paired.level == level]
            axes.hist(of_level, bins=bins, color=colour, alpha=0.6, label=name)
        axes.set_xlabel("swap to the photodiode's edge [ms]")
        axes.set_ylabel("edges [number]")
        axes.margins(y=0.25)
        axes.legend(loc="upper right", ncols=2)
