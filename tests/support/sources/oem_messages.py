"""Orbit Ephemeris Messages in KVN, made for tests of an orbit that SGP4 has."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hilstar.sky.bodies.orbit import TleOrbit
from tests.support.skies import STATION_TLE, STATION_UTC, utc_ns

START_NS = utc_ns(STATION_UTC)
STATION = TleOrbit(STATION_TLE, "station.tle")


def segment(
    seconds: Iterable[float],
    ahead_s: float = 0.0,
    day_of_year: bool = False,
    **keywords: str | None,
) -> str:
    """One segment of the station's orbit at these seconds after START_NS, in a scale that is so
    far ahead of UTC.
    """
    meta = {
        "OBJECT_NAME": "ISS",
        "OBJECT_ID": "1998-067A",
        "CENTER_NAME": "EARTH",
        "REF_FRAME": "EME2000",
        "TIME_SYSTEM": "UTC",
    }
    rows = []
    for second in seconds:
        t_ns = START_NS + round(second * 1e9)
        stamp = np.datetime64(t_ns + round(ahead_s * 1e9), "ns")
        text = str(stamp)
        if day_of_year:
            day = (
                stamp.astype("datetime64[D]")
                - stamp.astype("datetime64[Y]").astype("datetime64[D]")
            ).astype(int) + 1
            text = f"{text[:4]}-{day:03d}{text[10:]}"
        place, velocity = STATION.state(t_ns)
        rows.append(" ".join([text, *(f"{number:.9f}" for number in (*place, *velocity))]))
    lines = [f"{key} = {value}" for key, value in (meta | keywords).items() if value is not None]
    return "\n".join(["META_START", *lines, "META_STOP", "COMMENT states", *rows, ""])


def oem(*segments: str, version: str = "2.0") -> str:
    """A whole message."""
    head = f"CCSDS_OEM_VERS = {version}\nCREATION_DATE = 2008-09-20T00:00:00\nORIGINATOR = X\n\n"
    return head + "\n".join(segments)
