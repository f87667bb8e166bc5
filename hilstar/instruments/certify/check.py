"""The check in a minute: twelve patches, one pattern of dots and one delay, against the same
readings of the certificate.

Each figure is a difference with its uncertainty. It is out of tolerance where it exceeds its
tolerance by more than noise explains, at a probability by which all figures of a check together
raise a false alarm once in 10 000 checks (Bonferroni).
"""

import csv
import datetime
import io
import itertools
import math
import operator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from scipy.special import fdtri, stdtrit

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import BLUE, MUTED, ORANGE, chart, write_csv
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import NOT_JSON, exists, read_bytes, read_text
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.instruments.calibrate.warm_up import WarmUp, fitted_white, judge_warm_up, watch_white
from hilstar.instruments.certify.bench_readings import DotReadings, geometry_of
from hilstar.instruments.certify.budget import COVERAGE
from hilstar.instruments.certify.estimates import place_errors, surface
from hilstar.instruments.certify.readings import Reader, VirtualReader, dot_places
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.certify import VirtualSettings

PATCHES, REPEATS, DOT_IMAGES = 12, 3, 4
FALSE_ALARM = 1e-4  # for a whole check
FAINT = 3  # codes by which the floor of the readings is known
REST_DEGREES = (3,)
ALARMED_DOF = 1e6
MAX_BYTES = 50_000_000
FAINTEST_SHARE = 0.06  # relative to white's code: the faintest patch
WILD_SIGMAS = 6.0
SMALL_ARCSEC = 1e-9  # residuals without any noise are not wild
PPM_PER_ARCSEC = 1e6 / ARCSEC_PER_RAD
CHECKS, CHART = "checks.csv", "checks"
# Beyond noise, what a bench may move before its certificate is in doubt.
TOLERANCES = {
    # with the noise's part of the threshold, half of the 1 % that is to be caught
    "brightness": (0.25, "%"),
    "gamma": (0.004, ""),
    "response_rest": (0.2, "%"),
    "black": (0.02, "% of white"),
    "evenness": (0.3, "%"),
    "scale": (20.0, "ppm"),
    "rotation": (0.5, "arcsec"),
    "shift_x": (0.5, "arcsec"),
    "shift_y": (0.5, "arcsec"),
    "geometry_rest": (0.3, "arcsec"),
    "psf": (1.0, "%"),
    "latency": (0.1, "ms"),
}
DRAWN = (
    ("brightness", "brightness [%]"),
    ("shift_x", "shift along x [arcsec]"),
    ("psf", "PSF sigma [%]"),
)
DRAWN_COLUMNS = ("value", "standard_uncertainty", "threshold")
SECONDS_PER_DAY = 86400


class CheckReadings(msgspec.Struct, frozen=True, kw_only=True):
    """The readings of a check, as reference.json keeps those of the certificate: codes, light,
    dots, delays.
    """

    code: list[int]
    light: list[float]
    x_px: list[float]
    y_px: list[float]
    seen_x_px: list[float]
    seen_y_px: list[float]
    dot_light: list[float]
    psf_px: float
    psf_u_px: float
    delay_ms: float | None
    delay_u_ms: float
    delay_dof: int


@dataclass(frozen=True, slots=True)
class CheckFigure:
    """A difference from the certificate: its 95 % interval, its tolerance, and whether it is
    within it.
    """

    quantity: str
    value: float
    standard_uncertainty: float
    lower: float
    upper: float
    unit: str
    dof: float
    tolerance: float
    threshold: float
    in_tolerance: bool


