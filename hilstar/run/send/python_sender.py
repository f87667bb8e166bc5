"""A simulator in Python: attitudes to hilstar over any of its roads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.packet import Refusal, Status, checked_sample, encode
from hilstar.errors import InputError
from hilstar.run.send.ends import Clock, TwoWay, open_sender

Numbers = Sequence[float] | FloatArray


class Sender:
    """The sending end of a road to hilstar; `hilstar serve` is the other.

    `to` is `udp://HOST:PORT`, `serial:/dev/ttyX@BAUD`, or a ZeroMQ endpoint: `tcp://HOST:PORT` or `ipc:///PATH`, which this end
    binds unless `connect`. The key files are those of `hilstar keys`: `secret_key`, with `allowed_clients` where this end binds
    and `server_key` where it connects. `clock` gives the simulation's time in ns, of any zero. Over UDP and serial lines a
    thread answers hilstar's time requests on it, and keeps the newest `status`. Raises InputError where the road cannot be
    opened.
    """

    def __init__(
        self,
        to: str = "tcp://127.0.0.1:5560",
        *,
        connect: bool = False,
        secret_key: str | Path | None = None,
        server_key: str | Path | None = None,
        allowed_clients: str | Path | None = None,
        clock: Clock = time.monotonic_ns,
    ) -> None:
        files = (secret_key, server_key, allowed_clients)
        keys = CurveKeys(*(None if file is None else Path(file) for file in files))
        self._clock = clock
        self._end = open_sender(to, connect=connect, keys=keys, clock=clock)
        self._sequence = 0

    @property
    def endpoint(self) -> str:
        """Where this end is: bound to a free port, its number is in it."""
        return self._end.endpoint

    @property
    def status(self) -> Status | None:
        """The newest status of hilstar; None before the first, and over ZeroMQ, which has no way back."""
        return self._end.status if isinstance(self._end, TwoWay) else None

    def wait(self, timeout_s: float = 30.0) -> bool:
        """True once hilstar listens: a subscriber (ZeroMQ), an answer (UDP), or at once where the road cannot tell (serial)."""
        return self._end.wait_for_listener(timeout_s)

    def send(
        self,
        q_icrs_to_cam: Numbers,
        rate_cam_rad_s: Numbers | None = None,
        *,
        t_ns: int | None = None,
        discontinuity: bool = False,
    ) -> None:
        """Send one attitude: a unit quaternion (4,), scalar first, and its rate (3,), rad/s, camera components, if it is known.

        `t_ns` is the instant of the attitude on the simulation's clock, by default now. `discontinuity` says that the attitude
        jumped. Raises InputError for what hilstar would refuse. Only a full serial line is waited for, half a second at most.
        """
        at_ns = self._clock() if t_ns is None else int(t_ns)
        q, rate = tuple(map(float, q_icrs_to_cam)), None if rate_cam_rad_s is None else tuple(map(float, rate_cam_rad_s))
        if len(q) != 4 or (rate is not None and len(rate) != 3):
            raise InputError(f"{len(q)} and {len(rate or ())} numbers; give a quaternion of 4 (w, x, y, z) and a rate of 3")
        sample = checked_sample(at_ns, q, rate, self._sequence, discontinuity)
        if isinstance(sample, Refusal):
            raise InputError(f"{sample.detail} ({sample.reason})")
        self._sequence += 1
        self._end.put(encode(sample))

    def close(self) -> None:
        """Close the road; what was sent over ZeroMQ or a serial line leaves first."""
        self._end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
