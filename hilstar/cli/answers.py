"""hilstar answers: what a star tracker says, decoded and explained."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.cli import options
from hilstar.cli.pointing import QuaternionText, RadecText, StarText, optional_attitude
from hilstar.server.console.terminal import print_json, say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hilstar.basics.arrays import FloatArray
    from hilstar.server.answers.answer import Answer
    from hilstar.server.answers.formats import AnswerDecoder, RefusedAnswer
    from hilstar.server.answers.reader import ReadPlan
    from hilstar.server.bench.bench_file import BenchFile

SHOWN_WITHIN_S, PAGE_WITHIN_S = 2.0, 0.5
MAX_STATE_BYTES = 1_000_000
MAX_ROWS = 100_000  # the newest, in the JSON object


def answers(
    bench: options.BenchFile,
    recorded: Annotated[
        Path | None,
        Option(
            "--from",
            metavar="FILE",
            help="Bytes recorded from the tracker's line; by default the live link.",
        ),
    ] = None,
    explain: Annotated[
        bool,
        Option(
            "--explain",
            help="Show which bytes became which field, and each answer under every convention.",
        ),
    ] = False,
    radec: RadecText = None,
    star: StarText = None,
    quaternion: QuaternionText = None,
    duration: Annotated[
        float | None,
        Option(
            "--duration",
            metavar="SECONDS",
            help="Seconds to run; by default until Ctrl-C.",
            min=0.1,
            max=1e7,
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
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

    file = read_bench_file(bench)
    if file.config.answers is None:
        raise InputError(
            f'{bench}: has no [answers]; write the table, with source = "serial" or the like'
        )
    epoch_jyear = file.config.sky.epoch_jyear
    shown = optional_attitude("answers", radec, star, quaternion, epoch_jyear)
    plan = ReadPlan(file.config.answers, file.folder, file.config.tracker.q_body_to_cam)
    counts: Counter[str] = Counter()
    if shown is None and explain and recorded is None:
        shown = _shown_now(file)
    if recorded is None:
        decoder, answer_stream = _live(plan, duration)
    else:
        decoder = plan.decoder(messages=False)
        answer_stream = recorded_answers(plan, decoder, recorded)
    rows: deque[dict[str, Any]] = deque(maxlen=MAX_ROWS)
    for answer in answer_stream:
        if isinstance(answer, RefusedAnswer):
            counts[answer.reason] += 1
            row, line = (
                {"refused": answer.reason, "detail": answer.detail},
                f"refused ({answer.reason}): {answer.detail}",
            )
        else:
            counts["answers"] += 1
            counts["valid"] += answer.valid
            row, line = _row(answer), _line(answer)
        if as_json:
            rows.append(row | {"raw": answer.raw.hex()})
            continue
        for text in [line, *(lines_of(answer, decoder, shown) if explain else ())]:
            if text:
                typer.echo(text)
    if as_json:
        print_json({"answers": list(rows), "counts": dict(counts)})
    else:
        refused = ", ".join(
            f"{count} {reason}"
            for reason, count in counts.items()
            if reason not in {"answers", "valid"}
        )
        say(
            f"{counts['answers']} answers, {counts['valid']} valid"
            + (f"; refused: {refused}" if refused else "")
        )


def _shown_now(file: "BenchFile") -> "FloatArray | None":
    """What a run's page on this machine shows, or what the sender of the attitude says now.

    None without a page, where that road has room for one listener only or nobody sends.
    """
    from hilstar.server.open_link import first_attitude, open_link

    settings = file.config.attitude
    if (shown := _shown_by_page()) is not None:
        return shown
    if settings.source != "zmq" or settings.bind is True or settings.lockstep:
        return None
    try:
        with open_link(file.config, file.folder) as link:
            if link.steps:
                return None
            return first_attitude(link, SHOWN_WITHIN_S).q_icrs_to_cam
    except InputError:
        say(f"{settings.address}: no attitude comes; give what is shown by --radec RA,DEC,ROLL")
        return None


def _shown_by_page() -> "FloatArray | None":
    """The attitude of the newest frame of the run whose page is at the usual address; None where
    there is none.
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
    import threading

    from hilstar.basics.notices import Notices
    from hilstar.basics.process.interrupts import stop_on_signal
    from hilstar.server.answers.reader import live_answers

    link = plan.open_first(Notices())
    decoder = plan.decoder(link.messages)
    stop = threading.Event()
    say(f"listening at {link.endpoint}; Ctrl-C ends it")

    def found() -> "Iterator[Answer | RefusedAnswer]":
        with link, stop_on_signal(stop):
            yield from live_answers(
                plan, link, decoder, math.inf if seconds is None else seconds, stop.is_set
            )

    return decoder, found()


def _row(found: "Answer") -> dict[str, Any]:
    names = ("t_ns", "q_icrs_to_cam", "rate_cam_rad_s", "valid", "mode", "rms_arcsec", "centroids")
    return {name: getattr(found, name) for name in names} | {"stars": found.star_count}


def _line(found: "Answer") -> str:
    from hilstar.basics.rotation import to_radec_roll_deg, turn_text

    parts = [f"t {'-' if found.t_ns is None else f'{found.t_ns / 1e9:.6f}'} s"]
    if found.q_icrs_to_cam is not None:
        ra_deg, dec_deg, roll_deg = to_radec_roll_deg(found.q_icrs_to_cam)
        parts.append("q " + " ".join(f"{part:+.7f}" for part in found.q_icrs_to_cam))
        parts.append(f"RA {turn_text(ra_deg)} Dec {dec_deg:+.4f} roll {turn_text(roll_deg)}")
    parts += [] if found.valid else ["not valid"]
    parts += [found.mode] if found.mode else []
    parts += [] if found.star_count is None else [f"{found.star_count} stars"]
    return ", ".join(parts)
