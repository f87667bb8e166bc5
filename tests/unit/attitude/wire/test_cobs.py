"""The byte stream's laws (head of hilstar/attitude/wire/packet.py), on any cut and any garbage."""

from __future__ import annotations

import os
from itertools import pairwise

import numpy as np
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from hilstar.attitude.wire.packet import (
    MAX_FRAME_BYTES,
    MAX_KEPT_BYTES,
    AttitudeSample,
    Refusal,
    StreamDecoder,
    TimeRequest,
    decode,
    encode,
    frame,
)
from tests.support.wire.samples import sample

# On demand: HILSTAR_FUZZ=1000000 pytest tests/unit/attitude/wire/test_cobs.py
MUTATED_FRAMES = int(os.environ.get("HILSTAR_FUZZ", "20000"))


GOOD = frame(sample(77))
FRAMES = [frame(sample(k)) for k in range(1000)]


def described(events: list) -> list:
    """Events as plain values: a sample holds arrays, which have no one truth value."""
    return [(repr(event), raw) for event, raw in events]


def fed(decoder: StreamDecoder, chunks: list[bytes]) -> list:
    return [event for chunk in chunks for event in decoder.feed(chunk)]


pieces = st.lists(
    st.one_of(
        st.integers(0, 99).map(lambda k: frame(sample(k))),
        st.integers(0, 99).map(lambda k: frame(TimeRequest(k, -k))),
        st.binary(max_size=200),
        st.just(b"\0"),
    ),
    max_size=12,
)


@settings(max_examples=150, deadline=None)
@given(pieces, st.lists(st.integers(0, 2000), max_size=20))
def test_any_cut_gives_the_same_events(parts, cuts):
    stream = b"".join(parts)
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    chunks = [stream[a:b] for a, b in pairwise(edges)]
    whole = described(fed(StreamDecoder(), [stream]))
    assert described(fed(StreamDecoder(), chunks)) == whole
    assert described(fed(StreamDecoder(), [bytes([byte]) for byte in stream])) == whole


def test_garbage_of_every_length_gives_one_event_of_bounded_bytes_however_it_is_cut():
    for size in range(1, MAX_KEPT_BYTES + 4):
        stream = b"\0" + b"\x05" * size + b"\0" + GOOD
        whole = described(fed(StreamDecoder(), [stream]))
        assert [len(raw) for _, raw in whole[:-1]] == [min(size, MAX_KEPT_BYTES + 1)]
        assert described(fed(StreamDecoder(), [bytes([byte]) for byte in stream])) == whole


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=500))
def test_the_first_whole_frame_after_any_garbage_is_decoded(garbage):
    events = fed(StreamDecoder(), [garbage, b"\0", frame(sample(42))])
    last = events[-1][0]
    assert isinstance(last, AttitudeSample)
    assert last.sequence == 42


def test_nothing_is_accepted_that_the_crc_would_refuse_and_nothing_raises():
    """Mutated frames, each followed by a good one: the good one always comes, the mutant only
    where its CRC is right.
    """
    rng = np.random.default_rng(4)
    # of each mutation: how, where, what, how long
    draws = rng.integers(0, 2**31, size=(MUTATED_FRAMES, 4, 4)).tolist()
    counts = rng.integers(1, 5, size=MUTATED_FRAMES).tolist()
    noise = rng.bytes(100_100)
    decoder = StreamDecoder()
    decoder.feed(b"\0")
    accepted = 0
    for k, (mutations, count) in enumerate(zip(draws, counts, strict=True)):
        mutant = bytearray(FRAMES[k % len(FRAMES)])
        for how, where, what, length in mutations[:count]:
            place = where % len(mutant)
            match how % 4:
                case 0:
                    mutant[place] ^= 1 << what % 8
                case 1:
                    mutant[place] = what % 256
                case 2:
                    del mutant[place:]
                case _:
                    begin = what % 100_000
                    mutant[place:place] = noise[begin : begin + 1 + length % 89]
            if not mutant:
                break
        events = decoder.feed(bytes(mutant) + b"\0" + GOOD)
        *others, (last, _) = events
        assert isinstance(last, AttitudeSample)
        assert last.sequence == 77
        for event, raw in others:
            if not isinstance(event, Refusal):
                accepted += 1
                assert repr(decode(cobs.decode(raw))) == repr(event)
                assert raw in bytes(mutant)
    # A mutation that only adds bytes beside a frame, or turns a bit back, leaves some whole.
    assert accepted < 0.5 * MUTATED_FRAMES


def test_a_sender_that_never_sends_a_delimiter_costs_one_refusal_and_no_memory():
    decoder = StreamDecoder()
    events = decoder.feed(b"\0")
    for _ in range(1000):
        events += decoder.feed(b"\x55" * 1000)
    assert [event.reason for event, _ in events] == ["format"]
    assert len(decoder._kept) <= MAX_FRAME_BYTES
    ((last, _),) = decoder.feed(b"\0" + frame(sample(3)))
    assert isinstance(last, AttitudeSample)


def test_what_was_cut_in_two_before_the_first_delimiter_is_no_refusal():
    whole = frame(sample(1))
    events = fed(StreamDecoder(), [whole[30:], frame(sample(2))])
    assert [event.sequence for event, _ in events] == [2]
    assert [event.sequence for event, _ in fed(StreamDecoder(), [whole])] == [1]


def test_a_frame_of_json_is_refused_for_json_is_zeromq_s():
    body = b' {"t_ns": 1, "q": [1, 0, 0, 0]}'
    ((event, _),) = fed(StreamDecoder(), [b"\0" + cobs.encode(body) + b"\0"])
    assert isinstance(event, Refusal)
    assert event.reason == "format"


def test_a_frame_is_66_bytes_and_its_packet_comes_back():
    assert len(frame(sample(9))) == 66
    ((event, raw),) = fed(StreamDecoder(), [b"\0" + frame(sample(9))])
    assert repr(event) == repr(sample(9))
    assert cobs.decode(raw) == encode(sample(9))
