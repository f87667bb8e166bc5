"""The README is true: its sender, its bench file, its Python and its picture."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.support.benches import ROOT
from tests.support.commands import run_hilstar_here
from tests.support.readme import README


def test_the_picture_is_what_the_program_makes(tmp_path):
    script = [sys.executable, ROOT / "tools" / "make_picture.py", tmp_path / "p.png"]
    made = subprocess.run(script, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    ours, theirs = (
        np.array(Image.open(path).convert("L")).astype(int)
        for path in (tmp_path / "p.png", ROOT / "readme.png")
    )
    assert ours.shape == theirs.shape
    # Another driver may round a code the other way: the preview's power of 0.35 makes at most 40
    # grey levels of one, and a code that is written out differs in a hundred pixels of a million.
    # Another field differs in 5000.
    assert (np.abs(ours - theirs) > 40).mean() < 1e-3


COMMANDS = sorted(set(re.findall(r"(?m)^\| [^|]+ \| `hilstar ([^`]+)` \|$", README)))


def test_readme_shows_the_ten_commands_of_a_first_month():
    assert len(COMMANDS) == 10


@pytest.mark.parametrize("words", COMMANDS)
def test_every_command_of_the_readme_is_there_with_its_options(words):
    command = words.split()[0]
    result = run_hilstar_here(command, "--help")
    assert result.returncode == 0, result.stderr
    for option in re.findall(r"--[\w-]+", words):
        assert option in result.stdout


def test_a_row_that_justifies_a_default_is_there():
    """Comments in the code that name a row of the results: the file and the step exist."""
    steps = (ROOT / "results" / "tradeoff.csv").read_text()
    found = 0
    for path in [*(ROOT / "hilstar").rglob("*.py"), *(ROOT / "shaders").rglob("*.frag")]:
        for file, step in re.findall(r"results/(\w+\.csv)(?:, (\w+))?:", path.read_text()):
            assert (ROOT / "results" / file).exists()
            assert not step or f"\n{step}," in steps
            found += 1
    assert found >= 8
