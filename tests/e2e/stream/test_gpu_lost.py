"""A GPU that is lost, or has lost its memory in sleep, ends a run with exit code 3 and a ledger
that can be read.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from hilstar.server.record.ledger_records import EventRecord, run_records
from tests.support.benches import SMALL_BENCH, still_log
from tests.support.commands import run_hilstar_here, run_started
from tests.support.ledgers import read_run
from tests.support.x11.screens import xvfb

# hilstar's command line in which harm is done, once and for real, when the run first looks how long
# the machine has slept.
PLANTED = """
import sys
from hilstar.server.bench import build
from hilstar.cli import run_command
from hilstar.basics.process.scheduling import HostClock
from hilstar.server import watchdog

watchdog.GPU_LOOK_NS = 10**8  # in place of a second
harm, wanted, slept_s = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
benches, looks = [], 0
opened = build.open_bench

def open_bench(*given, **named):
    benches.append(opened(*given, **named))
    return benches[-1]

def do_harm():
    renderer = benches[-1].renderer
    if harm == "table":
        table = renderer.tables[wanted]
        data = bytearray(table.read())
        data[0] ^= 1
        table.write(bytes(data))
    elif harm == "error":
        renderer.context.enable_direct(0x1234)
    elif harm == "reset":
        ask = renderer._driver._reset
        renderer._driver._reset = lambda: ask() or 0x8255

def asleep_ns(clock):
    global looks
    looks += 1
    if looks == 2:
        with benches[-1].renderer.context:
            do_harm()
    return round(slept_s * 1e9) if looks > 1 else 0

HostClock.asleep_ns = asleep_ns
for module in list(sys.modules.values()):  # whoever has imported it already, too
    if getattr(module, "open_bench", None) is opened:
        module.open_bench = open_bench
sys.exit(run_command(sys.argv[4:]))
"""
LOG_S = 1


def harmed_replay(
    folder: Path, harm: str, slept_s: float, table: int = 0, quantisation: str = "round", **more
):
    """`replay --headless` (or with a window) of a log of LOG_S, with harm done in it; its
    ledger.
    """
    bench, ledger = folder / "bench.toml", folder / "run.mcap"
    bench.write_text(SMALL_BENCH + f'\n[render]\nquantisation = "{quantisation}"\n')
    log = still_log(folder / "still.csv", seconds=LOG_S)
    how = more.get("how", "--headless")
    command = ["replay", str(bench), str(log), how, "--json", "--ledger", str(ledger)]
    return (
        run_started(
            [sys.executable, "-c", PLANTED, harm, str(table), str(slept_s), *command],
            env=more.get("env"),
        ),
        ledger,
    )


def events_of(ledger: Path) -> list[str]:
    """The kinds of a ledger's events."""
    return [record.kind for record in run_records(ledger) if isinstance(record, EventRecord)]


def assert_ended_early(ran, ledger: Path, folder: Path, *words: str) -> None:
    """Exit code 3, a line that says why, a summary, and a ledger that says it too and that
    `report` reads.
    """
    assert ran.returncode == 3, ran.stderr
    last = ran.stderr.splitlines()[-1]
    for word in words:
        assert word in last
    assert "Traceback" not in ran.stderr
    summary = json.loads(ran.stdout)
    assert summary["events"]["gpu-lost"] == 1
    run = read_run(ledger)
    assert 0 < len(run.frames) == summary["frames"]
    assert events_of(ledger).count("gpu-lost") == 1
    told = run_hilstar_here("report", ledger, "-o", folder / "report", "--json")
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["frames"] == summary["frames"]


def test_a_table_that_changed_in_sleep_ends_the_run(tmp_path):
    """tests/gpu/test_driver.py holds that a change of any table of any quantisation is seen."""
    ran, ledger = harmed_replay(tmp_path, "table", 60.0, quantisation="exact")
    assert_ended_early(ran, ledger, tmp_path, "memory was lost in sleep, 1 of the tables")
    assert "the machine slept for 60.0 s" in ran.stderr


def test_a_gl_error_ends_the_run(tmp_path):
    ran, ledger = harmed_replay(tmp_path, "error", 0.0)
    assert_ended_early(ran, ledger, tmp_path, "GL_INVALID_ENUM")


def test_a_gpu_that_was_reset_ends_the_run(tmp_path):
    """The status is planted behind the driver's own, which is asked first."""
    ran, ledger = harmed_replay(tmp_path, "reset", 0.0)
    assert_ended_early(ran, ledger, tmp_path, "the GPU is lost", "reset for an unknown reason")


def test_after_a_sleep_that_harmed_nothing_the_run_goes_on(tmp_path):
    ran, ledger = harmed_replay(tmp_path, "nothing", 60.0)
    assert ran.returncode == 0, ran.stderr
    summary = json.loads(ran.stdout)
    assert summary["events"] == {"resumed": 1} | {
        kind: n for kind, n in summary["events"].items() if kind != "resumed"
    }
    assert "gpu-lost" not in summary["events"]
    assert events_of(ledger).count("resumed") == 1


def test_a_window_s_own_table_that_changed_in_sleep_ends_the_run(tmp_path):
    with xvfb(tmp_path) as screen:
        ran, ledger = harmed_replay(
            tmp_path, "table", 60.0, table=-1, how="--windowed", env=screen.env
        )
    assert_ended_early(ran, ledger, tmp_path, "memory was lost in sleep, 1 of the tables")
    # the window's own check of its codes leaves no error
    assert "before the first frame" not in ran.stderr
