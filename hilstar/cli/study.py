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

Study = Literal["models", "outputs", "stability", "quantisation", "timing", "tradeoff", "economy", "prediction"]


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
    room = what in {"stability", "tradeoff"}
    study_of = import_module(f"hilstar.study.{what}{'.run' if room else ''}")
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in study_of.run(output)], True
    if what == "stability":
        places = study_of.run(output)
        lines = [
            f"{'right' if p.right else 'WRONG'}  {p.case}: {p.happens} ({p.why}); not {p.method}: {p.fails}" for p in places
        ]
        return lines, all(place.right for place in places)
    return study_of.run(output) if what == "outputs" else study_of.run(output, quick), True
