"""Import and first frame in a fresh process, and the machine that the benchmark ran on."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.study.speed.result import Machine, Size, Start

FRESH = """
import re, sys, time
from pathlib import Path
begin = time.perf_counter()
from hilstar import load
imported = time.perf_counter()
import numpy as np
with load(sys.argv[1]) as bench:
    bench.draw(np.array([float(part) for part in sys.argv[2:]])).levels
    drawn = time.perf_counter()
# Not getrusage: its maximum is inherited from the process that started this one.
most_kb = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print((imported - begin) * 1e3, (drawn - imported) * 1e3, int(most_kb) / 1024)
"""


def fresh_start(path: Path, q_icrs_to_cam: FloatArray, size: Size) -> Start:
    """Start a process that imports hilstar and draws one frame of the bench file."""
    command = [sys.executable, "-c", FRESH, str(path), *map(repr, q_icrs_to_cam.tolist())]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    import_ms, first_frame_ms, memory_mb = map(float, done.stdout.split())
    return Start(*size, import_ms, first_frame_ms, memory_mb)


def this_machine() -> Machine:
    """The processor, and the versions of what the times depend on."""
    names = [line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name")]
    return Machine(
        cpu=next(iter(names), platform.machine()),
        cores=len(os.sched_getaffinity(0)),
        load=round(os.getloadavg()[0], 2),
        python=platform.python_version(),
        numpy=np.__version__,
    )


def _cpu_lines() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
