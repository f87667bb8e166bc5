"""The kernel's own stamps of what a socket receives, UDP or TCP: on the monotonic clock, however late it is read."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

from hilstar.units import NS_PER_S

SO_TIMESTAMPNS = 35  # Linux's number (asm-generic/socket.h); the stamp is a timespec of CLOCK_REALTIME
TIMESPEC = struct.Struct("@ll")
ANCILLARY_BYTES = socket.CMSG_SPACE(TIMESPEC.size)
CLOCK_TRIES = 3
NEAR_NS = 20_000


class KernelStamps:
    """Has the kernel stamp what `receiving` gets; where it cannot, the time of reading counts.

    `empty_ns` is when nothing waited last, host time: what is read arrived later than that. Of a TCP stream the stamp is that
    of the last byte read.
    """

    def __init__(self, receiving: socket.socket) -> None:
        self.empty_ns = time.monotonic_ns()
        with contextlib.suppress(OSError):
            receiving.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def arrived_ns(self, ancillary: list[tuple[int, int, bytes]], now_ns: int, offset_ns: int | None = None) -> int:
        """When something came, from what `recvmsg` told at `now_ns`.

        A realtime clock that was set meanwhile moves it by no more than it waited.
        `offset_ns` is `monotonic_minus_realtime_ns()`, where it was asked for already.
        """
        for _, kind, stamp in ancillary:
            if kind == SO_TIMESTAMPNS and len(stamp) == TIMESPEC.size:
                seconds, ns = TIMESPEC.unpack(stamp)
                offset_ns = monotonic_minus_realtime_ns() if offset_ns is None else offset_ns
                stamped_ns: int = seconds * NS_PER_S + ns + offset_ns
                return min(max(stamped_ns, self.empty_ns), now_ns)
        return now_ns


def monotonic_minus_realtime_ns() -> int:
    """The offset between the two clocks of this machine, both read within a few microseconds where that succeeds."""
    best_ns, offset_ns = None, 0
    for _ in range(CLOCK_TRIES):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        took_ns = after_ns - before_ns
        if best_ns is None or took_ns < best_ns:
            best_ns, offset_ns = took_ns, (before_ns + after_ns) // 2 - realtime_ns
        if took_ns < NEAR_NS:
            break
    return offset_ns
