"""42's messages: what the real program sent, by its own report; random attitudes by SciPy; and
what is wrong.
"""

from __future__ import annotations

import re
import socket
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire.endpoint import parse_endpoint
from hilstar.attitude.wire.nasa42 import (
    CONVENTIONS,
    END,
    MAX_MESSAGE_BYTES,
    MessageReader,
    MessageSplitter,
    Nasa42Link,
    Nasa42Lockstep,
    spacecraft_number,
    tcp_road,
)
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, Status
from hilstar.attitude.wire.source import CHECK_RADEC_DEG, Mounting
from hilstar.basics.rotation import to_radec_roll_deg
from tests.support.sources.nasa42 import BEGIN_NS, STREAM_2024, STREAM_2025, message, report
from tests.support.waiting import PATIENCE_S, wait_for

# 42 writes thirteen significant digits: four components off by 5e-13 turn a unit vector by 2e-12 at
# most.
DIGITS = 2e-12
REPORT_DIGITS = 5e-7  # its report has seven
# Over 0.1 s the rate of a body that nutates is not its mean rate: here by 1.1e-7 rad/s, of 0.068.
NUTATION_RAD_S = 3e-7
PERIOD_S = 0.1


def attitudes_of_stream(
    stream: bytes, spacecraft: int = 0, mounting: Mounting | None = None
) -> list[AttitudeSample | Refusal]:
    reader = MessageReader(spacecraft, mounting or Mounting())
    return [reader.decode(each) for each in MessageSplitter().feed(stream)]


def recorded_2025() -> list[AttitudeSample]:
    found = attitudes_of_stream(STREAM_2025.read_bytes())
    assert all(isinstance(each, AttitudeSample) for each in found)
    return [each for each in found if isinstance(each, AttitudeSample)]


def rotation(q) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def test_the_recorded_attitudes_turn_42_s_vectors_of_n_into_its_own_of_b():
    """svn and svb are the Sun's direction in N and in B, of 42's own report: neither direction
    nor scalar order is assumed.
    """
    by_time = report()
    samples = recorded_2025()
    assert len(samples) == 61
    for sample in samples:
        row = by_time[sample.t_ns]
        assert rotation(sample.q_icrs_to_cam).apply(row["svn"]) == pytest.approx(
            row["svb"], abs=DIGITS
        )
        assert (
            np.abs(rotation(sample.q_icrs_to_cam).inv().as_quat() - row["q"]).max() < REPORT_DIGITS
        )


def test_the_recorded_rates_are_how_the_recorded_attitudes_turn():
    for before, after in pairwise(recorded_2025()):
        turn = rotation(after.q_icrs_to_cam) * rotation(before.q_icrs_to_cam).inv()
        mean = (before.rate_cam_rad_s + after.rate_cam_rad_s) / 2
        # vectors turn the other way
        assert -turn.as_rotvec() / PERIOD_S == pytest.approx(mean, abs=NUTATION_RAD_S)


def test_a_stream_of_the_form_until_2025_is_read():
    samples = attitudes_of_stream(STREAM_2024.read_bytes())
    assert len(samples) == 20
    for before, after in pairwise(samples):
        assert after.t_ns - before.t_ns == 100_000_000
        turn = rotation(after.q_icrs_to_cam) * rotation(before.q_icrs_to_cam).inv()
        mean = (before.rate_cam_rad_s + after.rate_cam_rad_s) / 2
        assert -turn.as_rotvec() / PERIOD_S == pytest.approx(mean, abs=NUTATION_RAD_S)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_a_random_body_and_mounting_see_a_star_where_scipy_does(seed, old):
    rng = np.random.default_rng(seed)
    n_to_b, b_to_cam = Rotation.random(2, rng=rng)
    star, rate = rng.normal(size=3), rng.normal(size=3)
    mounting = Mounting(tuple(b_to_cam.as_quat(scalar_first=True)))
    text = message(3661.25, n_to_b, rate, old=old, number=3)
    (sample,) = attitudes_of_stream(text.encode(), 3, mounting)
    assert isinstance(sample, AttitudeSample)
    assert sample.t_ns == BEGIN_NS + 3_661_250_000_000
    seen = rotation(sample.q_icrs_to_cam).apply(star)
    assert seen == pytest.approx((b_to_cam * n_to_b).apply(star), abs=10 * DIGITS)
    assert sample.rate_cam_rad_s == pytest.approx(b_to_cam.apply(rate), abs=10 * DIGITS)


