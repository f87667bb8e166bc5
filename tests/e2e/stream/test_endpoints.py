"""Endpoints and keys of the commands: what libzmq would take and hilstar does not is one line, and
whose keys are let in.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from pathlib import Path

import pytest
import zmq

from tests.support.benches import LIVE_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.senders import connected, packet, talking
from tests.support.servers import Served, bound
from tests.support.waiting import wait_for
from tests.support.wire.zmtp import greeted, part

# What every command refuses, and the words that say so.
NO_ENDPOINTS = {
    "tcp://127.0.0.1:0;10.0.0.1:5560": "write tcp://HOST:PORT",
    "tcp://localhost.evil:5560": "hilstar keys",
    "tcp://127.0.0.1:*": "free port",
    "inproc://attitude": "write tcp://HOST:PORT",
    "ipc://relative": "absolute path",
}
HOSTS_BEYOND = ("*", "192.0.2.1", "0.0.0.0", "[::]")
USES = ("bind = true", "bind = false", "lockstep = true")
BAD_SECRET = 'curve_secret_key = "bad.key_secret"'
MISSING = 'curve_secret_key = "missing"\ncurve_server_key = "missing"'
NO_KEYS = {
    f'{BAD_SECRET}\ncurve_server_key = "bad.key_secret"': "not a key file",
    MISSING: "no such key file",
    BAD_SECRET: "curve_server_key",
    'curve_server_key = "bad.key_secret"': "curve_secret_key",
    f"bind = true\n{BAD_SECRET}": "allowed_clients",
}


def assert_serve_refuses(folder: Path, attitude: str, *words: str) -> None:
    """A bench file with these lines of [attitude] is refused."""
    bench = folder / "bench.toml"
    bench.write_text(f"{LIVE_BENCH}\n[attitude]\n{attitude}\n")
    assert_refused(run_hilstar_here("serve --headless --duration 1", bench), 2, *words)


def assert_send_refuses(endpoint: str, *words: str, options: tuple[str, ...] = ()) -> None:
    """`hilstar send` to an endpoint is refused."""
    result = run_hilstar_here("send --spin z,1 --count 1 --wait 0 --to", endpoint, *options)
    assert_refused(result, 2, *words)


@pytest.mark.parametrize("endpoint", NO_ENDPOINTS)
def test_endpoints_that_libzmq_would_take_and_hilstar_does_not(tmp_path, endpoint):
    words = (endpoint, NO_ENDPOINTS[endpoint])
    assert_serve_refuses(tmp_path, f'endpoint = "{endpoint}"', *words)
    assert_send_refuses(endpoint, *words, options=("--connect",))


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("host", HOSTS_BEYOND)
def test_beyond_loopback_nothing_is_bound_or_connected_without_keys(tmp_path, host, use):
    attitude = f'endpoint = "tcp://{host}:5599"\n{use}'
    assert_serve_refuses(tmp_path, attitude, "hilstar keys", "5599")


def test_send_beyond_loopback_needs_keys_too():
    assert_send_refuses("tcp://*:5599", "hilstar keys")


@pytest.mark.parametrize("keys", NO_KEYS)
def test_key_files_that_are_none_get_one_line(tmp_path, keys):
    (tmp_path / "bad.key_secret").write_text("nothing")
    assert_serve_refuses(tmp_path, keys, NO_KEYS[keys])


def test_keys_in_a_place_that_cannot_be_get_one_line(tmp_path):
    for folder, words in ((tmp_path / ("k" * 300), "choose another"), ("/proc/keys/here",) * 2):
        assert_refused(run_hilstar_here("keys -o", folder), 2, words)


def test_binding_a_file_deletes_nothing(tmp_path):
    measured = tmp_path / "measured.csv"
    measured.write_text("1,2,3\n")
    words = ("measured.csv", "not a socket")
    assert_serve_refuses(tmp_path, f'bind = true\nendpoint = "ipc://{measured}"', *words)
    assert_send_refuses(f"ipc://{measured}", *words)
    assert measured.read_text() == "1,2,3\n"


def test_a_free_port_is_told():
    sent = run_hilstar_here("send --spin z,1 --count 1 --wait 0 --to tcp://127.0.0.1:* --json")
    endpoint = json.loads(sent.stdout)["link"]["endpoint"]
    assert endpoint.startswith("tcp://127.0.0.1:")
    assert int(endpoint.rpartition(":")[2]) > 0
    assert endpoint in sent.stderr


def test_a_message_of_a_million_parts_is_dropped_before_it_is_a_list(tmp_path):
    with (
        bound(tmp_path) as served,
        connected(served.port) as sender,
        talking(sender, 100.0),
    ):
        served.await_line("the first attitude")
        before_mb = served.used_mb()
        with greeted(served.port) as attacker, contextlib.suppress(OSError):
            attacker.sendall(part(bytes(1), more=True) * 1_000_000 + part(b"end", more=False))
            served.await_line("more than 10000 parts")
        wait_for(lambda: served.used_mb() < before_mb + 128, "the memory is given back")
        summary = served.summary()
    assert summary["link"]["resets"] == 1


def make_client(directory: Path) -> Path:
    assert run_hilstar_here("keys", "-o", directory).returncode == 0
    return directory


FRESH = ("first attitude", "fresh again")


def await_heard(served: Served, own: Path, server: Path, first: int) -> None:
    """Wait until packets of a client, with numbers from `first` on, are told as fresh."""
    with connected(served.port, keys=(own, server)) as sender:
        told = len(served.lines)
        numbers = itertools.count(first)

        def is_heard() -> bool:
            sender.send(packet(next(numbers), time.monotonic_ns()))
            return any(words in line for line in served.lines[told:] for words in FRESH)

        wait_for(is_heard, served.lines, 0.01)


def assert_rejected(served: Served, own: Path, server: Path, first: int) -> None:
    """The client's own socket learns that its key is not let in, and no packet of it is heard."""
    with connected(served.port, keys=(own, server)) as sender:
        told = len(served.lines)
        numbers = itertools.count(first)
        with sender.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_AUTH) as events:

            def is_rejected() -> bool:
                sender.send(packet(next(numbers), time.monotonic_ns()))
                return bool(events.poll(10))

            wait_for(is_rejected, served.lines, 0.0)
            sender.disable_monitor()
    assert not any(words in line for line in served.lines[told:] for words in FRESH)


def test_clients_are_let_in_and_locked_out_without_a_restart_and_those_rejected_are_told(tmp_path):
    mine, late = make_client(tmp_path / "mine"), make_client(tmp_path / "late")
    allowed = mine / "allowed_clients"
    keys = (
        'bind = true\ncurve_secret_key = "mine/server.key_secret"\nallowed_clients ='
        ' "mine/allowed_clients"'
    )

    with bound(tmp_path, attitude=keys) as served:
        await_heard(served, mine, mine, 0)
        served.await_line("stale")
        assert_rejected(served, late, mine, 10_000)
        (allowed / "late.key").write_bytes((late / "client.key").read_bytes())
        (allowed / "client.key").unlink()
        await_heard(served, late, mine, 20_000)
        wait_for(lambda: served.count("is stale") >= 2)
        assert_rejected(served, mine, mine, 30_000)
        with connected(served.port):  # no keys at all
            rejected = served.count("was rejected")
            wait_for(lambda: served.count("was rejected") > rejected or rejected >= 3)
        summary = served.summary()
    assert summary["link"]["rejected"] == summary["events"]["client-rejected"] >= 3
    assert any("its key is not among those allowed" in line for line in served.lines)
