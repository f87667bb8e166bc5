"""A run's ledger that can be begun and ended while the run goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.notices import Notice
from hilstar.process.interrupts import stop_on_signal
from hilstar.run.record.ledger import Ledger
from hilstar.run.record.ledger_records import FaultRecord, FrameRecord


class LedgerSwitch:
    """Hands a run's records to the ledger of the moment, and drops them while there is none.

    Frames and packets come from any thread and wait for nothing; `begin` and `end` are for one thread, which may wait for a
    disk.
    """

    def __init__(self, ledger: Ledger | None = None) -> None:
        self.current = ledger
        self.last = ledger  # the newest there was
        self._ending = threading.Lock()  # the end of a run waits for one that an operator has begun
        self._scenario: list[FaultRecord] = []
        self._faults_on: dict[int, FaultRecord] = {}
        if ledger is not None:
            ledger.standing = self._standing

    @property
    def on(self) -> bool:
        """Whether there is a ledger now."""
        return self.current is not None

    @property
    def failure(self) -> str | None:
        """Why the newest ledger could not be written, None where it could."""
        return None if self.last is None else self.last.failure

    def packet(self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> None:
        """Record a packet; see `attitude.receiver.Watch`."""
        ledger = self.current
        if ledger is not None:
            ledger.packet(host_ns, raw, sample, refusal)

    def frame(self, record: FrameRecord) -> None:
        """Record a frame."""
        ledger = self.current
        if ledger is not None:
            ledger.frame(record)

    def notice(self, notice: Notice) -> None:
        """Record an event of the run."""
        ledger = self.current
        if ledger is not None:
            ledger.notice(notice)

    def pulse(self, what: str) -> None:
        """Count what became of a pulse: "sent", "skipped" or "lost"."""
        ledger = self.current
        if ledger is not None:
            ledger.pulse(what)

    def fault(self, record: FaultRecord) -> None:
        """Record what becomes of a fault; a ledger that begins later has the scenario too, and what is on then."""
        if record.event == "scenario":
            self._scenario.append(record)
        elif record.event == "start":
            self._faults_on[record.number] = record
        else:
            self._faults_on.pop(record.number, None)
        ledger = self.current
        if ledger is not None:
            ledger.fault(record)

    def begin(self, make: Callable[[], Ledger]) -> Ledger:
        """Begin a ledger, if there is none; the one there is then. Raises InputError where it cannot be made."""
        ledger = self.current
        if ledger is None:
            ledger = make()
            ledger.standing = self._standing
            for record in self._standing():
                ledger.fault(record)
            self.last = self.current = ledger
        return ledger

    def _standing(self) -> list[FaultRecord]:
        return [*self._scenario, *list(self._faults_on.values())]

    def end(self) -> Ledger | None:
        """End the ledger, and wait until it is whole on the disk; the one that was ended."""
        with self._ending, stop_on_signal(threading.Event()):  # a signal that comes now does not interrupt this
            ledger, self.current = self.current, None
            if ledger is not None:
                ledger.close()
        return ledger

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.end()
