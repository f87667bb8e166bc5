"""hilstar doctor: what this machine has and lacks, and whether a bench file is plausible."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from hilstar.cli.options import Json
from hilstar.cli.running import say_units
from hilstar.server.console.terminal import busy, print_found, print_json, print_states

OwnBench = Annotated[
    Path | None,
    Argument(
        metavar="[BENCH.toml]",
        help="A bench file, or one with heads, to be checked too.",
        show_default=False,
    ),
]
Report = Annotated[
    bool,
    Option(
        "--report",
        help=(
            "Print this machine as a row of the table of docs/where-it-fails.md, without names or"
            " serial numbers."
        ),
    ),
]


def doctor(bench_file: OwnBench = None, as_json: Json = False, report: Report = False) -> None:
    """Check this machine's OpenGL, displays, links and files, and say what is missing; of a
    bench file, what it means.
    """
    from hilstar.server.doctor import examine, examine_bench, row, table

    if report:
        cells = row()
        print_found(as_json, cells, [table(cells)])
        return
    with busy("examining this machine"):
        benches = examine_bench(bench_file, datetime.now(UTC).date())
        result = examine()
    for bench in benches.values():
        say_units(bench.fields)  # a star that is too wide is on the page, with its panels
    if benches:
        named = {"benches": {name: bench.keys() for name, bench in benches.items()}}
    else:
        named = {}
    lines = [check.line() for check in result.checks]
    lines += [line for output in result.outputs for line in output.lines()]
    lines += [line for name, bench in benches.items() for line in bench.lines(name)]
    if as_json:
        print_json(asdict(result) | named)
    else:
        print_states(lines)
    if not result.ok:
        raise typer.Exit(3)
    for bench in benches.values():
        bench.monitor.refuse(force=False)
