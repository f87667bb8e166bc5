"""What is said of the other side of a ZeroMQ connection that is no sender's."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest
import zmq

from hilstar.attitude.wire import zmq_peer as zmq_peer_module
from hilstar.attitude.wire.roads import LinkCounts
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqReceiver
from hilstar.attitude.wire.zmq_peer import PeerLook, answer_of, peer_trouble
from hilstar.attitude.wire.zmq_socket import CLIENT_REJECTED, WRONG_PEER, trouble_of
from hilstar.basics.notices import Notices
from tests.support.fake_clock import FakeClock
from tests.support.waiting import wait_for

WITHIN_S = 20.0  # a silent peer takes 3 s; a busy machine is slower
POLL_MS = 50


@contextlib.contextmanager
def zmq_peer(kind: int, *, curve: bool = False) -> Iterator[str]:
    with zmq.Context() as context, context.socket(kind) as made:
        made.linger = 0
        if curve:
            made.curve_publickey, made.curve_secretkey = zmq.curve_keypair()
            made.curve_server = True
        port = made.bind_to_random_port("tcp://127.0.0.1")
        yield f"tcp://127.0.0.1:{port}"


@contextlib.contextmanager
def plain_peer(answer: bytes) -> Iterator[str]:
    """A TCP server that answers with these bytes and closes; without any it says nothing."""
    connections: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    made, _ = listener.accept()
                    connections.append(made)
                    if answer:
                        made.recv(64)
                        made.sendall(answer)
                        made.close()

        threading.Thread(target=serve, daemon=True).start()
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
    for made in connections:
        made.close()


def trouble_at(endpoint: str, *, apart: bool = False) -> tuple[str, Notices]:
    """What the link knows of its other side, as soon as it knows something."""
    notices = Notices()
    receiver = ZmqReceiver(endpoint, notices=notices)
    with ZmqApart(receiver, notices) if apart else receiver as link:
        end_s = time.monotonic() + WITHIN_S
        while not link.trouble and time.monotonic() < end_s:
            link.receive(POLL_MS)
        return link.trouble, notices


@pytest.mark.parametrize("kind", ["PUSH", "DEALER", "PAIR", "REP", "ROUTER", "SUB"])
def test_another_type_of_socket_is_named_and_no_connection_called_lost(kind: str) -> None:
    with zmq_peer(getattr(zmq, kind)) as endpoint:
        trouble, notices = trouble_at(endpoint)
    assert f"a {kind} socket is there" in trouble
    assert "PUB socket" in trouble
    assert "lost" not in notices.counts()


def test_the_reading_process_says_it_too() -> None:
    with zmq_peer(zmq.PUSH) as endpoint:
        trouble, _ = trouble_at(endpoint, apart=True)
    assert "a PUSH socket is there" in trouble


@pytest.mark.parametrize("kind", ["PUB", "PUSH"])
def test_a_peer_that_asks_for_keys_is_named(kind: str) -> None:
    with zmq_peer(getattr(zmq, kind), curve=True) as endpoint:
        trouble, _ = trouble_at(endpoint)
    assert "it asks for keys (CURVE), and we have none" in trouble
    assert "allowed_clients" not in trouble


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.0 400 Bad Request\r\n\r\n", "HTTP"),
        (b"220 bench FTP server ready\r\n", "text, '220 bench"),
        (b"", "says nothing"),
    ],
)
def test_what_is_no_zeromq_is_named(answer: bytes, words: str) -> None:
    with plain_peer(answer) as endpoint:
        trouble, _ = trouble_at(endpoint)
    assert words in trouble


def test_a_connection_without_a_handshake_is_counted_as_rejected_and_as_none_that_was_made() -> (
    None
):
    with plain_peer(b"HTTP/1.0 400 Bad Request\r\n\r\n") as endpoint, ZmqReceiver(endpoint) as link:
        end_s = time.monotonic() + WITHIN_S
        while not link.link_counts.rejected and time.monotonic() < end_s:
            link.receive(POLL_MS)
        assert link.link_counts.rejected
        assert (link.link_counts.connections, link.link_counts.lost) == (0, 0)


def test_a_sender_is_no_trouble_and_nobody_is_neither() -> None:
    with zmq_peer(zmq.PUB) as endpoint, ZmqReceiver(endpoint) as link:
        end_s = time.monotonic() + WITHIN_S
        while not link.link_counts.connections and time.monotonic() < end_s:
            link.receive(POLL_MS)
        assert link.link_counts.connections == 1
        assert link.trouble == ""


def test_another_type_of_socket_that_connects_to_ours_is_rejected_in_words() -> None:
    notices = Notices()
    with ZmqReceiver("tcp://127.0.0.1:*", bind=True, notices=notices) as link:
        link.receive(POLL_MS)
        with zmq.Context() as context, context.socket(zmq.PUSH) as made:
            made.linger = 0
            made.connect(link.endpoint)
            end_s = time.monotonic() + WITHIN_S
            while not notices.latest("client-rejected") and time.monotonic() < end_s:
                link.receive(POLL_MS)
        # a line at the end of a run that had no attitude, in the place of "start the sender"
        assert "another type of ZeroMQ socket" in link.trouble
        with zmq.Context() as context, context.socket(zmq.XPUB) as made:
            made.connect(link.endpoint)
            end_s = time.monotonic() + WITHIN_S
            while not made.poll(POLL_MS) and time.monotonic() < end_s:
                link.receive(POLL_MS)
            link.receive(POLL_MS)
            assert link.trouble == ""
    assert "another type of ZeroMQ socket" in notices.latest("client-rejected")


def test_a_peer_is_looked_at_once_in_five_seconds_and_told_once(monkeypatch) -> None:
    """However often it rejects us: each look is a connection of its own."""
    looked: list[str] = []

    def answer_of(address: str) -> bytes:
        looked.append(address)
        return b"220 bench FTP server ready\r\n"

    monkeypatch.setattr(zmq_peer_module, "answer_of", answer_of)
    clock = FakeClock()
    look = PeerLook("tcp://127.0.0.1:9", "SUB", False, clock)
    told: list[str] = []
    for tenths in range(121):
        before = len(looked)
        look.begin()
        if tenths % 50 == 0:
            wait_for(lambda before=before: len(looked) > before and look._found, "the look")
        told += [line for line in [look.take()] if line]
        assert len(looked) == 1 + tenths // 50
        clock.work(0.1e9)
    assert len(told) == 1
    assert "220 bench" in told[0]


def greeting(mechanism: str, socket_type: str = "") -> bytes:
    """ZMTP 3.1's greeting of 64 bytes, and the READY command of a socket of this type."""
    first = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + mechanism.encode().ljust(20, b"\0")
    ready = b""
    if socket_type:
        name = socket_type.encode()
        ready = b"\x04\x1b\x05READY\x0bSocket-Type" + len(name).to_bytes(4, "big") + name
    return first.ljust(64, b"\0") + ready


