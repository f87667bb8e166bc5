"""The renderer's methods against their NumPy oracles, pixel for pixel, and the texture that a
window would show.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.exact import ExactQuantiser
from hilstar.display.panel import Panel
from hilstar.display.quantise import dither_levels, round_levels, shown_light, turned_mask
from hilstar.display.render.encoder import CUT_WINGS
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import bit_stealing_response, gamma_response, srgb_response
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import random_sprites, sprites_at

SIZE = (256, 192)
SIGMA = (0.85, 0.85)
WHITE = 1e6
# Of pixels that groups of stars light: light is within a few 64ths of a step under a threshold in
# as many of them.
FLIPPED = 0.02
GREY = srgb_response(8)
# of the faintest light that is shown: what light is rounded by where it is drawn star by star
UNIT = 2e-4
RESPONSES = {
    "srgb8": GREY,
    "srgb10": srgb_response(10),
    "gamma12": gamma_response(12),
    "stealing8": bit_stealing_response((GREY, GREY, GREY), (0.2126, 0.7152, 0.0722)),
}
# A GL may round light - low and its product with the threshold once more or less than NumPy: a tie
# is that near.
TIE = 4 * np.finfo(np.float32).eps


def uneven_map(rng) -> np.ndarray:
    return rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32)


def target_of(response, method, uniformity=None) -> Target:
    return Target(SIZE, GaussianPsf(SIGMA), response, WHITE, method, uniformity)


def assert_same_but_for_ties(found, expected, linear, panel):
    """Equal levels; where not, the light is at the mask's threshold within float32."""
    rows, columns = np.nonzero(found != expected)
    if not len(rows):
        return
    light = panel.light_e_per_s().astype(np.float64)
    gain = panel.gain()
    wanted = (linear if gain is None else linear * gain)[rows, columns].astype(np.float64)
    lower = np.minimum(found, expected)[rows, columns].astype(int)
    assert (np.maximum(found, expected)[rows, columns] == lower + 1).all()
    at = turned_mask(0.0)[rows % 64, columns % 64] * (light[lower + 1] - light[lower])
    assert (np.abs(wanted - light[lower] - at) <= TIE * wanted).all()


@pytest.mark.parametrize("response", RESPONSES.values(), ids=RESPONSES)
@pytest.mark.parametrize("count", [150, 8000])
@pytest.mark.parametrize("mapped", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize("method", ["round", "dither"])
@pytest.mark.usefixtures("in_no_units")
def test_levels_are_those_of_the_oracle_pixel_for_pixel(response, count, mapped, method, rng):
    """150 stars take the footprint pass, 8000 the full-screen pass: the levels of one linear
    image are one thing.
    """
    target = target_of(response, method, uneven_map(rng) if mapped else None)
    panel = target.panel()
    with Renderer(target) as gl:
        sprites = random_sprites(count, rng, SIZE, gl.footprint_px)
        gl.draw(sprites)
        linear, levels = gl.linear(), gl.levels().copy()
        oracle = {"round": round_levels, "dither": dither_levels}[method](linear, panel)
        assert (
            levels.dtype == oracle.dtype == (np.uint8 if len(response.light) <= 256 else np.uint16)
        )
        assert_same_but_for_ties(levels, oracle, linear, panel)
        gl.draw(sprites, 6)
        assert np.array_equal(gl.levels(), levels)
        assert gl.gl_error() == "GL_NO_ERROR"
    assert levels.max() == response.white


def test_where_wings_meet_round_leaves_out_no_more_than_it_says(rng):
    """Groups of faint stars and bright ones: a star's light beyond its square is under a 32nd of
    what lights a pixel.
    """
    size, groups, each = (640, 480), 40, 16
    middles = rng.uniform([20, 20], [620, 460], size=(groups, 2))
    pixels = (middles[:, None] + rng.uniform(-8, 8, (groups, each, 2))).reshape(-1, 2)
    light = 10.0 ** rng.uniform(2, 4, groups * each)
    light[:: 4 * each] *= 1e3
    with Renderer(replace(target_of(GREY, "round"), resolution_px=size)) as gl:
        gl.draw(sprites_at(pixels, light, gl.footprint_px))
        panel, found, whole = gl.target.panel(), gl.levels().copy(), gl.linear().copy()
        assert np.array_equal(found, gl.levels())  # to read the whole light leaves the levels
    expected = round_levels(whole, panel)
    left_out = each / CUT_WINGS * GREY.threshold[0] * WHITE
    assert (found <= expected).all()
    assert (found >= round_levels(np.maximum(whole - left_out, 0).astype(np.float32), panel)).all()
    assert np.count_nonzero(found != expected) < FLIPPED * np.count_nonzero(expected)
    assert np.count_nonzero(expected) > 1000


@pytest.mark.parametrize("sigma", [(0.55, 0.55), (0.85, 0.85), (1.3, 0.7)])
def test_a_star_alone_has_the_levels_of_its_whole_light(sigma):
    """At 144 phases, from one that lights no pixel to one that clips."""
    step = GaussianPsf(sigma).footprint_px + 3
    rows, columns = np.mgrid[1:13, 1:13].reshape(2, -1)
    pixels = np.column_stack([columns * step + columns / 12, rows * step + rows / 12])
    with Renderer(Target((60 * step, 15 * step), GaussianPsf(sigma), GREY, WHITE)) as gl:
        gl.draw(sprites_at(pixels, 10.0 ** np.linspace(1.5, 7.5, 144), gl.footprint_px))
        found = gl.levels().copy()
        light, panel = gl.linear(), gl.target.panel()
        assert (found >= round_levels(light * np.float32(1 - UNIT), panel)).all()
        assert (found <= round_levels(light * np.float32(1 + UNIT), panel)).all()
        assert np.count_nonzero(found != round_levels(light, panel)) <= 1
        assert len(np.unique(found)) > 100


# The shader sums in another order and knows erf to 4e-7: of two choices that are nearly as good it
# may take the other.
OTHER_PIXELS = 0.03
A_STAR = 32  # pixels: few stars may have one of them
ERF = 2e-6  # of a star's light: what its pixels may differ by besides a step
OTHER_FLUX_MAG = 2e-3


def apart(count, rng, footprint):
    """Stars of eight decades, each in a tile of its own, some of them over the edge."""
    x, y = np.meshgrid(np.arange(0, 257, 20), np.arange(0, 193, 20))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)[:count] + rng.uniform(
        -4, 4, (min(count, x.size), 2)
    )
    return sprites_at(pixels, 10.0 ** rng.uniform(0, 7, len(pixels)), footprint)


