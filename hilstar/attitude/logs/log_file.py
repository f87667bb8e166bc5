"""Attitude logs: read by what the file holds, written by what its name ends in.

CSV has the columns `t_s,qw,qx,qy,qz` and, where known, `rx,ry,rz` (rad/s), `sequence` and `discontinuity`; JSON lines are the
wire's JSON form, one object a line; CCSDS AEM is in `aem` and `aem_writer`, MCAP in `mcap_log`.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import IO

import msgspec

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.gaps import LogJoins, log_joins
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample, decode
from hilstar.errors import InputError
from hilstar.files import whole_file
from hilstar.reading import HEAD_BYTES, open_lines, open_regular, read_text
from hilstar.units import NS_PER_S

CSV_COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
RATE_COLUMNS = ("rx", "ry", "rz")
MCAP_MAGIC = b"\x89MCAP0\r\n"
# A JSON number that msgspec takes as an integer: what one form of log can hold, all can.
WHOLE_NUMBERS = range(-(2**63), 2**64)
MAX_TOPICS = 12  # that are named
LONGEST_QUOTE = 80
MAX_LOG_BYTES = 500_000_000
MAX_SAMPLES = 6_000_000  # 16 hours at 100 Hz; all are held, at 350 bytes each, so in 2 GB
MAX_AEM_BYTES = 50_000_000
READABLE = "hilstar reads CSV, JSON lines, CCSDS AEM (KVN or XML) and MCAP"

Entry = tuple[str, AttitudeSample | Refusal]


def read_log(path: Path) -> list[AttitudeSample]:
    """The samples of a CSV, JSON lines, CCSDS AEM (KVN or XML) or MCAP file, in order of time; the file's name is no matter.

    Raises InputError with the line (AEM in XML: the epoch) for anything that is not an attitude: nothing is skipped.
    """
    samples: list[AttitudeSample] = []
    try:
        with _open_log(path) as (entries, advice):
            for where, entry in entries:
                if isinstance(entry, Refusal):
                    raise InputError(f"{path}{where}: {entry.detail}")
                if samples and entry.t_ns <= samples[-1].t_ns:
                    times = f"t_ns {entry.t_ns} after {samples[-1].t_ns}"
                    raise InputError(f"{path}{where}: time does not rise ({times}); {advice}")
                samples.append(entry)
                if len(samples) > MAX_SAMPLES:
                    raise InputError(f"{path}{where}: more than {MAX_SAMPLES} attitudes; write them into several logs")
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error
    if not samples:
        _refuse_other_topics(path)
        raise InputError(f"{path}: holds no attitude; write a CSV with the header {','.join(CSV_COLUMNS)}, or JSON lines")
    return samples


def _refuse_other_topics(path: Path) -> None:
    """An MCAP file of another program says what it holds instead."""
    from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC
    from hilstar.attitude.logs.mcap_reader import is_mcap, topics_of

    topics = topics_of(path) if is_mcap(path) else []
    if topics and ATTITUDE_TOPIC not in topics:
        names = ", ".join(topic[:LONGEST_QUOTE] for topic in topics[:MAX_TOPICS]) + (
            ", ..." if len(topics) > MAX_TOPICS else ""
        )
        raise InputError(f"{path}: holds no attitude; its topics are {names}, and {ATTITUDE_TOPIC} is read")


def write_log(path: Path, samples: Sequence[AttitudeSample]) -> None:
    """Write samples, whose times rise, in the form that the name ends in; an old file is replaced by a whole one or not at all.

    CSV, JSON lines and MCAP give every bit back. An AEM leaves out sequence numbers, and rates that not every sample of a
    block has. Raises InputError for another ending, for no samples, and when the file cannot be written.
    """
    write = _WRITERS.get(path.suffix.lower())
    if write is None:
        raise InputError(f"{path}: a log's name ends in one of {', '.join(_WRITERS)}")
    if not samples:
        raise InputError(f"{path}: no attitude to write")
    with whole_file(path) as part, part.open("wb") as file:
        write(file, samples)


def log_timeline(samples: list[AttitudeSample], policy: Policy, joins: LogJoins | None = None) -> Timeline:
    """A timeline that holds every sample of a log, joined as the log's own samples say (see `gaps`), whoever asks."""
    timeline = Timeline(policy, capacity=len(samples), joins=log_joins(samples) if joins is None else joins)
    for sample in samples:
        timeline.add(sample)
    return timeline


# Reading


@contextlib.contextmanager
def _open_log(path: Path) -> Iterator[tuple[Iterable[Entry], str]]:
    """The entries of a file, and what to do when their times do not rise."""
    with open_regular(path, READABLE) as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(MCAP_MAGIC):
        yield _mcap_entries(path), "the sender restarted here, and a log is one stream"
        return
    with open_lines(path, READABLE, MAX_LOG_BYTES) as lines:
        word = _first_word(lines)
    if word.startswith("<") or word.startswith("CCSDS_AEM_VERS"):
        text = read_text(path, "write a shorter AEM, or CSV or JSON lines", MAX_AEM_BYTES)
        advice = "sort its lines, and let blocks not overlap; leap seconds are not counted, so write TAI across one"
        yield _aem_entries(path, text), advice
        return
    if word.startswith("CCSDS_"):
        raise InputError(f"{path}: starts with {word[:LONGEST_QUOTE]}; of the CCSDS messages, CCSDS_AEM_VERS is read")
    with open_lines(path, READABLE, MAX_LOG_BYTES) as lines:
        yield (_json_entries if word.startswith("{") else _csv_entries)(lines), "sort the log by time"


