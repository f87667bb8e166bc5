"""What a report reads of a ledger, in columns: decoded by this process, or where the ledger is large beside it."""

import os
from collections.abc import Callable, Iterator
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.mcap_log import parts_of, read_chunks, tell_no_end
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError, MachineError
from hilstar.process.pool import ProcessPool
from hilstar.run.record.ledger_records import (
    FrameRecord,
    PacketForm,
    RunMessage,
    RunRecord,
    decoded,
    messages_in,
    telling_faults,
)
from hilstar.units import NS_PER_MS

BLOCK = 4096  # records that are decoded and added at once
# Below it, processes take as long to start as they save. Two decode as fast as this one reads and adds.
POOL_BYTES, WORKERS = 50_000_000, 2
# Columns of frames; NaN is None. TIMES are in ms: before the swap (-1), or as they are.
TIMES = {"late": -1, "draw": -1, "age": 1, "prediction": 1, "packet": -1}
COUNTS, MARKS = ("missed_before", "stars_drawn", "clipped", "below_step"), ("stale", "capped", "operator", "hidden")
VALUES = (*TIMES, *COUNTS, *MARKS, "blank", "w", "x", "y", "z")
FIELDS = ("swap_ns", "t_ns", "predicted_swap_ns", "draw_ns", "age_ns", "prediction_ns", "receive_ns", *COUNTS, *MARKS, "q")
ACCEPTED, REFUSED = range(2)
FRAME, PACKET, OTHER = 1, 2, 4  # bits of what a record is
Integers = npt.NDArray[np.int64]


class Columns(NamedTuple):
    """Records in their order; `kinds` (n,) has the bits of each, `record` gives one of them.

    Of frames there are `swap_ns`, `t_ns` and `values` (VALUES, frames), of packets receive_ns and ACCEPTED or REFUSED. `others`
    are all other records, and among them packets refused or without a time, and frames of other faults than the one before.
    """

    kinds: npt.NDArray[np.uint8]
    swap_ns: Integers
    t_ns: Integers
    values: FloatArray
    packets: Integers
    others: list[RunRecord]
    record: Callable[[int], Any]

    def column(self, name: str) -> Any:
        """A column of VALUES."""
        return self.values[VALUES.index(name)]


def columns_of(records: list[RunRecord]) -> Columns:
    """Records as columns."""
    kinds, frames, times_ns, marks = bytearray(), [], [], []
    others: list[RunRecord] = []
    faults: tuple[int, ...] | None = None
    for record in records:
        kind = OTHER
        if type(record) is FrameRecord:
            frames.append(record)
            kind, faults = (FRAME if record.faults == faults else FRAME | OTHER), record.faults
        elif type(record) is PacketForm and record.receive_ns is not None:
            times_ns.append(record.receive_ns)
            marks.append(ACCEPTED if record.accepted else REFUSED)
            kind = PACKET if record.accepted else PACKET | OTHER
        kinds.append(kind)
        if kind & OTHER:
            others.append(record)
    swap_ns, t_ns, *columns, q = zip(*map(attrgetter(*FIELDS), frames), strict=True) if frames else [()] * len(FIELDS)
    swap, values = _integers(swap_ns), np.empty((len(VALUES), len(frames)))
    for row, name, column in zip(values, VALUES, columns, strict=False):
        first = column[0] if column else None
        if column.count(first) == len(column) and (first is None or name not in TIMES):  # as most are
            row[:] = bool(first) if name in MARKS else first
        elif name in TIMES:
            ns = _integers([each or 0 for each in column])
            row[:] = (swap - ns if TIMES[name] < 0 else ns) / NS_PER_MS
            if None in column:
                row[[each is None for each in column]] = np.nan
        else:
            row[:] = list(map(bool, column)) if name in MARKS else _integers(column)
    values[-5] = [each is None for each in q] if None in q else False
    values[-4:] = np.fromiter(chain.from_iterable([each or (np.nan,) * 4 for each in q]), np.float64).reshape(-1, 4).T
    what, packets = np.frombuffer(kinds, np.uint8), np.array([times_ns, marks], np.int64)
    return Columns(what, swap, _integers(t_ns), values, packets, others, records.__getitem__)


def _integers(values: Any) -> Integers:
    return np.fromiter(values, np.int64, len(values))


def blocks_of(path: Path) -> Iterator[Columns]:
    """The records of a ledger, BLOCK at once. Raises InputError for a file that is no ledger or is damaged."""
    rest: list[RunMessage] = []
    with telling_faults(path):
        blocks = _blocks(path, rest)
        yield from _decoded_beside(blocks) if _pays(path) else map(_checked_columns, map(decoded, blocks))
        records = decoded(rest)
        tell_no_end(path)
        yield _checked_columns(records)


def _pays(path: Path) -> bool:
    """Whether processes beside this one take less time: for a large ledger, and while a core is idle, for blocks wait often."""
    running = int(Path("/proc/loadavg").read_text().split()[3].split("/")[0])  # this one included
    return running < len(os.sched_getaffinity(0)) and sum(part.stat().st_size for part in parts_of(path)) >= POOL_BYTES


def _blocks(path: Path, rest: list[RunMessage]) -> Iterator[list[RunMessage]]:
    """Leaves in `rest` what does not fill a block."""
    try:
        for topics, messages in read_chunks(path, tell=False):
            rest += messages_in(topics, messages)
            while len(rest) >= BLOCK:
                yield rest[:BLOCK]
                del rest[:BLOCK]
    except InputError:
        decoded(rest)  # what is wrong before the damage is said first
        raise


def _decoded_beside(blocks: Iterator[list[RunMessage]]) -> Iterator[Columns]:
    with ProcessPool(_start_decoding, (), (Exception,)) as pool:
        for (block,), columns in pool.answers(WORKERS, ((block,) for block in blocks), MachineError):
            yield columns._replace(record=lambda place, block=block: decoded([block[place]])[0])


def _start_decoding() -> tuple[None, Callable[[list[RunMessage]], Columns]]:
    return None, lambda block: _checked_columns(decoded(block))._replace(record=int)  # a list's would be sent back


def _checked_columns(records: list[RunRecord]) -> Columns:
    found = columns_of(records)
    # `checked_sample` has the same rule, and costs ten times as much.
    with np.errstate(over="ignore"):
        if (np.abs(np.linalg.norm(found.values[-4:], axis=0) - 1.0) > NORM_TOLERANCE).any():  # NaN is not
            raise ArithmeticError("a quaternion's norm is not 1")
    return found
