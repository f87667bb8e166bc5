"""A live run in this process that lasts as long as what is asked of it takes, on a machine of
any speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.units import NS_PER_MS
from hilstar.server.bench.config import AttitudeSettings
from hilstar.server.bench.frame import Bench
from hilstar.server.loop import Limit
from hilstar.server.open_link import AnyLink
from hilstar.server.pacer import Shown
from hilstar.server.run_progress import Running
from hilstar.server.serve import Outlet, serve
from hilstar.server.summary import RunSummary
from tests.support.waiting import PATIENCE_S

MAX_EXTRAPOLATION_NS = round(AttitudeSettings().max_extrapolation_ms * NS_PER_MS)
LONGER_THAN_A_STALL = 60  # frames; their median is what the program does


def serve_until(
    bench: Bench,
    link: AnyLink,
    enough: Callable[[list[Shown], Running], object],
    outlet: Outlet | None = None,
) -> tuple[RunSummary, list[Shown]]:
    """Serve until `enough` is true of the frames so far and of the run's counts, PATIENCE_S at
    most; the frames.
    """
    frames: list[Shown] = []
    runs: list[Running] = []

    def sink(shown: Shown) -> None:
        frames.append(shown)
        if enough(frames, runs[0]):
            runs[0].loop.stop.set()

    slots = PATIENCE_S * bench.config.monitor.refresh_hz
    summary = serve(
        bench, link, Limit(slots=slots), sink, replace(outlet or Outlet(), follower=runs.append)
    )
    return summary, frames


def attitudes(frames: list[Shown]) -> list[tuple[int, Attitude]]:
    """Of the frames that show one: the time whose attitude that is, on the sender's clock, and the
    attitude.

    It is the frame's own time, unless its packet came so long ago that no more is predicted.
    """
    return [
        (each.t_ns - max(0, each.attitude.age_ns - MAX_EXTRAPOLATION_NS), each.attitude)
        for each in frames
        if each.attitude is not None
    ]


def median_age_ns(frames: list[Shown]) -> int:
    """The median age of the newest frames' attitudes: one that a machine that stood still made
    old does not count.
    """
    ages = sorted(
        each.attitude.age_ns for each in frames[-LONGER_THAN_A_STALL:] if each.attitude is not None
    )
    return ages[len(ages) // 2]
