"""Processor time and memory against stars, pixels, workers, packets a second and hours: python -m
tests.benchmarks.bench_scale.

Writes results/scale.csv, and the tracker's rows of `hilstar benchmark` with a first frame as
results/tracker.csv; `python results/charts.py` draws both. Each point is a process of its own, so
that its peak of memory is its own. Times are of the processor, which other work on the machine
changes least. Takes about ten minutes on two busy cores.
With `ledger RUN.mcap HOURS` it only writes a ledger as its reports are timed with: a day's is 1.3
GB and takes 8 minutes.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.basics.charts import write_csv
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.study.speed.benchmark import FRESH, RADEC_ROLL_DEG, own_bench_file, scene
from hilstar.instruments.study.speed.tracker import tracker_rows
from hilstar.server.bench.build import open_bench
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import FrameRecord
from hilstar.server.record.run_figures import figures_of
from tests.support.benches import ROOT

HILSTAR = (sys.executable, "-m", "hilstar")
FULL_HD = (1920, 1080)
STARS = (100, 1000, 10_000, 50_000, 200_000, 400_000, 1_000_000)
SIZES = ((640, 480), (1024, 1024), FULL_HD, (3840, 2160), (7680, 4320))
PACKETS_HZ, HOURS, WORKERS, CASES = (
    (10, 100, 1000, 10_000),
    (1 / 60, 0.1, 0.5, 2.0),
    (1, 2),
    (20, 420),
)
SECONDS, ROUNDS = 8.0, 15
FRAME_HZ, AXIS = 60, np.array([0.36, 0.48, 0.8])


def spent(*command: str) -> tuple[str, float]:
    """What a process of its own prints, and the seconds of processor time that it takes, its
    children's included.
    """
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        told = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert not process.returncode
    return told, used.ru_utime + used.ru_stime


def peak_mb() -> float:
    """The peak of this process's memory. Not getrusage's, which is inherited from the process
    that started this one.
    """
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def frame(width: int, height: int, stars: int) -> tuple[float, float]:
    """The processor time, ms, of a frame in `round` with so many stars in view, and the peak of
    memory, MB.
    """
    q = from_radec_roll_deg(*RADEC_ROLL_DEG)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench(own_bench_file(Path(folder) / "bench.toml", (width, height))) as one,
    ):
        shown = scene(one, one.shown_stars, q, stars, np.random.default_rng(1))
        bench, times = one.with_stars(shown.stars), []
        for _ in range(ROUNDS):
            begin = time.process_time()
            assert bench.draw(q).levels.any()
            times.append(time.process_time() - begin)
    return float(np.median(times)) * 1e3, peak_mb()


def report(path: str) -> tuple[float, float]:
    """The processor time, ms, of reading a run's ledger, and the peak of memory, MB, without
    processes beside this one.
    """
    begin = time.process_time()
    assert figures_of(Path(path)).counted["frames"]
    return (time.process_time() - begin) * 1e3, peak_mb()


class StepLedger(Ledger):
    """A ledger whose writer makes a pass when it is told to, not five times a second by the
    clock.
    """

    def _run(self) -> None:
        """Leave the passes to `turn`."""

    def turn(self, last: bool = False) -> None:
        """What the writer's thread does in one pass."""
        self._turn(last)


