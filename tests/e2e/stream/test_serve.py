"""The live stream: real ZeroMQ sockets, real processes."""

from __future__ import annotations

import contextlib
import json
import signal
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import zmq

from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.benches import SMALL_BENCH, attitude_table
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here
from tests.support.ledgers import read_run
from tests.support.senders import (
    await_subscriber,
    connected,
    free_port,
    packet,
    publisher,
)
from tests.support.servers import bound, serving, summary_of
from tests.support.waiting import CoreWaits, missed_in
from tests.support.wire.zmtp import greeted, part

SUMMARY_KEYS = {
    "frames",
    "duration_s",
    "fps",
    "frame_ms",
    "attitude_age_ms",
    "packets",
    "stars_drawn",
    "clipped",
}
SUMMARY_KEYS |= {
    "capped",
    "given_up",
    "missed_frames",
    "stale_frames",
    "gl_renderer",
    "gl_version",
    "fields_of_view",
    "star",
    "render_path",
    "stale_events",
    "receive_latency_ms",
    "clock",
    "reconnects",
    "events",
    "link",
    "beat",
    "blank_frames",
    "wrong_sky",
    "verdict",
}


@pytest.mark.timing
def test_packets_at_200_hz_all_arrive_with_garbage_between_them(tmp_path):
    """400 good ones; after every tenth, one each of: wrong CRC, NaN, norm, an old count, and bytes
    of no form.
    """
    with (
        publisher() as (sender, port),
        serving(tmp_path, port) as process,
        CoreWaits(process.pid) as waited,
    ):
        process.shows()
        start = time.monotonic_ns()
        for k in range(400):
            t_ns = start + k * 5_000_000
            time.sleep(max(0, (t_ns - time.monotonic_ns()) / 1e9))
            sender.send(packet(k, t_ns))
            if k % 10 == 9:
                broken = bytearray(packet(k, t_ns + 1))
                broken[20] ^= 4
                sender.send(bytes(broken))
                sender.send(packet(k, t_ns + 1, q=(float("nan"), 0, 0, 1)))
                sender.send(packet(k, t_ns + 1, q=(1.1, 0, 0, 0)))
                sender.send(packet(k, t_ns - 1))
                sender.send(np.random.default_rng(k).bytes(50))
        process.has_received(600)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    packets = summary["packets"]
    assert packets["accepted"] == 400
    assert packets["received"] == 600
    assert packets["refused_by"] == {
        "crc": 40,
        "norm": 40,
        "nan": 40,
        # a count that comes twice, at another time, is a second sender's
        "source": 40,
        "time": 0,
        "format": 40,
    }
    assert packets["refused"] == 200
    # A frame or a missed one for each sixtieth of the two seconds, whatever else the machine had
    # to do.
    assert summary["frames"] + summary["missed_frames"] >= 119
    assert summary["frames"] + missed_in(waited.s) > 80, (summary, waited.s)
    assert summary["stars_drawn"]["max"] > 0
    assert set(summary) == SUMMARY_KEYS


def test_json_and_multipart_messages_are_taken(tmp_path):
    with publisher() as (sender, port), serving(tmp_path, port) as process:
        sender.send(json.dumps({"t_ns": 1_000_000, "q": [1, 0, 0, 0], "rate": [0, 0, 0]}).encode())
        sender.send_multipart(
            [b"attitude", json.dumps({"t_ns": 2_000_000, "q": [1, 0, 0, 0]}).encode()]
        )
        sender.send_multipart([b"topic", b"more", packet(3, 3_000_000)])
        sender.send(b'{"t_ns": 4000000, "q": [NaN, 0, 0, 0]}')
        process.has_received(4)
        process.send_signal(signal.SIGINT)
        packets = summary_of(process)["packets"]
    assert (packets["accepted"], packets["refused_by"]["nan"]) == (3, 1)


def test_an_oversized_message_costs_a_connection_and_no_more(tmp_path):
    """2 MiB are over the limit: libzmq drops the connection for good, hilstar makes it anew."""
    with publisher() as (sender, port), serving(tmp_path, port) as process:
        for k in range(20):
            sender.send(packet(k, 1_000_000 * k))
        process.has_received(20)
        sender.send(bytes(2 << 20))
        await_subscriber(sender)
        for k in range(20, 120):
            sender.send(packet(k, 1_000_000 * k))
            time.sleep(0.005)
        process.has_received(120)
        process.send_signal(signal.SIGINT)
        packets = summary_of(process)["packets"]
    assert packets["accepted"] == 120
    assert packets["refused"] == 0


def test_a_silent_sender_shows_blank_frames_and_ends_in_order(tmp_path):
    """Its exit code says that it never had an attitude, and so does a line after two seconds."""
    with publisher() as (_, port), serving(tmp_path, port, "--frames", "150") as process:
        summary = summary_of(process, code=4)
    assert summary["events"]["no-attitude"] == 1
    assert summary["frames"] == summary["stale_frames"] == 150
    assert summary["attitude_age_ms"] == {"p50": None, "p99": None, "max": None}
    assert summary["stars_drawn"]["max"] == 0


