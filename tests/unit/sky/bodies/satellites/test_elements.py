"""Lists of element sets as people have them, and what is wrong in some."""

from __future__ import annotations

import json

import pytest

from hilstar.basics.errors import InputError
from hilstar.sky.bodies.orbit import TleOrbit
from hilstar.sky.bodies.satellites import read_satellites
from tests.support.satellites import element_set, with_checksum
from tests.support.skies import STATION_TLE, STATION_UTC, utc_ns

UTC_NS = utc_ns(STATION_UTC)
NAME, FIRST, SECOND = STATION_TLE.splitlines()
ONE, OTHER, THIRD = (
    element_set(number, (51.6, 0.0, 0.0, 0.0), 0.001, 15.5) for number in (10, 11, 12)
)
DEBRIS = ["DEB 10", "DEB 11", "DEB 12"]
# The columns of numbers, counted from 1, by CelesTrak's definition of the two-line format.
NUMBER_COLUMNS = {
    "1": ((19, 20), (21, 32), (34, 43)),
    "2": ((9, 16), (18, 25), (27, 33), (35, 42), (44, 51), (53, 63)),
}


def satellite_names(text: str) -> list[str]:
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
        (f"DEB\n{ONE}DEB\n{OTHER}DEB\n{THIRD}{STATION_TLE}", [*DEBRIS, "ISS (ZARYA)"]),
        (f"{'LONG ' * 6}\n{ONE}", ["LONG LONG LONG LONG LONG"[:24]]),
        (f"MÜLL\t1\n{ONE}", ["M?LL\\x091"]),
    ],
)
def test_lists_with_names_or_without_are_read(text, names):
    assert satellite_names(text) == names


def test_of_several_sets_of_one_the_nearest_in_time_counts():
    later = with_checksum(FIRST[:18] + "08265.51782528" + FIRST[32:68])
    latest = with_checksum(FIRST[:18] + "08275.51782528" + FIRST[32:68])
    text = f"A\n{latest}\n{SECOND}\nB\n{FIRST}\n{SECOND}\nC\n{later}\n{SECOND}\n"
    assert satellite_names(text) == ["B"]
    assert [one.name for one in read_satellites(text, "f", UTC_NS + 9 * 86_400 * 10**9)] == ["A"]
    # of two of one epoch the first
    assert satellite_names(f"A\n{FIRST}\n{SECOND}\nB\n{FIRST}\n{SECOND}\n") == ["A"]


@pytest.mark.parametrize(
    ("line", "first", "last"),
    [(line, *columns) for line, places in NUMBER_COLUMNS.items() for columns in places],
)
def test_each_number_of_an_element_line_is_looked_at(line, first, last):
    """A letter instead of its last digit, in a line whose digits add up all the same."""
    lines = [FIRST, SECOND]
    damaged = lines[int(line) - 1][:68]
    lines[int(line) - 1] = with_checksum(f"{damaged[: last - 1]}x{damaged[last:]}")
    with pytest.raises(InputError, match=rf":{line}: columns {first} to {last}, its .*x'; write a"):
        read_satellites("\n".join(lines), "tles.txt", UTC_NS)


def test_a_number_beyond_99999_is_one_with_a_letter():
    first, second = (with_checksum(f"{line[:2]}A0001{line[7:68]}") for line in (FIRST, SECOND))
    assert [one.number for one in read_satellites(f"{first}\n{second}\n", "f", UTC_NS)] == [100_001]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"tles\.txt: no element set"),
        ("# nothing\n\n", r"tles\.txt: no element set"),
        (
            f"{NAME}\n{FIRST[:-1]}{(int(FIRST[-1]) + 1) % 10}\n{SECOND}\n",
            r"tles\.txt:2: its digits add up to 7, not 8",
        ),
        (f"{FIRST}\n{SECOND[:-1]}\n", r"tles\.txt:2: 68 characters, where an element line has 69"),
        (f"{FIRST[:8]}\0{FIRST[9:]}\n{SECOND}\n", r"tles\.txt:1: it has a control character"),
        (
            '<?xml version="1.0" encoding="UTF-08"?><ndm><omm></omm></ndm>',
            r"tles\.txt: is no OMM that can be read \(unknown encoding: UTF-08\)",
        ),
        (
            '<?xml version="1.0"?><!DOCTYPE ndm [<!ENTITY a "a">]><ndm><omm></omm></ndm>',
            r"tles\.txt: has a DOCTYPE, which no OMM has",
        ),
        (f"{FIRST}\n{NAME}\n{SECOND}\n", r"tles\.txt:2: element line 2 is missing after line 1"),
        (f"{NAME}\n{SECOND}\n", r"tles\.txt:2: element line 1 is missing"),
        (f"{NAME}\n{FIRST}\n", r"tles\.txt: it ends within"),
        (f"{ONE}{NAME}\n", r"tles\.txt: it ends within"),
        ("a\nb\n" + ONE, r"tles\.txt:2: two lines in a row"),
        (
            f"{FIRST}\n{ONE.splitlines()[1]}\n",
            r"tles\.txt:2: it is of satellite 00010, line 1 of 25544",
        ),
        (
            f"{ONE.splitlines()[0]}\n{OTHER.splitlines()[1]}\n",
            r"tles\.txt:2: it is of satellite 00011, line 1 of 00010",
        ),
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


