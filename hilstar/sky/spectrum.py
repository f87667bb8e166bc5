"""Spectra: black bodies, colour temperatures, passbands and curves over wavelength."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.reading import exists
from hilstar.basics.text_tables import Chosen, Column, TextTable, finite_numbers, open_table
from hilstar.basics.units import LIGHT_M_S, factor

PLANCK_J_S = 6.62607015e-34  # SI 2019, exact
BOLTZMANN_J_K = 1.380649e-23
STEFAN_BOLTZMANN_W_M2_K4 = 5.670374419e-8

DATA_DIR = Path(__file__).resolve().parent / "data"
MAX_CURVE_BYTES = 1_000_000
# smallest constant curve: no sensor or lens is below, and products stay within float64
MIN_CONSTANT = 1e-6
MAX_CURVE_ROWS = 10_000
CURVE_COLUMNS = ("wavelength_nm", "value")
CURVE_ADVICE = "write wavelength_nm,value"
# What the second column may be called where none is called value.
VALUE_NAMES = (
    "qe",
    "quantum_efficiency",
    "absolute_qe",
    "external_qe",
    "eqe",
    "efficiency",
    "eta",
    "η",
    "transmission",
    "transmittance",
    "transmissivity",
    "trans",
    "t",
    "throughput",
    "tau",
    "response",
    "sensitivity",
    "extinction",
    "flux",
    "f_lambda",
    "flambda",
    "radiance",
    "intensity",
)
UNIT_HEADERS = {"nm": "wavelength_nm", "um": "wavelength_um", "angstrom": "wavelength_angstrom"}
# Where curves of sensors, glasses and skies begin (from, below) and end in each unit. Silicon and
# InGaAs see 200 to 2600 nm; what begins at 1000 to 2000 and goes on may be nm of the infrared or
# angstrom of the ultraviolet: its unit has to be stated.
UNIT_RANGES = (
    ("um", 0.1, 30.0, 30.0),
    ("nm", 100.0, 1000.0, 5000.0),
    ("nm", 1000.0, 2000.0, 2600.0),
    ("angstrom", 2000.0, 100_000.0, 100_000.0),
)
MIN_STATED_NM = 100.0  # no curve lies below as a whole
RANGE_NM = (1.0, 100_000.0)  # beyond any sensor; each MAX_INTERVAL_NM costs nodes
QUANTUM_EFFICIENCIES = ("ccd47-20", "kai-4021", "icx285", "imx249", "imx250", "imx252")
TRANSMISSIONS = ("n-bk7-10mm",)
BUILT_IN_CURVES = (*QUANTUM_EFFICIENCIES, *TRANSMISSIONS, "johnson-v")

# Gauss-Legendre nodes in each interval between knots of the curves; intervals are at most this
# wide.
# A Planck curve at 1000 K over 25 nm, times two straight lines, is then integrated to 1e-13.
GAUSS_ORDER = 8
MAX_INTERVAL_NM = 25.0
NODES, WEIGHTS = np.polynomial.legendre.leggauss(GAUSS_ORDER)

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


@dataclass(frozen=True, slots=True)
class Curve:
    """A value over wavelength: straight lines between knots, zero outside them.

    A constant has no knots of its own: `wavelength_nm` is empty and `value` has one entry.
    """

    wavelength_nm: FloatArray
    value: FloatArray

    def __call__(self, wavelength_nm: FloatArray) -> FloatArray:
        """The value at each wavelength, same shape."""
        if not len(self.wavelength_nm):
            return np.full_like(wavelength_nm, self.value[0])
        return np.interp(wavelength_nm, self.wavelength_nm, self.value, left=0.0, right=0.0)


def constant_curve(value: float) -> Curve:
    """The same value at every wavelength."""
    return Curve(np.empty(0), np.array([value]))


def load_curve(
    source: str | float,
    what: str,
    folder: Path = DATA_DIR,
    built_in: tuple[str, ...] = BUILT_IN_CURVES,
) -> Curve:
    """A curve from a built-in name, a CSV path (wavelength_nm,value; relative to `folder`) or a
    number.

    `what` names the curve in the InputError that bad input raises, `built_in` are the names of its
    kind.
    """
    if isinstance(source, int | float):
        if not MIN_CONSTANT <= source <= 1.0:
            raise InputError(
                f"{what} = {shortened(source)}: write a number from {MIN_CONSTANT:g} to 1"
            )
        return constant_curve(float(source))
    if source in built_in:
        return _packaged_curve(source)
    path = folder / source
    if not exists(path):
        names = ", ".join(f'"{name}"' for name in built_in)
        shown = shortened(source)
        raise InputError(
            f"{what} = {shown!r}: no such built-in or file {path}; "
            f"{did_you_mean(source, built_in)}write {names}, a CSV path or a number"
        )
    return read_curve_csv(path)


@cache
def _packaged_curve(name: str) -> Curve:
    return read_curve_csv(DATA_DIR / f"{name}.csv")


def read_curve_csv(path: Path, highest: float = 1.0) -> Curve:
    """Read a text table of wavelengths and values, values 0 to `highest`: `wavelength_nm,value`, or
    in units that it states.

    Shares (`highest` 1) may be in percent. Without a header there are two columns, and without a
    unit of wavelength its range says the unit (`_unit_by_range`). Raises InputError with the line
    number.
    """
    with open_table(path, CURVE_ADVICE, MAX_CURVE_BYTES) as table:
        if not table.columns:
            raise InputError(f"{path}: 0 rows; write at least two rows wavelength_nm,value")
        wavelength, values = _curve_columns(table, highest)
        table.not_used((wavelength, values))
        rows = []
        for line, cells in table.rows():
            pair = table.cell(cells, wavelength), table.cell(cells, values)
            rows.append(finite_numbers(path, line, CURVE_COLUMNS, pair, CURVE_ADVICE))
            if len(rows) > MAX_CURVE_ROWS:
                raise InputError(f"{path}: more than {MAX_CURVE_ROWS} rows; remove some")
        numbers = np.array(rows, dtype=np.float64).reshape(-1, 2)
        if len(rows) > 1:
            numbers[:, 0] *= _nm_of(table, wavelength, numbers[:, 0])
        table.warn()
    curve = Curve(numbers[:, 0].copy(), numbers[:, 1].copy())
    _check_curve(curve, path, highest)
    return curve


def _curve_columns(table: TextTable, highest: float) -> tuple[Chosen, Chosen]:
    """The columns of wavelength and value. Raises InputError where the header does not say which
    these are.
    """
    wavelength = None
    if table.header:
        wavelength = table.chosen("wavelength_nm", must_state=False)
    if wavelength is None and not (table.header and not table.commented):
        # A comment that names no wavelength is no header.
        if len(table.columns) != 2:
            raise table.refusal(
                table.header_line,
                f"{len(table.columns)} columns, and no header that says which is which",
            )
        table.columns = [Column("", "")] * 2
        return Chosen(0, has_unit=False), Chosen(1)
    if wavelength is None:
        raise table.refusal(table.header_line, f"no column wavelength_nm among {table.names}")
    unit = "1" if highest == 1 else ""
    values = table.chosen("value", unit, VALUE_NAMES, must_state=False)
    if values is None:
        raise table.refusal(table.header_line, f"no column value among {table.names}")
    return wavelength, values


def _nm_of(table: TextTable, wavelength: Chosen, wavelengths: FloatArray) -> float:
    """By what wavelengths are multiplied to be nm. Raises InputError where their range and their
    unit disagree.
    """
    low = float(wavelengths.min())
    high = float(wavelengths.max())
    unit = _unit_by_range(low, high)
    span = f"wavelengths from {low:g} to {high:g}"
    if not wavelength.has_unit:
        if unit is None:
            raise InputError(
                f"{table.path}: {span} without a unit; write it in the header:"
                f" {', '.join(UNIT_HEADERS.values())}"
            )
        if unit != "nm":
            table.notices.append(
                f"{span} without a unit are taken as {unit}; {UNIT_HEADERS['nm']} says that they"
                " are nm"
            )
        size = factor(unit, "nm")
        return 1.0 if size is None else float(size)
    if wavelength.factor is None:
        refuse_other_units(table.path, low, high)
    if high < MIN_STATED_NM:
        stated = table.columns[wavelength.place].header
        raise InputError(
            f"{table.path}: {span} nm by its column {stated}, which no tracker sees; check its unit"
        )
    return 1.0


def refuse_other_units(path: Path, low_nm: float, high_nm: float) -> None:
    """Refuse (InputError) wavelengths stated in nm that lie where only um or angstrom can."""
    unit = _unit_by_range(low_nm, high_nm)
    if unit in {"um", "angstrom"}:
        advice = f"write {UNIT_HEADERS[unit]} in the header, or wavelength_um for the far infrared"
        span = f"wavelengths from {low_nm:g} to {high_nm:g} nm"
        raise InputError(f"{path}: {span}, which look like {unit}; {advice}")


def _unit_by_range(low: float, high: float) -> str | None:
    """The unit of wavelengths of a silicon or an infrared sensor by their range; None where two
    would do.
    """
    for unit, first, before, last in UNIT_RANGES:
        if first <= low < before and high <= last:
            return unit
    return None


def _check_curve(curve: Curve, path: Path, highest: float) -> None:
    """Raise InputError for a curve of too few or too many rows, that do not rise, or beyond what
    their kind can have.
    """
    wavelength_nm = curve.wavelength_nm
    value = curve.value
    if len(wavelength_nm) < 2:
        raise InputError(
            f"{path}: {len(wavelength_nm)} rows; write at least two rows wavelength_nm,value"
        )
    if not (np.isfinite(wavelength_nm).all() and np.isfinite(value).all()):
        raise InputError(f"{path}: a wavelength or a value is not finite; write numbers")
    if not (np.diff(wavelength_nm) > 0).all() or wavelength_nm[0] <= 0:
        raise InputError(
            f"{path}: wavelengths do not rise from row to row; sort them, each once, in nm"
        )
    if len(wavelength_nm) > MAX_CURVE_ROWS:
        raise InputError(
            f"{path}: {len(wavelength_nm)} rows; at most {MAX_CURVE_ROWS} are read: remove some"
        )
    if wavelength_nm[0] < RANGE_NM[0] or wavelength_nm[-1] > RANGE_NM[1]:
        ends = f"{wavelength_nm[0]:g} to {wavelength_nm[-1]:g} nm"
        raise InputError(
            f"{path}: wavelengths from {ends}; write {RANGE_NM[0]:g} to {RANGE_NM[1]:g} nm"
        )
    if value.min() < 0 or value.max() > highest:
        what = "fractions from 0 to 1"
        if highest != 1:
            what = f"numbers from 0 to {highest:g}"
        raise InputError(f"{path}: values from {value.min():g} to {value.max():g}; write {what}")


def blackbody_exitance_w_m2_m(
    wavelength_nm: FloatArray, temperature_k: float | FloatArray
) -> FloatArray:
    """pi B(lambda, T), W per m2 and m of wavelength (thesis eq. 3.3, 3.4); the shapes broadcast.

    Written with exp(-x), so that a small lambda T gives 0 instead of an overflow.
    """
    wavelength_m = wavelength_nm * 1e-9
    x = PLANCK_J_S * LIGHT_M_S / (wavelength_m * BOLTZMANN_J_K * temperature_k)
    scale = 2 * np.pi * PLANCK_J_S * LIGHT_M_S**2 / wavelength_m**5
    return np.asarray(scale * np.exp(-x) / -np.expm1(-x))


def temperature_ballesteros2012_k(bv_mag: FloatArray) -> FloatArray:
    """Colour temperature from B-V (Ballesteros 2012, EPL 97, 34008, eq. 14): smooth everywhere."""
    hotter = 1.0 / (0.92 * bv_mag + 1.7)
    cooler = 1.0 / (0.92 * bv_mag + 0.62)
    return np.asarray(4600.0 * (hotter + cooler))


def temperature_wang2021_k(bv_mag: FloatArray) -> FloatArray:
    """Colour temperature from B-V, thesis eq. 3.13: jumps from 9260 K to 8910 K at B-V = 0."""
    hot = 1079.20644 * np.exp(-bv_mag / 0.09824) + 8180.59419
    cool = 8906.09411 * np.exp(-bv_mag / 1.59761) + 3.633
    return np.where(bv_mag < 0, hot, cool)


def torres2010_k(bv_mag: FloatArray, supergiant: bool = False) -> FloatArray:
    """Effective temperature from B-V (Torres 2010, table 2); shape of `bv_mag`."""
    coefficients = TORRES_SUPERGIANTS if supergiant else TORRES_DWARFS_AND_GIANTS
    return np.asarray(10 ** np.polynomial.polynomial.polyval(bv_mag, coefficients))


TEMPERATURE_SCALES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "ballesteros2012": temperature_ballesteros2012_k,
    "wang2021": temperature_wang2021_k,
}


def integration_nodes(*curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Wavelengths [nm] and weights [m] that integrate a product of the curves and a smooth
    spectrum.

    Gauss-Legendre between every two neighbouring knots of all curves, over the range they share.
    """
    ranged = [curve.wavelength_nm for curve in curves if len(curve.wavelength_nm)]
    low = max(w[0] for w in ranged)
    high = min(w[-1] for w in ranged)
    knots = np.sort(np.concatenate(ranged))
    is_new = np.diff(knots, prepend=-np.inf) > 0
    knots = knots[(knots >= low) & (knots <= high) & is_new]
    if len(knots) < 2:
        raise InputError(
            "the quantum efficiency and the transmission share no wavelength; check that both are"
            " in nm"
        )
    widths = np.diff(knots)
    pieces = np.maximum(1, np.ceil(widths / MAX_INTERVAL_NM)).astype(int)
    # number within its interval, from 0
    first_piece = np.cumsum(pieces) - pieces
    piece = np.arange(pieces.sum()) - np.repeat(first_piece, pieces)
    begins = np.repeat(knots[:-1], pieces) + piece * np.repeat(widths / pieces, pieces)
    edges = np.append(begins, knots[-1])
    half = np.diff(edges)[:, None] / 2
    wavelength_nm = (edges[:-1, None] + half * (1 + NODES)).ravel()
    return wavelength_nm, (half * WEIGHTS).ravel() * 1e-9