def take_check(file: BenchFile, reader: Reader) -> CheckReadings:
    """Read a bench as a check does. Raises InputError, MachineError."""
    white = 2**file.config.monitor.bits - 1
    faintest = max(white * FAINTEST_SHARE, 1)
    steps = np.rint(np.geomspace(faintest, white, PATCHES - 1))
    lit = np.unique(steps.astype(np.intp))
    planned = np.repeat(np.append(0, lit), REPEATS)
    light = reader.light(np.random.default_rng(PATCHES).permutation(planned))
    dots = reader.dots(*dot_places(geometry_of(file)), DOT_IMAGES)
    delays = reader.delays_ms()
    delay_ms = None
    delay_u_ms = 0.0
    if len(delays) > 1:
        delay_ms = float(delays.mean())
        delay_u_ms = float(delays.std(ddof=1)) / math.sqrt(len(delays))
    dot_light = dots.light / np.median(dots.light)
    return CheckReadings(
        code=light.code.tolist(),
        light=light.light.tolist(),
        x_px=dots.x_px.tolist(),
        y_px=dots.y_px.tolist(),
        seen_x_px=dots.seen_x_px.round(5).tolist(),
        seen_y_px=dots.seen_y_px.round(5).tolist(),
        dot_light=[float(f"{value:.6g}") for value in dot_light],
        psf_px=dots.psf_px,
        psf_u_px=dots.psf_u_px,
        delay_ms=delay_ms,
        delay_u_ms=delay_u_ms,
        delay_dof=max(len(delays) - 1, 0),
    )


def by_bench_file(file: BenchFile) -> CheckReadings:
    """What a check would read of a bench that is as its file says, without noise."""
    still = VirtualSettings(reading_noise=0.0, dot_noise_px=0.0, delay_noise_ms=0.0)
    certify = msgspec.structs.replace(file.config.certify, virtual=still)
    as_stated = msgspec.structs.replace(file.config, certify=certify)
    truth = BenchFile(file.path, file.text, as_stated, file.sha256)
    return take_check(file, VirtualReader(file, truth, 0))


def read_reference(path: Path) -> CheckReadings | None:
    """The readings of a certificate; None where there are none. Raises InputError for a file
    that has none.
    """
    if not exists(path):
        return None
    try:
        return msgspec.json.decode(read_bytes(path, "", MAX_BYTES), type=CheckReadings)
    except NOT_JSON as error:
        raise InputError(
            f"{path}: has no readings of a certificate ({shortened(error)}); certify the bench"
            " --again"
        ) from error


def compare(file: BenchFile, was: CheckReadings, now: CheckReadings) -> list[CheckFigure]:
    """The figures of a check against its reference. Raises InputError where they have too little
    in common.
    """
    changes = [*_light(was, now), *_geometry(file, was, now)]
    to_percent = 100 / was.psf_px
    wider = to_percent * (now.psf_px - was.psf_px)
    psf_u = to_percent * math.hypot(was.psf_u_px, now.psf_u_px)
    changes.append(_Change("psf", wider, psf_u, ALARMED_DOF))
    if was.delay_ms is not None and now.delay_ms is not None:
        both = math.hypot(was.delay_u_ms, now.delay_u_ms)
        dof = float(max(min(was.delay_dof, now.delay_dof), 1))
        changes.append(_Change("latency", now.delay_ms - was.delay_ms, both, dof))
    probability = FALSE_ALARM / len(changes)
    return [change.judged(probability) for change in changes]


@dataclass(frozen=True, slots=True)
class _Change:
    """A change with its standard uncertainty and freedom; with `free` numbers of freedom it is a
    root mean square, tested by F.
    """

    quantity: str
    value: float
    u: float
    dof: float
    free: float = 0.0

    def judged(self, probability: float) -> CheckFigure:
        """The figure with its threshold, which noise exceeds with this probability."""
        tolerance, unit = TOLERANCES[self.quantity]
        if self.free:  # a mean square of noise alone is u^2 times F's
            k = math.sqrt(fdtri(self.free, self.dof, 1 - probability))
            wide = self.u * math.sqrt(fdtri(self.free, self.dof, COVERAGE))
            lower = max(self.value - wide, 0.0)
            threshold = math.hypot(tolerance, k * self.u)
        else:
            k = float(stdtrit(self.dof, 1 - probability / 2))
            wide = float(stdtrit(self.dof, (1 + COVERAGE) / 2)) * self.u
            lower = self.value - wide
            threshold = tolerance + k * self.u
        return CheckFigure(
            quantity=self.quantity,
            value=self.value,
            standard_uncertainty=self.u,
            lower=lower,
            upper=self.value + wide,
            unit=unit,
            dof=min(self.dof, ALARMED_DOF),
            tolerance=tolerance,
            threshold=threshold,
            in_tolerance=abs(self.value) <= threshold,
        )


