"""The user's own regression test: it passes on the golden frame's bench, and fails, and says
why, on another sky.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.examples.support import commands, copied, section
from tests.support.commands import run_hilstar_here, run_started
from tests.support.readme import plain_pytest


def test_it_passes_on_the_same_sky_and_fails_on_another(tmp_path, monkeypatch):
    folder = copied(tmp_path)
    monkeypatch.chdir(folder)
    frame, test = commands("A regression test")
    assert run_hilstar_here(*frame[1:]).returncode == 0
    fault = re.search(
        r"With `(focal_length_mm = .*?)`.* `(Not the same sky: .*?)`", section("A regression test")
    )
    assert fault is not None
    wrong = folder / "wrong"
    wrong.mkdir()
    for file in ("test_sky.py", "golden.fits", "golden.csv"):
        shutil.copy(file, wrong)
    bench = Path("bench.toml").read_text()
    assert "focal_length_mm = 350\n" in bench
    (wrong / "bench.toml").write_text(bench.replace("focal_length_mm = 350\n", f"{fault[1]}\n"))

    options = ["--import-mode=importlib", "-p", "no:cacheprovider", "-rA"]
    command = [sys.executable, *test[1:], "wrong/test_sky.py", *options]
    result = run_started(command, env=plain_pytest(folder))
    assert result.returncode == pytest.ExitCode.TESTS_FAILED, result.stdout
    outcomes = {
        name: outcome
        for outcome, name in re.findall(r"(?m)^(PASSED|FAILED) (\S+)::", result.stdout)
    }
    assert outcomes == {"test_sky.py": "PASSED", "wrong/test_sky.py": "FAILED"}
    assert f"AssertionError: {fault[2]}" in result.stdout
