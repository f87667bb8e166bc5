"""Whether a machine is well, by what is required alone; and what a bench file means on it."""

from __future__ import annotations

import datetime
import re
from dataclasses import replace

import pytest

from hilstar.display.identity import MonitorIdentity
from hilstar.display.render.context import Gpu
from hilstar.server import doctor
from hilstar.server.bench.measured_on import MonitorCheck
from hilstar.server.bench.star_size import PANELS
from hilstar.server.doctor import Check
from tests.support.benches import bench_text


@pytest.mark.parametrize(
    ("there", "gpus", "is_ok"),
    [(True, True, True), (False, True, False), (True, False, False)],
)
def test_a_machine_is_well_where_all_that_is_required_is_there(monkeypatch, there, gpus, is_ok):
    """Neither a display nor a serial port nor a camera is required."""

    def look() -> str:
        if there:
            return "here"
        raise doctor.HilstarError("not here")

    monkeypatch.setattr(doctor, "LOOKS", {"python": look})
    monkeypatch.setattr(doctor, "displays", list)
    monkeypatch.setattr(doctor, "serial_ports", list)
    monkeypatch.setattr(doctor, "lit_outputs", list)
    monkeypatch.setattr(doctor, "_gpus", lambda: Check("gpus", gpus, ""))
    monkeypatch.setattr(doctor, "_cameras", lambda: Check("cameras", False, "", required=False))
    found = doctor.examine()
    assert found.ok is is_ok
    oks = {check.name: (check.ok, check.required) for check in found.checks}
    assert oks == {
        "python": (there, True),
        "gpus": (gpus, True),
        "display": (False, False),
        "serial": (False, False),
        "cameras": (False, False),
    }


@pytest.mark.parametrize(
    ("ok", "required", "state"),
    [(True, True, "ok"), (False, True, "MISSING"), (False, False, "none"), (True, False, "ok")],
)
def test_only_what_is_required_is_missing(ok, required, state):
    line = Check("serial", ok, "no serial port", required).line()
    assert line == f"{state:8}serial      no serial port"


@pytest.mark.parametrize(
    ("listed", "window", "is_ok", "told"),
    [
        (["A", "B"], "A", True, "headless 0: A; 1: B; window A"),
        (
            ["A", "B"],
            "B",
            True,
            "headless 0: A; 1: B; window B (another than headless: [render] gpu",
        ),
        (["", "B"], "", True, "headless 0: opens no OpenGL 3.3; 1: B; window none"),
        ([""], "", False, "headless 0: opens no OpenGL 3.3; window none"),
        ([], "A", False, "headless EGL lists none; window A"),
    ],
)
def test_a_window_s_card_is_told_where_it_is_another_than_the_first(
    monkeypatch, listed, window, is_ok, told
):
    monkeypatch.setattr(doctor, "gpus", lambda: [Gpu(k, name) for k, name in enumerate(listed)])
    monkeypatch.setattr(doctor, "window_renderer", lambda: window)
    check = doctor._gpus()
    assert (check.name, check.ok, check.required) == ("gpu", is_ok, False)
    assert check.detail.removesuffix(" chooses)") == told


def test_a_card_is_named_by_its_vendor_and_device(monkeypatch, tmp_path):
    """As `lspci -n` does. A card without them has its driver's name alone."""
    for card, parts in (("card1", {}), ("card0", {"vendor": "0x8086", "device": "0x3e92"})):
        device = tmp_path / "class" / "drm" / card / "device"
        device.mkdir(parents=True)
        (tmp_path / "drivers" / f"of-{card}").mkdir(parents=True)
        (device / "driver").symlink_to(tmp_path / "drivers" / f"of-{card}")
        for name, text in parts.items():
            (device / name).write_text(f"{text}\n")
    monkeypatch.setattr(doctor, "SYS", tmp_path)
    # whose text would end its cell in the table of a page
    monkeypatch.setattr(doctor, "adapters", lambda: ["a | b"])
    assert doctor.row()["links"] == "ZeroMQ and UDP over loopback; serial a / b"
    drivers = doctor.row()["OpenGL"].partition("kernel driver ")[2]
    assert drivers == "of-card0 (8086:3e92), of-card1"


# A 27-inch office monitor behind 500 mm before a tracker of 50 mm.
WIDE = {
    "tracker": {"focal_length_mm": 50, "pixel_pitch_um": 5.5, "resolution_px": [2048, 2048]},
    "monitor": {"resolution_px": [2560, 1440], "pixel_pitch_um": 233.1},
    "collimator": {"focal_length_mm": 500},
}
TODAY = datetime.date(2026, 11, 30)
SERIAL = "CN0F00BAR123"
HALF_A_DIGIT = 1e-3  # of a pitch and a length, both written to four digits


def test_a_bench_is_examined_with_its_star_the_panels_that_would_do_and_its_monitor(
    tmp_path, monkeypatch
):
    """A panel's longest collimator is its shorter side over the field of the detector, by its
    lens's focal length.
    """
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(WIDE))
    there = MonitorIdentity(maker="DEL", model="U2412M", serial=SERIAL)
    monkeypatch.setattr(doctor, "identity_here", lambda display: there)
    (report,) = doctor.examine_bench(path, TODAY).values()
    screen, star, remedy, head, *panels, monitor, unknown = report.lines(path.name)
    assert screen.startswith("ok      bench.toml  screen 61.7 x 37.1 deg, tracker 12.9 deg")
    assert star.startswith("check   star        star 4.0 px sigma, of the sky 0.55")
    assert remedy.startswith(" " * 20 + "a star is 6.5 times as wide as the sky's")
    assert head.split()[:3] == ["panel", "pitch", "collimator,"]
    field_mm_per_mm = 2048 * 0.0055 / 50
    told = {}
    for line in panels:
        name, pitch_um, rest = re.fullmatch(r" {20}(\S.*?) +([\d.]+) um  (.+)", line).groups()
        told[name] = float(pitch_um), rest
    assert list(told) == [panel for panel, _, _ in PANELS]
    pitch_um, lengths = told["27-inch 5K"]
    longest_mm = 2880 * pitch_um * 1e-3 / field_mm_per_mm
    shortest_mm, _, farthest_mm, _ = lengths.split()
    assert float(farthest_mm) == pytest.approx(longest_mm, rel=HALF_A_DIGIT)
    assert int(shortest_mm) == 930
    assert told["24-inch Full HD"][1] == (
        "none: the star is 3.0 times as wide where the field fits"
    )
    assert monitor.startswith("ok      monitor     DEL U2412M, serial CN0F00BAR123, on")
    assert unknown.strip().startswith('[monitor] calibration = "srgb" is built in')
    keys = report.keys()
    assert keys["tracker_px_a_monitor_px"] == pytest.approx(4.24, abs=0.01)
    assert len(keys["star"]["would_do"]["panels"]) == len(PANELS)
    assert keys["monitor"] == {
        "monitor_identity": {"maker": "DEL", "model": "U2412M", "serial": SERIAL},
        "fault": "",
        "notice": unknown.strip(),
    }
    changed = replace(report, monitor=MonitorCheck(there, "measured on another one"))
    assert [line[:8] for line in changed.lines(path.name)][-1] == "CHANGED "
