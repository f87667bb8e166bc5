"""hilstar frame: one frame into files."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics.errors import InputError
from hilstar.basics.files import CSV, FITS, PNG, check_ending
from hilstar.cli.declare import option, struct
from hilstar.cli.options import (
    at_option,
    bench_argument,
    check_files,
    explain_option,
    json_option,
    output_option,
    parse_at,
    scenario_option,
)
from hilstar.cli.pointing import PointingOptions, attitude_of
from hilstar.cli.running import explain_bench, explained_effort, optional_scenario, say_optics
from hilstar.server.console.terminal import busy, print_found

if TYPE_CHECKING:
    from hilstar.server.bench.frame import Bench, Frame

NO_OUTPUT = (
    "frame: no output was asked for; add -o OUT.fits, --truth OUT.csv, --codes OUT.png or --explain"
)


@struct
class FrameOptions:
    """The options of `hilstar frame`."""

    bench_file: Path = bench_argument()
    output: Path | None = output_option("OUT.fits", "The linear image, electrons per second.")
    truth: Path | None = option("OUT.csv", "The truth table: one row for each star in view.")
    codes: Path | None = option("OUT.png", "The code values.")
    preview: Path | None = option("OUT.png", "A picture stretched for the eye.")
    at: float | None = at_option()
    scenario: Path | None = scenario_option()
    explain: bool = explain_option()
    as_json: bool = json_option()

    def targets(self) -> list[Path]:
        """The files to write. Raises InputError for a file of another kind, and for no file where
        nothing is to be explained.
        """
        check_ending("-o", self.output, FITS)
        check_ending("--truth", self.truth, CSV)
        check_ending("--codes", self.codes, PNG)
        check_ending("--preview", self.preview, PNG)
        paths = (self.output, self.truth, self.codes, self.preview)
        targets = [path for path in paths if path is not None]
        if not targets and not self.explain:
            raise InputError(NO_OUTPUT)
        return targets


def frame(pointing: PointingOptions, options: FrameOptions) -> None:
    """Draw one frame and write it to files."""
    import numpy as np

    from hilstar.optics.layers.truth import clipped_in
    from hilstar.server.bench.bench_file import at_moment, read_bench_file
    from hilstar.server.bench.build import open_bench
    from hilstar.server.bench.cameras import fields_of_view
    from hilstar.server.bench.star_size import star_size

    file = read_bench_file(options.bench_file)
    q = attitude_of("frame", pointing, file.config.sky.epoch_jyear)
    targets = options.targets()
    t_ns = parse_at("frame", options.at, file.config, options.scenario is not None)
    wrong = optional_scenario(options.scenario)
    file = at_moment(file, t_ns)
    check_files([options.scenario], targets, file)
    fields = fields_of_view(file.config, file.folder)
    with busy("drawing"), open_bench(file) as bench:
        if options.explain:
            explain_bench(bench, t_ns)
        effects = None
        if wrong is not None:
            # takes 20 ms, with the random numbers of its light
            from hilstar.server.bench.fault_views import faults_at

            effects = faults_at(bench, wrong, t_ns or 0)
        shot = bench.frame(q, t_ns=t_ns, faults=effects)
        _write_files(options, bench, shot)
        clipped = clipped_in(shot.rows)
        seen_star = star_size(file.config, file.folder, bench.camera)
        faults = []
        if effects is not None:
            faults = [active.fault.name for active in effects.now]
        summary: dict[str, Any] = {
            "stars": len(shot.rows),
            "electrons_per_s": float(shot.linear.sum(dtype=np.float64)),
            "flux_at_white_e_per_s": bench.flux_at_white_e_per_s,
            "clipped": clipped,
            "clipped_mag": bench.losses_mag(shot, effects),
            "left_out": left_out(shot.rows),
            "calibration": {"name": bench.calibration.name, "sha256": bench.calibration.sha256},
            "faults": faults,
            "written": [str(path) for path in targets],
            "fields_of_view": fields.keys(),
            "star": seen_star.keys(),
            "gl_renderer": bench.renderer.gl_renderer,
        }
        summary |= explained_effort(bench, options.explain and options.as_json)
    print_found(options.as_json, summary, [_drawn_line(summary), fields.line(), seen_star.line()])
    say_optics(fields, seen_star)  # after the refusals: a failing command prints one line


def _write_files(options: FrameOptions, bench: "Bench", shot: "Frame") -> None:
    """Write a frame into the files that the command line names."""
    from hilstar.server.bench import frame_files as files

    if options.output is not None:
        files.write_frame_fits(options.output, bench, shot)
    if options.truth is not None:
        files.write_truth_csv(options.truth, shot)
    if options.codes is not None:
        files.write_codes_png(options.codes, shot.codes, bench.config.monitor.bits)
    if options.preview is not None:
        files.write_preview_png(options.preview, shot.levels)


def _drawn_line(summary: dict[str, Any]) -> str:
    """What was drawn, what of it the monitor cannot show, and the files."""
    parts = [f"{summary['stars']} stars"]
    if summary["clipped"]:
        parts.append(f"clipped: {clipped_text(summary['clipped_mag'])}")
    missing = summary["left_out"]
    if missing["stars"]:
        share = f"{missing['flux_share']:.2%} of all light"
        parts.append(f"{missing['stars']} too faint to show ({share})")
    if summary["faults"]:
        parts.append(f"faults: {', '.join(summary['faults'])}")
    line = ", ".join(parts)
    if summary["written"]:
        line += f"; wrote {', '.join(summary['written'])}"
    return line


def clipped_text(loss_mag: dict[int | str, float]) -> str:
    """ "HIP 24436 by 0.12 mag, 27989 by 0.50 mag, Moon by 9.81 mag"."""
    losses = {name: f"{name} by {mag:.2f} mag" for name, mag in loss_mag.items()}
    # a star's name here is its Hipparcos number
    stars = [text for name, text in losses.items() if isinstance(name, int)]
    bodies = [text for name, text in losses.items() if isinstance(name, str)]
    if stars:
        stars[0] = f"HIP {stars[0]}"
    return ", ".join([*stars, *bodies])


def left_out(truth: Any) -> dict[str, float | int]:
    """The stars in view that the monitor cannot show: their number, and their share of all
    stars' light.
    """
    stars = truth[truth["name"] == ""]
    missing = stars["electrons_per_s"][~stars["drawn"]]
    total = float(stars["electrons_per_s"].sum())
    share = 0.0
    if total:
        share = float(missing.sum()) / total
    return {"stars": len(missing), "flux_share": share}
