"""The store: what a kill leaves behind is mended, rows come back in order, and the table's bytes
are the rows' alone.
"""

from __future__ import annotations

import contextlib
import os
import random
import zlib
from pathlib import Path

import msgspec
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.campaign import store
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.store import (
    About,
    Directory,
    Journal,
    failures,
    file_sha256,
    schema_of,
    write_table,
)
from tests.support.campaigns import read_columns, write_campaign
from tests.support.damage import NO_JSON
from tests.support.refusals import refusal


def row(case: int) -> dict[str, object]:
    return {"case": case, "why": "ä\n", "value": 0.1 * case, "whole": 3.0, "none": None}


COLUMNS = {
    "case": "int64",
    "why": "text",
    "value": "float64",
    "whole": "float64",
    "none": "float64",
}


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "BLOCK_CASES", 8)


def test_rows_survive_a_cut_at_any_byte_and_none_is_there_twice(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    journal = Journal(whole, 5)
    journal.append([row(case) for case in (3, 0, 1)])
    journal.close()
    data = (whole / "000000.jsonl").read_bytes()
    ends = [k + 1 for k, byte in enumerate(data) if byte == 10]
    for cut in range(len(data) + 1):
        folder = tmp_path / f"cut{cut}"
        folder.mkdir()
        (folder / "000000.jsonl").write_bytes(data[:cut])
        journal = Journal(folder, 5)
        kept = sum(end <= cut for end in ends)
        assert journal.missing(0) == sorted(set(range(5)) - set([3, 0, 1][:kept]))
        assert journal.append([row(case) for case in (0, 1, 2, 3, 4)]) == 5 - kept
        assert journal.append([row(2)]) == 0
        assert journal.rows(0) == [row(case) for case in range(5)]
        journal.close()


def test_a_flipped_byte_costs_its_own_row_alone(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j", 6)
    journal.append([row(case) for case in range(4)])
    journal.close()
    path = tmp_path / "j" / "000000.jsonl"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert len(Journal(tmp_path / "j", 6).missing(0)) == 3


def test_a_table_is_the_same_bytes_whatever_the_order_and_the_pauses(tmp_path: Path) -> None:
    found = []
    for turn in range(3):
        order = list(range(20))
        random.Random(turn).shuffle(order)
        for begin in range(0, 20, 7):
            journal = Journal(tmp_path / str(turn), 20)
            journal.append([row(case) for case in order[begin : begin + 7]])
            journal.close()
        journal = Journal(tmp_path / str(turn), 20)
        assert journal.done == 20 and journal.blocks == 3
        path = tmp_path / f"{turn}.parquet"
        write_table(
            path,
            schema_of(COLUMNS, {"a": "b"}),
            (journal.rows(block) for block in range(journal.blocks)),
        )
        found.append(file_sha256(path))
    assert len(set(found)) == 1
    columns = read_columns(path)
    assert columns["case"] == list(range(20)) and columns["value"] == [
        0.1 * case for case in range(20)
    ]
    journal.remove()
    assert not (tmp_path / "2").exists()


def test_a_row_in_another_block_s_file_is_dropped(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j", 16)
    journal.append([row(3), row(9)])
    journal.close()
    first, second = (tmp_path / "j" / f"00000{block}.jsonl" for block in (0, 1))
    first.write_bytes(first.read_bytes() + second.read_bytes())
    second.unlink()
    again = Journal(tmp_path / "j", 16)
    assert again.done == 1 and 9 in again.missing(1)
    again.close()


def test_a_full_block_that_lost_rows_is_refused(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j", 3)
    journal.append([row(case) for case in range(3)])
    journal.close()
    path = tmp_path / "j" / "000000.full.jsonl"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match="missing"):
        Journal(tmp_path / "j", 3).rows(0)


@pytest.mark.parametrize("text", [*NO_JSON, b"[]", b'{"case":"1"}', b"{}"])
def test_a_line_that_is_no_row_is_dropped_though_its_checksum_is_right(
    tmp_path: Path, text: bytes
) -> None:
    journal = Journal(tmp_path / "j", 6)
    journal.append([row(case) for case in range(3)])
    journal.close()
    with (tmp_path / "j" / "000000.jsonl").open("ab") as file:
        file.write(b"%08x %s\n" % (zlib.crc32(text), text))
    assert Journal(tmp_path / "j", 6).missing(0) == [3, 4, 5]


@pytest.mark.parametrize("text", NO_JSON)
def test_a_campaign_file_that_is_none_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "campaign.json").write_bytes(text)
    with (
        contextlib.closing(Directory(tmp_path)) as directory,
        pytest.raises(InputError, match=r"campaign\.json"),
    ):
        directory.claim(About({}, "", {}, "centroids", False, {}))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"plan": {"cases": 9, "seed": 1}}, "the plan's cases was 8 and is 9"),
        ({"plan": {"cases": 8}}, "the plan's seed was 1 and is null"),
        ({"identity": {"numpy": "2.2"}}, 'this machine\'s numpy was "2.1" and is "2.2"'),
        ({"bench_sha256": "cc"}, "its bench file was aa and is cc"),
        ({"files_sha256": "cc"}, "its log or scenario was bb and is cc"),
        ({"solver": "solve"}, "--solver was centroids and is solve"),
        ({"images": True}, "--images was another"),
    ],
)
def test_a_directory_of_another_campaign_is_refused_with_what_differs(
    tmp_path: Path, changed: dict[str, object], words: str
) -> None:
    """One whose table is whole may be looked at on any machine."""
    about = About({"cases": 8, "seed": 1}, "aa", "bb", "centroids", False, {"numpy": "2.1"})
    now = msgspec.structs.replace(about, **changed)
    with contextlib.closing(Directory(tmp_path)) as directory:
        directory.claim(about)
        directory.claim(about)
        line = refusal(directory.claim, now)
        assert line == (
            f"{tmp_path}: holds another campaign: {words}; write another directory after -o, or"
            " delete this one"
        )
        directory.table.touch()
        if "identity" in changed:
            directory.claim(now)
        else:
            assert refusal(directory.claim, now) == line


