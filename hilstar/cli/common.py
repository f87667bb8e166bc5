"""What the commands share: the app, options that several have, and the attitude of a command line."""

from __future__ import annotations

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
MAX_SEED = 2**63 - 1  # what a FITS header holds
LOG_HELP = "CSV (t_s,qw,qx,qy,qz), JSON lines, CCSDS AEM, or a run's MCAP."


def attitude_of(command: str, radec: str | None, quaternion: str | None) -> Any:
    """The one attitude that the command line gives."""
    from hilstar.attitude.quaternion import from_radec_roll_deg
    from hilstar.bench.assembly import checked_quaternion
    from hilstar.bench.sender import parse_numbers, parse_radec

    if (radec is None) == (quaternion is None):
        raise InputError(f"{command}: give the attitude with --radec RA,DEC,ROLL or --quaternion W,X,Y,Z, one of them")
    if radec is not None:
        return from_radec_roll_deg(*parse_radec(radec))
    return checked_quaternion(parse_numbers(quaternion or "", 4, "--quaternion", "W,X,Y,Z"))
