"""Rotations from the ICRS to frames of date, to the turning Earth and to a local level; and the
reference frame of a log.

    ICRS --C(X, Y, s)--> CIRS --R3(ERA)--> TIRS --W(polar motion)--> ITRS
    ITRS --R2(-latitude - 90 deg) R3(longitude)--> NED

IERS Conventions (2010), chapter 5: precession and nutation of IAU 2006/2000A, the Earth rotation
angle of UT1, and UT1-UTC and polar motion from the IERS table in Astropy's package: nothing is
downloaded. The pole's offsets (0.4 mas), tides shorter than a day (0.6 mas) and s' (0.01 mas) are
neglected. "Level" is normal to the WGS84 ellipsoid at a geodetic latitude: a plumb line differs by
the deflection of the vertical, some arcsec in plains and an arcmin beside high mountains.

MOD and TOD are the mean and the true equator and equinox of date of IAU 2006/2000A; those of
1976/1980 lie within 0.1 arcsec. TEME is the true equator of 1980 with the mean equinox: TOD of 1980
turned back by the equation of the equinoxes of 1994 (Vallado et al. 2006, AIAA 2006-6753). ITRF is
the ITRS above; its realisations lie within 1 mas.

A reference frame named `icrs` or `gcrf` says what its axes are; `map`, `world` or `odom` does not,
and is never guessed.
"""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple

import erfa
import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.aem_blocks import AemFaultError, epoch_ns
from hilstar.attitude.logs.entries import LogEntry, Stated
from hilstar.attitude.logs.log_times import FIRST_DATE_NS
from hilstar.attitude.wire.packet import INT64, AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import frame_turns, from_matrix, multiply, normalise, rotate
from hilstar.basics.units import NS_PER_S

IntArray = npt.NDArray[np.int64]
HOUR_NS = 3600 * NS_PER_S
UNIX_MJD, MJD_ZERO_JD = 40587, 2400000.5
TT_FROM_TAI_S = 32.184
# rate of the Earth rotation angle: 2 pi 1.00273781191135448 a day of UT1 (IAU 2000)
EARTH_RATE_RAD_S = 7.292115146706979e-5
UT1_ARCSEC_PER_S = 15.041
TURNED = (
    "turned to the ICRS with the Earth (IAU 2006/2000A; 15 arcsec for each second that its UTC is"
    " off)"
)
# UT1-TAI, held at the ends of the table, has moved by this in a year since 1973 at most (days 3 ms
# long)
UT1_S_A_YEAR = 1.1
HALF = float(np.sqrt(0.5))
Q_NED_TO_ENU = (0.0, HALF, HALF, 0.0)
UTC_FORM = "write a UTC such as 2026-11-22T10:00:00"
BEYOND_NS = "UTC goes from 1677-09-22 to 2262-04-11, 64 bits of nanoseconds; write one between them"
# Seconds from a scale to TAI; TDB is within 2 ms of TT, in which the Earth turns by 0.03 arcsec.
TO_TAI_S = {"TAI": 0.0, "GPS": 19.0, "TT": -32.184, "TDB": -32.184}
Kind = Literal["icrs", "enu", "ned"]
# EME2000's axes lie within 23 mas of the ICRF's. "eci" and "inertial", which simulators write, are
# taken too, with a notice.
EXACT = frozenset({"icrs", "icrf", "gcrs", "gcrf", "j2000", "eme2000"})
LOOSE = frozenset({"eci", "inertial", "eci_j2000", "j2000_eci", "inertial_frame"})
KINDS: dict[str, Kind] = {**dict.fromkeys(EXACT | LOOSE, "icrs"), "enu": "enu", "ned": "ned"}
AXES: dict[Kind, str] = {"icrs": "the ICRS", "enu": "east, north, up", "ned": "north, east, down"}
BATCH = 4096


class _EarthTable(NamedTuple):
    """Earth orientation by day (n,): MJD of UTC, UT1-TAI in seconds, and the pole's coordinates
    in radians.
    """

    mjd: FloatArray
    ut1_tai_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray


