"""The wavelengths of a PSF, as the light of a bench's stars has them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.optics.glass.glass_psf import NodeSpline
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.star_rates import StarRates, bench_optics, channel_rates, star_kinds
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import (
    Optics,
)
from hilstar.sky.spectrum import Curve
from hilstar.sky.stars import (
    Stars,
)

# Bands of a star's light as a glass sees it: twice as fine moves no share by over 1e-3
# (tests/unit/instruments/simulate/test_glass.py)
BAND_NM, KNOT_NM = 25.0, 5.0


class StarGlass:
    """The shares that a `psf`'s wavelengths have of the light of a bench's stars, through one
    channel's `optics` or all.

    The band is cut into narrow ones, whose electrons come from the same tables as a star's total,
    so every model of
    spectra (`[sky] brightness`, `spectrum`, `temperature`) counts here too.
    """

    def __init__(
        self, file: BenchFile, psf: Psf, optics: Optics | None = None, band_nm: float = BAND_NM
    ) -> None:
        self.psf = psf
        self._config = file.config
        self._mean = psf.mean_shares
        self._catalog: Catalog | None = None
        self._of_row = np.empty((0, 0))
        self._bands: list[StarRates] = []
        self._of_band = np.ones((0, 1))
        if len(psf.wavelengths_nm) > 1:
            whole = optics or bench_optics(file.config.tracker, file.folder)
            flat = self._cut(file, whole, band_nm)
            if optics is not None and self._bands:
                self._mean = flat @ self._of_band / flat.sum()

    def _cut(self, file: BenchFile, optics: Optics, band_nm: float) -> FloatArray:
        """Bands that overlap as triangles do, so that they sum to the tracker's own; each one's
        response to even photons.
        """
        low_nm, high_nm = optics.range_nm
        range_nm = high_nm - low_nm
        nodes_nm = np.linspace(low_nm, high_nm, math.ceil(range_nm / band_nm) + 1)
        fine_nm = np.linspace(low_nm, high_nm, math.ceil(range_nm / KNOT_NM) + 1)
        curve_nm = optics.quantum_efficiency.wavelength_nm
        is_inside = (curve_nm >= low_nm) & (curve_nm <= high_nm)
        even_nm = np.union1d(nodes_nm, fine_nm)
        knots_nm = np.union1d(even_nm, curve_nm[is_inside])
        efficiency = optics.quantum_efficiency(knots_nm)
        splines = NodeSpline(self.psf.wavelengths_nm)
        shares = splines(knots_nm)
        triangles = np.eye(len(nodes_nm))
        of_band = []
        flat = []
        for triangle in triangles:
            part = efficiency * np.interp(knots_nm, nodes_nm, triangle)
            response = part * optics.transmission(knots_nm) * np.gradient(knots_nm)
            if not response.any():
                continue
            band = dataclasses.replace(optics, quantum_efficiency=Curve(knots_nm, part))
            try:
                rates = channel_rates(file.config.sky, band)
            except InputError:
                # so little light that some spectrum has none: the bands beside it stand for it
                continue
            self._bands.append(rates)
            flat.append(response.sum())
            of_band.append(response @ shares / flat[-1])
        self._of_band = np.array(of_band)
        return np.array(flat)

    def shares(self, stars: Stars, which: IntArray) -> FloatArray:
        """The shares (n, L) of stars at places (n,) of `stars`; those of light without a
        spectrum where a place is negative.
        """
        if not self._bands:
            return self._mean
        if self._catalog is not stars.catalog:
            self._catalog = stars.catalog
            self._of_row = np.full((len(stars.catalog), self._of_band.shape[1]), np.nan)
        spectra_shares = np.tile(self._mean, (len(which), 1))
        rows = np.where(which >= 0, stars.row[np.maximum(which, 0)], -1)
        listed = rows >= 0
        body = (rows < 0) & (which >= 0)
        listed_rows = rows[listed]
        is_new = np.isnan(self._of_row[listed_rows, 0])
        new_rows = np.unique(listed_rows[is_new])
        if len(new_rows):
            some = stars.catalog.taken(new_rows)
            kind = star_kinds(self._config, some)
            self._of_row[new_rows] = self._through(some.bv_mag, some.vi_mag, kind)
        spectra_shares[listed] = self._of_row[listed_rows]
        if body.any():
            bv_mag = stars.bv_mag[which[body]]
            nobody = stars.catalog.taken(np.arange(0))
            kind = None
            if star_kinds(self._config, nobody) is not None:  # stars count by type, too
                kind = np.full((len(bv_mag), 2), np.nan)
            spectra_shares[body] = self._through(bv_mag, np.full_like(bv_mag, np.nan), kind)
        return spectra_shares

    def shares_of(self, stars: Stars, hip: IntArray) -> FloatArray:
        """The same by Hipparcos numbers (n,) of `stars`, 0 for a body."""
        order = np.argsort(stars.hip)
        at = np.minimum(np.searchsorted(stars.hip, hip, sorter=order), len(order) - 1)
        return self.shares(stars, np.where(hip > 0, order[at], -1))

    def _through(
        self, bv_mag: FloatArray, vi_mag: FloatArray, kind: FloatArray | None
    ) -> FloatArray:
        v_mag = np.zeros_like(bv_mag)
        by_band = [band(v_mag, bv_mag, vi_mag, kind) for band in self._bands]
        rates = np.stack(by_band, axis=1)
        return np.asarray(rates @ self._of_band / rates.sum(axis=1, keepdims=True))


def star_glass(file: BenchFile, psf: Psf, optics: Optics | None = None) -> StarGlass | None:
    """The spectra of a bench's stars as `psf` has them; None for one that is the same for all."""
    if psf.by_colour:
        return StarGlass(file, psf, optics)
    return None
