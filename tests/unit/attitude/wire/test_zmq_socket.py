"""A ZeroMQ socket's bounds on the parts of a message, and what memory it watches."""

from __future__ import annotations

import re
from contextlib import closing

import pytest
import zmq

from hilstar.attitude.wire import zmq_socket
from hilstar.attitude.wire.keys import CurveKeys, load_public, load_secret, make_keys
from hilstar.attitude.wire.roads import LinkCounts
from hilstar.attitude.wire.zmq_links import ZmqRoad, ZmqRoadApart
from hilstar.attitude.wire.zmq_socket import MAX_GROWTH_BYTES, MAX_PARTS, ZmqReply, ZmqSocket
from hilstar.basics.notices import Notice, Notices
from tests.support.refusals import refusal
from tests.support.waiting import PATIENCE_S, wait_for

WAIT_MS = 20_000


@pytest.fixture
def pair(tmp_path):
    """A link, its notices, and a peer that binds and sends to it."""
    notices = Notices()
    endpoint = f"ipc://{tmp_path}/s"
    context = zmq.Context()
    with context.socket(zmq.PUSH) as peer:
        peer.linger, peer.sndtimeo = 0, WAIT_MS
        peer.bind(endpoint)
        with ZmqSocket(zmq.PULL, endpoint, notices=notices) as link:
            link.wait_for_message(0)  # it connects
            yield link, notices, peer
    context.term()


def taken_parts(link) -> list[int]:
    return [len(message.parts) for message in link.taken(WAIT_MS)]


def test_a_message_has_so_many_parts_and_a_longer_one_is_passed_over(pair):
    link, notices, peer = pair
    peer.send_multipart([b"x"] * MAX_PARTS)
    assert taken_parts(link) == [MAX_PARTS]
    peer.send_multipart([b"x"] * (MAX_PARTS + 2))
    peer.send_multipart([b"x"])
    assert taken_parts(link) + taken_parts(link) == [1]
    assert notices.counts()["long-message"] == 1
    assert link.link_counts.resets == 0


def test_a_message_that_is_too_long_to_be_passed_over_drops_every_connection(pair, monkeypatch):
    monkeypatch.setattr(zmq_socket, "MAX_PASSED_OVER", 5)
    link, notices, peer = pair
    peer.send_multipart([b"x"] * (MAX_PARTS + 10))
    assert taken_parts(link) == []
    assert link.link_counts.resets == 1 and notices.counts()["flood"] == 1


def test_who_connects_when_the_dropping_is_told_is_heard():
    """By the line the new socket is bound: the old one would take the request and lose it."""
    notices = Notices()
    with ZmqReply("tcp://127.0.0.1:0", notices=notices) as link, zmq.Context() as context:
        assert not link.wait_for_message(0)
        attacker = context.socket(zmq.DEALER)
        asker = context.socket(zmq.REQ)
        monitor = asker.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)

        def connect(notice: Notice) -> None:
            if notice.kind == "flood":
                asker.connect(link.endpoint)
                asker.send(b"request")
                assert monitor.poll(1000 * PATIENCE_S)  # a socket has taken it

        notices.listen(connect)
        with attacker, asker, monitor:
            attacker.connect(link.endpoint)
            attacker.send_multipart([b"", *[b"x"] * (MAX_PARTS + 1)])
            assert link.request(1000 * PATIENCE_S) is None
            request = link.request(20_000)
            assert request is not None and request.parts == [b"request"]
            asker.disable_monitor()


def test_what_this_process_took_before_the_link_was_used_is_not_the_link_s(tmp_path, monkeypatch):
    used_bytes = 10**9
    monkeypatch.setattr(zmq_socket._MemoryWatch, "_used_bytes", lambda watch: used_bytes)
    monkeypatch.setattr(zmq_socket, "LOOK_S", 0.0)
    monkeypatch.setattr(zmq_socket, "FREED_WITHIN_S", 0.0)
    with ZmqReply(f"ipc://{tmp_path}/open") as open_from_its_begin_on:
        used_bytes += 2 * MAX_GROWTH_BYTES
        assert not open_from_its_begin_on.wait_for_message(0)
        assert open_from_its_begin_on.link_counts.resets == 0
    with ZmqSocket(zmq.PULL, f"ipc://{tmp_path}/s") as link:
        used_bytes += 2 * MAX_GROWTH_BYTES
        link.wait_for_message(0)
        assert link.link_counts.resets == 0
        used_bytes += 2 * MAX_GROWTH_BYTES
        link.wait_for_message(0)
        assert link.link_counts.resets == 1


