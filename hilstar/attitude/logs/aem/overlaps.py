"""Segments of an AEM that overlap: which of them has a time.

504.0-B lets the TOTAL spans of segments overlap, for interpolation near their ends, and says by USEABLE_START_TIME and
USEABLE_STOP_TIME where each is meant to be used. So where several segments have a time, one that is useable then is taken
before one that is not, and of those the one that begins later (as Orekit does). What only one segment has is its own.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.aem.blocks import AemFaultError, Block
from hilstar.attitude.logs.aem.epochs import epoch_ns, epoch_text
from hilstar.attitude.logs.entries import Entry
from hilstar.attitude.logs.gaps import log_joins
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.units import NS_PER_S

MAX_OVERLAPPING = 1000


@dataclass(frozen=True)
class Segment:
    """One segment: its keywords, and its entries in the order of the file."""

    block: Block
    times: list[int]
    entries: list[Entry]

    @property
    def is_whole(self) -> bool:
        """Whether every entry is an attitude, in order of time; else reading it ends in a refusal."""
        return all(isinstance(entry.event, AttitudeSample) for entry in self.entries) and all(
            before < after for before, after in pairwise(self.times)
        )

    @cached_property
    def _timeline(self) -> Timeline:
        samples = [entry.event for entry in self.entries if isinstance(entry.event, AttitudeSample)]
        timeline = Timeline(Policy(0, NS_PER_S), capacity=len(samples), joins=log_joins(samples))
        for sample in samples:
            timeline.add(sample)
        return timeline

    def at(self, t_ns: int) -> Entry:
        """Its attitude at a time within it, as a replay has it between two of its own, with the place of the one before."""
        where, before = self.entries[bisect_right(self.times, t_ns) - 1]
        attitude = self._timeline.at(t_ns)
        if attitude is None or not isinstance(before, AttitudeSample):
            raise AssertionError("a whole segment has attitudes")
        rate = None if before.rate_cam_rad_s is None else attitude.rate_cam_rad_s
        return Entry(where, AttitudeSample(t_ns, attitude.q_icrs_to_cam, rate))

    def useable_ns(self) -> tuple[int, int]:
        """Where it is meant to be used; without keywords, all of it. Raises AemFaultError."""
        where, meta = self.block.where[0], self.block.meta
        first, last = self.times[0], self.times[-1]
        start = epoch_ns(where, meta["USEABLE_START_TIME"]) if "USEABLE_START_TIME" in meta else first
        stop = epoch_ns(where, meta["USEABLE_STOP_TIME"]) if "USEABLE_STOP_TIME" in meta else last
        if stop < start:
            raise AemFaultError(where, "USEABLE_STOP_TIME is before USEABLE_START_TIME")
        return min(max(start, first), last), max(min(stop, last), first)


def resolved(segments: list[Segment]) -> tuple[list[list[Entry]], str | None]:
    """The entries of segments, which come in the order of their first epochs, with those that overlap made one run of pieces.

    And what was done, in words; None where no segments overlap. Raises AemFaultError.
    """
    groups: list[list[Segment]] = []
    end_ns = 0
    for segment in segments:
        overlaps = bool(groups) and segment.times[0] < end_ns and segment.is_whole and all(each.is_whole for each in groups[-1])
        if overlaps:
            groups[-1].append(segment)
        else:
            groups.append([segment])
        end_ns = max(end_ns, segment.times[-1]) if overlaps else segment.times[-1]
    runs = [group[0].entries if len(group) == 1 else _one_run(group) for group in groups]
    several = [group for group in groups if len(group) > 1]
    if not several:
        return runs, None
    many = sum(map(len, several))
    first_ns = several[0][1].times[0]
    return runs, (
        f"{many} segments overlap, first at {epoch_text(first_ns)}: where they do, the one that its USEABLE times give is"
        " taken, and of several the one that begins later"
    )


def _one_run(group: list[Segment]) -> list[Entry]:
    if len(group) > MAX_OVERLAPPING:
        where = group[0].block.where[0]
        raise AemFaultError(where, f"{len(group)} segments overlap, and {MAX_OVERLAPPING} may; write a file for each")
    useable = [segment.useable_ns() for segment in group]
    edges = sorted({edge for k, segment in enumerate(group) for edge in (segment.times[0], segment.times[-1], *useable[k])})
    pieces: list[tuple[int, int, int]] = []  # of which segment, from, to
    for start, stop in pairwise(edges):
        having = [k for k, segment in enumerate(group) if segment.times[0] <= start and stop <= segment.times[-1]]
        meant = [k for k in having if useable[k][0] <= start and stop <= useable[k][1]]
        taken = max(meant or having)  # the later one: they come in the order of their first epochs
        if pieces and pieces[-1][0] == taken:
            pieces[-1] = (taken, pieces[-1][1], stop)
        else:
            pieces.append((taken, start, stop))
    run: list[Entry] = []
    for number, (k, start, stop) in enumerate(pieces):
        last = number == len(pieces) - 1
        piece = _piece(group[k], start, stop if last else stop - 1)
        if run and isinstance(piece[0].event, AttitudeSample):
            piece[0] = Entry(piece[0].where, replace(piece[0].event, discontinuity=True))
        run += piece
    return run


def _piece(segment: Segment, start_ns: int, stop_ns: int) -> list[Entry]:
    """The attitudes of a segment from a time to another, both among them, made where it has none just then."""
    piece = segment.entries[bisect_left(segment.times, start_ns) : bisect_right(segment.times, stop_ns)]
    own = {entry.event.t_ns for entry in (piece[:1] + piece[-1:]) if isinstance(entry.event, AttitudeSample)}
    if start_ns not in own:
        piece.insert(0, segment.at(start_ns))
    if stop_ns not in own and stop_ns > start_ns:
        piece.append(segment.at(stop_ns))
    return piece
