"""hilstar calibrate: a bench's geometry by dots or attitudes, its monitor by patches, its scale
by stars.
"""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    temporary_folder,
    write_whole,
)
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.image_source import (
    DotOptions,
    ImageOptions,
    dot_images,
    exposure_option,
    grab_option,
    handed_on,
    image_source,
)
from hilstar.cli.options import (
    bench_argument,
    check_files,
    json_option,
    output_option,
    overwrite_option,
    parse_reading,
    parse_resolution,
    seed_option,
    windowed_option,
)
from hilstar.cli.pointing import PointingOptions, attitude_of
from hilstar.cli.running import PageOptions, page_listener
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.display.identity import MonitorIdentity
    from hilstar.instruments.calibrate.first_light.image_sources import Pattern
    from hilstar.server.answers.star_widths import FocusReading
    from hilstar.server.bench.bench_file import BenchFile

MAX_OFFSET_S = 4e9  # int64 nanoseconds hold that
NAMED = "in the bench file, under [collimator]: geometry = {!r}"


@struct
class DotsOptions:
    """The options of `hilstar calibrate dots`."""

    bench_file: Path = bench_argument()
    output: Path = output_option("DIR", "Directory for plan.csv and the frames.")
    frames: int = option("N", "Number of frames.", default=20, min=1, max=1000)
    dots_per_frame: int | None = option(
        "N",
        "About how many dots are lit in each. [as many as the field holds, 60 at most]",
        "--dots",
        min=1,
        max=5000,
    )
    show: bool = switch("Show the frames on the display: space for the next, q to quit.")
    dwell: float | None = option(
        "SECONDS", "With --show: time for each frame, without keys.", min=0
    )
    windowed: bool = windowed_option()
    seed: int = seed_option("Seed of the dots' codes.")
    as_json: bool = json_option()


def dots(options: DotsOptions) -> None:
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

    check_directory("-o", options.output)
    file = read_bench_file(options.bench_file)
    monitor = file.config.monitor
    seen_screen = seen_screen_of(file)
    lit = options.dots_per_frame or lit_for(seen_screen)
    rng = np.random.default_rng(options.seed)
    plan = plan_seen_dots(seen_screen, options.frames, lit, rng)
    check_files([], [options.output / "plan.csv"], file)
    make_directory(options.output)
    write_plan(options.output / "plan.csv", plan)
    white = 2**monitor.bits - 1
    for frame in range(plan.frames):
        image = dot_image(plan, frame, monitor.resolution_px, white)
        write_codes_png(options.output / f"frame_{frame:03}.png", image, monitor.bits)
    if options.show:
        shown = show_dots(plan, monitor, options.dwell, windowed=options.windowed)
        say(f"{shown} of {plan.frames} frames shown")
    summary = {
        "frames": plan.frames,
        "dots": len(plan),
        "lit": int(plan.lit.sum()),
        "seed": options.seed,
        "written": str(options.output),
    }
    lit_text = f"{plan.lit.sum() / plan.frames:.0f} lit in each"
    line = f"{len(plan)} dots in {plan.frames} frames, {lit_text}, in {options.output}"
    print_found(options.as_json, summary, [line])


@struct
class GeometricOptions:
    """The options of `hilstar calibrate geometric`."""

    bench_file: Path = bench_argument()
    plan: Path = option("DIR", "Directory that `calibrate dots` wrote.")
    output: Path = output_option("geometry.toml", "The geometry file.")
    observed: list[Path] | None = argument(
        "OBSERVED...",
        "A CSV of centroids (frame,x_px,y_px), or the tracker's images; none with --grab.",
    )
    tracker_is_ideal: bool = switch(
        "Take the tracker's lens as ideal; the file then holds both lenses."
    )
    plot: Path | None = option("OUT.png", "The error over the screen, and the residuals.")
    as_json: bool = json_option()


def geometric(options: GeometricOptions, dots_from: DotOptions) -> None:
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

    check_ending("-o", options.output, TOML)
    check_ending("--plot", options.plot, PNG)
    file = read_bench_file(options.bench_file)
    observed = options.observed or []
    plan_file = options.plan / "plan.csv"
    check_files([*observed, dots_from.dark, plan_file], [options.output, options.plot], file)
    taken = dot_images(file, observed, options.plan, dots_from)
    with busy("fitting the geometry"):
        calibration = calibrate_files(
            file,
            taken.images,
            plan_file,
            taken.dark,
            tracker_is_ideal=options.tracker_is_ideal,
        )
    written = write_calibrated(options.output, calibration, options.plot, _monitor_of_bench(file))
    summary = summary_of(calibration, written)
    lines = lines_of(calibration)
    lines.append(NAMED.format(options.output.name))
    print_found(options.as_json, summary, lines)


