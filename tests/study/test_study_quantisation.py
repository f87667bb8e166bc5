"""The study of quantisation: its measure is right, and its tables say what its findings say."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields, replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.display.phases import USUAL_PSF, fainter, measure, phase_grid
from hilstar.display.render.reference import linear_image
from hilstar.instruments.study import codes, quantisation
from hilstar.instruments.study.codes import (
    AIMS,
    BITS,
    WAYS,
    frames_panels,
    over_frames,
    steps_words,
)
from hilstar.instruments.study.engine import write_rows
from hilstar.instruments.study.quantisation import (
    TimedWay,
    WayErrors,
    centroider_errors,
    centroiders_line,
    draw_each,
    draw_magnitudes,
    draw_times,
    faintest,
    largest_words,
    summary,
    timed_ways,
    times_line,
)
from hilstar.instruments.study.sweep import Load
from hilstar.tracker.centroiders import FAMILY
from tests.support.studies import times_are_watched
from tests.support.tables import csv_rows

# Of the error of `round` that `exact` leaves, by each centroider: 0.18 to 0.48 on 8 x 8 phases, 64
# stars.
MOST_LEFT = 0.6


def test_the_measure_finds_the_error_that_was_put_in():
    sprites, tile = phase_grid(4)
    image = linear_image(sprites, (4 * tile, 4 * tile), USUAL_PSF)
    errors = measure(image, np.roll(image, 1, axis=1) * 10 ** (-0.4 * 0.03), tile)
    assert (errors.flux_rms_mag, errors.flux_max_mag) == pytest.approx((0.03, 0.03), abs=1e-6)
    assert (errors.centroid_rms_px, errors.centroid_max_px) == pytest.approx((1, 1), abs=1e-4)
    nothing = measure(image, np.zeros_like(image), tile)
    assert np.isinf(nothing.flux_max_mag) and np.isinf(nothing.centroid_rms_px)


def test_a_timed_field_has_three_times_as_many_stars_in_each_magnitude_as_in_the_one_before():
    """Over eight of them under a white peak, all over the frame."""
    field = codes.star_field((1000, 200), 10)
    peaks = field.data["electrons_per_s"] * USUAL_PSF.peak_share
    mags = -2.5 * np.log10(peaks)
    assert len(mags) == codes.STARS and mags.min() >= 0 and mags.max() < 8.001
    # of 10^(m / 2) evenly
    for limit in (6.0, 7.0, 7.5):
        share = (10 ** (limit / 2) - 1) / (10**4 - 1)
        sigma = math.sqrt(share * (1 - share) / codes.STARS)
        assert (mags < limit).mean() == pytest.approx(share, abs=4 * sigma)
    for places, side_px in ((field.x_px, 1000), (field.y_px, 200)):
        assert places.min() < 0.02 * side_px and places.max() > 0.98 * side_px
        assert places.mean() == pytest.approx(side_px / 2, rel=0.08)


def test_fainter_stars_have_less_light():
    sprites, _ = phase_grid(2)
    ratio = fainter(sprites, 5.0).data["electrons_per_s"] / sprites.data["electrons_per_s"]
    assert ratio == pytest.approx(np.full(4, 0.01))


@pytest.fixture(scope="module")
def measured():
    """The quick study, whose times are of a small frame: no claim here is of a time."""
    with pytest.MonkeyPatch.context() as patch, times_are_watched():
        patch.setattr(codes, "FRAME_PX", (96, 54))
        patch.setattr(quantisation, "QUICK_ROUNDS", 1)
        return quantisation.measure(quick=True)


@pytest.fixture(scope="module")
def rows(measured):
    return measured.rows


CHARTS = {"quantisation", "quantisation_centroiders", "quantisation_time", "over_frames"}


def test_a_whole_study_has_a_finding_for_each_depth_and_times(whole_study, measured):
    found = whole_study.reported("quantisation", CHARTS, measured)
    assert len(found.findings) == len(BITS) + 3
    assert all(float(row["frame_ms"]) > 0 for row in found.rows("quantisation_time"))


def largest(rows, bits, method, figure):
    """The largest error of a way down to the faint end of its aim."""
    limit = AIMS[bits][1]
    own = [row for row in rows if (row.bits, row.method) == (bits, method)]
    return max(getattr(row.figures, figure) for row in own if row.mag_under_white <= limit)


def test_codes_meet_their_aims_at_each_depth(rows, tmp_path):
    assert len(rows) == len(BITS) * len(WAYS) * 5
    for bits, (aim_mag, limit) in AIMS.items():
        flux_mag = largest(rows, bits, "exact", "flux_max_mag")
        place_px = largest(rows, bits, "exact", "max_px_fit")
        assert flux_mag <= aim_mag
        assert largest_words(rows, bits, "exact") == f"{flux_mag:.3f} mag and {place_px:.3f} px"
        line = summary(bits, rows)
        assert line.startswith(f"{bits} bits, sRGB, {limit:g} magnitudes")
        assert f"of exact {flux_mag:.3f} mag" in line
        # half of sRGB's first step, 1 / 12.92 of a code, over the star's light, by its peak
        half_step = 0.5 / 12.92 / (2**bits - 1)
        moved_px = half_step * USUAL_PSF.peak_share * 10 ** (0.4 * limit)
        assert f"moves a centroid by {moved_px:.3f} px along each axis" in line
    faint = {row.method: faintest(rows, 8, row.method).figures for row in rows}
    for kind in FAMILY:
        rounded, exact = (faint[name].axis_rms_px(kind) for name in ("round", "exact"))
        assert 0 < exact < MOST_LEFT * rounded
        assert getattr(faint["exact"], f"max_px_{kind}") > exact
    moment_px = faint["exact"].axis_rms_px_moment
    assert faint["exact"].centroid_rms_px == pytest.approx(np.sqrt(2) * moment_px)
    write_rows(tmp_path / "quantisation.csv", rows)
    first = csv_rows(tmp_path / "quantisation.csv")[0]
    assert list(first)[:4] == ["bits", "method", "mag_under_white", "flux_rms_mag"]
    assert float(first["flux_max_mag"]) == rows[0].figures.flux_max_mag


def test_exact_leaves_a_share_of_what_rounding_makes_by_each_centroider(rows):
    table = centroider_errors(rows)
    assert [(row.bits, row.centroider) for row in table] == list(product(BITS, FAMILY))
    for row in table:
        assert row.round_px == faintest(rows, row.bits, "round").figures.axis_rms_px(row.centroider)
        assert row.share == row.exact_px / row.round_px
    line = centroiders_line(table)
    for row in table[: len(FAMILY)]:
        assert f"{row.centroider} {row.share:.2f} ({row.exact_px:.4f} px)" in line


def test_the_faint_end_is_the_first_magnitude_at_it():
    limit = AIMS[10][1]
    made = [WayErrors(10, "exact", mag, None) for mag in (limit - 0.25, limit, limit + 0.25)]
    assert faintest([WayErrors(8, "exact", 20.0, None), *made], 10, "exact") is made[1]


def test_a_whole_study_has_quarters_of_a_magnitude_beyond_every_aim(rows):
    phases, mags = quantisation.phases_and_mags(quick=False)
    assert phases == 32 and mags.tolist() == [k / 4 for k in range(41)]
    wanted = []
    for bits, way in product(BITS, WAYS):
        wanted += [(bits, way.name, mag) for mag in (0.0, 2.0, 4.0, 6.0, 8.0)]
    assert [(row.bits, row.method, row.mag_under_white) for row in rows] == wanted


def timed_way(bits, method, frame_ms, **figures):
    known = {field.name: 1.0 for field in fields(codes.ErrorFigures)}
    return TimedWay(bits, method, frame_ms, 6.0, codes.ErrorFigures(**(known | figures)))


def test_times_are_told_of_the_middle_panel_without_bit_stealing():
    timed = []
    for bits in BITS:
        for number, way in enumerate(WAYS):
            timed.append(timed_way(bits, way.name, bits + number / 10))
    assert times_line(timed) == (
        "1000 stars, 1920 x 1080, 10 bits, from light to levels in memory: round 10.0 ms, dither"
        " 10.1 ms, temporal 10.2 ms, exact 10.3 ms"
    )


def test_each_way_is_timed_by_its_own_codes_and_has_its_faint_end_s_errors(rows, monkeypatch):
    """On a small frame: its panel, its method, and frames that go on."""
    monkeypatch.setattr(codes, "FRAME_PX", (48, 40))
    monkeypatch.setattr(codes, "BITS", (8, 12))
    drawn = {}
    whole = quantisation.Renderer

    class Seen(whole):
        def __init__(self, target):
            super().__init__(target)
            self.frames = drawn.setdefault(id(target), (target, []))[1]

        def draw(self, sprites, frame=0):
            self.frames.append(frame)
            super().draw(sprites, frame)

    monkeypatch.setattr(quantisation, "Renderer", Seen)
    timed = timed_ways(rows, 2)
    keys = [(row.bits, row.method) for row in timed]
    assert keys == list(product((8, 12), (way.name for way in WAYS)))
    for row in timed:
        limit_mag = AIMS[row.bits][1]
        assert row.mag_under_white == limit_mag and row.frame_ms > 0
        assert row.figures is faintest(rows, row.bits, row.method).figures
    for (target, frames), (bits, name) in zip(drawn.values(), keys, strict=True):
        way = next(way for way in WAYS if way.name == name)
        assert (target.quantisation, target.response.bits) == (way.method, bits)
        # a panel whose channels are stolen has more levels than codes
        assert (len(target.response.light) > 2**bits) is way.stealing
        assert frames == [0, 1, 2]


def test_errors_are_drawn_by_their_panel_and_way_with_their_aim(rows, small_run):
    dark = replace(rows[0].figures, flux_max_mag=math.inf, max_px_fit=0.0)
    rows = [replace(rows[0], figures=dark), *rows[1:]]
    run = small_run(lambda folder: draw_magnitudes(folder / "m", rows))
    figure = run.charts["m"]
    exact, rounded = (largest_words(rows, 10, method) for method in ("exact", "round"))
    assert run.title("m") == (
        f"On 10 bits every star to 8 magnitudes under white is within {exact} with exact,"
        f" {rounded} with round"
    )
    for number, bits in enumerate(BITS):
        aim_mag, limit_mag = AIMS[bits]
        for axes, error, aim in zip(
            figure.axes[2 * number : 2 * number + 2],
            ("flux_max_mag", "max_px_fit"),
            (aim_mag, 0.01),
            strict=True,
        ):
            lines = list(axes.get_lines())
            assert lines.pop().get_xydata().tolist() == [
                [0, aim],
                [limit_mag, aim],
                [limit_mag, 1e-5],
            ]
            assert len(lines) == len(WAYS)
            wanted = {}
            for way in WAYS:
                own = [row for row in rows if (row.bits, row.method) == (bits, way.name)]
                y = [getattr(row.figures, error) for row in own]
                # a star that shows nothing is a gap, and an error of 0 stands at the floor
                y = [max(size, 1e-5) if math.isfinite(size) else math.nan for size in y]
                wanted[way.colour, ":" if way.stealing else "-"] = y
            for line in lines:
                y = wanted.pop((line.get_color(), line.get_linestyle()))
                np.testing.assert_array_equal(line.get_ydata(), y)


def test_errors_of_each_centroider_and_against_time_are_drawn_by_their_panel(rows, small_run):
    table = centroider_errors(rows)
    timed = []
    for bits, way in product(BITS, WAYS):
        figures_of = faintest(rows, bits, way.name).figures
        timed.append(TimedWay(bits, way.name, bits * 1.5, 6.0, figures_of))
    run = small_run(lambda folder: draw_each(folder / "e", table))
    each = run.charts["e"]
    shares = [row.share for row in table]
    left = f"exact leaves {min(shares):.2f} to {max(shares):.2f} of the error"
    assert left in run.title("e")
    # the first panel's names are those of all
    names = [text.get_text() for text in each.axes[0].get_yticklabels()]
    assert names == [row.centroider for row in table if row.bits == BITS[0]]
    for axes, bits in zip(each.axes, BITS, strict=True):
        own = [row for row in table if row.bits == bits]
        assert [row.centroider for row in own] == names
        round_line, exact_line = axes.get_lines()[-2:]
        assert round_line.get_xdata().tolist() == [row.round_px for row in own]
        assert exact_line.get_xdata().tolist() == [row.exact_px for row in own]
        assert [text.get_text() for text in axes.texts] == [f"{row.share:.2f}" for row in own]
    run = small_run(lambda folder: draw_times(folder / "t", timed, Load()))
    times = run.charts["t"]
    assert "exact takes 15.0 ms and round 15.0 ms, on 10 bits" in run.title("t")
    for axes, of in (
        (times.axes[0], lambda row: row.figures.flux_rms_mag),
        # along two axes
        (times.axes[1], lambda row: math.sqrt(2) * row.figures.axis_rms_px_fit),
    ):
        places = sorted((line.get_marker(), *line.get_xydata()[0]) for line in axes.get_lines())
        markers = dict(zip(BITS, "os^", strict=True))
        wanted = sorted((markers[row.bits], row.frame_ms, of(row)) for row in timed)
        assert [place[0] for place in places] == [place[0] for place in wanted]
        np.testing.assert_allclose([p[1:] for p in places], [w[1:] for w in wanted])


def test_errors_fall_with_the_frames_of_an_exposure():
    panels = {panel.name: panel for panel in frames_panels()}
    for name in ("sRGB, 8 bits", "1 bit"):
        found = list(over_frames(panels[name], 4, (2, 6)))
        left = {(row.method, row.frames): row.flux_rms_mag for row in found}
        assert left["temporal", 6] < left["temporal", 2]
        # Exposures that are no whole turn of the mask have what it leaves; steps of one light are
        # within 1 / 6 for both.
        assert left["temporal", 6] < 0.8 * left["dither", 6]
    # a star 2 mag under white, whose peak is a level of 1 bit: all of its light in white's steps
    assert found[0].steps == pytest.approx(10 ** (-0.4 * 2) / USUAL_PSF.peak_share)
    srgb = next(over_frames(panels["sRGB, 8 bits"], 4, (6,)))
    assert srgb.flux_rms_mag < 0.003
    first_step = 1 / 255 / 12.92
    star = 10 ** (-0.4 * 6) / USUAL_PSF.peak_share
    assert srgb.steps == pytest.approx(star / first_step, rel=1e-6)
    assert steps_words(srgb) == f"sRGB, 8 bits: {srgb.steps:.1f} steps"
    assert steps_words(replace(srgb, steps=100.4)) == "sRGB, 8 bits: 100 steps"


def test_a_study_s_lines_and_tables_are_of_each_of_its_parts(rows, small_run):
    """Its times are planted, and what frames add up to."""
    over_frames = []
    for frames, panel in product((2, 6), ("coarse", "fine")):
        over_frames.append(
            codes.OverFrames(panel, 6.0, 9.0, "temporal", frames, 1 / frames, 0, 0, 0.01)
        )
    timed = []
    for bits, way in product(BITS, WAYS):
        of_way = faintest(rows, bits, way.name).figures
        timed.append(TimedWay(bits, way.name, bits * 1.5, AIMS[bits][1], of_way))
    measured = quantisation.QuantisationMeasured(rows, timed, Load(), over_frames)
    run = small_run(quantisation.report, measured)
    lines, right = run.told
    wanted = [summary(bits, rows) for bits in BITS]
    wanted += [centroiders_line(centroider_errors(rows)), times_line(timed)]
    of_frames = "coarse 0.17 mag, 0.01 px; fine 0.17 mag, 0.01 px"
    wanted.append(f"temporal over any 6 frames, rms, places by a PSF fit: {of_frames}")
    assert (lines, right) == (wanted, True)
    assert len(run.rows("over_frames")) == len(over_frames)
    assert len(run.rows("quantisation")) == len(rows)
    written = run.rows("quantisation_time")
    assert [(int(row["bits"]), row["method"], float(row["frame_ms"])) for row in written] == [
        (row.bits, row.method, row.frame_ms) for row in timed
    ]
    assert set(run.charts) == CHARTS


def test_errors_over_frames_are_rms_over_where_an_exposure_begins(monkeypatch):
    """Four begins for each number of frames, by each method; light is a frame's mean."""
    panel = frames_panels()[0]
    sprites, tile, bright, _ = codes.judged_phases(2)
    light = []
    sizes = itertools.cycle((1.0, 2.0, 3.0, 4.0))

    def errors(image, share, kinds):
        light.append(image.sum() / (share * bright.sum()))
        size = next(sizes)
        places = {kind: size * (number + 2) for number, kind in enumerate(kinds)}
        return SimpleNamespace(flux_rms_mag=size, axis_rms_px=places.get)

    planted = sprites, tile, bright, SimpleNamespace(errors=errors)
    monkeypatch.setattr(codes, "judged_phases", lambda phases: planted)
    rows = list(over_frames(panel, 2, (2, 16)))
    assert [(row.method, row.frames) for row in rows] == list(
        product(("temporal", "dither"), (2, 16))
    )
    rms = math.sqrt((1 + 4 + 9 + 16) / 4)
    for row in rows:
        figures = row.flux_rms_mag, row.axis_rms_px_moment, row.axis_rms_px_window
        assert (*figures, row.axis_rms_px_fit) == pytest.approx((rms, 2 * rms, 3 * rms, 4 * rms))
    np.testing.assert_allclose(light, 1.0, atol=0.1)


