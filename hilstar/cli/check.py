"""Commands that measure and check: simulate, study, doctor."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from hilstar.cli.common import MAX_SEED, BenchFile, Json, QuaternionText, RadecText, app, attitude_of, check_files
from hilstar.console.terminal import print_json, progress, say
from hilstar.errors import InputError
from hilstar.files import FITS, PNG, PNG_OR_TIFF, check_directory, check_ending, make_directory


@app.command()
def simulate(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    rate: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="The camera turns: deg/s about its axes.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="LOG", help="Frames along a log, into the directory -o.")] = None,
    frames: Annotated[int | None, typer.Option(help="With --log: so many, evenly; each sample by default.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the frame's noise.", min=0, max=MAX_SEED)] = 0,
    noise: Annotated[Literal["full", "none"], typer.Option(help="All of the detector's noise, or none.")] = "full",
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="DN, uint16.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A stretched picture for a person.")] = None,
    dn_png: Annotated[Path | None, typer.Option(metavar="OUT.png|.tif", help="The DN themselves, 16 bits of grey.")] = None,
    as_json: Json = False,
) -> None:
    """The virtual tracker's image of the sky, with noise."""
    from hilstar.run.send.sender import parse_rate
    from hilstar.twin import exposure_files as files
    from hilstar.twin.simulator import Simulator

    if log is not None:
        if output is None or radec or quaternion or rate or png or dn_png:
            raise InputError("simulate --log LOG: give -o DIR, and no --radec, --quaternion, --rate, --png or --dn-png")
        check_directory("-o", output)
        simulate_log(bench_file, log, frames, (noise, seed), output)
        return
    targets = [path for path in (output, png, dn_png) if path is not None]
    if not targets:
        raise InputError("simulate: nothing to write; add -o OUT.fits, --png OUT.png or --dn-png OUT.png")
    check_ending("-o", output, FITS)
    check_ending("--png", png, PNG)
    check_ending("--dn-png", dn_png, PNG_OR_TIFF)
    check_files([], targets, bench_file)
    q = attitude_of("simulate", radec, quaternion)
    rate_rad_s = parse_rate(rate) if rate else np.zeros(3)
    with Simulator(bench_file) as simulator:
        rng = None if noise == "none" else np.random.default_rng(seed)
        exposure = simulator.expose(simulator.motion(q, rate_rad_s), rng)
        if output is not None:
            files.write_exposure_fits(output, simulator, exposure, noise, seed)
        if png is not None:
            files.write_exposure_png(png, exposure.dn)
        if dn_png is not None:
            files.write_dn_picture(dn_png, exposure.dn)
        summary = {
            "stars": len(exposure.truth),
            "clipped": exposure.truth["hip"][exposure.truth["clipped"]].tolist(),
            "capped": exposure.capped,
            "dn": {"min": int(exposure.dn.min()), "mean": float(exposure.dn.mean()), "max": int(exposure.dn.max())},
            "written": [str(path) for path in targets],
            "gl_renderer": simulator.renderer.gl_renderer,
        }
    if as_json:
        print_json(summary)
    else:
        dn = summary["dn"]
        typer.echo(f"{summary['stars']} stars, DN {dn['min']} to {dn['max']}; wrote {', '.join(summary['written'])}")


def simulate_log(
    bench_file: Path, log: Path, frames: int | None, noise_and_seed: tuple[Literal["full", "none"], int], output: Path
) -> None:
    """The virtual tracker along a log."""
    from hilstar.attitude.logs.gaps import log_joins
    from hilstar.attitude.logs.log_file import read_log
    from hilstar.bench.config import read_config
    from hilstar.twin.batch import log_motions, simulate_motions

    samples = read_log(log)
    for _, line in log_joins(samples).told:
        say(line)
    config = read_config(bench_file)
    motions = log_motions(samples, frames, config.tracker.exposure_s, math.radians(config.attitude.max_rate_deg_s))
    with progress("exposing", len(motions)) as advance:
        simulate_motions(bench_file, motions, *noise_and_seed, output, advance)
    typer.echo(f"{len(motions)} exposures in {output}")


Study = Literal["models", "outputs", "stability", "quantisation", "timing", "tradeoff", "economy", "prediction"]


@app.command()
def study(
    what: Annotated[Study, typer.Argument(help="Which charts.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where they go.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer rounds, where a study takes minutes.")] = False,
    as_json: Json = False,
) -> None:
    """Charts and tables: models, the thesis's outputs, where methods fail, codes, a slewing screen, error against time."""
    check_directory("-o", output)
    make_directory(output)
    with progress(f"study {what}", math.inf):
        lines, right = study_lines(what, output, quick)
    if as_json:
        print_json({"study": what, "right": right, "findings": lines, "directory": str(output)})
    else:
        typer.echo("\n".join([*lines, f"figures and tables in {output}"]))


def study_lines(what: str, output: Path, quick: bool = False) -> tuple[list[str], bool]:
    """Run a study; what it found, and whether everything was right."""
    room = what in {"stability", "tradeoff"}
    study_of = import_module(f"hilstar.study.{what}{'.run' if room else ''}")
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in study_of.run(output)], True
    if what == "stability":
        places = study_of.run(output)
        lines = [
            f"{'right' if p.right else 'WRONG'}  {p.case}: {p.happens} ({p.why}); not {p.method}: {p.fails}" for p in places
        ]
        return lines, all(place.right for place in places)
    return study_of.run(output) if what == "outputs" else study_of.run(output, quick), True


@app.command()
def verify(
    bench_file: BenchFile,
    fields: Annotated[int, typer.Option(help="Random attitudes.", min=1, max=100_000)] = 10,
    seed: Annotated[int, typer.Option(help="Of the attitudes and the noise.", min=0, max=MAX_SEED)] = 0,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="Charts and a table.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 when the bench does not pass.")] = False,
    as_json: Json = False,
) -> None:
    """The digital twin: what the tracker measures of the stars shown, against the sky."""
    from hilstar.bench.config import read_config
    from hilstar.twin.verdict import write_report
    from hilstar.twin.verify import verify as run_twin

    check_directory("-o", output)
    if output is not None:
        make_directory(output)
    with progress("verifying", fields) as advance:
        verdict, summary = run_twin(bench_file, fields, np.random.default_rng(seed), advance)
    if output is not None:
        config = read_config(bench_file)
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


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what GL, displays, links and files are there, and what is missing."""
    from hilstar.run.doctor import examine

    result = examine()
    if as_json:
        print_json(result)
    else:
        for check in result["checks"]:
            mark = "ok" if check["ok"] else "MISSING" if check["required"] else "none"
            typer.echo(f"{mark:8}{check['name']:12}{check['detail']}")
    if not result["ok"]:
        raise typer.Exit(3)
