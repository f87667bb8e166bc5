"""The attitude of a PX4 vehicle among the stars.

`vehicle_attitude.q` (w, x, y, z) turns components of the body (front, right, down) into north, east, down; the place and UTC
of each attitude turn those to the ICRS (`earth`). A change of `quat_reset_counter` is a step of the estimate, not of the
vehicle. `vehicle_angular_velocity` is the gyroscopes' (body components, with respect to the stars). Attitudes of zeros or NaN
with which a log begins are from before the estimator ran, and are left out with a notice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs import earth
from hilstar.attitude.logs.entries import Entry, LogReading, Stated
from hilstar.attitude.logs.in_order import in_order
from hilstar.attitude.logs.px4.fix import GLOBAL_POSITION, GPS, GROUND_TRUTH, Place, Utc, boot_utc, place_at
from hilstar.attitude.logs.px4.series import IntArray, Series, at_times, read_series
from hilstar.attitude.logs.px4.sieve import Topic, sieve
from hilstar.attitude.wire.packet import checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.errors import InputError, shortened
from hilstar.rotation import conjugate, multiply

ATTITUDE = "vehicle_attitude"
ATTITUDES = (ATTITUDE, ATTITUDE + GROUND_TRUTH, "estimator_attitude", "external_ins_attitude")
RATES = "vehicle_angular_velocity"
OLD_RATES = ("rollspeed", "pitchspeed", "yawspeed")  # in vehicle_attitude itself, before v1.9
ADVICE = "the log has two attitudes of one time, or is damaged there"


class Turning(NamedTuple):
    """What turns north, east, down to the ICRS: UTC at boot, and the place at each attitude."""

    utc: Utc
    place: Place

    def q_icrs_to_ned(self, t_us: IntArray) -> FloatArray:
        """The rotations (n, 4) at times of the boot clock (n,)."""
        return earth.q_icrs_to_ned(t_us * 1000 + self.utc.boot_ns, self.place.latitude_deg, self.place.longitude_deg)


@np.errstate(all="ignore")  # damaged numbers are refused as not finite, or are unknown rates
def read_ulog(path: Path, stated: Stated) -> LogReading:
    """The body's attitudes. Raises InputError where neither the log nor the user says where and when they were."""
    if stated.reference is not None and stated.reference.lower() != "ned":
        raise InputError(f"{path}: a PX4 log's attitudes refer to north, east, down; leave out --reference {stated.reference}")
    name, instance = _wanted(stated.topic)
    suffix = GROUND_TRUTH if name.endswith(GROUND_TRUTH) else ""
    sieved = sieve(path, frozenset({name, RATES + suffix, GLOBAL_POSITION + suffix, *GPS}))
    topic = _chosen(path, sieved.topics, name, instance)
    topics = read_series(path, sieved)
    series = topics.get(topic)
    q = None if series is None else series.stacked("q", 4)
    if series is None or q is None:
        raise InputError(
            f"{path}: has no attitude in {topic.name}; choose another topic with --topic NAME, or give another log"
        )
    told = sieved.told
    series, q = _ready(path, series, q, told)
    turning = Turning(boot_utc(path, stated, topics, told), place_at(path, stated, topics, series.t_us, suffix))
    rates = _rates(series, topics, suffix)
    first_ns, last_ns = (int(t_us) * 1000 + turning.utc.boot_ns for t_us in (series.t_us.min(), series.t_us.max()))
    beyond = earth.beyond_table(first_ns, last_ns)
    told += [] if beyond is None else [("log-earth", beyond)]
    entries = in_order(_entries(series, q, rates, turning), told)
    return LogReading(entries, _conventions(topic, series, turning, rates), ADVICE, told)


def _wanted(text: str | None) -> tuple[str, int | None]:
    """Name and instance of `--topic NAME` or `--topic NAME:INSTANCE`."""
    if text is None:
        return ATTITUDE, None
    name, _, number = text.partition(":")
    return name, int(number) if number.isdecimal() and len(number) < 4 else None


