"""A table beside Hipparcos: no star twice, pairs as one, and how the magnitudes compare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.sky.catalog import Catalog, load_catalog, plain_catalog
from hilstar.sky.star_table import join
from hilstar.sky.stars import unit_vectors_icrs

ARCSEC = np.pi / (180 * 3600)
BARNARD, MIZAR, SIRIUS = 87937, 65378, 32349


def moved_catalogue(catalog: Catalog, epoch_jyear: float, fainter_mag: float = 0.0) -> Catalog:
    """The same stars as another catalogue has them, at another epoch and without HIP numbers."""
    x, y, z = unit_vectors_icrs(catalog, epoch_jyear).T
    columns = {
        "ra_deg": np.degrees(np.arctan2(y, x)) % 360,
        "dec_deg": np.degrees(np.arctan2(z, np.hypot(x, y))),
        "v_mag": catalog.v_mag + fainter_mag,
        "bv_mag": catalog.bv_mag,
        "epoch_jyear": np.full(len(catalog), epoch_jyear),
    }
    return plain_catalog("Gaia DR3", len(catalog), columns)


def shifted(table: Catalog, row: int, north_arcsec: float, fainter_mag: float) -> Catalog:
    """One star beside that of `row`."""
    star = table.taken(np.array([row]))
    return replace(star, dec_deg=star.dec_deg + north_arcsec / 3600, v_mag=star.v_mag + fainter_mag)


def stacked(*parts: Catalog) -> Catalog:
    columns = {
        n: np.concatenate([getattr(p, n) for p in parts])
        for n in ("ra_deg", "dec_deg", "v_mag", "bv_mag", "epoch_jyear")
    }
    return plain_catalog("Gaia DR3", len(columns["v_mag"]), columns)


def test_no_star_of_hipparcos_stands_twice_at_any_epoch():
    hipparcos = load_catalog()
    for epoch_jyear in (1991.25, 2000.0, 2016.0):
        joined = join(hipparcos, moved_catalogue(hipparcos, epoch_jyear, 0.01))
        assert len(joined.catalog) == len(hipparcos)
        assert np.array_equal(joined.catalog.hip, hipparcos.hip)
        assert "V differs by +0.010 mag in the median" in joined.line
        assert joined.doubt is None
    # Barnard's star moves by 258 arcsec in those 25 years: at the wrong epoch it would stand twice.
    barnard = hipparcos.taken(hipparcos.hip == BARNARD)
    stale = replace(moved_catalogue(barnard, 2016.0), epoch_jyear=np.array([1991.25]))
    assert len(join(hipparcos, stale).catalog) == len(hipparcos) + 1


def test_places_are_compared_at_the_median_epoch_of_the_table():
    """Two of three are of 2016, Barnard's star among them."""
    hipparcos = load_catalog()
    early = moved_catalogue(hipparcos.taken(hipparcos.hip == MIZAR), 1991.25)
    late = [
        moved_catalogue(hipparcos.taken(hipparcos.hip == hip), 2016.0) for hip in (BARNARD, SIRIUS)
    ]
    assert len(join(hipparcos, stacked(early, *late)).catalog) == len(hipparcos)


def test_further_stars_are_added_with_their_own_name_and_epoch():
    hipparcos = load_catalog()
    table = moved_catalogue(hipparcos.taken(hipparcos.hip == SIRIUS), 2016.0)
    table = stacked(table, shifted(table, 0, 60.0, 8.0))
    catalog = join(hipparcos, table).catalog
    assert len(catalog) == len(hipparcos) + 1
    assert (catalog.name(len(catalog) - 1), catalog.epoch_jyear[-1]) == ("Gaia DR3 2", 2016.0)
    assert catalog.rows_read == hipparcos.rows_read + 2


