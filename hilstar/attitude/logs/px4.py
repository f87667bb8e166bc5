"""The attitude of a PX4 vehicle among the stars, from a ULog file.

`vehicle_attitude.q` (w, x, y, z) turns components of the body (front, right, down) into north, east, down; the place and UTC
of each attitude turn those to the ICRS (`earth`). A change of `quat_reset_counter` is a step of the estimate, not of the
vehicle. `vehicle_angular_velocity` comes from the gyroscopes (body components, with respect to the stars). Zeros or NaN at the
beginning of a log are from before the estimator ran; they are skipped with a notice. Place and UTC come from the log, or
from the user.

A ULog file (docs.px4.io, "ULog File Format") is a head of 16 bytes, then messages: size (u16), kind (one letter), content. A
logger that lost power leaves a cut message; a card that could not keep up leaves bytes that are no message, and the next
synchronisation message says where messages begin again. `_sieve` copies the few topics needed into a small ULog file, in one
pass and bounded memory. pyulog reads that copy: of a whole file it would read all topics and follow nested formats of
any size, and it searches a damaged file in quadratic time.
"""

import contextlib
import io
import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs import earth
from hilstar.attitude.logs.aem_blocks import epoch_text
from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated, in_order
from hilstar.attitude.wire.packet import checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.errors import InputError, shortened
from hilstar.reading import ULOG_MAGIC, open_regular, size_text
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

ULOG_ADVICE = "give a ULog file (.ulg) of PX4"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
KINDS = frozenset(b"FDIMPQARSOLCB")
HEAD_BYTES = 16
APPENDED = 1  # the only incompatible flag of the format, in the first of eight bytes: data appended after a crash
MAX_FORMAT_CHARACTERS, MAX_FIELDS = 4000, 1000  # an attitude has 12 fields
MAX_SUBSCRIPTIONS = 1000
MAX_KEPT_BYTES = 1_000_000_000
PIECE_BYTES = 1 << 20
_head = struct.Struct("<HB")
_u16 = struct.Struct("<H")
IntArray = npt.NDArray[np.int64]
MAX_TIME_US = 2**53  # 285 years: what a boot clock never shows
GAP_INTERVALS = 5  # usual intervals: farther than this from both neighbours, a value is unknown
GLOBAL_POSITION = "vehicle_global_position"
GPS = ("vehicle_gps_position", "sensor_gps")
PLACE_FIELDS = (("latitude_deg", "longitude_deg"), ("lat", "lon"))
GROUND_TRUTH = "_groundtruth"
# A receiver without a fix reports 0, or an old date.
FIRST_DATE_US, LAST_DATE_US = 946_684_800_000_000, 4_102_444_800_000_000  # 2000 and 2100
UNSURE_S = 0.1  # said of fixes that agree no better: 1.5 arcsec of the Earth's turning
APART_S = 1.0
ATTITUDE = "vehicle_attitude"
ATTITUDES = (ATTITUDE, ATTITUDE + GROUND_TRUTH, "estimator_attitude", "external_ins_attitude")
RATES = "vehicle_angular_velocity"
OLD_RATES = ("rollspeed", "pitchspeed", "yawspeed")  # in vehicle_attitude itself, before v1.9
ORDER_ADVICE = "the log has two attitudes of one time, or is damaged there"


class _ULogTopic(NamedTuple):
    name: str
    instance: int


@dataclass(slots=True)
class _Sieved:
    """What is left of a log: `ulog` is a whole file of the wanted topics; `topics` are all that the log has."""

    ulog: bytes = b""
    topics: set[_ULogTopic] = field(default_factory=set)
    lost_ms: int = 0
    damaged_bytes: int = 0
    cut_at: int | None = None
    misfits: bool = False

    @property
    def told(self) -> list[tuple[str, str]]:
        lines = []
        if self.cut_at is not None:
            lines.append(("log-cut", f"the log ends within a message at byte {self.cut_at}; all before it is read"))
        if self.damaged_bytes:
            lines.append(("log-damage", f"{size_text(self.damaged_bytes)} of the log are damaged, and are left out"))
        if self.misfits:
            lines.append(("log-damage", "some messages have not the size of their format, and are left out"))
        if self.lost_ms:
            lines.append(("log-dropout", f"the logger lost {self.lost_ms / 1000:.3g} s of messages"))
        return lines


