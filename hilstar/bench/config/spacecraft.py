"""[spacecraft]."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from hilstar.toml_tables import Table

GEOCENTRE = "geocentre"
SOURCE = "source"


class Spacecraft(Table, frozen=True):
    """From where the sky is seen. With this table, or bodies, places are apparent: parallax, light bending and aberration.

    `[sky] observer_velocity_km_s` is then left out: the velocity is that of the Earth about the barycentre, and the satellite's
    about the Earth.
    """

    orbit: Annotated[
        str | None,
        Meta(
            description='`"geocentre"`, or the path of a file: one two-line element set (TLE), propagated by SGP4, or a CCSDS'
            ' OEM (KVN; ICRF, GCRF or EME2000 about the Earth); `"source"`: where the messages of'
            ' `[attitude] source = "vizard"` (Basilisk) have the spacecraft.',
            extra={"default": 'none; `"geocentre"` with `[sky.bodies]`'},
        ),
    ] = None
