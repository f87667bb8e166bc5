"""hilstar calibrate scale: what white is worth, by what the tracker reads of a star."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hilstar.cli.options import BenchFile, Json, check_files, parse_reading
from hilstar.console.terminal import print_json, say
from hilstar.files import TOML, check_ending


def scale(
    bench_file: BenchFile,
    reading: Annotated[list[str], typer.Option(metavar="HIP,DN", help="A star, and the sum of its DN above the background.")],
    exposure: Annotated[
        float | None, typer.Option(metavar="S", help="The tracker's exposure; by default the bench file's.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.toml", help="A copy of the bench file with the key set.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Scale the light by the tracker: what one pixel at white is worth, from its readings of stars shown."""
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.bench.build import open_bench
    from hilstar.calibrate.scale import UNSURE_MAG, scale_by_tracker, with_flux_at_white

    check_ending("-o", output, TOML)
    file = read_bench_file(bench_file)
    check_files([], [output], file)
    with open_bench(file) as bench:
        exposure_s = bench.config.tracker.exposure_s if exposure is None else exposure
        found = scale_by_tracker(bench, [parse_reading(text) for text in reading], exposure_s)
    if found.scatter_mag > UNSURE_MAG:
        say(f"the readings disagree by {found.scatter_mag:.3f} mag: look at background, saturation, and the response")
    if output is not None:
        with_flux_at_white(file, found.flux_at_white_e_per_s, output)
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
