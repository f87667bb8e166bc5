"""The tracker before a running display sees what the campaign's tracker before the same display
does, electron for electron.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame, frame_parts, read_frame
from hilstar.basics.rotation import normalise
from hilstar.display.calibration import CalibrationHead, NotesTable, write_calibration
from hilstar.display.response import srgb_response
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.campaign.plan import Centroiding
from hilstar.instruments.campaign.solvers import CentroidSolver
from hilstar.instruments.simulate.live_exposure import TRACKING, LiveTracker
from hilstar.optics.layers.view import View
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.frame_feed import lit_pixels
from tests.support.benches import ORION_Q, TWIN, bench_text

ORION = normalise(np.array(ORION_Q))
FRAMES = 6
BITS, BLACK = 8, 2e-3  # a glow of 30 DN a detector pixel
MIN_FOUND = 8
MAX_OFF_PX = 0.3  # stars of a few hundred electrons, in read noise of 12
PERIOD_NS = 16_666_667
SAME = 1e-6  # of the brightest pixel: both add the same float32 shares, in another order


def watched_frame(bench, number: int) -> ShownFrame:
    """A frame of the bench at Orion's belt, as a watcher gets it."""
    levels = bench.draw(ORION, number).levels
    lit, rgb = lit_pixels(levels), bench.calibration.response.rgb
    found = levels.ravel()[lit]
    codes = found if rgb is None else rgb[found]
    height, width = levels.shape
    head = FrameHead(
        number,
        number * PERIOD_NS,
        width,
        height,
        bench.config.monitor.bits,
        ORION_Q,
        1 if rgb is None else 3,
    )
    frame = read_frame(frame_parts(ShownFrame(head, lit.astype(np.uint32), codes)))
    assert isinstance(frame, ShownFrame), frame
    return frame


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {
            "monitor": {"bits": 8},
            "render": {"quantisation": "round", "bit_stealing": True},
            "verify": {"true_mirror": "x"},
        },
        {
            "render": {"quantisation": "dither"},
            "monitor": {"bits": 8, "calibration": "lcd-example"},
        },
    ],
)
def test_both_trackers_see_the_same_electrons(tmp_path: Path, rng, monkeypatch, changes):
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, changes))
    file = read_bench_file(tmp_path / "bench.toml")
    view = View.exposure(ORION, np.zeros(3), file.config.tracker.exposure_s, None)
    campaigns = DisplayTracker(file)
    wanted = campaigns.expose(view, None).mean_e
    campaigns.close()
    with open_bench(file) as bench, LiveTracker(file, rng) as live:
        for number in range(FRAMES + 1):
            live.take(watched_frame(bench, number))
        exposed = live.frames.exposed(0, FRAMES * PERIOD_NS)
        assert exposed is not None
        seen = []
        monkeypatch.setattr(live._detector, "expose", lambda light_e, *_: seen.append(light_e))
        live.expose(exposed)
    assert np.abs(seen[0] - wanted).max() < SAME * wanted.max()
    assert wanted.max() > 1000


def glowing_file(folder: Path):
    """A bench whose screen is seen whole, and glows where it is black."""
    head = CalibrationHead("photometric", "", "2026-11-28", "", "relative", BITS, "light.csv")
    light = srgb_response(BITS).light + BLACK
    write_calibration(folder / "light.toml", head, {"w": light}, 0.0, NotesTable())
    changes = {
        "monitor": {"bits": BITS, "calibration": "light.toml"},
        "tracker": {"focal_length_mm": 12},
        "tracker.detector": {"offset_dn": 40, "read_noise_e": 12},
    }
    (folder / "bench.toml").write_text(bench_text(TWIN, changes))
    return read_bench_file(folder / "bench.toml")


def test_stars_are_found_on_a_screen_that_glows_over_a_part_of_the_field(tmp_path: Path, rng):
    """A screen seen whole was one large spot above the dark around it: no star was found."""
    file = glowing_file(tmp_path)
    with open_bench(file) as bench, LiveTracker(file, rng) as live:
        for number in range(FRAMES + 1):
            live.take(watched_frame(bench, number))
        exposed = live.frames.exposed(0, FRAMES * PERIOD_NS)
        assert exposed is not None
        solved = live.solve(exposed, live.expose(exposed))
        glow_dn = float(np.ptp(live._under_e)) / file.config.tracker.detector.gain_e_per_dn
    assert glow_dn > 10
    assert solved.mode == TRACKING
    assert len(solved.found) >= MIN_FOUND


@pytest.mark.parametrize("centroider", ["window", "psf"])
def test_a_campaign_s_centroids_are_found_on_such_a_screen_too(tmp_path: Path, rng, centroider):
    tracker = DisplayTracker(glowing_file(tmp_path))
    try:
        exposure_s = tracker.config.tracker.exposure_s
        exposure = tracker.expose(View.exposure(ORION, np.zeros(3), exposure_s, None), rng)
        answer = CentroidSolver(Centroiding(centroider=centroider)).solve(exposure, tracker)
    finally:
        tracker.close()
    errors = answer.star_errors
    assert errors.matched >= MIN_FOUND
    assert errors.false <= errors.matched
    assert float(np.median(np.hypot(errors.dx_px, errors.dy_px))) < MAX_OFF_PX
