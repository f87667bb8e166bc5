"""The monitor of a bench file as it stands in the bench: how it is turned, and when its rows light."""

from __future__ import annotations

from hilstar.bench.config import Monitor
from hilstar.render.presenter import Mount
from hilstar.scene.frame_motion import Scan

S_PER_MS = 1e-3


def mount_of(monitor: Monitor) -> Mount:
    """How the bench file says that the image lies on the screen."""
    return Mount(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


def scan_of(monitor: Monitor) -> Scan:
    """When rows light and for how long: one refresh period each, where the bench file does not say."""
    period_ms = 1000.0 / monitor.refresh_hz
    scanout_ms = period_ms if monitor.scanout_ms is None else monitor.scanout_ms
    hold_ms = period_ms if monitor.hold_ms is None else monitor.hold_ms
    return Scan(mount_of(monitor).down, scanout_ms * S_PER_MS, hold_ms * S_PER_MS)
