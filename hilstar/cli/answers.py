"""hilstar answers: what a star tracker says, decoded and explained."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import bench_argument, json_option
from hilstar.cli.pointing import PointingOptions, optional_attitude
from hilstar.server.console.terminal import print_json, say

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterator

    from hilstar.basics.arrays import FloatArray
    from hilstar.server.answers.answer import Answer
    from hilstar.server.answers.formats import AnswerDecoder, RefusedAnswer
    from hilstar.server.answers.reader import ReadPlan
    from hilstar.server.bench.bench_file import BenchFile

# how long a sender, and a page on this machine, may take to say what is shown
SHOWN_WITHIN_S, PAGE_WITHIN_S = 2.0, 0.5
MAX_STATE_BYTES = 1_000_000  # of a page's state; another program at its port may say more
MAX_ROWS = 100_000  # the newest, in the JSON object
WITHOUT_WIDTH = 4  # figures of a star whose width is not known
ROW_KEYS = ("t_ns", "q_icrs_to_cam", "rate_cam_rad_s", "valid", "mode", "rms_arcsec", "centroids")


@struct
class AnswersOptions:
    """The options of `hilstar answers`."""

    bench: Path = bench_argument()
    recorded: Path | None = option(
        "FILE", "Bytes recorded from the tracker's line; by default the live link.", "--from"
    )
    explain: bool = switch(
        "Show which bytes became which field, and each answer under every convention."
    )
    duration: float | None = option(
        "SECONDS", "Seconds to run; by default until Ctrl-C.", min=0.1, max=1e7
    )
    as_json: bool = json_option()


def answers(options: AnswersOptions, pointing: PointingOptions) -> None:
    """Decode a tracker's answers by `[answers]`, live or recorded: each as a line, and why bytes
    were refused.

    With --explain each answer is compared with what is shown: --radec, --star or --quaternion, or
    else the newest frame of a run with --console, or what the sender of [attitude] says now, where
    that is a ZeroMQ stream.
    """
    from collections import Counter, deque

    from hilstar.server.answers.explain import lines_of
    from hilstar.server.answers.formats import RefusedAnswer
    from hilstar.server.answers.reader import ReadPlan, recorded_answers
    from hilstar.server.bench.bench_file import read_bench_file

    file = read_bench_file(options.bench)
    if file.config.answers is None:
        raise InputError(
            f'{file.path}: has no [answers]; write the table, with source = "serial" or the like'
        )
    epoch_jyear = file.config.sky.epoch_jyear
    shown = optional_attitude("answers", pointing, epoch_jyear)
    plan = ReadPlan(file.config.answers, file.folder, file.config.tracker.q_body_to_cam)
    counts: Counter[str] = Counter()
    if shown is None and options.explain and options.recorded is None:
        shown = _shown_now(file)
    if options.recorded is None:
        decoder, answer_stream = _live(plan, options.duration)
    else:
        decoder = plan.decoder(messages=False)
        answer_stream = recorded_answers(plan, decoder, options.recorded)
    rows: deque[dict[str, Any]] = deque(maxlen=MAX_ROWS)
    for answer in answer_stream:
        if isinstance(answer, RefusedAnswer):
            counts[answer.reason] += 1
            row: dict[str, Any] = {"refused": answer.reason, "detail": answer.detail}
            line = f"refused ({answer.reason}): {answer.detail}"
        else:
            counts["answers"] += 1
            counts["valid"] += answer.valid
            row = _row(answer)
            line = _line(answer)
        if options.as_json:
            rows.append(row | {"raw": answer.raw.hex()})
            continue
        typer.echo(line)
        if options.explain:
            for text in filter(None, lines_of(answer, decoder, shown)):
                typer.echo(text)
    if options.as_json:
        print_json({"answers": list(rows), "counts": dict(counts)})
    else:
        say(_counts_line(counts))


def _counts_line(counts: "Counter[str]") -> str:
    """How many answers came, and how many were refused for which reason."""
    line = f"{counts['answers']} answers, {counts['valid']} valid"
    refusals = []
    for reason, count in counts.items():
        if reason not in {"answers", "valid"}:
            refusals.append(f"{count} {reason}")
    if refusals:
        line += f"; refused: {', '.join(refusals)}"
    return line


def _shown_now(file: "BenchFile") -> "FloatArray | None":
    """The attitude that is shown now, q_icrs_to_cam (4,): by a run's page on this machine, else by
    the sender of [attitude].

    None without a page where the sender has room for one listener only, or sends nothing.
    """
    from hilstar.server.open_link import first_attitude, open_link

    settings = file.config.attitude
    shown = _shown_by_page()
    if shown is not None:
        return shown
    if settings.source != "zmq" or settings.bind is True or settings.lockstep:
        return None
    try:
        with open_link(file.config, file.folder) as link:
            assert not link.steps  # nobody waits for a frame of it
            return first_attitude(link, SHOWN_WITHIN_S).q_icrs_to_cam
    except InputError:
        say(f"{settings.address}: no attitude comes; give what is shown by --radec RA,DEC,ROLL")
        return None


def _shown_by_page() -> "FloatArray | None":
    """The attitude of the newest frame, q_icrs_to_cam (4,), by the page at the usual address; None
    where there is no page.
    """
    import http.client

    import msgspec
    import numpy as np

    from hilstar.basics.reading import NOT_JSON
    from hilstar.server.console.listener import HOST, PORT
    from hilstar.server.console.protocol import ShownAttitude

    try:
        connection = http.client.HTTPConnection(HOST, PORT, timeout=PAGE_WITHIN_S)
        connection.request("GET", "/state")
        state = msgspec.json.decode(connection.getresponse().read(MAX_STATE_BYTES))
        connection.close()
        shown = msgspec.convert(state["state"]["attitude"], ShownAttitude)
    except (OSError, http.client.HTTPException, *NOT_JSON, LookupError, TypeError):
        return None  # no run, one without an attitude, or another program
    say(
        f"what is shown: RA {shown.ra_deg:.4f}, Dec {shown.dec_deg:.4f}, by the page at"
        f" {HOST}:{PORT}"
    )
    return np.array(shown.q)


def _live(
    plan: "ReadPlan", seconds: float | None
) -> "tuple[AnswerDecoder, Iterator[Answer | RefusedAnswer]]":
    """The decoder of the tracker's line and its answers, for `seconds` or until a signal."""
    import threading

    from hilstar.basics.notices import Notices
    from hilstar.basics.process.interrupts import stop_on_signal
    from hilstar.server.answers.reader import live_answers

    link = plan.open_first(Notices())
    decoder = plan.decoder(link.messages)
    stop = threading.Event()
    say(f"listening at {link.endpoint}; Ctrl-C ends it")

    limit_s = math.inf if seconds is None else seconds

    def answers_until_then() -> "Iterator[Answer | RefusedAnswer]":
        with link, stop_on_signal(stop):
            yield from live_answers(plan, link, decoder, limit_s, stop.is_set)

    return decoder, answers_until_then()


