"""Attitude logs as CSV.

The columns are `t_s,qw,qx,qy,qz` and, where known, `rx,ry,rz` (rad/s), `sequence`, `discontinuity`
and `valid`, in any order and any dialect of a text table. Times and rates are in the units that
their columns state (`t_ms`, `rx [deg/s]`). Rows that the file marks as not valid are left out, and
so is a last line that was cut off; a notice says so.
"""

import contextlib
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import IO, Literal

from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import MAX_LOG_BYTES, LogFormat, Writing, readable
from hilstar.attitude.logs.log_times import ns_of_seconds, refuse_grouped
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.attitude.wire.source import HILSTARS
from hilstar.basics.errors import InputError
from hilstar.basics.text_tables import (
    CUT,
    FLAGS,
    Chosen,
    TextTable,
    is_no_number,
    is_valid,
    name_words,
    number_fault,
    open_table,
    plain_name,
)
from hilstar.basics.units import NS_PER_S

CSV_COLUMNS = ("t_s", "qw", "qx", "qy", "qz")
RATE_COLUMNS = ("rx", "ry", "rz")
RATE_UNIT = "rad/s"
# The integers that msgspec reads from JSON: a sequence that JSON lines can hold, CSV can hold too.
WHOLE_NUMBERS = range(-(2**63), 2**64)
INT64_NS = range(-(2**63), 2**63)
DISCONTINUITY = {"": False, "0": False, "1": True}
TIME_UNITS = {Decimal("1e-3"): "ms", Decimal("1e-6"): "us", Decimal("1e-9"): "ns"}
# Names of columns in which other programs mark their rows; what the marks mean is not known here.
MARKS = frozenset(
    [
        "status",
        "quality",
        "flag",
        "flags",
        "state",
        "mode",
        "health",
        "fix",
        "tracking",
    ],
)
# In a column's name these words announce marks only where its cells are flags; elsewhere, as in
# an error in degrees, they name something else.
FLAG_WORDS = frozenset({"ok", "good", "bad", "valid", "error", "err", "fault", "lost", "converged"})
# Names that other programs give to angular rates. Their axes and their sign are not known, so they
# are not read as rates; a notice says so.
RATES_OF_OTHERS = re.compile(
    r"(?:w|om|omega|rate|gyro|gyr|ang_?vel|angular_velocity|body_rate)_?[xyz]|[xyz]_?rate|[pqr]"
)
MORE_ADVICE = ", all of rx,ry,rz or none, a whole number as sequence, 0 or 1 as discontinuity"
UNITS_ADVICE = "t_s is in seconds; name the column t_ms, t_us or t_ns if it is in ms, us or ns"
TABLE_KIND, VALID_KIND, CUT_KIND = "log-table", "log-valid", "log-cut"


@contextlib.contextmanager
def read_csv_log(path: Path, stated: Stated) -> Iterator[LogReading]:
    """Open a CSV log; its attitudes are read as the entries are. Raises InputError for a header
    without the columns of an attitude, or with one of them twice.
    """
    scalar = (stated.convention or HILSTARS).scalar
    with open_table(path, readable(), MAX_LOG_BYTES) as table:
        csv_log = CsvLog(table, scalar)
        entries = itertools.starmap(LogEntry, csv_log.entries())
        reading = of_packets(path, entries, "CSV", stated)
        # Some notices are known only once the last row has been read. So the log and the reading
        # share one list, to which the log adds these.
        reading.told.extend(csv_log.told)
        csv_log.told = reading.told
        conventions = replace(reading.conventions, time_unit=csv_log.time_unit)
        yield replace(reading, conventions=conventions)


