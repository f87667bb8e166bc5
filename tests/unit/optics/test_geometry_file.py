"""A geometry file's camera: angles in degrees, and what is no rotation is refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from hilstar.display.geometry import KIND, load_geometry
from tests.support.refusals import refusal

SIZE = (640, 480)


def geometry_file(folder: Path, keys: str = "", q: str = "[1.0, 0.0, 0.0, 0.0]") -> Path:
    path = folder / "geometry.toml"
    path.write_text(
        f"kind = {KIND!r}\nresolution_px = [640, 480]\nfocal_length_px = 5000.0\n"
        f"principal_point_px = [319.5, 239.5]\nq_cam_to_mon = {q}\nk1 = 0.1\n{keys}\n"
    )
    return path


def test_the_field_is_the_angle_from_the_axis_and_the_tilt_is_about_x_and_then_y(tmp_path):
    keys = "max_field_deg = 2.5\ntilt_deg = [0.5, -1.5]"
    lens = load_geometry(geometry_file(tmp_path, keys), SIZE).lens
    assert lens.max_tangent == pytest.approx(math.tan(math.radians(2.5)))
    assert lens.tilt_rad == pytest.approx((math.radians(0.5), math.radians(-1.5)))
    assert load_geometry(geometry_file(tmp_path), SIZE).lens.max_tangent == math.inf


@pytest.mark.parametrize("q", ["[1.0, 0.1, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]"])
def test_a_quaternion_that_is_not_of_length_one_is_refused(tmp_path, q):
    assert "q_cam_to_mon: its norm" in refusal(load_geometry, geometry_file(tmp_path, q=q), SIZE)


def test_a_file_of_another_monitor_is_refused(tmp_path):
    assert "640 x 480" in refusal(load_geometry, geometry_file(tmp_path), (640, 481))


def test_a_file_that_was_written_again_is_read_again(tmp_path):
    """One path, two texts: what was parsed before is of the first alone."""
    first = load_geometry(geometry_file(tmp_path), SIZE)
    again = load_geometry(geometry_file(tmp_path, "max_field_deg = 5.0"), SIZE)
    assert first.lens.max_tangent == math.inf
    assert again.lens.max_tangent == pytest.approx(math.tan(math.radians(5.0)))
