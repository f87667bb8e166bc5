"""The faults of an earlier run, from its ledger: each frame has those that it had, as far into their time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from hilstar.bench.faults.desk import Now, share_on
from hilstar.bench.faults.kinds import Fault, Freeze, MeasuredMap, fault_of
from hilstar.bench.faults.scenario import Scenario
from hilstar.bench.faults.surfaces import map_sha256
from hilstar.errors import InputError
from hilstar.reading import NOT_JSON
from hilstar.run.record.ledger_reader import fault_records
from hilstar.run.record.ledger_records import FaultRecord, FrameRecord
from hilstar.units import NS_PER_S


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
        return Scenario(self.folder, "", self.seed, tuple(dict.fromkeys(self.faults.values())), self.folder)


NO_RECORDING = Recording({}, 0, Path())


def read_recording(path: Path) -> Recording:
    """The faults of a run. Raises InputError for damage, and for a measured map that is not the run's any more."""
    faults: dict[int, Fault] = {}
    seed, folder = 0, Path()
    records = tuple(fault_records(path))
    for record in records:
        if record.event != "start":
            continue
        seed, folder = record.seed, Path(record.folder)
        try:
            faults[record.number] = fault = fault_of(msgspec.json.decode(record.table))
        except (*NOT_JSON, InputError) as error:
            raise InputError(f"{path}: the fault {record.name!r} is not one of hilstar's ({error})") from error
        if isinstance(fault, MeasuredMap) and map_sha256(folder / fault.file) != record.file_sha256:
            raise InputError(f"{path}: {folder / fault.file} is not the map that the run had; put that one there")
    return Recording(faults, seed, folder, records)


class RecordedFaults:
    """A source of faults (see `run.faulty_frames.Source`) that is told each frame: its faults of light, and whether it stays.

    A recorded attitude is the one that was shown, so a wrong one is not made wrong again; a dropped frame was never recorded.
    """

    def __init__(self, recording: Recording, refresh_hz: float) -> None:
        self._faults = recording.faults
        self._frame_ns = round(NS_PER_S / refresh_hz)
        self._now: tuple[Now, ...] = ()

    def recall(self, record: FrameRecord) -> None:
        """Take the faults of the frame that is drawn next."""
        found = []
        for number, since_ns in zip(record.faults, record.fault_since_ns, strict=False):
            fault = self._faults.get(number)
            if fault is not None and (fault.OF_LIGHT or isinstance(fault, Freeze)):
                found.append(Now(number, fault, since_ns, share_on(fault, since_ns, self._frame_ns)))
        self._now = tuple(found)

    def at(self, t_ns: int) -> tuple[Now, ...]:
        """The faults of that frame."""
        return self._now
