"""What operators order from the page: checked in the run's own process, done by the frame loop or beside it, and recorded.

An order is done when the frame loop has taken it, or the disk; its answer says so, and never before.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.console.feed.messages import SWITCHES, Answer, Order
from hilstar.console.feed.seen import Watched
from hilstar.errors import HilstarError, did_you_mean, one_line, printable
from hilstar.run.operator import PATCHES, SwitchRequest, SwitchRequests

if TYPE_CHECKING:
    from hilstar.run.record.ledger import Ledger

LOOP_WAITS_S = 2.0
POLL_S = 0.004
MAX_MARK_CHARACTERS = 200
MAX_WHO_CHARACTERS = 60


class Orders:
    """Does what is ordered; each call is on a thread of its own, and waits."""

    def __init__(self, requests: SwitchRequests, watched: Watched, make_ledger: Callable[[Path], Ledger]) -> None:
        self._requests, self._feed, self._faults = requests, watched.feed, watched.faults
        self._ledger, self._notices = watched.ledger, watched.notices
        self._make_ledger = make_ledger
        self._ledger_lock = threading.Lock()

    def do(self, order: Order) -> Answer:
        """Do it; what went wrong is in the answer."""
        who = one_line(order.who)[:MAX_WHO_CHARACTERS]
        try:
            answer = self._done(order, who)
        except HilstarError as error:
            return Answer(id=order.id, status=409, line=one_line(str(error)))
        answer.line = printable(answer.line)  # a ledger may be called anything
        return answer

    def _done(self, order: Order, who: str) -> Answer:
        if order.name in SWITCHES:
            return self._switch(order, who)
        if order.name == "ledger":
            return self._switch_ledger(order, who)
        return self._mark(order, who) if order.name == "mark" else self._fault(order, who)

    def _switch(self, order: Order, who: str) -> Answer:
        if order.name == "patch" and order.on and order.level not in PATCHES:
            return Answer(id=order.id, status=400, line=f"no such patch; write a level of {', '.join(map(str, PATCHES))}")
        request = SwitchRequest(order.name, order.on, who, order.level)
        self._requests.ask(request)
        if self._waits_for(lambda: request.done):
            return Answer(id=order.id, status=200, line=request.text)
        request.called_off = True
        return Answer(
            id=order.id, status=504, line=f"the frame loop did not take it within {LOOP_WAITS_S:g} s; nothing changed"
        )

    def _waits_for(self, holds: Callable[[], bool]) -> bool:
        """Whether that comes to hold while the frame loop is waited for."""
        end_s = time.monotonic() + LOOP_WAITS_S
        while not holds():
            if time.monotonic() > end_s:
                return False
            time.sleep(POLL_S)
        return True

    def _switch_ledger(self, order: Order, who: str) -> Answer:
        with self._ledger_lock:
            if order.on:
                path = self._free_path()
                was_on = self._ledger.on
                ledger = self._ledger.begin(lambda: self._make_ledger(path))
                if was_on:
                    return Answer(id=order.id, status=200, line=f"ledger on: {ledger.path}")
                self._notices.tell("operator", f"ledger on, by {who}: {ledger.path}", who)
                return Answer(id=order.id, status=200, line=f"ledger on: {ledger.path}")
            ledger_now = self._ledger.current
            if ledger_now is None:
                return Answer(id=order.id, status=200, line="ledger off")
            self._notices.tell("operator", f"ledger off, by {who}: {ledger_now.path}", who)
            self._ledger.end()
            if ledger_now.failure is not None:
                return Answer(id=order.id, status=500, line=f"{ledger_now.path}: {ledger_now.failure}")
            return Answer(id=order.id, status=200, line=f"ledger off: {ledger_now.path} is whole")

    def _free_path(self) -> Path:
        """A new name, beside the newest ledger where there was one."""
        folder = Path.cwd() if self._ledger.last is None else self._ledger.last.path.parent
        now = datetime.now(UTC)
        for k in range(100):
            path = folder / (f"hilstar-{now:%Y%m%dT%H%M%SZ}" + (f"-{k}" if k else "") + ".mcap")
            if not path.exists():
                return path
        return folder / f"hilstar-{now:%Y%m%dT%H%M%S.%fZ}.mcap"

    def _mark(self, order: Order, who: str) -> Answer:
        text = printable(" ".join(order.text.split()))[:MAX_MARK_CHARACTERS]
        if not text:
            return Answer(id=order.id, status=400, line='a mark needs its text: {"text": "..."}')
        self._notices.tell("mark", f"mark, by {who}: {text}", who)
        return Answer(
            id=order.id, status=200, line="mark written" if self._ledger.on else "mark told; no ledger is being written"
        )

    def _fault(self, order: Order, who: str) -> Answer:
        faults = self._faults
        if faults is None or not faults.names():
            return Answer(id=order.id, status=409, line="this run has no faults to start: give it some with --scenario")
        if order.fault not in faults.names():
            meant, known = did_you_mean(order.fault, faults.names()), ", ".join(faults.names())
            return Answer(id=order.id, status=404, line=f"no fault of that name; {meant}write one of {known}")
        before = self._feed.count
        act = faults.start if order.on else faults.stop
        act(order.fault, who)
        if self._waits_for(lambda: self._feed.count > before + 1):
            return Answer(id=order.id, status=200, line=f"fault {order.fault} {'on' if order.on else 'off'}")
        return Answer(id=order.id, status=504, line=f"asked for, but no frame was drawn within {LOOP_WAITS_S:g} s")
