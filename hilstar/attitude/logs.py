"""Attitude logs: CSV (`t_s,qw,qx,qy,qz`) and JSON lines (the wire's JSON form, one object a line)."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from hilstar.attitude.packet import AttitudeSample, Refusal, checked_sample, decode
from hilstar.attitude.timeline import NS_PER_S, Policy, Timeline
from hilstar.errors import InputError

CSV_COLUMNS = ("t_s", "qw", "qx", "qy", "qz")


def read_log(path: Path) -> list[AttitudeSample]:
    """The samples of a log, in order of time.

    Raises InputError with the line number for anything that is not an attitude: nothing is skipped.
    """
    samples: list[AttitudeSample] = []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            first = file.read(1)
            file.seek(0)
            entries = _json_lines(file) if first == "{" else _csv_rows(file, path)
            for number, entry in entries:
                if isinstance(entry, Refusal):
                    raise InputError(f"{path}:{number}: {entry.detail}")
                if samples and entry.t_ns <= samples[-1].t_ns:
                    raise InputError(f"{path}:{number}: time does not rise from the line before; sort the log by time")
                samples.append(entry)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error
    if not samples:
        raise InputError(f"{path}: holds no attitude; write a CSV with the header {','.join(CSV_COLUMNS)}, or JSON lines")
    return samples


def log_timeline(samples: list[AttitudeSample], policy: Policy) -> Timeline:
    """A timeline that holds every sample of a log."""
    timeline = Timeline(policy, capacity=len(samples))
    for sample in samples:
        timeline.add(sample)
    return timeline


def _json_lines(lines: Iterator[str]) -> Iterator[tuple[int, AttitudeSample | Refusal]]:
    for number, line in enumerate(lines, start=1):
        if line.strip():
            yield number, decode(line.strip().encode())


def _csv_rows(lines: Iterator[str], path: Path) -> Iterator[tuple[int, AttitudeSample | Refusal]]:
    reader = csv.reader(lines)
    rows = (row for row in reader if row and not row[0].startswith("#"))
    header = [name.strip() for name in next(rows, [])]
    if not header:
        return
    missing = [name for name in CSV_COLUMNS if name not in header]
    if missing:
        raise InputError(f"{path}:1: column {missing[0]} is missing; the header must have {','.join(CSV_COLUMNS)}")
    places = [header.index(name) for name in CSV_COLUMNS]
    for row in rows:
        try:
            t_s, *q = (float(row[place]) for place in places)
            t_ns = round(t_s * NS_PER_S)
        except (ValueError, IndexError, OverflowError):
            wanted = f"finite numbers {','.join(CSV_COLUMNS)} are wanted"
            yield reader.line_num, Refusal("format", f"{','.join(row)!r}; {wanted}")
            continue
        yield reader.line_num, checked_sample(t_ns, tuple(q), None)
