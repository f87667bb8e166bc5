"""Stray light of a tracker's pixels in another camera's: closed forms on detectors that are not
square, cameras that are not centred, and a part of an image that the other does not have.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.layers.fault_kinds import Gradient, MeasuredMap
from hilstar.optics.layers.stray_light import gradient_image, map_image, pixels_in, read_map
from tests.support.refusals import refusal

TRACKER = Camera((40, 30), 100.0, (19.5, 14.5), np.eye(3))
MAP = MeasuredMap(name="m", file="map.npy")
FLOAT32 = 1e-6
SPLINE = 1e-4  # of an area: splines through every eighth pixel


def gradient(towards_deg: float) -> Gradient:
    return Gradient(name="g", towards_deg=towards_deg, electrons_per_s=1.0)


@pytest.mark.parametrize(
    ("towards_deg", "corner"),
    [
        (0.0, None),
        (90.0, None),
        (30.0, (29, 39)),
        (120.0, (29, 0)),
        (-150.0, (0, 0)),
        (-60.0, (0, 39)),
    ],
)
def test_a_gradient_rises_along_its_direction_to_the_outer_corner(towards_deg, corner):
    """1 at the far corner of the detector and 0 at the near one, by the pixels' edges; 0 degrees
    is to the right and 90 down.
    """
    image = gradient_image(gradient(towards_deg), TRACKER, TRACKER)
    assert image.shape == (30, 40)
    right, down = np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg))
    extent_px = 40 * abs(right) + 30 * abs(down)
    assert image.mean() == pytest.approx(0.5, abs=FLOAT32)
    assert np.diff(image, axis=1) == pytest.approx(right / extent_px, abs=FLOAT32)
    assert np.diff(image, axis=0) == pytest.approx(down / extent_px, abs=FLOAT32)
    # half a pixel's way within the corner
    assert image.max() == pytest.approx(1 - (abs(right) + abs(down)) / 2 / extent_px, abs=FLOAT32)
    if corner is not None:
        assert np.unravel_index(image.argmax(), image.shape) == corner


def test_a_gradient_is_dark_beyond_its_dark_corner_and_goes_on_beyond_the_bright_one():
    """A screen that shows twice as much as the detector has, each of whose pixels covers four of
    its own. A gradient to the left is 1 at the detector's left edge and 0 at its right one.
    """
    camera = screen(50.0, (31.5, 23.5))
    image = gradient_image(gradient(180.0), camera, TRACKER)
    x_px = 19.5 + 2 * (np.arange(64) - 31.5)
    rise = 0.5 - (x_px - 19.5) / 40
    assert rise.min() < -0.2 and rise.max() > 1.2
    light = 4 * np.where(rise > 0, rise, 0.0)
    assert image == pytest.approx(np.tile(light, (48, 1)), abs=4 * SPLINE)


def screen(focal_px: float, principal_px: tuple[float, float], turned_rad: float = 0.0) -> Camera:
    """A camera of 64 x 48 px that looks along the tracker's axis, turned about it."""
    return Camera(
        (64, 48),
        focal_px,
        principal_px,
        to_matrix(from_rotation_vector(np.array([0.0, 0.0, turned_rad]))),
    )


@pytest.mark.parametrize("turned_deg", [0.0, 30.0, 90.0, -140.0])
def test_a_place_in_another_camera_is_by_its_focal_length_middle_and_turn(turned_deg):
    """Twice the focal length: half of the tracker's pixels along each side. The camera's x axis
    lies `turned_deg` from the tracker's, towards y.
    """
    turned_rad = np.radians(turned_deg)
    camera = screen(200.0, (20.0, 30.0), turned_rad)
    x_px, y_px, area = pixels_in(camera, TRACKER)
    y, x = np.mgrid[0:48, 0:64]
    cosine, sine = np.cos(turned_rad), np.sin(turned_rad)
    # what the camera has at an angle, the tracker has less of the turn
    assert x_px == pytest.approx(19.5 + ((x - 20.0) * cosine + (y - 30.0) * sine) / 2, abs=1e-9)
    assert y_px == pytest.approx(14.5 + ((y - 30.0) * cosine - (x - 20.0) * sine) / 2, abs=1e-9)
    assert area == pytest.approx(np.full((48, 64), 0.25), abs=1e-9)


