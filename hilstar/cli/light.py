"""Commands about the monitor's light: budget, and calibrate photometric, plan, scale."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from hilstar.cli.common import MAX_SEED, BenchFile, Json, Overwrite, app, check_files
from hilstar.console.terminal import print_json, say
from hilstar.errors import InputError
from hilstar.files import CSV, PNG, TOML, check_directory, check_ending, make_directory

calibrate = typer.Typer(help="What light the monitor makes: measured, and scaled by the tracker.", no_args_is_help=False)
app.add_typer(calibrate, name="calibrate")

RESOLUTION_FORM = "--resolution W,H in pixels, such as 1920,1080"


@app.command()
def budget(
    bench_file: BenchFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="A chart and a table.")] = None,
    as_json: Json = False,
) -> None:
    """Which magnitudes this monitor, sprite and quantisation can show, and how well."""
    from hilstar.bench.build import load
    from hilstar.twin.budget import budget as find_budget
    from hilstar.twin.budget import budget_json, budget_lines, write_budget

    check_directory("-o", output)
    with load(bench_file) as bench:
        found = find_budget(bench)
    if output is not None:
        write_budget(make_directory(output), found)
    if as_json:
        print_json(budget_json(found))
    else:
        typer.echo("\n".join(budget_lines(found)))


@calibrate.command()
def photometric(
    measured: Annotated[Path, typer.Argument(metavar="MEASURED.csv", help="code,channel,value; see configs/CALIBRATION.md.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MONITOR.toml", help="The calibration file.")],
    bits: Annotated[int | None, typer.Option(help="Of a code; by the codes measured by default.", min=1, max=16)] = None,
    who: Annotated[str, typer.Option(help="Who measured.")] = "",
    when: Annotated[str, typer.Option(help="When; today by default.")] = "",
    instrument: Annotated[str, typer.Option(help="With what.")] = "",
    unit: Annotated[str, typer.Option(help="Of the values, such as cd/m2 or DN.")] = "",
    plot: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The response and its residuals.")] = None,
    as_json: Json = False,
) -> None:
    """Fit the monitor's response to measured patches."""
    from hilstar.calibrate.photometric import calibrate_photometric

    check_ending("-o", output, TOML)
    check_ending("--plot", plot, PNG)
    check_files([measured], [output, output.with_suffix(".csv"), plot])
    summary = calibrate_photometric(measured, output, bits=bits, who=who, when=when, instrument=instrument, unit=unit)
    if plot is not None:
        from hilstar.calibrate.response_chart import draw_calibration

        draw_calibration(measured, plot, bits)
        summary["written"].append(str(plot))
    if as_json:
        print_json(summary)
        return
    black, hold = summary["black_level"]["relative"], summary["holdout"]
    contrast = f"1 : {1 / black:.0f}" if black > 0 else "not to be told: no light at code 0"
    drift = "not known" if summary["drift_percent"] is None else f"{summary['drift_percent']:+.2f} %"
    typer.echo(f"{'measured':20}{summary['codes']} codes above black, {summary['bits']} bits; drift {drift}")
    typer.echo(f"{'black level':20}{black:.3e} of white, contrast {contrast}")
    typer.echo(f"{'noise':20}{100 * summary['noise_relative']:.2f} % of a reading")
    typer.echo(
        f"{'held-out levels':20}{hold['rms_percent']:.2f} / {hold['p95_percent']:.2f} / {hold['max_percent']:.2f} %"
        f" (rms / 95 % / max), {hold['max_mag']:.4f} mag at most"
    )
    typer.echo(f"{'written':20}{', '.join(summary['written'])}")
    typer.echo(f"{'in the bench file':20}[monitor] calibration = {json.dumps(output.name)}")


