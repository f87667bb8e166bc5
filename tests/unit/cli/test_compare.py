"""hilstar compare from its words to its lines, of skies that are drawn here."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from hilstar.display.render.reference import linear_image
from hilstar.instruments import compare as engine
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from tests.support.commands import run_hilstar_here

PSF, SIZE_PX = GaussianPsf((0.85, 0.85)), (200, 120)
# Thirteen stars in a row, one that blends with the first, one that the other sky has not, and two
# beyond the image's edge.
X_PX = [*range(20, 176, 12), 20.5, 100.0, -3.4, -3.4]
Y_PX = [*range(30, 56, 2), 30.2, 100.0, 70.0, 90.0]
RATE = 1e5 * np.array([*range(1, 14), 0.6, 7.0, 1.0, 1.0])
FAINTER_MAG = np.array([*np.arange(1, 13) * 0.01, 0.0, 0.0, np.inf, 0.0, 0.0])
EXTRA = ([180.0, 190.0], [100.0, 60.0], [3e5, 2e5])


def sky(x_px, y_px, rate):
    rows = np.arange(len(rate))
    places = np.array(x_px, dtype=float), np.array(y_px, dtype=float)
    sprites = pack_sprites(*places, np.asarray(rate), rows, SIZE_PX, PSF.footprint_px)
    return linear_image(sprites, SIZE_PX, PSF).astype(np.float64)


@pytest.fixture
def asked(monkeypatch):
    """What each comparison was asked for: the frame and the golden one, by name."""
    golden = sky(X_PX, Y_PX, RATE)
    more_x_px, more_y_px, more_rate = EXTRA
    frame = sky(
        X_PX + more_x_px, Y_PX + more_y_px, [*RATE * 10 ** (-0.4 * FAINTER_MAG), *more_rate]
    )
    truth = np.zeros(len(RATE), TRUTH_DTYPE)
    truth["hip"] = np.arange(1, len(RATE) + 1)
    truth["x_px"], truth["y_px"], truth["electrons_per_s"] = X_PX, Y_PX, RATE
    compare = engine.compare
    every = []

    def of_skies(path, golden_path, **asked_for):
        every.append((str(path), str(golden_path), asked_for))
        limits = {name: asked_for[name] for name in ("flux_mag", "centroid_px")}
        return compare(frame, golden, truth=truth, **limits)

    monkeypatch.setattr(engine, "compare", of_skies)
    return every


def test_each_figure_is_said_in_its_place(asked):
    words = ("compare", "frame.fits", "golden.fits", "--flux-mag", "0.002", "--centroid-px", "0.3")
    told = run_hilstar_here(*words)
    assert told.returncode == 1, told.stderr
    summary = json.loads(run_hilstar_here(*words, "--json").stdout)
    lines = told.stdout.splitlines()
    assert lines[0] == (
        f"{'stars compared':20}14, 1 of them blends, 2 more with too little light of their own in"
        " view"
    )
    flux = summary["flux_error_mag"]
    rms, p95, largest = (f"{flux[name]:.2g}" for name in ("rms", "p95", "max"))
    assert (largest, float(rms) < float(p95) < float(largest)) == ("0.12", True)
    assert lines[1] == (
        f"{'flux error':20}{rms} / {p95} / {largest} mag (rms / 95 % / max; limit 0.002)"
    )
    assert lines[2].startswith("centroid error      ") and lines[2].endswith("limit 0.3)")
    (missing,) = [line for line in lines if line.startswith("missing, extra")]
    assert missing.split()[-2:] == ["1,", "2"]
    stars = [line for line in lines if re.match(r" {20}\S+.* at ", line)]
    assert len(stars) == 10
    assert lines[-2].endswith("(-o DIR writes a table of all)")
    assert lines[-1] == f"{'verdict':20}NOT the same sky"


def test_limits_that_are_not_stated_are_the_usual_ones_and_0_is_stated(asked):
    run_hilstar_here("compare", "a.fits", "b.fits", "--truth", "t.csv")
    refused = run_hilstar_here("compare", "a.fits", "b.fits", "--flux-mag", "0")
    assert refused.returncode == 2
    (frame, golden, usual), (_, _, stated) = asked
    assert (frame, golden, usual["truth"].name) == ("a.fits", "b.fits", "t.csv")
    assert (usual["flux_mag"], usual["centroid_px"]) == (0.001, 0.001)
    assert stated["flux_mag"] == 0


@pytest.mark.parametrize(
    ("words", "limits"),
    [
        ("", (1e-3, 1e-3)),
        ("--flux-mag 0.5", (0.5, 1e-3)),
        ("--centroid-px 0.5", (1e-3, 0.5)),
    ],
)
def test_a_limit_that_is_not_given_is_a_thousandth(asked, words, limits):
    run_hilstar_here("compare", "frame.fits", "golden.fits", *words.split())
    ((_, _, given),) = asked
    assert (given["flux_mag"], given["centroid_px"]) == limits
