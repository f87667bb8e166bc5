"""A sensor's `[tracker.detector]` from an EMVA 1288 data sheet, or from a user's own flats and
darks by photon transfer.

Photon transfer (Janesick 2007; EMVA 1288, release 4.0): two frames of one exposure give the noise
by their difference and the fixed pattern by their covariance. Shot noise makes the variance K times
the signal, with K in DN/e-.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from hilstar.basics import charts
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import write_whole
from hilstar.basics.reading import read_text
from hilstar.basics.text_tables import finite_numbers, read_rows
from hilstar.basics.units import ascii_text, plain_unit
from hilstar.instruments.calibrate.geometric.observed import read_exposed, read_image
from hilstar.tracker.settings import BOLTZMANN_EV_PER_K, DetectorSettings

MAX_EMVA_BYTES = 1_000_000
FRAME_ADVICE = "give raw frames as FITS or PNG, 8 to 16 bits of grey"
EMVA_ADVICE = "write rows quantity,value,unit, such as K,0.25,DN/e- and eta@530nm,62,%"
EMVA_COLUMNS = ("quantity", "value", "unit")
ICE_K = 273.15
EXPOSURE_KEY = "EXPTIME"
# of the temporal noise: means of one level drift by less, and 128 x 128 px tell them to 0.01
DARK_SPREAD = 0.5
ROUNDING_DN2 = 1 / 12
# share of saturation: the standard's range for the slope of variance over signal
LINEAR_SHARE = 0.7
GREEK = {"σ": "sigma", "μ": "mu", "µ": "mu", "η": "eta", "τ": "tau"}
# Of one quantity in DN and in electrons, both rounded.
ROUNDED_ALIKE = 0.05
WAVELENGTH = re.compile(r"(?:lambda=)?(\d+(?:\.\d+)?)nm")
# spellings of a unit that no rule of `sheet_unit` turns into its own
UNIT_SPELLINGS = {"c": "degc", "": "1", "e-s-1": "e-/s", "e-.s-1": "e-/s"}
GAIN_UNITS: dict[str, Callable[[float], float]] = {"dn/e-": lambda value: 1 / value}
ELECTRONS: dict[str, Callable[[float], float]] = {"e-": float, "ke-": lambda value: 1000 * value}
SHARES: dict[str, Callable[[float], float]] = {"%": lambda value: value / 100, "1": float}


class Quantity(NamedTuple):
    """A quantity of the standard: its names as of `symbol`, the key that it gives, and what turns
    each unit into the key's.

    With `by_gain` it may be in DN, which the sheet's gain turns into electrons.
    """

    names: tuple[str, ...]
    key: str
    units: dict[str, Callable[[float], float]]
    by_gain: str = ""


QUANTITIES = (
    Quantity(
        ("k", "overallsystemgain", "systemgain", "conversiongain"), "gain_e_per_dn", GAIN_UNITS
    ),
    Quantity(("1/k", "inverseofoverallsystemgain"), "gain_e_per_dn", {"e-/dn": float}),
    Quantity(
        ("sigmad", "sigma.d", "temporaldarknoise", "readnoise"), "read_noise_e", ELECTRONS, "dn"
    ),
    Quantity(
        ("mue.sat", "muesat", "saturationcapacity", "fullwell"), "full_well_e", ELECTRONS, "dn"
    ),
    Quantity(("dsnu1288", "dsnu"), "dsnu_e", ELECTRONS, "dn"),
    Quantity(("prnu1288", "prnu"), "prnu", SHARES),
    Quantity(
        ("mui", "mui.mean", "darkcurrent"),
        "dark_e_per_s",
        {"e-/s": float, "ke-/s": lambda value: 1000 * value},
        "dn/s",
    ),
    Quantity(("muy.dark", "muydark", "darksignal"), "offset_dn", {"dn": float}),
    Quantity(("bits", "bitdepth"), "bits", {"bit": round, "bits": round}),
    Quantity(("temperature",), "temperature_k", {"k": float, "degc": lambda value: value + ICE_K}),
    Quantity(("td", "doublingtemperature"), "doubling_k", {"k": float, "degc": float}),
    Quantity(("eta", "quantumefficiency", "qe"), "eta", SHARES),
)


@dataclass(frozen=True, slots=True)
class SensorFile:
    """A sensor's keys with one-sigma errors where measured, quantum efficiency (nm, share), and
    what is to be said.

    `transfer` (2, n) is the signal above dark and its variance less dark's, DN and DN^2; `dark` (2,
    m) seconds and mean DN.
    """

    keys: dict[str, Any]
    sigmas: dict[str, float]
    efficiency: tuple[tuple[float, float], ...] = ()
    notes: tuple[str, ...] = ()
    transfer: FloatArray | None = None
    dark: FloatArray | None = None

    @property
    def lines(self) -> list[str]:
        """A line for each key: `key = value`, and `+- sigma` where it was measured."""
        lines = []
        for key, value in self.keys.items():
            line = f"{key} = {value:.6g}"
            if key in self.sigmas:
                line += f" +- {self.sigmas[key]:.2g}"
            lines.append(line)
        return lines

    @property
    def settings(self) -> DetectorSettings:
        """The detector. Raises InputError for a value that no sensor has."""
        return DetectorSettings(**self.keys)


def symbol(text: str) -> str:
    """A quantity's name in small ASCII letters without underscores, braces and blanks: "σ_{d}" is
    sigmad, "μ_e,sat" mue.sat.
    """
    for letter, word in GREEK.items():
        text = text.replace(letter, word)
    return re.sub(r"[\s_{}\\$]", "", ascii_text(text)).replace(",", ".").lower()


def sheet_unit(text: str) -> str:
    """A unit of a data sheet: DN for ADU and counts, e- for electrons, degc for °C, nothing by
    pixel.
    """
    plain = plain_unit(text).replace("lambda", "")
    plain = re.sub(r"[/.*(]?(?:pixel|pix|px)\)?", "", plain)
    plain = plain.removesuffix("rms").removesuffix("/")
    plain = re.sub(r"[()]", "", plain)
    plain = re.sub(r"\b(?:adu|lsb|counts?|digit)\b", "dn", plain)
    plain = re.sub(r"(?<![a-z])(k?)(?:electrons?|el|e)(?![a-z-])-?", r"\1e-", plain)
    return UNIT_SPELLINGS.get(plain, plain)


class Reading(NamedTuple):
    """A row of a data sheet: its place, its quantity as written, and its value in the key's unit,
    or in DN.
    """

    place: str
    name: str
    quantity: Quantity
    value: float
    in_dn: bool


def import_emva(path: Path) -> SensorFile:
    """The sensor of a table `quantity,value,unit` (CSV, or JSON: a list of objects), in the units
    of the standard.

    What is given in DN counts by the sheet's own gain. Raises InputError, also for a quantity with
    two values.
    """
    readings: list[Reading] = []
    efficiency: list[tuple[float, float]] = []
    unused: list[str] = []
    for place, name, value, unit in _emva_rows(path):
        plain, _, wavelength = symbol(name).replace("(", "@").rstrip(")").partition("@")
        quantity = next((known for known in QUANTITIES if plain in known.names), None)
        if quantity is None:
            unused.append(shortened(name))
            continue
        reading = _reading(place, name, quantity, value, unit)
        if quantity.key != "eta":
            readings.append(reading)
            continue
        match = WAVELENGTH.fullmatch(wavelength)
        if match is None:
            raise InputError(f"{place}: {name}; write its wavelength, such as eta@530nm")
        efficiency.append((float(match[1]), reading.value))
    keys = _keys(path, readings)
    if "temperature_k" in keys:
        keys["dark_reference_temperature_k"] = keys["temperature_k"]
    doubling_k = keys.pop("doubling_k", 0.0)
    if doubling_k > 0:
        # exp(-E / k T) doubles from T to T + doubling
        kelvin = keys.get("temperature_k", DetectorSettings().temperature_k)
        inverse_k = kelvin * (kelvin + doubling_k) / doubling_k
        keys["dark_activation_ev"] = math.log(2) * BOLTZMANN_EV_PER_K * inverse_k
    notes: tuple[str, ...] = ()
    if unused:
        notes = (f"not used: {', '.join(unused)}",)
    return _checked(path, SensorFile(keys, {}, tuple(sorted(efficiency)), notes))


def _reading(place: str, name: str, quantity: Quantity, value: float, unit: str) -> Reading:
    """A row's value by its unit. Raises InputError for another unit, and for a gain that is not
    above 0.
    """
    plain = sheet_unit(unit)
    if quantity.by_gain and plain == quantity.by_gain:
        return Reading(place, name, quantity, value, True)
    convert = quantity.units.get(plain)
    if convert is None or (quantity.key == "gain_e_per_dn" and not value > 0):
        raise InputError(
            f"{place}: {name} = {value:g} {unit}; write it above 0 in {' or '.join(quantity.units)}"
        )
    return Reading(place, name, quantity, convert(value), False)


def _keys(path: Path, readings: Sequence[Reading]) -> dict[str, Any]:
    """The keys of a sheet's readings. Raises InputError where there is no gain, and for a quantity
    with two values.
    """
    gains = [reading for reading in readings if reading.quantity.key == "gain_e_per_dn"]
    if not gains:
        raise InputError(f"{path}: has no K; {EMVA_ADVICE}")
    keys: dict[str, Any] = {}
    first: dict[str, Reading] = {}
    # What is in electrons comes first: in DN it is rounded more coarsely.
    for reading in sorted(readings, key=lambda reading: reading.in_dn):
        key = reading.quantity.key
        value = reading.value
        if reading.in_dn:
            value = reading.value * gains[0].value
        if key not in keys:
            keys[key] = value
            first[key] = reading
            continue
        rounded = 0.0
        if reading.in_dn or reading.quantity is not first[key].quantity:
            rounded = ROUNDED_ALIKE
        if abs(value - keys[key]) > rounded * abs(keys[key]):
            _, _, other_line = first[key].place.rpartition(":")
            raise InputError(
                f"{reading.place}: {reading.name} makes {key} {value:g}, and line {other_line} has"
                f" {first[key].name} for {keys[key]:g}; leave one of them"
            )
    # in the order of the sheet again
    return {reading.quantity.key: keys[reading.quantity.key] for reading in readings}


def _checked(path: Path, sensor: SensorFile) -> SensorFile:
    """The sensor, whose values some sensor may have. Raises InputError."""
    wavelengths = {nm for nm, _ in sensor.efficiency}
    if len(wavelengths) < len(sensor.efficiency):
        raise InputError(f"{path}: eta has a wavelength twice; write each once")
    for nm, share in sensor.efficiency:
        if not 0 <= share <= 1:
            raise InputError(f"{path}: eta@{nm:g}nm = {100 * share:g} %; write it from 0 to 100 %")
    try:
        _ = sensor.settings
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return sensor


def _emva_rows(path: Path) -> Iterator[tuple[str, str, float, str]]:
    """Place, quantity, value and unit of each row."""
    if path.suffix.lower() == ".json":
        rows = _json_rows(path)
    else:
        rows = read_rows(path, EMVA_COLUMNS, EMVA_ADVICE, MAX_EMVA_BYTES)
    for line, cells in rows:
        name, value_text, unit = cells[:3]
        (value,) = finite_numbers(path, line, ("value",), [value_text], EMVA_ADVICE)
        yield f"{path}:{line}", name, value, unit


def _json_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Numbers and cells of the objects in a JSON list. Raises InputError."""
    text = read_text(path, EMVA_ADVICE, MAX_EMVA_BYTES)
    try:
        table = msgspec.json.decode(text, type=list[dict[str, str | float]])
    except msgspec.MsgspecError as error:
        raise InputError(
            f"{path}: {shortened(str(error))}; write a list of objects with quantity, value, unit"
        ) from error
    for number, row in enumerate(table, start=1):
        yield number, [str(row.get(name, "")) for name in EMVA_COLUMNS]


