"""The link that a bench file names, and the first attitude over one."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, TimeReply, TimeRequest
from hilstar.basics.units import NS_PER_S
from hilstar.server import open_link as links
from hilstar.server.bench.config import parse_config
from hilstar.server.open_link import first_attitude, open_link
from tests.support.benches import bench_text
from tests.support.refusals import refusal

SAMPLE = AttitudeSample(7, np.array([1.0, 0.0, 0.0, 0.0]))


def test_basilisk_s_rates_end_at_the_bench_s_largest_turn_and_at_its_silence(tmp_path, monkeypatch):
    """A turn of 2 deg/s is under a limit of 3 deg/s, one of 4 deg/s is a jump; 0.3 s are a gap."""
    made = []
    follower = links.Follower
    monkeypatch.setattr(links, "Follower", lambda *given: made.append(given[2]) or follower(*given))
    keys = {"source": "vizard", "endpoint": "tcp://127.0.0.1:5999"}
    limits = {"max_rate_deg_s": 3.0, "stale_after_ms": 250.0}
    config = parse_config(tmp_path / "bench.toml", bench_text({"attitude": keys | limits}))
    open_link(config, tmp_path).close()
    (rates,) = made
    for deg_s, step_s, is_known in ((2.0, 0.1, True), (4.0, 0.1, False), (2.0, 0.3, False)):
        found = []
        for k in range(3):
            half = math.radians(deg_s) * k * step_s / 2
            q = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
            found.append(rates.moving(AttitudeSample(round((1 + k * step_s) * NS_PER_S), q)))
        assert (found[-1].rate_cam_rad_s is not None) is is_known, (deg_s, step_s)
        rates.moving(AttitudeSample(0, q))  # back to the beginning


@pytest.mark.parametrize(("source", "of_packets"), [("udp", True), ("scpi", False)])
def test_what_scpi_s_own_process_sends_has_no_sender_s_convention(tmp_path, source, of_packets):
    keys = {"source": source} | ({"endpoint": "udp://127.0.0.1:0"} if of_packets else {})
    config = parse_config(tmp_path / "bench.toml", bench_text({"attitude": keys}))
    with open_link(config, tmp_path) as link:
        assert link.conventions.of_packets is of_packets
        assert (link.conventions.source == "SCPI") is not of_packets


class Waiting:
    """A link on which something waits, and what was sent back."""

    endpoint, trouble = "udp://here", ""

    def __init__(self, *events: object, two_way: bool = True) -> None:
        self.two_way = two_way
        self.sent: list[object] = []
        self._events = deque(events)

    def receive(self, timeout_ms: int) -> list[Arrival]:
        return [Arrival(5, self._events.popleft())] if self._events else []

    def send(self, packet: object) -> None:
        self.sent.append(packet)


def test_a_sender_s_time_request_is_answered_before_its_first_attitude():
    link = Waiting(Refusal("crc", "changed"), TimeRequest(3, 40), SAMPLE)
    assert first_attitude(link, 60.0) is SAMPLE
    (reply,) = link.sent
    assert isinstance(reply, TimeReply)
    assert (reply.sequence, reply.t1_ns, reply.t2_ns) == (3, 40, 5)
    assert reply.t3_ns > reply.t2_ns


def test_a_link_that_cannot_send_answers_nothing():
    link = Waiting(TimeRequest(3, 40), SAMPLE, two_way=False)
    assert first_attitude(link, 60.0) is SAMPLE
    assert link.sent == []


@pytest.mark.parametrize(
    ("events", "trouble", "words"),
    [
        ((), "", "no attitude within 0.01 s; start the sender"),
        ((), "udp://here: nobody answers", "within 0.01 s; nobody answers"),
        ((Refusal("norm", "it is 2"),), "x", "the last message was refused (norm: it is 2)"),
    ],
)
def test_what_came_in_place_of_an_attitude_is_said(events, trouble, words):
    link = Waiting(*events)
    link.trouble = trouble
    assert words in refusal(first_attitude, link, 0.01)


def test_only_named_machines_are_heard_by_42_s_link(tmp_path, monkeypatch):
    """Beyond this machine `[attitude] allow` says whose attitudes are taken."""
    made = []
    monkeypatch.setattr(links, "Nasa42Link", lambda *given, **keys: made.append((given, keys)))
    keys = {
        **{"source": "42", "endpoint": "tcp://0.0.0.0:10001", "bind": True},
        **{"allow": ["10.0.0.7"], "spacecraft": 0},
    }
    config = parse_config(tmp_path / "bench.toml", bench_text({"attitude": keys}))
    open_link(config, tmp_path)
    ((_, options),) = made
    assert options["bind"] is True
    allowed = options["allowed"]
    assert [allowed.admits(address) for address in ("10.0.0.7", "10.0.0.8")] == [True, False]
