"""Answers of a tracker that wait in a queue, in place of a line on which they come."""

from __future__ import annotations

from collections import deque

from hilstar.basics.notices import Notices
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.judge import AnswerRules
from hilstar.server.bench.config import Monitor
from hilstar.server.live_answers import LiveAnswers
from hilstar.server.record.ledger import LedgerSwitch

RULES = AnswerRules(0.1, clock="host")


class Queued:
    """Answers that wait, and what was refused; `unread` says why nothing is read."""

    unread = ""

    def __init__(self) -> None:
        self.waiting: deque[Answer] = deque()
        self.refused: dict[str, int] = {}

    def take(self) -> list[Answer]:
        return [self.waiting.popleft() for _ in range(len(self.waiting))]

    def refusals(self) -> dict[str, int]:
        return self.refused

    def trouble(self) -> str:
        return ""

    def close(self) -> None:
        pass


def unasked_answers(monitor: Monitor) -> LiveAnswers:
    """A tracker whose answers nobody takes: its figures are those that they are set to."""
    return LiveAnswers(monitor, RULES, Queued(), Notices(), LedgerSwitch())
