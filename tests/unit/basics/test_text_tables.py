"""Text tables: every dialect reads the same, units are taken as stated, and what is not plain is
refused or said.
"""

from __future__ import annotations

import itertools
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from hilstar.basics.text_tables import (
    Chosen,
    finite_numbers,
    is_no_number,
    open_table,
    read_rows,
    seconds_of_date,
    table_of,
)
from hilstar.basics.units import DIMENSIONS, factor, plain_unit
from tests.support.refusals import refusal

LIMIT = 1_000_000
COLUMNS = ("t_s", "x_px")


def read_table_rows(path, columns=COLUMNS, more=(), **options):
    return list(read_rows(path, columns, "write a table", LIMIT, more, **options))


def numbers(path, columns=COLUMNS):
    return [[float(cell) for cell in cells] for _, cells in read_table_rows(path, columns)]


@pytest.fixture
def table_file(tmp_path):
    def write(text, encoding="utf-8"):
        path = tmp_path / "table.txt"
        path.write_bytes(text.encode(encoding))
        return path

    return write


@pytest.fixture(autouse=True)
def warnings_anew():
    warn_once.cache_clear()


DELIMITERS = (",", ";", "\t", "|", "  ")
HEADERS = ("plain", "comment", "units line", "vizier", "brackets")
ENDS = ("\n", "\r\n")
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252")
COMMENTS = ("# by a program", "% by", "! by", "// by, it", '"# by, it"', "; by a program")


def in_dialect(values, delimiter, header, end, decimal):
    """A table of t in ms and x in pixels, with a text beside them that is not ASCII."""
    number = [[f"{value:.4f}".replace(".", decimal) for value in row] for row in values]
    lines = [delimiter.join((*row, "étoile")) for row in number]
    plain = delimiter.join(("t_ms", "x_px", "note"))
    named = delimiter.join(("t", "x", "note"))
    heads = {
        "plain": [plain],
        "comment": ["# made by a program", f"# {plain}"],
        "units line": [named, delimiter.join(("ms", "pixel", "-"))],
        "vizier": [
            "#Column t",
            "",
            named,
            delimiter.join(("ms", "pix", "---")),
            delimiter.join(("-----", "---", "----")),
        ],
        "brackets": [delimiter.join(("t[ms]", "x(px)", "note"))],
    }
    return end.join([*heads[header], *lines[:2], "", *lines[2:], ""])


@pytest.mark.parametrize("delimiter", DELIMITERS)
@pytest.mark.parametrize("header", HEADERS)
def test_a_table_reads_the_same_in_every_dialect(table_file, delimiter, header):
    values = np.random.default_rng(5).uniform(-1000, 1000, (7, 2)).round(4)
    wanted = values * (1e-3, 1.0)
    for end, encoding, decimal in itertools.product(ENDS, ENCODINGS, ".,"):
        if decimal == delimiter:
            continue
        path = table_file(in_dialect(values, delimiter, header, end, decimal), encoding)
        assert np.allclose(numbers(path), wanted, rtol=1e-15, atol=0), (end, encoding, decimal)


def test_what_was_taken_is_said_once(table_file, caplog):
    path = table_file("t_ms;x_px;note\n1,5;2,5;été\n2,5;3,5;x\n", "cp1252")
    assert numbers(path) == [[0.0015, 2.5], [0.0025, 3.5]]
    read_table_rows(path)
    lines = [record.getMessage().removeprefix(f"{path}: ") for record in caplog.records]
    assert lines == [
        "line 2 is not UTF-8, and is read as Windows-1252; save the file as UTF-8",
        "numbers such as 1,5 are read with a decimal comma",
        "column t_ms is in ms: its numbers are multiplied by 0.001, to be in s",
    ]