@dataclass(frozen=True, slots=True)
class Levels:
    """Pairs of frames by mean, (n,) each: temporal and spatial (fixed-pattern) variance, and
    exposure, NaN if not known.
    """

    mean_dn: FloatArray
    temporal_dn2: FloatArray
    spatial_dn2: FloatArray
    exposure_s: FloatArray
    largest_dn: float
    shape: tuple[int, ...]

    def line(self, name: str, power: int, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A column over the exposure to a power, where exposures differ: slope and value at 0,
        and their one-sigma errors.
        """
        weight = math.sqrt(math.prod(self.shape)) / np.maximum(error, 1e-9)
        place = np.nan_to_num(self.exposure_s) ** power
        degree = int(self.timed)
        column = getattr(self, name)
        values, covariance = np.polyfit(place, column, degree, w=weight, cov="unscaled")
        return values, np.sqrt(np.diag(covariance))

    @property
    def timed(self) -> bool:
        """Whether there are two exposures or more."""
        return bool(np.ptp(self.exposure_s) > 0)

    @property
    def pattern_error_dn2(self) -> FloatArray:
        """One sigma of a spatial variance, as a pixel of two frames tells it."""
        return np.hypot(self.temporal_dn2 + self.spatial_dn2, self.spatial_dn2)


def read_levels(paths: Sequence[Path], what: str) -> Levels:
    """Levels of frames that come in pairs: two of one light and exposure after each other.
    Raises InputError.
    """
    if not paths or len(paths) % 2:
        raise InputError(
            f"{what}: {len(paths)} frames; give two of each exposure, one after the other"
        )
    rows = []
    largest_dn = 0.0
    shape = read_image(paths[0], advice=FRAME_ADVICE).shape
    for first_path, second_path in zip(paths[::2], paths[1::2], strict=True):
        first, first_s = _exposed(first_path)
        second, second_s = _exposed(second_path)
        is_alike = first_s == second_s or (math.isnan(first_s) and math.isnan(second_s))
        if not (first.shape == second.shape == shape and is_alike):
            raise InputError(
                f"{second_path}: its size or EXPTIME is not that of {first_path}; give two frames"
                " of each exposure"
            )
        # what both have in common is no noise
        first_off = first - first.mean()
        second_off = second - second.mean()
        spatial_dn2 = float(np.mean(first_off * second_off))
        if not math.isfinite(spatial_dn2):
            raise InputError(
                f"{second_path}: it or {first_path} has pixels that are no finite number; give raw"
                " frames"
            )
        mean_dn = (first.mean() + second.mean()) / 2
        temporal_dn2 = float((first - second).var()) / 2
        rows.append((mean_dn, temporal_dn2, spatial_dn2, first_s))
        largest_dn = max(largest_dn, float(first.max()), float(second.max()))
    mean, temporal, spatial, exposure_s = np.array(sorted(rows)).T
    if 0 < np.isnan(exposure_s).sum() < len(exposure_s):
        raise InputError(
            f"{what}: some frames say no exposure and some do; write {EXPOSURE_KEY} into all of"
            " them"
        )
    return Levels(mean, temporal, spatial, exposure_s, largest_dn, shape)


def _exposed(path: Path) -> tuple[FloatArray, float]:
    """A frame, and its exposure, s; NaN where it says none."""
    image, exposure_s = read_exposed(path, advice=FRAME_ADVICE)
    if exposure_s is None:
        return image, math.nan
    return image, exposure_s


def _refuse_unlike_darks(dark: Levels) -> None:
    """Without exposures darks count as repeats of one level: those of several exposures are not."""
    noise_dn = math.sqrt(float(dark.temporal_dn2.mean()))
    spread_dn = float(np.ptp(dark.mean_dn))
    if np.isnan(dark.exposure_s).any() and spread_dn > DARK_SPREAD * noise_dn:
        raise InputError(
            f"--darks: their means differ by {spread_dn:.3g} DN, and no header says their"
            f" exposures; write them, in seconds, as {EXPOSURE_KEY}, or give darks of one exposure"
        )


def measure_sensor(flats: Sequence[Path], darks: Sequence[Path]) -> SensorFile:
    """A sensor from pairs of flats and darks. Raises InputError where they cannot tell its gain.

    Errors are those of a finite number of pixels. Light that is not even over the sensor counts as
    PRNU.
    """
    return sensor_of(read_levels(flats, "FLATS"), read_levels(darks, "--darks"))


def sensor_of(light: Levels, dark: Levels) -> SensorFile:
    """A sensor from the levels of its flats and darks. Raises InputError as `measure_sensor`."""
    if light.shape != dark.shape:
        raise InputError("--darks: not of the flats' size; give frames of one sensor")
    _refuse_unlike_darks(dark)
    pixels = math.prod(dark.shape)
    flat_s = np.nan_to_num(light.exposure_s)
    noise_dn = np.sqrt(dark.temporal_dn2 / 2 + np.maximum(dark.spatial_dn2, 0.0))
    mean, mean_error = dark.line("mean_dn", 1, noise_dn)
    temporal, temporal_error = dark.line("temporal_dn2", 1, math.sqrt(2) * dark.temporal_dn2)
    spatial, spatial_error = dark.line("spatial_dn2", 2, dark.pattern_error_dn2)
    signal = light.mean_dn - np.polyval(mean, flat_s)
    variance = light.temporal_dn2 - np.polyval(temporal, flat_s)
    # beyond saturation the noise falls
    top = int(light.temporal_dn2.argmax())
    is_lit = (signal > 0) & (light.temporal_dn2 > 0)
    usable = np.flatnonzero(is_lit & (signal <= LINEAR_SHARE * signal[top]))
    gain = _system_gain(signal[usable], variance[usable], light.temporal_dn2[usable], pixels)
    figures = _Figures(gain)
    figures.keys["offset_dn"] = float(mean[-1])
    figures.sigmas["offset_dn"] = float(mean_error[-1])
    figures.add_root("read_noise_e", temporal[-1] - ROUNDING_DN2, temporal_error[-1], gain)
    figures.add_root("dsnu_e", spatial[-1], spatial_error[-1], gain)
    from_half = np.abs(signal[usable] - signal[top] / 2)
    half = int(usable[from_half.argmin()])
    pattern_dn2 = light.spatial_dn2[half] - np.polyval(spatial, flat_s[half] ** 2)
    pattern_error_dn2 = light.pattern_error_dn2[half] / math.sqrt(pixels)
    figures.add_root("prnu", pattern_dn2, pattern_error_dn2, _Unit(signal[half], 0.0))
    notes = [
        f"{len(signal)} levels of light, {len(dark.mean_dn)} of dark, {pixels} px; light that is"
        " not even counts as PRNU"
    ]
    if dark.timed:
        figures.add("dark_e_per_s", mean[0], mean_error[0], gain)
        figures.add_root("dsnu_e_per_s", spatial[0], spatial_error[0], gain)
    else:
        notes.append("no dark current: the darks have no two exposures (EXPTIME)")
    if top < len(signal) - 1:
        full_error_dn = np.ptp(signal[top - 1 : top + 2]) / 2
        figures.add("full_well_e", signal[top], full_error_dn, gain)
    else:
        notes.append("full_well_e is not known: the brightest flats do not saturate")
    keys: dict[str, Any] = dict(figures.keys)
    keys["bits"] = max(1, math.ceil(math.log2(light.largest_dn + 1)))
    notes.append(f"bits holds the largest DN seen, {light.largest_dn:g}")
    transfer = np.array([signal, variance])
    dark_points = np.array([np.nan_to_num(dark.exposure_s), dark.mean_dn])
    return SensorFile(keys, figures.sigmas, (), tuple(notes), transfer, dark_points)


@dataclass(frozen=True, slots=True)
class _Unit:
    """What a figure in DN is divided by, with its relative one-sigma error."""

    value: float
    error: float


def _system_gain(
    signal_dn: FloatArray, variance_dn2: FloatArray, temporal_dn2: FloatArray, pixels: int
) -> _Unit:
    """K, DN/e-: the slope of the variance over the signal (n,). Raises InputError where noise does
    not grow with light.
    """
    weight = pixels / 2 * (signal_dn / temporal_dn2) ** 2
    k_dn_per_e = 0.0
    if len(signal_dn):
        k_dn_per_e = float((variance_dn2 / signal_dn) @ weight / weight.sum())
    if not k_dn_per_e > 0:
        raise InputError(
            "FLATS: no noise that grows with light; give raw frames of one sensor from dark to"
            " saturation"
        )
    return _Unit(k_dn_per_e, float(weight.sum()) ** -0.5 / k_dn_per_e)


class _Figures:
    """The keys that were measured, with their one-sigma errors; the gain first."""

    def __init__(self, gain: _Unit) -> None:
        self.keys = {"gain_e_per_dn": 1 / gain.value}
        self.sigmas = {"gain_e_per_dn": gain.error / gain.value}

    def add(self, key: str, value: float, error: float, unit: _Unit) -> None:
        """Add a figure of 0 or more, by its value in DN and that one's error."""
        positive = max(float(value), 0.0)
        self.keys[key] = positive / unit.value
        self.sigmas[key] = math.hypot(error, positive * unit.error) / unit.value

    def add_root(self, key: str, square: float, error: float, unit: _Unit) -> None:
        """Add the root of a square, DN^2, by that one's error; where it is within that, the
        error's own root is the figure's.
        """
        root = math.sqrt(max(square, 0.0))
        if square > error:
            root_error = error / (2 * root)
        else:
            root_error = math.sqrt(error)
        self.add(key, root, root_error, unit)


def write_sensor(output: Path, sensor: SensorFile, source: str) -> list[Path]:
    """Write the TOML file, a curve of quantum efficiency beside it, and the charts. Gives the
    files. Raises InputError.
    """
    settings = sensor.settings
    curve = output.with_name(f"{output.stem}_qe.csv")
    chart = output.with_name(f"{output.stem}_curves")
    files = [output]
    lines = [f"# {source}"]
    for note in sensor.notes:
        lines.append(f"# {note}")
    if len(sensor.efficiency) > 1:
        charts.write_csv(curve, ("wavelength_nm", "value"), sensor.efficiency)
        files.append(curve)
        lines += ["[tracker]", f"quantum_efficiency = {json.dumps(curve.name)}"]
    elif sensor.efficiency:
        _, share = sensor.efficiency[0]
        lines += ["[tracker]", f"quantum_efficiency = {share:.6g}"]
    lines.append("[tracker.detector]")
    for line in sensor.lines:
        lines.append(line.replace(" +- ", "  # +- "))
    write_whole(output, "\n".join(lines) + "\n")
    draw_curves(chart, settings, sensor)
    return [*files, *(chart.with_suffix(ending) for ending in charts.ENDINGS)]


def draw_curves(path: Path, settings: DetectorSettings, sensor: SensorFile) -> None:
    """Variance over signal, and dark signal over exposure, as the standard plots them: the
    file's lines, measured points.
    """
    gain = settings.gain_e_per_dn
    measured = sensor.transfer is not None and sensor.dark is not None
    finding = (
        f"{gain:.3g} e- a DN, {settings.read_noise_e:.3g} e- of read noise, full at"
        f" {settings.full_well_e:.0f} e-"
    )
    largest_dn = settings.full_well_e / gain
    if sensor.transfer is not None:
        largest_dn = sensor.transfer[0].max()
    longest_s = 1.0
    if sensor.dark is not None:
        longest_s = max(float(sensor.dark[0].max()), 1e-3)
    signal_dn = np.array([0.0, largest_dn])
    seconds = np.array([0.0, longest_s])
    dark_dn = settings.offset_dn + settings.dark_e_per_s * seconds / gain
    with charts.chart(path, finding, 1, 2, share_x=False) as (transfer, dark):
        transfer.plot(signal_dn, signal_dn / gain, label="shot noise")
        dark.plot(seconds, dark_dn, label="mean dark")
        for axes, points in ((transfer, sensor.transfer), (dark, sensor.dark)):
            if measured and points is not None:
                axes.plot(*points, "o", color=charts.ORANGE, label="measured")
            axes.legend()
        transfer.set(xlabel="signal above dark, DN", ylabel="variance above dark, DN²")
        dark.set(xlabel="exposure, s", ylabel="dark signal, DN")
