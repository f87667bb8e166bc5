"""hilstar demo: the main job in one command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import MAX_SEED, Json
from hilstar.console.terminal import progress, report
from hilstar.files import check_directory


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Directory for the pictures.")] = Path("hilstar-demo"),
    duration: Annotated[float, typer.Option(help="Seconds to run.", min=0.5, max=600)] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of the slew's jitter.", min=0, max=MAX_SEED)] = 1,
    as_json: Json = False,
) -> None:
    """The main job in one command: real stars, an attitude streamed over a real ZeroMQ socket, frames out."""
    import numpy as np

    from hilstar.run.demo import run_demo

    check_directory("-o", output)
    with progress("serving", duration * 60) as advance:
        result = run_demo(output, duration, np.random.default_rng(seed), lambda shown: advance(shown.number + 1))
    report(result.summary, as_json)
    if not as_json:
        typer.echo(f"{'pictures':20}{output}/frame_*_codes.png (what the monitor gets), _preview.png (stretched)")
