"""The row of the table *Tested with*: what it reads of a monitor, and what it keeps to itself."""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path

from hilstar.cli.service import user_name
from hilstar.server.doctor import COLUMNS, row, table
from tests.support.commands import run_hilstar_here

SERIAL, SERIAL_TEXT = 305419896, "CN0F00BAR123"


def edid(name: str = "DELL U2412M") -> bytes:
    """An EDID as VESA's E-EDID 1.4 lays it out, with a serial number in both of its places."""
    block = bytearray(128)
    block[:8] = bytes.fromhex("00ffffffffffff00")
    block[8:10] = (4 << 10 | 5 << 5 | 12).to_bytes(2, "big")  # "DEL"
    block[10:12] = (0xA07B).to_bytes(2, "little")
    block[12:16] = SERIAL.to_bytes(4, "little")
    block[16:20] = bytes((14, 2012 - 1990, 1, 3))
    block[21:23] = bytes((52, 32))
    for at, tag, text in ((72, 0xFF, SERIAL_TEXT), (90, 0xFC, name)):
        block[at : at + 5] = bytes((0, 0, 0, tag, 0))
        block[at + 5 : at + 18] = (text.encode() + b"\n").ljust(13)[:13]
    block[127] = -sum(block) % 256
    return bytes(block)


def test_a_monitor_is_named_without_its_serial_number(monkeypatch, tmp_path):
    for connector, block in (("DP-1", edid() + bytes(128)), ("DP-2", edid()[:127]), ("DP-3", b"")):
        (folder := tmp_path / f"class/drm/card0-{connector}").mkdir(parents=True)
        (folder / "edid").write_bytes(block)
    monkeypatch.setattr("hilstar.server.doctor.SYS", tmp_path)
    cells = row()
    assert (
        cells["monitors"].count("EDID") == 1
        and "EDID DEL DELL U2412M (2012, 52 x 32 cm)" in cells["monitors"]
    )
    assert SERIAL_TEXT not in str(cells) and str(SERIAL) not in str(cells)


def test_the_row_names_parts_and_versions_and_nothing_private(monkeypatch):
    """On whatever machine the tests run: no host name, no user, no path of theirs."""
    monkeypatch.setattr("platform.release", lambda: "6.1.0-18-labs-bench-ada")
    cells = row()
    assert tuple(cells) == COLUMNS and all(cells.values())
    assert (
        "Python 3." in cells["hilstar"]
        and "6.1.0" in cells["machine"]
        and "OpenGL" in cells["OpenGL"]
    )
    text = table(cells)
    head, rule, line = text.splitlines()
    assert head.count("|") == rule.count("|") == line.count("|") == len(COLUMNS) + 1
    private = {
        socket.gethostname(),
        str(Path.home()),
        str(Path.cwd()),
        "labs-bench-ada",
        "/dev/",
    } - {"localhost", "/", ""}
    private |= {user_name()} - {"root"}
    assert not [words for words in private if re.search(rf"(?<!\w){re.escape(words)}(?!\w)", text)]


def test_the_command_prints_it_to_be_pasted_or_read_by_a_program():
    printed = run_hilstar_here("doctor", "--report")
    assert (
        printed.returncode == 0
        and printed.stdout.startswith("| hilstar | machine |")
        and printed.stdout.count("\n") == 3
    )
    assert tuple(json.loads(run_hilstar_here("doctor", "--report", "--json").stdout)) == COLUMNS
