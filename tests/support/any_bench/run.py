"""The commands of a bench by chance, one after the other; each result is a file, and what is
there is not run again.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.support.any_bench.draw import DrawnBench, drawn_bench, write_bench
from tests.support.any_bench.judge import (
    ASSESS,
    CERTIFY,
    FIRST_LIGHT,
    SEND,
    SERVE,
    TRACKER,
    VERIFY,
    CommandResult,
    row_of,
)

ROOT = Path(__file__).resolve().parents[3]
HILSTAR = (sys.executable, "-m", "hilstar")
ROW, RESULTS, SESSION, LIVE, LEDGER = "row.json", "results", "session", "live.toml", "run.mcap"
LIMIT_S = 1800.0
SERVED_S, TRACKED_S, SENT_S = 20.0, 18.5, 40.0
SEND_HZ = 60
TURN_PX_S, MAX_TURN_DEG_S = 20.0, 0.3  # a slow turn: so many tracker pixels a second
BIAS_PX = (2.0, -1.0, 3.0)  # planted in the virtual tracker
POLL_S = 0.02
MB = 1024.0  # of ru_maxrss, kB


def run_bench(
    seed: int, number: int, folder: Path, limit_s: float = LIMIT_S, *, keep: bool = False
) -> dict[str, Any]:
    """The row of a bench: taken from `folder` where it is there, else of the commands that are
    still to run.
    """
    row_path = folder / ROW
    if row_path.exists():
        return dict(json.loads(row_path.read_text()))
    drawn = drawn_bench(seed, number)
    (folder / RESULTS).mkdir(parents=True, exist_ok=True)
    if not (folder / RESULTS / f"{FIRST_LIGHT}.json").exists() and not (folder / SESSION).exists():
        write_bench(drawn, folder)
    results = _all_results(drawn, folder, limit_s)
    row = {"bench": number, "seed": seed} | row_of(drawn, folder, results)
    _write_whole(row_path, json.dumps(row, indent=1, default=str))
    if not keep:
        shutil.rmtree(folder / SESSION / "images", ignore_errors=True)
        (folder / LEDGER).unlink(missing_ok=True)
    return row


def _write_whole(path: Path, text: str) -> None:
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)


def _all_results(drawn: DrawnBench, folder: Path, limit_s: float) -> dict[str, CommandResult]:
    """All commands; those after a session that failed are not run."""
    virtual = ("--virtual", "truth.toml")
    results = {
        FIRST_LIGHT: _result(
            folder, limit_s, FIRST_LIGHT, "bench.toml", "-o", SESSION, *virtual, "--json"
        )
    }
    session = results[FIRST_LIGHT]
    steps = {step["name"]: step["verdict"] for step in session.found.get("steps", [])}
    if not steps or any(verdict == "failed" for name, verdict in steps.items() if name != "verify"):
        return results
    results[VERIFY] = _result(folder, limit_s, VERIFY, "bench.toml", "--json")
    shutil.rmtree(
        folder / "certificate", ignore_errors=not (folder / RESULTS / f"{CERTIFY}.json").exists()
    )
    results[CERTIFY] = _result(
        folder, limit_s, CERTIFY, "bench.toml", "-o", "certificate", *virtual, "--quick", "--json"
    )
    results |= _live_results(drawn, folder, limit_s)
    if (folder / LEDGER).exists():
        results[ASSESS] = _result(folder, limit_s, ASSESS, LEDGER, "-o", "budget", "--json")
    return results


def _result(folder: Path, limit_s: float, name: str, *words: str) -> CommandResult:
    path = folder / RESULTS / f"{name}.json"
    if path.exists():
        return CommandResult(**json.loads(path.read_text()))
    (one,) = _ended(folder, limit_s, {name: words})
    return one


def _ended(folder: Path, limit_s: float, commands: dict[str, Sequence[str]]) -> list[CommandResult]:
    """Commands that run side by side, the last of them to its end; their results, which are
    written too.
    """
    started_s = time.monotonic()
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    running: dict[str, subprocess.Popen[bytes]] = {}
    for name, words in commands.items():
        with (folder / f"{name}.out").open("wb") as out, (folder / f"{name}.err").open("wb") as err:
            running[name] = subprocess.Popen(
                [*HILSTAR, name, *words], cwd=folder, env=environment, stdout=out, stderr=err
            )
    ended: dict[str, CommandResult] = {}
    stopped: set[str] = set()
    while len(ended) < len(running):
        for name, process in running.items():
            if name in ended:
                continue
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if pid:
                code = os.waitstatus_to_exitcode(status)
                process.returncode = code
                ended[name] = CommandResult(
                    code=None if name in stopped else code,
                    seconds=time.monotonic() - started_s,
                    cpu_s=used.ru_utime + used.ru_stime,
                    memory_mb=used.ru_maxrss / MB,
                    stdout=(folder / f"{name}.out").read_text(errors="replace"),
                    stderr=(folder / f"{name}.err").read_text(errors="replace"),
                    load=os.getloadavg()[0],
                )
            elif time.monotonic() - started_s > limit_s:
                stopped.add(name)
                process.kill()
        time.sleep(POLL_S)
    for name, one in ended.items():
        _write_whole(folder / RESULTS / f"{name}.json", json.dumps(asdict(one)))
        for ending in (".out", ".err"):
            (folder / f"{name}{ending}").unlink()
    return [ended[name] for name in commands]


def _live_results(drawn: DrawnBench, folder: Path, limit_s: float) -> dict[str, CommandResult]:
    """A run with a stream of attitudes and the virtual tracker before it."""
    names = (SERVE, SEND, TRACKER)
    paths = [folder / RESULTS / f"{name}.json" for name in names]
    if all(path.exists() for path in paths):
        return {
            name: CommandResult(**json.loads(path.read_text()))
            for name, path in zip(names, paths, strict=True)
        }
    attitude, frames, answers = (_free_port() for _ in range(3))
    tables = f'\n[attitude]\nendpoint = "tcp://127.0.0.1:{attitude}"\n'
    tables += f'\n[answers]\nsource = "udp"\nclock = "host"\nbind = "127.0.0.1:{answers}"\n'
    (folder / LIVE).write_text((folder / "bench.toml").read_text() + tables)
    px_deg = math.degrees(drawn.detector.pitch_um / 1000 / drawn.detector.focal_mm)
    turn_deg_s = min(TURN_PX_S * px_deg, MAX_TURN_DEG_S)
    bias = ",".join(f"{each * px_deg * 3600:.3f}" for each in BIAS_PX)
    watched = f"tcp://127.0.0.1:{frames}"
    run = (
        LIVE,
        "--headless",
        "--duration",
        str(SERVED_S),
        "--frames",
        watched,
        "--ledger",
        LEDGER,
        "--overwrite",
        "--json",
    )
    spin = (
        "--spin",
        f"0.3,0.5,0.8,{turn_deg_s:.6f}",
        "--radec",
        "84.057,-1.2,0",
        "--rate",
        str(SEND_HZ),
    )
    sent = (
        *spin,
        "--to",
        f"tcp://127.0.0.1:{attitude}",
        "--duration",
        str(SERVED_S),
        "--wait",
        str(SENT_S),
        "--json",
    )
    looks = (
        LIVE,
        "--watch",
        watched,
        "--answer",
        f"udp://127.0.0.1:{answers}",
        "--solver",
        "truth",
    )
    ended = _ended(
        folder,
        limit_s,
        {
            SERVE: run,
            SEND: sent,
            TRACKER: (*looks, "--bias", bias, "--duration", str(TRACKED_S), "--json"),
        },
    )
    return dict(zip(names, ended, strict=True))


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])
