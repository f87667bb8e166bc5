"""hilstar study: charts of what each choice costs, and of where methods fail."""

import math
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import check_files, json_option, output_option
from hilstar.cli.pointing import PlaceOptions, place_of
from hilstar.server.console.terminal import print_found, progress

if TYPE_CHECKING:
    from hilstar.instruments.study.chain.run import ChainStudy
    from hilstar.instruments.study.stability import FailureCase

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
WHOLE = {"models", "outputs", "stability"}  # the studies of which no part is quick
CHAIN_SCENES = 5


@struct
class FieldOptions(PlaceOptions):
    """The place of a study's own field."""

    radec: str | None = option(
        "RA,DEC,ROLL",
        "Of `models` and `outputs` of a bench: a field of one's own, beside the three.",
    )


@struct
class StudyOptions:
    """The options of `hilstar study`."""

    what: Study = argument("", "The study.")
    output: Path = output_option("DIR", "Directory for charts and tables.")
    bench: Path | None = argument(
        "[BENCH.toml]",
        "The bench file of `chain`; of `models` and `outputs` one's own.",
        show_default=False,
    )
    quick: bool = switch("Fewer rounds, where a full study takes minutes.")
    images: Path | None = option(
        "DIR", "Photographs for `confront`: a folder for each camera, with its guess.toml."
    )
    as_json: bool = json_option()


def study(options: StudyOptions, pointing: FieldOptions) -> None:
    """Draw charts and tables of what each choice costs in accuracy and in time, and of where
    methods fail.
    """
    check_directory("-o", options.output)
    refuse_unused(options, pointing)
    place = place_of("study", pointing)
    answers: list[str] = []
    with progress(f"study {options.what}", steps_of(options.what)) as advance:
        if options.images is not None:
            from hilstar.instruments.study.confront import run as confront_set

            make_directory(options.output)
            lines = confront_set(options.output, options.images, options.quick)
            right = None
        elif options.bench is None:
            lines, right = study_lines(options.what, options.output, options.quick)
        elif options.what == "chain":
            chain = chain_study(options.bench, options.output, options.quick, advance)
            lines = chain.lines
            right = chain.right
            answers = chain.answers
        else:
            lines = thesis_lines(options.what, options.bench, options.output, place)
            right = True
    fields = {
        "study": options.what,
        "right": right,
        "findings": lines,
        "answers": answers,
        "directory": str(options.output),
    }
    lines = [*lines, f"figures and tables in {options.output}", *answers]
    print_found(options.as_json, fields, lines)


def steps_of(what: Study) -> float:
    """The steps of a study's progress bar: the scenes of `chain`, infinite for all others."""
    if what == "chain":
        return CHAIN_SCENES
    return math.inf


def refuse_unused(options: StudyOptions, pointing: FieldOptions) -> None:
    """Refuse (InputError) what a study does not use, and what it lacks."""
    what = options.what
    bench = options.bench
    images = options.images
    if what == "chain" and bench is None:
        raise InputError("study chain: is of a bench; write hilstar study chain BENCH.toml -o DIR")
    if bench is not None and what not in OF_A_BENCH:
        raise InputError(f"study {what}: has benches of its own; leave out {bench}")
    for flag, value in (("--radec", pointing.radec), ("--star", pointing.star)):
        if value is None:
            continue
        if what not in OF_A_FIELD:
            raise InputError(f"study {what}: has fields of its own; leave out {flag}")
        if bench is None:
            example = f"hilstar study {what} BENCH.toml {flag} {value}"
            raise InputError(f"study {what} {flag}: a field is seen by a bench; write {example}")
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
    """The findings of `models` or `outputs` for a bench, in the thesis's fields and at a place."""
    from hilstar.instruments.study import outputs, rapp
    from hilstar.instruments.study.fields import fields_of
    from hilstar.server.bench.bench_file import read_bench_file

    file = read_bench_file(bench)
    names: Iterable[str] = rapp.BENCH_FILES
    if what != "models":
        names = outputs.output_files(fields_of(place))
    check_files([bench], [output / name for name in names], file)
    make_directory(output)
    if what != "models":
        return outputs.run(output, file, place)
    findings = rapp.bench_rapp(output, file, place)
    return [f"{finding.figure}: {finding.text}" for finding in findings]


def study_lines(what: str, output: Path, quick: bool = False) -> tuple[list[str], bool | None]:
    """The findings of a study, and whether all was right; None where its times cannot be judged on
    a busy machine.
    """
    make_directory(output)
    module = what
    if what in ROOMS:
        module = f"{what}.run"
    run = import_module(f"hilstar.instruments.study.{module}").run
    if what in WHOLE:
        return findings_of(what, run(output))
    return findings_of(what, run(output, quick))


def findings_of(what: str, result: Any) -> tuple[list[str], bool | None]:
    """The findings of a study and whether all was right, by what its `run` returns."""
    if what in TIMED:
        lines, right = result
        return lines, right
    if what == "models":
        return [f"{finding.figure}: {finding.text}" for finding in result], True
    if what == "stability":
        return [_case_line(case) for case in result], all(case.right for case in result)
    return result, True


def _case_line(case: "FailureCase") -> str:
    """A case in which another method fails, and whether this one was right."""
    verdict = "right" if case.right else "WRONG"
    answer = f"{verdict}  {case.case}: {case.happens} ({case.why})"
    return f"{answer}; not {case.method}: {case.fails}"
