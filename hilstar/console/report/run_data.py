"""What a run's page is given: its figures along the run, reduced to minimum and maximum, and what happened in it."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from hilstar import __version__
from hilstar.arrays import FloatArray
from hilstar.bench.config import BenchConfig
from hilstar.run.record.ledger_reader import config_of
from hilstar.run.record.ledger_records import EventRecord
from hilstar.run.record.report import RunReport, table_rows
from hilstar.run.record.report_figures import COUNTS, METRICS, Figures
from hilstar.units import NS_PER_S

BINS = 60
HISTOGRAM_SPREAD = 99.9  # percent of the frames that a histogram shows; the worst is in the table
MIN_RANGE_MS, NARROWEST = 1e-3, 1e-9  # of a histogram, and of its values
MS_DIGITS, S_DIGITS, Q_DIGITS, ANGLE_DIGITS = 3, 3, 8, 6
MAX_WHO_CHARACTERS = 60
IN_ARCSEC_DEG = 0.2  # a motion over less is drawn in arcsec
POLE_DEG = 88.0  # beyond it right ascension and roll say nothing: turns about the camera's axes are drawn
NAMES = ("RA \N{MULTIPLICATION SIGN} cos Dec", "Dec", "roll")
AXES = ("about x (right)", "about y (down)", "about z (boresight)")
DISTRIBUTIONS = {
    "interval": "Interval between swaps",
    "late": "Swap later than predicted",
    "draw": "Start of drawing to swap",
    "age": "Age of the attitude at light",
    "prediction": "Predicted past the last packet",
    "packet": "Packet received to swap",
}


def run_data(name: str, run: Figures, summary: RunReport) -> dict[str, Any]:
    """The figures of a run as the page reads them: lists of numbers, None for no value; times in s from the first swap."""
    with np.errstate(all="ignore"):  # absurd figures of a foreign file become no value
        return _run_data(name, run, summary)


def _run_data(name: str, run: Figures, summary: RunReport) -> dict[str, Any]:
    config = config_of(run.head)
    rows = table_rows(summary)
    return {
        "about": _about(name, run, config),
        "verdict": verdict(summary, run.late),
        "summary": rows[:-3],
        "facts": rows[-3:],
        "bench_text": run.head.get("bench_text", ""),
        "duration_s": summary.duration_s,
        "spans": _spans(run),
        "packets": _packets(run),
        "process": _process(run),
        "motion": _motion(run.path.rows),
        "path": _path(run.path.rows),
        "histograms": _histograms(run),
        "stride": run.samples.stride,
        "refused": {reason: count for reason, count in summary.packets.items() if reason != "accepted"},
        "events": [_event(each, run) for each in (*run.first_events, *run.last_events)],
        "events_total": sum(run.events.values()),
    }


def _about(name: str, run: Figures, config: BenchConfig | None) -> dict[str, Any]:
    monitor = None if config is None else config.monitor
    return {
        "run": name,
        "bench": run.head.get("bench_file", ""),
        "version": __version__,
        "started_utc": _utc(run, run.first_swap_ns),
        "refresh_hz": None if monitor is None else monitor.refresh_hz,
        "resolution_px": None if monitor is None else monitor.resolution_px,
        "bits": None if monitor is None else monitor.bits,
    }


def verdict(found: RunReport, late: int) -> dict[str, Any]:
    """Whether the sky was right all along, in how many of the refresh periods it was, and why not in the others."""
    counted = (
        (found.blank_frames, "without an attitude"),
        (late, "with a stale attitude"),
        (found.hidden_frames, "not seen on the screen"),
        (found.operator_frames, "changed by the operator"),
    )
    reasons = [f"{number} of {found.frames} frames {what}" for number, what in counted if number]
    if found.missed_frames:
        reasons.append(f"{found.missed_frames} refresh periods without a frame of their own")
    headline = "Sky was right throughout" if not reasons else "Sky was not right throughout"
    share = _share(found.right_frames, found.frames + found.missed_frames)  # of the refresh periods in which a frame was due
    return {"ok": not reasons, "headline": headline, "share": share, "reasons": reasons}


def _share(part: int, whole: int) -> str:
    """A share of a run, rounded down: 100 % is said of all of it alone."""
    percent = 100 * part / max(whole, 1)
    digits = 3 if percent > 99.9 else 2 if percent > 99 else 1
    return f"{math.floor(percent * 10**digits) / 10**digits:.{digits}f} %"


def _utc(run: Figures, host_ns: int) -> str | None:
    """A moment of the run's host clock as UTC; None where the ledger's head does not say."""
    try:
        unix_ns = int(run.head["unix_ns"]) + host_ns - int(run.head["monotonic_ns"])
        return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=unix_ns // 1000)).isoformat(timespec="milliseconds")
    except (KeyError, ValueError, OverflowError):
        return None


def _numbers(values: FloatArray, digits: int) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in np.round(values, digits).tolist()]


def _spans(run: Figures) -> dict[str, Any]:
    told: dict[str, Any] = {"t_s": _numbers(run.spans.begin, S_DIGITS), "frames": run.spans.length}
    for number, name in enumerate((*METRICS, *COUNTS)):
        low, high, total = run.spans.column(number)
        if name in {"missed", "stale", "blank"}:
            told[name] = _numbers(total, 0)
        else:
            told[name] = [_numbers(low, MS_DIGITS), _numbers(high, MS_DIGITS)]
    return told


def _packets(run: Figures) -> dict[str, Any]:
    begin_s, rates_hz = run.packet_times.rates_hz(run.first_swap_ns)
    accepted, refused = (_numbers(rates_hz[:, kind], MS_DIGITS) for kind in range(2))
    width_s = run.packet_times.width_ns / NS_PER_S
    return {"t_s": _numbers(begin_s, S_DIGITS), "width_s": width_s, "accepted_hz": accepted, "refused_hz": refused}


def _process(run: Figures) -> dict[str, Any]:
    host_s, resident_mb, cpu_s = run.process.rows.T
    t_s = host_s - run.first_swap_ns / NS_PER_S
    step_s = np.diff(host_s, prepend=np.nan)
    share = np.where(step_s > 0, 100 * np.diff(cpu_s, prepend=np.nan) / step_s, np.nan)
    return {"t_s": _numbers(t_s, S_DIGITS), "resident_mb": _numbers(resident_mb, 2), "cpu_percent": _numbers(share, 1)}


def _histograms(run: Figures) -> list[dict[str, Any]]:
    found = []
    for name, title in DISTRIBUTIONS.items():
        values = run.samples.rows[:, METRICS.index(name)]
        values = values[np.isfinite(values)]
        if not len(values):
            continue
        low, high = np.percentile(values, [100 - HISTOGRAM_SPREAD, HISTOGRAM_SPREAD])
        narrowest = max(MIN_RANGE_MS, NARROWEST * max(abs(low), abs(high)))
        counts, edges = np.histogram(values, BINS, (low, max(high, low + narrowest)))
        found.append(
            {"name": name, "title": title, "from_ms": float(edges[0]), "to_ms": float(edges[-1]), "counts": counts.tolist()}
        )
    return found


def _event(record: EventRecord, run: Figures) -> dict[str, Any]:
    t_s = (record.host_ns - run.first_swap_ns) / NS_PER_S
    who = f" ({record.who[:MAX_WHO_CHARACTERS]})" if record.who and record.who not in record.detail else ""
    return {
        "t_s": round(t_s, S_DIGITS),
        "utc": _utc(run, record.host_ns),
        "kind": record.kind[:40],
        "line": record.detail + who,
    }


def _path(rows: FloatArray) -> dict[str, Any]:
    """The attitude along the run, and its rate in cam components, deg/s."""
    turned_deg = np.degrees(rows[:, 6:9])
    rate = np.diff(turned_deg, axis=0, append=np.nan) / np.diff(rows[:, 1], append=np.nan)[:, None]
    return {
        "t_s": _numbers(rows[:, 0], S_DIGITS),
        "q": np.round(rows[:, 2:6], Q_DIGITS).tolist(),
        "rate_deg_s": [_numbers(axis, 4) for axis in rate.T],
    }


def _motion(rows: FloatArray) -> dict[str, Any] | None:
    """Three angles about their mean, and what is left of the turns about the camera's axes beside a steady one."""
    if not len(rows):
        return None
    turned_rad = rows[:, 6:9]
    angles, names = _angles(rows[:, 2:6], turned_rad)
    about = _curves(angles - angles.mean(axis=0), names)
    return {"t_s": _numbers(rows[:, 0], S_DIGITS), "about_mean": about, "beside_steady": _curves(beside_steady(rows), AXES)}