def write_ledger(path: Path, seconds: float) -> None:
    """A run's ledger of FRAME_HZ frames and as many packets a second, as its recorder writes it,
    on a clock that is stepped.
    """
    rng, count, now_ns = np.random.default_rng(1), round(seconds * FRAME_HZ), 10**12
    clock = SimpleNamespace(
        monotonic=lambda: now_ns / 1e9, monotonic_ns=lambda: now_ns, time_ns=time.time_ns
    )
    noise_ns = rng.integers(0, 10**5, (count, 2)).tolist()
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench(own_bench_file(Path(folder) / "bench.toml", FULL_HD)) as bench,
        patch("hilstar.server.record.ledger.time", clock),
        StepLedger(path, bench) as ledger,
    ):
        for k, (late_ns, age_ns) in enumerate(noise_ns):
            now_ns, turn = 10**12 + k * 10**9 // FRAME_HZ, 1e-4 * k
            q, swap_ns, sent_ns = (
                np.array([np.cos(turn), *np.sin(turn) * AXIS]),
                now_ns + late_ns,
                now_ns - 8_000_000 - age_ns,
            )
            sample, at_ns = AttitudeSample(sent_ns, q, 2e-4 * FRAME_HZ * AXIS, k), sent_ns + 400_000
            ledger.packet(at_ns, encode(sample), sample, None)
            times = {
                "t_ns": now_ns,
                "light_ns": now_ns,
                "draw_ns": now_ns - 5_000_000,
                "swap_ns": swap_ns,
            }
            known = {
                "attitude_sequence": k,
                "attitude_t_ns": sent_ns,
                "receive_ns": at_ns,
                "prediction_ns": now_ns - sent_ns,
            }
            ledger.frame(
                FrameRecord(
                    frame=k,
                    **times,
                    **known,
                    age_ns=now_ns - sent_ns,
                    q=tuple(q.tolist()),
                    stars_drawn=160 + k % 9,
                )
            )
            if k % (FRAME_HZ // 5) == 0:
                ledger.turn()
        ledger.turn(last=True)


def served(rate_hz: int) -> tuple[float, float]:
    """The packets a second that `serve` took, and the share of a core that it used, %."""
    with tempfile.TemporaryDirectory() as folder:
        bench = own_bench_file(Path(folder) / "bench.toml", (640, 480))
        text = (
            bench.path.read_text()
            + '\n[attitude]\nsource = "zmq"\nendpoint = "tcp://127.0.0.1:5598"\n'
        )
        bench.path.write_text(text)
        options = (
            "--rate",
            str(rate_hz),
            "--duration",
            str(SECONDS + 4),
            "--to",
            "tcp://127.0.0.1:5598",
        )
        sender = subprocess.Popen(
            (*HILSTAR, "send", "--spin", "z,0.1", *options), stdout=subprocess.DEVNULL
        )
        try:
            told, seconds = spent(
                *HILSTAR,
                "serve",
                str(bench.path),
                "--headless",
                "--json",
                "--duration",
                str(SECONDS),
            )
        finally:
            sender.terminate()
            sender.wait()
    run = json.loads(told)
    return run["packets"]["accepted"] / SECONDS, 100 * seconds / SECONDS


def case_ms(workers: int) -> float:
    """The time that a case takes each of so many workers, from the difference of a long and a
    short campaign.
    """
    used = []
    for cases in CASES:
        with tempfile.TemporaryDirectory() as folder:
            plan = Path(folder) / "plan.toml"
            plan.write_text(
                f'bench = "{ROOT / "configs" / "demo.toml"}"\ncases = {cases}\nseed = 1\n'
            )
            command = (
                "campaign",
                str(plan),
                "-o",
                str(Path(folder) / "out"),
                "--workers",
                str(workers),
                "--json",
            )
            begin_s = time.monotonic()
            spent(*HILSTAR, *command)
            used.append(time.monotonic() - begin_s)
    return workers * (used[1] - used[0]) / (CASES[1] - CASES[0]) * 1e3


def measured() -> list[tuple[str, float, float, float]]:
    """Rows: the axis, the place on it, and the two figures that its works give (nan: none)."""
    this = (sys.executable, "-m", "tests.benchmarks.bench_scale")
    rows = []

    def add(axis: str, at: float, values: tuple[float, float]) -> None:
        rows.append((axis, at, *values))
        print(*rows[-1], flush=True)

    for axis, points in (
        ("stars", [(*FULL_HD, n) for n in STARS]),
        ("pixels", [(*size, 1000) for size in SIZES]),
    ):
        for width, height, stars in points:
            told, _ = spent(*this, "frame", *map(str, (width, height, stars)))
            add(axis, stars if axis == "stars" else width * height, tuple(json.loads(told)))
    for workers in WORKERS:
        add("workers", workers, (case_ms(workers), np.nan))
    for rate_hz in PACKETS_HZ:
        taken_hz, share = served(rate_hz)
        add("packets", taken_hz, (share, np.nan))
    for hours in HOURS:
        with tempfile.TemporaryDirectory() as folder:
            write_ledger(Path(folder) / "run.mcap", 3600 * hours)
            add(
                "hours",
                hours,
                tuple(json.loads(spent(*this, "report", str(Path(folder) / "run.mcap"))[0])),
            )
    return rows


def first_frame_ms() -> list[float]:
    """The processor time of processes that import hilstar and draw a frame of the benchmark's
    bench, and end.
    """
    with tempfile.TemporaryDirectory() as folder:
        bench = own_bench_file(Path(folder) / "bench.toml", FULL_HD)
        q = map(repr, from_radec_roll_deg(*RADEC_ROLL_DEG).tolist())
        command = (sys.executable, "-c", FRESH, str(bench.path), *q)
        return sorted(1e3 * spent(*command)[1] for _ in range(5))


def main() -> None:
    match sys.argv[1:]:
        case ["frame", *values]:
            print(json.dumps(frame(*map(int, values))))
        case ["report", path]:
            print(json.dumps(report(path)))
        case ["ledger", path, hours]:
            write_ledger(Path(path), 3600 * float(hours))
        case []:
            results = ROOT / "results"
            tracker, _ = tracker_rows(ROUNDS, 30.0)
            table = [
                (r.width, r.height, r.stars, r.method, r.kind, r.ms.median, r.ms.min, r.ms.max)
                for r in tracker
            ]
            first = first_frame_ms()
            table.append((*FULL_HD, 0, "hilstar", "first_frame", first[2], first[0], first[-1]))
            columns = (
                "width",
                "height",
                "stars",
                "method",
                "kind",
                "median_ms",
                "min_ms",
                "max_ms",
            )
            write_csv(results / "tracker.csv", columns, table)
            write_csv(results / "scale.csv", ("axis", "at", "time", "memory_mb"), measured())


if __name__ == "__main__":
    main()