@struct
class PsfOptions:
    """The options of `hilstar calibrate psf`."""

    bench_file: Path = bench_argument()
    plan: Path = option("DIR", "Directory that `calibrate dots` wrote.")
    output: Path = output_option("PSF.fits", "The file for [tracker.optics] psf.")
    images: list[Path] | None = argument(
        "IMAGES...", "The tracker's images of the dots; none with --grab."
    )
    oversampling: int = option(
        "N", "Samples a tracker pixel along each axis.", default=4, min=2, max=16
    )
    plot: Path | None = option("OUT.png", "The PSFs over the field.")
    as_json: bool = json_option()


def psf(options: PsfOptions, dots_from: DotOptions) -> None:
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

    check_ending("-o", options.output, FITS)
    check_ending("--plot", options.plot, PNG)
    file = read_bench_file(options.bench_file)
    images = options.images or []
    plan_file = options.plan / "plan.csv"
    check_files([*images, dots_from.dark, plan_file], [options.output, options.plot], file)
    taken = dot_images(file, images, options.plan, dots_from)
    with busy("finding the PSFs"):
        psf_result = effective_psf(file, taken.images, plan_file, taken.dark, options.oversampling)
    write_glass(options.output, psf_result.glass)
    written = [str(options.output)]
    if options.plot is not None:
        draw_effective(options.plot, psf_result)
        written.append(str(options.plot))
    summary = summary_of(psf_result)
    summary["written"] = written
    lines = lines_of(psf_result)
    lines.append(f"in the bench file, under [tracker.optics]: psf = {options.output.name!r}")
    print_found(options.as_json, summary, lines)


@struct
class FocusOptions:
    """The options of `hilstar calibrate focus`."""

    bench_file: Path = bench_argument()
    grab: str | None = grab_option()
    virtual: Path | None = option(
        "TRUTH.toml", "Without hardware: a bench file that says how the bench really is."
    )
    answers: bool = switch(
        "In place of images: the widths of stars that the tracker's answers ([answers]) report,"
        " of a still sky at --radec, --star or --quaternion."
    )
    headless: bool = switch("With --answers: draw without a window, for --feed.")
    images: int | None = option("N", "End after so many figures. [at Ctrl-C]", min=1)
    exposure: float | None = exposure_option()
    feed: str | None = option(
        "ENDPOINT", "Hand the dots or the sky on to who watches there (tcp://127.0.0.1:5570)."
    )
    as_json: bool = json_option()


def focus(options: FocusOptions, pointing: PointingOptions, page: PageOptions) -> None:
    """Measure the PSF's sigma in image after image while somebody turns the tracker's ring, or the
    widths of stars in its answers.

    A line for each image, or for the answers of half a second, has the figure, the best so far and
    a curve of the last 40; it says where stars are drawn out or saturate the tracker. --console
    shows the same on a page. Ctrl-C ends it with the best. With --json there is an object for each
    figure, and one of the best at the end.
    """
    from hilstar.basics.process.interrupts import stop_on_signal
    from hilstar.server.answers.star_widths import WHAT, FocusCurve, FocusReading, figure_text
    from hilstar.server.bench.bench_file import read_bench_file

    _check_focus_source(options, pointing)
    file = read_bench_file(options.bench_file)
    check_files([options.virtual], [], file)
    stop = threading.Event()
    curve = FocusCurve("answers" if options.answers else "images")
    with page_listener(page) as listener, stop_on_signal(stop), ExitStack() as stack:
        shown = None
        if listener is not None:
            from hilstar.server.console.publisher import session_page

            shown = stack.enter_context(session_page(listener, False, file, "calibrate focus"))

        def take(reading: FocusReading) -> bool:
            curve.add(reading)
            if shown is not None:
                shown.focus = curve.state()
            print_found(options.as_json, reading, [curve.line()])
            return stop.is_set() or reading.number == options.images

        watch = None if shown is None else shown.show
        if options.answers:
            _focus_by_answers(file, options, pointing, take, stop, watch)
        else:
            _focus_by_images(file, options, take, stop, watch)
    best = curve.best
    if best is None or best.figure is None:
        raise InputError(curve.why_none())
    summary = {"best": best, "images": curve.count}
    what = curve.source.removesuffix("s")
    place = f"{what} {best.number} of {curve.count}, after {best.t_s:.0f} s"
    line = f"best: {WHAT[curve.source]} {figure_text(best.figure)}: {place}"
    print_found(options.as_json, summary, [line])


