"""hilstar calibrate plan: which patches to measure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import MAX_SEED, Json, Overwrite, check_files, parse_numbers
from hilstar.console.terminal import print_json, say
from hilstar.errors import InputError
from hilstar.files import CSV, check_directory, check_ending

RESOLUTION_FORM = "--resolution W,H in pixels, such as 1920,1080"


def plan(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="PLAN.csv", help="The plan, to be filled in.")],
    bits: Annotated[int, typer.Option(help="Bits per code.", min=1, max=16)] = 8,
    levels: Annotated[int, typer.Option(help="Levels from black to white; half of white is added.", min=2)] = 32,
    repeats: Annotated[int, typer.Option(help="Repeats of each level; 3 are enough for a plain power law.", min=1)] = 6,
    channels: Annotated[str, typer.Option(help="Channels to measure, of w, r, g, b.")] = "w",
    seed: Annotated[int, typer.Option(help="Seed of the order.", min=0, max=MAX_SEED)] = 0,
    headless: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the patches to this directory as PNG.")] = None,
    resolution: Annotated[str, typer.Option(metavar="W,H", help="Size of the pictures.")] = "1920,1080",
    show: Annotated[bool, typer.Option("--show", help="Show the patches on a display: space for the next, q to quit.")] = False,
    display: Annotated[str, typer.Option(metavar="INDEX|NAME", help="With --show: the display.")] = "0",
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="With --show: time for each patch, without keys.", min=0)
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Plan which codes to measure, in which order, and make their patches."""
    import numpy as np

    from hilstar.calibrate.plan import PlanSettings, is_filled_in, plan_patches, show_patches, write_patches, write_plan

    check_ending("-o", output, CSV)
    check_directory("--headless", headless)
    check_files([], [], None, output if is_filled_in(output) else None, overwrite)
    width, height = (round(value) for value in parse_numbers(resolution, 2, "--resolution", RESOLUTION_FORM))
    if not (1 <= width <= 32768 and 1 <= height <= 32768):
        raise InputError(f"--resolution {resolution}: write {RESOLUTION_FORM}")
    settings = PlanSettings(bits, levels, repeats, channels)
    planned = plan_patches(settings, np.random.default_rng(seed))
    write_plan(output, planned)
    written = [str(output)]
    if headless is not None:
        write_patches(headless, planned, (width, height), bits)
        written.append(str(headless))
    codes = len({patch.code for patch in planned})
    if as_json:
        print_json({"bits": bits, "patches": len(planned), "codes": codes, "seed": seed, "written": written})
    else:
        typer.echo(f"{len(planned)} patches of {codes} codes in {', '.join(written)}")
        typer.echo("fill in the column value, and give the file to hilstar calibrate photometric")
    if show:
        shown = show_patches(planned, bits, int(display) if display.isdecimal() else display, seconds)
        say(f"{shown} of {len(planned)} patches shown")
    elif headless is None:
        say("add --show for the patches on a display (space for the next one), or --headless DIR for pictures of them")
