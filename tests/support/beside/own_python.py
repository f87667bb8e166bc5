"""A program of Python in an environment of its own: what it makes of a scenario."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import MachineError


def images_by(
    program: str, package: str, script: Path, scenario: dict[str, Any], folder: Path
) -> dict[str, FloatArray]:
    """A program's images of a scenario, by name: `script` makes them of SCENARIO.json, as IMAGES.npz.

    The environment variable of the program's name in capitals is its Python. Raises MachineError
    where the script does not run there.
    """
    variable = program.upper()
    python = os.environ.get(variable, sys.executable)
    written = folder / f"{program.lower()}.json"
    images = written.with_suffix(".npz")
    written.write_text(json.dumps(scenario))
    ended = subprocess.run(
        [python, str(script), str(written), str(images)],
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode:
        last = ended.stderr.strip().splitlines()[-1]
        raise MachineError(
            f"{program} does not run ({last}); pip install {package} in an environment of its own,"
            f" and give its Python as the environment's {variable}"
        )
    with np.load(images) as arrays:
        return dict(arrays)
