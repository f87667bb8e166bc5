"""The renderer on a real OpenGL against the NumPy oracle, in flux, centroid and code."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.display.render import context as context_module
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import SpriteSide, Target
from hilstar.display.response import encode, srgb_response
from hilstar.optics.psf import MAX_CUT, GaussianPsf
from hilstar.optics.sprites import FrameLight
from tests.support.claims import holds
from tests.support.stars import sprites_at

# Of whole images of a few stars; a star's own light and place are claims.
FLUX_LIMIT = 1e-5
# A pixel's error relative to its star's flux: erf in float32 (sigma 0.4 px here) is at most 4.4e-7
# off and the polynomials of wider sprites 1e-7, so a share along one axis is too, and
# the other axis's share is 1 at most. Measured: 7e-8.
PIXEL_LIMIT = 2 * 4.4e-7
# Blending n stars in float32 rounds n times: for the few that overlap here.
BLEND_LIMIT = 1e-6


# A linear image beside codes is rasterised; alone, it is drawn on the CPU where that draws stars
# (cpu_stars.py).
BOTH_WAYS = pytest.mark.parametrize("bits", [8, None], ids=["beside codes", "alone"])


def draw(
    target: Target, pixels: np.ndarray, electrons_per_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, FrameLight]:
    with Renderer(target) as gl:
        assert gl.gl_error() == "GL_NO_ERROR"
        sprites = sprites_at(pixels, electrons_per_s, gl.footprint_px)
        gl.draw(sprites)
        linear, codes = gl.linear().copy(), None if target.response is None else gl.levels().copy()
        assert gl.gl_error() == "GL_NO_ERROR"
    return linear, codes, sprites


def plain_target(resolution=(256, 192), sigma=(0.85, 0.85), bits=8, white=1e6) -> Target:
    return Target(
        resolution, GaussianPsf(sigma), None if bits is None else srgb_response(bits), white
    )


@pytest.mark.parametrize(("per_star", "is_small"), [(1, True), (4, False)])
def test_a_fainter_star_s_square_is_by_the_light_of_its_whole_path(by_points, per_star, is_small):
    """Four sprites in one place: of stars below the side's rate, or of one star above it."""
    target = replace(plain_target((60, 40), bits=None), sides=(SpriteSide(1e4, 5),))
    places_px = np.tile([30.2, 20.4], (4, 1))
    sprites = sprites_at(places_px, np.full(4, 4e3), target.psf.footprint_px)
    sprites = replace(sprites, per_star=per_star, star=np.arange(4) // per_star)
    with Renderer(target) as gl:
        gl.draw(sprites)
        linear = gl.linear()
        assert linear[18:23, 28:33].all()
        assert (linear[:, 33].any(), linear[23].any()) == (not is_small, not is_small)


@BOTH_WAYS
@pytest.mark.parametrize(
    "sigma",
    [(0.4, 0.4), (0.55, 0.55), (0.85, 0.85), (1.3, 0.7), (0.5, 2.5), (3.0, 3.0), (10.0, 10.0)],
)
def test_an_isolated_star_has_its_flux_and_its_centroid_at_every_phase(sigma, bits):
    """A grid of 12 x 12 phases of a pixel, each star in a field of its own."""
    step = GaussianPsf(sigma).footprint_px + 3
    phases = np.linspace(-0.5, 0.5, 12)
    rows, columns = np.mgrid[0:12, 0:12]
    pixels = np.column_stack(
        ((columns * step + step).ravel() + phases[columns.ravel()], (rows * step + step).ravel())
    )
    pixels[:, 1] += phases[rows.ravel()]
    flux = 10.0 ** np.linspace(1, 9, 144)
    side = 14 * step
    linear, _, _ = draw(plain_target((side, side), sigma, bits), pixels, flux)
    off_flux, off_px = [], []
    for (x, y), f in zip(pixels, flux, strict=True):
        left, top = round(x) - step // 2, round(y) - step // 2
        patch = linear[top : top + step, left : left + step].astype(np.float64)
        off_flux.append(abs(patch.sum() / f - 1))
        centroid_x = patch.sum(axis=0) @ np.arange(left, left + step) / patch.sum()
        centroid_y = patch.sum(axis=1) @ np.arange(top, top + step) / patch.sum()
        # The centroid of the exact, infinite image is not the star itself but within 1e-4 px for
        # sigma >= 0.4 ...
        off_px.append(abs(centroid_x - exact_centroid(x, sigma[0])))
        off_px.append(abs(centroid_y - exact_centroid(y, sigma[1])))
    for sigma_px in sigma:
        holds("sigmas", sigma_px)
    # The footprint's cut (1e-6) is the most of both.
    holds("linear-flux", max(off_flux))
    holds("linear-centroid", max(off_px))


def exact_centroid(x: float, sigma: float) -> float:
    """... but for the sampling of a narrow Gaussian by pixels, which this sum over all pixels has exactly."""
    cdf = NormalDist(x, sigma).cdf
    pixels = range(round(x) - 60, round(x) + 61)
    return sum(p * (cdf(p + 0.5) - cdf(p - 0.5)) for p in pixels)


@BOTH_WAYS
@pytest.mark.parametrize("sigma", [(0.3, 0.3), (0.85, 0.85), (1.7, 0.6), (10.0, 10.0)])
def test_every_pixel_is_that_of_the_oracle(sigma, bits, rng):
    pixels = rng.uniform([-5, -5], [260, 197], size=(60, 2))
    flux = 10.0 ** rng.uniform(2, 6, 60)
    linear, _, sprites = draw(plain_target(sigma=sigma, bits=bits), pixels, flux)
    oracle = linear_image(sprites, (256, 192), GaussianPsf(sigma))
    # Where stars overlap, each brings its own error.
    scale = (
        linear_image(
            replace(sprites, data=sprites.data),
            (256, 192),
            GaussianPsf((sigma[0] * 1.5, sigma[1] * 1.5)),
        )
        + flux.max()
    )
    assert (np.abs(linear - oracle) / scale).max() < PIXEL_LIMIT
    assert linear.min() >= 0


@BOTH_WAYS
def test_stars_partly_off_the_edge_are_drawn_partly(bits):
    pixels = np.array(
        [
            [-0.5, 50.0],
            [-3.0, 90.0],
            [100.0, -0.5],
            [255.5, 60.0],
            [258.0, 20.0],
            [130.0, 193.5],
            [-0.5, -0.5],
        ]
    )
    flux = np.full(len(pixels), 1e6)
    linear, _, sprites = draw(plain_target(bits=bits), pixels, flux)
    oracle = linear_image(sprites, (256, 192), GaussianPsf((0.85, 0.85)))
    assert np.abs(linear - oracle).max() < PIXEL_LIMIT * 1e6
    # A star on the very edge gives half its light, one on the corner a quarter.
    assert linear[40:60, :10].sum() == pytest.approx(0.5e6, rel=FLUX_LIMIT)
    assert linear[:10, :10].sum() == pytest.approx(0.25e6, rel=FLUX_LIMIT)
    assert linear[80:100, :10].sum() > 100


def test_the_footprint_cuts_no_more_than_it_says():
    for sigma in ((0.4, 0.4), (0.85, 0.85), (3.0, 1.0)):
        size = GaussianPsf(sigma).footprint_px
        for phase in (-0.5, -0.25, 0.0, 0.4999, 0.5):
            sprite = sprites_at(np.array([[100 + phase, 80 + phase]]), np.ones(1), size)
            cut = linear_image(
                sprite, (256, 192), GaussianPsf(sigma), footprint_px=2 * size + 9
            ).sum()
            kept = linear_image(sprite, (256, 192), GaussianPsf(sigma)).sum()
            assert 0 <= cut - kept <= MAX_CUT * 1.000001


@pytest.mark.parametrize("bits", [6, 8, 10, 12, 16])
@pytest.mark.parametrize("count", [150, 8000])
@pytest.mark.usefixtures("in_no_units")
def test_codes_are_those_of_the_oracle_pixel_for_pixel(bits, count, rng):
    """150 stars take the footprint pass, 8000 the full-screen pass: the codes of one linear
    image are one thing.
    """
    pixels = rng.uniform([-5, -5], [260, 197], size=(count, 2))
    flux = 10.0 ** rng.uniform(1, 7, count)
    target = plain_target(bits=bits)
    linear, codes, _ = draw(target, pixels, flux)
    assert codes.dtype == (np.uint8 if bits <= 8 else np.uint16)
    assert np.array_equal(codes, encode(linear, target.response, target.flux_at_white_e_per_s))
    assert codes.max() == 2**bits - 1


@BOTH_WAYS
def test_overlapping_stars_add_up(bits, rng):
    pixels = np.full((1000, 2), 100.25) + rng.normal(scale=0.01, size=(1000, 2))
    linear, _, sprites = draw(plain_target(bits=bits), pixels, np.ones(1000))
    oracle = linear_image(sprites, (256, 192), GaussianPsf((0.85, 0.85)))
    # 1000 additions round by up to half a step of the running sum each: 1000 x 6e-8 at the very
    # worst.
    assert np.abs(linear - oracle).max() / oracle.max() < 6e-5
    assert linear.sum(dtype=np.float64) == pytest.approx(1000, rel=6e-5)


@BOTH_WAYS
def test_a_hundred_thousand_stars_are_drawn(bits, rng):
    count = 100_000
    pixels = rng.uniform([20, 20], [1004, 748], size=(count, 2))
    linear, _, _ = draw(plain_target((1024, 768), bits=bits), pixels, np.ones(count))
    assert linear.sum(dtype=np.float64) == pytest.approx(count, rel=BLEND_LIMIT + MAX_CUT)


@BOTH_WAYS
def test_twelve_decades_of_flux_stand_side_by_side(bits):
    pixels = np.array([[50.0, 50.0], [150.0, 100.0]])
    linear, _, _ = draw(plain_target(bits=bits), pixels, np.array([1e12, 1.0]))
    assert linear[30:70, 30:70].sum(dtype=np.float64) == pytest.approx(1e12, rel=FLUX_LIMIT)
    assert linear[80:120, 130:170].sum(dtype=np.float64) == pytest.approx(1.0, rel=FLUX_LIMIT)


def test_nothing_remains_of_the_frame_before(rng):
    target = plain_target()
    with Renderer(target) as gl:
        many = sprites_at(rng.uniform(0, 190, size=(6000, 2)), np.full(6000, 1e6), gl.footprint_px)
        few = sprites_at(np.array([[30.3, 40.4]]), np.array([1e6]), gl.footprint_px)
        gl.draw(few)
        alone = gl.linear().copy(), gl.levels().copy()
        gl.draw(many)
        gl.draw(few)
        assert np.array_equal(gl.linear(), alone[0])
        assert np.array_equal(gl.levels(), alone[1])
        gl.draw(None)
        assert gl.linear().max() == 0
        assert gl.levels().max() == 0
        gl.draw(few)
        gl.draw(replace(few, data=few.data[:0]))
        assert gl.levels().max() == 0
        assert gl.gl_error() == "GL_NO_ERROR"


@pytest.mark.parametrize("read", [False, True], ids=["unread", "light is read between"])
def test_frames_of_any_number_of_stars_follow_each_other(read, rng):
    """Few are erased one by one, more by a clear, and those that cover the image by the pass
    itself.
    """
    size = (640, 480)
    with Renderer(plain_target(size)) as gl, Renderer(plain_target(size)) as fresh:
        for count in (3, 40, 2, 9000, 1, 300, 9000, 0, 40, 300, 2, 0, 3):
            sprites = sprites_at(
                rng.uniform([0, 0], size, size=(count, 2)), np.full(count, 1e6), gl.footprint_px
            )
            gl.draw(sprites)
            if read:
                gl.linear()
            fresh.draw(None)
            fresh._last_count = None  # all of its images is cleared
            if fresh._cpu_stars is not None:
                fresh._cpu_stars.forget()
            fresh.draw(sprites)
            assert np.array_equal(gl.levels(), fresh.levels())
            if read:
                assert np.array_equal(gl.linear(), fresh.linear())


def test_two_renderers_live_side_by_side():
    pixels = np.array([[30.3, 40.4]])
    with Renderer(plain_target()) as a, Renderer(plain_target((64, 64), bits=12)) as b:
        for _ in range(3):
            a.draw(sprites_at(pixels, np.array([1e6]), a.footprint_px))
            b.draw(sprites_at(pixels, np.array([2e6]), b.footprint_px))
            assert a.linear().sum() == pytest.approx(1e6, rel=FLUX_LIMIT)
            assert b.linear().sum() == pytest.approx(2e6, rel=FLUX_LIMIT)
            assert a.levels().shape == (192, 256)
            assert b.levels().shape == (64, 64)


def test_a_sprite_larger_than_the_driver_s_points_is_refused():
    with pytest.raises(InputError, match="sprite_sigma_px"):
        Renderer(plain_target(sigma=(400.0, 400.0)))


def test_a_monitor_larger_than_the_driver_s_textures_is_refused():
    with pytest.raises(InputError, match="resolution_px"):
        Renderer(plain_target((32768, 64)))


def test_a_machine_without_egl_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(context_module, "EGL_LIBRARY", "libEGL.so.none")
    with pytest.raises(MachineError, match="apt-get install libegl1 libgl1-mesa-dri"):
        Renderer(plain_target())