@pytest.mark.parametrize(("on_stale", "stars_at_end"), [("hold", True), ("blank", False)])
def test_what_is_shown_after_the_stream_stops_is_the_policy_s(tmp_path, on_stale, stars_at_end):
    """One packet, then a second of silence: the frames after 100 ms are stale, and blank only
    where that was asked.
    """
    attitude = f'stale_after_ms = 100\nmax_extrapolation_ms = 50\non_stale = "{on_stale}"'
    with (
        publisher() as (sender, port),
        serving(tmp_path, port, "--duration", "1.5", attitude=attitude) as process,
    ):
        process.shows()
        sender.send(packet(0, 0, q=tuple(from_radec_roll_deg(84, -1, 0))))
        summary = summary_of(process)
    # Six or seven frames fall into 100 ms; all the others are stale, with those before the packet.
    assert 0 < summary["frames"] - summary["stale_frames"] <= 8
    mean, most = summary["stars_drawn"]["mean"], summary["stars_drawn"]["max"]
    assert (mean > 0.4 * most) is stars_at_end
    assert summary["frames"] + summary["missed_frames"] == 90


def test_hilstar_send_is_heard_by_serve_that_binds(tmp_path):
    port = free_port()
    with serving(tmp_path, port, attitude="bind = true") as process:
        sent = run_hilstar(
            f"send --spin z,1.5 --rate 200 --count 100 --to tcp://127.0.0.1:{port} --connect"
        )
        assert sent.returncode == 0, sent.stderr
        assert "100 packets sent" in sent.stderr
        process.has_received(100)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    assert (summary["packets"]["received"], summary["packets"]["refused"]) == (100, 0)
    assert None not in summary["attitude_age_ms"].values()


def test_a_sender_that_restarts_is_taken_up_again(tmp_path):
    ledger = tmp_path / "run.mcap"
    with (
        publisher() as (sender, port),
        serving(tmp_path, port, "--ledger", ledger) as process,
    ):
        assert process.stderr is not None
        for start_ns in (10**15, 0):  # the clock of the second run restarts
            for k in range(50):
                sender.send(packet(k, start_ns + k * 5_000_000))
                time.sleep(0.005)
            # What arrives before the first frame teaches the clock nothing; a loaded machine takes
            # seconds to draw that.
            while start_ns and "the first attitude has come" not in (
                line := process.stderr.readline()
            ):
                assert line, "serve ended before its first frame"
            time.sleep(0.5)  # between the two runs
        process.has_received(100)
        process.send_signal(signal.SIGINT)
        packets = summary_of(process)["packets"]
    assert packets["refused"] == 0
    assert packets["accepted"] == 100
    # frames are dated by the sender's clock as it is now
    assert read_run(ledger).frames[-1].light_ns < 10**13


def test_a_run_of_a_stated_time_ends_by_itself_and_without_an_attitude_with_code_4(tmp_path):
    """Half a second of 60 Hz are 30 frames, shown or missed."""
    bench = tmp_path / "bench.toml"
    bench.write_text(SMALL_BENCH + attitude_table(free_port()))
    result = run_hilstar_here("serve", bench, "--headless", "--duration", "0.5", "--json")
    assert result.returncode == 4
    summary = json.loads(result.stdout)
    assert summary["blank_frames"] == summary["frames"] > 0
    assert summary["frames"] + summary["missed_frames"] <= 30


def test_a_port_in_use_gets_one_line(tmp_path, small_bench_file):
    with publisher() as (_, port):
        small_bench_file.write_text(
            SMALL_BENCH + f'[attitude]\nbind = true\nendpoint = "tcp://127.0.0.1:{port}"\n'
        )
        result = run_hilstar_here("serve", small_bench_file, "--headless", "--duration", "1")
        assert_refused(result, 2, f"127.0.0.1:{port}", "in use")
        assert_refused(
            run_hilstar_here("send", "--spin", "z,1", "--to", f"tcp://127.0.0.1:{port}"),
            2,
            "in use",
        )


