"""Three heads beside one source: real processes, one of them killed and one stopped."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

from scipy.spatial.transform import Rotation

from hilstar.server.record.ledger_records import frame_records
from tests.support.commands import assert_refused, run_hilstar, typed
from tests.support.forks import HILSTAR, Started
from tests.support.heads import MOUNTINGS, heads_file
from tests.support.pages import gone
from tests.support.senders import free_port, publisher, talking
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.screens import recorded

ICRS_TO_BODY = Rotation.from_euler("zyx", [10, 20, 30], degrees=True)
SENT = tuple(ICRS_TO_BODY.inv().as_quat().tolist())  # x, y, z, w, from the body to the ICRS
CONVENTION = 'convention = { scalar = "last", direction = "cam_to_icrs" }\n'
SAME_RAD = 1e-9
# by then a head has told that it draws, in its own time; one that has not may take a minute to
# begin
BEGUN_FRAMES = 60


def children(parent: int) -> dict[str, int]:
    """The processes of the heads, by name."""
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdecimal() else []
            if (
                b"--head-of" in words
                and int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1]) == parent
            ):
                found[
                    Path(next(word for word in words if word.endswith(b".toml")).decode()).stem
                ] = int(entry.name)
        except (OSError, IndexError):
            continue  # it has just ended
    return found


def test_a_head_that_is_killed_or_hangs_stops_no_other_and_is_begun_again(tmp_path):
    """All have one body, whatever else the convention of its sender is."""
    lines = tmp_path / "said.txt"
    with publisher() as (sender, port), talking(sender, 50.0, SENT), lines.open("w") as said:
        path = heads_file(tmp_path, port)
        path.write_text(path.read_text() + CONVENTION)
        command = [
            *HILSTAR,
            *typed(f"serve {path} --headless --json --ledger {tmp_path}/run.mcap"),
        ]
        with Started(command, stdout=subprocess.PIPE, stderr=said, text=True) as process:
            try:
                wait_for(lambda: lines.read_text().count("the first attitude has come") >= 3)
                ledgers = [tmp_path / f"run.{name}.mcap" for name in MOUNTINGS]
                wait_for(lambda: all(len(recorded(ledger)) > BEGUN_FRAMES for ledger in ledgers))
                heads = children(process.pid)
                os.kill(heads["b"], signal.SIGKILL)
                os.kill(heads["c"], signal.SIGSTOP)
                wait_for(lambda: lines.read_text().count("it is started again") == 2)
                wait_for(lambda: lines.read_text().count("the first attitude has come") == 5)
                assert children(process.pid)["a"] == heads["a"]
            finally:
                process.send_signal(signal.SIGINT)
            out, _ = process.communicate(timeout=PATIENCE_S)
    told = json.loads(out)["heads"]
    assert [told[name]["restarts"] for name in "abc"] == [0, 1, 1], lines.read_text()
    assert "b: its process ended (signal 9); it is started again" in lines.read_text()
    for name, mounting in MOUNTINGS.items():
        again = ".again1" if name != "a" else ""
        ledger = tmp_path / f"run.{name}{again}.mcap"
        shown = [record.q for record in frame_records(ledger) if record.q is not None]
        camera = Rotation.from_quat(mounting, scalar_first=True) * ICRS_TO_BODY
        off = Rotation.from_quat(shown, scalar_first=True) * camera.inv()
        assert off.magnitude().max() < SAME_RAD
    assert not children(process.pid)


def test_a_page_s_port_that_is_taken_is_found_before_a_head_begins(tmp_path):
    page = free_port()
    while (second := free_port()) != page + 1:  # each head's page has the port after the one before
        page = second
    with socket.create_server(("127.0.0.1", second)), publisher() as (_, port):
        path = heads_file(tmp_path, port)
        options = ["--headless", "--console", f"127.0.0.1:{page}", "--duration", "5"]
        assert_refused(
            run_hilstar("serve", path, *options),
            2,
            f"--console 127.0.0.1:{second}: cannot listen there",
        )


def test_a_folder_too_deep_for_a_socket_is_one_line(tmp_path):
    place = tmp_path / ("deep" * 25)
    place.mkdir()
    environment = {**os.environ, "TMPDIR": str(place)}
    with publisher() as (_, port):
        path = heads_file(tmp_path, port)
        ended = run_hilstar("serve", path, "--headless", "--duration", "1", env=environment)
    assert ended.returncode == 2, ended.stderr
    assert "set TMPDIR to a folder whose path is shorter" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_killed_run_leaves_no_folder_after_the_next_one(tmp_path):
    # pytest's own folder may be too deep for the sockets of heads
    folder = tempfile.TemporaryDirectory()
    place = Path(folder.name)
    environment, lines = {**os.environ, "TMPDIR": str(place)}, tmp_path / "said.txt"
    with publisher() as (sender, port), talking(sender, 50.0, SENT), lines.open("w") as said:
        command = [*HILSTAR, "serve", str(heads_file(tmp_path, port, names="ab")), "--headless"]
        with Started(command, stdout=subprocess.DEVNULL, stderr=said, env=environment) as process:
            try:
                wait_for(lambda: lines.read_text().count("the first attitude has come") >= 2)
                heads = children(process.pid).values()
            finally:
                process.kill()
        wait_for(lambda: all(map(gone, heads)), "the heads end with their run")
        assert list(place.glob("hilstar-head*"))
        ended = run_hilstar(*command[3:], "--duration", "0.5", env=environment)
        assert ended.returncode in {0, 4}, ended.stderr
    assert not list(place.glob("hilstar-*"))
    folder.cleanup()
