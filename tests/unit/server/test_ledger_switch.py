"""A ledger that is begun and ended in a run: what reaches it, and what a later one is told of
what lasts.
"""

from __future__ import annotations

from typing import Any, cast

from hilstar.basics.notices import Notice
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.record.ledger_records import EventRecord, FaultRecord


class Kept:
    """A ledger in memory."""

    failure: str | None = None

    def __init__(self) -> None:
        self.taken: list[Any] = []
        self.closed = False

    def notice(self, notice: Notice) -> None:
        self.taken.append(notice.kind)

    def fault(self, record: FaultRecord) -> None:
        self.taken.append((record.event, record.name))

    def stands(self, record: EventRecord) -> None:
        self.taken.append((record.kind, record.since_ns))

    def close(self) -> None:
        self.closed = True


def fault(event: str, name: str, number: int) -> FaultRecord:
    return FaultRecord(
        host_ns=1,
        event=event,
        number=number,
        name=name,
        kind="",
        who="",
        t_ns=0,
        table="",
        seed=0,
        folder="",
    )


def begun(switch: LedgerSwitch) -> Kept:
    kept = Kept()
    assert switch.begin(lambda: cast(Ledger, kept)) is cast(Ledger, kept)
    return kept


def test_only_the_ledger_of_the_moment_gets_what_happens():
    switch = LedgerSwitch()
    switch.notice(Notice(1, "before", ""))
    first = begun(switch)
    assert switch.on and switch.begin(lambda: cast(Ledger, Kept())) is cast(Ledger, first)
    switch.notice(Notice(2, "first", ""))
    assert switch.end() is cast(Ledger, first) and first.closed and not switch.on
    switch.notice(Notice(3, "between", ""))
    assert switch.end() is None
    second = begun(switch)
    switch.notice(Notice(4, "second", ""))
    assert (first.taken, second.taken) == (["first"], ["second"])


def test_a_later_ledger_has_the_scenario_and_the_faults_that_are_on():
    switch = LedgerSwitch()
    for record in (
        fault("scenario", "file", 0),
        fault("start", "ghost", 1),
        fault("start", "flash", 2),
        fault("end", "ghost", 1),
    ):
        switch.fault(record)
    kept = begun(switch)
    assert kept.taken == [("scenario", "file"), ("start", "flash")]
    # which one that goes on in another file asks for again
    switch.fault(fault("start", "glow", 3))
    assert [record.name for record in kept.standing()] == ["file", "flash", "glow"]


def test_a_failure_is_told_after_its_ledger_has_ended():
    switch = LedgerSwitch()
    begun(switch).failure = "no room"
    switch.end()
    assert switch.failure == "no room"


def test_a_later_ledger_has_the_conditions_of_a_wrong_sky_that_hold():
    switch = LedgerSwitch()
    switch.notice(Notice(5, "rates-wrong", "", since_ns=3))
    switch.notice(Notice(6, "clock-not-shared", "", since_ns=4))
    switch.notice(Notice(7, "clock-shared", ""))
    assert begun(switch).taken == [("rates-wrong", 3)]
