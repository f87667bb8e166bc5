"""Attitude logs of every format: read by what the file holds, written by the ending of its name."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.csv_log import CSV_COLUMNS, read_csv, write_csv
from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, MAX_SAMPLES, Entry, Log, LogReading, Stated
from hilstar.attitude.logs.gaps import LogJoins, log_joins
from hilstar.attitude.logs.json_log import read_json_lines, write_json_lines
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.source import PACKETS
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

MAX_NAMED_TOPICS = 12
MAX_LOG_BYTES = 500_000_000
MAX_AEM_BYTES = 50_000_000
NOTHING_STATED = Stated()
READABLE = "hilstar reads CSV, JSON lines, CCSDS AEM (KVN or XML), MCAP, SPICE CKs, bags of ROS and ULogs of PX4"


def read_log(path: Path) -> list[AttitudeSample]:
    """The attitudes of a log that needs nothing stated, in order of time. Raises as `open_log` does."""
    return open_log(path).samples


def open_log(path: Path, stated: Stated = NOTHING_STATED) -> Log:
    """The attitudes of a log in order of time, whatever its name, with what the file means by its numbers.

    Raises InputError with the line (AEM in XML: the epoch) for anything that is not an attitude: nothing is skipped unless
    the notices say so. Raises MachineError where the format's library is not installed.
    """
    samples: list[AttitudeSample] = []
    try:
        with _open_log(path, stated) as reading:
            mounted = stated.mounting.sample if reading.conventions.of_body else _as_it_is
            for where, event in reading.entries:
                if isinstance(event, Refusal):
                    raise InputError(f"{path}{where}: {event.detail}")
                if samples and event.t_ns <= samples[-1].t_ns:
                    times = f"t_ns {event.t_ns} after {samples[-1].t_ns}"
                    raise InputError(f"{path}{where}: time does not increase ({times}); {reading.advice}")
                samples.append(mounted(event))
                if len(samples) > MAX_SAMPLES:
                    raise InputError(f"{path}{where}: more than {MAX_SAMPLES} attitudes; split the log into several")
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error
    if not samples:
        _refuse_other_topics(path)
        raise InputError(f"{path}: contains no attitude; write a CSV with the header {','.join(CSV_COLUMNS)}, or JSON lines")
    mounting = stated.mounting.told if reading.conventions.of_body else []
    return Log(samples, reading.conventions, [*reading.told, *mounting])


def _as_it_is(sample: AttitudeSample) -> AttitudeSample:
    return sample


def _refuse_other_topics(path: Path) -> None:
    """Name the topics of an MCAP file from another program."""
    from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC
    from hilstar.attitude.logs.mcap_reader import is_mcap, topics_of

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
    if ending not in _WRITERS and ending not in _AEM_IN_XML:
        raise InputError(f"{path}: not a log's name; end it in one of {', '.join([*_WRITERS, *_AEM_IN_XML])}")
    if not samples:
        raise InputError(f"{path}: no attitude to write")
    with whole_file(path) as file:
        if ending in _AEM_IN_XML:
            _write_aem(file, samples, _AEM_IN_XML[ending], scale)
        else:
            _WRITERS[ending](file, samples)


def log_timeline(samples: list[AttitudeSample], policy: Policy, joins: LogJoins | None = None) -> Timeline:
    """A timeline of every sample of a log, joined as the log's own samples require (see `gaps`)."""
    policy = replace(policy, prediction="rate")  # nothing is predicted of a log
    timeline = Timeline(policy, capacity=len(samples), joins=log_joins(samples) if joins is None else joins)
    for sample in samples:
        timeline.add(sample)
    return timeline