def test_a_campaign_with_images_is_another_than_one_without(tmp_path: Path) -> None:
    plan = write_campaign(tmp_path, {"key": "time_s", "values": [0.0]}, cases=2)
    with contextlib.closing(Directory(tmp_path / "out")) as directory:
        for images in (False, True):
            about = Campaign(plan, directory.path, "centroids", 1.0, images).about()
            if images:
                assert "--images was another" in refusal(directory.claim, about)
            else:
                directory.claim(about)


@pytest.mark.parametrize("name", ["cases.parquet", "journal"])
def test_files_of_a_campaign_that_nothing_says_whose_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with contextlib.closing(Directory(tmp_path)) as directory:
        line = refusal(directory.claim, About({}, "", "", "centroids", False, {}))
    assert line.startswith(f"{tmp_path / name}: is there already, and no campaign.json says whose")


def test_failures_are_counted_over_all_blocks_of_a_table(tmp_path: Path) -> None:
    rows = []
    for case, why in enumerate(("", "cloud", "", "dust", "cloud", "", "cloud")):
        rows.append({"case": case, "status": "failed" if why else "done", "why": why})
    path = tmp_path / "t.parquet"
    columns = {"case": "int64", "status": "text", "why": "text"}
    write_table(path, schema_of(columns, {}), iter([rows[:3], rows[3:4], rows[4:]]))
    assert list(failures(path).items()) == [("cloud", 3), ("dust", 1)]


@pytest.mark.parametrize(("cases", "blocks"), [(1, 1), (8, 1), (9, 2), (16, 2), (17, 3)])
def test_blocks_hold_all_cases_and_one_that_is_full_takes_no_more(
    tmp_path: Path, cases: int, blocks: int
) -> None:
    journal = Journal(tmp_path / "j", cases)
    assert journal.blocks == blocks
    assert [len(journal.missing(block)) for block in range(blocks)] == [
        min(8, cases - 8 * block) for block in range(blocks)
    ]
    rows = [row(case) for case in range(cases)]
    assert journal.append(rows) == cases
    assert journal.append(rows) == 0
    journal.close()
    again = Journal(tmp_path / "j", cases)
    assert again.append(rows) == 0
    assert again.done == cases
    assert not any(again.missing(block) for block in range(blocks))
    again.close()


def test_a_block_is_on_the_disk_before_it_has_the_name_of_a_full_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a loss of power a full block is read as it is; its file is closed at once, as a campaign
    has more blocks than a process may have files.
    """
    journal = Journal(tmp_path, 8)
    sync = os.fsync
    synced = []
    opened = []

    def seen_sync(fd: int) -> None:
        names = [path.name for path in tmp_path.iterdir()]
        synced.append((names, os.fstat(fd).st_size))
        opened.append(fd)
        sync(fd)

    monkeypatch.setattr(os, "fsync", seen_sync)
    journal.append([row(case) for case in range(8)])
    (fd,) = opened
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)
    journal.close()
    (full,) = tmp_path.iterdir()
    assert synced == [(["000000.jsonl"], full.stat().st_size)]
    assert full.name != "000000.jsonl"
