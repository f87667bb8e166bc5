"""Endpoints and keys of the commands: what libzmq would take and hilstar does not is one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.benches import LIVE_BENCH
from tests.support.commands import assert_refused, run_hilstar_here

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
