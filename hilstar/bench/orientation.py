"""How the monitor of a bench file is turned, and when its rows light."""

from __future__ import annotations

from hilstar.bench.config import Monitor
from hilstar.render.presenter import Orientation
from hilstar.scene.frame_motion import Scan

S_PER_MS = 1e-3


def orientation_of(monitor: Monitor) -> Orientation:
    """How the image lies on the screen, as the bench file has it."""
    return Orientation(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


def scan_of(monitor: Monitor) -> Scan:
    """When the rows light, and for how long."""
    return Scan(orientation_of(monitor).down, monitor.panel_scanout_ms * S_PER_MS, monitor.panel_hold_ms * S_PER_MS)
