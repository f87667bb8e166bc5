"""Stars that a tracker reports against those that were lit: which of them stand alone on a detector
of unequal sides, and which report is whose.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.stars import LitStars, judge_stars, lit_at, lit_by_report
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.config import parse_config
from tests.support.benches import bench_text
from tests.support.stars import stars_at

SIZE_PX = (100, 60)


def lit_stars(*places_and_light: tuple[float, float, float]) -> LitStars:
    """Lit stars at x, y, px, with electrons per second; V and B-V tell one from another."""
    x_px, y_px, light = np.array(places_and_light, dtype=np.float64).reshape(-1, 3).T
    number = np.arange(len(x_px), dtype=np.float64)
    return LitStars(x_px, y_px, number, -number, light)


@pytest.mark.parametrize(
    ("x_px", "y_px", "alone"),
    [
        # the detector's edges are at -0.5 and 59.5: its last pixel is at 59
        *((50.0, y_px, alone) for y_px, alone in ((8.0, 1), (7.9, 0), (51.0, 1), (51.1, 0))),
        *((x_px, 30.0, alone) for x_px, alone in ((8.0, 1), (7.9, 0), (91.0, 1), (91.1, 0))),
    ],
)
def test_a_star_within_eight_pixels_of_an_edge_is_not_judged(x_px, y_px, alone):
    found = judge_stars((), lit_stars((x_px, y_px, 10.0)), SIZE_PX)
    assert len(found.lit.x_px) == alone


def test_of_stars_beside_each_other_the_brightest_is_judged_and_each_report_is_of_one():
    """The third star is beside the second alone, and fainter; the last stands alone."""
    lit = lit_stars((30, 30, 50.0), (36, 30, 400.0), (43, 30, 10.0), (70, 20, 90.0))
    reports = (
        ReportedStar(30.5, 30.0, 5.0),
        ReportedStar(36.25, 29.0, 40.0),
        ReportedStar(68.0, 21.0, 9.0),
        ReportedStar(69.5, 20.5, 900.0),  # nearer to the last one
        ReportedStar(10.0, 50.0, 1.0),
    )
    found = judge_stars(reports, lit, SIZE_PX)
    assert found.lit.v_mag.tolist() == [1.0, 3.0]  # the brighter first
    assert found.dx_px.tolist() == [0.25, -0.5] and found.dy_px.tolist() == [-1.0, 0.5]
    # reported over lit: 40 / 400 and 900 / 90
    assert found.signal_mag == pytest.approx([2.5, -2.5])
    assert found.false == 2  # of the third and the last report no star was lit
    assert np.isnan(judge_stars((), lit, SIZE_PX).dx_px).all()


def test_one_report_between_two_stars_is_the_brighter_one_s():
    lit = lit_stars((30, 30, 50.0), (34, 30, 60.0))
    found = judge_stars((ReportedStar(32.0, 30.0, 1.0),), lit, SIZE_PX)
    assert (found.lit.v_mag.tolist(), found.dx_px.tolist(), found.false) == ([1.0], [-2.0], 0)


def test_a_detector_sees_stars_to_the_edges_of_its_pixels():
    """And those of enough light; the camera's axes are the sky's."""
    tables = {"tracker": {"resolution_px": list(SIZE_PX)}}
    camera = tracker_camera(parse_config(Path("b.toml"), bench_text(tables)).tracker, Path())
    x_px, y_px = np.array(
        [
            (-0.4, 20),
            (-0.6, 20),
            (99.4, 20),
            (99.6, 20),
            (30, -0.4),
            (30, -0.6),
            (30, 59.4),
            (30, 59.6),
            (50, 30),
            (51, 31),
        ],
        dtype=np.float64,
    ).T
    light = np.array([9.0] * 8 + [4.0, 3.9])
    stars = stars_at(camera.rays(x_px, y_px), light)
    found = lit_at(np.array([1.0, 0.0, 0.0, 0.0]), stars, camera, 4.0)
    seen = sorted(zip(found.x_px.round(6), found.y_px.round(6), strict=True))
    assert seen == [(-0.4, 20), (30, -0.4), (30, 59.4), (50, 30), (99.4, 20)]


def test_reports_matched_one_at_a_time_are_each_judged_as_if_it_were_alone(rng):
    """A crowd in which stars hide one another, reports beside stars and of none."""
    count = 60
    places = rng.uniform((0, 0), SIZE_PX, size=(count, 2))
    lit = lit_stars(*np.column_stack([places, rng.permutation(count) + 1.0]))
    reported = np.concatenate(
        [places + rng.normal(0, 1, places.shape), rng.uniform(0, 60, (20, 2))]
    )
    reports = tuple(ReportedStar(x_px, y_px, 1.0) for x_px, y_px in reported)
    expected = []
    for report in reports:
        alone = judge_stars((report,), lit, SIZE_PX)
        its_v_mag = alone.lit.v_mag[np.isfinite(alone.dx_px)]
        expected.append(int(its_v_mag[0]) if len(its_v_mag) else -1)
    assert lit_by_report(reports, lit, SIZE_PX).tolist() == expected
    assert {star >= 0 for star in expected} == {True, False}
    assert lit_by_report((), lit, SIZE_PX).tolist() == []
    assert lit_by_report(reports[:1], lit_stars(*np.zeros((0, 3))), SIZE_PX).tolist() == [-1]
