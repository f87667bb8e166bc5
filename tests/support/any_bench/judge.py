"""What a bench by chance came to: each figure of its session against the plant, and the outcome in
one word.

Places and light are compared on the screen's own pixels, so that a mounting that was found
differently is an error like any.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD, magnitude
from hilstar.display.calibration import read_toml
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.build import full_scale_e_per_s
from hilstar.server.bench.cameras import bench_camera, tracker_camera
from hilstar.server.bench.config.hardware import Monitor
from hilstar.server.bench.monitor import bench_calibration
from tests.support.any_bench.draw import DrawnBench, Panel, true_light

STEPS = (
    "orientation",
    "focus",
    "warm-up",
    "geometry",
    "uniformity",
    "photometry",
    "scale",
    "latency",
    "verify",
)
MAX_SIGMAS = 4.0
# the file was wrong: any other end without a step is a fault of the program or the machine
REFUSED_CODE = 2
MAX_MEMORY_MB = 2048.0
PLACES = 41  # along each side of the screen
DECADES = (1e-1, 1e-2, 1e-3)
# Outcomes, the best first.
VERIFIED, TOO_WIDE, REFUSED = "calibrated and verified", "calibrated, star too wide", "refused"
NOT_VERIFIED, FAILED, LATER, WRONG = (
    "calibrated, not verified",
    "step failed",
    "failed later",
    "wrong figure",
)
HEAVY, TRACEBACK = "over 2 GB", "traceback"
BUSY = "calibrated and verified, run missed frames"
OUTCOMES = (VERIFIED, BUSY, TOO_WIDE, REFUSED, NOT_VERIFIED, FAILED, LATER, HEAVY, WRONG, TRACEBACK)
GOOD_OUTCOMES = (VERIFIED, BUSY, TOO_WIDE, REFUSED)
# Refused by the first image, before anything is measured.
BLACK_TOO_BRIGHT = "a black screen fills the tracker"
# What `assess` says of a run of 20 s on a machine that is too busy to keep its rate.
TOO_FEW_ANSWERS = (
    "missed so many frames",
    "valid answers, and",
    "answers fall into the run, and",
)
WIDE_STAR = "star_sigma_ratio"
# Of a wide pixel the codes' own error is large in tracker pixels, and so is that of places.
BY_CODES, OFF_PLACES = "the codes alone cost", "centroids are"
FIRST_LIGHT, VERIFY, CERTIFY, SERVE, SEND, TRACKER, ASSESS = COMMANDS = (
    "first-light",
    "verify",
    "certify",
    "serve",
    "send",
    "tracker",
    "assess",
)


@dataclass(frozen=True)
class CommandResult:
    """A command that has ended: exit code (None where it was stopped for its time), what it took
    and printed. `load` is the mean number of the machine's processes that wanted a core in the
    minute before its end; NaN in files that do not have it.
    """

    code: int | None
    seconds: float
    cpu_s: float
    memory_mb: float
    stdout: str
    stderr: str
    load: float = math.nan

    @property
    def found(self) -> dict[str, Any]:
        """The JSON object that it printed; empty without one."""
        try:
            table = json.loads(self.stdout)
        except ValueError:
            return {}
        return table if isinstance(table, dict) else {}

    @property
    def last_line(self) -> str:
        """The last line of its errors."""
        lines = [line for line in self.stderr.splitlines() if line.strip()]
        return lines[-1] if lines else ""


@dataclass(frozen=True)
class Comparison:
    """A figure as it was found and as it was planted, and the difference in its own sigmas; None
    where it has none.
    """

    found: float | str
    planted: float | str
    sigmas: float | None = None


def in_screen(
    monitor: Monitor, x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels of the screen that show pixels (n,) of the image."""
    width, height = monitor.resolution_px
    for _ in range(monitor.rotate_deg // 90):
        x_px, y_px = height - 1 - y_px, x_px
        width, height = height, width
    return (width - 1 - x_px if monitor.flip_x else x_px), (
        height - 1 - y_px if monitor.flip_y else y_px
    )


def in_image(monitor: Monitor, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels of the image that pixels (n,) of the screen show."""
    width, height = monitor.resolution_px
    turned = monitor.rotate_deg % 180 != 0
    screen_w, screen_h = (height, width) if turned else (width, height)
    x_px = screen_w - 1 - x_px if monitor.flip_x else x_px
    y_px = screen_h - 1 - y_px if monitor.flip_y else y_px
    for _ in range(monitor.rotate_deg // 90):
        x_px, y_px, screen_w, screen_h = y_px, screen_w - 1 - x_px, screen_h, screen_w
    return x_px, y_px


@dataclass(frozen=True)
class SeenScreen:
    """Pixels of the screen that the tracker sees: where bench and truth have them on the
    detector, and how bright.
    """

    bench_px: FloatArray
    truth_px: FloatArray
    bench_light: FloatArray
    truth_light: FloatArray

    @classmethod
    def of(cls, bench: BenchFile, truth: BenchFile) -> SeenScreen:
        """The screen by both files, on a grid over what the true tracker sees of it."""
        tracker = tracker_camera(truth.config.tracker, truth.folder)
        width, height = truth.config.monitor.resolution_px
        columns, rows = np.meshgrid(
            np.linspace(0, width - 1, PLACES), np.linspace(0, height - 1, PLACES)
        )
        true_x, true_y = _tracker_px(truth, columns.ravel(), rows.ravel())
        inside = tracker.contains_px(true_x, true_y)
        if inside.sum() < PLACES:  # a small part of the screen: a grid over that
            ends = tracker.rays(
                *np.meshgrid(*(np.linspace(0, size - 1, PLACES) for size in tracker.resolution_px))
            )
            camera = bench_camera(truth.config, truth.folder)
            columns, rows = camera.project(ends.reshape(-1, 3) @ camera.cam_to_image.T)
            on_screen = camera.contains_px(columns, rows)
            columns, rows = columns[on_screen], rows[on_screen]
            true_x, true_y = _tracker_px(truth, columns, rows)
            inside = tracker.contains_px(true_x, true_y)
        columns, rows = columns.ravel()[inside], rows.ravel()[inside]
        own = in_image(bench.config.monitor, *in_screen(truth.config.monitor, columns, rows))
        bench_px = np.stack(_tracker_px(bench, *own))
        return cls(
            bench_px,
            np.stack([true_x[inside], true_y[inside]]),
            _light(bench, *own),
            _light(truth, columns, rows),
        )

    @property
    def off_px(self) -> FloatArray:
        """How far the bench file has each place from where it is, tracker pixels (n,); NaN where
        it has none.
        """
        return np.asarray(np.hypot(*(self.bench_px - self.truth_px)))

    @property
    def off_mag(self) -> FloatArray:
        """How much fainter the bench file has white there, mag (n,)."""
        return np.asarray(magnitude(self.bench_light / self.truth_light))


def _tracker_px(
    file: BenchFile, x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    monitor, tracker = (
        bench_camera(file.config, file.folder),
        tracker_camera(file.config.tracker, file.folder),
    )
    return tracker.project(monitor.rays(x_px, y_px) @ tracker.cam_to_image.T)


def _light(file: BenchFile, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Light of white, electrons per second, at pixels (n,) of the image."""
    monitor = file.config.monitor
    grid = bench_calibration(file.config, file.folder).uniformity_map(monitor.resolution_px)
    # A scale that agrees with the bench file's writes no key.
    white = full_scale_e_per_s(file)
    if grid is None:
        return np.full(len(x_px), white)
    columns, rows = np.rint(x_px).astype(np.intp), np.rint(y_px).astype(np.intp)
    return np.asarray(white * grid[rows, columns], dtype=np.float64)


def comparisons(drawn: DrawnBench, folder: Path, steps: Mapping[str, Any]) -> dict[str, Comparison]:
    """Each figure of the steps that are done against the plant."""
    done = {name: step["figures"] for name, step in steps.items() if step["verdict"] == "done"}
    compared: dict[str, Comparison] = {}
    if "focus" in done:
        found, error = done["focus"]["psf_sigma_px"], done["focus"]["psf_sigma_error_px"]
        compared["focus"] = Comparison(
            found, drawn.detector.psf_px, _sigmas(found - drawn.detector.psf_px, error)
        )
    if "warm-up" in done:
        found, error = (
            done["warm-up"]["drift_percent_per_h"],
            done["warm-up"]["drift_error_percent_per_h"],
        )
        compared["warm-up"] = Comparison(found, 0.0, _sigmas(found, error))
    if "latency" in done:
        found, planted = done["latency"]["panel_delay_ms"], drawn.mounting.delay_ms
        compared["latency"] = Comparison(
            found, planted, _sigmas(found - planted, done["latency"]["error_ms"])
        )
    if "photometry" in done:
        compared |= _response(drawn, folder, done["photometry"])
    if not {"geometry", "uniformity", "scale"} & done.keys():
        return compared
    bench, truth = read_bench_file(folder / "bench.toml"), read_bench_file(folder / "truth.toml")
    screen = SeenScreen.of(bench, truth)
    if "geometry" in done:
        arcsec_a_px = (
            ARCSEC_PER_RAD / tracker_camera(truth.config.tracker, truth.folder).focal_length_px
        )
        off_arcsec = float(np.sqrt(np.nanmean(screen.off_px**2))) * arcsec_a_px
        compared["geometry"] = Comparison(
            off_arcsec, 0.0, _sigmas(off_arcsec, done["geometry"]["error_rms_arcsec"])
        )
    if "uniformity" in done:
        scatter = float(np.nanstd(screen.off_mag))
        compared["uniformity"] = Comparison(
            scatter, 0.0, _sigmas(scatter, done["uniformity"]["map_error_mag"])
        )
    if "scale" in done:
        off_mag = float(np.nanmean(screen.off_mag))
        compared["scale"] = Comparison(off_mag, 0.0, _sigmas(off_mag, done["scale"]["error_mag"]))
    return compared


def planted_black(panel: Panel) -> float:
    """The light of code 0 relative to that of white above it, as `photometry` states it."""
    light = true_light(panel)
    return float(light[0] / (light[-1] - light[0]))


def _response(drawn: DrawnBench, folder: Path, figures: Mapping[str, Any]) -> dict[str, Comparison]:
    """The response by its largest error in sigmas, decade by decade, and the black level."""
    bench = read_bench_file(folder / "bench.toml")
    response = bench_calibration(bench.config, bench.folder).response
    planted = true_light(drawn.panel)
    black = planted_black(drawn.panel)
    true = (planted - planted[0]) / (planted[-1] - planted[0])
    worst = Comparison(math.nan, 0.0)
    for decade in DECADES:
        code = int(np.argmin(np.abs(true - decade)))
        off = float(response.light[code] / true[code] - 1)
        error = figures.get(f"error_at_1e-{round(-math.log10(decade))}_percent")
        sigmas = None if error is None else _sigmas(off, error / 100)
        if sigmas is not None and abs(sigmas) >= abs(worst.sigmas or 0.0):
            worst = Comparison(off, 0.0, sigmas)
    found = float(figures["black_level"])
    errors = read_toml(folder / str(bench.config.monitor.calibration)).errors
    sigmas = None if errors is None else _sigmas(found - black, errors.black)
    return {"photometry": worst, "black": Comparison(found, black, sigmas)}


def _sigmas(off: float, error: float | None) -> float | None:
    if error is None or not math.isfinite(error):
        return None
    if error == 0:
        return 0.0 if off == 0 else math.copysign(math.inf, off)
    return off / error


def held_by_certificate(found: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
    """How many intervals of a virtual bench's certificate hold the truth, and how many there
    are, of each quantity.
    """
    counts: dict[str, tuple[int, int]] = {}
    for figure in found.get("figures", []):
        if figure.get("truth") is None:
            continue
        held, intervals = counts.get(figure["quantity"], (0, 0))
        holds = figure["lower"] <= figure["truth"] <= figure["upper"]
        counts[figure["quantity"]] = (held + holds, intervals + 1)
    return counts


def outcome_of(
    results: Mapping[str, CommandResult], compared: Mapping[str, Comparison]
) -> tuple[str, str]:
    """The outcome of a bench, and the words for it."""
    return (
        _fault(results, compared) or _first_day(results) or _afterwards(results) or (VERIFIED, "")
    )


def _fault(
    results: Mapping[str, CommandResult], compared: Mapping[str, Comparison]
) -> tuple[str, str] | None:
    """What must never happen: a traceback, a figure beyond its sigmas, a command that takes too
    much memory.
    """
    for name, result in results.items():
        if "Traceback" in result.stderr:
            return TRACEBACK, f"{name}: {result.last_line}"
    wrong = {name: one for name, one in compared.items() if abs(one.sigmas or 0.0) > MAX_SIGMAS}
    if wrong:
        parts = (
            f"{name} {one.found:.4g}, not {one.planted:.4g}: {one.sigmas:+.1f} sigmas"
            for name, one in wrong.items()
        )
        return WRONG, "; ".join(parts)
    for name, result in results.items():
        if result.memory_mb > MAX_MEMORY_MB:
            return HEAVY, f"{name}: {result.memory_mb:.0f} MB"
    return None


def _first_day(results: Mapping[str, CommandResult]) -> tuple[str, str] | None:
    """A session that is refused or fails, and a bench that its twin does not pass; None where
    all is well.
    """
    session = results[FIRST_LIGHT]
    steps = {step["name"]: step for step in session.found.get("steps", [])}
    if not steps:
        return _without_steps(session)
    reasons = _reasons(results)
    failed = next((step for step in steps.values() if step["verdict"] == "failed"), None)
    if (
        failed is not None
        and failed["name"] == "orientation"
        and BLACK_TOO_BRIGHT in failed["line"]
    ):
        return REFUSED, failed["line"]
    if failed is not None and not (failed["name"] == "verify" and only_wide(reasons)):
        return FAILED, f"{failed['name']}: {failed['line']}"
    verdict = results.get(VERIFY)
    if verdict is None or verdict.code or not verdict.found:
        return NOT_VERIFIED, "verify: " + ("not run" if verdict is None else verdict.last_line)
    if reasons and not only_wide(reasons):
        return NOT_VERIFIED, "; ".join(reasons)
    return None


def _without_steps(session: CommandResult) -> tuple[str, str]:
    """A session that ended before its first step was recorded."""
    if session.code == REFUSED_CODE:
        return REFUSED, session.last_line
    end = (
        f"stopped after {session.seconds:.0f} s"
        if session.code is None
        else f"ended with {session.code}"
    )
    return FAILED, f"{end}: {session.last_line}"


def _afterwards(results: Mapping[str, CommandResult]) -> tuple[str, str] | None:
    """A later command that fails, or the star that was said to be too wide; None where all is
    well.
    """
    later = [name for name in COMMANDS[2:] if name in results and results[name].code]
    reasons = _reasons(results)
    if later == [ASSESS] and reasons:
        # A tracker before stars so wide sees few of them, or none, and `verify` said so.
        return TOO_WIDE, reasons[-1]
    if later == [ASSESS] and _is_short_of_frames(results):
        return BUSY, results[ASSESS].last_line + _load_of(results[SERVE])
    if later:
        return LATER, "; ".join(f"{name}: {results[name].last_line}" for name in later)
    # the last of them is the wide star, with what would do
    return (TOO_WIDE, reasons[-1]) if reasons else None


def _load_of(result: CommandResult) -> str:
    """The machine's load at a command's end, in words; "" where it is not known."""
    if math.isnan(result.load):
        return ""
    return f" (the machine's load was {result.load:.1f} on {os.cpu_count()} cores)"


def _is_short_of_frames(results: Mapping[str, CommandResult]) -> bool:
    """Whether `assess` has too few answers because the run missed frames."""
    missed = results[SERVE].found.get("missed_frames", 0)
    told = results[ASSESS].last_line
    return bool(missed) and any(words in told for words in TOO_FEW_ANSWERS)


def _reasons(results: Mapping[str, CommandResult]) -> list[str]:
    """The reasons against the bench by `verify`."""
    verdict = results.get(VERIFY)
    return [] if verdict is None else list(verdict.found.get("reasons", []))


def only_wide(reasons: list[str]) -> bool:
    """Whether all that is against a bench is its wide star, which was said before it was built,
    and what codes do to one so wide.
    """
    others = [reason for reason in reasons if WIDE_STAR not in reason]
    if not others:
        return bool(reasons)
    is_by_codes = any(BY_CODES in reason for reason in others)
    is_known = all(BY_CODES in reason or reason.startswith(OFF_PLACES) for reason in others)
    return len(others) < len(reasons) and is_by_codes and is_known


def row_of(drawn: DrawnBench, folder: Path, results: Mapping[str, CommandResult]) -> dict[str, Any]:
    """The row of a bench: what was planted, what was found, sigmas, time, words and outcome."""
    session = results[FIRST_LIGHT].found
    steps = {step["name"]: step for step in session.get("steps", [])}
    compared = comparisons(drawn, folder, steps)
    outcome, words = outcome_of(results, compared)
    row: dict[str, Any] = {"outcome": outcome, "words": words} | drawn.planted()
    for name in STEPS:
        step = steps.get(name, {})
        row |= {
            f"{name}_verdict": step.get("verdict", ""),
            f"{name}_s": step.get("seconds"),
            f"{name}_line": step.get("line"),
        }
    for name in (
        "focus",
        "warm-up",
        "geometry",
        "uniformity",
        "photometry",
        "black",
        "scale",
        "latency",
    ):
        one = compared.get(name)
        row[f"{name}_found"] = None if one is None else one.found
        row[f"{name}_planted"] = None if one is None else one.planted
        row[f"{name}_sigmas"] = None if one is None else one.sigmas
    held = held_by_certificate(results[CERTIFY].found) if CERTIFY in results else {}
    for quantity in (
        "flux",
        "place_along",
        "place_across",
        "attitude_x",
        "attitude_y",
        "attitude_z",
        "latency",
    ):
        counts = held.get(quantity)
        row[f"certified_{quantity}"] = None if counts is None else f"{counts[0]} of {counts[1]}"
    for name in COMMANDS:
        result = results.get(name)
        row[f"{name}_code"] = None if result is None else result.code
        row[f"{name}_cpu_s"] = None if result is None else round(result.cpu_s, 1)
        row[f"{name}_seconds"] = None if result is None else round(result.seconds, 1)
    row["memory_mb"] = round(max(result.memory_mb for result in results.values()))
    return row | _live(results)


def _live(results: Mapping[str, CommandResult]) -> dict[str, Any]:
    """The figures of the run and of the assessment."""
    served = results[SERVE].found if SERVE in results else {}
    assessed = results[ASSESS].found if ASSESS in results else {}
    answered = results[TRACKER].found if TRACKER in results else {}
    bias = assessed.get("bias_arcsec")
    return {
        "serve_frames": served.get("frames"),
        "serve_missed": served.get("missed_frames"),
        "serve_load": round(results[SERVE].load, 1) if SERVE in results else None,
        "tracker_answers": answered.get("answers"),
        "assess_bias_arcsec": None if bias is None else " ".join(f"{each:.3g}" for each in bias),
        "assess_availability": assessed.get("availability"),
    }
