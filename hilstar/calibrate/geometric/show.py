"""Frames of dots on the bench's own display, turned and flipped as its stars are."""

from __future__ import annotations

import logging

import numpy as np

from hilstar.bench.config import Monitor
from hilstar.bench.orientation import orientation_of
from hilstar.calibrate.geometric.dots import DotPlan, dot_image
from hilstar.calibrate.patches import stays_until_key
from hilstar.render.presenter import Presenter, View, level_texture, window_context

log = logging.getLogger(__name__)


def show_dots(plan: DotPlan, monitor: Monitor, seconds: float | None, *, windowed: bool) -> int:
    """Show each frame until space is pressed, or for `seconds`; q quits. Returns how many were shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not there.
    """
    from hilstar.monitor.window.window import Window, WindowSettings

    orientation = orientation_of(monitor)
    screen_px = orientation.screen_px(monitor.resolution_px)
    white = 2**monitor.bits - 1
    triples = np.array([[0, 0, 0], [white, white, white]], dtype=np.uint16)
    with Window(WindowSettings(screen_px, monitor.bits, None if windowed else monitor.display)) as window:
        view = View(monitor.resolution_px, window.size_px, monitor.bits, orientation, triples=triples)
        context = window_context()
        for frame in range(plan.frames):
            levels = dot_image(plan, frame, monitor.resolution_px, 1).astype(np.uint8)
            texture = level_texture(context, levels)
            log.warning("frame %d of %d (frame_%03d)", frame + 1, plan.frames, frame)
            if not stays_until_key(window, Presenter(texture, view), seconds):
                return frame
            texture.release()
    return plan.frames
