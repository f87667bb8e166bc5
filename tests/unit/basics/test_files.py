"""Files that are written: never over an input, whole or not at all, one writer each."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import pytest

from hilstar.basics import files
from hilstar.basics.errors import InputError
from hilstar.basics.files import (
    CSV,
    FITS,
    PNG,
    PNG_OR_TIFF,
    NewFile,
    check_directory,
    check_ending,
    check_outputs,
    clear_parts,
    files_named_in,
    lock_alone,
    refuse_existing,
    whole_file,
    write_whole,
)
from hilstar.basics.reading import CHUNK_BYTES
from tests.support.full_disk import files_of_at_most
from tests.support.refusals import refusal


@pytest.mark.parametrize("kind", ["same", "hard", "soft", "dotted"])
def test_an_output_that_is_an_input_by_any_name_is_refused(tmp_path, kind):
    given = tmp_path / "a.csv"
    given.write_text("x")
    other = {"same": given, "dotted": tmp_path / "." / "sub" / ".." / "a.csv"}.get(
        kind, tmp_path / "b.csv"
    )
    (tmp_path / "sub").mkdir()
    if kind == "hard":
        other.hardlink_to(given)
    if kind == "soft":
        other.symlink_to(given)
    assert "read or written by this command" in refusal(check_outputs, [given], [other])
    check_outputs([given], [tmp_path / "c.csv", None])


def test_two_outputs_that_are_one_file_are_refused_before_there_is_one(tmp_path):
    link = tmp_path / "link.fits"
    link.symlink_to(tmp_path / "x.fits")
    with pytest.raises(InputError, match=r"link.fits, the same file as .*x.fits"):
        check_outputs([], [tmp_path / "x.fits", link])


def test_devices_may_be_given_twice():
    check_outputs([], [Path("/dev/null"), Path("/dev/null")])


def test_what_a_bench_file_names_is_an_input_too(tmp_path):
    (tmp_path / "qe.csv").write_text("")
    (tmp_path / "m.csv").write_text("")
    (tmp_path / "m.toml").write_text('[calibration]\nresponse = "m.csv"\n')
    (tmp_path / "b.toml").write_text(
        '[tracker]\nquantum_efficiency = "qe.csv"\n[monitor]\ncalibration = "m.toml"\n'
        '[[maps]]\nfiles = [["first.fits"], ["second.fits", 5]]\n'
    )
    for name in ("first.fits", "second.fits"):
        (tmp_path / name).write_text("")
    assert {path.name for path in files_named_in(tmp_path / "b.toml")} == {
        "b.toml",
        "qe.csv",
        "m.toml",
        "m.csv",
        "first.fits",
        "second.fits",
    }


def test_a_plan_s_inputs_go_down_to_the_tables_of_its_bench_s_calibration(tmp_path):
    """A TOML file below those is an input too, but what it names is not looked for: a ring ends."""
    (tmp_path / "plan.toml").write_text('bench = "bench.toml"\n')
    (tmp_path / "bench.toml").write_text('[monitor]\ncalibration = "m.toml"\n')
    (tmp_path / "m.toml").write_text('response = "m.csv"\nfurther = "next.toml"\n')
    (tmp_path / "next.toml").write_text('again = "plan.toml"\n')
    (tmp_path / "m.csv").write_text("")
    names = [path.name for path in files_named_in(tmp_path / "plan.toml")]
    assert names == ["plan.toml", "bench.toml", "m.toml", "m.csv", "next.toml"]


def test_an_error_leaves_the_older_file_whole_and_nothing_beside(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    with pytest.raises(InputError, match="cannot be written"), whole_file(path) as part:
        part.write(b"half")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    write_whole(path, "new")
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o640)


def test_a_full_disk_leaves_the_older_file_whole(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with files_of_at_most(1000), pytest.raises(InputError, match="cannot be written"):
        write_whole(path, bytes(5000))
    assert path.read_bytes() == b"old"


def test_a_temporary_name_cannot_be_foreseen_and_no_planted_link_is_followed(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("theirs")
    (tmp_path / f".a.{os.getpid()}.part.txt").symlink_to(victim)
    write_whole(tmp_path / "a.txt", "mine")
    assert victim.read_text() == "theirs"
    monkeypatch.setattr("secrets.token_hex", lambda _: "foreseen")
    (tmp_path / ".a.foreseen.part.txt").symlink_to(victim)
    (tmp_path / ".run.foreseen.part.mcap").symlink_to(victim)
    (tmp_path / "run.mcap").write_text("old")
    assert "cannot be written" in refusal(write_whole, tmp_path / "a.txt", "mine again")
    assert "is there already" in refusal(NewFile, tmp_path / "run.mcap", overwrite=True)
    assert victim.read_text() == "theirs"
    assert (tmp_path / "a.txt").read_text() == "mine"


def test_what_takes_the_temporary_name_s_place_gets_nothing_written(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("theirs")
    with (
        pytest.raises(InputError, match="cannot be written"),
        whole_file(tmp_path / "a.txt") as file,
    ):
        [part] = tmp_path.glob(".a.*.part.txt")
        part.unlink()
        part.symlink_to(victim)
        file.write(b"mine")
    assert victim.read_text() == "theirs"


def test_links_in_a_circle_are_refused_and_stay(tmp_path):
    one, other = tmp_path / "one.fits", tmp_path / "other.fits"
    one.symlink_to(other)
    other.symlink_to(one)
    with pytest.raises(
        InputError, match=r"one.fits: cannot be written \(Too many levels of symbolic links\)"
    ):
        write_whole(one, "x")
    assert "Too many levels" in refusal(check_outputs, [], [one])
    assert one.is_symlink() and other.is_symlink()


def test_a_lock_file_is_no_way_to_another_file(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("theirs")
    (tmp_path / ".lock").symlink_to(victim)
    assert "cannot be written" in refusal(lock_alone, tmp_path / ".lock", "held")
    assert victim.read_text() == "theirs"


def test_a_long_name_in_any_script_has_room_for_its_temporary_one(tmp_path):
    path = tmp_path / ("\N{CJK UNIFIED IDEOGRAPH-661F}" * 80 + ".csv")
    write_whole(path, "x")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_pipe_is_written_itself(tmp_path):
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(pipe, "x")
    assert os.read(reader, 10) == b"x"
    os.close(reader)


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to("real.txt")
    write_whole(link, "new")
    assert link.is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_what_is_there_is_refused_but_for_an_empty_file(tmp_path):
    path = tmp_path / "run.mcap"
    refuse_existing(path, False)
    path.touch()
    refuse_existing(path, False)
    path.write_text("x")
    assert "--overwrite" in refusal(refuse_existing, path, False)
    refuse_existing(path, True)


def test_a_file_has_one_writer(tmp_path):
    path = tmp_path / "run.mcap"
    first = NewFile(path)
    os.write(first.fd, b"a run")
    for overwrite in (False, True):
        assert "another run is writing it" in refusal(NewFile, path, overwrite)
    first.close()
    second = NewFile(path, overwrite=True)
    os.write(second.fd, b"new")
    assert path.read_bytes() == b"a run"  # until the new one has begun
    second.commit()
    assert path.read_bytes() == b"new"
    second.close()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_file_that_is_discarded_leaves_an_older_one_as_it_was(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"a run")
    file = NewFile(path, overwrite=True)
    os.write(file.fd, b"new")
    file.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    assert path.read_bytes() == b"a run"


def test_no_ledger_of_a_run_is_written_over_by_anything_else(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + b"..bench_sha256..")
    assert "ledger of a run" in refusal(write_whole, path, "x")
    for place in (tmp_path, tmp_path / "fifo"):
        if place.name == "fifo":
            os.mkfifo(place)
        assert "cannot be" in refusal(NewFile, place)


@pytest.mark.parametrize(
    "name", ["a.fits", "a.FIT", "a.fts", "a.fits.gz", "a", "a.dat", "/dev/null", "run.3"]
)
def test_a_name_that_says_fits_or_nothing_is_taken(name):
    check_ending("-o", Path(name), FITS)


@pytest.mark.parametrize(
    ("name", "endings", "better"),
    [
        ("d/x.png", FITS, "a FITS file is written there; write x.fits"),
        ("x.csv.gz", FITS, "write x.csv.fits"),
        ("x.jpg", PNG, "a PNG picture is written there; write x.png"),
        ("x.fits", PNG_OR_TIFF, "a PNG or TIFF picture is written there; write x.png"),
        ("x.TOML", CSV, "a CSV table is written there; write x.csv"),
    ],
)
def test_a_name_that_says_another_kind_is_refused(name, endings, better):
    line = refusal(check_ending, "--codes", Path(name), endings)
    assert line.startswith(f"--codes {name}: ")
    assert better in line


def test_a_file_s_name_is_no_directory_unless_one_is_there(tmp_path):
    with pytest.raises(
        InputError,
        match=r"-o .*frames.png: several files are written, into a directory; .* such as frames",
    ):
        check_directory("-o", tmp_path / "frames.png")
    check_directory("-o", None)
    check_directory("-o", tmp_path / "run-0.5")
    (tmp_path / "old.csv").mkdir()
    check_directory("-o", tmp_path / "old.csv")


@pytest.mark.parametrize(
    ("content", "harm"),
    [
        (b"12345", None),
        (b"123456", "overwritten"),
        (b"1234", "truncated"),
        (b"12344", "overwritten"),
    ],
)
def test_what_somebody_did_to_a_file_is_told(tmp_path, content, harm):
    file = NewFile(tmp_path / "run.mcap")
    os.write(file.fd, b"12345")
    file.note()
    with (tmp_path / "run.mcap").open("r+b") as other:
        other.write(content)
        other.truncate()
    os.utime(tmp_path / "run.mcap", ns=(0, 0))
    assert file.harm(5, zlib.crc32(b"12345")) == harm
    (tmp_path / "run.mcap").unlink()
    assert file.harm(5, zlib.crc32(b"12345")) == "deleted"
    file.close()


def test_a_file_that_is_only_touched_is_read_through_at_longer_and_longer_intervals(
    tmp_path, monkeypatch
):
    """After 1, 2 and 4 s: what is done to it in between is told at the next. It is of several
    pieces, which all count.
    """
    clock = [100.0]
    monkeypatch.setattr(files.time, "monotonic", lambda: clock[0])
    path = tmp_path / "run.mcap"
    file = NewFile(path)
    content = bytes(range(256)) * (2 * CHUNK_BYTES // 256) + b"end"
    os.write(file.fd, content)
    file.note()
    crc = zlib.crc32(content)
    os.utime(path, ns=(0, 0))
    for now_s in (100.0, 101.0, 103.0):
        clock[0] = now_s
        assert file.harm(len(content), crc) is None
    with path.open("r+b") as other:
        other.seek(CHUNK_BYTES + 5)
        other.write(b"!")
    os.utime(path, ns=(0, 0))
    for now_s, harm in ((104.0, None), (106.9, None), (107.0, "overwritten")):
        clock[0] = now_s
        assert file.harm(len(content), crc) == harm
    file.close()


def test_what_killed_writers_of_any_version_left_is_deleted_and_nothing_else(tmp_path):
    (tmp_path / "sub").mkdir()
    left = [".run.0123456789abcdef.part.mcap", ".a.b.4711.part.csv", "sub/.x.00ff00ff00ff00ff.part"]
    kept = [
        ".run.0123456789abcde.part.mcap",
        "run.4711.part.csv",
        ".run.part",
        ".hidden",
        "run.csv",
    ]
    for name in (*left, *kept):
        (tmp_path / name).write_text("")
    (tmp_path / ".link.4711.part").symlink_to(tmp_path / "run.csv")
    clear_parts(tmp_path)
    there = {path.name for path in tmp_path.iterdir()}
    assert there == {*kept, "sub", ".link.4711.part"}
    assert list((tmp_path / "sub").iterdir()) == []


def test_a_lock_that_another_has_is_refused_and_leaves_no_descriptor_open(tmp_path):
    held = lock_alone(tmp_path / "lock", "another run is there")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        line = refusal(lock_alone, tmp_path / "lock", "another run is there")
        assert line == f"{tmp_path}: another run is there"
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    os.close(held)
    os.close(lock_alone(tmp_path / "lock", "another run is there"))