def _check_focus_source(options: FocusOptions, pointing: PointingOptions) -> None:
    """Refuse (InputError) options of `calibrate focus` that exclude each other."""
    sources = [options.grab is not None, options.virtual is not None, options.answers]
    if sum(sources) != 1:
        raise InputError(
            "give --grab CMD or a camera, or --virtual TRUTH.toml, or --answers: one of them"
        )
    if options.answers and options.exposure is not None:
        raise InputError("--exposure: is for --grab; leave it out")
    if not options.answers and pointing.given:
        raise InputError("--radec, --star and --quaternion are for --answers; leave the sky out")
    if not options.answers and options.headless:
        raise InputError("--headless: is for --answers; leave it out")
    if options.headless and options.feed is None:
        raise InputError("--headless: nobody sees the sky; add --feed ENDPOINT, or leave it out")


def _focus_by_images(
    file: "BenchFile",
    options: FocusOptions,
    take: "Callable[[FocusReading], bool]",
    stop: threading.Event,
    watch: "Callable[[Pattern], None] | None",
) -> None:
    from hilstar.instruments.calibrate.first_light.image_sources import NoImage, Stopped
    from hilstar.instruments.calibrate.grabbed_dots import exposure_of
    from hilstar.instruments.calibrate.live_focus import focus_readings

    source_options = ImageOptions(grab=options.grab, virtual=options.virtual, dark=None, diode=None)
    with (
        temporary_folder("focus") as folder,
        closing(image_source(file, source_options)) as source,
        handed_on(options.feed, source),
    ):
        exposure_s = exposure_of(file, source, options.exposure)
        try:
            for reading in focus_readings(file, source, folder, exposure_s, watch):
                if take(reading):
                    break
        except Stopped:
            pass
        except NoImage:
            # Ctrl-C at a terminal ends the command of --grab, too.
            if not stop.is_set():
                raise


def _focus_by_answers(
    file: "BenchFile",
    options: FocusOptions,
    pointing: PointingOptions,
    take: "Callable[[FocusReading], bool]",
    stop: threading.Event,
    watch: "Callable[[Pattern], None] | None",
) -> None:
    from hilstar.attitude.wire.shown_frames import FrameSender
    from hilstar.basics.notices import Notices
    from hilstar.instruments.calibrate.first_light.image_sources import (
        PatternDisplay,
        PatternFrames,
        Stopped,
    )
    from hilstar.instruments.calibrate.live_focus import follow_answers, headless_hold, still_sky
    from hilstar.server.answers.reader import open_answers

    settings = file.config.answers
    if settings is not None and settings.format in {"packet", "frame"}:
        raise InputError(
            f'--answers: [answers] format = "{settings.format}" carries no stars and so no widths;'
            ' write "json" or a Python function, or give --grab CMD in place of it'
        )
    q_icrs_to_cam = attitude_of("calibrate focus --answers", pointing, file.config.sky.epoch_jyear)
    with ExitStack() as stack:
        frames = None
        if options.feed is not None:
            sender = stack.enter_context(FrameSender(options.feed))
            frames = PatternFrames(sender)
            say(f"frames: {sender.endpoint}")
        source = stack.enter_context(open_answers(file.config, file.folder, Notices()))
        sky = still_sky(file, q_icrs_to_cam)
        if watch is not None:
            watch(sky)
        if options.headless:
            hold = headless_hold(frames, file, sky)
        else:
            display = stack.enter_context(PatternDisplay())
            display.frames = frames
            hold = partial(display.show_until, file, sky)
        with suppress(Stopped):
            follow_answers(source, hold, take, stop.is_set)


def _monitor_of(display: int | str, modes: tuple[str, ...] = ("",)) -> "MonitorIdentity | None":
    """The identity of the display that was measured, where this machine has it and its mode begins
    like one of `modes`; None elsewhere.
    """
    from hilstar.display.window.this_monitor import identity_here

    identity = identity_here(display)
    if identity is None or not identity.mode.startswith(modes):
        return None
    say(f"measured on {identity.name()}")
    return identity