def test_excel_and_programs_write_tables_of_their_own(table_file):
    assert numbers(table_file("sep=;\nt_s;x_px\n1;2\n")) == [[1, 2]]
    assert numbers(table_file(";t_s;x_px\n0;1;2\n1;3;4\n")) == [[1, 2], [3, 4]]  # pandas' index
    assert numbers(table_file("t_s,x_px,\n1,2\n3,4\n")) == [[1, 2], [3, 4]]
    assert numbers(table_file("t_s,x_px\n1,2,\n3,4, \n")) == [[1, 2], [3, 4]]
    assert numbers(table_file("x_px,t_s\n−1,\u00a02\n")) == [[2, -1]]
    assert numbers(table_file('"t_s","x_px"\n"1","2"\n')) == [[1, 2]]
    assert numbers(table_file("# t x_px\n% t_s, x_px\n1,2\n")) == [[1, 2]]
    assert numbers(table_file("T_S,Time,x_px\n1,9,2\n")) == [[1, 2]]


def test_lines_are_those_of_the_file(table_file):
    path = table_file("# a\n\nt_s,x_px\n1,2\n\n# between\n3,4\n")
    assert [line for line, _ in read_table_rows(path)] == [4, 7]


REFUSED = {
    "t_s,x_px,t_s\n1,2,3\n": ":1: column t_s is there twice",
    "t_ms,t_us,x_px\n1,2,3\n": ":1: column t_s is there twice (t_ms, t_us)",
    "t,x_px\n1,2\n": ":1: column t has no unit; write t_s, or its unit as t [s]",
    "t [deg],x_px\n1,2\n": ":1: column t [deg] is in 'deg', and s is wanted",
    "t_s [ms],x_px\n1,2\n": ":1: column t_s [ms] states two units",
    "u,x_px\n1,2\n": ":1: column t_s is missing (its columns are u, x_px)",
    "t_s,x_px\n1,2\n3\n": ":3: 1 cells and 2 columns; write a table",
    "t_s,x_px\n1,2\n3,4,5\n": (
        ":3: 3 cells and 2 columns (a decimal comma, or commas between thousands? write 1234.5)"
    ),
    "t_s,x_px\n1,2\n3,4,5,6\n": ":3: 4 cells and 2 columns (a decimal comma? write points)",
    "t_s;x_px\n1,234;2,345\n": (
        "'1,234' is a decimal comma, or a comma between thousands? write 1234.5"
    ),
    "t_s;x_px\n1,23;2.345\n": (
        "'1,23' is a decimal comma, or a comma between thousands? write 1234.5"
    ),
    't_s,x_px\n1,"2\n': "not CSV",
    "1,2\n3,4\n": ":1: column t_s is missing",
    "t_s,x_px\n1,\x00\xff\n": "it is no text: line 2 has a byte 0x00",
    "," * 2000 + "\n": "its first line names more than 1000 columns",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_not_plain_is_refused_with_its_line(table_file, text):
    path = table_file(text, "latin-1")
    line = refusal(read_table_rows, path)
    assert REFUSED[text] in line
    assert line.startswith(str(path))


CUT_ENDS = {
    # the last line as it was cut off: whether it is read
    "1.5,0.0362700": True,
    "1.5,0.036": False,
    "1.5,0.": False,
    "1.5": False,
    "1.": False,
}


@pytest.mark.parametrize("last", CUT_ENDS)
def test_a_last_line_without_an_end_is_left_out_where_it_may_be_cut(table_file, last, caplog):
    path = table_file(f"t_s,x_px\n0.5,0.1234567\n1.0,0.2345678\n{last}")
    read = read_table_rows(path, keep_cut=False)
    assert len(read) == 2 + CUT_ENDS[last]
    assert ("the last line has no line end" in caplog.text) is not CUT_ENDS[last]


def test_whole_numbers_and_sharp_ones_at_the_end_are_known_to_be_whole(table_file):
    for others, last, whole in (
        (("57", "58"), "59", True),
        (("57", "58"), "5", False),
        (("9", "58"), "7", False),
        (("58", "9"), "70", True),
        (("0.12345678901234567", "0.1234567890123456"), "0.123456789012", True),
        (("1.5e-05", "1.5e-05"), "1.5e-0", False),
        (("1.5e-05", "1.5e-05"), "1.512345678901", False),
        (("yes", "no"), "yes", True),
        (("yes", "no"), "ye", False),
        # the row before, of a table of more rows than are looked at first
        (("1",) * 120 + ("100",), "10", False),
        (("1",) * 120 + ("100",), "101", True),
    ):
        text = "".join(f"1,{other}\n" for other in others)
        assert (
            len(read_table_rows(table_file(f"t_s,x_px\n{text}2,{last}"), keep_cut=False))
            == len(others) + whole
        ), last


def test_a_document_cut_off_is_read_and_said(table_file, caplog):
    path = table_file("t_s,x_px\n1,0.25\n2,0.35\n3,0.4")
    assert len(read_table_rows(path)) == 3
    assert (
        f"{path}:4: the last line has no line end, and may be cut off: is the file whole?"
        in caplog.text
    )


def test_rows_that_do_not_hold_are_told_by_any_name(table_file):
    for header, flags in (
        ("valid", "10"),
        ("is_valid", "TF"),
        ("Valid", "yn"),
        ("lost", "01"),
        ("invalid", ("false", "true")),
    ):
        path = table_file(f"t_s,{header}\n1,{flags[0]}\n2,{flags[1]}\n")
        cells = [cells[1].lower() for _, cells in read_table_rows(path, ("t_s",), ("valid",))]
        assert [cell in {"1", "t", "y"} for cell in cells] == [True, False]


@pytest.mark.parametrize("header", ["valid", "lost"])
def test_a_blank_flag_says_nothing_of_its_row_whatever_its_column_tells(table_file, header):
    path = table_file(f"t_s,{header},n\n1,1,0\n2,,0\n3,0,0\n")
    flags = [cells[1] for _, cells in read_table_rows(path, ("t_s",), ("valid",))]
    assert flags == (["1", "", "0"] if header == "valid" else ["0", "", "1"])


def test_columns_know_their_names_and_units(table_file):
    with open_table(
        table_file('ra (h),RA(ICRS),"flux [DN]",pmRA\nh,deg,DN,mas/yr\n1,2,3,4\n'), "", LIMIT
    ) as opened:
        assert [(column.name, column.unit) for column in opened.columns] == [
            ("ra", "h"),
            ("RA(ICRS)", "deg"),
            ("flux", "DN"),
            ("pmRA", "mas/yr"),
        ]


def test_a_column_without_a_unit_beside_one_with_it_is_another_quantity_where_units_are_stated(
    table_file,
):
    """Where none has to be, either of them may be meant."""
    with open_table(table_file("wavelength,wavelength_um\n1,2\n"), "", LIMIT) as opened:
        chosen = opened.chosen("wavelength_nm")
        assert (chosen.place, float(opened.cell(["1", "2"], chosen))) == (1, 2000.0)
        line = refusal(opened.chosen, "wavelength_nm", must_state=False)
        assert "wavelength_nm" in line


@pytest.mark.parametrize(
    ("unit", "wanted", "size"),
    [
        ("ms", "s", 1e-3),
        ("µs", "s", 1e-6),
        ("Å", "nm", 0.1),
        ("Angstroms", "nm", 0.1),
        ("um", "nm", 1e3),
        ("°/s", "rad/s", np.pi / 180),
        ("deg per s", "rad/s", np.pi / 180),
        ("hours", "deg", 15),
        ('"/yr', "mas/yr", 1e3),
        ("%", "1", 0.01),
        ("ns", "ns", 1),
    ],
)
def test_units_as_people_spell_them(unit, wanted, size):
    assert float(factor(unit, wanted)) == pytest.approx(size, rel=1e-15)


# in the first unit of each kind: the SI brochure's definitions, a Julian year apart, which is in both
SIZES = {
    **{"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60, "h": 3600, "d": 86_400},
    **{"nm": 1, "a": 0.1, "um": 1e3, "mm": 1e6, "cm": 1e7, "m": 1e9},
    **{"deg": 1, "hourangle": 15, "rad": 180 / np.pi, "arcmin": 1 / 60, "arcsec": 1 / 3600},
    **{"mas": 1 / 3.6e6, "uas": 1 / 3.6e9},
    **{"rad/s": 1, "mrad/s": 1e-3, "urad/s": 1e-6, "rad/ms": 1e3, "rpm": 2 * np.pi / 60},
    **{"deg/s": np.pi / 180, "mdeg/s": np.pi / 180e3, "deg/min": np.pi / 180 / 60},
    **{"deg/h": np.pi / 180 / 3600, "arcmin/s": np.pi / 180 / 60},
    "arcsec/s": np.pi / 180 / 3600,
    **{"mas/yr": 1, "uas/yr": 1e-3, "arcsec/yr": 1e3, "arcmin/yr": 6e4, "deg/yr": 3.6e6},
    **{"1": 1, "%": 1e-2, "permille": 1e-3, "px": 1, "mag": 1, "mmag": 1e-3},
}


def test_every_unit_has_its_size_by_the_si():
    """Each spelling of a unit has the same one."""
    seen = set()
    for dimension in DIMENSIONS:
        first = next(iter(dimension)).split()[0]
        for spellings in dimension:
            (name,) = [
                name
                for name in spellings.split()
                if name in SIZES and (first, name) != ("deg", "h")
            ]
            seen.add(name)
            for spelling in spellings.split():
                assert float(factor(spelling, first)) == pytest.approx(SIZES[name], rel=1e-14)
    assert seen == SIZES.keys()


def test_units_of_another_kind_have_no_factor():
    assert factor("deg", "s") is None
    assert factor("furlong", "nm") is None
    assert plain_unit("e⁻/s") == "e-/s"


PLAIN = "t_s,x_px\n0.5,10.25\n1.5,11.25\n"
SAME = [[0.5, 10.25], [1.5, 11.25]]


@pytest.mark.parametrize("comment", COMMENTS)
def test_comments_of_every_style_are_passed_over(table_file, comment):
    assert numbers(table_file(f"{comment}\n{PLAIN}")) == SAME


@pytest.mark.parametrize("comment", COMMENTS[:-1])  # within a table of semicolons ; is a cell
def test_comments_between_rows_are_passed_over(table_file, comment):
    assert numbers(table_file(PLAIN.replace("1.5", f"{comment}\n1.5"))) == SAME


@pytest.mark.parametrize(
    ("comment", "names"),
    [("# t_s x_px", ["t_s", "x_px"]), ("# 9.5 8.25", ["", ""]), ("# t_s 8.25", ["", ""])],
)
def test_a_comment_names_the_columns_below_it_unless_it_has_numbers(table_file, comment, names):
    """Such a comment is a row that somebody left out."""
    path = table_file(f"{comment}\n0.5 10.25\n1.5 11.25\n")
    with open_table(path, "write a table", LIMIT) as table:
        assert [column.header for column in table.columns] == names
        assert table.header == table.commented == any(names)


# What stands around a table, and what is said of it.
SURROUNDINGS = {
    "title": (f"Log of today\n\n{PLAIN}", "2 lines above"),
    "values above": (f"Date,2024-01-01,10:00\nRate\n{PLAIN}", "2 lines above"),
    "title above words": (
        "A list of today\nx_px,t_s,name\n10.25,0.5,a\n11.25,1.5,b\n",
        "line above",
    ),
    "comments behind": (f"{PLAIN}# the end\n% of it\n", ""),
    "numbers of rows": ('t_s,x_px\n"1",0.5,10.25\n"2",1.5,11.25\n"3",2.5,12.25\n', "its number"),
    "units in square brackets": ("t,x\n[s],[px]\n0.5,10.25\n1.5,11.25\n", ""),
    "units in round ones": ("t,x\n(s),(px)\n0.5,10.25\n1.5,11.25\n", ""),
    "a unit and none": ("t_s,x_px\n[s],[]\n0.5,10.25\n1.5,11.25\n", ""),
}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_what_stands_around_a_table_is_told_apart_from_it(table_file, name, caplog):
    text, words = SURROUNDINGS[name]
    assert numbers(table_file(text))[:2] == SAME
    assert words in caplog.text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (PLAIN + PLAIN, r":4: the header stands here again"),
        ("t_s,x_px,x_px.1\n0.5,1,2\n", r":1: column x_px is there twice \(x_px, x_px.1\)"),
        ("time,x_px\nnoon,1\n", r":1: column time has 'noon', which is no time"),
        ("t_s,x\n0,wide\n", r":1: column x has 'wide', which is no number px"),
    ],
)
def test_what_other_programs_make_of_a_table_is_refused_by_name(table_file, text, words):
    with pytest.raises(InputError, match=words):
        read_table_rows(table_file(text))


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("2008-09-20T12:25:40.104192", "2008-09-20T12:25:40.104192"),
        ("2008-264T12:25:40.104192Z", "2008-09-20T12:25:40.104192"),
        ("2008-001 00:00:00", "2008-01-01T00:00:00"),
        ("2008-366T23:59:59.", "2008-12-31T23:59:59"),
        ("1969:365T23:59:58", "1969-12-31T23:59:58"),
        ("2026/032:06:07:08 UTC", "2026-02-01T06:07:08"),
        ("2026-03-01T00:30:00+02:00", "2026-02-28T22:30:00"),
        ("2026-02-28T22:30:00-0330", "2026-03-01T02:00:00"),
    ],
)
def test_a_date_is_seconds_since_1970_with_its_digits(text, moment):
    wanted_ns = int(np.datetime64(moment, "ns").astype(np.int64))
    assert Decimal(seconds_of_date(text)) * 10**9 == wanted_ns


