"""The cache of tables: used where it can be trusted, made anew where not, and never in the way."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hilstar.sky import star_table
from hilstar.sky.catalog import column_names
from hilstar.sky.star_table import KEPT_FILES, TableChoice, choose_catalog, kept, store_path
from tests.support.waiting import PATIENCE_S

TEXT = "ra_deg,dec_deg,vmag,b-v\n1,2,3,0.1\n4,5,6,\n7,8,9,0.5\n"


@pytest.fixture
def stored_table(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "t.csv").write_text(TEXT)
    return tmp_path / "t.csv"


def stored(stored_table):
    return sorted((stored_table.parent / "cache" / "hilstar").glob("*"))


def rewritten(path, **changes):
    """The same cache file with other arrays."""
    with np.load(path) as packed:
        arrays = dict(packed) | changes
    np.savez(path.with_suffix(""), **arrays)


def is_same_catalogue(a, b):
    return all(
        np.array_equal(getattr(a, n), getattr(b, n), equal_nan=getattr(a, n).dtype.kind == "f")
        for n in column_names()
    )


def test_the_second_time_the_cache_is_read_and_says_the_same(stored_table, caplog):
    first = choose_catalog(TableChoice(stored_table))
    assert "1 without a magnitude" in caplog.text
    caplog.clear()
    (path,) = stored(stored_table)
    rewritten(path, v_mag=np.array([1.0, 2.0]))
    second = choose_catalog(TableChoice(stored_table))
    assert second.v_mag.tolist() == [1.0, 2.0]  # the cache's, which shows that it was read
    assert "1 without a magnitude" in caplog.text
    assert (second.notes, second.rows_read, second.designation) == (first.notes, 3, "t row")


def test_another_content_epoch_or_company_is_another_catalogue(stored_table):
    choose_catalog(TableChoice(stored_table))
    choose_catalog(TableChoice(stored_table, epoch_jyear=2000.0))
    assert (
        len(choose_catalog(TableChoice(stored_table, with_hipparcos=True, epoch_jyear=2000.0)))
        > 100_000
    )
    before = stored_table.stat()
    stored_table.write_text(TEXT.replace("0.5", "0.7"))
    os.utime(stored_table, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert 0.7 in choose_catalog(TableChoice(stored_table)).bv_mag
    assert len(stored(stored_table)) == 4


def test_a_cache_lies_in_the_user_s_directory_by_what_it_was_made_of(tmp_path, monkeypatch):
    """The XDG base directory specification: a path that is not absolute is ignored."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    in_home = tmp_path / "home" / ".cache" / "hilstar"
    for named, folder in ((str(tmp_path), tmp_path / "hilstar"), ("near", in_home), ("", in_home)):
        monkeypatch.setenv("XDG_CACHE_HOME", named)
        assert store_path(["a"]).parent == folder
    before = store_path(["a", "b"])
    assert store_path(["a", "b"]) == before
    assert store_path(["a", "c"]) != before != store_path(["ab"])
    monkeypatch.setattr(star_table, "VERSION", star_table.VERSION + 1)
    assert store_path(["a", "b"]) != before


def test_a_damaged_or_hostile_cache_is_made_anew(stored_table):
    whole = choose_catalog(TableChoice(stored_table))
    (path,) = stored(stored_table)
    good = path.read_bytes()

    def objects():
        rewritten(path, v_mag=np.array([{}, {}], dtype=object))

    def packed():
        with np.load(path) as arrays:
            np.savez_compressed(path.with_suffix(""), **dict(arrays))

    damage = [
        lambda: path.write_bytes(b""),
        lambda: path.write_bytes(good[:-100]),
        lambda: path.write_bytes(good[:400] + bytes([good[400] ^ 1]) + good[401:]),
        lambda: path.write_bytes(np.random.default_rng(0).bytes(2000)),
        objects,
        packed,
        lambda: rewritten(path, v_mag=np.array([1.0])),
        lambda: rewritten(path, v_mag=np.array([1.0, np.nan])),
        lambda: rewritten(path, ra_deg=np.array([1.0, 361.0])),
        lambda: rewritten(path, hip=np.array([1.0, 2.0])),
        lambda: rewritten(path, about=np.array("{")),
        lambda: (path.unlink(), path.mkdir()),
    ]
    for k, harm in enumerate(damage):
        harm()
        assert is_same_catalogue(choose_catalog(TableChoice(stored_table)), whole), k
        if path.is_file():
            assert path.read_bytes() == good, k


class Harm:
    """An object that touches a file when it is read from a pickle."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_in_a_cache_is_run(stored_table, tmp_path):
    choose_catalog(TableChoice(stored_table))
    (path,) = stored(stored_table)
    rewritten(path, v_mag=np.array([Harm(tmp_path / "run"), None], dtype=object))
    choose_catalog(TableChoice(stored_table))
    assert not (tmp_path / "run").exists()


def test_nothing_depends_on_a_place_for_the_cache(stored_table, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no directory")
    for named in (str(tmp_path / "file"), "/proc/none", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", named)
        monkeypatch.setenv("HOME", "/proc/none")
        assert len(choose_catalog(TableChoice(stored_table))) == 2
    assert not (tmp_path / "relative").exists()


def test_only_the_newest_files_are_kept(stored_table):
    order = []
    for k in range(KEPT_FILES + 2):
        choose_catalog(TableChoice(stored_table, epoch_jyear=2000.0 + k))
        (path,) = set(stored(stored_table)).difference(order)
        os.utime(path, (k, k))  # the clock of a file system may not tell them apart
        order.append(path)
    # the last but one was the newest until it was given its time
    assert set(stored(stored_table)) == set(order[-KEPT_FILES:])


@pytest.mark.e2e
def test_two_processes_at_once_both_have_the_catalogue(stored_table):
    program = (
        "import sys; from pathlib import Path; from hilstar.sky.star_table import *;"
        "print(len(choose_catalog(TableChoice(Path(sys.argv[1])))))"
    )
    runs = [
        subprocess.Popen([sys.executable, "-c", program, stored_table], stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    counts = [run.communicate(timeout=PATIENCE_S)[0].strip() for run in runs]
    assert counts == [b"2"] * 2
    (path,) = stored(stored_table)
    rewritten(path, v_mag=np.array([1.0, 2.0]))
    # what they left is whole
    assert choose_catalog(TableChoice(stored_table)).v_mag.tolist() == [1.0, 2.0]


def test_a_cache_of_another_user_and_one_that_unfolds_are_not_read(stored_table, monkeypatch):
    choose_catalog(TableChoice(stored_table))
    (path,) = stored(stored_table)
    assert kept(path) is not None
    with monkeypatch.context() as patched:
        patched.setattr(os, "getuid", lambda: path.stat().st_uid + 1)
        assert kept(path) is None
    with np.load(path) as packed:
        np.savez_compressed(path.with_suffix(""), **packed)
    assert kept(path) is None
    assert kept(path.with_name("none.npz")) is None
