"""Stars by name, designation and number."""

from __future__ import annotations

import math

import pytest

from hilstar.basics.errors import InputError
from hilstar.sky.named_stars import hip_named, hip_of, star_place_deg
from tests.support.refusals import refusal

# SIMBAD's places, ICRS, epoch J2000, degrees; Barnard's star moves by 10.4 arcsec a year.
AT_J2000_DEG = {
    "Vega": (279.23473479, 38.78368896),
    "Sirius": (101.28715533, -16.71611586),
    "HIP 87937": (269.45207696, 4.69336497),
    "Polaris": (37.95456067, 89.26410897),
}
TOLERANCE_ARCSEC = 0.2  # Hipparcos' places carried over 8.75 years by its proper motions


@pytest.mark.parametrize("name", AT_J2000_DEG)
def test_a_star_stands_where_simbad_has_it(name):
    ra_deg, dec_deg = star_place_deg(name, 2000.0)
    wanted_ra_deg, wanted_dec_deg = AT_J2000_DEG[name]
    east = (ra_deg - wanted_ra_deg) * math.cos(math.radians(wanted_dec_deg))
    assert math.hypot(east, dec_deg - wanted_dec_deg) * 3600 < TOLERANCE_ARCSEC


def test_a_star_moves_with_the_epoch():
    before, after = (star_place_deg("87937", epoch) for epoch in (2000.0, 2026.0))
    assert (after[1] - before[1]) * 3600 == pytest.approx(26 * 10.33, abs=0.5)


@pytest.mark.parametrize(
    "text", ["Vega", "vega", " VEGA ", "α Lyr", "alpha Lyr", "ALPHA LYR", "91262", "HIP91262"]
)
def test_one_star_has_many_spellings(text):
    assert hip_of(text) == 91262


def test_a_number_above_a_letter_is_written_after_it():
    assert hip_named("omicron1 CMa") == hip_named("ο¹ CMa") is not None


def test_lambda_is_spelled_as_people_spell_it():
    assert hip_named("lambda Ori") == hip_named("λ Ori") == 26207


@pytest.mark.parametrize(
    ("designation", "hip"),
    [("alpha Cen", 71683), ("delta Cep", 110991), ("gamma Col", 28199), ("55 UMa", 55266)],
)
def test_a_designation_of_two_stars_is_the_brighter_ones(designation, hip):
    assert hip_named(designation) == hip


def test_a_name_that_no_star_has_is_answered_with_the_nearest():
    assert hip_named("sirus") is None
    assert "did you mean Sirius" in refusal(hip_of, "sirus")
    with pytest.raises(InputError, match="HIP 999999: the packaged catalogue has no place"):
        star_place_deg("HIP 999999", 2026.0)