@pytest.mark.parametrize(
    "text", ["2007-366T00:00:00", "2008-000T00:00:00", "2008-02-30T00:00:00", "2008-01-01T24:00:00"]
)
def test_what_is_no_date_stays_as_it_is(text):
    assert seconds_of_date(text) == text


NO_NUMBER = (
    *("", " ", "-", "--", "---", "?", "*", ".", "NaN", "-NAN", "+nan", "nan(ind)", "-nan(ind)"),
    *("1.#QNAN", "-1.#QNAN", "1.#IND", "-1.#IND", "NA", "N/A", "#N/A", "<NA>", "NULL", "<null>"),
    *("(null)", "nil", "None", "NaT", "\\N", "missing", "undefined"),
)


@pytest.mark.parametrize("text", NO_NUMBER)
def test_what_programs_write_for_no_number_is_none(text):
    """pandas, R, MATLAB, Visual C++, Excel, MySQL, VizieR and others."""
    assert is_no_number(text)


@pytest.mark.parametrize("text", ["0", "-0", "----", "n", "nan1", "ok", "- -"])
def test_what_is_a_number_or_a_word_is_not_called_none(text):
    assert not is_no_number(text)


def opened(text):
    return table_of(Path("table.csv"), "write a table", iter(text.splitlines(keepends=True)))


