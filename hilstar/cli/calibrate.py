"""hilstar calibrate: a bench's geometry by dots or attitudes, its monitor by patches, its scale
by stars.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import (
    CSV,
    FITS,
    PNG,
    TOML,
    check_directory,
    check_ending,
    make_directory,
    refuse_stdout,
)
from hilstar.cli.image_source import Exposure, Grab, ShownTo, dot_images
from hilstar.cli.options import (
    BenchFile,
    Json,
    Overwrite,
    check_files,
    parse_numbers,
    parse_reading,
    seed_option,
)
from hilstar.cli.running import Windowed
from hilstar.server.console.terminal import busy, print_found, print_json, say

MAX_OFFSET_S = 4e9  # int64 nanoseconds hold that
NAMED = "in the bench file, under [collimator]: geometry = {!r}"
RESOLUTION_FORM = "--resolution W,H in pixels, such as 1920,1080"


def dots(
    bench_file: BenchFile,
    output: Annotated[
        Path, Option("-o", "--output", metavar="DIR", help="Directory for plan.csv and the frames.")
    ],
    frames: Annotated[int, Option(metavar="N", help="Number of frames.", min=1, max=1000)] = 20,
    dots_per_frame: Annotated[
        int | None,
        Option(
            "--dots",
            metavar="N",
            help="About how many dots are lit in each. [as many as the field holds, 60 at most]",
            min=1,
            max=5000,
        ),
    ] = None,
    show: Annotated[
        bool,
        Option("--show", help="Show the frames on the display: space for the next, q to quit."),
    ] = False,
    dwell: Annotated[
        float | None,
        Option(metavar="SECONDS", help="With --show: time for each frame, without keys.", min=0),
    ] = None,
    windowed: Windowed = False,
    seed: Annotated[int, seed_option("Seed of the dots' codes.")] = 0,
    as_json: Json = False,
) -> None:
    """Make frames of dots for `calibrate geometric`: each dot blinks its own code.

    They stand where the tracker sees the screen, by the bench file's lens, or by its geometry file
    once it has one.
    """
    import numpy as np

    from hilstar.instruments.calibrate.geometric.dots import (
        dot_image,
        lit_for,
        plan_seen_dots,
        show_dots,
        write_plan,
    )
    from hilstar.instruments.calibrate.geometric.geometry_fit import seen_screen_of
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.frame_files import write_codes_png

    check_directory("-o", output)
    file = read_bench_file(bench_file)
    monitor = file.config.monitor
    seen_screen = seen_screen_of(file)
    if dots_per_frame is None:
        lit = lit_for(seen_screen)
    else:
        lit = dots_per_frame
    plan = plan_seen_dots(seen_screen, frames, lit, np.random.default_rng(seed))
    check_files([], [output / "plan.csv"], file)
    make_directory(output)
    write_plan(output / "plan.csv", plan)
    for frame in range(plan.frames):
        image = dot_image(plan, frame, monitor.resolution_px, 2**monitor.bits - 1)
        write_codes_png(output / f"frame_{frame:03}.png", image, monitor.bits)
    shown = None
    if show:
        shown = show_dots(plan, monitor, dwell, windowed=windowed)
        say(f"{shown} of {plan.frames} frames shown")
    summary = {
        "frames": plan.frames,
        "dots": len(plan),
        "lit": int(plan.lit.sum()),
        "seed": seed,
        "written": str(output),
    }
    lit_text = f"{plan.lit.sum() / plan.frames:.0f} lit in each"
    print_found(
        as_json, summary, [f"{len(plan)} dots in {plan.frames} frames, {lit_text}, in {output}"]
    )


def geometric(
    bench_file: BenchFile,
    plan: Annotated[Path, Option(metavar="DIR", help="Directory that `calibrate dots` wrote.")],
    output: Annotated[
        Path, Option("-o", "--output", metavar="geometry.toml", help="The geometry file.")
    ],
    observed: Annotated[
        list[Path] | None,
        Argument(
            metavar="OBSERVED...",
            help="A CSV of centroids (frame,x_px,y_px), or the tracker's images; none with --grab.",
        ),
    ] = None,
    grab: Grab = None,
    exposure: Exposure = None,
    feed: ShownTo = None,
    overwrite: Overwrite = False,
    tracker_is_ideal: Annotated[
        bool,
        Option(
            "--tracker-is-ideal",
            help="Take the tracker's lens as ideal; the file then holds both lenses.",
        ),
    ] = False,
    dark: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="A dark frame, taken from each image; with --grab one is taken, too.",
        ),
    ] = None,
    plot: Annotated[
        Path | None, Option(metavar="OUT.png", help="The error over the screen, and the residuals.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit the collimator's lens, the screen's tilt and the alignment to dots that the tracker
    saw.
    """
    from hilstar.instruments.calibrate.geometric.geometry_fit import (
        calibrate_files,
        lines_of,
        summary_of,
        write_calibrated,
    )
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", output, TOML)
    check_ending("--plot", plot, PNG)
    file = read_bench_file(bench_file)
    check_files([*(observed or []), dark, plan / "plan.csv"], [output, plot], file)
    taken = dot_images(file, observed or [], plan, grab, exposure, feed, overwrite)
    dark = dark or taken.dark
    with busy("fitting the geometry"):
        calibration = calibrate_files(
            file, taken.images, plan / "plan.csv", dark, tracker_is_ideal=tracker_is_ideal
        )
    monitor = file.config.monitor
    written = write_calibrated(
        output, calibration, plot, _monitor_of(monitor.display, monitor.resolution_px)
    )
    print_found(
        as_json,
        summary_of(calibration, written),
        [*lines_of(calibration), NAMED.format(output.name)],
    )


