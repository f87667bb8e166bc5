"""What is asked of the GL driver itself."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.errors import GpuError
from hilstar.basics.units import NS_PER_S
from hilstar.display.render.context import create_context
from hilstar.display.render.driver import (
    GL_TIMEOUT_EXPIRED,
    GL_WAIT_FAILED,
    Driver,
    sleep_in_waits,
)
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import gamma_response
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import random_sprites

NO_SUCH_CAPABILITY = 0x1234
TRIANGLE = (
    "void main() { gl_Position = vec4(gl_VertexID / 2 * 4.0 - 1.0, gl_VertexID % 2 * 4.0 - 1.0,"
    " 0.0, 1.0); }"
)


@pytest.fixture
def context():
    with create_context() as made:
        yield made
    made.release()


def test_a_wait_ends_when_what_was_drawn_is_there(context):
    fill = "#version 330\nout vec4 colour; void main() { colour = vec4(1.0); }"
    program = context.program(vertex_shader=f"#version 330\n{TRIANGLE}", fragment_shader=fill)
    target = context.framebuffer([context.texture((64, 64), 1)])
    target.use()
    context.vertex_array(program, []).render(vertices=3)
    Driver(context).wait()
    assert set(target.read(components=1)) == {255}


def test_a_gl_error_is_told_once_and_by_its_name(context):
    driver = Driver(context)
    assert driver.fault() == ""
    context.enable_direct(NO_SUCH_CAPABILITY)
    assert driver.fault() == "the GL driver reports GL_INVALID_ENUM"
    assert driver.fault() == ""


def test_the_reset_status_is_asked_for(context):
    assert Driver(context)._reset is not None


SIZE, SIGMA, WHITE = (96, 64), (0.85, 0.85), 1e6


@pytest.mark.parametrize("quantisation", ["round", "dither", "exact", "temporal"])
def test_a_frame_after_the_images_were_lost_is_as_if_nothing_had_been_drawn(quantisation, rng):
    footprint = GaussianPsf(SIGMA).footprint_px
    few, many = (random_sprites(count, rng, SIZE, footprint, (4, 6)) for count in (3, 40))
    with Renderer(
        Target(SIZE, GaussianPsf(SIGMA), gamma_response(8), WHITE, quantisation)
    ) as renderer:
        renderer.draw(few)
        wanted = renderer.levels().copy()
        renderer.draw(many)
        with renderer.context:
            renderer.codes_texture.write(np.full(SIZE[::-1], 7, np.uint8))
        renderer.draw(few, 1)
        assert (renderer.levels() == 7).any()  # images are kept from frame to frame
        renderer.forget_images()
        renderer.draw(few)
        assert (renderer.levels() == wanted).all()


def test_levels_of_extended_light_that_were_lost_are_drawn_again(rng):
    """`exact` keeps them under the stars for as long as the light is the same."""
    psf = GaussianPsf(SIGMA)
    glow = LightMap(rng.uniform(1e4, 5e4, (20, 30)).astype(np.float32), (25, 8), 1.0)
    light = replace(random_sprites(3, rng, SIZE, psf.footprint_px, (4, 6)), extended=(glow,))
    with Renderer(Target(SIZE, psf, gamma_response(8), WHITE, "exact")) as renderer:
        renderer.draw(light)
        wanted = renderer.levels().copy()
        with renderer.context:
            renderer._floor_levels.write(np.full(SIZE[::-1], 7, np.uint8))
        renderer.draw(light, 1)
        assert (renderer.levels() != wanted).any()
        renderer.forget_images()
        renderer.draw(light)
        assert (renderer.levels() == wanted).all()


# the gain and the steps; of `dither` its mask and edges, too; of `exact` its pixels, light and gain
@pytest.mark.parametrize(("quantisation", "tables"), [("round", 2), ("dither", 4), ("exact", 5)])
def test_a_byte_of_each_table_is_noticed(quantisation, tables):
    uneven = np.full(SIZE[::-1], 0.9, np.float32)
    with Renderer(
        Target(SIZE, GaussianPsf(SIGMA), gamma_response(8), WHITE, quantisation, uneven)
    ) as renderer:
        renderer.remember_tables()
        assert (len(renderer.tables), renderer.changed_tables()) == (tables, 0)
        for number, table in enumerate(renderer.tables, 1):
            with renderer.context:
                data = bytearray(table.read())
                data[-1] ^= 1
                table.write(bytes(data))
            assert renderer.changed_tables() == number


def test_nvidia_s_driver_sleeps_while_it_waits_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.delenv("__GL_YIELD", raising=False)
    sleep_in_waits()
    assert os.environ["__GL_YIELD"] == "USLEEP"
    monkeypatch.setenv("__GL_YIELD", "NOTHING")
    sleep_in_waits()
    assert os.environ["__GL_YIELD"] == "NOTHING"


def test_a_driver_that_is_not_well_is_an_error_that_says_what_it_reports(context):
    driver = Driver(context)
    driver.check()
    context.enable_direct(NO_SUCH_CAPABILITY)
    with pytest.raises(
        GpuError, match="the GL driver reports GL_INVALID_ENUM; begin the run again"
    ):
        driver.check()
    driver.check()


@pytest.mark.parametrize(
    ("result", "words"),
    [(GL_TIMEOUT_EXPIRED, "has not finished a frame for 10 s"), (GL_WAIT_FAILED, "cannot wait")],
)
def test_a_gpu_that_does_not_finish_or_cannot_be_waited_for_is_an_error(context, result, words):
    """As many slices of a tenth of a second are waited for as make 10 s, and none after a failure."""
    driver = Driver(context)
    slices_ns = []

    def wait(fence: int, flags: int, timeout_ns: int) -> int:
        slices_ns.append(timeout_ns)
        return result

    driver._ask = driver._wait = wait
    fences: list[int] = []
    delete = driver._delete
    driver._delete = lambda fence: (fences.append(fence), delete(fence))
    with pytest.raises(GpuError, match=words):
        driver.wait()
    assert len(fences) == 1  # a frame's fence goes, whatever became of it
    waited_ns = 10 * NS_PER_S if result == GL_TIMEOUT_EXPIRED else 0
    assert sum(slices_ns) == waited_ns


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (0x8253, "the GPU is lost: this program's work reset it"),  # glext.h
        (0x8254, "the GPU is lost: another program's work reset it"),
        (0x8255, "the GPU is lost: it was reset for an unknown reason"),
        (0x1234, "the GPU is lost: reset status 0x1234"),
    ],
)
def test_a_gpu_that_was_reset_is_lost_and_errors_without_end_are_told_once(context, status, words):
    """A lost context may give the same error for ever; the reset goes before it."""
    driver = Driver(context)
    driver._error = lambda: 0x0507
    assert driver.fault() == "the GL driver reports GL_CONTEXT_LOST"
    driver._reset = lambda: status
    assert driver.fault() == words
    errors = iter([0x0502, 0x0505, 0x0502, 0x9999, 0])
    driver._reset = None
    driver._error = lambda: next(errors)
    assert driver.fault() == (
        "the GL driver reports GL_INVALID_OPERATION, GL_OUT_OF_MEMORY, 0x9999"
    )
