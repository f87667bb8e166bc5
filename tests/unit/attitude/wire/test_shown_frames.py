"""Frames on their way to a watcher: what was shown comes back, and what is no frame is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame, frame_parts, read_frame
from hilstar.run.frame_feed import lit_pixels

HEAD = FrameHead(frame=7, lit_ns=123, width=5, height=3, bits=8, q=(1.0, 0.0, 0.0, 0.0))
LIT = np.array([2, 14], dtype=np.uint32)


@pytest.mark.parametrize(("bits", "channels", "largest"), [(8, 1, 255), (10, 1, 1023), (8, 3, 255), (12, 3, 4095)])
def test_a_frame_comes_back_as_it_was_shown(bits, channels, largest):
    head = msgspec.structs.replace(HEAD, bits=bits, channels=channels)
    codes = np.array([[1, 2, 3], [largest, 0, 1]], dtype=np.uint16)[:, :channels].squeeze()
    back = read_frame(frame_parts(ShownFrame(head, LIT, codes)))
    assert isinstance(back, ShownFrame), back
    assert back.head == head
    assert np.array_equal(back.lit, LIT)
    assert np.array_equal(back.codes, codes)


@pytest.mark.parametrize(
    "change",
    [
        lambda parts: parts[:2],
        lambda parts: [*parts, b""],
        lambda parts: [parts[0][:-1], *parts[1:]],
        lambda parts: [parts[0].replace(b'"width":5', b'"width":4'), *parts[1:]],  # index 14 is outside
        lambda parts: [parts[0].replace(b"1.0,", b"1.1,"), *parts[1:]],
        lambda parts: [parts[0], parts[1][::-1], parts[2]],
        lambda parts: [parts[0], parts[1][:-1], parts[2]],
        lambda parts: [parts[0], parts[1], parts[2] + b"\1"],
        lambda parts: [parts[0].replace(b'"channels":1', b'"channels":3'), *parts[1:]],
    ],
)
def test_what_is_no_frame_is_refused(change):
    parts = frame_parts(ShownFrame(HEAD, LIT, np.array([9, 9], dtype=np.uint8)))
    assert isinstance(read_frame(parts), ShownFrame)
    assert isinstance(read_frame(change(parts)), str)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("width", [8, 13])
def test_lit_pixels_are_those_over_code_zero(kind, width, rng):
    levels = (rng.integers(0, 300, (7, width)) * (rng.random((7, width)) < 0.2)).astype(kind)
    assert np.array_equal(lit_pixels(levels), np.flatnonzero(levels))
