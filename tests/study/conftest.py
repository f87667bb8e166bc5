"""Every chart that a study draws in these tests is looked at as it is saved, and saved as PNG
alone.

That a chart without an ending becomes a PNG and an SVG is held by tests/unit/basics/test_charts.py;
an SVG takes as long as its PNG.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from hilstar.basics import charts
from hilstar.instruments.study.sweep import Load, OtherWork
from tests.support.studies import SmallRun, WholeStudy, times_are_watched

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@pytest.fixture(scope="package", autouse=True)
def idle_machine() -> Iterator[None]:
    """Studies of times take this machine for an idle one; test_other_work.py measures, and
    plants a busy one.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OtherWork, "load", lambda self: Load())
        yield


@pytest.fixture(scope="package", autouse=True)
def every_chart_is_legible() -> Iterator[None]:
    """No text over another or off the canvas, no curve without a name, no figure in a title that is
    not drawn.

    See tests/support/figures.py.
    """
    from tests.support.figures import assert_legible, assert_title_is_drawn  # brings matplotlib

    save = charts.save

    @wraps(save)
    def looked_at(figure, path: Path) -> None:
        save(figure, path if path.suffix in charts.ENDINGS else path.with_name(f"{path.name}.png"))
        assert_legible(figure, drawn=path.suffix != ".svg")
        assert_title_is_drawn(figure, path.stem)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts, "save", looked_at)
        # the figure's own: half the pixels, and texts are measured once
        patch.setattr(charts, "PNG_DPI", 100)
        yield


@pytest.fixture(scope="session")
def whole_study(tmp_path_factory: pytest.TempPathFactory) -> WholeStudy:
    """Runs a study by its command, or reports what one of times has measured. README's command
    leaves out the tests that ask for it, also by a fixture of theirs; a study's own functions are
    held by the others.
    """
    return WholeStudy(tmp_path_factory)


@pytest.fixture(scope="session")
def long_run(small_run: Callable[..., SmallRun]) -> Callable[..., SmallRun]:
    """`small_run` of a study that takes seconds however small it is made: README's command leaves
    out the tests that ask for it.
    """
    return small_run


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., SmallRun]:
    """Runs a study's own function, which takes a folder first, in this process; its charts are
    neither laid out nor written. What makes it small is patched by the test.
    """

    def run(work: Callable[..., object], *arguments: object) -> SmallRun:
        folder = tmp_path_factory.mktemp("small")
        saved: dict[str, Figure] = {}
        with pytest.MonkeyPatch.context() as patch, times_are_watched():
            patch.setattr(charts, "finish", lambda drawn: None)
            patch.setattr(charts, "save", lambda drawn, path: saved.update({path.name: drawn}))
            told = work(folder, *arguments)
        return SmallRun(folder, told, saved)

    return run
