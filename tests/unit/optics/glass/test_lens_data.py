"""What a lens file states, whatever its format: indices of model glasses, masks, axes, and limits."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.optics.glass.codev_file import read_codev
from hilstar.optics.glass.lens_data import LINES_UM, Aperture, Frame, Glass
from hilstar.optics.glass.zemax_file import read_zemax
from tests.support.lenses import seq, zmx
from tests.support.refusals import refusal


@pytest.mark.parametrize("anomaly", [-0.01, 0.0, 0.02])
def test_a_model_glass_has_its_index_its_dispersion_and_its_distance_from_the_normal_line(anomaly):
    """Schott's TIE-29: P_g,F of glasses on the line is 0.6438 - 0.001682 V."""
    glass = Glass("own", index_d=1.6, abbe=40.0, anomaly=anomaly)
    d, f, c, g = glass.model_index(np.array([LINES_UM[name] for name in "dFCg"]))
    assert d == pytest.approx(1.6)
    assert (d - 1) / (f - c) == pytest.approx(40.0)
    assert (g - f) / (f - c) == pytest.approx(0.6438 - 0.001682 * 40.0 + anomaly)
    assert Glass("own", index_d=1.6).model_index(np.array([0.4, 0.9])).tolist() == [1.6, 1.6]
    assert "the glass NBK7 has no index" in refusal(Glass("NBK7").model_index, 0.5)


def test_a_spider_s_arms_stand_evenly_from_plus_x_on_and_have_one_side_each():
    """Three of 1 mm: at 0, 120 and 240 deg about a middle that is not the vertex."""
    spider = Aperture("spider", (0.5, 0.0), False, centre_mm=(2.0, -1.0), arms=3)
    for angle_deg, along_mm, across_mm, passes in (
        *((arm, 5.0, 0.45, False) for arm in (0, 120, 240)),
        *((arm, 5.0, -0.45, False) for arm in (0, 120, 240)),
        *((arm, 5.0, 0.55, True) for arm in (0, 120, 240)),
        *((arm, 5.0, 0.0, True) for arm in (60, 180, 300)),
    ):
        angle = np.radians(angle_deg)
        x = 2.0 + along_mm * np.cos(angle) - across_mm * np.sin(angle)
        y = -1.0 + along_mm * np.sin(angle) + across_mm * np.cos(angle)
        assert spider.passes(x, y) == passes


def test_a_mask_s_shape_lies_about_its_own_centre():
    x = np.array([2.0, 4.9, 5.1, 2.0, 2.0, 4.5])
    y = np.array([-1.0, -1.0, -1.0, 0.9, 1.1, 0.5])
    for shape, inside in (
        ("rectangle", [True, True, False, True, False, True]),
        ("ellipse", [True, True, False, True, False, False]),
    ):
        for is_clear in (True, False):
            mask = Aperture(shape, (3.0, 2.0), is_clear, centre_mm=(2.0, -1.0))
            assert mask.passes(x, y).tolist() == [part == is_clear for part in inside]
    ring = Aperture("circle", (3.0, 3.0), True, smallest_mm=0.5, centre_mm=(2.0, -1.0))
    assert ring.passes(x, y).tolist() == [False, True, False, True, True, True]


def test_axes_move_along_themselves_and_turn_one_after_the_other():
    """A quarter turn about z, then 2 along the new x, which is the old y, and a quarter about x."""
    frame = Frame()
    frame.rotate(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    frame.move(2.0, 0.0, 3.0)
    frame.rotate(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    frame.move(0.0, 0.5, 0.0)
    assert frame.origin_mm.tolist() == [0.0, 2.0, 3.5]
    assert frame.turn.tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(("pupil_mm", "is_met"), [(122.8, True), (123.0, False)])
def test_a_pupil_is_met_by_a_sphere_up_to_its_whole_width(pupil_mm, is_met):
    """The doublet's first radius is 61.47 mm."""
    if is_met:
        assert read_zemax(zmx(f"ENPD {pupil_mm}")).pupil == pupil_mm
    else:
        assert "no ray at its edge meets it" in refusal(read_zemax, zmx(f"ENPD {pupil_mm}"))


def test_codev_turns_the_first_two_angles_to_the_left_and_the_third_to_the_right():
    for words, turned, wanted in (
        ("ADE 30", (1, 2), (0.5, np.cos(np.pi / 6))),
        ("BDE 30", (0, 2), (-0.5, np.cos(np.pi / 6))),
        ("CDE 30", (1, 0), (0.5, np.cos(np.pi / 6))),
    ):
        turn = read_codev(seq(more={2: [words]})).surfaces[1].turn
        row, column = turned
        assert (turn[row, column], turn[column, column]) == pytest.approx(wanted)
        assert turn[column, row] == pytest.approx(-wanted[0])


@pytest.mark.parametrize(("words", "primary_um"), [("", 0.6), ("REF 1\n", 0.5), ("REF 3\n", 0.7)])
def test_codev_s_reference_is_the_one_named_or_the_middle_one(words, primary_um):
    text = seq().decode().replace("WL 587.5618\nREF 1\n", f"WL 500 600 700\n{words}")
    lens = read_codev(text.encode())
    assert lens.wavelengths_um == pytest.approx((0.5, 0.6, 0.7))
    assert lens.wavelengths_um[lens.primary] == pytest.approx(primary_um)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ({"system": ("ENPD 20", "FTYP 0 1")}, "says that the object's side is telecentric"),
        ({"more": {1: ["  GLAS ___BLANK 1 0 1.5 -40 0 0 0 0 0 0"]}}, "n = 1.5, V = -40"),
        ({"more": {1: ["  GLAS ___BLANK 1 0 0.99 40 0 0 0 0 0 0"]}}, "n = 0.99, V = 40"),
        ({"more": {1: ["  GLAS ___BLANK 1 0 6.1 40 0 0 0 0 0 0"]}}, "n = 6.1, V = 40"),
    ],
)  # fmt: skip
def test_what_a_zemax_file_may_not_say_is_refused(lines, words):
    text = zmx(*lines.get("system", ()), more=lines.get("more"))
    assert words in refusal(read_zemax, text)
