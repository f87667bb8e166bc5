"""Where the vehicle was, and what its boot clock was in UTC: from the log, or as the user states it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs import earth
from hilstar.attitude.logs.aem.epochs import epoch_text
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.px4.series import IntArray, Series
from hilstar.attitude.logs.px4.sieve import Topic
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

GLOBAL_POSITION = "vehicle_global_position"
GPS = ("vehicle_gps_position", "sensor_gps")
GROUND_TRUTH = "_groundtruth"
# A receiver without a fix reports 0, or a date of its own past.
FIRST_DATE_US, LAST_DATE_US = 946_684_800_000_000, 4_102_444_800_000_000  # 2000 and 2100
UNSURE_S = 0.1  # said of fixes that agree no better: 1.5 arcsec of the Earth's turning
APART_S = 1.0


class Utc(NamedTuple):
    """The UTC at boot (ns since 1970), and where that is from."""

    boot_ns: int
    words: str


class Place(NamedTuple):
    """Geodetic latitude and longitude, degrees, each (n,), and where they are from."""

    latitude_deg: FloatArray
    longitude_deg: FloatArray
    words: str


def boot_utc(path: Path, stated: Stated, topics: dict[Topic, Series], told: list[tuple[str, str]]) -> Utc:
    """From `--epoch-utc`, else the median over the receiver's times. Raises InputError where there is neither."""
    offsets_us = _offsets_us(topics)
    gps_ns = round(float(np.median(offsets_us - offsets_us[0]))) * 1000 + int(offsets_us[0]) * 1000 if len(offsets_us) else None
    if stated.epoch_utc is not None:
        boot_ns = earth.utc_ns_of(stated.epoch_utc, "--epoch-utc")
        if gps_ns is not None and abs(gps_ns - boot_ns) > APART_S * NS_PER_S:
            told.append(
                ("log-utc", f"--epoch-utc is {(boot_ns - gps_ns) / NS_PER_S:+.3g} s from the log's own GPS time at boot")
            )
        return Utc(boot_ns, f"{epoch_text(boot_ns)}, as stated")
    if gps_ns is None:
        raise InputError(f"{path}: has no UTC (no GPS fix with a time); give --epoch-utc TIME, the UTC at boot")
    low, high = np.percentile(offsets_us - offsets_us[0], [5, 95])
    spread_s = float(high - low) / 1e6
    if spread_s > UNSURE_S:
        turned = earth.UT1_ARCSEC_PER_S * spread_s / 2
        told.append(("log-utc", f"GPS times differ by {spread_s:.3g} s; the sky may be turned by {turned:.2g} arcsec"))
    return Utc(gps_ns, f"{epoch_text(gps_ns)} by {len(offsets_us)} GPS times, 90 % of them within {spread_s:.3g} s")


def _offsets_us(topics: dict[Topic, Series]) -> IntArray:
    """UTC less the boot clock (n,), microseconds, of the first receiver that has dates."""
    for series in _of(topics, GPS):
        utc_us = series.columns.get("time_utc_usec")
        if utc_us is None:
            continue
        good = (utc_us >= FIRST_DATE_US) & (utc_us < LAST_DATE_US)
        if good.any():
            return np.asarray(utc_us[good].astype(np.int64) - _fixed_us(series)[good])
    return np.array([], dtype=np.int64)


def _fixed_us(series: Series) -> IntArray:
    """When a fix was true: when its message came, or as much earlier as the newer receivers' drivers say."""
    late_us = series.columns.get("timestamp_time_relative")
    return series.t_us if late_us is None else series.t_us + late_us.astype(np.int64)


def place_at(path: Path, stated: Stated, topics: dict[Topic, Series], t_us: IntArray, suffix: str) -> Place:
    """From `--place`, else the estimated position, else a receiver's. Raises InputError where there is none."""
    if stated.place is not None:
        latitude_deg, longitude_deg = (np.full(len(t_us), value) for value in stated.place[:2])
        return Place(latitude_deg, longitude_deg, f"at latitude {stated.place[0]:g}, longitude {stated.place[1]:g}, as stated")
    for name in (GLOBAL_POSITION + suffix, *GPS):
        for series in _of(topics, (name,)):
            found = _degrees(series)
            if found is not None:
                times, latitude_deg, longitude_deg = found
                longitude_deg = np.unwrap(longitude_deg, period=360.0)
                return Place(
                    np.interp(t_us, times, latitude_deg), np.interp(t_us, times, longitude_deg), f"at the place of {name}"
                )
    raise InputError(f"{path}: has no position; give the place with --place LAT,LON,HEIGHT")


def _degrees(series: Series) -> tuple[IntArray, FloatArray, FloatArray] | None:
    """Times, latitudes and longitudes of the rows that have any."""
    columns = series.columns
    if "latitude_deg" in columns and "longitude_deg" in columns:
        names, scale = ("latitude_deg", "longitude_deg"), 1.0
    elif "lat" in columns and "lon" in columns:
        names, scale = ("lat", "lon"), 1.0 if columns["lat"].dtype.kind == "f" else 1e-7
    else:
        return None
    latitude_deg, longitude_deg = (np.asarray(columns[name], dtype=np.float64) * scale for name in names)
    good = (
        np.isfinite(latitude_deg) & np.isfinite(longitude_deg) & (np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 360)
    )
    good &= (latitude_deg != 0) | (longitude_deg != 0)
    if "fix_type" in columns:
        good &= columns["fix_type"] >= 2
    if not good.any():
        return None
    times_us = _fixed_us(series)[good]
    order = np.argsort(times_us, kind="stable")
    return times_us[order], latitude_deg[good][order], longitude_deg[good][order]


def _of(topics: dict[Topic, Series], names: tuple[str, ...]) -> list[Series]:
    """The series of topics by name, the first instance first."""
    return [topics[topic] for name in names for topic in sorted(topics) if topic.name == name]
