"""Attitude logs of every format, read and written: samples in order of time, and their meaning.

Which formats there are, and which of them a file is, `log_formats` says.

What a user states of a log is used or refused:
1. Each format declares the statements that its reader uses. Any other is refused by name, before
   the file is read (`check_stated`).
2. A statement that a format uses, but not for this file, is refused by the reader
   (`stated_reference` for a place) or, for a mounting where the attitudes are the camera's own, by
   `open_log`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hilstar.attitude.clock.rate_causes import ReadAs
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.aem_blocks import AemFaultError, epoch_ns, epoch_text
from hilstar.attitude.logs.entries import (
    MAX_SAMPLES,
    SORT_ADVICE,
    AttitudeLog,
    LogJoins,
    LogReading,
    Stated,
    log_joins,
)
from hilstar.attitude.logs.log_formats import NOTHING_STATED, Writing, check_stated, writer_of
from hilstar.attitude.logs.log_times import time_notices
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.source import HILSTARS, Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.files import whole_file
from hilstar.basics.units import NS_PER_S

YEAR_NS = 31_557_600 * NS_PER_S
SECONDS_FORM = "write seconds after its first sample"
TIME_FORM = f"{SECONDS_FORM}, or a date and time such as 2026-11-21T06:00:00"
NO_ATTITUDE = "contains no attitude; write a CSV with the header t_s,qw,qx,qy,qz, or JSON lines"
DROPOUT = "zeros or NaN after an attitude are a dropout: leave those entries out, or cut the log"
UNSET = "zeros or NaN, from before the estimator ran"


def read_log(path: Path) -> list[AttitudeSample]:
    """The attitudes of a log that needs nothing stated, in order of time. Raises as `open_log`
    does.
    """
    return open_log(path).samples


def open_log(path: Path, stated: Stated = NOTHING_STATED) -> AttitudeLog:
    """The attitudes of a log in order of time, with what the file means by its numbers.

    Raises InputError with the line (AEM in XML: the epoch) for anything that is not an attitude:
    nothing is skipped unless the notices say so, as of zeros and NaN before the first attitude.
    Raises MachineError where the format's library is not installed.
    """
    mounting = stated.mounting
    try:
        with check_stated(path, stated).read(path, stated) as reading:
            conventions = reading.conventions
            if mounting.by_option and not conventions.of_body:
                refusal = f"{path}: --mounting: its attitudes are the camera's own"
                raise InputError(f"{refusal} ({conventions.source}); leave it out")
            samples, unset = _samples(path, reading, mounting)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a log ({error})") from error
    notices = [*reading.told, *conventions.mounting_notices(mounting)]
    if unset:
        if unset == 1:
            left_out = "1 attitude is"
        else:
            left_out = f"{unset} attitudes are"
        notices.append(("log-start", f"{left_out} left out at the beginning: {UNSET}"))
    if conventions.of_packets:  # other formats say themselves what their times are
        notices += time_notices(samples, conventions.time_unit)
    read_as = ReadAs.of(conventions, stated.convention or HILSTARS, mounting, stated.convention_by)
    return AttitudeLog(samples, conventions, notices, read_as)


def _samples(
    path: Path,
    reading: LogReading,
    mounting: Mounting,
) -> tuple[list[AttitudeSample], int]:
    """The camera's samples of a reading, and how many entries without an attitude are before the
    first. Raises InputError.
    """
    samples: list[AttitudeSample] = []
    unset = 0
    for where, event in reading.entries:
        if isinstance(event, Refusal):
            if samples or not event.unset:
                detail = event.detail
                if event.unset:
                    detail += f"; {DROPOUT}"
                raise InputError(f"{path}{where}: {detail}")
            unset += 1
            continue
        if samples and event.t_ns <= samples[-1].t_ns:
            fault = _order_fault(event.t_ns, samples[-1].t_ns, reading.advice)
            raise InputError(f"{path}{where}: {fault}")
        samples.append(mounting.sample(event) if reading.conventions.of_body else event)
        if len(samples) > MAX_SAMPLES:
            detail = f"more than {MAX_SAMPLES} attitudes; split the log into several"
            raise InputError(f"{path}{where}: {detail}")
    if not samples and unset:
        raise InputError(f"{path}: no attitude in {unset} entries: {UNSET}; give another log")
    if not samples:
        raise InputError(f"{path}: {NO_ATTITUDE}")
    return samples, unset


def _order_fault(t_ns: int, before_ns: int, advice: str) -> str:
    times = f"time does not increase (t_ns {t_ns} after {before_ns})"
    if t_ns == before_ns and advice == SORT_ADVICE:
        return f"{times}: two attitudes have one time; write more of its digits"
    return f"{times}; {advice}"


def write_log(path: Path, samples: Sequence[AttitudeSample], scale: str | None = None) -> None:
    """Write samples, whose times increase, in the format of the name's ending; an old file is
    replaced whole or not at all.

    CSV, JSON lines and MCAP keep every bit. An AEM states `scale`, and drops sequence numbers, and
    the rates of a block where any is missing.
    Raises InputError for another ending, for no samples, and when the file cannot be written.
    """
    write, ending = writer_of(path)
    if not samples:
        raise InputError(f"{path}: no attitude to write")
    with whole_file(path) as file:
        write(file, samples, Writing(ending, scale))


def log_timeline(
    samples: list[AttitudeSample], policy: Policy, joins: LogJoins | None = None
) -> Timeline:
    """A timeline of every sample of a log, joined as the log's own samples require (see
    `entries`).
    """
    policy = replace(policy, prediction="rate")  # nothing is predicted of a log
    timeline = Timeline(
        policy, capacity=len(samples), joins=log_joins(samples) if joins is None else joins
    )
    for sample in samples:
        timeline.add(sample)
    return timeline


def time_in_log(path: Path, samples: Sequence[AttitudeSample], text: str | None) -> int:
    """The `t_ns` that `text` names, within the span of the log; its first sample's for None.

    A date and time is read on the log's own scale, from 1970-01-01T00:00:00. Raises InputError
    outside the span.
    """
    first_ns = samples[0].t_ns
    last_ns = samples[-1].t_ns
    if text is None:
        return first_ns
    try:
        seconds = float(text)
        if not abs(seconds) <= 1e12:
            raise InputError(f"--time {text}: {TIME_FORM}")
        t_ns = first_ns + round(seconds * NS_PER_S)
    except ValueError:
        try:
            t_ns = epoch_ns("", text)
        except AemFaultError as fault:
            raise InputError(f"--time {text}: {fault}") from fault
    if not first_ns <= t_ns <= last_ns:
        span = f"{(last_ns - first_ns) / NS_PER_S:.9g} s long"
        if first_ns < YEAR_NS:
            raise InputError(
                f"--time {text}: {path} is {span}, and its times are no dates; {SECONDS_FORM}"
            )
        span += f", from {epoch_text(first_ns)} to {epoch_text(last_ns)} on its own scale"
        raise InputError(f"--time {text}: {path} is {span}; {TIME_FORM}")
    return t_ns
