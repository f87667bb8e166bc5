"""A whole ledger in memory: for runs as short as a test's."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from mcap.reader import make_reader

from hilstar.attitude.logs.mcap_log import read_messages
from hilstar.server.record.ledger_records import (
    EventRecord,
    FrameRecord,
    PacketTally,
    ProcessRecord,
    read_head,
    run_records,
)


@dataclass(slots=True)
class Run:
    """The head of a ledger, its frames, the process's state, and packets by "accepted" or why
    refused.
    """

    head: dict[str, str]
    frames: list[FrameRecord] = field(default_factory=list)
    process: list[ProcessRecord] = field(default_factory=list)
    packets: dict[str, int] = field(default_factory=dict)


def read_run(path: Path) -> Run:
    """Read a ledger, which has frames."""
    run, tally = Run(read_head(path)), PacketTally()
    for record in run_records(path):
        tally.add(record)
        if isinstance(record, FrameRecord):
            run.frames.append(record)
        elif isinstance(record, ProcessRecord):
            run.process.append(record)
    assert run.frames
    run.packets = tally.counts
    return run


def read_events(path: Path) -> list[EventRecord]:
    """The events of a ledger, which may be growing."""
    return [msgspec.json.decode(data, type=EventRecord) for data in read_messages(path, "/event")]


def messages_by_topic(path: Path) -> dict[str, list[dict]]:
    """A ledger's messages, through MCAP's own reader."""
    found: dict[str, list[dict]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    return found
