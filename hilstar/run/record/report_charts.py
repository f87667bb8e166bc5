"""The charts of a run's report; each function draws one, or none if there is nothing to draw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import STYLE, chart, save, title_lines
from hilstar.run.record.report_figures import AGE, BELOW_STEP, CLIPPED, DRAWN, INTERVAL, METRICS, MISSED, Figures

BINS = 80
HISTOGRAM_SPREAD = 99.9  # percent of the frames that a histogram shows; the worst is in the table
BLUE, RED, GREEN = "#2b6ca3", "#c33", "#2a2"
IN_ARCSEC_DEG = 0.2  # a motion over less is drawn in arcsec
POLE_DEG = 88.0  # beyond it right ascension and roll say nothing: turns about the camera's axes are drawn
NAMES = ("right ascension x cos(dec)", "declination", "roll")
AXES = ("about x (right)", "about y (down)", "about z (boresight)")


def _histogram(axes: Any, values: FloatArray, label: str, stride: int) -> None:
    some = values[np.isfinite(values)]
    if len(some):
        low, high = np.percentile(some, [100 - HISTOGRAM_SPREAD, HISTOGRAM_SPREAD])
        axes.hist(some, bins=BINS, range=(low, max(high, low + 1e-3)), color=BLUE)
    axes.set_xlabel(label)
    axes.set_ylabel("frames" if stride == 1 else f"frames, each {stride}th")
    axes.set_yscale("log")


def _histograms(path: Path, finding: str, run: Figures, labels: dict[str, str]) -> Path | None:
    """A panel for each metric that the run has."""
    rows = run.samples.rows
    known = {name: rows[:, METRICS.index(name)] for name in labels}
    known = {name: values for name, values in known.items() if np.isfinite(values).any()}
    if not known:
        return None
    with chart(path, finding, panels=len(known), share_x=False) as panels:
        for axes, (name, values) in zip(panels, known.items(), strict=True):
            _histogram(axes, values, labels[name], run.samples.stride)
    return path


def timing(run: Figures, directory: Path) -> Path | None:
    """When frames were swapped, against when they were to be, and how long they took."""
    jitter = run.spreads["interval"].deviation
    finding = "One swap only" if jitter is None else f"The interval between swaps has a standard deviation of {jitter:.2f} ms"
    labels = {
        "interval": "interval between swaps, ms",
        "late": "swap later than predicted, ms",
        "draw": "start of drawing to swap, ms",
    }
    return _histograms(directory / "timing.png", finding, run, labels)


def ages(run: Figures, directory: Path) -> Path | None:
    """How old the attitude was that each frame showed."""
    p99 = run.spreads["age"].percentile(99)
    if p99 is None:
        return None
    labels = {"age": "age of the newest packet at light, ms", "packet": "packet received to swap, ms"}
    finding = f"99 % of frames show an attitude at most {p99:.1f} ms old at light"
    return _histograms(directory / "age.png", finding, run, labels)


def missed(run: Figures, directory: Path) -> Path | None:
    """Intervals and ages along the run, and where frames were missed."""
    path = directory / "missed.png"
    _, _, _, lost = run.spans.column(MISSED)
    _, _, oldest, _ = run.spans.column(AGE)
    panels: list[Callable[[Any], None]] = [lambda axes: _envelope(axes, run, INTERVAL, "interval, ms")]
    if lost.any():
        panels.append(lambda axes: _losses(axes, run))
    if oldest.any():
        panels.append(lambda axes: _envelope(axes, run, AGE, "age at light, ms"))
    with chart(path, f"{int(lost.sum())} refresh periods had no frame of their own", panels=len(panels)) as drawn:
        for draw, axes in zip(panels, drawn, strict=True):
            draw(axes)
        drawn[-1].set_xlabel("run, s")
    return path


def _losses(axes: Any, run: Figures) -> None:
    at, _, _, lost = run.spans.column(MISSED)
    axes.vlines(at[lost > 0], 0, lost[lost > 0], color=RED, linewidth=2.5)
    axes.plot(at[lost > 0], lost[lost > 0], "o", color=RED, markersize=5)
    axes.set_ylim(0, float(lost.max()) * 1.15)
    axes.set_ylabel("missed periods")


def _envelope(axes: Any, run: Figures, column: int, label: str) -> None:
    """Minimum and maximum of each span of the run: no outlier is too thin to be seen."""
    at, low, high, _ = run.spans.column(column)
    axes.fill_between(at, low, high, color=BLUE, alpha=0.35, linewidth=0)
    axes.plot(at, high, color=BLUE, linewidth=1.2, label="maximum")
    axes.plot(at, low, color=BLUE, linewidth=1.2, alpha=0.6, label="minimum")
    axes.set_ylabel(label)


def stars(run: Figures, directory: Path) -> Path | None:
    """Stars on the screen along the run."""
    path = directory / "stars.png"
    with chart(path, f"Stars on the screen; {run.most['clipped']} clipped at most") as (axes,):
        for column, name in ((DRAWN, "stars drawn"), (CLIPPED, "clipped"), (BELOW_STEP, "below step")):
            at, _, high, _ = run.spans.column(column)
            axes.plot(at, high, label=name)
        axes.set_xlabel("run, s")
        axes.set_ylabel("stars")
        axes.legend()
    return path


def memory(run: Figures, directory: Path) -> Path | None:
    """The process's memory along the run."""
    rows, growth = run.process.rows, run.memory_growth_mb
    if len(rows) < 2:
        return None
    finding = "Memory of the process" if growth is None else f"After the first minute memory grows by {growth:.2f} MB"
    path = directory / "memory.png"
    with chart(path, finding) as (axes,):
        axes.plot(rows[:, 0], rows[:, 1])
        axes.ticklabel_format(useOffset=False)
        axes.set_xlabel("run, s")
        axes.set_ylabel("resident, MB")
    return path