def test_errors_over_frames_are_drawn_solid_by_temporal_and_dotted_by_dither(small_run):
    rows = []
    for number, panel in enumerate(("coarse", "fine"), start=1):
        for method, times in (("temporal", 1.0), ("dither", 3.0)):
            for frames in (2, 6):
                mag = 0.1 * number * times / frames
                rows.append(
                    codes.OverFrames(panel, 6.0, 50.0 * number, method, frames, mag, 0, 0, mag / 2)
                )
    run = small_run(lambda folder: codes.draw(folder / "o", rows))
    assert run.title("o") == (
        "Over any 6 frames temporal places stars within 0.0083 px rms on coarse, and within 0.017 px"
        " on fine"
    )
    for axes, error in zip(run.charts["o"].axes, ("flux_rms_mag", "axis_rms_px_fit"), strict=True):
        drawn = {}
        for line in axes.get_lines():
            drawn[line.get_color(), line.get_linestyle()] = list(line.get_ydata())
        assert len(drawn) == 4
        for number, panel in enumerate(("coarse", "fine")):
            for method, style in (("temporal", "-"), ("dither", ":")):
                own = [row for row in rows if (row.panel, row.method) == (panel, method)]
                wanted = [getattr(row, error) for row in own]
                assert drawn[charts.SERIES[number], style] == wanted
    labels = {line.get_label() for line in run.charts["o"].axes[0].get_lines()}
    assert {"coarse: 50.0 steps", "fine: 100 steps"} < labels