class CsvLog:
    """A CSV log. Its `entries` can be read once; the notices `told` (kind, line) are complete after
    that.

    `time_unit` is the unit of its time column: s, ms, us or ns. With `scalar` "last", the
    quaternion's four columns are taken as x, y, z, w from left to right, whatever their names.
    Raises InputError for a header without the columns of an attitude, or with one of them twice.
    """

    def __init__(self, table: TextTable, scalar: Literal["first", "last"]) -> None:
        self.table = table
        self.time_unit = "s"
        self.told: list[tuple[str, str]] = []
        if not table.columns:
            return
        table.advice = f"write finite numbers for {','.join(CSV_COLUMNS)}"
        of_the_head = list(table.notices)
        has_rates = any(table.chosen(name, RATE_UNIT) for name in RATE_COLUMNS)
        # That look added notices about columns; choosing them below adds the right ones.
        table.notices[:] = of_the_head
        names = CSV_COLUMNS + (RATE_COLUMNS if has_rates else ())
        self._t, *numbers = [self._needed(name, names) for name in CSV_COLUMNS]
        # The convention overrides the columns' names: a table whose names say where the scalar is
        # needs no convention.
        self._q = sorted(numbers) if scalar == "last" else numbers
        self._rates = [self._needed(name, names) for name in names[len(CSV_COLUMNS) :]]
        self._sequence = table.chosen("sequence")
        self._discontinuity = table.chosen("discontinuity")
        self._valid = table.valid()
        self.time_unit = TIME_UNITS.get(self._t.factor or Decimal(1), "s")
        self.told += [(TABLE_KIND, notice) for notice in table.notices]
        self._tell_marks()
        if not has_rates:
            self._tell_rates()
        if has_rates or self._sequence or self._discontinuity:
            table.advice += MORE_ADVICE

    def _needed(self, name: str, names: Sequence[str]) -> Chosen:
        unit = RATE_UNIT if name in RATE_COLUMNS else ""
        chosen = self.table.chosen(name, unit)
        if chosen is None:
            place = f"{self.table.path}:{self.table.header_line}"
            missing = f"column {name} is missing"
            if self.table.header:
                missing += f" (its columns are {self.table.names})"
            else:
                missing += ", as no line names the columns"
            raise InputError(f"{place}: {missing}; the header must have {','.join(names)}")
        return chosen

    def _tell_marks(self) -> None:
        marks = []
        for place, column in enumerate(self.table.columns):
            words = name_words(column.name)
            if words & MARKS or (words & FLAG_WORDS and self._has_flags(place)):
                marks.append(column.header)
        if marks and self._valid is None:
            named = ", ".join(marks)
            rows = f"column {named} is not used: rows of every value of it are shown"
            self.told.append((TABLE_KIND, f"{rows}; name it valid, 1 or 0"))

    def _has_flags(self, place: int) -> bool:
        cells = [row[place].lower() for row in self.table.sample if len(row) > place]
        return bool(cells) and all(cell in FLAGS for cell in cells)

    def _tell_rates(self) -> None:
        notice = rates_of_others(self.table)
        if notice:
            self.told.append((TABLE_KIND, notice))

    def entries(self) -> Iterator[tuple[str, AttitudeSample | Refusal]]:
        """Each row's place in the file (":12"), and its attitude or why it is refused, in the
        file's order.
        """
        table = self.table
        if not table.columns:
            return
        invalid = 0
        converted = self._conversions()
        for line, cells in table.rows(keep_cut=False):
            if self._valid is not None:
                flag = table.cell(cells, self._valid)
                if not is_valid(table.path, line, flag):
                    invalid += 1
                    continue
            if converted:
                cells = self._converted(cells, converted)
            yield f":{line}", self._event(cells)
        if invalid:
            self.told.append(invalid_notice(invalid, "row"))
        if table.is_cut:
            self.told.append((CUT_KIND, CUT))

    def _conversions(self) -> list[Chosen]:
        """The columns whose cells must be converted first: all of them where the table has decimal
        commas, else those in another unit or form.
        """
        columns = [self._t, *self._q, *self._rates]
        if self.table.decimal_comma:
            return columns
        return [column for column in columns if not column.is_as_written]

    def _converted(self, cells: list[str], columns: Sequence[Chosen]) -> list[str]:
        cells = cells.copy()
        for column in columns:
            cells[column.place] = self.table.cell(cells, column)
        return cells

    def _event(self, cells: list[str]) -> AttitudeSample | Refusal:
        try:
            return self._sample(cells)
        except (ValueError, LookupError, ArithmeticError):
            pass
        texts = [cells[column.place] for column in self._q]
        if all(map(is_no_number, texts)) and texts != ["nan"] * len(texts):
            # An estimator that has not begun yet writes nothing or a word where another writes
            # NaN, so such a row is treated as one with NaN.
            return self._event(self._without_quaternion(cells))
        row = self.table.delimiter.join(cells)
        # A typographic minus or blank: `table.cell` reads such numbers.
        if not row.isascii():
            try:
                return self._sample(self._converted(cells, [self._t, *self._q, *self._rates]))
            except (ValueError, LookupError, ArithmeticError):
                pass
        faults = [number_fault(cells[column.place].strip()) for column in (self._t, *self._q)]
        fault = next(filter(None, faults), "")
        quoted = row.strip()[:MAX_QUOTED_CHARACTERS]
        return Refusal("format", f"{quoted!r}{fault}; {self.table.advice}")

    def _without_quaternion(self, cells: list[str]) -> list[str]:
        cells = cells.copy()
        for column in self._q:
            cells[column.place] = "nan"
        return cells

    def _sample(self, cells: list[str]) -> AttitudeSample | Refusal:
        """The attitude of a row in the log's own convention, or why it is refused. Raises
        ValueError, LookupError or ArithmeticError for cells that are no numbers.
        """
        t_ns = ns_of_seconds(cells[self._t.place])
        w, x, y, z = (cells[column.place] for column in self._q)
        refuse_grouped(w + x + y + z)
        q = float(w), float(x), float(y), float(z)
        rate = None
        if self._rates:
            turning = [cells[column.place].strip() for column in self._rates]
            if any(turning):
                refuse_grouped("".join(turning))
                rate = float(turning[0]), float(turning[1]), float(turning[2])
        sequence = 0
        discontinuity = False
        if self._sequence is not None:
            text = cells[self._sequence.place].strip()
            refuse_grouped(text)
            sequence = int(text or 0)
            if sequence not in WHOLE_NUMBERS:
                raise ValueError
        if self._discontinuity is not None:
            discontinuity = DISCONTINUITY[cells[self._discontinuity.place].strip()]
        if t_ns not in INT64_NS:
            text = cells[self._t.place].strip()[:MAX_QUOTED_CHARACTERS]
            return Refusal("format", f"t_s = {text} s does not fit 64 bits of ns; {UNITS_ADVICE}")
        return checked_sample(t_ns, q, rate, sequence, discontinuity)


