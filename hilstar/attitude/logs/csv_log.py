"""CSV logs of attitudes: the columns `t_s,qw,qx,qy,qz` in any order and, where known, `rx,ry,rz`
(rad/s), `sequence` and `discontinuity`.
"""

import contextlib
import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Literal

from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import MAX_LOG_BYTES, LogFormat, Writing, readable
from hilstar.attitude.logs.log_times import ns_of_seconds
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.attitude.wire.source import HILSTARS
from hilstar.errors import InputError
from hilstar.reading import open_lines
from hilstar.units import NS_PER_S

CSV_COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
RATE_COLUMNS = ("rx", "ry", "rz")
# A JSON number that msgspec takes as an integer: what one format can hold, all can.
WHOLE_NUMBERS = range(-(2**63), 2**64)


@contextlib.contextmanager
def read_csv_log(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of a CSV. Raises InputError."""
    scalar = (stated.convention or HILSTARS).scalar
    try:
        with open_lines(path, readable(), MAX_LOG_BYTES) as lines:
            reading = of_packets(path, _read_csv(lines, scalar), "CSV", stated)
            yield replace(reading, conventions=replace(reading.conventions, time_unit="s"))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error


def _read_csv(lines: Iterable[str], scalar: Literal["first", "last"]) -> Iterator[LogEntry]:
    """The attitudes of a CSV, each quaternion as it was sent: with the scalar last, its columns
    count as x, y, z, w in turn.
    """
    reader = csv.reader(lines)
    rows = (row for row in reader if row and not row[0].startswith("#"))
    header = [name.strip() for name in next(rows, [])]
    if not header:
        return
    needed = CSV_COLUMNS + (RATE_COLUMNS if any(name in header for name in RATE_COLUMNS) else ())
    missing = [name for name in needed if name not in header]
    if missing:
        detail = f"column {missing[0]} is missing; the header must have {','.join(needed)}"
        if missing[0] == "t_s" and "t_ns" in header:
            detail = f"column t_ns: a CSV has its times in seconds; divide by 1e9, and write {','.join(needed)}"
        yield LogEntry(f":{reader.line_num}", Refusal("format", detail))
        return
    places = {name: header.index(name) for name in (*needed, "sequence", "discontinuity") if name in header}
    numbers: tuple[str, ...] = CSV_COLUMNS[1:]
    if scalar == "last":  # whatever the columns are called: a table that says so by its names needs no statement
        numbers = tuple(sorted(numbers, key=lambda name: places[name]))
    wanted = f"write finite numbers for {','.join(CSV_COLUMNS)}"
    if len(places) > len(CSV_COLUMNS):
        wanted += ", all of rx,ry,rz or none, a whole number as sequence, 0 or 1 as discontinuity"
    for row in rows:
        try:
            cells = {name: row[place].strip() for name, place in places.items()}
            q = tuple(float(cells[name]) for name in numbers)
            turning = [cells.get(name, "") for name in RATE_COLUMNS]
            rate = tuple(map(float, turning)) if any(turning) else None
            sequence = int(cells.get("sequence") or 0)
            discontinuity = {"": False, "0": False, "1": True}[cells.get("discontinuity", "")]
            if sequence not in WHOLE_NUMBERS:
                raise ValueError
            event = checked_sample(ns_of_seconds(cells["t_s"]), q, rate, sequence, discontinuity)
        except (ValueError, LookupError, ArithmeticError):
            event = Refusal("format", f"{','.join(row)[:MAX_QUOTED_CHARACTERS]!r}; {wanted}")
        yield LogEntry(f":{reader.line_num}", event)


def _write_csv(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    file.write((",".join((*CSV_COLUMNS, *RATE_COLUMNS, "sequence", "discontinuity")) + "\n").encode())
    for sample in samples:
        rate = sample.rate_cam_rad_s
        numbers = [
            *map(repr, sample.q_icrs_to_cam.tolist()),
            *(("", "", "") if rate is None else map(repr, rate.tolist())),
        ]
        seconds, ns = divmod(abs(sample.t_ns), NS_PER_S)
        t_s = f"{'-' if sample.t_ns < 0 else ''}{seconds}.{ns:09}"
        file.write((",".join((t_s, *numbers, str(sample.sequence), "1" if sample.discontinuity else "0")) + "\n").encode())


# What no other format takes is read as CSV.
log_format = LogFormat(
    "CSV",
    read_csv_log,
    listed="CSV",
    uses=LIKE_PACKETS,
    endings=(".csv",),
    write=_write_csv,
)
