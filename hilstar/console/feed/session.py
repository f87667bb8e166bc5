"""The page of a session of first light: the pattern that the tracker looks at, the steps as they end, and which failed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from hilstar.console.feed.board import PICTURE_HEAD_BYTES, Board
from hilstar.console.feed.host import Host
from hilstar.console.feed.introduction import Told, introduced
from hilstar.console.feed.messages import Answer, Order, PictureHead, RunSeen
from hilstar.errors import one_line
from hilstar.notices import Listener, Notice

if TYPE_CHECKING:
    from hilstar.bench.bench_file import BenchFile
    from hilstar.calibrate.first_light.image_sources import Pattern
    from hilstar.console.feed.door import Door

CODE = np.dtype("<u2")
FAILED = "failed:"  # as `first-light` says of a step


class SessionFeed:
    """What a session leaves for its page; its thread writes pictures, and the page's keeper asks for the rest."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._listeners: list[Listener] = []
        self._failed: dict[str, str] = {}
        self._patterns = 0

    def show(self, pattern: Pattern) -> None:
        """Take the pattern that is shown now; of one with colours its brightest channel."""
        codes = pattern.codes if pattern.codes.ndim == 2 else pattern.codes.max(axis=2)
        ring, (height, width) = self._board.pictures, codes.shape
        whole = PICTURE_HEAD_BYTES + codes.size * CODE.itemsize
        if whole > ring.slot_bytes:  # a step has found that the monitor is larger than the bench file said
            return
        self._patterns += 1
        ring.begin()
        room = ring.room(whole)
        head = PictureHead(self._patterns, time.monotonic_ns(), 0, width, height, CODE.itemsize, 0).pack()
        room[: len(head)] = head
        np.copyto(np.frombuffer(room[PICTURE_HEAD_BYTES:], dtype=CODE).reshape(height, width), codes)
        ring.end(whole, 0)
        self.tell("pattern", f"shows {pattern.name}")

    def say(self, line: str) -> None:
        """Take a line of the session: a step that begins, or ends."""
        step, _, words = line.partition(" ")
        if words.strip().startswith(FAILED):
            self._failed[step] = f"{step} {words.strip()}"
        else:
            self._failed.pop(step, None)
        self.tell("step", line)

    def listen(self, listener: Listener) -> None:
        """Hand every further event to `listener`."""
        self._listeners.append(listener)

    def tell(self, kind: str, line: str) -> None:
        """Tell the page of an event."""
        for listener in self._listeners:
            listener(Notice.now(kind, " ".join(line.split())))

    def now(self) -> RunSeen:
        """The state now."""
        now_ns = time.monotonic_ns()
        failed = list(self._failed.values())
        return RunSeen(host_ns=now_ns, alive_ns=now_ns, frame=self._patterns, missing=False, blank=False, failed=failed)

    def do(self, order: Order) -> Answer:
        """A mark is told; there is nothing else to order."""
        if order.name != "mark" or not order.text.strip():
            return Answer(id=order.id, status=409, line="a session of first light takes marks with a text, and no other order")
        self.tell("mark", f"mark, by {one_line(order.who)}: {one_line(order.text)}")
        return Answer(id=order.id, status=200, line="mark told; a session has no ledger")


@contextmanager
def session_page(door: Door, control: bool, file: BenchFile) -> Iterator[SessionFeed]:
    """The page of a session while this is open."""
    monitor = file.config.monitor
    width, height = monitor.resolution_px
    picture_bytes = width * height * CODE.itemsize
    board = Board.make(picture_bytes)
    feed = SessionFeed(board)
    setup = introduced(door, control, Told("first-light", "session", "", "session"), file, picture_bytes)
    setup.hello["session"] = True
    with Host(setup, board, door.socket, feed, feed.do):
        yield feed
