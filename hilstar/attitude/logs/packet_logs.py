"""Logs whose entries have the numbers of a packet (CSV, JSON lines, MCAP): their convention,
mounting and reference, as the user states them.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from hilstar.attitude.logs.entries import OPTIONS, SORT_ADVICE, LogEntry, LogReading, Stated
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import (
    HILSTARS,
    Convention,
    Conventions,
    components,
    packet_conventions,
)
from hilstar.basics.rotation import conjugate, multiply
from hilstar.basics.units import NS_PER_S

if TYPE_CHECKING:
    from hilstar.attitude.logs.earth import Reference
    from hilstar.basics.arrays import FloatArray

# The statements that say where a level frame is, and those that all of these logs use.
LEVEL = frozenset({"reference", "place", "epoch_utc"})
LIKE_PACKETS = LEVEL | {"mounting", "convention"}


def of_packets(
    path: Path,
    entries: Iterator[LogEntry],
    source: str,
    stated: Stated,
    advice: str = SORT_ADVICE,
) -> LogReading:
    """The reading of entries that have the numbers of a packet, as they were sent: their
    convention, then their reference.

    Rates are with respect to the reference, in the frame's own components.
    """
    if stated.convention is None:
        convention = HILSTARS
    else:
        convention = stated.convention
    if stated.convention is None:
        by = []
    else:
        by = [stated.convention_by]
    if stated.mounting.by_option:  # which says that the attitudes are the body's
        convention = structs.replace(convention, frame="body")
        by = [*by, OPTIONS["mounting"]]
    notices: list[tuple[str, str]] = []
    if convention != HILSTARS:
        notices.append(("log-convention", f"read with convention = {convention} ({', '.join(by)})"))
    if not convention.is_hilstars:
        entries = _by_convention(entries, convention)
    conventions = packet_conventions(convention, source)
    if stated.reference is None and stated.place is None and stated.epoch_utc is None:
        return LogReading(entries, conventions, advice, notices)
    from hilstar.attitude.logs.earth import reference_kind, stated_reference, to_icrs  # 30 ms

    kind = reference_kind(path, stated, notices)
    begin, first = _up_to_first(entries)
    if first is None:  # what there is is refused when it is read
        return LogReading(begin, conventions, advice, notices)
    reference = stated_reference(path, kind, stated, first.t_ns)
    turned = to_icrs(itertools.chain(begin, entries), reference, False, notices)
    return LogReading(
        turned, _referred(conventions, convention, reference, first.t_ns), advice, notices
    )


def _up_to_first(entries: Iterator[LogEntry]) -> tuple[list[LogEntry], AttitudeSample | None]:
    """The entries up to the first attitude, and that attitude; None where there is none."""
    begin = []
    for entry in entries:
        begin.append(entry)
        if isinstance(entry.event, AttitudeSample):
            return begin, entry.event
        if not entry.event.unset:
            break
    return begin, None


def _by_convention(entries: Iterable[LogEntry], convention: Convention) -> Iterator[LogEntry]:
    for entry in entries:
        event = entry.event
        yield (
            LogEntry(entry.where, convention.sample(event))
            if isinstance(event, AttitudeSample)
            else entry
        )


def _referred(
    conventions: Conventions, convention: Convention, reference: "Reference", first_ns: int
) -> Conventions:
    """The conventions of a log whose attitudes refer to a reference; the self-check is for its
    first time.
    """
    if reference.kind == "icrs":
        return conventions

    def written(q_icrs_to_frame: "FloatArray") -> str:
        q = multiply(q_icrs_to_frame, conjugate(reference.q_icrs_to_reference([first_ns])[0]))
        return f"q = {components(convention.as_sent(q))} at {first_ns / NS_PER_S:.9f} s"

    turns = packet_conventions(convention, reference="reference").turns
    return replace(
        conventions, turns=f"{turns}; the reference is {reference.words}", written=written
    )
