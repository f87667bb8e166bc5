"""hilstar catalogue: the stars of a bench as its tracker sees them."""

from pathlib import Path
from typing import Annotated

from typer import Option

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import STDOUT, check_outputs
from hilstar.cli.options import BenchFile, Json
from hilstar.server.console.terminal import busy, print_found


def catalogue(
    bench_file: BenchFile,
    output: Annotated[
        Path,
        Option(
            "-o",
            "--output",
            metavar="STARS.csv|fits|parquet|vot",
            help="The table; its ending says what it is.",
        ),
    ],
    faintest: Annotated[
        float | None,
        Option(
            "--faintest", metavar="MAG", help="Faintest V; the bench's by default.", min=-30, max=40
        ),
    ] = None,
    epoch: Annotated[
        float | None,
        Option(
            "--epoch",
            metavar="JYEAR",
            help="Julian year of the places; the bench's by default.",
            min=-10_000,
            max=10_000,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write the stars as the tracker sees them: places with errors, types, electrons per second,
    instrument magnitudes.
    """
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.catalogue import ENDINGS, bench_catalogue, write_catalogue

    if output != STDOUT and output.suffix.lower() not in ENDINGS:
        raise InputError(
            f"-o {shortened(str(output))}: give a name that ends in {', '.join(ENDINGS)}, or - for"
            " CSV on stdout"
        )
    check_outputs([bench_file], [output])
    file = read_bench_file(bench_file)
    with busy("computing the catalogue"):
        bench_stars = bench_catalogue(file, faintest, epoch)
        write_catalogue(output, bench_stars)
    fields = {
        "file": str(output),
        "stars": len(bench_stars),
        "epoch_jyear": bench_stars.epoch_jyear,
        "zero_points_mag": bench_stars.zero_points,
    }
    vega = bench_stars.zero_points["vega"]
    ab = bench_stars.zero_points["ab"]
    worth = f"an electron per second is {vega:.4f} mag (Vega), {ab:.4f} mag (AB)"
    print_found(
        as_json,
        fields,
        [f"{len(bench_stars)} stars at J{bench_stars.epoch_jyear:g}; {worth}; wrote {output}"],
    )
