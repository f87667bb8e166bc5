"""What is asked of the GL driver itself."""

from __future__ import annotations

import pytest

from hilstar.render.context import create_context
from hilstar.render.driver import Driver

NO_SUCH_CAPABILITY = 0x1234
TRIANGLE = "void main() { gl_Position = vec4(gl_VertexID / 2 * 4.0 - 1.0, gl_VertexID % 2 * 4.0 - 1.0, 0.0, 1.0); }"


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
    assert Driver(context).tells_resets
