"""Tables of README and docs/ from the CSV files beside this script: `python results/tables.py`
writes them between their marks.

bench.csv and bench_h100.csv are written by `hilstar benchmark -o`; tradeoff.csv, economy.csv,
timing.csv and those of colour by `hilstar study NAME -o`, quantisation_time.csv and over_frames.csv
by `hilstar study quantisation -o`. machine.txt says on which machine; bench_h100.csv on an NVIDIA
H100, kinds_h200.csv by `python -m tests.benchmarks.bench_kinds` on an H200. chain.csv and
chain_budget.csv are written by `python tools/measure_answers.py`, and no machine changes them.
loop.csv and motion.csv are `python tools/measure_loop.py`, and no machine changes motion.csv.
rigs.csv is `hilstar study rigs -o DIR`, and no machine changes it.
limits.csv is `hilstar study limits -o DIR`, and no machine changes it.
certify.csv is `python tools/certify_coverage.py -o`, and intervals.csv is `python
tools/interval_coverage.py -o`; no machine changes them.
beside_*.csv are `python tools/beside.py NAME -o DIR`, and no machine changes them.
any_bench.csv is the any_bench_outcomes.csv of `python tools/any_bench.py --benches 100 --seed 405
-o DIR`; the load of the machine changes how many runs miss frames, and nothing else.
confronted.csv is `hilstar study confront` over the images that docs/confronted.md names; no machine
changes it.
"""

from __future__ import annotations

import csv
import math
import re
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, get_type_hints

from hilstar.basics.charts import two_digits
from hilstar.instruments.assess.bounded_figures import clopper_pearson
from hilstar.instruments.study import limits
from hilstar.instruments.study.chain.answers import STEP_WORDS, Answer, Given, answer, scenes_of
from hilstar.instruments.study.chain.measuring import CombinationRow, ErrorPart

HERE = Path(__file__).parent
ROOT = HERE.parent
COUNTS = (100, 1000, 10_000, 50_000)
OTHERS = ("numpy", "numba", "photutils", "galsim")
TIMED_DEG_S = 2.0
# As tools/any_bench.py names them, the best first; those that a person accepts are the first.
GOOD_BENCH_OUTCOMES = (
    "calibrated and verified",
    "calibrated and verified, run missed frames",
    "calibrated, star too wide",
    "refused",
)
BENCH_OUTCOMES = (
    *GOOD_BENCH_OUTCOMES,
    "calibrated, not verified",
    "step failed",
    "failed later",
    "over 2 GB",
    "wrong figure",
    "traceback",
)
MAX_BENCH_SIGMAS = 4.0
CLAUSES = "clauses, "  # what the kinds of intervals.csv begin with that are of clauses


