"""The temperature scales against Torres 2010, over B-V, and what the difference costs in electrons."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import BLUE, INK, MUTED, ORANGE, chart, label_ends, write_csv
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Photometry, dgs_electrons_per_s
from hilstar.sky.spectrum import TEMPERATURE_SCALES
from hilstar.study.models.finding import Finding
from hilstar.study.models.settings import BRIGHT_V_MAG
from hilstar.study.shared.brightness import study_optics
from hilstar.units import magnitude

# log10 T over B-V: Torres 2010 (AJ 140, 1158, table 2), Flower 1996 corrected.
TORRES_DWARFS_AND_GIANTS = (
    3.979145106714099,
    -0.654992268598245,
    1.740690042385095,
    -4.608815154057166,
    6.792599779944473,
    -5.396909891322525,
    2.192970376522490,
    -0.359495739295671,
)
TORRES_SUPERGIANTS = (
    4.012559732366214,
    -1.055043117465989,
    2.133394538571825,
    -2.459769794654992,
    1.349423943497744,
    -0.283942579112032,
)
BV_MAG = np.arange(-35, 181) / 100  # where Torres 2010 holds; exact at 0, where wang2021 steps


@dataclass(frozen=True, slots=True)
class Scales:
    """Temperatures by scale over B-V (n,) in K, and their difference from `torres_k` in percent and in magnitudes."""

    bv_mag: FloatArray
    torres_k: FloatArray
    kelvin: dict[str, FloatArray]
    percent: dict[str, FloatArray]
    mag: dict[str, FloatArray]


def temperature_scales(directory: Path) -> Finding:
    """The scales that a bench file can choose, beside Torres 2010, and what they cost in electrons."""
    scales = compared_scales()
    stars_bv = load_catalog().brighter_than(BRIGHT_V_MAG).bv_mag
    bv = scales.bv_mag
    stars_bv = stars_bv[(stars_bv >= bv[0]) & (stars_bv <= bv[-1])]
    within = {n: np.percentile(np.abs(np.interp(stars_bv, bv, scales.mag[n])), (50, 95)) for n in TEMPERATURE_SCALES}
    zero = int(np.searchsorted(bv, 0.0))
    wang = scales.kelvin["wang2021"]
    step_k = wang[zero - 1] - wang[zero]
    text = (
        f"wang2021 steps down by {step_k:.0f} K ({100 * step_k / wang[zero - 1]:.1f} %) at B-V = 0; half of"
        " Hipparcos to V = 7.5 (95 %) is within "
        + ", ".join(f"{half:.3f} ({most:.2f}) mag by {name}" for name, (half, most) in within.items())
        + " of Torres 2010"
    )
    finding = f"The scale wang2021 steps down by {step_k:.0f} K at B-V = 0; half of Hipparcos is within " + ", ".join(
        f"{half:.3f} mag by {name}" for name, (half, _) in within.items()
    )
    _draw(directory / "temperature_scales", f"{finding} of Torres 2010", scales)
    groups = (("k", scales.kelvin), ("percent", scales.percent), ("mag", scales.mag))
    columns = ("bv_mag", "torres2010_k", *(f"{name}_{unit}" for unit, values in groups for name in values))
    table = np.column_stack((bv, scales.torres_k, *(value for _, values in groups for value in values.values())))
    write_csv(directory / "temperature_scales.csv", columns, table.tolist())
    return Finding("temperature_scales", text)


def compared_scales() -> Scales:
    """Every scale over BV_MAG, against Torres 2010 for dwarfs and giants."""
    bv = np.union1d(BV_MAG, -1e-9)  # both sides of wang2021's step
    torres = torres2010_k(bv)
    optics, photometry = study_optics("ccd47-20"), Photometry()
    base = dgs_electrons_per_s(torres, optics, photometry)
    kelvin = {"torres2010_supergiant": torres2010_k(bv, supergiant=True)}
    kelvin |= {name: scale(bv) for name, scale in TEMPERATURE_SCALES.items()}
    percent = {name: 100 * (t / torres - 1) for name, t in kelvin.items()}
    mag = {name: magnitude(dgs_electrons_per_s(t, optics, photometry) / base) for name, t in kelvin.items()}
    return Scales(bv, torres, kelvin, percent, mag)


def torres2010_k(bv_mag: FloatArray, supergiant: bool = False) -> FloatArray:
    """Effective temperature from B-V (Torres 2010, table 2); shape of `bv_mag`."""
    coefficients = TORRES_SUPERGIANTS if supergiant else TORRES_DWARFS_AND_GIANTS
    return np.asarray(10 ** np.polynomial.polynomial.polyval(bv_mag, coefficients))


def _draw(path: Path, finding: str, scales: Scales) -> None:
    note = "Torres 2010 (Flower 1996) for dwarfs and giants is the reference. Electrons: CCD47-20, + is fainter."
    with chart(path, finding, panels=3, note=note) as panels:
        kelvin, percent, mag = panels
        kelvin.plot(scales.bv_mag, scales.torres_k, color=INK, label="Torres 2010")
        for axes, values in zip(panels, (scales.kelvin, scales.percent, scales.mag), strict=True):
            for (name, value), style, colour in zip(values.items(), (":", "-", "-"), (MUTED, BLUE, ORANGE), strict=True):
                words = name.replace("torres2010_supergiant", "Torres, supergiants")
                axes.plot(scales.bv_mag, value, style, color=colour, label=words)
        for axes in (percent, mag):
            axes.axhline(0, color=INK, lw=1)
        kelvin.set(yscale="log", ylabel="temperature [K]")
        percent.set(ylabel="difference [%]")
        mag.set(xlabel="B-V [mag]", ylabel="difference in electrons [mag]")
        for axes in panels:
            label_ends(axes)