def _sieve(path: Path, wanted: frozenset[str]) -> _Sieved:
    """The messages of topics by name. Raises InputError for what is no ULog, or one of a newer kind."""
    result = _Sieved()
    ids: set[int] = set()
    with open_regular(path, ULOG_ADVICE) as file:
        head = file.read(HEAD_BYTES)
        if len(head) < HEAD_BYTES or not head.startswith(ULOG_MAGIC):
            raise InputError(f"{path}: not a ULog file, or cut within its first {HEAD_BYTES} bytes; {ULOG_ADVICE}")
        kept = bytearray(head)
        for kind, content in _messages(path, file, result):
            if kind == ord("O") and len(content) == _u16.size:
                result.lost_ms += _u16.unpack(content)[0]
            if _is_wanted(path, kind, content, wanted, (ids, result.topics)):
                kept += _head.pack(len(content), kind) + content
                if len(kept) > MAX_KEPT_BYTES:
                    raise InputError(f"{path}: its attitudes have more than {size_text(MAX_KEPT_BYTES)}; split the log")
    result.ulog = bytes(kept)
    return result


def _is_wanted(path: Path, kind: int, content: bytes, wanted: frozenset[str], found: tuple[set[int], set[_ULogTopic]]) -> bool:
    ids, topics = found
    if kind == ord("D"):
        return len(content) > _u16.size and _u16.unpack_from(content)[0] in ids
    if kind == ord("F"):
        name, _, fields = content.partition(b":")
        if name.decode("ascii", "replace") not in wanted:
            return False
        sizes = [int(size[:9]) for size in re.findall(rb"\[(\d+)\]", fields)]
        if len(fields) > MAX_FORMAT_CHARACTERS or sum(sizes) > MAX_FIELDS:
            raise InputError(
                f"{path}: its {name.decode()} has more than {MAX_FIELDS} fields, which PX4's has not; {ULOG_ADVICE}"
            )
        return True
    if kind == ord("A") and len(content) > 3:
        topic = _ULogTopic(content[3:].decode("ascii", "replace"), content[0])
        if len(topics) < MAX_SUBSCRIPTIONS:
            topics.add(topic)
        if topic.name in wanted and len(ids) < MAX_SUBSCRIPTIONS:
            ids.add(_u16.unpack_from(content, 1)[0])
            return True
    return False


def _messages(path: Path, file: IO[bytes], result: _Sieved) -> Iterator[tuple[int, bytes]]:
    """Kind and content of every whole message; `result` gets what is cut or damaged."""
    ends: list[int] = []
    last = file.tell()
    while True:
        place = file.tell()
        limit = ends[0] if ends else None
        head = file.read(_head.size)
        size, kind = _head.unpack(head) if len(head) == _head.size else (0, 0)
        if limit is not None and place + _head.size + size > limit:
            file.seek(ends.pop(0))  # what was appended after a crash; the message before it may be cut
            last = file.tell()
            continue
        if len(head) < _head.size:
            result.cut_at = place if head else result.cut_at
            return
        if kind not in KINDS or not size:
            if not _find_sync(file, last, place, result):
                return
            last = file.tell()
            continue
        content = file.read(size)
        if len(content) < size:
            result.cut_at = place
            return
        last = place
        if kind == ord("B"):
            ends = _appended(path, content, place)
        yield kind, content


def _find_sync(file: IO[bytes], last: int, place: int, result: _Sieved) -> bool:
    """Go on after the next synchronisation message; the size of the message at `last` may be what is damaged."""
    file.seek(last + _head.size)
    at, tail = file.tell(), b""
    while piece := file.read(PIECE_BYTES):
        found = (tail + piece).find(SYNC)
        if found >= 0:
            begin = at - len(tail) + found
            result.damaged_bytes += max(0, begin - place)
            file.seek(begin + len(SYNC))
            return True
        at += len(piece)
        tail = (tail + piece)[-len(SYNC) + 1 :]
    result.damaged_bytes += at - place
    return False


def _appended(path: Path, content: bytes, place: int) -> list[int]:
    """Where data was appended, from the flags that are the log's first message."""
    if place != HEAD_BYTES or len(content) < 40:
        return []
    flags = content[8:16]
    if flags[0] & ~APPENDED or any(flags[1:]):
        raise InputError(f"{path}: a ULog of a newer kind (incompatible flags {flags.hex()}); convert it with PX4's own tools")
    offsets: tuple[int, ...] = struct.unpack_from("<3Q", content, 16)
    return sorted(offset for offset in offsets if offset > place) if flags[0] & APPENDED else []


