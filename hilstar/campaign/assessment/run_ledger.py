"""What a run's ledger says of the commanded attitude, and of the bench that showed it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.bench.bench_file import BenchFile, bench_file_of
from hilstar.bench.config import BenchConfig
from hilstar.campaign.budget.commanded import Commanded
from hilstar.campaign.budget.scale import Scale
from hilstar.errors import InputError
from hilstar.run.record.ledger_reader import NO_FRAMES, config_of, frame_records, read_head
from hilstar.units import NS_PER_S

NOT_SHOWN = (np.nan,) * 4


@dataclass(frozen=True)
class RunLedger:
    """A run: the commanded attitudes, whose times are seconds after `zero_ns` of the sender's clock, and its bench."""

    path: Path
    head: dict[str, str]
    config: BenchConfig
    commanded: Commanded
    zero_ns: int
    frames: int
    not_plain: int

    @property
    def scale(self) -> Scale:
        """The tracker's sizes, by the bench file in the ledger."""
        tracker = self.config.tracker
        width, height = tracker.resolution_px
        return Scale(1e3 * tracker.focal_length_mm / tracker.pixel_pitch_um, (width, height))

    def bench_file(self) -> BenchFile:
        """The bench as it was, by the text in the ledger; what it names has to be where it was. Raises InputError."""
        return bench_file_of(Path(self.head.get("bench_file", "bench.toml")), self.head.get("bench_text", ""))


def read_ledger(path: Path) -> RunLedger:
    """Read a ledger. Raises InputError for a file that is none, for damage, and for a run without attitudes or bench file."""
    head = read_head(path)
    shown: dict[int, tuple[float, ...]] = {}
    not_plain = 0
    for record in frame_records(path):
        plain = record.q is not None and not record.operator and not record.hidden
        not_plain += record.q is not None and not plain
        shown[record.light_ns] = record.q if plain and record.q is not None else NOT_SHOWN
    if not shown:
        raise InputError(f"{path}: {NO_FRAMES}")
    light_ns = np.array(sorted(shown), dtype=np.int64)
    q = np.array([shown[int(t)] for t in light_ns])
    known = int(np.isfinite(q[:, 0]).sum())
    if known < 2:
        why = "operators' keys or a hidden window changed all of them" if not_plain else "none of them has an attitude"
        raise InputError(f"{path}: {len(light_ns)} frames, and {why}; give the ledger of a run that was sent attitudes")
    config = config_of(head)
    if config is None:
        raise InputError(f"{path}: its head holds no bench file that can be read; give the ledger of serve or replay --ledger")
    zero_ns = int(light_ns[0])
    return RunLedger(path, head, config, Commanded((light_ns - zero_ns) / NS_PER_S, q), zero_ns, len(light_ns), not_plain)
