"""The test sender: what a bad cable does to packets, and the samples of logs and spins."""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
import pytest

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, TimeReply, TimeRequest, decode, encode
from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    propagate,
)
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server import send_log
from hilstar.server.send_log import BadCable, Faults, SendTally, log_samples, send, spin_samples
from hilstar.server.sender import TwoWay
from tests.support.fake_clock import FakeClock
from tests.support.waiting import PATIENCE_S

PACKETS = 2000
# of a share of PACKETS: five standard deviations of the number that chance gives
SHARE_ERROR = 5 * 0.5 / np.sqrt(PACKETS)
SAME_RAD = 1e-9
RATE = np.array([0.1, -0.2, 0.05])
START = np.array([0.5, 0.5, -0.5, 0.5])


def packet(sequence: int) -> bytes:
    """A packet that says its number."""
    return encode(AttitudeSample(sequence, START, None, sequence))


def carried(faults: Faults, rng) -> tuple[SendTally, list[bytes]]:
    """What of PACKETS leaves a cable."""
    left: list[bytes] = []
    cable = BadCable(faults, rng, left.append)
    for sequence in range(PACKETS):
        cable.carry(packet(sequence))
    cable.close()
    return cable.tally, left


def test_each_fault_meets_its_share_of_the_packets_and_each_packet_one(rng):
    tally, left = carried(Faults(lose=0.1, corrupt=0.2, reorder=0.3), rng)
    assert tally.total == PACKETS
    assert len(left) == PACKETS - tally.lost
    assert tally.lost / PACKETS == pytest.approx(0.1, abs=SHARE_ERROR)
    assert tally.corrupted / PACKETS == pytest.approx(0.2, abs=SHARE_ERROR)
    refused = sum(not isinstance(decode(data), AttitudeSample) for data in left)
    assert refused == tally.corrupted


def test_a_corrupted_packet_has_one_to_three_bits_of_its_own_changed(rng):
    tally, left = carried(Faults(corrupt=1.0), rng)
    assert tally == SendTally(corrupted=PACKETS)
    changed = []
    for sequence, data in enumerate(left):
        before = np.frombuffer(packet(sequence), np.uint8)
        after = np.frombuffer(data, np.uint8)
        changed.append(int(np.unpackbits(before ^ after).sum()))
    assert set(changed) == {1, 2, 3}


