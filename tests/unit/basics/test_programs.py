"""Another program that a command runs: what it prints, and its end with all that it began."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from hilstar.basics.process import programs
from hilstar.basics.process.programs import Child
from tests.support.waiting import wait_for

PATIENCE_S = 20.0


def shell(script: str, **options) -> Child:
    return Child(["/bin/sh", "-c", script], **options)


def test_what_it_prints_and_its_exit_code_are_its_own(tmp_path):
    with shell("pwd; echo '\\377' >&2; read line; exit 3", folder=tmp_path) as child:
        assert child.wait(PATIENCE_S) == 3
        assert (child.out, child.err) == (f"{tmp_path}\n", "\N{REPLACEMENT CHARACTER}\n")
        assert child.poll() == 3 and not child.too_much
    with shell("echo lost; echo kept >&2", keeps_stdout=False) as child:
        assert child.wait(PATIENCE_S) == 0
        assert (child.out, child.err) == ("", "kept\n")


def test_one_that_takes_longer_has_no_exit_code_yet_and_ends_with_all_that_it_began():
    with shell("sleep 600 & echo $!; wait") as child:
        assert child.wait(0.05) is None and child.poll() is None
        wait_for(lambda: child.out.endswith("\n"))
        grandchild = int(child.out)
        os.kill(grandchild, 0)
    assert child.poll() == -9
    wait_for(lambda: not is_alive(grandchild))


def is_alive(process: int) -> bool:
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("where", ["", " >&2"])
def test_one_that_prints_without_end_is_ended_at_the_bound(monkeypatch, where):
    monkeypatch.setattr(programs, "MAX_OUTPUT_BYTES", 100_000)
    begin_s = time.monotonic()
    with shell(f"exec yes{where}") as child:
        assert child.wait(PATIENCE_S) == -9
        assert child.too_much
        assert (len(child.out), len(child.err)) == ((0, 100_000) if where else (100_000, 0))
    assert time.monotonic() - begin_s < PATIENCE_S


def test_what_cannot_be_started_raises_what_the_system_says(tmp_path):
    with pytest.raises(FileNotFoundError):
        Child([str(tmp_path / "none")])
