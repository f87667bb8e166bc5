"""The model in an FMU, stepped as a simulation tool does, before a display that is the test's
socket.
"""

from __future__ import annotations

import importlib
import json
import socket
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import (
    AnswerPacket,
    AttitudeSample,
    Status,
    TimeReply,
    TimeRequest,
    decode,
    encode,
)
from hilstar.cli import fmu
from tests.support.waiting import PATIENCE_S, wait_for

Q = (0.1, -0.5, 0.7, 0.5)
RATE = (0.25, -0.5, 0.125)


@pytest.fixture
def display() -> Iterator[socket.socket]:
    """Where the model sends its attitudes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened


@pytest.fixture
def model(display: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The model of an FMU for that display; its tool is in real time itself."""
    monkeypatch.setitem(sys.modules, fmu.PROTOCOL, protocol)
    monkeypatch.delitem(sys.modules, "hilstar.server.fmu_model", raising=False)
    source = importlib.import_module("hilstar.server.fmu_model")
    monkeypatch.setattr(source, "__file__", str(tmp_path / "model.py"))
    port = display.getsockname()[1]
    (tmp_path / "bench.json").write_text(json.dumps({"address": f"127.0.0.1:{port}"}))
    made = source.StarDisplay(
        instance_name="display", resources=str(tmp_path), visible=False, logging_on=False
    )
    made.real_time = False
    made.log = lambda line, *_: logged.append(line)
    made.logged = logged = []
    made.exit_initialization_mode()
    yield made
    made.terminate()


def turned(model: Any, q: tuple[float, ...] = Q, rate: tuple[float, ...] = RATE) -> None:
    """Connect an attitude and a rate."""
    model.q_w, model.q_x, model.q_y, model.q_z = q
    model.rate_x, model.rate_y, model.rate_z = rate


def received(display: socket.socket) -> tuple[AttitudeSample, Any]:
    """The next attitude, and whose it is."""
    data, peer = display.recvfrom(256)
    packet = decode(data)
    assert isinstance(packet, AttitudeSample)
    return packet, peer


def test_a_step_sends_the_attitude_of_its_communication_point(model, display):
    turned(model)
    assert model.do_step(2.5, 0.02) and model.do_step(2.52, 0.02)
    first, second = (received(display)[0] for _ in range(2))
    assert first.q_icrs_to_cam == pytest.approx(Q, abs=1e-12)
    assert tuple(first.rate_cam_rad_s) == RATE
    assert (first.sequence, first.t_ns) == (0, 2_500_000_000)
    assert (second.sequence, second.t_ns) == (1, 2_520_000_000)


def test_a_connected_time_is_the_attitude_s_and_no_rate_is_none(model, display):
    turned(model)
    model.use_rate, model.t_s = False, 77.125
    assert model.do_step(1.0, 0.5)
    packet = received(display)[0]
    assert (packet.t_ns, packet.rate_cam_rad_s) == (77_125_000_000, None)


@pytest.mark.parametrize(
    ("q", "rate", "words"),
    [
        ((0.0, 0.0, 0.0, 0.0), RATE, "q has the norm 0, rate is (0.25, -0.5, 0.125)"),
        ((1.002, 0.0, 0.0, 0.0), RATE, "q has the norm 1.002"),
        ((0.998, 0.0, 0.0, 0.0), RATE, "q has the norm 0.998"),
        ((float("nan"), 0.0, 0.0, 1.0), RATE, "connect a unit quaternion"),
        (Q, (0.0, float("inf"), 0.0), "rate is (0.0, inf, 0.0)"),
    ],
)
def test_a_step_without_an_attitude_fails_and_sends_nothing(model, display, q, rate, words):
    turned(model, q, rate)
    assert not model.do_step(0.0, 0.1)
    assert len(model.logged) == 1 and words in model.logged[0]
    turned(model, (1.0005, 0.0, 0.0, 0.0))
    assert model.do_step(0.1, 0.1)
    assert received(display)[0].sequence == 0