@pytest.mark.parametrize(("count", "shown"), [(12, 12), (13, 12), (30, 12)])
def test_a_message_names_twelve_columns_at_most(count, shown):
    names = [f"c{k}" for k in range(count)]
    table = opened(",".join(names) + "\n" + ",".join("1" * count) + "\n")
    assert table.names == ", ".join(names[:shown]) + (", ..." if count > shown else "")
    table.not_used([Chosen(0)])
    assert table.notices == [f"not used: {', '.join(names[1 : 1 + 12])}"]


@pytest.mark.parametrize(("count", "is_taken"), [(1000, True), (1001, False)])
def test_a_table_has_a_thousand_columns_at_most(count, is_taken):
    text = ",".join(f"c{k}" for k in range(count)) + "\n"
    if is_taken:
        assert len(opened(text).columns) == count
    else:
        assert refusal(opened, text).endswith("names more than 1000 columns; write a table")


def test_a_piece_of_a_table_ends_with_no_quoted_cell_open():
    """Pieces of 8 characters or more; each begins with the number of its first line."""
    lines = ["1,plain\n", '2,"of two\n', 'lines"\n', "3,b\n", "4,c\n", '5,"d"\n']
    table = opened("".join(["t_s,note\n", *lines]))
    pieces = list(table.blocks(8))
    assert [line for _, part in pieces for line in part] == lines
    assert [sum(line.count('"') for line in part) % 2 for _, part in pieces] == [0] * len(pieces)
    assert [number for number, _ in pieces] == [2, 3, 5, 7]