def test_a_pair_that_hipparcos_sums_takes_in_both_components_of_the_table():
    """Mizar's V = 2.23 is of both, 14.4 arcsec apart: a table has 2.27 and 3.95 there."""
    hipparcos = load_catalog()
    mizar = moved_catalogue(hipparcos.taken(hipparcos.hip == MIZAR), 2016.0)
    components = stacked(shifted(mizar, 0, 0.0, 0.04), shifted(mizar, 0, -14.4, 1.72))
    assert len(join(hipparcos, components).catalog) == len(hipparcos)
    # the orbit may have widened it by 2 arcsec, and a component may be a little brighter than the sum
    widest = int(np.nanargmax(hipparcos.separation_arcsec))
    two = hipparcos.taken(np.append(np.flatnonzero(hipparcos.hip == MIZAR), widest))
    for north_arcsec, fainter_mag, is_own in (
        (-16.3, 1.7, False),
        (-16.5, 1.7, True),
        (-14.4, -0.9, False),
        (-14.4, -1.1, True),
    ):
        component = shifted(mizar, 0, north_arcsec, fainter_mag)
        assert len(join(two, component).catalog) == 2 + is_own
    # the widest pair bounds where a component is looked for
    beside_arcsec = float(two.separation_arcsec[1]) + 1.9
    component = shifted(moved_catalogue(two, 2016.0), 1, beside_arcsec, 1.7)
    assert len(join(two, component).catalog) == 2
    # A star as near to a single one, and farther than any photometer's blur, is one of its own.
    vega = moved_catalogue(hipparcos.taken(hipparcos.hip == 91262), 2016.0)
    assert (
        len(join(hipparcos, stacked(vega, shifted(vega, 0, -14.4, 6.0))).catalog)
        == len(hipparcos) + 1
    )


def test_a_star_off_its_place_is_another_where_one_is_at_that_place():
    hipparcos = load_catalog().brighter_than(5.0)
    vega = moved_catalogue(hipparcos.taken(hipparcos.hip == 91262), 2016.0)
    beside = stacked(vega, shifted(vega, 0, 6.0, 0.3))
    assert len(join(hipparcos, beside).catalog) == len(hipparcos) + 1


@pytest.mark.parametrize("fainter_mag", [0.3, 3.0, -0.3, -3.0])
def test_a_star_off_its_place_is_the_same_where_its_magnitude_is(fainter_mag):
    """0.3 mag either way are errors of a magnitude; 3 mag are another star."""
    hipparcos = load_catalog().brighter_than(5.0)
    vega = moved_catalogue(hipparcos.taken(hipparcos.hip == 91262), 2016.0)
    joined = join(hipparcos, shifted(vega, 0, 6.0, fainter_mag))
    assert len(joined.catalog) == len(hipparcos) + (abs(fainter_mag) > 1)


@pytest.mark.parametrize("sign", [1, -1], ids=["fainter", "brighter"])
def test_an_overlap_s_differences_are_said_by_their_size(sign):
    """Of single constant stars 0.03 mag off three are 2 mag off; others may differ by anything."""
    hipparcos = load_catalog()
    bright = hipparcos.brighter_than(5.0)
    plain = (bright.variable == b"") & (bright.multiple == b"")
    table = moved_catalogue(bright, 2016.0)
    v_mag = table.v_mag + np.where(plain, sign * 0.03, -0.4)
    v_mag[np.flatnonzero(plain)[[5, 50, 100]]] += sign * 2.0
    bv_mag = table.bv_mag + np.where(plain, sign * 0.02, -0.4)
    line = join(hipparcos, replace(table, v_mag=v_mag, bv_mag=bv_mag)).line
    assert line == (
        f"{len(bright)} stars of Hipparcos are among them, of {plain.sum()} single constant ones V"
        f" differs by {sign * 0.03:+.3f} mag in the median (0.030 at 95 %, 3 by more than 1) and"
        f" B-V by {sign * 0.02:+.3f}; 0 stars added to Hipparcos' {len(hipparcos)}"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dec_deg": 0.01}, "Hipparcos has 0% at their place"),
        ({"v_mag": 0.05}, "its V differs by +0.050 mag"),
        ({"v_mag": -0.05}, "its V differs by -0.050 mag"),
    ],
)
def test_an_overlap_that_does_not_fit_is_said(change, words):
    hipparcos = load_catalog()
    table = moved_catalogue(hipparcos.brighter_than(6.0), 2016.0)
    (name, by), *_ = change.items()
    joined = join(hipparcos, replace(table, **{name: getattr(table, name) + by}))
    assert joined.doubt is not None
    assert words in joined.doubt


@pytest.mark.parametrize("count", [19, 20])
def test_twenty_bright_stars_are_enough_to_doubt_places(count):
    hipparcos = load_catalog().brighter_than(5.0)
    table = moved_catalogue(hipparcos.taken(np.arange(count)), 2016.0)
    joined = join(hipparcos, replace(table, dec_deg=table.dec_deg + 0.01))
    assert (joined.doubt is not None) == (count == 20)
