"""An assessment for its readers: the JSON object, tables, lines on the terminal, and one page
with charts.
"""

from collections.abc import Iterator
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, MUTED, label_ends, panels_of, write_csv
from hilstar.basics.files import write_whole
from hilstar.basics.html_pages import drawing_of, escaped, page_of, table_of
from hilstar.basics.rotation import to_matrix
from hilstar.instruments.assess.assessment import Assessment
from hilstar.instruments.assess.bench_effects import Slice
from hilstar.instruments.assess.budget import Axes, Decomposed, DecomposedRun
from hilstar.server.bench.certificate import Certificate, off_by

COUNT = "1"  # the unit of counts and shares in the tables
PARTS = {"fov": "field-of-view error", "pixel": "pixel error", "noise": "noise"}
MAX_NAMED = 10
MAX_POINTS = 4000
MAX_ROWS = 200
AXES = ("x", "y", "about the boresight")


def budget_of(found: Assessment) -> dict[str, Any]:
    """The JSON object of `hilstar assess`.

    `clock` is the tracker's minus the run's at the run's start, and its excess rate; null where the
    motion does not tell.
    """
    parts, clock = found.found, found.found.clock
    return {
        "bias_arcsec": parts.bias_arcsec.tolist(),
        "fov_arcsec": parts.fov_arcsec,
        "pixel_arcsec": parts.pixel_arcsec,
        "noise_arcsec": found.noise_arcsec,
        "clock": {
            "offset_ms": 1e3 * found.offset_s if clock.offset_told else None,
            "drift_ppm": 1e6 * clock.drift if clock.drift_told else None,
            "sigma_ms": 1e3 * clock.sigma_offset_s,
        },
        "availability": found.lock.availability,
        "wrong": found.wrong,
        "missed": {"frames": found.run.run.missed, "answers_left_out": len(parts.held)},
        "out_of_order": found.out_of_order,
        "limit_arcsec": found.limit_arcsec,
        **({} if found.glass is None else {"glass": found.glass}),
        **({} if found.certificate is None else {"bench": bench_part(found.certificate, parts)}),
    }


def bench_part(certificate: Certificate, parts: DecomposedRun) -> dict[str, Any]:
    """How much of the tracker's bias the bench could have made: how far it may be off at 95 %,
    and that over the bias.
    """
    bias = np.abs(parts.bias_arcsec)
    found: dict[str, Any] = {
        "certificate": certificate.number,
        "off_arcsec": None,
        "share_of_bias": None,
    }
    if certificate.attitude_arcsec is not None:
        sizes = zip(
            ("cross", "roll"),
            certificate.attitude_arcsec,
            (float(np.hypot(*bias[:2])), float(bias[2])),
            strict=True,
        )
        each = {
            name: (own, min(own / measured, 1.0) if measured else 1.0)
            for name, own, measured in sizes
        }
        found["off_arcsec"] = {name: own for name, (own, _) in each.items()}
        found["share_of_bias"] = {name: share for name, (_, share) in each.items()}
    return found


class FigureRow(NamedTuple):
    """A row of budget.csv, here and in a campaign's directory: None is an empty cell."""

    quantity: str
    axis: str
    value: float | int | None
    unit: str = COUNT
    low_95: float | None = None
    high_95: float | None = None


def part_rows(parts: Decomposed | None, noise_arcsec: Axes) -> Iterator[FigureRow]:
    """The rows of bias, field-of-view error, pixel error and noise; without values where `parts`
    is None.
    """
    for k, axis in enumerate("xyz"):
        value = None if parts is None else float(parts.bias_arcsec[k])
        yield FigureRow(
            "bias",
            axis,
            value,
            "arcsec",
            *([] if parts is None else parts.intervals.bias[:, k].tolist()),
        )
    for part, name in PARTS.items():
        axes = (
            noise_arcsec if part == "noise" or parts is None else getattr(parts, f"{part}_arcsec")
        )
        for k, axis in enumerate(("cross", "roll")):
            value = getattr(axes, axis)
            ends = (
                []
                if parts is None or value is None
                else getattr(parts.intervals, part)[:, k].tolist()
            )
            yield FigureRow(name, axis, value, "arcsec", *ends)


def limit_rows(limit: Axes | None) -> Iterator[FigureRow]:
    """The rows of the smallest noise that the tracker's stars allow."""
    for axis in ("cross", "roll") if limit is not None else ():
        yield FigureRow("limit of the tracker's stars", axis, getattr(limit, axis), "arcsec")


def limit_text(limit: Axes | None) -> str:
    """The smallest noise that a tracker's stars allow, in words."""
    if limit is None or limit.cross is None or limit.roll is None:
        return "not known"
    return (
        f"{limit.cross:.3g} arcsec across, {limit.roll:.3g} about the boresight (Cramer-Rao, one"
        " exposure at rest)"
    )