def test_the_self_check_s_own_words_point_where_it_says():
    mounting = Mounting(
        tuple(Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_quat(scalar_first=True))
    )
    words = re.search(r"qn = \(([-0-9., ]+)\)", CONVENTIONS.lines(mounting)[-1])
    assert words is not None
    text = f"TIME 2024-099-00:00:00.0\nSC[0].B[0].qn = [{words[1].replace(',', ' ')}]\n[ENDMSG]\n"
    (sample,) = attitudes_of_stream(text.encode(), 0, mounting)
    assert isinstance(sample, AttitudeSample)
    # Seven digits of each component: 2e-7 rad.
    assert to_radec_roll_deg(sample.q_icrs_to_cam)[:2] == pytest.approx(
        CHECK_RADEC_DEG, abs=np.degrees(2e-7)
    )


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 17_326), max_size=20), st.booleans())
def test_however_the_bytes_are_cut_the_messages_are_the_same(cuts, old):
    stream = (
        (STREAM_2024 if old else STREAM_2025).read_bytes()
        + b"x" * (MAX_MESSAGE_BYTES + 5)
        + b"\n[ENDMSG]\nTIME"
    )
    whole = MessageSplitter().feed(stream)
    splitter = MessageSplitter()
    places = [0, *sorted(cuts), len(stream)]
    assert [each for a, b in pairwise(places) for each in splitter.feed(stream[a:b])] == whole
    assert whole[-1] == b""


GOOD = "TIME 2024-099-00:00:01.5\nSC[0].B[0].wn = [0 0 1e-3]\nSC[0].B[0].qn = [0 0 0 1]\n[ENDMSG]\n"


@pytest.mark.parametrize(
    ("was", "becomes", "reason"),
    [
        ("TIME", "time", "format"),
        ("2024-099", "2024-367", "format"),
        ("2024-099", "0000-099", "format"),
        ("2024-099", "9999-366", "format"),
        ("2024-099", "2023-366", "format"),
        ("2024-099", "2024-000", "format"),
        ("00:00:01.5", "25:00:01.5", "format"),
        ("00:00:01.5", "23:59:60.000000000", None),
        ("SC[0].B[0].qn", "SC[1].B[0].qn", "format"),
        ("SC[0].B[0].qn", "SC[0].qn", None),
        ("[0 0 0 1]", "[0 0 0]", "format"),
        ("[0 0 0 1]", "[0 0 0 one]", "format"),
        ("[0 0 0 1]", "[0 0 0 1", None),
        ("[0 0 0 1]", "[]", "format"),
        ("[0 0 0 1]", "[nan 0 0 1]", "nan"),
        ("[0 0 0 1]", "[0 0 0 1e999]", "nan"),
        ("[0 0 0 1]", "[0 0 0 2]", "norm"),
        ("[0 0 1e-3]", "[0 0]", "format"),
        ("[0 0 1e-3]", "[0 -nan 0]", "nan"),
        ("[0 0 1e-3]", "[0 0 1e9]", "format"),
        ("SC[0].B[0].wn = [0 0 1e-3]\n", "", None),
        (GOOD[:-10], "", "format"),
        (GOOD[:-10], "\0\xff\x80" * 999, "format"),
        (GOOD[:-10], "[" * 60_000, "format"),
        (GOOD[:-10], "[" * 70_000, "format"),
    ],
)
def test_a_wrong_message_is_refused_by_reason_and_the_next_is_read(was, becomes, reason):
    assert was in GOOD
    wrong, good = attitudes_of_stream((GOOD.replace(was, becomes) + GOOD).encode("latin-1"))
    assert (wrong.reason if isinstance(wrong, Refusal) else None) == reason
    assert isinstance(good, AttitudeSample)
    assert good.sequence == 2


@pytest.mark.parametrize(
    ("written", "date", "ns"),
    [
        ("2024-099-00:00:01.5", "2024-04-08T00:00:01", 500_000_000),
        ("2024-366-23:59:59.000000001", "2024-12-31T23:59:59", 1),
        ("2016-366-23:59:60.25", "2017-01-01T00:00:00", 250_000_000),
        ("2023-001-01:02:03", "2023-01-01T01:02:03", 0),
        ("2000-060-12:34:56.0123456789", "2000-02-29T12:34:56", 12_345_678),
    ],
)
def test_a_time_is_that_of_its_day_of_the_year_and_each_digit_counts(written, date, ns):
    (sample,) = attitudes_of_stream(GOOD.replace("2024-099-00:00:01.5", written).encode())
    assert isinstance(sample, AttitudeSample)
    assert sample.t_ns == int(np.datetime64(date, "ns").astype(np.int64)) + ns


