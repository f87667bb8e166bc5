"""A spacecraft's orbit by a CCSDS Orbit Ephemeris Message, 1.0 to 3.0 (CCSDS 502.0-B), in KVN.

Its frame is ICRF, GCRF or EME2000 about the Earth; lines of a segment are joined by the Hermite
polynomial through the four epochs about a time, places and velocities, whatever the message
recommends. Accelerations and covariances are not used.
"""

import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import erfa
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S

EPOCH = re.compile(r"(\d{4})-(?:(\d\d)-(\d\d)|(\d{3}))T(\d\d):(\d\d):(\d\d(?:\.\d+)?)Z?", re.ASCII)
YEARS = range(1900, 2200)
NODES = 4  # 1e-6 km of a low orbit at four minutes
# to beyond the Lagrange points; a state in metres is outside one of them
MIN_KM, MAX_KM, MAX_KM_S = 6000.0, 1e7, 1e3
FAR_KM = 1.0  # half an arcsecond of the Moon
TRIED = 50  # epochs that are held out in turn: they bound the time that a long file takes
DAY_NS = 86_400 * NS_PER_S
# magnitudes are those of a minute's beginning, places those of two steps
UNSEEN_NS = 120 * NS_PER_S
COUNTS = {7, 10}  # an epoch, place and velocity, perhaps an acceleration

