"""The trade-off of spectra: what stands in for a star's own spectrum, by its colours."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import SkySettings
from hilstar.sky.electrons import (
    Photometry,
    RateTable,
    library_electrons_per_s,
    load_library,
    star_temperatures_k,
    tabulate,
    tabulate_pickles,
)
from hilstar.sky.spectrum import (
    TEMPERATURE_SCALES,
)
from hilstar.study.shared.brightness import MAX_RELIABLE_VI_MAG, held_out_errors, study_optics
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import magnitude

SENSOR = "ccd47-20"
OWN_SPECTRUM = "each star's own spectrum"
# A library's spectra are known to about 0.01 mag; a tenth of that counts as none.
LIBRARY_MAG = 1e-3


def spectrum(stack: ExitStack, quick: bool) -> Trials:
    """What a star's colour says of its spectrum: error, mag, 95 % and median of the Pickles library bluer than V-I = 2.5."""
    del stack, quick
    library, optics = load_library(), study_optics(SENSOR)
    exact, zero = library_electrons_per_s(library, optics, Photometry()), np.zeros(len(library.spectral_type))
    sure, sky = library.vi_mag < MAX_RELIABLE_VI_MAG, SkySettings()
    real, bodies = tabulate_pickles(optics, Photometry()), tabulate("dgs", optics, Photometry())
    average = tabulate("ags", optics, Photometry())

    def trial(name: str, rates: FloatArray, work: Callable[[], object], settings: tuple[str, ...]) -> Trial:
        error = np.abs(magnitude(rates / exact))[sure]
        default = (sky.brightness, sky.spectrum, sky.temperature)[: len(settings)]
        figures = float(np.percentile(error, 95)), float(np.median(error))
        return Trial(name, *figures, work, settings == default, name == OWN_SPECTRUM)

    by_own = partial(library_electrons_per_s, library, optics, Photometry())
    colours = zero, library.bv_mag, library.vi_mag
    held_out = exact * (1 + held_out_errors(exact))
    trials = [
        trial(OWN_SPECTRUM, by_own(), by_own, ("dgs", "own")),
        trial("real spectra by V-I", held_out, partial(real.electrons_per_s, *colours), ("dgs", "pickles")),
    ]
    for scale in TEMPERATURE_SCALES:
        body = partial(_body_rates, bodies, library.bv_mag, scale)
        trials.append(trial(f"black body, {scale}", body(), body, ("dgs", "blackbody", scale)))
    ags = partial(average.electrons_per_s, zero, np.full(len(zero), 9602.0))
    trials.append(trial("AGS, one average", ags(), ags, ("ags",)))
    return Trials(
        "spectrum",
        f"{len(zero)} stars by a table made before",
        Figure("error of the electron rate, 95 % of library stars", "mag", LIBRARY_MAG),
        Figure("median star", "mag"),
        "a catalogue has colours and no spectra",
        trials,
    )


def _body_rates(table: RateTable, bv_mag: FloatArray, scale: str) -> FloatArray:
    return table.electrons_per_s(np.zeros(len(bv_mag)), star_temperatures_k(bv_mag, scale))
