"""What serve, replay, first-light and demo share: the options of the operator's page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from hilstar.console.run_status import RunStatus
from hilstar.console.terminal import say
from hilstar.errors import InputError
from hilstar.process.programs import Service

if TYPE_CHECKING:
    from hilstar.bench.fault_desk import FaultDesk
    from hilstar.console.listener import PageListener
    from hilstar.console.publisher import FramePublisher, PageParts, RunDescription
    from hilstar.run.faults import AnyFaults
    from hilstar.run.operator import SwitchRequests
    from hilstar.run.serve import Follower, Running
    from hilstar.run.shown import FrameSink, Shown

Console = Annotated[
    str | None,
    typer.Option(
        "--console",
        metavar="[HOST:PORT]",
        help="Serve the operator's page there, by default on 127.0.0.1:8765; port 0 is any free one.",
        show_default=False,
    ),
]
Control = Annotated[bool, typer.Option("--control", help="Let the page act: without it, it only shows.")]
Token = Annotated[
    str | None,
    typer.Option(
        "--token",
        metavar="TEXT",
        envvar="HILSTAR_TOKEN",
        help="What a browser must give to see the page; beyond 127.0.0.1 one is made where none is given.",
    ),
]
ConsoleName = Annotated[
    list[str] | None,
    typer.Option("--console-name", metavar="NAME", help="A further name of the page, as a proxy shows it; may be given often."),
]


def fault_desk(faults: AnyFaults | None) -> FaultDesk | None:
    """Where faults are asked for; None for a run that has none, or those of an earlier run."""
    return getattr(faults, "desk", None)


@contextmanager
def page_listener(
    console: str | None, control: bool, token: str | None, names: list[str] | None
) -> Iterator[PageListener | None]:
    """The page's socket, which listens from here on; None without --console. Raises InputError."""
    from hilstar.console.listener import PageListener, parse_address

    if console is None:
        for option, given in (("--control", control), ("--console-name", bool(names))):
            if given:
                raise InputError(f"{option}: is the page's; add --console, or leave it out")
        yield None
        return
    with PageListener(parse_address(console), token, tuple(names or ())) as listener:
        say(f"the operator's page is at {listener.url}")
        yield listener


@contextmanager
def followed(
    listener: PageListener | None,
    control: bool,
    description: RunDescription,
    parts: PageParts,
    status: RunStatus,
    record: FrameSink | None = None,
) -> Iterator[tuple[FrameSink, Follower, SwitchRequests | None]]:
    """Connect a run to the terminal, `record`, systemd and the page: its sink, its follower, and the page's requests."""
    sinks: list[FrameSink] = [status.see] if record is None else [record, status.see]
    with Service(status.begun, status.alive, status.line):
        if listener is None:
            yield _all_of(sinks), status.follow, None
            return
        with _page(listener, control, description, parts, status) as (feed, follow, requests):
            yield _all_of([*sinks, feed.see]), follow, requests


@contextmanager
def _page(
    listener: PageListener, control: bool, description: RunDescription, parts: PageParts, status: RunStatus
) -> Iterator[tuple[FramePublisher, Follower, SwitchRequests]]:
    from hilstar.console.publisher import opened_page

    with opened_page(listener, control, description, parts) as (feed, requests):

        def follow(running: Running) -> None:
            status.follow(running)
            feed.follow(running)

        yield feed, follow, requests


def _all_of(sinks: list[FrameSink]) -> FrameSink:
    if len(sinks) == 1:
        return sinks[0]

    def sink(shown: Shown) -> None:
        for one in sinks:
            one(shown)

    return sink
