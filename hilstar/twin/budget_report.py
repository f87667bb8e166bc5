"""The budget for a person, and as a table and a chart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from hilstar.bench.white import named
from hilstar.charts import BLUE, MUTED, ORANGE, RED, SERIES, chart, label_ends, write_csv
from hilstar.tracker.centroiders import FAMILY
from hilstar.twin.budget import CENTROID_LIMIT_PX, COMPARED_MAG, FLUX_LIMITS_MAG, Budget, MagnitudeRow

MAX_NAMED = 20
MIN_ERROR = 1e-6  # as drawn


def write_report(directory: Path, found: Budget) -> None:
    """budget.csv, and its chart as budget.png and budget.svg. Raises InputError where one cannot be written."""
    rows = [_flat(row) for row in found.rows]
    write_csv(directory / "budget.csv", list(rows[0]), [["" if v is None else v for v in row.values()] for row in rows])
    reach = found.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    finding = f"{found.bits} bits, {found.method}: from V = {found.clips_v_mag:.1f}, where stars clip, within "
    finding += f"{FLUX_LIMITS_MAG[1]:g} mag over {'no' if reach is None else f'{reach:g}'} magnitudes"
    shown = [row for row in found.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    note = f"Left of the first grey line stars clip (V = {found.clips_v_mag:.2f}), right of the second they show nothing (V ="
    note += f" {found.nothing_v_mag:.2f}). Over sub-pixel phases; places by {found.centroider} but in the last panel."
    with chart(directory / "budget", finding, 3, note=note) as axes:
        for axis, kind, limits, label in (
            (axes[0], "flux", FLUX_LIMITS_MAG, "flux error [mag]"),
            (axes[1], "centroid", (CENTROID_LIMIT_PX,), "place error [monitor px]"),
        ):
            unit = "mag" if kind == "flux" else "px"
            for name, word, colour in (("max", "largest to V", ORANGE), ("rms", "rms", BLUE)):
                values = np.array([getattr(row, f"{kind}_{name}_{unit}") for row in shown])
                values = np.maximum.accumulate(values.astype(float)) if name == "max" else values
                axis.semilogy(v_mag, np.maximum(values, MIN_ERROR), color=colour, label=word)
            for limit in limits:
                axis.axhline(limit, color=RED, linestyle=":", linewidth=1.4, label=f"limit {limit:g} {unit}")
            axis.set_ylabel(label)
        for kind, colour in zip(FAMILY, SERIES, strict=True):
            values = np.array([row.axis_rms_px[kind] for row in shown])
            axes[2].semilogy(v_mag, np.maximum(values, MIN_ERROR), "--" if kind == "fit" else "-", color=colour, label=kind)
        axes[2].set_ylabel("rms along an axis [monitor px]")
        axes[2].set_xlabel("V of a star of the Sun's colour [mag]")
        for axis in axes:
            for edge in (found.clips_v_mag, found.nothing_v_mag):
                axis.axvline(edge, color=MUTED, linewidth=1)
            label_ends(axis)


def _flat(row: MagnitudeRow) -> dict[str, float | None]:
    """A row's columns: each kind of centroider has its own."""
    values = asdict(row)
    return values | {f"axis_rms_px_{kind}": value for kind, value in values.pop("axis_rms_px").items()}


def budget_lines(found: Budget) -> list[str]:
    """The budget for a person."""
    within = ", ".join(f"{_number(value, 'g')} mag within {limit.replace('_', ' ')}" for limit, value in found.within.items())
    each = ", ".join(f"{kind} {_number(value, '.4f')}" for kind, value in found.centroid_rms_px.items())
    return [
        f"{'method':22}{found.method}, {found.bits} bits",
        f"{'clips at':22}V = {found.clips_v_mag:.2f} in the middle of a pixel, {found.clips_v_mag_at_best:.2f} on a corner",
        f"{'shows nothing':22}from V = {found.nothing_v_mag:.2f}, a range of {found.range_mag:.1f} mag",
        f"{'below full scale':22}{within}",
        f"{'centroider':22}{found.centroider}, in the tracker's pixels after its blur",
        f"{f'{COMPARED_MAG:g} mag below it':22}{each} px rms along an axis",
        f"{'clipped stars':22}{named(found.clipped_hip, MAX_NAMED)}",
        f"{'not drawn':22}{found.left_out.stars} stars, too faint: {found.left_out.flux_share:.2e} of all light",
        f"{'black':22}{found.black_e_per_s_px:.4g} e-/s in a monitor pixel",
        "",
        *(_by_each(found) if found.centroider == "all" else _by_one(found)),
    ]


def _by_one(found: Budget) -> Iterator[str]:
    yield f"{'V':>6}{'flux rms':>12}{'max mag':>10}{'centroid rms':>14}{'max px':>9}{'max arcsec':>12}"
    for row in found.rows:
        yield (
            f"{row.v_mag:6.2f}{_number(row.flux_rms_mag, '.4f'):>12}{_number(row.flux_max_mag, '.4f'):>10}"
            f"{_number(row.centroid_rms_px, '.4f'):>14}{_number(row.centroid_max_px, '.4f'):>9}"
            f"{_number(row.centroid_max_arcsec, '.2f'):>12}"
        )


def _by_each(found: Budget) -> Iterator[str]:
    yield f"{'V':>6}{'flux rms':>12}{'max mag':>10}{'':4}{''.join(f'{kind:>9}' for kind in FAMILY)}{'max px':>9}"
    for row in found.rows:
        each = "".join(f"{_number(row.axis_rms_px[kind], '.4f'):>9}" for kind in FAMILY)
        flux = f"{_number(row.flux_rms_mag, '.4f'):>12}{_number(row.flux_max_mag, '.4f'):>10}"
        yield f"{row.v_mag:6.2f}{flux}{'':4}{each}{_number(row.centroid_max_px, '.4f'):>9}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
