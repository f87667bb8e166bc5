"""The live status of a run, on a terminal and elsewhere, beside a real sender."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import time
from pathlib import Path

import pytest

from hilstar.server.console import run_status
from tests.support.benches import LIVE_BENCH, attitude_table, still_log
from tests.support.commands import HILSTAR, run_hilstar_here, typed
from tests.support.forks import Started
from tests.support.senders import free_port, packet, publisher, talking
from tests.support.servers import serving
from tests.support.waiting import PATIENCE_S, repeating

pytestmark = pytest.mark.e2e
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
EVENT_TIME = re.compile(r"^hilstar: \d\d:\d\d:\d\d\.\d{3}Z ", re.MULTILINE)


def bench_for(tmp_path: Path, port: int) -> Path:
    path = tmp_path / "bench.toml"
    path.write_text(LIVE_BENCH + attitude_table(port))
    return path


def test_a_terminal_shows_the_attitude_and_turns_to_stale(tmp_path):
    """As a person sees it: through a pseudo-terminal."""
    ours, theirs = pty.openpty()
    raw, seen = b"", ""

    def read_until(words: str) -> None:
        nonlocal raw, seen
        deadline_s = time.monotonic() + PATIENCE_S
        while words not in seen:
            assert time.monotonic() < deadline_s, f"no {words!r} in {seen[-2000:]}"
            if select.select([ours], [], [], 0.1)[0]:
                # which may end within a letter, or within an escape sequence
                raw += os.read(ours, 65536)
                seen = ESCAPES.sub("", raw.decode(errors="ignore"))

    with publisher() as (sender, port):
        command = [
            *HILSTAR,
            *typed(f"serve {bench_for(tmp_path, port)} --headless --ledger {tmp_path}/run.mcap"),
        ]
        with Started(
            command, stdout=theirs, stderr=theirs, env={**os.environ, "COLUMNS": "120"}
        ) as process:
            os.close(theirs)
            try:
                read_until("none yet: the frames are blank")
                with talking(sender):
                    read_until("RA 84.0000, Dec -1.0000")
                    read_until("run.mcap")
                read_until("STALE")
                sender.send(b"not an attitude")
                read_until("1 refused (format 1)")
                process.terminate()
                read_until("renderer")
            finally:
                process.kill()
    os.close(ours)
    events = [line for line in seen.splitlines() if line.startswith("hilstar: ")]
    for words in (
        "the first attitude has come",
        "the attitude is stale",
        "packet refused (format)",
    ):
        assert any(words in line for line in events), events
    assert all(EVENT_TIME.match(line) for line in events if "attitude" in line or "refused" in line)


def test_elsewhere_a_plain_line_comes_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr(run_status, "PLAIN_EACH_S", 0.2)
    begun_s = time.monotonic()
    with publisher() as (sender, port), talking(sender):
        result = run_hilstar_here(
            "serve", bench_for(tmp_path, port), "--headless", "--duration", "1.2"
        )
    assert result.returncode == 0, result.stderr
    told = [line for line in result.stderr.splitlines() if "; packets " in line]
    assert 2 <= len(told) <= (time.monotonic() - begun_s) / 0.2, result.stderr
    assert re.search(
        r"attitude RA 84\.0000, Dec -1\.0000, roll 0\.0000 deg, .* ms old; frames \d+ of 72"
        r" \([\d.]+/s\)",
        told[-1],
    )
    received = int(re.search(r"packets (\d+) received", told[-1])[1])
    assert received > 50, "200 a second are sent"


def test_a_replay_tells_its_frames_too(tmp_path, small_bench_file, monkeypatch):
    monkeypatch.setattr(run_status, "PLAIN_EACH_S", 0.3)
    result = run_hilstar_here(
        "replay", small_bench_file, still_log(tmp_path / "log.csv", 1.0), "--headless"
    )
    assert result.returncode == 0, result.stderr
    assert re.search(
        r"attitude RA 84\.0570.*frames \d+ of 61 .*source replaying .*log\.csv", result.stderr
    )


def test_a_run_whose_packets_were_all_refused_says_why_and_what_to_change(tmp_path):
    """Its last line was that no attitude came, and to start the sender."""
    with publisher() as (sender, port), serving(tmp_path, port) as process:
        with repeating(
            lambda: sender.send(packet(0, time.monotonic_ns(), q=(84.0, -1.2, 0.0, 0.0))), 0.01
        ):
            process.has_refused(20)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 4
    last = err.splitlines()[-1]
    assert re.fullmatch(
        r"all \d+ packets from tcp://127.0.0.1:\d+ were refused, \d+ for norm: send unit"
        r" quaternions, .*",
        last,
    )
    assert "connected to the sender" in err


def test_a_run_that_never_had_an_attitude_says_so_at_its_end(tmp_path):
    result = run_hilstar_here(
        "serve", bench_for(tmp_path, free_port()), "--headless", "--duration", "0.3"
    )
    assert result.returncode == 4
    assert "no attitude came from tcp://127.0.0.1" in result.stderr.splitlines()[-1]
    assert result.stderr.startswith("waiting for a sender at tcp://127.0.0.1:")
    assert "connected to" not in result.stderr
