"""When and from where a bench file sees the sky: what its keys mean together."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.bench.config.bench import BenchConfig
from hilstar.bench.config.spacecraft import GEOCENTRE, SOURCE
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

UNIX_JD, DAY_NS = 2_440_587.5, 86_400 * NS_PER_S
EPOCH_KEY = "[sky] epoch_utc ="
FROM_SOURCE, UNIX = "source", "unix"
TT_FROM_TAI_NS, TAI_FROM_GPS_NS = 32_184_000_000, 19 * NS_PER_S  # TDB is TT within 2 ms
SCALES = ("UTC", "TAI", "TT", "TDB", "GPS")


def epoch_utc_ns(config: BenchConfig) -> int | None:
    """The UTC of t = 0, ns since 1970 where every day has 86400 s; None where the file has none. Raises InputError."""
    if config.sky.epoch_utc is None:
        return None
    if config.sky.epoch_utc == UNIX:
        return 0
    if config.sky.epoch_utc == FROM_SOURCE:
        raise InputError(
            f'{EPOCH_KEY} "{FROM_SOURCE}" is for a log that has dates (replay, simulate --log, attitude LOG);'
            " write the UTC of t_ns = 0"
        )
    from hilstar.attitude.logs.earth import utc_ns_of  # with ERFA 30 ms, which a bench without a date does not need

    return utc_ns_of(config.sky.epoch_utc, EPOCH_KEY)


def has_observer(config: BenchConfig) -> bool:
    """Whether the sky is seen from a known place: a spacecraft's, or for its bodies the Earth's centre."""
    bodies = config.sky.bodies
    shown = bodies.planets or bodies.moon or bodies.sun or bodies.earth or bodies.satellites is not None
    return shown or config.spacecraft.orbit is not None


def from_source(config: BenchConfig) -> bool:
    """Whether the source of the attitudes says where the spacecraft is."""
    return config.spacecraft.orbit == SOURCE


def with_epoch(config: BenchConfig, path: Path, tables: dict[str, Any]) -> BenchConfig:
    """The same with the Julian year of `epoch_utc`, which a bench's hash covers. Raises InputError for keys that disagree."""
    if config.sky.epoch_utc is not None and "epoch_jyear" in tables.get("sky", {}):
        raise InputError(f"{path}: [sky] has epoch_utc and epoch_jyear; write one of them")
    if config.sky.bodies.satellite_magnitudes is not None and config.sky.bodies.satellites is None:
        raise InputError(f'{path}: [sky.bodies] satellite_magnitudes is of no satellites; write satellites = "tles.txt" too')
    if has_observer(config):
        if config.sky.epoch_utc is None:
            raise InputError(
                f'{path}: [sky.bodies] and [spacecraft] need a date; write [sky] epoch_utc = "2026-11-21T00:00:00Z"'
            )
        if any(config.sky.observer_velocity_km_s):
            raise InputError(
                f"{path}: [sky] observer_velocity_km_s: with [sky.bodies] or [spacecraft] the velocity follows from the"
                " ephemeris; leave it out"
            )
    _check_orbit(config, path)
    attitude, orbit = config.attitude, config.spacecraft.orbit
    if orbit not in {None, GEOCENTRE, SOURCE} and attitude.source == "vizard" and attitude.use_velocity:
        raise InputError(
            f"{path}: [attitude] use_velocity = true adds Basilisk's velocity to that of [spacecraft] orbit; write"
            ' use_velocity = false, or orbit = "geocentre"'
        )
    if config.sky.epoch_utc in {FROM_SOURCE, UNIX}:
        return config
    try:
        utc_ns = epoch_utc_ns(config)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if utc_ns is None:
        return config
    return msgspec.structs.replace(config, sky=msgspec.structs.replace(config.sky, epoch_jyear=jyear(utc_ns)))


