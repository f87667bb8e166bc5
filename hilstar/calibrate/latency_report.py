"""The latency of a run: its figures for a person, and a chart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.calibrate.edges import Edges, square_edges
from hilstar.calibrate.latency import LatencySummary, Paired, pair, summarise
from hilstar.charts import BLUE, ORANGE, chart
from hilstar.errors import InputError
from hilstar.files import make_directory
from hilstar.run.record.ledger_reader import config_of, read_head, run_records
from hilstar.units import NS_PER_MS, NS_PER_S

BINS = 80
LEVEL_NAMES = {1: "dark to light", 0: "light to dark"}


def measure_latency(ledger: Path, edges: Edges, directory: Path | None) -> LatencySummary:
    """The figures of `hilstar latency`, and the chart `latency` in a directory where one is given.

    Raises InputError for a ledger or edges that do not fit each other.
    """
    config = config_of(read_head(ledger))
    if config is None:
        raise InputError(f"{ledger}: its header has no bench file that can be read; record the run again")
    shown = square_edges(run_records(ledger))
    if not len(shown.host_ns):
        raise InputError(f"{ledger}: its photodiode square never changed; record a longer run")
    paired = pair(edges, shown, NS_PER_S / config.monitor.refresh_hz)
    summary = summarise(paired, config)
    if directory is not None:
        draw_latency(make_directory(directory) / "latency", paired, summary)
    return summary


def latency_lines(summary: LatencySummary) -> list[str]:
    """The figures for a person."""
    latency, turn = summary.latency_ms, summary.beat
    every = "none" if turn.period_s is None else f"every {turn.period_s:.3g} s"
    cost = "-" if turn.worst_arcsec_per_deg_s is None else f"at most {turn.worst_arcsec_per_deg_s:.2g} arcsec at 1 deg/s"
    rise, fall = ("-" if value is None else f"{value:.2f}" for value in (summary.rise_ms, summary.fall_ms))
    figures = {
        "edges": f"{summary.edges} paired, {summary.unmatched} without a frame",
        "swap to light": f"{latency.p1:.2f} / {latency.p50:.2f} / {latency.p99:.2f} ms (p1 / p50 / p99)",
        "rise, fall": f"{rise}, {fall} ms (medians)",
        "jitter": f"{summary.jitter_ms:.3f} ms (standard deviation)",
        "beat with the exposure": f"{turn.refreshes_per_exposure:.3f} refreshes in one; {every}; {cost}",
        "of this, scan-out": f"{summary.swap_to_square_ms:.2f} ms to the square",
        "panel_delay_ms": f"{summary.panel_delay_ms:.3f}",
    }
    if summary.ambiguous:
        figures["note"] = 'a latency longer by whole pairs of frames fits too; [monitor] photodiode = "code" tells which'
    return [f"{what:24}{how_much}" for what, how_much in figures.items()]


def draw_latency(path: Path, paired: Paired, summary: LatencySummary) -> None:
    """The latencies of the edges, by their level."""
    middle, jitter = summary.latency_ms.p50, summary.jitter_ms
    with chart(path, f"From swap to light: {middle:.2f} ms, jitter {jitter:.3f} ms") as (axes,):
        ms = paired.latency_ns / NS_PER_MS
        bins = np.linspace(ms.min(), max(ms.max(), ms.min() + 1e-3), BINS).tolist()
        for (level, name), colour in zip(LEVEL_NAMES.items(), (BLUE, ORANGE), strict=True):
            axes.hist(ms[paired.level == level], bins=bins, color=colour, alpha=0.6, label=name)
        axes.set_xlabel("swap to the photodiode's edge [ms]")
        axes.set_ylabel("edges [number]")
        axes.margins(y=0.25)
        axes.legend(loc="upper right", ncols=2)
