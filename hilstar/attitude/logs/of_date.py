"""Frames that move with the equator or with the Earth, against the ICRS: MOD, TOD and TEME of a date, and the ITRF.

MOD and TOD are the mean and the true equator and equinox of date of IAU 2006/2000A; those of 1976/1980 lie within 0.1 arcsec.
TEME is the true equator of 1980 with the mean equinox: TOD of 1980 turned back by the equation of the equinoxes of 1994
(Vallado et al. 2006, AIAA 2006-6753). The ITRF is that of `earth`; its realisations lie within 1 mas.
"""

from __future__ import annotations

import erfa
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs import earth
from hilstar.attitude.logs.aem.blocks import AemFaultError
from hilstar.rotation import from_matrix, normalise
from hilstar.units import NS_PER_S

# Seconds from a scale to TAI; TDB is within 2 ms of TT, in which the Earth turns by 0.03 arcsec.
TO_TAI_S = {"TAI": 0.0, "GPS": 19.0, "TT": -32.184, "TDB": -32.184}


def q_icrs_to_date(frame: str, scale: str, t_ns: earth.IntArray) -> tuple[FloatArray, FloatArray, str | None]:
    """The rotations (n, 4) from ICRS to a frame at times (n,), its own rate (3,), rad/s, in its components, and a notice.

    Times are ns since 1970 in a scale's days of 86400 s. Raises AemFaultError for a scale that does not tell UTC, by
    which the ITRF turns.
    """
    if frame in {"MOD", "TOD", "TEME"}:
        return _of_hours(frame, t_ns), np.zeros(3), None
    if scale == "UTC":
        utc_ns = t_ns
    elif scale in TO_TAI_S:
        tai_ns = t_ns + round(TO_TAI_S[scale] * NS_PER_S)
        days = (tai_ns - 37 * NS_PER_S) // (24 * earth.HOUR_NS)  # within a second of UTC's day since 2017
        utc_ns = tai_ns - np.round(earth.tai_minus_utc_s(days) * NS_PER_S).astype(np.int64)
    else:
        raise AemFaultError(
            "", f"TIME_SYSTEM = {scale} does not tell UTC, by which the {frame} turns; write UTC, TAI, TT, TDB or GPS"
        )
    turning = np.array([0.0, 0.0, earth.EARTH_RATE_RAD_S])
    return earth.q_icrs_to_itrs(utc_ns), turning, earth.beyond_table(int(utc_ns.min()), int(utc_ns.max()))


def _of_hours(frame: str, t_ns: earth.IntArray) -> FloatArray:
    """Linear over an hour, which is within 5 microarcsec; a scale's offset from TT, 69 s, is 0.1 mas of precession."""
    hours, place = np.unique(np.concatenate((t_ns // earth.HOUR_NS, t_ns // earth.HOUR_NS + 1)), return_inverse=True)
    q = np.array([from_matrix(_matrix(frame, hour / 24.0)) for hour in hours.tolist()])
    before, after = q[place[: len(t_ns)]], q[place[len(t_ns) :]]
    return normalise(before + ((t_ns % earth.HOUR_NS) / earth.HOUR_NS)[:, None] * (after - before))


def _matrix(frame: str, unix_days: float) -> FloatArray:
    date = (earth.MJD_ZERO_JD, earth.UNIX_MJD + unix_days)
    if frame == "MOD":
        return np.asarray(erfa.pmat06(*date))
    if frame == "TOD":
        return np.asarray(erfa.pnm06a(*date))
    bias, _, _ = erfa.bp00(*date)
    return np.asarray(erfa.rz(erfa.eqeq94(*date), erfa.pnm80(*date) @ bias))
