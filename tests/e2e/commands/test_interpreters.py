"""The Pythons that this machine has and hilstar takes, by the newest of which README's first command
is followed (test_fresh_checkout.py).
"""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path

from tests.support.benches import ROOT


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


def test_the_classifiers_name_each_python_that_is_tested():
    named = {text.rsplit(" ", 1)[1] for text in _project()["classifiers"] if "3." in text}
    assert set(others()) <= named