@pytest.mark.parametrize(("bind", "openings"), [(False, 2), (True, 0)])
def test_connections_of_a_reading_process_are_openings_where_the_link_makes_them(bind, openings):
    """After each opening a link's messages are read anew; who connects to it ends none of them."""
    road = ZmqRoad("tcp://127.0.0.1:*" if bind else "tcp://127.0.0.1:5560", bind=bind)
    with road, closing(ZmqRoadApart(road)) as apart:
        apart._count(LinkCounts(connections=2))
        assert apart.openings == openings


def test_a_place_that_cannot_be_bound_is_refused_with_what_to_do(tmp_path):
    make_keys(tmp_path)
    keys = CurveKeys(tmp_path / "server.key_secret", allowed_clients=tmp_path / "allowed_clients")
    elsewhere = "tcp://192.0.2.1:5560"  # RFC 5737: no machine has it
    assert refusal(ZmqRoad, elsewhere, bind=True, keys=keys) == (
        f"{elsewhere}: not an address of this machine, so it cannot be bound; connect (--connect,"
        " bind = false) instead"
    )
    without_files = "ipc:///proc/attitude"  # nothing can be made there, whoever asks
    assert re.fullmatch(
        without_files + r": cannot bind \(.+\); write the absolute path of a socket, .+",
        refusal(ZmqRoad, without_files, bind=True),
    )
    with ZmqRoad("tcp://127.0.0.1:*", bind=True) as road:
        # a road that binds lets go until its first read
        road.taken(0)
        assert refusal(ZmqRoad, road.endpoint, bind=True) == (
            f"{road.endpoint}: the port is in use; stop the program that has it, or choose another"
            " port"
        )


@pytest.mark.parametrize(
    ("has_keys", "why"),
    [
        # libzmq says which of the two by chance
        (False, "it left before its handshake|it has no keys"),
        (True, "its key is not among those allowed"),
    ],
)
def test_a_client_that_is_rejected_says_nothing_of_the_next_one(tmp_path, has_keys, why):
    """One without keys or with keys of its own, and then one that is allowed and leaves."""
    make_keys(tmp_path)
    notices = Notices()
    keys = CurveKeys(tmp_path / "server.key_secret", allowed_clients=tmp_path / "allowed_clients")
    with ZmqRoad("tcp://127.0.0.1:*", bind=True, keys=keys, notices=notices) as road:
        road.taken(0)

        def counts_are(connections: int, rejected: int) -> bool:
            road.taken(20)
            counts = road.link_counts
            return (counts.connections, counts.rejected) == (connections, rejected)

        with zmq.Context() as context:
            with context.socket(zmq.PUB) as stranger:
                stranger.reconnect_ivl = -1
                if has_keys:
                    stranger.curve_publickey, stranger.curve_secretkey = zmq.curve_keypair()
                    stranger.curve_serverkey = load_public(tmp_path / "server.key")
                stranger.connect(road.endpoint)
                wait_for(lambda: counts_are(1, 1), "the rejection", poll_s=1e-3)
            with context.socket(zmq.PUB) as client:
                client.linger = 0
                client.curve_publickey, client.curve_secretkey = load_secret(
                    tmp_path / "client.key_secret"
                )
                client.curve_serverkey = load_public(tmp_path / "server.key")
                client.connect(road.endpoint)

                def is_heard() -> bool:
                    client.send(b"x")
                    return bool(road.taken(20))

                wait_for(is_heard, "the client", poll_s=1e-3)
            assert road._keeper is not None
            wait_for(lambda: counts_are(2, 1) and not road._keeper._open, "its end", poll_s=1e-3)
    assert notices.counts()["client-rejected"] == 1
    assert re.search(why, notices.latest("client-rejected"))
