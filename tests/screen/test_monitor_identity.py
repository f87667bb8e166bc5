"""Which monitor this is, on a real X.Org server (dummy driver): a change is refused, and what is
forced stays visible.
"""

from __future__ import annotations

import datetime
import json
import subprocess
import tomllib
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.display.calibration import CalibrationHead, NotesTable, write_calibration
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, monitor_camera, write_geometry
from hilstar.display.identity import MonitorIdentity
from hilstar.display.response import gamma_response
from hilstar.display.window.this_monitor import identity_here
from hilstar.server.console.run_status import RunSource, RunStatus
from hilstar.server.record.ledger_records import EventRecord, run_records
from tests.screen.test_monitors import on_dummy
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here
from tests.support.forks import HILSTAR, Started
from tests.support.ledgers import read_run
from tests.support.pages import ADDRESS, PageAddress
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.xorg import Xorg
from tests.unit.server.test_machine_row import edid

TODAY = datetime.datetime.now(datetime.UTC).date()
NAMED = 'display = "DUMMY0"\ncalibration = "response.toml"'
DDCUTIL = """#!/bin/sh
[ "$1 $2 $3 $4 $5 $6 $7" = "getvcp 10 12 14 C0 --terse --edid" ] || exit 1
printf 'VCP 10 C %d 100\\nVCP 12 C 75 100\\nVCP 14 SNC x%02x\\nVCP C0 CNC x00 xff x04 xb0\\n'
"""


def plugged(server: Xorg, block: bytes = edid()) -> AbstractContextManager[None]:
    """A monitor that says what it is."""
    return server.property("DUMMY0", "EDID", block)


def first_identity(server: Xorg) -> MonitorIdentity:
    with plugged(server):
        found = identity_here("DUMMY0")
    assert found is not None
    return found


def ddcutil(folder: Path, brightness: int = 40, preset: int = 5) -> None:
    """A stand-in for the program, whose answers are in the form of ddcutil 1.4.1; no such
    monitor was there.
    """
    program = folder / "ddcutil"
    program.write_text(DDCUTIL.replace("'\n", f"' {brightness} {preset}\n"))
    program.chmod(0o755)


def measured_bench(
    folder: Path,
    identity: MonitorIdentity | None,
    when: datetime.date | str = TODAY,
    keys: str = "",
) -> Path:
    """A bench whose response and geometry were measured on that monitor."""
    light = {"w": gamma_response(8).light}
    head = CalibrationHead("photometric", "", str(when), "", "relative", 8, "response.csv")
    write_calibration(folder / "response.toml", head, light, 0.0, NotesTable(), identity=identity)
    q = np.array([1.0, 0, 0, 0])
    notes = Notes({}, ErrorTable(), MadeTable(when=str(when)), identity)
    write_geometry(folder / "geometry.toml", monitor_camera((640, 480), 57.65, 60.0, q), q, notes)
    path = on_dummy(folder, f"{NAMED}\n{keys}")
    path.write_text(
        path.read_text().replace("[collimator]", '[collimator]\ngeometry = "geometry.toml"')
    )
    return path