def test_a_packet_held_back_leaves_right_after_the_next_and_the_last_one_at_the_end(rng):
    tally, left = carried(Faults(reorder=1.0), rng)
    sequences = [decode(data).sequence for data in left]
    swapped = np.arange(PACKETS).reshape(-1, 2)[:, ::-1].ravel()
    assert sequences == swapped.tolist()
    assert (tally.reordered, tally.sent) == (PACKETS // 2, PACKETS // 2)
    alone: list[bytes] = []
    cable = BadCable(Faults(reorder=1.0), rng, alone.append)
    cable.carry(packet(5))
    assert alone == []
    cable.close()
    cable.close()
    assert [decode(data).sequence for data in alone] == [5]
    assert cable.tally == SendTally(sent=1)  # with none after it, it is in order


def test_a_spin_turns_at_its_rate_from_where_it_begins():
    samples = list(itertools.islice(spin_samples(RATE, 50.0, (84.0, -1.2, 10.0)), 101))
    assert [sample.t_ns for sample in samples] == [k * NS_PER_S // 50 for k in range(101)]
    assert [sample.sequence for sample in samples] == list(range(101))
    start = from_radec_roll_deg(84.0, -1.2, 10.0)
    wanted = propagate(start, RATE, 2.0)
    assert angle_between_rad(samples[100].q_icrs_to_cam, wanted) < SAME_RAD


def turning(times_s, rates, breaks=()) -> list[AttitudeSample]:
    """Samples of a turn, at 5 s and on, with rates of their own."""
    return [
        AttitudeSample(
            round((5 + t_s) * NS_PER_S),
            propagate(START, RATE, t_s),
            None if rate is None else np.asarray(rate),
            discontinuity=k in breaks,
        )
        for k, (t_s, rate) in enumerate(zip(times_s, rates, strict=True))
    ]


def test_a_log_begins_at_0_and_a_rate_that_it_lacks_is_the_turn_to_the_next_sample():
    samples = list(log_samples(turning([0.0, 0.5, 1.0], [None] * 3), None))
    assert [sample.t_ns for sample in samples] == [0, NS_PER_S // 2, NS_PER_S]
    assert samples[0].rate_cam_rad_s == pytest.approx(RATE)
    assert samples[2].rate_cam_rad_s is None


def test_a_rate_between_two_of_a_log_is_between_theirs_and_none_crosses_a_break():
    """At a third of the way a third of the change; behind a break the log begins anew."""
    rates = [[0.0, 0.0, 0.0], [0.3, -0.6, 0.9], [3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
    samples = list(log_samples(turning([0.0, 0.3, 0.6, 0.9], rates, breaks={0, 2}), 10.0))
    assert [sample.t_ns for sample in samples] == [k * NS_PER_S // 10 for k in range(10)]
    rate = [sample.rate_cam_rad_s for sample in samples]
    assert rate[1] == pytest.approx([0.1, -0.2, 0.3])
    assert rate[2] == pytest.approx([0.2, -0.4, 0.6])
    for before_break in (4, 5):
        assert rate[before_break] == pytest.approx([0.3, -0.6, 0.9])
    assert rate[6] == pytest.approx([3.0, 0.0, 0.0])
    assert [k for k, sample in enumerate(samples) if sample.discontinuity] == [6]


def test_a_jump_between_two_packets_of_a_resampled_log_is_one_at_the_second():
    """A log of 100 Hz, sent at 10 Hz: nine more of its samples lie between two packets."""
    times_s = [k / 100 for k in range(41)]
    samples = list(log_samples(turning(times_s, [None] * 41, breaks={12}), 10.0))
    assert [k for k, sample in enumerate(samples) if sample.discontinuity] == [2]


def test_behind_a_gap_a_log_begins_anew_and_no_rate_crosses_it():
    times_s = [0.0, 1.0, 2.0, 3.0, 60.0, 61.0, 62.0, 63.0]
    samples = list(log_samples(turning(times_s, [None] * len(times_s)), None))
    assert [k for k, sample in enumerate(samples) if sample.discontinuity] == [4]
    without = [k for k, sample in enumerate(samples) if sample.rate_cam_rad_s is None]
    assert without == [3, 7]


def test_a_time_reply_has_when_its_request_came_and_when_the_reply_leaves():
    """`receive` hands a request over 80 ms after it came."""
    waits_ns, sent, replied = 80 * NS_PER_MS, [], threading.Event()

    class End(TwoWay):
        def receive(self, patience_ms: int) -> list[Arrival]:
            if replied.is_set():
                self._stop.wait(patience_ms / 1000)
                return []
            return [Arrival(time.monotonic_ns() - waits_ns, TimeRequest(3, 40))]

        def send(self, packet: TimeReply) -> None:
            sent.append(packet)
            replied.set()

        def close(self) -> None:
            self._stop_listening()

    own = FakeClock(5 * NS_PER_S)
    with End() as end:
        end._listen_to(end.receive, end.send, own.now_ns)
        assert replied.wait(PATIENCE_S)
    (reply,) = sent
    assert (reply.sequence, reply.t1_ns, reply.t3_ns) == (3, 40, own.now_ns())
    assert waits_ns <= reply.t3_ns - reply.t2_ns < waits_ns + 2 * NS_PER_S
    assert end.requests == 1


def test_jitter_delays_packets_and_not_the_time_of_their_attitudes(monkeypatch, rng):
    """Each is stamped when it was due, on an even grid, and none goes out before."""
    clock = FakeClock()
    monkeypatch.setattr(send_log, "HOST_CLOCK", clock)
    monkeypatch.setattr(send_log.time, "monotonic_ns", clock.now_ns)
    left: list[tuple[int, AttitudeSample]] = []
    cable = BadCable(
        Faults(jitter_s=0.004), rng, lambda data: left.append((clock.ns, decode(data)))
    )
    start_ns = clock.ns
    samples = itertools.islice(spin_samples(RATE, 100.0, (0.0, 0.0, 0.0)), 200)
    told: list[int] = []
    send(cable, samples, threading.Event(), sender=9, on_sent=told.append)
    assert told == list(range(1, 201))
    stamps_ns = np.array([sample.t_ns for _, sample in left])
    assert (stamps_ns - start_ns == np.arange(200) * 10 * NS_PER_MS).all()
    late_ns = np.array([host_ns for host_ns, _ in left]) - stamps_ns
    assert late_ns.min() >= 0
    assert 0.003 * NS_PER_S < late_ns.max() <= 0.004 * NS_PER_S
    assert {sample.sender for _, sample in left} == {9}


def test_a_stopped_sender_sends_no_more(rng):
    left: list[bytes] = []
    stop = threading.Event()
    stop.set()
    send(BadCable(Faults(), rng, left.append), spin_samples(RATE, 100.0, (0.0, 0.0, 0.0)), stop)
    assert left == []


@pytest.mark.parametrize(("sent", "sequences"), [(4, [1, 0, 3, 2]), (5, [1, 0, 3, 2, 4])])
def test_a_sender_ends_with_the_packet_that_its_cable_holds_back(rng, sent, sequences):
    left: list[bytes] = []
    cable = BadCable(Faults(reorder=1.0), rng, left.append)
    samples = itertools.islice(spin_samples(RATE, 1e6, (0.0, 0.0, 0.0)), sent)
    send(cable, samples, threading.Event())
    assert [decode(data).sequence for data in left] == sequences
    assert cable.tally.total == sent


def test_a_sender_that_is_stopped_lets_out_what_its_cable_holds_back(rng):
    left: list[bytes] = []
    stop = threading.Event()
    cable = BadCable(Faults(reorder=1.0), rng, left.append)
    samples = spin_samples(RATE, 1e6, (0.0, 0.0, 0.0))
    send(cable, samples, stop, on_sent=lambda count: stop.set())
    assert [decode(data).sequence for data in left] == [0]


def test_a_packet_has_all_of_its_sample_but_the_time(rng):
    left: list[bytes] = []
    rate = np.array([0.25, 0.5, -0.125])  # of float32, as a packet has it
    samples = [AttitudeSample(0, START, rate, 7), AttitudeSample(1, START, None, 8, True)]
    send(BadCable(Faults(), rng, left.append), iter(samples), threading.Event())
    first, last = map(decode, left)
    assert first.q_icrs_to_cam.tolist() == START.tolist()
    assert np.array_equal(first.rate_cam_rad_s, rate) and last.rate_cam_rad_s is None
    assert [(each.sequence, each.discontinuity) for each in (first, last)] == [
        (7, False),
        (8, True),
    ]
    assert last.t_ns - first.t_ns == 1
