"""A tracker's channels, and the electrons per second of stars in each."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.reading import warn_once
from hilstar.server.bench.config import (
    BenchConfig,
    Tracker,
)
from hilstar.server.bench.config.sky import SkySettings
from hilstar.server.bench.glass import glass_transmission
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import (
    Optics,
    Photometry,
    all_channels,
    star_temperatures_k,
    tabulate,
    tabulate_pickles,
)
from hilstar.sky.spectral_types import star_types, tabulate_types
from hilstar.sky.spectrum import QUANTUM_EFFICIENCIES, Curve, load_curve
from hilstar.sky.stars import (
    total_and_colours,
)

V_BAND_NM, V_BAND_POINTS = (470.0, 700.0), 231  # Johnson V


def bench_channels(tracker: Tracker, folder: Path) -> tuple[Optics, ...]:
    """The tracker's light-gathering part by channel: what it tells apart; curve paths are
    relative to `folder`.
    """
    given = tracker.quantum_efficiencies.items()
    efficiencies = []
    for key, source in given:
        efficiencies.append(load_curve(source, f"[tracker] {key}", folder, QUANTUM_EFFICIENCIES))
    transmission = glass_transmission(tracker, folder)
    if not any(_sees_v(curve) for curve in efficiencies):
        names = ", ".join(tracker.quantum_efficiencies)
        band = f"{V_BAND_NM[0]:g} to {V_BAND_NM[1]:g} nm"
        warn_once(
            f"[tracker] {names}: no light of V ({band}), in which magnitudes are; all light is from"
            " their colours"
        )
    channels = []
    for efficiency in efficiencies:
        filled = efficiency.value * tracker.detector.fill_factor
        of_pixel = Curve(efficiency.wavelength_nm, filled)
        channels.append(Optics(tracker.aperture_mm, of_pixel, transmission))
    return tuple(channels)


def _sees_v(efficiency: Curve) -> bool:
    first_nm, last_nm = V_BAND_NM
    nm = np.linspace(first_nm, last_nm, V_BAND_POINTS)
    return bool(efficiency(nm).any())


def bench_optics(tracker: Tracker, folder: Path) -> Optics:
    """The tracker's light-gathering part in all channels together."""
    return all_channels(bench_channels(tracker, folder))


class StarRates(Protocol):
    """Electron rates of stars (n,) by their V, B-V, V-I (NaN where unknown) and, if it is used,
    `kind` of `star_kinds`.
    """

    def __call__(
        self,
        v_mag: FloatArray,
        bv_mag: FloatArray,
        vi_mag: FloatArray,
        kind: FloatArray | None = None,
        /,
    ) -> FloatArray:
        """The rates (n,), or by channel (n, channels)."""


def star_kinds(config: BenchConfig, catalog: Catalog) -> FloatArray | None:
    """The types (n, 2) of stars, as `star_types` reads them, where a bench's spectra follow
    types; None elsewhere.
    """
    if (config.sky.brightness, config.sky.spectrum) == ("dgs", "mk"):
        return star_types(catalog)
    return None


def star_rates(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n,) of stars on a bench's tracker, in all channels together."""
    flux = star_flux(config, folder)
    return lambda *columns: total_and_colours(flux(*columns)).electrons_per_s


def star_flux(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n, channels) of stars on a bench's tracker, by tables that are made
    here, once.
    """
    rates = [channel_rates(config.sky, optics) for optics in bench_channels(config.tracker, folder)]
    return lambda *columns: np.stack([channel(*columns) for channel in rates], axis=1)


def channel_rates(sky: SkySettings, optics: Optics) -> StarRates:
    """The electron rates (n,) of stars in one channel, by a table that is made here, once.
    Raises InputError.
    """
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    if sky.brightness == "dgs" and sky.spectrum == "pickles":
        by_colour = tabulate_pickles(optics, photometry)
        return lambda v_mag, bv_mag, vi_mag, _kind=None: by_colour.electrons_per_s(
            v_mag, bv_mag, vi_mag
        )
    if sky.brightness == "dgs" and sky.spectrum == "mk":
        return tabulate_types(optics, photometry).electrons_per_s
    by_temperature = tabulate(sky.brightness, optics, photometry)
    return lambda v_mag, bv_mag, vi_mag, kind=None: by_temperature.electrons_per_s(
        v_mag, star_temperatures_k(bv_mag, sky.temperature)
    )


def named_channels(tracker: Tracker, folder: Path) -> dict[str, Optics]:
    """The tracker's light-gathering part of each channel by its key."""
    return dict(zip(tracker.quantum_efficiencies, bench_channels(tracker, folder), strict=True))
