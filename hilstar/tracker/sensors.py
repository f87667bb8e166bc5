"""Sensors by name: what their public sheets say, as keys of a bench file."""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hilstar.basics.errors import InputError, did_you_mean, shortened

SHEETS = Path(__file__).resolve().parent / "sensors.toml"


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor's figures and where they are from.

    `tracker` and `detector` are keys of [tracker] and [tracker.detector]; a figure that no source
    states has no key. `efficiency` has (nm, share) where they are too few for a curve.
    """

    name: str
    source: str
    tracker: dict[str, Any]
    detector: dict[str, Any]
    efficiency: tuple[tuple[float, float], ...]


@cache
def sensors() -> dict[str, Sensor]:
    """All sensors by name, in small letters.

    >>> sensors()["imx250"].tracker["pixel_pitch_um"]
    3.45
    """
    sheets = tomllib.loads(SHEETS.read_text(encoding="utf-8"))
    return {name: _sensor(name, sheet) for name, sheet in sheets.items()}


def _sensor(name: str, sheet: dict[str, Any]) -> Sensor:
    efficiency = tuple((nm, share) for nm, share in sheet.get("efficiency", []))
    return Sensor(name, sheet["source"], sheet["tracker"], sheet.get("detector", {}), efficiency)


def sensor_named(name: str, what: str) -> Sensor:
    """The sensor of a name, in small or capital letters. Raises InputError, which calls the name
    `what`.
    """
    sensor = sensors().get(name.casefold())
    if sensor is None:
        meant = did_you_mean(name, sensors())
        raise InputError(f"{what} {shortened(name)}: {meant}write one of {', '.join(sensors())}")
    return sensor
