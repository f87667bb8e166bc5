"""hilstar compare: two frames, star by star."""

from itertools import product
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import Json
from hilstar.server.console.terminal import busy, print_json

MAX_LINES = 10  # stars listed: if the whole sky differs, more of them say nothing


def compare(
    frame: Annotated[
        Path, Argument(metavar="A.fits", help="The linear image from `hilstar frame -o`.")
    ],
    golden: Annotated[
        Path, Argument(metavar="B.fits", help="The golden frame that it is compared with.")
    ],
    truth: Annotated[
        Path | None, Option(metavar="TRUTH.csv", help="B's stars, from `hilstar frame --truth`.")
    ] = None,
    flux_mag: Annotated[
        float | None, Option(metavar="MAG", help="Largest flux error of a star; 0.001 by default.")
    ] = None,
    centroid_px: Annotated[
        float | None,
        Option(metavar="PX", help="Largest centroid error of a star; 0.001 by default."),
    ] = None,
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="DIR", help="Directory for a page, a chart and a table."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare two frames star by star; exit code 0 if they show the same sky, 1 if not."""
    from hilstar.instruments.compare import compare as compare_files
    from hilstar.instruments.compare.report import write_report
    from hilstar.instruments.compare.sky_comparison import CENTROID_PX, FLUX_MAG, star_lines

    check_directory("-o", output)
    limits = (
        FLUX_MAG if flux_mag is None else flux_mag,
        CENTROID_PX if centroid_px is None else centroid_px,
    )
    with busy("comparing"):
        comparison = compare_files(
            frame, golden, flux_mag=limits[0], centroid_px=limits[1], truth=truth
        )
        if output is not None:
            write_report(make_directory(output), comparison)
    summary = comparison.summary()
    if as_json:
        print_json(summary)
    else:
        if comparison.common is not None:
            typer.echo(f"{'in common':20}{comparison.common.line()}")
        rest = (
            f"{summary['blends']} of them blends, {summary['unmeasured']} more with too little"
            " light of their own in view"
        )
        typer.echo(f"{'stars compared':20}{summary['stars']}, {rest}")
        by_channel = {"": summary} | {
            f", {name}": channel_summary for name, channel_summary in summary["channels"].items()
        }
        for (name, unit), (channel, figures) in product(
            (("flux", "mag"), ("centroid", "px")), by_channel.items()
        ):
            limit = summary["limits"][f"{name}_{unit}"]
            three = " / ".join(
                "-" if value is None else f"{value:.2g}"
                for value in figures[f"{name}_error_{unit}"].values()
            )
            typer.echo(
                f"{f'{name} error{channel}':20}{three} {unit} (rms / 95 % / max; limit {limit:g})"
            )
        if summary["widened"]:
            why = "for rounding of the light around them or the image's edge"
            typer.echo(f"{'wider limits':20}{summary['widened']} stars, {why}")
        typer.echo(f"{'missing, extra':20}{summary['missing']}, {summary['extra']}")
        if output is None:
            where = " (-o DIR writes a table of all)"
        else:
            where = f" (in {output / 'compare.csv'})"
        for line in star_lines(comparison, MAX_LINES, where):
            typer.echo(f"{'':20}{line}")
        typer.echo(f"{'verdict':20}{'the same sky' if comparison.same else 'NOT the same sky'}")
    if not comparison.same:
        raise typer.Exit(1)