def psf(
    bench_file: BenchFile,
    plan: Annotated[Path, Option(metavar="DIR", help="Directory that `calibrate dots` wrote.")],
    output: Annotated[
        Path,
        Option("-o", "--output", metavar="PSF.fits", help="The file for [tracker.optics] psf."),
    ],
    images: Annotated[
        list[Path] | None,
        Argument(metavar="IMAGES...", help="The tracker's images of the dots; none with --grab."),
    ] = None,
    grab: Grab = None,
    exposure: Exposure = None,
    feed: ShownTo = None,
    overwrite: Overwrite = False,
    dark: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="A dark frame, taken from each image; with --grab one is taken, too.",
        ),
    ] = None,
    oversampling: Annotated[
        int, Option(metavar="N", help="Samples a tracker pixel along each axis.", min=2, max=16)
    ] = 4,
    plot: Annotated[Path | None, Option(metavar="OUT.png", help="The PSFs over the field.")] = None,
    as_json: Json = False,
) -> None:
    """Find the effective PSF of tracker and collimator over the field by the dots of `calibrate
    geometric`.
    """
    from hilstar.instruments.calibrate.effective_psf import (
        draw_effective,
        effective_psf,
        lines_of,
        summary_of,
    )
    from hilstar.optics.glass.psf_file import write_glass
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", output, FITS)
    check_ending("--plot", plot, PNG)
    file = read_bench_file(bench_file)
    check_files([*(images or []), dark, plan / "plan.csv"], [output, plot], file)
    taken = dot_images(file, images or [], plan, grab, exposure, feed, overwrite)
    dark = dark or taken.dark
    with busy("finding the PSFs"):
        psf_result = effective_psf(file, taken.images, plan / "plan.csv", dark, oversampling)
    write_glass(output, psf_result.glass)
    if plot is not None:
        draw_effective(plot, psf_result)
    summary = summary_of(psf_result) | {
        "written": [
            str(written_path) for written_path in (output, plot) if written_path is not None
        ]
    }
    print_found(
        as_json,
        summary,
        [
            *lines_of(psf_result),
            f"in the bench file, under [tracker.optics]: psf = {str(output.name)!r}",
        ],
    )


def _monitor_of(display: int | str, sides_px: tuple[int, int] | None = None) -> Any:
    """The identity of the display that was measured, where this machine has it, of those sides;
    None elsewhere.
    """
    from hilstar.display.window.this_monitor import identity_here

    identity = identity_here(display)
    modes = () if sides_px is None else ("{}x{}@".format(*sides_px), "{1}x{0}@".format(*sides_px))
    if identity is None or not identity.mode.startswith(modes or ""):
        return None
    say(f"measured on {identity.name()}")
    return identity


