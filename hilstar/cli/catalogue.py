"""hilstar catalogue: the stars of a bench as its tracker sees them."""

from pathlib import Path

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import STDOUT, check_outputs
from hilstar.cli.declare import option, struct
from hilstar.cli.options import bench_argument, json_option, output_option
from hilstar.server.console.terminal import busy, print_found


@struct
class CatalogueOptions:
    """The options of `hilstar catalogue`."""

    bench_file: Path = bench_argument()
    output: Path = output_option(
        "STARS.csv|fits|parquet|vot", "The table; its ending says what it is."
    )
    faintest: float | None = option("MAG", "Faintest V; the bench's by default.", min=-30, max=40)
    epoch: float | None = option(
        "JYEAR", "Julian year of the places; the bench's by default.", min=-10_000, max=10_000
    )
    as_json: bool = json_option()


def catalogue(options: CatalogueOptions) -> None:
    """Write the stars as the tracker sees them: places with errors, types, electrons per second,
    instrument magnitudes.
    """
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.bench.catalogue import ENDINGS, bench_catalogue, write_catalogue

    output = options.output
    if output != STDOUT and output.suffix.lower() not in ENDINGS:
        endings = ", ".join(ENDINGS)
        raise InputError(
            f"-o {shortened(str(output))}: give a name that ends in {endings}, or - for CSV on"
            " stdout"
        )
    check_outputs([options.bench_file], [output])
    file = read_bench_file(options.bench_file)
    with busy("computing the catalogue"):
        bench_stars = bench_catalogue(file, options.faintest, options.epoch)
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
    count = f"{len(bench_stars)} stars at J{bench_stars.epoch_jyear:g}"
    print_found(options.as_json, fields, [f"{count}; {worth}; wrote {output}"])
