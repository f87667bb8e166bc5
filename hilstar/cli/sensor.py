"""hilstar sensor: a tracker's sensor from its EMVA 1288 data sheet, or from its own frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from hilstar.basics.files import TOML, check_ending, refuse_stdout
from hilstar.cli.options import Json, check_files
from hilstar.server.console.terminal import busy, print_found

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.sensor import SensorFile

Output = Annotated[
    Path, Option("-o", "--output", metavar="SENSOR.toml", help="The tables for a bench file.")
]


def import_(
    data: Annotated[
        Path, Argument(metavar="EMVA.csv|json", help="Rows of quantity, value and unit.")
    ],
    output: Output,
    as_json: Json = False,
) -> None:
    """Make a bench file's [tracker.detector] and quantum efficiency of an EMVA 1288 data sheet,
    and its curves.
    """
    from hilstar.instruments.calibrate.sensor import import_emva

    _check(output)
    check_files([data], [output])
    _tell(output, import_emva(data), f"By hilstar sensor import from {data.name}", as_json)


def measure(
    flats: Annotated[
        list[Path],
        Argument(metavar="FLATS...", help="FITS or PNG, two of each light after each other."),
    ],
    darks: Annotated[
        list[Path],
        Option(
            "--darks",
            metavar="DARKS...",
            help="Frames without light, two of each exposure (EXPTIME).",
        ),
    ],
    output: Output,
    as_json: Json = False,
) -> None:
    """Measure gain, noise, full well and fixed pattern of a sensor by photon transfer, and write
    [tracker.detector].
    """
    from hilstar.instruments.calibrate.sensor import measure_sensor

    _check(output)
    check_files([*flats, *darks], [output])
    with busy("measuring"):
        measured = measure_sensor(flats, darks)
    _tell(output, measured, "By hilstar sensor measure; errors are one sigma", as_json)


def _check(output: Path) -> None:
    check_ending("-o", output, TOML)
    refuse_stdout("-o", output)


def _tell(output: Path, sensor: "SensorFile", source: str, as_json: bool) -> None:
    from hilstar.instruments.calibrate.sensor import write_sensor

    files = write_sensor(output, sensor, source)
    written = [str(file) for file in files]
    fields = {
        "keys": sensor.keys,
        "sigmas": sensor.sigmas,
        "notes": sensor.notes,
        "written": written,
    }
    print_found(as_json, fields, [*sensor.lines, *sensor.notes, f"wrote {', '.join(written)}"])
