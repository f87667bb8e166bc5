"""hilstar send: a log or a spin, sent as a simulator sends it."""

import math
import threading
import time
from collections.abc import Callable
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, NamedTuple

from hilstar.attitude.wire import protocol
from hilstar.basics.errors import InputError
from hilstar.basics.process.interrupts import is_command, stop_on_signal
from hilstar.basics.process.scheduling import PromptWhileLight
from hilstar.basics.units import NS_PER_S
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import (
    LOG_HELP,
    LogStatements,
    json_option,
    parse_share,
    parse_spin,
    seed_option,
)
from hilstar.cli.pointing import PlaceOptions, place_of
from hilstar.server.console.terminal import print_json, progress, say

ORION_DEG = (84.057, -1.2, 0.0)  # RA, Dec and roll where a spin begins
LISTEN_SLICE_S = 0.1  # between checks for a signal
USUAL_SPIN_HZ = 100.0
LINK_COUNTS = ("requests", "statuses")  # of the links that answer


def share_option() -> Any:
    """The option of a share of the packets."""
    return option(
        "[SHARE]",
        "Fraction of the packets, such as 5% or 0.05; 5% if no value follows.",
        default="0",
    )


def key_option() -> Any:
    """The option of a CURVE key."""
    return option("FILE", "From `hilstar keys`.")


@struct
class SendOptions:
    """The options of `hilstar send`."""

    log: Path | None = argument("[LOG]", LOG_HELP)
    spin: str | None = option("AXIS,DEG_PER_S", "A constant rotation instead of a log.")
    to: str = option(
        "TARGET",
        "tcp://HOST:PORT, udp://HOST:PORT or serial:/dev/ttyX@BAUD.",
        default="tcp://127.0.0.1:5560",
    )
    rate: float | None = option("HZ", "Packets per second; by default at the log's own times.")
    connect: bool = switch("Connect instead of binding, for a bench file with bind = true.")
    count: int | None = option("N", "Stop after this many packets.", min=1)
    duration: float | None = option("SECONDS", "Stop after this many seconds.", min=0)
    wait: float = option("SECONDS", "Seconds to wait for a listener.", default=30.0, min=0, max=1e6)
    sender: int = option(
        "N",
        "The sender's number, 1 to 254, by which hilstar tells it from another; 0: none.",
        default=0,
        min=0,
        max=protocol.MAX_SENDER,
    )
    lose: str = share_option()
    corrupt: str = share_option()
    reorder: str = share_option()
    jitter: float = option(
        "MS", "Delay each packet at random by up to this much.", default=0.0, min=0, max=1e6
    )
    seed: int = seed_option("Seed of the faults.")
    secret_key: Path | None = key_option()
    server_key: Path | None = key_option()
    allowed_clients: Path | None = option("DIR", "Directory of the public keys that may connect.")
    as_json: bool = json_option()


def send(options: SendOptions, pointing: PlaceOptions, statements: LogStatements) -> None:
    """Send a log or a constant rotation over ZeroMQ, UDP or a serial line, with the faults of a
    bad cable on request.
    """
    import numpy as np

    from hilstar.attitude.wire.keys import CurveKeys
    from hilstar.server.send_log import BadCable, Faults
    from hilstar.server.send_log import send as send_samples
    from hilstar.server.sender import open_sender

    lost = parse_share(options.lose, "--lose")
    corrupted = parse_share(options.corrupt, "--corrupt")
    reordered = parse_share(options.reorder, "--reorder")
    if lost + corrupted + reordered > 1:
        raise InputError(
            "send: --lose, --corrupt and --reorder add up to more than 100 %; write smaller"
            " fractions"
        )
    sent = wanted_samples(options, place_of("send", pointing), statements)
    samples = sent.samples
    if options.duration is not None:
        end_ns = options.duration * NS_PER_S
        samples = takewhile(lambda sample: sample.t_ns < end_ns, samples)
    total = min(sent.total, options.count or math.inf)
    faults = Faults(lost, corrupted, reordered, options.jitter / 1000)
    rng = np.random.default_rng(options.seed)
    stop = threading.Event()
    keys = CurveKeys(options.secret_key, options.server_key, options.allowed_clients)
    with open_sender(options.to, connect=options.connect, keys=keys) as link, stop_on_signal(stop):
        cable = BadCable(faults, rng, link.put)
        say(f"waiting for a listener on {link.endpoint}")
        with progress("waiting", options.wait) as waited:
            is_heard = heard(link.wait_for_listener, options.wait, stop, waited)
        if not is_heard:
            say("no listener yet; sending anyway")
        with progress("sending", total) as advance:
            send_samples(
                cable, islice(samples, options.count), stop, in_time(advance), options.sender
            )
    tell(cable.tally, link, options.as_json)


