"""A quantisation that the package does not have: a class, a shader and a row in QUANTISERS, and
everything draws by it.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.arrays import Float32Array
from hilstar.display.exact import ExactQuantiser
from hilstar.display.footprints import PixelOrder
from hilstar.display.panel import Panel
from hilstar.display.quantise import PixelQuantiser, level_dtype
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.numpy_backend import NumpyBackend
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Levels, srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.effort import Light, plan_effort
from hilstar.server.replay import OTHER_CODES_BY_NUMPY
from tests.support.stars import random_sprites, sprites_at

SIZE = (256, 192)
PSF = GaussianPsf((0.85, 0.85))
WHITE = 1e6
FRAMES = 4
TIES = 1e-4  # of lit pixels
# Of lit pixels: of two choices of a star that are nearly as good the shader may take the other.
# Measured 0.011, and 0.39 from the levels of `exact`.
OTHER_CHOICE = 0.03
SHADER = """
uniform int turn;

bool rises(ivec2 pixel, float light, float low, float high) {
    return light - low > 0.25 * (float((pixel.x + 2 * pixel.y + turn) & 3) + 0.5) * (high - low);
}
"""


class OrderedQuantiser(PixelQuantiser):
    """Ordered dither by four thresholds along each row, which take turns: the mean of four
    frames is right to an eighth.
    """

    words = "ordered dither."

    def levels(self, linear_e_per_s: Float32Array, number: int = 0) -> Levels:
        panel, light = self._panel, self._panel.light_e_per_s()
        gain = panel.gain()
        wanted = linear_e_per_s if gain is None else linear_e_per_s * gain
        lower = np.searchsorted(light[1:], wanted, side="right")
        y, x = np.indices(wanted.shape)
        threshold = np.float32(0.25) * (
            ((x + 2 * y + number) & 3).astype(np.float32) + np.float32(0.5)
        )
        step = light[np.minimum(lower + 1, panel.response.white)] - light[lower]
        more = (lower < panel.response.white) & (wanted - light[lower] > threshold * step)
        return Levels((lower + more).astype(level_dtype(panel.response)))

    @classmethod
    def lit_from_e_per_s(cls, panel: Panel) -> float:
        return float(panel.response.light[1]) * panel.flux_at_white_e_per_s / 8

    @classmethod
    def uniforms(cls, number: int) -> dict[str, float]:
        return {"turn": number}

    @classmethod
    def exposure(cls, before: int, count: int) -> range:
        return range(before, before + count)


class CarelessQuantiser(ExactQuantiser):
    """`exact`, but however faint a star is, all pixels within reach are chosen among."""

    words = "exact, with all pixels within reach."

    @classmethod
    def fewest(cls, order: PixelOrder) -> int:
        return order.near


@pytest.fixture(autouse=True)
def rows(tmp_path, monkeypatch):
    """The two rows, and the shader of the first."""
    (tmp_path / "ordered.glsl").write_text(SHADER)
    monkeypatch.setattr(OrderedQuantiser, "shader", str(tmp_path / "ordered.glsl"))
    monkeypatch.setitem(QUANTISERS, "ordered", OrderedQuantiser)
    monkeypatch.setitem(QUANTISERS, "careless", CarelessQuantiser)


@pytest.mark.parametrize("mapped", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize("count", [150, 8000], ids=["under sprites", "whole image"])
def test_a_new_pixel_quantiser_draws_its_oracle_s_levels_in_each_frame(count, mapped, rng):
    """Pixel for pixel, but for light within float32 of a threshold, which a GL may round
    otherwise: none was seen.
    """
    uniformity = rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32) if mapped else None
    target = Target(SIZE, PSF, srgb_response(8), WHITE, "ordered", uniformity)
    oracle, sprites, drawn = (
        OrderedQuantiser(target.panel(), SIZE, PSF),
        random_sprites(count, rng, SIZE, PSF.footprint_px),
        [],
    )
    with Renderer(target) as gl:
        for number in range(FRAMES):
            gl.draw(sprites, number)
            drawn.append(gl.levels().copy())
            found = oracle.levels(gl.linear(), number)
            assert np.count_nonzero(drawn[-1] != found) <= TIES * np.count_nonzero(found)
    assert (drawn[0] != drawn[1]).any()


def test_a_new_star_quantiser_draws_its_oracle_s_levels(rng):
    """Stars apart; `exact` itself has other levels."""
    target = Target(SIZE, PSF, srgb_response(8), WHITE, "careless")
    x, y = np.meshgrid(np.arange(10, 256, 20), np.arange(10, 192, 20))
    places = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-4, 4, (x.size, 2))
    sprites = sprites_at(places, 10.0 ** rng.uniform(3, 5, x.size), PSF.footprint_px)
    with Renderer(target) as gl:
        gl.draw(sprites)
        levels = gl.levels().copy()
    found, exact = (
        kind(target.panel(), SIZE, PSF).levels(sprites)
        for kind in (CarelessQuantiser, ExactQuantiser)
    )
    assert np.count_nonzero(levels != found) <= OTHER_CHOICE * np.count_nonzero(found)
    assert np.count_nonzero(levels != exact) > 10 * OTHER_CHOICE * np.count_nonzero(found)


@pytest.mark.parametrize("method", ["ordered", "careless"])
def test_numpy_draws_and_effort_judges_a_new_quantisation(method, rng):
    target = Target(SIZE, PSF, srgb_response(8), WHITE, method)
    backend, sprites = NumpyBackend(target), random_sprites(40, rng, SIZE, PSF.footprint_px)
    backend.draw(sprites, 1)
    with Renderer(target) as gl:
        gl.draw(sprites, 1)
        lit = np.count_nonzero(gl.levels())
        assert np.count_nonzero(backend.levels() != gl.levels()) <= OTHER_CODES_BY_NUMPY * lit
    light = Light(
        srgb_response(8), WHITE, 5e6 * 10 ** (-0.4 * np.linspace(0, 4, 50)), exposure_frames=FRAMES
    )
    new, rounded = (
        plan_effort(RenderSettings(quantisation=each), light) for each in (method, "round")
    )
    assert new.quantisation == method and new.error_px < rounded.error_px