class _Series(NamedTuple):
    """The columns of one topic, by the names of its fields (`q[0]`), each (n,); `t_us` is the boot clock, microseconds."""

    t_us: IntArray
    columns: dict[str, npt.NDArray[Any]]

    def stacked(self, name: str, count: int) -> FloatArray | None:
        """The fields `name[0]`, `name[1]`, ... as (n, count); None where one is missing."""
        names = [f"{name}[{i}]" for i in range(count)]
        if not all(each in self.columns for each in names):
            return None
        return np.stack([np.asarray(self.columns[each], dtype=np.float64) for each in names], axis=1)

    def where(self, good: npt.NDArray[np.bool_]) -> "_Series":
        return _Series(self.t_us[good], {name: column[good] for name, column in self.columns.items()})


def _read_series(path: Path, sieved: _Sieved) -> dict[_ULogTopic, _Series]:
    """Every topic that the sieved log has messages of. Raises InputError where pyulog reads none of it."""
    import pyulog

    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):  # pyulog prints what it thinks of a file
            log = pyulog.ULog(io.BytesIO(sieved.ulog))
    except Exception as error:  # pyulog passes on what struct, NumPy and its own tables raise
        raise InputError(f"{path}: pyulog does not read it ({shortened(error)}); {ULOG_ADVICE}") from error
    if log.file_corruption:
        sieved.misfits = True
    series = {}
    for data in log.data_list:
        if "timestamp" in data.data:
            series[_ULogTopic(data.name, data.multi_id)] = _Series(_times_us(path, data.data), data.data)
    return series


def _times_us(path: Path, columns: dict[str, npt.NDArray[Any]]) -> IntArray:
    """When the values were true: `timestamp_sample` where the topic has it, else when they were published."""
    published = columns["timestamp"].astype(np.uint64)
    sampled = columns.get("timestamp_sample", np.zeros(1)).astype(np.uint64)
    times = sampled if len(sampled) == len(published) and bool(np.all((sampled > 0) & (sampled <= published))) else published
    if len(times) and int(times.max()) > MAX_TIME_US:
        raise InputError(f"{path}: a time of {int(times.max())} microseconds since boot; the log is damaged")
    return times.astype(np.int64)


def _at_times(series: _Series, values: FloatArray, t_us: IntArray) -> FloatArray:
    """Values (n, k) at other times (m,), linear between samples; NaN outside of them and within gaps."""
    order = np.argsort(series.t_us, kind="stable")
    times, values = series.t_us[order], values[order]
    if len(times) < 2:
        return np.full((len(t_us), values.shape[1]), np.nan)
    found = np.stack([np.interp(t_us, times, column, left=np.nan, right=np.nan) for column in values.T], axis=1)
    after = np.clip(np.searchsorted(times, t_us), 1, len(times) - 1)
    interval = times[after] - times[after - 1]
    found[interval > GAP_INTERVALS * np.median(np.diff(times))] = np.nan
    return found


def _boot_utc(path: Path, stated: Stated, topics: dict[_ULogTopic, _Series], told: list[tuple[str, str]]) -> tuple[int, str]:
    """The UTC of boot, and where it is from: `--epoch-utc`, else the median over the receiver's times.

    Raises InputError where there is neither.
    """
    offsets_us = np.array([], dtype=np.int64)  # UTC less the boot clock (n,), microseconds
    for series in _of(topics, GPS):  # the first receiver that has dates
        utc_us = series.columns.get("time_utc_usec", np.zeros(len(series.t_us)))
        good = (utc_us >= FIRST_DATE_US) & (utc_us < LAST_DATE_US)
        if good.any():
            offsets_us = utc_us[good].astype(np.int64) - _fixed_us(series)[good]
            break
    gps_ns = round(float(np.median(offsets_us - offsets_us[0]))) * 1000 + int(offsets_us[0]) * 1000 if len(offsets_us) else None
    if stated.epoch_utc is not None:
        boot_ns = earth.utc_ns_of(stated.epoch_utc, "--epoch-utc")
        if gps_ns is not None and abs(gps_ns - boot_ns) > APART_S * NS_PER_S:
            told.append(
                ("log-utc", f"--epoch-utc is {(boot_ns - gps_ns) / NS_PER_S:+.3g} s from the log's own GPS time at boot")
            )
        return boot_ns, f"{epoch_text(boot_ns)}, as stated"
    if gps_ns is None:
        raise InputError(f"{path}: has no UTC (no GPS fix with a time); give --epoch-utc TIME, the UTC at boot")
    low, high = np.percentile(offsets_us - offsets_us[0], [5, 95])
    spread_s = float(high - low) / 1e6
    if spread_s > UNSURE_S:
        turned = earth.UT1_ARCSEC_PER_S * spread_s / 2
        told.append(("log-utc", f"GPS times differ by {spread_s:.3g} s; the sky may be turned by {turned:.2g} arcsec"))
    return gps_ns, f"{epoch_text(gps_ns)} by {len(offsets_us)} GPS times, 90 % of them within {spread_s:.3g} s"


