"""hilstar convert: an attitude log in another form."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import LOG_HELP, check_files


def convert(
    log: Annotated[Path, typer.Argument(metavar="LOG", help=LOG_HELP)],
    output: Annotated[Path, typer.Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.logs.log_file import read_log, write_log

    check_files([log], [output])
    samples = read_log(log)
    write_log(output, samples)
    typer.echo(f"{len(samples)} attitudes in {output}")