def rows_of(found: Assessment) -> Iterator[FigureRow]:
    """The rows of budget.csv."""
    yield from part_rows(found.found, found.noise_arcsec)
    clock = found.found.clock
    for name, value, sigma, unit, told in (
        ("clock offset", 1e3 * found.offset_s, 1e3 * clock.sigma_offset_s, "ms", clock.offset_told),
        ("clock drift", 1e6 * clock.drift, 1e6 * clock.sigma_drift, "ppm", clock.drift_told),
    ):
        yield FigureRow(
            name, "", value if told else None, unit, value - 1.96 * sigma, value + 1.96 * sigma
        )
    lock = found.lock
    yield FigureRow("availability", "", lock.availability)
    yield FigureRow("answers due", "", lock.due)
    yield FigureRow("right answers", "", lock.right)
    yield FigureRow("wrong answers", "", len(found.wrong))
    yield FigureRow("missed frames", "", found.run.run.missed)
    yield FigureRow("answers left out for held frames", "", len(found.found.held))
    yield FigureRow("answers out of order", "", found.out_of_order)
    yield FigureRow("lock lost", "", len(lock.lost))
    yield FigureRow("acquisition probability", "", lock.acquisition_probability)
    yield FigureRow("acquisition time, median", "", lock.acquisition_s, "s")
    if found.display is not None:
        yield FigureRow("display's own error", "cross", found.display.cross_arcsec, "arcsec")
        yield FigureRow("display's own error", "roll", found.display.roll_arcsec, "arcsec")
        yield FigureRow("display's own error, share seen", "", found.display.seen)
    yield from limit_rows(found.limit_arcsec)
    for name, axes in found.glass.fov_arcsec.items() if found.glass is not None else ():
        for axis in ("cross", "roll"):
            yield FigureRow(f"glass {name.replace('_', ' ')}", axis, getattr(axes, axis), "arcsec")


def write_tables(directory: Path, found: Assessment) -> None:
    """Write budget.csv, slices.csv, wrong.csv and outages.csv. Raises InputError."""
    write_csv(directory / "budget.csv", FigureRow._fields, [_plain(row) for row in rows_of(found)])
    slices = [("rate_deg_s", each) for each in found.by_rate] + [
        ("field_v_mag", each) for each in found.by_magnitude
    ]
    names = ["by", *(field.name for field in fields(Slice))]
    write_csv(
        directory / "slices.csv", names, [_plain((by, *astuple(each))) for by, each in slices]
    )
    write_csv(
        directory / "wrong.csv",
        ("row", "t_s", "run_s", "off_deg"),
        [
            (each.row, repr(each.t_s), f"{each.run_s:.6f}", f"{each.off_deg:.6g}")
            for each in found.wrong
        ],
    )
    write_csv(
        directory / "outages.csv",
        ("run_s", "length_s", "lost", "rows", "wrong"),
        [
            (f"{o.start_s:.6f}", f"{o.length_s:.6f}", int(o.lost), o.rows, o.wrong)
            for o in found.lock.outages
        ],
    )


def _plain(row: tuple[object, ...]) -> list[object]:
    return [
        "" if value is None else f"{value:.9g}" if isinstance(value, float) else value
        for value in row
    ]


def lines_of(found: Assessment) -> list[tuple[str, str]]:
    """The lines of the assessment on the terminal: name and text."""
    parts, lock, clock, display = found.found, found.lock, found.found.clock, found.display
    x, y, z = parts.bias_arcsec.tolist()
    named = ", ".join(str(each.row) for each in found.wrong[:MAX_NAMED]) + (
        ", ..." if len(found.wrong) > MAX_NAMED else ""
    )
    where = "on lines" if found.telemetry.of_lines else "attitudes"
    offset = (
        f"{1e3 * found.offset_s:.3f} +- {1e3 * clock.sigma_offset_s:.2g} ms"
        if clock.offset_told
        else "unknown"
    )
    drift = f"{1e6 * clock.drift:.2f} +- {1e6 * clock.sigma_drift:.2g} ppm"
    share, wait_s = lock.acquisition_probability, lock.acquisition_s
    wait = "-" if wait_s is None else f"{wait_s:.3g}"
    own = "not looked at"
    if display is not None:
        own = (
            f"{display.cross_arcsec:.2g} arcsec across, {display.roll_arcsec:.2g} about the"
            " boresight,"
        )
        own += (
            f" at {display.attitudes} attitudes; {display.seen:.2f} +- {display.sigma_seen:.2f} of"
            " it in the answers"
        )
    answers = (
        f"{len(parts.row)} right of {int(found.telemetry.valid.sum())} valid and"
        f" {len(found.telemetry.t_ns)} rows"
    )
    answers += (
        f"; {found.out_of_order} came out of order, sorted by their stamps"
        if found.out_of_order
        else ""
    )
    return [
        ("answers", answers),
        ("missed frames", found.missed_line),
        ("bias", f"x {x:.2f}, y {y:.2f}, about the boresight {z:.2f} arcsec"),
        ("field-of-view error", _text(parts.fov_arcsec, parts.intervals.fov)),
        ("pixel error", _text(parts.pixel_arcsec, parts.intervals.pixel)),
        ("noise", _text(found.noise_arcsec, parts.intervals.noise)),
        (
            "clock",
            (
                f"offset {offset}, fast by {drift}"
                if clock.drift_told
                else "cannot be told: the run does not turn enough"
            ),
        ),
        (
            "availability",
            (
                f"{100 * lock.availability:.2f} % of {lock.due} answers due, one each"
                f" {1e3 * lock.cycle_s:.4g} ms"
            ),
        ),
        ("lock lost", f"{len(lock.lost)} times"),
        ("acquisition", "-" if share is None else f"{100 * share:.0f} %, median {wait} s"),
        ("wrong", f"{len(found.wrong)}, {where} {named}" if found.wrong else "none"),
        ("display's own error", own),
        ("limit of its stars", limit_text(found.limit_arcsec)),
        *([("bench's own error", _bench_text(found))] if found.certificate is not None else []),
        *([("glass", found.glass.line())] if found.glass is not None else []),
    ]


