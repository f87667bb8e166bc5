"""README's first command, as it stands, in a folder that has only what git has; and what it
installed, without that folder.

It is followed by the newest other Python that this machine has and hilstar takes, where there is
one: the system's own installs hilstar for all other tests, and what a Python between the two took
away, the newest lacks too.
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

import hilstar
from tests.e2e.commands.test_interpreters import others
from tests.support.benches import ROOT
from tests.support.licences import UNKNOWN, is_copyleft, licence_of
from tests.support.readme import blocks
from tests.support.waiting import INSTALLED_WITHIN_S, PATIENCE_S

FILES = ("pyproject.toml", "README.md", "LICENSE", "hilstar", "shaders", "configs")
# For pip: packages are not compiled ahead, which takes longer than all that the demo then imports
# ("no" turns it off).
ENVIRONMENT = {"PIP_NO_COMPILE": "no"}
HIP_OF_VEGA = 91262
FACADE = """
import hilstar
from hilstar.basics.resources import resource_path
from hilstar.rotation import from_radec_roll_deg

with hilstar.load(resource_path("configs", "demo.toml")) as bench:
    q = from_radec_roll_deg(279.235, 38.785, 0.0)
    frame = bench.frame(q)
    exposure = bench.simulate(q)
    assert frame.to_table()["hip"][0] == 91262
    assert exposure.dn.max() > exposure.dn.min()
    assert dir(hilstar) == sorted([*hilstar.__all__, "__version__"])
    print(hilstar.__version__, hilstar.__file__)
"""


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
    environment = clean_environment()
    for newest in list(others().values())[-1:]:
        programs = tmp_path_factory.mktemp("python")
        (programs / "python3").symlink_to(newest)
        environment["PATH"] = f"{programs}:{environment['PATH']}"
    result = subprocess.run(
        ["sh", "-c", blocks("sh")[0]], cwd=folder, capture_output=True, text=True, timeout=INSTALLED_WITHIN_S, check=False,
        env=environment, stdin=subprocess.DEVNULL,
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


def test_the_installed_wheel_draws_without_the_checkout(checkout, tmp_path):
    """A frame by the command and its shaders, and a frame and an exposure by the facade: shaders,
    configs and data are inside the wheel.
    """
    folder, _ = checkout
    for name in FILES:
        (folder / name).rename(tmp_path / name)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def printed(*command: str | Path, **environment: str) -> str:
        done = subprocess.run(
            command,
            cwd=elsewhere,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
            env=clean_environment() | environment,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    programs = folder / ".venv" / "bin"
    words = (tmp_path / "configs" / "demo.toml", "--star", "Vega", "-o", "f.fits", "--json")
    frame = json.loads(printed(programs / "hilstar", "frame", *words, HILSTAR_DRAW="gl"))
    assert HIP_OF_VEGA in frame["clipped"] and frame["gl_renderer"] != "NumPy"
    version, path = printed(programs / "python", "-c", FACADE).split()
    assert version == hilstar.__version__ and path.startswith(str(folder / ".venv"))
    of_python = Path(path).relative_to(folder / ".venv" / "lib").parts[0]
    for newest in list(others())[-1:]:
        assert of_python == f"python{newest}"
