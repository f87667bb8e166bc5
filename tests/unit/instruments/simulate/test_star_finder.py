"""Which stars the twin compares."""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy.io import fits
from scipy.special import ndtr

from hilstar.instruments.simulate.star_finder import (
    StarFinder,
    crowded,
    inside_by,
    nearest,
    shared,
    star_finder,
)
from hilstar.instruments.verify.verdict import median
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.build import open_bench
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.centroids import Centroids, CentroidSettings, LocalBackground
from tests.support.bench_files import filed_bench
from tests.support.psfs import gaussian, sampled
from tests.support.spectra import write_channels

# Of a star of sigma 1 px in pixels: a window's S-curve, a box's cut wings.
BIAS_PX = {"moment": 1e-3, "window": 0.03, "wide": 0.03, "fit": 1e-3, "box3": 0.3, "box5": 0.1}


def test_a_star_is_crowded_by_the_light_that_others_bring_into_its_window():
    """Window of 9 px, sigma 1: a neighbour at the window's edge brings half of its light, one 3
    px past it a thousandth.
    """
    place = [100.0, 104.5, 200.0, 207.5, 300.0, 307.5, np.nan]
    flux = [1.0, 1.0, 1.0, 1.0, 1.0, 1000.0, 1.0]
    assert crowded(
        np.array(place), np.full(7, 50.0), np.array(flux), 4, GaussianPsf((1.0, 1.0))
    ).tolist() == [True, True, False, False, True, False, False]


def test_two_stars_that_are_found_as_one_are_no_two():
    assert shared(np.array([-1, 0, 1, 1, -1])).tolist() == [False, False, True, True, False]
    nothing = np.empty(0)
    found = Centroids(
        nothing, nothing, nothing, nothing, np.empty(0, dtype=np.intp), np.empty(0, dtype=np.bool_)
    )
    assert nearest(found, np.array([1.0, np.nan]), np.array([2.0, 2.0])).tolist() == [-1, -1]


def test_nothing_measured_has_no_zero_point():
    assert median([math.nan, 2.0, math.inf, 4.0]) == 3.0
    assert median([]) == 0.0


@pytest.mark.parametrize("kind", FAMILY)
def test_each_centroider_places_stars_where_they_are_also_aside_and_at_the_edge(kind):
    """One star where it should be, one 2 px aside, one cut by the image's edge; nothing at the
    fourth place.
    """
    finder = StarFinder(
        CentroidSettings(window_sigma_px=1.0),
        GaussianPsf((1.0, 1.0)),
        LocalBackground(0.0, 0.01),
        kind,
    )
    x_px, y_px = np.array([20.3, 42.1, 0.4, 60.0]), np.array([21.8, 40.0, 30.2, 15.0])
    places = [(20.3, 21.8), (40.1, 40.0), (0.4, 30.2)]
    share = [[np.diff(ndtr(np.arange(65) - 0.5 - at)) for at in place] for place in places]
    image = 1e4 * sum(np.outer(down, across) for across, down in share)
    matched = finder.match(image, x_px, y_px)
    assert (matched.index[:3] >= 0).all() and matched.index[3] == -1
    found = np.stack([matched.found.x_px, matched.found.y_px])[:, matched.index[:3]]
    assert np.isfinite(found).all()
    assert np.abs(found[:, :2] - np.array(places[:2]).T).max() < BIAS_PX[kind]
    assert 0 <= found[0, 2] < 1.5 and abs(found[1, 2] - 30.2) < BIAS_PX[kind]
    # a window's are where they were found, and so are none
    windowed = finder.find(image, x_px, y_px)
    assert (finder.placed(windowed, image, (x_px, y_px), kind) is windowed) == (kind == "window")
    nowhere = finder.find(0 * image, x_px, y_px)
    assert finder.placed(nowhere, 0 * image, (x_px, y_px), kind) is nowhere


