"""Writes the report of a run from its ledger: the operator's page as one HTML file that contains
the run's data, and the figures as JSON.
"""

import base64
import hashlib
import math
import re
import zlib
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.attitude.logs.mcap_log import NO_END, unfinished_part
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, MachineError, printable
from hilstar.basics.files import make_directory, write_whole
from hilstar.basics.notices import Notices
from hilstar.basics.palette import palette_css
from hilstar.basics.units import NS_PER_S
from hilstar.basics.version import __version__
from hilstar.optics.layers.fault_kinds import Freeze
from hilstar.server.bench.bench_file import BenchFile, bench_file_of, with_codes_ms
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import Bench
from hilstar.server.console.overlay import Overlay, catalogue_sky, overlay_of
from hilstar.server.faults import read_recording
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger_records import EventRecord, codes_ms_of, config_of, wrong_in_frame
from hilstar.server.record.run_figures import (
    COUNTS,
    METRICS,
    RunFigures,
    RunReport,
    figures_of,
    summarise,
    table_rows,
)
from hilstar.server.replay import played_again, replay
from hilstar.server.serve import Outlet

PAGE_DIR = Path(__file__).resolve().parent / "page"
_import = re.compile(r'^import \{ ([^}]+) \} from "\./(\w+)\.js";\n', re.MULTILINE)
_export = re.compile(r"^export (?=(?:class|const|function) (\w+))", re.MULTILINE)
LINKS = re.compile(
    r'^<(?:link rel="(?:icon|stylesheet)"|script type="module"|script src=).*\n', re.MULTILINE
)
UPLOT, UPLOT_STYLE = "uplot.min.js", "uplot.min.css"  # of npm's uplot 1.6.32, as published
MAX_BYTES = 3_000_000  # all pictures together, packed
NO_BENCH = "the ledger's head has no bench file"
CAUTION = (
    "Drawn by a bench that is not the run's own: a file that it names has changed since, or another"
    " version of hilstar wrote the ledger. Codes may differ from those shown."
)
NO_VALUES = "- / - / -"  # the beginning of a row of percentiles without values
BINS = 60
# A histogram ends at this percentile and at 100 minus it; the worst value is in the table.
HISTOGRAM_SPREAD = 99.9
MIN_RANGE_MS, NARROWEST = 1e-3, 1e-9  # smallest range of a histogram, in ms and relative
MS_DIGITS, S_DIGITS, Q_DIGITS, ANGLE_DIGITS = 3, 3, 8, 6
MAX_WHO_CHARACTERS = 60
IN_ARCSEC_DEG = 0.2  # a smaller motion is drawn in arcsec
# Near a pole right ascension and roll mean nothing: at larger declinations turns about the camera's
# axes are drawn instead.
POLE_DEG = 88.0
NAMES = ("RA \N{MULTIPLICATION SIGN} cos Dec", "Dec", "roll")
AXES = ("about x (right)", "about y (down)", "about z (boresight)")
DISTRIBUTIONS = {
    "interval": "Interval between swaps",
    "late": "Swap later than predicted",
    "draw": "Start of drawing to swap",
    "age": "Age of the attitude at light",
    "prediction": "Predicted past the last packet",
    "packet": "Packet received to swap",
}


def one_script(entry: str, folder: Path = PAGE_DIR) -> str:
    """The JavaScript module `entry` and all that it imports, as one script.

    If the page is a file, a browser loads no module from another file, so that each module becomes
    a function here. Imports and exports have to begin a line and to be by name, without a default
    export. Raises ValueError for any other form.
    """
    done: dict[str, str] = {}
    _take(entry, folder, done)
    return "".join(done.values())