@calibrate.command()
def plan(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="PLAN.csv", help="To be filled in.")],
    bits: Annotated[int, typer.Option(help="Of a code.", min=1, max=16)] = 8,
    levels: Annotated[int, typer.Option(help="From black to white; half of white comes besides.", min=2)] = 32,
    repeats: Annotated[int, typer.Option(help="Of each level; 3 do for a plain power law.", min=1)] = 6,
    channels: Annotated[str, typer.Option(help="Of w, r, g, b.")] = "w",
    seed: Annotated[int, typer.Option(help="Of the order.", min=0, max=MAX_SEED)] = 0,
    headless: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the patches there as PNG.")] = None,
    resolution: Annotated[str, typer.Option(metavar="W,H", help="Of the pictures.")] = "1920,1080",
    show: Annotated[bool, typer.Option("--show", help="Show the patches on a display: space for the next, q to end.")] = False,
    display: Annotated[str, typer.Option(metavar="INDEX|NAME", help="With --show: which.")] = "0",
    seconds: Annotated[float | None, typer.Option(metavar="S", help="With --show: each so long, without keys.", min=0)] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Which codes to measure, in which order, and their patches."""
    from hilstar.calibrate.photometric import is_filled_in
    from hilstar.calibrate.photometric import plan as write_plan
    from hilstar.run.send.sender import parse_numbers

    check_ending("-o", output, CSV)
    check_directory("--headless", headless)
    check_files([], [], None, output if is_filled_in(output) else None, overwrite)
    width, height = (round(value) for value in parse_numbers(resolution, 2, "--resolution", RESOLUTION_FORM))
    if not (1 <= width <= 32768 and 1 <= height <= 32768):
        raise InputError(f"--resolution {resolution}: write {RESOLUTION_FORM}")
    summary = write_plan(
        bits,
        output,
        seed=seed,
        levels=levels,
        repeats=repeats,
        channels=channels,
        patches=headless,
        resolution_px=(width, height),
    )
    steps = summary.pop("steps")
    if as_json:
        print_json(summary)
    else:
        typer.echo(f"{summary['patches']} patches of {summary['codes']} codes in {', '.join(summary['written'])}")
        typer.echo("fill in the column value, and give the file to hilstar calibrate photometric")
    if show:
        from hilstar.calibrate.photometric import show_patches

        shown = show_patches(steps, bits, int(display) if display.isdecimal() else display, seconds)
        say(f"{shown} of {len(steps)} patches shown")
    elif headless is None:
        say("add --show for the patches on a display (space for the next one), or --headless DIR for pictures of them")


@calibrate.command()
def scale(
    bench_file: BenchFile,
    reading: Annotated[list[str], typer.Option(metavar="HIP,DN", help="A star, and the sum of its DN over background.")],
    exposure: Annotated[float | None, typer.Option(metavar="S", help="The tracker's; that of the bench by default.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.toml", help="A copy with the key set.")] = None,
    as_json: Json = False,
) -> None:
    """What one pixel at white is worth, by what the tracker reads of a star that is shown."""
    from hilstar.bench.build import load
    from hilstar.calibrate.scale import UNSURE_MAG, parse_reading, scale_by_tracker, with_flux_at_white

    check_ending("-o", output, TOML)
    check_files([], [output], bench_file)
    with load(bench_file) as bench:
        exposure_s = bench.config.tracker.exposure_s if exposure is None else exposure
        found = scale_by_tracker(bench, [parse_reading(text) for text in reading], exposure_s)
    if found.scatter_mag > UNSURE_MAG:
        say(f"the readings disagree by {found.scatter_mag:.3f} mag: look at background, saturation, and the response")
    if output is not None:
        with_flux_at_white(bench_file, found.flux_at_white_e_per_s, output)
    summary: dict[str, Any] = {
        "flux_at_white_e_per_s": found.flux_at_white_e_per_s,
        "assumed_e_per_s": found.assumed_e_per_s,
        "readings": len(reading),
        "scatter_mag": found.scatter_mag,
        "exposure_s": exposure_s,
        "written": None if output is None else str(output),
    }
    if as_json:
        print_json(summary)
        return
    typer.echo(f"# by {len(reading)} readings of {exposure_s:g} s, scatter {found.scatter_mag:.4f} mag; under [render]:")
    typer.echo(f"flux_at_white_e_per_s = {found.flux_at_white_e_per_s!r}")