def _check_orbit(config: BenchConfig, path: Path) -> None:
    """Refuse (InputError) a place that nobody gives, and the Earth from its own centre."""
    attitude, orbit = config.attitude, config.spacecraft.orbit
    if config.sky.bodies.earth and orbit in {None, GEOCENTRE}:
        raise InputError(
            f"{path}: [sky.bodies] earth = true: from its centre no Earth is seen; write [spacecraft] orbit = the path of a TLE"
            f' or an OEM, or "{SOURCE}"'
        )
    if not from_source(config):
        return
    if attitude.source != "vizard":
        raise InputError(
            f'{path}: [spacecraft] orbit = "{SOURCE}": of the sources of attitudes only "vizard" (Basilisk) sends the'
            f' spacecraft\'s place, and [attitude] source = "{attitude.source}"; write the path of a TLE or an OEM'
        )
    if not attitude.use_velocity:
        raise InputError(
            f'{path}: [attitude] use_velocity = false, and [spacecraft] orbit = "{SOURCE}" takes the source\'s place and'
            " velocity; leave use_velocity out"
        )


def with_dates(config: BenchConfig, scale: str | None, first_ns: int) -> BenchConfig:
    """The same for a source that gives the dates: its first time, ns since 1970 on a time scale (see `Conventions`).

    `epoch_utc` is then the UTC of its t_ns = 0 by the leap seconds of that day, and `epoch_jyear` the beginning of the day: for
    it stars are placed. Unchanged where the file has a date of its own. Raises InputError for a source without dates, and for
    one whose times are none of Unix where the file says that they are.
    """
    if config.sky.epoch_utc == UNIX:
        if scale in SCALES and scale != "UTC":
            raise InputError(f'{EPOCH_KEY} "{UNIX}": the times of this log are {scale}; write "{FROM_SOURCE}"')
        return _on_day(config, UNIX, first_ns)
    if config.sky.epoch_utc != FROM_SOURCE:
        return config
    if scale not in SCALES:
        raise InputError(
            f'{EPOCH_KEY} "{FROM_SOURCE}": the times of this log are no dates in {", ".join(SCALES[:-1])} or {SCALES[-1]};'
            " write the UTC of t_ns = 0"
        )
    if scale == "UTC":
        return _on_day(config, UNIX, first_ns)
    ahead_ns = _ahead_of_utc_ns(scale, first_ns)
    return _on_day(config, str(np.datetime64(-ahead_ns, "ns")), first_ns - ahead_ns)


def today(config: BenchConfig) -> BenchConfig:
    """The same with stars of the present day, by this machine's clock, where t_ns counts from 1970."""
    return _on_day(config, UNIX, time.time_ns()) if config.sky.epoch_utc == UNIX else config


def _on_day(config: BenchConfig, epoch_utc: str, utc_ns: int) -> BenchConfig:
    """The same with this `epoch_utc`, and stars placed for the beginning of a UTC's day."""
    day = jyear(utc_ns // DAY_NS * DAY_NS)
    return msgspec.structs.replace(config, sky=msgspec.structs.replace(config.sky, epoch_utc=epoch_utc, epoch_jyear=day))


def jyear(utc_ns: int) -> float:
    """The Julian year of a UTC."""
    import erfa

    return float(erfa.epj(UNIX_JD, utc_ns / DAY_NS))


def _ahead_of_utc_ns(scale: str, t_ns: int) -> int:
    """How far a time scale is ahead of UTC at a time of it, ns since 1970."""
    import erfa

    tai_from_ns = {"TAI": 0, "GPS": -TAI_FROM_GPS_NS}.get(scale, TT_FROM_TAI_NS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # years after the last known leap second
        tai = UNIX_JD, (t_ns - tai_from_ns) / DAY_NS
        utc = erfa.taiutc(*tai)
        year, month, day, _ = erfa.jd2cal(*utc)
        return tai_from_ns + round(float(erfa.dat(year, month, day, 0.0)) * NS_PER_S)
