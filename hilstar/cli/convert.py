"""hilstar convert: an attitude log in another form."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

from hilstar.cli import options
from hilstar.server.console.terminal import say


@options.log_statements
def convert(
    log: Annotated[Path, Argument(metavar="LOG", help=options.LOG_HELP)],
    output: Annotated[Path, Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
    statements: options.LogStatements = options.NOTHING_STATED,
) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.clock.resolution import coarse_lines
    from hilstar.attitude.logs.log_file import open_log, write_log

    options.check_files([log], [output])
    read = open_log(log, statements.stated())
    for _, line in [*read.told, *coarse_lines(read.samples)]:
        say(line)
    doubt = read.joins().doubt
    if doubt:
        say(doubt)
    write_log(output, read.samples, read.conventions.scale)
    typer.echo(f"{len(read.samples)} attitudes in {output}")
