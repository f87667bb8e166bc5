"""Faults over ZeroMQ: a message is a JSON object with the keys of a scenario's `[[fault]]`, or
starts or stops one by name.

`{"start": "NAME"}` begins a fault of the scenario, `{"stop": "NAME"}` ends any. A message that is
wrong, or one too many, is refused and counted; nothing of it is kept.
"""

import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import msgspec

from hilstar.attitude.wire.zmq_links import ZmqReceiver
from hilstar.attitude.wire.zmq_socket import SocketOptions
from hilstar.basics.allowance import Allowance
from hilstar.basics.errors import InputError, printable, shortened
from hilstar.basics.notices import Notices
from hilstar.basics.reading import NOT_JSON
from hilstar.basics.units import NS_PER_S
from hilstar.optics.layers.fault_kinds import Fault, Freeze, MeasuredMap, Now, fault_of, table_of
from hilstar.optics.layers.stray_light import map_sha256
from hilstar.server.bench.config.attitude import FaultSettings
from hilstar.server.bench.fault_views import display_view
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.scenario import FILE, FaultChange, FaultSchedule, Scenario, share_on
from hilstar.server.loop import FaultyFrames
from hilstar.server.open_link import link_keys
from hilstar.server.record.ledger import LedgerSwitch
from hilstar.server.record.ledger_records import FaultRecord, FrameRecord, fault_records

STREAM = "stream"
POLL_MS = 50
RETRY_S = 0.5
MAX_MESSAGE_BYTES = 16_384
# A fault costs time to prepare and room in the ledger: that many at once, and that many each second
# after.
MAX_BURST, MAX_PER_S = 50, 10
FORM = 'write a JSON object with kind and name, {"start": "NAME"} or {"stop": "NAME"}'
WORDS = {"start": "begins", "end": "ends", "missed": "fell between two frames"}
MAX_NAMES = 100  # in the summary: a stream may make up names


def act(schedule: FaultSchedule, raw: bytes) -> None:
    """Do what a message asks for. Raises InputError for one that is wrong, or that cannot be
    done.
    """
    try:
        message: Any = msgspec.json.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InputError(f"a message is no JSON ({shortened(error)}); {FORM}") from error
    if not isinstance(message, dict):
        raise InputError(f"a message is {type(message).__name__}, no object; {FORM}")
    for verb in ("start", "stop"):
        if verb in message:
            name = message[verb]
            if len(message) > 1 or not isinstance(name, str):
                raise InputError(f"{shortened(message)}: {FORM}")
            schedule.start(name, STREAM) if verb == "start" else schedule.stop(name, STREAM)
            return
    schedule.ask(fault_of(message), STREAM)


