"""Endpoints: what libzmq would take and hilstar must not, and that nothing is deleted."""

from __future__ import annotations

import contextlib
import socket

import pytest

from hilstar.attitude.wire.endpoint import check_use, parse_endpoint
from hilstar.attitude.wire.vizard import check_loopback
from hilstar.basics.errors import InputError
from tests.support.refusals import refusal

LOOPBACK = (
    "tcp://127.0.0.1:5560",
    "tcp://127.9.8.7:1",
    "tcp://localhost:5560",
    "tcp://[::1]:65535",
    "ipc:///tmp/attitude",
)
BEYOND = (
    "tcp://10.0.0.1:5560",
    "tcp://bench-pc.lab.example:5560",
    "tcp://localhost.evil:5560",
    "tcp://[2001:db8::1]:5560",
)
BEYOND += (
    "tcp://0.0.0.0:5560",
    "tcp://[::]:5560",
    "tcp://*:5560",
    "tcp://lo:5560",
    "tcp://LOCALHOST:5560",
    "tcp://eth0:5560",
)


@pytest.mark.parametrize("text", LOOPBACK)
def test_loopback_and_sockets_of_this_machine_need_no_keys(text):
    assert parse_endpoint(text).loopback


@pytest.mark.parametrize("text", BEYOND)
def test_what_others_can_reach_is_never_taken_for_loopback(text):
    assert not parse_endpoint(text).loopback


@pytest.mark.parametrize("letter", ["a", "ä", "€"])
def test_a_sockets_path_is_as_long_as_its_bytes(letter):
    """sun_path of sockaddr_un has 108 bytes with the NUL behind it (unix(7))."""
    count, rest = divmod(107 - len("/"), len(letter.encode()))
    longest = "/" + letter * count + "a" * rest
    with socket.socket(socket.AF_UNIX) as asker, pytest.raises(FileNotFoundError):
        asker.connect(longest)  # the kernel takes it
    assert str(parse_endpoint(f"ipc://{longest}").path) == longest
    assert "at most 107 bytes" in refusal(parse_endpoint, f"ipc://{longest}a")


def test_libzmq_gets_the_address_that_was_judged():
    """A name could be resolved to anything; leading zeros are octal to some."""
    assert parse_endpoint("tcp://localhost:05560").address == "tcp://127.0.0.1:5560"
    assert parse_endpoint("tcp://127.0.0.1:0").address == "tcp://127.0.0.1:*"
    assert parse_endpoint("tcp://[0:0::1]:7").address == "tcp://[::1]:7"


@pytest.mark.parametrize(
    "text", ["tcp://127.0.0.1:*", "tcp://127.0.0.1:0", "tcp://*:5560", "tcp://[::]:5560"]
)
def test_any_port_and_every_interface_can_be_bound(text):
    check_use(parse_endpoint(text), text, bind=True)


def test_a_bind_deletes_no_file_and_takes_no_socket_from_a_running_program(tmp_path):
    def refused(path, *, bind: bool = True) -> str:
        with pytest.raises(InputError) as caught:
            check_use(parse_endpoint(f"ipc://{path}"), f"ipc://{path}", bind=bind)
        return str(caught.value)

    file, link, served, stale = (tmp_path / name for name in ("file", "link", "served", "stale"))
    file.write_text("measured")
    link.symlink_to(file)
    for path in (file, link, tmp_path):
        assert "not a socket" in refused(path)
        assert "not a socket" in refused(path, bind=False)
    assert file.read_text() == "measured"
    assert "does not exist" in refused(tmp_path / "nowhere" / "socket")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(served))
        server.listen()
        assert "running program" in refused(served)
        check_use(parse_endpoint(f"ipc://{served}"), "", bind=False)
    with contextlib.ExitStack() as opened:
        # one that has no time for more callers is no less a running program
        server = opened.enter_context(socket.socket(socket.AF_UNIX))
        busy = tmp_path / "busy"
        server.bind(str(busy))
        server.listen(0)
        with pytest.raises(BlockingIOError):
            for _ in range(100):
                caller = opened.enter_context(socket.socket(socket.AF_UNIX))
                caller.setblocking(False)
                caller.connect(str(busy))
        assert "running program" in refused(busy)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(stale))
    check_use(parse_endpoint(f"ipc://{stale}"), "", bind=True)


def test_vizard_on_this_machine_needs_no_way_round() -> None:
    check_loopback("tcp://127.0.0.1:5570")
