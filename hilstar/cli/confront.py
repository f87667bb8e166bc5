"""hilstar confront: photographs of the sky against the simulator, and the camera that took them."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from hilstar.basics.files import check_directory
from hilstar.cli.options import (
    BenchFile,
    Json,
    check_files,
)
from hilstar.cli.pointing import QuaternionText, RadecText, StarText, optional_attitude
from hilstar.server.console.terminal import print_found, say


def confront(
    bench_file: BenchFile,
    images: Annotated[
        list[Path],
        Argument(metavar="IMAGE...", help="Raw frames: FITS, TIFF or PNG, 8 to 16 bits."),
    ],
    output: Annotated[
        Path,
        Option(
            "-o", "--output", metavar="DIR", help="Directory for the page, tracker.toml, tables."
        ),
    ],
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
    check_files(images, [output / name for name in OUTPUTS], file)
    tell = (lambda line: None) if as_json else typer.echo
    confronted = confront_files(
        bench_file, images, output, start=start, at_ns=at_ns, fixed=fixed, tell=tell
    )
    print_found(as_json, confronted.figures, [*confronted.lines, f"page: {output / 'index.html'}"])
    for note in (*confronted.notes, *confronted.failures):
        say(note)
    if strict and confronted.failures:
        raise typer.Exit(1)
