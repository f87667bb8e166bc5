"""hilstar confront: photographs of the sky against the simulator, and the camera that took them."""

from pathlib import Path

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.image_source import exposure_option, photographs
from hilstar.cli.options import bench_argument, check_files, json_option, output_option
from hilstar.cli.pointing import PointingOptions, optional_attitude
from hilstar.server.console.terminal import print_found, progress, say

IMAGES, USUAL_COUNT = "images", 5


@struct
class ConfrontOptions:
    """The options of `hilstar confront`."""

    bench_file: Path = bench_argument()
    output: Path = output_option("DIR", "Directory for the page, tracker.toml, tables.")
    images: list[Path] | None = argument(
        "IMAGE...", "Raw frames: FITS, TIFF or PNG, 8 to 16 bits; none with --grab."
    )
    grab: str | None = option(
        "CMD|genicam:NAME",
        "Take the images now, into DIR/images: a command ({output}, {exposure_s}), or a camera.",
    )
    count: int | None = option("N", "With --grab: how many. [5]", min=1, max=1000)
    exposure: float | None = exposure_option()
    fixed: bool = switch(
        "Fit attitudes and background alone: does the bench file's camera predict these?"
    )
    taken: str | None = option("UTC", "When the images were taken, where they do not say it.")
    as_json: bool = json_option()
    strict: bool = switch("Exit with 1 where an image is beyond the limits.")


def confront(options: ConfrontOptions, pointing: PointingOptions) -> None:
    """Fit a tracker's camera to photographs of the sky, and hold what `simulate` predicts
    against them.
    """
    from hilstar.instruments.confront.images import parse_utc
    from hilstar.instruments.confront.measured_bench import read_tracker_file
    from hilstar.instruments.confront.run import OUTPUTS
    from hilstar.instruments.confront.run import confront as confront_files

    check_directory("-o", options.output)
    at_ns = None
    if options.taken is not None:
        at_ns = parse_utc(options.taken)
    file = read_tracker_file(options.bench_file)[0]
    start = optional_attitude("confront", pointing, file.config.sky.epoch_jyear)
    given = options.images or []
    check_files(given, [options.output / name for name in OUTPUTS], file)
    if options.grab is not None:
        if given:
            raise InputError(f"{given[0]}: --grab takes the images; leave one of them out")
        count = options.count or USUAL_COUNT
        folder = options.output / IMAGES
        given = photographs(file, options.grab, count, options.exposure, folder)
    for name, value in (("--count", options.count), ("--exposure", options.exposure)):
        if options.grab is None and value is not None:
            raise InputError(f"{name}: is for --grab; write --grab, or leave it out")
    if not given:
        raise InputError("confront: no image; give files, or --grab to take them")
    tell = (lambda line: None) if options.as_json else typer.echo
    with progress("confronting, percent", 100) as advance:
        confronted = confront_files(
            options.bench_file,
            given,
            options.output,
            start=start,
            at_ns=at_ns,
            fixed=options.fixed,
            tell=tell,
            advance=advance,
        )
    page = options.output / "index.html"
    print_found(options.as_json, confronted.figures, [*confronted.lines, f"page: {page}"])
    for note in (*confronted.notes, *confronted.failures):
        say(note)
    if options.strict and confronted.failures:
        raise typer.Exit(1)
