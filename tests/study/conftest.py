"""Every chart that a study draws in these tests is looked at as it is saved."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hilstar import charts


@pytest.fixture(scope="package", autouse=True)
def every_chart_is_legible() -> Iterator[None]:
    """No text over another or off the canvas, no curve that leaves its axes or has no name: tests/support/figures.py."""
    from tests.support.figures import assert_legible  # brings matplotlib

    save = charts.save

    def looked_at(figure, path: Path) -> None:
        assert_legible(figure)
        save(figure, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts, "save", looked_at)
        yield
