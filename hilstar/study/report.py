"""The report of a run from its ledger: timing, age, missed frames and the path of the attitude, on one page."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.quaternion import to_matrix
from hilstar.bench.records import FrameRecord, Run, config_of, read_run
from hilstar.errors import InputError
from hilstar.study.charts import chart

NS_PER_MS = 1e6
NS_PER_S = 1e9
MEGABYTE = 1e6
WARM_UP_S = 60.0  # after so long the process has all the memory that it wants
BINS = 80
HISTOGRAM_SPREAD = 99.9  # percent of the frames that a histogram shows; the worst is in the table
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 sans-serif; max-width: 1020px; margin: 2em auto; padding: 0 1em; color: #222 }}
table {{ border-collapse: collapse; margin: 1em 0 }}
td {{ padding: 3px 14px 3px 0; border-bottom: 1px solid #ddd; vertical-align: top }}
img {{ max-width: 100% }}
</style></head><body><h1>{title}</h1><table>{rows}</table>{figures}</body></html>
"""


@dataclass(frozen=True, slots=True)
class Times:
    """Of each frame, (n,): seconds since the first swap, and what ms the others name; NaN where there is none."""

    run_s: FloatArray
    interval_ms: FloatArray
    late_ms: FloatArray
    draw_ms: FloatArray
    age_ms: FloatArray
    prediction_ms: FloatArray
    packet_ms: FloatArray
    missed_before: FloatArray


def times_of(frames: list[FrameRecord]) -> Times:
    """The times of a run's frames; an interval over missed frames is none."""

    def ms(value: Callable[[FrameRecord], float | None]) -> FloatArray:
        values = (value(frame) for frame in frames)
        return np.array([math.nan if v is None else v / NS_PER_MS for v in values])

    swap_ns = np.array([frame.swap_ns for frame in frames], dtype=np.float64)
    missed = np.array([frame.missed_before for frame in frames], dtype=np.float64)
    interval_ms = np.diff(swap_ns, prepend=math.nan) / NS_PER_MS
    return Times(
        run_s=(swap_ns - swap_ns[0]) / NS_PER_S,
        interval_ms=np.where(missed > 0, math.nan, interval_ms),
        late_ms=ms(lambda f: None if f.predicted_swap_ns is None else f.swap_ns - f.predicted_swap_ns),
        draw_ms=ms(lambda f: f.swap_ns - f.draw_ns),
        age_ms=ms(lambda f: f.age_ns),
        prediction_ms=ms(lambda f: f.prediction_ns),
        packet_ms=ms(lambda f: None if f.receive_ns is None else f.swap_ns - f.receive_ns),
        missed_before=missed,
    )


def summarise(run: Run) -> dict[str, Any]:
    """The figures of a run: the JSON object of `hilstar report`."""
    times, last = times_of(run.frames), run.frames[-1]
    config = config_of(run)
    refresh_hz = None if config is None else config.monitor.refresh_hz
    duration_s = float(times.run_s[-1])
    age = known(times.age_ms)
    return {
        "frames": len(run.frames),
        "duration_s": duration_s,
        "missed_frames": last.missed,
        "stale_frames": sum(frame.stale for frame in run.frames),
        "blank_frames": sum(frame.q is None for frame in run.frames),
        "timestamp_source": last.timestamp_source,
        "refresh_hz": refresh_hz,
        "pacing_jitter_ms": deviation(times.interval_ms),
        "interval_ms": spread_of(times.interval_ms),
        "swap_late_ms": spread_of(times.late_ms),
        "draw_to_swap_ms": spread_of(times.draw_ms),
        "attitude_age_ms": spread_of(age),
        "attitude_age_frames": None if refresh_hz is None else spread_of(age * refresh_hz / 1e3),
        "prediction_ms": spread_of(times.prediction_ms),
        "packet_to_swap_ms": spread_of(times.packet_ms),
        "packets": run.packets,
        "clipped": max(frame.clipped for frame in run.frames),
        "below_step": max(frame.below_step for frame in run.frames),
        "stars_drawn": max(frame.stars_drawn for frame in run.frames),
        "memory_growth_mb": memory_growth_mb(run),
        "bench_sha256": run.head.get("bench_sha256"),
        "calibration": run.head.get("calibration"),
        "calibration_sha256": run.head.get("calibration_sha256"),
        "gl_renderer": run.head.get("gl_renderer"),
    }