def rows_of(name: str) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with (HERE / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def records_of(name: str, record: type[Any], **columns: str) -> list[Any]:
    """The rows of a CSV file whose columns have these values, as a study's dataclasses."""
    kinds = get_type_hints(record)
    rows = [
        row
        for row in rows_of(name)
        if all(row[column] == value for column, value in columns.items())
    ]
    return [record(**{column: kind(row[column]) for column, kind in kinds.items()}) for row in rows]


def figure(value: float) -> str:
    """Three digits, and no more places than they need."""
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def table(head: list[str], body: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def bench_table(
    name: str = "bench.csv", counts: tuple[int, ...] = COUNTS, others: tuple[str, ...] = OTHERS
) -> str:
    """Medians of the whole frame by image size, and of the linear image beside the others at
    1080p.
    """
    rows = rows_of(name)
    at = {
        (r["width"], r["height"], int(r["stars"]), r["method"], r["kind"]): float(r["median_ms"])
        for r in rows
    }
    sizes = list(dict.fromkeys((r["width"], r["height"]) for r in rows))

    def line(name: str, size: tuple[str, str], method: str, kind: str) -> list[str]:
        values = (at.get((*size, count, method, kind)) for count in counts)
        return [name, *("-" if v is None else figure(v) for v in values)]

    body = [line(f"whole frame, {w} x {h}", (w, h), "hilstar", "whole_frame") for w, h in sizes]
    full_hd = ("1920", "1080")
    body.append(line("linear image alone, 1920 x 1080", full_hd, "hilstar", "linear_only"))
    body += [line(f"the same by {other}", full_hd, other, "linear_only") for other in others]
    return table(["ms, median", *(f"{count} stars" for count in counts)], body)


def card_table() -> str:
    """The same on a graphics card."""
    return bench_table("bench_h100.csv", COUNTS[1:], OTHERS[:2])


def kinds_table() -> str:
    """Grey stars, three primaries and a glass on a graphics card, by image size."""
    rows = rows_of("kinds_h200.csv")
    sizes = list(dict.fromkeys((r["width"], r["height"]) for r in rows))
    at = {(r["width"], r["quantisation"], r["kind"], i // 8 % 2): r for i, r in enumerate(rows)}
    body = []
    for width, height in sizes:
        for few in (0, 1):
            for quantisation in ("round", "exact"):
                found = [
                    at[width, quantisation, kind, few]
                    for kind in dict.fromkeys(r["kind"] for r in rows)
                ]
                head = [f"{width} x {height}", found[0]["stars"], f"`{quantisation}`"]
                body.append(head + [figure(float(one["median_ms"])) for one in found])
    return table(["ms, median", "stars", "codes", *dict.fromkeys(r["kind"] for r in rows)], body)


def error_text(error: float, unit: str) -> str:
    """An error with its unit, a share of 1 in per cent."""
    if error == 0:
        return "none"
    if unit == "1":
        return f"{figure(100 * error)} %"
    return f"{figure(error)} {unit}"


def tradeoff_table() -> str:
    """Each step's default beside its exact method."""
    steps: dict[str, list[dict[str, str]]] = {}
    for row in rows_of("tradeoff.csv"):
        steps.setdefault(row["step"], []).append(row)
    body = []
    for step, rows in steps.items():
        default = next(row for row in rows if row["default"] == "True")
        exact = [row for row in rows if row["exact"] == "True" and row is not default]
        error = error_text(float(default["error"]), default["error_unit"])
        beside = f"{exact[0]['method']}: {figure(float(exact[0]['time_ms']))} ms" if exact else "-"
        body.append(
            [step, default["method"], error, f"{figure(float(default['time_ms']))} ms", beside]
        )
    return table(["step", "default", "error", "time", "the exact way"], body)


PACKETS = {True: "with rates", False: "without"}
ANSWERED_BITS = ("8", "10", "12")


def answers_table() -> str:
    """What to set on each panel for each turn, and what to expect, by primaries and rates."""
    head = [
        "bits",
        "turn",
        "packets",
        "set",
        "expect",
        "set, if primaries are known",
        "expect",
        "most of the error",
    ]
    body: list[list[str]] = []
    for bits in ANSWERED_BITS:
        scenes = scenes_of(records_of("chain.csv", CombinationRow, bits=bits))
        budget = records_of("chain_budget.csv", ErrorPart, bits=bits)
        for scene in scenes:
            turn_deg_s = scene[0].rate_deg_s
            for rates in (True, False) if turn_deg_s else (True,):
                plain, stealing = (
                    answer(scene, budget, Given(primaries, rates)) for primaries in (False, True)
                )
                turn = f"{turn_deg_s:g} deg/s" if turn_deg_s else "rest"
                packets = PACKETS[rates] if turn_deg_s else "any"
                step = STEP_WORDS.get(plain.largest.step, plain.largest.step)
                part = f"{step}, {two_digits(plain.largest.error_arcsec)} arcsec"
                body.append(
                    [bits, turn, packets, *answer_cells(plain), *answer_cells(stealing), part]
                )
    return table(head, body)


def answer_cells(choice: Answer) -> tuple[str, str]:
    """What to set, and what to expect; at rest with the time of a frame of 1000 stars."""
    stealing = choice.row.bit_stealing == "true"
    keys = f"`{choice.row.quantisation}`" + (", `bit_stealing`" if stealing else "")
    expected = choice.expected.replace(", ", "; ")
    if choice.row.rate_deg_s:
        return keys, expected
    method = choice.row.quantisation + (", bit stealing" if stealing else "")
    times = {
        (row["bits"], row["method"]): float(row["frame_ms"])
        for row in rows_of("quantisation_time.csv")
    }
    return keys, f"{expected}; {times[str(choice.row.bits), method]:.1f} ms"


def limits_table() -> str:
    """Where each of hilstar's methods leaves its tolerance, and what to do there."""
    body = []
    for name, advice in limits.ADVICE.items():
        row = next(row for row in rows_of("limits.csv") if row["stress"] == name)
        if row["meets"] == "nan":  # within it to the last point
            continue
        tolerance = f"{two_digits(float(row['tolerance']))} {row['unit']}"
        body.append([row["method"], name, two_digits(float(row["meets"])), tolerance, advice])
    return table(["method", "stress", "leaves its tolerance at", "of", "do"], body)


def economy_table() -> str:
    """Five scenes by bits, with full effort and with what two tolerances need: the time of a
    whole frame.
    """
    rows = rows_of("economy.csv")
    body = []
    for full, auto, loose in zip(rows[::3], rows[1::3], rows[2::3], strict=True):
        full_ms = float(full["frame_ms"])
        needs = []
        for row in (auto, loose):
            ms = float(row["frame_ms"])
            needs.append(f"`{row['quantisation']}`, {figure(ms)} ms, {full_ms / ms:.1f}")
        worst_px = max(float(value) for name, value in auto.items() if name.startswith("max_px_"))
        errors = f"{float(auto['flux_max_mag']):.3f} mag, {worst_px:.3f} px"
        claimed = f"{float(auto['claimed_mag']):.3f} mag, {float(auto['claimed_px']):.3f} px"
        body.append(
            [
                auto["bits"],
                auto["scene"],
                auto["stars"],
                f"{figure(full_ms)} ms",
                *needs,
                errors,
                claimed,
            ]
        )
    heads = ["bits", "scene", "stars", "full effort", "0.05 mag, 0.1 px", "0.1 mag, 0.1 px"]
    return table([*heads, "worst star of the field", "claimed of any star"], body)


def timing_table() -> str:
    """Star positions on a screen at 2 deg/s by what is compensated."""
    body = []
    for row in rows_of("timing.csv"):
        if float(row["rate_deg_s"]) == TIMED_DEG_S:
            errors = (figure(float(row[name])) for name in ("rms_arcsec", "worst_arcsec"))
            body.append([row["way"], *errors, f"{figure(float(row['draw_ms']))} ms"])
    return table(["at 2 deg/s", "arcsec rms", "worst", "time to draw"], body)


CENTROIDERS = {
    "moment": "plain first moment",
    "window": "Gaussian window as wide as the star",
    "wide": "Gaussian window half as wide again",
    "fit": "PSF fit",
    "box3": "centre of mass, 3 x 3",
    "box5": "centre of mass, 5 x 5",
}


def quantisation_table() -> str:
    """Each method's worst errors at the faint end of two panels' aims, and its time."""
    rows = [row for row in rows_of("quantisation_time.csv") if row["bits"] in ("8", "10")]
    at = {(row["bits"], row["method"]): row for row in rows}

    def errors(row: dict[str, str]) -> str:
        return f"{float(row['flux_max_mag']):.3f} mag, {float(row['max_px_fit']):.3f} px"

    def times(method: str) -> float:
        return float(at["8", method]["frame_ms"]) / float(at["8", "round"]["frame_ms"])

    methods = dict.fromkeys(row["method"] for row in rows)
    ends = [
        f"{bits} bits, {float(at[bits, 'round']['mag_under_white']):g} mag under white"
        for bits in ("8", "10")
    ]
    body = [
        [method, *(errors(at[bits, method]) for bits in ("8", "10")), f"{times(method):.1f} times"]
        for method in methods
    ]
    return table(["", *ends, "1000 stars, 1080p, 8 bits, to the time of `round`"], body)


def centroider_table() -> str:
    """What each centroider finds of `round` and `exact`, rms along an axis, and what is left."""
    at = {(row["bits"], row["method"]): row for row in rows_of("quantisation_time.csv")}
    head, body = ["centroider"], [[name] for name in CENTROIDERS.values()]
    for bits in ("8", "10"):
        rounded, exact = at[bits, "round"], at[bits, "exact"]
        head += [
            f"{bits} bits, {float(exact['mag_under_white']):g} mag: `round`",
            "`exact`",
            "of it",
        ]
        for line, kind in zip(body, CENTROIDERS, strict=True):
            both = [float(row[f"axis_rms_px_{kind}"]) for row in (rounded, exact)]
            line += [f"{both[0]:.3f} px", f"{both[1]:.3f} px", f"{both[1] / both[0]:.2f}"]
    flux = ["flux, rms"]
    for bits in ("8", "10"):
        both = [float(at[bits, method]["flux_rms_mag"]) for method in ("round", "exact")]
        flux += [f"{both[0]:.3f} mag", f"{both[1]:.3f} mag", f"{both[1] / both[0]:.2f}"]
    return table(head, [*body, flux])


def over_frames_table() -> str:
    """What `temporal` leaves on each panel after so many frames."""
    rows = [row for row in rows_of("over_frames.csv") if row["method"] == "temporal"]
    at = {(row["panel"], row["frames"]): row for row in rows}
    frames = ("1", "2", "6", "16", "64")

    def cell(row: dict[str, str]) -> str:
        flux_mag, off_px = float(row["flux_rms_mag"]), float(row["axis_rms_px_fit"])
        return f"{flux_mag:.2g} mag, {off_px:.2g} px" if math.isfinite(flux_mag) else "may be dark"

    def name(panel: str) -> str:
        row = at[panel, "1"]
        return (
            f"{panel}, {float(row['mag_under_white']):g} mag under white:"
            f" {figure(float(row['steps']))} steps of light"
        )

    panels = dict.fromkeys(row["panel"] for row in rows)
    head = ["", *(f"{count} frames" if count != "1" else "1 frame" for count in frames)]
    return table(
        head, [[name(panel), *(cell(at[panel, count]) for count in frames)] for panel in panels]
    )


def colour_table() -> str:
    """Each choice before each tracker, by the codes."""
    head = [
        "tracker",
        "`colour`",
        "codes",
        "colour, mean",
        "flux, 95 %",
        "a channel, 95 %",
        "place, 95 %",
    ]
    body = []
    for row in rows_of("colour.csv"):
        words = [
            row["tracker"],
            f"`{row['colour']}`",
            f"`{row['method']}`",
            f"{figure(float(row['subtypes']))} subtypes",
        ]
        channel = "-" if row["tracker"].startswith("mono") else f"{float(row['channel']):.2g} %"
        body.append([*words, f"{float(row['mag']):.2g} mag", channel, f"{float(row['px']):.2g} px"])
    return table(head, body)


def gamut_table() -> str:
    """How many stars have their colour on each panel before each sensor, and what is left."""
    head = [
        "panel",
        "sensor",
        "condition number",
        "stars out of gamut",
        "colour off, mean",
        "`white`",
    ]
    body = []
    for row in rows_of("colour_gamut.csv"):
        out, off, white = (float(row[name]) for name in ("out_share", "subtypes", "subtypes_white"))
        names = [
            row["panel"],
            row["sensor"],
            f"{float(row['condition']):.1f}" if "Bayer" in row["sensor"] else "-",
        ]
        body.append(
            [
                *names,
                f"{100 * out:.2g} %",
                f"{off:.2g} subtypes" if off > 1e-4 else "none",
                f"{white:.0f}",
            ]
        )
    return table(head, body)


def class_table() -> str:
    """What a mono sensor's mixtures on an sRGB LCD lack, by spectral class."""
    at = {
        (row["sensor"], row["class"]): row
        for row in rows_of("colour_class.csv")
        if row["panel"] == "sRGB LCD"
    }
    classes = list(dict.fromkeys(kind for _, kind in at))

    def cell(row: dict[str, str]) -> str:
        off_nm, subtypes = float(row["off_nm"]), float(row["subtypes"])
        return f"{figure(off_nm)} nm, {subtypes:.2g}" if subtypes > 1e-3 else "none"

    sensors = dict.fromkeys(sensor for sensor, _ in at)
    return table(
        ["sensor", *classes],
        [[sensor, *(cell(at[sensor, kind]) for kind in classes)] for sensor in sensors],
    )


def red_table() -> str:
    """The share of each class's electrons that is light from 700 nm on."""
    rows = rows_of("colour_red.csv")
    return table(
        ["sensor", *list(rows[0])[1:]],
        [[row["sensor"], *(f"{100 * float(row[k]):.2g} %" for k in list(row)[1:])] for row in rows],
    )


def lateral_table() -> str:
    """Lateral colour that is shown, against the sky's own."""
    rows = rows_of("colour_lateral.csv")
    body = [
        [
            row["lens"],
            row["panel"],
            f"`{row['colour']}`",
            f"{float(row['sky_px']):.2g} px",
            f"{100 * float(row['off_share']):.0f} %",
        ]
        for row in rows
    ]
    return table(["lens", "panel", "`colour`", "the sky's own, rms", "off by, of that"], body)


def mosaic_table() -> str:
    """Places in a raw mosaic and in its superpixels."""
    rows = {
        (row["sigma_px"], row["temperature_k"], row["image"]): row
        for row in rows_of("colour_mosaic.csv")
    }
    temperatures = list(dict.fromkeys(key[1] for key in rows))

    def cell(*key: str) -> str:
        return f"{float(rows[key]['rms_px']):.2g} ({float(rows[key]['max_px']):.2g})"

    head = [
        "sigma",
        *(f"{float(k):.0f} K: {image}" for k in temperatures for image in ("mosaic", "superpixel")),
    ]
    body = [
        [
            f"{px} px",
            *(cell(px, k, image) for k in temperatures for image in ("mosaic", "superpixel")),
        ]
        for px in dict.fromkeys(key[0] for key in rows)
    ]
    return table(head, body)


def confronted_table() -> str:
    """What is left of each photograph of the set, and why others were refused."""
    head = [
        "camera, image",
        "stars to V = 6.5",
        "px rms",
        "mag rms",
        "background chi²",
        "unexplained",
        "held out, or why refused",
    ]
    body = []
    for row in rows_of("confronted.csv"):
        name = f"{row['camera']}, {row['image']}"
        if row["refused"]:
            body.append([name, *[""] * 5, f"refused: {row['refused'].split(';')[0]}"])
            continue
        figures = [f"{float(row[key]):.3f}" for key in ("rms_px", "rms_mag")]
        held = [float(row[f"held_out_{key}"]) for key in ("px", "mag")]
        out = "" if math.isnan(held[0]) else f"{held[0]:.3f} px, {held[1]:.3f} mag"
        body.append(
            [
                name,
                row["stars"],
                *figures,
                f"{float(row['background_chi2']):.2f}",
                row["unexplained"],
                out,
            ]
        )
    return table(head, body)


CERTIFIED = (
    ("flux", ("flux",)),
    ("places", ("place_along", "place_across")),
    ("attitude across", ("attitude_x", "attitude_y")),
    ("about the boresight", ("attitude_z",)),
    ("latency", ("latency",)),
)


def certify_table() -> str:
    """How often certificates' intervals held the truth of planted benches, by kind and figure:
    the mean over regions; blank where a kind does not move the figure.
    """
    rows = [row for row in rows_of("certify.csv") if row["held_percent"]]
    head, body = ["kind", "benches", *(name for name, _ in CERTIFIED)], []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        cells = [kind, of_kind[0]["benches"]]
        for _, quantities in CERTIFIED:
            members = [row for row in of_kind if row["quantity"] in quantities]
            if not members:
                cells.append("")
                continue
            held, low, high, ratio = (
                # its rounding is the same in every Python; that of sum is not
                fmean(float(row[key]) for row in members)
                for key in ("held_percent", "low_percent", "high_percent", "ratio")
            )
            cells.append(f"{held:.1f} % ({low:.0f} to {high:.0f}), {ratio:.2f}")
        body.append(cells)
    return table(head, body)


def intervals_table() -> str:
    """How often intervals of calibrations and assessments held the truth, by figure."""
    body = []
    for row in rows_of("intervals.csv"):
        if not row["kind"].startswith(CLAUSES):
            body.append([f"`{row['kind']}`", row["figure"], row["trials"], share_held(row)])
    return table(["by", "interval of", "trials", "held the truth"], body)


def clause_intervals_table() -> str:
    """How often the intervals of clauses held the truth, by quantity and what makes it hard."""
    shares: dict[str, dict[str, str]] = {}
    heads: dict[str, str] = {}
    for row in rows_of("intervals.csv"):
        if row["kind"].startswith(CLAUSES):
            kind = row["kind"].removeprefix(CLAUSES)
            heads[kind] = f"{kind} ({row['trials']} trials)"
            shares.setdefault(row["figure"], {})[kind] = share_held(row)
    body = []
    for quantity, by_kind in shares.items():
        body.append([f"`{quantity}`", *(by_kind.get(kind, "") for kind in heads)])
    return table(["quantity", *heads.values()], body)


def share_held(row: dict[str, str]) -> str:
    """The share of a row's intervals that held, with its interval."""
    held, low, high = (float(row[f"{name}_percent"]) for name in ("held", "low", "high"))
    return f"{held:.1f} % ({low:.0f} to {high:.0f})"


BESIDE = ("galsim", "astrometry", "lost", "basilisk", "pyxel", "satsim", "stellarium")


def beside_table(name: str) -> str:
    """What stands between hilstar and an independent program, cause by cause."""
    body = []
    subject = ""
    for row in rows_of(f"beside_{name}.csv"):
        first = row["subject"] if row["subject"] != subject else ""
        subject = row["subject"]
        size = two_digits(float(row["size"]))
        body.append([first, row["step"], f"{size} {UNIT_WORDS.get(row['unit'], row['unit'])}"])
    version = f"{row['program']} {row['version']}, {row['date']}"
    return table([version, "taken out, one after the other", "difference"], body)


UNIT_WORDS = {"relative": "of it"}


def rigs_table() -> str:
    """What is published of rigs, what is predicted of it, and what hilstar's codes would leave."""

    def cell(value: str, unit: str) -> str:
        size = float(value)
        return "" if math.isnan(size) else f"{size:.3g} {unit}"

    body = []
    for row in rows_of("rigs.csv"):
        unit = row["unit"].split()[0].rstrip(",")
        figures = [cell(row[name], unit) for name in ("published", "predicted", "difference")]
        body.append([row["rig"], row["figure"], *figures, cell(row["with_hilstar"], unit)])
    return table(
        ["rig", "figure", "published", "predicted", "difference", "hilstar's codes there"], body
    )


# of each end: 95 % in all
INTERVAL_CONFIDENCE = 0.975
BENCH_STEPS = {
    "focus": "focus: PSF sigma",
    "warm-up": "warm-up: drift",
    "geometry": "geometry: places, rms",
    "uniformity": "uniformity: light, rms",
    "photometry": "photometry: worst of 1e-1, 1e-2, 1e-3 of white",
    "black": "photometry: black level",
    "scale": "scale: light of white",
    "latency": "latency: the panel's delay",
}


def share_text(count: int, of: int) -> str:
    """A share in per cent with its 95 % interval (Clopper and Pearson 1934)."""
    low, high = clopper_pearson(count, of, INTERVAL_CONFIDENCE)
    return f"{100 * count / of:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def any_bench_table() -> str:
    """How benches by chance ended, the best first, and how many ended well."""
    rows = rows_of("any_bench.csv")
    outcomes = [row["outcome"] for row in rows]
    body = []
    for outcome in BENCH_OUTCOMES:
        count = outcomes.count(outcome)
        if count:
            body.append([outcome, str(count), share_text(count, len(rows))])
    good = sum(outcome in GOOD_BENCH_OUTCOMES for outcome in outcomes)
    body.append(["**calibrated, or refused for a reason**", str(good), share_text(good, len(rows))])
    return table(["outcome", f"of {len(rows)} benches", "share, 95 %"], body)


def any_bench_errors_table() -> str:
    """Each step's figure against the plant, in its own errors."""
    rows = rows_of("any_bench.csv")
    body = []
    for step, name in BENCH_STEPS.items():
        sigmas = [float(row[f"{step}_sigmas"]) for row in rows if row[f"{step}_sigmas"]]
        sizes = sorted(abs(value) for value in sigmas)
        rms = math.sqrt(sum(value**2 for value in sizes) / len(sizes))
        over = sum(value > MAX_BENCH_SIGMAS for value in sizes)
        body.append([name, str(len(sizes)), f"{rms:.2f}", f"{sizes[-1]:.1f}", str(over)])
    head = ["figure", "benches", "off by, rms of its errors", "largest", "over 4 errors"]
    return table(head, body)


def loop_table() -> str:
    """What the demo's tracker has planted, and what is found of it."""
    body = []
    for row in rows_of("loop.csv"):
        if row["run"] == "demo":
            unit = row["unit"]
            body.append([row["quantity"], f"{row['planted']} {unit}", f"{row['found']} {unit}"])
    return table(["", "planted", "found"], body)


def motion_table() -> str:
    """The virtual tracker's own error by motion."""
    body = []
    for row in rows_of("motion.csv"):
        rate_deg_s, scanout_ms = (float(row[name]) for name in ("rate_deg_s", "scanout_ms"))
        motion = f"{rate_deg_s:g} deg/s" if rate_deg_s else "at rest"
        lit = f"over {scanout_ms:.0f} ms" if scanout_ms else "at once"
        x, y, z, mean = (figure(float(row[f"{name}_arcsec"])) for name in ("x", "y", "z", "mean_z"))
        body.append([motion, lit, f"{x}, {y} arcsec", f"{z} arcsec", f"{mean} arcsec"])
    head = ["motion", "rows are lit", "one sigma across", "about the boresight", "mean about it"]
    return table(head, body)


TABLES = {
    "any_bench": any_bench_table,
    "any_bench_errors": any_bench_errors_table,
    **{f"beside_{name}": partial(beside_table, name) for name in BESIDE},
    "rigs": rigs_table,
    "answers": answers_table,
    "certify": certify_table,
    "intervals": intervals_table,
    "clause_intervals": clause_intervals_table,
    "colour": colour_table,
    "colour_gamut": gamut_table,
    "colour_red": red_table,
    "colour_class": class_table,
    "colour_lateral": lateral_table,
    "colour_mosaic": mosaic_table,
    "confronted": confronted_table,
    "over_frames": over_frames_table,
    "quantisation": quantisation_table,
    "centroiders": centroider_table,
    "bench": bench_table,
    "card": card_table,
    "kinds": kinds_table,
    "limits": limits_table,
    "tradeoff": tradeoff_table,
    "economy": economy_table,
    "timing": timing_table,
    "loop": loop_table,
    "motion": motion_table,
}


def with_tables(text: str) -> str:
    """`text` with each table between its marks `<!-- table: NAME -->` and `<!-- end -->`."""
    for name, make in TABLES.items():
        begin, end = f"<!-- table: {name} -->", "<!-- end -->"
        text = re.sub(
            rf"{begin}\n.*?{end}",
            lambda _, n=make, b=begin, e=end: f"{b}\n{n()}\n{e}",
            text,
            flags=re.DOTALL,
        )
    return text


def pages() -> list[Path]:
    """The files that may have tables: README and the pages of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


if __name__ == "__main__":
    for page in pages():
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
