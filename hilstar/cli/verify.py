"""hilstar verify: the digital twin of a bench."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import MAX_SEED, BenchFile, Json, ScenarioFile
from hilstar.cli.running import optional_scenario, say_units_of
from hilstar.server.console.terminal import print_found, print_json, progress

if TYPE_CHECKING:
    from hilstar.instruments.verify.verdict import Verdict
    from hilstar.server.bench.bench_file import BenchFile as Bench
    from hilstar.server.bench.bench_file import HeadsFile


def verify(
    bench_file: BenchFile,
    fields: Annotated[int, Option(help="Number of random attitudes.", min=1, max=100_000)] = 10,
    seed: Annotated[
        int, Option(help="Seed of the attitudes and the noise.", min=0, max=MAX_SEED)
    ] = 0,
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="DIR", help="Directory for charts and a table."),
    ] = None,
    strict: Annotated[
        bool, Option("--strict", help="Exit with code 1 if the bench does not pass.")
    ] = False,
    propose: Annotated[
        bool,
        Option(
            "--propose",
            help="Find the smallest change of the bench file with which a failing bench passes.",
        ),
    ] = False,
    write: Annotated[
        bool, Option("--write", help="Find it, and make it in the bench file.")
    ] = False,
    scenario: ScenarioFile = None,
    as_json: Json = False,
) -> None:
    """Run the digital twin: what the tracker would measure of the stars shown, against the sky."""
    import numpy as np

    from hilstar.instruments.verify.proposals import check_writable
    from hilstar.instruments.verify.summary import summarise, summary_lines, write_report
    from hilstar.instruments.verify.summary import verify as run_twin
    from hilstar.server.bench.bench_file import HeadsFile, read_bench_or_heads

    check_directory("-o", output)
    file = read_bench_or_heads(bench_file)
    if isinstance(file, HeadsFile):
        given = {
            "-o": output,
            "--strict": strict,
            "--propose": propose,
            "--write": write,
            "--scenario": scenario,
        }
        for option in [name for name, value in given.items() if value]:
            raise InputError(
                f"verify {option}: is of one bench; leave it out, or give one of the heads' files"
                f" of {bench_file}"
            )
        _verify_heads(file, fields, seed, as_json)
        return
    if write:
        check_writable(file)
    wrong = optional_scenario(scenario)
    with progress("verifying", fields) as advance:
        verdict = run_twin(file, fields, np.random.default_rng(seed), advance, wrong)
    if output is not None:
        write_report(make_directory(output), verdict)
    summary = summarise(verdict)
    if not as_json:
        typer.echo("\n".join(summary_lines(summary)))
    proposed = _proposed(file, verdict, seed, write, as_json) if propose or write else {}
    if as_json:
        print_json(summary | proposed)
    say_units_of(file)
    mended = bool(proposed.get("written"))
    if strict and not verdict.passed and not mended:
        raise typer.Exit(1)


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
        linear, codes = pair["linear_arcsec"], pair["codes_arcsec"]
        told = "too few stars in both"
        if linear is not None and codes is not None:
            told = (
                f"{linear['rms']:.4f} / {linear['max']:.4f} arcsec from linear light,"
                f" {codes['rms']:.4f} / {codes['max']:.4f} from codes (rms / max, {pair['fields']}"
                " fields)"
            )
        lines.append(f"{f'{first} to {second}':20}{told}")
    print_found(as_json, {"angles": pairs}, lines)


def _proposed(
    file: "Bench", verdict: "Verdict", seed: int, write: bool, as_json: bool
) -> dict[str, Any]:
    """The keys of --propose and --write in the JSON object; the lines are printed unless that is
    wanted.
    """
    from hilstar.instruments.verify.proposals import proposal_lines, propose, write_proposal

    if verdict.passed:
        return {"proposal": None, "written": False}
    with progress("changes tried", float("inf")) as advance:
        found = propose(file, verdict, verdict.measured.field_count, seed, advance)
    if not as_json:
        typer.echo("\n".join(proposal_lines(file, found)))
    written = write and bool(found.changes)
    if written:
        write_proposal(file, found)
        if not as_json:
            typer.echo(f"{'written':20}{file.path}")
    return {"proposal": asdict(found), "written": written}
