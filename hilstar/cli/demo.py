"""hilstar demo: the main job in one command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilstar.cli.options import MAX_SEED, Json
from hilstar.cli.running import Console, ConsoleName, Control, Token, followed, optional_ledger, page_listener, refuse_lost_gpu
from hilstar.console.run_status import RunSource, RunStatus
from hilstar.console.terminal import progress, report, say
from hilstar.files import check_directory
from hilstar.notices import Notices
from hilstar.process.interrupts import caught

if TYPE_CHECKING:
    from hilstar.bench.frame import Bench
    from hilstar.console.listener import PageListener
    from hilstar.run.pacer import FrameSink
    from hilstar.run.serve import Outlet

HZ = 60  # the demo bench's refresh


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Directory for the pictures.")] = Path("hilstar-demo"),
    duration: Annotated[float, typer.Option(help="Seconds to run.", min=0.5, max=600)] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of the slew's jitter.", min=0, max=MAX_SEED)] = 1,
    console: Console = None,
    control: Control = False,
    token: Token = None,
    console_name: ConsoleName = None,
    as_json: Json = False,
) -> None:
    """The main job in one command: real stars, an attitude streamed over a real ZeroMQ socket, frames out.

    Where frames show an old sky, because attitudes came too late, the last line says so and the exit code is 1.
    """
    import numpy as np

    from hilstar.run.demo import run_demo, write_pictures

    check_directory("-o", output)
    with page_listener(console, control, token, console_name) as listener, progress("serving", duration * HZ) as advance:

        def watching(bench: Bench, endpoint: str) -> AbstractContextManager[tuple[FrameSink, Outlet]]:
            return _watching(bench, endpoint, listener, control, lambda shown: advance(shown.number + 1))

        result = run_demo(output, duration, np.random.default_rng(seed), watching)
    if result.kept and caught() is None:  # no pictures after Ctrl-C
        if not as_json:
            say(f"writing {len(result.kept)} pictures and their previews to {output}")
        with progress("writing pictures", 2 * len(result.kept)) as advance:
            write_pictures(output, result, advance)
    report(result.summary, as_json)
    if not as_json:
        typer.echo(f"{'pictures':20}{output}/frame_*_codes.png (what the monitor gets), _preview.png (stretched)")
    if result.summary.stale_frames and caught() is None:
        line = (
            f"{result.summary.stale_frames} of {result.summary.frames} frames show an old sky: no attitude came in time; "
            "the machine is busy, so close other programs and run it again"
        )
        if as_json:
            say(f"hilstar: {line}")
        else:
            typer.echo(f"{'stale sky':20}{line}")
        raise typer.Exit(1)


@contextmanager
def _watching(
    bench: Bench, endpoint: str, listener: PageListener | None, control: bool, advance: FrameSink
) -> Iterator[tuple[FrameSink, Outlet]]:
    """Follow the demo with a progress bar and its page."""
    from hilstar.console.publisher import PageParts, RunDescription
    from hilstar.run.record.ledger import NO_SPLIT, Ledger
    from hilstar.run.serve import Outlet

    notices = Notices()
    status = RunStatus(RunSource(f"bound to {endpoint}", bench.renderer.gl_renderer, bench.config.monitor.refresh_hz))
    with optional_ledger(None, bench, notices, False, NO_SPLIT) as kept:
        parts = PageParts(bench, notices, kept, lambda path: Ledger(path, bench, notices))
        page = RunDescription("demo", bench.config.attitude.source, endpoint)
        with followed(listener, control, page, parts, status, advance) as (sink, follower, requests):
            yield sink, Outlet(None, kept, notices, follower=follower, requests=requests)
    refuse_lost_gpu(notices)
