"""What the answering end of a tracker's link puts on a wire, read there without hilstar."""

from __future__ import annotations

import json
import socket
import struct
import zlib

import numpy as np
import pytest

from hilstar.instruments.simulate.answer_link import AnswerLink
from hilstar.instruments.simulate.live_exposure import TRACKING
from hilstar.server.answers.answer import Answer, ReportedStar

Q = np.array([0.5, -0.5, 0.5, 0.5])
RATE = np.array([0.125, -0.25, 0.5])
MAX_BYTES = 1000


def answer(number: int) -> Answer:
    """An answer of a second after another."""
    stars = (ReportedStar(1.25, 2.5, 700.0, 32349), ReportedStar(3.0, 4.0))
    return Answer(
        host_ns=5,
        raw=b"",
        t_ns=10**15 + number,
        q_icrs_to_cam=Q,
        rate_cam_rad_s=RATE,
        valid=True,
        mode=TRACKING,
        star_count=9,
        rms_arcsec=1.5,
        centroids=stars,
    )


@pytest.fixture
def wire():
    """A socket of this machine, and its address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as received:
        received.bind(("127.0.0.1", 0))
        received.settimeout(30)
        yield received, f"udp://127.0.0.1:{received.getsockname()[1]}"


def test_packets_have_the_answer_the_sender_s_own_count_and_a_checksum(wire):
    received, target = wire
    link = AnswerLink(target, "packet", False, None)
    for number in range(2):
        link.send(answer(number))
    for number in range(2):
        data = received.recv(MAX_BYTES)
        assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])
        version, kind, _, sequence, t_ns = struct.unpack_from("<BBHIq", data)
        assert (version, kind, sequence, t_ns) == (1, kind, number, 10**15 + number)
        assert struct.unpack_from("<4d3f", data, 16) == (*Q.tolist(), *RATE.tolist())
    assert (link.sent, link.babbled) == (2, 0)
    link.close()


def test_json_over_udp_is_one_object_a_datagram_without_an_end_of_line(wire):
    received, target = wire
    link = AnswerLink(target, "json", False, None)
    link.send(answer(7))
    data = received.recv(MAX_BYTES)
    assert data.endswith(b"}")
    told = json.loads(data)
    assert told["t_ns"] == 10**15 + 7
    assert (told["q"], told["rate"]) == (Q.tolist(), RATE.tolist())
    assert (told["valid"], told["mode"], told["stars"]) == (True, TRACKING, 9)
    assert told["rms_arcsec"] == 1.5
    assert told["centroids"] == [[1.25, 2.5, 700.0, 32349], [3.0, 4.0, None]]
    link.close()


def test_babble_comes_before_each_answer_and_is_counted_by_itself(wire):
    received, target = wire
    link = AnswerLink(target, "packet", False, np.random.default_rng(2))
    link.send(answer(0))
    link.send(answer(1))
    messages = [received.recv(MAX_BYTES) for _ in range(4)]
    for number, packet in enumerate(messages[1::2]):
        assert struct.unpack_from("<I", packet, 4)[0] == number
    for garbage in messages[::2]:
        assert 1 <= len(garbage) < 300
    assert messages[0] != messages[2]
    assert (link.sent, link.babbled) == (2, 2)
    link.close()