def test_in_lockstep_each_message_is_acknowledged_once_its_own_frame_is_shown():
    reader = MessageReader(0, Mounting())
    with (
        Nasa42Lockstep("tcp://127.0.0.1:*", reader, bind=True) as link,
        closing(socket.socket()) as simulator,
    ):
        place = parse_endpoint(link.endpoint).address
        simulator.connect(("127.0.0.1", int(place.rpartition(":")[2])))
        simulator.settimeout(PATIENCE_S)
        simulator.sendall(GOOD.encode() * 2)
        arrivals = []

        def arrives() -> bool:
            arrivals.append(link.receive(10))
            return arrivals[-1] is not None

        for number in (1, 2):
            wait_for(arrives, "a message")
            assert arrivals[-1].event.sequence == number
            link.answer(Status(0, 0, 0, 0, 0, 0, 0), 0, None)
            assert simulator.recv(64) == b"Ack\n"


def test_a_free_stream_acknowledges_each_message_of_a_chunk_and_none_that_has_no_end():
    with (
        Nasa42Link("tcp://127.0.0.1:*", MessageReader(0, Mounting()), bind=True) as link,
        closing(socket.socket()) as simulator,
    ):
        place = parse_endpoint(link.endpoint).address
        simulator.connect(("127.0.0.1", int(place.rpartition(":")[2])))
        simulator.settimeout(PATIENCE_S)
        begun, ended = GOOD[:40].encode(), GOOD[40:].encode()
        arrivals = []

        def come(count: int) -> bool:
            arrivals.extend(link.receive(10))
            return len(arrivals) == count

        simulator.sendall(GOOD.encode() * 3 + begun)
        wait_for(lambda: come(3), "three messages")
        assert simulator.recv(64) == b"Ack\n" * 3
        simulator.sendall(ended + GOOD.encode())
        wait_for(lambda: come(5), "two more")
        assert simulator.recv(64) == b"Ack\n" * 2


def test_a_message_without_an_end_costs_its_bound_and_no_more():
    splitter = MessageSplitter()
    for _ in range(1000):
        assert splitter.feed(b"SC[0].B[0].qn = [0 0 0 1]\n" * 100) == []
        assert len(splitter._kept) <= MAX_MESSAGE_BYTES
    assert splitter.feed(b"[ENDMSG]\n" + GOOD.encode()) == [b"", GOOD.encode()]


def test_the_spacecraft_is_a_number_or_42_s_own_name_of_it():
    assert [spacecraft_number(name) for name in (None, 0, 3, "SC[12]", "7")] == [0, 0, 3, 12, 7]


def test_a_message_that_comes_byte_by_byte_is_looked_through_once(monkeypatch):
    """Each byte had all that was kept searched again: 0.4 ms of it for each."""
    looked_at = 0

    class Counted:
        def search(self, kept, begin=0):
            nonlocal looked_at
            looked_at += len(kept) - begin
            return END.search(kept, begin)

    monkeypatch.setattr("hilstar.attitude.wire.nasa42.END", Counted())
    stream = b"SC[0].B[0].wn = [0 0 0]\n" * 500 + b"[ENDMSG]\n"
    splitter = MessageSplitter()
    assert [message for byte in stream for message in splitter.feed(bytes([byte]))] == [stream]
    assert looked_at <= 2 * len(stream)


@pytest.mark.parametrize(
    ("endpoint", "bind", "place"),
    [
        ("tcp://*:*", True, r"tcp://0\.0\.0\.0:\d+"),
        ("tcp://127.0.0.1:*", True, r"tcp://127\.0\.0\.1:\d+"),
        ("tcp://[::1]:10001", False, r"tcp://\[::1\]:10001"),
        ("tcp://[::1]:*", True, r"tcp://\[::1\]:\d+"),
        ("tcp://localhost:10001", False, "tcp://localhost:10001"),
    ],
)
def test_the_road_to_42_is_where_the_endpoint_says(endpoint, bind, place):
    with tcp_road(endpoint, bind=bind) as road:
        assert re.fullmatch(place, road.endpoint)
        assert road.verb == ("bound to" if bind else "connecting to")
