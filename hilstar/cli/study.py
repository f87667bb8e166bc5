"""hilstar study: charts of what each choice costs, and of where methods fail."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import typer

from hilstar.cli.options import Json
from hilstar.console.terminal import print_json, progress
from hilstar.files import check_directory

Study = Literal[
    "models",
    "outputs",
    "stability",
    "quantisation",
    "timing",
    "tradeoff",
    "economy",
    "prediction",
    "geometry",
    "bodies",
    "faults",
]

ROOMS = {"bodies", "geometry", "models", "stability", "timing", "tradeoff"}  # the studies of more than one file


def study(
    what: Annotated[Study, typer.Argument(help="The study.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Directory for charts and tables.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer rounds, where a full study takes minutes.")] = False,
    as_json: Json = False,
) -> None:
    """Draw charts and tables of what each choice costs in accuracy and in time, and of where methods fail."""
    from hilstar.files import make_directory

    check_directory("-o", output)
    make_directory(output)
    with progress(f"study {what}", math.inf):
        lines, right = study_lines(what, output, quick)
    if as_json:
        print_json({"study": what, "right": right, "findings": lines, "directory": str(output)})
    else:
        typer.echo("\n".join([*lines, f"figures and tables in {output}"]))


def study_lines(what: str, output: Path, quick: bool = False) -> tuple[list[str], bool]:
    """Run a study; what it found, and whether everything was right."""
    study_of = import_module(f"hilstar.study.{what}{'.run' if what in ROOMS else ''}")
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in study_of.run(output)], True
    if what == "stability":
        cases = study_of.run(output)
        lines = [
            f"{'right' if c.right else 'WRONG'}  {c.case}: {c.happens} ({c.why}); not {c.method}: {c.fails}" for c in cases
        ]
        return lines, all(case.right for case in cases)
    return study_of.run(output) if what == "outputs" else study_of.run(output, quick), True
