"""Full scale of the light by the tracker: stars shown, their DN read, and the light of white
that follows.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.files import write_whole
from hilstar.basics.units import ERROR_OF_MEDIAN, MAG_PER_RELATIVE, magnitude
from hilstar.server.bench.bench_file import BenchFile, with_key
from hilstar.server.bench.config import read_config
from hilstar.server.bench.frame import Bench

# Error of a star's light beside its noise and its codes: what the window's sum, the response and
# the uniformity map leave on a well measured bench.
STAR_MAG = 0.004
UNSURE_MAG = 0.05  # readings that disagree by more are wrong for another reason than the scale


@dataclass(frozen=True, slots=True)
class StarReading:
    """A star shown, the sum of its DN above background, and the noise of that sum, DN; 0 where
    it is not known.
    """

    hip: int
    dn: float
    sigma_dn: float = 0.0


@dataclass(frozen=True, slots=True)
class MeasuredScale:
    """The light of white by the tracker; of each reading (n,) the ratio of measured to wanted
    light, and its weight.

    `noise_mag` is the error that the readings' own noise leaves, 0 where it is not known.
    """

    flux_at_white_e_per_s: float
    assumed_e_per_s: float
    ratios: FloatArray
    weights: FloatArray
    noise_mag: float

    @property
    def scatter_mag(self) -> float:
        """Standard deviation of the readings, by their weights, magnitudes; 0 for one."""
        count = len(self.ratios)
        if count < 2:
            return 0.0
        off = magnitude(self.ratios)
        shares = self.weights / self.weights.sum()
        variance = float((shares * (off - float((shares * off).sum())) ** 2).sum())
        return float(np.sqrt(variance * count / (count - 1)))

    @property
    def dof(self) -> int:
        """The degrees of freedom of that error: readings less one."""
        return len(self.ratios) - 1

    @property
    def relative_error(self) -> float | None:
        """The relative standard error of the light of white, by the readings' scatter and noise;
        None for one.
        """
        count = len(self.ratios)
        if count < 2:
            return None
        # as many readings of one weight
        alike = float(self.weights.sum() ** 2 / (self.weights**2).sum())
        by_scatter = ERROR_OF_MEDIAN * self.scatter_mag / math.sqrt(alike)
        return max(by_scatter, self.noise_mag) / MAG_PER_RELATIVE


def scale_of(white_e_per_s: float, ratios: FloatArray, noise_mag: FloatArray) -> MeasuredScale:
    """The light of white by the ratios of measured to wanted light (n,): their weighted median.

    `noise_mag` (n,) is the noise of each, 0 where it is not known, and then all have one weight.
    """
    is_known = bool((noise_mag > 0).all())
    if is_known:
        weights = 1 / (noise_mag**2 + STAR_MAG**2)
    else:
        weights = np.ones_like(ratios)
    order = np.argsort(ratios, kind="stable")
    below = np.cumsum(weights[order]) - weights[order] / 2
    median = float(np.interp(weights.sum() / 2, below, ratios[order]))
    noise = float(weights.sum() ** -0.5) if is_known else 0.0
    return MeasuredScale(white_e_per_s * median, white_e_per_s, ratios, weights, noise)


def scale_by_tracker(bench: Bench, readings: list[StarReading], exposure_s: float) -> MeasuredScale:
    """The light of white from the median ratio of measured to wanted light.

    Raises InputError for a star that the bench does not have, that clips, or that is too faint to
    be shown.
    """
    detector = bench.config.tracker.detector
    if exposure_s <= 0:
        raise InputError(
            f"an exposure of {exposure_s:g} s; write --exposure S, as the tracker exposed"
        )
    ratios = []
    for reading in readings:
        place = np.flatnonzero(bench.stars.hip == reading.hip)
        named = f"--reading {reading.hip}"
        if not len(place):
            raise InputError(
                f"{named}: the bench has no such star; take one of [sky] catalogue within"
                " faintest_v_mag"
            )
        rate = float(bench.stars.electrons_per_s[place[0]])
        if rate * bench.psf.peak_share > bench.flux_at_white_e_per_s:
            raise InputError(f"{named}: the star clips on the monitor; take a fainter one")
        if rate < bench.faintest_shown_e_per_s:
            raise InputError(
                f"{named}: the star is too faint for the monitor to show; take a brighter one"
            )
        ratios.append(reading.dn * detector.gain_e_per_dn / (rate * exposure_s))
    noise_mag = np.array(
        [MAG_PER_RELATIVE * reading.sigma_dn / max(reading.dn, 1e-9) for reading in readings]
    )
    return scale_of(bench.flux_at_white_e_per_s, np.array(ratios), noise_mag)


def with_flux_at_white(file: BenchFile, found: MeasuredScale, output: Path) -> None:
    """Write a copy of a bench file with the light of white and its standard error set, and comments
    kept.

    Raises InputError where that cannot be done.
    """
    if output.resolve().parent != file.path.resolve().parent:
        raise InputError(
            f"{output}: the bench file's paths are relative to it; write the copy beside"
            f" {file.path}"
        )
    key = "flux_at_white_e_per_s"
    flux_at_white_e_per_s = found.flux_at_white_e_per_s
    text = with_key(
        file.text, "render", key, flux_at_white_e_per_s, instead_of=("brightest_v_mag",)
    )
    if found.relative_error is not None:
        text = with_key(
            text, "certify", "flux_at_white_relative", float(f"{found.relative_error:.3g}")
        )
        text = with_key(text, "certify", "flux_at_white_dof", float(found.dof))
    write_whole(output, text)
    if read_config(output).render.flux_at_white_e_per_s != flux_at_white_e_per_s:
        raise InputError(
            f"{output}: the key could not be set in this file; write {key} ="
            f" {flux_at_white_e_per_s!r} under [render] yourself"
        )
