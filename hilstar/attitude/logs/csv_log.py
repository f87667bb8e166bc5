"""CSV logs: `t_s,qw,qx,qy,qz` and, where known, `rx,ry,rz` (rad/s), `sequence` and `discontinuity`, in any order."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from typing import IO

from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, Entry
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.units import NS_PER_S

CSV_COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
RATE_COLUMNS = ("rx", "ry", "rz")
# A JSON number that msgspec takes as an integer: what one format can hold, all can.
WHOLE_NUMBERS = range(-(2**63), 2**64)


def read_csv(lines: Iterable[str]) -> Iterator[Entry]:
    """The entries of a CSV log's lines."""
    reader = csv.reader(lines)
    rows = (row for row in reader if row and not row[0].startswith("#"))
    header = [name.strip() for name in next(rows, [])]
    if not header:
        return
    needed = CSV_COLUMNS + (RATE_COLUMNS if any(name in header for name in RATE_COLUMNS) else ())
    missing = [name for name in needed if name not in header]
    if missing:
        detail = f"column {missing[0]} is missing; the header must have {','.join(needed)}"
        yield Entry(f":{reader.line_num}", Refusal("format", detail))
        return
    places = {name: header.index(name) for name in (*needed, "sequence", "discontinuity") if name in header}
    for row in rows:
        yield Entry(f":{reader.line_num}", _sample(row, places))


def _sample(row: list[str], places: dict[str, int]) -> AttitudeSample | Refusal:
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
        wanted = f"write finite numbers for {','.join(CSV_COLUMNS)}"
        if len(places) > len(CSV_COLUMNS):
            wanted += ", all of rx,ry,rz or none, a whole number as sequence, 0 or 1 as discontinuity"
        return Refusal("format", f"{','.join(row)[:MAX_QUOTED_CHARACTERS]!r}; {wanted}")
    return checked_sample(t_ns, q, rate, sequence, discontinuity)


def _t_ns(seconds: str) -> int:
    """Decimal seconds as nanoseconds, to the nearest; a float of today's Unix time would be off by 100 ns."""
    value = Decimal(seconds)
    if not value.is_finite() or value.adjusted() > 40:
        raise ValueError
    return int(value.scaleb(9).to_integral_value())


def write_csv(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    """Write samples with every column; a rate that is not known is an empty cell. Raises OSError."""
    file.write((",".join((*CSV_COLUMNS, *RATE_COLUMNS, "sequence", "discontinuity")) + "\n").encode())
    for sample in samples:
        rate = sample.rate_cam_rad_s
        numbers = [*map(repr, sample.q_icrs_to_cam.tolist()), *(("", "", "") if rate is None else map(repr, rate.tolist()))]
        row = (_seconds(sample.t_ns), *numbers, str(sample.sequence), "1" if sample.discontinuity else "0")
        file.write((",".join(row) + "\n").encode())


def _seconds(t_ns: int) -> str:
    seconds, ns = divmod(abs(t_ns), NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{ns:09}"
