"""hilstar study: charts of what each choice costs, and of where methods fail."""

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import Json, check_files
from hilstar.cli.pointing import StarText, place_of
from hilstar.server.console.terminal import print_found, progress

if TYPE_CHECKING:
    from hilstar.instruments.study.chain.run import ChainStudy

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
    "limits",
    "rigs",
]

ROOMS = {"chain", "stability", "tradeoff"}  # the studies of more than one file
OF_A_BENCH = {"chain", "models", "outputs"}
OF_A_FIELD = {"models", "outputs"}
# The studies that draw times: on a busy machine they name no winner, and `right` is null.
TIMED = {
    "quantisation",
    "timing",
    "tradeoff",
    "economy",
    "prediction",
    "bodies",
    "faults",
    "colour",
}
CHAIN_SCENES = 5


def study(
    what: Annotated[Study, Argument(help="The study.")],
    output: Annotated[
        Path, Option("-o", "--output", metavar="DIR", help="Directory for charts and tables.")
    ],
    bench: Annotated[
        Path | None,
        Argument(
            metavar="[BENCH.toml]",
            help="The bench file of `chain`; of `models` and `outputs` one's own.",
            show_default=False,
        ),
    ] = None,
    radec: Annotated[
        str | None,
        Option(
            metavar="RA,DEC,ROLL",
            help="Of `models` and `outputs` of a bench: a field of one's own, beside the three.",
        ),
    ] = None,
    star: StarText = None,
    quick: Annotated[
        bool, Option("--quick", help="Fewer rounds, where a full study takes minutes.")
    ] = False,
    images: Annotated[
        Path | None,
        Option(
            metavar="DIR",
            help="Photographs for `confront`: a folder for each camera, with its guess.toml.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Draw charts and tables of what each choice costs in accuracy and in time, and of where
    methods fail.
    """
    check_directory("-o", output)
    refuse_unused(what, bench, radec, star, images)
    place = place_of("study", radec, star)
    answers: list[str] = []
    steps = CHAIN_SCENES if what == "chain" else math.inf
    with progress(f"study {what}", steps) as advance:
        if images is not None:
            from hilstar.instruments.study.confront import run as confront_set

            make_directory(output)
            lines = confront_set(output, images, quick)
            right = None
        elif bench is None:
            lines, right = study_lines(what, output, quick)
        elif what == "chain":
            chain = chain_study(bench, output, quick, advance)
            lines = chain.lines
            right = chain.right
            answers = chain.answers
        else:
            lines = thesis_lines(what, bench, output, place)
            right = True
    fields = {
        "study": what,
        "right": right,
        "findings": lines,
        "answers": answers,
        "directory": str(output),
    }
    print_found(as_json, fields, [*lines, f"figures and tables in {output}", *answers])


def refuse_unused(
    what: str, bench: Path | None, radec: str | None, star: str | None, images: Path | None
) -> None:
    """Refuse (InputError) what a study does not use, and what it lacks."""
    if what == "chain" and bench is None:
        raise InputError("study chain: is of a bench; write hilstar study chain BENCH.toml -o DIR")
    if bench is not None and what not in OF_A_BENCH:
        raise InputError(f"study {what}: has benches of its own; leave out {bench}")
    for option, given in (("--radec", radec), ("--star", star)):
        if given is None:
            continue
        if what not in OF_A_FIELD:
            raise InputError(f"study {what}: has fields of its own; leave out {option}")
        if bench is None:
            example = f"hilstar study {what} BENCH.toml {option} {given}"
            raise InputError(f"study {what} {option}: a field is seen by a bench; write {example}")
    if what == "confront" and images is None:
        raise InputError("study confront: is of photographs; add --images DIR")
    if what != "confront" and images is not None:
        raise InputError(f"study {what}: has no photographs; leave out --images")


def chain_study(
    bench: Path, output: Path, quick: bool, advance: Callable[[int], object]
) -> "ChainStudy":
    """Run the study of a bench's whole chain."""
    from hilstar.instruments.study.chain.run import OUTPUTS, run
    from hilstar.server.bench.bench_file import read_bench_file

    file = read_bench_file(bench)
    check_files([bench], [output / name for name in OUTPUTS], file)
    return run(file, output, quick, advance)


def thesis_lines(
    what: str, bench: Path, output: Path, place: tuple[float, float, float] | None
) -> list[str]:
    """Run the study of `models` or `outputs` with a bench, in the thesis's fields and at a
    place; what it found.
    """
    from hilstar.instruments.study import outputs, rapp
    from hilstar.instruments.study.fields import fields_of
    from hilstar.server.bench.bench_file import read_bench_file

    file = read_bench_file(bench)
    names = rapp.BENCH_FILES if what == "models" else outputs.output_files(fields_of(place))
    check_files([bench], [output / name for name in names], file)
    make_directory(output)
    if what == "models":
        return [
            f"{finding.figure}: {finding.text}" for finding in rapp.bench_rapp(output, file, place)
        ]
    return outputs.run(output, file, place)


def study_lines(what: str, output: Path, quick: bool = False) -> tuple[list[str], bool | None]:
    """Run a study; what it found, and whether everything was right (None: its times cannot be
    judged).
    """
    make_directory(output)
    study_of = import_module(f"hilstar.instruments.study.{what}{'.run' if what in ROOMS else ''}")
    if what in TIMED:
        lines, right = study_of.run(output, quick)
        return lines, right
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in study_of.run(output)], True
    if what == "stability":
        cases = study_of.run(output)
        lines = [
            f"{'right' if c.right else 'WRONG'}  {c.case}: {c.happens} ({c.why}); not {c.method}:"
            f" {c.fails}"
            for c in cases
        ]
        return lines, all(case.right for case in cases)
    return study_of.run(output) if what == "outputs" else study_of.run(output, quick), True
