"""README's first command, as it stands, in a folder that has only what git has; and what it
installed, without that folder.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from importlib import metadata
from pathlib import Path

import pytest

from tests.support.benches import ROOT
from tests.support.licences import UNKNOWN, is_copyleft, licence_of
from tests.support.readme import blocks
from tests.support.waiting import INSTALLED_WITHIN_S, PATIENCE_S

FILES = ("pyproject.toml", "README.md", "LICENSE", "hilstar", "shaders", "configs")
# For pip: packages are not compiled ahead, which takes longer than all that the demo then imports
# ("no" turns it off).
ENVIRONMENT = {"PIP_NO_COMPILE": "no"}


def clean_environment() -> dict[str, str]:
    """Without what would lead Python back to this checkout."""
    return {
        key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")
    } | ENVIRONMENT


def shape(text: str) -> str:
    """The lines with every figure and name that differs from machine to machine made alike."""
    text = re.sub(r"(?m)^(renderer|verdict) .*$", r"\1", text)
    return re.sub(r"-?\d+(\.\d+)?", "N", text)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder after the command (apt, a new environment, a wheel with all it depends on, the
    demo), and what was printed.
    """
    folder = tmp_path_factory.mktemp("checkout")
    for name in FILES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    result = subprocess.run(
        ["sh", "-c", blocks("sh")[0]], cwd=folder, capture_output=True, text=True, timeout=INSTALLED_WITHIN_S, check=False,
        env=clean_environment(), stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder, result.stdout


def test_the_first_command_does_the_main_job_in_a_fresh_checkout(checkout):
    folder, out = checkout
    assert shape(out[out.index("frames  ") :]) == shape(blocks("text")[0])
    assert len(list((folder / "hilstar-demo").glob("frame_*_codes.png"))) == 4


def test_nothing_that_pip_pulled_is_under_the_gpl(checkout):
    folder, _ = checkout
    [packages] = (folder / ".venv" / "lib").glob("python*/site-packages")
    licences = {
        each.metadata["Name"]: licence_of(each)
        for each in metadata.distributions(path=[str(packages)])
    }
    assert "hilstar" in licences
    assert {
        name: licence
        for name, licence in licences.items()
        if licence == UNKNOWN or is_copyleft(licence)
    } == {}


def test_the_installed_wheel_runs_the_demo_without_the_checkout(checkout, tmp_path):
    """Shaders, configs and data are inside the wheel."""
    folder, _ = checkout
    for name in FILES:
        (folder / name).rename(tmp_path / name)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def printed(*command: str | Path) -> str:
        done = subprocess.run(
            command,
            cwd=elsewhere,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
            env=clean_environment(),
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    programs = folder / ".venv" / "bin"
    shown = json.loads(printed(programs / "hilstar", "demo", "--duration", "2", "--json"))
    assert shown["frames"] > 0 and shown["stars_drawn"]["mean"] > 50
    assert len(list((elsewhere / "hilstar-demo").glob("*_codes.png"))) == 4
    assert str(folder / ".venv") in printed(
        programs / "python", "-c", "import hilstar; print(hilstar.__file__)"
    )
