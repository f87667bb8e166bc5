"""Attitude logs of every format: the content decides how a file is read, the ending of its name how it is written.

JSON lines are read and written here: a line is the wire's JSON form of an attitude. The other
formats have a module each.

What a user states of a log is used or refused:
1. Each format of FORMATS declares the statements that its reader uses. Any other is refused by
   name, before the file is read.
2. A statement that a format uses, but not for this file, is refused by the reader
   (`stated_reference` for a place) or, for a mounting where the attitudes are the camera's own, by
   `open_log`.
"""

import contextlib
import importlib.util
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple

import msgspec
from msgspec import structs

from hilstar.attitude.clock.rate_causes import ReadAs
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.aem_blocks import AemFaultError, epoch_ns, epoch_text
from hilstar.attitude.logs.csv_log import CSV_COLUMNS, CsvLog, invalid_notice, write_csv_log
from hilstar.attitude.logs.entries import (
    MAX_QUOTED_CHARACTERS,
    MAX_SAMPLES,
    OPTIONS,
    SORT_ADVICE,
    AttitudeLog,
    LogEntry,
    LogJoins,
    LogReading,
    Stated,
    log_joins,
)
from hilstar.attitude.logs.log_times import time_notices
from hilstar.attitude.wire.packet import JSON_FORM, AttitudeSample, Event, Refusal, decode
from hilstar.attitude.wire.source import HILSTARS, PACKETS, Convention, Conventions, components, packet_conventions
from hilstar.errors import InputError, MachineError
from hilstar.files import whole_file
from hilstar.reading import (
    CK_MAGIC,
    HEAD_BYTES,
    MCAP_MAGIC,
    ROSBAG_MAGIC,
    SQLITE_MAGIC,
    ULOG_MAGIC,
    open_lines,
    open_regular,
    read_text,
)
from hilstar.rotation import conjugate, multiply
from hilstar.text_tables import open_table
from hilstar.units import NS_PER_S

if TYPE_CHECKING:
    from hilstar.arrays import FloatArray
    from hilstar.attitude.logs.earth import Reference

MAX_NAMED_TOPICS = 12
MAX_LOG_BYTES = 500_000_000
MAX_AEM_BYTES = 50_000_000
NOTHING_STATED = Stated()
JSON_KEYS = ('"t_ns"', '"q"', '"rate"', '"sequence"', '"discontinuity"')
VALID_KEY = '"valid"'
ENDINGS = (".csv", ".jsonl", ".json", ".mcap", ".aem", ".kvn", ".xml")
READABLE = "hilstar reads CSV, JSON lines, CCSDS AEM (KVN or XML), MCAP, SPICE CKs, bags of ROS and ULogs of PX4"
YEAR_NS = 31_557_600 * NS_PER_S
SECONDS_FORM = "write seconds after its first sample"
TIME_FORM = f"{SECONDS_FORM}, or a date and time such as 2026-11-21T06:00:00"


def _read_json_lines(lines: Iterable[str], told: list[tuple[str, str]]) -> Iterator[LogEntry]:
    """The attitudes of JSON lines; at their end `told` gets a notice of those that say `"valid":
    false`.
    """
    invalid = 0
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text:
            continue
        event: Event = _json_fault(text) or decode(text.encode())
        if not isinstance(event, AttitudeSample | Refusal):
            event = Refusal("format", f"is not an attitude; write {JSON_FORM}")
        if VALID_KEY in text and _says_invalid(text):
            invalid += 1
            continue
        yield LogEntry(f":{number}", event)
    if invalid:
        told.append(invalid_notice(invalid, "line"))


def _json_fault(text: str) -> Refusal | None:
    """What msgspec would not say of a line: an object over several lines, a key twice (it takes the
    last).
    """
    if text in ("{", "["):
        return Refusal("format", "a JSON object over several lines; write each on one line (jq -c . FILE)")
    for key in JSON_KEYS:
        if text.count(key) > 1:
            return Refusal("format", f"key {key} is there twice; write each once")
    return None


def _says_invalid(text: str) -> bool:
    try:
        return msgspec.json.decode(text, type=dict[str, object]).get("valid") in (False, 0)
    except msgspec.MsgspecError:
        return False  # refused by `decode`


