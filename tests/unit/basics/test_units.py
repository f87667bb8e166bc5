"""Units as people spell them: how large each is, by Astropy's definition of it."""

from __future__ import annotations

import pytest
from astropy import units as u

from hilstar.basics.units import DIMENSIONS, factor, plain_unit

# The first spelling of each table, and what it is called there; a spelling that Astropy lacks or
# takes for another unit, in its words.
FIRST = (u.s, u.nm, u.deg, u.rad / u.s, u.mas / u.yr, u.dimensionless_unscaled, u.pix, u.mag)
IN_ASTROPY = {
    "a": u.AA,
    "h": u.h,
    "%": u.percent,
    "permille": u.Unit("0.001"),
    "px": u.pix,
    "rpm": u.cycle / u.min,
    "1": u.dimensionless_unscaled,
}
SIZES = [
    (spellings.split(), size, first)
    for table, first in zip(DIMENSIONS, FIRST, strict=True)
    for spellings, size in table.items()
]


@pytest.mark.parametrize(("spellings", "size", "first"), SIZES, ids=[one[0][0] for one in SIZES])
def test_a_unit_is_as_large_as_astropy_s(spellings, size, first):
    plain = spellings[0]
    unit = IN_ASTROPY[plain] if plain in IN_ASTROPY else u.Unit(plain)
    if plain == "h" and first == u.deg:
        unit = u.hourangle
    assert float(size) == pytest.approx(unit.to(first), rel=1e-14)
    for spelling in spellings:
        assert factor(spelling, spellings[0]) == 1


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("°/s", "deg/s"),
        ("Å", "a"),
        ('"/yr', "arcsec/yr"),
        ('"', "arcsec"),
        ("deg per s", "deg/s"),
        ("mas / yr", "mas/yr"),
        ("rad s⁻¹", "rads-1"),
        ("µas", "uas"),
        ("percent", "percent"),
    ],
)
def test_a_unit_is_read_however_it_is_written(text, plain):
    assert plain_unit(text) == plain


def test_units_of_two_kinds_have_no_factor():
    assert factor("s", "deg") is None and factor("h", "s") == 3600 and factor("h", "deg") == 15
