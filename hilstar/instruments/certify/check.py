"""The check in a minute: twelve patches, one pattern of dots and one delay, against the same
readings of the certificate.

Each figure is a difference with its uncertainty. It is out of tolerance where it exceeds its
tolerance by more than noise explains, at a probability by which all figures of a check together
raise a false alarm once in 10 000 checks (Bonferroni).
"""

import csv
import datetime
import io
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import msgspec
import numpy as np
from scipy.special import fdtri, stdtrit

from hilstar.basics.charts import BLUE, MUTED, ORANGE, chart, write_csv
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import NOT_JSON, exists, read_bytes, read_text
from hilstar.instruments.calibrate.warm_up import WarmUp, fitted_white, judge_warm_up, watch_white
from hilstar.instruments.certify.budget import COVERAGE
from hilstar.instruments.certify.estimates import place_errors, surface
from hilstar.instruments.certify.readings import (
    DotReadings,
    Reader,
    VirtualReader,
    dot_places,
    geometry_of,
)
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.certify import VirtualSettings

PATCHES, REPEATS, DOT_IMAGES = 12, 3, 4
FALSE_ALARM = 1e-4  # for a whole check
FAINT = 3  # codes by which the floor of the readings is known
REST_DEGREES = (3,)
ALARMED_DOF = 1e6
MAX_BYTES = 50_000_000
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
    lit = np.unique(np.rint(np.geomspace(max(white * 0.06, 1), white, PATCHES - 1)).astype(np.intp))
    order = np.random.default_rng(PATCHES).permutation(np.repeat(np.append(0, lit), REPEATS))
    light = reader.light(order)
    dots = reader.dots(*dot_places(geometry_of(file)), DOT_IMAGES)
    delays = reader.delays_ms()
    many = len(delays) > 1
    return CheckReadings(
        code=light.code.tolist(),
        light=light.light.tolist(),
        x_px=dots.x_px.tolist(),
        y_px=dots.y_px.tolist(),
        seen_x_px=dots.seen_x_px.round(5).tolist(),
        seen_y_px=dots.seen_y_px.round(5).tolist(),
        dot_light=[float(f"{value:.6g}") for value in dots.light / np.median(dots.light)],
        psf_px=dots.psf_px,
        psf_u_px=dots.psf_u_px,
        delay_ms=float(delays.mean()) if many else None,
        delay_u_ms=float(delays.std(ddof=1)) / math.sqrt(len(delays)) if many else 0.0,
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
    psf_u = 100 * math.hypot(was.psf_u_px, now.psf_u_px) / was.psf_px
    changes.append(("psf", 100 * (now.psf_px / was.psf_px - 1), psf_u, ALARMED_DOF, 0.0))
    if was.delay_ms is not None and now.delay_ms is not None:
        both = math.hypot(was.delay_u_ms, now.delay_u_ms)
        changes.append(
            (
                "latency",
                now.delay_ms - was.delay_ms,
                both,
                float(max(min(was.delay_dof, now.delay_dof), 1)),
                0.0,
            )
        )
    probability = FALSE_ALARM / len(changes)
    return [_judged(*change, probability) for change in changes]


def _judged(
    quantity: str, value: float, u: float, dof: float, free: float, probability: float
) -> CheckFigure:
    """A figure with its threshold; with `free` numbers of freedom it is a root mean square,
    tested by F.
    """
    tolerance, unit = TOLERANCES[quantity]
    if free:  # a mean square of noise alone is u^2 times F's
        k = math.sqrt(fdtri(free, dof, 1 - probability))
        wide = u * math.sqrt(fdtri(free, dof, COVERAGE))
        lower = max(value - wide, 0.0)
        upper = value + wide
    else:
        k = float(stdtrit(dof, 1 - probability / 2))
        wide = float(stdtrit(dof, (1 + COVERAGE) / 2)) * u
        lower = value - wide
        upper = value + wide
    if free:
        threshold = math.hypot(tolerance, k * u)
    else:
        threshold = tolerance + k * u
    return CheckFigure(
        quantity,
        value,
        u,
        lower,
        upper,
        unit,
        min(dof, ALARMED_DOF),
        tolerance,
        threshold,
        abs(value) <= threshold,
    )


Figure = tuple[str, float, float, float, float]


def _light(was: CheckReadings, now: CheckReadings) -> list[Figure]:
    """Brightness, gamma, what is left of the response, and black: the change of each code's
    light.
    """
    codes = np.unique(was.code)
    sets = [(np.array(readings.code), np.array(readings.light)) for readings in (was, now)]
    if not np.array_equal(codes, np.unique(now.code)):
        raise InputError("the check's codes are not the certificate's; certify the bench --again")
    mean = np.array([[light[code == c].mean() for c in codes] for code, light in sets])
    count = np.array([[(code == c).sum() for c in codes] for code, _ in sets])
    squares = np.array(
        [
            [((light[code == c] - light[code == c].mean()) ** 2).sum() for c in codes]
            for code, light in sets
        ]
    )
    used = squares.sum(axis=1) > 0  # a bench file's own figures have no noise
    freedom = (count - 1)[used]
    bright = codes > codes[len(codes) // 3]
    dof = float(freedom[:, bright].sum())
    if dof:
        relative = math.sqrt(
            float((squares[used][:, bright] / mean[used][:, bright] ** 2).sum()) / dof
        )
    else:
        relative = 0.0
    faint = np.arange(len(codes)) < FAINT
    floor = float(
        (squares[used] - freedom * (relative * mean[used]) ** 2)[:, faint].sum()
        / max(freedom[:, faint].sum(), 1)
    )
    variance = sum(
        ((relative * mean[k]) ** 2 + max(floor, 0.0)) / count[k] for k in (0, 1) if used[k]
    )
    sigma = np.sqrt(variance)
    lit = codes > 0
    white = mean[0, -1]
    change = mean[1, lit] / mean[0, lit] - 1
    error = sigma[lit] / mean[0, lit]
    design = np.stack([np.ones(int(lit.sum())), np.log(codes[lit] / codes[-1])], axis=1)
    inverse = np.linalg.pinv(design / error[:, None]) / error
    covariance = (inverse * error**2) @ inverse.T
    slope = inverse @ change
    middle = float(np.average(np.log(codes[lit] / codes[-1]), weights=error**-2))
    at = np.array([1.0, middle])
    standardised = (change - design @ slope) / error
    free = len(standardised) - 2
    rest = math.sqrt(float((standardised**2).mean()))
    typical = 100 * math.sqrt(float(np.mean(error**2)))
    return [
        (
            "brightness",
            100 * float(at @ slope),
            100 * math.sqrt(float(at @ covariance @ at)),
            dof,
            0.0,
        ),
        ("gamma", float(slope[1]), math.sqrt(float(covariance[1, 1])), dof, 0.0),
        (
            "response_rest",
            rest * typical,
            typical * math.sqrt(free / len(standardised)),
            dof,
            float(free),
        ),
        (
            "black",
            100 * float(mean[1, 0] - mean[0, 0]) / white,
            100 * float(sigma[0]) / white,
            dof,
            0.0,
        ),
    ]


def _geometry(file: BenchFile, was: CheckReadings, now: CheckReadings) -> list[Figure]:
    """Evenness, scale, rotation, shift, and what is left of the geometry, by the dots that both
    have.
    """
    places = [
        {(x, y): k for k, (x, y) in enumerate(zip(readings.x_px, readings.y_px, strict=True))}
        for readings in (was, now)
    ]
    both = sorted(places[0].keys() & places[1].keys())
    dots = []
    for readings, place in zip((was, now), places, strict=True):
        columns = (
            readings.x_px,
            readings.y_px,
            readings.seen_x_px,
            readings.seen_y_px,
            readings.dot_light,
        )
        x, y, seen_x, seen_y, light_of = np.array(columns)[:, [place[at] for at in both]]
        dots.append(DotReadings(x, y, seen_x, seen_y, light_of))
    if len(both) < 4 * len(TOLERANCES):
        raise InputError(
            f"{len(both)} dots are seen now and were then; look at focus, exposure and what covers"
            " the screen"
        )
    size = file.config.monitor.resolution_px
    moved = place_errors(file, dots[1]) - place_errors(file, dots[0])
    rays = geometry_of(file).monitor.rays(dots[0].x_px, dots[0].y_px)
    u = rays[:, 0] / rays[:, 2]
    v = rays[:, 1] / rays[:, 2]
    ones = np.ones_like(u)
    none = np.zeros_like(u)
    design = np.concatenate(
        [np.stack([ones, none, u, -v], axis=1), np.stack([none, ones, v, u], axis=1)]
    )
    values = moved.T.ravel()
    is_kept = np.isfinite(values)
    for _ in range(3):
        inverse = np.linalg.pinv(design[is_kept])
        solution = inverse @ values[is_kept]
        residual = values - design @ solution
        is_kept = np.isfinite(values) & (
            np.abs(residual) < 6 * 1.4826 * max(float(np.median(np.abs(residual[is_kept]))), 1e-9)
        )
    rest = surface(
        dots[0].x_px,
        dots[0].y_px,
        np.where(is_kept, residual, np.nan).reshape(2, -1).T,
        REST_DEGREES,
        size,
    )
    error = rest.noise * np.linalg.norm(inverse, axis=1)
    ppm = 1e6 / 206264.806
    terms = rest.terms(dots[0].x_px, dots[0].y_px)
    free = 2.0 * terms.shape[1] - 4
    fitted = terms @ rest.value
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(dots[1].light / dots[0].light)
    light = surface(dots[0].x_px, dots[0].y_px, ratio[:, None], REST_DEGREES, size)
    even = light.terms(dots[0].x_px, dots[0].y_px) @ light.value[:, 0]
    n = float(len(both))
    count = float(terms.shape[1])
    return [
        (
            "evenness",
            100 * float(even.std()),
            100 * light.noise * math.sqrt((count - 1) / n),
            light.dof,
            count - 1,
        ),
        ("scale", ppm * float(solution[2]), ppm * float(error[2]), rest.dof, 0.0),
        ("rotation", float(solution[3]), float(error[3]), rest.dof, 0.0),
        ("shift_x", float(solution[0]), float(error[0]), rest.dof, 0.0),
        ("shift_y", float(solution[1]), float(error[1]), rest.dof, 0.0),
        (
            "geometry_rest",
            float(np.sqrt((fitted**2).mean())),
            rest.noise * math.sqrt(free / (2 * n)),
            rest.dof,
            free,
        ),
    ]


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
        rows = list(csv.DictReader(io.StringIO(read_text(path, "", MAX_BYTES))))
        if any(set(row) != set(columns) for row in rows):
            raise InputError(f"{path}: its columns are not {', '.join(columns)}; move it away")
    stamp = made.isoformat(timespec="milliseconds")  # two checks of one second are two
    rows += [
        {"made": stamp, "certificate": since, **{k: str(v) for k, v in asdict(figure).items()}}
        for figure in figures
    ]
    write_csv(path, columns, ([row[name] for name in columns] for row in rows))
    draw_checks(folder / CHART, rows)
    return rows


def draw_checks(path: Path, rows: list[dict[str, str]]) -> None:
    """Draw brightness, shift and focus of all checks against time, with their thresholds."""
    first = datetime.datetime.fromisoformat(rows[0]["made"])
    out = sorted({row["quantity"] for row in rows if row["in_tolerance"] != "True"})
    number = len({row["made"] for row in rows})
    if out:
        tolerance_text = f"out of tolerance in {', '.join(out)}"
    else:
        tolerance_text = "all within tolerance"
    finding = f"{number} check{'s' if number > 1 else ''}: {tolerance_text}"
    with chart(path, finding, panels=len(DRAWN)) as panels:
        for axes, (quantity, label) in zip(panels, DRAWN, strict=True):
            mine = [row for row in rows if row["quantity"] == quantity]
            days = [
                (datetime.datetime.fromisoformat(row["made"]) - first).total_seconds() / 86400
                for row in mine
            ]
            value, u, limit = (
                np.array([float(row[key]) for row in mine])
                for key in ("value", "standard_uncertainty", "threshold")
            )
            axes.errorbar(days, value, 2 * u, fmt="o-", color=BLUE)
            for sign in (-1, 1):
                axes.plot(days, sign * limit, color=ORANGE, lw=1, marker="_", ls=":")
            axes.axhline(0, color=MUTED, lw=0.8)
            axes.set_ylabel(label)
        panels[-1].set_xlabel("days since the first check")


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
        for row in csv.DictReader(io.StringIO(read_text(path, "", MAX_BYTES))):
            changes[row["quantity"]] = max(
                abs(float(row["value"])), changes.get(row["quantity"], 0.0)
            )
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
    with chart(path, judged.line) as (axes,):
        axes.plot(t_s / 60, light / light[-1], "o", color=BLUE, ms=3)
        axes.plot(t_s / 60, fitted_white(judged, t_s, light) / light[-1], color=ORANGE)
        axes.set(xlabel="time [min]", ylabel="white over its last reading")
    return judged
