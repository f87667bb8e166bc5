"""Which codes a replay draws: those that its machine holds in time, or those of an earlier run."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hilstar.basics.errors import InputError
from hilstar.cli import running
from hilstar.server import replay
from tests.support.benches import still_log
from tests.support.commands import run_hilstar_here


@pytest.mark.parametrize(
    ("paced", "moving", "timed"),
    [(True, None, True), (True, True, False), (False, None, False), (False, True, False)],
)
def test_only_a_paced_log_takes_the_codes_that_its_machine_holds(
    small_bench_file, tmp_path, monkeypatch, paced, moving, timed
):
    """The frames of an earlier run have their own, and a replay as fast as it can is late for
    nothing.
    """
    asked = []
    conventions = SimpleNamespace(scale=None)

    def planned(*given):
        return SimpleNamespace(
            paced=paced, moving=moving, conventions=conventions, first_ns=0, codes_ms=None
        )

    def opened(file, display, *, timed):
        asked.append(timed)
        raise InputError("enough")

    monkeypatch.setattr(replay, "plan_play", planned)
    monkeypatch.setattr(running, "shown_bench", opened)
    log = still_log(tmp_path / "still.csv", seconds=1)
    result = run_hilstar_here("replay", small_bench_file, log, "--headless")
    assert (result.returncode, asked) == (2, [timed]), result.stderr
