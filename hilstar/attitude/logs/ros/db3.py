"""Bags of ROS 2 in SQLite (.db3): the tables `topics` and `messages`, and `message_definitions` from Iron on."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import zstandard

from hilstar.attitude.logs.ros.storage import MAX_MESSAGE_BYTES, Message, Topic, damaged, message_bytes, type_name
from hilstar.errors import InputError

MAX_TOPICS = 10_000


class Db3File:
    """A .db3 file; see Storage."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def topics(self) -> list[Topic]:
        """The rows of `topics`."""
        with self._open() as database:
            texts = {}
            if self._tables(database, "message_definitions"):
                rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
                texts = {name: text for name, encoding, text in rows.fetchmany(MAX_TOPICS) if encoding == "ros2msg"}
            found = []
            rows = database.execute("SELECT name, type, serialization_format FROM topics ORDER BY id")
            for name, kind, serialised in rows.fetchmany(MAX_TOPICS):
                if serialised == "cdr":
                    found.append(Topic(str(name), type_name(str(kind)), "cdr", str(texts.get(kind, ""))))
            return list(dict.fromkeys(found))

    def messages(self, topic: Topic) -> Iterator[Message]:
        """The messages of a topic, in the order of recording."""
        with self._open() as database:
            ids = [
                number
                for number, name, kind in database.execute("SELECT id, name, type FROM topics").fetchmany(MAX_TOPICS)
                if (name, type_name(str(kind))) == (topic.name, topic.type)
            ]
            marks = ",".join("?" * len(ids))
            rows = database.execute(f"SELECT timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id", ids)
            for receive_ns, data in rows:
                if not isinstance(receive_ns, int) or not isinstance(data, bytes):
                    raise damaged(self._path, "a message without time or bytes")
                yield Message(receive_ns, message_bytes(data))

    def told(self) -> list[tuple[str, str]]:
        """That the recorder was killed before all was in the file."""
        log = self._path.with_name(self._path.name + "-wal")
        if not log.is_file() or not log.stat().st_size:
            return []
        advice = f"merge it with: sqlite3 {self._path.name} 'PRAGMA wal_checkpoint'"
        return [("log-cut", f"what {log.name} has is not read, since its recorder did not close the bag; {advice}")]

    @contextlib.contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(
                sqlite3.connect(f"file:{quote(str(self._path.absolute()))}?mode=ro&immutable=1", uri=True)
            ) as database:
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
                database.execute("PRAGMA trusted_schema = off")
                if self._tables(database, "topics", "messages") != 2:
                    raise InputError(f"{self._path}: an SQLite database, but no bag of ROS 2: it lacks topics and messages")
                yield database
        except (sqlite3.Error, ValueError, OverflowError, zstandard.ZstdError) as error:
            raise damaged(self._path, error) from error

    def _tables(self, database: sqlite3.Connection, *names: str) -> int:
        """How many of the names are tables (a view would run what the file says)."""
        marks = ",".join("?" * len(names))
        query = f"SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ({marks})"
        return int(database.execute(query, names).fetchone()[0])
