"""hilstar send: a log or a spin, sent as a simulator sends it."""

import math
import threading
import time
from collections.abc import Callable
from itertools import islice, takewhile
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hilstar.attitude.wire import protocol
from hilstar.basics.errors import InputError
from hilstar.basics.process.interrupts import is_command, stop_on_signal
from hilstar.basics.process.scheduling import PromptWhileLight
from hilstar.basics.units import NS_PER_S
from hilstar.cli import options
from hilstar.cli.pointing import RadecText, StarText, place_of
from hilstar.server.console.terminal import print_json, progress, say

ORION_DEG = (84.057, -1.2, 0.0)  # RA, Dec and roll where a spin begins
LISTEN_SLICE_S = 0.1  # between checks for a signal
Share = Annotated[
    str,
    Option(
        metavar="[SHARE]",
        help="Fraction of the packets, such as 5% or 0.05; 5% if no value follows.",
    ),
]
KeyFile = Annotated[Path | None, Option(metavar="FILE", help="From `hilstar keys`.")]


@options.log_statements
def send(
    log: Annotated[Path | None, Argument(metavar="[LOG]", help=options.LOG_HELP)] = None,
    spin: Annotated[
        str | None, Option(metavar="AXIS,DEG_PER_S", help="A constant rotation instead of a log.")
    ] = None,
    to: Annotated[
        str,
        Option(metavar="TARGET", help="tcp://HOST:PORT, udp://HOST:PORT or serial:/dev/ttyX@BAUD."),
    ] = "tcp://127.0.0.1:5560",
    rate: Annotated[
        float | None,
        Option(metavar="HZ", help="Packets per second; by default at the log's own times."),
    ] = None,
    connect: Annotated[
        bool,
        Option("--connect", help="Connect instead of binding, for a bench file with bind = true."),
    ] = False,
    radec: RadecText = None,
    star: StarText = None,
    count: Annotated[
        int | None, Option(metavar="N", help="Stop after this many packets.", min=1)
    ] = None,
    duration: Annotated[
        float | None, Option(metavar="SECONDS", help="Stop after this many seconds.", min=0)
    ] = None,
    wait: Annotated[
        float, Option(metavar="SECONDS", help="Seconds to wait for a listener.", min=0, max=1e6)
    ] = 30.0,
    sender: Annotated[
        int,
        Option(
            metavar="N",
            help="The sender's number, 1 to 254, by which hilstar tells it from another; 0: none.",
            min=0,
            max=protocol.MAX_SENDER,
        ),
    ] = 0,
    lose: Share = "0",
    corrupt: Share = "0",
    reorder: Share = "0",
    jitter: Annotated[
        float,
        Option(
            metavar="MS", help="Delay each packet at random by up to this much.", min=0, max=1e6
        ),
    ] = 0.0,
    seed: Annotated[int, options.seed_option("Seed of the faults.")] = 0,
    secret_key: KeyFile = None,
    server_key: KeyFile = None,
    allowed_clients: Annotated[
        Path | None, Option(metavar="DIR", help="Directory of the public keys that may connect.")
    ] = None,
    statements: options.LogStatements = options.NOTHING_STATED,
    as_json: options.Json = False,
) -> None:
    """Send a log or a constant rotation over ZeroMQ, UDP or a serial line, with the faults of a
    bad cable on request.
    """
    import numpy as np

    from hilstar.attitude.wire.keys import CurveKeys
    from hilstar.server.send_log import BadCable, Faults
    from hilstar.server.send_log import send as send_samples
    from hilstar.server.sender import open_sender

    named = (("--lose", lose), ("--corrupt", corrupt), ("--reorder", reorder))
    lost, corrupted, reordered = (options.parse_share(text, option) for option, text in named)
    if lost + corrupted + reordered > 1:
        raise InputError(
            "send: --lose, --corrupt and --reorder add up to more than 100 %; write smaller"
            " fractions"
        )
    samples, total = wanted_samples(log, spin, rate, place_of("send", radec, star), statements)
    if duration is not None:
        samples = takewhile(lambda sample: sample.t_ns < duration * NS_PER_S, samples)
    stop = threading.Event()
    keys = CurveKeys(secret_key, server_key, allowed_clients)
    with open_sender(to, connect=connect, keys=keys) as link, stop_on_signal(stop):
        cable = BadCable(
            Faults(lost, corrupted, reordered, jitter / 1000), np.random.default_rng(seed), link.put
        )
        say(f"waiting for a listener on {link.endpoint}")
        with progress("waiting", wait) as waited:
            is_heard = heard(link, wait, stop, waited)
        if not is_heard:
            say("no listener yet; sending anyway")
        with progress("sending", min(total, count or math.inf)) as advance:
            send_samples(cable, islice(samples, count), stop, in_time(advance), sender)
    tell(cable.tally, link, as_json)