def _take(name: str, folder: Path, done: dict[str, str]) -> None:
    """Add a module as a function to `done`, after the modules that it imports."""
    text = (folder / f"{name}.js").read_text(encoding="utf-8")
    wanted = _import.findall(text)
    for _, other in wanted:
        if other not in done:
            _take(other, folder, done)
    body = _import.sub("", text)
    names = _export.findall(text)
    body = _export.sub("", body)
    if re.search(r"^(?:import|export)\b", body, re.MULTILINE):
        raise ValueError(
            f"{name}.js: an import or export that is not in one line with names in braces"
        )
    takes = "".join(
        f"const {{ {', '.join(part.replace(' as ', ': ').split(', '))} }} = of_{other};\n"
        for part, other in wanted
    )
    done[name] = (
        f"const of_{name} = (() => {{\n{takes}{body}return {{ {', '.join(names)} }};\n}})();\n"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def report_page(data: dict[str, Any]) -> str:
    """The HTML of a report with a run's data (see `run_data`, `run_pictures`); it needs no other
    file and no network.
    """
    html, uplot, uplot_style, page_style = (
        (PAGE_DIR / name).read_text(encoding="utf-8")
        for name in ("index.html", UPLOT, UPLOT_STYLE, "page.css")
    )
    style = palette_css() + uplot_style + page_style
    script = one_script("report")
    policy = (
        f"default-src 'none'; script-src {_hash(uplot)} {_hash(script)}; style-src {_hash(style)};"
        " img-src data:; base-uri 'none'; form-action 'none'"
    )
    icon = base64.b64encode((PAGE_DIR / "icon.svg").read_bytes()).decode()
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f'<link rel="icon" href="data:image/svg+xml;base64,{icon}">\n<style>{style}</style>\n'
    )
    packed = base64.b64encode(zlib.compress(msgspec.json.encode(data), 9)).decode()
    tail = (
        f'<script type="text/plain" id="run-data">{packed}</script>\n<script>{uplot}</script>\n'
        f'<script type="module">{script}</script>\n'
    )
    html = LINKS.sub("", html).replace('data-mode="live"', 'data-mode="report"')
    # The data come before the script that reads them, and both after the page's own elements.
    return html.replace("</head>", f"{head}</head>").replace("</body>", f"{tail}</body>")


class _Unreported(Notices):
    """Drops all notices: events of the redrawing are not events of the run."""

    def tell(self, kind: str, detail: str, who: str = "", since_ns: int | None = None) -> None:
        """Drop the notice."""


def run_pictures(run: RunFigures, ledger: Path) -> dict[str, Any]:
    """Redraw the run's key frames: a dictionary with `pictures`, the map of the `sky`, and a
    `caution` where the bench has changed since the run. Without a usable bench `pictures` is empty,
    and `no_pictures` says why.
    """
    try:
        file = with_codes_ms(_bench_file(run.head, ledger), codes_ms_of(run.head))
        with open_bench(file) as bench:
            overlay = overlay_of(bench)
            return {
                "pictures": _pictures(bench, overlay, run, ledger),
                "caution": "" if file.sha256 == run.head.get("bench_sha256") else CAUTION,
                "sky": overlay.sky(),
                "white_level": len(bench.calibration.response.light) - 1,
            }
    except (InputError, MachineError) as error:
        return {"pictures": [], "no_pictures": str(error), "sky": catalogue_sky()}


def _bench_file(head: dict[str, str], ledger: Path) -> BenchFile:
    """The bench file of a run: the text in the ledger's head, and the files that it names, beside
    the original file or beside the ledger; the place where they are unchanged goes first.

    Raises InputError where the head has no bench file, or one that cannot be read.
    """
    text = head.get("bench_text")
    named = Path(head.get("bench_file", "bench.toml"))
    if not text:
        raise InputError(NO_BENCH)
    files = [bench_file_of(path, text) for path in (named, ledger.parent / named.name)]
    return next((file for file in files if file.sha256 == head.get("bench_sha256")), files[0])


def _pictures(
    bench: Bench, overlay: Overlay, run: RunFigures, ledger: Path
) -> list[dict[str, Any]]:
    recording = read_recording(ledger, run.faults)
    frames = run.keyframes.chosen(run.last)
    # Frames of a frozen sky are left out: they showed the picture of an earlier frame.
    frozen = {number for number, fault in recording.faults.items() if isinstance(fault, Freeze)}
    chosen = [
        (record, why)
        for record, why in frames
        if not (frozen & set(record.faults) or wrong_in_frame(record))
    ]
    pictures: list[dict[str, Any]] = []

    def take(shown: Shown) -> None:
        record, why = chosen[len(pictures)]
        picture = _picture(overlay, shown)
        t_s = (record.swap_ns - run.first_swap_ns) / NS_PER_S
        told = {"why": why, "operator": record.operator, "stale": record.stale}
        pictures.append(picture | told | {"t_s": round(t_s, 3)})

    if chosen:
        play = played_again(
            lambda: (record for record, _ in chosen), len(chosen), 0, False, recording
        )
        replay(bench, play, take, Outlet(notices=_Unreported()))
    # Every second picture is dropped until the rest fits into MAX_BYTES.
    while len(pictures) > 1 and sum(len(picture["data"]) for picture in pictures) > MAX_BYTES:
        pictures = pictures[::2]
    return pictures


