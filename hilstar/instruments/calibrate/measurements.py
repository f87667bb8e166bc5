"""Measured patches: reading MEASURED.csv, and the checks that refuse a set of measurements."""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import read_bytes
from hilstar.basics.text_tables import Chosen, TextTable, open_table

PRIMARIES = ("r", "g", "b")
CHANNELS = ("w", *PRIMARIES)
COLUMNS = ("order", "code", "channel", "value", "exposure_s", "t_s", "sigma")
COMMON = "common_"  # before the name of a cause of errors that readings have in common
NEEDED = ("code", "channel", "value")
USUAL_BITS = (8, 10, 12, 14, 16)
MAX_BYTES = 10_000_000
ADVICE = "give a CSV file with code,channel,value"
# at 1 % noise: 2.2 % of error (95th percentile of the worst code) on gamma, sRGB and S-curves; 8
# leave 4.4 %
MIN_CODES = 10
# one run in a few hundred is refused because of noise alone, with 32 levels
FALSE_ALARM_SIGMA = 4.0
MIN_DRIFT = 0.005  # over the run; less does not matter beside 1 % of noise
BRIGHT_DOF = 8
FAINT_ALARM = 0.999  # quantile of the F distribution beyond which additive noise is believed
ASSUMED_NOISE = 0.01  # where nothing was repeated and no error stated, until the residuals tell
NOISE_FLOOR = 1e-4  # relative; no photometer repeats better
CLIPPED_VALUES = 3  # equal largest readings, over two codes or more


