"""What of a log is replayed, and how fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from hilstar.attitude.clock import NS_PER_S
from hilstar.attitude.logs import read_log
from hilstar.attitude.packet import AttitudeSample
from hilstar.errors import InputError

MOST_FRAMES = 100_000_000
SPEED_FORM = "write --speed realtime, max, or a number such as 2 or 0.5"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asks of a replay; start and stop are seconds after the log's first sample."""

    speed: str = "realtime"
    start_s: float | None = None
    stop_s: float | None = None
    step_s: float | None = None


@dataclass(frozen=True, slots=True)
class Play:
    """A log to replay: frame k shows the log's `first_ns + k step_s`."""

    samples: list[AttitudeSample]
    first_ns: int
    step_s: float
    frame_count: int
    paced: bool

    def time_ns(self, slot: int) -> int:
        """The log's time that a frame shows."""
        return self.first_ns + round(slot * self.step_s * NS_PER_S)


def plan_play(log: Path, wanted: Wanted, refresh_hz: float) -> Play:
    """The frames of a replay: one each refresh period of the log, stretched by the speed, unless a step is given.

    Raises InputError for a speed, a span or a step that gives no frame.
    """
    factor = parse_speed(wanted.speed)
    samples = read_log(log)
    length_s = (samples[-1].t_ns - samples[0].t_ns) / NS_PER_S
    start_s = 0.0 if wanted.start_s is None else wanted.start_s
    stop_s = length_s if wanted.stop_s is None else wanted.stop_s
    if not 0 <= start_s <= stop_s <= length_s + 1e-9:
        raise InputError(f"{log}: --start {start_s:g} --stop {stop_s:g}; write seconds from 0 to its length, {length_s:g}")
    step_s = (1.0 if math.isinf(factor) else factor) / refresh_hz
    if wanted.step_s is not None:
        if wanted.step_s <= 0 or factor not in {1.0, math.inf}:
            raise InputError(f"--step {wanted.step_s:g}: write seconds above 0, and --speed realtime or max beside it")
        step_s = wanted.step_s
    count = (stop_s - start_s) / step_s + 1e-6
    if count > MOST_FRAMES:
        raise InputError(f"{log}: makes {count:.3g} frames; write a longer --step, or --start and --stop")
    first_ns = samples[0].t_ns + round(start_s * NS_PER_S)
    return Play(samples, first_ns, step_s, int(count) + 1, not math.isinf(factor))


def parse_speed(text: str) -> float:
    """The factor of real time of `--speed`: 1 for realtime, infinite for max. Raises InputError."""
    named = {"realtime": 1.0, "max": math.inf}
    if text in named:
        return named[text]
    try:
        factor = float(text)
    except ValueError as error:
        raise InputError(f"--speed {text}: {SPEED_FORM}") from error
    if not 1e-3 <= factor <= 1e3:
        raise InputError(f"--speed {text}: {SPEED_FORM}, from 0.001 to 1000")
    return factor
