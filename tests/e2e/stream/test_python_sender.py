"""`hilstar.Sender` against `hilstar serve`, over each of its roads."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest

import hilstar
from hilstar.attitude.wire.protocol import HEALTH_CLOCK_SYNCHRONISED
from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_hilstar_here
from tests.support.senders import ORION, free_port
from tests.support.servers import interrupted, listening
from tests.support.waiting import wait_for
from tests.support.wire.ptys import Cable

CLOCK_AHEAD_NS = 10**15


def send_until(sender: hilstar.Sender, until=lambda: True, count: int = 60) -> int:
    """Send until something holds, `count` times at least; how many were sent."""
    sent = 0

    def told() -> bool:
        nonlocal sent
        sender.send(ORION, (0.0, 0.0, 1e-3))
        sent += 1
        return sent >= count and until()

    wait_for(told, "what the stream is for", poll_s=0.005)
    return sent


def simulation_ns() -> int:
    return time.monotonic_ns() + CLOCK_AHEAD_NS


@pytest.mark.parametrize("road", ["udp", "serial"])
def test_both_ways_the_status_comes_back_and_the_simulation_s_own_clock_is_known(tmp_path, road):
    port = free_port()
    with Cable(tmp_path) as cable:
        bench = tmp_path / "bench.toml"
        where = (
            f'source = "serial"\nport = "{cable.host}"\nbaud = 921600'
            if road == "serial"
            else f'source = "udp"\nport = {port}'
        )
        bench.write_text(f"{SMALL_BENCH}\n[attitude]\n{where}\n")
        to = f"serial:{cable.sender}@921600" if road == "serial" else f"udp://127.0.0.1:{port}"
        with (
            listening(bench, "reading" if road == "serial" else "bound to") as process,
            hilstar.Sender(to, clock=simulation_ns) as sender,
        ):
            assert sender.wait()

            def synchronised() -> bool:
                return sender.status is not None and bool(
                    sender.status.health & HEALTH_CLOCK_SYNCHRONISED
                )

            sent = send_until(sender, synchronised)
            time.sleep(0.2)
            summary = interrupted(process)
    assert summary["packets"]["accepted"] == summary["packets"]["received"] == sent
    clock = summary["clock"]
    # Host time minus the simulation's, both of this machine.
    assert abs(clock["offset_ms"] + CLOCK_AHEAD_NS / 1e6) <= clock["uncertainty_ms"] + 1.0


@pytest.mark.parametrize("connect", [True, False])
def test_with_keys_it_is_let_in_on_either_side_of_the_connection(tmp_path, connect):
    assert run_hilstar_here("keys", "-o", tmp_path / "keys").returncode == 0
    keys = tmp_path / "keys"
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    ours = (
        {"server_key": keys / "server.key"}
        if connect
        else {"allowed_clients": keys / "allowed_clients"}
    )
    theirs = (
        'allowed_clients = "keys/allowed_clients"'
        if connect
        else 'curve_server_key = "keys/server.key"'
    )
    mine, its = ("client", "server") if connect else ("server", "client")
    lines = [
        f'endpoint = "{endpoint}"',
        f"bind = {str(connect).lower()}",
        f'curve_secret_key = "keys/{its}.key_secret"',
        theirs,
    ]
    bench = tmp_path / "bench.toml"
    bench.write_text("\n".join([SMALL_BENCH, "[attitude]", *lines, ""]))
    with (
        listening(bench, "bound to" if connect else "waiting for a sender at") as process,
        hilstar.Sender(
            endpoint, connect=connect, secret_key=keys / f"{mine}.key_secret", **ours
        ) as sender,
    ):
        assert sender.wait()
        assert sender.status is None
        sent = send_until(sender)
        time.sleep(0.2)
        packets = interrupted(process)["packets"]
    assert packets["accepted"] == packets["received"] == sent


@pytest.mark.parametrize(
    ("q", "rate", "said"),
    [
        ((1, 0, 0), None, "3 numbers"),
        (ORION, (0, 0), "three numbers"),
        ((1, 1, 0, 0), None, "norm"),
        ((float("nan"), 0, 0, 1), None, "nan"),
        (ORION, (0, 0, 1e9), "rad/s"),
    ],
)
def test_what_hilstar_would_refuse_is_refused_where_it_is_sent(q, rate, said):
    with hilstar.Sender(f"udp://127.0.0.1:{free_port()}") as sender:
        with pytest.raises(hilstar.InputError, match=said):
            sender.send(q, rate)
        sender.send(np.array(ORION), np.zeros(3))


def test_a_road_that_is_none_is_refused():
    for to in ("udp://nowhere", "serial:", "carrier://pigeon"):
        with pytest.raises(hilstar.InputError):
            hilstar.Sender(to)


def test_a_simulator_that_imports_it_brings_no_renderer_and_no_catalogue():
    code = (
        "import sys, hilstar; hilstar.Sender; print(*({'moderngl', 'glfw', 'astropy', 'matplotlib'}"
        " & set(sys.modules)))"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "\n"
    )
