"""hilstar convert: an attitude log in another form."""

from pathlib import Path

from hilstar.basics.units import NS_PER_S
from hilstar.cli.declare import argument, struct
from hilstar.cli.options import LOG_HELP, LogStatements, check_files, json_option
from hilstar.server.console.terminal import busy, print_found, say


@struct
class ConvertOptions:
    """The options of `hilstar convert`."""

    log: Path = argument("LOG", LOG_HELP)
    output: Path = argument("OUT", ".csv, .jsonl, .aem, .xml or .mcap.")
    as_json: bool = json_option()


def convert(options: ConvertOptions, statements: LogStatements) -> None:
    """Convert an attitude log to another format."""
    from hilstar.attitude.clock.resolution import coarse_lines
    from hilstar.attitude.logs.log_file import open_log, write_log

    check_files([options.log], [options.output])
    with busy("reading the log"):
        read = open_log(options.log, statements.stated())
        notes = [line for _, line in [*read.told, *coarse_lines(read.samples)]]
        doubt = read.joins().doubt
    if doubt:
        notes.append(doubt)
    for line in notes:
        say(line)
    with busy("writing the log"):
        write_log(options.output, read.samples, read.conventions.scale)
    fields = {
        "attitudes": len(read.samples),
        "duration_s": (read.samples[-1].t_ns - read.samples[0].t_ns) / NS_PER_S,
        "source": read.conventions.source,
        "notes": notes,
        "written": [str(options.output)],
    }
    print_found(options.as_json, fields, [f"{len(read.samples)} attitudes in {options.output}"])
