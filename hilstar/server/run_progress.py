"""What a run in progress counts, for those who follow it: the page, a campaign, a terminal."""

from collections.abc import Callable
from dataclasses import dataclass

from hilstar.attitude.clock.sender_clock import ClockSummary
from hilstar.attitude.receiver import PacketCounts
from hilstar.server.live_answers import LiveAnswers
from hilstar.server.loop import FrameLoop


@dataclass(frozen=True, slots=True)
class Running:
    """Counters of a run in progress, readable from any thread; `clock` tells of the sender's clock,
    None without a sender.

    `answers` are the tracker's, None where the bench file names none.
    """

    loop: FrameLoop
    packets: PacketCounts
    clock: Callable[[], ClockSummary] | None = None
    answers: LiveAnswers | None = None


Follower = Callable[[Running], None]  # called once, when a run begins
