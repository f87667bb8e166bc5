"""hilstar study: charts of what each choice costs, and of where methods fail."""

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from hilstar.cli.options import Json, check_files
from hilstar.console.terminal import print_found, progress
from hilstar.errors import InputError
from hilstar.files import check_directory, make_directory

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
    "chain",
    "colour",
    "confront",
]

ROOMS = {"chain", "stability", "tradeoff"}  # the studies of more than one file
# The studies that draw times: on a busy machine they name no winner, and `right` is null.
TIMED = {"quantisation", "timing", "tradeoff", "economy", "prediction", "bodies", "faults", "colour"}
CHAIN_SCENES = 5


def study(
    what: Annotated[Study, Argument(help="The study.")],
    output: Annotated[Path, Option("-o", "--output", metavar="DIR", help="Directory for charts and tables.")],
    bench: Annotated[
        Path | None, Argument(metavar="[BENCH.toml]", help="The bench file of `chain`.", show_default=False)
    ] = None,
    quick: Annotated[bool, Option("--quick", help="Fewer rounds, where a full study takes minutes.")] = False,
    images: Annotated[
        Path | None, Option(metavar="DIR", help="Photographs for `confront`: a folder for each camera, with its guess.toml.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Draw charts and tables of what each choice costs in accuracy and in time, and of where methods fail."""
    check_directory("-o", output)
    if what == "chain" and bench is None:
        raise InputError("study chain: is of a bench; write hilstar study chain BENCH.toml -o DIR")
    if what != "chain" and bench is not None:
        raise InputError(f"study {what}: has benches of its own; leave out {bench}")
    if (what == "confront") != (images is not None):
        raise InputError(
            "study confront: is of photographs; add --images DIR"
            if images is None
            else f"study {what}: has no photographs; leave out --images"
        )
    with progress(f"study {what}", math.inf if bench is None else CHAIN_SCENES) as advance:
        if images is not None:
            from hilstar.study.confront import run as confront_set

            make_directory(output)
            lines, right = confront_set(output, images, quick), None
        elif bench is None:
            lines, right = study_lines(what, output, quick)
        else:
            lines, right = chain_lines(bench, output, quick, advance)
    told = {"study": what, "right": right, "findings": lines, "directory": str(output)}
    print_found(as_json, told, [*lines, f"figures and tables in {output}"])


def chain_lines(bench: Path, output: Path, quick: bool, advance: Callable[[int], object]) -> tuple[list[str], bool | None]:
    """Run the study of a bench's whole chain; what it found, and whether `auto` is on every front (None: not judged)."""
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.study.chain.run import OUTPUTS, run

    file = read_bench_file(bench)
    check_files([bench], [output / name for name in OUTPUTS], file)
    return run(file, output, quick, advance)


def study_lines(what: str, output: Path, quick: bool = False) -> tuple[list[str], bool | None]:
    """Run a study; what it found, and whether everything was right (None: its times cannot be judged)."""
    make_directory(output)
    study_of = import_module(f"hilstar.study.{what}{'.run' if what in ROOMS else ''}")
    if what in TIMED:
        lines, right = study_of.run(output, quick)
        return lines, right
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in study_of.run(output)], True
    if what == "stability":
        cases = study_of.run(output)
        lines = [
            f"{'right' if c.right else 'WRONG'}  {c.case}: {c.happens} ({c.why}); not {c.method}: {c.fails}" for c in cases
        ]
        return lines, all(case.right for case in cases)
    return study_of.run(output) if what == "outputs" else study_of.run(output, quick), True
