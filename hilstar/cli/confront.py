"""hilstar confront: photographs of the sky against the simulator, and the camera that took them."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory
from hilstar.cli.image_source import Exposure, photographs
from hilstar.cli.options import (
    BenchFile,
    Json,
    check_files,
)
from hilstar.cli.pointing import QuaternionText, RadecText, StarText, optional_attitude
from hilstar.server.console.terminal import print_found, progress, say

IMAGES, USUAL_COUNT = "images", 5


def confront(
    bench_file: BenchFile,
    output: Annotated[
        Path,
        Option(
            "-o", "--output", metavar="DIR", help="Directory for the page, tracker.toml, tables."
        ),
    ],
    images: Annotated[
        list[Path] | None,
        Argument(
            metavar="IMAGE...",
            help="Raw frames: FITS, TIFF or PNG, 8 to 16 bits; none with --grab.",
        ),
    ] = None,
    grab: Annotated[
        str | None,
        Option(
            metavar="CMD|genicam:NAME",
            help=(
                "Take the images now, into DIR/images: a command ({output}, {exposure_s}), or a"
                " camera."
            ),
        ),
    ] = None,
    count: Annotated[
        int | None, Option(metavar="N", help="With --grab: how many. [5]", min=1, max=1000)
    ] = None,
    exposure: Exposure = None,
    fixed: Annotated[
        bool,
        Option(
            "--fixed",
            help="Fit attitudes and background alone: does the bench file's camera predict these?",
        ),
    ] = False,
    radec: RadecText = None,
    star: StarText = None,
    quaternion: QuaternionText = None,
    taken: Annotated[
        str | None,
        Option(
            "--taken", metavar="UTC", help="When the images were taken, where they do not say it."
        ),
    ] = None,
    as_json: Json = False,
    strict: Annotated[
        bool, Option("--strict", help="Exit with 1 where an image is beyond the limits.")
    ] = False,
) -> None:
    """Fit a tracker's camera to photographs of the sky, and hold what `simulate` predicts
    against them.
    """
    from hilstar.instruments.confront.images import parse_utc
    from hilstar.instruments.confront.measured_bench import read_tracker_file
    from hilstar.instruments.confront.run import OUTPUTS
    from hilstar.instruments.confront.run import confront as confront_files
    from hilstar.server.bench.bench_file import BenchFile as ReadFile

    check_directory("-o", output)
    at_ns = None if taken is None else parse_utc(taken)
    file: ReadFile = read_tracker_file(bench_file)[0]
    epoch_jyear = file.config.sky.epoch_jyear
    start = optional_attitude("confront", radec, star, quaternion, epoch_jyear)
    given = images or []
    check_files(given, [output / name for name in OUTPUTS], file)
    if grab is not None:
        if given:
            raise InputError(f"{given[0]}: --grab takes the images; leave one of them out")
        given = photographs(file, grab, count or USUAL_COUNT, exposure, output / IMAGES)
    for name, value in (("--count", count), ("--exposure", exposure)):
        if grab is None and value is not None:
            raise InputError(f"{name}: is for --grab; write --grab, or leave it out")
    if not given:
        raise InputError("confront: no image; give files, or --grab to take them")
    tell = (lambda line: None) if as_json else typer.echo
    with progress("confronting, percent", 100) as advance:
        confronted = confront_files(
            bench_file,
            given,
            output,
            start=start,
            at_ns=at_ns,
            fixed=fixed,
            tell=tell,
            advance=advance,
        )
    print_found(as_json, confronted.figures, [*confronted.lines, f"page: {output / 'index.html'}"])
    for note in (*confronted.notes, *confronted.failures):
        say(note)
    if strict and confronted.failures:
        raise typer.Exit(1)
