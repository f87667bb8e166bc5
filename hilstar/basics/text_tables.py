r"""Text tables as users have them: one reader for logs, curves, data sheets and catalogues.

How a table is read, by its first lines:
1. The lines between cells are split by comma, tab, semicolon, | or blanks: the one that gives most
   lines as many cells as the header has, with numbers in them.
2. Lines that begin with #, %, ! or // are comments, and so is one with ; before its text. Where no
   line but a comment names the columns, the last comment does. Lines of fewer cells above the
   header are a title.
3. Below the header may stand a line of units, and a line of dashes (VizieR).
4. A unit stands in that line, in brackets behind a name, or at its end: `wavelength [nm]`, `t_ms`.
5. In a table whose cells are split by something other than commas, or quoted, numbers such as
   0,85 have a decimal comma, if none has a point and one cannot be thousands.
6. A column of times may have dates (ISO 8601, with the day of the month or of the year): they are
   UTC, unless they state an offset, and read as seconds since 1970.

What was taken and is not plain is said in `notices`. Python's csv module splits the lines.
"""

import csv
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date, time, timedelta
from decimal import Decimal, InvalidOperation
from functools import cache
from pathlib import Path
from typing import NamedTuple

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import open_lines, warn_once
from hilstar.basics.units import ascii_text, factor, is_unit, plain_unit, suffix_unit

