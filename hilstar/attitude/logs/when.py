"""A moment of a log that a person names: seconds after its first sample, or a date and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from hilstar.attitude.logs.aem.blocks import AemFaultError
from hilstar.attitude.logs.aem.epochs import epoch_ns, epoch_text
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

YEAR_NS = 31_557_600 * NS_PER_S
SECONDS_FORM = "write seconds after its first sample"
TIME_FORM = f"{SECONDS_FORM}, or a date and time such as 2026-11-21T06:00:00"


def time_in_log(path: Path, samples: Sequence[AttitudeSample], text: str | None) -> int:
    """The `t_ns` that `text` names, within the span of the log; its first sample's for None.

    A date and time is read on the log's own scale, from 1970-01-01T00:00:00. Raises InputError outside the span.
    """
    first_ns, last_ns = samples[0].t_ns, samples[-1].t_ns
    if text is None:
        return first_ns
    t_ns = _named_ns(text, first_ns)
    if not first_ns <= t_ns <= last_ns:
        span = f"{(last_ns - first_ns) / NS_PER_S:.9g} s long"
        if first_ns < YEAR_NS:
            raise InputError(f"--at {text}: {path} is {span}, and its times are no dates; {SECONDS_FORM}")
        span += f", from {epoch_text(first_ns)} to {epoch_text(last_ns)} on its own scale"
        raise InputError(f"--at {text}: {path} is {span}; {TIME_FORM}")
    return t_ns


def _named_ns(text: str, first_ns: int) -> int:
    try:
        seconds = float(text)
    except ValueError:
        try:
            return epoch_ns("", text)
        except AemFaultError as fault:
            raise InputError(f"--at {text}: {fault}") from fault
    if not math.isfinite(seconds) or abs(seconds) > 1e12:
        raise InputError(f"--at {text}: {TIME_FORM}")
    return first_ns + round(seconds * NS_PER_S)