def _monitor_of_bench(file: "BenchFile") -> "MonitorIdentity | None":
    """The same of a bench's display, which may stand on its side."""
    monitor = file.config.monitor
    width_px, height_px = monitor.resolution_px
    modes = (f"{width_px}x{height_px}@", f"{height_px}x{width_px}@")
    return _monitor_of(monitor.display, modes)


def _display_of(text: str) -> int | str:
    """A display by its number or its name."""
    if text.isdecimal():
        return int(text)
    return text


@struct
class AlignmentOptions:
    """The options of `hilstar calibrate alignment`."""

    bench_file: Path = bench_argument()
    pairs: Path = argument(
        "PAIRS.csv",
        "Commanded and reported q_icrs_to_cam, scalar first: qw,qx,qy,qz,tw,tx,ty,tz[,valid]. With"
        " --ledger, the tracker's telemetry: t_s,qw,qx,qy,qz[,valid].",
    )
    output: Path = output_option("geometry.toml", "The geometry file.")
    ledger: Path | None = option(
        "RUN.mcap",
        "The ledger of the run that the telemetry is of: t_s is the middle of an exposure in"
        " seconds of the ledger's light_ns, the sender's clock.",
    )
    offset_s: float | None = option(
        "SECONDS", "With --ledger: seconds to add to the telemetry's t_s; 0 by default."
    )
    as_json: bool = json_option()


def alignment(options: AlignmentOptions) -> None:
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

    check_ending("-o", options.output, TOML)
    if options.offset_s is not None and options.ledger is None:
        raise InputError(
            "--offset-s: pairs have no times; give it with --ledger RUN.mcap and the tracker's"
            " telemetry"
        )
    if options.offset_s is not None and not abs(options.offset_s) < MAX_OFFSET_S:
        raise InputError(
            f"--offset-s {options.offset_s}: write seconds, less than {MAX_OFFSET_S:g} either way"
        )
    file = read_bench_file(options.bench_file)
    check_files([options.pairs, options.ledger], [options.output], file)
    with busy("fitting the alignment"):
        aligned = align_files(file, options.pairs, options.ledger, options.offset_s or 0.0)
    write_alignment(options.output, aligned, file, _monitor_of_bench(file))
    summary = summary_of(aligned)
    summary["written"] = [str(options.output)]
    lines = lines_of(aligned)
    lines.append(NAMED.format(options.output.name))
    print_found(options.as_json, summary, lines)


@struct
class PlanOptions:
    """The options of `hilstar calibrate plan`."""

    output: Path = output_option("PLAN.csv", "The plan, to be filled in.")
    bits: int = option("N", "Bits per code.", default=8, min=1, max=16)
    levels: int = option(
        "N", "Levels from black to white; half of white is added.", default=32, min=2
    )
    repeats: int = option(
        "N", "Repeats of each level; 3 are enough for a plain power law.", default=6, min=1
    )
    channels: str = option("wrgb", "Channels to measure, of w, r, g, b.", default="w")
    seed: int = seed_option("Seed of the order.")
    headless: Path | None = option("DIR", "Write the patches to this directory as PNG.")
    resolution: str = option("W,H", "Size of the pictures.", default="1920,1080")
    show: bool = switch("Show the patches on a display: space for the next, q to quit.")
    display: str = option("INDEX|NAME", "With --show: the display.", default="0")
    dwell: float | None = option(
        "SECONDS", "With --show: time for each patch, without keys.", min=0
    )
    overwrite: bool = overwrite_option()
    as_json: bool = json_option()


def plan(options: PlanOptions) -> None:
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

    check_ending("-o", options.output, CSV)
    check_directory("--headless", options.headless)
    # only what a person filled in cannot be made again
    if is_filled_in(options.output):
        check_files([], [], None, options.output, options.overwrite)
    size_px = parse_resolution(options.resolution)
    settings = PlanSettings(options.bits, options.levels, options.repeats, options.channels)
    planned = plan_patches(settings, np.random.default_rng(options.seed))
    write_plan(options.output, planned)
    written = [str(options.output)]
    if options.headless is not None:
        write_patches(options.headless, planned, size_px, options.bits)
        written.append(str(options.headless))
    codes = len({patch.code for patch in planned})
    line = f"{len(planned)} patches of {codes} codes in {', '.join(written)}"
    advice = "fill in the column value, and give the file to hilstar calibrate photometric"
    summary = {
        "bits": options.bits,
        "patches": len(planned),
        "codes": codes,
        "seed": options.seed,
        "written": written,
    }
    print_found(options.as_json, summary, [line, advice])
    if options.show:
        display = _display_of(options.display)
        shown = show_patches(planned, options.bits, display, options.dwell)
        say(f"{shown} of {len(planned)} patches shown")
    elif options.headless is None:
        say(
            "add --show for the patches on a display (space for the next one), or --headless DIR"
            " for pictures of them"
        )


