"""A monitor's response, fitted to measured patches: its calibration file, and how well it is known."""

from __future__ import annotations

import datetime
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.fit import ChannelFit, fit_channel
from hilstar.calibrate.measurements import CHANNELS, PRIMARIES, Measurements, check_drift, read_measurements
from hilstar.errors import InputError
from hilstar.monitor.calibration import load_calibration
from hilstar.monitor.calibration_file import Head, NotesTable, write_calibration
from hilstar.units import MAG_PER_RELATIVE

DECADES = (0, 1, 2, 3)  # below white, where the error of the response is stated
NOT_STATED = "not stated"


@dataclass(frozen=True, slots=True)
class Provenance:
    """Who measured, when (today by default), with what, and in which unit."""

    who: str = ""
    when: str = ""
    instrument: str = ""
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Repeats:
    """How often the levels were measured."""

    min: int
    max: int


@dataclass(frozen=True, slots=True)
class BlackLevel:
    """The light of code 0, relative to white and in the unit of measurement."""

    relative: float
    unit: float


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The errors of levels held out of the fit, of light above black, from white to three decades below it."""

    rms_percent: float
    p95_percent: float
    max_percent: float
    rms_mag: float
    max_mag: float


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """One channel's figures; `error_percent` is the standard error of its response at each decade below white."""

    codes: int
    repeats: Repeats
    black_level: BlackLevel
    noise_relative: float
    shape: str
    parameters: float
    error_percent: dict[str, float]
    holdout: HeldOut


@dataclass(frozen=True, slots=True)
class PhotometricSummary:
    """What was fitted and written; `first` is the channel that comes first in the calibration file."""

    bits: int
    channels: dict[str, ChannelSummary]
    first: ChannelSummary
    noise_relative: float
    additivity_percent: float | None
    drift_percent: float | None
    written: tuple[str, ...]
    sha256: str

    def json(self) -> dict[str, Any]:
        """The JSON object of `hilstar calibrate photometric`, the first channel's figures among the others."""
        figures = asdict(self)
        return {**figures.pop("first"), **figures}


def calibrate_photometric(
    measured: Path, output: Path, provenance: Provenance | None = None, bits: int | None = None
) -> PhotometricSummary:
    """Fit a response to MEASURED.csv and write MONITOR.toml with its CSV beside it.

    Raises InputError for files that cannot be read or written, and for data that are too few, saturated, falling or drifting.
    """
    data = read_measurements(measured, bits)
    fits = fit_all(data)
    drift = check_drift(data)
    columns = response_columns(fits)
    noise = max(fits[name].noise_relative for name in columns)
    drift_note = "not known: nothing was repeated" if math.isnan(drift) else f"{100 * drift:+.2f} % over the run"
    text = f"fitted to {measured.name}, sha256 {data.sha256}"
    if output.with_suffix(".csv").resolve() == measured.resolve():
        raise InputError(f"{output}: its response would be written over {measured}; choose another name")
    head = _head(data.bits, output, provenance or Provenance())
    table = write_calibration(output, head, columns, noise, NotesTable(drift=drift_note, text=text))
    written = load_calibration(output, data.bits)
    channels = {name: _channel_summary(fit) for name, fit in fits.items()}
    return PhotometricSummary(
        bits=data.bits,
        channels=channels,
        first=channels[next(iter(columns))],
        noise_relative=noise,
        additivity_percent=additivity_percent(fits),
        drift_percent=None if math.isnan(drift) else 100 * drift,
        written=(str(output), str(table)),
        sha256=written.sha256,
    )


def _head(bits: int, output: Path, provenance: Provenance) -> Head:
    return Head(
        kind="photometric",
        who=provenance.who or NOT_STATED,
        when=provenance.when or datetime.date.today().isoformat(),
        instrument=provenance.instrument or NOT_STATED,
        unit=provenance.unit or NOT_STATED,
        bits=bits,
        response=output.with_suffix(".csv").name,
    )


def fit_all(data: Measurements) -> dict[str, ChannelFit]:
    """The response of each channel that was measured. Raises InputError where it is neither w nor all of r, g and b."""
    channels = data.channels
    if "w" not in channels and channels != PRIMARIES:
        raise InputError(f"{data.source}: only channel {', '.join(channels)}; measure w, or all of r, g and b")
    if len(channels) not in {1, 3, 4}:
        raise InputError(f"{data.source}: channels {', '.join(channels)}; measure w alone, or all of r, g and b")
    return {name: fit_channel(data, name) for name in channels}


def response_columns(fits: dict[str, ChannelFit]) -> dict[str, FloatArray]:
    """Light (2^bits,) by channel as the calibration file has it: r, g and b where they are known, else w; one black for all."""
    names = PRIMARIES if "r" in fits else ("w",)
    black = float(np.mean([fits[name].black for name in names]))
    return {name: black + fits[name].white * fits[name].light for name in names}


def additivity_percent(fits: dict[str, ChannelFit]) -> float | None:
    """How far r + g + b is from w at white, both above black, in % of w; None where they were not all measured."""
    if len(fits) < len(CHANNELS):
        return None
    return 100 * (sum(fits[name].white for name in PRIMARIES) / fits["w"].white - 1)


def _channel_summary(fit: ChannelFit) -> ChannelSummary:
    count = fit.levels.count
    log_light = np.log(np.maximum(fit.light, 1e-12))
    places = {decade: int(np.argmin(np.abs(log_light + decade * math.log(10)))) for decade in DECADES}
    return ChannelSummary(
        codes=len(count),
        repeats=Repeats(int(count.min()), int(count.max())),
        black_level=BlackLevel(fit.black / fit.white, fit.black),
        noise_relative=fit.noise_relative,
        shape=fit.shape,
        parameters=fit.parameters,
        error_percent={f"1e-{decade}": 100 * float(fit.error[place]) for decade, place in places.items()},
        holdout=held_out(fit),
    )


def held_out(fit: ChannelFit) -> HeldOut:
    """The errors of the levels of a fit, each held out of it."""
    shown = fit.light[fit.levels.code[1:]] >= 10.0 ** -DECADES[-1]
    residual = np.abs(fit.residual[shown])
    rms, p95, largest = float(np.sqrt((residual**2).mean())), float(np.percentile(residual, 95)), float(residual.max())
    return HeldOut(100 * rms, 100 * p95, 100 * largest, MAG_PER_RELATIVE * rms, MAG_PER_RELATIVE * largest)