@dataclass(frozen=True, slots=True)
class Measurements:
    """Light (n,) of patches in one linear unit, their codes and channels, and the time of each (s,
    or the row's number).

    `clipped` has by channel the codes that share the largest reading, where that looks like the
    instrument's limit. `sigma` (n,) is the standard error of each value, 0 where none is stated;
    `common` (n, causes) is what one standard error of a cause does to all of them.
    """

    source: str
    bits: int
    code: IntArray
    channel: npt.NDArray[np.str_]
    value: FloatArray
    time: FloatArray
    clipped: dict[str, list[int]]
    sha256: str
    sigma: FloatArray
    common: FloatArray

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that were measured, in the order w, r, g, b."""
        return tuple(name for name in CHANNELS if np.any(self.channel == name))

    @property
    def white(self) -> int:
        """The largest code."""
        return int(2**self.bits - 1)


@dataclass(frozen=True, slots=True)
class MeasuredLevels:
    """Repeats combined: for each distinct code (n,), rising, the mean light and the number of
    readings.

    `relative_noise` is that of one reading, nan where nothing was repeated; `additive_noise` is in
    the unit of measurement. Both are what repeats scatter beyond the readings' own errors, where
    these are stated: `stated` (n,) is that of the mean. `common` (n, causes) is what one standard
    error of a cause does to the means.
    """

    code: IntArray
    mean: FloatArray
    count: IntArray
    relative_noise: float
    additive_noise: float
    stated: FloatArray
    common: FloatArray

    @property
    def has_errors(self) -> bool:
        """Whether the readings came with standard errors."""
        return bool(self.stated.any())

    def reading_noise(self, relative_noise: float) -> float:
        """The noise of one reading of white, relative to it, for a given relative noise beyond
        stated errors.
        """
        reading_sigma = self.stated[-1] * math.sqrt(self.count[-1])
        return math.hypot(relative_noise, float(reading_sigma / self.mean[-1]))

    def standard_error(self, relative_noise: float) -> FloatArray:
        """Standard error of the mean (n,), in its unit, for a given relative noise of one
        reading.
        """
        reading_variance = (relative_noise * self.mean) ** 2 + self.additive_noise**2
        variance = reading_variance / self.count + self.stated**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)


class _Row(NamedTuple):
    """A measurement as its line has it."""

    code: int
    channel: str
    value: float
    exposure_s: float
    t_s: float | None
    sigma: float
    common: tuple[float, ...]


def read_measurements(path: Path, bits: int | None = None) -> Measurements:
    """Read `code,channel,value` rows; '#' starts a comment line.

    `exposure_s`, `t_s`, `order`, `sigma` and any `common_NAME` are read where they are given.
    Values and their errors are divided by exposure_s. `bits` is by default the smallest of 8, 10,
    12, 14, 16 that holds every code.
    Raises InputError: file, line, what is wrong.
    """
    raw = read_bytes(path, ADVICE, MAX_BYTES)
    rows = list(_rows(path))
    if not rows:
        raise InputError(
            f"{path}: it has no measurement; write code,channel,value rows below the header"
        )
    codes = np.array([row.code for row in rows], dtype=np.intp)
    largest_code = int(codes.max())
    if bits is None or bits == 0:
        bits = next(usual for usual in USUAL_BITS if largest_code < 2**usual)
    if largest_code >= 2**bits:
        raise InputError(
            f"{path}: code {largest_code} is outside {bits} bits (0 to {2**bits - 1}); say --bits"
        )
    channel = np.array([row.channel for row in rows])
    reading = np.array([row.value for row in rows])
    exposure_s = np.array([row.exposure_s for row in rows])
    sigma = np.array([row.sigma for row in rows])
    common = np.array([row.common for row in rows]).reshape(len(rows), -1)
    clipped = {}
    for name in set(channel.tolist()):
        of_channel = channel == name
        clipped[name] = _clipped(codes[of_channel], reading[of_channel])
    return Measurements(
        source=str(path),
        bits=bits,
        code=codes,
        channel=channel,
        value=reading / exposure_s,
        time=_times(path, rows),
        clipped=clipped,
        sha256=hashlib.sha256(raw).hexdigest(),
        sigma=sigma / exposure_s,
        common=common / exposure_s[:, None],
    )


def _times(path: Path, rows: list[_Row]) -> FloatArray:
    """The time of each row (n,), s; its number where no row has one. Raises InputError where some
    do not.
    """
    times = [row.t_s for row in rows if row.t_s is not None]
    if not times:
        return np.arange(len(rows), dtype=np.float64)
    if len(times) < len(rows):
        raise InputError(
            f"{path}: t_s is empty in some rows; give it in every row or leave the column out"
        )
    return np.array(times, dtype=np.float64)


def _rows(path: Path) -> Iterator[_Row]:
    """The rows of a table. Raises InputError with the line."""
    with open_table(path, f"write {','.join(NEEDED)}", MAX_BYTES) as table:
        if not table.columns:
            return
        columns = _columns(table)
        table.warn()
        for number, cells in table.rows():
            texts = {}
            for name, column in columns.items():
                texts[name] = table.cell(cells, column)
            yield _row(f"{path}: line {number}", texts)


def _columns(table: TextTable) -> dict[str, Chosen]:
    """The columns by hilstar's names. Raises InputError for one that is missing, unknown or there
    twice.
    """
    place = f"{table.path}: line {table.header_line}"
    columns: dict[str, Chosen] = {}
    shared = [column.name for column in table.columns if column.name.startswith(COMMON)]
    for name in (*COLUMNS, *shared):
        chosen = table.chosen(name)
        if chosen is not None:
            columns[name] = chosen
        elif name in NEEDED:
            raise InputError(
                f"{place}: the column {name} is missing; the header is code,channel,value"
            )
    if len(columns) < len(table.columns):
        known = ", ".join(COLUMNS)
        raise InputError(
            f"{place}: unknown or repeated column in {shortened(table.names)}; known are {known}"
        )
    return columns


def _row(place: str, cells: dict[str, str]) -> _Row:
    """A row by its cells. Raises InputError."""
    if not cells["value"]:
        raise InputError(
            f"{place}: value is empty; measure the patch and fill it in, or delete the row"
        )
    try:
        code = int(cells["code"])
    except ValueError as error:
        raise InputError(
            f"{place}: code = {shortened(cells['code'])}; write a whole number"
        ) from error
    if not 0 <= code < 2**16:
        raise InputError(f"{place}: code = {shortened(cells['code'])}; write 0 to 65535")
    if cells["channel"] not in CHANNELS:
        raise InputError(f"{place}: channel = {shortened(cells['channel'])}; write w, r, g or b")
    value = _number(place, "value", cells["value"])
    if value < 0:
        raise InputError(
            f"{place}: value = {value:g}; light is not negative; write readings from which no"
            " offset was subtracted"
        )
    exposure_s = _number(place, "exposure_s", cells.get("exposure_s") or "1")
    if exposure_s <= 0:
        raise InputError(f"{place}: exposure_s = {exposure_s:g}; write more than 0")
    time = cells.get("t_s")
    sigma = _sigma(place, cells)
    common = []
    for name, cell in cells.items():
        if name.startswith(COMMON):
            common.append(_number(place, name, cell or "0"))
    t_s = None
    if time:
        t_s = _number(place, "t_s", time)
    return _Row(code, cells["channel"], value, exposure_s, t_s, sigma, tuple(common))


def _sigma(place: str, cells: dict[str, str]) -> float:
    """The standard error of a row's value, 0 without that column. Raises InputError."""
    if cells.get("sigma") == "":
        advice = "write the value's standard error, or leave the column out"
        raise InputError(f"{place}: sigma is empty; {advice}")
    sigma = _number(place, "sigma", cells.get("sigma", "0"))
    if sigma < 0:
        raise InputError(f"{place}: sigma = {sigma:g}; write a standard error, 0 or more")
    return sigma


