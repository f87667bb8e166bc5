"""What a window shows of a frame is what NumPy presents of it: turned, with aids, stolen bits
and the photodiode's square.
"""

from __future__ import annotations

import sys

from tests.support.commands import run_started

RUN = """
import numpy as np
from hilstar.display.quantise import Panel
from hilstar.display.response import bit_stealing_response, srgb_response
from hilstar.display.window.window import Window, WindowSettings
from hilstar.display.render.backend import ScreenView, Target
from dataclasses import replace
from hilstar.display.render.numpy_backend import NumpyBackend, open_backend
from hilstar.display.render.presenter import window_context
from hilstar.display.render.renderer import Renderer
from hilstar.optics.scan import Orientation
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import sprites_at

SIZE, PSF, WHITE = (320, 240), GaussianPsf((0.85, 0.85)), 1e6
GREY = srgb_response(8)
TURNED = [(False, False, 0), (True, False, 1), (False, True, 2), (True, True, 3), (False, True, 1), (False, False, 3)]
OVER = [(0, (0, 0)), (1, (12, 255)), (2, (0, 0)), (3 + 8, (12, 0)), (3 + 4, (0, 0)), (1 + 8, (5, 7))]  # overlay, marker
rng = np.random.default_rng(31)
sprites = sprites_at(rng.uniform(0, 1, (300, 2)) * SIZE, 10.0 ** rng.uniform(4, 6.5, 300), PSF.footprint_px)
with Window(WindowSettings(SIZE, 8)) as window:
    context = window_context()
    for response in (GREY, bit_stealing_response((GREY, GREY, GREY), (0.2126, 0.7152, 0.0722))):
        target = Target(SIZE, PSF, response, WHITE)
        gl, oracle = Renderer(target, context), NumpyBackend(target)
        gl.draw(sprites)
        oracle._levels = gl.levels()  # this is about the last pass alone
        for turned in TURNED if response is GREY else TURNED[1:2]:
            view = ScreenView(SIZE, window.size_px, 8, Orientation(*turned), (150.4, 99.6), response.rgb)
            gl.show_on(view)
            oracle.show_on(view)
            for overlay, marker in OVER:
                for backend in (gl, oracle):
                    backend.present(overlay, 200 if overlay == 11 else 30, marker)
                read = context.screen.read(viewport=(0, 0, *window.size_px), components=3, dtype="f4")
                shown = np.rint(np.frombuffer(read, np.float32).reshape(*window.size_px[::-1], 3)[::-1] * 255)
                assert np.array_equal(shown, oracle.back_buffer), (view, overlay, marker)
                assert shown.any() or overlay & 4
            gl.take_back_buffer()
        assert gl.changed_codes() == oracle.changed_codes() == ""
    # Primaries that are driven apart: three pictures of levels, each to its own colour.
    each = tuple(Panel(GREY, WHITE * share) for share in (0.3, 0.5, 0.2))
    apart = replace(sprites, primaries=(10.0 ** rng.uniform(4, 6, (300, 3))).astype(np.float32))
    places_px = np.array([(-0.3, 0), (0, 0), (0.3, 0)])
    target = Target(SIZE, PSF, GREY, WHITE, primaries=each, places_px=places_px, together=np.eye(3))
    gl, oracle = open_backend(target, context), open_backend(target, None)
    for one in (gl, oracle):
        one.draw(apart)
    levels = gl.levels()
    assert levels.shape == (240, 320, 3) and (levels.max(axis=(0, 1)) > 0).all()
    assert np.mean(levels != oracle.levels()) < 1e-4
    for k, panel in enumerate(oracle.panels):
        panel._levels = levels[..., k]
    for turned, (overlay, marker) in zip(TURNED, OVER, strict=True):
        gl.fault()  # of what this test has read
        for backend in (gl, oracle):
            backend.show_on(ScreenView(SIZE, window.size_px, 8, Orientation(*turned), (150.4, 99.6)))
            backend.present(overlay, 30, marker)
        assert gl.fault() == ""
        read = context.screen.read(viewport=(0, 0, *window.size_px), components=3, dtype="f4")
        shown = np.rint(np.frombuffer(read, np.float32).reshape(*window.size_px[::-1], 3)[::-1] * 255)
        assert np.array_equal(shown, oracle.panels[0].back_buffer), (turned, overlay)
        gl.take_back_buffer()
print("presented")
"""


def test_a_window_shows_what_numpy_presents(screen):
    ran = run_started([sys.executable, "-c", RUN], env=screen.env)
    assert ran.stdout == "presented\n", ran.stderr
