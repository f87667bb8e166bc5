"""hilstar verify: the digital twin of a bench."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import BenchFile, Json, ScenarioFile, seed_option
from hilstar.cli.running import optional_scenario, say_units_of
from hilstar.server.console.terminal import print_found, print_json, progress

if TYPE_CHECKING:
    from hilstar.server.bench.bench_file import HeadsFile


def verify(
    bench_file: BenchFile,
    fields: Annotated[
        int, Option(metavar="N", help="Number of random attitudes.", min=1, max=100_000)
    ] = 10,
    seed: Annotated[int, seed_option("Seed of the attitudes and the noise.")] = 0,
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="DIR", help="Directory for charts and a table."),
    ] = None,
    strict: Annotated[
        bool, Option("--strict", help="Exit with code 1 if the bench does not pass.")
    ] = False,
    propose: Annotated[bool, Option("--propose", hidden=True)] = False,
    write: Annotated[bool, Option("--write", hidden=True)] = False,
    scenario: ScenarioFile = None,
    as_json: Json = False,
) -> None:
    """Run the digital twin: what the tracker would measure of the stars shown, against the sky."""
    import numpy as np

    from hilstar.instruments.verify.summary import summarise, summary_lines, write_report
    from hilstar.instruments.verify.summary import verify as run_twin
    from hilstar.server.bench.bench_file import HeadsFile, read_bench_or_heads

    if propose:
        raise _moved_to_explain("--propose", bench_file)
    if write:
        raise _moved_to_explain("--write", bench_file)
    check_directory("-o", output)
    file = read_bench_or_heads(bench_file)
    if isinstance(file, HeadsFile):
        given = {"-o": output, "--strict": strict, "--scenario": scenario}
        for option in [name for name, value in given.items() if value]:
            raise InputError(
                f"verify {option}: is of one bench; leave it out, or give one of the heads' files"
                f" of {bench_file}"
            )
        _verify_heads(file, fields, seed, as_json)
        return
    wrong = optional_scenario(scenario)
    with progress("verifying", fields) as advance:
        verdict = run_twin(file, fields, np.random.default_rng(seed), advance, wrong)
    if output is not None:
        write_report(make_directory(output), verdict)
    summary = summarise(verdict)
    if as_json:
        print_json(summary)
    else:
        typer.echo("\n".join(summary_lines(summary)))
    say_units_of(file)
    if strict and not verdict.passed:
        raise typer.Exit(1)


def _moved_to_explain(option: str, bench_file: Path) -> InputError:
    """The refusal of an option that tried keys of the bench file."""
    return InputError(
        f"verify {option}: was removed; hilstar frame {bench_file} --radec RA,DEC,ROLL --explain"
        " lists each key that would do, with its error (--json: effort.would_do); set one yourself"
    )


def _verify_heads(heads: "HeadsFile", fields: int, seed: int, as_json: bool) -> None:
    import numpy as np

    from hilstar.instruments.simulate.heads import verify_heads

    with progress("verifying", fields) as advance:
        pairs = [
            pair.summary()
            for pair in verify_heads(heads, fields, np.random.default_rng(seed), advance)
        ]
    lines = []
    for pair in pairs:
        first, second = pair["heads"]
        linear = pair["linear_arcsec"]
        codes = pair["codes_arcsec"]
        agreement = "too few stars in both"
        if linear is not None and codes is not None:
            agreement = (
                f"{linear['rms']:.4f} / {linear['max']:.4f} arcsec from linear light,"
                f" {codes['rms']:.4f} / {codes['max']:.4f} from codes (rms / max, {pair['fields']}"
                " fields)"
            )
        lines.append(f"{f'{first} to {second}':20}{agreement}")
    print_found(as_json, {"angles": pairs}, lines)