@struct
class PhotometricOptions:
    """The options of `hilstar calibrate photometric`."""

    measured: Path = argument("MEASURED.csv", "code,channel,value; see configs/CALIBRATION.md.")
    output: Path = output_option("MONITOR.toml", "The calibration file.")
    bits: int | None = option(
        "N", "Bits per code; by default from the codes measured.", min=1, max=16
    )
    who: str = option("NAME", "Who made the measurements.", default="")
    when: str = option("DATE", "Date of the measurements; today by default.", default="")
    instrument: str = option("NAME", "Instrument used.", default="")
    unit: str = option("UNIT", "Unit of the values, such as cd/m2 or DN.", default="")
    plot: Path | None = option("OUT.png", "The response and its residuals.")
    display: str = option(
        "INDEX|NAME", "The display that was measured, where this machine has one.", default="0"
    )
    as_json: bool = json_option()


def photometric(options: PhotometricOptions) -> None:
    """Fit the monitor's response to measured patches."""
    from hilstar.instruments.calibrate.photometric import (
        Provenance,
        calibrate_photometric,
        draw_calibration,
    )

    check_ending("-o", options.output, TOML)
    refuse_stdout("-o", options.output)
    check_ending("--plot", options.plot, PNG)
    table = options.output.with_suffix(".csv")
    check_files([options.measured], [options.output, table, options.plot])
    identity = _monitor_of(_display_of(options.display))
    provenance = Provenance(options.who, options.when, options.instrument, options.unit)
    with busy("fitting the response"):
        summary = calibrate_photometric(
            options.measured, options.output, provenance, options.bits, identity
        )
    if options.plot is not None:
        draw_calibration(options.measured, options.plot, options.bits)
        summary["written"].append(str(options.plot))
    lines = list(_response_lines(summary))
    lines.append(f"{'written':20}{', '.join(summary['written'])}")
    name = json.dumps(options.output.name)
    lines.append(f"{'in the bench file':20}[monitor] calibration = {name}")
    print_found(options.as_json, summary, lines)


def _response_lines(summary: dict[str, Any]) -> Iterator[str]:
    """The figures of a monitor's response as lines of text."""
    black = summary["black_level"]["relative"]
    contrast = "unknown: no light at code 0"
    if black > 0:
        contrast = f"1 : {1 / black:.0f}"
    drift = "not known"
    if summary["drift_percent"] is not None:
        drift = f"{summary['drift_percent']:+.2f} %"
    codes = f"{summary['codes']} codes above black, {summary['bits']} bits"
    yield f"{'measured':20}{codes}; drift {drift}"
    yield f"{'black level':20}{black:.3e} of white, contrast {contrast}"
    yield f"{'noise':20}{100 * summary['noise_relative']:.2f} % of a reading"
    holdout = summary["holdout"]
    percents = [f"{holdout[name]:.2f}" for name in ("rms_percent", "p95_percent", "max_percent")]
    yield (
        f"{'held-out levels':20}{' / '.join(percents)} % (rms / 95 % / max),"
        f" {holdout['max_mag']:.4f} mag maximum"
    )
    if len(summary["channels"]) > 1:
        yield from _channel_lines(summary["channels"])
    crosstalk = summary["crosstalk_percent"] or {}
    for decade, percent in crosstalk.items():
        error = summary["crosstalk_error_percent"][decade]
        label = f"crosstalk at {decade}"
        yield f"{label:20}r + g + b is {percent:+.2f} +- {error:.2f} % from w"


