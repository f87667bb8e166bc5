"""The sender for MATLAB and Octave, in Octave: its packets bit for bit, and its stream into
`hilstar serve`.
"""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AnswerPacket, AttitudeSample, encode
from tests.examples.support import section
from tests.support.benches import ROOT, SMALL_BENCH
from tests.support.senders import free_port
from tests.support.servers import interrupted, listening
from tests.support.waiting import PATIENCE_S

OCTAVE = shutil.which("octave-cli")
pytestmark = pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed")
STREAM_S, SENT = 1.5, 300
LAST = 20  # datagrams, a tenth of a second
HAS_UDP = "exit(double(isempty(pkg('list', 'instrument-control'))))"


def octave(program: str) -> subprocess.CompletedProcess[str]:
    command = [OCTAVE, "--norc", "--quiet", "--path", str(ROOT / "examples"), "--eval", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def random_samples(rng: np.random.Generator) -> list[AttitudeSample]:
    samples = [
        AttitudeSample(t_ns, np.array([0.5, 0.5, -0.5, 0.5]), None, 2**32 - 1)
        for t_ns in (0, -1, 2**63 - 1, -(2**63))
    ]
    for k in range(40):
        q = rng.normal(size=4)
        rate = None if k % 3 == 0 else rng.normal(size=3)
        samples.append(
            AttitudeSample(int(rng.integers(2**62)), q / np.linalg.norm(q), rate, k, bool(k % 2))
        )
    return samples


def test_its_packets_are_those_of_python_bit_for_bit(rng):
    samples = random_samples(rng)
    lines = []
    for sample in samples:
        q = " ".join(f"{c:.17g}" for c in sample.q_icrs_to_cam)
        rate = (
            ""
            if sample.rate_cam_rad_s is None
            else " ".join(f"{c:.17g}" for c in sample.rate_cam_rad_s)
        )
        # A literal is a double, and exact to 2^53 only.
        high, low = divmod(sample.t_ns, 2**31)
        t_ns = f"int64({high}) * int64({2**31}) + int64({low})"
        call = (
            f"hilstar_packet({sample.sequence}, {t_ns}, [{q}], [{rate}],"
            f" {str(sample.discontinuity).lower()})"
        )
        lines.append(f"printf('%02x', {call}); printf('\\n');\n")
    result = octave("".join(lines))
    assert result.stdout.split() == [encode(sample).hex() for sample in samples], result.stderr


def test_its_answers_are_those_of_python_bit_for_bit():
    answer = AnswerPacket(7, 1 | 2 | 8, 42, (0.6, 0.0, 0.8, 0.0), (0.0, 0.25, -1.5), 12)
    result = octave(
        "printf('%02x', hilstar_answer(7, int64(42), [0.6 0 0.8 0], [0 0.25 -1.5], 10, 12));"
    )
    assert result.stdout.strip() == encode(answer).hex(), result.stderr


def test_its_stream_is_taken(tmp_path):
    if octave(HAS_UDP).returncode != 0:
        pytest.skip("octave-instrument-control is not installed")
    port = free_port()
    bench = tmp_path / "udp.toml"
    bench.write_text(f'{SMALL_BENCH}\n[attitude]\nsource = "udp"\nport = {port}\n')
    call = "udp_sender('127.0.0.1', 5560, 200, 10, 0.5)"
    assert call in section("A MATLAB or Octave sender over UDP")
    with listening(bench, "bound to") as process:
        result = octave(call.replace("5560", str(port)).replace("10, ", f"{STREAM_S}, "))
        assert f"sent {SENT}" in result.stdout, result.stderr
        # a busy machine begins to read late
        assert any("the first attitude has come" in line for line in process.stderr)
        summary = interrupted(process)
    # The run may end before it has read the last ones.
    assert SENT - LAST < summary["packets"]["received"] <= SENT
    assert summary["packets"]["accepted"] == summary["packets"]["received"]
    assert summary["packets"]["lost"] == 0
    assert summary["clock"]["jumps"] == 0
