"""hilstar compare: two frames, star by star."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.declare import argument, option, struct
from hilstar.cli.options import json_option, output_option
from hilstar.server.console.terminal import busy, print_found

MAX_LINES = 10  # stars listed: if the whole sky differs, more of them say nothing


@struct
class CompareOptions:
    """The options of `hilstar compare`."""

    frame: Path = argument("A.fits", "The linear image from `hilstar frame -o`.")
    golden: Path = argument("B.fits", "The golden frame that it is compared with.")
    truth: Path | None = option("TRUTH.csv", "B's stars, from `hilstar frame --truth`.")
    flux_mag: float | None = option("MAG", "Largest flux error of a star; 0.001 by default.")
    centroid_px: float | None = option("PX", "Largest centroid error of a star; 0.001 by default.")
    output: Path | None = output_option("DIR", "Directory for a page, a chart and a table.")
    as_json: bool = json_option()


def compare(options: CompareOptions) -> None:
    """Compare two frames star by star; exit code 0 if they show the same sky, 1 if not."""
    from hilstar.instruments.compare import compare as compare_files
    from hilstar.instruments.compare.report import write_report
    from hilstar.instruments.compare.sky_comparison import CENTROID_PX, FLUX_MAG, star_lines

    check_directory("-o", options.output)
    flux_mag = FLUX_MAG if options.flux_mag is None else options.flux_mag
    centroid_px = CENTROID_PX if options.centroid_px is None else options.centroid_px
    with busy("comparing"):
        comparison = compare_files(
            options.frame,
            options.golden,
            flux_mag=flux_mag,
            centroid_px=centroid_px,
            truth=options.truth,
        )
        if options.output is not None:
            write_report(make_directory(options.output), comparison)
    summary = comparison.summary()
    where = " (-o DIR writes a table of all)"
    if options.output is not None:
        where = f" (in {options.output / 'compare.csv'})"
    lines = list(_figure_lines(summary))
    if comparison.common is not None:
        lines.insert(0, f"{'in common':20}{comparison.common.line()}")
    lines += [f"{'':20}{line}" for line in star_lines(comparison, MAX_LINES, where)]
    verdict = "the same sky" if comparison.same else "NOT the same sky"
    lines.append(f"{'verdict':20}{verdict}")
    print_found(options.as_json, summary, lines)
    if not comparison.same:
        raise typer.Exit(1)


def _figure_lines(summary: dict[str, Any]) -> Iterator[str]:
    """How many stars were compared, and their errors by channel."""
    rest = (
        f"{summary['blends']} of them blends, {summary['unmeasured']} more with too little light"
        " of their own in view"
    )
    yield f"{'stars compared':20}{summary['stars']}, {rest}"
    for name, unit in (("flux", "mag"), ("centroid", "px")):
        key = f"{name}_error_{unit}"
        limit = summary["limits"][f"{name}_{unit}"]
        errors = {f"{name} error": summary[key]}
        for channel, figures in summary["channels"].items():
            errors[f"{name} error, {channel}"] = figures[key]
        for label, error in errors.items():
            figure = " / ".join(_figure(value) for value in error.values())
            yield f"{label:20}{figure} {unit} (rms / 95 % / max; limit {limit:g})"
    if summary["widened"]:
        why = "for rounding of the light around them or the image's edge"
        yield f"{'wider limits':20}{summary['widened']} stars, {why}"
    yield f"{'missing, extra':20}{summary['missing']}, {summary['extra']}"


def _figure(value: float | None) -> str:
    """A figure, and a dash for none."""
    if value is None:
        return "-"
    return f"{value:.2g}"
