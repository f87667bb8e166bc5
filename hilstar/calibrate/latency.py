"""Latency by a photodiode: the edges that it saw, set against the frames of the ledger that caused them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.bench_file_edit import with_key
from hilstar.bench.config import BenchConfig, Monitor
from hilstar.calibrate.edges import MIN_EDGES, Edges
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import MAX_TOML_BYTES, read_text
from hilstar.run.sync.advice import exposures_of
from hilstar.run.sync.beat import Beat, beat
from hilstar.units import NS_PER_MS

MAX_LATENCY_NS = 500 * NS_PER_MS
MAX_EARLY_NS = 5 * NS_PER_MS  # a clock that is read after the swap may give a time later than that of the light
BIN_NS = NS_PER_MS
LIKELY_SHARE = 0.9  # of the best peak: with a square that toggles, the latency repeats every two frames
AGREEING_SHARE = 0.5  # of the edges that must find their frames


@dataclass(frozen=True, slots=True)
class Paired:
    """Latencies from swap to edge, ns, of the edges that found their frames, and those edges' levels; (n,) each.

    `unmatched` counts the other edges of the run's time, and `ambiguous` says that the latency is known only up to
    whole pairs of frames.
    """

    latency_ns: FloatArray
    level: IntArray
    unmatched: int
    ambiguous: bool


def pair(seen: Edges, shown: Edges, period_ns: float) -> Paired:
    """Each edge with the frame that caused it: the latency that most edges agree on, within half a refresh period.

    Raises InputError where too few agree.
    """
    inside = (seen.host_ns >= shown.host_ns[0] - MAX_EARLY_NS) & (seen.host_ns <= shown.host_ns[-1] + MAX_LATENCY_NS)
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
    if len(found) < max(MIN_EDGES, AGREEING_SHARE * len(host_ns)):
        fit = f"{len(found)} of {len(host_ns)} edges fit the run's frames"
        raise InputError(f"{fit}; record the edges during the run, on the same machine")
    return Paired(found, np.concatenate(kept), len(host_ns) - len(found), ambiguous)


def nearest_of(moments: IntArray, wanted: FloatArray) -> IntArray:
    """The member of sorted `moments` (m,) that is nearest to each of `wanted` (n,)."""
    after = np.minimum(np.searchsorted(moments, wanted), len(moments) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(moments[after] - wanted) < np.abs(moments[before] - wanted)
    return np.asarray(moments[np.where(closer, after, before)])


def _likely_latency_ns(seen: Edges, shown: Edges) -> tuple[float, bool]:
    """The most frequent delay from a change to an edge of its level, and whether others are about as frequent."""
    bins = (MAX_LATENCY_NS + MAX_EARLY_NS) // BIN_NS
    counts = np.zeros(bins, dtype=np.int64)
    for value in (0, 1):
        causes, mine = shown.host_ns[shown.level == value], seen.host_ns[seen.level == value]
        begin = np.searchsorted(causes, mine - MAX_LATENCY_NS)
        end = np.searchsorted(causes, mine + MAX_EARLY_NS, side="right")
        for edge_ns, a, b in zip(mine, begin, end, strict=True):
            np.add.at(counts, np.minimum((edge_ns - causes[a:b] + MAX_EARLY_NS) // BIN_NS, bins - 1), 1)
    smooth = np.convolve(counts, np.ones(3, dtype=np.int64), mode="same")
    likely = np.flatnonzero(smooth >= LIKELY_SHARE * smooth.max())
    first = likely[likely <= likely[0] + 2]
    best = int(first[np.argmax(smooth[first])])
    return (best + 0.5) * BIN_NS - MAX_EARLY_NS, bool((likely > likely[0] + 4).any())


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Latencies, ms."""

    p1: float
    p50: float
    p99: float
    max: float


@dataclass(frozen=True, slots=True)
class LatencySummary:
    """The figures of `hilstar latency`; its fields are the keys of the JSON object.

    `swap_to_square_ms` is the scan-out down to the square, `panel_delay_ms` the rest of the median latency: the panel's own.
    """

    edges: int
    unmatched: int
    ambiguous: bool
    latency_ms: Percentiles
    jitter_ms: float
    rise_ms: float | None
    fall_ms: float | None
    swap_to_square_ms: float
    panel_delay_ms: float
    beat: Beat


def summarise(paired: Paired, config: BenchConfig) -> LatencySummary:
    """The figures of a latency measurement.

    The square is at the foot of the screen, so it lights nearly a scan-out after the swap: that is subtracted from the
    panel's delay.
    """
    ms = paired.latency_ns / NS_PER_MS
    monitor = config.monitor
    to_square_ms = swap_to_square_ms(monitor)
    p1, p50, p99 = (float(value) for value in np.percentile(ms, [1, 50, 99]))
    rise, fall = ms[paired.level == 1], ms[paired.level == 0]
    return LatencySummary(
        edges=len(ms),
        unmatched=paired.unmatched,
        ambiguous=paired.ambiguous,
        latency_ms=Percentiles(p1, p50, p99, float(ms.max())),
        jitter_ms=float(ms.std()),
        rise_ms=float(np.median(rise)) if len(rise) else None,
        fall_ms=float(np.median(fall)) if len(fall) else None,
        swap_to_square_ms=to_square_ms,
        panel_delay_ms=p50 - to_square_ms,
        beat=beat(exposures_of(config)),
    )


def swap_to_square_ms(monitor: Monitor) -> float:
    """From the first row's light to that of the square's middle, at the foot of the screen, by the scan-out."""
    rows = monitor.resolution_px[0 if monitor.rotate_deg % 180 else 1]
    return monitor.panel_scanout_ms * (1 - monitor.photodiode_px / 2 / rows)


def checked_delay_ms(panel_delay_ms: float) -> float:
    """The delay as a bench file has it. Raises InputError where the light came before the scan-out that the file assumes."""
    if panel_delay_ms < 0:
        raise InputError(
            f"the square lit {-panel_delay_ms:.2f} ms before the scan-out could reach it; set [monitor] scanout_ms to what the "
            "panel needs (0 where all rows light at once)"
        )
    return round(panel_delay_ms, 3)


def write_panel_delay(path: Path, panel_delay_ms: float) -> None:
    """Set `[monitor] panel_delay_ms` in a bench file and leave the rest unchanged.

    Raises InputError where the light came before the scan-out that the file assumes, and for a file that cannot be changed.
    """
    value = checked_delay_ms(panel_delay_ms)
    try:
        text = read_text(path, "give the path of a bench file", MAX_TOML_BYTES)
        changed = with_key(text, "monitor", "panel_delay_ms", value)
        if tomllib.loads(changed).get("monitor", {}).get("panel_delay_ms") != value:
            raise InputError(
                f"{path}: write panel_delay_ms = {value} into its [monitor] yourself: the table is not in plain form"
            )
        write_whole(path, changed)
    except OSError as error:
        raise InputError(f"{path}: cannot be changed ({error.strerror}); write panel_delay_ms = {value} yourself") from error
    except ValueError as error:  # tomllib's own, and that of an integer of thousands of digits
        raise InputError(f"{path}: not TOML: {shortened(error)}") from error
