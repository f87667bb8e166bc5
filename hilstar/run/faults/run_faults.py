"""The faults of a run, put together: the scenario, the stream, what becomes of them in the frames, and who is told."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from hilstar.attitude.wire.keys import CurveKeys
from hilstar.bench.config.faults import FaultSettings
from hilstar.bench.faults.desk import FILE, Change, FaultDesk
from hilstar.bench.faults.kinds import Fault, MeasuredMap, table_of
from hilstar.bench.faults.scenario import NO_SCENARIO, Scenario
from hilstar.bench.faults.surfaces import map_sha256
from hilstar.bench.faults.views import display_view
from hilstar.bench.frame import Bench
from hilstar.errors import printable
from hilstar.notices import Notices
from hilstar.run.faults.recorded import RecordedFaults, Recording
from hilstar.run.faults.stream import STREAM, FaultStream
from hilstar.run.faulty_frames import FaultyFrames
from hilstar.run.record.ledger_records import FaultRecord, FrameRecord
from hilstar.run.record.ledger_switch import LedgerSwitch

WORDS = {"start": "begins", "end": "ends", "missed": "fell between two frames"}
MAX_NAMES = 100  # in the summary: a stream may make up names


class RunFaults:
    """The faults of one run: `desk` for who wants to start one, `frames` for the loop.

    Raises InputError for a fault that this bench cannot draw.
    """

    def __init__(self, bench: Bench, scenario: Scenario, notices: Notices, ledger: LedgerSwitch | None = None) -> None:
        self._scenario, self._notices, self._ledger = scenario, notices, ledger
        self._started: Counter[str] = Counter()
        self._missed: Counter[str] = Counter()
        self._stream: FaultStream | None = None
        view = display_view(bench, scenario)
        self._sha256: dict[Fault, str] = {
            fault: map_sha256(scenario.folder / fault.file) for fault in scenario.faults if isinstance(fault, MeasuredMap)
        }
        self.desk = FaultDesk(scenario, 1 / bench.config.monitor.refresh_hz, view.prepare, self._hear)
        self.frames = FaultyFrames(self.desk, view)
        if ledger is not None and scenario.faults:
            ledger.fault(self._record("scenario", scenario.text, name=printable(str(scenario.path))))

    def _hear(self, change: Change) -> None:
        fault = change.fault
        tally = self._missed if change.what == "missed" else self._started
        if change.what != "end":
            tally[fault.name if len(tally) < MAX_NAMES or fault.name in tally else "others"] += 1
        person = "" if change.who in {FILE, STREAM} else change.who
        self._notices.tell("fault", f"fault {fault.name} ({fault.KIND}) {WORDS[change.what]}, by {change.who}", person)
        if self._ledger is not None:
            table = msgspec.json.encode(table_of(fault)).decode()
            record = self._record(change.what, table, name=fault.name, kind=fault.KIND, who=change.who)
            record.number, record.t_ns = change.number, change.t_ns
            record.file_sha256 = self._sha256.get(fault, "")
            self._ledger.fault(record)

    def _record(self, event: str, table: str, name: str, kind: str = "", who: str = "") -> FaultRecord:
        folder = str(self._scenario.folder.resolve()) if self._scenario.faults else ""
        return FaultRecord(
            host_ns=time.monotonic_ns(),
            event=event,
            number=0,
            name=name,
            kind=kind,
            who=who,
            t_ns=0,
            table=table,
            seed=self._scenario.seed,
            folder=folder,
        )

    def begin(self, zero_ns: int) -> None:
        """Say from which time of the timeline a scenario's seconds count; by default from the first frame with an attitude."""
        self.desk.begin(zero_ns)

    def recall(self, record: FrameRecord | None) -> None:
        """These faults come from the desk, whatever an earlier run had."""

    @contextmanager
    def listening(self, settings: FaultSettings, folder: Path) -> Iterator[str]:
        """Take faults from the stream that a bench file names; says where it listens, "" where it names none.

        Raises InputError where the endpoint cannot be used.
        """
        if settings.endpoint is None:
            yield ""
            return
        names = (settings.curve_secret_key, settings.curve_server_key, settings.allowed_clients)
        keys = CurveKeys(*(None if name is None else folder / name for name in names))
        self._stream = FaultStream(self.desk, settings.endpoint, bind=settings.bind, keys=keys, notices=self._notices)
        try:
            yield self._stream.endpoint
        finally:
            self._stream.close()

    def summary(self) -> dict[str, Any]:
        """What was on in the run: names and how often each began, frames dropped and frozen, and the stream's messages."""
        told: dict[str, Any] = {
            "scenario": str(self._scenario.path) if self._scenario.faults else None,
            "started": dict(self._started),
            "missed": dict(self._missed),
            "on": self.desk.on(),
            "dropped_frames": self.frames.dropped,
            "frozen_frames": self.frames.frozen,
        }
        return told if self._stream is None else told | {"stream": self._stream.summary()}


def run_faults(
    bench: Bench, scenario: Scenario | None, notices: Notices, ledger: LedgerSwitch | None = None
) -> RunFaults | None:
    """The faults of a run that has a scenario, or whose bench file has a stream of them; None for one that has neither."""
    if scenario is None and bench.config.faults.endpoint is None:
        return None
    return RunFaults(bench, scenario or NO_SCENARIO, notices, ledger)


class ReplayedFaults:
    """The faults of an earlier run for the loop that draws it again, and for the ledger of that.

    Raises InputError for a fault that this bench cannot draw.
    """

    def __init__(self, bench: Bench, recording: Recording, ledger: LedgerSwitch | None = None) -> None:
        view = display_view(bench, recording.scenario)
        for fault in recording.faults.values():
            view.prepare(fault)
        self._source = RecordedFaults(recording, bench.config.monitor.refresh_hz)
        self._started = Counter(record.name for record in recording.records if record.event == "start")
        self.frames = FaultyFrames(self._source, view)
        if ledger is not None:
            for record in recording.records:
                ledger.fault(record)

    def begin(self, zero_ns: int) -> None:
        """The recording says what is on in each frame."""

    def recall(self, record: FrameRecord | None) -> None:
        """Take the faults of the frame that is drawn next."""
        if record is not None:
            self._source.recall(record)

    def summary(self) -> dict[str, Any]:
        """What was on in the earlier run, by how often it began, and how many frames stayed."""
        return {"recorded": dict(self._started), "frozen_frames": self.frames.frozen}


AnyFaults = RunFaults | ReplayedFaults


def replayed_faults(bench: Bench, recording: Recording, ledger: LedgerSwitch | None = None) -> ReplayedFaults | None:
    """The faults of an earlier run; None where it had none."""
    return ReplayedFaults(bench, recording, ledger) if recording.faults else None
