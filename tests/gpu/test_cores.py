"""Which cores the threads of a software OpenGL are kept on; a process's first context begins
them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

LOOK = """
import json, os, time
from pathlib import Path
{before}
from hilstar.display.render.context import create_context
create_context()
def tasks():
    found = [task for task in Path("/proc/self/task").iterdir() if int(task.name) != os.getpid()]
    return [((task / "comm").read_text().strip(), sorted(os.sched_getaffinity(int(task.name)))) for task in found]
end_s = time.monotonic() + 60
while time.monotonic() < end_s:  # until the driver's threads have named themselves
    names = [name for name, _ in tasks() if ":" not in name]
    if 2 * sum(name.startswith("llvmpipe-") for name in names) == len(names):
        break
    time.sleep(0.02)
print(json.dumps(tasks()))
"""
# On a busy machine a thread that has begun has no name of its own for some time: here for the first
# fifty looks at it.
NAMED_LATE = """
from hilstar.basics.process import scheduling as cores
threads, looks = cores._threads, iter(range(10**9))
cores._threads = lambda: {each: name if next(looks) > 50 * len(threads()) else "python" for each, name in threads().items()}
"""
ALL = sorted(os.sched_getaffinity(0))


def threads(before: str = "", **environment: str) -> list[tuple[str, list[int]]]:
    """Names of a new process's threads and the cores that they may run on."""
    run = [sys.executable, "-c", LOOK.format(before=before)]
    # a campaign here has set it
    own = {name: value for name, value in os.environ.items() if name != "LP_NUM_THREADS"}
    env = own | {"OPENBLAS_NUM_THREADS": "1"} | environment
    return json.loads(
        subprocess.run(run, capture_output=True, check=True, env=env, text=True).stdout
    )


@pytest.mark.usefixtures("on_llvmpipe")
@pytest.mark.parametrize("before", ["", NAMED_LATE], ids=["at once", "named late"])
def test_each_has_one_and_each_core_has_one_that_rasterises_and_one_that_computes(before):
    """Where there are as many threads as cores: one core has nothing to part, and llvmpipe
    begins so many at most.
    """
    found = [(name, cores) for name, cores in threads(before) if ":" not in name]
    rasterisers = [cores for name, cores in found if name.startswith("llvmpipe-")]
    others = [cores for name, cores in found if not name.startswith("llvmpipe-")]
    apart = [[core] for core in ALL] if 2 <= len(ALL) <= 16 else [ALL] * len(rasterisers)
    assert sorted(rasterisers) == sorted(others) == apart


@pytest.mark.parametrize(
    ("before", "environment"),
    [("", {"LP_NUM_THREADS": "1"}), (f"os.sched_setaffinity(0, {{{ALL[0]}}})", {})],
    ids=["one thread", "one core"],
)
def test_where_threads_and_cores_are_not_as_many_they_stay_where_they_may(before, environment):
    """Several processes of one thread each would all be kept on the first core."""
    allowed = [ALL[0]] if before else ALL
    found = threads(before, **environment)
    # the driver's own for its files is elsewhere
    assert all(cores == allowed for name, cores in found if ":" not in name)
