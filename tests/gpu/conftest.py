"""The two ways in which a software OpenGL draws levels: star by star, as it does, and by points,
as a graphics card does.
"""

from __future__ import annotations

import pytest

from hilstar.display.render.context import gpus
from hilstar.display.render.star_passes import LightUnits


@pytest.fixture
def on_llvmpipe() -> None:
    """For what only a software OpenGL does: its threads, its image, the version that it is told
    to give.
    """
    if not (drawn_by := gpus()[0].renderer).startswith("llvmpipe"):
        pytest.skip(f"{drawn_by} draws here")


@pytest.fixture
def by_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sprites are rasterised and blended."""
    monkeypatch.setattr(
        "hilstar.display.render.renderer.computes_in_software", lambda context: False
    )


@pytest.fixture
def in_no_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sprites are blended as they are, as in frames with extended light: the image that is read
    is the one that is encoded.
    """
    monkeypatch.setattr(LightUnits, "takes", staticmethod(lambda *target: False))


@pytest.fixture(params=["star by star", "by points"])
def each_way(request: pytest.FixtureRequest) -> None:
    """Once in each of the two ways."""
    if request.param == "by points":
        request.getfixturevalue("by_points")
