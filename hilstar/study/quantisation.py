"""What each method from light to levels costs: flux and centroid errors against magnitude, and against time."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import STYLE, plain_ticks, save, title_lines, write_csv
from hilstar.monitor.phases import SIGMA_PX, WHITE
from hilstar.monitor.quantise import EXPOSURE_FRAMES
from hilstar.monitor.response import srgb_response
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.psf import footprint_px, peak_share
from hilstar.study.shared.code_errors import ERROR_COLUMNS, JUDGE, code_errors, error_cells
from hilstar.study.shared.codes import AIM_PX, AIMS, BITS, FRAME_PX, STARS, WAYS, Way, response_of, star_field
from hilstar.study.shared.over_frames import study_frames
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import StarErrors
from hilstar.units import flux_ratio

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Found = dict[tuple[int, str], list[StarErrors]]
COLOURS = ("C0", "C1", "C2", "C3", "C4", "C5")  # of centroiders
THIRD = 1 / 3  # of the error of `round`, at most, is what `exact` is meant to leave


def run(directory: Path, quick: bool = False) -> list[str]:
    """Write the charts (PNG) and their tables (CSV) into `directory`; a line for each finding."""
    phases, mags = (8, np.linspace(0, 8, 5)) if quick else (32, np.linspace(0, 10, 41))
    found: Found = {(bits, way.name): code_errors(bits, way, phases, mags) for bits in BITS for way in WAYS}
    times = {(bits, name): ms for bits in BITS for name, ms in _frames_ms(bits, 3 if quick else 31).items()}
    rows = [
        (bits, name, float(mag), *error_cells(e))
        for (bits, name), errors in found.items()
        for mag, e in zip(mags, errors, strict=True)
    ]
    write_csv(directory / "quantisation.csv", ("bits", "method", "mag_under_white", *ERROR_COLUMNS), rows)
    faintest = {key: errors[int(np.searchsorted(mags, AIMS[key[0]][1]))] for key, errors in found.items()}
    findings = [*(_summary(bits, found, mags) for bits in BITS), _each_summary(faintest), _time_summary(times)]
    _draw_magnitudes(directory / "quantisation.png", found, mags, findings[1])
    _draw_each(directory / "quantisation_centroiders.png", found, mags, findings[-2])
    _draw_times(directory / "quantisation_time.png", faintest, times, findings[-1])
    write_csv(
        directory / "quantisation_time.csv",
        ("bits", "method", "frame_ms", "mag_under_white", *ERROR_COLUMNS),
        [(*key, times[key], AIMS[key[0]][1], *error_cells(e)) for key, e in faintest.items()],
    )
    return [*findings, study_frames(directory, quick)]


def _frames_ms(bits: int, rounds: int) -> dict[str, float]:
    """The median times of drawing STARS stars and reading their codes back, by way, in turn, so that all bear the same load."""
    sprites, times = star_field(FRAME_PX, footprint_px(SIGMA_PX)), {way.name: list[float]() for way in WAYS}
    with ExitStack() as stack:
        targets = {way.name: Target(FRAME_PX, SIGMA_PX, response_of(bits, way), WHITE, way.method) for way in WAYS}
        renderers = {name: stack.enter_context(Renderer(target)) for name, target in targets.items()}
        for frame in range(rounds + 1):
            for name, renderer in renderers.items():
                begin = time.perf_counter()
                renderer.draw(sprites, frame)
                renderer.codes()
                times[name].append((time.perf_counter() - begin) * 1e3)
    return {name: float(np.median(each[1:])) for name, each in times.items()}


def _summary(bits: int, found: Found, mags: FloatArray) -> str:
    aim_mag, limit = AIMS[bits]

    def worst(way: Way) -> str:
        within = [e for e, mag in zip(found[bits, way.name], mags, strict=True) if mag <= limit]
        return f"{max(e.flux_max_mag for e in within):.3f} mag and {max(e.max_px(JUDGE) for e in within):.3f} px"

    others = ", ".join(f"{way.method} {worst(way)}" for way in WAYS[:3])
    half_step_px = srgb_response(bits).half_step * peak_share(SIGMA_PX) / flux_ratio(limit)
    return (
        f"{bits} bits, sRGB, {limit:g} magnitudes (aim {aim_mag:g} mag, {AIM_PX:g} px): largest errors, places by a PSF fit, of"
        f" exact {worst(WAYS[3])}, with bit stealing {worst(WAYS[5])}; {others} (over {EXPOSURE_FRAMES} frames)."
        f" Half the smallest step of light moves a centroid by {half_step_px:.3f} px along each axis"
    )


def _each_summary(faintest: dict[tuple[int, str], StarErrors]) -> str:
    """What `exact` leaves of the error of `round`, by each centroider, at the faint end of the coarsest panel."""
    bits = BITS[0]
    rounded, exact = faintest[bits, "round"], faintest[bits, "exact"]
    left = {kind: exact.axis_rms_px(kind) / rounded.axis_rms_px(kind) for kind in FAMILY}
    each = ", ".join(f"{kind} {left[kind]:.2f} ({exact.axis_rms_px(kind):.4f} px)" for kind in FAMILY)
    return (
        f"{bits} bits, {AIMS[bits][1]:g} magnitudes under white: of the error of round (rms along an axis) exact leaves,"
        f" by each centroider, {each}"
    )


def _time_summary(times: dict[tuple[int, str], float]) -> str:
    ms = {way.name: times[10, way.name] for way in WAYS}
    return (
        f"{STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}, 10 bits, from light to levels in memory: round {ms['round']:.1f} ms,"
        f" dither {ms[WAYS[1].name]:.1f} ms, temporal {ms[WAYS[2].name]:.1f} ms, exact {ms['exact']:.1f} ms"
    )


def _draw_magnitudes(path: Path, found: Found, mags: FloatArray, finding: str) -> None:
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
                _lines(off, mags, [(np.sqrt(2) * e.axis_rms_px(JUDGE), e.max_px(JUDGE)) for e in errors], way)
            for axis, aim in ((grid[0, column], aim_mag), (grid[1, column], AIM_PX)):
                axis.plot([0, limit], [aim, aim], "k--", lw=1.2, label="aim, and its range")
                axis.plot([limit, limit], [1e-6, aim], "k--", lw=1.2)
            grid[0, column].set(title=f"{bits} bits", yscale="log", ylim=(1e-5, 1))
            grid[1, column].set(yscale="log", ylim=(1e-5, 1), xlabel="magnitudes under a star whose peak is white")
        grid[0, 0].set(ylabel="flux error [mag]\nthick: rms over phases, thin: largest")
        grid[1, 0].set(ylabel="centroid error by a PSF fit [monitor px]\nthick: rms over phases, thin: largest")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)


def _draw_each(path: Path, found: Found, mags: FloatArray, finding: str) -> None:
    """Each centroider's error with `round` and with `exact`, and what is left of the one by the other."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(15.0, 12.0), layout="constrained")
        grid = figure.subplots(3, len(BITS), sharex=True, sharey="row")
        for column, bits in enumerate(BITS):
            limit = AIMS[bits][1]
            for kind, colour in zip(FAMILY, COLOURS, strict=True):
                rounded, exact = (np.array([e.axis_rms_px(kind) for e in found[bits, name]]) for name in ("round", "exact"))
                style = "--" if kind == "fit" else "-"  # a window as wide as the star finds the same
                rounded, exact = (np.where(np.isfinite(values), values, np.nan) for values in (rounded, exact))
                for axis, values in zip(grid[:, column], (rounded, exact, exact / rounded), strict=True):
                    axis.plot(mags, values, style, color=colour, label=kind)
            for axis in grid[:2, column]:
                axis.set(yscale="log", ylim=(1e-5, 1))
            grid[2, column].axhline(THIRD, color="k", ls="--", lw=1.2, label="a third of the error of round")
            grid[2, column].set(ylim=(0, 1), xlabel="magnitudes under a star whose peak is white")
            for axis in grid[:, column]:
                axis.axvline(limit, color="0.5", ls=":", lw=1.2, label="faint end of the aim")
            grid[0, column].set_title(f"{bits} bits")
        for axis, what in zip(grid[:, 0], ("round", "exact", "exact / round"), strict=True):
            axis.set_ylabel(f"{what}\nrms along an axis" + ("" if "/" in what else " [monitor px]"))
        figure.legend(*grid[2, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)


def _lines(axis: Axes, mags: FloatArray, rms_and_max: list[tuple[float, float]], way: Way) -> None:
    """The rms as a thick line, the largest as a thin one; a line ends where a star shows nothing."""
    rms, largest = np.array(rms_and_max).T
    axis.plot(mags, np.where(np.isfinite(rms), rms, np.nan), way.style, label=way.name)
    axis.plot(mags, np.where(np.isfinite(largest), largest, np.nan), way.style, lw=0.7, alpha=0.7)


def _draw_times(
    path: Path, faintest: dict[tuple[int, str], StarErrors], times: dict[tuple[int, str], float], finding: str
) -> None:
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
                for axis, error in zip(axes, _rms(faintest[key]), strict=True):
                    axis.plot(times[key], error, markers[bits], color=way.style[:2], mfc=face, ms=9, label=label)
        for bits, marker in markers.items():
            label = f"{bits} bits, {AIMS[bits][1]:g} mag under white"
            axes[0].plot([], [], "k" + marker, ms=9, label=label)
        names = ("flux error [mag]", "centroid error by a PSF fit [monitor px]")
        for axis, aim, what in zip(axes, (AIMS[10][0], AIM_PX), names, strict=True):
            axis.axhline(aim, color="k", ls="--", lw=1.2, label="aim (8 bits: 0.05 mag)")
            axis.set(yscale="log", xscale="log", ylabel=f"{what}, rms over phases")
            axis.set(xlabel=f"time of a frame with {STARS} stars [ms]")
            plain_ticks(axis.xaxis, (1, 1.5, 2, 3, 4, 5, 7, 10, 15))
            axis.set_xlim(min(times.values()) / 1.2, max(times.values()) * 1.2)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(title_lines(finding), fontsize=12)
        save(figure, path)


def _rms(errors: StarErrors) -> tuple[float, float]:
    return errors.flux_rms_mag, float(np.sqrt(2)) * errors.axis_rms_px(JUDGE)
