"""What a command imports before it does anything: half a second of a start is imports, and each
has to be wanted.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.waiting import PATIENCE_S

# What single commands, files and plots need, and no bench: each costs 15 to 250 ms.
HEAVY = {"asyncio", "astropy", "matplotlib", "mcap", "rich", "scipy.special", "unittest"}
# What no frame of stars alone needs: 3 to 12 ms each.
OF_SOME_FRAMES = {
    "hilstar.attitude.wire.packet",
    "numpy.ma",
    "numpy.random",
    "hilstar.display.render.disc_tiles",
    "hilstar.optics.trails",
    "scipy",
}
FIRST_FRAME = """import sys, hilstar
with hilstar.load(sys.argv[1]) as bench:
    bench.draw((1.0, 0.0, 0.0, 0.0)).levels
print(*sys.modules)"""


def imported_by(module: str) -> set[str]:
    """The modules that a new process has after it imported one."""
    return modules_after(f"import sys, {module}; print(*sys.modules)")


def modules_after(program: str, *words: str) -> set[str]:
    """The modules that a program says."""
    command = [sys.executable, "-c", program, *words]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    return set(result.stdout.split())


@pytest.mark.parametrize(
    "module", ["hilstar.cli", "hilstar.server.bench.build", "hilstar.server.send_log"]
)
def test_nothing_heavy_is_imported_before_it_is_used(module):
    assert not imported_by(module) & HEAVY


def test_the_process_that_reads_a_link_imports_no_numpy():
    """That is half of what its start would cost."""
    assert "numpy" not in imported_by(
        "hilstar.attitude.wire.apart_child, hilstar.attitude.wire.zmq_links"
    )


def test_a_run_imports_before_its_first_frame_what_some_frames_need():
    assert {"scipy.special", "hilstar.display.render.disc_tiles"} <= imported_by(
        "hilstar.server.loop"
    )


def test_the_first_frame_of_stars_alone_imports_nothing_that_only_others_need():
    assert not modules_after(FIRST_FRAME, "configs/demo.toml") & OF_SOME_FRAMES


def test_a_run_begins_no_other_process_by_what_it_imports():
    """As the own search of glfw would, whose process says a traceback where a signal ends the
    start-up meanwhile.
    """
    program = (
        "import sys; sys.addaudithook(lambda name, _: print(name) if name == 'subprocess.Popen'"
        " else None)\n"
    )
    program += "import hilstar.cli.serve, hilstar.server.screen.gate; print('glfw' in sys.modules)"
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYGLFW")
    }
    result = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
        env=environment,
    )
    assert result.stdout == "True\n"
