"""Black bodies by B-V, and real spectra by V-I, against the library of real spectra itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.charts import BLUE, GREEN, INK, MUTED, ORANGE, chart, plain_ticks, write_csv
from hilstar.sky.electrons import (
    Library,
    Photometry,
    dgs_electrons_per_s,
    library_electrons_per_s,
    load_library,
    star_temperatures_k,
)
from hilstar.sky.spectrum import TEMPERATURE_SCALES
from hilstar.study.models.finding import Finding
from hilstar.study.models.settings import SENSORS
from hilstar.study.shared.brightness import MAX_RELIABLE_VI_MAG, held_out_errors, study_optics

HELD_OUT = "pickles, leave-one-out"

# Relative errors (m,) of the library's stars, by sensor and method.
Errors = dict[tuple[str, str], FloatArray]


def spectra(directory: Path) -> Finding:
    """Black bodies and the Pickles relation, each star held out in turn, against the Pickles spectra over V-I."""
    library = load_library()
    errors = method_errors(library)
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    figures = {key: np.percentile(100 * np.abs(error[sure]), (50, 95)) for key, error in errors.items()}
    text = "Median error of the electron rate (95 %), V-I < 2.5: " + "; ".join(
        f"{SENSORS[sensor].split()[0]} {real[0]:.1f} % ({real[1]:.1f} %) by real spectra and V-I,"
        f" {body[0]:.1f} % ({body[1]:.1f} %) by black bodies and B-V"
        for sensor in SENSORS
        for real, body in [(figures[sensor, HELD_OUT], figures[sensor, "black body, ballesteros2012"])]
    )
    real, body = (max(figures[s, name][1] for s in SENSORS) for name in (HELD_OUT, "black body, ballesteros2012"))
    finding = (
        f"Real spectra by V-I give the electron rate within {real:.1f} % for 95 % of stars to V-I = {MAX_RELIABLE_VI_MAG:g},"
        f" black bodies by B-V within {body:.0f} %"
    )
    _draw(directory / "spectra", finding, library, errors)
    columns = ("spectral_type", "bv_mag", "vi_mag", *(f"{s}: {n} [%]" for s, n in errors))
    table = zip(library.spectral_type, library.bv_mag, library.vi_mag, *(100 * e for e in errors.values()), strict=True)
    write_csv(directory / "spectra.csv", columns, table)
    return Finding("spectra", text)


def method_errors(library: Library) -> Errors:
    """The error of every method for every star of the library."""
    errors: Errors = {}
    for sensor in SENSORS:
        rates = library_electrons_per_s(library, study_optics(sensor), Photometry())
        errors[sensor, HELD_OUT] = held_out_errors(rates)
        for scale in TEMPERATURE_SCALES:
            body = dgs_electrons_per_s(star_temperatures_k(library.bv_mag, scale), study_optics(sensor), Photometry())
            errors[sensor, f"black body, {scale}"] = body / rates - 1
    return errors


def _draw(path: Path, finding: str, library: Library, errors: Errors) -> None:
    redder = int((library.vi_mag >= MAX_RELIABLE_VI_MAG).sum())
    note = f"A mark a Pickles spectrum, each held out in turn; {redder} are redder than the dashed line."
    with chart(path, finding, panels=2, note=note) as panels:
        for axes, sensor in zip(panels, SENSORS, strict=True):
            named = [(name, error) for (owner, name), error in errors.items() if owner == sensor]
            for (name, error), mark, colour in zip(reversed(named), ("+", "x", "o"), (GREEN, ORANGE, BLUE), strict=True):
                axes.plot(library.vi_mag, 100 * error, mark, color=colour, ms=4, label=name)
            axes.axvline(MAX_RELIABLE_VI_MAG, color=MUTED, lw=1, ls="--")
            axes.axhline(0, color=INK, lw=1)
            axes.set_yscale("symlog", linthresh=5)
            axes.set(ylabel="error of the electron rate [%]", title=SENSORS[sensor])
            axes.set_ylim(-130, 5000)
            plain_ticks(axes.yaxis, (-50, -10, 0, 10, 50, 200))
        panels[-1].set(xlabel="V-I [mag]")
        panels[0].legend(loc="upper right")
