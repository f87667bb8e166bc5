"""JSON logs as programs write them: one object a line, indented, or one array on one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hilstar.attitude.logs.json_lines import JsonObjects
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.basics.errors import InputError
from hilstar.basics.reading import MAX_LINE_CHARACTERS
from tests.support.refusals import refusal

ROWS: list[dict[str, Any]] = [
    {"t_ns": k * 10**7, "q": [0.5, -0.5, 0.5, 0.5], "note": 'a } " { [ \\'} for k in range(4)
]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.json"


def lines(rows: list[dict[str, Any]]) -> str:
    return "".join(json.dumps(row) + "\n" for row in rows)


FORMS = {
    "lines": lines(ROWS),
    "lines with commas": lines(ROWS).replace("\n", ",\n"),
    "array": json.dumps(ROWS),
    "array with a line end": json.dumps(ROWS) + "\n",
    "array without blanks": json.dumps(ROWS, separators=(",", ":")),
    "array, an object a line": "[\n" + ",\n".join(map(json.dumps, ROWS)) + "\n]\n",
    "indented array": json.dumps(ROWS, indent=2),
    "indented array of Windows": json.dumps(ROWS, indent=2).replace("\n", "\r\n"),
    "indented objects": "\n".join(json.dumps(row, indent=1) for row in ROWS),
    "array with a byte order mark": "\ufeff" + json.dumps(ROWS),
    "array after blank lines": "\n \n" + json.dumps(ROWS),
}


@pytest.mark.parametrize("form", FORMS)
def test_json_is_read_however_its_objects_stand(path: Path, form: str) -> None:
    path.write_text(FORMS[form], newline="")
    log = open_log(path)
    assert [sample.t_ns for sample in log.samples] == [row["t_ns"] for row in ROWS]
    assert all(sample.q_icrs_to_cam.tolist() == ROWS[0]["q"] for sample in log.samples)
    assert not [kind for kind, _ in log.told if kind == "log-cut"]


def test_an_array_may_be_longer_than_any_line_of_a_table(path: Path) -> None:
    count = MAX_LINE_CHARACTERS // 50
    rows = [{"t_ns": k * 10**7, "q": [0.5, -0.5, 0.5, 0.5], "sequence": k} for k in range(count)]
    text = json.dumps(rows)
    assert len(text) > MAX_LINE_CHARACTERS
    path.write_text(text)
    assert [sample.sequence for sample in open_log(path).samples] == list(range(count))


@pytest.mark.parametrize(
    ("form", "places"),
    [
        ("array", [":1, object 1", ":1, object 2", ":1, object 3", ":1, object 4"]),
        ("lines with commas", [":1", ":2", ":3", ":4"]),
        ("indented array", [":2, object 1", ":12, object 2", ":22, object 3", ":32, object 4"]),
    ],
)
def test_objects_and_their_places_are_the_same_wherever_a_piece_of_a_line_ends(
    form: str, places: list[str]
) -> None:
    """A note has braces, quotes and a backslash, so that a piece may end before any of them."""
    for size in (*range(1, 60), 1000):
        pieces = []
        for line in FORMS[form].splitlines(keepends=True):
            pieces += [line[begin : begin + size] for begin in range(0, len(line), size)]
        objects = list(JsonObjects().split(pieces))
        assert [json.loads(text) for _, text in objects] == ROWS
        assert [place for place, _ in objects] == places


def test_a_line_of_no_object_is_one_text_wherever_its_pieces_end() -> None:
    """It is refused once, with its line."""
    lines = ["attitude: none yet\n", '{"t_ns": 1}\n']
    for size in (*range(1, 20), 1000):
        pieces = []
        for line in lines:
            pieces += [line[begin : begin + size] for begin in range(0, len(line), size)]
        found = list(JsonObjects().split(pieces))
        assert found == [(":1", "attitude: none yet"), (":2", '{"t_ns": 1}')]


def test_an_array_that_was_cut_off_between_objects_is_read_and_that_is_said(path: Path) -> None:
    path.write_text(json.dumps(ROWS)[:-1])
    log = open_log(path)
    assert len(log.samples) == len(ROWS)
    assert next(text for kind, text in log.told if kind == "log-cut").startswith(
        "the array has no ]"
    )


@pytest.mark.parametrize(("begin", "between"), [("[", ","), ("", "\n")])
def test_an_object_that_the_file_s_end_cuts_is_left_out_and_said(path, begin, between) -> None:
    text = begin + between.join(map(json.dumps, ROWS))
    path.write_text(text[: text.rindex('], "note"')])
    log = open_log(path)
    assert len(log.samples) == len(ROWS) - 1
    assert dict(log.told)["log-cut"].startswith("the last object has no end")


@pytest.mark.parametrize(
    "last",
    [
        '{"t_ns": 9000000000, "q": [1, 0, 0, 0], "note": "a brace { in a te',
        '{"t_ns": 9000000000, "q": [1, 0, 0, 0], "note": "a \\" and a \\',
        '{"t_ns": 9000000000, "q": [1, 0, 0, 0], "mode": {"name": "track"',
        '{"t_ns": 9000000000, "q": [1, 0, 0, 0], "heads": [{"stars": 9}, {"stars"',
    ],
    ids=["a text with a brace", "an escape", "an object within", "objects within"],
)
def test_an_object_is_cut_within_a_text_or_an_object_of_its_own(path: Path, last: str) -> None:
    path.write_text(lines(ROWS) + last)
    log = open_log(path)
    assert len(log.samples) == len(ROWS)
    assert dict(log.told)["log-cut"].startswith("the last object has no end")


@pytest.mark.parametrize("begun", ['{"t_ns": 9000000000, "q": [1, 0, 0, 0]', '{"note": "a"', "{"])
def test_an_object_without_an_end_before_another_is_no_cut(path: Path, begun: str) -> None:
    """A log that goes on was not cut off: to leave the rest out would hide an attitude."""
    after = '{"t_ns": 10000000000, "q": [1, 0, 0, 0]}'
    path.write_text(f"{lines(ROWS)}{begun}\n{after}\n")
    assert f"log.json:{len(ROWS) + 1}: " in refusal(open_log, path)


def test_zeros_and_rows_marked_invalid_are_left_out_of_an_array(path: Path) -> None:
    unset = {"t_ns": -2, "q": [float("nan")] * 4}
    lost = {"t_ns": 10**9, "q": [1, 0, 0, 0], "valid": False}
    path.write_text(json.dumps([unset, *ROWS, lost]))
    log = open_log(path)
    assert [sample.t_ns for sample in log.samples] == [row["t_ns"] for row in ROWS]
    assert {kind for kind, _ in log.told} >= {"log-start", "log-valid"}


@pytest.mark.parametrize("valid", [False, 0, "false", "False", "0"])
def test_an_attitude_is_left_out_however_its_program_writes_false(
    path: Path, valid: object
) -> None:
    path.write_text(lines([{**ROWS[0], "valid": True}, {**ROWS[1], "valid": valid}, ROWS[2]]))
    log = open_log(path)
    assert [sample.t_ns for sample in log.samples] == [ROWS[0]["t_ns"], ROWS[2]["t_ns"]]
    assert dict(log.told)["log-valid"].startswith("1 line is marked as not valid")


def test_telemetry_has_the_stars_of_its_objects(tmp_path: Path) -> None:
    path = tmp_path / "telemetry.jsonl"
    many = [[1.5, 2.5, 3.0, 26311, 0.7]] * 400  # an answer longer than a message with an attitude
    lines = [
        {"t_ns": 1, "q": [1, 0, 0, 0], "mode": "tracking", "centroids": [[5, 6, None], [7, 8]]},
        {"t_ns": 2, "valid": False, "centroids": [[9, 9]]},
        {"t_ns": 3, "q": [1, 0, 0, 0], "centroids": many},
        {"t_ns": 4, "q": [1, 0, 0, 0], "rate": [0.1, 0.2, 0.3]},
    ]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    telemetry = read_telemetry(path)
    assert telemetry.t_ns.tolist() == [1, 3, 4]
    assert list(telemetry.star_rows) == [[[5.0, 6.0, None], [7.0, 8.0]], many, []]
    assert telemetry.rate_cam_rad_s is not None
    assert telemetry.rate_cam_rad_s[2].tolist() == [0.1, 0.2, 0.3]


def test_stars_of_another_form_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "telemetry.jsonl"
    path.write_text('{"t_ns": 1, "q": [1, 0, 0, 0], "centroids": [["a", 2]]}\n')
    with pytest.raises(InputError, match=r"telemetry.jsonl:1: .*write centroids as \[\[x_px"):
        read_telemetry(path)
