"""The Python API's sender: what leaves over its road, which stands in here as a list."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.packet import AttitudeSample, decode
from hilstar.server import sender as roads
from hilstar.server.sender import Sender
from tests.support.refusals import refusal

Q = (0.5, -0.5, 0.5, -0.5)


@pytest.fixture
def left(monkeypatch) -> list[bytes]:
    """The packets that left."""
    packets: list[bytes] = []
    end = SimpleNamespace(put=packets.append, close=lambda: None)
    monkeypatch.setattr(roads, "open_sender", lambda to, **words: end)
    return packets


def test_packets_are_numbered_in_their_order_with_the_time_and_rate_given(left):
    sender = Sender("tcp://127.0.0.1:5560", clock=lambda: 77, sender=254)
    sender.send(Q)
    sender.send(Q, (0.1, -0.2, 0.3), t_ns=5, discontinuity=True)
    assert "must be 1" in refusal(sender.send, (2.0, 0.0, 0.0, 0.0))
    sender.send(Q, t_ns=-9)
    first, second, third = (decode(packet) for packet in left)
    assert isinstance(first, AttitudeSample)
    assert [each.sequence for each in (first, second, third)] == [0, 1, 2]
    assert [each.t_ns for each in (first, second, third)] == [77, 5, -9]
    assert [each.discontinuity for each in (first, second, third)] == [False, True, False]
    assert first.rate_cam_rad_s is None
    assert tuple(second.rate_cam_rad_s) == pytest.approx((0.1, -0.2, 0.3))
    sender.close()
    assert "closed" in refusal(sender.send, Q)
    assert len(left) == 3


@pytest.mark.parametrize(
    ("to", "words", "said"),
    [
        ("udp://127.0.0.1:0", {}, "write udp://HOST:PORT"),
        ("udp://127.0.0.1:65536", {}, "write udp://HOST:PORT"),
        ("udp://127.0.0.1:65535", {"keys": CurveKeys(Path("key"))}, "only ZeroMQ has keys"),
        ("serial:/dev/null@115200", {"keys": CurveKeys(Path("key"))}, "only ZeroMQ has keys"),
        ("serial:/dev/null@115200", {"connect": True}, "a side that connects (--connect)"),
    ],
)
def test_where_nothing_can_be_sent_or_what_a_road_has_not_is_refused(to, words, said):
    assert said in refusal(roads.open_sender, to, **words)


@pytest.mark.usefixtures("left")
def test_a_sender_has_a_number_up_to_254_or_none():
    for number in (0, 1, 254):
        Sender("tcp://127.0.0.1:5560", sender=number)
    with pytest.raises(roads.InputError, match="write 1 to 254, or 0 for no number"):
        Sender("tcp://127.0.0.1:5560", sender=255)
