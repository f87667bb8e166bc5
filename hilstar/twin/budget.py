"""The budget of a bench's light: which magnitudes its monitor, sprites and quantisation can show, and how well.

Every error is measured: single stars at a grid of sub-pixel phases through the bench's own method.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.bench.white import clipping_hip, named
from hilstar.charts import chart, write_csv
from hilstar.monitor.phases import WHITE, fainter, measure, phase_grid, shown_by
from hilstar.monitor.quantise import Panel
from hilstar.render.reference import linear_image
from hilstar.scene.psf import peak_share
from hilstar.units import ARCSEC_PER_RAD, flux_ratio

PHASES = 16
STEP_MAG = 0.5
FAINTEST_BELOW_WHITE_MAG = 15.0
SOLAR_BV = 0.65
LIKE_SOLAR_BV = 0.1
FLUX_LIMITS_MAG = (0.02, 0.05)
CENTROID_LIMIT_PX = 0.01
NAMED = 20


@dataclass(frozen=True, slots=True)
class Row:
    """One magnitude: rms and worst errors over phases, magnitudes and monitor pixels; None where some star shows nothing."""

    v_mag: float
    below_white_mag: float
    flux_rms_mag: float | None
    flux_max_mag: float | None
    centroid_rms_px: float | None
    centroid_max_px: float | None
    centroid_max_arcsec: float | None


@dataclass(frozen=True, slots=True)
class Budget:
    """What a bench can show: magnitudes are those of a star of the Sun's colour."""

    method: str
    bits: int
    clips_v_mag: float
    clips_v_mag_at_best: float
    nothing_v_mag: float
    range_mag: float
    within: dict[str, float | None]
    clipped_hip: list[int]
    left_out: dict[str, float | int]
    black_e_per_s_px: float
    rows: list[Row]


def budget(bench: Bench) -> Budget:
    """The budget of a bench."""
    render, white = bench.config.render, bench.flux_at_white_e_per_s
    share = peak_share(render.sprite_sigma_px)
    zero_mag = zero_point_mag(bench)
    # A star of rate r has V = zero_mag - 2.5 log10 r. It clips first where the screen is darkest, in the middle of a pixel.
    clips = zero_mag - 2.5 * math.log10(white * bench.darkest / share)
    corner = corner_share(render.sprite_sigma_px)
    best = zero_mag - 2.5 * math.log10(white / corner)
    nothing_e_per_s = nothing_below_e_per_s(bench)
    rows = _rows(bench, clips)
    return Budget(
        method=render.quantisation + (" with bit stealing" if render.bit_stealing else ""),
        bits=bench.config.monitor.bits,
        clips_v_mag=clips,
        clips_v_mag_at_best=best,
        nothing_v_mag=zero_mag - 2.5 * math.log10(nothing_e_per_s),
        range_mag=zero_mag - 2.5 * math.log10(nothing_e_per_s) - clips,
        within=_within(rows, clips),
        clipped_hip=clipping_hip(bench),
        left_out=left_out(bench),
        black_e_per_s_px=bench.calibration.response.black * white,
        rows=rows,
    )


def zero_point_mag(bench: Bench) -> float:
    """V of a star of the Sun's colour that gives one electron a second, by the bench's own stars of about that colour.

    Raises InputError where it has none.
    """
    stars = bench.stars
    # The bench's stars of that colour, or the nearest to it: none of them is far off in a bench with stars.
    distance = np.abs(stars.bv_mag - SOLAR_BV)
    alike = distance <= max(LIKE_SOLAR_BV, float(distance.min()))
    return float(np.median(stars.v_mag[alike] + 2.5 * np.log10(stars.electrons_per_s[alike])))


def corner_share(sigma_px: tuple[float, float]) -> float:
    """The share of a star's brightest pixel when it stands on a corner of four: the least that a peak can be."""
    return math.prod(0.5 * math.erf(1.0 / (sigma * math.sqrt(2.0))) for sigma in sigma_px)


def nothing_below_e_per_s(bench: Bench) -> float:
    """The rate under which a star shows nothing, wherever it stands; for dithers, one that lights a pixel in half of frames."""
    drawn = bench.faintest_shown_e_per_s
    return drawn or float(bench.calibration.response.light[1]) / 2 * bench.flux_at_white_e_per_s


def left_out(bench: Bench) -> dict[str, float | int]:
    """The bench's stars that are not drawn: how many, and their share of all light."""
    rates = bench.stars.electrons_per_s
    missing = rates[rates < bench.faintest_shown_e_per_s]
    return {"stars": len(missing), "flux_share": float(missing.sum() / rates.sum())}


