"""Lists of element sets as people have them, and what is wrong in some."""

from __future__ import annotations

import pytest

from hilstar.errors import InputError
from hilstar.sky.bodies.satellites import read_satellites
from tests.support.satellites import element_set, with_checksum
from tests.support.skies import STATION_TLE, STATION_UTC, utc_ns

UTC_NS = utc_ns(STATION_UTC)
NAME, FIRST, SECOND = STATION_TLE.splitlines()
ONE, OTHER = (element_set(number, (51.6, 0.0, 0.0, 0.0), 0.001, 15.5) for number in (10, 11))


def names_of(text: str) -> list[str]:
    return [one.name for one in read_satellites(text, "tles.txt", UTC_NS)]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (STATION_TLE, ["ISS (ZARYA)"]),
        (STATION_TLE.replace("\n", "\r\n"), ["ISS (ZARYA)"]),
        (f"0 {STATION_TLE}", ["ISS (ZARYA)"]),
        (f"{FIRST}   \n{SECOND}\n", ["NORAD 25544"]),
        (f"# taken today\n\n{NAME}\n\n{FIRST}\n# its second\n{SECOND}", ["ISS (ZARYA)"]),
        (f"{ONE}{STATION_TLE}", ["NORAD 10", "ISS (ZARYA)"]),
        (f"DEB\n{ONE}DEB\n{OTHER}", ["DEB 10", "DEB 11"]),
        (f"MÜLL\t1\n{ONE}", ["M?LL\\x091"]),
    ],
)
def test_lists_with_names_or_without_are_read(text, names):
    assert names_of(text) == names


def test_of_several_sets_of_one_the_nearest_in_time_counts():
    later = with_checksum(FIRST[:18] + "08265.51782528" + FIRST[32:68])
    latest = with_checksum(FIRST[:18] + "08275.51782528" + FIRST[32:68])
    text = f"A\n{latest}\n{SECOND}\nB\n{FIRST}\n{SECOND}\nC\n{later}\n{SECOND}\n"
    assert names_of(text) == ["B"]
    assert [one.name for one in read_satellites(text, "f", UTC_NS + 9 * 86_400 * 10**9)] == ["A"]


def test_a_number_beyond_99999_is_one_with_a_letter():
    first, second = (with_checksum(f"{line[:2]}A0001{line[7:68]}") for line in (FIRST, SECOND))
    assert [one.number for one in read_satellites(f"{first}\n{second}\n", "f", UTC_NS)] == [100_001]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"tles\.txt: no element set"),
        ("# nothing\n\n", r"tles\.txt: no element set"),
        (f"{NAME}\n{FIRST[:-1]}{(int(FIRST[-1]) + 1) % 10}\n{SECOND}\n", r"tles\.txt:2: its digits add up to 7, not 8"),
        (f"{FIRST}\n{SECOND[:-1]}\n", r"tles\.txt:2: 68 characters, where an element line has 69"),
        (f"{FIRST}\n{NAME}\n{SECOND}\n", r"tles\.txt:2: element line 2 is missing after line 1"),
        (f"{NAME}\n{SECOND}\n", r"tles\.txt:2: element line 1 is missing"),
        (f"{NAME}\n{FIRST}\n", r"tles\.txt: it ends within"),
        (f"{ONE}{NAME}\n", r"tles\.txt: it ends within"),
        ("a\nb\n" + ONE, r"tles\.txt:2: two lines in a row"),
        (f"{FIRST}\n{ONE.splitlines()[1]}\n", r"tles\.txt:2: it is of satellite 00010, line 1 of 25544"),
        (
            f"{FIRST}\n{with_checksum(SECOND[:8] + ' nearly ' + SECOND[16:68])}\n",
            r"tles\.txt:2: columns 9 to 16, its inclin.*'nearly'",
        ),
        ("norad,standard_mag\n25544,-1.8\n", r"tles\.txt:2: two lines in a row"),
    ],
)
def test_a_wrong_line_is_named(text, said):
    with pytest.raises(InputError, match=said):
        read_satellites(text, "tles.txt", UTC_NS)
