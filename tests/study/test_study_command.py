"""`hilstar study`: in a process of its own, and what it refuses."""

from __future__ import annotations

import csv

import numpy as np
from PIL import Image

from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def assert_drawn(path):
    """A picture with more than a frame in it."""
    pixels = np.array(Image.open(path).convert("L"))
    assert pixels.shape[0] > 300
    assert ((pixels < 200).mean() > 0.005) and ((pixels > 250).mean() > 0.1)


def test_the_thesis_s_outputs_are_drawn(tmp_path):
    result = run_hilstar("study", "outputs", "-o", tmp_path)
    assert result.returncode == 0, result.stderr
    for name, least in (("orion", 500), ("lyra", 100), ("rosetta", 50)):
        assert_drawn(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.fits").is_file()
        assert len(table(tmp_path / f"{name}.csv")) > least


def test_an_unwritable_directory_and_an_unknown_study_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(run_hilstar_here("study", "models", "-o", tmp_path / "file" / "x"), 2, "cannot be written")
    assert_refused(run_hilstar_here("study", "weather", "-o", tmp_path), 2, "weather")
    assert_refused(run_hilstar_here("study", "models"), 2, "-o")
