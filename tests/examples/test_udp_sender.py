"""The C++ sender against `hilstar serve` over UDP, and the turn that it says."""

from __future__ import annotations

import re
import socket
import subprocess
from pathlib import Path

import pytest

from hilstar.attitude.wire.packet import decode
from tests.examples.support import (
    assert_refused_in_one_line,
    assert_turns,
    commands,
    compiled_by_readme,
)
from tests.support.benches import SMALL_BENCH
from tests.support.compilers import STRICT_CPP
from tests.support.senders import free_port
from tests.support.servers import interrupted, listening
from tests.support.waiting import PATIENCE_S

STREAM_S = 2


@pytest.fixture(scope="module")
def streamer(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("udp") / "udp_sender"
    return compiled_by_readme(commands("A C++ sender over UDP")[0], target, *STRICT_CPP)


def test_the_sender_streams_into_hilstar_and_both_sides_talk(tmp_path, streamer):
    address, port = "::1", free_port()
    bench = tmp_path / "udp.toml"
    bench.write_text(
        f'{SMALL_BENCH}\n[attitude]\nsource = "udp"\nbind = "{address}"\nport = {port}\n'
    )
    with listening(bench, "bound to") as process:
        process.shows()  # before that it answers late
        command = [streamer, address, str(port), "100", str(STREAM_S), "5"]
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, check=True
        )
        process.has_received(100 * STREAM_S)
        summary = interrupted(process)
    match = re.fullmatch(rf"sent {100 * STREAM_S}, requests (\d+), statuses (\d+)\n", result.stdout)
    assert match is not None, result.stdout
    # A second has 8 quick time requests and 10 statuses.
    assert int(match[1]) >= 4
    assert int(match[2]) >= 4
    assert summary["packets"]["received"] == summary["packets"]["accepted"] == 100 * STREAM_S
    assert summary["clock"]["mode"] == "exchange"
    # Both processes have the same clock.
    assert abs(summary["clock"]["offset_ms"]) <= summary["clock"]["uncertainty_ms"] + 1.0


def test_the_sender_turns_as_its_rate_says(streamer):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        end.settimeout(PATIENCE_S)
        command = [streamer, "127.0.0.1", str(end.getsockname()[1]), "500", "0.1", "20"]
        subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=True)
        samples = [decode(end.recv(100)) for _ in range(50)]
    assert_turns(samples, 20.0)


def test_the_sender_says_in_one_line_what_is_wrong(streamer):
    wrong = [
        ([], 2),
        (["127.0.0.1", "9", "1", "1", "x"], 2),
        (["127.0.0.1", "no port", "1", "1", "1"], 1),
    ]
    assert_refused_in_one_line(streamer, wrong)
