"""hilstar convert: an attitude log in another form."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import (
    LOG_HELP,
    BodyName,
    EpochUtc,
    KernelFiles,
    MountingText,
    PlaceText,
    ReferenceName,
    TopicName,
    check_files,
    parse_mounting,
    parse_place,
)
from hilstar.console.terminal import say


def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help=LOG_HELP)],
    output: Annotated[Path, typer.Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
    kernel: KernelFiles = None,
    topic: TopicName = None,
    body: BodyName = None,
    reference: ReferenceName = None,
    epoch_utc: EpochUtc = None,
    place: PlaceText = None,
    mounting: MountingText = None,
) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.logs.log_file import open_log, write_log

    check_files([log], [output])
    read = open_log(
        log, Stated(parse_mounting(mounting), tuple(kernel or ()), topic, body, reference, epoch_utc, parse_place(place))
    )
    for _, line in read.told:
        say(line)
    write_log(output, read.samples, read.conventions.scale)
    typer.echo(f"{len(read.samples)} attitudes in {output}")
