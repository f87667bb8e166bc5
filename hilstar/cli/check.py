"""Commands that measure and check: simulate, study, doctor."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from hilstar.cli.common import BenchFile, Json, QuaternionText, RadecText, app, attitude_of
from hilstar.console import print_json, progress
from hilstar.errors import InputError


@app.command()
def simulate(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    rate: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="The camera turns: deg/s about its axes.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="LOG", help="Frames along a log, into the directory -o.")] = None,
    frames: Annotated[int | None, typer.Option(help="With --log: so many, evenly; each sample by default.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the frame's noise.", min=0)] = 0,
    noise: Annotated[Literal["full", "none"], typer.Option(help="All of the detector's noise, or none.")] = "full",
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="DN, uint16.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A stretched picture for a person.")] = None,
    as_json: Json = False,
) -> None:
    """The virtual tracker's image of the sky, with noise."""
    from hilstar.bench import output as files
    from hilstar.bench.sender import parse_rate
    from hilstar.bench.simulation import Simulator

    if log is not None:
        if output is None or radec or quaternion or rate or png:
            raise InputError("simulate --log LOG: give -o DIR, and no --radec, --quaternion, --rate or --png")
        simulate_log(bench_file, log, frames, (noise, seed), output)
        return
    if output is None and png is None:
        raise InputError("simulate: nothing to write; add -o OUT.fits or --png OUT.png")
    q = attitude_of("simulate", radec, quaternion)
    rate_rad_s = parse_rate(rate) if rate else np.zeros(3)
    with Simulator(bench_file) as simulator:
        rng = None if noise == "none" else np.random.default_rng(seed)
        exposure = simulator.expose(simulator.motion(q, rate_rad_s), rng)
        if output is not None:
            files.write_exposure_fits(output, simulator, exposure, noise, seed)
        if png is not None:
            files.write_exposure_png(png, exposure.dn)
        summary = {
            "stars": len(exposure.truth),
            "clipped": exposure.truth["hip"][exposure.truth["clipped"]].tolist(),
            "dn": {"min": int(exposure.dn.min()), "mean": float(exposure.dn.mean()), "max": int(exposure.dn.max())},
            "written": [str(path) for path in (output, png) if path is not None],
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
    from hilstar.attitude.logs import read_log
    from hilstar.bench.batch import log_motions, simulate_motions
    from hilstar.bench.config import read_config

    motions = log_motions(read_log(log), frames, read_config(bench_file).tracker.exposure_s)
    with progress("exposing", len(motions)) as advance:
        simulate_motions(bench_file, motions, *noise_and_seed, output, advance)
    typer.echo(f"{len(motions)} exposures in {output}")


@app.command()
def study(
    what: Annotated[Literal["models", "outputs", "stability", "quantisation"], typer.Argument(help="Which charts.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where they go.")],
    as_json: Json = False,
) -> None:
    """Charts and tables: brightness models, the thesis's outputs, where methods fail, and what each quantisation costs."""
    from hilstar.bench.output import make_directory

    make_directory(output)
    with progress(f"study {what}", math.inf):
        lines, right = study_lines(what, output)
    if as_json:
        print_json({"study": what, "right": right, "findings": lines, "directory": str(output)})
    else:
        typer.echo("\n".join([*lines, f"figures and tables in {output}"]))


def study_lines(what: str, output: Path) -> tuple[list[str], bool]:
    """Run a study; what it found, and whether everything was right."""
    if what == "models":
        from hilstar.study.models import run as run_models

        return [f"{finding.figure}: {finding.text}" for finding in run_models(output)], True
    if what == "outputs":
        from hilstar.study.outputs import run as run_outputs

        return run_outputs(output), True
    if what == "quantisation":
        from hilstar.study.quantisation import run as run_quantisation

        return run_quantisation(output), True
    from hilstar.study.stability import run as run_stability

    places = run_stability(output)
    lines = [f"{'right' if p.right else 'WRONG'}  {p.case}: {p.happens} ({p.why})" for p in places]
    return lines, all(place.right for place in places)


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what GL, displays, links and files are there, and what is missing."""
    from hilstar.bench.doctor import examine

    result = examine()
    if as_json:
        print_json(result)
    else:
        for check in result["checks"]:
            mark = "ok" if check["ok"] else "MISSING" if check["required"] else "none"
            typer.echo(f"{mark:8}{check['name']:12}{check['detail']}")
    if not result["ok"]:
        raise typer.Exit(3)
