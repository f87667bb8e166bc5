"""Settings of a display on a real X.Org server (dummy driver): wrong ones are refused, and their
own advice mends them.
"""

from __future__ import annotations

import ctypes
import json
import shlex
from pathlib import Path

import pytest

from hilstar.display.window.output_settings import OutputState, findings
from hilstar.display.window.randr import Randr, lit_outputs
from hilstar.display.window.watch import PresentEvents, is_straight, presented_as
from hilstar.server.record.ledger_records import EventRecord, run_records
from tests.screen.test_monitors import on_dummy, showing
from tests.support.commands import run_hilstar, run_hilstar_here
from tests.support.ledgers import read_run
from tests.support.waiting import PATIENCE_S, wait_for
from tests.unit.display.test_output_settings import HALF, edid


def dummy0() -> OutputState:
    return next(state for state in lit_outputs() if state.name == "DUMMY0")


def kinds(ledger: Path) -> set[str]:
    """The kinds of a ledger's events."""
    return {record.kind for record in run_records(ledger) if isinstance(record, EventRecord)}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("Broadcast RGB", "Limited 16:235"),
        ("max bpc", (6,)),
        ("dithering mode", "auto"),
        ("dither", "on"),
        ("CTM", HALF),
        ("Colorspace", "BT2020_RGB"),
        ("underscan", "on"),
        ("abm level", (2,)),
        ("TearFree", "on"),
    ],
)
def test_the_command_that_is_named_mends_a_wrong_property(here, name, wrong):
    with here.property("DUMMY0", name, wrong):
        (finding,) = findings(dummy0(), 8)
        command = shlex.split(finding.text.rsplit("; ", 1)[1])
        assert command[0] == "xrandr"
        here.xrandr(*command[1:])
        assert not list(findings(dummy0(), 8))


def test_a_mode_that_is_not_the_panel_s_own_is_mended_by_its_command(here):
    here.xrandr("--output", "DUMMY0", "--mode", "800x600")
    try:
        (finding,) = findings(dummy0(), 8)
        assert finding.refused and "800 x 600" in finding.text
        here.xrandr(*shlex.split(finding.text.rsplit("; ", 1)[1])[1:])
        assert not list(findings(dummy0(), 8))
    finally:
        here.xrandr("--output", "DUMMY0", "--mode", "640x480")


def test_other_outputs_and_the_edid_are_read(here):
    here.xrandr("--output", "DUMMY1", "--mode", "640x480", "--right-of", "DUMMY0")
    try:
        with here.property("DUMMY0", "EDID", edid((598, 336))):
            state = dummy0()
    finally:
        here.xrandr("--output", "DUMMY1", "--off")
    assert state.others == ("DUMMY1",) and state.fields()["size_mm"] == (598, 336)
    assert "EDID" not in state.properties


def test_the_ramp_is_read_as_it_is_set_and_an_output_that_is_off_has_none(here):
    with Randr() as randr:
        assert is_straight(randr.ramp("DUMMY0"))
        here.xrandr("--output", "DUMMY0", "--gamma", "1.2:1:1")
        assert not is_straight(randr.ramp("DUMMY0"))
        here.xrandr("--output", "DUMMY0", "--gamma", "1:1:1")
        assert randr.ramp("DUMMY1") == b"" == randr.ramp("no such output")


def test_nvidia_s_settings_are_asked_of_its_tool_where_its_driver_runs(here, monkeypatch, tmp_path):
    """A stand-in for nvidia-settings; no such driver was there."""
    tool = tmp_path / "nvidia-settings"
    tool.write_text(
        '#!/bin/sh\ncase "$3" in *CurrentDithering) echo 1;; *ColorRange) echo 0;; *) echo ERROR;;'
        " esac\n"
    )
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert "nvidia-settings: CurrentDithering" not in dummy0().properties
    monkeypatch.setattr("hilstar.display.window.randr.has_extension", lambda display, name: True)
    (finding,) = findings(dummy0(), 8)
    assert finding.refused and 'nvidia-settings -a "[DPY:DUMMY0]/Dithering=2"' in finding.text


def test_doctor_lists_outputs_with_their_properties_and_what_is_wrong(here):
    with here.property("DUMMY0", "Broadcast RGB", "Limited 16:235"):
        told = run_hilstar_here("doctor")
        listed = json.loads(run_hilstar_here("doctor", "--json").stdout)
    assert told.returncode == 0
    (output,) = listed["outputs"]
    refresh = f"{output['state']['refresh_hz']:.4g} Hz"
    words = f"check   output      DUMMY0, 640 x 480, {refresh}; Broadcast RGB Limited 16:235"
    assert words in told.stdout
    assert output["state"]["properties"]["Broadcast RGB"] == "Limited 16:235"
    assert 'xrandr --output DUMMY0 --set "Broadcast RGB" "Full"' in output["faults"][0]


