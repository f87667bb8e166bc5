"""A bench of which no two sides, axes or middles are alike, against its own projection in NumPy and
SciPy: where five stars are on the screen and on the detector, and how bright.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import to_matrix
from hilstar.optics.psf import GaussianPsf, SampledPsf
from hilstar.server.answers.stars import lit_at
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
    display_psf,
    flight_camera,
    real_monitor,
    tracker_camera,
)
from hilstar.server.bench.frame import Bench, aid_levels_of
from hilstar.server.bench.scene import seen_by
from tests.support.benches import bench_text
from tests.support.psfs import coma, sampled

# about an oblique axis: the monitor stands rolled by two degrees, and beside the axis
TURN = Rotation.from_rotvec(np.radians([0.4, -0.7, 2.0]))
RADEC_ROLL_DEG = (84.0, 10.0, 25.0)
PITCH_UM, COLLIMATOR_MM = 50.0, 120.0
TRACKER_UM, TRACKER_MM = 9.0, 55.0
SCREEN_PX, SCREEN_MIDDLE_PX = (300, 200), (140.25, 110.5)
DETECTOR_PX, DETECTOR_MIDDLE_PX = (900, 600), (430.5, 310.25)
# right ascension, declination, V: the fourth is on no screen, the fifth behind the camera
STARS = (
    (84.0, 10.0, 1.0),
    (85.5, 10.9, 2.5),
    (83.1, 8.9, 3.25),
    (90.0, 14.0, 2.0),
    (264.0, -10.0, 0.5),
)


def quaternion_of(rotation: Rotation) -> list[float]:
    """A rotation's quaternion, scalar first."""
    x, y, z, w = rotation.as_quat().tolist()
    return [w, x, y, z]


BESIDE = {
    "tracker": {
        "focal_length_mm": TRACKER_MM,
        "pixel_pitch_um": TRACKER_UM,
        "resolution_px": list(DETECTOR_PX),
        "principal_point_px": list(DETECTOR_MIDDLE_PX),
        "psf_sigma_px": [0.9, 0.5],
    },
    "monitor": {"resolution_px": list(SCREEN_PX), "pixel_pitch_um": PITCH_UM},
    "collimator": {
        "focal_length_mm": COLLIMATOR_MM,
        "principal_point_px": list(SCREEN_MIDDLE_PX),
        "q_cam_to_mon": quaternion_of(TURN),
    },
    "sky": {"catalogue": "stars.csv", "catalogue_epoch_jyear": 2026.0, "epoch_jyear": 2026.0},
}
EXACT_PX = 1e-6  # of places that are a rotation and a quotient each


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def bench_file(folder: Path, *changes: dict[str, dict[str, object]]) -> BenchFile:
    """The bench's file, and its stars beside it."""
    rows = [f"{ra_deg},{dec_deg},{v_mag},0.6" for ra_deg, dec_deg, v_mag in STARS]
    (folder / "stars.csv").write_text("\n".join(["ra,dec,v,bv", *rows]) + "\n")
    return bench_file_of(folder / "bench.toml", bench_text(BESIDE, *changes))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """The bench, at the attitude of `q`."""
    with open_bench(bench_file(tmp_path)) as opened:
        yield opened


def icrs_to_cam() -> FloatArray:
    """A3(-roll) A1(90 - dec) A3(90 - ra) of vectors: the thesis' eq. 2.3 the other way round."""
    ra_deg, dec_deg, roll_deg = RADEC_ROLL_DEG
    from_cam = Rotation.from_euler("ZXZ", [ra_deg - 90, dec_deg - 90, roll_deg], degrees=True)
    return from_cam.inv().as_matrix()


def directions() -> FloatArray:
    """The stars' directions (n, 3), camera axes."""
    ra, dec = np.radians([star[:2] for star in STARS]).T
    vectors = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    return vectors @ icrs_to_cam().T


def places_px(rays: FloatArray, focal_px: float, middle_px: tuple[float, float]) -> FloatArray:
    """Where a pinhole has rays (n, 3); NaN behind it."""
    x, y, z = np.where(rays[:, 2:] > 0, rays, np.nan).T
    return np.stack([middle_px[0] + focal_px * x / z, middle_px[1] + focal_px * y / z], axis=1)


def on_screen() -> FloatArray:
    """The stars' places (n, 2) on the monitor."""
    return places_px(
        directions() @ TURN.as_matrix().T, COLLIMATOR_MM / PITCH_UM * 1e3, SCREEN_MIDDLE_PX
    )


def within(places: FloatArray, size_px: tuple[int, int]) -> list[int]:
    """Which places are on an image, to its pixels' edges."""
    lower = (places > -0.5).all(axis=1)
    return np.flatnonzero(lower & (places < np.array(size_px) - 0.5).all(axis=1)).tolist()


Q = np.array(quaternion_of(Rotation.from_matrix(icrs_to_cam())))


