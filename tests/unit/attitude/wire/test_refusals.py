"""Endpoints, keys and sources that are refused: what is written, and the words of the line."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest

from hilstar.attitude.wire.endpoint import Endpoint, check_use, parse_endpoint
from hilstar.attitude.wire.keys import CurveKeys, check_reach, load_public
from hilstar.attitude.wire.nasa42 import spacecraft_number
from hilstar.attitude.wire.vizard import check_loopback
from hilstar.server.bench.config.bench_config import parse_config
from tests.support.benches import SMALL_BENCH
from tests.support.commands import bounded_by
from tests.support.refusals import assert_file_refused, refusal, says
from tests.support.waiting import PATIENCE_S

# Two places in one text, of which libzmq takes one.
TWO_PLACES = ("tcp://127.0.0.1:0;10.0.0.1:5560", "tcp://127.0.0.1;10.0.0.1:5560")
TWO_PLACES += ("tcp://10.0.0.1:1;127.0.0.1:5560", "tcp://lo;127.0.0.1:5560")
TWO_PLACES += ("pgm://127.0.0.1;239.0.0.1:5560", "tcp://user@127.0.0.1:5560")
# Other writings of an address, which one reader takes for this machine and another does not.
ADDRESSES = ("tcp://127.1:5560", "tcp://0177.0.0.1:5560", "tcp://0x7f.0.0.1:5560")
ADDRESSES += ("tcp://2130706433:5560", "tcp://127.0.0.1.:5560", "tcp://-evil:5560", "tcp://:5560")
ADDRESSES += ("tcp://[::ffff:127.0.0.1]:5560", "tcp://[::ffff:10.0.0.1]:5560", "tcp://::1:5560")
ADDRESSES += ("tcp://[::1:5560", "tcp://[127.0.0.1:5560", "tcp://[localhost]:5560")
ADDRESSES += ("tcp://[127.0.0.1]:5560", "tcp://127.0.0.1\0:5560")
ADDRESSES += ("tcp://224.0.0.1:5560", "tcp://[ff02::1]:5560")  # of many machines: multicast
PORTS = ("tcp://127.0.0.1:65536", "tcp://127.0.0.1:-1", "tcp://127.0.0.1:+1", "tcp://127.0.0.1:")
PORTS += ("tcp://127.0.0.1:٥٥٦٠", "tcp://127.0.0.1", "tcp://127.0.0.1:5560/x")
PORTS += ("tcp://127.0.0.1:5560 ", "tcp://127.0.0.1:5560\n", "tcp://127.0.0.1:5560\0")
SCHEMES = ("TCP://127.0.0.1:5560", " tcp://127.0.0.1:5560", "inproc://attitude", "")
SCHEMES += ("udp://127.0.0.1:5560", "ws://127.0.0.1:5560", "vmci://*:5560")
SOCKETS = ("ipc://", "ipc://*", "ipc://@abstract", "ipc://relative/path", "ipc:///tmp/a\0b")
SOCKETS += ("ipc:///" + 200 * "a",)
NOWHERE = ("tcp://127.0.0.1:*", "tcp://127.0.0.1:0", "tcp://*:5560", "tcp://[::]:5560")
HERE, THERE = Endpoint("tcp://127.0.0.1:1", loopback=True), Endpoint("tcp://10.0.0.1:1", False)
SECRET, SERVER, CLIENTS = Path("mine.key_secret"), Path("theirs.key"), Path("allowed")


def reach(endpoint: Endpoint, keys: CurveKeys, *, bind: bool) -> partial[None]:
    return partial(check_reach, endpoint, "as written", bind=bind, keys=keys)


def connect(text: str) -> None:
    check_use(parse_endpoint(text), text, bind=False)


def bench_of(tables: str, tracker: str = "") -> partial[object]:
    """A bench with other tables, and more keys of [tracker]."""
    text = SMALL_BENCH.replace("[tracker]", f"[tracker]\n{tracker}")
    return partial(parse_config, "bench.toml", f"{text}\n{tables}\n")


OWN = "[attitude] convention = ...has a convention of its own; remove it"
MOUNTED = "q_body_to_cam = [0.5, -0.5, -0.5, -0.5]"
LAST = '[attitude]\nconvention = { scalar = "last" }\nsource = '
BODY = 'convention = { frame = "body" }'
SERIAL = 'source = "serial"\nport = "/dev/ttyS0"\nformat = "json"\n'
REFUSED = [
    *(
        (partial(parse_endpoint, text), "write ")
        for text in (*TWO_PLACES, *ADDRESSES, *PORTS, *SCHEMES, *SOCKETS)
    ),
    *((partial(connect, text), "cannot connect to") for text in NOWHERE),
    (reach(THERE, CurveKeys(), bind=True), "as written: ...require CURVE keys"),
    (reach(THERE, CurveKeys(), bind=False), "as written: ...require CURVE keys"),
    (
        reach(HERE, CurveKeys(allowed_clients=CLIENTS), bind=True),
        "as written: ...curve_secret_key is missing",
    ),
    (
        reach(THERE, CurveKeys(SECRET, SERVER), bind=True),
        "as written: ...binds requires allowed_clients",
    ),
    (
        reach(THERE, CurveKeys(SECRET, None, CLIENTS), bind=False),
        "as written: ...connects requires curve_server_key",
    ),
    (partial(check_loopback, "tcp://192.168.1.2:5570"), "ssh -L 5570:127.0.0.1:5570 HOST"),
    *((partial(spacecraft_number, name), "SC") for name in ("Aura", "SC[x]", -1, "SC[1].B[0]")),
    *((bench_of(LAST + source, MOUNTED), OWN) for source in ('"vizard"', '"42"', '"scpi"')),
    (
        bench_of(f"[attitude]\n{BODY}"),
        "[attitude] convention = ... needs [tracker] q_body_to_cam",
    ),
    (
        bench_of(f"[answers]\n{SERIAL}{BODY}"),
        "[answers] convention = ... needs [tracker] q_body_to_cam",
    ),
]


@pytest.mark.parametrize(("call", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_no_way_to_an_attitude_is_refused_in_one_line(call, words):
    line = refusal(call)
    assert says(line, words), line


@pytest.mark.parametrize(
    "text", ["", "public-key", 'public-key = "short"', f'public-key = "{"~" * 40}"', "\0\xff"]
)
def test_what_is_no_key_file_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "x.key"
    path.write_text(text)
    assert_file_refused(load_public, path, "not a key file")


def test_a_pipe_in_the_place_of_a_key_file_is_refused_in_one_line(tmp_path):
    os.mkfifo(tmp_path / "pipe.key")
    with bounded_by(PATIENCE_S):  # whoever opens it waits for ever
        assert_file_refused(load_public, tmp_path / "pipe.key", "")
