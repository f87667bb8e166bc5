"""The register of log formats: hilstar's own, another package's, and what a file is said to be."""

from __future__ import annotations

import logging
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import hilstar
from hilstar.attitude.logs import log_formats as formats
from hilstar.attitude.logs.log_file import open_log, read_log, write_log
from hilstar.basics import reading
from hilstar.basics.errors import InputError, MachineError
from tests.support.commands import run_hilstar_here, typed

PYPROJECT = Path(hilstar.__file__).parents[1] / "pyproject.toml"
OWN_NAMES = {
    "CSV",
    "JSON lines",
    "a CCSDS AEM",
    "a CCSDS message",
    "a CIC AEM",
    "an MCAP file",
    "the ledger of a run",
    "an STK attitude file",
    "a SPICE CK",
    "a ROS bag",
    "a ULog of PX4",
}
# A whole format of another package: a line is t_ns and four numbers behind the word PLANETARIUM.
MODULE = """
import contextlib
from hilstar.attitude.logs.entries import LogEntry, LogReading
from hilstar.attitude.logs.log_formats import LogFormat
from hilstar.attitude.wire.packet import checked_sample
from hilstar.attitude.wire.source import PACKETS

@contextlib.contextmanager
def read(path, stated):
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    entries = [LogEntry("", checked_sample(int(t), tuple(map(float, q)), None)) for t, *q in rows]
    yield LogReading(entries, PACKETS)

def write(file, samples, writing):
    file.write(b"PLANETARIUM\\n")
    for sample in samples:
        numbers = " ".join(map(repr, sample.q_icrs_to_cam.tolist()))
        file.write(f"{sample.t_ns} {numbers}\\n".encode())

FORMAT = LogFormat(
    "a planetarium's log",
    read,
    listed="planetarium logs",
    magic=(b"PLANETARIUM",),
    endings=(".planet",),
    write=write,
)
"""


@pytest.fixture(autouse=True)
def read_anew():
    """The register is read once a process: what a test adds is gone after it."""
    formats.log_formats.cache_clear()
    yield
    formats.log_formats.cache_clear()


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package with one entry point of the group."""

    def install(value: str) -> None:
        folder = tmp_path / "site"
        info = folder / "planetarium-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: planetarium\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[hilstar.log_formats]\nplanet = {value}\n")
        (folder / "planetarium_log.py").write_text(MODULE)
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, "planetarium_log", raising=False)

    return install


def test_hilstars_own_formats_are_those_of_its_entry_points():
    listed = tomllib.loads(PYPROJECT.read_text())["project"]["entry-points"][formats.GROUP]
    found = formats.log_formats()
    assert {each.name for each in found} == OWN_NAMES
    assert len(listed) == len(found)
    assert found[-1].name == "CSV"


def test_a_format_of_another_package_is_read_written_and_named(tmp_path, package):
    package("planetarium_log:FORMAT")
    path = tmp_path / "a.planet"
    path.write_text("PLANETARIUM\n7 1 0 0 0\n9 0 1 0 0\n")
    samples = read_log(path)
    assert [sample.t_ns for sample in samples] == [7, 9]
    write_log(tmp_path / "b.planet", samples)
    again = read_log(tmp_path / "b.planet")
    assert [sample.q_icrs_to_cam.tolist() for sample in again] == [[1, 0, 0, 0], [0, 1, 0, 0]]
    assert "planetarium logs" in formats.readable()
    assert formats.kinds()[b"PLANETARIUM"] == "a planetarium's log"
    with pytest.raises(InputError, match=r"end it in one of .*\.planet"):
        write_log(tmp_path / "c.txt", samples)


@pytest.mark.parametrize("name", ["a.CSV", "b.Jsonl", "c.json", "d.MCAP"])
def test_a_log_is_written_by_the_ending_of_its_name_in_capitals_or_not(tmp_path, name):
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,0,1,0,0\n")
    samples = read_log(tmp_path / "log.csv")
    write_log(tmp_path / name, samples)
    assert [sample.t_ns for sample in read_log(tmp_path / name)] == [0, 10**9]


def test_a_file_with_the_magic_number_of_two_formats_is_what_any_such_file_is():
    """A ledger is an MCAP file of a run: by its first bytes alone it is an MCAP file."""
    ledger, mcap = (
        next(form for form in formats.log_formats() if form.name == name)
        for name in ("the ledger of a run", "an MCAP file")
    )
    assert ledger.magic == mcap.magic
    assert {formats.kinds()[magic] for magic in mcap.magic} == {"an MCAP file"}


def test_a_format_of_hilstar_s_is_tried_before_another_that_looks_as_close(package):
    """Both have a magic number and nothing else to look at: which comes first is hilstar's."""
    package("planetarium_log:FORMAT")
    found = formats.log_formats()
    names = [each.name for each in found if each.magic and each.begins is None]
    assert names[-1] == "a planetarium's log" and len(names) > 1


