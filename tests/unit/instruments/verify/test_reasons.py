"""The reasons of a verdict name what is off, in the unit that they state, from its limit on."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import pytest

from hilstar.instruments.verify.measure import GeometryFit, GlassEffect, GlowFit, MatchTally
from hilstar.instruments.verify.verdict import reasons
from tests.support.planted_verdicts import display_errors, lost_star, measured, star

LIMIT_PX = 0.1
EXACT_FIT = GeometryFit(0.0, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)
MEASURED_LENS = {"collimator": {"geometry": "lens.toml"}}
AGAIN = "its geometry file does not say so; run hilstar calibrate geometric again"
GEOMETRIC = "hilstar calibrate geometric measures it"
ALIGNMENT = "look at q_cam_to_mon"
# below the limit of 0.1 px at the corner, 50 px from the middle, and over it
UNDER, OVER = 0.99 * LIMIT_PX / 50, 1.01 * LIMIT_PX / 50


def geometry_reasons(tables=None, **off):
    """What is said of a geometry where stars are a pixel off."""
    errors = display_errors([star(dx_px=0.6, dy_px=-0.8)], geometry=replace(EXACT_FIT, **off))
    centroids, *others = reasons(measured(tables), errors)
    assert centroids == "centroids are 1.000 px off at 95 % (limit 0.1)"
    return others


@pytest.mark.parametrize(
    ("off", "words", "cure"),
    [
        ({"scale_error": UNDER, "rotation_rad": -UNDER, "offset_px": (0.05, 0.086)}, "", ""),
        (
            {"scale_error": OVER},
            "the plate scale is +0.20% off",
            "look at focal_length_mm and pixel_pitch_um",
        ),
        (
            {"scale_error": -0.0123},
            "the plate scale is -1.23% off",
            "look at focal_length_mm and pixel_pitch_um",
        ),
        ({"rotation_rad": OVER}, "the field is turned by +0.116 deg", ALIGNMENT),
        ({"rotation_rad": math.radians(-0.25)}, "the field is turned by -0.250 deg", ALIGNMENT),
        (
            {"offset_px": (0.05, -0.087)},
            "the field is shifted by (+0.05, -0.09) px",
            f"{ALIGNMENT} and principal_point_px",
        ),
        (
            {"offset_px": (-0.3, 0.5)},
            "the field is shifted by (-0.30, +0.50) px",
            f"{ALIGNMENT} and principal_point_px",
        ),
        ({"tilt_rad": (0.01, 0.0), "tilt_px": UNDER, "distortion_px": UNDER, "k1": 1.0}, "", ""),
        (
            {"tilt_rad": (math.radians(0.5), math.radians(-1.0)), "tilt_px": 0.37},
            "the screen is tilted by (+0.50, -1.00) deg about its x and y axes, 0.37 px",
            GEOMETRIC,
        ),
        (
            {"distortion_px": 2.5, "k1": -0.0123},
            "the lens distorts by 2.50 px (k1 -0.0123)",
            GEOMETRIC,
        ),
    ],
)
def test_a_geometry_is_off_from_the_limit_on_and_cured_by_its_keys_or_by_another_file(
    off, words, cure
):
    assert geometry_reasons(**off) == [f"{words}: {cure}"] * bool(words)
    assert geometry_reasons(MEASURED_LENS, **off) == [f"{words}: {AGAIN}"] * bool(words)


def test_what_a_geometry_does_not_explain_is_told_without_a_cure():
    left = "that leaves 0.44 px at 95 %, which is neither alignment, tilt nor distortion"
    assert geometry_reasons(left_px=0.44) == geometry_reasons(MEASURED_LENS, left_px=0.44) == [left]
    # a fit that leaves more than half says nothing of the geometry
    assert len(geometry_reasons(scale_error=0.1, left=0.5)) == 1
    assert geometry_reasons(scale_error=0.1, left=0.51) == []


def test_a_geometry_is_no_reason_where_stars_are_in_their_places():
    off = replace(EXACT_FIT, scale_error=0.1, offset_px=(3.0, 3.0))
    assert reasons(measured(), display_errors([star(dx_px=0.099)], geometry=off)) == []


@pytest.mark.parametrize("seen_e_per_s_px", [4.0, 6.0])
def test_a_black_level_is_wrong_on_either_side(seen_e_per_s_px):
    (reason,) = reasons(measured(glow=GlowFit(5.0, seen_e_per_s_px, 0.9)), display_errors([star()]))
    assert reason == (
        f"the screen's black gives {seen_e_per_s_px:g} e-/s in a tracker pixel where 5 are assumed"
        " (limit 0.9): calibrate the black level"
    )
    within = measured(glow=GlowFit(5.0, seen_e_per_s_px, 1.0))
    assert reasons(within, display_errors([star()])) == []


@pytest.mark.parametrize(
    ("floor_px", "floor_mag", "glass", "is_glass"),
    [
        (0.3, 0.0, GlassEffect(0.2, 0.0), True),
        (0.3, 0.0, GlassEffect(0.1, 0.0), False),  # under half of it
        (0.3, 0.0, GlassEffect(0.0, 0.9), False),  # vignetting moves no star
        (0.3, 0.0, None, False),
        (0.0, 0.3, GlassEffect(0.0, 0.2), True),
        (0.0, 0.3, GlassEffect(0.9, 0.1), False),
    ],
)
@pytest.mark.parametrize("centroider", ["window", "psf"])
def test_a_glass_is_named_where_it_makes_most_of_what_is_off(
    floor_px, floor_mag, glass, is_glass, centroider
):
    """And cured by a centroider that fits it, where that is another."""
    bench = measured({"verify": {"centroider": centroider}}, glass=glass)
    off = display_errors([star(floor_px=floor_px, floor_mag=-floor_mag)])
    (reason,) = reasons(bench, off)
    assert reason.startswith(
        f"the linear image itself is measured {floor_mag:.3f} mag and {floor_px:.3f} px off the"
        " catalogue at 95 %: the "
    )
    assert ("beside their chief rays" in reason) == is_glass
    assert ("nothing can be said about the display" in reason) != is_glass
    assert ('centroider = "psf" fits it' in reason) == (is_glass and centroider == "window")
    within = display_errors([star(floor_px=0.99 * LIMIT_PX, floor_mag=-0.049)])
    assert reasons(bench, within) == []


@pytest.mark.parametrize(
    ("vanished", "mirrored", "cause"),
    [
        (0, {}, "look at focal lengths, pixel pitches and q_cam_to_mon"),
        (20, {}, "look at focal lengths, pixel pitches and q_cam_to_mon"),
        (21, {}, "they are too faint to be seen: look at the monitor's response, and at what the"),
        # of 100 that were looked for, however many are lost
        (21, {"x": 50}, "they are too faint to be seen: look at the monitor's response"),
        (21, {"x": 51}, "51 are where a mirrored screen with its columns reversed would show them"),
        (0, {"x": 3, "swap": 60}, "60 are where a mirrored screen with its axes swapped would"),
    ],
)
def test_lost_stars_have_the_cause_of_most_of_them(vanished, mirrored, cause):
    tally = MatchTally(vanished=vanished, mirrored=Counter(mirrored))
    bench = measured({"verify": {"lost_share": 0.4}}, tally=tally)
    (reason,) = reasons(bench, display_errors([star()] * 59, lost=[lost_star()] * 41))
    lost = "41 of 100 stars are not where the sky has them (limit 40.0%): "
    assert reason.startswith(lost + cause)
    assert reasons(bench, display_errors([star()] * 60, lost=[lost_star()] * 40)) == []


@pytest.mark.parametrize(("lost", "is_judged"), [(5, True), (6, False)])
def test_light_and_codes_are_judged_where_half_of_the_stars_are_measured(lost, is_judged):
    off = display_errors([star(flux_mag=0.3, codes_mag=0.2)] * 5, lost=[lost_star()] * lost)
    lines = reasons(measured(), off)
    assert lines[0].startswith(f"{lost} of {5 + lost} stars are not where the sky has them")
    openings = [line.partition(" ")[0] for line in lines[1:]]
    assert openings == (["flux", "the"] if is_judged else [])


ALL_OFF = "all stars are {:+.3f} mag off (limit 0.05): "
WHITE = "look at flux_at_white_e_per_s"
RESPONSE = (
    ": light does not follow the codes as assumed, look at the monitor's response and uniformity"
)
FLUX = "flux is 0.100 mag off at 95 % (limit 0.05)"


@pytest.mark.parametrize(
    ("flux_mag", "codes_mag", "offset_mag", "codes_offset_mag", "true_white", "lines"),
    [
        (0.04, 0.0, 0.04, 0.0, None, []),
        # by the codes alone: the root of 0.1^2 - 0.09^2 is 0.044
        (0.1, 0.09, 0.0, 0.0, None, [FLUX]),
        (0.1, 0.08, 0.0, 0.0, None, [FLUX + RESPONSE]),
        (0.1, 0.0, -0.2, 0.0, None, [FLUX + RESPONSE]),
        (0.1, 0.0, -0.2, 0.0, 5.0, [FLUX + RESPONSE, ALL_OFF.format(-0.2) + WHITE]),
        (0.0, 0.0, -0.2, 0.0, None, [ALL_OFF.format(-0.2) + WHITE]),
        (0.0, 0.0, 0.2, 0.0, None, [ALL_OFF.format(0.2) + WHITE]),
        (0.0, 0.0, 0.2, -0.1, None, [ALL_OFF.format(0.2) + "the codes alone make -0.100"]),
    ],
)
def test_light_is_off_from_star_to_star_and_in_common_beyond_what_codes_make(
    flux_mag, codes_mag, offset_mag, codes_offset_mag, true_white, lines
):
    bench = measured({"verify": {"true_flux_at_white_e_per_s": true_white}})
    errors = display_errors(
        [star(flux_mag=-flux_mag, codes_mag=codes_mag)] * 9,
        zero_point_mag=offset_mag,
        codes_zero_point_mag=codes_offset_mag,
    )
    of_codes = [line for line in reasons(bench, errors) if line.startswith("the codes alone cost")]
    assert len(of_codes) == (codes_mag > 0.05)
    assert reasons(bench, errors) == [*lines, *of_codes]
