"""What of an error is the display's, the glass's, or goes with the frame: each by a closed form, of
stars and answers that all differ.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess import bench_effects
from hilstar.instruments.assess.bench_effects import (
    DisplayCost,
    _field_turn,
    display_cost,
    field_magnitudes,
    matched_turn,
    noise_limit,
    seen_cost,
    slices_of,
)
from hilstar.instruments.simulate.noise import field_stars
from hilstar.instruments.simulate.star_finder import Matched
from hilstar.optics.camera import Camera
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.star_light import bench_stars
from hilstar.tracker.centroids import Centroids
from tests.support.benches import bench_text
from tests.support.planted_tracker import attitude, scalar_first

CAMERA = Camera((1200, 700), 5000.0, (599.5, 349.5), np.eye(3))
TURN_ARCSEC = np.array([3.0, -5.0, 40.0])


def turned_places(x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where a pinhole sees these stars after a turn by TURN_ARCSEC."""
    rays = np.stack([(x_px - 599.5) / 5000, (y_px - 349.5) / 5000, np.ones(len(x_px))], axis=1)
    turned = rays @ to_matrix(from_rotation_vector(TURN_ARCSEC / ARCSEC_PER_RAD)).T
    x, y = 5000 * turned[:, :2].T / turned[:, 2]
    return x + 599.5, y + 349.5


def matched(x_px: FloatArray, y_px: FloatArray, index: list[int], flux: FloatArray) -> Matched:
    count = len(flux)
    inside = np.zeros(count, dtype=bool)
    found = Centroids(x_px, y_px, flux, flux, np.full(count, 9), inside)
    return Matched(found, np.array(index))


def test_a_display_s_turn_is_that_of_the_stars_found_in_both(rng):
    """Of six stars one is not found in the sky and one not as shown; those shown are found in
    another order, beside one that is none of them.
    """
    x_px, y_px = rng.uniform(100, 600, (2, 6))
    flux = rng.uniform(1, 50, 6)
    moved = turned_places(x_px, y_px)
    order = np.array([4, 2, 5, 0, 1])
    shown_x, shown_y = (np.append(at[order], 333.0) for at in moved)
    sky = matched(x_px, y_px, [0, 1, 2, -1, 4, 5], flux)
    shown = matched(shown_x, shown_y, [3, 4, 1, -1, 0, -1], np.ones(6))
    assert matched_turn(CAMERA, sky, shown) == pytest.approx(TURN_ARCSEC, abs=0.02)
    few = matched(shown_x, shown_y, [3, 4, -1, 1, -1, -1], np.ones(6))
    assert np.isnan(matched_turn(CAMERA, sky, few)).all()


def test_a_field_s_turn_is_mostly_that_of_its_bright_stars():
    """Three that are a million times as bright as the others have moved, and these have not."""
    x_px = np.array([100.0, 900.0, 400.0, 200.0, 700.0, 1000.0])
    y_px = np.array([100.0, 200.0, 600.0, 300.0, 350.0, 100.0])
    moved = np.stack(turned_places(x_px, y_px), axis=1) - np.stack([x_px, y_px], axis=1)
    moved[3:] = 0.0
    kind = [("x_px", "f8"), ("y_px", "f8"), ("electrons_per_s", "f8")]
    light = np.array([1e6] * 3 + [1.0] * 3)
    rows = np.array(list(zip(x_px, y_px, light, strict=True)), dtype=kind)
    assert _field_turn(CAMERA, rows, moved) == pytest.approx(TURN_ARCSEC, abs=0.05)


def test_a_display_s_cost_is_its_scatter_and_the_share_that_answers_have_of_it():
    """A constant turn is a bias, and no error of the display's. Answers have 0.6 of the scatter."""
    wave = np.sin(np.arange(40))
    error = np.array([100.0, -50.0, 7.0]) + wave[:, None] * [1.0, -2.0, 5.0]
    left = 0.6 * (error - error.mean(axis=0))
    error[7] = np.nan
    cost = display_cost(error, left)
    kept = np.delete(wave, 7)
    spread = kept.std(ddof=1)
    assert cost is not None and cost.attitudes == 39
    assert cost.cross_arcsec == pytest.approx(math.sqrt(2.5) * spread)
    assert cost.roll_arcsec == pytest.approx(5 * spread)
    assert cost.seen == pytest.approx(0.6, rel=1e-3)
    # three axes of 39 answers, each with a noise of 0.6 of the error
    assert cost.sigma_seen == pytest.approx(0.6 / math.sqrt(3 * 39), rel=0.01)


@pytest.mark.parametrize(
    ("seen", "share"), [(0.31, 0.31**2), (0.3, 0.0), (0.9, 0.81), (1.3, 1.0), (-0.9, 0.0)]
)
def test_no_more_than_all_of_a_display_s_variance_is_subtracted_and_none_that_is_unsure(
    seen, share
):
    assert DisplayCost(1.0, 2.0, 30, seen, 0.1).subtracted == pytest.approx(share)


