"""The budget for a person, and as a table and a chart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.bench.white import named
from hilstar.charts import chart, write_csv
from hilstar.tracker.centroiders import FAMILY
from hilstar.twin.budget import CENTROID_LIMIT_PX, COMPARED_MAG, FLUX_LIMITS_MAG, Budget, MagnitudeRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_NAMED = 20
MIN_ERROR = 1e-6  # as drawn


def write_report(directory: Path, found: Budget) -> None:
    """budget.csv and budget.png. Raises InputError where one cannot be written."""
    rows = [_flat(row) for row in found.rows]
    write_csv(directory / "budget.csv", list(rows[0]), [["" if v is None else v for v in row.values()] for row in rows])
    reach = found.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    finding = f"{found.bits} bits, {found.method}: from V = {found.clips_v_mag:.1f}, where stars clip, within "
    finding += f"{FLUX_LIMITS_MAG[1]:g} mag over {'no' if reach is None else f'{reach:g}'} magnitudes"
    shown = [row for row in found.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    with chart(directory / "budget.png", finding, 3) as axes:
        for axis, kind, limits, label in (
            (axes[0], "flux", FLUX_LIMITS_MAG, "flux error [mag]"),
            (axes[1], "centroid", (CENTROID_LIMIT_PX,), f"centroid error by {found.centroider}\n[monitor px]"),
        ):
            unit = "mag" if kind == "flux" else "px"
            for name, style in (("max", "C0-"), ("rms", "C0--")):
                values = np.array([getattr(row, f"{kind}_{name}_{unit}") for row in shown])
                axis.semilogy(v_mag, np.maximum(values, MIN_ERROR), style, label=f"{name} over sub-pixel phases")
            _draw_limits(axis, found, limits, unit)
            axis.set_ylabel(label)
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        for kind in FAMILY:
            values = np.array([row.axis_rms_px[kind] for row in shown])
            axes[2].semilogy(v_mag, np.maximum(values, MIN_ERROR), "--" if kind == "fit" else "-", label=kind)
        axes[2].set_ylabel("centroid error by each, rms\nalong an axis [monitor px]")
        axes[2].legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9, title="centroider")
        axes[2].set_xlabel("V of a star of the Sun's colour [mag]")


def _flat(row: MagnitudeRow) -> dict[str, float | None]:
    """A row's columns: each kind of centroider has its own."""
    values = asdict(row)
    return values | {f"axis_rms_px_{kind}": value for kind, value in values.pop("axis_rms_px").items()}


def _draw_limits(axis: Axes, found: Budget, limits: tuple[float, ...], unit: str) -> None:
    for limit, style in zip(limits, (":", "-."), strict=False):
        axis.axhline(limit, color="tab:red", linestyle=style, linewidth=1, label=f"limit: {limit:g} {unit}")
    axis.axvline(found.clips_v_mag, color="0.4", linewidth=1, label=f"clips: brighter than V = {found.clips_v_mag:.2f}")
    dark = f"shows nothing: fainter than V = {found.nothing_v_mag:.2f}"
    axis.axvline(found.nothing_v_mag, color="0.4", linestyle="--", linewidth=1, label=dark)


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
