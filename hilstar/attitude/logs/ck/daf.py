"""The summaries of a DAF (DAF Required Reading), read without SPICE, which would follow a damaged list of records for ever."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError, shortened
from hilstar.reading import open_regular

RECORD_BYTES, WORD_BYTES = 1024, 8
ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}
MAX_SUMMARIES = 100_000


@dataclass(frozen=True, slots=True)
class Summary:
    """One array of a DAF: the summary's doubles and integers, of which the last two are the first and last word (from 1)."""

    doubles: tuple[float, ...]
    integers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Daf:
    """A DAF whose list of summaries is whole, and whose arrays lie within the file."""

    path: Path
    order: str
    summaries: list[Summary]

    def words(self, summary: Summary) -> FloatArray:
        """The doubles (n,) of an array. Raises InputError where the file cannot be read."""
        first, last = summary.integers[-2:]
        with open_regular(self.path, "give a SPICE kernel") as file:
            file.seek((first - 1) * WORD_BYTES)
            raw = file.read((last - first + 1) * WORD_BYTES)
        if len(raw) != (last - first + 1) * WORD_BYTES:
            raise InputError(f"{self.path}: was cut while it was read; copy it whole")
        return np.frombuffer(raw, self.order + "f8").astype(np.float64)


def read_daf(path: Path, limit_bytes: int) -> Daf:
    """The summaries of a DAF, in the file's order. Raises InputError for a file that is not one, or is damaged."""
    with open_regular(path, "give a SPICE kernel", limit_bytes) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(RECORD_BYTES)
        order = ORDERS.get(head[88:96])
        if len(head) < RECORD_BYTES:
            raise InputError(f"{path}: has {len(head)} bytes, less than a DAF's first record; is it cut off?")
        if not head.startswith(b"DAF/") or order is None:
            format_text = head[88:96].decode("ascii", "replace").strip() or "missing"
            raise InputError(f"{path}: is no DAF in IEEE form (its form is {shortened(format_text)}); convert it by tobin")
        doubles, integers = struct.unpack(order + "2i", head[8:16])
        first, last = struct.unpack(order + "2i", head[76:84])
        words = doubles + (integers + 1) // 2
        if not (0 <= doubles <= 124 and 2 <= integers <= 250 and words <= 125):
            raise InputError(f"{path}: is a damaged DAF: its summaries have {doubles} doubles and {integers} integers")
        return Daf(path, order, _summaries(file, _Layout(path, order, doubles, integers, size), first, last))


@dataclass(frozen=True, slots=True)
class _Layout:
    path: Path
    order: str
    doubles: int
    integers: int
    size_bytes: int

    def fault(self, what: str) -> InputError:
        return InputError(f"{self.path}: is a damaged DAF: {what}; is it cut off?")


def _summaries(file: IO[bytes], layout: _Layout, first: int, last: int) -> list[Summary]:
    """The summaries of the list of records from `first` to `last`; each record names the next and the previous one."""
    found: list[Summary] = []
    seen: set[int] = set()
    record, previous = first, 0
    while record:
        if record in seen or not 1 < record <= layout.size_bytes // RECORD_BYTES:
            raise layout.fault(f"its list of summaries leads to record {record}")
        seen.add(record)
        file.seek((record - 1) * RECORD_BYTES)
        raw = file.read(RECORD_BYTES)
        following, before, count = struct.unpack(layout.order + "3d", raw[:24])
        words = layout.doubles + (layout.integers + 1) // 2
        if before != previous or not 0 <= count <= 125 // words or not (0 <= following < 2**31 and following.is_integer()):
            raise layout.fault(f"summary record {record} is not one of its list")
        found += [_summary(raw[(3 + k * words) * WORD_BYTES :], layout) for k in range(int(count))]
        if len(found) > MAX_SUMMARIES:
            raise InputError(f"{layout.path}: has more than {MAX_SUMMARIES} segments; split it into several")
        record, previous = int(following), record
    if previous != last:
        raise layout.fault(f"its list of summaries ends at record {previous}, not {last}")
    return found


def _summary(raw: bytes, layout: _Layout) -> Summary:
    doubles = struct.unpack_from(f"{layout.order}{layout.doubles}d", raw)
    integers = struct.unpack_from(f"{layout.order}{layout.integers}i", raw, layout.doubles * WORD_BYTES)
    begin, end = integers[-2:]
    if not RECORD_BYTES // WORD_BYTES < begin <= end <= layout.size_bytes // WORD_BYTES:
        raise layout.fault(f"an array has the words {begin} to {end} of {layout.size_bytes // WORD_BYTES}")
    return Summary(doubles, integers)