@pytest.mark.parametrize(("quick", "phases", "count"), [(True, 6, 4), (False, 16, 8)])
def test_the_finding_over_frames_is_of_temporal_at_the_frames_of_the_aim(
    quick, phases, count, small_run, monkeypatch
):
    asked = []

    def planted(panel, of_phases, counts):
        asked.append((of_phases, len(counts)))
        for method, times in (("temporal", 1.0), ("dither", 3.0)):
            for frames in (4, 6):
                mag = times * frames / 100 + len(asked) / 10
                yield codes.OverFrames(panel.name, 6.0, 9.0, method, frames, mag, 7, 7, mag / 2)

    monkeypatch.setattr(codes, "over_frames", planted)
    finding = small_run(codes.report_frames, codes.measure_frames(quick)).told
    assert asked == [(phases, count)] * 5
    assert finding == (
        "temporal over any 6 frames, rms, places by a PSF fit: sRGB, 8 bits 0.16 mag, 0.08 px;"
        " gamma 2.2, 8 bits 0.26 mag, 0.13 px; linear, 8 bits 0.36 mag, 0.18 px; linear, 2 bits"
        " 0.46 mag, 0.23 px; 1 bit 0.56 mag, 0.28 px"
    )


@pytest.mark.parametrize("bits", BITS)
def test_bit_stealing_s_steps_from_black_are_by_the_shares_of_rec_709(bits: int) -> None:
    """Blue has 7 % of white, red 21 %, green 72 %: by rising light blue, red, both, green."""
    steals = {way: codes.response_of(bits, way) for way in WAYS}
    for way, response in steals.items():
        if not way.stealing:
            assert response.rgb is None and len(response.light) == 2**bits
            continue
        assert response.rgb is not None and len(response.light) == 7 * (2**bits - 1) + 1
        steps = [[0, 0, 1], [1, 0, 0], [1, 0, 1], [0, 1, 0], [0, 1, 1], [1, 1, 0], [1, 1, 1]]
        assert response.rgb[1:8].tolist() == steps
        shares = np.array([0.0722, 0.2126, 0.2848, 0.7152, 0.7874, 0.9278, 1.0])
        assert response.light[1:8] == pytest.approx(shares * response.light[7])
