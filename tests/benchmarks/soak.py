"""Memory over a long run at 200 packets and 60 frames a second: python -m tests.benchmarks.soak
[SECONDS] [BENCH.toml].

The growth a day is a straight line through the memory that the run's own ledger recorded each
second, without its first fifth. Its error is that of the line's slope over blocks of a twentieth,
whose rests are not alike from second to second.
The ledger's index of chunks grows too, and ends at 16 MB: it is said beside.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from hilstar.server.record.ledger_records import ProcessRecord, run_records
from tests.support.benches import ROOT

HILSTAR = (sys.executable, "-m", "hilstar")
WARM_UP, BLOCKS = 0.2, 16
DAY_S = 86400.0


def growth_mb_a_day(seconds: np.ndarray, megabytes: np.ndarray) -> tuple[float, float]:
    """The slope of memory over time, MB a day, and its standard error by the means of blocks."""
    time_s, memory_mb = (
        np.array([part.mean() for part in np.array_split(each, BLOCKS)])
        for each in (seconds, megabytes)
    )
    (slope, _), covariance = np.polyfit(time_s, memory_mb, 1, cov=True)
    return slope * DAY_S, float(np.sqrt(covariance[0, 0])) * DAY_S


def main(
    seconds: float = 3600.0, bench: str = str(ROOT / "configs" / "monitor-10bit.toml")
) -> None:
    """Run, and print the run's figures and its growth."""
    with tempfile.TemporaryDirectory() as folder:
        ledger = Path(folder) / "run.mcap"
        sender = subprocess.Popen(
            (*HILSTAR, "send", "--spin", "y,0.5", "--rate", "200", "--duration", str(seconds + 60))
        )
        serve = (
            *HILSTAR,
            "serve",
            bench,
            "--headless",
            "--duration",
            str(seconds),
            "--ledger",
            str(ledger),
            "--json",
        )
        try:
            run = json.loads(subprocess.run(serve, stdout=subprocess.PIPE, check=True).stdout)
        finally:
            sender.terminate()
        kept = [record for record in run_records(ledger) if isinstance(record, ProcessRecord)]
        time_s = np.array([record.host_ns for record in kept]) * 1e-9
        memory_mb = np.array([record.resident_bytes for record in kept]) * 1e-6
        warm = time_s > time_s[0] + WARM_UP * seconds
        slope, error = growth_mb_a_day(time_s[warm], memory_mb[warm])
        print(
            {name: run[name] for name in ("frames", "missed_frames", "stale_frames") if name in run}
        )
        print(
            f"memory {memory_mb[warm].min():.1f} to {memory_mb[warm].max():.1f} MB; {slope:+.1f} +-"
            f" {error:.1f} MB a day"
        )
        with ledger.open("rb") as file:
            summary = make_reader(file).get_summary()
        index_bytes = sum(
            77 + 10 * len(chunk.message_index_offsets) for chunk in summary.chunk_indexes
        )
        print(f"of it the ledger's index {index_bytes / 1e6 / seconds * DAY_S:.1f} MB a day")
        print(
            f"ledger {ledger.stat().st_size / 1e6:.1f} MB,"
            f" {ledger.stat().st_size / 1e9 / seconds * DAY_S:.2f} GB a day"
        )


if __name__ == "__main__":
    main(*(kind(word) for kind, word in zip((float, str), sys.argv[1:], strict=False)))