@pytest.mark.parametrize("response", RESPONSES.values(), ids=RESPONSES)
@pytest.mark.parametrize("mapped", [False, True], ids=["even", "uneven"])
def test_exact_levels_are_those_of_its_quantiser(response, mapped, rng):
    target = target_of(response, "exact", uneven_map(rng) if mapped else None)
    panel = target.panel()
    with Renderer(target) as gl:
        for count in (130, 20):
            sprites = apart(count, rng, gl.footprint_px)
            gl.draw(sprites)
            found, oracle = (
                gl.levels(),
                ExactQuantiser(panel, SIZE, GaussianPsf(SIGMA)).levels(sprites),
            )
            assert (found != oracle).sum() <= OTHER_PIXELS * (oracle > 0).sum() + A_STAR
            light = panel.light_e_per_s().astype(float)
            other = np.nonzero(found != oracle)
            step = (
                light[np.maximum(found, oracle)[other]]
                - light[np.maximum(found, oracle)[other] - 1]
            )
            assert (np.abs(light[found] - light[oracle])[other] <= 1.01 * step + ERF * 1e7).all()
            whole = [shown_light(levels, panel).sum() for levels in (found, oracle)]
            assert abs(2.5 * np.log10(whole[0] / whole[1])) < OTHER_FLUX_MAG
        assert gl.levels().max() > 0
        assert gl.gl_error() == "GL_NO_ERROR"


def test_exact_paths_are_those_of_its_quantiser(rng):
    """Streaks of up to 70 sprites, some over the edge: the same flux within a step of each, and
    as good.
    """
    target = target_of(RESPONSES["srgb8"], "exact")
    panel, step = target.panel(), RESPONSES["srgb8"].light[1] * WHITE
    with Renderer(target) as gl:
        nodes = rng.integers(2, 70, 12)
        star = np.repeat(np.arange(12), nodes)
        at = np.concatenate([np.arange(n) - n / 2 for n in nodes])
        angle = rng.uniform(0, np.pi, 12)[star]
        x, y = np.meshgrid(np.arange(4) * 70 + 20.3, np.arange(3) * 70 + 30.6)
        pixels = np.stack(
            [
                x.ravel()[star] + 0.6 * at * np.cos(angle),
                y.ravel()[star] + 0.6 * at * np.sin(angle),
            ],
            axis=1,
        )
        data = sprites_at(pixels, (10.0 ** rng.uniform(4, 6, 12) / nodes)[star], gl.footprint_px)
        sprites = replace(data, star=star, per_star=int(nodes.max()))
        gl.draw(sprites)
        wanted = gl.linear().astype(float)
        for levels in (
            gl.levels().copy(),
            ExactQuantiser(panel, SIZE, GaussianPsf(SIGMA)).levels(sprites),
        ):
            assert abs(shown_light(levels, panel).sum() - wanted.sum()) < 12 * step
            assert (
                np.abs(shown_light(levels, panel) - np.minimum(wanted, WHITE)).max()
                < np.diff(panel.light_e_per_s()).max()
            )
        assert gl.gl_error() == "GL_NO_ERROR"


