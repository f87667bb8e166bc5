"""The wheel in the newest other Python that this machine has and hilstar takes: a frame, an
exposure, and the facade. README's first command does the same by the system's own: what a Python
between the two took away, the newest lacks too.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import hilstar
from tests.support.benches import ROOT
from tests.support.waiting import INSTALLED_WITHIN_S

HIP_OF_VEGA = 91262
FACADE = """
import hilstar
from hilstar.rotation import from_radec_roll_deg

with hilstar.load("bench.toml") as bench:
    q = from_radec_roll_deg(279.235, 38.785, 0.0)
    frame = bench.frame(q)
    exposure = bench.simulate(q)
    assert frame.to_table()["hip"][0] == 91262
    assert exposure.dn.max() > exposure.dn.min()
    print(hilstar.__version__, dir(hilstar) == sorted([*hilstar.__all__, "__version__"]))
"""


def others() -> dict[str, Path]:
    """The newest Python of each minor version but the one that runs this, by its version."""
    floor = re.search(r"(\d+)\.(\d+)", _project()["requires-python"])
    assert floor is not None
    least = (int(floor[1]), int(floor[2]))
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    named = {path: path.name.removeprefix("python") for path in Path("/usr/bin").glob("python3.*")}
    # another user's, as `su` leaves it in the environment, cannot be read
    if os.access(pyenv, os.X_OK):
        named |= {path: path.parents[1].name for path in pyenv.glob("versions/*/bin/python")}
    found: dict[tuple[int, ...], tuple[tuple[int, ...], Path]] = {}
    for path, version in named.items():
        if re.fullmatch(r"\d+\.\d+(\.\d+)?", version) is None:
            continue
        numbers = tuple(map(int, version.split(".")))
        minor = numbers[:2]
        if minor >= least and minor != sys.version_info[:2]:
            found[minor] = max(found.get(minor, ((), path)), (numbers, path))
    return {".".join(map(str, minor)): path for minor, (_, path) in sorted(found.items())}


def _project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def done(*command, cwd: Path) -> str:
    """What a command prints, which has to end well."""
    apart = ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
    environment = {key: value for key, value in os.environ.items() if key not in apart}
    result = subprocess.run(
        [*map(str, command)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=INSTALLED_WITHIN_S,
        check=False,
        env=environment | {"PIP_NO_COMPILE": "no"},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.skipif(not others(), reason="this machine has no other Python that hilstar takes")
@pytest.mark.parametrize("version", list(others())[-1:])
def test_the_wheel_works_in_another_python(version, tmp_path):
    done(others()[version], "-m", "venv", ".venv", cwd=tmp_path)
    programs = tmp_path / ".venv" / "bin"
    done(programs / "pip", "install", "-q", ROOT, cwd=tmp_path)
    shutil.copy(ROOT / "configs" / "demo.toml", tmp_path / "bench.toml")
    words = ("frame", "bench.toml", "--star", "Vega", "-o", "f.fits", "--json")
    frame = json.loads(done(programs / "hilstar", *words, cwd=tmp_path))
    assert HIP_OF_VEGA in frame["clipped"]
    text = done(programs / "python", "-c", FACADE, cwd=tmp_path)
    assert text == f"{hilstar.__version__} True\n"


def test_the_classifiers_name_each_python_that_is_tested():
    named = {text.rsplit(" ", 1)[1] for text in _project()["classifiers"] if "3." in text}
    assert set(others()) <= named
