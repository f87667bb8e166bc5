"""What the commands share: the app, options that several have, and the attitude of a command line."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from hilstar.errors import InputError

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Stars for a star tracker on a bench: attitudes in, frames of code values out.",
)

BenchFile = Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The bench file; see configs/README.md.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else there.")]
Headless = Annotated[bool, typer.Option("--headless", help="Draw without a window.")]
RadecText = Annotated[str | None, typer.Option("--radec", metavar="RA,DEC,ROLL", help="Boresight and roll in degrees, ICRS.")]
QuaternionText = Annotated[str | None, typer.Option("--quaternion", metavar="W,X,Y,Z", help="q_icrs_to_cam, scalar first.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an older file that cannot be made again.")]
MAX_SEED = 2**63 - 1  # what a FITS header holds
LOG_HELP = "CSV (t_s,qw,qx,qy,qz), JSON lines, CCSDS AEM, or a run's MCAP."


def attitude_of(command: str, radec: str | None, quaternion: str | None) -> Any:
    """The one attitude that the command line gives."""
    from hilstar.bench.build import checked_quaternion
    from hilstar.rotation import from_radec_roll_deg
    from hilstar.run.send.sender import parse_numbers, parse_radec

    if (radec is None) == (quaternion is None):
        raise InputError(f"{command}: give the attitude with --radec RA,DEC,ROLL or --quaternion W,X,Y,Z, one of them")
    if radec is not None:
        return from_radec_roll_deg(*parse_radec(radec))
    return checked_quaternion(parse_numbers(quaternion or "", 4, "--quaternion", "W,X,Y,Z"))


def check_files(
    inputs: Iterable[Path | None],
    outputs: Iterable[Path | None],
    bench_file: Path | None = None,
    kept: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Refuse (InputError), before anything is done, outputs that are inputs, or one file, and `kept` where it is there.

    Inputs are also the bench file and all that it names; `kept` is the output that cannot be made again.
    """
    from hilstar.files import check_outputs, files_named_in, refuse_existing, refuse_writer

    named = [] if bench_file is None else files_named_in(bench_file)
    check_outputs([*inputs, *named], [*outputs, kept])
    if kept is not None:
        refuse_writer(kept)
    refuse_existing(kept, overwrite)
