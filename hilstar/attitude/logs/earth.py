"""From the ICRS to the local level (north-east-down, east-north-up) of a place on the turning Earth, at a UTC.

    ICRS --C(X, Y, s)--> CIRS --R3(ERA)--> TIRS --W(polar motion)--> ITRS --R2(-latitude - 90 deg) R3(longitude)--> NED

IERS Conventions (2010), chapter 5: the precession and nutation of IAU 2006/2000A, the Earth rotation angle of UT1, and UT1-UTC
and polar motion from the IERS table that Astropy's package holds: nothing is downloaded. The pole's offsets (0.4 mas), tides
shorter than a day (0.6 mas) and s' (0.01 mas) are left out. "Level" is normal to the WGS84 ellipsoid at a geodetic latitude: a
plumb line is off by the deflection of the vertical, some arcsec in plains and an arcmin beside high mountains.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import NamedTuple

import erfa
import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem.blocks import AemFaultError
from hilstar.attitude.logs.aem.epochs import epoch_ns
from hilstar.errors import InputError
from hilstar.rotation import multiply
from hilstar.units import NS_PER_S

IntArray = npt.NDArray[np.int64]
HOUR_NS = 3600 * NS_PER_S
UNIX_MJD, MJD_ZERO_JD = 40587, 2400000.5
TT_FROM_TAI_S = 32.184
EARTH_RATE_RAD_S = 7.292115146706979e-5  # of the Earth rotation angle: 2 pi 1.00273781191135448 a day of UT1 (IAU 2000)
UT1_ARCSEC_PER_S = 15.041
TURNED = "turned to the ICRS with the Earth (IAU 2006/2000A; 15 arcsec for each second that its UTC is off)"
UT1_S_A_YEAR = 1.1  # UT1-TAI, held at the ends of the table, has moved by this in a year since 1973 at most (days 3 ms long)
HALF = float(np.sqrt(0.5))
Q_NED_TO_ENU = (0.0, HALF, HALF, 0.0)
UTC_FORM = "write a UTC such as 2026-11-22T10:00:00"


class _Table(NamedTuple):
    """Earth orientation by day (n,): MJD of UTC, UT1-TAI in seconds, and the pole's coordinates in radians."""

    mjd: FloatArray
    ut1_tai_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray


