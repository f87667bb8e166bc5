"""Commands about attitude streams: send, convert, keys."""

from __future__ import annotations

import math
import threading
import time
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hilstar.cli.common import LOG_HELP, MAX_SEED, Json, RadecText, app, check_files
from hilstar.console.terminal import print_json, progress, say
from hilstar.errors import InputError
from hilstar.files import check_directory
from hilstar.process.interrupts import stop_on_signal

LISTEN_SLICE_S = 0.1  # between looks at whether a signal has come
Share = Annotated[str, typer.Option(metavar="[SHARE]", help="Share of the packets, such as 5% or 0.05; alone: 5%.")]
KeyFile = Annotated[Path | None, typer.Option(metavar="FILE", help="Of `hilstar keys`.")]


@app.command()
def send(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG]", help=LOG_HELP)] = None,
    spin: Annotated[str | None, typer.Option(metavar="AXIS,DEG_PER_S", help="A constant turn instead of a log.")] = None,
    to: Annotated[
        str, typer.Option(metavar="TARGET", help="tcp://HOST:PORT, or serial:/dev/ttyX@BAUD.")
    ] = "tcp://127.0.0.1:5560",
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Packets a second; a log's own by default.")] = None,
    connect: Annotated[bool, typer.Option("--connect", help="Connect (for bind = true in the bench) instead of bind.")] = False,
    radec: RadecText = None,
    count: Annotated[int | None, typer.Option(help="Stop after so many packets.", min=1)] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Stop after so many seconds.", min=0)] = None,
    wait: Annotated[float, typer.Option(help="Seconds to wait for a listener.", min=0, max=1e6)] = 30.0,
    lose: Share = "0",
    corrupt: Share = "0",
    reorder: Share = "0",
    jitter: Annotated[float, typer.Option(metavar="MS", help="Each packet leaves up to so much late.", min=0, max=1e6)] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the faults.", min=0, max=MAX_SEED)] = 0,
    secret_key: KeyFile = None,
    server_key: KeyFile = None,
    allowed_clients: Annotated[Path | None, typer.Option(metavar="DIR", help="Public keys that may connect.")] = None,
    as_json: Json = False,
) -> None:
    """Send a log or a spin, over ZeroMQ or a serial line, with the faults of a bad cable on request: the test instrument."""
    from hilstar.attitude.wire.keys import CurveKeys
    from hilstar.run.send.faults import BadCable, Faults, parse_share
    from hilstar.run.send.sender import open_road
    from hilstar.run.send.sender import send as send_samples

    shares = (parse_share(lose, "--lose"), parse_share(corrupt, "--corrupt"), parse_share(reorder, "--reorder"))
    if sum(shares) > 1:
        raise InputError("send: --lose, --corrupt and --reorder come to more than all packets; write smaller shares")
    samples, total = wanted_samples(log, spin, rate, radec)
    if duration is not None:
        samples = until(samples, duration)
    stop = threading.Event()
    keys = CurveKeys(secret_key, server_key, allowed_clients)
    with open_road(to, connect=connect, keys=keys) as road, stop_on_signal(stop):
        cable = BadCable(Faults(*shares, jitter / 1000), np.random.default_rng(seed), road.put)
        say(f"waiting for a listener on {road.endpoint}")
        if not heard(road, wait, stop):
            say("nobody listens yet; sending all the same")
        with progress("sending", min(total, count or math.inf)) as advance:
            send_samples(cable, islice(samples, count), stop, advance)
    tell(cable.tally, road, as_json)


def wanted_samples(log: Path | None, spin: str | None, rate: float | None, radec: str | None) -> tuple[Any, float]:
    """The samples that `send` is asked for, and how many they are (infinite where nobody can say)."""
    from hilstar.attitude.logs.gaps import log_joins
    from hilstar.attitude.logs.log_file import read_log
    from hilstar.run.send.sender import log_samples, parse_radec, parse_spin, spin_samples

    if (log is None) == (spin is None):
        raise InputError("send: give a LOG or --spin AXIS,DEG_PER_S, one of them")
    if rate is not None and not 1e-3 <= rate <= 10_000:
        raise InputError(f"--rate {rate:g}: write packets a second, 0.001 to 10000")
    if spin is not None:
        return spin_samples(parse_spin(spin), rate or 100.0, parse_radec(radec or "84.057,-1.2,0")), math.inf
    recorded = read_log(log or Path())
    for _, line in log_joins(recorded).told:
        say(line)
    return log_samples(recorded, rate), len(recorded) if rate is None else math.inf


def until(samples: Any, duration_s: float) -> Any:
    """The samples of the first `duration_s`."""
    from itertools import takewhile

    return takewhile(lambda sample: sample.t_ns < duration_s * 1e9, samples)


def tell(tally: Any, road: Any, as_json: bool) -> None:
    """What left, and what did not."""
    told = {
        "packets": tally.total,
        "sent": tally.total - tally.lost,
        "lost": tally.lost,
        "corrupted": tally.corrupted,
        "reordered": tally.reordered,
    }
    for name in ("requests", "statuses", "unsent"):
        if hasattr(road, name):
            told[name] = getattr(road, name)
    told["link"] = {"endpoint": road.endpoint} | road.link_counts.summary()
    if as_json:
        print_json(told)
        return
    faults = ", ".join(f"{told[name]} {name}" for name in ("lost", "corrupted", "reordered", "unsent") if told.get(name))
    say(f"{told['sent']} packets sent" + (f" ({faults})" if faults else ""))
    if told.get("statuses"):
        say(f"{told['statuses']} statuses heard, {told['requests']} time requests answered")


@app.command()
def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help=LOG_HELP)],
    output: Annotated[Path, typer.Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
) -> None:
    """Write an attitude log in another form."""
    from hilstar.attitude.logs.log_file import read_log, write_log

    check_files([log], [output])
    samples = read_log(log)
    write_log(output, samples)
    typer.echo(f"{len(samples)} attitudes in {output}")


@app.command()
def keys(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where they go.")] = Path("hilstar-keys"),
) -> None:
    """Make CURVE keys for ZeroMQ beyond this machine."""
    from hilstar.attitude.wire.keys import make_keys

    check_directory("-o", output)
    for path in make_keys(output):
        typer.echo(str(path))
    say("the side that binds: server.key_secret and allowed_clients; the side that connects: client.key_secret and server.key")


def heard(sender: Any, wait_s: float, stop: threading.Event) -> bool:
    """True once somebody listens; also when stopped, which then ends the sending at once."""
    deadline_s = time.monotonic() + wait_s
    while not stop.is_set():
        if sender.wait_for_listener(min(LISTEN_SLICE_S, max(0.0, deadline_s - time.monotonic()))):
            return True
        if time.monotonic() >= deadline_s:
            return False
    return True
