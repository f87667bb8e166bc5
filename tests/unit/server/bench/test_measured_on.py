"""Whether a bench's calibration files are of the monitor that is there, by their own words."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hilstar.display.calibration import CalibrationHead, NotesTable, write_calibration
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, monitor_camera, write_geometry
from hilstar.display.identity import MonitorIdentity
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.certificate_file import KIND, Certificate
from hilstar.server.bench.measured_on import check_monitor
from tests.support.benches import bench_text

MEASURED = datetime.date(2026, 3, 1)
VALID_DAYS = 90
OWN = MonitorIdentity(maker="ACME", model="P27", serial="A-17", edid_sha256="a1", bits=10)
SET = msgspec.structs.replace(OWN, brightness=70)
OTHER = msgspec.structs.replace(OWN, serial="A-18", edid_sha256="b2")
NOT_READ = "the monitor's own settings cannot be read now (DDC/CI)"


def later(days: int) -> datetime.date:
    return MEASURED + datetime.timedelta(days=days)


def bench(
    folder: Path,
    light: MonitorIdentity | None = OWN,
    place: MonitorIdentity | None = None,
    when: str = MEASURED.isoformat(),
) -> BenchFile:
    """A bench whose response was measured on a monitor, and its geometry on one (None: no file)."""
    head = CalibrationHead(
        kind="photometric", bits=8, response="light.csv", who="", when=when, instrument="", unit=""
    )
    response = {"w": np.linspace(0.0, 1.0, 256)}
    write_calibration(folder / "light.toml", head, response, 0.01, NotesTable(), identity=light)
    collimator = {}
    if place is not None:
        q = np.array([1.0, 0.0, 0.0, 0.0])
        notes = Notes({}, ErrorTable(), MadeTable(when=when), place)
        write_geometry(folder / "place.toml", monitor_camera((320, 240), 57.65, 60.0, q), q, notes)
        collimator = {"geometry": "place.toml"}
    monitor = {"calibration": "light.toml", "calibration_valid_days": VALID_DAYS}
    (folder / "bench.toml").write_text(
        bench_text({"monitor": monitor, "collimator": collimator}), encoding="utf-8"
    )
    return read_bench_file(folder / "bench.toml")


@pytest.mark.parametrize(
    ("days", "words"), [(VALID_DAYS, ""), (VALID_DAYS + 1, "was measured 91 days ago")]
)
def test_a_file_holds_for_as_many_days_as_the_bench_says(tmp_path, days, words):
    # a person may have written the hour, too
    for when in (MEASURED.isoformat(), f" {MEASURED.isoformat()} 14:05, in the lab"):
        fault = check_monitor(bench(tmp_path, when=when), OWN, later(days)).fault
        assert bool(fault) == bool(words)
        assert words in fault


@pytest.mark.parametrize(
    ("light", "now", "fault", "notice"),
    [
        (OWN, OWN, "", ""),
        (OWN, OTHER, "another monitor", ""),
        (OWN, msgspec.structs.replace(OWN, bits=8), "bits 10, now 8", ""),
        (SET, OWN, "", NOT_READ),
        (OWN, None, "", "this display does not say which monitor it is"),
        (None, OWN, "", "light.toml names no monitor"),
    ],
)
def test_a_monitor_is_held_against_the_one_that_was_measured(tmp_path, light, now, fault, notice):
    check = check_monitor(bench(tmp_path, light), now, later(1))
    assert bool(check.fault) == bool(fault)
    assert fault in check.fault
    assert bool(check.notice) == bool(notice)
    assert notice in check.notice


def test_what_is_doubtful_of_one_file_is_told_beside_another_that_is_not(tmp_path):
    """Only the response was measured with the monitor's settings known."""
    check = check_monitor(bench(tmp_path, SET, OWN), OWN, later(1))
    assert (check.fault, check.notice) == ("", NOT_READ)
    both = check_monitor(bench(tmp_path, SET, SET), OWN, later(1))
    assert both.notice == NOT_READ


@pytest.mark.parametrize(
    ("readings_sha256", "fault"), [("0" * 64, ""), (None, "was measured 400 days ago")]
)
def test_old_files_are_fresh_by_a_certificate_of_readings_alone(tmp_path, readings_sha256, fault):
    """One made from the files has looked at no monitor."""
    file = bench(tmp_path)
    monitor = {"identity": msgspec.to_builtins(OWN)}
    empty = dict.fromkeys(("read_by", "who", "where", "ambient", "traceability"), "")
    certificate = Certificate(
        kind=KIND,
        number="C-1",
        made=later(399).isoformat(),
        valid_until=later(900).isoformat(),
        hilstar="1.0",
        bench="bench.toml",
        bench_sha256=file.sha256,
        files={},
        monitor=monitor,
        collimator={},
        instrument={},
        decision="guard-band",
        conforms=None,
        trials=0,
        two_digits_stand=True,
        inputs=[],
        figures=[],
        not_assessed=[],
        measurands={},
        reference_sha256=readings_sha256,
        **empty,
    )
    (tmp_path / "certificate.json").write_bytes(msgspec.json.encode(certificate))
    certify = msgspec.structs.replace(file.config.certify, certificate="certificate.json")
    config = msgspec.structs.replace(file.config, certify=certify)
    check = check_monitor(replace(file, config=config), OWN, later(400))
    assert bool(check.fault) == bool(fault)
    assert fault in check.fault
