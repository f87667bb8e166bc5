"""UDP: real sockets of this machine, real processes."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hilstar.attitude.wire.endpoint import AllowedSenders, bound_place
from hilstar.attitude.wire.packet import AttitudeSample, TimeRequest, decode, encode
from hilstar.attitude.wire.udp import UdpLink
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import angle_between_rad, propagate
from hilstar.server.bench.build import load
from hilstar.server.pacer import Shown
from hilstar.server.run_progress import Running
from hilstar.server.send_log import BadCable, Faults, send, spin_samples
from hilstar.server.sender import UdpSender
from hilstar.server.serve import Outlet
from tests.support.benches import LIVE_BENCH
from tests.support.commands import assert_refused, run_hilstar_here, sent, typed
from tests.support.forks import HILSTAR, Started
from tests.support.live_runs import attitudes, serve_until
from tests.support.senders import free_port, packet
from tests.support.servers import Run, Served, interrupted, listening, until_said
from tests.support.waiting import PATIENCE_S, wait_for

START_DEG = (84.057, -1.2, 0.0)
RATE_RAD_S = np.radians([0.0, 0.0, 20.0])
# A packet's float32 rate of 20 deg/s (0.35 rad/s) predicts over 100 ms; and rounding.
PREDICTED_RAD = 0.35 * 0.1 * 2**-24 * 2 + 1e-9
ANSWERED_S = 0.3
A_BUSY_MACHINE_S = ("frame-late", "frame-given-up", "stale", "fresh")  # and no fault of a sender's


def udp_bench(folder: Path, *lines: str) -> Path:
    path = folder / "udp.toml"
    path.write_text("\n".join([LIVE_BENCH, "[attitude]", 'source = "udp"', *lines, ""]))
    return path


def test_a_sender_over_ipv6_that_starts_first_waits_none_is_lost_and_both_sides_talk(tmp_path):
    port = free_port()
    options = typed(f"--spin z,1 --rate 200 --count 300 --to udp://[::1]:{port} --json")
    with Started(
        [*HILSTAR, "send", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as sender:
        assert sender.stderr is not None
        assert "waiting for a listener" in sender.stderr.readline()
        with listening(
            udp_bench(tmp_path, f'bind = "[::1]:{port}"'), f"bound to udp://[::1]:{port}"
        ) as process:
            told = json.loads(sender.communicate(timeout=PATIENCE_S)[0])
            process.has_received(300)
            summary = interrupted(process)
    assert told["sent"] == summary["packets"]["accepted"] == summary["packets"]["received"] == 300
    assert told["requests"] >= 1 and told["statuses"] >= 1
    clock = summary["clock"]
    assert clock["mode"] == "exchange"
    # Both processes have the same clock: the offset is its own error.
    assert abs(clock["offset_ms"]) <= clock["uncertainty_ms"] + 1.0


def test_lost_corrupted_and_reordered_datagrams_add_up(tmp_path):
    port = free_port()
    with listening(
        udp_bench(tmp_path, f'endpoint = "udp://127.0.0.1:{port}"'), "bound to"
    ) as process:
        faults = ["--lose", "10%", "--corrupt", "5%", "--reorder", "--jitter", "1", "--seed", "3"]
        told = sent(
            f"udp://127.0.0.1:{port}", "--spin", "z,1", "--rate", "400", "--count", "400", *faults
        )
        process.has_received(told["sent"])
        summary = interrupted(process)
    packets = summary["packets"]
    assert told["lost"] and told["corrupted"] and told["reordered"]
    assert packets["received"] == told["sent"] == 400 - told["lost"]
    assert packets["refused_by"]["crc"] == told["corrupted"]
    assert packets["refused_by"]["time"] == told["reordered"]
    assert packets["accepted"] == packets["received"] - told["corrupted"] - told["reordered"]


def json_of_packet(data: bytes) -> bytes:
    """The same attitude as JSON that counts nothing; what is no attitude stays as it is."""
    event = decode(data)
    if not isinstance(event, AttitudeSample) or event.rate_cam_rad_s is None:
        return data
    return json.dumps(
        {"t_ns": event.t_ns, "q": [*event.q_icrs_to_cam], "rate": [*event.rate_cam_rad_s]}
    ).encode()


@pytest.mark.parametrize("form", [bytes, json_of_packet], ids=["packets", "JSON"])
def test_nothing_wrong_is_drawn_over_a_bad_network(tmp_path, form: Callable[[bytes], bytes]):
    """A turn of 20 deg/s; datagrams lost, corrupted, reordered, every fifth twice: each attitude
    drawn is that of its time.
    """
    count = doubled = 0
    port = free_port()
    allowed, notices = AllowedSenders(), Notices()
    with (
        load(udp_bench(tmp_path, f"port = {port}")) as bench,
        UdpLink(bound_place(None, port, None), allowed, notices) as link,
        UdpSender(link.endpoint) as road,
    ):

        def put(data: bytes) -> None:
            nonlocal count, doubled
            road.put(form(data))
            count += 1
            if count % 5 == 0:
                doubled += 1
                road.put(form(data))

        stop = threading.Event()
        cable = BadCable(Faults(0.10, 0.05, 0.05), np.random.default_rng(7), put)
        sender = threading.Thread(
            target=send, args=(cable, spin_samples(RATE_RAD_S, 200.0, START_DEG), stop)
        )
        sender.start()

        def enough(frames: list[Shown], run: Running) -> bool:
            if len(attitudes(frames)) > 70 and doubled > 30:
                stop.set()
            return not sender.is_alive() and run.packets.received == count + doubled

        run, frames = serve_until(bench, link, enough, Outlet(notices=notices))
        stop.set()
        sender.join()
        summary = msgspec.to_builtins(run)
    shown = [(t_ns, attitude.q_icrs_to_cam) for t_ns, attitude in attitudes(frames)]
    assert len(shown) > 70
    assert doubled > 30
    assert summary["packets"]["refused"] >= doubled + cable.tally.corrupted
    assert set(summary["events"]) <= {"first-attitude", *A_BUSY_MACHINE_S}
    first_ns, first = shown[0]
    for t_ns, q in shown:
        assert (
            angle_between_rad(q, propagate(first, RATE_RAD_S, (t_ns - first_ns) / 1e9))
            < PREDICTED_RAD
        )


GOOD = packet(1, 1_000_000)
WRONG = {
    "format": [
        b"",
        b"\0",
        GOOD[:-1],
        GOOD + b"\0",
        bytes(1400),
        bytes(65_000),
        b"{" * 65_000,
        b'{"t_ns": 1}',
    ],
    "crc": [b"\xff" * 64, GOOD[:30] + bytes([GOOD[30] ^ 8]) + GOOD[31:], GOOD[:-1] + b"\0"],
    "nan": [packet(1, 2_000_000, q=(float("nan"), 0, 0, 1))],
    "norm": [packet(1, 2_000_000, q=(2, 0, 0, 0))],
}


def test_an_address_that_is_not_listed_is_counted_and_never_answered_and_malformed_datagrams_by_reason(
    tmp_path,
):
    port = free_port()
    bench = udp_bench(tmp_path, f'bind = "127.0.0.1:{port}"', 'allow = ["127.0.0.1", "10.0.0.0/8"]')
    command = [*HILSTAR, "serve", str(bench), "--headless", "--json"]
    with (
        Run(command) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listed,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        served = Served(process, port)
        try:
            served.await_line("bound to")
            process.shows()
            listed.bind(("127.0.0.1", 0))
            stranger.bind(("127.0.0.2", 0))
            stranger.settimeout(ANSWERED_S)
            listed.settimeout(PATIENCE_S)
            listed.connect(("127.0.0.1", port))
            for k in range(40):
                listed.send(packet(k, time.monotonic_ns()))
                for data in (reason[k] for reason in WRONG.values() if k < len(reason)):
                    listed.send(data)
                stranger.sendto(packet(k, time.monotonic_ns(), q=(1, 0, 0, 0)), ("127.0.0.1", port))
                stranger.sendto(encode(TimeRequest(k, 1)), ("127.0.0.1", port))
                time.sleep(0.01)
            listed.send(packet(40, time.monotonic_ns()))  # what is counted before it, is
            refused = {reason: len(messages) for reason, messages in WRONG.items()}
            process.has_received(41 + sum(refused.values()))
            assert decode(listed.recv(100)) is not None  # a status or a time request
            with pytest.raises(TimeoutError):
                stranger.recv(100)
            summary = served.summary()
        finally:
            process.kill()
    assert summary["packets"]["accepted"] == 41
    assert summary["packets"]["refused_by"] == {"time": 0, **refused}
    assert summary["link"]["rejected"] == 80
    assert summary["events"]["sender-not-allowed"] == 1
    assert "second-sender" not in summary["events"]
    assert served.count("127.0.0.2") == 1


def test_a_look_at_where_a_live_stream_points_answers_a_sender_that_waits(tmp_path):
    port = free_port()
    command = [
        *HILSTAR,
        *typed(f"send --spin z,0 --radec 30,40,50 --rate 50 --to udp://127.0.0.1:{port}"),
    ]
    with Started(command, stderr=subprocess.PIPE, text=True) as sender:
        try:
            result = run_hilstar_here("attitude", udp_bench(tmp_path, f"port = {port}"), "--json")
        finally:
            sender.kill()
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["ra_deg"], told["dec_deg"]) == pytest.approx((30.0, 40.0), abs=1e-9)


def test_a_sender_that_comes_back_on_another_port_is_answered_there(tmp_path):
    """Without a number it is another sender, until the first was silent for `stale_after_ms`."""
    port = free_port()
    with listening(udp_bench(tmp_path, f"port = {port}"), "bound to") as process:
        for _ in range(2):
            with UdpSender(f"udp://127.0.0.1:{port}") as road:
                k = iter(range(10**9))

                def answered(road=road, k=k) -> bool:
                    road.put(packet(next(k), time.monotonic_ns()))
                    return road.statuses > 2 and road.requests > 0

                wait_for(answered, "statuses and time requests", poll_s=0.01)
        packets = interrupted(process)["packets"]
    assert packets["refused"] == packets["refused_by"]["source"] > 0


def unread_bytes(port: int) -> int:
    """What waits in the kernel for whoever is bound to a UDP port."""
    rows = (line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:])
    return sum(
        int(row[4].partition(":")[2], 16)
        for row in rows
        if int(row[1].partition(":")[2], 16) == port
    )


def test_a_flood_costs_little_and_its_newest_attitude_is_shown(tmp_path):
    port = free_port()
    # For 0.3 s, and until stdin closes: a machine without a free core takes longer to send more
    # than may come.
    flood = (
        "import select, socket, sys, time\ns = socket.socket(2, 2)\ns.connect(('127.0.0.1',"
        " int(sys.argv[1])))\n"
    )
    flood += "end = time.time() + 0.3\n"
    flood += (
        "while time.time() < end or not select.select([0], [], [], 0)[0]: [s.send(b'?' * 64) for _"
        " in range(500)]"
    )
    with listening(udp_bench(tmp_path, f"port = {port}"), "bound to") as process:
        process.shows()
        with subprocess.Popen(
            [sys.executable, "-c", flood, str(port)], stdin=subprocess.PIPE
        ) as sender:
            until_said(process, "packets per second")
            sender.communicate(timeout=PATIENCE_S)
        wait_for(lambda: unread_bytes(port) == 0, "the flood is read")
        assert (
            sent(f"udp://127.0.0.1:{port}", "--spin", "z,1", "--rate", "100", "--count", "20")[
                "sent"
            ]
            == 20
        )
        process.has_accepted(20)
        summary = interrupted(process)
    assert summary["packets"]["accepted"] == 20
    # one, and more where the sender stood still for a second
    assert 1 <= summary["events"]["flood"] <= 3
    assert summary["link"]["flooded"] > 500
    assert summary["frames"] + summary["missed_frames"] >= 30


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (['bind = "0.0.0.0:5560"'], "allow"),
        (['bind = "[::]"'], "allow"),
        (['bind = "192.168.1.20"', "allow = []"], "allow"),
        (['bind = "127.0.0.1:5560"', "port = 5561"], "disagree"),
        (["port = 5560", 'endpoint = "udp://127.0.0.1:5561"'], "disagree"),
        (['bind = "[::1]:5560"', 'endpoint = "udp://127.0.0.1:5560"'], "disagree"),
        (['endpoint = "tcp://127.0.0.1:5561"'], "udp://ADDRESS:PORT"),
        (["bind = false"], "bind"),
        (['bind = "simulator.local:5560"'], "not an address"),
        (['bind = "224.0.0.1:5560"'], "not an address"),
        (['bind = "::1:99999"'], "not an address"),
        (["port = 65536"], "65535"),
        (["port = -1"], "65535"),
        (['port = "/dev/ttyUSB0"'], "65535"),
        (['allow = ["somewhere"]'], "allow"),
        (['allow = ["192.168.1.20/24"]'], "host bits"),
        (["lockstep = true"], "lockstep"),
    ],
)
def test_keys_that_are_wrong_or_disagree_get_one_line(tmp_path, lines, said):
    result = run_hilstar_here(
        "serve", udp_bench(tmp_path, *lines), "--headless", "--duration", "0.1"
    )
    assert_refused(result, 2, "udp.toml: [attitude]", said)


def test_keys_of_udp_are_refused_on_another_road(tmp_path):
    for line in ('bind = "127.0.0.1:5560"', 'allow = ["127.0.0.1"]'):
        bench = udp_bench(tmp_path, line)
        bench.write_text(bench.read_text().replace('"udp"', '"zmq"'))
        assert_refused(
            run_hilstar_here("serve", bench, "--headless", "--duration", "0.1"), 2, "udp"
        )
    bench = udp_bench(tmp_path, "port = 5560")
    bench.write_text(bench.read_text().replace('"udp"', '"serial"'))
    assert_refused(
        run_hilstar_here("serve", bench, "--headless", "--duration", "0.1"), 2, "/dev/ttyUSB0"
    )


def test_a_port_in_use_an_address_of_another_machine_and_a_wrong_target_get_one_line(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        bench = udp_bench(tmp_path, f"port = {other.getsockname()[1]}")
        assert_refused(
            run_hilstar_here("serve", bench, "--headless", "--duration", "0.1"), 2, "in use"
        )
    bench = udp_bench(tmp_path, 'bind = "192.0.2.1:5560"', 'allow = ["192.0.2.2"]')
    assert_refused(
        run_hilstar_here("serve", bench, "--headless", "--duration", "0.1"),
        2,
        "not an address of this machine",
    )
    for target in ("udp://", "udp://127.0.0.1", "udp://127.0.0.1:0", "udp://::1:5560"):
        assert_refused(
            run_hilstar_here("send", "--spin", "z,1", "--to", target), 2, "udp://HOST:PORT"
        )
    assert_refused(
        run_hilstar_here("send", "--spin", "z,1", "--to", "udp://127.0.0.1:5560", "--connect"),
        2,
        "--connect",
    )