def _fixed_us(series: _Series) -> IntArray:
    """When a fix was true: when its message came, or as much earlier as the newer receivers' drivers say."""
    late_us = series.columns.get("timestamp_time_relative")
    return series.t_us if late_us is None else series.t_us + late_us.astype(np.int64)


def _place_at(
    path: Path, stated: Stated, topics: dict[_ULogTopic, _Series], t_us: IntArray, suffix: str
) -> tuple[FloatArray, FloatArray, str]:
    """Latitudes and longitudes (n,), and where they are from: `--place`, else the estimated position, else a receiver's.

    Raises InputError where there is none.
    """
    if stated.place is not None:
        latitude_deg, longitude_deg = stated.place[:2]
        words = f"at latitude {latitude_deg:g}, longitude {longitude_deg:g}, as stated"
        return np.full(len(t_us), latitude_deg), np.full(len(t_us), longitude_deg), words
    for name in (GLOBAL_POSITION + suffix, *GPS):
        for series in _of(topics, (name,)):
            found = _degrees(series)
            if found is not None:
                times, latitudes_deg, longitudes_deg = found
                longitudes_deg = np.unwrap(longitudes_deg, period=360.0)
                latitude, longitude = (np.interp(t_us, times, each) for each in (latitudes_deg, longitudes_deg))
                return latitude, longitude, f"at the place of {name}"
    raise InputError(f"{path}: has no position; give the place with --place LAT,LON,HEIGHT")


def _degrees(series: _Series) -> tuple[IntArray, FloatArray, FloatArray] | None:
    """Times, latitudes and longitudes of the rows that have any."""
    columns = series.columns
    names = next((pair for pair in PLACE_FIELDS if set(pair) <= set(columns)), None)
    if names is None:
        return None
    scale = 1e-7 if names == ("lat", "lon") and columns["lat"].dtype.kind != "f" else 1.0
    latitude_deg, longitude_deg = (np.asarray(columns[name], dtype=np.float64) * scale for name in names)
    good = (np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 360)  # False for NaN
    good &= (latitude_deg != 0) | (longitude_deg != 0)
    if "fix_type" in columns:
        good &= columns["fix_type"] >= 2
    if not good.any():
        return None
    times_us = _fixed_us(series)[good]
    order = np.argsort(times_us, kind="stable")
    return times_us[order], latitude_deg[good][order], longitude_deg[good][order]


def _of(topics: dict[_ULogTopic, _Series], names: tuple[str, ...]) -> list[_Series]:
    return [topics[topic] for name in names for topic in sorted(topics) if topic.name == name]


class _Turning(NamedTuple):
    """What turns north, east, down to the ICRS: UTC at boot (ns since 1970), the place at each attitude, and both in words.

    `latitude_deg` and `longitude_deg` (n,) are geodetic.
    """

    boot_utc_ns: int
    utc_words: str
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    place_words: str

    def q_icrs_to_ned(self, t_us: IntArray, rows: slice = slice(None)) -> FloatArray:
        """The rotations (n, 4) at times of the boot clock (n,), which are those of these rows."""
        utc_ns = t_us * 1000 + self.boot_utc_ns
        return earth.q_icrs_to_ned(utc_ns, self.latitude_deg[rows], self.longitude_deg[rows])


