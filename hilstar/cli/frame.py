"""hilstar frame: one frame into files."""

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import CSV, FITS, PNG, check_ending
from hilstar.cli import options
from hilstar.cli.pointing import QuaternionText, RadecText, StarText, attitude_of
from hilstar.cli.running import explain_bench, explained_effort, optional_scenario, say_optics
from hilstar.server.console.terminal import busy, print_found

NO_OUTPUT = (
    "frame: no output was asked for; add -o OUT.fits, --truth OUT.csv, --codes OUT.png or --explain"
)


def frame(
    bench_file: options.BenchFile,
    radec: RadecText = None,
    star: StarText = None,
    quaternion: QuaternionText = None,
    output: Annotated[
        Path | None,
        Option(
            "-o", "--output", metavar="OUT.fits", help="The linear image, electrons per second."
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        Option(metavar="OUT.csv", help="The truth table: one row for each star in view."),
    ] = None,
    codes: Annotated[Path | None, Option(metavar="OUT.png", help="The code values.")] = None,
    preview: Annotated[
        Path | None, Option(metavar="OUT.png", help="A picture stretched for the eye.")
    ] = None,
    at: options.AtSeconds = None,
    scenario: options.ScenarioFile = None,
    explain: options.Explain = False,
    as_json: options.Json = False,
) -> None:
    """Draw one frame and write it to files."""
    import numpy as np

    from hilstar.optics.layers.truth import clipped_in
    from hilstar.server.bench import frame_files as files
    from hilstar.server.bench.bench_file import at_moment, read_bench_file
    from hilstar.server.bench.build import open_bench
    from hilstar.server.bench.cameras import fields_of_view
    from hilstar.server.bench.star_size import star_size

    file = read_bench_file(bench_file)
    q = attitude_of("frame", radec, star, quaternion, file.config.sky.epoch_jyear)
    targets = [path for path in (output, truth, codes, preview) if path is not None]
    _check_targets(output, truth, codes, preview, explain)
    t_ns, wrong = (
        options.parse_at("frame", at, file.config, scenario is not None),
        optional_scenario(scenario),
    )
    file = at_moment(file, t_ns)
    options.check_files([scenario], targets, file)
    fields = fields_of_view(file.config, file.folder)
    with busy("drawing"), open_bench(file) as bench:
        if explain:
            explain_bench(bench, t_ns)
        effects = None
        if wrong is not None:
            # takes 20 ms, with the random numbers of its light
            from hilstar.server.bench.fault_views import faults_at

            effects = faults_at(bench, wrong, t_ns or 0)
        shot = bench.frame(q, t_ns=t_ns, faults=effects)
        if output is not None:
            files.write_frame_fits(output, bench, shot)
        if truth is not None:
            files.write_truth_csv(truth, shot)
        if codes is not None:
            files.write_codes_png(codes, shot.codes, bench.config.monitor.bits)
        if preview is not None:
            files.write_preview_png(preview, shot.levels)
        clipped = clipped_in(shot.rows)
        seen_star = star_size(file.config, file.folder, bench.camera)
        summary: dict[str, Any] = {
            "stars": len(shot.rows),
            "electrons_per_s": float(shot.linear.sum(dtype=np.float64)),
            "flux_at_white_e_per_s": bench.flux_at_white_e_per_s,
            "clipped": clipped,
            "clipped_mag": bench.losses_mag(shot, effects),
            "left_out": left_out(shot.rows),
            "calibration": {"name": bench.calibration.name, "sha256": bench.calibration.sha256},
            "faults": [] if effects is None else [active.fault.name for active in effects.now],
            "written": [str(path) for path in targets],
            "fields_of_view": fields.keys(),
            "star": seen_star.keys(),
            "gl_renderer": bench.renderer.gl_renderer,
        }
        summary |= explained_effort(bench, explain and as_json)
    names = f", clipped: {clipped_text(summary['clipped_mag'])}" if clipped else ""
    missing = summary["left_out"]
    if missing["stars"]:
        names += (
            f", {missing['stars']} too faint to show ({missing['flux_share']:.2%} of all light)"
        )
    if summary["faults"]:
        names += f", faults: {', '.join(summary['faults'])}"
    drawn = f"{len(shot.rows)} stars{names}"
    if targets:
        drawn += f"; wrote {', '.join(summary['written'])}"
    print_found(as_json, summary, [drawn, fields.line(), seen_star.line()])
    say_optics(fields, seen_star)  # after the refusals: a failing command prints one line


def _check_targets(
    output: Path | None,
    truth: Path | None,
    codes: Path | None,
    preview: Path | None,
    explain: bool,
) -> None:
    """Refuse (InputError) a file of another kind, and no file where nothing is to be explained."""
    check_ending("-o", output, FITS)
    check_ending("--truth", truth, CSV)
    check_ending("--codes", codes, PNG)
    check_ending("--preview", preview, PNG)
    asked = output or truth or codes or preview or explain
    if not asked:
        raise InputError(NO_OUTPUT)


def clipped_text(loss_mag: dict[int | str, float]) -> str:
    """ "HIP 24436 by 0.12 mag, 27989 by 0.50 mag, Moon by 9.81 mag"."""
    stars = ", ".join(
        f"{hip} by {mag:.2f} mag" for hip, mag in loss_mag.items() if isinstance(hip, int)
    )
    bodies = [f"{name} by {mag:.2f} mag" for name, mag in loss_mag.items() if isinstance(name, str)]
    return ", ".join([*([f"HIP {stars}"] if stars else []), *bodies])


def left_out(truth: Any) -> dict[str, float | int]:
    """The stars in view that the monitor cannot show: their number, and their share of all
    stars' light.
    """
    stars = truth[truth["name"] == ""]
    missing = stars["electrons_per_s"][~stars["drawn"]]
    total = float(stars["electrons_per_s"].sum())
    return {"stars": len(missing), "flux_share": float(missing.sum()) / total if total else 0.0}