def test_each_star_s_row_has_its_own_place_and_light(bench: Bench) -> None:
    frame = bench.frame(Q)
    shown = within(on_screen(), SCREEN_PX)
    assert shown == [0, 1, 2]
    rows = frame.truth
    order = sorted(shown, key=lambda star: STARS[star][2])
    np.testing.assert_allclose(
        np.stack([rows["x_px"], rows["y_px"]], axis=1), on_screen()[order], atol=EXACT_PX
    )
    assert rows["v_mag"] == pytest.approx([STARS[star][2] for star in order])
    np.testing.assert_allclose(rows["ra_deg"], [STARS[star][0] for star in order], atol=1e-9)
    np.testing.assert_allclose(rows["dec_deg"], [STARS[star][1] for star in order], atol=1e-9)
    # Pogson's law, and the centroid and the sum of what the pixels have
    loss_mag = -2.5 * np.log10(rows["electrons_per_s"] / rows["electrons_per_s"][0])
    assert loss_mag == pytest.approx(rows["v_mag"] - rows["v_mag"][0], abs=1e-6)
    y, x = np.indices(frame.linear.shape)
    for row in rows:
        near = np.hypot(x - row["x_px"], y - row["y_px"]) < 12
        light = np.where(near, frame.linear, 0.0)
        assert light.sum() == pytest.approx(row["electrons_per_s"], rel=2e-3)
        assert (light * x).sum() / light.sum() == pytest.approx(row["x_px"], abs=2e-3)
        assert (light * y).sum() / light.sum() == pytest.approx(row["y_px"], abs=2e-3)


def test_a_tracker_sees_each_star_where_its_own_pinhole_has_it(tmp_path: Path) -> None:
    file = bench_file(tmp_path)
    with open_bench(file) as bench:
        camera = tracker_camera(file.config.tracker, file.folder)
        rates = bench.stars.electrons_per_s
        lit = lit_at(Q, bench.stars, camera, float(np.sort(rates)[0]))
        fewer = lit_at(Q, bench.stars, camera, float(np.sort(rates)[1]))
    focal_px = TRACKER_MM / TRACKER_UM * 1e3
    places = places_px(directions(), focal_px, DETECTOR_MIDDLE_PX)
    seen = within(places, DETECTOR_PX)
    assert seen == [0, 1, 2]
    found = {
        round(v_mag, 2): (x, y) for v_mag, x, y in zip(lit.v_mag, lit.x_px, lit.y_px, strict=True)
    }
    for star in seen:
        assert found.pop(STARS[star][2]) == pytest.approx(tuple(places[star]), abs=1e-5)
    assert not found
    # the faintest of all is left out where it is under the limit
    assert sorted(fewer.v_mag.round(2).tolist()) == [1.0, 2.5]


def test_a_tracker_s_oval_psf_is_oval_the_same_way_on_the_display(tmp_path: Path) -> None:
    """A tracker pixel is so many of the monitor's; behind a quarter turn its sides are swapped."""
    ratio = (COLLIMATOR_MM / PITCH_UM) / (TRACKER_MM / TRACKER_UM)
    for quarters in range(4):
        turn = Rotation.from_euler("z", 90 * quarters, degrees=True)
        q = quaternion_of(turn)
        square = {
            "collimator": {"q_cam_to_mon": q, "principal_point_px": None},
            "monitor": {"resolution_px": [400, 400]},
            "render": {"psf": "tracker"},
        }
        file = bench_file(tmp_path, square)
        psf = display_psf(file.config, tmp_path, bench_camera(file.config, tmp_path))
        assert isinstance(psf, GaussianPsf)
        wanted = [0.9 * ratio, 0.5 * ratio][:: -1 if quarters % 2 else 1]
        assert psf.sigma_px == pytest.approx(wanted, rel=1e-3)


