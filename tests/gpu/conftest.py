"""The two ways in which a software OpenGL draws levels: star by star, as it does, and by points, as a graphics card does."""

from __future__ import annotations

import pytest

from hilstar.render.star_passes import StarPasses


@pytest.fixture
def by_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sprites are rasterised and blended."""
    monkeypatch.setattr(StarPasses, "runs_on", staticmethod(lambda *target: False))


@pytest.fixture(params=["star by star", "by points"])
def each_way(request: pytest.FixtureRequest) -> None:
    """Once in each of the two ways."""
    if request.param == "by points":
        request.getfixturevalue("by_points")