def test_slices_have_back_what_the_fits_took_and_leave_out_what_is_not_known():
    """400 answers, of which 100 numbers were taken, by a value that 100 of them have not."""
    value = np.concatenate([np.arange(300.0), np.full(100, np.nan)])
    sense = np.tile([1.0, -1.0], 200)[:, None]
    slices = slices_of(value, [3.0, 4.0, 12.0] * sense, [6.0, 8.0, 24.0] * sense, 100.0)
    assert [(each.low, each.high, each.answers) for each in slices] == [
        (pytest.approx(59.8 * k), pytest.approx(59.8 * (k + 1)), 60) for k in range(5)
    ]
    growth = math.sqrt(400 / 300)
    for each in slices:
        assert each.noise_cross_arcsec == pytest.approx(growth * math.sqrt(12.5))
        assert each.noise_roll_arcsec == pytest.approx(growth * 12)
        assert (each.rms_cross_arcsec, each.rms_roll_arcsec) == pytest.approx((math.sqrt(50), 24))
    assert slices_of(value[282:], sense[282:] * np.ones(3), sense[282:] * np.ones(3), 0.0) == ()
    (alike,) = slices_of(np.full(30, 7.0), np.ones((30, 3)), np.ones((30, 3)), 0.0)
    assert (alike.low, alike.high, alike.answers) == (7.0, 7.0, 30)
    # twenty are enough for a slice
    (fewest,) = slices_of(np.full(20, 7.0), np.ones((20, 3)), np.ones((20, 3)), 0.0)
    assert fewest.answers == 20


def test_a_limit_is_the_median_of_fields_all_along_a_run(monkeypatch):
    asked = []

    def limits(file: Any, q: FloatArray) -> FloatArray:
        asked.append(q[:, 0].tolist())
        cross = np.where(q[:, 0] < 60, 1.0, np.where(q[:, 0] < 80, 3.0, np.inf))
        return np.stack([cross, np.full(len(q), np.inf)], axis=1)

    monkeypatch.setattr(bench_effects, "attitude_limits_arcsec", limits)
    q = np.arange(111.0)[:, None] * np.ones(4)
    limit = noise_limit(None, q)  # type: ignore[arg-type]
    assert asked == [[10.0 * k for k in range(12)]]
    assert (limit.cross, limit.roll) == (2.0, None)  # between the sixth and the seventh
    assert noise_limit(None, q[30:]).cross == 3.0  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> BenchFile:
    tracker = {"resolution_px": [1200, 700], "focal_length_mm": 65}
    text = bench_text({"tracker": tracker, "sky": {"faintest_v_mag": 6.0}})
    return bench_file_of(tmp_path_factory.mktemp("bench") / "bench.toml", text)


def looks(count: int) -> FloatArray:
    """Attitudes (n, 4) of fields that differ."""
    number = np.arange(count)
    sky = attitude(lambda t: (84 + 3.0 * t, -1.2 + 2 * np.cos(t), 20 * t), number.astype(float))
    return scalar_first(sky)


def test_a_field_s_magnitude_is_its_own_where_it_is_summed(bench, monkeypatch):
    """Of seven answers four are summed, and the others have one beside them."""
    q = looks(7)
    each = np.array([field_magnitudes(bench, q[k : k + 1])[0] for k in range(7)])
    assert len(set(each.tolist())) == 7
    monkeypatch.setattr(bench_effects, "FIELDS", 4)
    found = field_magnitudes(bench, q)
    assert found[::2] == pytest.approx(each[::2])
    for k in (1, 3, 5):
        assert found[k] in (found[k - 1], found[k + 1])


def test_a_star_by_another_s_name_is_no_error_of_a_glass(bench):
    """Of each field's stars one has the place of another; all others are off by 0.1 px."""
    stars = bench_stars(bench.config, bench.folder)
    camera = tracker_camera(bench.config.tracker, bench.folder)
    rng = np.random.default_rng(2)
    q = looks(10)
    centroids = []
    count = 0
    for attitude_q in q:
        rows = field_stars(stars, camera, attitude_q)
        places_px = np.stack([rows["x_px"], rows["y_px"]], axis=1)
        places_px += rng.normal(0, 0.1, places_px.shape)
        places_px[0] += 60.0
        named = zip(places_px.tolist(), rows["hip"].tolist(), strict=True)
        centroids.append([ReportedStar(x_px, y_px, None, hip) for (x_px, y_px), hip in named])
        count += len(rows) - 1
    cost = seen_cost(bench, q, centroids)
    assert cost is not None
    assert (cost.source, cost.stars, cost.attitudes) == ("answers' stars", count, 10)
    # an error of so many numbers is known to 1 / sqrt(2 n), and a split takes some
    assert cost.rms_px["total"] == pytest.approx(0.1 * math.sqrt(2), rel=4 / math.sqrt(4 * count))
