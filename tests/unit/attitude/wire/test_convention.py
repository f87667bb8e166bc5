"""Packets and JSON of every convention become the camera's attitude, on every road, once; SciPy is
the authority.
"""

from __future__ import annotations

import os
import re
import socket
from itertools import product

import msgspec
import numpy as np
import pytest
import zmq
from cobs import cobs
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.source import (
    AS_SENT,
    HILSTARS,
    Convention,
    Mounting,
    SentAttitudes,
    packet_conventions,
)
from hilstar.server.bench.config.bench_config import parse_config
from hilstar.server.open_link import open_link
from tests.support.benches import SMALL_BENCH
from tests.support.senders import free_port, packet
from tests.support.waiting import PATIENCE_S
from tests.support.wire.ptys import serial_line

# Three products of float64 rotations; a packet's rate is float32.
ROUNDING, RATE_ROUNDING = 1e-14, 1e-7
CONVENTIONS = [
    Convention(scalar=scalar, direction=direction, frame=frame)
    for scalar, direction, frame in product(
        ("first", "last"), ("icrs_to_cam", "cam_to_icrs"), ("cam", "body")
    )
]
Q_BODY_TO_CAM = (0.5, -0.5, -0.5, -0.5)
BODY_TO_CAM = Rotation.from_quat(Q_BODY_TO_CAM, scalar_first=True)
ICRS_TO_CAM = Rotation.from_euler("zyx", [10, 20, 30], degrees=True)
RATE = np.array([0.01, -0.02, 0.03])  # of the camera, in its components


def sent_by(convention: Convention) -> tuple[list[float], list[float]]:
    """What a sender of this convention sends: its quaternion and its rate."""
    turn, rate = ICRS_TO_CAM, RATE
    if convention.frame == "body":
        turn, rate = BODY_TO_CAM.inv() * turn, BODY_TO_CAM.inv().apply(rate)
    if convention.direction == "cam_to_icrs":
        turn = turn.inv()
    return turn.as_quat(scalar_first=convention.scalar == "first").tolist(), rate.tolist()


def assert_is_truth(event: wire.Event) -> None:
    assert isinstance(event, wire.AttitudeSample)
    found = Rotation.from_quat(event.q_icrs_to_cam, scalar_first=True)
    assert (found * ICRS_TO_CAM.inv()).magnitude() < ROUNDING
    assert event.rate_cam_rad_s == pytest.approx(RATE, abs=RATE_ROUNDING)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_words_of_a_convention_name_its_components_where_they_stand(convention: Convention):
    said = packet_conventions(convention)
    order = re.search(r"\((.+)\)", said.scalar)[1].split(", ")
    assert order.index("w") == {"first": 0, "last": 3}[convention.scalar]
    sent = dict(zip(order, convention.as_sent(np.array([0.5, 0.1, -0.7, 0.5])), strict=True))
    assert sent["w"] == 0.5
    sign = -1 if convention.direction == "cam_to_icrs" else 1
    assert [sent[axis] for axis in "xyz"] == [sign * 0.1, sign * -0.7, sign * 0.5]
    frame = {"cam": "camera", "body": "body"}[convention.frame]
    first, second = ("ICRS", frame) if sign == 1 else (frame, "ICRS")
    assert said.turns.endswith(f"turns {first} components into {second} components")


def config_with(convention: Convention, table: str):
    text = SMALL_BENCH.replace("[tracker]", f"[tracker]\nq_body_to_cam = {list(Q_BODY_TO_CAM)}")
    return parse_config("bench.toml", f"{text}\n[attitude]\nconvention = {convention}\n{table}\n")


