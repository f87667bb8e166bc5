"""What each method from light to levels costs: flux and centroid errors against magnitude, and against time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import STYLE, plain_ticks, save, title_lines, write_csv
from hilstar.monitor.balance import Balance
from hilstar.monitor.phases import SIGMA_PX, WHITE, Errors, fainter, measure, phase_grid, shown_by
from hilstar.monitor.quantise import CYCLE_FRAMES, Panel
from hilstar.monitor.response import srgb_response
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.psf import footprint_px, peak_share
from hilstar.study.shared.codes import AIM_PX, AIMS, BITS, FRAME_PX, STARS, WAYS, Way, response_of, star_field
from hilstar.units import flux_ratio

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def run(directory: Path, quick: bool = False) -> list[str]:
    """Write both charts (PNG) and their tables (CSV) into `directory`; a line for each finding."""
    phases, mags = (8, np.linspace(0, 8, 5)) if quick else (32, np.linspace(0, 10, 41))
    found = {(bits, way.name): _against_magnitude(bits, way, phases, mags) for bits in BITS for way in WAYS}
    times = {(bits, way.name): _frame_ms(bits, way, 3 if quick else 60) for bits in BITS for way in WAYS}
    columns = ("bits", "method", "mag_under_white", "flux_rms_mag", "flux_max_mag", "centroid_rms_px", "centroid_max_px")
    rows = [
        (bits, name, float(mag), e.flux_rms_mag, e.flux_max_mag, e.centroid_rms_px, e.centroid_max_px)
        for (bits, name), errors in found.items()
        for mag, e in zip(mags, errors, strict=True)
    ]
    write_csv(directory / "quantisation.csv", columns, rows)
    faintest = {key: errors[int(np.searchsorted(mags, AIMS[key[0]][1]))] for key, errors in found.items()}
    findings = [_summary(bits, found, mags) for bits in BITS] + [_time_summary(times)]
    _draw_magnitudes(directory / "quantisation.png", found, mags, findings[1])
    _draw_times(directory / "quantisation_time.png", faintest, times, findings[-1])
    write_csv(
        directory / "quantisation_time.csv",
        ("bits", "method", "frame_ms", "mag_under_white", "flux_rms_mag", "centroid_rms_px"),
        [(*key, times[key], AIMS[key[0]][1], e.flux_rms_mag, e.centroid_rms_px) for key, e in faintest.items()],
    )
    return findings


def _against_magnitude(bits: int, way: Way, phases: int, mags: FloatArray) -> list[Errors]:
    panel = Panel(response_of(bits, way), WHITE)
    sprites, tile = phase_grid(phases)
    bright = linear_image(sprites, (phases * tile, phases * tile), SIGMA_PX)
    errors = []
    for mag in mags:
        wanted = bright * flux_ratio(mag)
        linear, cycle = wanted.astype(np.float32), CYCLE_FRAMES if way.whole_cycle else 1
        shown = shown_by(way.method, cycle, panel, linear, fainter(sprites, mag), Balance(SIGMA_PX))
        errors.append(measure(wanted, shown, tile))
    return errors


def _frame_ms(bits: int, way: Way, repeats: int) -> float:
    """The median time of drawing STARS stars and reading their codes back."""
    sprites = star_field(FRAME_PX, footprint_px(SIGMA_PX))
    target = Target(FRAME_PX, SIGMA_PX, response_of(bits, way), WHITE, way.method)
    times = []
    with Renderer(target) as renderer:
        for frame in range(repeats + 1):
            begin = time.perf_counter()
            renderer.draw(sprites, frame)
            renderer.codes()
            times.append((time.perf_counter() - begin) * 1e3)
    return float(np.median(times[1:]))


def _summary(bits: int, found: dict[tuple[int, str], list[Errors]], mags: FloatArray) -> str:
    aim_mag, limit = AIMS[bits]

    def worst(way: Way) -> str:
        within = [e for e, mag in zip(found[bits, way.name], mags, strict=True) if mag <= limit]
        return f"{max(e.flux_max_mag for e in within):.3f} mag and {max(e.centroid_max_px for e in within):.3f} px"

    one_frame = ", ".join(f"{way.method} {worst(way)}" for way in WAYS[:3])
    half_step_px = srgb_response(bits).half_step * peak_share(SIGMA_PX) / flux_ratio(limit)
    return (
        f"{bits} bits, sRGB, {limit:g} magnitudes (aim {aim_mag:g} mag, {AIM_PX:g} px): largest errors of exact"
        f" {worst(WAYS[3])}, with bit stealing {worst(WAYS[5])}; {one_frame} (over {CYCLE_FRAMES} frames)."
        f" Half the smallest step of light moves a centroid by {half_step_px:.3f} px along each axis"
    )


def _time_summary(times: dict[tuple[int, str], float]) -> str:
    ms = {way.name: times[10, way.name] for way in WAYS}
    return (
        f"{STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}, 10 bits, from light to levels in memory: round {ms['round']:.1f} ms,"
        f" dither {ms[WAYS[1].name]:.1f} ms, temporal {ms[WAYS[2].name]:.1f} ms, exact {ms['exact']:.1f} ms"
    )


def _draw_magnitudes(path: Path, found: dict[tuple[int, str], list[Errors]], mags: FloatArray, finding: str) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(15.0, 9.6), layout="constrained")
        grid = figure.subplots(2, len(BITS), sharex=True, sharey="row")
        for column, bits in enumerate(BITS):
            aim_mag, limit = AIMS[bits]
            for way in WAYS:
                errors = found[bits, way.name]
                flux, off = grid[0, column], grid[1, column]
                _lines(flux, mags, [(e.flux_rms_mag, e.flux_max_mag) for e in errors], way)
                _lines(off, mags, [(e.centroid_rms_px, e.centroid_max_px) for e in errors], way)
            for axis, aim in ((grid[0, column], aim_mag), (grid[1, column], AIM_PX)):
                axis.plot([0, limit], [aim, aim], "k--", lw=1.2, label="aim, and its range")
                axis.plot([limit, limit], [1e-6, aim], "k--", lw=1.2)
            grid[0, column].set(title=f"{bits} bits", yscale="log", ylim=(1e-5, 1))
            grid[1, column].set(yscale="log", ylim=(1e-5, 1), xlabel="magnitudes under a star whose peak is white")
        grid[0, 0].set(ylabel="flux error [mag]\nthick: rms over phases, thin: largest")
        grid[1, 0].set(ylabel="centroid error [monitor px]\nthick: rms over phases, thin: largest")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)


def _lines(axis: Axes, mags: FloatArray, rms_and_max: list[tuple[float, float]], way: Way) -> None:
    """The rms as a thick line, the largest as a thin one; a line ends where a star shows nothing."""
    rms, largest = np.array(rms_and_max).T
    axis.plot(mags, np.where(np.isfinite(rms), rms, np.nan), way.style, label=way.name)
    axis.plot(mags, np.where(np.isfinite(largest), largest, np.nan), way.style, lw=0.7, alpha=0.7)


def _draw_times(path: Path, faintest: dict[tuple[int, str], Errors], times: dict[tuple[int, str], float], finding: str) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    markers = dict(zip(BITS, "os^", strict=True))
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 6.8), layout="constrained")
        axes = figure.subplots(1, 2, sharex=True)
        for way in WAYS:
            for bits in BITS:
                key = bits, way.name
                label = way.name if bits == BITS[0] else None
                face = "none" if way.stealing else way.style[:2]
                for axis, error in zip(axes, (faintest[key].flux_rms_mag, faintest[key].centroid_rms_px), strict=True):
                    axis.plot(times[key], error, markers[bits], color=way.style[:2], mfc=face, ms=9, label=label)
        for bits, marker in markers.items():
            label = f"{bits} bits, {AIMS[bits][1]:g} mag under white"
            axes[0].plot([], [], "k" + marker, ms=9, label=label)
        names = ("flux error [mag]", "centroid error [monitor px]")
        for axis, aim, what in zip(axes, (AIMS[10][0], AIM_PX), names, strict=True):
            axis.axhline(aim, color="k", ls="--", lw=1.2, label="aim (8 bits: 0.05 mag)")
            axis.set(yscale="log", xscale="log", ylabel=f"{what}, rms over phases")
            axis.set(xlabel=f"time of a frame with {STARS} stars [ms]")
            plain_ticks(axis.xaxis, (1, 1.5, 2, 3, 4, 5, 7, 10, 15))
            axis.set_xlim(min(times.values()) / 1.2, max(times.values()) * 1.2)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)
