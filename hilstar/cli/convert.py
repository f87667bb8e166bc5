"""hilstar convert: an attitude log in another form."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from hilstar.basics.units import NS_PER_S
from hilstar.cli import options
from hilstar.server.console.terminal import busy, print_found, say


@options.log_statements
def convert(
    log: Annotated[Path, Argument(metavar="LOG", help=options.LOG_HELP)],
    output: Annotated[Path, Argument(metavar="OUT", help=".csv, .jsonl, .aem, .xml or .mcap.")],
    statements: options.LogStatements = options.NOTHING_STATED,
    as_json: options.Json = False,
) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.clock.resolution import coarse_lines
    from hilstar.attitude.logs.log_file import open_log, write_log

    options.check_files([log], [output])
    with busy("reading the log"):
        read = open_log(log, statements.stated())
        notes = [line for _, line in [*read.told, *coarse_lines(read.samples)]]
        doubt = read.joins().doubt
    if doubt:
        notes.append(doubt)
    for line in notes:
        say(line)
    with busy("writing the log"):
        write_log(output, read.samples, read.conventions.scale)
    fields = {
        "attitudes": len(read.samples),
        "duration_s": (read.samples[-1].t_ns - read.samples[0].t_ns) / NS_PER_S,
        "source": read.conventions.source,
        "notes": notes,
        "written": [str(output)],
    }
    print_found(as_json, fields, [f"{len(read.samples)} attitudes in {output}"])