def memory_growth_mb(run: Run) -> float | None:
    """How much more memory the process has at the end than after its first minute; None for a shorter run."""
    after = [p for p in run.process if p.host_ns - run.process[0].host_ns >= WARM_UP_S * NS_PER_S]
    return (after[-1].resident_bytes - after[0].resident_bytes) / MEGABYTE if len(after) > 1 else None


def known(values: FloatArray) -> FloatArray:
    """Those that are."""
    return values[np.isfinite(values)]


def spread_of(values: FloatArray) -> dict[str, float | None]:
    """Median, 99th percentile and greatest; nulls without any."""
    some = known(values)
    figures = np.percentile(some, [50, 99, 100]).tolist() if len(some) else [None] * 3
    return dict(zip(("p50", "p99", "max"), figures, strict=True))


def deviation(values: FloatArray) -> float | None:
    """The standard deviation; None without two."""
    some = known(values)
    return float(some.std()) if len(some) > 1 else None


def report(path: Path, directory: Path) -> dict[str, Any]:
    """Write `report.html`, its figures and `report.json` of a ledger into a directory; the figures.

    Raises InputError for a file that is no ledger, and where it cannot write.
    """
    run = read_run(path)
    summary = summarise(run)
    times = times_of(run.frames)
    figures = [draw(run, times, directory) for draw in (_timing, _ages, _missed, _path, _stars, _memory)]
    page = PAGE.format(
        title=html.escape(f"Run {path.name}"),
        rows="".join(f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td></tr>" for a, b in table_rows(summary)),
        figures="".join(f'<p><img alt="{f.stem}" src="data:image/png;base64,{_base64(f)}"></p>' for f in figures if f),
    )
    _write(directory / "report.html", page.encode(errors="replace"))
    _write(directory / "report.json", msgspec.json.format(msgspec.json.encode(summary)))
    return summary


def table_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """The figures for a person: what, and how much."""
    refused = sum(count for reason, count in summary["packets"].items() if reason != "accepted")

    def three(key: str, unit: str = "ms") -> str:
        values = [(summary[key] or {}).get(name) for name in ("p50", "p99", "max")]
        return " / ".join("-" if v is None else f"{v:.2f}" for v in values) + f" {unit} (p50 / p99 / max)"

    def number(key: str, unit: str) -> str:
        return "-" if summary[key] is None else f"{summary[key]:.2f} {unit}"

    frames = f"{summary['frames']} in {summary['duration_s']:.1f} s, {summary['missed_frames']} missed"
    return [
        ("frames", f"{frames}, {summary['stale_frames']} stale, {summary['blank_frames']} blank"),
        ("time stamps", f"{summary['timestamp_source']}; the bench's refresh is {number('refresh_hz', 'Hz')}"),
        ("pacing jitter", f"{number('pacing_jitter_ms', 'ms')} (standard deviation of the interval between swaps)"),
        ("interval", three("interval_ms")),
        ("swap after its prediction", three("swap_late_ms")),
        ("drawing begun to swap", three("draw_to_swap_ms")),
        ("age of the attitude at light", f"{three('attitude_age_ms')} = {three('attitude_age_frames', 'frames')}"),
        ("predicted past the last packet", three("prediction_ms")),
        ("packet to swap", three("packet_to_swap_ms")),
        ("packets", f"{summary['packets'].get('accepted', 0)} accepted, {refused} refused"),
        ("stars", f"{summary['stars_drawn']} at most, {summary['clipped']} clipped, {summary['below_step']} under a step"),
        ("memory after the first minute", number("memory_growth_mb", "MB more at the end")),
        ("bench file", f"SHA-256 {summary['bench_sha256']}"),
        ("calibration", f"{summary['calibration']}, SHA-256 {summary['calibration_sha256']}"),
        ("renderer", str(summary["gl_renderer"])),
    ]


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def _histogram(axes: Any, values: FloatArray, label: str) -> None:
    some = known(values)
    if len(some):
        low, high = np.percentile(some, [100 - HISTOGRAM_SPREAD, HISTOGRAM_SPREAD])
        axes.hist(some, bins=BINS, range=(low, max(high, low + 1e-3)), color="#2b6ca3")
    axes.set_xlabel(label)
    axes.set_ylabel("frames")
    axes.set_yscale("log")


def _timing(run: Run, times: Times, directory: Path) -> Path | None:
    path, jitter = directory / "timing.png", deviation(times.interval_ms)
    finding = "One swap only" if jitter is None else f"The interval between swaps has a standard deviation of {jitter:.2f} ms"
    with chart(path, finding, panels=3, share_x=False) as (interval, late, draw):
        _histogram(interval, times.interval_ms, "interval between swaps, ms")
        _histogram(late, times.late_ms, "swap after its prediction, ms")
        _histogram(draw, times.draw_ms, "drawing begun to swap, ms")
    return path


def _ages(run: Run, times: Times, directory: Path) -> Path | None:
    p99 = spread_of(times.age_ms)["p99"]
    if p99 is None:
        return None
    path = directory / "age.png"
    with chart(path, f"99 % of frames show an attitude at most {p99:.1f} ms old at light", panels=2, share_x=False) as axes:
        _histogram(axes[0], times.age_ms, "age of the newest packet at light, ms")
        _histogram(axes[1], times.packet_ms, "packet received to swap, ms")
    return path


def _missed(run: Run, times: Times, directory: Path) -> Path | None:
    path, total = directory / "missed.png", int(times.missed_before.sum())
    with chart(path, f"{total} refresh periods had no frame of their own", panels=2) as (interval, age):
        interval.plot(times.run_s, times.interval_ms, ",", color="#2b6ca3")
        for moment in times.run_s[times.missed_before > 0]:
            interval.axvline(moment, color="#c33", alpha=0.4, linewidth=0.8)
        interval.set_ylabel("interval, ms\n(red: frames missed)")
        age.plot(times.run_s, times.age_ms, ",", color="#2b6ca3")
        age.set_ylabel("age at light, ms")
        age.set_xlabel("run, s")
    return path


def _path(run: Run, times: Times, directory: Path) -> Path | None:
    shown = [frame.q for frame in run.frames if frame.q is not None]
    if not shown:
        return None
    boresight = np.array([to_matrix(np.array(q))[2] for q in shown])
    ra_deg = np.degrees(np.unwrap(np.arctan2(boresight[:, 1], boresight[:, 0])))
    dec_deg = np.degrees(np.arcsin(np.clip(boresight[:, 2], -1, 1)))
    path = directory / "attitude.png"
    with chart(path, f"Boresight of {len(shown)} frames, ICRS") as (axes,):
        axes.plot(ra_deg, dec_deg, ".", markersize=2, color="#2b6ca3")
        axes.plot(ra_deg[:1], dec_deg[:1], "o", color="#2a2", label="first")
        axes.plot(ra_deg[-1:], dec_deg[-1:], "s", color="#c33", label="last")
        axes.ticklabel_format(useOffset=False)
        axes.set_xlabel("right ascension, deg (unwrapped)")
        axes.set_ylabel("declination, deg")
        axes.invert_xaxis()
        axes.legend()
    return path


def _stars(run: Run, times: Times, directory: Path) -> Path | None:
    path = directory / "stars.png"
    most = max(frame.clipped for frame in run.frames)
    with chart(path, f"Stars on the screen; {most} clipped at most") as (axes,):
        for name in ("stars_drawn", "clipped", "below_step"):
            axes.plot(times.run_s, [getattr(frame, name) for frame in run.frames], label=name.replace("_", " "))
        axes.set_xlabel("run, s")
        axes.set_ylabel("stars")
        axes.legend()
    return path


def _memory(run: Run, times: Times, directory: Path) -> Path | None:
    if len(run.process) < 2:
        return None
    growth = memory_growth_mb(run)
    finding = "Memory of the process" if growth is None else f"After the first minute memory grows by {growth:.2f} MB"
    path = directory / "memory.png"
    with chart(path, finding) as (axes,):
        seconds = [(p.host_ns - run.process[0].host_ns) / NS_PER_S for p in run.process]
        axes.plot(seconds, [p.resident_bytes / MEGABYTE for p in run.process])
        axes.ticklabel_format(useOffset=False)
        axes.set_xlabel("run, s")
        axes.set_ylabel("resident, MB")
    return path