def _bench_text(found: Assessment) -> str:
    assert found.certificate is not None
    part = bench_part(found.certificate, found.found)
    said = f"{found.certificate.line}: {off_by(found.certificate)}"
    if part["share_of_bias"] is None:
        return said
    cross, roll = (100 * share for share in part["share_of_bias"].values())
    return (
        f"{said}; it could have made {cross:.0f} % of the bias across and {roll:.0f} % of that"
        " about"
    )


def _text(axes: Axes, interval: FloatArray) -> str:
    if axes.cross is None or axes.roll is None:
        return "cannot be told"
    (cross_low, roll_low), (cross_high, roll_high) = interval.tolist()
    cross = f"{axes.cross:.3g} ({cross_low:.3g} to {cross_high:.3g})"
    return (
        f"{cross} across, {axes.roll:.3g} ({roll_low:.3g} to {roll_high:.3g}) arcsec about the"
        " boresight"
    )


def write_page(path: Path, found: Assessment) -> None:
    """Write the page of an assessment as one file that needs no other. Raises InputError."""
    budget: list[tuple[object, ...]] = [
        (*row[:3], "" if row[3] == COUNT else row[3], *row[4:]) for row in rows_of(found)
    ]
    pixel = found.found.components.pixel
    body = [
        *(f'<p class="note">{escaped(note)}</p>' for note in found.notes),
        table_of(lines_of(found), ("", "")),
        "<h2>Budget</h2><p>One sigma an axis, with 95 % intervals by the block bootstrap.</p>",
        table_of(budget, ("quantity", "axis", "value", "unit", "low", "high")),
        "<h2>Errors over the run</h2>" + _over_time(found),
        "<h2>What repeats with the place in the field</h2>" + _field_map(found),
        f"<p>Pixel error: {escaped(pixel.detail or pixel.reason)}.</p>",
        "<h2>Noise</h2>" + _histogram(found),
    ]
    for name, unit, slices in (
        ("rate", "deg/s", found.by_rate),
        ("magnitude of the field", "V mag", found.by_magnitude),
    ):
        header = (
            f"from, {unit}",
            "to",
            "answers",
            "noise across",
            "noise about",
            "error across, rms",
            "error about, rms",
        )
        if slices:
            table = table_of([astuple(each) for each in slices], header)
            body.append(
                f"<h2>By {name}</h2>{table}<p>Arcsec; the error's rms is about the bias.</p>"
            )
    if found.wrong:
        wrong = table_of(
            [astuple(each) for each in found.wrong[:MAX_ROWS]],
            ("row", "t_s", "run s", "off by, deg"),
        )
        body.append("<h2>Wrong answers</h2>" + wrong)
    if found.lock.outages:
        outages = [
            (o.start_s, o.length_s, "yes" if o.lost else "", o.rows, o.wrong)
            for o in found.lock.outages[:MAX_ROWS]
        ]
        body.append(
            "<h2>Outages</h2>"
            + table_of(outages, ("run s", "length, s", "lock lost", "rows", "wrong"))
        )
    title = f"Error budget: {found.telemetry.path.name} against {found.run.path.name}"
    write_whole(path, page_of(title, body))


