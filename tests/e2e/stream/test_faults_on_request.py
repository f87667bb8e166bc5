"""A run with a scenario and a stream of faults, over real sockets; and from its ledger the same
pictures twice.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

from hilstar.attitude.logs.mcap_log import read_messages
from tests.support.benches import LIVE_BENCH, attitude_table
from tests.support.commands import run_hilstar_here
from tests.support.senders import ORION, await_subscriber, packet, publisher
from tests.support.servers import interrupted, listening, until_said
from tests.support.waiting import wait_for

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
GHOST = json.dumps(
    {"kind": "false-star", "name": "ghost", "tracker_px": [500, 500], "electrons": 1e5}
).encode()
# Each message, and what the ledger then says.
MESSAGES = (
    (b"no JSON", ["refused"]),
    (GHOST, ["start ghost"]),
    (GHOST, ["refused", "refused"]),  # it is on already
    (b'{"start": "cover"}', ["start cover"]),
    (b'{"stop": "cover"}', ["end cover"]),
)
STEP_S = 0.01


def told_faults(ledger: Path) -> list[str]:
    """What the ledger of a run says so far of faults: those that began and ended, and the
    messages that were refused.
    """
    records = [json.loads(data) for data in read_messages(ledger, "/fault")]
    events = [json.loads(data)["kind"] for data in read_messages(ledger, "/event")]
    return [f"{each['event']} {each['name']}" for each in records] + ["refused"] * events.count(
        "fault-refused"
    )


def test_a_live_run_takes_faults_from_file_and_stream_and_is_replayed(tmp_path):
    scenario, ledger, bench = (
        tmp_path / "faults.toml",
        tmp_path / "run.mcap",
        tmp_path / "bench.toml",
    )
    scenario.write_text(SCENARIO)
    with publisher() as (attitudes, port), publisher() as (faults, fault_port):
        stream = f'[faults]\nendpoint = "tcp://127.0.0.1:{fault_port}"\n'
        bench.write_text(LIVE_BENCH + attitude_table(port, stream))
        options = ("--scenario", str(scenario), "--ledger", str(ledger))
        with listening(bench, "2 faults, 1 of them at their time", *options) as process:
            sending = threading.Thread(
                target=send_until_the_end, args=(attitudes, process), daemon=True
            )
            sending.start()
            until_said(process, "first attitude")
            await_subscriber(faults)
            for message, effects in [*MESSAGES, (None, ["end rays"])]:
                if message is not None:
                    faults.send(message)
                wait_for(
                    lambda wanted=Counter(effects): wanted <= Counter(told_faults(ledger)), effects
                )
            summary = interrupted(process)
            sending.join()
    faulty = summary["faults"]
    assert faulty["started"] == {"rays": 1, "ghost": 1, "cover": 1} and faulty["on"] == ["ghost"]
    assert faulty["stream"] == {"messages": 5, "refused": 2, "dropped_unread": 0}
    pictures = []
    for name in ("first", "second"):
        result = run_hilstar_here(
            "replay", bench, ledger, "--headless", "--speed", "max", "-o", tmp_path / name, "--json"
        )
        assert json.loads(result.stdout)["faults"]["recorded"] == faulty["started"]
        pictures.append([path.read_bytes() for path in sorted((tmp_path / name).glob("*.png"))])
    assert pictures[0] == pictures[1] and len(pictures[0]) == summary["frames"]


def send_until_the_end(attitudes, process):
    sequence = 0
    while process.poll() is None:
        attitudes.send(packet(sequence, time.monotonic_ns(), ORION))
        sequence += 1
        time.sleep(STEP_S)