def test_a_wrong_setting_is_refused_and_with_force_only_told_and_recorded(here, tmp_path):
    path, ledger = on_dummy(tmp_path), tmp_path / "run.mcap"
    with (
        here.property("DUMMY0", "dithering mode", "auto"),
        here.property("DUMMY0", "TearFree", "on"),
    ):
        refused = run_hilstar_here("replay", path, tmp_path / "still.csv")
        assert (
            refused.returncode == 3 and refused.stdout == "" and "Traceback" not in refused.stderr
        )
        last = refused.stderr.splitlines()[-1]
        assert "dithering mode of DUMMY0 is auto" in last
        assert last.endswith('xrandr --output DUMMY0 --set "dithering mode" "off"; or add --force')
        options = ("--force", "--json", "--stop", "0.3", "--ledger", ledger)
        forced = run_hilstar("replay", path, tmp_path / "still.csv", *options, env=here.env)
    assert forced.returncode == 0, forced.stderr
    assert (
        "dithering mode of DUMMY0 is auto" in forced.stderr
        and "shown anyway (--force)" in forced.stderr
    )
    assert "TearFree of DUMMY0 is on" in forced.stderr
    screen = json.loads(forced.stdout)["screen"]
    assert screen["output"]["properties"]["dithering mode"] == "auto"
    # llvmpipe does not use Present
    assert screen["presented"] == "unknown" and screen["gamma"] == {"frames": 0, "s": 0.0}
    assert json.loads(read_run(ledger).head["output"])["properties"]["TearFree"] == "on"


def test_another_program_s_gamma_ramp_is_told_once_and_its_frames_are_counted(server, tmp_path):
    path = on_dummy(tmp_path)
    with showing(server, path) as process:
        server.xrandr("--output", "DUMMY0", "--gamma", "1.7:1.4:1.2")
        wait_for(lambda: "gamma" in kinds(tmp_path / "run.mcap"))
        server.xrandr("--output", "DUMMY0", "--gamma", "1:1:1")
        wait_for(lambda: "gamma-straight" in kinds(tmp_path / "run.mcap"))
        process.terminate()
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert err.count("another program changed the display's gamma ramp") == 1
    said = json.loads(out)
    assert said["screen"]["gamma"]["frames"] > 0 and said["screen"]["gamma"]["s"] > 0
    assert said["events"]["gamma"] == 1


def test_frames_that_the_server_copies_are_told_as_copied(here, tmp_path: Path):
    """A client presents a pixmap itself: llvmpipe does not, and this server cannot flip."""
    x11, xcb, present = (
        ctypes.CDLL(name) for name in ("libX11.so.6", "libxcb.so.1", "libxcb-present.so.0")
    )
    pointer, number, long = ctypes.c_void_p, ctypes.c_ulong, ctypes.c_uint32
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = pointer, [ctypes.c_char_p]
    for name, arguments in (
        ("XDefaultRootWindow", [pointer]),
        (
            "XCreateSimpleWindow",
            [pointer, number, *[ctypes.c_int] * 2, *[ctypes.c_uint] * 3, *[number] * 2],
        ),
        ("XCreatePixmap", [pointer, number, *[ctypes.c_uint] * 3]),
    ):
        function = getattr(x11, name)
        function.restype, function.argtypes = number, arguments
    x11.XMapWindow.argtypes, x11.XSync.argtypes, x11.XCloseDisplay.argtypes = (
        [pointer, number],
        [pointer, ctypes.c_int],
        [pointer],
    )
    xcb.xcb_connect.restype, xcb.xcb_flush.argtypes, xcb.xcb_disconnect.argtypes = (
        pointer,
        [pointer],
        [pointer],
    )
    wide = ctypes.c_uint64
    present.xcb_present_pixmap.argtypes = [
        pointer, *[long] * 5, *[ctypes.c_int16] * 2, *[long] * 4, wide, wide, wide, long, pointer
    ]  # fmt: skip
    client = x11.XOpenDisplay(None)
    window = x11.XCreateSimpleWindow(client, x11.XDefaultRootWindow(client), 0, 0, 64, 64, 0, 0, 0)
    pixmap = x11.XCreatePixmap(client, window, 64, 64, 24)
    x11.XMapWindow(client, window)
    x11.XSync(client, 0)
    events = PresentEvents(window)
    connection = xcb.xcb_connect(None, None)
    try:
        assert events.modes() == [] and presented_as({}) == "unknown"
        for serial in range(3):
            present.xcb_present_pixmap(
                connection, window, pixmap, serial, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, None
            )
        xcb.xcb_flush(connection)
        seen: list[str] = []
        wait_for(lambda: seen.extend(events.modes()) or "copy" in seen)
        assert set(seen) <= {"copy", "skip"}
        assert presented_as({mode: seen.count(mode) for mode in seen}) == "copy"
    finally:
        events.close()
        xcb.xcb_disconnect(connection)
        x11.XCloseDisplay(client)
