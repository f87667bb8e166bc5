"""The study of quantisation: its measure is right, and its tables say what its findings say."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hilstar.display.phases import USUAL_PSF, fainter, measure, phase_grid
from hilstar.display.render.reference import linear_image
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
    WayErrors,
    centroider_errors,
    centroiders_line,
    faintest,
    largest_words,
    summary,
    way_errors,
)
from hilstar.tracker.centroiders import FAMILY
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


def test_fainter_stars_have_less_light():
    sprites, _ = phase_grid(2)
    ratio = fainter(sprites, 5.0).data["electrons_per_s"] / sprites.data["electrons_per_s"]
    assert ratio == pytest.approx(np.full(4, 0.01))


def test_the_command_has_a_finding_for_each_depth_and_times(whole_study):
    charts = {"quantisation", "quantisation_centroiders", "quantisation_time", "over_frames"}
    found = whole_study("quantisation", charts)
    assert len(found.findings) == len(BITS) + 3
    assert all(float(row["frame_ms"]) > 0 for row in found.rows("quantisation_time"))


@pytest.fixture(scope="module")
def rows():
    return way_errors(quick=True)


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