log = logging.getLogger(__name__)
VERSION_KEY = "CCSDS_OEM_VERS"
OEM_ADVICE = "write an OEM in KVN about the Earth in ICRF, GCRF or EME2000"
FRAMES = frozenset({"ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "EME2000", "J2000"})
# TDB is within 2 ms, or 15 m, of TT
TAI_TO_SCALE_S = {"TAI": 0.0, "GPS": -19.0, "TT": 32.184, "TDB": 32.184}


@dataclass(frozen=True, slots=True)
class Segment:
    """One segment: its time scale, epochs (n,), ns since 1970 of that scale, and states (n, 6),
    km and km/s, ICRS axes.
    """

    scale: str
    t_ns: npt.NDArray[np.int64]
    states: FloatArray

    def ends_ns(self) -> tuple[int, int]:
        """The first and the last epoch."""
        return int(self.t_ns[0]), int(self.t_ns[-1])


class OemOrbit:
    """The orbit in the text of a file `name`.

    Raises InputError for a text that is none, or that has no epoch within a day of a UTC, ns since
    1970, at which stars are placed. Where that is only the beginning of the `day` of what is shown,
    the file need not cover it.
    """

    step_s = 2.0  # as for a `TleOrbit`

    def __init__(self, text: str, name: str, utc_ns: int, day: bool = False) -> None:
        self._name = name
        self._segments = list(_segments(text, name))
        self._told = False
        self._stars_ns = utc_ns
        self._unseen_ns = UNSEEN_NS if day else -1
        if not self._segments:
            raise InputError(f"{name}: contains no segment of an orbit; {OEM_ADVICE}")
        nearest_ns = min(_away_ns(segment, utc_ns) for segment in self._segments)
        if nearest_ns > DAY_NS:
            spans = ", ".join(map(_span, self._segments[:5]))
            raise InputError(
                f"{name}: has no orbit within a day of {_date(utc_ns)} UTC; it has {spans}"
            )
        off_km = max(map(_off_km, self._segments))
        if off_km > FAR_KM:
            advice = "write epochs a few minutes apart"
            log.warning(
                "%s: between its epochs the orbit is off by some %.2g km; %s", name, off_km, advice
            )

    def state(self, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """Place (3,), km, and velocity (3,), km/s; where the file has none, those of its nearest
        epoch, which is told once.
        """
        segment = min(reversed(self._segments), key=lambda s: _away_ns(s, utc_ns))
        is_away = _away_ns(segment, utc_ns) > 0
        since_ns = abs(utc_ns - self._stars_ns)
        if is_away and not self._told and since_ns > self._unseen_ns:
            log.warning(
                "%s: has no orbit at %s UTC; that of its nearest epoch is held",
                self._name,
                _date(utc_ns),
            )
            self._told = True
        first_ns, last_ns = segment.ends_ns()
        t_ns = min(max(_time(segment.scale, utc_ns), first_ns), last_ns)
        return _at(segment.t_ns, segment.states, t_ns)


def _away_ns(segment: Segment, utc_ns: int) -> int:
    """How far a UTC is from what a segment covers; 0 within."""
    t_ns = _time(segment.scale, utc_ns)
    first_ns, last_ns = segment.ends_ns()
    return max(first_ns - t_ns, t_ns - last_ns, 0)


def _at(
    times_ns: npt.NDArray[np.int64], states: FloatArray, t_ns: int
) -> tuple[FloatArray, FloatArray]:
    """Place and velocity at a time by the NODES states (n, 6) about it."""
    centred = np.searchsorted(times_ns, t_ns) - NODES // 2
    first = int(np.clip(centred, 0, max(0, len(times_ns) - NODES)))
    near = slice(first, first + NODES)
    from scipy.interpolate import KroghInterpolator

    # An epoch that stands twice gives its place first and then its velocity.
    since_s = (times_ns[near] - t_ns) / NS_PER_S
    place_and_velocity = states[near].reshape(-1, 3)
    polynomial = KroghInterpolator(np.repeat(since_s, 2), place_and_velocity)
    place, velocity = polynomial.derivatives(0.0, der=2)
    return place, velocity


def _off_km(segment: Segment) -> float:
    """How far the polynomial is off between epochs, km, by what it is at epochs that are held
    out, where steps are longer.
    """
    count = len(segment.t_ns)
    if count <= 2:
        return 0.0
    held_out = np.unique(np.linspace(1, count - 2, TRIED).astype(int))
    order = 2 * min(NODES, count - 1)
    worst_km = 0.0
    for k in held_out.tolist():
        first = max(0, k - NODES)
        around = slice(first, k + NODES + 1)
        near_ns = np.delete(segment.t_ns[around], k - first)
        near_states = np.delete(segment.states[around], k - first, axis=0)
        place, _ = _at(near_ns, near_states, int(segment.t_ns[k]))
        off_km = float(np.linalg.norm(place - segment.states[k, :3]))
        worst_km = max(worst_km, off_km)
    # the polynomial's error falls with the step to its order
    return worst_km / float(2**order)


def _segments(text: str, name: str) -> Iterator[Segment]:
    """The segments of a text, one after the other. Raises InputError with the line."""
    meta: dict[str, str] = {}
    rows: list[list[str]] = []
    section = "header"
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if not line or line.split(maxsplit=1)[0] == "COMMENT":
            continue
        if line in {"META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"}:
            if line == "META_START":
                yield from _segment(meta, rows, name)
                meta = {}
                rows = []
            section = {"META_START": "metadata", "COVARIANCE_START": "covariance"}.get(line, "data")
        elif section in {"header", "metadata"}:
            key, equals, value = line.partition("=")
            if not equals:
                raise InputError(
                    f"{name}:{number}: {line[:40]!r} in the {section}; write KEYWORD = value"
                )
            meta[key.strip()] = " ".join(value.upper().split())
        elif section == "data":
            fields = line.split()
            if len(fields) not in COUNTS:
                raise InputError(
                    f"{name}:{number}: {line[:40]!r}; write an epoch, X Y Z (km) and X_DOT Y_DOT"
                    " Z_DOT (km/s)"
                )
            rows.append([str(number), *fields[:7]])
    if section == "metadata":
        raise InputError(f"{name}: ends in the metadata; is it cut off?")
    yield from _segment(meta, rows, name)


def _segment(meta: dict[str, str], rows: list[list[str]], name: str) -> Iterator[Segment]:
    """The segment of some rows; none for the header, which has no frame. Raises InputError."""
    if "REF_FRAME" not in meta and not rows:
        return  # the header
    frame = meta.get("REF_FRAME", "missing")
    centre = meta.get("CENTER_NAME", "missing")
    scale = meta.get("TIME_SYSTEM", "missing")
    if frame not in FRAMES or centre != "EARTH":
        raise InputError(
            f"{name}: REF_FRAME is {frame[:40]} and CENTER_NAME {centre[:40]}; {OEM_ADVICE}"
        )
    if scale not in {"UTC", *TAI_TO_SCALE_S}:
        raise InputError(
            f"{name}: TIME_SYSTEM is {scale[:40]}; write UTC, {', '.join(TAI_TO_SCALE_S)}"
        )
    if len(rows) < 2:
        raise InputError(f"{name}: a segment has {len(rows)} states; it needs two or more")
    epochs_ns = []
    states = []
    for line, epoch, *numbers in rows:
        where = f"{name}:{line}"
        epochs_ns.append(_epoch_ns(epoch, where))
        states.append(_numbers(numbers, where))
    t_ns = np.array(epochs_ns, dtype=np.int64)
    back = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(back):
        raise InputError(
            f"{name}:{rows[back[0] + 1][0]}: the epoch is not after the one before it; sort the"
            " lines by time"
        )
    yield Segment(scale, t_ns, np.array(states))


def _numbers(words: list[str], where: str) -> list[float]:
    """A state's six figures. Raises InputError."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [np.nan] * 6
    place = np.abs(numbers[:3])
    speed = np.abs(numbers[3:])
    is_orbit = (place < MAX_KM).all() and (speed < MAX_KM_S).all()
    if not is_orbit or not np.linalg.norm(place) > MIN_KM:
        raise InputError(
            f"{where}: {' '.join(words)[:60]!r}; write km from the Earth's centre, and km/s"
        )
    return numbers


def _epoch_ns(text: str, where: str) -> int:
    """Nanoseconds from 1970 to an epoch in its own scale, every day 86400 s."""
    match = EPOCH.fullmatch(text)
    try:
        if match is None:
            raise ValueError
        year, month, day, of_year, hour, minute, second = match.groups()
        # either month and day, or the day of the year
        day_of_year = int(of_year or 1)
        start = f"{year}-{month}-{day}" if month else year
        date = np.datetime64(start, "D") + (day_of_year - 1)
        # a day of the year before its first or after its last is in another year
        is_date = int(year) in YEARS and str(date).startswith(year)
        is_time = int(hour) < 24 and int(minute) < 60 and float(second) < 60
        if not is_date or not is_time:
            raise ValueError
        days = int(date.astype(np.int64))
        minutes = 60 * int(hour) + int(minute)
        return days * DAY_NS + minutes * 60 * NS_PER_S + round(float(second) * NS_PER_S)
    except ValueError:
        raise InputError(
            f"{where}: the epoch is {text[:40]!r}; write YYYY-MM-DDThh:mm:ss.f or"
            " YYYY-DDDThh:mm:ss.f"
        ) from None


def _time(scale: str, utc_ns: int) -> int:
    """A UTC, ns since 1970, in another time scale."""
    if scale == "UTC":
        return utc_ns
    date = _date(utc_ns)[:10]
    year, month, day = map(int, date.split("-"))
    with warnings.catch_warnings():
        # before 1960, and years after the last known leap second
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        leap_s = float(erfa.dat(year, month, day, 0.0))
    return utc_ns + round((leap_s + TAI_TO_SCALE_S[scale]) * NS_PER_S)


def _date(t_ns: int) -> str:
    """A time, ns since 1970, to the second."""
    return str(np.datetime64(t_ns, "ns").astype("datetime64[s]"))


def _span(segment: Segment) -> str:
    """The first and the last date of a segment, and their time scale."""
    first_ns, last_ns = segment.ends_ns()
    return f"{_date(first_ns)} to {_date(last_ns)} {segment.scale}"
