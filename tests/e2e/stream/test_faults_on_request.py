"""A run with a scenario and a stream of faults, over real sockets; and from its ledger the same pictures twice."""

from __future__ import annotations

import json
import threading
import time

import pytest

from tests.support.benches import LIVE_BENCH, attitude_table
from tests.support.commands import run_hilstar_here
from tests.support.senders import ORION, packet, publisher
from tests.support.servers import listening, summary_of

pytestmark = pytest.mark.e2e

SCENARIO = """
seed = 2
[[fault]]
kind = "cosmic-rays"
name = "rays"
at_s = 0.2
for_s = 0.4
number = 20
electrons = 5e4
[[fault]]
kind = "blank"
name = "cover"
"""
MESSAGES = (
    b"no JSON",
    json.dumps({"kind": "false-star", "name": "ghost", "tracker_px": [500, 500], "electrons": 1e5}).encode(),
    json.dumps({"kind": "false-star", "name": "ghost", "tracker_px": [500, 500], "electrons": 1e5}).encode(),  # on already
    b'{"start": "cover"}',
    b'{"stop": "cover"}',
)
STEP_S = 0.01


def test_a_live_run_takes_faults_from_file_and_stream_and_is_replayed(tmp_path):
    scenario, ledger, bench = tmp_path / "faults.toml", tmp_path / "run.mcap", tmp_path / "bench.toml"
    scenario.write_text(SCENARIO)
    with publisher() as (attitudes, port), publisher() as (faults, fault_port):
        stream = f'[faults]\nendpoint = "tcp://127.0.0.1:{fault_port}"\n'
        bench.write_text(LIVE_BENCH + attitude_table(port, stream))
        options = ("--scenario", str(scenario), "--ledger", str(ledger), "--frames", "100")
        with listening(bench, "2 faults, 1 of them at their time", *options) as process:
            sending = threading.Thread(target=send_until_the_end, args=(attitudes, process), daemon=True)
            sending.start()
            while "first attitude" not in process.stderr.readline():
                pass
            for message in MESSAGES:
                faults.send(message)
                time.sleep(0.15)  # frames come at 60 Hz: each message has one of its own, or several
            summary = summary_of(process)
            sending.join()
    told = summary["faults"]
    assert told["started"] == {"rays": 1, "ghost": 1, "cover": 1} and told["on"] == ["ghost"]
    assert told["stream"] == {"messages": 5, "refused": 2, "dropped_unread": 0}
    pictures = []
    for name in ("first", "second"):
        result = run_hilstar_here("replay", bench, ledger, "--headless", "--speed", "max", "-o", tmp_path / name, "--json")
        assert json.loads(result.stdout)["faults"]["recorded"] == told["started"]
        pictures.append([path.read_bytes() for path in sorted((tmp_path / name).glob("*.png"))])
    assert pictures[0] == pictures[1] and len(pictures[0]) == summary["frames"]


def send_until_the_end(attitudes, process):
    sequence = 0
    while process.poll() is None:
        attitudes.send(packet(sequence, time.monotonic_ns(), ORION))
        sequence += 1
        time.sleep(STEP_S)
