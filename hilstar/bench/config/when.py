"""When and from where a bench file sees the sky: what its keys mean together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from hilstar.bench.config.bench import BenchConfig
from hilstar.bench.config.spacecraft import GEOCENTRE
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

UNIX_JD, DAY_NS = 2_440_587.5, 86_400 * NS_PER_S
EPOCH_KEY = "[sky] epoch_utc ="


def epoch_utc_ns(config: BenchConfig) -> int | None:
    """The UTC of t = 0, ns since 1970 where every day has 86400 s; None where the file has none. Raises InputError."""
    if config.sky.epoch_utc is None:
        return None
    from hilstar.attitude.logs.earth import utc_ns_of  # with ERFA 30 ms, which a bench without a date does not need

    return utc_ns_of(config.sky.epoch_utc, EPOCH_KEY)


def has_observer(config: BenchConfig) -> bool:
    """Whether the sky is seen from a known place: a spacecraft's, or for its bodies the Earth's centre."""
    bodies = config.sky.bodies
    return bodies.planets or bodies.moon or bodies.sun or config.spacecraft.orbit is not None


def with_epoch(config: BenchConfig, path: Path, tables: dict[str, Any]) -> BenchConfig:
    """The same with the Julian year of `epoch_utc`, which a bench's hash covers. Raises InputError for keys that disagree."""
    if config.sky.epoch_utc is not None and "epoch_jyear" in tables.get("sky", {}):
        raise InputError(f"{path}: [sky] has epoch_utc and epoch_jyear; write one of them")
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
    attitude, orbit = config.attitude, config.spacecraft.orbit
    if orbit not in {None, GEOCENTRE} and attitude.source == "vizard" and attitude.use_velocity:
        raise InputError(
            f"{path}: [attitude] use_velocity = true adds Basilisk's velocity to that of [spacecraft] orbit; write"
            ' use_velocity = false, or orbit = "geocentre"'
        )
    try:
        utc_ns = epoch_utc_ns(config)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if utc_ns is None:
        return config
    import erfa

    sky = msgspec.structs.replace(config.sky, epoch_jyear=float(erfa.epj(UNIX_JD, utc_ns / DAY_NS)))
    return msgspec.structs.replace(config, sky=sky)
