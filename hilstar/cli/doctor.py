"""hilstar doctor: what this machine has and lacks, and whether a bench file is plausible."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import typer

from hilstar.cli.declare import argument, struct, switch
from hilstar.cli.options import json_option
from hilstar.cli.running import say_units
from hilstar.server.console.terminal import busy, print_found, print_json, print_states


@struct
class DoctorOptions:
    """The options of `hilstar doctor`."""

    bench_file: Path | None = argument(
        "[BENCH.toml]",
        "A bench file, or one with heads, to be checked too.",
        show_default=False,
    )
    as_json: bool = json_option()
    report: bool = switch(
        "Print this machine as a row of the table of docs/where-it-fails.md, without names or"
        " serial numbers."
    )


def doctor(options: DoctorOptions) -> None:
    """Check this machine's OpenGL, displays, links and files, and say what is missing; of a
    bench file, what it means.
    """
    from hilstar.server.doctor import examine, examine_bench, row, table

    if options.report:
        cells = row()
        print_found(options.as_json, cells, [table(cells)])
        return
    with busy("examining this machine"):
        benches = examine_bench(options.bench_file, datetime.now(UTC).date())
        result = examine()
    for bench in benches.values():
        say_units(bench.fields)  # a star that is too wide is on the page, with its panels
    lines = [check.line() for check in result.checks]
    for output in result.outputs:
        lines += output.lines()
    fields = asdict(result)
    if benches:
        fields["benches"] = {name: bench.keys() for name, bench in benches.items()}
    for name, bench in benches.items():
        lines += bench.lines(name)
    if options.as_json:
        print_json(fields)
    else:
        print_states(lines)
    if not result.ok:
        raise typer.Exit(3)
    for bench in benches.values():
        bench.monitor.refuse(force=False)
