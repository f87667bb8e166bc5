"""The examples of a tracker that answers, in C, C++ and Python: what they send is what hilstar
reads.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

import zmq

from hilstar.attitude.wire.packet import AnswerPacket, decode
from tests.examples.support import commands, compiled_by_readme
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.commands import run_hilstar_here
from tests.support.compilers import STRICT
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S

EXAMPLES = ROOT / "examples"
HEADING = "A tracker that answers"
Q = (0.5, 0.5, -0.5, 0.5)


def built(folder: Path, line: int) -> Path:
    """The program that the README's line builds, as strictly as compilers are."""
    words = commands(HEADING)[line]
    return compiled_by_readme(words, folder / words[-1], *STRICT)


def said_by(command: list) -> str:
    return subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=True
    ).stdout


def test_the_c_tracker_s_line_is_decoded(tmp_path):
    line = tmp_path / "line.bin"
    line.touch()
    assert said_by([built(tmp_path, 0), line, "1000", "5"]) == "sent 5\n"
    (tmp_path / "bench.toml").write_text(
        SMALL_BENCH + '\n[answers]\nsource = "serial"\nport = "/dev/ttyUSB0"\n'
    )
    found = json.loads(
        run_hilstar_here("answers", tmp_path / "bench.toml", "--from", line, "--json").stdout
    )
    assert found["counts"] == {"answers": 5, "valid": 5}
    assert [
        (tuple(row["q_icrs_to_cam"]), row["stars"], row["mode"]) for row in found["answers"]
    ] == [(Q, 12, "tracking")] * 5


def test_the_c_plus_plus_tracker_s_datagrams_are_answers(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        end.settimeout(PATIENCE_S)
        assert (
            said_by([built(tmp_path, 1), "127.0.0.1", str(end.getsockname()[1]), "1000", "5"])
            == "sent 5\n"
        )
        found = [decode(end.recv(100)) for _ in range(5)]
    assert [(each.sequence, each.q_icrs_to_cam, each.flags, each.stars) for each in found] == [
        (k, Q, 10, 12) for k in range(5)
    ]


def test_the_python_tracker_s_messages_are_answers():
    port = free_port()
    with zmq.Context() as context, context.socket(zmq.SUB) as end:
        end.connect(f"tcp://127.0.0.1:{port}")
        end.subscribe(b"")
        end.setsockopt(zmq.RCVTIMEO, PATIENCE_S * 1000)
        command = [
            sys.executable,
            EXAMPLES / "zmq_tracker.py",
            f"tcp://127.0.0.1:{port}",
            "50",
            "1000",
        ]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            found = decode(end.recv())
            process.terminate()
    assert isinstance(found, AnswerPacket)
    assert (found.q_icrs_to_cam, found.flags, found.stars) == (Q, 10, 12)
