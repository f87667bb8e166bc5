"""The step of latency: from swap to light, by a photodiode before the square on the display."""

from __future__ import annotations

import math

from hilstar.calibrate.first_light.records import Change, Figure, Outcome
from hilstar.calibrate.first_light.rooms import Room
from hilstar.calibrate.latency import LatencySummary, checked_delay_ms, draw_latency, pair, summarise
from hilstar.units import ERROR_OF_MEDIAN, NS_PER_S

WATCHED_S = 5.0  # some 150 edges at 60 Hz
AGREE_MS = 0.05  # less is no reason to change the bench file, nor to doubt a scan-out


def latency(room: Room) -> Outcome:
    """Measure the panel's delay and set it in the bench file. Raises InputError, MachineError."""
    monitor = room.file.config.monitor
    if not monitor.photodiode_px:
        return Outcome("skipped", "not measured: [monitor] photodiode_px is 0, so no square is shown for a photodiode")
    watched = room.eyes.diode(room.file, WATCHED_S)
    if watched is None:
        how = "--diode serial:/dev/ttyX@BAUD, with the display on this machine; or `hilstar latency` with the ledger of a run"
        return Outcome("skipped", f"not measured, the bench file's {monitor.panel_delay_ms:g} ms stays: give {how}")
    paired = pair(watched.seen, watched.shown, NS_PER_S / monitor.refresh_hz)
    found = summarise(paired, room.file.config)
    picture = room.session / "latency.png"
    draw_latency(picture, paired, found)
    delay_ms = checked_delay_ms(0.0 if -AGREE_MS < found.panel_delay_ms < 0 else found.panel_delay_ms)
    error_ms = ERROR_OF_MEDIAN * found.jitter_ms / math.sqrt(found.edges)
    figures = _figures(room, found, delay_ms, error_ms)
    line = (
        f"panel_delay_ms {delay_ms:g} +- {error_ms:.3f}, the bench file has {monitor.panel_delay_ms:g}; a swap is light at the"
        f" square after {found.latency_ms.p50:.2f} ms, jitter {found.jitter_ms:.3f}, {found.edges} edges"
    )
    if abs(delay_ms - monitor.panel_delay_ms) < max(AGREE_MS, 3 * error_ms):
        return Outcome("done", line, figures, (picture,), (picture,))
    change = Change(table="monitor", key="panel_delay_ms", before=monitor.panel_delay_ms, after=delay_ms)
    return Outcome("done", line, figures, (picture,), (picture,), (change,))


def _figures(room: Room, found: LatencySummary, delay_ms: float, error_ms: float) -> dict[str, Figure]:
    figures: dict[str, Figure] = {
        "panel_delay_ms": delay_ms,
        "error_ms": error_ms,
        "in_bench_file_ms": room.file.config.monitor.panel_delay_ms,
        "swap_to_light_p50_ms": found.latency_ms.p50,
        "swap_to_light_p99_ms": found.latency_ms.p99,
        "swap_to_square_ms": found.swap_to_square_ms,
        "jitter_ms": found.jitter_ms,
        "edges": found.edges,
        "edges_without_a_frame": found.unmatched,
    }
    figures |= {name: value for name, value in (("rise_ms", found.rise_ms), ("fall_ms", found.fall_ms)) if value is not None}
    if room.truth is not None:
        figures["truth_panel_delay_ms"] = room.truth.config.monitor.panel_delay_ms
    return figures
