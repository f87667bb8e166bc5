"""What `hilstar verify` says of stars that are planted: each figure of its JSON, its lines, its
table and its charts by closed forms.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.basics.error_spread import ErrorSpread
from hilstar.instruments.verify.measure import (
    GeometryFit,
    GlowFit,
    MatchTally,
    Measured,
    Star,
    channel_errors_mag,
    glass_effect,
)
from hilstar.instruments.verify.summary import summarise, summary_lines, write_report
from hilstar.instruments.verify.verdict import Verdict, judge
from hilstar.optics.camera import Camera
from tests.support import planted_verdicts
from tests.support.tables import csv_rows

FOCAL_PX = 2000.0
ARCSEC_PER_RAD = 206264.806
ROUNDING = 1e-9
# V, x, y, flux, dx, dy, of the codes alone (mag, px), of the linear image (mag, px)
STARS = [
    (2.0, 10.0, 20.0, 0.11, 0.01, -0.02, 0.01, 0.004, 0.001, 0.002),
    (3.0, 60.0, 25.0, 0.13, -0.03, 0.04, 0.03, 0.006, -0.002, 0.001),
    (3.999, 70.0, 80.0, 0.10, 0.00, 0.05, 0.02, 0.001, 0.003, 0.003),
    (4.0, 20.0, 70.0, 0.16, 0.06, 0.08, -0.04, 0.002, -0.004, 0.004),
    (5.5, 40.0, 45.0, 0.12, -0.05, 0.12, 0.06, 0.009, 0.000, 0.001),
]
LOST = (4.5, 90.0, 5.0, 0.0, 0.0, 0.0, math.nan, math.nan, 0.0, 0.0)
CHANNELS = {f"quantum_efficiency_{colour}": 0.5 for colour in "rgb"}


def star(hip: int, values: tuple[float, ...]) -> Star:
    return Star(hip, *values)


def measured(verify: dict[str, float] | None = None, **changes: Any) -> Measured:
    """Fields with STARS, one lost, and a screen that glows a little more than is assumed."""
    tally = MatchTally(
        stars=[star(hip, values) for hip, values in enumerate(STARS, start=1)],
        lost=[star(9, LOST)],
        displaced=[np.array([[x, y, dx, dy] for _, x, y, _, dx, dy, *_ in STARS])],
        blended=3,
        summed=2,
        clipped=4,
        not_shown=5,
        at_edge=6,
        noisy_mag=[0.02, 0.22, 0.17],
        noisy_px=[0.3, 0.1, 0.2, 0.4],
        channels_mag=[[0.01, 0.03], [0.04, 0.04], [0.02, 0.05]],
        out_of_gamut=7,
        off_px={"window": [0.1, 0.3], "moment": [0.2]},
    )
    tables = {
        "verify": {"flux_mag": 0.2, "centroid_px": 0.5, "lost_share": 0.2, **(verify or {})},
        "tracker": {"quantum_efficiency": None, **CHANNELS},
        "sky": {"faintest_v_mag": 6.0},
    }
    base = planted_verdicts.measured(
        tables,
        tally=tally,
        camera=Camera((100, 90), FOCAL_PX, (50.0, 40.0), np.eye(3)),
        glow=GlowFit(5.0, 5.4, 1.0),
        wide_bodies=["Moon: a disc"],
    )
    return replace(base, **changes)


def spread(errors) -> dict[str, float]:
    sizes = np.abs(np.asarray(errors, dtype=float))
    return {
        "rms": pytest.approx(math.sqrt((sizes**2).mean())),
        "p95": pytest.approx(np.percentile(sizes, 95)),
        "max": pytest.approx(sizes.max()),
    }


def test_each_figure_is_that_of_the_stars():
    summary = summarise(judge(measured()))
    columns = np.array(STARS).T
    v_mag, _, _, flux_mag, dx_px, dy_px, codes_mag, codes_px, floor_mag, floor_px = columns
    relative_mag = flux_mag - 0.12  # the median
    codes_mag = codes_mag - 0.02
    off_px = np.hypot(dx_px, dy_px)
    assert (summary["fields"], summary["stars"], summary["lost"]) == (2, 5, 1)
    assert summary["zero_point_mag"] == 0.12
    assert asdict(summary["flux_error_mag"]) == spread(relative_mag)
    assert asdict(summary["centroid_error_px"]) == spread(off_px)
    arcsec = off_px * ARCSEC_PER_RAD / FOCAL_PX
    assert asdict(summary["centroid_error_arcsec"]) == spread(arcsec)
    assert summary["centroider"] == "window"
    by_kind = {kind: asdict(of) for kind, of in summary["centroid_error_px_by"].items()}
    assert by_kind == {"window": spread([0.1, 0.3]), "moment": spread([0.2])}
    counts = [summary[name] for name in ("blended", "summed", "clipped", "not_shown", "at_edge")]
    assert counts == [3, 2, 4, 5, 6]
    channels = {name: asdict(of) for name, of in summary["channels_mag"].items()}
    assert channels == {
        "quantum_efficiency_r": spread([0.01, 0.03]),
        "quantum_efficiency_g": spread([0.04, 0.04]),
        "quantum_efficiency_b": spread([0.02, 0.05]),
    }
    assert summary["out_of_gamut"] == 7
    assert summary["black_e_per_s_px"] == {"assumed": 5.0, "seen": 5.4}
    floor = summary["estimator_floor"]
    assert asdict(floor["flux_mag"]) == spread(floor_mag)
    assert asdict(floor["centroid_px"]) == spread(floor_px)
    codes = summary["codes_alone"]
    assert asdict(codes["flux_mag"]) == spread(codes_mag)
    assert asdict(codes["centroid_px"]) == spread(codes_px)
    assert codes["zero_point_mag"] == 0.02
    noisy = summary["noisy"]
    # as far from the zero point of the stars without noise
    assert asdict(noisy["flux_mag"]) == spread([0.10, 0.10, 0.05])
    assert asdict(noisy["centroid_px"]) == spread([0.3, 0.1, 0.2, 0.4])
    assert noisy["stars"] == 4
    assert summary["scale_error"] is None  # of five stars nothing can be said
    by_mag = [(row["v_from"], row["v_to"], row["stars"]) for row in summary["by_magnitude"]]
    assert by_mag == [(2, 3, 1), (3, 4, 2), (4, 5, 1), (5, 6, 1)]
    of_third = np.floor(v_mag) == 3
    third = summary["by_magnitude"][1]
    assert asdict(third["flux_error_mag"]) == spread(relative_mag[of_third])
    assert asdict(third["centroid_error_px"]) == spread(off_px[of_third])
    assert summary["passed"]


def test_the_lines_have_the_figures():
    lines = summary_lines(summarise(judge(measured())))
    text = "\n".join(lines)
    assert lines[0].split(None, 1) == [
        "stars",
        "5 in 2 fields; 1 lost, 3 blended, 4 clipped, 5 not shown, 6 at edge, 2 part of a blend",
    ]
    # of 0.01, 0.01, 0.02, 0.04 and 0 mag from the median
    assert "0.0210 / 0.0360 / 0.0400 mag (rms / 95 % / max)" in text
    assert "by window" in text
    assert "window 0.2236, moment 0.2000 px rms" in text
    red = next(line for line in lines if line.startswith("quantum_efficiency_r"))
    assert red.endswith(" 0.0224 / 0.0290 / 0.0300 mag")
    assert "out of gamut        7 stars, which are not in these" in lines
    assert "         V 3 to 4   0.0158 mag rms, 0.0500 px rms, 2 stars" in lines
    assert f"{'':20}Moon: a disc" in lines
    assert lines[-1] == "verdict             passed"
    failed = summary_lines(summarise(judge(measured(glow=GlowFit(5.0, 7.0, 1.0)))))
    assert failed[-1] == "verdict             NOT passed"
    assert "the screen's black gives 7 e-/s in a tracker pixel where 5 are assumed" in failed[-2]


def test_a_geometry_is_told_in_arcsec_and_degrees_by_the_keys_of_one_that_is_not_known():
    fit = GeometryFit(
        scale_error=0.01,
        rotation_rad=1e-3,
        offset_px=(0.5, -0.25),
        tilt_rad=(0.01, -0.02),
        tilt_px=0.3,
        k1=-0.02,
        distortion_px=0.4,
        left=0.5,
        left_px=0.6,
    )
    errors = planted_verdicts.display_errors([planted_verdicts.star()], geometry=fit)
    told = summarise(Verdict(measured(), errors, []))
    wanted = {
        "scale_error": 0.01,
        "rotation_arcsec": pytest.approx(1e-3 * ARCSEC_PER_RAD),
        "offset_px": (0.5, -0.25),
        "tilt_deg": pytest.approx((0.01 * 180 / math.pi, -0.02 * 180 / math.pi)),
        "k1": -0.02,
        "distortion_px": 0.4,
    }
    assert {key: told[key] for key in wanted} == wanted
    unknown = summarise(Verdict(measured(), replace(errors, geometry=None), []))
    assert list(unknown) == list(told)
    assert [unknown[key] for key in wanted] == [None] * len(wanted)


@pytest.mark.parametrize(("reasons", "word"), [([], "passed"), (["off"], "not passed")])
@pytest.mark.parametrize("lost", [0, 1])
def test_a_verdict_is_true_where_no_reason_is_against_it_though_a_star_is_lost(lost, reasons, word):
    stars = [planted_verdicts.star()]
    errors = planted_verdicts.display_errors(stars, lost=[planted_verdicts.lost_star()] * lost)
    verdict = Verdict(measured(), errors, reasons)
    assert bool(verdict) == verdict.passed == (not reasons)
    counts = f"stars: {1 + lost}, reasons against it: {len(reasons)}"
    assert repr(verdict) == f"<hilstar verdict: {word}, {counts}>"


def test_a_field_without_a_star_has_no_figures_and_lines_all_the_same():
    # of 3 stars a field on average: in four of them none is no chance
    nothing = summarise(judge(measured(tally=MatchTally(), field_count=4)))
    assert nothing["flux_error_mag"] == ErrorSpread(None, None, None)
    assert nothing["by_magnitude"] == []
    assert (nothing["zero_point_mag"], nothing["passed"]) == (0.0, False)
    lines = summary_lines(nothing)
    assert any(line.endswith("- / - / - mag (rms / 95 % / max)") for line in lines)
    assert "3 stars to V = 6 are in the tracker's field" not in "\n".join(lines)
    few = summarise(judge(measured(tally=MatchTally(), field_count=3)))
    assert "3 stars to V = 6 are in the tracker's field" in few["reasons"][0]


@pytest.mark.parametrize(("lost", "is_judged"), [(5, True), (6, False)])
def test_light_is_judged_where_half_of_the_stars_are_measured(lost, is_judged):
    """Five stars are, and all of them are 0.12 mag too faint in the median."""
    tally = replace(measured().tally, lost=[star(9, LOST)] * lost)
    reasons = judge(measured({"flux_mag": 0.001}, tally=tally)).reasons
    assert any("mag off at 95 %" in reason for reason in reasons) == is_judged
    assert any(f"{lost} of {5 + lost}" in reason for reason in reasons)


def test_the_table_has_each_star_and_the_charts_where_they_are(tmp_path, figures):
    write_report(tmp_path, judge(measured()))
    rows = csv_rows(tmp_path / "stars.csv")
    assert [int(row["hip"]) for row in rows] == [1, 2, 3, 4, 5, 9]
    assert float(rows[3]["flux_mag"]) == pytest.approx(0.16 - 0.12)
    assert float(rows[3]["codes_mag"]) == pytest.approx(-0.04 - 0.02)
    for name, value in zip(("v_mag", "x_px", "y_px"), STARS[3], strict=False):
        assert float(rows[3][name]) == value
    field, errors = figures
    (axes,) = field.axes
    dots, lost = axes.get_lines()[:2]
    assert dots.get_xydata().tolist() == [[x, y] for _, x, y, *_ in STARS]
    assert lost.get_xydata().tolist() == [[90.0, 5.0]]
    # the detector's rows run down
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 100), (90, 0))
    (arrows,) = [each for each in axes.collections if hasattr(each, "U")]
    assert arrows.U.tolist() == [dx for *_, dx, _, _, _, _, _ in STARS]
    assert arrows.V.tolist() == [dy for *_, dy, _, _, _, _ in STARS]
    longest = np.percentile(np.hypot(arrows.U, arrows.V), 95)
    # 95 % of the arrows are within 0.06 of the detector's width
    assert longest / arrows.scale == pytest.approx(6.0)
    assert f"enlarged {6 / longest:.0f} times" in " ".join(field.get_supxlabel().split())
    flux_axes, place_axes = errors.axes
    for axes, sizes, limit in (
        (flux_axes, [abs(flux - 0.12) for _, _, _, flux, *_ in STARS], 0.2),
        (place_axes, [math.hypot(dx, dy) for _, _, _, _, dx, dy, *_ in STARS], 0.5),
    ):
        stars, at_limit, within = axes.get_lines()
        np.testing.assert_allclose(stars.get_xdata(), [v for v, *_ in STARS])
        np.testing.assert_allclose(stars.get_ydata(), np.maximum(sizes, 1e-4 * limit))
        assert at_limit.get_ydata()[0] == limit
        assert within.get_ydata()[0] == pytest.approx(np.percentile(sizes, 95))


def test_each_channel_is_compared_in_the_squares_of_its_stars():
    """Shown light is 0.8 and 1.1 of the sky's in a square about a star near the detector's corner,
    and nothing elsewhere.
    """
    sky = [np.ones((12, 16)), 2 * np.ones((12, 16))]
    shown = [np.zeros((12, 16)), np.zeros((12, 16))]
    # reach of 2 px, cut by the left edge: x 0 to 3, y 5 to 9
    shown[0][5:10, 0:4] = 0.8
    shown[1][5:10, 0:4] = 2.2
    by_channel = list(zip(shown, sky, strict=True))
    (first,), (second,) = channel_errors_mag(by_channel, np.array([1.2]), np.array([6.9]), 2)
    assert first == pytest.approx(-2.5 * math.log10(0.8), abs=ROUNDING)
    assert second == pytest.approx(2.5 * math.log10(1.1), abs=ROUNDING)


def test_a_glass_that_brightens_is_as_far_off_as_one_that_dims():
    stars = [star(1, (4.0, 10.0, 20.0) + (0.0,) * 7)]
    for light in (0.5, 2.0):
        glass = SimpleNamespace(
            by_colour=True,
            mean_shares=None,
            centroids_px=lambda x, y, shares, light=light: (x, y, np.array([light])),
        )
        assert glass_effect(glass, stars).mag == pytest.approx(2.5 * math.log10(2))


def test_a_glass_is_off_its_chief_rays_and_vignettes_at_95_percent():
    stars = [star(1, (4.0, 10.0, 20.0) + (0.0,) * 7), star(2, (5.0, 30.0, 5.0) + (0.0,) * 7)]
    glass = SimpleNamespace(
        by_colour=True,
        mean_shares=None,
        centroids_px=lambda x, y, shares: (
            x + np.array([0.3, 3.0]),
            y - np.array([0.4, 4.0]),
            np.array([0.5, 0.25]),
        ),
    )
    effect = glass_effect(glass, stars)
    assert effect.px == pytest.approx(np.percentile([0.5, 5.0], 95))
    fainter = -2.5 * np.log10([0.5, 0.25])
    assert effect.mag == pytest.approx(np.percentile(fainter, 95))
    assert glass_effect(SimpleNamespace(by_colour=False), stars) is None
    assert glass_effect(glass, []) is None
