"""The ledger of a run that showed a planted tracker's attitudes, and that tracker's telemetry,
as files.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import msgspec

from hilstar.attitude.logs.mcap_log import RUN_METADATA, McapWriter
from hilstar.basics.arrays import FloatArray
from hilstar.server.record.ledger import TOPICS
from hilstar.server.record.ledger_records import AnswerRecord, FaultRecord, FrameRecord
from tests.support.benches import SMALL_BENCH
from tests.support.planted_tracker import Planted

NS_PER_S = 1_000_000_000


def write_ledger(
    path: Path,
    frames_s: FloatArray,
    frames_q: FloatArray | None,
    start_ns: int = 5 * NS_PER_S,
    records: Sequence[AnswerRecord | FaultRecord] = (),
    bench: str = SMALL_BENCH,
    missed_before: Sequence[int] = (),
    markers: Sequence[int] = (),
) -> Path:
    """A ledger with a frame at each time (n,), s after `start_ns` of the sender's clock, of the
    attitudes (n, 4), or none.

    The sender's clock is the host's; `markers` are the photodiode square's levels, and `records` are written among the frames by their host time.
    """
    written: list[AnswerRecord | FaultRecord | FrameRecord] = []
    waiting = sorted(records, key=lambda each: each.host_ns, reverse=True)
    for number, t_s in enumerate(frames_s.tolist()):
        t_ns = start_ns + round(t_s * NS_PER_S)
        q = None if frames_q is None else tuple(frames_q[number].tolist())
        while waiting and waiting[-1].host_ns <= t_ns:
            written.append(waiting.pop())
        record = FrameRecord(
            frame=number, t_ns=t_ns, light_ns=t_ns, draw_ns=t_ns, swap_ns=t_ns, q=q
        )
        record.missed_before = missed_before[number] if missed_before else 0
        record.marker = markers[number] if markers else None
        written.append(record)
    return write_records(path, written, bench)


def write_records(
    path: Path,
    records: Sequence[AnswerRecord | FaultRecord | FrameRecord],
    bench: str = SMALL_BENCH,
) -> Path:
    """A ledger of these records, in their order."""
    head = {
        "bench_text": bench,
        "bench_file": str(path.parent / "bench.toml"),
        "bench_sha256": "of a test",
    }
    with path.open("wb") as file:
        writer = McapWriter(file.fileno(), TOPICS, RUN_METADATA, head)
        for one in records:
            data = msgspec.json.encode(one)
            if isinstance(one, FrameRecord):
                writer.add("frame", one.swap_ns, data, one.frame)
            else:
                kind = "answer" if isinstance(one, AnswerRecord) else "fault"
                writer.add(kind, one.host_ns, data, 0)
        writer.flush()
        writer.finish()
        os.fsync(file.fileno())
    return path


def write_telemetry(
    path: Path, tau_s: FloatArray, reported: FloatArray, start_s: float = 5.0
) -> Path:
    """Telemetry as CSV; its line k + 2 is answer k."""
    rows = [
        f"{start_s + t:.9f},{w!r},{x!r},{y!r},{z!r},1"
        for t, (w, x, y, z) in zip(tau_s.tolist(), reported.tolist(), strict=True)
    ]
    path.write_text("\n".join(["t_s,qw,qx,qy,qz,valid", *rows]) + "\n")
    return path


def write_run(folder: Path, planted: Planted, bench: str = SMALL_BENCH) -> tuple[Path, Path]:
    """The ledger and the telemetry of a planted run."""
    ledger = write_ledger(folder / "run.mcap", planted.frames_s, planted.frames_q, bench=bench)
    return ledger, write_telemetry(folder / "telemetry.csv", planted.tau_s, planted.reported)
