"""MCAP files as logs: hilstar's own attitudes, and the ledger of a run.

Their bytes are `mcap_log`'s, which is imported where a file is MCAP: it takes 30 ms.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import LogFormat, LogHead, Writing
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import PACKETS
from hilstar.basics.errors import InputError
from hilstar.basics.files import MCAP_MAGIC

RESTARTED = "the sender restarted here; give a log of one run"
MAX_NAMED_TOPICS = 12


@contextlib.contextmanager
def read_ledger(path: Path, stated: Stated) -> Iterator[LogReading]:
    """A run's attitudes as it showed them: its convention and its mounting are in them already."""
    yield LogReading(_entries(path), replace(PACKETS, source="MCAP", of_packets=False), RESTARTED)


@contextlib.contextmanager
def read_mcap(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of an MCAP file with hilstar's attitudes. Raises InputError."""
    yield of_packets(path, _entries(path), "MCAP", stated, RESTARTED)


def _entries(path: Path) -> Iterator[LogEntry]:
    from hilstar.attitude.logs.mcap_log import read_events

    is_empty = True
    for where, event in read_events(path):
        is_empty = False
        yield LogEntry(where, event)
    if is_empty:
        _refuse_other_topics(path)


def _refuse_other_topics(path: Path) -> None:
    """Name the topics of an MCAP file from another program."""
    from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC, topics_of

    topics = topics_of(path)
    if topics and ATTITUDE_TOPIC not in topics:
        named = [topic[:MAX_QUOTED_CHARACTERS] for topic in topics[:MAX_NAMED_TOPICS]]
        names = ", ".join([*named, *(["..."] if len(topics) > MAX_NAMED_TOPICS else [])])
        raise InputError(
            f"{path}: contains no attitude; its topics are {names}, and only {ATTITUDE_TOPIC} is"
            " read"
        )


def _begins_as_ledger(beginning: LogHead) -> bool:
    if not beginning.head.startswith(MCAP_MAGIC):
        return False
    from hilstar.attitude.logs.mcap_log import begins_as_ledger

    return begins_as_ledger(beginning.path)


def _write(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    from hilstar.attitude.logs.mcap_log import write_attitudes

    write_attitudes(file, samples)


ledger_format = LogFormat(
    "the ledger of a run",
    read_ledger,
    magic=(MCAP_MAGIC,),
    begins=_begins_as_ledger,
    of_ledgers=True,
)
log_format = LogFormat(
    "an MCAP file",
    read_mcap,
    listed="MCAP",
    uses=LIKE_PACKETS,
    magic=(MCAP_MAGIC,),
    endings=(".mcap",),
    write=_write,
)