def _channel_lines(channels: dict[str, Any]) -> Iterator[str]:
    """The response of each channel as a line of text."""
    for name, channel in channels.items():
        rms = channel["holdout"]["rms_percent"]
        black = channel["black_level"]["relative"]
        fit = f"{channel['shape']}, held-out levels {rms:.2f} % rms"
        yield f"{f'channel {name}':20}{fit}, black {black:.3e} of its white"


@struct
class ScaleOptions:
    """The options of `hilstar calibrate scale`."""

    bench_file: Path = bench_argument()
    reading: list[str] = option(
        "HIP,DN[,SIGMA]",
        "A star, the sum of its DN above the background, and the noise of that sum.",
    )
    exposure: float | None = option(
        "SECONDS", "The tracker's exposure; by default the bench file's."
    )
    output: Path | None = output_option("OUT.toml", "A copy of the bench file with the key set.")
    as_json: bool = json_option()


def scale(options: ScaleOptions) -> None:
    """Scale the light by the tracker: what one pixel at white is worth, from its readings of
    stars shown.
    """
    from hilstar.instruments.calibrate.scale import UNSURE_MAG, scale_by_tracker, with_flux_at_white
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.build import open_bench

    check_ending("-o", options.output, TOML)
    file = read_bench_file(options.bench_file)
    check_files([], [options.output], file)
    readings = [parse_reading(text) for text in options.reading]
    exposure_s = options.exposure
    if exposure_s is None:
        exposure_s = file.config.tracker.exposure_s
    with open_bench(file) as bench:
        scaled = scale_by_tracker(bench, readings, exposure_s)
    if scaled.scatter_mag > UNSURE_MAG:
        say(
            f"the readings disagree by {scaled.scatter_mag:.3f} mag: look at background,"
            " saturation, and the response"
        )
    written = None
    if options.output is not None:
        with_flux_at_white(file, scaled, options.output)
        written = str(options.output)
    summary = {
        "flux_at_white_e_per_s": scaled.flux_at_white_e_per_s,
        "assumed_e_per_s": scaled.assumed_e_per_s,
        "scatter_mag": scaled.scatter_mag,
        "relative_error": scaled.relative_error,
        "readings": len(readings),
        "exposure_s": exposure_s,
        "written": written,
    }
    lines = [
        f"# by {len(readings)} readings of {exposure_s:g} s, scatter {scaled.scatter_mag:.4f} mag;"
        " under [render]:",
        f"flux_at_white_e_per_s = {scaled.flux_at_white_e_per_s!r}",
    ]
    if scaled.relative_error is not None:
        lines.append("# and how well it is known, under [certify]:")
        lines.append(f"flux_at_white_relative = {scaled.relative_error:.3g}")
        lines.append(f"flux_at_white_dof = {scaled.dof}")
    print_found(options.as_json, summary, lines)


@struct
class ReferenceOptions:
    """The options of `hilstar calibrate reference`."""

    readings: Path = argument(
        "READINGS.csv",
        "target,azimuth_deg,elevation_deg[,station][,sigma_arcsec][,x_px,y_px]: faces of the cube"
        " (+x, -y, ...), lit dots (dot), and links between stations (docs: Calibration files).",
    )
    bench_file: Path | None = option(
        "BENCH.toml", "The bench, for dots by their pixels.", "--bench"
    )
    output: Path | None = output_option("FILE.toml", "Write the table [alignment] here.")
    name: str = option("TEXT", "What the reference is.", default="")
    as_json: bool = json_option()


def reference(options: ReferenceOptions) -> None:
    """Find how the display stands to the tracker's cube from a theodolite's readings: the table
    [alignment] of the bench file.
    """
    from hilstar.instruments.calibrate.reference import (
        fit_reference,
        lines_of,
        read_readings,
        summary_of,
        toml_of,
    )
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.cameras import bench_camera

    check_ending("-o", options.output, TOML)
    camera = None
    file = None
    if options.bench_file is not None:
        file = read_bench_file(options.bench_file)
        camera = bench_camera(file.config, file.folder)
    check_files([options.readings, options.bench_file], [options.output], file)
    fitted = fit_reference(options.readings, read_readings(options.readings, camera))
    today = datetime.now(UTC).date().isoformat()
    table = toml_of(fitted, options.name, today)
    written = []
    if options.output is not None:
        write_whole(options.output, table)
        written.append(str(options.output))
    summary = summary_of(fitted)
    summary["written"] = written
    lines = [*lines_of(fitted), "in the bench file:", *table.splitlines()]
    print_found(options.as_json, summary, lines)
