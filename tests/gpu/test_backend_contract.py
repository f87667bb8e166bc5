"""What every backend and the oracle draw of one small scene: stars, maps that hide and add, and a
glow, against closed forms; frames that follow each other; what is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from hilstar.display.quantise import round_levels
from hilstar.display.render.backend import Backend, Target
from hilstar.display.render.numpy_backend import NumpyBackend
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.response import srgb_response
from hilstar.optics.camera import Camera
from hilstar.optics.extended import GlowLight, LightMap
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight
from tests.support.stars import sprites_at

SIZE, SIGMA, WHITE = (70, 50), (0.7, 1.1), 3e5
PSF = GaussianPsf(SIGMA)
CAMERA = Camera(SIZE, 120.0, (20.0, 33.0), np.eye(3))
# at edges and corners, between pixels, one beside the image whose wing is on it
PLACES_PX = np.array(
    [[10.0, 12.5], [10.6, 13.1], [0.2, 49.3], [69.4, 20.0], [-1.2, 30.4], [44.3, 5.0]]
)
RATES = np.array([2e5, 5e4, 1e5, 3e5, 8e5, 9e3])
# of a star's light: what a footprint cuts; llvmpipe's pow is good to 2e-5 of the glow
CUT, GLOW_LIMIT = 1e-4, 1e-4


class PointsRenderer(Renderer):
    """OpenGL draws stars as points, whatever machine it is on."""

    MAY_USE_CPU = False


BACKENDS: list[Callable[[Target], Backend]] = [NumpyBackend, Renderer, PointsRenderer]


def stars_image() -> np.ndarray:
    """Gaussians integrated over each pixel."""

    def shares(size: int, at_px: np.ndarray, sigma: float) -> np.ndarray:
        edges = np.arange(size + 1) - 0.5 - at_px[:, None]
        return np.diff(erf(edges / sigma / np.sqrt(2)), axis=1) / 2

    across = shares(SIZE[0], PLACES_PX[:, 0], SIGMA[0])
    down = shares(SIZE[1], PLACES_PX[:, 1], SIGMA[1])
    return np.einsum("n,nj,ni->ij", RATES, across, down)


def glow_image(peak: float, direction: np.ndarray, scale_rad: float, exponent: float) -> np.ndarray:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([(x - 20.0) / 120, (y - 33.0) / 120, np.ones(SIZE[::-1])], axis=-1)
    cosine = np.minimum(rays @ direction / np.linalg.norm(rays, axis=-1), 1.0)
    return peak * (1 + (np.arccos(cosine) / scale_rad) ** 2) ** (-exponent / 2)


def scene(rng: np.random.Generator) -> tuple[FrameLight, np.ndarray]:
    """A map, over it one that hides a part and sticks out of the image, and a glow between."""
    first = (1e4 * rng.uniform(0, 1, (20, 30))).astype(np.float32)
    second = (1e4 * rng.uniform(0, 1, (12, 16))).astype(np.float32)
    cover = rng.uniform(0, 1, second.shape).astype(np.float32)
    towards = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    lights = (
        LightMap(first, (25, 8), 2.0),
        GlowLight(towards, 4e3, 0.11, 3.0, CAMERA),
        LightMap(second, (45, 40), 0.5, cover),
    )
    image = np.zeros(SIZE[::-1])
    image[8:28, 25:55] += 2.0 * first
    image += glow_image(4e3, towards, 0.11, 3.0)
    image[40:50, 45:61] *= 1 - cover[:10]
    image[40:50, 45:61] += 0.5 * second[:10]
    light = replace(sprites_at(PLACES_PX, RATES, PSF.footprint_px), extended=lights)
    return light, image + stars_image()


def path_of_sprites() -> tuple[FrameLight, np.ndarray]:
    """Each star as two sprites in one place, with a third of its light and the rest."""
    order = np.repeat(np.arange(len(RATES)), 2)
    parts = np.tile([1 / 3, 2 / 3], len(RATES))
    sprites = sprites_at(PLACES_PX[order], RATES[order] * parts, PSF.footprint_px)
    return replace(sprites, star=order, per_star=2), stars_image()


def limit(wanted: np.ndarray) -> float:
    return float(CUT * RATES.max() + GLOW_LIMIT * wanted.max())


@pytest.mark.parametrize("make", BACKENDS)
def test_light_and_levels_are_those_of_closed_forms_frame_by_frame(make, rng):
    """Each frame has its own light: other maps, the same again, none, and blank."""
    frames = [scene(rng), scene(rng)]
    plain = replace(frames[0][0], extended=())
    path = path_of_sprites()
    follow = [*frames, frames[0], (plain, stars_image()), path, (None, np.zeros(SIZE[::-1]))]
    follow += [frames[1], path, (plain, stars_image())]
    backend = make(Target(SIZE, PSF, srgb_response(8), WHITE))
    panel = backend.target.panel()
    for number, (light, wanted) in enumerate(follow):
        backend.draw(light, number)
        levels = backend.levels().astype(int)
        linear = backend.linear().astype(float)
        assert np.abs(linear - wanted).max() <= limit(wanted)
        assert np.mean(levels != round_levels(wanted, panel)) < 5e-3  # those at a threshold
        assert np.abs(levels - round_levels(wanted, panel).astype(int)).max() <= 1
    backend.draw_linear(frames[0][0])
    assert np.abs(backend.linear() - frames[0][1]).max() <= limit(frames[0][1])
    backend.draw(plain, len(follow))
    assert np.abs(backend.linear() - stars_image()).max() <= limit(stars_image())
    assert backend.fault() == ""
    backend.close()


def test_the_oracle_has_the_same_light(rng):
    light, wanted = scene(rng)
    assert np.abs(linear_image(light, SIZE, PSF) - wanted).max() <= CUT * RATES.max()
    wide = linear_image(light, SIZE, PSF, footprint_px=41)
    assert np.abs(wide - wanted).max() <= 1e-9 * wanted.max()


@pytest.mark.parametrize("make", BACKENDS)
def test_a_target_without_a_response_has_light_and_no_levels(make, rng):
    backend = make(Target(SIZE, PSF))
    light, wanted = scene(rng)
    backend.draw(light)
    assert np.abs(backend.linear() - wanted).max() <= limit(wanted)
    with pytest.raises(TypeError, match="no monitor response"):
        backend.levels()
    backend.close()


@pytest.mark.parametrize("make", BACKENDS)
def test_a_sequence_that_begins_anew_is_that_of_a_new_backend(make):
    """`temporal` carries errors from frame to frame: by the number that does not rise, by
    `begin_anew` and by `forget_images` they are gone.
    """
    target = Target(SIZE, PSF, srgb_response(5), WHITE, "temporal")
    light = sprites_at(PLACES_PX, RATES, PSF.footprint_px)

    def levels(backend: Backend, numbers: list[int]) -> list[np.ndarray]:
        drawn = []
        for number in numbers:
            backend.draw(light, number)
            drawn.append(backend.levels().copy())
        return drawn

    new = levels(make(target), [4, 5, 6])
    assert any((each != new[0]).any() for each in new[1:])  # errors are carried on
    backend = make(target)
    levels(backend, [2, 3])
    carried_on = levels(backend, [4, 5, 6])
    assert any((mine != other).any() for mine, other in zip(carried_on, new, strict=True))
    assert (levels(backend, [6])[0] == new[0]).all()  # the last number does not rise, either
    again = levels(backend, [4, 5, 6])  # 4 is below the last number
    assert all((mine == other).all() for mine, other in zip(again, new, strict=True))
    for begin_anew in (backend.begin_anew, backend.forget_images):
        levels(backend, [2, 3])
        begin_anew()
        again = levels(backend, [4, 5, 6])
        assert all((mine == other).all() for mine, other in zip(again, new, strict=True))
    backend.close()


@pytest.mark.parametrize("make", [NumpyBackend, Renderer])
def test_each_frame_of_exact_stands_by_itself(make):
    """Whatever errors the frames before it left, it is that of a new backend."""
    target = Target(SIZE, PSF, srgb_response(5), WHITE, "exact")
    light = sprites_at(PLACES_PX, RATES, PSF.footprint_px)
    brighter = sprites_at(PLACES_PX, 1.013 * RATES, PSF.footprint_px)
    new = make(target)
    new.draw(light)
    wanted = new.levels().copy()
    new.close()
    backend = make(target)
    for number, before in enumerate((brighter, light, light)):
        backend.draw(before, number)
    assert (backend.levels() == wanted).all()
    backend.close()


def test_extended_light_of_another_frame_is_dithered_by_that_frame_s_turn(rng):
    """A glow that stands still under stars: a frame that begins anew is that of a new backend,
    whatever was drawn before it.
    """
    light, _ = scene(rng)
    target = Target(SIZE, PSF, srgb_response(5), WHITE, "temporal")
    with Renderer(target) as backend:
        backend.draw(light, 0)
        backend.begin_anew()
        backend.draw(light, 5)
        drawn = backend.levels().copy()
    with Renderer(target) as new:
        new.draw(light, 5)
        assert (drawn == new.levels()).all()


@pytest.mark.parametrize("make", BACKENDS)
def test_primaries_that_are_driven_apart_are_no_backend_s_own(make):
    panel = Target(SIZE, PSF, srgb_response(8), WHITE).panel()
    with pytest.raises(ValueError, match="open those of primaries by open_backend"):
        make(Target(SIZE, PSF, srgb_response(8), WHITE, primaries=(panel,) * 3))
