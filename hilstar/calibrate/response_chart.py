"""The chart of a photometric calibration: the response, and the residuals of levels held out of the fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.calibrate.fit import ChannelFit
from hilstar.calibrate.measurements import read_measurements
from hilstar.calibrate.photometric import fit_all, held_out
from hilstar.charts import chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"w": "0.2", "r": "tab:red", "g": "tab:green", "b": "tab:blue"}


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
    with chart(path, finding, panels=2) as (response, residual):
        for name, fit in fits.items():
            _draw_response(response, name, fit)
            _draw_residuals(residual, name, fit)
        response.set_yscale("log")
        response.set_ylim(1e-5, 2)
        response.set_ylabel("light above black / white")
        response.legend()
        residual.axhline(0, color="0.5", linewidth=0.8)
        residual.set_ylabel("held-out residual [%]")
        residual.set_xlabel("code")
        residual.legend()
    return finding


def _draw_response(axes: Axes, name: str, fit: ChannelFit) -> None:
    codes = np.arange(1, len(fit.light))
    level = (fit.levels.mean[1:] - fit.black) / fit.white
    axes.plot(codes, fit.light[1:], color=COLOURS[name], label=f"{name}: fit")
    axes.plot(
        fit.levels.code[1:][level > 0], level[level > 0], "o", color=COLOURS[name], markersize=4, label=f"{name}: measured"
    )
    axes.axhline(
        max(fit.black / fit.white, 1e-9), color=COLOURS[name], linewidth=0.8, linestyle=":", label=f"{name}: black level"
    )


def _draw_residuals(axes: Axes, name: str, fit: ChannelFit) -> None:
    shown = fit.light >= 1e-3
    codes = np.arange(len(fit.light))[shown]
    axes.fill_between(
        codes,
        -100 * fit.error[shown],
        100 * fit.error[shown],
        color=COLOURS[name],
        alpha=0.15,
        label=f"{name}: error of the fit",
    )
    held = fit.light[fit.levels.code[1:]] >= 1e-3
    axes.plot(
        fit.levels.code[1:][held], 100 * fit.residual[held], "o", color=COLOURS[name], markersize=4, label=f"{name}: held out"
    )
