"""`hilstar demo` without its run, which is the test's: how long it is, what is written of it, and
what is said of a sky that stood still.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from hilstar.attitude.receiver import PacketCounts
from hilstar.server import demo
from hilstar.server.replay import DrawnBy
from hilstar.server.summary import RunTally
from tests.support.commands import run_hilstar_here

RENDERER: Any = DrawnBy("none", "none", "NumPy")
CODES = np.zeros((3, 4), np.uint16)


class Demos:
    """The runs that were asked for, each of 100 frames, some of them stale."""

    def __init__(self, stale: int) -> None:
        self.asked: list[tuple[float, demo.Shows]] = []
        tally = RunTally()
        for _ in range(100):
            tally.add(1_000_000, 0, 3, ())
        summary = tally.summary(2.0, PacketCounts(received=5), RENDERER)
        self._summary = replace(summary, stale_frames=stale)

    def run(self, directory: Any, duration_s: float, shows: demo.Shows, watching: Any) -> demo.Demo:
        directory.mkdir(exist_ok=True)
        self.asked.append((duration_s, shows))
        return demo.Demo(self._summary, {7: CODES, 90: CODES}, 8)


@pytest.mark.parametrize(("stale", "code"), [(0, 0), (3, 1)])
def test_a_demo_writes_its_pictures_and_a_sky_that_stood_still_is_no_success(
    tmp_path, monkeypatch, stale, code
):
    demos = Demos(stale)
    monkeypatch.setattr(demo, "run_demo", demos.run)
    done = run_hilstar_here("demo", "-o", "out", "--duration", "2", cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        f"frame_{number}_{kind}.png" for number in ("0007", "0090") for kind in ("codes", "preview")
    }
    assert "writing 2 pictures and their previews to out" in done.stderr
    last = [line for line in done.stdout.splitlines() if line][-1]
    assert last.startswith("stale sky           3 of 100 frames" if stale else "pictures    ")
    done = run_hilstar_here(
        "demo", "-o", "out", "--duration", "2", "--seed", "2", "--json", cwd=tmp_path
    )
    assert done.returncode == code and json.loads(done.stdout)["stale_frames"] == stale
    assert ("hilstar: 3 of 100 frames show an old sky" in done.stderr) is bool(stale)
    (seconds, first), (_, second) = demos.asked
    assert seconds == 2.0 and first.bench_file.name == "demo.toml"
    # attitudes go on for a second, and then rest: none of a run's frames is without
    assert first.samples[-1].t_ns == round((3.0 + demo.REST_S) * 1e9)
    apart = [
        np.abs(one.q_icrs_to_cam - other.q_icrs_to_cam).max()
        for one, other in zip(first.samples, second.samples, strict=True)
    ]
    assert 0 < max(apart) < 1e-3  # another seed is another jitter, and the same slew


def test_a_demo_is_ten_seconds_long_unless_it_is_told(tmp_path, monkeypatch):
    demos = Demos(0)
    monkeypatch.setattr(demo, "run_demo", demos.run)
    run_hilstar_here("demo", "--json", cwd=tmp_path)
    assert demos.asked[0][0] == 10.0 and (tmp_path / "hilstar-demo").is_dir()
