"""Primaries that are driven apart: each is a grey monitor of its own light, and in `exact` each
makes up for what the others leave.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.exact import Turn
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.render import apart
from hilstar.display.render.numpy_backend import NumpyBackend, headless_context, open_backend
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import SpriteSide, Target
from hilstar.display.render.way import WAY_VARIABLE
from hilstar.display.response import srgb_response
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight, by_primary
from tests.support.stars import sprites_at

SIZE, WHITE, PSF, GREY = (320, 240), 1e6, GaussianPsf((0.85, 0.85)), srgb_response(8)
STEP_PX = 20  # from star to star
PANELS = tuple(Panel(GREY, WHITE * share) for share in (0.3, 0.5, 0.2))
STRIPES_PX = np.array([(-1 / 3, 0), (0, 0), (1 / 3, 0)])
MONO = np.ones((3, 3))  # a tracker of one channel
WAYS = ["cpu", "gl", "no OpenGL"]
CHOICES = 0.03  # of lit pixels: `exact` has ties, as in test_versions.py
FALL = 0.5  # ratio of rms errors; 0.33 by each way


def target_of(quantisation: str, together: np.ndarray = MONO) -> Target:
    return Target(
        SIZE,
        PSF,
        GREY,
        WHITE,
        quantisation,
        primaries=PANELS,
        places_px=STRIPES_PX,
        together=together,
    )


def stars(rng) -> FrameLight:
    grid = np.meshgrid(*(np.arange(STEP_PX, size - STEP_PX, STEP_PX) for size in SIZE))
    places = np.stack(grid, axis=-1).reshape(-1, 2)
    places = places + rng.uniform(-0.5, 0.5, places.shape)
    sprites = sprites_at(places, 10 ** rng.uniform(4, 6, len(places)), PSF.footprint_px)
    light = sprites.data["electrons_per_s"][:, None] * rng.dirichlet([3, 3, 3], len(places))
    return replace(sprites, primaries=light.astype(np.float32))


def levels_of(target: Target, frames: list[FrameLight], way: str, monkeypatch) -> list[np.ndarray]:
    if way != "no OpenGL":
        monkeypatch.setenv(WAY_VARIABLE, way)
    with closing(open_backend(target, None if way == "no OpenGL" else headless_context())) as drawn:
        levels = []
        for number, sprites in enumerate(frames):
            drawn.draw(sprites, number)
            levels.append(drawn.levels().copy())
        assert drawn.fault() == ""
    return levels


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("quantisation", ["round", "dither", "temporal"])
def test_each_primary_is_a_grey_monitor_of_its_light(quantisation, way, rng, monkeypatch):
    target = replace(target_of(quantisation), sides=(SpriteSide(WHITE / 100, 6),))
    frames = [stars(rng), stars(rng)]
    levels = levels_of(target, frames, way, monkeypatch)
    assert levels[0].shape == (*SIZE[::-1], 3)
    for k in range(3):
        alone = [by_primary(sprites, STRIPES_PX, k) for sprites in frames]
        grey = levels_of(target.of_primary(k, Turn()), alone, way, monkeypatch)
        for of_all, of_one in zip(levels, grey, strict=True):
            np.testing.assert_array_equal(of_all[..., k], of_one)
            assert of_one.any()


@pytest.mark.parametrize("way", WAYS)
def test_in_exact_each_makes_up_for_what_those_before_left(way, rng, monkeypatch):
    """Of a tracker of one channel, whose electrons are the sum of all three."""
    sprites = stars(rng)
    errors = []
    for turns in (apart.turns_of, lambda target: dict.fromkeys(range(3), Turn())):
        monkeypatch.setattr(apart, "turns_of", turns)
        levels = levels_of(target_of("exact"), [sprites], way, monkeypatch)[0]
        light = shown_light(levels, Panel(GREY, WHITE, primaries=PANELS))
        rows, columns = (size // STEP_PX - 2 for size in SIZE[::-1])
        half = STEP_PX // 2
        tiles = light[half : half + rows * STEP_PX, half : half + columns * STEP_PX]
        sums = tiles.reshape(rows, STEP_PX, columns, STEP_PX).sum(axis=(1, 3))
        errors.append(sums.ravel() - sprites.primaries.sum(axis=1))
    rms = [float(np.sqrt(np.mean(np.square(error)))) for error in errors]
    assert rms[0] < FALL * rms[1]


@pytest.mark.parametrize("way", ["cpu", "gl"])
@pytest.mark.parametrize("lit", [(0, 1, 2), (0,)], ids=["all", "red alone"])
def test_exact_on_light_that_is_no_star_s_is_as_without_opengl(way, lit, rng, monkeypatch):
    """A primary without such light may be drawn another way than one with it."""
    glow = LightMap(np.full((60, 80), 3e3, dtype=np.float32), (90, 60))
    sprites = stars(rng)
    lights = tuple((glow,) if k in lit else () for k in range(3))
    sprites = replace(sprites, extended=(glow,), lights=lights)
    target = target_of("exact", np.eye(3))
    levels = levels_of(target, [sprites], way, monkeypatch)[0].astype(int)
    oracle = levels_of(target, [sprites], "no OpenGL", monkeypatch)[0]
    assert np.abs(levels - oracle).max() <= 1
    assert np.mean(levels[oracle > 0] != oracle[oracle > 0]) < CHOICES


@pytest.mark.parametrize("lit", [((0, 1, 2), (1, 2)), ((), (0,))], ids=["by NumPy", "by points"])
def test_a_frame_of_exact_hangs_on_no_frame_before(lit, rng, monkeypatch):
    """Red leaves its stars' errors to the others by NumPy, on a glow, or by a compute shader; in
    the second frame it is drawn the other way.
    """
    glow = LightMap(np.full((60, 80), 3e3, dtype=np.float32), (90, 60))
    sprites = stars(rng)
    frames = []
    for lit_now in lit:
        lights = tuple((glow,) if k in lit_now else () for k in range(3))
        frames.append(replace(sprites, extended=(glow,) if lit_now else (), lights=lights))
    target = target_of("exact")
    both = levels_of(target, frames, "gl", monkeypatch)
    alone = levels_of(target, frames[1:], "gl", monkeypatch)
    np.testing.assert_array_equal(both[1], alone[0])


def test_a_backend_of_one_panel_refuses_primaries():
    for kind in (Renderer, NumpyBackend):
        with pytest.raises(ValueError, match="open those of primaries by open_backend"):
            kind(target_of("round"))
