"""`temporal` on the GPU: its aims there, the same as the oracle frame by frame, and frames that
NumPy draws in between.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.balance import SUMS
from hilstar.display.exact import Left
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.render.way import WAY_VARIABLE
from hilstar.display.response import srgb_response, table_response
from hilstar.display.temporal import TemporalQuantiser
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf
from tests.support.star_tiles import SIDE, SIGMA, SIZE, WHITE, flux_of, places, stars, tiles

FRAMES = 6
AIM_MAG = 0.003  # as in tests/unit/display/test_temporal.py
# The shader sums in another order and knows erf to 4e-7: of two choices that are nearly as good it
# may take the other.
OTHER_PIXELS = 0.03
LEFT = 0.02
UNEVEN = np.random.default_rng(5).uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32)


def flux_mag(shown, wanted):
    return float(
        np.sqrt(np.mean(np.square(2.5 * np.log10(shown.sum((1, 2)) / wanted.sum((1, 2))))))
    )


def test_errors_that_are_set_are_those_of_the_next_frame_s_beginning(rng):
    """As a sequence that goes on elsewhere hands them over: each star's own."""
    target = Target((40, 30), GaussianPsf(SIGMA), srgb_response(8), WHITE, "temporal")
    error = rng.normal(size=(SUMS, 7)).astype(np.float32)
    with Renderer(target) as gl:
        gl.draw(stars(np.array([20.0]), np.array([15.0]), np.array([1e5])), 0)
        gl.levels()
        with gl.context:
            assert gl._exact_pass.left.star.tolist() == [0]
            gl._exact_pass.left = Left(np.arange(7) * 3, error)
            left = gl._exact_pass.left
    assert left.star.tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert np.array_equal(left.error, error)


@pytest.mark.parametrize("uniformity", [None, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("bits", [1, 8])
def test_a_frame_is_the_oracle_s_after_the_same_frame_before(bits, uniformity):
    """Each frame begins with what the GPU's last one left; some stars go and come, and are half
    off the image.
    """
    target = Target(
        SIZE,
        GaussianPsf(SIGMA),
        table_response(bits, np.linspace(0, 1, 2**bits)),
        WHITE,
        "temporal",
        uniformity,
    )
    panel, rng = target.panel(), np.random.default_rng(3)
    x, y = places()
    every = stars(x, y - 11, 10 ** rng.uniform(4, 6.5, len(x)))
    oracle = TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA))
    with Renderer(target) as gl:
        for frame in range(6):
            keep = rng.random(len(every)) < 0.8
            some = replace(
                every,
                data=every.data[keep],
                star=every.star[keep],
                x_px=every.x_px[keep],
                y_px=every.y_px[keep],
            )
            gl.draw(some, frame)
            found, wanted = gl.levels().copy(), oracle.levels(some)
            assert (found != wanted).sum() <= OTHER_PIXELS * (wanted > 0).sum() + 4
            with gl.context:
                left = gl._exact_pass.left
            # and whole
            same = tiles(np.roll(found == wanted, 11, axis=0)).all(axis=(1, 2))[some.star] & (
                some.star >= SIDE
            )
            assert same.mean() > 0.5
            assert np.abs(left.error - oracle.left.error)[:, same].max() < LEFT
            oracle.left = left


def test_without_compute_shaders_it_is_numpy_s(monkeypatch):
    monkeypatch.setattr("hilstar.display.exact.COMPUTE_VERSION", 999)
    target = Target(SIZE, GaussianPsf(SIGMA), srgb_response(8), WHITE, "temporal")
    oracle, sprites = (
        TemporalQuantiser(target.panel(), SIZE, GaussianPsf(SIGMA)),
        stars(*places(), flux_of(6.0)),
    )
    with Renderer(target) as gl:
        for frame in range(3):
            gl.draw(sprites, frame)
            assert np.array_equal(gl.levels(), oracle.levels(sprites))