def test_lockstep_shows_one_frame_a_request_and_says_when(tmp_path):
    """Packets and JSON, a simulator's time that runs at any speed and goes back, and what is
    wrong: each gets its answer.
    """
    port = free_port()
    with (
        serving(tmp_path, port, attitude="lockstep = true") as process,
        connected(port, zmq.REQ) as asker,
    ):
        for k in range(50):
            asker.send(packet(k, k * 3_600_000_000_000))
            version, kind, health, frame, light_ns, age_ns, sequence, accepted, refused, crc = (
                struct.unpack("<BBHIqqIIII", body := asker.recv())
            )
            assert (version, kind, frame, sequence, accepted, refused) == (1, 4, k, k, k + 1, 0)
            assert (light_ns, age_ns) == (k * 3_600_000_000_000, 0)
            assert crc == zlib.crc32(body[:-4])
            assert health & 0b111 == 0
        asker.send_string(json.dumps({"t_ns": 5, "q": [1, 0, 0, 0]}))
        answer = json.loads(asker.recv())
        assert (answer["frame"], answer["light_t_ns"], answer["refused"]) == (50, 5, None)
        assert 0 < answer["shown_ns"] <= time.monotonic_ns()
        asker.send_string('{"t_ns": 6, "q": [1, 1, 0, 0]}')
        assert json.loads(asker.recv())["refused"]["reason"] == "norm"
        asker.send(b"nonsense")
        assert struct.unpack("<BBHI", asker.recv()[:8])[3] == 50
        asker.send(
            struct.pack("<BBHIq", 1, 2, 0, 9, 77)
            + struct.pack("<I", zlib.crc32(struct.pack("<BBHIq", 1, 2, 0, 9, 77)))
        )
        assert struct.unpack("<BBHIqqq", asker.recv()[:-4])[:5] == (1, 3, 0, 9, 77)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    assert summary["frames"] == 51
    assert (summary["packets"]["accepted"], summary["packets"]["refused"]) == (51, 2)
    assert summary["turn_ms"]["p50"] > 0


def test_lockstep_without_a_request_never_had_an_attitude(tmp_path):
    with serving(tmp_path, free_port(), "--duration", "4", attitude="lockstep = true") as process:
        summary = summary_of(process, code=4)
    assert (summary["packets"]["accepted"], summary["events"]["no-attitude"]) == (0, 1)


def test_lockstep_survives_no_delimiter_dead_askers_and_endless_parts(tmp_path):
    with bound(tmp_path, attitude="lockstep = true") as served:
        with greeted(served.port, b"DEALER") as attacker:
            attacker.sendall(part(b"no delimiter", more=False) * 10)
        with greeted(served.port, b"REQ") as dead:
            dead.sendall(part(b"", more=True) + part(packet(0, 0), more=False))
        with greeted(served.port, b"REQ") as attacker, contextlib.suppress(OSError):
            attacker.sendall(
                part(b"", more=True) * 1000 + part(b"x", more=True) * 1000 + part(b"x", more=False)
            )
            served.await_line("more than 64 parts")
        with connected(served.port, zmq.REQ) as asker:
            asker.send(packet(1, 1))
            assert len(asker.recv()) == 40
        summary = served.summary()
    assert summary["frames"] >= 1
    assert summary["link"]["resets"] == 1


def test_with_keys_a_known_client_is_heard_and_a_stranger_is_not(tmp_path):
    """hilstar binds, with an allow-list; the stranger has keys of its own, and the server's
    public one.
    """
    port = free_port()
    for directory in ("mine", "strange"):
        assert run_hilstar_here("keys", "-o", tmp_path / directory).returncode == 0
    assert_refused(run_hilstar_here("keys", "-o", tmp_path / "mine"), 2, "in use")
    assert (tmp_path / "mine" / "server.key_secret").stat().st_mode & 0o077 == 0
    keys = (
        'bind = true\ncurve_secret_key = "mine/server.key_secret"\nallowed_clients ='
        ' "mine/allowed_clients"'
    )
    with serving(tmp_path, port, attitude=keys) as process:
        for directory, waits in (("strange", "0.5"), ("mine", "10")):
            client = tmp_path / directory / "client.key_secret"
            options = [
                "--secret-key",
                client,
                "--server-key",
                tmp_path / "mine" / "server.key",
                "--wait",
                waits,
            ]
            to = [
                "--to",
                f"tcp://127.0.0.1:{port}",
                "--connect",
                "--spin",
                "z,1",
                "--count",
                "40",
                "--rate",
                "200",
            ]
            assert run_hilstar("send", *to, *options).returncode == 0
        plain = run_hilstar("send", *to, "--wait", "0.5")
        assert "no listener" in plain.stderr
        process.has_received(40)
        process.send_signal(signal.SIGINT)
        packets = summary_of(process)["packets"]
    assert (packets["received"], packets["accepted"]) == (40, 40)


def test_a_flood_is_bounded_and_the_display_goes_on(tmp_path):
    """Messages of 200 kB as fast as they go, for 1.2 s: what hilstar keeps of them is bounded, and
    frames go on.
    """
    with publisher() as (sender, port), serving(tmp_path, port) as process:
        process.shows()
        message = bytes(200_000)
        end = time.monotonic() + 1.2
        most_kb = 0
        while time.monotonic() < end:
            sender.send(message)
            with Path(f"/proc/{process.pid}/status").open() as status:
                most_kb = max(
                    most_kb, *(int(line.split()[1]) for line in status if line.startswith("VmRSS"))
                )
        sender.close(linger=0)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process, code=4)  # none of them is an attitude
    assert summary["packets"]["refused_by"]["format"] > 100
    assert summary["frames"] + summary["missed_frames"] >= 71
    assert summary["frames"] > summary["missed_frames"] / 3
    assert most_kb < 1_000_000