def in_time(advance: Callable[[int], None]) -> Callable[[int], None]:
    """`advance`, which keeps this process prompt, too: it stands for another machine, which no
    display here delays.
    """
    if not is_command():
        return advance
    priority = PromptWhileLight()

    def advance_in_time(count: int) -> None:
        advance(count)
        priority.tend()

    return advance_in_time


def wanted_samples(
    log: Path | None,
    spin: str | None,
    rate: float | None,
    place: tuple[float, float, float] | None,
    statements: options.LogStatements,
) -> tuple[Any, float]:
    """The samples to send, and their number (infinite if unknown)."""
    from hilstar.attitude.logs.log_file import open_log
    from hilstar.server.send_log import log_samples, spin_samples

    if log is None and spin is None and place is not None:
        raise InputError(
            "send: --radec and --star say where a --spin begins; add --spin AXIS,DEG_PER_S, such"
            " as --spin z,0 for an attitude at rest"
        )
    if (log is None) == (spin is None):
        raise InputError("send: give either a LOG or --spin AXIS,DEG_PER_S")
    if rate is not None and not 1e-3 <= rate <= 10_000:
        raise InputError(f"--rate {rate:g}: write packets per second, 0.001 to 10000")
    if spin is not None:
        statements.refuse("it is for a LOG, and --spin sends none; leave it out")
        return (
            spin_samples(
                options.parse_spin(spin),
                rate or 100.0,
                place or ORION_DEG,
            ),
            math.inf,
        )
    if place is not None:
        say("--radec and --star say where a --spin begins; the log has attitudes of its own")
    read = open_log(log or Path(), statements.stated())
    recorded = read.samples
    for _, line in [*read.told, *read.joins().told]:
        say(line)
    return log_samples(recorded, rate), len(recorded) if rate is None else math.inf


def tell(tally: Any, link: Any, as_json: bool) -> None:
    """Print what was sent and what was lost."""
    fields = {"packets": tally.total, "sent": tally.total - tally.lost}
    fields |= {name: getattr(tally, name) for name in ("lost", "corrupted", "reordered")}
    fields |= {
        name: getattr(link, name)
        for name in ("requests", "statuses", "unsent")
        if hasattr(link, name)
    }
    fields["link"] = {"endpoint": link.endpoint} | link.link_counts.summary()
    if as_json:
        print_json(fields)
        return
    faults = ", ".join(
        f"{fields[name]} {name}"
        for name in ("lost", "corrupted", "reordered", "unsent")
        if fields.get(name)
    )
    say(f"{fields['sent']} packets sent" + (f" ({faults})" if faults else ""))
    if fields.get("statuses"):
        say(f"{fields['statuses']} statuses heard, {fields['requests']} time requests answered")


def heard(sender: Any, wait_s: float, stop: threading.Event, waited: Callable[[int], None]) -> bool:
    """True once a receiver listens, and when stopped, which then ends the sending at once."""
    started_s = time.monotonic()
    deadline_s = started_s + wait_s
    while not stop.is_set():
        waited(round(time.monotonic() - started_s))
        if sender.wait_for_listener(min(LISTEN_SLICE_S, max(0.0, deadline_s - time.monotonic()))):
            return True
        if time.monotonic() >= deadline_s:
            return False
    return True
