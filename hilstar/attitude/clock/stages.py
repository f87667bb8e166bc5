"""The contract of what a stream passes through from its link to the timeline, and the one state
that its stages share; no I/O. A file of its own: senders, clock and receiver keep to it.

A stage may hold messages back until later ones decide them. A message with a refusal passes the
stages that follow unseen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from hilstar.attitude.wire.links import SampleArrival


@dataclass(slots=True)
class StreamState:
    """What stages of one stream tell each other."""

    resumed: bool = False  # the sender's clock stood still: it does not jump where it goes on
    busy: bool = False  # messages came just now: the sender shown may be among those to come


class Stage(Protocol):
    """Messages in, messages out, in the order in which they are decided."""

    def take(self, arrival: SampleArrival) -> Sequence[SampleArrival]:
        """The messages that this one decides."""

    def expire(self, now_ns: int) -> Sequence[SampleArrival]:
        """The messages that have been held for too long."""

    def release(self) -> Sequence[SampleArrival]:
        """The messages that are still held: no more will come to decide them."""


class Each:
    """A stage that holds nothing: what `look` makes of a message passes."""

    def __init__(self, look: Callable[[SampleArrival], SampleArrival]) -> None:
        self._look = look

    def take(self, arrival: SampleArrival) -> Sequence[SampleArrival]:
        """What is made of this message."""
        return (self._look(arrival),)

    def expire(self, now_ns: int) -> Sequence[SampleArrival]:
        """Nothing is held."""
        return ()

    def release(self) -> Sequence[SampleArrival]:
        """Nothing is held."""
        return ()


class Stages:
    """Stages one after the other; what has passed all of them, or was refused by one, goes to
    `settle`.
    """

    def __init__(self, stages: Sequence[Stage], settle: Callable[[SampleArrival], None]) -> None:
        self._stages = stages
        self._settle = settle

    def take(self, arrival: SampleArrival) -> None:
        """Take the next message."""
        self._pass((arrival,), 0)

    def expire(self, now_ns: int) -> None:
        """Take what has been held for too long, from the first stage on."""
        for place, stage in enumerate(self._stages):
            self._pass(stage.expire(now_ns), place + 1)

    def release(self) -> None:
        """Take all that is held, from the first stage on."""
        for place, stage in enumerate(self._stages):
            self._pass(stage.release(), place + 1)

    def _pass(self, arrivals: Sequence[SampleArrival], place: int) -> None:
        """One message at a time through all stages from this one on: what is believed of the
        next may depend on it.
        """
        for arrival in arrivals:
            if arrival.refusal is not None or place == len(self._stages):
                self._settle(arrival)
            else:
                self._pass(self._stages[place].take(arrival), place + 1)
