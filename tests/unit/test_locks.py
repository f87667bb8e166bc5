"""What two threads share is read and written under its lock alone. A race shows in one run of
thousands; here each public call is watched instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hilstar.attitude.receiver import BackChannel, Traffic
from hilstar.attitude.wire.packet import Status
from hilstar.basics.notices import Notices
from hilstar.basics.reading import KeptFiles
from hilstar.basics.wrong_sky import ENDS, WrongSky
from hilstar.display.window.watch import PresentedModes
from hilstar.optics.layers.fault_kinds import Gradient
from hilstar.server.bench.scenario import FaultSchedule, parse_scenario
from hilstar.server.console.messages import Order
from hilstar.server.console.publisher import OrderHandler
from hilstar.server.record.ledger import FloodFilter, LedgerQueue, LedgerSwitch, QueueEntry
from tests.unit.optics.test_fault_light import view_of

NOW_NS = 10**12
FLOOD = 1000  # of one kind: more than are said
BEGIN = next(iter(ENDS))
SCENARIO = parse_scenario(Path("f.toml"), '[[fault]]\nkind = "blank"\nname = "cover"')


@contextmanager
def only_under_its_lock(
    shared: Any, *names: str, lock: str = "_lock", may_read: bool = False
) -> Iterator[None]:
    """Refuse (AssertionError) each write of attributes while the lock is free, and each read
    unless others `may_read` them.
    """
    kind = type(shared)

    def check(name: str) -> None:
        if name in names:
            is_held = object.__getattribute__(shared, lock).locked()
            assert is_held, f"{kind.__name__}.{name} is used without its lock"

    class Watched(kind):
        __slots__ = ()

        def __getattribute__(self, name: str) -> Any:
            if not may_read:
                check(name)
            return super().__getattribute__(name)

        def __setattr__(self, name: str, value: Any) -> None:
            check(name)
            super().__setattr__(name, value)

    shared.__class__ = Watched
    try:
        yield
    finally:
        shared.__class__ = kind


def test_notices_are_counted_and_told_under_their_lock():
    notices = Notices()
    with only_under_its_lock(notices, "_counts", "_kinds", "_active"):
        for _ in range(FLOOD):
            notices.tell("flood", "again")
        notices.begin("lasting", "begun")
        assert notices.active == {"lasting"}
        assert notices.lasting == {"lasting": "begun"}
        notices.end("lasting", "over", "ended")
        assert notices.latest("over") == "ended"
        assert notices.counts() == {"flood": FLOOD, "lasting": 1, "over": 1}
        notices.sum_up()


def test_a_wrong_sky_s_spans_are_kept_under_their_lock():
    wrong_sky = WrongSky()
    with only_under_its_lock(wrong_sky, "_now", "_past", "_texts"):
        wrong_sky.see(BEGIN, "wrong", 10)
        assert [condition.kind for condition in wrong_sky.now()] == [BEGIN]
        wrong_sky.see(ENDS[BEGIN], "right", 30)
        assert wrong_sky.at(20) == [(BEGIN, "wrong")]
        assert wrong_sky.spans_ns() == [(10, 30)]
        assert len(wrong_sky.total(0, 40).conditions) == 1


def test_files_are_kept_under_their_lock():
    files = KeptFiles()
    with only_under_its_lock(files, "_contents"):
        files.keep((1, 2), b"content")
        assert files.content((1, 2)) == b"content"


def test_a_ledger_s_queue_is_filled_and_emptied_under_its_lock():
    queue = LedgerQueue()
    entry = QueueEntry("packet", NOW_NS, 1, lambda: b"{}")
    too_large = QueueEntry("packet", NOW_NS, 2, lambda: b"{}", raw_bytes=10**12)
    with only_under_its_lock(queue, "_entries", "_bytes", "_dropped"):
        assert queue.put(entry) and not queue.put(too_large)
        assert queue.take() == [entry]
        assert queue.dropped == 1
        assert queue.take_dropped() == Counter(packet=1)


def test_a_flood_is_counted_under_its_lock():
    flood = FloodFilter()
    with only_under_its_lock(flood, "_allowances", "_counts"):
        kept = sum(flood.keeps("event", "stale", NOW_NS) for _ in range(FLOOD))
        flood.count("lost", "", 3)
        assert flood.counted() == {("event", "stale"): FLOOD - kept, ("lost", ""): 3}


def test_a_ledger_that_is_ended_is_ended_under_its_lock():
    switch = LedgerSwitch()
    with only_under_its_lock(switch, "current", lock="_ending"):
        assert switch.end() is None


@pytest.mark.parametrize("is_on", [True, False])
def test_one_order_at_a_time_switches_the_ledger(is_on, tmp_path):
    ledger = SimpleNamespace(path=tmp_path / "run.mcap", failure=None)
    switch = SimpleNamespace(
        on=False, last=ledger, current=ledger, begin=lambda make: ledger, end=lambda: ledger
    )
    parts = SimpleNamespace(faults=None, ledger=switch, notices=Notices(), make_ledger=None)
    handler = OrderHandler(None, None, parts)
    with only_under_its_lock(handler, "_ledger", lock="_ledger_lock"):
        order = Order(id=1, name="ledger", who="operator", on=is_on)
        assert handler.do(order).status == 200


ANY_THREAD: dict[str, Callable[[FaultSchedule], object]] = {
    "start": lambda schedule: schedule.start("cover", "operator"),
    "ask": lambda schedule: schedule.ask(SCENARIO.faults[0], "operator"),
    "on": lambda schedule: schedule.on(),
}


@pytest.mark.parametrize("call", ANY_THREAD.values(), ids=ANY_THREAD)
def test_faults_are_asked_for_from_any_thread_under_a_lock(call):
    schedule = FaultSchedule(SCENARIO)
    with only_under_its_lock(schedule, "_asked", "_on", "_stops"):
        call(schedule)


def test_the_frames_thread_takes_faults_and_their_ends_under_the_lock():
    schedule = FaultSchedule(SCENARIO)
    schedule.start("cover", "operator")
    with only_under_its_lock(schedule, "_stops"):
        assert len(schedule.at(0)) == 1
        schedule.stop("cover")
        assert schedule.at(NOW_NS) == ()


def test_a_fault_s_map_is_kept_under_the_lock():
    view = view_of()
    with only_under_its_lock(view, "_maps"):
        view.prepare(Gradient(name="stray", electrons_per_s=5.0))


def test_how_a_screen_showed_frames_is_taken_under_a_lock():
    modes = PresentedModes(lambda: ["flip", "copy", "flip"])
    with only_under_its_lock(modes, "_counts", "_taken"):
        assert modes.counts() == {"flip": 2, "copy": 1}


def test_a_status_is_posted_and_taken_under_a_lock():
    """The receiver looks for one without the lock, and takes it with it."""
    sent: list[Status] = []
    link = SimpleNamespace(send=sent.append)
    channel = BackChannel(link, Traffic(status_hz=10.0), lambda: NOW_NS)
    first, second = (Status(0, frame, NOW_NS, -1, 0, 0, 0) for frame in (1, 2))
    with only_under_its_lock(channel, "_status", lock="_posting"):
        channel.post(first)
        channel.post(second)
    with only_under_its_lock(channel, "_status", lock="_posting", may_read=True):
        channel.talk(NOW_NS, ask=False)
    assert sent == [second]