# One set in each form of an OMM: sgp4's own reader of each is the authority for what it means.
FIELDS = {
    "OBJECT_NAME": "ISS (ZARYA)",
    "OBJECT_ID": "1998-067A",
    "EPOCH": "2008-09-20T12:25:40.104192",
    "MEAN_MOTION": 15.72125391,
    "ECCENTRICITY": 0.0006703,
    "INCLINATION": 51.6416,
    "RA_OF_ASC_NODE": 247.4627,
    "ARG_OF_PERICENTER": 130.5360,
    "MEAN_ANOMALY": 325.0288,
    "EPHEMERIS_TYPE": 0,
    "CLASSIFICATION_TYPE": "U",
    "NORAD_CAT_ID": 25544,
    "ELEMENT_SET_NO": 292,
    "REV_AT_EPOCH": 56353,
    "BSTAR": -0.11606e-4,
    "MEAN_MOTION_DOT": -0.2182e-4,
    "MEAN_MOTION_DDOT": 0,
}
MEAN = (
    "EPOCH",
    "MEAN_MOTION",
    "ECCENTRICITY",
    "INCLINATION",
    "RA_OF_ASC_NODE",
    "ARG_OF_PERICENTER",
    "MEAN_ANOMALY",
)
META = {
    "CENTER_NAME": "EARTH",
    "REF_FRAME": "TEME",
    "TIME_SYSTEM": "UTC",
    "MEAN_ELEMENT_THEORY": "SGP4",
}
SAME_KM = 1e-3  # sgp4 rounds an OMM's epoch to a microsecond, in which a low orbit goes 8 mm


def json_omm(fields):
    return json.dumps([fields], indent=1)


def as_text_json(fields):
    """As Space-Track writes it: every value is text."""
    return json.dumps([{key: str(value) for key, value in (META | fields).items()}])


def as_csv(fields):
    return ",".join(fields) + "\n" + ",".join(map(str, fields.values())) + "\n"


def as_xml(fields):
    parts = {"metadata": ["OBJECT_NAME", "OBJECT_ID"], "meanElements": MEAN}
    named = {name for names in parts.values() for name in names}
    parts["tleParameters"] = [name for name in fields if name not in named]
    inner = {
        part: "".join(f"<{name}>{fields[name]}</{name}>" for name in names if name in fields)
        for part, names in parts.items()
    }
    data = "".join(f"<{part}>{inner[part]}</{part}>" for part in ("meanElements", "tleParameters"))
    segment = f"<segment><metadata>{inner['metadata']}</metadata><data>{data}</data></segment>"
    return (
        '<?xml version="1.0"?><ndm><omm id="CCSDS_OMM_VERS"'
        f' version="2.0"><body>{segment}</body></omm></ndm>'
    )


def as_kvn(fields):
    """With the units that a KVN may state behind its figures."""
    units = {"MEAN_MOTION": " [rev/day]", "INCLINATION": " [deg]", "BSTAR": " [1/ER]"}
    lines = [f"{key} = {value}{units.get(key, '')}" for key, value in (META | fields).items()]
    return "\n".join(["CCSDS_OMM_VERS = 2.0", "COMMENT a set = of elements", *lines, ""])


FORMS = [json_omm, as_text_json, as_csv, as_xml, as_kvn]