def _rows(bench: Bench, clips_v_mag: float) -> list[Row]:
    render = bench.config.render
    sigma_px, cycle = render.sprite_sigma_px, render.cycle_frames
    panel = Panel(bench.calibration.response, WHITE)
    sprites, tile = phase_grid(PHASES, sigma_px)
    bright = linear_image(sprites, (PHASES * tile, PHASES * tile), sigma_px)
    arcsec_per_px = ARCSEC_PER_RAD / bench.camera.focal_length_px
    rows = []
    for mag in np.arange(0.0, FAINTEST_BELOW_WHITE_MAG + STEP_MAG / 2, STEP_MAG):
        wanted = bright * flux_ratio(mag)
        linear = wanted.astype(np.float32)
        shown = shown_by(bench.renderer.target.quantisation, cycle, panel, linear, fainter(sprites, float(mag)), sigma_px)
        errors = measure(wanted, shown, tile)
        rows.append(
            Row(
                v_mag=clips_v_mag + float(mag),
                below_white_mag=float(mag),
                flux_rms_mag=_finite(errors.flux_rms_mag),
                flux_max_mag=_finite(errors.flux_max_mag),
                centroid_rms_px=_finite(errors.centroid_rms_px),
                centroid_max_px=_finite(errors.centroid_max_px),
                centroid_max_arcsec=_finite(errors.centroid_max_px * arcsec_per_px),
            )
        )
        if rows[-1].flux_rms_mag is None:
            break
    return rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _within(rows: list[Row], clips_v_mag: float) -> dict[str, float | None]:
    """The magnitudes below white over which the worst star stays within each limit."""

    def reach(values: list[float | None], limit: float) -> float | None:
        good = 0
        while good < len(rows) and (value := values[good]) is not None and value <= limit:
            good += 1
        return rows[good - 1].below_white_mag if good else None

    flux, centroid = [row.flux_max_mag for row in rows], [row.centroid_max_px for row in rows]
    limits = {f"{limit:g}_mag": reach(flux, limit) for limit in FLUX_LIMITS_MAG}
    return limits | {f"{CENTROID_LIMIT_PX:g}_px": reach(centroid, CENTROID_LIMIT_PX)}


def write_budget(directory: Path, found: Budget) -> None:
    """budget.csv and budget.png."""
    columns = list(asdict(found.rows[0]))
    write_csv(directory / "budget.csv", columns, [["" if v is None else v for v in asdict(row).values()] for row in found.rows])
    reach = found.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    finding = f"{found.bits} bits, {found.method}: from V = {found.clips_v_mag:.1f}, where stars clip, within "
    finding += f"{FLUX_LIMITS_MAG[1]:g} mag over {'no' if reach is None else f'{reach:g}'} magnitudes"
    shown = [row for row in found.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    with chart(directory / "budget.png", finding, 2) as axes:
        for axis, kind, limits, label in (
            (axes[0], "flux", FLUX_LIMITS_MAG, "flux error [mag]"),
            (axes[1], "centroid", (CENTROID_LIMIT_PX,), "centroid error [monitor px]"),
        ):
            unit = "mag" if kind == "flux" else "px"
            for name, style in (("max", "C0-"), ("rms", "C0--")):
                values = np.array([getattr(row, f"{kind}_{name}_{unit}") for row in shown])
                axis.semilogy(v_mag, np.maximum(values, 1e-6), style, label=f"{name} over sub-pixel phases")
            _lines(axis, found, limits, unit)
            axis.set_ylabel(label)
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        axes[1].set_xlabel("V of a star of the Sun's colour [mag]")


def _lines(axis: Any, found: Budget, limits: tuple[float, ...], unit: str) -> None:
    for limit, style in zip(limits, (":", "-."), strict=False):
        axis.axhline(limit, color="tab:red", linestyle=style, linewidth=1, label=f"limit: {limit:g} {unit}")
    axis.axvline(found.clips_v_mag, color="0.4", linewidth=1, label=f"clips: brighter than V = {found.clips_v_mag:.2f}")
    dark = f"shows nothing: fainter than V = {found.nothing_v_mag:.2f}"
    axis.axvline(found.nothing_v_mag, color="0.4", linestyle="--", linewidth=1, label=dark)


def budget_lines(found: Budget) -> list[str]:
    """The budget for a person."""

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else f"{value:{form}}"

    within = ", ".join(f"{number(value, 'g')} mag within {limit.replace('_', ' ')}" for limit, value in found.within.items())
    lines = [
        f"{'method':22}{found.method}, {found.bits} bits",
        f"{'clips at':22}V = {found.clips_v_mag:.2f} in the middle of a pixel, {found.clips_v_mag_at_best:.2f} on a corner",
        f"{'nothing from':22}V = {found.nothing_v_mag:.2f} on: a range of {found.range_mag:.1f} mag",
        f"{'under white':22}{within}",
        f"{'clipped stars':22}{named(found.clipped_hip, NAMED)}",
        f"{'left out':22}{found.left_out['stars']} stars, {found.left_out['flux_share']:.2e} of all light",
        f"{'black':22}{found.black_e_per_s_px:.4g} e-/s in a monitor pixel",
        "",
        f"{'V':>6}{'flux rms':>12}{'max mag':>10}{'centroid rms':>14}{'max px':>9}{'max arcsec':>12}",
    ]
    for row in found.rows:
        lines.append(
            f"{row.v_mag:6.2f}{number(row.flux_rms_mag, '.4f'):>12}{number(row.flux_max_mag, '.4f'):>10}"
            f"{number(row.centroid_rms_px, '.4f'):>14}{number(row.centroid_max_px, '.4f'):>9}"
            f"{number(row.centroid_max_arcsec, '.2f'):>12}"
        )
    return lines


def budget_json(found: Budget) -> dict[str, Any]:
    """The JSON object of `hilstar budget`."""
    return asdict(found)