def test_paths_keep_their_light_over_the_frames():
    """6 px a frame in five sprites, one way after another: within the aim, by GL as by NumPy."""
    panel = Panel(srgb_response(8), WHITE)
    x, y = places()
    way = np.repeat(np.arange(len(x)) * 2.4, 5)
    numbers = np.repeat(np.arange(len(x)), 5)
    oracle, errors = TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA)), []
    with Renderer(Target(SIZE, GaussianPsf(SIGMA), panel.response, WHITE, "temporal")) as gl:
        shown, sky = np.zeros((2, *SIZE)), np.zeros(SIZE)
        for frame in range(FRAMES):
            at = np.tile(np.arange(5) * 1.2 - 2.4, len(x)) + 1.0 * (frame - 2.5)
            sprites = stars(
                np.repeat(x, 5) + at * np.cos(way),
                np.repeat(y, 5) + at * np.sin(way),
                flux_of(6.0) / 5,
                numbers,
            )
            sprites = replace(sprites, per_star=5)
            gl.draw(sprites, frame)
            shown[0] += shown_light(gl.levels(), panel)
            shown[1] += shown_light(oracle.levels(sprites), panel)
            sky += linear_image(sprites, SIZE, GaussianPsf(SIGMA))
        errors = [flux_mag(tiles(image), tiles(sky)) for image in shown]
        assert gl.gl_error() == "GL_NO_ERROR"
    assert max(errors) < AIM_MAG


def test_a_path_of_two_stretches_makes_up_once_for_what_it_left():
    """40 sprites of 2.3 steps, of which the last eight are begun anew: after the first frame, which
    begins anywhere, the light of each frame is the path's own 92 steps.
    """
    target = Target(SIZE, GaussianPsf(SIGMA), table_response(2, np.linspace(0, 1, 4)), WHITE)
    target = replace(target, quantisation="temporal")
    y_px = np.arange(20, 240, 24)
    x_px = np.linspace(20, 244, 40)
    star = np.repeat(np.arange(len(y_px)), 40)
    rates = np.full(len(star), 2.3 * WHITE / 3)
    paths = stars(np.tile(x_px, len(y_px)), np.repeat(y_px, 40), rates, star)
    with Renderer(target) as gl:
        for frame in range(4):
            gl.draw(replace(paths, per_star=40), frame)
            shown = [int(gl.levels()[y - 12 : y + 12].sum()) for y in y_px]
            assert frame == 0 or shown == [92] * len(y_px)


@pytest.mark.parametrize("way", ["cpu", "gl"])
def test_frames_with_extended_light_go_on_where_others_stopped(way, monkeypatch):
    """A map lights the image in two frames of four, which points leave to NumPy: the light of all
    is right within a step.
    """
    monkeypatch.setenv(WAY_VARIABLE, way)
    panel = Panel(table_response(2, np.linspace(0, 1, 4)), WHITE)
    sprites = stars(*places(), 1.3 * WHITE / 3)
    none = replace(
        sprites,
        data=sprites.data[:0],
        star=sprites.star[:0],
        x_px=sprites.x_px[:0],
        y_px=sprites.y_px[:0],
    )
    light = LightMap(np.full(SIZE[::-1], 0.02 * WHITE, dtype=np.float32))
    with (
        Renderer(Target(SIZE, GaussianPsf(SIGMA), panel.response, WHITE, "temporal")) as gl,
        Renderer(gl.target) as floor,
    ):
        total = np.zeros(len(sprites))
        for frame in range(9):
            lights = (light,) if frame % 4 in (1, 2) else ()
            gl.draw(replace(sprites, extended=lights), frame)
            floor.draw(replace(none, extended=lights), frame)
            added = shown_light(gl.levels(), panel) - shown_light(floor.levels(), panel)
            total += tiles(added).sum((1, 2)) / (WHITE / 3) - 1.3
            assert np.abs(total).max() < 1.0 + 1e-3
        assert gl.gl_error() == "GL_NO_ERROR"
