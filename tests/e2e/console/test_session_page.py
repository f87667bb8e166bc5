"""The page of a session of first light: the patterns that the tracker looks at, and each step as
it ends.
"""

from __future__ import annotations

import os
import signal
import subprocess

import pytest

from tests.e2e.calibrate.test_first_light import plant
from tests.support.forks import HILSTAR, Started
from tests.support.pages import children, gone, live, page_of, picture_of
from tests.support.servers import Served
from tests.support.waiting import wait_for

pytestmark = pytest.mark.e2e


def is_orientation(said: object) -> bool:
    return isinstance(said, dict) and "orientation" in said.get("event", {}).get("line", "")


def is_lit(said: object) -> bool:
    return isinstance(said, bytes) and bool(picture_of(said)[1].any())


def test_a_session_shows_its_patterns_and_tells_its_steps(tmp_path):
    plant(tmp_path)
    command = [
        *HILSTAR,
        "first-light",
        str(tmp_path / "bench.toml"),
        "-o",
        str(tmp_path / "s"),
        "--console",
        "127.0.0.1:0",
    ]
    command += ["--virtual", str(tmp_path / "truth.toml"), "--patches", "0"]
    with Started(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=os.environ
    ) as process:
        try:
            page = page_of(Served(process, 0))
            with live(page) as link:
                said = link.await_message(lambda said: "hello" in said)
                assert (
                    said["hello"]["session"] and said["hello"]["command"] == "hilstar first-light"
                )
                link.want(picture=True, hz=10)
                link.await_message(is_orientation)
                head, levels = picture_of(link.await_message(is_lit))
                assert (head["w"], head["h"], str(levels.dtype)) == (640, 480, "uint16")
            assert page.json("/health")["ok"]
            pages = children(process.pid, "hilstar.server.console.server")
        finally:
            process.send_signal(signal.SIGKILL)
        wait_for(lambda: all(gone(pid) for pid in pages))