def test_what_comes_back_is_its_outputs(model, display):
    assert (model.frame, model.health, model.statuses, model.answers) == (0, 0, 0, 0)
    turned(model)
    model.do_step(0.0, 0.1)
    peer = received(display)[1]
    health = protocol.HEALTH_STALE | protocol.HEALTH_CLIPPED
    for frame in (2**31 + 17, 2**31 + 18):
        display.sendto(encode(Status(health, frame, 1, 2, 3, 4, 5)), peer)
    wait_for(lambda: model.statuses == 2, "two statuses")
    assert (model.health, model.frame) == (health, 18)
    lost = AnswerPacket(1, protocol.ANSWER_LOST_IN_SPACE, 5, (1.0, 0.0, 0.0, 0.0))
    valid = AnswerPacket(2, protocol.ANSWER_VALID, 1_250_000_000, (0.5, -0.5, -0.5, 0.5))
    damaged = bytearray(encode(valid))
    damaged[9] ^= 1
    other_version = bytes([protocol.VERSION + 1]) + encode(valid)[1:-4]
    display.sendto(other_version + zlib.crc32(other_version).to_bytes(4, "little"), peer)
    display.sendto(b"?", peer)
    display.sendto(damaged, peer)
    display.sendto(encode(lost), peer)
    display.sendto(encode(valid), peer)
    wait_for(lambda: model.answers == 1, "the valid answer")
    answered = (model.answered_q_w, model.answered_q_x, model.answered_q_y, model.answered_q_z)
    assert (answered, model.answered_t_s) == ((0.5, -0.5, -0.5, 0.5), 1.25)


def test_it_tells_its_time_from_its_first_step_on(model, display):
    """The model's clock goes on with the host's from the first attitude's time."""
    turned(model)
    before_ns = time.monotonic_ns()
    model.do_step(40.0, 0.1)
    after_ns = time.monotonic_ns()
    peer = received(display)[1]
    model.do_step(40.1, 0.1)
    received(display)
    asked_ns = time.monotonic_ns()
    display.sendto(encode(TimeRequest(9, 11)), peer)
    reply = decode(display.recv(256))
    heard_ns = time.monotonic_ns()
    assert isinstance(reply, TimeReply) and (reply.sequence, reply.t1_ns) == (9, 11)
    elapsed_ns = [t_ns - 40_000_000_000 for t_ns in (reply.t2_ns, reply.t3_ns)]
    assert asked_ns - after_ns <= elapsed_ns[0] <= elapsed_ns[1] <= heard_ns - before_ns


def test_in_real_time_a_step_ends_with_its_time(model, monkeypatch):
    """Steps begin at 3 s; what computing took is not waited for again, and a late step not at
    all.
    """
    now_s = [100.0]
    slept = []
    clock = SimpleNamespace(
        monotonic=lambda: now_s[0], monotonic_ns=lambda: int(now_s[0] * 1e9), sleep=slept.append
    )
    monkeypatch.setattr(sys.modules["hilstar.server.fmu_model"], "time", clock)
    turned(model)
    model.real_time = True
    for at_s, host_s, wait_s in ((3.0, 100.0, 0.5), (3.5, 100.6, 0.4), (4.0, 102.0, 0.0)):
        now_s[0] = host_s
        assert model.do_step(at_s, 0.5)
        assert slept.pop() == pytest.approx(wait_s, abs=1e-9) and not slept


def test_it_is_described_with_its_inputs_outputs_and_what_they_begin_as(model):
    root = model.to_xml({})
    kinds: dict[str, list[str]] = {}
    for variable in root.iter("ScalarVariable"):
        kinds.setdefault(variable.get("causality"), []).append(variable.get("name"))
    assert kinds["input"] == [
        "q_w", "q_x", "q_y", "q_z", "rate_x", "rate_y", "rate_z", "t_s"
    ]  # fmt: skip
    assert kinds["parameter"] == ["address", "real_time", "use_rate"]
    assert kinds["output"] == [
        "frame", "health", "statuses", "answers", "answered_q_w", "answered_q_x", "answered_q_y",
        "answered_q_z", "answered_t_s",
    ]  # fmt: skip
    said = {node.get("name"): node.get("description") for node in root.iter("ScalarVariable")}
    assert said["t_s"].startswith("s: time of the attitude")
    assert {said[name] for name in ("q_w", "q_z")} == {"q_icrs_to_cam, scalar first, Hamilton"}
    assert said["rate_z"].startswith("rad/s")
    outputs, unknown = (
        root.find("ModelStructure/Outputs"),
        root.find("ModelStructure/InitialUnknowns"),
    )
    numbers = [node.get("index") for node in outputs]
    assert numbers == [node.get("index") for node in unknown] == [str(k) for k in range(12, 21)]
