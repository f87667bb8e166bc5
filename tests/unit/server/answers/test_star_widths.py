"""The focus by the widths of stars that answers report: its figure, its best, and who reports none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.units import NS_PER_S
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.answers.formats import reported_stars
from hilstar.server.answers.star_widths import (
    NONE_AFTER,
    AnswerWidths,
    FocusCurve,
    FocusFigure,
    FocusReading,
    sparkline,
    width_figure,
)

ANSWER_HZ, STARS, SCATTER = 10.0, 12, 0.05
SURE_SIGMAS = 4.0
TRIALS = 2000


def answers_of(widths_px, rng, first: int = 0) -> list[Answer]:
    """Ten answers a second, each with STARS whose widths scatter about one of `widths_px`."""
    found = []
    for k, width_px in enumerate(widths_px, start=first):
        noise = rng.normal(0, SCATTER, STARS)
        stars = tuple(ReportedStar(9.0, 9.0, 5.0, None, width_px + off) for off in noise.tolist())
        found.append(Answer(round(k / ANSWER_HZ * NS_PER_S), b"", centroids=stars))
    return found


def test_a_figure_is_the_median_width_and_its_error_holds_the_truth(rng):
    """The share of medians within one error of the truth is that of a normal distribution."""
    inside = 0
    for _ in range(TRIALS):
        figure = width_figure((1.3 + rng.normal(0, SCATTER, 60)).tolist())
        inside += abs(figure.psf_sigma_px - 1.3) <= figure.error_px
    # of 60 widths the scatter itself is known to 12 %, which costs 1 % of share; 4 sigmas of 2000
    assert inside / TRIALS == pytest.approx(0.683, abs=0.01 + 4 * np.sqrt(0.683 * 0.317 / TRIALS))


def test_a_star_that_saturates_is_no_wider_figure(rng):
    widths = (1.3 + rng.normal(0, SCATTER, 40)).tolist()
    assert width_figure([*widths, 6.0, 7.0]).psf_sigma_px == pytest.approx(1.3, abs=0.04)


def test_the_best_is_where_the_ring_was_sharpest(rng):
    ring = np.repeat([2.4, 1.8, 1.3, 1.0, 1.2, 1.7], 10)  # a second at each place
    widths = AnswerWidths()
    readings = [widths.take(answer) for answer in answers_of(ring.tolist(), rng)]
    figures = [reading.figure for reading in readings if reading is not None]
    assert len(figures) == widths.curve.count == 11
    best = widths.curve.best
    assert abs(best.figure.psf_sigma_px - 1.0) < SURE_SIGMAS * best.figure.error_px
    assert 3.0 < best.t_s <= 4.0
    assert widths.curve.is_worse(figures[-1]) and not widths.curve.is_worse(best.figure)
    state = widths.state
    assert (state.what, state.number, state.worse, state.still) == ("star sigma", 11, True, True)
    assert state.best_px == pytest.approx(best.figure.psf_sigma_px, abs=1e-4)
    best_words = f"best {best.figure.psf_sigma_px:.3f} px"
    assert state.line == f"{best_words} {widths.curve.readings[-1].t_s - best.t_s:.0f} s ago"
    assert widths.curve.line().startswith("  11  star sigma ")


def test_a_tracker_without_widths_is_known_after_some_answers_with_stars():
    widths = AnswerWidths()
    without = Answer(0, b"", centroids=(ReportedStar(1.0, 2.0, 3.0, 7),))
    for k in range(NONE_AFTER):
        assert not widths.reports_none
        # however much later the next answer comes: there is nothing to read
        assert widths.take(replace(without, host_ns=k * NS_PER_S)) is None
    assert widths.reports_none and widths.state is None and widths.curve.count == 0
    # an attitude without stars, as in a packet, is one of stars whose widths are not reported
    packets = AnswerWidths()
    for _ in range(NONE_AFTER):
        packets.take(Answer(0, b"", q_icrs_to_cam=np.array([1.0, 0.0, 0.0, 0.0])))
    assert packets.reports_none


def test_a_tracker_that_sees_no_star_says_so_and_is_waited_for(rng):
    lost = AnswerWidths()
    readings = [lost.take(Answer(k * NS_PER_S // 10, b"")) for k in range(3 * NONE_AFTER)]
    whys = [reading.why for reading in readings if reading is not None]
    assert whys == ["the tracker reports no star"] * 5
    assert not lost.reports_none and lost.state is None
    for answer in answers_of([1.3] * 10, rng, first=3 * NONE_AFTER):
        lost.take(answer)
    assert lost.state.sigma_px == pytest.approx(1.3, abs=0.05)


def test_answers_of_too_few_widths_have_no_figure_and_say_why(rng):
    widths = AnswerWidths()
    few = [Answer(k * NS_PER_S, b"", centroids=(ReportedStar(1, 2, 3, None, 1.0),)) for k in (1, 2)]
    assert widths.take(few[0]) is None
    reading = widths.take(few[1])
    assert reading.figure is None
    assert (
        widths.state.line
        == reading.why
        == ("the tracker reports 2 widths of stars, 3 at least are needed")
    )
    assert widths.state.sigma_px is None


def test_a_width_is_the_fifth_figure_of_a_star_and_a_wrong_one_is_none():
    rows = [
        [1, 2, 3, 7, 1.25],
        [1, 2, None, None, 0.5],
        [1, 2, 3, 7],
        [1, 2, 3, 7, -1],
        [1, 2, 3, 7, 1e9],
    ]
    assert [star.width_px for star in reported_stars(rows)] == [1.25, 0.5, None, None, None]


def test_a_curve_remembers_a_bounded_number_of_readings_and_its_best():
    curve = FocusCurve()
    for number in range(1, 3001):
        sigma_px = 1.0 if number == 5 else 2.0
        curve.add(FocusReading(number, number, 9, FocusFigure(sigma_px, 0.01, 9, 0.0, 0.0)))
    assert curve.count == 3000 and len(curve.readings) == 2000
    assert curve.best.number == 5 and curve.state().best_ago_s == 2995


def test_a_figure_is_worse_beyond_both_errors():
    """Three sigmas of a difference of 0.3 and 0.4 px are 1.5 px."""
    curve = FocusCurve("answers")
    curve.add(FocusReading(1, 0.0, 0, FocusFigure(2.0, 0.4, 9, 0.0, 0.0)))
    worse = [curve.is_worse(FocusFigure(width, 0.3, 9, 0.0, 0.0)) for width in (3.4, 3.6)]
    assert worse == [False, True]


def test_a_curve_without_a_best_image_says_why():
    curve = FocusCurve("answers")
    assert curve.why_none() == "no answer came"
    assert FocusCurve().why_none() == "no image came"
    curve.add(FocusReading(1, 0.0, 0, None, "no star is wide enough"))
    assert curve.best is None and curve.why_none() == "no star is wide enough"


def test_a_curve_shows_the_newest_figures():
    rising = [1.0] * 10 + [float(k) for k in range(40)]
    assert sparkline(rising, 0.0) == sparkline(rising[10:], 0.0)
    assert sparkline(rising, 0.0)[0] == "▁" and sparkline(rising, 0.0)[-1] == "█"
    assert sparkline([1.0, 2.0, 1.5], 4.0) == "▁▃▂"  # a span of 4 would be the highest bar