def _picture(overlay: Overlay, shown: Shown) -> dict[str, Any]:
    shown_levels = shown.drawn.levels
    if shown_levels.ndim == 2:
        levels = shown_levels
    else:
        levels = shown_levels.max(axis=2)
    attitude = shown.attitude
    if attitude is None:
        truth = None
    else:
        truth = overlay.truth(shown.number, attitude.q_icrs_to_cam, shown.drawn.clipped_hip)
    wide = levels.dtype.itemsize == 2
    data = np.ascontiguousarray(levels, dtype="<u2" if wide else "u1").tobytes()
    return {
        "frame": shown.number,
        "w": levels.shape[1],
        "h": levels.shape[0],
        "dtype": "u2" if wide else "u1",
        "data": base64.b64encode(zlib.compress(data, 9)).decode(),
        "truth": truth,
    }


def run_data(name: str, run: RunFigures, summary: RunReport) -> dict[str, Any]:
    """The data of a run for the report's page, ready for JSON: lists of numbers, None for a missing
    value; times in s after the first swap. `name` is the ledger's name.
    """
    config = config_of(run.head)
    rows = table_rows(summary)
    monitor = None if config is None else config.monitor
    about = {
        "run": name,
        "bench": run.head.get("bench_file", ""),
        "version": __version__,
        "started_utc": _utc(run, run.first_swap_ns),
        "refresh_hz": None if monitor is None else monitor.refresh_hz,
        "resolution_px": None if monitor is None else monitor.resolution_px,
        "bits": None if monitor is None else monitor.bits,
    }
    with np.errstate(all="ignore"):  # impossible numbers of a foreign file become None
        return {
            "about": about,
            "verdict": verdict(summary, run.counted["late"]),
            "summary": [row for row in rows[:-3] if not row[1].startswith(NO_VALUES)],
            "facts": rows[-3:],
            "bench_text": run.head.get("bench_text", ""),
            "duration_s": summary.duration_s,
            "spans": _spans(run),
            "packets": _packets(run),
            "process": _process(run),
            "motion": _motion(run.path.rows),
            "path": _path(run.path.rows),
            "histograms": _histograms(run),
            "stride": run.samples.stride,
            "answers": _answers(run, summary),
            "refused": {
                reason: count for reason, count in summary.packets.items() if reason != "accepted"
            },
            "events": [_event(event, run) for event in (*run.first_events, *run.last_events)],
            "events_total": sum(run.events.values()),
        }


def verdict(found: RunReport, late: int) -> dict[str, Any]:
    """The verdict on a run, a dictionary: `ok`, whether the sky was right throughout; the `share`
    of refresh periods in which it was; a `headline`; and the `reasons` for the others.

    `late` counts stale frames with an attitude. The result's "late" says that the only fault is
    missed frames: what was shown was the right sky.
    """
    counted = (
        (found.blank_frames, "without an attitude"),
        (late, "with a stale attitude"),
        (found.hidden_frames, "not seen on the screen"),
        (found.operator_frames, "changed by the operator"),
        (found.wrong_frames, "of a wrong sky"),
    )
    reasons = [f"{number} of {found.frames} frames {what}" for number, what in counted if number]
    if found.missed_frames:
        reasons.append(f"{found.missed_frames} refresh periods without a frame of their own")
    reasons += [
        f"{condition.seconds:.1f} s of {condition.kind}: {condition.text}"
        for condition in found.wrong_sky.conditions
        if condition.seconds
    ]
    due = found.frames + found.missed_frames  # refresh periods in which a frame was due
    only_late = len(reasons) == 1 and found.missed_frames > 0
    if not reasons:
        headline = "Sky was right throughout"
    elif only_late:
        headline = f"{100 * found.missed_frames / due:.2g} % of frames missed"
    else:
        headline = "Sky was not right throughout"
    percent = 100 * found.right_frames / max(due, 1)
    if percent > 99.9:
        digits = 3
    elif percent > 99:
        digits = 2
    else:
        digits = 1
    # Rounded down, so that only a run without a fault has 100 %.
    share = f"{math.floor(percent * 10**digits) / 10**digits:.{digits}f} %"
    told = {"ok": not reasons, "late": only_late, "headline": headline}
    return told | {"share": share, "reasons": reasons}


def _utc(run: RunFigures, host_ns: int) -> str | None:
    try:
        unix_ns = int(run.head["unix_ns"]) + host_ns - int(run.head["monotonic_ns"])
        return (
            datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=unix_ns // 1000)
        ).isoformat(timespec="milliseconds")
    except (KeyError, ValueError, OverflowError):
        return None


def _numbers(values: FloatArray, digits: int) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in np.round(values, digits).tolist()]


