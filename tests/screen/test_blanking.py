"""No screen goes dark during a run, and what the X server was set to comes back, however the run
ends.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hilstar.display.window.awake import Awake
from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.screens import xvfb
from tests.support.x11.xorg import Xorg, xorg

pytestmark = pytest.mark.screen
BEFORE, AWAKE = ("600", "300", "yes"), ("0", "no")


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Xorg]:
    """A real X server."""
    with xorg(tmp_path_factory.mktemp("xorg")) as running:
        yield running


@pytest.fixture(autouse=True)
def blanking(server):
    for words in (("s", "600", "300"), ("s", "blank")):
        xset(server, *words)
    assert blanking_of(server) == BEFORE


def xset(server: Xorg, *words: str) -> str:
    done = subprocess.run(
        ["xset", *words],
        env=server.env,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    return done.stdout


def blanking_of(server: Xorg) -> tuple[str, ...]:
    """Timeout, cycle, and whether blanking is preferred, as xset tells them."""
    text = xset(server, "q")
    patterns = (r"timeout:\s+(\d+)", r"cycle:\s+(\d+)", r"blanking:\s+(\w+)")
    found = [re.search(pattern, text) for pattern in patterns]
    return tuple("" if match is None else match[1] for match in found)


def awake(server: Xorg) -> bool:
    timeout, _, prefers = blanking_of(server)
    return (timeout, prefers) == AWAKE


@contextmanager
def shown_frames_of(
    server: Xorg, folder: Path, name: str = "bench", *options: str
) -> Iterator[subprocess.Popen[bytes]]:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.toml").write_text(SCREEN_BENCH)
    still_log(folder / "still.csv")
    command = [
        *HILSTAR,
        "replay",
        str(folder / f"{name}.toml"),
        str(folder / "still.csv"),
        "--force",
        *options,
    ]
    with (
        (folder / f"{name}.txt").open("wb") as said,
        Started(
            command, env=server.env, stdout=said, stderr=said, start_new_session=True
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("sign", "options"),
    [(signal.SIGINT, ()), (signal.SIGTERM, ("--windowed",)), (signal.SIGKILL, ("--windowed",))],
)
def test_nothing_blanks_during_a_run_and_all_is_as_before_after_it(server, tmp_path, sign, options):
    with shown_frames_of(server, tmp_path, "bench", *options) as process:
        wait_for(lambda: awake(server) or process.poll() is not None)
        assert process.poll() is None, (tmp_path / "bench.txt").read_text()
        process.send_signal(sign)
        process.wait(PATIENCE_S)
        if sign != signal.SIGKILL:
            assert blanking_of(server) == BEFORE  # before the command has ended
    wait_for(lambda: blanking_of(server) == BEFORE, "after a kill, within moments")


class InterruptedAwake(Awake):
    """A run that a signal ends while it waits for the first word of the process that prevents
    blanking, which has done it.
    """

    server: Xorg
    is_interrupted = False

    def _word(self) -> bytes:
        if not self.is_interrupted:
            self.is_interrupted = True
            wait_for(lambda: awake(self.server))
            raise KeyboardInterrupt
        return super()._word()


def test_a_run_that_is_ended_while_blanking_is_set_aside_restores_it(server, monkeypatch):
    monkeypatch.setenv("DISPLAY", server.display)
    monkeypatch.setattr(InterruptedAwake, "server", server, raising=False)
    with pytest.raises(KeyboardInterrupt):
        InterruptedAwake()
    assert blanking_of(server) == BEFORE


def test_a_kill_of_all_its_processes_restores_too(server, tmp_path):
    with shown_frames_of(server, tmp_path) as process:
        wait_for(lambda: awake(server) or process.poll() is not None)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)
    wait_for(lambda: blanking_of(server) == BEFORE)


def test_two_runs_on_one_server_keep_it_awake_until_the_last_ends(server, tmp_path):
    with shown_frames_of(server, tmp_path / "one", "one", "--windowed") as one:
        wait_for(lambda: awake(server))
        with shown_frames_of(server, tmp_path / "two", "two", "--windowed") as two:
            said = tmp_path / "two" / "two.txt"
            wait_for(lambda: "the first attitude has come" in said.read_text())
            one.send_signal(signal.SIGINT)
            one.wait(PATIENCE_S)
            wait_for(lambda: awake(server))
            two.send_signal(signal.SIGKILL)
    wait_for(lambda: blanking_of(server) == BEFORE)


def test_what_somebody_sets_meanwhile_is_prevented_and_comes_after(server, tmp_path):
    with shown_frames_of(server, tmp_path) as process:
        wait_for(lambda: awake(server) or process.poll() is not None)
        xset(server, "s", "120", "300")
        wait_for(lambda: awake(server) or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)
    assert blanking_of(server)[0] == "120"


def test_a_virtual_server_is_kept_awake_too(tmp_path):
    with xvfb(tmp_path, "640x480x24") as screen:
        xset(screen, "s", "600", "300")
        with shown_frames_of(screen, tmp_path) as process:
            wait_for(lambda: blanking_of(screen)[0] == "0")
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)
        assert blanking_of(screen)[0] == "600"