def _over_time(found: Assessment) -> str:
    parts = found.found.components
    valid = np.flatnonzero(found.telemetry.valid)
    t_s = found.t_s[valid[found.found.row]]
    some = np.unique(np.linspace(0, len(t_s) - 1, MAX_POINTS).astype(int))
    repeating = parts.fov.fitted + parts.pixel.fitted
    rms = np.sqrt(np.mean((repeating + parts.left) ** 2, axis=0))
    finding = (
        f"The error about the bias is {rms[0]:.2g} arcsec rms in x, {rms[1]:.2g} in y, {rms[2]:.2g}"
        " about the boresight"
    )
    note = (
        "Grey: the error. Blue: what of it repeats with the place in the field. Bands: lock lost."
        " Dotted lines: wrong answers."
    )
    with panels_of(finding, 3, note=note, height_inch=7.0) as panels:
        for axes, name, k in zip(panels, AXES, range(3), strict=True):
            axes.plot(
                t_s[some],
                (repeating + parts.left)[some, k],
                ".",
                ms=3.5,
                color=MUTED,
                rasterized=True,
            )
            axes.plot(
                t_s[some],
                parts.fov.fitted[some, k],
                ".",
                ms=2.5,
                color=BLUE,
                rasterized=True,
                label="repeats",
            )
            for each in found.lock.lost:
                axes.axvspan(
                    each.start_s, each.start_s + each.length_s, color=MUTED, alpha=0.3, lw=0
                )
            for wrong in found.wrong:
                axes.axvline(wrong.run_s, color=INK, lw=1, ls=":")
            axes.set_ylabel(f"{name} [arcsec]")
            label_ends(axes)
        panels[-1].set_xlabel("run time [s]")
    return drawing_of(panels[0].figure, "errors over the run")


def _field_map(found: Assessment) -> str:
    parts, scale = found.found.components, found.run.scale
    axes = to_matrix(found.found.commanded_q)
    some = np.unique(np.linspace(0, len(axes) - 1, MAX_POINTS).astype(int))
    mean = axes[:, 2].mean(axis=0)
    size = float(np.linalg.norm(mean))
    seen = axes[some] @ (mean / max(size, 1e-9))
    if parts.fov.reason or seen[:, 2].min() < 0.3:
        reason = (
            parts.fov.reason
            or "the run goes over too much of the sky for one map: see the chart over time"
        )
        return f"<p>{escaped(reason)}.</p>"
    place = scale.focal_px * seen[:, :2] / seen[:, 2:]
    largest = np.abs(parts.fov.fitted).max(axis=0)
    finding = (
        f"It is up to {largest[0]:.2g} arcsec in x, {largest[1]:.2g} in y and {largest[2]:.2g}"
        " about the boresight"
    )
    with panels_of(finding, 1, 3, share_x=False, height_inch=3.9) as panels:
        for k, (panel, name) in enumerate(zip(panels, AXES, strict=True)):
            value, limit = parts.fov.fitted[some, k], max(float(largest[k]), 1e-6)
            look: dict[str, Any] = {
                "cmap": "RdBu_r",
                "vmin": -limit,
                "vmax": limit,
                "rasterized": True,
            }
            drawn = panel.scatter(place[:, 0], place[:, 1], c=value, s=6, edgecolors="none", **look)
            panel.figure.colorbar(
                drawn, ax=panel, orientation="horizontal", label=f"{name} [arcsec]"
            )
            panel.set_aspect("equal", adjustable="datalim")
            panel.set_xlabel("star field x [px]")
            panel.invert_yaxis()
        panels[0].set_ylabel("star field y [px]")
    return drawing_of(panels[0].figure, "field-of-view error over the field")


def _histogram(found: Assessment) -> str:
    left, variance = found.found.components.left, found.found.components.noise_variance
    sigmas = np.sqrt(variance)
    finding = (
        f"Noise is {sigmas[0]:.2g} arcsec in x, {sigmas[1]:.2g} in y and {sigmas[2]:.2g} about the"
        " boresight, one sigma"
    )
    note = (
        "Bars: what is left when all that repeats is taken away. Line: the normal distribution of"
        " that sigma."
    )
    with panels_of(finding, 1, 3, share_x=False, note=note, height_inch=3.6) as panels:
        for k, (axes, name) in enumerate(zip(panels, AXES, strict=True)):
            sigma = max(float(sigmas[k]), 1e-9)
            edges = np.linspace(-5, 5, 61) * sigma
            axes.hist(left[:, k], edges.tolist(), density=True, color=BLUE, alpha=0.5)
            axes.plot(
                edges,
                np.exp(-0.5 * (edges / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)),
                color=INK,
                lw=1.2,
            )
            axes.set_yscale("log")
            axes.set_ylim(1e-6 / sigma, 1 / sigma)
            axes.set_xlabel(f"{name} [arcsec]")
        panels[0].set_ylabel("share [1/arcsec]")
    return drawing_of(panels[0].figure, "noise, and the normal distribution")
