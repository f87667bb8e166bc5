"""What a simulation in lockstep is told of the tracker's camera."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

import hilstar
from hilstar.attitude.wire.source import PACKETS
from hilstar.server.loop import Limit
from hilstar.server.serve import serve
from tests.support.benches import SMALL_BENCH


class AskedForItsCamera:
    """A link in lockstep that is shown the camera, and asks for no frame."""

    steps = True
    endpoint = "none"
    conventions = PACKETS
    link_counts = SimpleNamespace(summary=dict)

    def show_camera(self, camera, pictures) -> None:
        self.camera = camera


def test_a_simulation_s_camera_has_the_height_of_the_tracker_s_field(tmp_path):
    """1024 rows of 13 um behind 70 mm: 10.86 degrees from edge to edge."""
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    link = AskedForItsCamera()
    with hilstar.load(path) as bench:
        tracker = bench.config.tracker
        serve(bench, link, Limit(frames=0))
    height_mm = tracker.resolution_px[1] * tracker.pixel_pitch_um / 1000
    wanted_deg = 2 * math.degrees(math.atan2(height_mm / 2, tracker.focal_length_mm))
    assert link.camera.field_of_view_deg == pytest.approx(wanted_deg)
    assert link.camera.resolution_px == tracker.resolution_px