@pytest.mark.parametrize("seen_by", [(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
@pytest.mark.parametrize("turned_deg", [0.0, -40.0])
def test_a_mirrored_screen_has_the_same_light_the_other_way_round(seen_by, turned_deg):
    """Across or down, and also where a part of the screen is nowhere on the detector. Its middle
    is the principal point.
    """
    aside = to_matrix(from_rotation_vector(np.radians([0.0, turned_deg, 0.0])))
    middle_px = (29.5, 19.5)
    plain = Camera((60, 40), 14.0, middle_px, aside)
    mirrored = Camera((60, 40), 14.0, middle_px, np.diag(seen_by) @ aside)
    axis = 1 if seen_by[0] < 0 else 0
    values = np.arange(1.0, 1201.0).reshape(30, 40)
    image = map_image(values, MAP, mirrored, TRACKER)
    assert image.max() > 0 and image.min() == 0
    same = map_image(values, MAP, plain, TRACKER)
    assert np.flip(image, axis) == pytest.approx(same, rel=1e-5)


def test_a_map_over_another_detector_keeps_its_light_and_its_places():
    """A map of two tracker pixels to a sample. What the other camera gets in all is what the
    detector got, and a sample's middle of light lies where its own middle does.
    """
    camera = screen(120.0, (30.0, 25.0))
    values = np.zeros((15, 20))
    values[4, 13] = 3.0
    image = map_image(values, MAP, camera, TRACKER).astype(float)
    # four tracker pixels' worth of light, linear between samples, which a pixel's middle stands for
    assert image.sum() == pytest.approx(3.0 * 4, rel=0.05)
    y, x = np.indices(image.shape)
    tracker_px = np.array([2 * 13 + 0.5, 2 * 4 + 0.5])
    wanted = np.array([30.0, 25.0]) + 1.2 * (tracker_px - [19.5, 14.5])
    found = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    assert found == pytest.approx(wanted, abs=0.05)


def test_a_map_ends_at_the_detector_s_edges():
    """Every sample is 1: each screen pixel on the detector has its area of tracker pixels, the
    others nothing.
    """
    camera = screen(50.0, (31.3, 23.2))
    image = map_image(np.ones((2, 3)), MAP, camera, TRACKER)
    x = 19.5 + 2 * (np.arange(64) - 31.3)
    y = 14.5 + 2 * (np.arange(48) - 23.2)
    on = np.outer((y >= -0.5) & (y <= 29.5), (x >= -0.5) & (x <= 39.5))
    assert image == pytest.approx(4.0 * on, abs=4 * SPLINE)
    assert on.sum() == 300


def test_a_map_of_the_camera_s_own_pixels_is_itself():
    values = np.arange(1200.0).reshape(30, 40)
    assert (map_image(values, MAP, TRACKER, TRACKER) == values).all()


def test_a_part_of_an_image_that_is_nowhere_in_the_other_s_has_no_light():
    """A field of 130 degrees that looks 40 degrees aside, turned by 35 about its axis: a part lies
    behind the tracker's plane. Areas are those of small steps about each pixel.
    """
    turned = to_matrix(from_rotation_vector(np.radians([0.0, 0.0, 35.0])))
    aside = turned @ to_matrix(from_rotation_vector(np.radians([0.0, -40.0, 0.0])))
    wide = Camera((60, 40), 14.0, (29.5, 19.5), aside)

    def place_px(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.stack([(x - 29.5) / 14.0, (y - 19.5) / 14.0, np.ones_like(x)], axis=-1) @ aside
        ahead = np.where(rays[..., 2] > 0, rays[..., 2], np.nan)
        return 19.5 + 100 * rays[..., 0] / ahead, 14.5 + 100 * rays[..., 1] / ahead

    y, x = np.mgrid[0.0:40, 0.0:60]
    found = pixels_in(wide, TRACKER)
    wanted = place_px(x, y)
    known = np.isfinite(wanted[0])
    assert 0.3 < known.mean() < 0.95
    assert found.x_px == pytest.approx(wanted[0], abs=1e-9, nan_ok=True)
    assert found.y_px == pytest.approx(wanted[1], abs=1e-9, nan_ok=True)
    step = 0.01
    right, left = place_px(x + step, y), place_px(x - step, y)
    below, above = place_px(x, y + step), place_px(x, y - step)
    across = [(b - a) / 2 / step for a, b in zip(left, right, strict=True)]
    down = [(b - a) / 2 / step for a, b in zip(above, below, strict=True)]
    area = np.abs(across[0] * down[1] - across[1] * down[0])
    even = known & (area < 80) & (x > 0) & (x < 59) & (y > 0) & (y < 39)
    assert even.sum() > 200
    assert found.area[even] == pytest.approx(area[even], rel=0.05)  # steps of a pixel
    on = (np.abs(wanted[0] - 19.5) <= 20) & (np.abs(wanted[1] - 14.5) <= 15)
    image = map_image(np.ones((30, 40)), MAP, wide, TRACKER)
    assert (image > 0).tolist() == on.tolist()
    assert on.any()


@pytest.mark.parametrize(
    ("shape", "is_map"), [((2, 2), True), ((1, 5), False), ((5, 1), False), ((2, 2, 2), False)]
)
def test_a_map_has_two_axes_of_two_pixels_or_more(tmp_path, shape, is_map):
    values = np.arange(np.prod(shape), dtype=float).reshape(shape)
    np.save(tmp_path / "map.npy", values)
    if is_map:
        assert np.array_equal(read_map(tmp_path / "map.npy"), values)
    else:
        said = refusal(read_map, tmp_path / "map.npy")
        assert f"an array of shape {shape}" in said


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_map_of_light_has_no_value_that_is_none(tmp_path, value):
    values = np.ones((3, 4))
    values[2, 1] = value
    np.save(tmp_path / "map.npy", values)
    assert "a value is negative or not finite" in refusal(read_map, tmp_path / "map.npy")
    np.save(tmp_path / "map.npy", np.zeros((3, 4)))
    assert "is dark everywhere" in refusal(read_map, tmp_path / "map.npy")
