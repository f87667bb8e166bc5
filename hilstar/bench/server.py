"""The frame loop: an attitude at each frame's time, drawn, counted, handed on."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from hilstar.attitude.links import ZmqReceiver
from hilstar.attitude.logs import log_timeline
from hilstar.attitude.packet import AttitudeSample
from hilstar.attitude.receiver import PacketCounts, Receiver
from hilstar.attitude.timeline import NS_PER_MS, NS_PER_S, Attitude, Policy, Timeline
from hilstar.bench.assembly import Bench, Drawn
from hilstar.bench.config import AttitudeSettings
from hilstar.bench.pacing import wait_until
from hilstar.bench.stats import RunStats
from hilstar.errors import InputError


@dataclass(frozen=True, slots=True)
class Shown:
    """One frame of a run: its number, its time on the sender's clock, its attitude (None: blank) and its codes."""

    number: int
    t_ns: int
    attitude: Attitude | None
    drawn: Drawn


FrameSink = Callable[[Shown], None]


def _ignore(shown: Shown) -> None:
    """The sink of a run that nobody looks at."""


@dataclass(frozen=True, slots=True)
class Limit:
    """When a paced run ends: after so many refresh periods, or so many frames drawn."""

    slots: float = math.inf
    frames: float = math.inf


class FrameLoop:
    """Draws frames of one timeline; one slow frame is missed, and never queues others."""

    def __init__(self, bench: Bench, timeline: Timeline, sink: FrameSink = _ignore) -> None:
        self.stats = RunStats()
        self.stop = threading.Event()
        self._bench = bench
        self._timeline = timeline
        self._sink = sink
        self._blank_when_stale = bench.config.attitude.on_stale == "blank"

    def draw(self, number: int, t_ns: int) -> None:
        """Draw the frame for `t_ns` of the sender's clock."""
        begin_ns = time.perf_counter_ns()
        attitude = self._timeline.at(t_ns)
        blank = attitude is None or (attitude.stale and self._blank_when_stale)
        drawn = self._bench.draw(None if attitude is None or blank else attitude.q_icrs_to_cam)
        frame_ns = time.perf_counter_ns() - begin_ns
        self.stats.add(frame_ns, None if attitude is None else attitude.age_ns, drawn.star_count, drawn.clipped_hip)
        self.stats.stale_frames += attitude is None or attitude.stale
        self._sink(Shown(number, t_ns, None if blank else attitude, drawn))

    def paced(self, refresh_hz: float, limit: Limit, time_of: Callable[[int, int], int]) -> None:
        """Draw at `refresh_hz` up to `limit`; `time_of(slot, host_ns)` gives each frame's time.

        A slot whose moment has passed when its turn comes is missed, counted, and not drawn.
        """
        period_ns = NS_PER_S / refresh_hz
        start_ns = time.monotonic_ns()
        slot = 0
        while slot < limit.slots and self.stats.frames < limit.frames and not self.stop.is_set():
            if wait_until(start_ns + round(slot * period_ns), self.stop):
                return
            self.draw(slot, time_of(slot, time.monotonic_ns()))
            late = int((time.monotonic_ns() - start_ns) // period_ns)
            following = max(slot + 1, late + 1)
            if self.stats.frames < limit.frames:
                self.stats.missed_frames += int(min(following, limit.slots)) - slot - 1
            slot = following


@contextmanager
def stop_on_signal(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM end the run in order while this is open (main thread only)."""

    def handle(number: int, frame: object) -> None:
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def policy_of(settings: AttitudeSettings) -> Policy:
    """The timeline's policy, from the bench file's milliseconds."""
    return Policy(
        max_extrapolation_ns=round(settings.max_extrapolation_ms * NS_PER_MS),
        stale_after_ns=round(settings.stale_after_ms * NS_PER_MS),
    )


def open_link(settings: AttitudeSettings) -> ZmqReceiver:
    """The link that the bench file names. Raises InputError for an endpoint that cannot be had."""
    if settings.source != "zmq":
        raise InputError(f'[attitude] source = "{settings.source}" is not in this version; write source = "zmq"')
    return ZmqReceiver(settings.endpoint, bind=settings.bind)


def serve(bench: Bench, link: ZmqReceiver, limit: Limit, sink: FrameSink = _ignore) -> dict[str, Any]:
    """Show the live stream of `link` up to `limit`, or until a signal; the summary."""
    timeline = Timeline(policy_of(bench.config.attitude))
    receiver = Receiver(link, timeline)
    loop = FrameLoop(bench, timeline, sink)
    with stop_on_signal(loop.stop):
        receiver.start()
        try:
            bench.warm_up()
            begin_ns = time.monotonic_ns()
            refresh_hz = bench.config.monitor.refresh_hz
            loop.paced(refresh_hz, limit, lambda slot, host_ns: receiver.clock.to_sender_ns(host_ns))
        finally:
            receiver.close()
    duration_s = (time.monotonic_ns() - begin_ns) / NS_PER_S
    return loop.stats.summary(duration_s, receiver.counts, bench.renderer.gl_renderer)


def replay(bench: Bench, samples: list[AttitudeSample], realtime: bool, sink: FrameSink = _ignore) -> dict[str, Any]:
    """Show a log, a frame each refresh period from its first to its last sample; the summary.

    In real time late frames are missed, as on a monitor; otherwise every frame is drawn, as fast as it can be.
    """
    loop = FrameLoop(bench, log_timeline(samples, policy_of(bench.config.attitude)), sink)
    refresh_hz = bench.config.monitor.refresh_hz
    first_ns = samples[0].t_ns
    frame_count = replay_frame_count(bench, samples)

    def time_of(slot: int, host_ns: int = 0) -> int:
        return first_ns + round(slot * NS_PER_S / refresh_hz)

    bench.warm_up()
    begin_ns = time.monotonic_ns()
    with stop_on_signal(loop.stop):
        if realtime:
            loop.paced(refresh_hz, Limit(slots=frame_count), time_of)
        else:
            for slot in range(frame_count):
                if loop.stop.is_set():
                    break
                loop.draw(slot, time_of(slot))
    duration_s = (time.monotonic_ns() - begin_ns) / NS_PER_S
    return loop.stats.summary(duration_s, PacketCounts(received=len(samples)), bench.renderer.gl_renderer)


def replay_frame_count(bench: Bench, samples: list[AttitudeSample]) -> int:
    """Refresh periods from a log's first sample to its last, both included."""
    span_ns = samples[-1].t_ns - samples[0].t_ns
    return int(span_ns * bench.config.monitor.refresh_hz / NS_PER_S + 1e-6) + 1