@contextlib.contextmanager
def _open_log(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of a file, by what it holds."""
    if path.is_dir():
        head = b""
    else:
        with open_regular(path, READABLE) as file:
            head = file.read(HEAD_BYTES)
    if _is_bag(path, head):
        with _ros(path, stated) as reading:
            yield reading
        return
    if head.startswith(MCAP_MAGIC):
        yield _mcap(path)
        return
    if head.startswith(ULOG_MAGIC):
        yield _ulog(path, stated)
        return
    if head.startswith(CK_MAGIC):
        yield _ck(path, stated)
        return
    with open_lines(path, READABLE, MAX_LOG_BYTES) as lines:
        word = _first_word(lines)
    if word.startswith("<") or word.startswith("CCSDS_AEM_VERS"):
        yield _aem(path, read_text(path, "write a shorter AEM, or CSV or JSON lines", MAX_AEM_BYTES))
        return
    if word.startswith("CCSDS_"):
        raise InputError(
            f"{path}: starts with {word[:MAX_QUOTED_CHARACTERS]}; of the CCSDS messages, only CCSDS_AEM_VERS is read"
        )
    with open_lines(path, READABLE, MAX_LOG_BYTES) as lines:
        if word.startswith("{"):
            yield LogReading(read_json_lines(lines), replace(PACKETS, source="JSON lines"))
        else:
            yield LogReading(read_csv(lines), replace(PACKETS, source="CSV"))


def _first_word(lines: Iterable[str]) -> str:
    """The first word of the first line that is not a comment; it tells AEM, JSON and XML apart."""
    for line in lines:
        words = line.split(maxsplit=1)
        if words and words[0] != "COMMENT" and not words[0].startswith("#"):
            return words[0]
    return ""


# A format's reader, and its library, are imported where a log needs them.


def _is_bag(path: Path, head: bytes) -> bool:
    if head.startswith(MCAP_MAGIC):
        from hilstar.attitude.logs.mcap_reader import holds_ros

        return holds_ros(path)
    if path.is_dir():
        from hilstar.attitude.logs.ros.bag import is_bag_directory

        return is_bag_directory(path)
    return head.startswith((ROSBAG_MAGIC, SQLITE_MAGIC))


@contextlib.contextmanager
def _ros(path: Path, stated: Stated) -> Iterator[LogReading]:
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise MachineError(f"{path}: a ROS bag; reading it needs rosbags: pip install 'hilstar[ros]'") from error
    from hilstar.attitude.logs.ros.bag import open_bag
    from hilstar.attitude.logs.ros.reader import read_ros

    with open_bag(path) as bag:
        yield read_ros(bag, stated)


def _mcap(path: Path) -> LogReading:
    from hilstar.attitude.logs.mcap_log import read_attitudes

    entries = (Entry(f", attitude {number}", sample) for number, sample in enumerate(read_attitudes(path), start=1))
    return LogReading(entries, replace(PACKETS, source="MCAP"), "the sender restarted here; give a log of one run")


def _aem(path: Path, text: str) -> LogReading:
    from hilstar.attitude.logs.aem.blocks import AemFaultError
    from hilstar.attitude.logs.aem.reader import read_aem
    from hilstar.attitude.logs.of_date import q_icrs_to_date

    try:
        return read_aem(text, q_icrs_to_date)
    except AemFaultError as fault:
        raise InputError(f"{path}{fault.where}: {fault}") from fault


def _ulog(path: Path, stated: Stated) -> LogReading:
    try:
        import pyulog  # noqa: F401
    except ImportError as error:
        raise MachineError(f"{path}: a ULog of PX4; reading it needs pyulog: pip install 'hilstar[px4]'") from error
    from hilstar.attitude.logs.px4.reader import read_ulog

    return read_ulog(path, stated)


def _ck(path: Path, stated: Stated) -> LogReading:
    from hilstar.attitude.logs.ck.reader import read_ck

    return read_ck(path, stated)


def _write_aem(file: IO[bytes], samples: Sequence[AttitudeSample], xml: bool, scale: str | None) -> None:
    from hilstar.attitude.logs.aem.writer import aem_text

    file.write(aem_text(samples, xml, scale).encode())


def _write_mcap(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    from hilstar.attitude.logs.mcap_log import write_attitudes

    write_attitudes(file, samples)


_WRITERS: dict[str, Callable[[IO[bytes], Sequence[AttitudeSample]], None]] = {
    ".csv": write_csv,
    ".jsonl": write_json_lines,
    ".json": write_json_lines,
    ".mcap": _write_mcap,
}
_AEM_IN_XML = {".aem": False, ".kvn": False, ".xml": True}