def _chosen(path: Path, topics: set[Topic], name: str, instance: int | None) -> Topic:
    found = sorted(topic for topic in topics if topic.name == name and instance in {None, topic.instance})
    if not found:
        others = sorted(f"{topic.name}:{topic.instance}" for topic in topics if topic.name in ATTITUDES)
        has = f"it has {shortened(', '.join(others))}; choose with --topic" if others else "it has no attitude at all"
        raise InputError(f"{path}: has no topic {name}{'' if instance is None else f':{instance}'}; {has}")
    if len(found) > 1:
        names = ", ".join(f"{topic.name}:{topic.instance}" for topic in found)
        raise InputError(
            f"{path}: has several instances: {shortened(names)}; choose one with --topic {name}:{found[0].instance}"
        )
    return found[0]


def _ready(path: Path, series: Series, q: FloatArray, told: list[tuple[str, str]]) -> tuple[Series, FloatArray]:
    """The attitudes from the first that is one."""
    good = np.isfinite(q).all(axis=1) & (np.abs(q).max(axis=1) > 0)
    if not good.any():
        raise InputError(f"{path}: all of its attitudes are zeros or NaN: the estimator never ran; give another log")
    begin = int(np.argmax(good))
    if begin:
        told.append(("log-start", f"{begin} attitudes from before the estimator ran (zeros or NaN) are left out"))
    return series.where(np.arange(len(q)) >= begin), q[begin:]


def _rates(series: Series, topics: dict[Topic, Series], suffix: str) -> FloatArray | None:
    """Body rates (n, 3), rad/s, at the attitudes' times; NaN where the log has none, None where it has none at all."""
    for topic in sorted(topics):
        if topic.name == RATES + suffix:
            rates = topics[topic].stacked("xyz", 3)
            return None if rates is None else at_times(topics[topic], rates, series.t_us)
    if all(name in series.columns for name in OLD_RATES):
        return np.stack([np.asarray(series.columns[name], dtype=np.float64) for name in OLD_RATES], axis=1)
    return None


def _entries(series: Series, q: FloatArray, rates: FloatArray | None, turning: Turning) -> Iterator[Entry]:
    counter = series.columns.get("quat_reset_counter", np.zeros(len(q)))
    resets = [False, *np.diff(counter.astype(np.int64)).astype(bool).tolist()]
    with np.errstate(all="ignore"):  # too
        body = multiply(conjugate(q), turning.q_icrs_to_ned(series.t_us))
    rows = np.full((len(q), 3), np.nan) if rates is None else rates
    for number, t_us in enumerate(series.t_us.tolist()):
        w, x, y, z = body[number].tolist()
        rate = tuple(rows[number].tolist())
        known = None if any(map(math.isnan, rate)) else rate
        sample = checked_sample(t_us * 1000, (w, x, y, z), known, discontinuity=resets[number])
        yield Entry(f": attitude {number + 1}", sample)


def _conventions(topic: Topic, series: Series, turning: Turning, rates: FloatArray | None) -> Conventions:
    words = "turns components of the body (front, right, down) into north, east, down"
    gyro = "" if rates is None else "; the gyroscopes' rate, with respect to the stars"
    return Conventions(
        f"PX4 ULog, {topic.name}:{topic.instance}",
        f"q {words} {turning.place.words}, {earth.TURNED}{gyro}",
        "scalar first (w, x, y, z), Hamilton, single precision (0.02 arcsec)",
        f"microseconds since boot, which was at UTC {turning.utc.words}",
        of_body=True,
        written=_written(series, turning),
    )


def _written(series: Series, turning: Turning) -> Callable[[FloatArray], str]:
    """An attitude (q_icrs_to_body) as the log has it, at its first time."""
    t_us = series.t_us[:1]
    place = Place(turning.place.latitude_deg[:1], turning.place.longitude_deg[:1], "")
    q_icrs_to_ned = Turning(turning.utc, place).q_icrs_to_ned(t_us)[0]

    def words(q: FloatArray) -> str:
        return f"q = {components(multiply(q_icrs_to_ned, conjugate(q)))} at {int(t_us[0]) / 1e6:.6f} s"

    return words
