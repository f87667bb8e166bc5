"""The chart of a photometric calibration: the response, and the residuals of levels held out of the fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.calibrate.fit import ChannelFit
from hilstar.calibrate.measurements import read_measurements
from hilstar.calibrate.photometric import fit_all, held_out
from hilstar.charts import BLUE, GREEN, INK, MUTED, RED, chart, label_ends

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MIN_LIGHT = 1e-5  # of white, as drawn
COLOURS = {"w": INK, "r": RED, "g": GREEN, "b": BLUE}
NAMES = {"w": "white", "r": "red", "g": "green", "b": "blue"}


def draw_calibration(measured: Path, path: Path, bits: int | None = None) -> str:
    """Draw the response and the held-out residuals of MEASURED.csv into a PNG; returns its finding in one sentence.

    Raises InputError for the same data as the fit does, and where the PNG cannot be written.
    """
    fits = fit_all(read_measurements(measured, bits))
    worst = max(fits, key=lambda name: held_out(fits[name]).rms_percent)
    left, known = held_out(fits[worst]), fits[worst].noise_relative
    finding = (
        f"Levels held out of the fit are {left.rms_percent:.2g} % ({left.rms_mag:.2g} mag) rms off, {left.max_percent:.2g} % at"
        f" the maximum; a patch repeats to {100 * known:.2g} %"
    )
    note = "Lines: the fit. Dots: measured above, held out of the fit below. Dotted: black. Bands: the fit's error."
    with chart(path, finding, panels=2, note=note) as (response, residual):
        for name, fit in fits.items():
            _draw_response(response, name, fit)
            _draw_residuals(residual, name, fit)
        response.set(yscale="log", ylim=(1e-5, 2), ylabel="light over white [share]")
        residual.axhline(0, color=MUTED, linewidth=0.8)
        residual.set(ylabel="held-out residual [%]", xlabel="code")
        label_ends(response)
    return finding


def _draw_response(axes: Axes, name: str, fit: ChannelFit) -> None:
    codes = np.arange(1, len(fit.light))
    level = (fit.levels.mean[1:] - fit.black) / fit.white
    seen = np.maximum(fit.light[1:], MIN_LIGHT)
    axes.plot(codes, seen, color=COLOURS[name], label=NAMES[name])
    kept = level > MIN_LIGHT
    axes.plot(fit.levels.code[1:][kept], level[kept], "o", color=COLOURS[name], markersize=4, label="_measured")
    axes.axhline(max(fit.black / fit.white, MIN_LIGHT), color=COLOURS[name], linewidth=0.8, linestyle=":", label="_black")


def _draw_residuals(axes: Axes, name: str, fit: ChannelFit) -> None:
    shown = fit.light >= 1e-3
    codes, error = np.arange(len(fit.light))[shown], 100 * fit.error[shown]
    axes.fill_between(codes, -error, error, color=COLOURS[name], alpha=0.15, lw=0)
    held = fit.light[fit.levels.code[1:]] >= 1e-3
    axes.plot(fit.levels.code[1:][held], 100 * fit.residual[held], "o", color=COLOURS[name], markersize=4)