def _spans(run: RunFigures) -> dict[str, Any]:
    span_columns: dict[str, Any] = {
        "t_s": _numbers(run.spans.begin, S_DIGITS),
        "frames": run.spans.length,
    }
    for number, name in enumerate((*METRICS, *COUNTS)):
        low, high, total = run.spans.column(number)
        if name in {"missed", "stale", "blank"}:
            span_columns[name] = _numbers(total, 0)
        else:
            span_columns[name] = [_numbers(low, MS_DIGITS), _numbers(high, MS_DIGITS)]
    return span_columns


def _packets(run: RunFigures) -> dict[str, Any]:
    begin_s, rates_hz = run.packet_times.rates_hz(run.first_swap_ns)
    accepted, refused = (_numbers(rates_hz[:, kind], MS_DIGITS) for kind in range(2))
    width_s = run.packet_times.width_ns / NS_PER_S
    if len(begin_s) and begin_s[-1] + width_s > run.duration_s:
        accepted[-1] = None  # the run ended within this bin: its rate would be too low
    return {
        "t_s": _numbers(begin_s, S_DIGITS),
        "width_s": width_s,
        "accepted_hz": accepted,
        "refused_hz": refused,
    }


def _process(run: RunFigures) -> dict[str, Any]:
    host_s, resident_mb, cpu_s = run.process.rows.T
    t_s = host_s - run.first_swap_ns / NS_PER_S
    step_s = np.diff(host_s, prepend=np.nan)
    share = np.where(step_s > 0, 100 * np.diff(cpu_s, prepend=np.nan) / step_s, np.nan)
    return {
        "t_s": _numbers(t_s, S_DIGITS),
        "resident_mb": _numbers(resident_mb, 2),
        "cpu_percent": _numbers(share, 1),
    }


def _histograms(run: RunFigures) -> list[dict[str, Any]]:
    histograms = []
    for name, title in DISTRIBUTIONS.items():
        values = run.samples.rows[:, list(METRICS).index(name)]
        values = values[np.isfinite(values)]
        if not len(values):
            continue
        low, high = np.percentile(values, [100 - HISTOGRAM_SPREAD, HISTOGRAM_SPREAD])
        narrowest = max(MIN_RANGE_MS, NARROWEST * max(abs(low), abs(high)))
        counts, edges = np.histogram(values, BINS, (low, max(high, low + narrowest)))
        ends = {"from_ms": float(edges[0]), "to_ms": float(edges[-1])}
        histograms.append({"name": name, "title": title, "counts": counts.tolist()} | ends)
    return histograms


def _answers(run: RunFigures, summary: RunReport) -> dict[str, Any] | None:
    """The data of the tracker's answers: residuals along the run, times of wrong answers, the
    number of faults that are on, and the effect of each fault; None for a run without answers.
    """
    if not summary.answers:
        return None
    faults = summary.answers.faults
    spans_s = [(fault.start_s, fault.end_s) for fault in faults]
    on_s, on = faults_on(spans_s, summary.duration_s)
    residuals = residuals_along(run.residuals.rows, run.answers.wrong_ns, run.first_swap_ns)
    return residuals | {"on_s": on_s, "on": on, "faults": faults}


def residuals_along(rows: FloatArray, wrong_ns: Sequence[int], begin_ns: int) -> dict[str, Any]:
    """Residuals (n, 4), host time, s, and x, y, z, arcsec, and the host times of wrong answers as
    the page has them: from the begin of the run on.
    """
    zero_s = begin_ns / NS_PER_S
    return {
        "t_s": _numbers(rows[:, 0] - zero_s, S_DIGITS),
        "xyz_arcsec": [_numbers(axis, MS_DIGITS) for axis in rows[:, 1:].T],
        "wrong_s": [round(at_ns / NS_PER_S - zero_s, S_DIGITS) for at_ns in wrong_ns],
    }


def faults_on(
    spans_s: Sequence[tuple[float, float | None]], duration_s: float
) -> tuple[list[float], list[int]]:
    """When the number of faults that are on changes, s, and that number from then on; a fault
    without an end is on until the run's.
    """
    edges = []
    for start_s, end_s in spans_s:
        edges += [(start_s, 1), (end_s or duration_s, -1)]
    edges.sort()
    steps = [step for _, step in edges]
    return [at_s for at_s, _ in edges], np.cumsum(steps, dtype=int).tolist()