def test_overlapping_stars_are_exact_together(rng):
    """2000 stars over each other: light as right as that of the oracle, rounding is off by much
    more.
    """
    target = target_of(RESPONSES["srgb8"], "exact")
    panel = target.panel()
    sprites = sprites_at(
        rng.uniform([0, 0], SIZE, (2000, 2)),
        10.0 ** rng.uniform(3.5, 5, 2000),
        GaussianPsf(SIGMA).footprint_px,
    )
    with Renderer(target) as gl:
        gl.draw(sprites)
        wanted, found = gl.linear().astype(float), gl.levels().copy()
    oracle = ExactQuantiser(panel, SIZE, GaussianPsf(SIGMA)).levels(sprites)
    rounded = round_levels(wanted.astype(np.float32), panel)
    blocks = [
        2.5
        * np.log10(block_sums(shown_light(levels, panel)) / block_sums(np.minimum(wanted, WHITE)))
        for levels in (found, oracle, rounded)
    ]
    rms = [float(np.sqrt(np.mean(np.square(block)))) for block in blocks]
    assert rms[0] < 1.5 * rms[1]
    assert rms[0] < 0.7 * rms[2]


def test_temporal_goes_on_while_the_frames_numbers_rise(rng):
    """A number not above the last one's, `begin_anew` and a blank frame begin a sequence; other
    drawings do not.
    """
    with Renderer(target_of(GREY, "temporal")) as gl:
        sprites = random_sprites(60, rng, SIZE, gl.footprint_px)

        def seen(frame):
            gl.draw(sprites, frame)
            return gl.levels().copy()

        first, second, third = (seen(frame) for frame in (3, 4, 9))
        assert not np.array_equal(first, second)
        assert np.array_equal(seen(9), first)
        gl.draw_linear(sprites)
        assert gl.linear().sum() > 0
        assert np.array_equal(seen(10), second)
        gl.begin_anew()
        assert np.array_equal(seen(11), first)
        gl.draw(None, 12)
        assert gl.levels().max() == 0
        assert [
            np.array_equal(seen(frame), codes)
            for frame, codes in ((13, first), (14, second), (15, third))
        ] == [True] * 3
        assert gl.gl_error() == "GL_NO_ERROR"


def block_sums(image, side=16):
    return image.reshape(image.shape[0] // side, side, -1, side).sum(axis=(1, 3))


def test_without_compute_shaders_exact_is_numpy_s(monkeypatch, rng):
    monkeypatch.setattr("hilstar.display.exact.COMPUTE_VERSION", 999)
    target = target_of(RESPONSES["srgb8"], "exact")
    with Renderer(target) as gl:
        for count in (300, 20):
            sprites = random_sprites(count, rng, SIZE, gl.footprint_px)
            gl.draw(sprites)
            assert np.array_equal(
                gl.levels(),
                ExactQuantiser(target.panel(), SIZE, GaussianPsf(SIGMA)).levels(sprites),
            )


def test_exact_and_round_draw_one_sky(rng):
    """Two roads to one image: a pixel of `exact` is within a level of what `round` makes of the
    GPU's light.
    """
    response = RESPONSES["srgb10"]
    with Renderer(target_of(response, "exact")) as gl:
        sprites = random_sprites(60, rng, SIZE, gl.footprint_px)
        gl.draw(sprites)
        rounded = round_levels(gl.linear(), Panel(response, WHITE))
        assert np.abs(gl.levels().astype(int) - rounded).max() <= 1


def on_the_gpu(gl, dtype):
    texture = gl.codes_texture
    with texture.ctx:
        return np.frombuffer(texture.read(alignment=1), dtype=dtype)


@pytest.mark.parametrize("method", ["round", "dither", "temporal", "exact"])
@pytest.mark.parametrize("name", ["srgb8", "stealing8"])
def test_the_texture_on_the_gpu_holds_the_codes(method, name, rng):
    with Renderer(target_of(RESPONSES[name], method)) as gl:
        for count in (200, 3):
            gl.draw(random_sprites(count, rng, SIZE, gl.footprint_px), 5)
            codes = gl.levels().copy()
            texture = on_the_gpu(gl, codes.dtype).reshape(codes.shape)
            assert np.array_equal(texture, codes)
            assert codes.max() > 0
        gl.draw(None)
        assert gl.levels().max() == 0
        assert not on_the_gpu(gl, np.uint8).any()
        assert gl.gl_error() == "GL_NO_ERROR"


def test_beyond_the_footprints_dither_leaves_black(rng):
    with Renderer(target_of(RESPONSES["srgb8"], "dither")) as gl:
        gl.draw(sprites_at(np.array([[100.3, 50.2]]), np.array([1e9]), gl.footprint_px))
        y, x = np.nonzero(gl.levels())
        assert np.abs(x - 100).max() <= gl.footprint_px // 2
        assert np.abs(y - 50).max() <= gl.footprint_px // 2


@pytest.mark.parametrize("method", ["round", "exact"])
def test_a_uniformity_map_of_another_size_is_refused(method):
    with pytest.raises(InputError, match="192 x 256 px and the monitor 256 x 192"):
        Renderer(target_of(GREY, method, np.ones((256, 192), dtype=np.float32)))


def test_a_target_without_a_monitor_has_no_texture():
    with (
        Renderer(Target((32, 32), GaussianPsf(SIGMA))) as gl,
        pytest.raises(TypeError, match="no monitor response"),
    ):
        _ = gl.codes_texture
