"""While the loop waits for the GPU, Python's other threads go on."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.support.waiting import PATIENCE_S

# 40 million sines or more for each frame: on llvmpipe, seconds of two cores.
FRAME = """
import json, threading, time
import moderngl, numpy as np
from hilstar.display.window.window import Window, WindowSettings
from hilstar.display.render.backend import ScreenView
from hilstar.display.render.presenter import Presenter, level_texture, window_context

TRIANGLE = "void main() { gl_Position = vec4(gl_VertexID / 2 * 4.0 - 1.0, gl_VertexID % 2 * 4.0 - 1.0, 0.0, 1.0); }"
SINES = "float x = gl_FragCoord.x; for (int i = 0; i < 400; i++) x = sin(x) + 1.1;"
counted, stop = 0, threading.Event()

def count():
    global counted
    while not stop.wait(0.001):
        counted += 1

size = (320, 240)
with Window(WindowSettings(size, 8)) as window:
    context = window_context()
    texture = level_texture(context, np.zeros(size[::-1], np.uint8))
    presenter = Presenter(texture, ScreenView(size, window.size_px, 8))
    program = context.program(
        vertex_shader=f"#version 330\\n{TRIANGLE}",
        fragment_shader=f"#version 330\\nout uint level; void main() {{ {SINES} level = x > 9.0 ? 1u : 2u; }}",
    )
    heavy, target = context.vertex_array(program, []), context.framebuffer([texture])
    threading.Thread(target=count, daemon=True).start()
    found = {}
    for name, wait in (("finish", context.finish), ("present", presenter.present), ("wait", presenter.wait)):
        target.use()
        for _ in range(4):
            heavy.render(moderngl.TRIANGLES, vertices=3)
        before, begin_s = counted, time.monotonic()
        wait()
        found[name] = [counted - before, time.monotonic() - begin_s]
        window.swap()
    stop.set()
print(json.dumps(found))
"""
MIN_WAITED_S = 0.05
MIN_SHARE = 0.2  # of the milliseconds waited: a machine whose cores are busy gives a thread fewer


def test_another_thread_advances_while_a_frame_is_waited_for(screen):
    command = [sys.executable, "-c", FRAME]
    ran = subprocess.run(
        command, capture_output=True, text=True, env=screen.env, timeout=PATIENCE_S, check=False
    )
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    counted, waited_s = found.pop("finish")  # moderngl's own keeps the lock
    assert waited_s > MIN_WAITED_S
    # a turn before the call, and one after
    assert counted < MIN_SHARE * waited_s * 1000 / 10, (counted, waited_s)
    for counted, waited_s in found.values():
        assert waited_s > MIN_WAITED_S
        assert counted > MIN_SHARE * waited_s * 1000