PLACE = "tcp://10.0.0.1:5560"
PEERS = [
    (None, "SUB", False, ""),
    (b"", "SUB", False, "says nothing, so it is no ZeroMQ; give the place of a PUB socket"),
    (b"", "REP", False, "give the place of a REQ socket"),
    (b"HTTP/1.1 400 Bad Request", "SUB", False, "no ZeroMQ answers there, but "),
    (greeting("NULL")[:63], "SUB", False, "no ZeroMQ answers there, but "),
    (greeting("NULL"), "SUB", False, ""),
    (greeting("NULL", "PUB"), "SUB", False, ""),
    (greeting("NULL", "XPUB"), "SUB", False, ""),
    (
        greeting("NULL", "REP"),
        "SUB",
        False,
        "a REP socket is there, and ours is SUB; let the other",
    ),
    (greeting("NULL", "DEALER"), "REP", False, ""),
    (greeting("NULL", "PUB"), "REP", False, "a PUB socket is there, and ours is REP; let the othe"),
    (greeting("NULL", "SUB"), "XPUB", False, ""),
    (greeting("CURVE"), "SUB", False, "it asks for keys (CURVE), and we have none; give curve_sec"),
    (greeting("NULL", "PUB"), "SUB", True, "it has no keys, and we have; give it keys"),
    (greeting("CURVE"), "SUB", True, "the other side rejected us: check its allowed_clients"),
    (greeting("GSSAPI"), "SUB", False, "it asks for GSSAPI; hilstar has CURVE keys, or none"),
    (greeting("PLAIN"), "SUB", True, "it asks for PLAIN; hilstar has CURVE keys, or none"),
]


@pytest.mark.parametrize(("answer", "kind", "keys", "words"), PEERS, ids=range(len(PEERS)))
def test_what_answers_at_a_place_is_named_by_its_greeting(answer, kind, keys, words):
    line = peer_trouble(PLACE, answer, kind, keys)
    if not words:
        assert line == ""
    else:
        assert words in line
        assert line.startswith(f"{PLACE}: ") or line.startswith("the other side")


def test_a_socket_in_the_file_system_is_asked_as_a_port_is(tmp_path):
    with zmq.Context() as context, context.socket(zmq.PUB) as made:
        made.linger = 0
        made.bind(f"ipc://{tmp_path}/feed")
        answer = answer_of(f"ipc://{tmp_path}/feed")
        assert answer is not None
        assert peer_trouble(PLACE, answer, "SUB", False) == ""
        assert "a PUB socket is there, and ours is REP" in peer_trouble(PLACE, answer, "REP", False)
        made.bind(f"ipc://@{tmp_path}")  # Linux's names without a file
        assert answer_of(f"ipc://@{tmp_path}") == answer
    assert answer_of(f"ipc://{tmp_path}/none", 1.0) is None


@pytest.mark.parametrize(
    ("connections", "rejected", "said", "trouble"),
    [
        (0, 0, WRONG_PEER, "why"),  # what we connect to is another socket, and none was made
        (1, 1, WRONG_PEER, ""),
        (2, 2, CLIENT_REJECTED, "why"),  # to what we bind: all that came were rejected
        (2, 1, CLIENT_REJECTED, ""),
        (0, 0, "flood", ""),
    ],
)
def test_a_socket_without_a_partner_says_why(connections, rejected, said, trouble):
    notices = Notices()
    notices.tell(said, "why")
    counts = LinkCounts(connections=connections, rejected=rejected)
    assert trouble_of(counts, notices) == trouble