def _number(place: str, name: str, text: str) -> float:
    """A finite number of a cell. Raises InputError."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) < 1e30:
        raise InputError(f"{place}: {name} = {shortened(text)}; write a finite number")
    return number


def _clipped(code: IntArray, reading: FloatArray) -> list[int]:
    """The codes that share the largest reading, if several do and it is frequent: the instrument
    is at its limit.
    """
    at_limit = reading == reading.max()
    codes = np.unique(code[at_limit])
    if len(codes) > 1 and at_limit.sum() >= CLIPPED_VALUES:
        return [int(code) for code in codes]
    return []


def group_levels(measured: Measurements, channel: str) -> MeasuredLevels:
    """Combine the repeats of one channel; code 0 is the same black in every channel, so all its
    readings count.
    """
    chosen = (measured.channel == channel) | (measured.code == 0)
    value = measured.value[chosen]
    code, place, count = np.unique(measured.code[chosen], return_inverse=True, return_counts=True)
    mean = np.asarray(np.bincount(place, value) / count, dtype=np.float64)
    off = value - mean[place]
    squares = np.asarray(np.bincount(place, off**2), dtype=np.float64)
    stated_variance = np.bincount(place, measured.sigma[chosen] ** 2) / count
    is_stated = bool(stated_variance.any())
    # What repeats scatter beyond the readings' own errors.
    squares -= (count - 1) * stated_variance
    floor = 0.0 if is_stated else NOISE_FLOOR
    # The relative noise of the bright half, where the instrument's floor is negligible; of all but
    # black if too few repeat.
    relative = math.nan
    for part in ((mean > 0) & (code > 0), mean > np.median(mean)):
        dof = int((count[part] - 1).sum())
        if dof >= BRIGHT_DOF:
            square = max(float((squares[part] / mean[part] ** 2).sum()), 0.0)
            relative = max(math.sqrt(square / dof), floor)
    additive = 0.0
    if not is_stated:
        additive = _additive(squares, mean, count, relative)
    common = np.zeros((len(code), measured.common.shape[1]))
    np.add.at(common, place, measured.common[chosen])
    return MeasuredLevels(
        code=code.astype(np.intp),
        mean=mean,
        count=count.astype(np.intp),
        relative_noise=relative,
        additive_noise=additive,
        stated=np.sqrt(stated_variance / count),
        common=common / count[:, None],
    )


def _additive(squares: FloatArray, mean: FloatArray, count: IntArray, relative: float) -> float:
    """The instrument's floor, in its unit, if the faintest third, black included, scatters more
    than `relative` explains.
    """
    # F's quantile; scipy.stats has the same one and takes half a second to import
    from scipy.special import fdtri

    levels = len(mean)
    faint = (np.arange(levels) <= levels // 3) & (count > 1)
    freedom = count[faint] - 1
    dof = int(freedom.sum())
    if not dof or math.isnan(relative):
        return 0.0
    expected = float(((relative * mean[faint]) ** 2 * freedom).sum())
    square = float(squares[faint].sum())
    if square <= expected * fdtri(dof, BRIGHT_DOF * 2, FAINT_ALARM):
        return 0.0
    return math.sqrt((square - expected) / dof)


def check_levels(measured: Measurements, channel: str, levels: MeasuredLevels) -> None:
    """Refuse (InputError) levels that no response can be fitted to, with the reason and the
    cure.
    """
    place = f"{measured.source}: channel {channel}"
    if levels.code[0] != 0:
        raise InputError(
            f"{place}: code 0 is not measured; without it the black level is unknown, so add it,"
            " several times"
        )
    if levels.code[-1] != measured.white:
        raise InputError(
            f"{place}: white, code {measured.white} of {measured.bits} bits, is not measured; add"
            " it or say --bits"
        )
    if len(levels.code) < MIN_CODES:
        raise InputError(
            f"{place}: {len(levels.code)} distinct codes; measure {MIN_CODES} or more, 32 for 1 %"
            " (calibrate plan)"
        )
    if not levels.mean[-1] > levels.mean[0]:
        raise InputError(
            f"{place}: white is not brighter than code 0; check that the instrument looks at the"
            " patch"
        )
    relative = levels.relative_noise
    if math.isnan(relative):
        relative = 0.0 if levels.has_errors else ASSUMED_NOISE
    error = levels.standard_error(relative)
    _check_saturation(measured, channel, levels, error)
    highest = np.maximum.accumulate(levels.mean)
    # the level before each one that is the highest so far
    numbers = np.where(levels.mean == highest, np.arange(len(highest)), 0)
    peak = np.maximum.accumulate(numbers)
    fall_error = np.maximum(np.hypot(error, error[peak]), 1e-30)
    fall = (highest - levels.mean) / fall_error
    worst = int(np.argmax(fall))
    if fall[worst] > FALSE_ALARM_SIGMA:
        percent = 100 * (1 - levels.mean[worst] / highest[worst])
        raise InputError(
            f"{place}: light falls by {percent:.2g} % from code {levels.code[peak[worst]]} to code"
            f" {levels.code[worst]}, beyond the noise; measure both again, with the monitor's"
            " dynamic contrast off"
        )


def _check_saturation(
    measured: Measurements, channel: str, levels: MeasuredLevels, error: FloatArray
) -> None:
    """Refuse (InputError) a saturated top: one flatter than the S-curve sin^2, which falls by 3
    (1 - code / white)^2 there.
    """
    clipped = measured.clipped.get(channel, [])
    white = levels.mean[-1]
    noise = float(np.hypot(error, error[-1])[-1] / white)
    margin = max(0.03, math.sqrt(FALSE_ALARM_SIGMA * noise / 3))
    is_darker_code = levels.code <= (1 - margin) * measured.white
    flat = is_darker_code & (levels.mean >= white * (1 - noise))
    if not clipped and flat.any():
        clipped = levels.code[int(np.argmax(flat)) :].tolist()
    if clipped:
        raise InputError(
            f"{measured.source}: channel {channel}: codes {clipped[0]} to {clipped[-1]} read the"
            " same, so the instrument is saturated or the link clips; shorten the exposure, or set"
            " the link to full range"
        )


def drift_over_run(measured: Measurements) -> tuple[float, float]:
    """The trend of repeated patches from the first to the last measurement and its standard error,
    both relative.

    Both are nan where nothing was repeated. Code 0 is left out: its noise is not that of light.
    """
    lit = (measured.code > 0) & (measured.value > 0)
    channels = [CHANNELS.index(str(name)) for name in measured.channel[lit]]
    patch = measured.code[lit] * len(CHANNELS) + np.array(channels)
    _, place, count = np.unique(patch, return_inverse=True, return_counts=True)
    # each reading against its patch's mean
    log_light = _within(np.log(measured.value[lit]), place, count)
    time = _within(measured.time[lit], place, count)
    leverage = float((time**2).sum())
    span = float(np.ptp(measured.time))
    dof = len(place) - len(count) - 1
    if dof < 3 or leverage <= 1e-12 * max(span, 1e-300) ** 2:
        return math.nan, math.nan
    slope = float(log_light @ time) / leverage
    residual = log_light - slope * time
    scatter = float((residual**2).sum()) / dof
    return slope * span, math.sqrt(scatter / leverage) * span


def _within(values: FloatArray, place: IntArray, count: IntArray) -> FloatArray:
    """Values (n,) less the mean of their group."""
    means = np.bincount(place, values) / count
    return np.asarray(values - means[place])


def check_drift(measured: Measurements) -> float:
    """The drift over the run, relative (nan where nothing was repeated). Raises InputError where
    it is beyond the noise.
    """
    drift, error = drift_over_run(measured)
    if abs(drift) > max(FALSE_ALARM_SIGMA * error, MIN_DRIFT):
        raise InputError(
            f"{measured.source}: light drifts by {100 * drift:+.2g} % (noise {100 * error:.1g} %)"
            " from the first measurement to the last; let monitor and instrument warm up, then"
            " measure again"
        )
    return drift
