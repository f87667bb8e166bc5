"""Where hilstar fails: each method is within its tolerance where it is easy, and leaves it
between two of its own rows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.rotation import propagate
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.study import limits
from hilstar.instruments.study.limits import StressLimit, limits_finding
from tests.support.benches import ROOT
from tests.support.recorded import assert_recorded
from tests.support.tables import csv_rows

# Of hilstar's own claims: docs/where-it-fails.md and the modules' own.
ROOM_STARS = 250_000  # stars of sigma 0.85 px fill a frame
RED_VI_MAG = 2.5  # V-I to which spectra by colour are told to be good
RED_LIMIT_MAG = 0.026  # 2.4 % of a signal
HALF_SAMPLE = 0.5


def test_the_command_draws_one_chart(whole_study):
    assert len(whole_study("limits", {"limits"}).findings) == 13


@pytest.fixture(scope="module")
def small(small_run):
    """The quick study."""
    return small_run(limits.run, True)


@pytest.fixture(scope="module")
def limits_study(small):
    return small.folder, small.told, small.rows("limits")


def test_the_page_s_table_is_of_what_is_measured_now(limits_study):
    """Where a quick study has the same stress; the rest is finer."""
    assert_recorded(
        limits_study[0] / "limits.csv", ("method", "stress", "at"), ("error", "tolerance")
    )


def limit_rows(rows, stress):
    """The stress, the error, and where they meet, of one limit."""
    own = [row for row in rows if row["stress"] == stress]
    at, error = (np.array([float(row[name]) for row in own]) for name in ("at", "error"))
    return at, error, float(own[0]["meets"]), float(own[0]["tolerance"])


def test_the_place_where_a_method_leaves_its_tolerance_is_between_its_own_rows(limits_study):
    _, lines, rows = limits_study
    assert len(lines) == 1 + len({row["stress"] for row in rows}) == 13
    assert_meets_between_rows(rows)
    assert_meets_between_rows(csv_rows(ROOT / "results" / "limits.csv"))


def assert_meets_between_rows(rows):
    for stress in dict.fromkeys(row["stress"] for row in rows):
        at, error, meets, tolerance = limit_rows(rows, stress)
        assert error[0] <= tolerance, f"{stress}: over the tolerance where it is easy"
        over = np.flatnonzero(error > tolerance)
        if not len(over):
            assert math.isnan(meets)
            continue
        before, after = at[over[0] - 1], at[over[0]]
        assert min(before, after) <= meets <= max(before, after)


def test_the_limits_are_those_that_hilstar_tells_elsewhere(limits_study):
    _, _, rows = limits_study
    stars, lost_mag, _, _ = limit_rows(rows, "stars in view")
    assert not lost_mag[stars < ROOM_STARS].any()
    assert (lost_mag[stars > 1.5 * ROOM_STARS] > 0).all()
    vi_mag, off_mag, _, _ = limit_rows(rows, "V-I [mag]")
    assert (off_mag[vi_mag < RED_VI_MAG - 0.5] < RED_LIMIT_MAG).all()
    assert off_mag[vi_mag > RED_VI_MAG + 1.0].max() > 2 * RED_LIMIT_MAG


@pytest.mark.parametrize("measured", [limits.poles, limits.wide_fields])
def test_directions_and_attitudes_are_right_up_to_where_they_have_no_place(measured):
    limit = measured()
    assert math.isnan(limit.meets) and not limit.fails
    assert (limit.error < 1e-3 * limit.tolerance).all()
    assert limit.words.startswith("nowhere to ")


def test_a_wide_field_s_directions_are_as_far_from_the_axis_as_is_said(monkeypatch):
    """Along x, from 30 degrees to 1e-7 short of 90."""
    asked = []

    def camera(*given):
        made = monitor_camera(*given)
        project = made.project
        return SimpleNamespace(
            project=lambda rays: asked.append(rays) or project(rays), rays=made.rays
        )

    monkeypatch.setattr(limits, "monitor_camera", camera)
    limit = limits.wide_fields()
    (rays,) = asked
    short_deg = np.degrees(np.arctan2(rays[:, 2], rays[:, 0]))
    np.testing.assert_allclose(short_deg, limit.at, rtol=1e-6)
    assert (limit.at[0], limit.at[-1]) == pytest.approx((60.0, 1e-7))


def test_a_turn_over_parted_refreshes_is_off_by_their_part():
    """By f (1 - f) / 2 of a refresh over n + f refreshes (server/sync.py), to first order."""
    limit = limits.parted_refreshes()
    per_deg_s = 3600 / 60 * 0.3 * 0.7 / 2 / 6.3
    assert limit.error == pytest.approx(per_deg_s * limit.at, rel=0.02)
    assert limit.meets == pytest.approx(limits.TOLERANCE_ARCSEC / per_deg_s, rel=0.05)


def test_a_narrow_star_s_moment_is_drawn_to_the_middle_of_its_pixel():
    """Of a star at p from a pixel's middle the pixels beside it have what lies beyond its edges:
    their difference is the moment, where no light reaches further.
    """
    limit = limits.narrow_sprites()
    phases_px = np.linspace(0, 0.5, 11)
    for sigma_px, error_px in zip(limit.at[-6:], limit.error[-6:], strict=True):
        beside = ndtr((phases_px - 0.5) / sigma_px) - ndtr(-(phases_px + 0.5) / sigma_px)
        assert error_px == pytest.approx(np.abs(beside - phases_px).max(), abs=1e-6)
    assert limit.error[0] < 1e-6
    # the first harmonic of the pixels, exp(-2 pi^2 sigma^2) / pi, is most of a wider star's error
    first_px = math.sqrt(-math.log(math.pi * limits.TOLERANCE_PX) / 2) / math.pi
    assert limit.meets == pytest.approx(first_px, rel=0.02)


def test_a_pinhole_on_a_tilted_screen_is_off_by_the_square_of_the_field():
    """Along x the depth grows by x sin t, so a place x is off by x^2 t / f less what a rotation
    takes.
    """
    limit = limits.tilted_screen()
    at, error = limit.at, limit.error
    assert error[5] / at[5] == pytest.approx(error[0] / at[0], rel=0.01)
    widest_px = (959.5**2) * math.radians(at[0]) / (350e3 / 57.65)
    assert 0.1 * widest_px < error[0] < 0.6 * widest_px


def limit_of(errors, at=(1.0, 2.0, 4.0)) -> StressLimit:
    return StressLimit(
        "A method", limits.AGE, "packets over {} ms old", "px", np.array(at), np.array(errors)
    )


def test_a_crossing_is_found_between_points_and_none_is_said_as_such():
    tolerance = limits.TOLERANCE_PX
    crossing = limit_of([tolerance / 10, tolerance / 10, tolerance * 10])
    assert crossing.meets == pytest.approx(2.0 + HALF_SAMPLE * 2.0)
    assert crossing.words == "packets over 3 ms old"
    assert limit_of([0.0, 0.0, 0.0]).words == "nowhere to 4 ms"
    assert limit_of([1.0, 1.0, 1.0]).words == "everywhere"
    falling = limit_of([0.0, tolerance * 10, 0.0])
    assert 1.0 < falling.meets < 2.0
    # a method that reaches its tolerance keeps it
    assert not limit_of([0.0, tolerance, tolerance]).fails
    others = [limit_of([0.0, 0.0, 0.0]), replace(crossing, stress=limits.BITS)]
    assert limits_finding([crossing, *others]) == (
        "2 of 3 methods of hilstar leave their tolerance: packets over 3 ms old"
    )


@pytest.mark.parametrize("power", [2, 3])
def test_a_turn_is_foretold_along_a_straight_line_from_the_newest_packet(power):
    """Of a turn a t^n the line from a packet at t0 is off by a (t^n - t0^n - n t0^(n-1) (t - t0));
    packets come at 10 Hz, frames at 60 Hz from 1 s on.
    """
    size_rad = 1e-3

    def attitude(t_ns: int) -> np.ndarray:
        return propagate(limits.ORION, limits.Z, size_rad * (t_ns / NS_PER_S) ** power)

    frames = np.arange(round(limits.SPAN_S * limits.REFRESH_HZ))
    t = 1 + frames / limits.REFRESH_HZ
    newest = 1 + frames // 6 / 10
    line = newest**power + power * newest ** (power - 1) * (t - newest)
    rms_arcsec = np.sqrt(np.mean((t**power - line) ** 2)) * size_rad * ARCSEC_PER_RAD
    found_arcsec = limits.predicted_rms_arcsec(attitude, 10.0, 0.0)
    # rates are differences over a millisecond at the most, and times whole ns: 1e-6 of the turn
    assert found_arcsec == pytest.approx(rms_arcsec, rel=1e-5)
    # a packet that is a period old is one that comes a period later
    later = newest - 1 / 10
    line = later**power + power * later ** (power - 1) * (t - later)
    rms_arcsec = np.sqrt(np.mean((t**power - line) ** 2)) * size_rad * ARCSEC_PER_RAD
    assert limits.predicted_rms_arcsec(attitude, 10.0, 100.0) == pytest.approx(rms_arcsec, rel=1e-5)


def test_a_quick_study_s_table_chart_and_lines_are_those_of_its_limits(small):
    """Beside the recorded rows of a whole study, where both have the same stress."""
    run = small
    rows = run.rows("limits")
    stresses = list(dict.fromkeys(row["stress"] for row in rows))
    recorded = csv_rows(ROOT / "results" / "limits.csv")
    assert stresses == list(dict.fromkeys(row["stress"] for row in recorded))
    then = {(row["stress"], row["at"]) for row in recorded}
    for panel, stress in enumerate(stresses):
        at, error, meets, tolerance = limit_rows(rows, stress)
        # the ends of every stress are the same, quick or not, but for the coarsest depth
        ends = {(row["stress"], row["at"]) for row in rows if row["stress"] == stress} & then
        assert len(ends) >= 2
        axes = run.charts["limits"].axes[panel]
        (_, x, y), (_, _, level), *met = run.lines("limits", panel)
        assert (x, level) == (at.tolist(), [tolerance, tolerance])
        assert y == np.maximum(error, limits.SMALLEST).tolist()
        assert axes.xaxis_inverted() == (at[0] > at[-1])
        assert axes.get_yscale() == "log"
        ratio = max(at) / abs(min(at)) if min(at) else 0.0
        assert (axes.get_xscale() == "log") == (ratio > limits.LOG_FROM)
        if math.isnan(meets):
            assert not met
            assert "nowhere to" in run.told[1 + panel]
        else:
            assert met == [("_meets", [meets], [tolerance])]
            assert limits.two_digits(meets) in run.told[1 + panel]
        assert f"({stress}): " in run.told[1 + panel]
        assert run.told[1 + panel].startswith(axes.get_title(loc="left"))
    assert len(run.told) == 13 and run.told[0] == run.title("limits")
    tolerance = "Red: the tolerance, 0.05 mag, 0.1 px, or 3.4 arcsec, which is 0.1 px of the demo's"
    assert tolerance in run.note("limits")


@pytest.mark.parametrize("measured", [limits.coarse_codes, limits.faint_stars])
def test_codes_leave_their_tolerance_where_the_whole_study_has_it(measured):
    limit = measured(quick=False)
    then = []
    for row in csv_rows(ROOT / "results" / "limits.csv"):
        if row["stress"] == limit.stress:
            then.append((float(row["at"]), float(row["error"])))
    at, error = np.array(then).T
    assert limit.at.tolist() == at.tolist()
    np.testing.assert_allclose(limit.error, error, rtol=0.02)
