"""Prints the output of commands: lines of text, a JSON object, the summary of a run, a progress
bar, or a refusal.
"""

import json
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

import msgspec
import typer
from msgspec import UNSET

from hilstar.basics.errors import one_line
from hilstar.basics.process.interrupts import finish_stderr

if TYPE_CHECKING:
    from hilstar.attitude.clock.sender_clock import ClockSummary
    from hilstar.attitude.wire.packet import Reason
    from hilstar.basics.running_statistics import Percentiles
    from hilstar.server.summary import PacketSummary, RunSummary

INSTEAD: "dict[Reason, str]" = {
    "format": "send packets of 64 bytes, version 1, little-endian, or JSON with t_ns and q",
    "crc": (
        "end each packet with the CRC-32 of zlib over the 60 bytes before it, and look at the cable"
    ),
    "nan": "send finite numbers",
    "norm": "send unit quaternions, scalar first, not angles",
    "rate": "send rates in rad/s, or write a larger [attitude] max_rate_deg_s",
    "time": "let t_ns rise from packet to packet",
    "source": "stop one of the two senders",
}
STATE_WIDTH = 8
STATE_STYLES = {
    "ok": "green",
    "none": "dim",
    "check": "yellow",
    "MISSING": "bold red",
    "CHANGED": "bold red",
}
NAME_STYLE = "bold cyan"  # as options in --help
# TERM of a terminal that only adds lines; rich draws nothing in place there
UNABLE_TERMINALS = ("dumb", "unknown")
BUSY_AFTER_S = 1.0  # a command that ends sooner shows no spinner
BUSY_THREAD = "hilstar-busy"
ERASED_WITHIN_S = 0.5
CLOCK_WORDS = {"one-way": "from arrivals", "exchange": "from time exchanges"}


def say(line: str) -> None:
    """Print a line on stderr, for the person at the terminal."""
    typer.echo(line, err=True)


def print_json(value: Any) -> None:
    """Print the JSON object of --json on stdout; NumPy numbers and arrays become plain ones."""
    try:
        typer.echo(msgspec.json.encode(value, enc_hook=_plain).decode())
    except UnicodeEncodeError:
        # The name of a file may not be UTF-8: Python's `json` writes such bytes as escapes.
        typer.echo(json.dumps(msgspec.to_builtins(value, enc_hook=_plain)))


def print_found(as_json: bool, found: Any, lines: Iterable[str]) -> None:
    """Print the result of a command on stdout: the object `found` (dictionary, dataclass or struct)
    as JSON, or `lines` of text.
    """
    if as_json:
        print_json(found)
    else:
        for line in lines:
            typer.echo(line)


def print_states(lines: Iterable[str]) -> None:
    """Print lines that begin with a state and a name, in columns of 8 and 12 characters; in colour
    on a terminal, unless NO_COLOR is set.
    """
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):
        for line in lines:
            typer.echo(line)
        return
    from rich.console import Console
    from rich.text import Text

    console = Console()
    for line in lines:
        text = Text(line)
        state = line[:STATE_WIDTH].strip()
        if state:
            text.stylize(STATE_STYLES.get(state, ""), 0, STATE_WIDTH)
            name = line[STATE_WIDTH:].split(" ")[0]
            text.stylize(NAME_STYLE, STATE_WIDTH, STATE_WIDTH + len(name))
        console.print(text, soft_wrap=True)


def _plain(value: Any) -> Any:
    import numpy as np  # takes 0.1 s, and is not needed for Tab and --help

    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def report(summary: "RunSummary", as_json: bool) -> None:
    """Print the summary of a run on stdout, as JSON or as lines of text."""
    if as_json:
        print_json(summary)
        return

    def figure(value: float | None, digits: int = 2) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    def spread(times: "Percentiles") -> str:
        return " / ".join(figure(value) for value in (times.p50, times.p99, times.max))

    packets = summary.packets
    stars = summary.stars_drawn
    clipped = summary.clipped
    clipped_names = [*clipped.bodies]
    clipped_names += [f"HIP {hip}" for hip in clipped.hip]
    refused = ", ".join(
        f"{reason} {count}" for reason, count in packets.refused_by.items() if count
    )
    flooded = summary.link["flooded"] if summary.link else 0
    turned_away = (f" ({refused})" if refused else "") + (
        f"; {flooded} more passed over unread" if flooded else ""
    )
    lost = f", {packets.lost} lost" if packets.lost else ""
    lines = {
        "frames": (
            f"{summary.frames} in {summary.duration_s:.2f} s ({figure(summary.fps, 1)} fps)"
            f", {summary.missed_frames} missed, {summary.stale_frames} stale"
        ),
        "frame time": (
            f"{spread(summary.frame_ms)} ms (p50 / p99 / max), attitude in to codes ready"
        ),
        "attitude age": f"{spread(summary.attitude_age_ms)} ms (p50 / p99 / max) at render",
        "stars drawn": (
            f"{figure(stars.mean, 0)} mean, {stars.max} max, {clipped.max} clipped"
            + "".join(f" {name}" for name in clipped_names[:5])
        ),
        "packets": f"{packets.received} received, {packets.refused} refused{turned_away}{lost}",
    }
    if summary.clock:
        # Imports NumPy, which is not needed for Tab and --help.
        from hilstar.attitude.clock.sender_clock import KNOWN_MODES

        if summary.clock.mode in KNOWN_MODES:
            absolute = ""
        else:
            absolute = " above the minimum"
        if summary.receive_latency_ms:
            lines["receive latency"] = (
                f"{spread(summary.receive_latency_ms)} ms (p50 / p99 / max){absolute}"
            )
        lines["sender's clock"] = clock_line(summary.clock)
    if summary.sync:
        lines["pulses"] = summary.sync.line()
    for name, line in [*lines.items(), *_last_lines(summary)]:
        typer.echo(f"{name:20}{line}")


