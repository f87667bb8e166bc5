"""The notebook: its cells run in order in one namespace, and its plots show a sky that the
catalogue agrees with.
"""

from __future__ import annotations

import json
import re

import matplotlib
import numpy as np
import pytest

from tests.examples.support import EXAMPLES, copied, section

# of 1: five standard errors of a standard deviation of 126 errors, 1 / sqrt(2 * 126)
SIGMA_TOLERANCE = 0.3


@pytest.fixture
def cells() -> list[str]:
    notebook = json.loads((EXAMPLES / "bench_to_plot.ipynb").read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    # None is kept, so that none is stale.
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    sources = ["".join(cell["source"]) for cell in code]
    # the facade alone: no command, no module of hilstar's
    assert re.findall(r"hilstar\.\w+|subprocess", " ".join(sources)) == ["hilstar.load"]
    return sources


def test_its_cells_run_from_the_bench_file_to_the_plots(tmp_path, monkeypatch, capsys, cells):
    matplotlib.use("agg")
    from matplotlib import pyplot

    monkeypatch.chdir(copied(tmp_path))
    names: dict[str, object] = {}
    try:
        for number, cell in enumerate(cells):
            exec(compile(cell, f"cell {number}", "exec"), names)
        figures = [pyplot.figure(number) for number in pyplot.get_fignums()]
        for figure in figures:
            figure.canvas.draw()
        assert [len(figure.axes) for figure in figures] == [2, 2]
    finally:
        pyplot.close("all")

    errors = np.asarray(names["error_mag"]) / np.asarray(names["sigma_mag"])
    assert len(errors) > 100
    assert abs(errors.mean()) < 5 / np.sqrt(len(errors))
    assert abs(errors.std() - 1) < SIGMA_TOLERANCE
    last_line = capsys.readouterr().out.splitlines()[-1]
    assert f"`{last_line}`" in section("A notebook")