def rates_of_others(table: TextTable) -> str:
    """A notice of columns that look like rates by another program's names, and are not used; "" for
    none.
    """
    headers = []
    for column in table.columns:
        if RATES_OF_OTHERS.fullmatch(plain_name(column.name)):
            headers.append(column.header)
    if len(headers) < len(RATE_COLUMNS):
        return ""
    named = ", ".join(headers)
    return (
        f"columns {named} are not used: rates are named {','.join(RATE_COLUMNS)}, of cam with"
        " respect to icrs in cam axes, rad/s or the unit in their names"
    )


def invalid_notice(count: int, what: str) -> tuple[str, str]:
    """The notice (kind, line) that `count` rows or lines (`what`), which a log itself marks as not
    valid, are left out.
    """
    if count == 1:
        number = f"1 {what} is"
    else:
        number = f"{count} {what}s are"
    return VALID_KIND, f"{number} marked as not valid by the log itself, and left out"


def write_csv_log(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    """Write samples as a CSV log with all columns except `valid`; a number read back has the same
    bits.
    """
    header = ",".join((*CSV_COLUMNS, *RATE_COLUMNS, "sequence", "discontinuity"))
    file.write(f"{header}\n".encode())
    for sample in samples:
        cells = [_seconds_text(sample.t_ns), *map(repr, sample.q_icrs_to_cam.tolist())]
        rate = sample.rate_cam_rad_s
        cells += ["", "", ""] if rate is None else map(repr, rate.tolist())
        cells += [str(sample.sequence), str(int(sample.discontinuity))]
        file.write((",".join(cells) + "\n").encode())


def _seconds_text(t_ns: int) -> str:
    seconds, ns = divmod(abs(t_ns), NS_PER_S)
    sign = "-" if t_ns < 0 else ""
    return f"{sign}{seconds}.{ns:09}"


# A file that no other format recognises is read as CSV.
log_format = LogFormat(
    "CSV",
    read_csv_log,
    listed="CSV",
    uses=LIKE_PACKETS,
    endings=(".csv",),
    write=write_csv_log,
)
