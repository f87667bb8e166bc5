"""hilstar sensor: a tracker's sensor from its EMVA 1288 data sheet, or from its own frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics.files import TOML, check_ending, refuse_stdout
from hilstar.cli.declare import argument, option, struct
from hilstar.cli.options import check_files, json_option, output_option
from hilstar.server.console.terminal import busy, print_found

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.sensor import SensorFile


def sensor_option() -> Any:
    """The option of the file of a sensor."""
    return output_option("SENSOR.toml", "The tables for a bench file.")


@struct
class ImportOptions:
    """The options of `hilstar sensor import`."""

    data: Path = argument("EMVA.csv|json", "Rows of quantity, value and unit.")
    output: Path = sensor_option()
    as_json: bool = json_option()


def import_(options: ImportOptions) -> None:
    """Make a bench file's [tracker.detector] and quantum efficiency of an EMVA 1288 data sheet,
    and its curves.
    """
    from hilstar.instruments.calibrate.sensor import import_emva

    _check(options.output)
    check_files([options.data], [options.output])
    source = f"By hilstar sensor import from {options.data.name}"
    _tell(options.output, import_emva(options.data), source, options.as_json)


@struct
class MeasureOptions:
    """The options of `hilstar sensor measure`."""

    flats: list[Path] = argument("FLATS...", "FITS or PNG, two of each light after each other.")
    darks: list[Path] = option("DARKS...", "Frames without light, two of each exposure (EXPTIME).")
    output: Path = sensor_option()
    as_json: bool = json_option()


def measure(options: MeasureOptions) -> None:
    """Measure gain, noise, full well and fixed pattern of a sensor by photon transfer, and write
    [tracker.detector].
    """
    from hilstar.instruments.calibrate.sensor import measure_sensor

    _check(options.output)
    check_files([*options.flats, *options.darks], [options.output])
    with busy("measuring"):
        measured = measure_sensor(options.flats, options.darks)
    source = "By hilstar sensor measure; errors are one sigma"
    _tell(options.output, measured, source, options.as_json)


def _check(output: Path) -> None:
    """Refuse (InputError) an output that is no TOML file: its curves stand beside it."""
    check_ending("-o", output, TOML)
    refuse_stdout("-o", output)


def _tell(output: Path, sensor: "SensorFile", source: str, as_json: bool) -> None:
    """Write a sensor's tables and curves, and print what they hold."""
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
