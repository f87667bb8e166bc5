"""What the charts of first light show: which way each is off, where, and in which unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.display.response import gamma_response
from hilstar.instruments.calibrate.first_light.focus import Sharpness, _draw_dots
from hilstar.instruments.calibrate.first_light.photometry import _draw_before
from hilstar.instruments.calibrate.first_light.stars import draw_light, draw_residuals
from hilstar.instruments.calibrate.first_light.uniformity import _draw_warm_up
from hilstar.instruments.calibrate.warm_up import judge_warm_up
from tests.support.card_texts import drawn_figures
from tests.support.figures import assert_legible

PATH = Path("chart")  # which nothing is written to


def title_of(figure) -> str:
    return " ".join(figure.get_suptitle().split())


def test_a_monitor_of_a_steeper_response_is_drawn_as_fainter_than_in_the_bench_file():
    """Of gamma 2.4 where the file has 2.2: fainter by 0.2 x 2.5 log10 of the signal, and down."""
    responses = gamma_response(8, 2.2), gamma_response(8, 2.4)
    figures = {"bench_file_off_rms_mag": 0.25, "bench_file_off_max_mag": 0.625}
    with drawn_figures() as drawn:
        _draw_before(PATH, figures, responses)
    (axes,) = drawn[0].axes
    light, off_mag = axes.lines[0].get_data()
    codes = np.arange(1, 256)
    signal = codes[(codes / 255) ** 2.4 >= 1e-3] / 255
    np.testing.assert_allclose(light, signal**2.4)
    np.testing.assert_allclose(off_mag, -0.2 * 2.5 * np.log10(signal), atol=1e-9)
    assert axes.yaxis_inverted() and axes.get_xscale() == "log"
    assert axes.get_ylabel() == "fainter than in the bench file [mag]"
    assert title_of(drawn[0]).endswith("is off by 0.250 mag rms, 0.625 max")


def test_a_response_that_is_off_is_drawn_legibly(figures):
    responses = gamma_response(8, 2.2), gamma_response(8, 2.4)
    _draw_before(PATH, {"bench_file_off_rms_mag": 0.25, "bench_file_off_max_mag": 0.625}, responses)
    assert_legible(figures[0])


def test_a_star_that_is_too_faint_is_drawn_down_at_its_light_and_at_its_place():
    e_per_s, off_mag = np.array([100.0, 400.0, 2500.0]), np.array([0.3, -0.1, 0.05])
    noise_mag, from_middle = np.array([0.03, 0.02, 0.01]), np.array([0.9, 0.1, 0.5])
    with drawn_figures() as drawn:
        draw_light(PATH, e_per_s, off_mag, noise_mag, "a finding", from_middle)
        draw_light(PATH, e_per_s, off_mag, noise_mag, "a finding")
    both, alone = drawn
    assert len(alone.axes) == 1
    for axes, along, scale in zip(
        both.axes, (e_per_s, from_middle), ("log", "linear"), strict=True
    ):
        points, _, (bars,) = axes.containers[0]
        np.testing.assert_array_equal(points.get_xydata(), np.column_stack([along, off_mag]))
        ends_mag = np.array([segment[:, 1] for segment in bars.get_segments()])
        np.testing.assert_allclose(ends_mag[:, 1] - ends_mag[:, 0], 2 * noise_mag)
        # the median of all
        assert list(axes.lines[-1].get_ydata()) == [0.05, 0.05]
        assert axes.yaxis_inverted() and axes.get_xscale() == scale


def test_arrows_point_the_way_that_stars_are_off_the_longest_an_agreed_share_of_the_image():
    place = np.array([[10.0, 20.0], [300.0, 40.0]])
    residual = np.array([[0.3, -0.4], [0.0, 0.1]])
    with drawn_figures() as drawn:
        draw_residuals(PATH, place, residual, 400, "a finding")
        draw_residuals(PATH, place, residual, 800, "a finding")
    (axes,), (wider,) = (figure.axes for figure in drawn)
    arrows = axes.collections[0]
    np.testing.assert_array_equal(arrows.XY, place)
    np.testing.assert_array_equal(np.column_stack([arrows.U, arrows.V]), residual)
    # of twice as wide an image an arrow is twice as long
    assert arrows.scale == pytest.approx(2 * wider.collections[0].scale)
    assert 0.02 < 0.5 / arrows.scale / 400 < 0.2
    assert axes.yaxis_inverted()
    (key,) = (artist for artist in axes.get_children() if hasattr(artist, "U") and artist != arrows)
    assert (key.U, key.label) == (0.5, "0.500 px, the longest")


def test_dots_are_drawn_where_the_tracker_has_them_by_each_one_s_width():
    sharp = Sharpness(
        x_px=np.array([10.0, 250.0, 90.0]),
        y_px=np.array([20.0, 30.0, 400.0]),
        psf_sigma_px=0.625,
        psf_sigma_error_px=0.01,
        dot_side_px=3.5,
        dot_side_error_px=0.1,
        each_psf_sigma_px=np.array([0.5, 0.75, 0.625]),
    )
    with drawn_figures() as drawn:
        _draw_dots(PATH, sharp, 0.55)
    axes = drawn[0].axes[0]
    (dots,) = axes.collections
    np.testing.assert_array_equal(dots.get_offsets(), np.column_stack([sharp.x_px, sharp.y_px]))
    np.testing.assert_array_equal(dots.get_array(), sharp.each_psf_sigma_px)
    assert axes.yaxis_inverted()
    assert title_of(drawn[0]) == "PSF sigma 0.625 px (by 3 dots), the bench file has 0.55"


def test_a_warm_up_is_drawn_in_percent_of_its_last_reading_against_minutes():
    t_s = np.arange(0.0, 1200.0, 10.0)
    light = 500 * (1 - 0.05 * np.exp(-t_s / 240))
    judged = judge_warm_up(t_s, light)
    with drawn_figures() as drawn:
        _draw_warm_up(PATH, judged, t_s, light)
    (axes,) = drawn[0].axes
    readings, law = axes.lines[:2]
    np.testing.assert_allclose(
        readings.get_xydata(), np.column_stack([t_s / 60, 100 * light / light[-1]])
    )
    np.testing.assert_allclose(law.get_xydata(), readings.get_xydata(), rtol=1e-6)
    assert readings.get_ydata()[-1] == 100.0