@pytest.mark.parametrize(("bayer", "least"), [(None, 1.0), ("rggb", 0.25)])
def test_blobs_begin_at_a_fifth_of_the_faintest_star_s_peak_of_red_in_a_mosaic(
    tmp_path, bayer, least
):
    """Three monitor pixels to one of the tracker."""
    tables = {
        "tracker": {"psf_sigma_px": [0.6, 0.8], "exposure_s": 0.2},
        "monitor": {"bits": 8},
        "render": {"sprite_sigma_px": [0.9, 1.2], "quantisation": "round"},
        "sky": {"faintest_v_mag": 7.0},
    }
    if bayer is not None:
        nm = np.arange(400.0, 701.0, 10.0)
        curves = {name: np.full_like(nm, 0.5) for name in "rgb"}
        tables["tracker"] |= write_channels(tmp_path, nm, curves)
        tables["tracker.detector"] = {"bayer": bayer}
        tables["render"]["colour"] = "white"
    with open_bench(filed_bench(tmp_path, tables)) as bench:
        finder = star_finder(bench, 3.0)
        rates = bench.shown_stars.electrons_per_s
        faintest_e_per_s = rates[rates >= bench.faintest_shown_e_per_s].min()
    # sampled and shown by squares of a monitor pixel each
    sigma_px = [
        math.sqrt(own**2 + (shown**2 + 2 / 12) / 9) for own, shown in ((0.6, 0.9), (0.8, 1.2))
    ]
    if bayer is None:
        assert finder.psf.width_px == pytest.approx(sigma_px)
    peak_e = faintest_e_per_s * 0.2 * finder.psf.peak_share
    threshold_e = finder.background.noise * finder.settings.threshold_sigma
    assert threshold_e == pytest.approx(0.2 * least * peak_e)
    assert finder.background.level == 0.0
    assert finder.centroider == "window" and finder.told is None


@pytest.mark.parametrize(
    ("centroider", "psf", "is_told"),
    [
        ("psf", "psf.fits", True),
        ("psf", "gaussian", False),
        ("window", "psf.fits", False),
        ("box3", "gaussian", False),
    ],
)
def test_a_centroider_of_the_psf_is_told_that_of_a_star_as_shown(
    tmp_path, centroider, psf, is_told
):
    """Samples of a Gaussian of 0.8 by 0.6 px before one of 0.9 px of a monitor three times as fine, of
    two squares; a Gaussian is known by its width.
    """
    samples = sampled(gaussian(0.8, 0.6), 5, 5).astype(np.float32)
    header = fits.Header([("OVERSAMP", 5)])
    fits.PrimaryHDU(samples, header).writeto(tmp_path / "psf.fits")
    tables = {
        "tracker.optics": {"psf": psf},
        "render": {"sprite_sigma_px": [0.9, 0.9]},
        "sky": {"faintest_v_mag": 5.0},
        "verify": {"centroider": centroider},
    }
    with open_bench(filed_bench(tmp_path, tables)) as bench:
        finder = star_finder(bench, 3.0)
    assert finder.centroider == centroider
    assert (finder.told is not None) is is_told
    if finder.told is not None:
        shown_px2 = (0.9**2 + 2 / 12) / 9
        wanted_px = np.sqrt(np.array([0.8, 0.6]) ** 2 + shown_px2)
        assert finder.told.width_px == pytest.approx(wanted_px, rel=0.01)


def test_places_are_inside_by_the_margin_of_each_axis():
    x_px = np.array([2.0, 2.1, 96.9, 97.0, 50.0, 50.0, 50.0, 50.0])
    y_px = np.array([20.0, 20.0, 20.0, 20.0, 2.0, 2.1, 46.9, 47.0])
    expected = [False, True, True, False, False, True, True, False]
    assert inside_by(2.0, x_px, y_px, (100, 50)).tolist() == expected


def test_of_several_stars_that_are_found_about_a_place_the_nearest_is_its():
    x_px = np.array([10.6, 10.1, 9.5, 40.0])
    none = np.zeros(4)
    whole = np.zeros(4, dtype=np.intp)
    found = Centroids(x_px, none, none, none, whole, whole.astype(np.bool_))
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 3, 2]):
        turned = Centroids(x_px[order], none, none, none, whole, whole.astype(np.bool_))
        match = nearest(turned, np.array([10.0, 40.2, 70.0]), np.zeros(3))
        assert x_px[order][match[:2]].tolist() == [10.1, 40.0]
        assert match[2] == -1
    assert nearest(found, np.array([10.4]), np.zeros(1)).tolist() == [0]
