"""The C sender against `hilstar serve` over a real pty, and against the rules of its protocol."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hilstar.attitude.wire.packet import AttitudeSample, Status, TimeReply, TimeRequest
from hilstar.attitude.wire.serial_link import SerialLink
from tests.examples.support import assert_refused_in_one_line, assert_turns
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.compilers import STRICT, compiled
from tests.support.servers import interrupted, listening
from tests.support.waiting import PATIENCE_S
from tests.support.wire.ptys import Cable

EXAMPLES = ROOT / "examples"
BAUD = 921_600
CLOCK_OFFSET_S = 1000


@pytest.fixture
def cable(tmp_path) -> Iterator[Cable]:
    with Cable(tmp_path) as cable:
        yield cable


@pytest.fixture(scope="module")
def uart(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("serial") / "serial_sender"
    compiler = ("gcc", "-std=c99", "-D_POSIX_C_SOURCE=200809L", "-O2", *STRICT)
    header = ("-I", ROOT / "firmware_protocol")
    return compiled(target, *compiler, *header, EXAMPLES / "serial_sender.c", "-lm")


def sender_counts(output: str) -> dict[str, int]:
    match = re.fullmatch(r"sent (\d+), requests (\d+), statuses (\d+)\n", output)
    assert match is not None, output
    return dict(zip(("sent", "requests", "statuses"), map(int, match.groups()), strict=True))


def test_the_sender_streams_into_hilstar_and_both_sides_know_each_other_s_clock(
    tmp_path, cable, uart
):
    bench_file = tmp_path / "serial.toml"
    bench_file.write_text(
        f'{SMALL_BENCH}\n[attitude]\nsource = "serial"\nport = "{cable.host}"\nbaud = {BAUD}\n'
    )
    command = [str(uart), str(cable.sender), str(BAUD), "100", "1.5", "5", str(CLOCK_OFFSET_S)]
    with listening(bench_file, "reading serial:") as process:
        process.shows()
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert result.returncode == 0, result.stderr
        counted = sender_counts(result.stdout)
        process.has_received(counted["sent"])
        summary = interrupted(process)
    packets = summary["packets"]
    assert counted["sent"] == 150 == packets["received"] == packets["accepted"]
    assert packets["refused"] == 0
    # 1.5 s have 8 quick time requests and one more, and 15 statuses, less what the start took.
    assert counted["requests"] >= 4
    assert counted["statuses"] >= 4
    clock = summary["clock"]
    assert clock["mode"] == "exchange"
    # Host time minus the sender's, whose clock is ahead.
    assert abs(clock["offset_ms"] + 1000 * CLOCK_OFFSET_S) <= clock["uncertainty_ms"] + 1.0
    assert clock["jumps"] == 0


def listened(link: SerialLink, program: subprocess.Popen) -> list[tuple[int, object]]:
    """What the program sends until it ends: (arrival, event)."""
    heard: list[tuple[int, object]] = []
    while program.poll() is None:
        heard += [(arrival.host_ns, arrival.event) for arrival in link.receive(20)]
    while rest := link.receive(200):
        heard += [(arrival.host_ns, arrival.event) for arrival in rest]
    return heard


def test_the_sender_turns_as_its_rate_says_and_answers_on_its_own_clock(cable, uart):
    command = [str(uart), str(cable.sender), str(BAUD), "200", "0.5", "20", str(CLOCK_OFFSET_S)]
    with (
        SerialLink(str(cable.host), BAUD) as link,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program,
    ):
        first = link.receive(5000)
        t1_ns = time.monotonic_ns()
        link.send(TimeRequest(5, t1_ns))
        link.send(Status(0, 0, 0, 0, 0, 0, 0))
        heard = [(arrival.host_ns, arrival.event) for arrival in first] + listened(link, program)
        assert program.stdout is not None
        counted = sender_counts(program.stdout.read())
    samples = [event for _, event in heard if isinstance(event, AttitudeSample)]
    assert counted == {"sent": 100, "requests": 1, "statuses": 1}
    assert_turns(samples, 20.0)
    off_ns = [sample.t_ns - samples[0].t_ns - 5_000_000 * k for k, sample in enumerate(samples)]
    assert len(samples) == 100 and max(map(abs, off_ns)) <= 1
    ((t4_ns, reply),) = [(at_ns, event) for at_ns, event in heard if isinstance(event, TimeReply)]
    assert (reply.sequence, reply.t1_ns) == (5, t1_ns)
    offset_ns = CLOCK_OFFSET_S * 1_000_000_000
    assert t1_ns <= reply.t2_ns - offset_ns <= reply.t3_ns - offset_ns <= t4_ns


def test_the_sender_says_in_one_line_what_is_wrong(uart):
    wrong = [
        ([], 2),
        (["/dev/null", "115200", "1", "1", "x"], 2),
        (["/dev/null", "7", "1", "1", "1"], 2),
        (["/dev/null", "115200", "1", "1", "1"], 1),
    ]
    assert_refused_in_one_line(uart, wrong)