def middle_and_spread(samples: FloatArray, per_px: int) -> tuple[FloatArray, FloatArray]:
    """The centroid of an image of a PSF from its middle, x and y in px, and its covariance, px2."""
    weight = samples / samples.sum()
    y, x = np.indices(samples.shape)
    places = np.stack([x, y], axis=-1) / per_px - (np.array(samples.shape[::-1]) // 2) / per_px
    middle = np.einsum("yx,yxk->k", weight, places)
    off = places - middle
    return middle, np.einsum("yx,yxk,yxl->kl", weight, off, off)


def test_a_tracker_s_coma_points_the_way_that_the_display_is_turned(tmp_path: Path) -> None:
    """Its tail is to one side: an image is turned and scaled with the places of stars."""
    samples = sampled(coma(0.9), 4, 9)
    hdu = fits.PrimaryHDU(samples)
    hdu.header["OVERSAMP"] = 4
    hdu.writeto(tmp_path / "psf.fits")
    turn = Rotation.from_euler("z", 33, degrees=True)
    keys = {
        "tracker": {"psf_sigma_px": None},
        "tracker.optics": {"psf": "psf.fits"},
        "collimator": {"q_cam_to_mon": quaternion_of(turn), "focal_length_mm": 611.0},
        "render": {"psf": "tracker"},
    }
    file = bench_file(tmp_path, keys)
    psf = display_psf(file.config, tmp_path, bench_camera(file.config, tmp_path))
    assert isinstance(psf, SampledPsf)
    ratio = (611.0 / PITCH_UM) / (TRACKER_MM / TRACKER_UM)
    onto = ratio * turn.as_matrix()[:2, :2]
    middle, spread = middle_and_spread(samples, 4)
    assert np.hypot(*middle) > 0.2
    shown_middle, shown_spread = middle_and_spread(psf.samples, psf.per_px)
    np.testing.assert_allclose(shown_middle, onto @ middle, atol=0.01)
    np.testing.assert_allclose(shown_spread, onto @ spread @ onto.T, rtol=0.03, atol=0.03)


def test_a_collimator_s_blur_is_added_to_both_axes_of_the_tracker_s(tmp_path: Path) -> None:
    """Its sigma is of monitor pixels; variances add."""
    ratio = (TRACKER_MM / TRACKER_UM) / (COLLIMATOR_MM / PITCH_UM)
    file = bench_file(tmp_path, {"collimator": {"psf_sigma_px": 0.3}})
    camera = bench_camera(file.config, tmp_path)
    psf = before_detector(file.config, tmp_path, camera)
    wanted = [math.hypot(sigma_px, 0.3 * ratio) for sigma_px in (0.9, 0.5)]
    assert psf.width_px == pytest.approx(wanted, rel=1e-9)
    seen = seen_by(file, camera)
    assert seen.pixel_px == pytest.approx(1 / ratio)
    assert seen.blur_px == pytest.approx(math.sqrt(math.prod(wanted)) / ratio)


def test_a_lens_beside_its_place_is_so_in_the_tracker_and_not_in_its_software(
    tmp_path: Path,
) -> None:
    """Of a lens that is warmer than at its calibration the software knows neither."""
    optics = {"decentre_x_um": 18.0, "decentre_y_um": -4.5}
    warm = {
        "focal_length_ppm_per_k": 20.0,
        "temperature_k": 303.0,
        "reference_temperature_k": 293.0,
    }
    file = bench_file(tmp_path, {"tracker.optics": {**optics, **warm}})
    tracker = file.config.tracker
    true = tracker_camera(tracker, tmp_path)
    x_px, y_px = DETECTOR_MIDDLE_PX
    assert true.principal_point_px == pytest.approx((x_px + 2.0, y_px - 0.5))
    assert true.focal_length_px == pytest.approx(TRACKER_MM / TRACKER_UM * 1e3 * (1 + 2e-4))
    known = flight_camera(tracker, tmp_path, true)
    assert known.principal_point_px == pytest.approx(DETECTOR_MIDDLE_PX)
    assert known.focal_length_px == pytest.approx(TRACKER_MM / TRACKER_UM * 1e3)
    for name, value in optics.items():
        alone = replace(
            tracker, optics=replace(tracker.optics, **{**dict.fromkeys(optics, 0.0), name: value})
        )
        beside = flight_camera(alone, tmp_path, tracker_camera(alone, tmp_path))
        assert beside.principal_point_px == pytest.approx(DETECTOR_MIDDLE_PX), name
    plain = bench_file(tmp_path).config.tracker
    camera = tracker_camera(plain, tmp_path)
    assert flight_camera(plain, tmp_path, camera) is camera


def test_the_aids_cross_stands_at_the_boresight_s_pixel(bench: Bench) -> None:
    """The boresight, cam z, is the turn's last column on the monitor."""
    middle = places_px(
        TURN.as_matrix()[:, 2][None], COLLIMATOR_MM / PITCH_UM * 1e3, SCREEN_MIDDLE_PX
    )
    x_px, y_px = middle[0]
    assert abs(x_px - y_px) > 1
    assert aid_levels_of(bench).cross_px == (round(x_px), round(y_px))


def test_a_monitor_by_a_file_has_the_file_s_own_middle_and_turn(tmp_path: Path) -> None:
    """Whatever the bench file says."""
    quaternion = quaternion_of(TURN)
    text = [
        'kind = "hilstar geometry 1"',
        f"resolution_px = {list(SCREEN_PX)}",
        "focal_length_px = 2345.0",
        "principal_point_px = [151.0, 93.0]",
        f"q_cam_to_mon = {quaternion}",
        "k1 = -0.02",
    ]
    (tmp_path / "geometry.toml").write_text("\n".join(text) + "\n")
    file = bench_file(tmp_path)
    camera = real_monitor(file.config, tmp_path, "geometry.toml")
    assert camera.focal_length_px == 2345.0
    assert camera.principal_point_px == (151.0, 93.0)
    np.testing.assert_allclose(camera.cam_to_image, TURN.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(to_matrix(np.array(quaternion)), TURN.as_matrix(), atol=1e-12)
