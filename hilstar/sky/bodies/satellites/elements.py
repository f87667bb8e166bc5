"""Lists of two-line element sets, with or without name lines, as CelesTrak and Space-Track give them."""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hilstar.errors import InputError, MachineError, printable
from hilstar.sky.bodies.kernel import INSTALL, NS_PER_DAY, UNIX_JD

if TYPE_CHECKING:
    from sgp4.api import Satrec

LINE_LENGTH = 69  # with its checksum
MAX_NAME = 24  # characters, as CelesTrak has them
ADVICE = "give a list of two-line element sets, with name lines or without"
# Of each line the columns (from 0) that are numbers, and what they are.
NUMBERS = {
    "1": {"epoch's year": (18, 20), "epoch's day": (20, 32), "first derivative of the mean motion": (33, 43)},
    "2": {
        "inclination": (8, 16),
        "right ascension of the node": (17, 25),
        "eccentricity": (26, 33),
        "argument of perigee": (34, 42),
        "mean anomaly": (43, 51),
        "mean motion": (52, 63),
    },
}
DIGIT_SUM = {ord(c): int(c) if c.isdigit() else int(c == "-") for c in map(chr, range(128))}


@dataclass(frozen=True, slots=True, eq=False)
class Satellite:
    """One satellite: its name (that of no other in its list), its catalogue number, and its elements."""

    name: str
    number: int
    satrec: Satrec

    def age_days(self, utc_ns: int) -> float:
        """How many days a UTC is after the elements' own date."""
        return float(utc_ns / NS_PER_DAY + UNIX_JD - self.satrec.jdsatepoch - self.satrec.jdsatepochF)


def read_satellites(text: str, file: str, utc_ns: int) -> list[Satellite]:
    """The satellites in the text of a list, in its order; of several sets of one, that of the date nearest to a UTC.

    A name that several have is followed by the catalogue number; one without a name is called by that.

    Raises InputError with the line that is wrong, and MachineError without SGP4.
    """
    if importlib.util.find_spec("sgp4") is None:
        raise MachineError(f"[sky.bodies] satellites need SGP4; {INSTALL}")
    from sgp4.api import Satrec

    found: dict[int, Satellite] = {}
    for name, first, second in _sets(text, file):
        satrec = Satrec.twoline2rv(first, second)
        number = satrec.satnum
        one = Satellite(name, number, satrec)
        other = found.get(number)
        if other is None or abs(one.age_days(utc_ns)) < abs(other.age_days(utc_ns)):
            found[number] = one
    if not found:
        raise InputError(f"{file}: no element set in it; {ADVICE}")
    shared = Counter(one.name for one in found.values())
    return [Satellite(_called(one, shared[one.name]), one.number, one.satrec) for one in found.values()]


def _called(one: Satellite, bearers: int) -> str:
    if not one.name:
        return f"NORAD {one.number}"
    return one.name if bearers == 1 else f"{one.name} {one.number}"


def _sets(text: str, file: str) -> Iterator[tuple[str, str, str]]:
    """The name (empty where there is none), the first and the second line of each set."""
    name, first, first_at = "", "", 0
    for at, line in enumerate(text.splitlines(), start=1):
        line = line.rstrip()
        where = f"{file}:{at}"
        if not line or line.startswith("#"):
            continue
        if first:
            if not line.startswith("2 "):
                raise InputError(f"{where}: element line 2 is missing after line {first_at}; {ADVICE}")
            _check(line, where)
            if line[2:7] != first[2:7]:
                other = first[2:7].strip()
                raise InputError(f"{where}: it is of satellite {line[2:7].strip()}, line {first_at} of {other}; {ADVICE}")
            yield name, first, line
            name, first = "", ""
        elif line.startswith("1 "):
            _check(line, where)
            first, first_at = line, at
        elif line.startswith("2 "):
            raise InputError(f"{where}: element line 1 is missing before it; {ADVICE}")
        elif name:
            raise InputError(f"{where}: two lines in a row that are no elements; {ADVICE}")
        else:
            name = _name(line)
    if first or name:
        raise InputError(f"{file}: it ends within an element set; {ADVICE}")


def _name(line: str) -> str:
    """A name line's name in ASCII, as tables have it; Space-Track writes "0 " before it."""
    text = line[2:] if line.startswith("0 ") else line
    return printable(text.strip()).encode("ascii", "replace").decode()[:MAX_NAME].strip()


def _check(line: str, where: str) -> None:
    """Refuse (InputError) a line of the wrong length, with a wrong checksum, or without its numbers."""
    if len(line) != LINE_LENGTH or not line.isascii():
        raise InputError(f"{where}: {len(line)} characters, where an element line has {LINE_LENGTH}; {ADVICE}")
    total = sum(map(DIGIT_SUM.__getitem__, line[:-1].encode())) % 10
    if str(total) != line[-1]:
        raise InputError(f"{where}: its digits add up to {total}, not {line[-1]}: a damaged line; take the list anew")
    for what, (begin, end) in NUMBERS[line[0]].items():
        part = line[begin:end].strip()
        if not part.lstrip("+-").replace(".", "", 1).isdigit():
            raise InputError(f"{where}: columns {begin + 1} to {end}, its {what}, read {part!r}; write a number")