@np.errstate(all="ignore")  # damaged numbers are refused as not finite, or are unknown rates
def read_ulog(path: Path, stated: Stated) -> LogReading:
    """The body's attitudes. Raises InputError where neither the log nor the user says where and when they were."""
    if stated.reference is not None and stated.reference.lower() != "ned":
        raise InputError(f"{path}: a PX4 log's attitudes refer to north, east, down; leave out --reference {stated.reference}")
    name, _, number = (stated.topic or ATTITUDE).partition(":")
    suffix = GROUND_TRUTH if name.endswith(GROUND_TRUTH) else ""
    sieved = _sieve(path, frozenset({name, RATES + suffix, GLOBAL_POSITION + suffix, *GPS}))
    topic = _chosen(path, sieved.topics, name, int(number) if number.isdecimal() and len(number) < 4 else None)
    topics = _read_series(path, sieved)
    series = topics.get(topic)
    q = None if series is None else series.stacked("q", 4)
    if series is None or q is None:
        raise InputError(
            f"{path}: has no attitude in {topic.name}; choose another topic with --topic NAME, or give another log"
        )
    told = sieved.told
    series, q = _ready(path, series, q, told)
    boot_utc_ns, utc_words = _boot_utc(path, stated, topics, told)
    latitude_deg, longitude_deg, place_words = _place_at(path, stated, topics, series.t_us, suffix)
    turning = _Turning(boot_utc_ns, utc_words, latitude_deg, longitude_deg, place_words)
    rates = _rates(series, topics, suffix)
    first_ns, last_ns = (int(t_us) * 1000 + turning.boot_utc_ns for t_us in (series.t_us.min(), series.t_us.max()))
    beyond = earth.beyond_table(first_ns, last_ns)
    told += [] if beyond is None else [("log-earth", beyond)]
    entries = in_order(_entries(series, q, rates, turning), told)
    return LogReading(entries, _conventions(topic, series, turning, rates is not None), ORDER_ADVICE, told)


def _chosen(path: Path, topics: set[_ULogTopic], name: str, instance: int | None) -> _ULogTopic:
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


def _ready(path: Path, series: _Series, q: FloatArray, told: list[tuple[str, str]]) -> tuple[_Series, FloatArray]:
    """The attitudes from the first valid one on."""
    good = np.isfinite(q).all(axis=1) & (np.abs(q).max(axis=1) > 0)
    if not good.any():
        raise InputError(f"{path}: all of its attitudes are zeros or NaN: the estimator never ran; give another log")
    begin = int(np.argmax(good))
    if begin:
        told.append(("log-start", f"{begin} attitudes from before the estimator ran (zeros or NaN) are left out"))
    return series.where(np.arange(len(q)) >= begin), q[begin:]


def _rates(series: _Series, topics: dict[_ULogTopic, _Series], suffix: str) -> FloatArray | None:
    """Body rates (n, 3), rad/s, at the attitudes' times; NaN where the log has none, None where it has none at all."""
    for other in _of(topics, (RATES + suffix,)):
        rates = other.stacked("xyz", 3)
        return None if rates is None else _at_times(other, rates, series.t_us)
    if all(name in series.columns for name in OLD_RATES):
        return np.stack([np.asarray(series.columns[name], dtype=np.float64) for name in OLD_RATES], axis=1)
    return None


def _entries(series: _Series, q: FloatArray, rates: FloatArray | None, turning: _Turning) -> Iterator[LogEntry]:
    counter = series.columns.get("quat_reset_counter", np.zeros(len(q)))
    resets = [False, *np.diff(counter.astype(np.int64)).astype(bool).tolist()]
    with np.errstate(all="ignore"):
        body = multiply(conjugate(q), turning.q_icrs_to_ned(series.t_us)).tolist()
    rows = np.full((len(q), 3), np.nan).tolist() if rates is None else rates.tolist()
    for number, (t_us, own, rate, reset) in enumerate(zip(series.t_us.tolist(), body, rows, resets, strict=True), start=1):
        known = None if any(map(math.isnan, rate)) else tuple(rate)
        yield LogEntry(f": attitude {number}", checked_sample(t_us * 1000, tuple(own), known, discontinuity=reset))


def _conventions(topic: _ULogTopic, series: _Series, turning: _Turning, has_rates: bool) -> Conventions:
    q_icrs_to_ned = turning.q_icrs_to_ned(series.t_us[:1], slice(1))[0]
    begin_s = int(series.t_us[0]) / 1e6
    words = "turns components of the body (front, right, down) into north, east, down"
    gyro = "; the gyroscopes' rate, with respect to the stars" if has_rates else ""
    return Conventions(
        f"PX4 ULog, {topic.name}:{topic.instance}",
        f"q {words} {turning.place_words}, {earth.TURNED}{gyro}",
        "scalar first (w, x, y, z), Hamilton, single precision (0.02 arcsec)",
        f"microseconds since boot, which was at UTC {turning.utc_words}",
        of_body=True,
        written=lambda q: f"q = {components(multiply(q_icrs_to_ned, conjugate(q)))} at {begin_s:.6f} s",
    )
