"""A monitor's primaries and a tracker's channels: the electrons of each channel by each primary, one matrix from spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.csv_tables import finite_numbers, read_rows
from hilstar.errors import InputError
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import MAX_CURVE_BYTES, RANGE_NM, Curve, integration_nodes

PRIMARIES = ("r", "g", "b")
COLUMNS = ("wavelength_nm", *PRIMARIES)
ADVICE = "write wavelength_nm,r,g,b: each primary's relative spectral power at full drive"


@dataclass(frozen=True, slots=True)
class ChannelMatrix:
    """`e_per_s` (channels, 3): electrons per second in each of `channels` by each primary of a pixel at full light.

    By `condition` times as much as the channels' light can the primaries' be wrong, both relative; None where two channels, or
    two primaries, have the same colour.
    """

    channels: tuple[str, ...]
    e_per_s: FloatArray
    condition: float | None


def read_primaries(path: Path) -> tuple[Curve, ...]:
    """The spectra of red, green and blue in a CSV file, per nm in one unit, zero outside its wavelengths. Raises InputError."""
    rows = []
    for line, cells in read_rows(path, COLUMNS, ADVICE, MAX_CURVE_BYTES):
        rows.append(finite_numbers(path, line, COLUMNS, cells[: len(COLUMNS)], ADVICE))
        if min(rows[-1][1:]) < 0 or not RANGE_NM[0] < rows[-1][0] < RANGE_NM[1]:
            raise InputError(f"{path}:{line}: power below 0, or a wavelength that is not in nm; {ADVICE}")
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise InputError(f"{path}:{line}: wavelengths do not rise from row to row; sort them, each once")
    table = np.array(rows).reshape(-1, len(COLUMNS)).T
    dark = [name for name, power in zip(PRIMARIES, table[1:], strict=True) if not power.any()]
    if dark:
        raise InputError(f"{path}: {len(rows)} rows, and no light of {', '.join(dark)}; {ADVICE}")
    # Knots beside both ends and far off: beyond its ends, where a tracker may see, a primary has no light.
    first, last = np.nextafter(table[0, [0, -1]], [0.0, np.inf])
    nm = np.concatenate([[RANGE_NM[0], first], table[0], [last, RANGE_NM[1]]])
    return tuple(Curve(nm, np.pad(power, 2)) for power in table[1:])


def reddest_nm(primaries: Sequence[Curve], least: float = 0.01) -> float:
    """The longest wavelength at which a primary has `least` of its largest power."""
    lit = [curve.wavelength_nm[curve.value > least * curve.value.max()].max() for curve in primaries]
    return float(max(lit))


def channel_matrix(primaries: Sequence[Curve], channels: Mapping[str, Optics], white_e_per_s: float) -> ChannelMatrix:
    """The matrix of a monitor and a tracker: all primaries give `white_e_per_s` in all channels together.

    An entry is in proportion to the integral of power, quantum efficiency, transmission and wavelength: photons are counted.
    Raises InputError where the tracker detects no light of the primaries.
    """
    matrix = np.array([[_electrons(primary, optics) for primary in primaries] for optics in channels.values()])
    if not matrix.any():
        raise InputError("[monitor.primaries] file: the tracker detects none of this light; check that both are in nm")
    parted = np.linalg.matrix_rank(matrix) == min(matrix.shape)
    condition = float(np.linalg.cond(matrix)) if parted else None
    return ChannelMatrix(tuple(channels), matrix * (white_e_per_s / matrix.sum()), condition)


def _electrons(primary: Curve, optics: Optics) -> float:
    curves = primary, optics.quantum_efficiency, optics.transmission
    nm, weight = integration_nodes(*curves)
    return float(np.prod([curve(nm) for curve in curves], axis=0) * nm @ weight)