@pytest.mark.parametrize(
    "value", ["planetarium_log:read", "planetarium_log:MISSING", "no_such_module:FORMAT"]
)
def test_what_another_package_registers_and_is_no_format_is_left_out_with_a_warning(
    tmp_path, package, value, caplog
):
    package(value)
    (tmp_path / "a.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    with caplog.at_level(logging.WARNING):
        assert len(read_log(tmp_path / "a.csv")) == 1
    assert f"planet of planetarium ({value}) is no LogFormat, and is left out" in caplog.text


def test_a_checkout_reads_its_own_list_whatever_an_older_installation_has_registered(monkeypatch):
    stale = EntryPoint("csv", "gone.from.here:FORMAT", formats.GROUP)
    stale = stale._for(type("Installed", (), {"name": "hilstar"})())
    monkeypatch.setattr(formats, "entry_points", lambda group: [stale])
    assert {each.name for each in formats.log_formats()} == OWN_NAMES


def test_an_installed_hilstar_goes_by_its_entry_points(monkeypatch):
    own = EntryPoint("csv", "hilstar.attitude.logs.csv_log:log_format", formats.GROUP)
    own = own._for(type("Installed", (), {"name": "hilstar"})())
    monkeypatch.setattr(formats, "_of_checkout", lambda path: [])
    monkeypatch.setattr(formats, "entry_points", lambda group: [own])
    assert [each.name for each in formats.log_formats()] == ["CSV"]
    formats.log_formats.cache_clear()
    monkeypatch.setattr(formats, "entry_points", lambda group: [])
    with pytest.raises(MachineError, match="not registered; install hilstar again"):
        formats.log_formats()


def test_a_pyproject_of_another_project_beside_the_package_is_not_taken(tmp_path):
    path = tmp_path / "pyproject.toml"
    assert formats._of_checkout(path) == []
    path.write_text('[project]\nname = "other"\n')
    assert formats._of_checkout(path) == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("CCSDS_AEM_VERS = 1.0\n", "CCSDS_AEM_VERS"),
        ("\n  \nCIC_AEM_VERS = 1.0\n", "CIC_AEM_VERS"),
        ("COMMENT of the mission\nCCSDS_AEM_VERS = 1.0\n", "CCSDS_AEM_VERS"),
        ("COMMENT\nCOMMENT two\nCIC_AEM_VERS = 1.0\n", "CIC_AEM_VERS"),
        ("# by STK\n#\nstk.v.11.0\n", "stk.v.11.0"),
        ("// of a run\n{}\n", "{}"),
        ("COMMENTS = 1\n", "COMMENTS"),
        ("# alone\nCOMMENT\n", ""),
        ("", ""),
    ],
)
def test_a_file_is_what_its_first_word_after_comments_says(tmp_path, text, word):
    path = tmp_path / "a.txt"
    path.write_text(text)
    assert formats.LogHead(path, b"").word == word


def test_reading_names_no_format_of_a_log_itself():
    own = {magic for each in formats.log_formats() for magic in each.magic}
    assert own and own.isdisjoint(reading.MAGIC)


def test_a_log_in_the_place_of_a_bench_file_is_named(tmp_path):
    for magic, kind in formats.kinds().items():
        (tmp_path / "bench.toml").write_bytes(magic + bytes(20))
        result = run_hilstar_here(
            "frame", tmp_path / "bench.toml", "--radec", "0,0,0", "-o", tmp_path / "a.png"
        )
        assert result.returncode == 2
        assert f"it is {kind}" in result.stderr


def test_a_ulog_of_px4_is_refused_with_the_way_to_bring_one(tmp_path):
    (tmp_path / "a.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8))
    for stated in ([], ["--reference", "ned", "--topic", "vehicle_attitude"]):
        result = run_hilstar_here("attitude", tmp_path / "a.ulg", *stated)
        assert result.returncode == 2
        assert result.stderr.count("\n") == 1
        for words in ("a ULog of PX4, which is not read", "pyulog", "t_s", "qw,qx,qy,qz", "q[0]"):
            assert words in result.stderr
        for words in (
            "--convention frame=body,direction=cam_to_icrs",
            "--reference ned",
            "--place",
            "--epoch-utc",
        ):
            assert words in result.stderr


def test_the_way_to_bring_a_log_of_px4_gives_the_place_of_astropy(tmp_path):
    """A body 34.38 deg from north, level at 47 N 8 E: Astropy (ITRS to GCRS) and SciPy."""
    path = tmp_path / "flight.csv"
    path.write_text(
        "t_s,qw,qx,qy,qz\n0.998,0.9553365,0.0,0.0,0.29552022\n1.098,0.9553365,0.0,0.0,0.29552022\n"
    )
    stated = typed("--convention frame=body,direction=cam_to_icrs --reference ned --place 47,8,0")
    result = run_hilstar_here("attitude", path, *stated, "--epoch-utc", "2024-06-01T22:00:00")
    assert "RA 48.6736, Dec -47.0910, roll 304.52" in result.stdout, result.stderr


def test_a_log_says_what_formats_there_are_where_it_is_none(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    with pytest.raises(
        InputError, match=r"it is a PNG picture.*hilstar reads .*STK attitude files"
    ):
        open_log(tmp_path / "a.png")
