"""The light of white by stars read on the tracker: ratios, scatter, error, and what is written."""

from __future__ import annotations

import math
from types import SimpleNamespace

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
from hilstar.server.bench.config import read_config

MAG = 2.5 / math.log(10)


def bench_of(rates, *, white=1e6, faintest=10.0):
    return SimpleNamespace(
        config=SimpleNamespace(
            tracker=SimpleNamespace(detector=SimpleNamespace(gain_e_per_dn=4.0))
        ),
        stars=SimpleNamespace(hip=np.arange(len(rates)) + 1, electrons_per_s=np.array(rates)),
        psf=SimpleNamespace(peak_share=0.5),
        flux_at_white_e_per_s=white,
        faintest_shown_e_per_s=faintest,
    )


def test_white_is_as_much_brighter_as_its_stars():
    bench = bench_of([1000.0, 4000.0, 2000.0])
    # 4 e per DN in 0.2 s: 1.1 of what is wanted, 0.9 and 1.3
    readings = [StarReading(1, 55.0), StarReading(2, 180.0), StarReading(3, 130.0)]
    found = scale_by_tracker(bench, readings, 0.2)
    np.testing.assert_allclose(found.ratios, [1.1, 0.9, 1.3])
    assert found.flux_at_white_e_per_s == pytest.approx(1.1e6)
    assert (found.assumed_e_per_s, found.dof, found.noise_mag) == (1e6, 2, 0.0)


def test_noise_of_a_reading_is_relative_to_it():
    readings = [StarReading(1, 100.0, 2.0), StarReading(2, 50.0, 0.5)]
    found = scale_by_tracker(bench_of([500.0, 250.0]), readings, 1.0)
    weights = [1 / ((MAG * share) ** 2 + STAR_MAG**2) for share in (0.02, 0.01)]
    np.testing.assert_allclose(found.weights, weights)
    assert found.noise_mag == pytest.approx(sum(weights) ** -0.5)


@pytest.mark.parametrize(
    ("rate", "found"), [(2.1e6, "clips"), (1.9e6, None), (9.9, "too faint"), (10.1, None)]
)
def test_a_star_is_read_between_what_clips_and_what_is_not_shown(rate, found):
    reading = [StarReading(1, 100.0)]
    if found is None:
        assert scale_by_tracker(bench_of([rate]), reading, 1.0).dof == 0
    else:
        with pytest.raises(Exception, match=found):
            scale_by_tracker(bench_of([rate]), reading, 1.0)


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
