"""Files that a user names: whatever is no regular file of a sensible size is refused in one
line, and never awaited.
"""

from __future__ import annotations

import io
import os
import socket
from pathlib import Path

import pytest

from hilstar.basics import reading
from hilstar.basics.errors import InputError, one_line, shortened
from hilstar.basics.reading import (
    CHUNK_BYTES,
    MAGIC,
    KeptFiles,
    by_number,
    exists,
    named_bytes,
    open_lines,
    open_regular,
    parse_toml,
    read_bytes,
    read_text,
)
from tests.support.refusals import refusal

ADVICE = "give a file of text"
LIMIT_BYTES = 1000


def text_refusal(path: Path, limit_bytes: int = LIMIT_BYTES) -> str:
    line = refusal(read_text, path, ADVICE, limit_bytes)
    assert line.startswith(one_line(f"{path}:"))
    assert line.endswith(ADVICE)
    return line.removeprefix(f"{path}: ")


def test_a_text_is_read_without_its_byte_order_mark(tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfg\xc3\xbcnstig")
    assert read_text(path, ADVICE, LIMIT_BYTES) == "günstig"
    assert read_bytes(path, ADVICE, 11) == path.read_bytes()


def test_what_is_no_regular_file_is_named_and_never_awaited(tmp_path):
    pipe, local = tmp_path / "pipe", tmp_path / "socket"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(local))
        assert "it is a socket" in text_refusal(local)
    assert "it is a pipe" in text_refusal(pipe)
    assert "it is a directory" in text_refusal(tmp_path)
    for device in ("zero", "full", "null", "urandom"):
        assert "it is a device" in text_refusal(Path("/dev") / device)


def test_a_name_that_is_no_file_s_is_refused(tmp_path):
    assert "(No such file or directory)" in text_refusal(tmp_path / "none")
    assert "(File name too long)" in text_refusal(tmp_path / ("n" * 300))
    assert "(no file has such a name)" in text_refusal(tmp_path / "a\0b")
    assert not any(map(exists, (tmp_path / "none", tmp_path / ("n" * 300), tmp_path / "a\0b")))
    assert exists(tmp_path)


def test_a_link_to_a_device_is_a_device(tmp_path):
    link = tmp_path / "link"
    link.symlink_to("/dev/zero")
    assert "it is a device" in text_refusal(link)


def test_a_file_past_the_limit_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(10**12)  # a hole: nothing is on the disk
    assert "has 1000 GB or more, and at most 1 kB are read" in text_refusal(path)
    assert "at most 50 MB" in refusal(open_regular, path, ADVICE, 50_000_000)


def test_a_file_that_does_not_tell_its_size_is_bounded_too():
    assert "at most 4 bytes are read" in text_refusal(Path("/proc/self/maps"), 4)


def test_the_first_byte_that_is_not_utf_8_is_named(tmp_path):
    path = tmp_path / "latin"
    for mark in (b"", b"\xef\xbb\xbf"):
        path.write_bytes(mark + b"abc\xe9 xx")
        assert f"byte {len(mark) + 3} is 0xe9" in text_refusal(path)


@pytest.mark.parametrize("before", [0, 1, 2])
def test_a_byte_that_is_not_utf_8_is_named_by_its_place_in_a_large_file_too(tmp_path, before):
    """A character of three bytes may lie across the pieces in which the file is looked at."""
    text = "a" * (CHUNK_BYTES - before) + "\N{EURO SIGN}" + "b" * 10
    path = tmp_path / "large"
    path.write_bytes(text.encode() + b"\xff")
    place = CHUNK_BYTES - before + 3 + 10
    assert f"byte {place} is 0xff" in text_refusal(path, 2 * CHUNK_BYTES)
    path.write_bytes(text.encode()[: CHUNK_BYTES - before + 2] + b"b")
    place = CHUNK_BYTES - before
    assert f"byte {place} is 0xe2" in text_refusal(path, 2 * CHUNK_BYTES)


