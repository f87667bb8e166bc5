"""The light of white by stars read on the tracker: ratios, scatter, error, and what is written."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.units import ERROR_OF_MEDIAN
from hilstar.instruments.calibrate.scale import (
    STAR_MAG,
    MeasuredScale,
    StarReading,
    scale_by_tracker,
    scale_of,
    with_flux_at_white,
)
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.config import read_config
from tests.support.bench_files import filed_bench
from tests.support.refusals import refusal

MAG = 2.5 / math.log(10)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A bench of 4 e- a DN."""
    tables = {"sky": {"faintest_v_mag": 4.0}, "tracker.detector": {"gain_e_per_dn": 4.0}}
    tables["render"] = {"quantisation": "round"}
    with open_bench(filed_bench(tmp_path_factory.mktemp("scale"), tables)) as made:
        yield made


def readings_of(bench, ratios, exposure_s, sigmas=None):
    """Of the faintest stars so much of the light that is wanted, each with its relative noise."""
    faintest = np.argsort(bench.stars.electrons_per_s)[: len(ratios)]
    readings = []
    for star, ratio, sigma in zip(faintest, ratios, sigmas or [0.0] * len(ratios), strict=True):
        dn = ratio * float(bench.stars.electrons_per_s[star]) * exposure_s / 4.0
        readings.append(StarReading(int(bench.stars.hip[star]), dn, sigma * dn))
    return readings


def test_white_is_as_much_brighter_as_its_stars(bench):
    found = scale_by_tracker(bench, readings_of(bench, [1.1, 0.9, 1.3], 0.2), 0.2)
    np.testing.assert_allclose(found.ratios, [1.1, 0.9, 1.3])
    white = bench.flux_at_white_e_per_s
    assert found.flux_at_white_e_per_s == pytest.approx(1.1 * white)
    assert (found.assumed_e_per_s, found.dof, found.noise_mag) == (white, 2, 0.0)


def test_noise_of_a_reading_is_relative_to_it(bench):
    shares = [0.02, 0.01]
    found = scale_by_tracker(bench, readings_of(bench, [0.8, 0.8], 1.0, shares), 1.0)
    weights = [1 / ((MAG * share) ** 2 + STAR_MAG**2) for share in shares]
    np.testing.assert_allclose(found.weights, weights)
    assert found.noise_mag == pytest.approx(sum(weights) ** -0.5)


@pytest.mark.parametrize(
    ("key", "share", "found"),
    [
        ("flux_at_white_e_per_s", 0.95, "clips"),
        ("flux_at_white_e_per_s", 1.05, None),
        ("faintest_shown_e_per_s", 1.01, "too faint"),
        ("faintest_shown_e_per_s", 0.99, None),
    ],
)
def test_a_star_is_read_between_what_clips_and_what_is_not_shown(bench, key, share, found):
    """A limit is so much of a star's light, in its brightest pixel or in all."""
    rate = float(bench.stars.electrons_per_s.min())
    if key == "flux_at_white_e_per_s":
        rate *= bench.psf.peak_share
    limited = replace(bench, **{key: share * rate})
    readings = readings_of(bench, [1.0], 1.0)
    if found is None:
        assert scale_by_tracker(limited, readings, 1.0).dof == 0
    else:
        assert found in refusal(scale_by_tracker, limited, readings, 1.0)


def test_the_scatter_is_of_a_sample_and_the_error_of_its_median():
    off = np.array([0.01, -0.02, 0.03, 0.0])
    scale = MeasuredScale(1.0, 1.0, 10 ** (-0.4 * off), np.ones(4), 0.0)
    assert scale.scatter_mag == pytest.approx(np.std(off, ddof=1))
    error_mag = ERROR_OF_MEDIAN * np.std(off, ddof=1) / 2
    assert scale.relative_error == pytest.approx(error_mag / MAG)
    # a reading of no weight neither scatters nor counts
    weighed = MeasuredScale(1.0, 1.0, 10 ** (-0.4 * off), np.array([1.0, 1.0, 1e-9, 1e-9]), 0.0)
    assert weighed.scatter_mag == pytest.approx(0.015 * math.sqrt(4 / 3), rel=1e-6)
    assert weighed.relative_error == pytest.approx(
        ERROR_OF_MEDIAN * weighed.scatter_mag / math.sqrt(2) / MAG, rel=1e-6
    )
    noisy = MeasuredScale(1.0, 1.0, np.ones(4), np.ones(4), 0.02)
    assert noisy.relative_error == pytest.approx(0.02 / MAG)
    alone = MeasuredScale(1.0, 1.0, np.array([1.1]), np.ones(1), 0.02)
    assert (alone.scatter_mag, alone.relative_error, alone.dof) == (0.0, None, 0)


def test_the_copy_gets_white_its_error_and_its_freedom(small_bench_file):
    path = small_bench_file
    found = scale_of(1e6, np.array([1.0, 1.02, 1.01]), np.zeros(3))
    output = path.parent / "scaled.toml"
    with_flux_at_white(read_bench_file(path), found, output)
    config = read_config(output)
    assert config.render.flux_at_white_e_per_s == pytest.approx(1.01e6)
    assert config.certify.flux_at_white_dof == 2
    assert config.certify.flux_at_white_relative == pytest.approx(found.relative_error, rel=5e-3)


def test_the_copy_stands_in_the_bench_file_s_own_folder(small_bench_file):
    """However that is written; another of the same name has none of its files."""
    path = small_bench_file
    found = scale_of(1e6, np.array([1.0, 1.02]), np.zeros(2))
    other = path.parent / "other" / path.parent.name
    other.mkdir(parents=True)
    file = read_bench_file(path)
    line = refusal(with_flux_at_white, file, found, other / "scaled.toml")
    assert line.endswith(f"write the copy beside {path}")
    assert not (other / "scaled.toml").exists()
    with_flux_at_white(file, found, other / ".." / ".." / "scaled.toml")
    assert read_config(path.parent / "scaled.toml").certify.flux_at_white_dof == 1
