"""MCAP with messages of ROS: what ROS 2 records by default, and what other programs write with ROS's schemas."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from hilstar.attitude.logs.mcap_reader import ROS_ENCODINGS, records_of
from hilstar.attitude.logs.ros.storage import Message, Topic, damaged, message_bytes, type_name
from hilstar.reading import MCAP_MAGIC


class McapBag:
    """An .mcap file; see Storage."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def topics(self) -> list[Topic]:
        """The channels whose messages are ROS's."""
        return list(dict.fromkeys(topic for _, topic in self._channels()))

    def messages(self, topic: Topic) -> Iterator[Message]:
        """The messages of a topic, in the order of the file."""
        wanted: set[int] = set()
        schemas: dict[int, Schema] = {}
        for record in records_of(self._path):
            if isinstance(record, McapMessage):
                if record.channel_id in wanted:
                    yield Message(record.log_time, self._unpacked(record.data))
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and _topic(record, schemas.get(record.schema_id)) == topic:
                wanted.add(record.id)

    def told(self) -> list[tuple[str, str]]:
        """That the recorder was killed before the file's end was written."""
        with self._path.open("rb") as file:
            file.seek(-min(len(MCAP_MAGIC), self._path.stat().st_size), os.SEEK_END)
            if file.read() == MCAP_MAGIC:
                return []
        return [("log-cut", f"{self._path} was not closed by its recorder; all chunks that are whole are read")]

    def _channels(self) -> Iterator[tuple[int, Topic]]:
        schemas: dict[int, Schema] = {}
        for record in records_of(self._path):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and (topic := _topic(record, schemas.get(record.schema_id))) is not None:
                yield record.id, topic

    def _unpacked(self, data: bytes) -> bytes:
        try:
            return message_bytes(data)
        except (ValueError, zstandard.ZstdError) as error:
            raise damaged(self._path, error) from error


def _topic(channel: Channel, schema: Schema | None) -> Topic | None:
    if schema is None or channel.message_encoding not in ROS_ENCODINGS:
        return None
    text = schema.data.decode(errors="replace") if schema.encoding in {"ros2msg", "ros1msg"} else ""
    return Topic(channel.topic, type_name(schema.name), "ros1" if channel.message_encoding == "ros1" else "cdr", text)