def _write_json_lines(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    encoder = msgspec.json.Encoder()
    for sample in samples:
        form: dict[str, object] = {"t_ns": sample.t_ns, "q": sample.q_icrs_to_cam.tolist()}
        if sample.rate_cam_rad_s is not None:
            form["rate"] = sample.rate_cam_rad_s.tolist()
        form |= {"sequence": sample.sequence, "discontinuity": sample.discontinuity}
        file.write(encoder.encode(form) + b"\n")


def read_log(path: Path) -> list[AttitudeSample]:
    """The attitudes of a log that needs nothing stated, in order of time. Raises as `open_log` does."""
    return open_log(path).samples


def open_log(path: Path, stated: Stated = NOTHING_STATED) -> AttitudeLog:
    """The attitudes of a log in order of time, whatever its name, with what the file means by its numbers.

    Raises InputError with the line (AEM in XML: the epoch) for anything that is not an attitude: nothing is skipped unless
    the notices say so. Raises MachineError where the format's library is not installed.
    """
    samples: list[AttitudeSample] = []
    try:
        with _open_log(path, stated) as reading:
            conventions, mounting = reading.conventions, stated.mounting
            if mounting.by_option and not conventions.of_body:
                own = f"{path}: --mounting: its attitudes are the camera's own ({conventions.source})"
                raise InputError(f"{own}; leave it out")
            for where, event in reading.entries:
                if isinstance(event, Refusal):
                    raise InputError(f"{path}{where}: {event.detail}")
                if samples and event.t_ns <= samples[-1].t_ns:
                    raise InputError(f"{path}{where}: {_order_fault(event.t_ns, samples[-1].t_ns, reading.advice)}")
                samples.append(mounting.sample(event) if conventions.of_body else event)
                if len(samples) > MAX_SAMPLES:
                    raise InputError(f"{path}{where}: more than {MAX_SAMPLES} attitudes; split the log into several")
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error
    if not samples:
        _refuse_other_topics(path)
        raise InputError(f"{path}: contains no attitude; write a CSV with the header {','.join(CSV_COLUMNS)}, or JSON lines")
    told = [*reading.told, *conventions.mounting_notices(mounting)]
    if conventions.of_packets:  # other formats say themselves what their times are
        told += time_notices(samples, conventions.time_unit)
    read_as = ReadAs.of(conventions, stated.convention or HILSTARS, mounting, stated.convention_by)
    return AttitudeLog(samples, conventions, told, read_as)


def _order_fault(t_ns: int, before_ns: int, advice: str) -> str:
    if t_ns == before_ns and advice == SORT_ADVICE:
        return f"time does not increase (t_ns {t_ns} after {before_ns}): two attitudes have one time; write more of its digits"
    return f"time does not increase (t_ns {t_ns} after {before_ns}); {advice}"


def _refuse_other_topics(path: Path) -> None:
    """Name the topics of an MCAP file from another program."""
    from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC, is_mcap, topics_of

    topics = topics_of(path) if is_mcap(path) else []
    if topics and ATTITUDE_TOPIC not in topics:
        named = [topic[:MAX_QUOTED_CHARACTERS] for topic in topics[:MAX_NAMED_TOPICS]]
        names = ", ".join([*named, *(["..."] if len(topics) > MAX_NAMED_TOPICS else [])])
        raise InputError(f"{path}: contains no attitude; its topics are {names}, and only {ATTITUDE_TOPIC} is read")


def write_log(path: Path, samples: Sequence[AttitudeSample], scale: str | None = None) -> None:
    """Write samples, whose times increase, in the format of the name's ending; an old file is replaced whole or not at all.

    CSV, JSON lines and MCAP keep every bit. An AEM states `scale`, and drops sequence numbers, and the rates of a block
    where any is missing.
    Raises InputError for another ending, for no samples, and when the file cannot be written.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"{path}: not a log's name; end it in one of {', '.join(ENDINGS)}")
    if not samples:
        raise InputError(f"{path}: no attitude to write")
    with whole_file(path) as file:
        if ending == ".csv":
            write_csv_log(file, samples)
        elif ending in {".jsonl", ".json"}:
            _write_json_lines(file, samples)
        elif ending == ".mcap":
            from hilstar.attitude.logs.mcap_log import write_attitudes

            write_attitudes(file, samples)
        else:
            from hilstar.attitude.logs.aem import aem_text

            file.write(aem_text(samples, ending == ".xml", scale).encode())


def log_timeline(samples: list[AttitudeSample], policy: Policy, joins: LogJoins | None = None) -> Timeline:
    """A timeline of every sample of a log, joined as the log's own samples require (see `entries`)."""
    policy = replace(policy, prediction="rate")  # nothing is predicted of a log
    timeline = Timeline(policy, capacity=len(samples), joins=log_joins(samples) if joins is None else joins)
    for sample in samples:
        timeline.add(sample)
    return timeline


class LogHead(NamedTuple):
    """The beginning of a log: its first bytes, none of a directory."""

    path: Path
    head: bytes

    @property
    def word(self) -> str:
        """The first word of a text's first line that is no comment; "" where there is none."""
        with open_lines(self.path, READABLE, MAX_LOG_BYTES) as lines:
            firsts = (line.split(maxsplit=1)[0] for line in lines if line.strip())
            return next((first for first in firsts if first != "COMMENT" and not first.startswith("#")), "")


Opened = contextlib.AbstractContextManager[LogReading]


class LogFormat(NamedTuple):
    """A format: its name in a message, the statements (fields of `Stated`) that its reader uses,
    how it is told and opened.
    """

    name: str
    uses: frozenset[str]
    begins: Callable[[LogHead], bool]
    open: Callable[[Path, Stated], Opened]


def check_stated(path: Path, stated: Stated) -> LogFormat:
    """The format of a log. Raises InputError for a statement that the format does not use, and for
    a file that is no log.
    """
    head = b""
    if not path.is_dir():
        with open_regular(path, READABLE) as file:
            head = file.read(HEAD_BYTES)
    beginning = LogHead(path, head)
    log_format = next(each for each in FORMATS if each.begins(beginning))
    for name, written in stated:
        if name in log_format.uses or (log_format.name == LEDGER and written != OPTIONS[name]):
            continue  # what a run's bench file says of its packets, its ledger has already done
        reason = " has a convention of its own" if name == "convention" else " does not use it"
        raise InputError(f"{path}: {written}: {log_format.name}{reason}; leave it out")
    return log_format


@contextlib.contextmanager
def _open_log(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of a file, by what it holds. A format's reader, and its library, are imported
    where a log needs them.
    """
    with check_stated(path, stated).open(path, stated) as reading:
        yield reading


def _of_packets(path: Path, entries: Iterator[LogEntry], source: str, stated: Stated, advice: str = SORT_ADVICE) -> LogReading:
    """The reading of entries that have the numbers of a packet, as they were sent: their
    convention, then their reference.

    Rates are with respect to the reference, in the frame's own components.
    """
    convention = HILSTARS if stated.convention is None else stated.convention
    by = [] if stated.convention is None else [stated.convention_by]
    if stated.mounting.by_option:  # which says that the attitudes are the body's
        convention, by = structs.replace(convention, frame="body"), [*by, OPTIONS["mounting"]]
    notices: list[tuple[str, str]] = []
    if convention != HILSTARS:
        notices.append(("log-convention", f"read with convention = {convention} ({', '.join(by)})"))
    if not convention.is_hilstars:
        entries = _by_convention(entries, convention)
    conventions = packet_conventions(convention, source)
    if stated.reference is None and stated.place is None and stated.epoch_utc is None:
        return LogReading(entries, conventions, advice, notices)
    from hilstar.attitude.logs.earth import reference_kind, stated_reference, to_icrs  # 30 ms

    kind = reference_kind(path, stated, notices)
    first = next(entries, None)
    sample = None if first is None else first.event
    if first is None or not isinstance(sample, AttitudeSample):  # which is refused when it is read
        return LogReading([] if first is None else [first], conventions, advice, notices)
    reference = stated_reference(path, kind, stated, sample.t_ns)
    turned = to_icrs(itertools.chain([first], entries), reference, False, notices)
    return LogReading(turned, _referred(conventions, convention, reference, sample.t_ns), advice, notices)


def _by_convention(entries: Iterable[LogEntry], convention: Convention) -> Iterator[LogEntry]:
    for entry in entries:
        event = entry.event
        yield LogEntry(entry.where, convention.sample(event)) if isinstance(event, AttitudeSample) else entry


def _referred(conventions: Conventions, convention: Convention, reference: "Reference", first_ns: int) -> Conventions:
    """The conventions of a log whose attitudes refer to a reference; the self-check is for its
    first time.
    """
    if reference.kind == "icrs":
        return conventions

    def written(q_icrs_to_frame: "FloatArray") -> str:
        q = multiply(q_icrs_to_frame, conjugate(reference.q_icrs_to_reference([first_ns])[0]))
        return f"q = {components(convention.as_sent(q))} at {first_ns / NS_PER_S:.9f} s"

    turns = packet_conventions(convention, reference="reference").turns
    return replace(conventions, turns=f"{turns}; the reference is {reference.words}", written=written)


@contextlib.contextmanager
def _open_ros(path: Path, stated: Stated) -> Iterator[LogReading]:
    _require("rosbags", "ros", f"{path}: a ROS bag")
    from hilstar.attitude.logs.ros import read_ros
    from hilstar.attitude.logs.ros_bags import open_bag

    with open_bag(path) as bag:
        yield read_ros(bag, stated)


@contextlib.contextmanager
def _open_ulog(path: Path, stated: Stated) -> Iterator[LogReading]:
    _require("pyulog", "px4", f"{path}: a ULog of PX4")
    from hilstar.attitude.logs.px4 import read_ulog

    yield read_ulog(path, stated)


@contextlib.contextmanager
def _open_ck(path: Path, stated: Stated) -> Iterator[LogReading]:
    _require("spiceypy", "spice", f"{path}: a SPICE CK")
    from hilstar.attitude.logs.ck import read_ck

    yield read_ck(path, stated)


@contextlib.contextmanager
def _open_ledger(path: Path, stated: Stated) -> Iterator[LogReading]:
    """A run's attitudes as it showed them: its convention and its mounting are in them already."""
    yield LogReading(_mcap_entries(path), replace(PACKETS, source="MCAP", of_packets=False), RESTARTED)


@contextlib.contextmanager
def _open_mcap(path: Path, stated: Stated) -> Iterator[LogReading]:
    yield _of_packets(path, _mcap_entries(path), "MCAP", stated, RESTARTED)


def _mcap_entries(path: Path) -> Iterator[LogEntry]:
    from hilstar.attitude.logs.mcap_log import read_attitudes

    for number, sample in enumerate(read_attitudes(path), start=1):
        yield LogEntry(f", attitude {number}", sample)


@contextlib.contextmanager
def _open_aem(path: Path, stated: Stated) -> Iterator[LogReading]:
    from hilstar.attitude.logs.aem import read_aem
    from hilstar.attitude.logs.earth import q_icrs_to_date

    text = read_text(path, "write a shorter AEM, or CSV or JSON lines", MAX_AEM_BYTES)
    try:
        reading = read_aem(text, q_icrs_to_date)
    except AemFaultError as fault:
        raise InputError(f"{path}{fault.where}: {fault}") from fault
    yield reading


@contextlib.contextmanager
def _open_other_ccsds(path: Path, stated: Stated) -> Iterator[LogReading]:
    word = LogHead(path, b"").word[:MAX_QUOTED_CHARACTERS]
    raise InputError(f"{path}: starts with {word}; of the CCSDS messages, only CCSDS_AEM_VERS is read")
    yield


@contextlib.contextmanager
def _open_json_lines(path: Path, stated: Stated) -> Iterator[LogReading]:
    with open_lines(path, READABLE, MAX_LOG_BYTES) as lines:
        told: list[tuple[str, str]] = []
        reading = _of_packets(path, _read_json_lines(lines, told), "JSON lines", stated)
        yield reading
        reading.told.extend(told)


@contextlib.contextmanager
def _open_csv(path: Path, stated: Stated) -> Iterator[LogReading]:
    scalar = (stated.convention or HILSTARS).scalar
    with open_table(path, READABLE, MAX_LOG_BYTES) as table:
        csv_log = CsvLog(table, scalar)
        reading = _of_packets(path, itertools.starmap(LogEntry, csv_log.entries()), "CSV", stated)
        reading.told.extend(csv_log.told)
        csv_log.told = reading.told
        yield replace(reading, conventions=replace(reading.conventions, time_unit=csv_log.time_unit))


def _is_bag(beginning: LogHead) -> bool:
    if beginning.head.startswith(MCAP_MAGIC):
        from hilstar.attitude.logs.mcap_log import holds_ros

        return holds_ros(beginning.path)
    if beginning.path.is_dir():
        from hilstar.attitude.logs.ros_bags import is_bag_directory

        return is_bag_directory(beginning.path)
    return beginning.head.startswith((ROSBAG_MAGIC, SQLITE_MAGIC))


def _is_ledger(beginning: LogHead) -> bool:
    from hilstar.attitude.logs.mcap_log import begins_as_ledger

    return beginning.head.startswith(MCAP_MAGIC) and begins_as_ledger(beginning.path)


LEDGER = "the ledger of a run"
RESTARTED = "the sender restarted here; give a log of one run"
LEVEL = frozenset({"reference", "place", "epoch_utc"})
LIKE_PACKETS = LEVEL | {"mounting", "convention"}
# The first that a file begins like is its format; what is none of the others is read as CSV.
FORMATS = (
    LogFormat("a ROS bag", LEVEL | {"mounting", "topic", "body"}, _is_bag, _open_ros),
    LogFormat("a ULog of PX4", LEVEL | {"mounting", "topic"}, lambda log: log.head.startswith(ULOG_MAGIC), _open_ulog),
    LogFormat("a SPICE CK", frozenset({"mounting", "kernels", "body"}), lambda log: log.head.startswith(CK_MAGIC), _open_ck),
    LogFormat(LEDGER, frozenset(), _is_ledger, _open_ledger),
    LogFormat("MCAP", LIKE_PACKETS, lambda log: log.head.startswith(MCAP_MAGIC), _open_mcap),
    LogFormat(
        "a CCSDS AEM",
        frozenset({"mounting"}),
        lambda log: log.word.startswith(("<", "CCSDS_AEM_VERS")),
        _open_aem,
    ),
    LogFormat("a CCSDS message", frozenset(), lambda log: log.word.startswith("CCSDS_"), _open_other_ccsds),
    LogFormat("JSON lines", LIKE_PACKETS, lambda log: log.word.startswith("{"), _open_json_lines),
    LogFormat("CSV", LIKE_PACKETS, lambda log: True, _open_csv),
)


def _require(library: str, extra: str, what: str) -> None:
    if importlib.util.find_spec(library) is None:
        raise MachineError(f"{what}; reading it needs {library}: pip install 'hilstar[{extra}]'")


def time_in_log(path: Path, samples: Sequence[AttitudeSample], text: str | None) -> int:
    """The `t_ns` that `text` names, within the span of the log; its first sample's for None.

    A date and time is read on the log's own scale, from 1970-01-01T00:00:00. Raises InputError outside the span.
    """
    first_ns, last_ns = samples[0].t_ns, samples[-1].t_ns
    if text is None:
        return first_ns
    try:
        seconds = float(text)
        if not abs(seconds) <= 1e12:
            raise InputError(f"--at {text}: {TIME_FORM}")
        t_ns = first_ns + round(seconds * NS_PER_S)
    except ValueError:
        try:
            t_ns = epoch_ns("", text)
        except AemFaultError as fault:
            raise InputError(f"--at {text}: {fault}") from fault
    if not first_ns <= t_ns <= last_ns:
        span = f"{(last_ns - first_ns) / NS_PER_S:.9g} s long"
        if first_ns < YEAR_NS:
            raise InputError(f"--at {text}: {path} is {span}, and its times are no dates; {SECONDS_FORM}")
        span += f", from {epoch_text(first_ns)} to {epoch_text(last_ns)} on its own scale"
        raise InputError(f"--at {text}: {path} is {span}; {TIME_FORM}")
    return t_ns
