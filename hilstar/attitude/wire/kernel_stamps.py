"""Times of arrival by the kernel (SO_TIMESTAMPNS): of datagrams, and of TCP's bytes."""

import contextlib
import socket
import struct

from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

# Linux's number (asm-generic/socket.h); the stamp is a timespec of CLOCK_REALTIME
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@ll")
ANCILLARY_BYTES = socket.CMSG_SPACE(TIMESPEC.size)


class KernelStamps:
    """Has the kernel stamp arrivals at `receiving`; where it cannot, the time of reading counts.

    `empty_ns` is when nothing waited last, host time: what is read arrived later than that. Of a
    TCP stream the stamp is that of the last byte read.
    """

    def __init__(self, receiving: socket.socket, clock: HostClock = HOST_CLOCK) -> None:
        self._clock = clock
        self.empty_ns = clock.now_ns()
        with contextlib.suppress(OSError):
            receiving.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def arrived_ns(
        self, ancillary: list[tuple[int, int, bytes]], now_ns: int, offset_ns: int | None = None
    ) -> int:
        """When something came, from what `recvmsg` told at `now_ns`.

        A realtime clock that was set meanwhile moves it by no more than it waited.
        `offset_ns` is the clock's `monotonic_minus_realtime_ns()`, where it was asked for already.
        """
        for _, kind, stamp in ancillary:
            if kind == SO_TIMESTAMPNS and len(stamp) == TIMESPEC.size:
                seconds, ns = TIMESPEC.unpack(stamp)
                if offset_ns is None:
                    offset_ns = self._clock.monotonic_minus_realtime_ns()
                stamped_ns: int = seconds * NS_PER_S + ns + offset_ns
                return min(max(stamped_ns, self.empty_ns), now_ns)
        return now_ns
