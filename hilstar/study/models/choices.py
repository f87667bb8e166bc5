"""What each choice of a brightness model costs in magnitudes, over B-V and for the stars of Hipparcos."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import INK, MUTED, SERIES, chart, label_ends, write_csv
from hilstar.sky.catalog import Catalog, load_catalog
from hilstar.sky.electrons import (
    Optics,
    Photometry,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    star_temperatures_k,
    tabulate_pickles,
)
from hilstar.study.models.finding import Finding
from hilstar.study.models.settings import BRIGHT_V_MAG
from hilstar.study.shared.brightness import study_optics
from hilstar.units import magnitude

BV_MAG = np.arange(-30, 201) / 100
WINDOW_MAG = 0.05  # half the width of the running percentiles in B-V
MIN_STARS = 20


def choices(directory: Path) -> Finding:
    """What each choice costs in magnitudes over B-V, and what it costs the stars of Hipparcos."""
    optics = study_optics("ccd47-20")
    cost = choice_costs_mag(BV_MAG, optics)
    stars = load_catalog().brighter_than(BRIGHT_V_MAG)
    real = pickles_cost_mag(stars, optics)
    percentiles = running_percentiles(stars.bv_mag, real, BV_MAG)
    on_stars = choice_costs_mag(stars.bv_mag, optics) | {"spectrum pickles": real}
    paid = {name: np.percentile(np.abs(mag), (50, 95)) for name, mag in on_stars.items()}
    text = "What each choice costs half of Hipparcos to V = 7.5 (95 %), CCD47-20, mag: " + ", ".join(
        f"{name.split()[-1]} {half:.2f} ({most:.2f})" for name, (half, most) in paid.items()
    )
    dearest = max(paid, key=lambda name: paid[name][1])
    finding = (
        f"Of the choices of brightness {dearest.split()[-1]} changes most: half of Hipparcos to V = {BRIGHT_V_MAG:g} by"
        f" {paid[dearest][0]:.2f} mag and more, a twentieth by {paid[dearest][1]:.2f} mag"
    )
    _draw(directory / "choices", finding, cost, percentiles, len(stars))
    columns = ("bv_mag", *(f"{n.replace(' ', '_')}_mag" for n in cost))
    columns += ("pickles_p5_mag", "pickles_median_mag", "pickles_p95_mag", "stars_in_window")
    write_csv(directory / "choices.csv", columns, np.column_stack((BV_MAG, *cost.values(), *percentiles)).tolist())
    return Finding("choices", text)


def choice_costs_mag(bv_mag: FloatArray, optics: Optics) -> dict[str, FloatArray]:
    """What each choice costs, mag (n,), against a black body by ballesteros2012, vega and energy; + is fainter."""
    default = Photometry()
    kelvin = star_temperatures_k(bv_mag, "ballesteros2012")
    rates = {
        "temperature wang2021": dgs_electrons_per_s(star_temperatures_k(bv_mag, "wang2021"), optics, default),
        "weighting photon": dgs_electrons_per_s(kelvin, optics, Photometry("vega", "photon")),
        "zero point iau-bolometric": dgs_electrons_per_s(kelvin, optics, Photometry("iau-bolometric")),
        "brightness ags": np.full_like(bv_mag, ags_electrons_per_s(optics, default)),
    }
    base = dgs_electrons_per_s(kelvin, optics, default)
    return {name: magnitude(rate / base) for name, rate in rates.items()}


def pickles_cost_mag(stars: Catalog, optics: Optics) -> FloatArray:
    """Real spectra against the black body by ballesteros2012 for catalogue stars, mag (n,); + is fainter."""
    zero = np.zeros(len(stars))
    real = tabulate_pickles(optics, Photometry()).electrons_per_s(zero, stars.bv_mag, stars.vi_mag)
    body = dgs_electrons_per_s(star_temperatures_k(stars.bv_mag, "ballesteros2012"), optics, Photometry())
    return magnitude(real / body)


def running_percentiles(bv_mag: FloatArray, value: FloatArray, at_bv_mag: FloatArray) -> FloatArray:
    """5, 50 and 95 % of `value` (n,) within WINDOW_MAG of each colour, and the count, shape (4, m).

    NaN where there are fewer than MIN_STARS.
    """
    rows = np.full((4, len(at_bv_mag)), np.nan)
    for k, centre in enumerate(at_bv_mag):
        inside = value[np.abs(bv_mag - centre) <= WINDOW_MAG]
        rows[3, k] = len(inside)
        if len(inside) >= MIN_STARS:
            rows[:3, k] = np.percentile(inside, (5, 50, 95))
    return rows


def _draw(path: Path, finding: str, cost: dict[str, FloatArray], percentiles: FloatArray, star_count: int) -> None:
    low, middle, high, _ = percentiles
    note = f"Band: 5 to 95 % of {star_count} Hipparcos stars. M giants share the B-V of K giants, and are up to"
    note += f" {-np.nanmin(low):.1f} mag brighter than the black body. + is fainter; CCD47-20."
    with chart(path, finding, panels=2, note=note) as (upper, lower):
        for (name, mag), colour in zip(cost.items(), SERIES, strict=False):
            upper.plot(BV_MAG, mag, color=colour, label=name.split()[-1])
        for axes in (upper, lower):
            axes.plot(BV_MAG, middle, color=INK, label="pickles, median")
            axes.axhline(0, color=MUTED, lw=1)
            axes.set(ylabel="cost against a black body [mag]")
        lower.fill_between(BV_MAG, low, high, color=MUTED, alpha=0.35, lw=0)
        lower.set(xlabel="B-V [mag]")
        for axes in (upper, lower):
            label_ends(axes)