def alignment(
    bench_file: BenchFile,
    pairs: Annotated[
        Path,
        Argument(
            metavar="PAIRS.csv",
            help=(
                "Commanded and reported q_icrs_to_cam, scalar first:"
                " qw,qx,qy,qz,tw,tx,ty,tz[,valid]. With --ledger, the"
                " tracker's telemetry: t_s,qw,qx,qy,qz[,valid]."
            ),
        ),
    ],
    output: Annotated[
        Path, Option("-o", "--output", metavar="geometry.toml", help="The geometry file.")
    ],
    ledger: Annotated[
        Path | None,
        Option(
            metavar="RUN.mcap",
            help=(
                "The ledger of the run that the telemetry is of: t_s is the middle of an exposure"
                " in seconds of the ledger's"
                " light_ns, the sender's clock."
            ),
        ),
    ] = None,
    offset_s: Annotated[
        float | None,
        Option(
            "--offset-s",
            metavar="SECONDS",
            help="With --ledger: seconds to add to the telemetry's t_s; 0 by default.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find how the tracker stands before the screen from the attitudes that it reports, for one
    that gives nothing else.
    """
    from hilstar.instruments.calibrate.alignment import (
        align_files,
        lines_of,
        summary_of,
        write_alignment,
    )
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", output, TOML)
    if offset_s is not None and ledger is None:
        raise InputError(
            "--offset-s: pairs have no times; give it with --ledger RUN.mcap and the tracker's"
            " telemetry"
        )
    if offset_s is not None and not abs(offset_s) < MAX_OFFSET_S:
        raise InputError(
            f"--offset-s {offset_s}: write seconds, less than {MAX_OFFSET_S:g} either way"
        )
    file = read_bench_file(bench_file)
    check_files([pairs, ledger], [output], file)
    with busy("fitting the alignment"):
        aligned = align_files(file, pairs, ledger, offset_s or 0.0)
    monitor = file.config.monitor
    write_alignment(output, aligned, file, _monitor_of(monitor.display, monitor.resolution_px))
    print_found(
        as_json,
        summary_of(aligned) | {"written": [str(output)]},
        [*lines_of(aligned), NAMED.format(output.name)],
    )


def plan(
    output: Annotated[
        Path, Option("-o", "--output", metavar="PLAN.csv", help="The plan, to be filled in.")
    ],
    bits: Annotated[int, Option(metavar="N", help="Bits per code.", min=1, max=16)] = 8,
    levels: Annotated[
        int, Option(metavar="N", help="Levels from black to white; half of white is added.", min=2)
    ] = 32,
    repeats: Annotated[
        int,
        Option(
            metavar="N", help="Repeats of each level; 3 are enough for a plain power law.", min=1
        ),
    ] = 6,
    channels: Annotated[
        str, Option(metavar="wrgb", help="Channels to measure, of w, r, g, b.")
    ] = "w",
    seed: Annotated[int, seed_option("Seed of the order.")] = 0,
    headless: Annotated[
        Path | None, Option(metavar="DIR", help="Write the patches to this directory as PNG.")
    ] = None,
    resolution: Annotated[str, Option(metavar="W,H", help="Size of the pictures.")] = "1920,1080",
    show: Annotated[
        bool, Option("--show", help="Show the patches on a display: space for the next, q to quit.")
    ] = False,
    display: Annotated[str, Option(metavar="INDEX|NAME", help="With --show: the display.")] = "0",
    dwell: Annotated[
        float | None,
        Option(metavar="SECONDS", help="With --show: time for each patch, without keys.", min=0),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Plan which codes to measure, in which order, and make their patches."""
    import numpy as np

    from hilstar.instruments.calibrate.plan import (
        PlanSettings,
        is_filled_in,
        plan_patches,
        show_patches,
        write_patches,
        write_plan,
    )

    check_ending("-o", output, CSV)
    check_directory("--headless", headless)
    check_files([], [], None, output if is_filled_in(output) else None, overwrite)
    width, height = (
        round(value) for value in parse_numbers(resolution, 2, "--resolution", RESOLUTION_FORM)
    )
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
    line = f"{len(planned)} patches of {codes} codes in {', '.join(written)}"
    advice = "fill in the column value, and give the file to hilstar calibrate photometric"
    summary = {
        "bits": bits,
        "patches": len(planned),
        "codes": codes,
        "seed": seed,
        "written": written,
    }
    print_found(as_json, summary, [line, advice])
    if show:
        shown = show_patches(planned, bits, int(display) if display.isdecimal() else display, dwell)
        say(f"{shown} of {len(planned)} patches shown")
    elif headless is None:
        say(
            "add --show for the patches on a display (space for the next one), or --headless DIR"
            " for pictures of them"
        )


def photometric(
    measured: Annotated[
        Path,
        Argument(metavar="MEASURED.csv", help="code,channel,value; see configs/CALIBRATION.md."),
    ],
    output: Annotated[
        Path, Option("-o", "--output", metavar="MONITOR.toml", help="The calibration file.")
    ],
    bits: Annotated[
        int | None,
        Option(
            metavar="N", help="Bits per code; by default from the codes measured.", min=1, max=16
        ),
    ] = None,
    who: Annotated[str, Option(metavar="NAME", help="Who made the measurements.")] = "",
    when: Annotated[
        str, Option(metavar="DATE", help="Date of the measurements; today by default.")
    ] = "",
    instrument: Annotated[str, Option(metavar="NAME", help="Instrument used.")] = "",
    unit: Annotated[
        str, Option(metavar="UNIT", help="Unit of the values, such as cd/m2 or DN.")
    ] = "",
    plot: Annotated[
        Path | None, Option(metavar="OUT.png", help="The response and its residuals.")
    ] = None,
    display: Annotated[
        str,
        Option(
            metavar="INDEX|NAME", help="The display that was measured, where this machine has one."
        ),
    ] = "0",
    as_json: Json = False,
) -> None:
    """Fit the monitor's response to measured patches."""
    from hilstar.instruments.calibrate.photometric import (
        Provenance,
        calibrate_photometric,
        draw_calibration,
    )

    check_ending("-o", output, TOML)
    refuse_stdout("-o", output)
    check_ending("--plot", plot, PNG)
    check_files([measured], [output, output.with_suffix(".csv"), plot])
    identity = _monitor_of(int(display) if display.isdecimal() else display)
    provenance = Provenance(who, when, instrument, unit)
    with busy("fitting the response"):
        found = calibrate_photometric(measured, output, provenance, bits, identity)
    if plot is not None:
        draw_calibration(measured, plot, bits)
        found["written"].append(str(plot))
    if as_json:
        print_json(found)
        return
    black = found["black_level"]["relative"]
    held = found["holdout"]
    if black > 0:
        contrast = f"1 : {1 / black:.0f}"
    else:
        contrast = "unknown: no light at code 0"
    if found["drift_percent"] is None:
        drift = "not known"
    else:
        drift = f"{found['drift_percent']:+.2f} %"
    typer.echo(
        f"{'measured':20}{found['codes']} codes above black, {found['bits']} bits; drift {drift}"
    )
    typer.echo(f"{'black level':20}{black:.3e} of white, contrast {contrast}")
    typer.echo(f"{'noise':20}{100 * found['noise_relative']:.2f} % of a reading")
    typer.echo(
        f"{'held-out levels':20}{held['rms_percent']:.2f} / {held['p95_percent']:.2f} /"
        f" {held['max_percent']:.2f} % (rms / 95 % / max), {held['max_mag']:.4f} mag maximum"
    )
    for name, channel_fit in found["channels"].items() if len(found["channels"]) > 1 else ():
        rms = channel_fit["holdout"]["rms_percent"]
        under = channel_fit["black_level"]["relative"]
        typer.echo(
            f"{'channel ' + name:20}{channel_fit['shape']}, held-out levels {rms:.2f} % rms, black"
            f" {under:.3e} of its white"
        )
    for decade, percent in (found["crosstalk_percent"] or {}).items():
        unsure = found["crosstalk_error_percent"][decade]
        typer.echo(
            f"{'crosstalk at ' + decade:20}r + g + b is {percent:+.2f} +- {unsure:.2f} % from w"
        )
    typer.echo(f"{'written':20}{', '.join(found['written'])}")
    typer.echo(f"{'in the bench file':20}[monitor] calibration = {json.dumps(output.name)}")


def scale(
    bench_file: BenchFile,
    reading: Annotated[
        list[str],
        Option(
            metavar="HIP,DN[,SIGMA]",
            help="A star, the sum of its DN above the background, and the noise of that sum.",
        ),
    ],
    exposure: Annotated[
        float | None,
        Option(metavar="SECONDS", help="The tracker's exposure; by default the bench file's."),
    ] = None,
    output: Annotated[
        Path | None,
        Option(
            "-o", "--output", metavar="OUT.toml", help="A copy of the bench file with the key set."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Scale the light by the tracker: what one pixel at white is worth, from its readings of
    stars shown.
    """
    from hilstar.instruments.calibrate.scale import UNSURE_MAG, scale_by_tracker, with_flux_at_white
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.build import open_bench

    check_ending("-o", output, TOML)
    file = read_bench_file(bench_file)
    check_files([], [output], file)
    with open_bench(file) as bench:
        if exposure is None:
            exposure_s = bench.config.tracker.exposure_s
        else:
            exposure_s = exposure
        found = scale_by_tracker(bench, [parse_reading(text) for text in reading], exposure_s)
    if found.scatter_mag > UNSURE_MAG:
        say(
            f"the readings disagree by {found.scatter_mag:.3f} mag: look at background, saturation,"
            " and the response"
        )
    if output is not None:
        with_flux_at_white(file, found, output)
    keys = ("flux_at_white_e_per_s", "assumed_e_per_s", "scatter_mag", "relative_error")
    summary: dict[str, Any] = {key: getattr(found, key) for key in keys}
    summary |= {
        "readings": len(reading),
        "exposure_s": exposure_s,
        "written": None if output is None else str(output),
    }
    lines = [
        f"# by {len(reading)} readings of {exposure_s:g} s, scatter {found.scatter_mag:.4f} mag;"
        " under [render]:"
    ]
    lines.append(f"flux_at_white_e_per_s = {found.flux_at_white_e_per_s!r}")
    if found.relative_error is not None:
        lines.append("# and how well it is known, under [certify]:")
        lines += [
            f"flux_at_white_relative = {found.relative_error:.3g}",
            f"flux_at_white_dof = {len(found.ratios) - 1}",
        ]
    print_found(as_json, summary, lines)


def reference(
    readings: Annotated[
        Path,
        Argument(
            metavar="READINGS.csv",
            help=(
                "target,azimuth_deg,elevation_deg[,station][,sigma_arcsec][,x_px,y_px]: faces of"
                " the cube (+x, -y, ...), lit dots (dot), and links between stations (docs:"
                " Calibration files)."
            ),
        ),
    ],
    bench_file: Annotated[
        Path | None,
        Option("--bench", metavar="BENCH.toml", help="The bench, for dots by their pixels."),
    ] = None,
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="FILE.toml", help="Write the table [alignment] here."),
    ] = None,
    name: Annotated[str, Option(metavar="TEXT", help="What the reference is.")] = "",
    as_json: Json = False,
) -> None:
    """Find how the display stands to the tracker's cube from a theodolite's readings: the table
    [alignment] of the bench file.
    """
    import datetime

    from hilstar.basics.files import write_whole
    from hilstar.instruments.calibrate.reference import (
        fit_reference,
        lines_of,
        read_readings,
        summary_of,
        toml_of,
    )
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.cameras import bench_camera

    check_ending("-o", output, TOML)
    camera = None
    file = None
    if bench_file is not None:
        file = read_bench_file(bench_file)
        camera = bench_camera(file.config, file.folder)
    check_files([readings, bench_file], [output], file)
    found = fit_reference(readings, read_readings(readings, camera))
    table = toml_of(found, name, datetime.datetime.now(datetime.UTC).date().isoformat())
    written = []
    if output is not None:
        write_whole(output, table)
        written.append(str(output))
    print_found(
        as_json,
        summary_of(found) | {"written": written},
        [*lines_of(found), "in the bench file:", *table.splitlines()],
    )
