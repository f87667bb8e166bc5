"""The square on the screen that a photodiode watches: what it shows, frame by frame."""

from __future__ import annotations

CODE_BITS = 7


def maximal_sequence() -> tuple[int, ...]:
    """The 127 bits of the shift register x^7 + x^6 + 1: any 7 in a row come once (Golomb, Shift Register Sequences, 1967)."""
    state, bits = 1, []
    for _ in range(2**CODE_BITS - 1):
        bits.append(state & 1)
        state = state >> 1 | ((state ^ state >> 1) & 1) << CODE_BITS - 1
    return tuple(bits)


CODE = maximal_sequence()


def marker_light(number: int, kind: str) -> int:
    """The square of a frame, 0 or 1: light in every other frame (`toggle`), or the bit of CODE at the frame's number.

    `toggle` gives a latency modulo two frames, `code` modulo 127 frames.
    """
    return number % 2 if kind == "toggle" else CODE[number % len(CODE)]