def played(path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """The bench on the screen of DISPLAY, for 0.2 s."""
    run = run_hilstar if "--force" in options else run_hilstar_here
    return run("replay", path, path.parent / "still.csv", "--stop", "0.2", "--json", *options)


def test_the_display_says_which_monitor_it_is_and_how_it_is_driven(here, tmp_path, monkeypatch):
    ddcutil(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    found = first_identity(here)
    assert found.name() == "DEL DELL U2412M, serial CN0F00BAR123, on DUMMY0 at 640x480@59.94"
    assert (found.week, found.year, found.bits, found.gamma_ramp, found.window_system) == (
        14,
        2012,
        8,
        "straight",
        (),
    )
    assert (found.brightness, found.contrast, found.colour_preset, found.hours) == (40, 75, 5, 1200)
    assert identity_here("no such display") is None and identity_here("dummy0") == identity_here(0)
    monkeypatch.delenv("DISPLAY")
    assert identity_here(0) is None


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "another monitor": (
        {"edid": edid("DELL P2423D")},
        "this is DEL DELL P2423D, serial CN0F00BAR123",
    ),
    "no EDID": ({"edid": b"\0"}, "another monitor"),
    "mode": ({"xrandr": ("--mode", "640x480_120")}, "mode 640x480@59.94, now 640x480@119.88"),
    "gamma ramp": ({"xrandr": ("--gamma", "1.01:1:1")}, "gamma ramp straight, now "),
    "brightness": ({"ddc": (41, 5)}, "brightness 40, now 41"),
    "colour preset": ({"ddc": (40, 11)}, "colour preset 5, now 11"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_of_the_monitor_is_refused_in_a_line_that_names_both(
    here, tmp_path, monkeypatch, name
):
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    ddcutil(tmp_path)
    was = first_identity(here)
    path = measured_bench(tmp_path, was)
    change, words = CHANGES[name]
    with ExitStack() as undone:
        undone.enter_context(plugged(here, change.get("edid", edid())))
        if "xrandr" in change:
            here.xrandr("--output", "DUMMY0", *change["xrandr"])
            undone.callback(
                here.xrandr, "--output", "DUMMY0", "--mode", "640x480", "--gamma", "1:1:1"
            )
        ddcutil(tmp_path, *change.get("ddc", (40, 5)))
        refused = played(path)
    both = ("response.toml was measured on", "geometry.toml was measured on", was.name())
    assert_refused(
        refused, 3, *both, words, "; add --force, or measure it again: hilstar certify --again"
    )


def test_each_command_with_a_screen_refuses_and_a_headless_one_says_nothing(here, tmp_path):
    path = measured_bench(tmp_path, first_identity(here))
    still = tmp_path / "still.csv"
    path.write_text(
        path.read_text() + '\n[attitude]\nendpoint = "tcp://127.0.0.1:*"\nbind = true\n'
    )
    with plugged(here, edid("DELL P2423D")):
        for command in (
            ("serve", path),
            ("first-light", path, "-o", tmp_path / "s", "--grab", "false {output}"),
        ):
            assert_refused(run_hilstar_here(*command), 3, "this is DEL DELL P2423D")
        doctor = run_hilstar_here("doctor", path)
        assert doctor.returncode == 3 and "this is DEL DELL P2423D" in doctor.stderr
        assert (
            "CHANGED monitor     DEL DELL P2423D, serial CN0F00BAR123, on DUMMY0" in doctor.stdout
        )
        headless = run_hilstar_here("replay", path, still, "--headless", "--stop", "0.1", "--json")
        assert headless.returncode == 0 and "monitor" not in headless.stderr
    with plugged(here):
        assert run_hilstar_here("doctor", path).returncode == 0


def test_what_is_forced_stays_on_status_page_and_ledger(here, tmp_path):
    path, ledger = measured_bench(tmp_path, first_identity(here)), tmp_path / "run.mcap"
    options = ["--force", "--json", "--ledger", str(ledger), "--console", "127.0.0.1:0"]
    command = [*HILSTAR, "replay", str(path), str(tmp_path / "still.csv"), *options]
    with (
        plugged(here, edid("DELL P2423D")),
        Started(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=here.env
        ) as process,
    ):
        try:
            host, port, _ = next(
                found for line in process.stderr if (found := ADDRESS.search(line))
            ).groups()
            page, words = (
                PageAddress(host, int(port), ""),
                "shown by --force: response.toml was measured on DEL",
            )
            wait_for(
                lambda: any(reason.startswith(words) for reason in page.json("/health")["reasons"])
            )
            process.terminate()
            out, told = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 0, told
    assert "this is DEL DELL P2423D" in told and "shown anyway (--force)" in told
    line, _ = json.loads(out)["screen"]["forced"]  # the other one: swaps do not wait
    assert "another monitor" in line
    events = [
        one for one in run_records(ledger) if isinstance(one, EventRecord) and one.kind == "forced"
    ]
    assert any("this is DEL DELL P2423D" in event.detail for event in events)
    output = json.loads(read_run(ledger).head["output"])
    assert output["monitor_identity"]["model"] == "DELL P2423D" and line in output["forced"]
    status = RunStatus(RunSource("", "", 60.0, forced=line))
    assert ("forced", line, False) in status.lines(0)


def test_calibrate_writes_the_monitor_that_this_machine_has(here, tmp_path):
    path = measured_bench(tmp_path, None)
    light = "".join(f"{code},w,{0.01 + (code / 255) ** 2.2}\n" for code in [*range(0, 256, 15)] * 2)
    (tmp_path / "measured.csv").write_text(f"code,channel,value\n{light}")
    lines = "".join(
        f"{','.join(map(str, q))},{','.join(map(str, q))},1\n" for q in np.eye(4).tolist()
    )
    (tmp_path / "pairs.csv").write_text(f"qw,qx,qy,qz,tw,tx,ty,tz,valid\n{lines}")
    photometric = ("photometric", tmp_path / "measured.csv", "-o", tmp_path / "light.toml")
    alignment = ("alignment", path, tmp_path / "pairs.csv", "-o", tmp_path / "aligned.toml")
    for command, written in ((photometric, "light.toml"), (alignment, "aligned.toml")):
        with plugged(here):
            made = run_hilstar_here("calibrate", *command)
        assert made.returncode == 0, made.stderr
        assert (
            "measured on DEL DELL U2412M, serial CN0F00BAR123, on DUMMY0 at 640x480@59.94"
            in made.stderr
        )
        assert (
            tomllib.loads((tmp_path / written).read_text())["monitor_identity"]["serial"]
            == "CN0F00BAR123"
        )
    path.write_text(
        path.read_text().replace("resolution_px = [640, 480]", "resolution_px = [320, 240]")
    )
    # another display than the bench's
    assert "measured on" not in run_hilstar_here("calibrate", *alignment).stderr


def test_a_forced_first_light_says_so_in_its_session_and_on_its_page(here, tmp_path):
    path, session = measured_bench(tmp_path, first_identity(here)), tmp_path / "s"
    with plugged(here, edid("DELL P2423D")):
        told = run_hilstar(
            "first-light", path, "-o", session, "--grab", "false {output}", "--force", env=here.env
        )
    assert "this is DEL DELL P2423D" in told.stderr and told.returncode == 1  # no image came
    kept = json.loads((session / "session.json").read_text())
    assert "another monitor" in kept["forced"][0] and kept["steps"][1]["verdict"] == "done"
    assert "this is DEL DELL P2423D" in (session / "first-light.html").read_text()


def test_old_files_are_refused_by_their_date_and_undated_or_built_in_ones_are_noticed(
    here, tmp_path
):
    old = measured_bench(tmp_path, None, TODAY - datetime.timedelta(days=181))
    assert_refused(
        played(old),
        3,
        "response.toml was measured 181 days ago",
        "calibration_valid_days = 180",
        "--force",
    )
    noticed = run_hilstar_here("doctor", measured_bench(tmp_path, None, "some day in spring"))
    assert noticed.returncode == 0
    lacking = (
        "response.toml names no monitor and no date; geometry.toml names no monitor and no date:"
        " whether this"
    )
    assert noticed.stdout.count(lacking) == 1
    built_in = played(on_dummy(tmp_path), "--force")
    assert (
        built_in.returncode == 0 and built_in.stderr.count('"srgb" is built in: whether this') == 1
    )


@pytest.mark.parametrize(("days", "valid", "code"), [(180, 180, 0), (181, 180, 3), (181, 400, 0)])
def test_a_monitor_that_says_nothing_is_doubted_and_its_files_grow_old(
    here, tmp_path, days, valid, code
):
    """`doctor` as an example: the files were measured on this connector and in this mode, and
    more is not known.
    """
    when = TODAY - datetime.timedelta(days=days)
    told = run_hilstar_here(
        "doctor",
        measured_bench(tmp_path, identity_here(0), when, f"calibration_valid_days = {valid}"),
    )
    assert told.returncode == code, told.stderr
    assert "no EDID: the monitor is told apart by connector and mode alone" in told.stdout