VALID = "valid"
# A column says which rows hold, or which do not, by one of these words, beside words of what it
# is about: attitudeValid, is_valid, st_lost. With other words (rate_valid) it is about those.
VALID_WORDS, INVALID_WORDS = frozenset({"valid", "validity"}), frozenset({"invalid", "lost"})
SUBJECT_WORDS = frozenset(
    {
        *("is", "flag", "q", "quat", "quaternion", "att", "attitude", "orientation", "pose"),
        *("st", "str", "star", "tracker", "solution", "estimate", "row", "sample", "data"),
    }
)
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W\d_]+")
FLAGS = dict.fromkeys(("", "1", "1.0", "true", "t", "yes", "y", "valid", "ok", "good"), True)
FLAGS |= dict.fromkeys(("0", "0.0", "false", "f", "no", "n", "invalid", "bad", "lost"), False)
# Excel puts quotes around a comment that has a delimiter.
COMMENTS = ("#", "%", "!", "//", '"#')
COMMENT_CHARACTERS = frozenset("#%!/")
# What programs write where there is no number, in small letters.
NO_NUMBERS = frozenset(
    {
        *("", "-", "--", "---", "?", "*", ".", "nan", "-nan", "+nan", "nan(ind)", "-nan(ind)"),
        *("1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "na", "n/a", "#n/a", "<na>", "null"),
        *("<null>", "(null)", "nil", "none", "nat", "\\n", "missing", "undefined"),
    }
)
DELIMITERS = (",", "\t", ";", "|", " ")
DELIMITER_NAMES = {",": "commas", "\t": "tabs", ";": "semicolons", "|": "bars |", " ": "blanks"}
SAMPLE_LINES = 100
MAX_HEAD_LINES = 20_000  # of comments
MAX_COLUMNS, MAX_HEADER_CHARACTERS = 1000, 50_000
MAX_NAMED = 12
EPOCH_DAY = date(1970, 1, 1)
CUT = "the last line has no line end, as of a file that was cut off, and is left out"
CUT += "; end the line where it is whole"
DOUBTFUL_END = "the last line has no line end, and may be cut off: is the file whole?"
SHARP_DECIMALS = 12  # of a quaternion or a place: a thousandth of a milliarcsecond
# Excel's own first line, which names the delimiter.
EXCEL_MARK = re.compile(r"sep=(.)\s*", re.IGNORECASE)
# pandas and R write a name that is there twice as NAME.1.
TWIN = re.compile(r"(.+)\.\d")
DATE = re.compile(
    r"(?P<year>\d{4})(?:-(?P<month>\d\d)-(?P<day>\d\d)|[-:/](?P<day_of_year>\d{3}))[T :]"
    r"(?P<hour>\d\d):(?P<minute>\d\d):(?P<second>\d\d)(?P<fraction>\.\d*)?"
    r" ?(?P<zone>Z|UTC|[-+]\d\d:?\d\d)?",
    re.ASCII,
)
DATE_NAMES = frozenset(
    {
        *("t_s", "t", "time", "timestamp", "time_stamp", "date", "datetime", "date_time"),
        *("utc", "t_utc", "time_utc", "utc_time", "timestamp_utc", "epoch", "epoch_utc"),
    }
)
MAX_TITLE_LINES = 30
PERCENT_OF = re.compile(r"% ?(?:of )?([^\W\d].*)")
BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*")
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:[,'  ]\d{3})+(?:[.]\d*)?|[-+]?\d{1,3}(?:\.\d{3})+,\d*")
FORTRAN = re.compile(r"[-+]?\d*\.?\d*[dD][-+]?\d+")
NOT_SURELY_A_COMMA = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
DASHES = re.compile(r"-{2,}|-?")
# The unit of hilstar's own columns by the end of their names; the longest end comes first.
SUFFIXES = {
    "_rad_s": "rad/s",
    "_mas_yr": "mas/yr",
    "_arcsec": "arcsec",
    "_deg": "deg",
    "_nm": "nm",
    "_ns": "ns",
    "_px": "px",
    "_mag": "mag",
    "_s": "s",
}
# Other names of hilstar's quantities, without their units.
OTHER_NAMES = {
    "t": ("time", "timestamp", "seconds", "epoch", "time_since_start"),
    "wavelength": ("lambda", "λ", "wl", "wave", "wavelengths", "wvl", "lam"),
    "quantity": ("parameter", "symbol", "property"),
    "unit": ("units",),
    "exposure": ("exposure_time", "exptime", "t_exp", "integration_time"),
}


class Column(NamedTuple):
    """A column: its header as written, its name without a unit, and the unit that is stated ("":
    none).
    """

    header: str
    name: str
    unit: str = ""


class Chosen(NamedTuple):
    """A column that was asked for: its place in a row, and what its numbers are multiplied by, if
    any.

    `inverted`: its flags say which rows do not hold. `has_unit` is False where no unit is stated
    that was wanted. `has_dates`: its cells are dates, whose numbers are seconds since 1970.
    """

    place: int
    factor: Decimal | None = None
    inverted: bool = False
    has_unit: bool = True
    has_dates: bool = False

    @property
    def is_as_written(self) -> bool:
        """Whether its cells are the wanted numbers themselves."""
        return self.factor is None and not self.has_dates


@dataclass
class TextTable:
    """A text table, open for reading: its `columns`, then its rows, once.

    `header` is False where no line names the columns, `commented` True where a comment does.
    `notices` says what was taken that the file does not plainly state; `is_cut` is True, once the
    rows are read, where the last line was cut off. `sample` has the cells of the first rows.
    """

    path: Path
    advice: str
    columns: list[Column]
    delimiter: str
    first_row: int
    lines: Iterator[str]
    header: bool = True
    commented: bool = False
    quoted: bool = True
    decimal_comma: bool = False
    header_line: int = 1
    notices: list[str] = field(default_factory=list)
    is_cut: bool = False
    sample: Sequence[list[str]] = ()
    _unended: bool = False

    def refusal(self, line: int, reason: str) -> InputError:
        """The refusal of a line of the file."""
        return InputError(f"{self.path}:{line}: {reason}; {self.advice}")

    @property
    def names(self) -> str:
        """The headers of its columns, for a message."""
        names = [shortened(column.header, 40) for column in self.columns[:MAX_NAMED]]
        more = ", ..." if len(self.columns) > MAX_NAMED else ""
        return ", ".join(names) + more

    def rows(self, keep_cut: bool = True) -> Iterator[tuple[int, list[str]]]:
        """Line numbers with the cells of each row, as many as there are columns, as they stand.

        Blank rows and comments are skipped. A last line without an end, which is not surely whole
        (`_is_whole`), is left out, or with `keep_cut` read with a warning; `is_cut` is then True.
        Raises InputError, with `advice`, for a row of more or fewer cells.
        """
        count = len(self.columns)
        quote = '"' if self.quoted else None
        reader = csv.reader(self._watched(), delimiter=self.delimiter, quotechar=quote, strict=True)
        before = self.first_row - 1
        previous: list[str] = []
        try:
            for cells in reader:
                if len(cells) != count or not cells[0] or cells[0][0] in COMMENT_CHARACTERS:
                    if not any(map(str.strip, cells)) or cells[0].lstrip().startswith(COMMENTS):
                        continue
                    if not self._unended or keep_cut:
                        cells = self._counted(before + reader.line_num, cells)
                if self._is_header(cells):
                    again = "the header stands here again, as of files that were joined"
                    raise self.refusal(before + reader.line_num, f"{again}; delete this line")
                if self._unended and not self._is_whole(cells, previous):
                    self.is_cut = True
                    if not keep_cut:
                        return
                    warn_once(f"{self.path}:{before + reader.line_num}: {DOUBTFUL_END}")
                yield before + reader.line_num, cells
                previous = cells
        except csv.Error as error:
            raise self.refusal(before + reader.line_num, f"not CSV ({error})") from error

    def blocks(self, characters: int) -> Iterator[tuple[int, list[str]]]:
        """The lines of the rows in pieces of about so many characters, with each first line's
        number.

        No quoted cell goes over the end of a piece. For a parser of whole columns; a doubtful end
        is warned of.
        """
        number = self.first_row
        size = 0
        quotes = 0
        lines: list[str] = []
        for line in self._watched():
            lines.append(line)
            size += len(line)
            quotes += line.count('"') if self.quoted else 0
            if size < characters or (quotes % 2 and size < 2 * characters):
                continue
            yield number, lines
            number = number + len(lines)
            size = 0
            quotes = 0
            lines = []
        if not lines:
            return
        if self._unended and not self._is_whole(split(lines[-1], self.delimiter), []):
            self.is_cut = True
            warn_once(f"{self.path}:{number + len(lines) - 1}: {DOUBTFUL_END}")
        yield number, lines

    def row_of(self, line: int, text: str) -> list[str]:
        """The cells of one line, as many as there are columns. Raises InputError for another
        number.
        """
        return self._counted(line, split(text, self.delimiter))

    def _is_header(self, cells: list[str]) -> bool:
        if not self.header or cells[0].strip().strip('"') != self.columns[0].header:
            return False
        return [column_of(cell).header for cell in cells] == [
            column.header for column in self.columns
        ]

    def _is_whole(self, cells: list[str], previous: list[str]) -> bool:
        """Whether a row whose line has no end is whole, by its last cell beside those of other
        rows.

        Numbers of one format all have as many decimals, and beyond SHARP_DECIMALS no further one
        matters; a whole number is as long as the one before. One whose exponent may be missing
        tells nothing.
        """
        if len(cells) != len(self.columns):
            return False
        last = cells[-1].strip()
        others = [row[-1].strip() for row in (*self.sample, previous) if len(row) == len(cells)]
        if not others or not is_number(last):
            return last in others
        if "e" in "".join([last, *others]).lower():
            return False
        decimals = min(map(_decimals, others))
        if decimals:
            return _decimals(last) >= min(decimals, SHARP_DECIMALS)
        return len(last) >= max(map(len, others))

    def _watched(self) -> Iterator[str]:
        """The lines of the rows; `_unended` is set at one without an end."""
        blanks = self.delimiter == " "
        for line in self.lines:
            if line[-1] not in "\r\n":
                self._unended = True
            yield " ".join(line.split()) + "\n" if blanks else line

    def _counted(self, line: int, cells: list[str]) -> list[str]:
        """A row's cells where further ones are blank. Raises InputError for another number of
        them.
        """
        count = len(self.columns)
        rest = cells[count:]
        if len(cells) >= count and not any(map(str.strip, rest)):
            return cells[:count]
        reason = f"{len(cells)} cells and {count} columns"
        if self.delimiter == "," and len(cells) == 2 * count:
            reason += " (a decimal comma? write points)"
        elif self.delimiter == "," and len(cells) > count:
            reason += " (a decimal comma, or commas between thousands? write 1234.5)"
        raise self.refusal(line, reason)

    def chosen(
        self,
        name: str,
        unit: str = "",
        other_names: Sequence[str] = (),
        must_state: bool = True,
    ) -> Chosen | None:
        """The column of hilstar's `name`, in any unit that it states; None where there is none.

        `unit` is the wanted one, by default that at the end of `name`. Raises InputError for two
        such columns, for one in a unit of another kind and, with `must_state`, for one without.
        """
        base, by_name = quantity_of(name)
        wanted = unit or by_name
        exact = self._places((name.casefold(),))
        if exact:
            return self._named(self._only(name, exact), by_name, wanted)
        bases = (base, *OTHER_NAMES.get(base, ()), *other_names)
        united = self._united(bases, wanted)
        plain = self._places(bases)
        if base == "t" and not united:
            dated = self._dated()
        else:
            dated = []
        if dated:
            return self._of_dates(self._only(name, dated))
        # Where a unit has to be stated, one that states none is another quantity.
        places = set(united)
        if not united or not must_state:
            places.update(plain)
        if not places:
            return None
        place = self._only(name, sorted(places))
        stated = united.get(place) or self.columns[place].unit
        if wanted and not stated:
            if must_state:
                raise self._no_unit(place, name, wanted)
            return Chosen(place, has_unit=False)
        return self._in_unit(place, stated or wanted, wanted)

    def _named(self, place: int, by_name: str, wanted: str) -> Chosen:
        """A column of hilstar's own name, whose unit `by_name` a bracket may only repeat."""
        column = self.columns[place]
        if by_name == "s" and self._has_dates(place):
            return self._of_dates(place)
        if column.unit and by_name and factor(column.unit, by_name) != 1:
            raise self.refusal(self.header_line, f"column {column.header} states two units")
        return self._in_unit(place, column.unit or wanted, wanted)

    def _no_unit(self, place: int, name: str, wanted: str) -> InputError:
        column = self.columns[place]
        where = f"{self.path}:{self.header_line}: column {column.header}"
        cell = self.first_cell(place)
        if cell and not is_number(cell) and not is_no_number(cell):
            kind = f"no number {wanted}"
            if wanted == "s":
                kind = "no time: write seconds, or dates such as 2024-01-31T06:00:00.000Z"
            return InputError(f"{where} has {shortened(cell, 40)!r}, which is {kind}")
        advice = f"write {name}, or its unit as {column.name} [{wanted}]"
        return InputError(f"{where} has no unit; {advice}")

    def valid(self) -> Chosen | None:
        """The column that says which rows hold, or which do not, by any of its names, if there is
        one.
        """
        places = self._about(True)
        if places:
            return Chosen(self._only(VALID, places))
        places = self._about(False)
        if places:
            return Chosen(self._only("invalid", places), inverted=True)
        return None

    def _places(self, names: Sequence[str]) -> list[int]:
        places = []
        for place, column in enumerate(self.columns):
            twin = TWIN.fullmatch(column.name)
            is_twin = twin is not None and plain_name(twin[1]) in names
            if is_twin or plain_name(column.name) in names:
                places.append(place)
        return places

    def _about(self, holds: bool) -> list[int]:
        """The places of the columns whose flags say which rows hold, or which do not."""
        places = []
        for place, column in enumerate(self.columns):
            if validity_of_name(column.name) is holds:
                places.append(place)
        return places

    def _dated(self) -> list[int]:
        places = []
        for place, column in enumerate(self.columns):
            name = re.sub(r"\W+", "_", column.name.casefold()).strip("_")
            if name in DATE_NAMES and self._has_dates(place):
                places.append(place)
        return places

    def _has_dates(self, place: int) -> bool:
        return DATE.fullmatch(self.first_cell(place)) is not None

    def first_cell(self, place: int) -> str:
        """The first cell of a column that is not blank, among the first rows; "" for none."""
        for row in self.sample:
            if len(row) > place and row[place] and not row[0].startswith(COMMENTS):
                return row[place]
        return ""

    def _of_dates(self, place: int) -> Chosen:
        header = self.columns[place].header
        since = "in UTC where they state no offset, and read as seconds since 1970"
        self.notices.append(f"column {header} has dates, {since}")
        return Chosen(place, has_dates=True)

    def _united(self, bases: Sequence[str], wanted: str) -> dict[int, str]:
        """The unit by place of the columns named like one of `bases` with a unit of the wanted
        kind.
        """
        united = {}
        for place, column in enumerate(self.columns):
            name = plain_name(column.name)
            for base in bases:
                if not wanted or not name.startswith(f"{base}_"):
                    continue
                unit = suffix_unit(name[len(base) + 1 :])
                if factor(unit, wanted) is not None:
                    united[place] = unit
        return united

    def _only(self, name: str, places: Sequence[int]) -> int:
        if len(places) > 1:
            headers = {self.columns[place].header for place in places}
            if headers == {name}:
                also = ""
            else:
                also = f" ({', '.join(sorted(headers))})"
            raise self.refusal(self.header_line, f"column {name} is there twice{also}")
        return places[0]

    def _in_unit(self, place: int, unit: str, wanted: str) -> Chosen:
        column = self.columns[place]
        if not wanted:
            if column.unit and factor(column.unit, "1") != 1:
                self.notices.append(f"column {column.header} is taken as it is, in {column.unit}")
            return Chosen(place)
        size = factor(unit, wanted)
        if size is None:
            reason = f"column {column.header} is in {unit!r}, and {wanted} is wanted"
            raise self.refusal(self.header_line, reason)
        if size == 1:
            return Chosen(place)
        change = f"its numbers are multiplied by {size:.9g}, to be in {wanted}"
        self.notices.append(f"column {column.header} is in {unit}: {change}")
        return Chosen(place, size)

    def cell(self, cells: Sequence[str], chosen: Chosen | None) -> str:
        """The text of a chosen column in a row, its number in the wanted unit; "" for no column."""
        if chosen is None:
            return ""
        text = cells[chosen.place].strip()
        if not text.isascii() and is_number(text):
            text = ascii_text(text)
        if self.decimal_comma and DECIMAL_COMMA.fullmatch(text):
            text = text.replace(",", ".")
        if chosen.has_dates:
            text = seconds_of_date(text)
        elif chosen.factor is not None:
            text = _scaled(text, chosen.factor)
        if chosen.inverted and text.lower() in FLAGS:
            text = str(int(not FLAGS[text.lower()])) if text else ""
        return text

    def not_used(self, used: Sequence[Chosen]) -> None:
        """Add a notice of the columns that are not among those `used`."""
        places = {chosen.place for chosen in used}
        rest = [column.header for place, column in enumerate(self.columns) if place not in places]
        rest = list(filter(None, rest))
        if rest:
            self.notices.append(f"not used: {', '.join(rest[:MAX_NAMED])}")

    def warn(self) -> None:
        """Log each notice as a warning, once in a process."""
        for notice in self.notices:
            warn_once(f"{self.path}: {notice}")


def quantity_of(name: str) -> tuple[str, str]:
    """The quantity and the unit of one of hilstar's columns: "t_s" is t, s."""
    for suffix, unit in SUFFIXES.items():
        if name.endswith(suffix):
            return name.removesuffix(suffix), unit
    return name, ""


def _decimals(text: str) -> int:
    return len(text.replace(",", ".").partition(".")[2])


def name_words(text: str) -> frozenset[str]:
    """The words of a name in small letters: AttitudeValid and attitude_valid have the same."""
    return frozenset(word.casefold() for word in WORD.findall(text))


def validity_of_name(name: str) -> bool | None:
    """Whether flags of that name say what holds (True) or what does not; None for other names."""
    words = name_words(name)
    for known, holds in ((VALID_WORDS, True), (INVALID_WORDS, False)):
        if words & known and words - known <= SUBJECT_WORDS:
            return holds
    return None


def is_no_number(text: str) -> bool:
    """Whether a cell says that there is no number."""
    return text.strip().casefold() in NO_NUMBERS


def seconds_of_date(text: str) -> str:
    """A date's seconds since 1970, in days of 86400 s, every digit of them; another text as it
    is.
    """
    match = DATE.fullmatch(text)
    if match is None:
        return text
    try:
        day = date(int(match["year"]), int(match["month"] or 1), int(match["day"] or 1))
        day += timedelta(days=int(match["day_of_year"] or 1) - 1)
        clock = time(int(match["hour"]), int(match["minute"]), int(match["second"]))
    except ValueError:
        return text  # its reader refuses it as it stands
    if day.year != int(match["year"]):
        return text
    seconds = (day - EPOCH_DAY).days * 86400 + clock.hour * 3600
    seconds += clock.minute * 60 + clock.second - _ahead_s(match["zone"] or "Z")
    whole = Decimal(seconds)
    if match["fraction"] != ".":
        return str(whole + Decimal(match["fraction"] or 0))
    return str(whole)


def _ahead_s(zone: str) -> int:
    """How far a clock with this offset is ahead of UTC."""
    if zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "")
    ahead_s = int(digits[:2]) * 3600 + int(digits[2:]) * 60
    return -ahead_s if zone[0] == "-" else ahead_s


def plain_name(text: str) -> str:
    """A name in small letters, its blanks, points and hyphens as one underscore."""
    return re.sub(r"[\s.\-]+", "_", text.strip()).casefold()


def column_of(header: str) -> Column:
    """The column of a header, with the unit in its brackets, if it has one."""
    text = header.strip().strip('"').strip()
    match = BRACKETS.fullmatch(text)
    percent = PERCENT_OF.fullmatch(text)
    if percent is not None:
        return Column(text, percent[1], "%")
    if match is None or not match[1]:
        return Column(text, text)
    unit = match[2] if match[2] is not None else match[3]
    # Square brackets are for units, round ones for others, too: RA(ICRS).
    if match[2] is None and not is_unit(plain_unit(unit)):
        return Column(text, text)
    return Column(text, match[1], unit.strip())


def is_number(text: str) -> bool:
    """Whether a cell is a number, with a point or a decimal comma."""
    plain = ascii_text(text.strip())
    if DECIMAL_COMMA.fullmatch(plain):
        return True
    try:
        float(plain)
    except ValueError:
        return False
    return "_" not in plain


def _scaled(text: str, size: Decimal) -> str:
    try:
        return str(Decimal(text) * size)
    except (InvalidOperation, ValueError):
        return text  # its reader refuses it as it stands


@contextmanager
def open_table(path: Path, advice: str, limit_bytes: int) -> Iterator[TextTable]:
    """A text table with its head read. Raises InputError, with `advice`, for what is no text
    table.
    """
    with open_lines(path, advice, limit_bytes) as lines:
        yield table_of(path, advice, lines)


def table_of(path: Path, advice: str, lines: Iterator[str]) -> TextTable:
    """The text table of lines, each with its end, with its head read. Raises InputError, with
    `advice`.
    """
    comments, sample, number, delimiter = _head(path, advice, lines)
    # Each of the first lines is tried as the header, with those below it: none is split twice.
    counts_of = cache(line_counts)
    title = _title_lines(sample, counts_of)
    number = number + title
    sample = sample[title:]
    following = itertools.chain(sample, lines)
    if not sample:
        return TextTable(path, advice, [], ",", number, following, header=False)
    delimiter = delimiter or delimiter_of(sample, counts_of)
    header = split(sample[0], delimiter)
    table = TextTable(path, advice, [], delimiter, number, following, header_line=number)
    if title:
        if title == 1:
            above = "line above the header is"
        else:
            above = f"{title} lines above the header are"
        table.notices.append(f"the {above} taken for a title")
    if len(sample[0]) > MAX_HEADER_CHARACTERS:
        reason = f"its first line is longer than {MAX_HEADER_CHARACTERS} characters"
        raise table.refusal(number, reason)
    if len(header) > MAX_COLUMNS:
        raise table.refusal(number, f"its first line names more than {MAX_COLUMNS} columns")
    if 2 * sum(map(is_number, header)) >= len(header):
        _name_by_comment(table, comments, len(header))
    else:
        next(following)
        _name_by_header(table, header, sample[1:], following)
    rows = sample[table.first_row - number :]
    table.decimal_comma = _has_decimal_comma(table, rows)
    table.sample = [split(line, delimiter) for line in rows if line[-1] in "\r\n"]
    return table


def _name_by_header(
    table: TextTable,
    header: list[str],
    sample: Sequence[str],
    following: Iterator[str],
) -> None:
    """Name the columns by the header and the lines of units and dashes below it."""
    rows = [split(line, table.delimiter) for line in sample]
    if not header[-1].strip() and rows and len(rows[0]) == len(header) - 1:
        del header[-1]  # a delimiter at the end of the header alone
    table.columns = [column_of(name) for name in header]
    if _are_numbered(rows, len(header)):
        table.columns.insert(0, Column("", ""))
        beginning = "each row begins with its number, for which the header has no name"
        table.notices.append(beginning)
    table.first_row += 1 + _skip_units(table, rows, following)


def _are_numbered(rows: Sequence[list[str]], count: int) -> bool:
    """Whether rows have a cell more than the header, before its first: R writes their numbers."""
    whole = [row for row in rows[:-1] if any(row)]
    if len(whole) < 2 or any(len(row) != count + 1 or not row[-1] for row in whole):
        return False
    numbers = [row[0] for row in whole]
    first = int(numbers[0]) if numbers[0].isdecimal() else -1
    return first in (0, 1) and numbers == [str(first + k) for k in range(len(numbers))]


class LineCounts(NamedTuple):
    """Of a line that is split: its cells, those that are filled, and those that are numbers."""

    cells: int
    filled: int
    numbers: int


CountsOf = Callable[[str, str], LineCounts]


def line_counts(line: str, delimiter: str) -> LineCounts:
    """The counts of a line's cells with a delimiter between them."""
    cells = split(line, delimiter)
    filled = list(filter(None, cells))
    return LineCounts(len(cells), len(filled), sum(map(is_number, filled)))


def _title_lines(sample: Sequence[str], counts_of: CountsOf) -> int:
    """How many lines stand above the header, which has as many cells as the first row: one of
    numbers alone or, where no row is, one with a number.
    """
    return _lines_above(sample, all, counts_of) or _lines_above(sample, any, counts_of)


def _lines_above(
    sample: Sequence[str], which: Callable[[Iterable[bool]], bool], counts_of: CountsOf
) -> int:
    for place, line in enumerate(sample[:MAX_TITLE_LINES]):
        if not line.strip() or _is_comment(line):
            continue
        delimiter = delimiter_of(sample[place:], counts_of)
        row = split(line, delimiter)
        numbers = [is_number(cell) or (which is all and is_no_number(cell)) for cell in row]
        if len(row) < 2 or not which(numbers):
            continue
        for above, text in enumerate(sample[:place]):
            cells = split(text, delimiter)
            is_header = len(cells) == len(row) and not any(map(is_number, cells))
            if is_header and not _is_comment(text):
                return above
        return 0
    return 0


class Head(NamedTuple):
    """The comments before a table, its first lines, the number of the first, and Excel's
    delimiter.
    """

    comments: list[str]
    sample: list[str]
    number: int
    delimiter: str | None


def _head(path: Path, advice: str, lines: Iterator[str]) -> Head:
    comments: list[str] = []
    delimiter = None
    number = 0
    for line in lines:
        number += 1
        mark = EXCEL_MARK.fullmatch(line)
        if mark is not None and number == 1:
            delimiter = mark[1]
        elif _is_comment(line):
            comments.append(line)
        elif line.strip():
            sample = [line, *itertools.islice(lines, SAMPLE_LINES)]
            return Head(comments, sample, number, delimiter)
        if number > MAX_HEAD_LINES:
            reason = f"{MAX_HEAD_LINES} lines, and none with a table's header"
            raise InputError(f"{path}: {reason}; {advice}")
    return Head(comments, [], max(number, 1), delimiter)


def _is_comment(line: str) -> bool:
    text = line.lstrip()
    # A table of semicolons may begin with one, where its first column has no name.
    semicolon = text.startswith(";") and (text[1:2].isspace() or text.count(";") == 1)
    return text.startswith(COMMENTS) or semicolon


def split(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    if delimiter == " ":
        line = " ".join(line.split())
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:  # a cell of more characters than the module reads
        cells = [line]
    return [cell.strip() for cell in cells]


def delimiter_of(lines: Sequence[str], counts_of: CountsOf) -> str:
    """What stands between the cells of a table's first lines, a header or a row before the
    others.
    """
    best = ","
    best_rank = (0, 0.0, 0)
    rows = [line for line in lines if line.strip() and not _is_comment(line)]
    for delimiter in DELIMITERS:
        count = counts_of(rows[0], delimiter).cells
        if count < 2:
            continue
        counts = [counts_of(line, delimiter) for line in rows]
        alike = [row for row in counts if row.cells == count]
        filled = sum(row.filled for row in alike)
        numbers = sum(row.numbers for row in alike)
        rank = (len(alike), numbers / max(filled, 1), count)
        if rank > best_rank:
            best = delimiter
            best_rank = rank
    return best


def _name_by_comment(table: TextTable, comments: Sequence[str], count: int) -> None:
    """Name the columns of a table whose first line is a row, where the last comment has all
    names.
    """
    table.header = False
    table.columns = [Column("", "")] * count
    if comments:
        text = comments[-1].strip().lstrip('#%!;/"').strip()
    else:
        text = ""
    for delimiter in dict.fromkeys((table.delimiter, ",", " ")):
        names = split(text, delimiter) if text else []
        if len(names) == count and not any(map(is_number, names)):
            table.columns = [column_of(name) for name in names]
            table.header = table.commented = True
            return


def _skip_units(table: TextTable, rows: Sequence[list[str]], following: Iterator[str]) -> int:
    """Read a line of units and one of dashes below the header, where they are; how many these
    are.
    """
    skipped = 0
    dashes = [bool(row) and len(row) == len(table.columns) and _is_rule(row) for row in rows[:2]]
    has_dashes = any(dashes)
    if has_dashes:
        skipped = 1 + dashes.index(True)
        table.quoted = False  # VizieR writes quotes as they are
    elif rows and _is_units(rows[0], len(table.columns)):
        skipped = 1
    if skipped and not (has_dashes and skipped == 1):
        for place, unit in enumerate(rows[0][: len(table.columns)]):
            if unit:
                table.columns[place] = table.columns[place]._replace(unit=unit.strip('"[]()'))
    for _ in range(skipped):
        next(following)
    return skipped


def _is_rule(cells: Sequence[str]) -> bool:
    return max(map(len, cells)) > 1 and all(map(DASHES.fullmatch, cells))


def _is_units(cells: Sequence[str], count: int) -> bool:
    """Whether each cell that is not blank is a unit, and none a number."""
    if len(cells) != count:
        return False
    if any(map(is_number, cells)):
        return False
    units = list(filter(None, (cell.strip("[]() ") for cell in cells)))
    if not units:
        return False
    return all(map(is_unit, map(plain_unit, units)))


def _has_decimal_comma(table: TextTable, lines: Sequence[str]) -> bool:
    """Whether numbers of the first rows have decimal commas. Raises InputError for likely
    thousands.
    """
    commas = []
    points = False
    for line in lines:
        if _is_comment(line):
            continue
        for cell in split(line, table.delimiter):
            if DECIMAL_COMMA.fullmatch(cell):
                commas.append(cell)
            elif "." in cell and is_number(cell):
                points = True
    if not commas:
        return False
    if points or all(map(NOT_SURELY_A_COMMA.fullmatch, commas)):
        reason = "a decimal comma, or a comma between thousands? write 1234.5"
        raise InputError(f"{table.path}: {commas[0]!r} is {reason}; {table.advice}")
    table.notices.append(f"numbers such as {commas[0]} are read with a decimal comma")
    return True


def read_rows(
    path: Path,
    columns: tuple[str, ...],
    advice: str,
    limit_bytes: int,
    more: tuple[str, ...] = (VALID,),
    keep_cut: bool = True,
) -> Iterator[tuple[int, list[str]]]:
    """Line numbers with the cells of `columns` and of `more` ("": not there), in hilstar's units.

    What was taken that is not plainly stated is logged as a warning.
    Raises InputError, with `advice`, for a column that is missing or there twice, and for a row of
    more or fewer cells.
    """
    with open_table(path, advice, limit_bytes) as table:
        places: list[Chosen | None] = [needed(table, name) for name in columns]
        places += [table.valid() if name == VALID else table.chosen(name) for name in more]
        table.warn()
        for line, cells in table.rows(keep_cut):
            yield line, [table.cell(cells, chosen) for chosen in places]
        if table.is_cut and not keep_cut:
            warn_once(f"{path}: {CUT}")


def needed(table: TextTable, name: str, unit: str = "") -> Chosen:
    """The column of that name. Raises InputError where there is none."""
    chosen = table.chosen(name, unit)
    if chosen is None:
        if table.header and table.columns:
            there = f" (its columns are {table.names})"
        else:
            there = ""
        raise table.refusal(table.header_line, f"column {name} is missing{there}")
    return chosen


def is_valid(path: Path, line: int, cell: str) -> bool:
    """The flag in a cell of `valid`. Raises InputError."""
    if cell.lower() not in FLAGS:
        raise InputError(f"{path}:{line}: valid = {shortened(cell)!r}; write 1 or 0")
    return FLAGS[cell.lower()]


def number_fault(text: str) -> str:
    """Why a cell is no number, and what to write, where its form shows that; "" elsewhere."""
    if DECIMAL_COMMA.fullmatch(text) and not NOT_SURELY_A_COMMA.fullmatch(text):
        return " (a decimal comma: write a point)"
    if FORTRAN.fullmatch(text):
        return " (an exponent of D: write E)"
    if THOUSANDS.fullmatch(text):
        return " (thousands apart: write 1234.5)"
    return ""


def finite_numbers(
    path: Path,
    line: int,
    columns: Iterable[str],
    cells: Iterable[str],
    advice: str,
) -> list[float]:
    """The numbers of the cells of `columns`. Raises InputError, with `advice`, for one not
    finite.
    """
    numbers = []
    for name, cell in zip(columns, cells, strict=True):
        try:
            number = float(cell)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in cell:
            reason = f"{name} = {shortened(cell)!r} is not a finite number{number_fault(cell)}"
            raise InputError(f"{path}:{line}: {reason}; {advice}")
        numbers.append(number)
    return numbers
