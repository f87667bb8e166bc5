"""The virtual tracker before the display: where frames stand in an exposure, and what a change of
its bench file changes.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.optics.layers.view import STILL, View
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from tests.support.benches import bench_text

FOCAL_PX = 20e3 / 13
RIGEL = from_radec_roll_deg(78.634, -8.202, 0.0)
EXPOSURE_S, REFRESH_HZ = 0.045, 60.0  # 2.7 frames, which are three
RATE_DEG_S = 3.0
AROUND_PX = 12  # of Rigel, where no star to V 4 stands
# Codes of 10 bits move the centre of a star's light, and its width, by hundredths of a pixel.
CODES_PX, CODES_PX2 = 0.03, 0.06


def shown_file(
    path: Path,
    quantisation: str = "exact",
    background: Any = None,
    monitor: dict[str, Any] | None = None,
    faintest_v_mag: float = 4.0,
    **tracker: Any,
) -> BenchFile:
    """A bench file whose display covers the tracker's field."""
    tables = {
        "tracker": {
            "focal_length_mm": 20,
            "resolution_px": [96, 64],
            "transmission": None,
            "exposure_s": EXPOSURE_S,
            **tracker,
        },
        "sky": {"faintest_v_mag": faintest_v_mag},
        "monitor": {
            "resolution_px": [640, 480],
            "bits": 10,
            "refresh_hz": REFRESH_HZ,
            **(monitor or {}),
        },
        "collimator": {"focal_length_mm": 250},
        "render": {"quantisation": quantisation},
    }
    if background is not None:
        tables["background"] = background
    path.write_text(bench_text(tables))
    return read_bench_file(path)


def moments(mean_e: FloatArray) -> tuple[float, float, float]:
    """The centre of light along x and along y, px, and its variance along x, px^2."""
    rows, columns = np.indices(mean_e.shape)
    y, x = np.unravel_index(mean_e.argmax(), mean_e.shape)
    near = (abs(columns - x) <= AROUND_PX) & (abs(rows - y) <= AROUND_PX)
    weights = np.where(near, mean_e - np.median(mean_e), 0.0)
    weights /= weights.sum()
    x_px, y_px = float((weights * columns).sum()), float((weights * rows).sum())
    return x_px, y_px, float((weights * (columns - x_px) ** 2).sum())


def test_frames_of_an_exposure_stand_evenly_about_its_middle(tmp_path: Path) -> None:
    """Three frames at a third of the path from each other: a variance of 2/27 of its square."""
    turn = np.radians([0.0, RATE_DEG_S, 0.0])
    path_px = np.radians(RATE_DEG_S) * EXPOSURE_S * FOCAL_PX
    with contextlib.closing(DisplayTracker(shown_file(tmp_path / "bench.toml"))) as tracker:
        seen = {}
        for name, motion in (("still", STILL), ("turning", turn)):
            view = View.exposure(RIGEL, motion, EXPOSURE_S)
            exposure = tracker.expose(view, None)
            seen[name] = moments(exposure.mean_e)
    (still_x, still_y, still_px2), (x_px, y_px, turning_px2) = seen["still"], seen["turning"]
    assert (x_px, y_px) == pytest.approx((still_x, still_y), abs=CODES_PX)
    assert turning_px2 - still_px2 == pytest.approx(2 / 27 * path_px**2, abs=CODES_PX2)


@pytest.mark.parametrize(
    "change",
    [
        {"principal_point_px": [50.5, 29.0]},
        {"exposure_s": 0.09},
        {"psf_sigma_px": [1.3, 0.9]},
        {"aperture_mm": 21.0},
        {"distortion": "lens.toml"},
    ],
)
def test_a_tracker_that_changes_is_one_of_the_new_file(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    """Its image is that of a tracker which was never another, with the glow of the screen's black."""
    (tmp_path / "lens.toml").write_text("k1 = 0.5\n")
    glows = {"calibration": "lcd-example", "bits": 8}
    new = shown_file(tmp_path / "new.toml", monitor=glows, **change)
    images = []
    old = shown_file(tmp_path / "bench.toml", monitor=glows)
    with contextlib.closing(DisplayTracker(old)) as tracker:
        exposure_s = new.config.tracker.exposure_s
        view = View.exposure(RIGEL, STILL, exposure_s)
        images.append(tracker.expose(view, None).mean_e)
        tracker.change(new)
        images.append(tracker.expose(view, None).mean_e)
    with contextlib.closing(DisplayTracker(new)) as fresh:
        images.append(fresh.expose(view, None).mean_e)
    before, after, wanted = images
    np.testing.assert_array_equal(after, wanted)
    assert not np.array_equal(before, after) or "exposure_s" in change


def test_a_black_screen_is_as_bright_as_the_image_between_its_stars(tmp_path: Path) -> None:
    background = {"electrons_per_px": 2000.0, "gradient_electrons_across": [3000.0, 0.0]}
    file = shown_file(tmp_path / "bench.toml", background=background)
    with contextlib.closing(DisplayTracker(file)) as tracker:
        dark_dn = tracker.dark_dn(EXPOSURE_S)
        image = tracker.expose(View.exposure(RIGEL, STILL, EXPOSURE_S), None)
    assert dark_dn is not None
    gain_e_per_dn = file.config.tracker.detector.gain_e_per_dn
    assert np.ptp(dark_dn) == pytest.approx(3000.0 / gain_e_per_dn, rel=0.05)
    # stars to V 4 are in a hundredth of the pixels; a code is a DN
    off_dn = np.abs(image.dn - dark_dn)
    assert np.percentile(off_dn, 90) <= 1.0


def test_a_quantisation_that_was_chosen_stays_where_the_display_does(tmp_path: Path) -> None:
    file = shown_file(tmp_path / "bench.toml", quantisation="auto")
    moved = shown_file(tmp_path / "new.toml", "auto", principal_point_px=[50.5, 29.0])
    with contextlib.closing(DisplayTracker(file)) as tracker:
        chosen = tracker._bench.config.render
        tracker.change(moved)
        assert tracker._bench.config.tracker.principal_point_px == (50.5, 29.0)
        assert tracker._bench.config.render == chosen
    assert chosen.quantisation != "auto"


def test_the_stars_of_a_truth_that_are_drawn_make_all_of_its_image(tmp_path: Path) -> None:
    """On codes of 6 bits: a catalogue that ends before the brightest of the others gives the same."""
    images = []
    counts = []
    faintest_v_mag = 12.0
    for name in ("deep", "shallow"):
        path = tmp_path / f"{name}.toml"
        file = shown_file(path, monitor={"bits": 6}, faintest_v_mag=faintest_v_mag)
        with contextlib.closing(DisplayTracker(file)) as tracker:
            exposure = tracker.expose(View.exposure(RIGEL, STILL, EXPOSURE_S), None)
        images.append(exposure.mean_e)
        drawn = exposure.truth["drawn"]
        counts.append((int(drawn.sum()), len(drawn)))
        if name == "deep":
            faintest_v_mag = float(exposure.truth["v_mag"][~drawn].min()) - 1e-6
    (drawn_of_deep, of_deep), (drawn_of_shallow, of_shallow) = counts
    assert 0 < drawn_of_deep == drawn_of_shallow == of_shallow < of_deep
    np.testing.assert_array_equal(*images)