@pytest.mark.parametrize(
    ("text", "columns", "unit", "rows"),
    [
        ("t [s], roll angle [deg]\n1.5, 2.5\n2.5, 3.5\n", 2, "deg", 2),
        ('"# by a program, it"\nt_s,a [deg]\n1,2\n', 2, "deg", 1),
        ("t;a\ns;deg\n---;---\n1;2\n3;4\n", 2, "deg", 2),
        ("t_s;a [deg]\n---;---\n1;2\n3;4\n", 2, "deg", 2),
        ("t_s;a [deg]\n0,85;1,234\n1,5;2,5\n", 2, "deg", 2),
        ('t_s,a [deg]\n"1","2","3","x"\n'.replace(',"3","x"', ""), 2, "deg", 1),
        ("sep=;\nt_s;a [deg]\n1;2\n", 2, "deg", 1),
    ],
)
def test_a_head_says_the_columns_and_their_units_and_where_the_rows_begin(
    text, columns, unit, rows
):
    table = opened(text)
    assert (len(table.columns), table.columns[1].unit) == (columns, unit)
    assert not any("title" in notice for notice in table.notices)
    read = list(table.rows())
    last = len(text.splitlines())
    assert [line for line, _ in read] == list(range(last - rows + 1, last + 1))


@pytest.mark.parametrize(("first", "is_numbered"), [(0, True), (1, True), (2, False)])
def test_rows_that_begin_with_their_numbers_from_0_or_1_have_a_column_more(first, is_numbered):
    rows = "".join(f"{first + k},{5 * k},{k}.5\n" for k in range(4))
    table = opened("t_s,a\n" + rows)
    if is_numbered:
        assert [column.name for column in table.columns] == ["", "t_s", "a"]
        assert "each row begins with its number" in table.notices[0]
    else:
        assert "3 cells and 2 columns" in refusal(lambda: list(table.rows()))
    # numbers that do not follow each other are no rows' own
    apart = opened("t_s,a\n" + rows.replace(f"{first + 2},", "9,"))
    assert "3 cells and 2 columns" in refusal(lambda: list(apart.rows()))


def test_what_parts_the_cells_leaves_more_numbers_where_two_would_give_alike_rows():
    """Words with blanks between them are more cells, none of which is a number."""
    table = opened("kind of star,value\nred and big,5\nblue and small,7\n")
    assert [column.name for column in table.columns] == ["kind of star", "value"]
    assert [cells for _, cells in table.rows()] == [["red and big", "5"], ["blue and small", "7"]]


@pytest.mark.parametrize(
    ("cell", "why"),
    [
        ("1_000", ""),
        ("0,85", " (a decimal comma: write a point)"),
        ("1,234", " (thousands apart: write 1234.5)"),
        ("1.5D3", " (an exponent of D: write E)"),
        ("12,345,678.9", " (thousands apart: write 1234.5)"),
        ("inf", ""),
    ],
)
def test_a_cell_that_is_no_number_is_refused_with_what_to_write(cell, why):
    line = refusal(finite_numbers, Path("t.csv"), 7, ("t_s", "a"), ("1.5", cell), "write a table")
    assert line == f"t.csv:7: a = {cell!r} is not a finite number{why}; write a table"