def _row(answer: "Answer") -> dict[str, Any]:
    """An answer by the keys of --json."""
    row = {name: getattr(answer, name) for name in ROW_KEYS}
    row["stars"] = answer.star_count
    row["centroids"] = [
        star[:WITHOUT_WIDTH] if star.width_px is None else star for star in answer.centroids
    ]
    return row


def _line(answer: "Answer") -> str:
    """An answer as a line of text."""
    from hilstar.basics.rotation import to_radec_roll_deg, turn_text

    time_text = "-"
    if answer.t_ns is not None:
        time_text = f"{answer.t_ns / NS_PER_S:.6f}"
    parts = [f"t {time_text} s"]
    if answer.q_icrs_to_cam is not None:
        ra_deg, dec_deg, roll_deg = to_radec_roll_deg(answer.q_icrs_to_cam)
        components = [f"{component:+.7f}" for component in answer.q_icrs_to_cam]
        parts.append(f"q {' '.join(components)}")
        parts.append(f"RA {turn_text(ra_deg)} Dec {dec_deg:+.4f} roll {turn_text(roll_deg)}")
    if not answer.valid:
        parts.append("not valid")
    if answer.mode:
        parts.append(answer.mode)
    if answer.star_count is not None:
        parts.append(f"{answer.star_count} stars")
    return ", ".join(parts)
