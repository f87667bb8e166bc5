"""The error budget on one page: figures, charts within it, tables, and what is to be known of them."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hilstar.campaign.assessment.assess import Assessment
from hilstar.campaign.assessment.figures import lines_of, rows_of
from hilstar.campaign.assessment.slices import Slice
from hilstar.campaign.budget.places import axes_of
from hilstar.charts import STYLE
from hilstar.files import write_whole

MAX_POINTS = 4000
MAX_ROWS = 200
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 sans-serif; max-width: 1020px; margin: 2em auto; padding: 0 1em; color: #222 }}
table {{ border-collapse: collapse; margin: 1em 0 }}
td, th {{ padding: 3px 14px 3px 0; border-bottom: 1px solid #ddd; vertical-align: top; text-align: left }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums }}
img {{ max-width: 100% }}
.note {{ background: #fff6df; padding: .4em .8em; margin: .4em 0 }}
</style></head><body><h1>{title}</h1>{notes}{body}</body></html>
"""


def write_page(path: Path, found: Assessment) -> None:
    """Write the page of an assessment; it needs no other file. Raises InputError."""
    title = f"Error budget: {found.telemetry.path.name} against {found.run.path.name}"
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in found.notes)
    write_whole(
        path, PAGE.format(title=html.escape(title), notes=notes, body="".join(_sections(found))).encode(errors="replace")
    )


def _sections(found: Assessment) -> Iterator[str]:
    yield _table(("", ""), lines_of(found))
    yield "<h2>Budget</h2><p>One sigma an axis, with 95 % intervals by the block bootstrap.</p>"
    yield _table(("quantity", "axis", "value", "unit", "low", "high"), list(rows_of(found)))
    yield "<h2>Errors over the run</h2>" + _over_time(found)
    yield "<h2>What repeats with the place in the field</h2>" + _field_map(found)
    detail = found.found.components.pixel.detail or found.found.components.pixel.reason
    yield f"<p>Pixel error: {html.escape(detail)}.</p>"
    yield "<h2>Noise</h2>" + _histogram(found)
    for name, unit, slices in (("rate", "deg/s", found.by_rate), ("magnitude of the field", "V mag", found.by_magnitude)):
        if slices:
            yield f"<h2>By {name}</h2>" + _slices(unit, slices)
    if found.wrong:
        rows = [(each.row, each.t_s, each.run_s, each.off_deg) for each in found.wrong[:MAX_ROWS]]
        yield "<h2>Wrong answers</h2>" + _table(("row", "t_s", "run s", "off by, deg"), rows)
    if found.lock.outages:
        outages = [(o.start_s, o.length_s, "yes" if o.lost else "", o.rows, o.wrong) for o in found.lock.outages[:MAX_ROWS]]
        yield "<h2>Outages</h2>" + _table(("run s", "length, s", "lock lost", "rows", "wrong"), outages)


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: object) -> str:
    if value is None:
        return "<td>-</td>"
    if isinstance(value, float):
        return f'<td class="n">{value:.6g}</td>'
    return f'<td class="n">{value}</td>' if isinstance(value, int) else f"<td>{html.escape(str(value))}</td>"


def _slices(unit: str, slices: Sequence[Slice]) -> str:
    header = (f"from, {unit}", "to", "answers", "noise across", "noise about", "error across, rms", "error about, rms")
    rows = [
        (s.low, s.high, s.answers, s.noise_cross_arcsec, s.noise_roll_arcsec, s.rms_cross_arcsec, s.rms_roll_arcsec)
        for s in slices
    ]
    return _table(header, rows) + "<p>Arcsec; the error's rms is about the bias.</p>"


def _image(figure: object, alt: str) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)  # type: ignore[attr-defined]
    return f'<p><img alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}"></p>'


def _over_time(found: Assessment) -> str:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    parts = found.found.components
    valid = np.flatnonzero(found.telemetry.valid)
    t_s = found.t_s[valid[found.found.row]]
    some = np.unique(np.linspace(0, len(t_s) - 1, MAX_POINTS).astype(int))
    repeating = parts.fov.fitted + parts.pixel.fitted
    with rc_context(STYLE):
        figure = Figure(figsize=(9.5, 7), layout="constrained")
        for axis, name, k in zip(figure.subplots(3, 1, sharex=True), ("x", "y", "about the boresight"), range(3), strict=True):
            axis.plot(t_s[some], (repeating + parts.left)[some, k], ".", ms=2, color="#9bb8d3", label="error about the bias")
            axis.plot(
                t_s[some], parts.fov.fitted[some, k], ".", ms=2, color="#c0392b", label="repeats with the place in the field"
            )
            for each in found.lock.lost:
                axis.axvspan(each.start_s, each.start_s + each.length_s, color="#dddddd")
            for wrong in found.wrong:
                axis.axvline(wrong.run_s, color="#e6a100", lw=0.6)
            axis.set_ylabel(f"{name}, arcsec")
        axis.set_xlabel("run time, s (grey: lock lost; yellow: wrong answers)")
        figure.axes[0].legend(markerscale=6, loc="upper right", ncols=2)
        return _image(figure, "errors over the run")


def _field_map(found: Assessment) -> str:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    parts, scale = found.found.components, found.run.scale
    axes = axes_of(found.found.commanded_q)
    some = np.unique(np.linspace(0, len(axes) - 1, MAX_POINTS).astype(int))
    mean = axes[:, 2].mean(axis=0)
    size = float(np.linalg.norm(mean))
    seen = axes[some] @ (mean / max(size, 1e-9))
    if parts.fov.reason or seen[:, 2].min() < 0.3:
        reason = parts.fov.reason or "the run goes over too much of the sky for one map: see the chart over time"
        return f"<p>{html.escape(reason)}.</p>"
    place = scale.focal_px * seen[:, :2] / seen[:, 2:]
    with rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.6), layout="constrained")
        for k, (axis, name) in enumerate(zip(figure.subplots(1, 3), ("x", "y", "about the boresight"), strict=True)):
            value = parts.fov.fitted[some, k]
            limit = max(float(np.abs(value).max()), 1e-6)
            drawn = axis.scatter(*place.T, c=value, s=4, cmap="RdBu_r", vmin=-limit, vmax=limit)
            figure.colorbar(drawn, ax=axis, orientation="horizontal", label=f"{name}, arcsec")
            axis.set_aspect("equal", adjustable="datalim")
            axis.invert_yaxis()
            axis.set_xlabel("place of the star field, px")
        return _image(figure, "field-of-view error over the field")


def _histogram(found: Assessment) -> str:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    left, variance = found.found.components.left, found.found.components.noise_variance
    with rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.2), layout="constrained")
        for k, (axis, name) in enumerate(zip(figure.subplots(1, 3), ("x", "y", "about the boresight"), strict=True)):
            sigma = max(float(np.sqrt(variance[k])), 1e-9)
            edges = np.linspace(-5, 5, 61) * sigma
            axis.hist(left[:, k], edges, density=True, color="#9bb8d3")
            axis.plot(edges, np.exp(-0.5 * (edges / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)), color="#333")
            axis.set_yscale("log")
            axis.set_ylim(1e-4 / sigma, 1 / sigma)
            axis.set_xlabel(f"{name}, arcsec")
        return _image(figure, "noise, and the normal distribution")