def q_icrs_to_itrs(utc_ns: IntArray) -> FloatArray:
    """The rotations (n, 4) from ICRS to the Earth's axes (ITRS) at UTCs (n,), ns since 1970
    where every day has 86400 s.
    """
    hours, place = np.unique(
        np.concatenate((utc_ns // HOUR_NS, utc_ns // HOUR_NS + 1)), return_inverse=True
    )
    before = place[: len(utc_ns)]
    after = place[len(utc_ns) :]
    share = (utc_ns % HOUR_NS) / HOUR_NS

    def between(values: FloatArray) -> FloatArray:
        return values[before] + share * (values[after] - values[before])

    table = _table()
    mjd = UNIX_MJD + hours / 24.0
    tai_utc_s = _tai_minus_utc_s(hours // 24)
    tt_days = (tai_utc_s + TT_FROM_TAI_S) / 86400.0
    # Linear over an hour, these are within 5 microarcsec: the shortest nutation of note takes 5.5
    # days.
    x, y, s = (between(values) for values in erfa.xys06a(MJD_ZERO_JD, mjd + tt_days))
    ut1_tai_s, pole_x, pole_y = (
        between(np.interp(mjd, table.mjd, column))
        for column in (table.ut1_tai_s, table.x_rad, table.y_rad)
    )
    ut1_days = (utc_ns % (24 * HOUR_NS)) / (24 * HOUR_NS) + (
        ut1_tai_s + tai_utc_s[before]
    ) / 86400.0
    era = erfa.era00(MJD_ZERO_JD + UNIX_MJD + utc_ns // (24 * HOUR_NS), ut1_days)
    node = np.arctan2(y, x)
    tilt = np.arcsin(np.hypot(x, y))
    to_cirs = _chain(frame_turns(2, node), frame_turns(1, tilt), frame_turns(2, -node - s))
    return _chain(to_cirs, frame_turns(2, era), frame_turns(1, -pole_x), frame_turns(0, -pole_y))


def q_icrs_to_ned(
    utc_ns: IntArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> FloatArray:
    """The rotations (n, 4) from ICRS to north, east, down at UTCs (n,) and geodetic places (n,)
    or ().
    """
    zeros = np.zeros(len(utc_ns))
    to_meridian = frame_turns(2, zeros + np.radians(longitude_deg))
    return _chain(
        q_icrs_to_itrs(utc_ns),
        to_meridian,
        frame_turns(1, zeros - np.radians(latitude_deg) - np.pi / 2),
    )


def q_icrs_to_enu(
    utc_ns: IntArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> FloatArray:
    """The rotations (n, 4) from ICRS to east, north, up, as `q_icrs_to_ned`."""
    return multiply(np.array(Q_NED_TO_ENU), q_icrs_to_ned(utc_ns, latitude_deg, longitude_deg))


def earth_rate_ned_rad_s(latitude_deg: float) -> FloatArray:
    """The Earth's own rate (3,), rad/s, in north, east, down: what a level frame turns by with
    respect to the ICRS.
    """
    latitude = np.radians(latitude_deg)
    return EARTH_RATE_RAD_S * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


def beyond_table(first_ns: int, last_ns: int) -> str | None:
    """What to tell the user where a span of UTC (ns) leaves the table of the Earth's
    orientation; None where it does not.
    """
    table = _table()
    first, last = (UNIX_MJD + t_ns / (24 * HOUR_NS) for t_ns in (first_ns, last_ns))
    beyond_days = max(table.mjd[0] - first, last - table.mjd[-1])
    if beyond_days <= 0:
        return None
    begin, end = (
        f"{np.datetime64(int(mjd) - UNIX_MJD, 'D')}" for mjd in (table.mjd[0], table.mjd[-1])
    )
    off = UT1_ARCSEC_PER_S * UT1_S_A_YEAR * max(1.0, beyond_days / 365.25)
    return (
        f"the table of the Earth's orientation goes from {begin} to {end}; beyond it UT1 is"
        f" guessed, and the sky may be turned by {off:.0f} arcsec; a newer astropy-iers-data has"
        " later dates"
    )


def utc_ns_of(text: str, option: str) -> int:
    """Nanoseconds since 1970 of a UTC, where every day has 86400 s. Raises InputError that names
    the option.
    """
    try:
        return epoch_ns("", text)
    except AemFaultError as fault:
        raise InputError(f"{option} {text}: {UTC_FORM}") from fault


@lru_cache(maxsize=1)
def _table() -> _EarthTable:
    """The IERS table of Astropy's package (finals2000A) and its year of predictions, in a
    twentieth of Astropy's own time.
    """
    from astropy_iers_data import IERS_A_FILE

    # UT1, pole
    a_columns = ((58, 68), (18, 27), (37, 46))
    b_columns = ((154, 165), (134, 144), (144, 154))
    rows = []
    with Path(IERS_A_FILE).open(encoding="ascii") as file:
        for line in file:
            # days beyond the predictions have a date alone
            if not line[58:68].strip():
                continue
            # the final values of Bulletin B, where there are some
            columns = b_columns if line[154:165].strip() else a_columns
            cells = [line[begin:end] for begin, end in columns]
            rows.append((line[7:15], *cells))
    mjd, ut1_utc_s, x_arcsec, y_arcsec = np.array(rows, dtype=np.float64).T
    ut1_tai_s = ut1_utc_s - _tai_minus_utc_s(mjd.astype(np.int64) - UNIX_MJD)
    return _EarthTable(mjd, ut1_tai_s, np.radians(x_arcsec / 3600), np.radians(y_arcsec / 3600))


def _tai_minus_utc_s(unix_days: IntArray) -> FloatArray:
    """TAI-UTC in seconds at the beginnings of days since 1970."""
    year, month, day, _ = erfa.jd2cal(
        MJD_ZERO_JD + UNIX_MJD, np.asarray(unix_days, dtype=np.float64)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # a year after the last known leap second
        return np.asarray(erfa.dat(year, month, day, 0.0))


def _chain(*turns: FloatArray) -> FloatArray:
    q = turns[0]
    for turn in turns[1:]:
        q = multiply(turn, q)
    return q


def q_icrs_to_date(
    frame: str, scale: str, t_ns: IntArray
) -> tuple[FloatArray, FloatArray, str | None]:
    """The rotations (n, 4) from ICRS to a frame at times (n,), its own rate (3,), rad/s, in its
    components, and a notice.

    Times are ns since 1970 in a scale's days of 86400 s. Raises AemFaultError for a scale that does
    not tell UTC, by
    which the ITRF turns.
    """
    if frame in {"MOD", "TOD", "TEME"}:
        return _of_hours(frame, t_ns), np.zeros(3), None
    if scale == "UTC":
        utc_ns = t_ns
    elif scale in TO_TAI_S:
        tai_ns = t_ns + round(TO_TAI_S[scale] * NS_PER_S)
        days = (tai_ns - 37 * NS_PER_S) // (24 * HOUR_NS)  # within a second of UTC's day since 2017
        utc_ns = tai_ns - np.round(_tai_minus_utc_s(days) * NS_PER_S).astype(np.int64)
    else:
        raise AemFaultError(
            "",
            f"TIME_SYSTEM = {scale} does not tell UTC, by which the {frame} turns; write UTC, TAI,"
            " TT, TDB or GPS",
        )
    turning = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
    return q_icrs_to_itrs(utc_ns), turning, beyond_table(int(utc_ns.min()), int(utc_ns.max()))


def _of_hours(frame: str, t_ns: IntArray) -> FloatArray:
    """Linear over an hour, which is within 5 microarcsec; a scale's offset from TT, 69 s, is 0.1
    mas of precession.
    """
    hours, place = np.unique(
        np.concatenate((t_ns // HOUR_NS, t_ns // HOUR_NS + 1)), return_inverse=True
    )
    q = np.array([from_matrix(_matrix(frame, hour / 24.0)) for hour in hours.tolist()])
    before = q[place[: len(t_ns)]]
    after = q[place[len(t_ns) :]]
    return normalise(before + ((t_ns % HOUR_NS) / HOUR_NS)[:, None] * (after - before))


def _matrix(frame: str, unix_days: float) -> FloatArray:
    date = (MJD_ZERO_JD, UNIX_MJD + unix_days)
    if frame == "MOD":
        return np.asarray(erfa.pmat06(*date))
    if frame == "TOD":
        return np.asarray(erfa.pnm06a(*date))
    bias, _, _ = erfa.bp00(*date)
    return np.asarray(erfa.rz(erfa.eqeq94(*date), erfa.pnm80(*date) @ bias))


class Reference(NamedTuple):
    """What attitudes refer to; a level frame has a `place` (latitude, longitude, degrees), and
    its UTC is `t_ns + utc_ns`.
    """

    kind: Kind
    place: tuple[float, float] = (0.0, 0.0)
    utc_ns: int = 0

    def q_icrs_to_reference(self, t_ns: Iterable[int]) -> FloatArray:
        """The rotations (n, 4) from ICRS at the log's times (n,)."""
        utc_ns = np.fromiter(t_ns, dtype=np.int64) + self.utc_ns
        if self.kind == "icrs":
            return np.tile([1.0, 0.0, 0.0, 0.0], (len(utc_ns), 1))
        if self.kind == "enu":
            turn = q_icrs_to_enu
        else:
            turn = q_icrs_to_ned
        return turn(utc_ns, np.array(self.place[0]), np.array(self.place[1]))

    @property
    def earth_rate_rad_s(self) -> FloatArray:
        """What the reference itself turns by with respect to the stars (3,), in its own
        components.
        """
        if self.kind == "icrs":
            return np.zeros(3)
        north, east, down = earth_rate_ned_rad_s(self.place[0])
        return np.array([east, north, -down] if self.kind == "enu" else [north, east, down])

    @property
    def words(self) -> str:
        """The frame in words, for `--explain`."""
        if self.kind == "icrs":
            return AXES["icrs"]
        latitude_deg, longitude_deg = self.place
        return (
            f"{AXES[self.kind]} at latitude {latitude_deg:g}, longitude {longitude_deg:g}, {TURNED}"
        )


def stated_reference(path: Path, kind: Kind, stated: Stated, first_ns: int) -> Reference:
    """The reference of that kind, once all is stated that it needs; `first_ns` is the log's first
    time.

    Raises InputError where a level frame has no place, or its times are no dates and their zero is
    not stated, or is twice; and where a place or a zero is stated of the ICRS, which needs none.
    """
    if kind == "icrs":
        for option, value in (("--place", stated.place), ("--epoch-utc", stated.epoch_utc)):
            if value is not None:
                raise InputError(
                    f"{path}: {option} is for attitudes that refer to a level frame (--reference"
                    f" enu or ned), and these refer to {AXES[kind]}; leave it out"
                )
        return Reference(kind)
    if stated.place is None:
        raise InputError(
            f"{path}: its attitudes refer to {AXES[kind]}; give the place with --place"
            " LAT,LON,HEIGHT"
        )
    dated = first_ns >= FIRST_DATE_NS
    utc_ns = 0
    if dated and stated.epoch_utc is not None:
        raise InputError(
            f"{path}: its times are dates already (ns since 1970); leave out --epoch-utc"
        )
    if not dated:
        if stated.epoch_utc is None:
            raise InputError(
                f"{path}: its times begin at {first_ns / NS_PER_S:.9g} s, no date; give --epoch-utc"
                " TIME, UTC at 0 s"
            )
        utc_ns = utc_ns_of(stated.epoch_utc, "--epoch-utc")
        if first_ns + utc_ns not in INT64:
            raise InputError(f"--epoch-utc {stated.epoch_utc}: {BEYOND_NS}")
    return Reference(kind, stated.place[:2], utc_ns)


def reference_kind(path: Path, stated: Stated, told: list[tuple[str, str]]) -> Kind:
    """What the axes of a log's reference are by `--reference` alone, the log itself naming no
    frame; the ICRS without one.

    Raises InputError for a name that does not say what its axes are.
    """
    if stated.reference is None:
        return "icrs"
    kind = KINDS.get(stated.reference.lower())
    if kind is None:
        raise InputError(
            f"{path}: --reference {shortened(stated.reference)}: the log names no frame; write"
            " icrs, enu or ned"
        )
    if stated.reference.lower() in LOOSE:
        told.append(("reference", loosely_icrs(stated.reference)))
    return kind


def loosely_icrs(frame: str) -> str:
    """What to tell the user of a frame that simulators call inertial."""
    return f"the frame {frame!r} is taken as the ICRS; a frame of date is 0.4 deg off by now"


def to_icrs(
    entries: Iterable[LogEntry], reference: Reference, gyro: bool, told: list[tuple[str, str]]
) -> Iterator[LogEntry]:
    """Attitudes from the reference to the body become those from ICRS; rates too, unless a
    gyroscope measured them.

    At their end `told` gets a notice where the dates leave the table of the Earth's orientation.
    Raises InputError at a time whose UTC does not fit 64 bits.
    """
    if reference.kind == "icrs":
        yield from entries
        return
    first_ns = None
    last_ns = 0
    remaining = iter(entries)
    while batch := list(islice(remaining, BATCH)):
        samples = [entry.event for entry in batch if isinstance(entry.event, AttitudeSample)]
        beyond_ns = [each.t_ns for each in samples if each.t_ns + reference.utc_ns not in INT64]
        if beyond_ns:
            raise InputError(f"t_s {beyond_ns[0] / NS_PER_S:.9g} with --epoch-utc: {BEYOND_NS}")
        turned = iter(_from_icrs(samples, reference, gyro))
        if samples:
            if first_ns is None:
                first_ns = samples[0].t_ns
            else:
                first_ns = min(first_ns, samples[0].t_ns)
            last_ns = max(last_ns, samples[-1].t_ns)
        for entry in batch:
            yield (
                LogEntry(entry.where, next(turned))
                if isinstance(entry.event, AttitudeSample)
                else entry
            )
    if first_ns is not None:
        beyond = beyond_table(first_ns + reference.utc_ns, last_ns + reference.utc_ns)
        told += [] if beyond is None else [("log-earth", beyond)]


def _from_icrs(
    samples: list[AttitudeSample], reference: Reference, gyro: bool
) -> list[AttitudeSample]:
    if not samples:
        return []
    q_ref_to_body = np.array([sample.q_icrs_to_cam for sample in samples])
    q = multiply(q_ref_to_body, reference.q_icrs_to_reference(sample.t_ns for sample in samples))
    earths = rotate(q_ref_to_body, np.tile(reference.earth_rate_rad_s, (len(samples), 1)))
    turned = []
    for sample, attitude, earth_rate in zip(samples, q, earths, strict=True):
        if sample.rate_cam_rad_s is None or gyro:
            rate = sample.rate_cam_rad_s
        else:
            rate = sample.rate_cam_rad_s + earth_rate
        turned.append(replace(sample, q_icrs_to_cam=attitude, rate_cam_rad_s=rate))
    return turned