def _event(record: EventRecord, run: RunFigures) -> dict[str, Any]:
    t_s = (record.host_ns - run.first_swap_ns) / NS_PER_S
    if record.who and record.who not in record.detail:
        who = f" ({record.who[:MAX_WHO_CHARACTERS]})"
    else:
        who = ""
    return {
        "t_s": round(t_s, S_DIGITS),
        "utc": _utc(run, record.host_ns),
        "kind": record.kind[:40],
        "line": record.detail + who,
    }


def _path(rows: FloatArray) -> dict[str, Any]:
    turned_deg = np.degrees(rows[:, 6:9])
    rate = np.diff(turned_deg, axis=0, append=np.nan) / np.diff(rows[:, 1], append=np.nan)[:, None]
    return {
        "t_s": _numbers(rows[:, 0], S_DIGITS),
        "q": np.round(rows[:, 2:6], Q_DIGITS).tolist(),
        "rate_deg_s": [_numbers(axis, 4) for axis in rate.T],
    }


def _motion(rows: FloatArray) -> dict[str, Any] | None:
    """The curves of the run's motion: three angles minus their means, and the turns about the
    camera's axes minus a steady motion; None without attitudes. `rows` are those of RunFigures'
    `path`.
    """
    if not len(rows):
        return None
    turned_rad = rows[:, 6:9]
    at = rows[:, 1] - rows[:, 1].mean()
    angles, names = _angles(rows[:, 2:6], turned_rad)
    about = _curves(angles - angles.mean(axis=0), names)
    # A line is fitted to each turn over the attitude's time.
    spread = float((at * at).sum())
    if spread > 0:
        slope = (at @ turned_rad) / spread
    else:
        slope = np.zeros(3)
    beside = np.degrees(turned_rad - turned_rad.mean(axis=0) - at[:, None] * slope)
    return {
        "t_s": _numbers(rows[:, 0], S_DIGITS),
        "about_mean": about,
        "beside_steady": _curves(beside, AXES),
    }


def _curves(angles_deg: FloatArray, names: tuple[str, str, str]) -> dict[str, Any]:
    """The data of three curves, angles (n, 3), deg, by name; in arcsec if they are small."""
    in_arcsec = float(np.ptp(angles_deg, axis=0).max()) < IN_ARCSEC_DEG
    scaled = angles_deg * (3600 if in_arcsec else 1)
    return {
        "unit": "arcsec" if in_arcsec else "\N{DEGREE SIGN}",
        "curves": {
            name: _numbers(values, ANGLE_DIGITS)
            for name, values in zip(names, scaled.T, strict=True)
        },
    }


def _angles(q: FloatArray, turned_rad: FloatArray) -> tuple[FloatArray, tuple[str, str, str]]:
    """Three angles of the camera's motion, deg (n, 3), and their names, from q_icrs_to_cam (n, 4):
    RA times cos Dec, Dec and roll, or, near a pole, the turns `turned_rad` (n, 3).
    """
    # The formulae of `rotation.to_radec_roll_deg`, for arrays.
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    boresight = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    dec_deg = np.degrees(np.arctan2(boresight[2], np.hypot(boresight[0], boresight[1])))
    if np.abs(dec_deg).max() > POLE_DEG:
        return np.degrees(turned_rad), AXES
    ra = np.arctan2(boresight[1], boresight[0])
    right = (1 - 2 * (y * y + z * z)), 2 * (x * y - w * z)
    down = 2 * (x * y + w * z), (1 - 2 * (x * x + z * z))
    east = tuple(-np.sin(ra) * axis[0] + np.cos(ra) * axis[1] for axis in (right, down))
    ra_deg, roll_deg = (np.degrees(np.unwrap(part)) for part in (ra, np.arctan2(east[1], -east[0])))
    return (
        np.column_stack(
            ((ra_deg - ra_deg.mean()) * np.cos(np.radians(dec_deg)), dec_deg, roll_deg)
        ),
        NAMES,
    )


def report(path: Path, directory: Path) -> RunReport:
    """Write `report.html` and `report.json` of the ledger `path` into a directory, and return the
    figures.

    Raises InputError for a file that is no ledger, and if a file cannot be written.
    """
    run = figures_of(path)
    summary = summarise(run)
    data = run_data(printable(path.name), run, summary) | run_pictures(run, path)
    unfinished = unfinished_part(path)
    if unfinished is not None:
        data["facts"].insert(0, ("no end", f"{printable(unfinished.name)} {NO_END}"))
    page = report_page(data)
    make_directory(directory)
    write_whole(directory / "report.html", page.encode(errors="replace"))
    write_whole(directory / "report.json", msgspec.json.format(msgspec.json.encode(summary)))
    return summary
