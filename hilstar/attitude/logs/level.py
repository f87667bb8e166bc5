"""The frame that a log's attitudes refer to, as the user states it: the ICRS, or the local level of a place at a UTC.

A name such as `icrs` or `gcrf` says what its axes are; `map`, `world` or `odom` does not, and is never guessed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs import earth
from hilstar.attitude.logs.entries import Entry, Stated
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.errors import InputError
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

Kind = Literal["icrs", "enu", "ned"]
# EME2000's axes lie within 23 mas of the ICRF's. "eci" and "inertial", which simulators write, are taken too, with a notice.
EXACT = frozenset({"icrs", "icrf", "gcrs", "gcrf", "j2000", "eme2000"})
LOOSE = frozenset({"eci", "inertial", "eci_j2000", "j2000_eci", "inertial_frame"})
KINDS: dict[str, Kind] = {**dict.fromkeys(EXACT | LOOSE, "icrs"), "enu": "enu", "ned": "ned"}
AXES: dict[Kind, str] = {"icrs": "the ICRS", "enu": "east, north, up", "ned": "north, east, down"}
# Times before 2000 are those of a simulated clock that began at 0, not dates.
FIRST_DATE_NS = 946_684_800 * NS_PER_S
BATCH = 4096


class Reference(NamedTuple):
    """What attitudes refer to; a level frame has a `place` (latitude, longitude, degrees), and its UTC is `t_ns + utc_ns`."""

    kind: Kind
    place: tuple[float, float] = (0.0, 0.0)
    utc_ns: int = 0

    def q_icrs_to_reference(self, t_ns: Iterable[int]) -> FloatArray:
        """The rotations (n, 4) from ICRS at the log's times (n,)."""
        utc_ns = np.fromiter(t_ns, dtype=np.int64) + self.utc_ns
        if self.kind == "icrs":
            return np.tile([1.0, 0.0, 0.0, 0.0], (len(utc_ns), 1))
        turn = earth.q_icrs_to_enu if self.kind == "enu" else earth.q_icrs_to_ned
        return turn(utc_ns, np.array(self.place[0]), np.array(self.place[1]))

    @property
    def earth_rate_rad_s(self) -> FloatArray:
        """What the reference itself turns by with respect to the stars (3,), in its own components."""
        if self.kind == "icrs":
            return np.zeros(3)
        north, east, down = earth.earth_rate_ned_rad_s(self.place[0])
        return np.array([east, north, -down] if self.kind == "enu" else [north, east, down])

    @property
    def words(self) -> str:
        """For a person."""
        if self.kind == "icrs":
            return AXES["icrs"]
        latitude_deg, longitude_deg = self.place
        return f"{AXES[self.kind]} at latitude {latitude_deg:g}, longitude {longitude_deg:g}, {earth.TURNED}"


def stated_reference(path: Path, kind: Kind, stated: Stated, first_ns: int) -> Reference:
    """The reference of that kind, once all is stated that it needs; `first_ns` is the log's first time.

    Raises InputError where a level frame has no place, or its times are no dates and their zero is not stated, or is twice.
    """
    if kind == "icrs":
        return Reference(kind)
    if stated.place is None:
        raise InputError(f"{path}: its attitudes refer to {AXES[kind]}; give the place with --place LAT,LON,HEIGHT")
    return Reference(kind, stated.place[:2], zero_utc_ns(path, stated, first_ns))


def zero_utc_ns(path: Path, stated: Stated, first_ns: int) -> int:
    """What makes UTC (ns since 1970) of the log's times. Raises InputError as `stated_reference`."""
    dated = first_ns >= FIRST_DATE_NS
    if stated.epoch_utc is None:
        if not dated:
            raise InputError(
                f"{path}: its times begin at {first_ns / NS_PER_S:.9g} s, no date; give --epoch-utc TIME, UTC at 0 s"
            )
        return 0
    if dated:
        raise InputError(f"{path}: its times are dates already (ns since 1970); leave out --epoch-utc")
    return earth.utc_ns_of(stated.epoch_utc, "--epoch-utc")


def to_icrs(entries: Iterable[Entry], reference: Reference, gyro: bool, told: list[tuple[str, str]]) -> Iterator[Entry]:
    """Attitudes from the reference to the body become those from ICRS; rates too, unless a gyroscope measured them.

    At their end `told` gets a notice where the dates leave the table of the Earth's orientation.
    """
    if reference.kind == "icrs":
        yield from entries
        return
    first_ns, last_ns = None, 0
    remaining = iter(entries)
    while batch := list(islice(remaining, BATCH)):
        samples = [entry.event for entry in batch if isinstance(entry.event, AttitudeSample)]
        turned = iter(_from_icrs(samples, reference, gyro))
        if samples:
            first_ns = samples[0].t_ns if first_ns is None else min(first_ns, samples[0].t_ns)
            last_ns = max(last_ns, samples[-1].t_ns)
        for entry in batch:
            yield Entry(entry.where, next(turned)) if isinstance(entry.event, AttitudeSample) else entry
    if first_ns is not None:
        beyond = earth.beyond_table(first_ns + reference.utc_ns, last_ns + reference.utc_ns)
        told += [] if beyond is None else [("log-earth", beyond)]


def _from_icrs(samples: list[AttitudeSample], reference: Reference, gyro: bool) -> list[AttitudeSample]:
    if not samples:
        return []
    q_ref_to_body = np.array([sample.q_icrs_to_cam for sample in samples])
    q = multiply(q_ref_to_body, reference.q_icrs_to_reference(sample.t_ns for sample in samples))
    own = np.array([0.0, *reference.earth_rate_rad_s])
    earths = multiply(multiply(q_ref_to_body, own), conjugate(q_ref_to_body))[:, 1:]
    turned = []
    for sample, attitude, earth_rate in zip(samples, q, earths, strict=True):
        rate = sample.rate_cam_rad_s
        turned.append(
            replace(sample, q_icrs_to_cam=attitude, rate_cam_rad_s=rate if rate is None or gyro else rate + earth_rate)
        )
    return turned