class FaultStream:
    """Listens on a thread of its own while it is open. Raises InputError where the endpoint
    cannot be used.
    """

    def __init__(
        self, schedule: FaultSchedule, endpoint: str, **options: Unpack[SocketOptions]
    ) -> None:
        self.messages = 0
        self.refused: Counter[str] = Counter()
        self._schedule = schedule
        self._notices = options.get("notices") or Notices()
        options |= {"notices": self._notices, "max_part_bytes": MAX_MESSAGE_BYTES}
        self._link = ZmqReceiver(endpoint, **options)
        self._allowance = Allowance(MAX_BURST, MAX_PER_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-faults", daemon=True)
        self._thread.start()

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return f"{self._link.verb} {self._link.endpoint}"

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                for message in self._link.taken(POLL_MS):
                    self._take(message.host_ns, message.parts[-1])
            except Exception as error:  # whatever it is: the run goes on, and so does this
                self._notices.tell(
                    "fault-stream",
                    f"the stream of faults failed ({type(error).__name__}: {error}); going on",
                )
                self._stop.wait(RETRY_S)

    def _take(self, host_ns: int, raw: bytes) -> None:
        self.messages += 1
        if not self._allowance.take(host_ns):
            self._refuse("too-many", f"more than {MAX_PER_S} messages a second; send fewer")
            return
        try:
            act(self._schedule, raw)
        except InputError as error:
            self._refuse("refused", str(error))

    def _refuse(self, reason: str, detail: str) -> None:
        self.refused[reason] += 1
        self._notices.tell("fault-refused", f"fault refused: {shortened(detail, 300)}")

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self._link.close()

    def summary(self) -> dict[str, int]:
        """How many messages came, and how many were refused."""
        return {
            "messages": self.messages,
            "refused": sum(self.refused.values()),
            "dropped_unread": self._link.link_counts.flooded,
        }


@dataclass(frozen=True, slots=True)
class Recording:
    """The faults of a ledger by the number of their start; empty where the run had none."""

    faults: dict[int, Fault]
    seed: int
    folder: Path
    records: tuple[FaultRecord, ...] = ()

    @property
    def scenario(self) -> Scenario:
        """What a view of them has to know."""
        return Scenario(
            self.folder, "", self.seed, tuple(dict.fromkeys(self.faults.values())), self.folder
        )


NO_RECORDING = Recording({}, 0, Path())


def read_recording(path: Path, records: Sequence[FaultRecord] | None = None) -> Recording:
    """The faults of a run, from its `records` of them where these are read already.

    Raises InputError for damage, and for a measured map that is not the run's any more.
    """
    faults: dict[int, Fault] = {}
    seed = 0
    folder = Path()
    records = tuple(fault_records(path) if records is None else records)
    for record in records:
        if record.event != "start":
            continue
        seed = record.seed
        folder = Path(record.folder)
        try:
            faults[record.number] = fault = fault_of(msgspec.json.decode(record.table))
        except (*NOT_JSON, InputError) as error:
            raise InputError(
                f"{path}: the fault {record.name!r} is not one of hilstar's ({error})"
            ) from error
        if isinstance(fault, MeasuredMap) and map_sha256(folder / fault.file) != record.file_sha256:
            raise InputError(
                f"{path}: {folder / fault.file} is not the map that the run had; put that one there"
            )
    return Recording(faults, seed, folder, records)


class RunFaults:
    """The faults of a run: `schedule` starts them, `frames` is the loop's. Raises InputError for
    one that cannot be drawn.
    """

    def __init__(
        self, bench: Bench, scenario: Scenario, notices: Notices, ledger: LedgerSwitch | None = None
    ) -> None:
        self._scenario = scenario
        self._notices = notices
        self._ledger = ledger
        self._started: Counter[str] = Counter()
        self._missed: Counter[str] = Counter()
        self._stream: FaultStream | None = None
        view = display_view(bench, scenario)
        self._sha256: dict[Fault, str] = {
            fault: map_sha256(scenario.folder / fault.file)
            for fault in scenario.faults
            if isinstance(fault, MeasuredMap)
        }
        self.schedule = FaultSchedule(
            scenario, 1 / bench.config.monitor.refresh_hz, view.prepare, self._hear
        )
        self.frames = FaultyFrames(self.schedule.at, view)
        if ledger is not None and scenario.faults:
            ledger.fault(
                self._record("scenario", scenario.text, name=printable(str(scenario.path)))
            )

    def _hear(self, change: FaultChange) -> None:
        fault = change.fault
        if change.what == "missed":
            tally = self._missed
        else:
            tally = self._started
        if change.what != "end":
            tally[fault.name if len(tally) < MAX_NAMES or fault.name in tally else "others"] += 1
        if change.who in {FILE, STREAM}:
            person = ""
        else:
            person = change.who
        self._notices.tell(
            "fault",
            f"fault {fault.name} ({fault.KIND}) {WORDS[change.what]}, by {change.who}",
            person,
        )
        if self._ledger is not None:
            table = msgspec.json.encode(table_of(fault)).decode()
            record = self._record(
                change.what, table, name=fault.name, kind=fault.KIND, who=change.who
            )
            record.number = change.number
            record.t_ns = change.t_ns
            record.file_sha256 = self._sha256.get(fault, "")
            self._ledger.fault(record)

    def _record(
        self, event: str, table: str, name: str, kind: str = "", who: str = ""
    ) -> FaultRecord:
        if self._scenario.faults:
            folder = str(self._scenario.folder.resolve())
        else:
            folder = ""
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
        """Set the time of the timeline from which a scenario counts; by default that of the
        first frame with an attitude.
        """
        self.schedule.begin(zero_ns)

    @contextmanager
    def listening(self, settings: FaultSettings, folder: Path) -> Iterator[str]:
        """Take faults from the stream that a bench file names; says where it listens, "" where it
        names none.

        Raises InputError where the endpoint cannot be used.
        """
        if settings.endpoint is None:
            yield ""
            return
        keys = link_keys(settings, folder)
        self._stream = FaultStream(
            self.schedule, settings.endpoint, bind=settings.bind, keys=keys, notices=self._notices
        )
        try:
            yield self._stream.endpoint
        finally:
            self._stream.close()

    def summary(self) -> dict[str, Any]:
        """What was on in the run: names and how often each began, frames dropped and frozen, and
        the stream's messages.
        """
        told: dict[str, Any] = {
            "scenario": str(self._scenario.path) if self._scenario.faults else None,
            "started": dict(self._started),
            "missed": dict(self._missed),
            "on": self.schedule.on(),
            "dropped_frames": self.frames.dropped,
            "frozen_frames": self.frames.frozen,
        }
        if self._stream is None:
            return told
        return told | {"stream": self._stream.summary()}


class ReplayedFaults:
    """The faults of an earlier run that is drawn and recorded again. Raises InputError for one
    that cannot be drawn.
    """

    def __init__(
        self, bench: Bench, recording: Recording, ledger: LedgerSwitch | None = None
    ) -> None:
        view = display_view(bench, recording.scenario)
        for fault in recording.faults.values():
            view.prepare(fault)
        self._faults = recording.faults
        self._frame_ns = round(NS_PER_S / bench.config.monitor.refresh_hz)
        self._now: tuple[Now, ...] = ()
        self._started = Counter(
            record.name for record in recording.records if record.event == "start"
        )
        self.frames = FaultyFrames(lambda t_ns: self._now, view)
        if ledger is not None:
            for record in recording.records:
                ledger.fault(record)

    def recall(self, record: FrameRecord) -> None:
        """Take the faults of the frame that is drawn next: those of light, and what freezes it.

        A recorded attitude is the one that was shown: a wrong one is not made wrong again. A
        dropped frame was never recorded.
        """
        recorded = zip(record.faults, record.fault_since_ns, strict=False)
        known = (
            (number, self._faults[number], since_ns)
            for number, since_ns in recorded
            if number in self._faults
        )
        self._now = tuple(
            Now(number, fault, since_ns, share_on(fault, since_ns, self._frame_ns))
            for number, fault, since_ns in known
            if fault.OF_LIGHT or isinstance(fault, Freeze)
        )

    def summary(self) -> dict[str, Any]:
        """What was on in the earlier run, by how often it began, and how many frames stayed."""
        return {"recorded": dict(self._started), "frozen_frames": self.frames.frozen}


AnyFaults = RunFaults | ReplayedFaults