def _first_word(lines: Iterable[str]) -> str:
    """The first word of the first line that is no comment; in an AEM, a JSON object and XML it says which it is."""
    for line in lines:
        words = line.split(maxsplit=1)
        if words and words[0] != "COMMENT" and not words[0].startswith("#"):
            return words[0]
    return ""


def _mcap_entries(path: Path) -> Iterator[Entry]:
    from hilstar.attitude.logs.mcap_log import read_attitudes

    return ((f", attitude {number}", sample) for number, sample in enumerate(read_attitudes(path), start=1))


def _aem_entries(path: Path, text: str) -> list[Entry]:
    from hilstar.attitude.logs.aem import read_aem
    from hilstar.attitude.logs.aem_keywords import AemFaultError

    try:
        return read_aem(text)
    except AemFaultError as fault:
        raise InputError(f"{path}{fault.where}: {fault}") from fault


def _json_entries(lines: Iterable[str]) -> Iterator[Entry]:
    for number, line in enumerate(lines, start=1):
        if line.strip():
            event = decode(line.strip().encode())
            if not isinstance(event, AttitudeSample | Refusal):
                event = Refusal("format", 'is not an attitude; {"t_ns":..., "q":[w,x,y,z], "rate":[x,y,z]} is wanted')
            yield f":{number}", event


def _csv_entries(lines: Iterable[str]) -> Iterator[Entry]:
    reader = csv.reader(lines)
    rows = (row for row in reader if row and not row[0].startswith("#"))
    header = [name.strip() for name in next(rows, [])]
    if not header:
        return
    needed = CSV_COLUMNS + (RATE_COLUMNS if any(name in header for name in RATE_COLUMNS) else ())
    missing = [name for name in needed if name not in header]
    if missing:
        detail = f"column {missing[0]} is missing; the header must have {','.join(needed)}"
        yield f":{reader.line_num}", Refusal("format", detail)
        return
    places = {name: header.index(name) for name in (*needed, "sequence", "discontinuity") if name in header}
    for row in rows:
        yield f":{reader.line_num}", _csv_sample(row, places)


def _csv_sample(row: list[str], places: dict[str, int]) -> AttitudeSample | Refusal:
    try:
        cells = {name: row[place].strip() for name, place in places.items()}
        t_ns = _t_ns(cells["t_s"])
        q = tuple(float(cells[name]) for name in CSV_COLUMNS[1:])
        turning = [cells.get(name, "") for name in RATE_COLUMNS]
        rate = tuple(map(float, turning)) if any(turning) else None
        sequence = int(cells.get("sequence") or 0)
        discontinuity = {"": False, "0": False, "1": True}[cells.get("discontinuity", "")]
        if sequence not in WHOLE_NUMBERS:
            raise ValueError
    except (ValueError, LookupError, ArithmeticError):
        wanted = f"finite numbers {','.join(CSV_COLUMNS)} are wanted"
        if len(places) > len(CSV_COLUMNS):
            wanted += ", all of rx,ry,rz or none, a whole number as sequence, 0 or 1 as discontinuity"
        return Refusal("format", f"{','.join(row)[:LONGEST_QUOTE]!r}; {wanted}")
    return checked_sample(t_ns, q, rate, sequence, discontinuity)


def _t_ns(seconds: str) -> int:
    """Decimal seconds as nanoseconds, to the nearest; a float of today's Unix time would be off by 100 ns."""
    value = Decimal(seconds)
    if not value.is_finite() or value.adjusted() > 40:
        raise ValueError
    return int(value.scaleb(9).to_integral_value())


# Writing


def _write_csv(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    file.write((",".join((*CSV_COLUMNS, *RATE_COLUMNS, "sequence", "discontinuity")) + "\n").encode())
    for sample in samples:
        rate = sample.rate_cam_rad_s
        numbers = [*map(repr, sample.q_icrs_to_cam.tolist()), *(("", "", "") if rate is None else map(repr, rate.tolist()))]
        row = (_seconds(sample.t_ns), *numbers, str(sample.sequence), "1" if sample.discontinuity else "0")
        file.write((",".join(row) + "\n").encode())


def _seconds(t_ns: int) -> str:
    seconds, ns = divmod(abs(t_ns), NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{ns:09}"


def _write_json_lines(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    encoder = msgspec.json.Encoder()
    for sample in samples:
        form: dict[str, object] = {"t_ns": sample.t_ns, "q": sample.q_icrs_to_cam.tolist()}
        if sample.rate_cam_rad_s is not None:
            form["rate"] = sample.rate_cam_rad_s.tolist()
        form |= {"sequence": sample.sequence, "discontinuity": sample.discontinuity}
        file.write(encoder.encode(form) + b"\n")


def _write_kvn(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    from hilstar.attitude.logs.aem_writer import aem_text

    file.write(aem_text(samples, xml=False).encode())


def _write_xml(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    from hilstar.attitude.logs.aem_writer import aem_text

    file.write(aem_text(samples, xml=True).encode())


def _write_mcap(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    from hilstar.attitude.logs.mcap_log import write_attitudes

    write_attitudes(file, samples)


_WRITERS: dict[str, Callable[[IO[bytes], Sequence[AttitudeSample]], None]] = {
    ".csv": _write_csv,
    ".jsonl": _write_json_lines,
    ".json": _write_json_lines,
    ".aem": _write_kvn,
    ".kvn": _write_kvn,
    ".xml": _write_xml,
    ".mcap": _write_mcap,
}