def heard(link) -> wire.Event:
    """The first event that a link brings, whose bytes are those that were sent."""
    for _ in range(round(PATIENCE_S * 20)):
        found = link.receive(50)
        if found:
            return found[0] if isinstance(found, list) else found
    raise AssertionError("nothing came")


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_a_packet_and_json_of_each_convention_over_zeromq(convention):
    q, rate = sent_by(convention)
    port = free_port()
    with zmq.Context() as context, context.socket(zmq.PUB) as sender:
        sender.setsockopt(zmq.LINGER, 0)
        config = config_with(convention, f'endpoint = "tcp://127.0.0.1:{port}"\nbind = true')
        with open_link(config, None) as link:
            sender.connect(f"tcp://127.0.0.1:{port}")
            for raw in (
                packet(1, 5, q, rate),
                msgspec.json.encode({"t_ns": 5, "q": q, "rate": rate}),
            ):
                arrivals = []
                for _ in range(round(PATIENCE_S * 20)):
                    sender.send(raw)
                    arrivals = [arrival for arrival in link.receive(50) if arrival.raw == raw]
                    if arrivals:
                        break
                assert_is_truth(arrivals[0].event)
            assert link.conventions.of_body == (convention.frame == "body")


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_a_packet_of_each_convention_over_udp_and_serial(convention):
    q, rate = sent_by(convention)
    raw = packet(1, 5, q, rate)
    port = free_port()
    with open_link(
        config_with(convention, f'source = "udp"\nbind = "127.0.0.1:{port}"'), None
    ) as link:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(raw, ("127.0.0.1", port))
        arrival = heard(link)
        assert arrival.raw == raw
        assert_is_truth(arrival.event)
    with serial_line() as (device, name):
        config = config_with(convention, f'source = "serial"\nport = "{name}"')
        with open_link(config, None) as link:
            os.write(device, b"\0" + cobs.encode(raw) + b"\0")
            arrival = heard(link)
            assert cobs.decode(arrival.raw) == raw
            assert_is_truth(arrival.event)


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_a_request_of_each_convention_in_lockstep(convention):
    q, rate = sent_by(convention)
    port = free_port()
    config = config_with(convention, f'endpoint = "tcp://127.0.0.1:{port}"\nlockstep = true')
    with (
        zmq.Context() as context,
        context.socket(zmq.REQ) as sender,
        open_link(config, None) as link,
    ):
        sender.setsockopt(zmq.LINGER, 0)
        sender.connect(f"tcp://127.0.0.1:{port}")
        sender.send(packet(1, 5, q, rate))
        assert_is_truth(heard(link).event)


def test_hilstars_own_convention_costs_no_call():
    assert AS_SENT.decoder(wire.decode) is wire.decode
    assert SentAttitudes(HILSTARS, Mounting(Q_BODY_TO_CAM)).decoder(wire.decode) is wire.decode
    assert SentAttitudes(Convention(scalar="last")).decoder(wire.decode) is not wire.decode


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_what_a_sender_sends_is_found_again(convention):
    sent = SentAttitudes(convention, Mounting(Q_BODY_TO_CAM))
    q = np.array(sent_by(convention)[0])
    found = sent.as_sent(sent.q_icrs_to_cam(q))
    assert min(np.abs(found - q).max(), np.abs(found + q).max()) < ROUNDING


@pytest.mark.parametrize("source", ['source = "vizard"', 'source = "42"', 'source = "scpi"'])
def test_a_source_with_a_convention_of_its_own_takes_hilstars_to_be_stated(source):
    config_with(HILSTARS, source)


def test_a_mounting_that_turns_nothing_is_told():
    mounting, plain = Mounting(Q_BODY_TO_CAM), Mounting((1.0, 0.0, 0.0, 0.0))
    own, body = (
        SentAttitudes(HILSTARS).conventions,
        SentAttitudes(Convention(frame="body")).conventions,
    )
    assert (
        'write [attitude] convention = { frame = "body" }'
        in dict(own.mounting_notices(mounting))["mounting"]
    )
    assert not own.mounting_notices(plain)
    assert not own.mounting_notices(Mounting())
    assert not body.mounting_notices(mounting)
    assert "nobody" not in str(body.mounting_notices(Mounting()))
    assert body.mounting_notices(Mounting())
