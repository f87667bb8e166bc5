"""A fault's window on the tracker's image, and what is taken of it: planted images, no bench."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.rotation import to_matrix
from hilstar.instruments.simulate.star_finder import Matched
from hilstar.instruments.verify.faulty_fields import (
    FaultSeen,
    FaultWindow,
    attitude_at,
    fault_lines,
    fault_seen,
    looked_at_ns,
    median_off_px,
)
from hilstar.optics.layers.fault_kinds import KINDS
from hilstar.optics.layers.fault_light import icrs_direction
from hilstar.tracker.centroids import Centroids

SIZE_PX = (120, 80)
DRAWS = 200


# Before a PSF that is wider along y: six of 1.4 px, to whole pixels, and one more are 10 px.
WINDOW = FaultWindow.of(SIZE_PX, (0.8, 1.4))


def test_a_window_is_six_sigmas_about_its_place_and_whole_on_the_detector():
    rows, columns = WINDOW.about(np.array([30.4, 50.6]))
    assert (rows.start, rows.stop, columns.start, columns.stop) == (41, 62, 20, 41)
    for place_px, is_whole in (
        ((10.0, 10.0), True),
        ((9.9, 40.0), False),
        ((40.0, 9.9), False),
        ((109.9, 69.9), True),
        ((110.0, 40.0), False),
        ((40.0, 70.0), False),
    ):
        assert WINDOW.is_whole(np.array(place_px)) is is_whole


POINT = KINDS["false-star"](name="ghost", radec_deg=(1.0, 2.0), electrons=5.0)
GLOW = KINDS["glow"](name="sun", icrs=(0.0, 0.6, 0.8), electrons_per_s=8.0, scale_deg=4.0)


def test_a_point_of_light_is_what_it_adds_in_its_window():
    asked = np.zeros(SIZE_PX[::-1])
    shown = np.zeros(SIZE_PX[::-1])
    asked[50, 30], shown[50, 31] = 1000.0, 600.0
    shown[52, 31] = 200.0
    shown[5, 100] = 5e4  # another star's twinkle, far from it
    seen = fault_seen(POINT, asked, shown, np.array([30.0, 50.0]), WINDOW)
    assert (seen.asked_e, seen.seen_e) == pytest.approx((1000.0, 800.0))
    assert seen.flux_mag == pytest.approx(-2.5 * math.log10(0.8))
    # a quarter of its light stands two rows further down
    assert seen.off_px == pytest.approx(math.hypot(1.0, 0.5))
    for place_px in (np.array([5.0, 50.0]), None):
        beside = fault_seen(POINT, asked, shown, place_px, WINDOW)
        assert beside == FaultSeen("ghost", "false-star", note="not on the tracker's image")


def test_a_glow_is_what_it_adds_to_the_whole_image():
    asked = np.linspace(0.0, 2.0, SIZE_PX[0]) * np.ones(SIZE_PX[::-1])
    seen = fault_seen(GLOW, asked, 1.1 * asked, None, WINDOW)
    assert seen.asked_e == pytest.approx(asked.sum())
    assert seen.flux_mag == pytest.approx(-2.5 * math.log10(1.1))
    assert seen.off_px is None
    nothing = fault_seen(GLOW, 0 * asked, 0 * asked, None, WINDOW)
    assert (nothing.asked_e, nothing.note) == (0.0, "not on the tracker's image")
    dark = fault_seen(GLOW, asked, 0 * asked, None, WINDOW)
    assert dark.flux_mag is None


def test_a_fault_is_shown_within_the_image_and_a_glow_beside_it(rng):
    """A point anywhere within two fifths of the field's radius, as often by area; a glow's middle
    a fifth beyond the field's edge.
    """
    angles_rad = {}
    for fault, toward in ((POINT, icrs_direction(POINT)), (GLOW, np.array(GLOW.icrs))):
        attitudes = [attitude_at(fault, toward, 0.1, rng) for _ in range(DRAWS)]
        boresights = np.array([to_matrix(q)[2] for q in attitudes])
        angles_rad[fault.name] = np.arccos(boresights @ toward)
    np.testing.assert_allclose(angles_rad["sun"], 1.2 * 0.1, rtol=1e-6)
    areas = (angles_rad["ghost"] / (0.4 * 0.1)) ** 2
    assert areas.max() < 1 + 1e-6
    # the mean of so many uniform numbers, to four of its sigmas
    assert areas.mean() == pytest.approx(0.5, abs=4 / math.sqrt(12 * DRAWS))


def test_each_fault_has_a_line_of_its_figures():
    lines = fault_lines(
        [
            FaultSeen("ghost", "false-star", 1000.0, 800.0, 0.2423, 0.5),
            FaultSeen("loss", "drop", note="of the run's frames"),
            FaultSeen("step", "attitude-step", off_px=0.0123),
            FaultSeen("none", "attitude-step"),
        ]
    )
    assert [" ".join(line.split()) for line in lines] == [
        "fault ghost (false-star): 1000 e- asked for, 800 seen, +0.2423 mag, 0.5000 px off",
        "fault loss (drop): of the run's frames",
        "fault step (attitude-step): 0.0123 px off",
        "fault none (attitude-step): nothing was found",
    ]


FLASH = KINDS["flash"](name="flare", radec_deg=(1.0, 2.0), electrons=5.0, for_s=3.0)


@pytest.mark.parametrize(("fault", "since_s"), [(FLASH, 1.5), (GLOW, 0.0)])
def test_a_fault_is_looked_at_half_way_through_or_at_its_beginning_where_it_never_ends(
    fault, since_s
):
    assert looked_at_ns(fault) == round(since_s * 1e9)


def test_stars_of_a_wrong_attitude_are_off_by_their_median_distance():
    """Three that are found, by 0.5, 1 and 1.3 px in several directions, and one that is not."""
    x_px = np.array([20.0, 40.0, 60.0, 80.0])
    y_px = np.full(4, 5.0)
    none = np.zeros(3)
    found = Centroids(
        np.array([60.5, 20.3, 39.0]),
        np.array([6.2, 5.4, 5.0]),
        none,
        none,
        none.astype(int),
        none > 0,
    )
    assert median_off_px(Matched(found, np.array([1, 2, 0, -1])), x_px, y_px) == pytest.approx(1.0)
    assert median_off_px(Matched(found, np.full(4, -1)), x_px, y_px) is None