def in_time(advance: Callable[[int], None]) -> Callable[[int], None]:
    """`advance`, which also keeps this process prompt: the sender stands for another machine, which
    a display here does not delay.
    """
    if not is_command():
        return advance
    priority = PromptWhileLight()

    def advance_in_time(count: int) -> None:
        advance(count)
        priority.tend()

    return advance_in_time


class SentSamples(NamedTuple):
    """The samples to send, and their number; infinite where they end by a signal."""

    samples: Any
    total: float


def wanted_samples(
    options: SendOptions, place: tuple[float, float, float] | None, statements: LogStatements
) -> SentSamples:
    """The samples of a log or a spin. Raises InputError."""
    from hilstar.attitude.logs.log_file import open_log
    from hilstar.server.send_log import log_samples, spin_samples

    rate_hz = options.rate
    if options.log is None and options.spin is None and place is not None:
        raise InputError(
            "send: --radec and --star say where a --spin begins; add --spin AXIS,DEG_PER_S, such"
            " as --spin z,0 for an attitude at rest"
        )
    if (options.log is None) == (options.spin is None):
        raise InputError("send: give either a LOG or --spin AXIS,DEG_PER_S")
    if rate_hz is not None and not 1e-3 <= rate_hz <= 10_000:
        raise InputError(f"--rate {rate_hz:g}: write packets per second, 0.001 to 10000")
    if options.spin is not None:
        statements.refuse("it is for a LOG, and --spin sends none; leave it out")
        rate_rad_s = parse_spin(options.spin)
        spin = spin_samples(rate_rad_s, rate_hz or USUAL_SPIN_HZ, place or ORION_DEG)
        return SentSamples(spin, math.inf)
    if place is not None:
        say("--radec and --star say where a --spin begins; the log has attitudes of its own")
    log = open_log(options.log or Path(), statements.stated())
    for _, line in [*log.told, *log.joins().told]:
        say(line)
    # at another rate the log is sampled between its own times
    total = len(log.samples) if rate_hz is None else math.inf
    return SentSamples(log_samples(log.samples, rate_hz), total)


def tell(tally: Any, link: Any, as_json: bool) -> None:
    """Print what was sent and what was lost."""
    fields: dict[str, Any] = {
        "packets": tally.total,
        "sent": tally.total - tally.lost,
        "lost": tally.lost,
        "corrupted": tally.corrupted,
        "reordered": tally.reordered,
    }
    for name in LINK_COUNTS:
        if hasattr(link, name):
            fields[name] = getattr(link, name)
    fields["link"] = {"endpoint": link.endpoint} | link.link_counts.summary()
    if as_json:
        print_json(fields)
        return
    faults = []
    for name in ("lost", "corrupted", "reordered"):
        if fields.get(name):
            faults.append(f"{fields[name]} {name}")
    line = f"{fields['sent']} packets sent"
    if faults:
        line += f" ({', '.join(faults)})"
    say(line)
    if fields.get("statuses"):
        say(f"{fields['statuses']} statuses heard, {fields['requests']} time requests answered")


def heard(
    wait_for_listener: Callable[[float], bool],
    wait_s: float,
    stop: threading.Event,
    waited: Callable[[int], None],
) -> bool:
    """Whether a receiver listens within `wait_s`; True, too, once the sender is stopped, which then
    ends at once.
    """
    started_s = time.monotonic()
    deadline_s = started_s + wait_s
    while not stop.is_set():
        waited(round(time.monotonic() - started_s))
        if wait_for_listener(min(LISTEN_SLICE_S, max(0.0, deadline_s - time.monotonic()))):
            return True
        if time.monotonic() >= deadline_s:
            return False
    return True