def q_icrs_to_itrs(utc_ns: IntArray) -> FloatArray:
    """The rotations (n, 4) from ICRS to the Earth's axes (ITRS) at UTCs (n,), ns since 1970 where every day has 86400 s."""
    hours, place = np.unique(np.concatenate((utc_ns // HOUR_NS, utc_ns // HOUR_NS + 1)), return_inverse=True)
    before, after = place[: len(utc_ns)], place[len(utc_ns) :]
    share = (utc_ns % HOUR_NS) / HOUR_NS

    def between(values: FloatArray) -> FloatArray:
        return values[before] + share * (values[after] - values[before])

    table, mjd = _table(), UNIX_MJD + hours / 24.0
    tai_utc_s = tai_minus_utc_s(hours // 24)
    tt_days = (tai_utc_s + TT_FROM_TAI_S) / 86400.0
    # Linear over an hour, these are within 5 microarcsec: the shortest nutation of note takes 5.5 days.
    x, y, s = (between(values) for values in erfa.xys06a(MJD_ZERO_JD, mjd + tt_days))
    ut1_tai_s, pole_x, pole_y = (
        between(np.interp(mjd, table.mjd, column)) for column in (table.ut1_tai_s, table.x_rad, table.y_rad)
    )
    ut1_days = (utc_ns % (24 * HOUR_NS)) / (24 * HOUR_NS) + (ut1_tai_s + tai_utc_s[before]) / 86400.0
    era = erfa.era00(MJD_ZERO_JD + UNIX_MJD + utc_ns // (24 * HOUR_NS), ut1_days)
    node, tilt = np.arctan2(y, x), np.arcsin(np.hypot(x, y))
    to_cirs = _chain(_turn(3, node), _turn(2, tilt), _turn(3, -node - s))
    return _chain(to_cirs, _turn(3, era), _turn(2, -pole_x), _turn(1, -pole_y))


def q_icrs_to_ned(utc_ns: IntArray, latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """The rotations (n, 4) from ICRS to north, east, down at UTCs (n,) and geodetic places (n,) or ()."""
    zeros = np.zeros(len(utc_ns))
    to_meridian = _turn(3, zeros + np.radians(longitude_deg))
    return _chain(q_icrs_to_itrs(utc_ns), to_meridian, _turn(2, zeros - np.radians(latitude_deg) - np.pi / 2))


def q_icrs_to_enu(utc_ns: IntArray, latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """The rotations (n, 4) from ICRS to east, north, up, as `q_icrs_to_ned`."""
    return multiply(np.array(Q_NED_TO_ENU), q_icrs_to_ned(utc_ns, latitude_deg, longitude_deg))


def earth_rate_ned_rad_s(latitude_deg: float) -> FloatArray:
    """The Earth's own rate (3,), rad/s, in north, east, down: what a level frame turns by with respect to the ICRS."""
    latitude = np.radians(latitude_deg)
    return EARTH_RATE_RAD_S * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


def beyond_table(first_ns: int, last_ns: int) -> str | None:
    """What to tell the user where a span of UTC (ns) leaves the table of the Earth's orientation; None where it does not."""
    table = _table()
    first, last = (UNIX_MJD + t_ns / (24 * HOUR_NS) for t_ns in (first_ns, last_ns))
    beyond_days = max(table.mjd[0] - first, last - table.mjd[-1])
    if beyond_days <= 0:
        return None
    begin, end = (f"{np.datetime64(int(mjd) - UNIX_MJD, 'D')}" for mjd in (table.mjd[0], table.mjd[-1]))
    off = UT1_ARCSEC_PER_S * UT1_S_A_YEAR * max(1.0, beyond_days / 365.25)
    return (
        f"the table of the Earth's orientation goes from {begin} to {end}; beyond it UT1 is guessed, and the sky may be turned"
        f" by {off:.0f} arcsec; a newer astropy-iers-data has later dates"
    )


def utc_ns_of(text: str, option: str) -> int:
    """Nanoseconds since 1970 of a UTC, where every day has 86400 s. Raises InputError that names the option."""
    try:
        return epoch_ns("", text)
    except AemFaultError as fault:
        raise InputError(f"{option} {text}: {UTC_FORM}") from fault


@lru_cache(maxsize=1)
def _table() -> _Table:
    """The IERS table of Astropy's package (finals2000A), with its predictions of a year."""
    from astropy.utils import iers

    rows = iers.IERS_A.read(iers.IERS_A_FILE)
    mjd = np.array(rows["MJD"].value, dtype=np.float64)
    ut1_utc_s, x_arcsec, y_arcsec = (np.array(rows[name].value, dtype=np.float64) for name in ("UT1_UTC", "PM_x", "PM_y"))
    ut1_tai_s = ut1_utc_s - tai_minus_utc_s(mjd.astype(np.int64) - UNIX_MJD)
    return _Table(mjd, ut1_tai_s, np.radians(x_arcsec / 3600), np.radians(y_arcsec / 3600))


def tai_minus_utc_s(unix_days: IntArray) -> FloatArray:
    """TAI-UTC in seconds at the beginnings of days since 1970."""
    year, month, day, _ = erfa.jd2cal(MJD_ZERO_JD + UNIX_MJD, np.asarray(unix_days, dtype=np.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # a year after the last known leap second
        return np.asarray(erfa.dat(year, month, day, 0.0))


def _turn(axis: int, angle_rad: FloatArray) -> FloatArray:
    """Quaternions (n, 4) of frames turned about their axis 1, 2 or 3 (R1, R2, R3 of the IERS Conventions)."""
    q = np.zeros((len(angle_rad), 4))
    q[:, 0], q[:, axis] = np.cos(angle_rad / 2), -np.sin(angle_rad / 2)
    return q


def _chain(*turns: FloatArray) -> FloatArray:
    """The rotation of all turns, the first one first."""
    q = turns[0]
    for turn in turns[1:]:
        q = multiply(turn, q)
    return q
