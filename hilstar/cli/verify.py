"""hilstar verify: the digital twin of a bench."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import (
    bench_argument,
    json_option,
    output_option,
    scenario_option,
    seed_option,
)
from hilstar.cli.running import optional_scenario, say_units_of
from hilstar.server.console.terminal import print_found, print_json, progress

if TYPE_CHECKING:
    from hilstar.server.bench.bench_file import HeadsFile


@struct
class VerifyOptions:
    """The options of `hilstar verify`."""

    bench_file: Path = bench_argument()
    fields: int = option("N", "Number of random attitudes.", default=10, min=1, max=100_000)
    seed: int = seed_option("Seed of the attitudes and the noise.")
    output: Path | None = output_option("DIR", "Directory for charts and a table.")
    strict: bool = switch("Exit with code 1 if the bench does not pass.")
    propose: bool = switch("Was removed.", hidden=True)
    write: bool = switch("Was removed.", hidden=True)
    scenario: Path | None = scenario_option()
    as_json: bool = json_option()


def verify(options: VerifyOptions) -> None:
    """Run the digital twin: what the tracker would measure of the stars shown, against the sky."""
    import numpy as np

    from hilstar.instruments.verify.summary import summarise, summary_lines, write_report
    from hilstar.instruments.verify.summary import verify as run_twin
    from hilstar.server.bench.bench_file import HeadsFile, read_bench_or_heads

    if options.propose:
        raise _moved_to_explain("--propose", options.bench_file)
    if options.write:
        raise _moved_to_explain("--write", options.bench_file)
    check_directory("-o", options.output)
    file = read_bench_or_heads(options.bench_file)
    if isinstance(file, HeadsFile):
        given = {"-o": options.output, "--strict": options.strict, "--scenario": options.scenario}
        for flag in [name for name, value in given.items() if value]:
            raise InputError(
                f"verify {flag}: is of one bench; leave it out, or give one of the heads' files"
                f" of {options.bench_file}"
            )
        _verify_heads(file, options.fields, options.seed, options.as_json)
        return
    wrong = optional_scenario(options.scenario)
    with progress("verifying", options.fields) as advance:
        verdict = run_twin(
            file, options.fields, np.random.default_rng(options.seed), advance, wrong
        )
    if options.output is not None:
        write_report(make_directory(options.output), verdict)
    summary = summarise(verdict)
    if options.as_json:
        print_json(summary)
    else:
        typer.echo("\n".join(summary_lines(summary)))
    say_units_of(file)
    if options.strict and not verdict.passed:
        raise typer.Exit(1)


def _moved_to_explain(option: str, bench_file: Path) -> InputError:
    """The refusal of an option that tried keys of the bench file."""
    return InputError(
        f"verify {option}: was removed; hilstar frame {bench_file} --radec RA,DEC,ROLL --explain"
        " lists each key that would do, with its error (--json: effort.would_do); set one yourself"
    )


def _verify_heads(heads: "HeadsFile", fields: int, seed: int, as_json: bool) -> None:
    """Print the errors of the angles between the heads of a file."""
    import numpy as np

    from hilstar.instruments.simulate.heads import verify_heads

    with progress("verifying", fields) as advance:
        rng = np.random.default_rng(seed)
        pairs = [pair.summary() for pair in verify_heads(heads, fields, rng, advance)]
    lines = [_pair_line(pair) for pair in pairs]
    print_found(as_json, {"angles": pairs}, lines)


def _pair_line(pair: dict[str, Any]) -> str:
    """The errors of the angle between two heads."""
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
    return f"{f'{first} to {second}':20}{agreement}"
