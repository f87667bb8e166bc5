"""hilstar serve of a file with `heads`: a process for each, beside one source."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import typer

from hilstar.console.terminal import say
from hilstar.errors import InputError
from hilstar.notices import Notices

if TYPE_CHECKING:
    from hilstar.attitude.wire.zmq_links import ZmqReceiver
    from hilstar.bench.bench_file import BenchFile, HeadsFile

NO_ATTITUDE = 4


@dataclass(frozen=True, slots=True)
class HeadsAsked:
    """The options of `serve` that hold for all heads; the page of head number k is at the port of `console` plus k."""

    duration_s: float | None
    frames: int | None
    ledger: Path | None
    ledger_split: str | None
    scenario: Path | None
    switches: dict[str, bool]
    console: str | None
    token: str | None

    def options(self) -> tuple[str, ...]:
        """The same as the command line of each head has them."""
        valued = {"--frames": self.frames, "--ledger-split": self.ledger_split, "--scenario": self.scenario}
        given = [word for name, value in valued.items() if value is not None for word in (name, str(value))]
        return (*given, *(name for name, on in self.switches.items() if on))


def serve_heads(heads: HeadsFile, asked: HeadsAsked, as_json: bool) -> None:
    """Show every head's stars up to its end, and print what each said; exit code 4 where none ever had an attitude."""
    from hilstar.run.heads import HeadsRun, head_ledger, run_heads, source_config
    from hilstar.run.open_link import open_link

    if asked.ledger is not None and not asked.switches.get("--overwrite"):
        taken = [file for name in heads.names if (file := head_ledger(asked.ledger, name)).exists()]
        if taken:
            raise InputError(f"--ledger {asked.ledger}: {taken[0]} exists; give another name, or --overwrite")
    notices = Notices()
    consoles = _consoles(asked, heads)
    with open_link(source_config(heads), heads.folder, notices, apart=True) as link:
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {len(heads.names)} heads: {', '.join(heads.names)}")
        assert not link.steps  # read_heads refuses lockstep
        run = HeadsRun(heads, asked.options(), asked.duration_s, asked.ledger, consoles, asked.token)
        told = run_heads(run, link, say)
    _report(told, as_json)
    codes = [head["exit_code"] for head in told.values()]
    if all(code == NO_ATTITUDE for code in codes):
        raise typer.Exit(NO_ATTITUDE)
    failed = [code for code in codes if code not in {0, NO_ATTITUDE}]
    if failed:
        raise typer.Exit(failed[0] if 0 < failed[0] <= NO_ATTITUDE else 1)


def _consoles(asked: HeadsAsked, heads: HeadsFile) -> tuple[str, ...]:
    """The address of each head's page. Raises InputError where one cannot be had, before a head is begun."""
    from hilstar.console.listener import MAX_PORT, ListenAddress, PageListener, parse_address

    if asked.console is None:
        return ()
    first, count = parse_address(asked.console), len(heads.names)
    if first.port and first.port + count - 1 > MAX_PORT:
        raise InputError(f"--console {asked.console}: {count} pages need as many ports from there; choose a lower one")
    addresses = [ListenAddress(first.host, first.port + k if first.port else 0) for k in range(count)]
    with ExitStack() as doors:
        for address in addresses:
            doors.enter_context(PageListener(address, asked.token))
    host = f"[{first.host}]" if ":" in first.host else first.host
    return tuple(f"{host}:{address.port}" for address in addresses)


def _report(told: dict[str, dict[str, object]], as_json: bool) -> None:
    if as_json:
        typer.echo(msgspec.json.encode({"heads": told}).decode())
        return
    for name, head in told.items():
        summary = head["summary"]
        frames = summary.get("frames") if isinstance(summary, dict) else None
        counted = "no summary" if frames is None else f"{frames} frames"
        again = f", started again {head['restarts']} times" if head["restarts"] else ""
        typer.echo(f"{name:20s}{counted}, exit code {head['exit_code']}{again}")


def fed_link(file: BenchFile, fed_by: str, notices: Notices) -> ZmqReceiver:
    """A head's link to the process that has the source, with which it ends; `fed_by` is its endpoint and its number."""
    from hilstar.attitude.wire.source import PACKETS, Mounting
    from hilstar.attitude.wire.zmq_links import FedDecoder, ZmqReceiver
    from hilstar.process.interrupts import end_with_parent

    endpoint, _, parent = fed_by.rpartition(",")
    end_with_parent(int(parent))
    conventions = replace(PACKETS, source="the source of several heads", of_body=True)
    decoder = FedDecoder(Mounting(file.config.tracker.q_body_to_cam), conventions)
    return ZmqReceiver(endpoint, notices=notices, decoder=decoder)
