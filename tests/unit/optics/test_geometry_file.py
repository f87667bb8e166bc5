"""A geometry file's camera: angles in degrees, and what is no rotation is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.display.geometry import (
    KIND,
    MAX_TERMS,
    ErrorTable,
    MadeTable,
    Notes,
    load_distortion,
    load_geometry,
    load_notes,
    monitor_camera,
    write_geometry,
)
from hilstar.optics.camera import Camera, Lens, ResidualField
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


def test_what_is_written_is_read_number_by_number(tmp_path, rng):
    """No two of them are alike."""
    field = ResidualField(rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), SIZE)
    lens = Lens((0.1, -0.2, 0.3), (0.004, -0.005), (0.02, -0.03), field, 0.6)
    q = from_rotation_vector(np.array([0.1, -0.2, 0.3]))
    camera = Camera(SIZE, 5000.0, (300.25, 250.5), to_matrix(q), lens)
    error = ErrorTable(model="brown", rms_arcsec=1.5, map_arcsec=[[1.0, 2.0]])
    made = MadeTable(by="a test", poses=7, rotation_arcsec=(1.0, 2.0, 3.0))
    path = tmp_path / "geometry.toml"
    write_geometry(path, camera, q, Notes({"k1": 0.01}, error, made))
    read = load_geometry(path, SIZE)
    assert read.resolution_px == SIZE
    assert (read.focal_length_px, read.principal_point_px) == (5000.0, (300.25, 250.5))
    assert read.cam_to_image == pytest.approx(camera.cam_to_image, abs=1e-15)
    assert (read.lens.radial, read.lens.tangential) == (lens.radial, lens.tangential)
    assert read.lens.tilt_rad == pytest.approx(lens.tilt_rad, rel=1e-14)
    assert read.lens.max_tangent == pytest.approx(0.6, rel=1e-14)
    assert np.array_equal([read.lens.field.x, read.lens.field.y], [field.x, field.y])
    notes = load_notes(path)
    assert (notes.sigma, notes.error, notes.made, notes.identity) == (
        {"k1": 0.01},
        error,
        made,
        None,
    )


def test_a_tracker_s_flight_model_is_its_five_numbers(tmp_path):
    path = tmp_path / "flight.toml"
    path.write_text("k1 = 0.1\nk2 = 0.2\nk3 = 0.3\np1 = 0.4\np2 = 0.5\n")
    camera = monitor_camera(SIZE, 10.0, 50.0, np.array([1.0, 0.0, 0.0, 0.0]))
    lens = load_distortion(path, camera).lens
    assert (lens.radial, lens.tangential) == ((0.1, 0.2, 0.3), (0.4, 0.5))
    assert camera.focal_length_px == 5000.0
    path.write_text("k1 = 0.1\nk4 = 0.2\n")
    assert "write k1, k2, k3, p1 and p2" in refusal(load_distortion, path, camera)


@pytest.mark.parametrize(
    ("side", "is_read"), [(1, True), (MAX_TERMS, True), (MAX_TERMS + 1, False)]
)
def test_a_field_has_terms_up_to_a_bound_in_two_squares_of_one_size(tmp_path, side, is_read):
    square = str([[0.0] * side] * side)
    keys = f"[field]\nx_px = {square}\ny_px = "
    if is_read:
        assert load_geometry(geometry_file(tmp_path, keys + square), SIZE).lens.field is not None
    else:
        said = refusal(load_geometry, geometry_file(tmp_path, keys + square), SIZE)
        assert f"no two squares of one size, up to {MAX_TERMS}" in said
    other = str([[0.0] * (side + 1)] * side)
    assert "no two squares" in refusal(load_geometry, geometry_file(tmp_path, keys + other), SIZE)


@pytest.mark.parametrize("kind", ["hilstar geometry 2", "hilstar alignment 1"])
def test_a_file_of_another_kind_is_refused(tmp_path, kind):
    path = geometry_file(tmp_path)
    path.write_text(path.read_text().replace(KIND, kind))
    assert f"kind = '{kind}' and '{KIND}' is wanted" in refusal(load_geometry, path, SIZE)
