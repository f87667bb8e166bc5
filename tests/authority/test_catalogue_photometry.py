"""V and colours from other passbands: Tycho's against the ground's, Gaia's against spectra
through its passbands.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import load_library
from hilstar.sky.table_reader import bv_from_vi, from_gaia, from_tycho
from tests.support.claims import holds

HERE = Path(__file__).parent
DEFAULT_DEPTH_V_MAG = 7.5
# Mamajek et al. 2002 state 0.006 mag in V and 0.009 in B-V; ground and Tycho scatter by 0.015 and
# 0.02
# mag a star, the median of 20 by 0.25 of that. In V they leave 0.015 at the red end, where the
# linear relation of the catalogue itself has 0.05 in B-V at BT - VT = 0.5.
TYCHO_MEDIAN_MAG, TYCHO_BIN_MAG = 0.009, 0.02
# Riello et al. 2021: scatter 0.030 mag in V, 0.038 in I. The library's stars are V = 0 at 3.631e-9,
# Vega's system at 0.03 mag from it by its V; the coolest giants, beyond BP - RP = 2.5, are beyond
# the relations' scatter.
GAIA_ZERO_MAG, GAIA_MEDIAN_MAG, COOL_MAG = 0.03, 0.02, 2.5


def photometry_columns(name: str) -> dict[str, np.ndarray]:
    lines = [line for line in (HERE / name).read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    return {
        key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key.endswith("_mag")
    }


def test_tycho_magnitudes_become_those_of_the_ground():
    stars = photometry_columns("tycho_photometry.csv")
    v, bv = from_tycho(stars["bt_mag"], stars["vt_mag"])
    colour = stars["bt_mag"] - stars["vt_mag"]
    for name, ours, theirs in (("v", v, stars["v_mag"]), ("bv", bv, stars["bv_mag"])):
        error = ours - theirs
        assert abs(np.median(error)) < TYCHO_MEDIAN_MAG
        holds(f"tycho-{name}", np.quantile(np.abs(error), 0.95))
        for low in np.arange(-0.25, 2.0, 0.25):
            part = error[(colour >= low) & (colour < low + 0.25)]
            assert abs(np.median(part)) < TYCHO_BIN_MAG, low


def test_tycho_s_relation_is_the_published_one():
    """By hand at BT - VT = 0.3 and 1: the two polynomials of B - V, and that of V."""
    v, bv = from_tycho(np.array([10.3, 11.0]), np.array([10.0, 10.0]))
    assert bv == pytest.approx(
        [0.3 - 0.006 - 0.03207 + 0.013131, 1 - 0.007813 - 0.1489 + 0.03384], abs=1e-12
    )
    assert v == pytest.approx(
        [
            10 + 0.00097 - 0.04002 + 0.0049374 - 0.00053946,
            10 + 0.00097 - 0.1334 + 0.05486 - 0.01998,
        ],
        abs=1e-12,
    )


@pytest.mark.parametrize(("edge_mag", "way"), [(2.0, 1), (-0.25, -1)], ids=["red", "blue"])
def test_beyond_its_range_tycho_s_relation_goes_on_without_a_step(edge_mag, way):
    colour = edge_mag + way * np.array([0.0, 1e-9, 1.0])
    v, bv = from_tycho(10 + colour, np.full(3, 10.0))
    assert v == pytest.approx(np.full(3, v[0]), abs=1e-9)
    assert np.diff(bv) == pytest.approx([0, way], abs=1e-8)


@pytest.mark.parametrize(("edge_mag", "way"), [(4.5, 1), (-0.5, -1)], ids=["red", "blue"])
def test_beyond_its_range_gaia_s_relation_is_that_of_its_end(edge_mag, way):
    """Polynomials of up to the third power, which run away from what they were fitted to."""
    v, vi = from_gaia(np.full(3, 10.0), edge_mag + way * np.array([0.0, 0.1, 3.0]))
    assert v == pytest.approx(np.full(3, v[0]), abs=1e-12)
    assert vi == pytest.approx(np.full(3, vi[0]), abs=1e-12)


def test_gaia_magnitudes_become_those_of_the_spectra():
    stars = photometry_columns("gaia_photometry.csv")
    library = load_library()
    v, vi = from_gaia(stars["g_mag"], stars["bp_mag"] - stars["rp_mag"])
    plain = stars["bp_mag"] - stars["rp_mag"] < COOL_MAG
    assert plain.sum() > 90
    assert abs(np.median(v[plain])) < GAIA_ZERO_MAG
    holds("gaia-v", np.abs(v[plain] - np.median(v[plain])).max())
    assert abs(np.median(vi[plain] - library.vi_mag[plain])) < GAIA_MEDIAN_MAG
    holds("gaia-vi", np.abs(vi[plain] - library.vi_mag[plain]).max())


def test_stars_beyond_the_default_depth_have_so_much_of_the_light():
    v_mag = load_catalog().v_mag
    light = 10 ** (-0.4 * v_mag)
    holds("depth-light", 100 * light[v_mag > DEFAULT_DEPTH_V_MAG].sum() / light.sum())


def test_b_less_v_by_v_less_i_is_right_where_rates_depend_on_it():
    """Electron rates take B-V up to 0.3 only, where 0.1 mag of it is worth 1 to 2 % of a rate."""
    library = load_library()
    hot = library.bv_mag < 0.3
    error = bv_from_vi(library.vi_mag[hot]) - library.bv_mag[hot]
    assert np.median(np.abs(error)) < 0.06
    assert np.abs(error).max() < 0.16