@pytest.mark.parametrize("form", FORMS)
def test_an_omm_is_the_satellite_of_its_two_lines(form):
    (wanted,) = read_satellites(STATION_TLE, "tles.txt", UTC_NS)
    (found,) = read_satellites(form(FIELDS), "omm", UTC_NS)
    assert (found.name, found.number) == (wanted.name, wanted.number)
    assert found.age_days(UTC_NS) == pytest.approx(wanted.age_days(UTC_NS), abs=1e-9)
    for minutes in (0, 90, 1440):
        jd = wanted.satrec.jdsatepoch, wanted.satrec.jdsatepochF + minutes / 1440
        error, place_km, _ = found.satrec.sgp4(*jd)
        assert error == 0
        assert place_km == pytest.approx(wanted.satrec.sgp4(*jd)[1], abs=SAME_KM)
    orbit = TleOrbit(form(FIELDS), "omm")
    assert orbit.number == 25544
    assert orbit.state(UTC_NS)[0] == pytest.approx(
        TleOrbit(STATION_TLE, "tle").state(UTC_NS)[0], abs=SAME_KM
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"EPHEMERIS_TYPE": 4}, "EPHEMERIS_TYPE is 4, and only 0 is read"),
        ({"MEAN_MOTION": "fast"}, "MEAN_MOTION is fast; it must be from 0.001 to 20"),
        ({"ECCENTRICITY": 1.5}, "ECCENTRICITY is 1.5; it must be from 0"),
        ({"INCLINATION": "nan"}, "INCLINATION is nan; it must be from 0 to 180"),
        ({"EPOCH": "2008-09-31T00:00:00"}, "element set 1: .*day"),
        ({"EPOCH": ""}, "EPOCH is missing"),
        ({"NORAD_CAT_ID": "-7"}, "NORAD_CAT_ID is -7; write a catalogue number"),
        (
            {"NORAD_CAT_ID": 1_000_000_000},
            "NORAD_CAT_ID is 1000000000; write a catalogue number, such as 25544",
        ),
    ],
)
def test_an_element_that_sgp4_would_take_otherwise_is_refused_by_name(form, change, said):
    with pytest.raises(InputError, match=f"omm: element set 1.*{said}|omm: {said}"):
        read_satellites(form(FIELDS | change), "omm", UTC_NS)


@pytest.mark.parametrize(
    ("key", "value"),
    [("REF_FRAME", "EME2000"), ("MEAN_ELEMENT_THEORY", "SGP4-XP"), ("CENTER_NAME", "MOON")],
)
def test_another_theory_or_frame_is_refused_by_name(key, value):
    with pytest.raises(InputError, match=f"{key} is {value}, and only "):
        read_satellites(
            as_kvn(FIELDS).replace(f"{key} = {META[key]}", f"{key} = {value}"), "omm", UTC_NS
        )


def test_what_writers_leave_out_and_numbers_of_nine_digits_are_read():
    few = {name: FIELDS[name] for name in (*MEAN, "OBJECT_NAME", "BSTAR")}
    few |= {"NORAD_CAT_ID": 799_500_123, "EPOCH": "2008-09-20T12:25:40Z"}
    (found,) = read_satellites(json_omm(few), "omm", UTC_NS)
    assert found.number == 799_500_123


@pytest.mark.parametrize(
    "text",
    [
        "[",
        "{}",
        "[1]",
        '<omm id="x">',
        "<!DOCTYPE a><omm/>",
        "EPOCH,MEAN_MOTION\n1,2\n",
        "[" * 10_000,
    ],
)
def test_what_is_no_omm_is_refused_in_one_line(text):
    with pytest.raises(InputError, match=r"^omm: (?!.*\n)"):
        read_satellites(text, "omm", UTC_NS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (json.dumps([FIELDS, 3]), "element set 2 is no JSON object"),
        (json.dumps([FIELDS, FIELDS | {"OBJECT_NAME": "X"} | {"EPOCH": ""}]), r"2 \(X\): EPOCH is"),
        (as_kvn(FIELDS) + as_kvn(FIELDS | {"BSTAR": "b"}), r"element set 2 \(ISS.*: BSTAR is b;"),
    ],
)
def test_the_wrong_one_of_several_sets_is_named_by_its_number(text, said):
    with pytest.raises(InputError, match=said):
        read_satellites(text, "omm", UTC_NS)


def test_a_header_in_small_letters_is_told_what_it_lacks():
    header, rows = as_csv(FIELDS).split("\n", 1)
    with pytest.raises(InputError, match="omm: element set 1: EPOCH is missing"):
        read_satellites(f"{header.lower()}\n{rows}", "omm", UTC_NS)


def test_an_orbit_is_one_element_set():
    with pytest.raises(InputError, match="omm: has 2 element sets, and an orbit is one"):
        TleOrbit(json.dumps([FIELDS, FIELDS]), "omm")
