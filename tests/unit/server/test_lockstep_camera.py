"""What a simulation in lockstep is told of the tracker's camera."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

import hilstar
from hilstar.attitude.wire.source import PACKETS
from hilstar.server.loop import Limit
from hilstar.server.serve import serve
from tests.support.benches import bench_text


class AskedForItsCamera:
    """A link in lockstep that is shown the camera, and asks for no frame."""

    steps = True
    endpoint = "none"
    conventions = PACKETS
    link_counts = SimpleNamespace(summary=dict)

    def show_camera(self, camera, pictures) -> None:
        self.camera = camera


def test_a_simulation_s_camera_has_the_height_of_the_tracker_s_field(tmp_path):
    """800 rows of 13 um behind 70 mm: 8.50 degrees from edge to edge, and more along a row."""
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"tracker": {"resolution_px": [1280, 800]}}))
    link = AskedForItsCamera()
    with hilstar.load(path) as bench:
        serve(bench, link, Limit(frames=0))
    wanted_deg = 2 * math.degrees(math.atan2(800 / 2 * 0.013, 70))
    assert link.camera.field_of_view_deg == pytest.approx(wanted_deg)
    assert link.camera.resolution_px == (1280, 800)
