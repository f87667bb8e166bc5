"""hilstar verify: the digital twin of a bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hilstar.cli.options import MAX_SEED, BenchFile, Json
from hilstar.console.terminal import print_json, progress
from hilstar.files import check_directory


def verify(
    bench_file: BenchFile,
    fields: Annotated[int, typer.Option(help="Number of random attitudes.", min=1, max=100_000)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the attitudes and the noise.", min=0, max=MAX_SEED)] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Directory for charts and a table.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with code 1 if the bench does not pass.")] = False,
    as_json: Json = False,
) -> None:
    """Run the digital twin: what the tracker would measure of the stars shown, against the sky."""
    import numpy as np

    from hilstar.bench.bench_file import read_bench_file
    from hilstar.files import make_directory
    from hilstar.twin.verdict import write_report
    from hilstar.twin.verify import verify as run_twin

    check_directory("-o", output)
    if output is not None:
        make_directory(output)
    file = read_bench_file(bench_file)
    with progress("verifying", fields) as advance:
        verdict, summary = run_twin(file, fields, np.random.default_rng(seed), advance)
    if output is not None:
        config = file.config
        write_report(output, verdict, (config.verify.flux_mag, config.verify.centroid_px), config.tracker.resolution_px)
    if as_json:
        print_json(summary)
    else:
        tell_verdict(summary)
    if strict and not verdict.passed:
        raise typer.Exit(1)


def tell_verdict(summary: dict[str, Any]) -> None:
    """The verdict for a person."""

    def three(errors: dict[str, float | None]) -> str:
        return " / ".join("-" if errors[key] is None else f"{errors[key]:.4f}" for key in ("rms", "p95", "max"))

    kinds = ("lost", "blended", "clipped", "not_shown", "at_edge")
    rest = ", ".join(f"{summary[name]} {name.replace('_', ' ')}" for name in kinds)
    typer.echo(f"{'stars':20}{summary['stars']} in {summary['fields']} fields; {rest}")
    typer.echo(f"{'flux error':20}{three(summary['flux_error_mag'])} mag (rms / 95 % / max)")
    arcsec = three(summary["centroid_error_arcsec"])
    typer.echo(f"{'centroid error':20}{three(summary['centroid_error_px'])} px, {arcsec} arcsec")
    typer.echo(
        f"{'with detector noise':20}{three(summary['noisy']['flux_mag'])} mag, {three(summary['noisy']['centroid_px'])} px"
    )
    for row in summary["by_magnitude"]:
        where, flux, centroid = f"V {row['v_from']} to {row['v_to']}", row["flux_error_mag"], row["centroid_error_px"]
        typer.echo(f"{where:>17}   {flux['rms']:.4f} mag rms, {centroid['rms']:.4f} px rms, {row['stars']} stars")
    for line in summary["reasons"]:
        typer.echo(f"{'':20}{line}")
    typer.echo(f"{'verdict':20}{'passed' if summary['passed'] else 'NOT passed'}")
