"""The ways of drawing stars that a test asks for; without one it is HILSTAR_DRAW's, or the
machine's own.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hilstar.display.render.backend import Target
from hilstar.display.render.context import gpus
from hilstar.display.render.light_units import LightUnits
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.way import WAY_VARIABLE
from hilstar.optics.psf import GaussianPsf


@pytest.fixture(scope="module")
def gl(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    """A renderer of the module's SIZE, px, and its PSF's SIGMA, which ends without a GL error."""
    target = Target(request.module.SIZE, GaussianPsf(request.module.SIGMA))
    with Renderer(target) as renderer:
        yield renderer
        assert renderer.gl_error() == "GL_NO_ERROR"


@pytest.fixture
def on_llvmpipe() -> None:
    """For what only a software OpenGL does: its threads, its image, the version that it is told
    to give.
    """
    if not (drawn_by := gpus()[0].renderer).startswith("llvmpipe"):
        pytest.skip(f"{drawn_by} draws here")


@pytest.fixture
def by_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sprites are rasterised and blended, as by a graphics card."""
    monkeypatch.setenv(WAY_VARIABLE, "gl")


@pytest.fixture
def by_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy draws the lit pixels of stars, whatever the OpenGL."""
    monkeypatch.setenv(WAY_VARIABLE, "cpu")


@pytest.fixture
def in_no_units(by_points: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sprites are blended as they are, as in frames with extended light: the image that is read
    is the one that is encoded.
    """
    monkeypatch.setattr(LightUnits, "unit_for", lambda units, sprites: None)