@dataclass(frozen=True, slots=True)
class _Codes:
    """Light by code (k,): its mean, the number of readings, their squares about it. A bench file's
    own readings have no noise: `is_noisy` is then false.
    """

    mean: FloatArray
    count: FloatArray
    squares: FloatArray

    @classmethod
    def of(cls, readings: CheckReadings) -> Self:
        """The light of a check by its codes."""
        _, place, count = np.unique(readings.code, return_inverse=True, return_counts=True)
        light = np.array(readings.light)
        mean = np.bincount(place, light) / count
        squares = np.bincount(place, (light - mean[place]) ** 2).astype(np.float64)
        return cls(mean, count.astype(np.float64), squares)

    @property
    def freedom(self) -> FloatArray:
        """The freedom (k,) of the squares."""
        return self.count - 1

    @property
    def is_noisy(self) -> bool:
        """Whether readings scatter."""
        return bool(self.squares.sum() > 0)


@dataclass(frozen=True, slots=True)
class _Noise:
    """The noise of readings: relative to light, with its freedom, and a floor's variance."""

    relative: float
    floor: float
    dof: float

    @classmethod
    def of(cls, codes: IntArray, noisy: list[_Codes]) -> Self:
        """The noise by the scatter of those readings that have some."""
        is_bright = codes > codes[len(codes) // 3]
        dof = squares = 0.0
        for of in noisy:
            relative_squares = of.squares[is_bright] / of.mean[is_bright] ** 2
            squares += float(relative_squares.sum())
            dof += float(of.freedom[is_bright].sum())
        relative = 0.0
        if dof:
            relative = math.sqrt(squares / dof)
        excess = freedom = 0.0
        for of in noisy:
            by_light = of.freedom * (relative * of.mean) ** 2
            beyond = of.squares - by_light
            excess += float(beyond[:FAINT].sum())
            freedom += float(of.freedom[:FAINT].sum())
        floor = max(excess / max(freedom, 1.0), 0.0)
        return cls(relative, floor, dof)

    def variance(self, of: _Codes) -> FloatArray:
        """The variance of each code's mean (k,)."""
        of_reading = (self.relative * of.mean) ** 2 + self.floor
        return np.asarray(of_reading / of.count)


def _light(was: CheckReadings, now: CheckReadings) -> list[_Change]:
    """Brightness, gamma, what is left of the response, and black: the change of each code's
    light.
    """
    codes = np.unique(was.code)
    if not np.array_equal(codes, np.unique(now.code)):
        raise InputError("the check's codes are not the certificate's; certify the bench --again")
    before, after = _Codes.of(was), _Codes.of(now)
    noisy = [of for of in (before, after) if of.is_noisy]
    noise = _Noise.of(codes, noisy)
    variance = np.zeros(len(codes))
    for of in noisy:
        variance += noise.variance(of)
    sigma = np.sqrt(variance)
    lit = codes > 0
    log_code = np.log(codes[lit] / codes[-1])
    change = after.mean[lit] / before.mean[lit] - 1
    error = sigma[lit] / before.mean[lit]
    design = np.stack([np.ones(len(log_code)), log_code], axis=1)
    inverse = np.linalg.pinv(design / error[:, None]) / error
    covariance = (inverse * error**2) @ inverse.T
    slope = inverse @ change
    # At the middle by weight brightness and gamma are apart.
    middle = np.array([1.0, float(np.average(log_code, weights=error**-2))])
    brightness_u = math.sqrt(float(middle @ covariance @ middle))
    gamma_u = math.sqrt(float(covariance[1, 1]))
    standardised = (change - design @ slope) / error
    count = len(standardised)
    free = count - 2.0
    rest = math.sqrt(float((standardised**2).mean()))
    typical = 100 * math.sqrt(float(np.mean(error**2)))
    rest_u = typical * math.sqrt(free / count)
    to_white = 100 / before.mean[-1]
    black = to_white * float(after.mean[0] - before.mean[0])
    black_u = to_white * float(sigma[0])
    brighter = 100 * float(middle @ slope)
    dof = noise.dof
    return [
        _Change("brightness", brighter, 100 * brightness_u, dof),
        _Change("gamma", float(slope[1]), gamma_u, dof),
        _Change("response_rest", rest * typical, rest_u, dof, free),
        _Change("black", black, black_u, dof),
    ]


def _geometry(file: BenchFile, was: CheckReadings, now: CheckReadings) -> list[_Change]:
    """Evenness, scale, rotation, shift, and what is left of the geometry, by the dots that both
    have.
    """
    before, after = _dots_of_both(was, now)
    size = file.config.monitor.resolution_px
    moved = place_errors(file, after) - place_errors(file, before)
    rays = geometry_of(file).monitor.rays(before.x_px, before.y_px)
    tangents = rays[:, :2] / rays[:, 2:]
    solution, inverse, residual = _similarity(tangents, moved)
    rest = surface(before.x_px, before.y_px, residual, REST_DEGREES, size)
    error = rest.noise * np.linalg.norm(inverse, axis=1)
    terms = rest.terms(before.x_px, before.y_px)
    fitted = terms @ rest.value
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(after.light / before.light)
    light = surface(before.x_px, before.y_px, ratio[:, None], REST_DEGREES, size)
    even = 100 * float((terms @ light.value[:, 0]).std())
    count = float(terms.shape[1])
    dots = float(len(before.x_px))
    even_u = 100 * light.noise * math.sqrt((count - 1) / dots)
    free = 2.0 * count - 4
    rest_u = rest.noise * math.sqrt(free / (2 * dots))
    rest_arcsec = float(np.sqrt((fitted**2).mean()))
    to_unit = np.array([1.0, 1.0, PPM_PER_ARCSEC, 1.0])
    x, y, scale, turn = (to_unit * solution).tolist()
    x_u, y_u, scale_u, turn_u = (to_unit * error).tolist()
    dof = rest.dof
    return [
        _Change("evenness", even, even_u, light.dof, count - 1),
        _Change("scale", scale, scale_u, dof),
        _Change("rotation", turn, turn_u, dof),
        _Change("shift_x", x, x_u, dof),
        _Change("shift_y", y, y_u, dof),
        _Change("geometry_rest", rest_arcsec, rest_u, dof, free),
    ]


def _dots_of_both(was: CheckReadings, now: CheckReadings) -> tuple[DotReadings, DotReadings]:
    """The dots that both checks have, in one order. Raises InputError where they are too few."""
    places = []
    for readings in (was, now):
        keys = zip(readings.x_px, readings.y_px, strict=True)
        places.append(dict(zip(keys, itertools.count(), strict=False)))
    first, second = places
    both = sorted(first.keys() & second.keys())
    if len(both) < 4 * len(TOLERANCES):
        raise InputError(
            f"{len(both)} dots are seen now and were then; look at focus, exposure and what covers"
            " the screen"
        )
    dots = []
    for readings, place in zip((was, now), places, strict=True):
        rows = [place[key] for key in both]
        dots_seen = readings.seen_x_px, readings.seen_y_px
        columns = np.array([readings.x_px, readings.y_px, *dots_seen, readings.dot_light])
        dots.append(DotReadings(*columns[:, rows]))
    return dots[0], dots[1]


def _similarity(
    tangents: FloatArray, moved: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shifts along x and y, scale and rotation (4,) that move places (n, 2) so, arcsec; the
    pseudo-inverse (4, 2n) of their fit; what is left (n, 2), nan where it is wild.
    """
    u, v = tangents.T
    ones = np.ones_like(u)
    none = np.zeros_like(u)
    along = np.stack([ones, none, u, -v], axis=1)
    across = np.stack([none, ones, v, u], axis=1)
    design = np.concatenate([along, across])
    values = moved.T.ravel()
    usable = np.isfinite(values)
    for _ in range(3):
        inverse = np.linalg.pinv(design[usable])
        solution = inverse @ values[usable]
        residual = values - design @ solution
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual[usable])))
        tame = np.abs(residual) < WILD_SIGMAS * max(spread, SMALL_ARCSEC)
        usable = np.isfinite(values) & tame
    return solution, inverse, np.where(usable, residual, np.nan).reshape(2, -1).T


def record(
    folder: Path, made: datetime.datetime, since: str, figures: list[CheckFigure]
) -> list[dict[str, str]]:
    """Add a check to checks.csv and draw all of them; its rows. Raises InputError where they
    cannot be read or written.
    """
    path = folder / CHECKS
    columns = ["made", "certificate", *(field.name for field in fields(CheckFigure))]
    rows: list[dict[str, str]] = []
    if exists(path):
        rows = _rows_of(path)
        if any(set(row) != set(columns) for row in rows):
            raise InputError(f"{path}: its columns are not {', '.join(columns)}; move it away")
    stamp = made.isoformat(timespec="milliseconds")  # two checks of one second are two
    for figure in figures:
        texts = {name: str(value) for name, value in asdict(figure).items()}
        rows.append({"made": stamp, "certificate": since, **texts})
    write_csv(path, columns, map(operator.itemgetter(*columns), rows))
    draw_checks(folder / CHART, rows)
    return rows


def draw_checks(path: Path, rows: list[dict[str, str]]) -> None:
    """Draw brightness, shift and focus of all checks against time, with their thresholds."""
    first = datetime.datetime.fromisoformat(rows[0]["made"])
    tolerance_text = "all within tolerance"
    out = sorted({row["quantity"] for row in rows if row["in_tolerance"] != "True"})
    if out:
        tolerance_text = f"out of tolerance in {', '.join(out)}"
    number = len({row["made"] for row in rows})
    checks = "1 check"
    if number > 1:
        checks = f"{number} checks"
    with chart(path, f"{checks}: {tolerance_text}", panels=len(DRAWN)) as panels:
        for axes, (quantity, label) in zip(panels, DRAWN, strict=True):
            members = [row for row in rows if row["quantity"] == quantity]
            made = [datetime.datetime.fromisoformat(row["made"]) for row in members]
            days = [(moment - first).total_seconds() / SECONDS_PER_DAY for moment in made]
            value, u, limit = (_column(members, key) for key in DRAWN_COLUMNS)
            axes.errorbar(days, value, 2 * u, fmt="o-", color=BLUE)
            for sign in (-1, 1):
                axes.plot(days, sign * limit, color=ORANGE, lw=1, marker="_", ls=":")
            axes.axhline(0, color=MUTED, lw=0.8)
            axes.set_ylabel(label)
        panels[-1].set_xlabel("days since the first check")


def _rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a file of checks. Raises InputError where it cannot be read."""
    return list(csv.DictReader(io.StringIO(read_text(path, "", MAX_BYTES))))


def _column(rows: list[dict[str, str]], name: str) -> FloatArray:
    """A column (n,) of numbers of rows of checks."""
    return np.array([float(row[name]) for row in rows])


def checks_in(folder: Path) -> int:
    """How many rows of checks a directory has."""
    path = folder / CHECKS
    if exists(path):
        return read_text(path, "", MAX_BYTES).count("\n")
    return 0


def largest_changes(folder: Path) -> dict[str, float] | None:
    """The largest change of each quantity over all checks, in its unit; None without checks.
    Raises InputError.
    """
    path = folder / CHECKS
    if not exists(path):
        return None
    changes: dict[str, float] = {}
    try:
        for row in _rows_of(path):
            quantity = row["quantity"]
            change = abs(float(row["value"]))
            changes[quantity] = max(change, changes.get(quantity, 0.0))
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path}: is no table of checks ({shortened(error)}); move it away"
        ) from error
    return changes or None


def watch(reader: Reader, white: int, longest_min: float, path: Path) -> WarmUp:
    """Watch white until it is stable to 0.2 %, or for so long, and draw it. Raises InputError,
    MachineError.
    """

    def read() -> float:
        return float(reader.light(np.array([white], dtype=np.intp)).light[0])

    t_s, light = watch_white(read, reader.now_ns, reader.wait, longest_min * 60)
    judged = judge_warm_up(t_s, light)
    minutes = t_s / 60
    last = light[-1]
    fitted = fitted_white(judged, t_s, light)
    with chart(path, judged.line) as (axes,):
        axes.plot(minutes, light / last, "o", color=BLUE, ms=3)
        axes.plot(minutes, fitted / last, color=ORANGE)
        axes.set(xlabel="time [min]", ylabel="white over its last reading")
    return judged