def attitude(run: Figures, directory: Path) -> Path | None:
    """The track over the sky, the motion, and its residual against a steady turn."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    rows = run.path.rows
    if not len(rows):
        return None
    t_s, turned = rows[:, 0], rows[:, 5:8]
    angles, names = _angles(rows[:, 1:5], turned)
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 11.0), layout="constrained")
        grid = figure.add_gridspec(3, 1, height_ratios=(1.25, 1, 1))
        _track(figure.add_subplot(grid[0], projection="mollweide"), rows[:, 1:5])
        moving = figure.add_subplot(grid[1])
        _lines(moving, t_s, angles - angles.mean(axis=0), names)
        moving.set_title("about the mean", fontsize=11)
        rest = figure.add_subplot(grid[2], sharex=moving)
        _lines(rest, t_s, _beside_steady(t_s, turned), AXES)
        rest.set_title("residual against a steady turn about the camera's axes", fontsize=11)
        rest.set_xlabel("time of the attitude, s")
        figure.suptitle(title_lines(_finding(angles, names, rows[:, 1:5])), fontsize=12)
        save(figure, directory / "attitude.png")
    return directory / "attitude.png"


def _finding(angles: FloatArray, names: tuple[str, str, str], q: FloatArray) -> str:
    ra_deg, dec_deg, roll_deg = (float(part[0]) for part in _radec_roll_deg(q))
    spans = np.ptp(angles, axis=0)
    moved = ", ".join(f"{name} {_amount(float(span))}" for name, span in zip(names, spans, strict=True))
    return f"From RA {ra_deg % 360:.3f}, Dec {dec_deg:.3f}, roll {roll_deg % 360:.3f} degrees; spans: {moved}"


def _amount(span_deg: float) -> str:
    return f"{span_deg * 3600:.3g} arcsec" if span_deg < IN_ARCSEC_DEG else f"{span_deg:.4g} degrees"


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


def _beside_steady(t_s: FloatArray, turned_rad: FloatArray) -> FloatArray:
    """The turns minus a straight line fitted to each, deg (n, 3)."""
    at = t_s - t_s.mean()
    spread = float((at * at).sum())
    slope = (at @ turned_rad) / spread if spread > 0 else np.zeros(3)
    return np.asarray(np.degrees(turned_rad - turned_rad.mean(axis=0) - at[:, None] * slope))


def _lines(axes: Any, t_s: FloatArray, angles_deg: FloatArray, names: tuple[str, str, str]) -> None:
    in_arcsec = float(np.ptp(angles_deg, axis=0).max()) < IN_ARCSEC_DEG
    for values, name, style in zip(angles_deg.T, names, ("-", "--", ":"), strict=True):
        axes.plot(t_s, values * (3600 if in_arcsec else 1), style, label=name, linewidth=1.6)
    axes.set_ylabel("arcsec" if in_arcsec else "degrees")
    low, high = axes.get_ylim()
    if in_arcsec and high - low < 1e-3:  # rounding is no motion
        axes.set_ylim(-1e-3, 1e-3)
    axes.ticklabel_format(useOffset=False)
    axes.legend(loc="best", fontsize=9)


def _track(axes: Any, q: FloatArray) -> None:
    """The whole sky, east to the left, with the track of the boresight."""
    ra_deg, dec_deg, _ = _radec_roll_deg(q)
    x = -np.radians((ra_deg + 180) % 360 - 180)
    y = np.radians(dec_deg)
    breaks = np.flatnonzero(np.abs(np.diff(x)) > np.pi) + 1
    axes.plot(np.insert(x, breaks, np.nan), np.insert(y, breaks, np.nan), ".-", color=BLUE, markersize=3, linewidth=1.2)
    axes.plot(x[:1], y[:1], "o", color=GREEN, markersize=9, label="first")
    axes.plot(x[-1:], y[-1:], "s", color=RED, markersize=6, label="last")
    axes.set_xticks(
        np.radians(np.arange(-150, 180, 30)), [f"{-d % 360}\N{DEGREE SIGN}" for d in range(-150, 180, 30)], fontsize=8
    )
    axes.tick_params(axis="y", labelsize=8)
    axes.set_title("boresight, ICRS", fontsize=11)
    axes.legend(loc="lower right")


CHARTS = (timing, ages, missed, attitude, stars, memory)
