"""The study of quantisation: its measure is right, and its tables say what its findings say."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.phases import USUAL_PSF, fainter, measure, phase_grid
from hilstar.display.render.reference import linear_image
from hilstar.instruments.study.codes import AIMS, BITS, WAYS
from hilstar.tracker.centroiders import FAMILY

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


def test_codes_meet_their_aims_at_each_depth_and_over_frames(whole_study):
    charts = {"quantisation", "quantisation_centroiders", "quantisation_time", "over_frames"}
    found = whole_study("quantisation", charts)
    assert len(found.findings) == len(BITS) + 3
    rows = found.rows("quantisation")
    assert len(rows) == len(BITS) * len(WAYS) * 5
    for bits, (aim_mag, limit) in AIMS.items():
        exact = [
            r
            for r in rows
            if r["bits"] == str(bits)
            and r["method"] == "exact"
            and float(r["mag_under_white"]) <= limit
        ]
        assert max(float(r["flux_max_mag"]) for r in exact) <= aim_mag
    faint = {r["method"]: r for r in rows if (r["bits"], float(r["mag_under_white"])) == ("8", 6.0)}
    for kind in FAMILY:
        rounded, exact = (float(faint[name][f"axis_rms_px_{kind}"]) for name in ("round", "exact"))
        assert 0 < exact < MOST_LEFT * rounded
        assert float(faint["exact"][f"max_px_{kind}"]) > exact
    assert float(faint["exact"]["centroid_rms_px"]) == pytest.approx(
        np.sqrt(2) * float(faint["exact"]["axis_rms_px_moment"])
    )
    assert all(float(row["frame_ms"]) > 0 for row in found.rows("quantisation_time"))
    rows = found.rows("over_frames")
    left = {(r["panel"], r["method"], r["frames"]): float(r["flux_rms_mag"]) for r in rows}
    for panel in dict.fromkeys(r["panel"] for r in rows):
        assert left[panel, "temporal", "6"] < left[panel, "temporal", "2"]
        # Exposures that are no whole turn of the mask have what it leaves; steps of one light are
        # within 1 / 6 for both.
        assert left[panel, "temporal", "6"] < 0.8 * left[panel, "dither", "6"]
    assert left["sRGB, 8 bits", "temporal", "6"] < 0.003
