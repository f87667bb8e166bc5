"""Electrons of a star of V = 0 by zero point and passband weighting."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import BLUE, ORANGE, SMALL_PT, chart, write_csv
from hilstar.sky.electrons import REFERENCE_TEMPERATURE_K, Photometry, dgs_electrons_per_s
from hilstar.study.models.finding import Finding
from hilstar.study.models.settings import SENSORS, WEIGHTINGS
from hilstar.study.shared.brightness import study_optics
from hilstar.units import magnitude

SETTINGS = [Photometry(zero, weighting) for zero in ("vega", "iau-bolometric") for weighting in WEIGHTINGS]


def zero_points(directory: Path) -> Finding:
    """Electrons of a V = 0 star of 9602 K by zero point and weighting."""
    rates = {
        sensor: np.array([dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, study_optics(sensor), p) for p in SETTINGS])
        for sensor in SENSORS
    }
    mag = {sensor: magnitude(rate / rate[0]) for sensor, rate in rates.items()}
    base, cost = rates["ccd47-20"], mag["ccd47-20"]
    text = (
        f"A V = 0 star of 9602 K gives {base[0] / 1e6:.1f} million electrons/s by Vega's flux (CCD47-20, 30 mm),"
        f" {100 * (1 - base[2] / base[0]):.0f} % ({cost[2]:.2f} mag) fewer by the IAU's bolometric zero point"
    )
    _draw(directory / "zero_points", text, rates, mag)
    rows = [
        (sensor, p.zero_point, p.weighting, float(rate), float(m))
        for sensor in SENSORS
        for p, rate, m in zip(SETTINGS, rates[sensor], mag[sensor], strict=True)
    ]
    columns = ("sensor", "zero_point", "weighting", "electrons_per_s", "mag_against_default")
    write_csv(directory / "zero_points.csv", columns, rows)
    return Finding("zero_points", text)


def _draw(path: Path, text: str, rates: dict[str, FloatArray], mag: dict[str, FloatArray]) -> None:
    with chart(path, text, panels=2) as (upper, lower):
        place = np.arange(len(SETTINGS))
        for k, ((sensor, name), colour) in enumerate(zip(SENSORS.items(), (BLUE, ORANGE), strict=True)):
            for axes, height, figure in ((upper, rates[sensor] / 1e6, "%.2f"), (lower, mag[sensor], "%+.3f")):
                bars = axes.bar(place + 0.4 * k - 0.2, height, 0.38, color=colour, label=name)
                axes.bar_label(bars, fmt=figure, padding=2, fontsize=SMALL_PT)
        upper.set(ylabel="electrons a second [millions]", ylim=(0, 1.3 * rates["ccd47-20"].max() / 1e6))
        low, high = min(0.0, *(m.min() for m in mag.values())), max(m.max() for m in mag.values())
        limits = (low - 0.15 * (high - low), high + 0.4 * (high - low))  # with room for figures and names
        lower.set_xticks(place, [f"{p.zero_point},\n{p.weighting} weighting" for p in SETTINGS])
        lower.set(ylabel="fainter than vega, energy [mag]", xlabel="zero point, weighting of the passband", ylim=limits)
        for axes in (upper, lower):
            axes.grid(visible=False, axis="x")
            axes.legend(loc="upper left", ncols=2)
