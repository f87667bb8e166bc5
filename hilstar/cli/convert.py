"""hilstar convert: an attitude log in another form."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

from hilstar.cli import options
from hilstar.console.terminal import say


def convert(
    log: Annotated[Path, Argument(metavar="LOG", help=options.LOG_HELP)],
    output: Annotated[Path, Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
    kernel: options.KernelFiles = None,
    topic: options.TopicName = None,
    body: options.BodyName = None,
    reference: options.ReferenceName = None,
    epoch_utc: options.EpochUtc = None,
    place: options.PlaceText = None,
    mounting: options.MountingText = None,
) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.logs.log_file import open_log, write_log

    options.check_files([log], [output])
    mounted, at = options.parse_mounting(mounting), options.parse_place(place)
    read = open_log(log, Stated(mounted, tuple(kernel or ()), topic, body, reference, epoch_utc, at))
    for _, line in read.told:
        say(line)
    write_log(output, read.samples, read.conventions.scale)
    typer.echo(f"{len(read.samples)} attitudes in {output}")