def _last_lines(summary: "RunSummary") -> Iterator[tuple[str, str]]:
    """The last lines of a summary, (name, text): what was wrong with the sky and for how long, the
    renderer, and the verdict.
    """
    for name, what in (
        ("operator", "changed by an operator's keys"),
        ("hidden", "not fully visible"),
        ("gamma", "under another program's gamma ramp"),
    ):
        lasted = (summary.screen or {}).get(name, {"frames": 0})
        if lasted["frames"]:
            yield name, f"{lasted['frames']} frames, {lasted['s']:.1f} s, {what}"
    for condition in summary.wrong_sky.conditions:
        yield condition.kind, f"{condition.seconds:.1f} s: {condition.text}"
    yield "renderer", summary.gl_renderer
    if summary.verdict:
        yield "verdict", summary.verdict.line


def without_attitude(endpoint: str, packets: "PacketSummary", trouble: str = "") -> str:
    """A line that says why a run got no attitude, and what to change. `trouble` is the fault that
    the link reports, "" for none.
    """
    if not packets.received:
        advice = trouble.removeprefix(f"{endpoint}: ") or "start the sender, and check its address"
        return f"no attitude came from {endpoint}; {advice}"
    reasons = [(count, reason) for reason, count in packets.refused_by.items() if count]
    if packets.shown is UNSET:
        shown = INSTEAD
    else:
        shown = {**INSTEAD, **packets.shown}
    reasons_text = "; ".join(
        f"{count} for {reason}: {shown[reason]}" for count, reason in sorted(reasons, reverse=True)
    )
    return f"all {packets.refused} packets from {endpoint} were refused, {reasons_text}"


def clock_line(clock: "ClockSummary") -> str:
    """A line on the sender's clock relative to this machine's: how they are compared, the drift and
    the uncertainty.
    """
    if clock.mode == "none":
        return "no attitude has arrived"
    if clock.mode == "shared":
        return "shared with the sender"
    if clock.mode == "unix":
        return (
            f"Unix time, kept to {clock.uncertainty_ms or 0.0:.3f} ms by this machine's kernel, and"
            " the sender's own error"
        )
    if clock.uncertainty_ms is None:
        return f"{CLOCK_WORDS[clock.mode]}: heard too briefly to state an uncertainty"
    known = f"drift {clock.drift_ppm:.1f} ppm, uncertainty {clock.uncertainty_ms:.3f} ms"
    if clock.mode == "one-way":
        known += ", excluding the minimum transport delay"
    jumps = f", jumps: {clock.jumps}" if clock.jumps else ""
    return f"{CLOCK_WORDS[clock.mode]}: {known}{jumps}"


def erases_lines() -> bool:
    """Whether stderr is a terminal that can erase a line."""
    if sys.stderr is None or not sys.stderr.isatty():
        return False
    return os.environ.get("TERM", "").lower() not in UNABLE_TERMINALS


@contextmanager
def progress(what: str, total: float) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on stderr during the `with` block, if stderr is a terminal. Call the
    function that it gives with the number of steps done, of `total` (infinite: not known).
    """
    if not erases_lines():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    # Without redirection, or rich would send to stderr what is printed on stdout meanwhile.
    with Progress(
        *columns, console=console, transient=True, refresh_per_second=4, redirect_stdout=False
    ) as bar:
        task = bar.add_task(what, total=None if math.isinf(total) else total)
        yield lambda done: bar.update(task, completed=done)
    finish_stderr(ERASED_WITHIN_S)


@contextmanager
def busy(what: str, after_s: float = BUSY_AFTER_S) -> Iterator[None]:
    """Show the elapsed time of a computation of unknown length on stderr during the `with` block,
    once it has taken `after_s`, if stderr is a terminal.
    """
    if not erases_lines():
        yield
        return
    ended = threading.Event()
    shower = threading.Thread(
        target=_show_busy, args=(what, after_s, ended), name=BUSY_THREAD, daemon=True
    )
    shower.start()
    try:
        yield
    finally:
        ended.set()
        shower.join()
        # A thread writes stderr: without this wait, text on stdout would come before the line is
        # erased.
        finish_stderr(ERASED_WITHIN_S)


def _show_busy(what: str, after_s: float, ended: threading.Event) -> None:
    if ended.wait(after_s):
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn("line"), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, refresh_per_second=4, redirect_stdout=False
    ) as bar:
        bar.add_task(what, total=None)
        ended.wait()


def fail(line: str, code: int) -> NoReturn:
    """Print one line on stderr and exit with `code`."""
    print("hilstar: " + one_line(line), file=sys.stderr)
    sys.exit(code)