def test_lines_come_one_by_one_and_as_the_file_has_them(tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n\nd")
    with open_lines(path, ADVICE, LIMIT_BYTES) as lines:
        assert list(lines) == ["a\r\n", "b\r", "c\n", "\n", "d"]


def test_a_line_without_end_and_a_late_byte_that_is_no_text_are_named(tmp_path):
    path, limit_bytes = tmp_path / "text", 10**8
    path.write_bytes(b"a\n" + b"b" * 5_000_000)
    with (
        pytest.raises(InputError, match="text:2: the line has 1000000 characters or more"),
        open_lines(path, ADVICE, limit_bytes) as lines,
    ):
        list(lines)
    path.write_bytes(b"abc\n" * 10**6 + b"\xe9 ")
    with open_lines(path, ADVICE, limit_bytes) as lines:
        assert list(lines)[-1] == "\u00e9 "  # Windows-1252, with a warning


def test_a_file_of_another_kind_is_called_by_its_kind(tmp_path):
    path = tmp_path / "other"
    for magic, kind in MAGIC.items():
        path.write_bytes(magic + b"\x01rest")
        assert f"it is {kind})" in text_refusal(path)


def test_a_long_piece_keeps_its_beginning_and_its_end():
    assert shortened("x" * 120) == "x" * 120
    cut = shortened("/first" + "x" * 100_000 + "last.toml")
    assert len(cut) == 120
    assert cut.startswith("/first") and cut.endswith("last.toml")


def test_a_line_is_one_line_and_bounded_whatever_it_repeats():
    line = one_line("bench\udcff.toml:\n\x1b[31m " + "x" * 10**6 + " word" * 10**6)
    assert line.startswith("bench\\xff.toml: \\x1b[31m xxx")
    assert len(line) <= 1000


@pytest.mark.parametrize("mark", [True, False], ids=["marked", "unmarked"])
@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32-le", "utf-32-be"])
def test_a_wide_text_is_read_line_by_line_and_named_where_it_is_not(tmp_path, encoding, mark):
    path = tmp_path / "wide.csv"
    text = "t_s,qw\n0,1\n"
    path.write_bytes((("\ufeff" if mark else "") + text).encode(encoding))
    with open_lines(path, ADVICE, 1000) as lines:
        assert "".join(lines).removeprefix("\ufeff") == text
    assert f"it is text in {encoding[:6].upper()}, not UTF-8" in text_refusal(path)


def test_a_line_of_windows_is_read_and_one_of_no_text_is_not(tmp_path, caplog):
    path = tmp_path / "lines.csv"
    path.write_bytes(b"\x0cpage\n20 \xb0C\n")
    with open_lines(path, ADVICE, 1000) as lines:
        assert list(lines) == ["\x0cpage\n", "20 °C\n"]
    assert "line 2 is not UTF-8, and is read as Windows-1252" in caplog.text
    path.write_bytes(b"a\n\x1b \xb0\n")
    with (
        pytest.raises(InputError, match="it is no text: line 2 has a byte 0x1b"),
        open_lines(path, ADVICE, 1000) as lines,
    ):
        list(lines)


def test_what_was_taken_longest_ago_goes_first(monkeypatch):
    monkeypatch.setattr(reading, "MAX_KEPT_BYTES", 10)
    kept = KeptFiles()
    for state in (1, 2):
        kept.keep((state,), b"1234")
    kept.content((1,))
    kept.keep((3,), b"1234")
    assert [kept.content((state,)) for state in (1, 2, 3)] == [b"1234", None, b"1234"]
    kept.keep((4,), b"12345678901")
    assert kept.content((4,)) is None and kept.content((3,)) is not None
    assert kept.content(None) is None


@pytest.mark.parametrize(("age_s", "is_kept"), [(0.5, False), (10.0, True)])
def test_a_file_that_was_just_written_is_read_again(tmp_path, monkeypatch, age_s, is_kept):
    """Two writes within a file system's step of time leave the same state."""
    path = tmp_path / "bench.toml"
    path.write_bytes(b"one")
    written_ns = path.stat().st_ctime_ns
    monkeypatch.setattr(reading.time, "time_ns", lambda: written_ns + round(age_s * 1e9))
    assert (named_bytes(path, ADVICE, 3) is named_bytes(path, ADVICE, 3)) is is_kept
    with pytest.raises(InputError, match="at most 2 bytes are read"):
        named_bytes(path, ADVICE, 2)
    with (
        pytest.raises(InputError, match="at most 2 bytes are read"),
        open_lines(path, ADVICE, 2) as lines,
    ):
        list(lines)


@pytest.mark.parametrize(
    ("whole_lines", "text", "pieces"),
    [
        (True, "123456789\n1\n", ["123456789\n", "1\n"]),
        (False, "123456789\n1\n", ["123456789\n", "1\n"]),
        (False, "1234567890\n1", ["1234567890", "\n", "1"]),
        (True, "1234567890\n", None),
        (True, "1\n1234567890", None),
    ],
)
def test_a_line_is_as_long_as_the_limit_with_its_end(
    tmp_path, monkeypatch, whole_lines, text, pieces
):
    monkeypatch.setattr(reading, "MAX_LINE_CHARACTERS", 10)
    path = tmp_path / "lines.txt"
    path.write_text(text)
    with open_lines(path, ADVICE, 100, whole_lines) as lines:
        if pieces is not None:
            assert list(lines) == pieces
            return
        with pytest.raises(InputError, match=r":\d: the line has 10 characters or more"):
            list(lines)


def test_files_are_sorted_as_people_number_them():
    names = ["b_2.png", "a_10.png", "a_9.png", "a_9_10.png", "a_9_2.png", "a.png"]
    assert [path.name for path in sorted(map(Path, names), key=by_number)] == [
        *("a.png", "a_9.png", "a_9_2.png", "a_9_10.png", "a_10.png", "b_2.png"),
    ]


@pytest.mark.parametrize(("parts", "is_taken"), [(31, True), (32, False)])
def test_a_key_has_31_parts_at_most(parts, is_taken):
    """tomllib's time grows as their square."""
    text = ".".join("a" * parts) + " = 1\n"
    if not is_taken:
        line = refusal(parse_toml, Path("b.toml"), text)
        assert line == "b.toml: not TOML that anybody wrote: a key has 32 parts or more"
        return
    value = parse_toml(Path("b.toml"), text)
    for _ in range(parts):
        value = value["a"]
    assert value == 1


def test_a_room_names_the_kinds_of_files_that_it_reads_once(monkeypatch):
    """They go before the kinds that are known here."""
    monkeypatch.setattr(reading, "_kinds_of_rooms", [])
    asked = []

    def kinds() -> dict[bytes, str]:
        asked.append(1)
        return {b"\x89PNG\r\n": "a picture of ours", b"OWN": "a log of ours"}

    assert reading.kind_of(b"OWN log") is None
    for _ in range(2):
        reading.add_kinds(kinds)
    assert reading.kind_of(b"OWN log") == "a log of ours"
    assert reading.kind_of(b"\x89PNG\r\n") == "a picture of ours"
    assert reading.kind_of(b"PK\x03\x04") == "a zip archive"
    assert len(asked) == 3


def test_rooms_are_asked_only_of_a_file_that_is_no_plain_text(monkeypatch, tmp_path):
    asked = []

    def kinds() -> dict[bytes, str]:
        asked.append(1)
        return {b"OWN\0": "a log of ours", b"DAF/CK": "a SPICE CK"}

    monkeypatch.setattr(reading, "_kinds_of_rooms", [kinds])
    path = tmp_path / "bench.toml"
    for text in ("", "[monitor]\n", "#\tOWN\n\f\r\n~"):
        path.write_text(text)
        assert reading.read_text(path, "give another", 100) == path.read_bytes().decode()
    assert not asked
    for raw, kind in ((b"OWN\0log", "a log of ours"), (b"DAF/CK", "a SPICE CK")):
        path.write_bytes(raw)
        assert f"it is {kind}" in refusal(reading.read_text, path, "give another", 100)
    path.write_text("# \N{DEGREE SIGN}\n")
    assert reading.read_text(path, "give another", 100) == "# \N{DEGREE SIGN}\n"
    assert len(asked) == 3


def test_a_file_that_has_just_come_is_not_kept_whatever_age_it_states(tmp_path):
    """A copy keeps its original's time; the next one may come within the same tick."""
    path = tmp_path / "a.txt"
    path.write_text("a")
    os.utime(path, (1e9, 1e9))
    with reading.open_named(path, "give a file", 100) as file:
        assert not isinstance(file, io.BytesIO)