def _curves(angles_deg: FloatArray, names: tuple[str, str, str]) -> dict[str, Any]:
    in_arcsec = float(np.ptp(angles_deg, axis=0).max()) < IN_ARCSEC_DEG
    scaled = angles_deg * (3600 if in_arcsec else 1)
    return {
        "unit": "arcsec" if in_arcsec else "\N{DEGREE SIGN}",
        "curves": {name: _numbers(values, ANGLE_DIGITS) for name, values in zip(names, scaled.T, strict=True)},
    }


def _angles(q: FloatArray, turned_rad: FloatArray) -> tuple[FloatArray, tuple[str, str, str]]:
    """Three angles of the camera's motion, deg (n, 3), and their names."""
    ra_deg, dec_deg, roll_deg = _radec_roll_deg(q)
    if np.abs(dec_deg).max() > POLE_DEG:
        return np.degrees(turned_rad), AXES
    ra_deg, roll_deg = (np.degrees(np.unwrap(np.radians(part))) for part in (ra_deg, roll_deg))
    return np.column_stack(((ra_deg - ra_deg.mean()) * np.cos(np.radians(dec_deg)), dec_deg, roll_deg)), NAMES


def _radec_roll_deg(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As `rotation.to_radec_roll_deg`, for an array (n, 4)."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    boresight = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    dec = np.arctan2(boresight[2], np.hypot(boresight[0], boresight[1]))
    ra = np.arctan2(boresight[1], boresight[0])
    right = (1 - 2 * (y * y + z * z)), 2 * (x * y - w * z)
    down = 2 * (x * y + w * z), (1 - 2 * (x * x + z * z))
    east = tuple(-np.sin(ra) * axis[0] + np.cos(ra) * axis[1] for axis in (right, down))
    return np.degrees(ra), np.degrees(dec), np.degrees(np.arctan2(east[1], -east[0]))


def beside_steady(rows: FloatArray) -> FloatArray:
    """The turns of a path's rows minus a straight line in the attitude's time fitted to each, deg (n, 3)."""
    turned_rad, at = rows[:, 6:9], rows[:, 1] - rows[:, 1].mean()
    spread = float((at * at).sum())
    slope = (at @ turned_rad) / spread if spread > 0 else np.zeros(3)
    return np.asarray(np.degrees(turned_rad - turned_rad.mean(axis=0) - at[:, None] * slope))
