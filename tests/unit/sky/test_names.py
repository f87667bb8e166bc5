"""Designations and names of stars, held to Skyfield's own list and to stars whose numbers
everybody knows.
"""

from __future__ import annotations

from skyfield.named_stars import named_star_dict

from hilstar.sky.catalog import label_of, load_catalog, star_names

# of Skyfield's 119 names; the others are spelt otherwise, or not the ones that the IAU approved
MIN_SHARED = 80
# Names that the IAU (WGSN, 2016 to 2018) gave to another star than Skyfield's older list: γ Crv, α
# Cen B, γ Peg and α Peg.
GIVEN_ANEW = {"Gienah": 59803, "Toliman": 71681, "Algenib": 1067, "Markab": 113963}
KNOWN = {
    27989: "α Ori",
    26311: "ε Ori",
    11767: "α UMi",
    91262: "α Lyr",
    32349: "α CMa",
    113357: "51 Peg",
    68702: "β Cen",
    5447: "β And",
}


def test_names_belong_to_the_stars_that_skyfield_gives_them():
    ours = {name: hip for hip, (_, name) in star_names().items() if name}
    shared = ours.keys() & named_star_dict.keys()
    assert len(shared) >= MIN_SHARED
    assert {name: ours[name] for name in shared} == {
        name: named_star_dict[name] for name in shared
    } | GIVEN_ANEW


def test_labels_are_designations_where_there_are_any():
    assert {hip: label_of(hip) for hip in KNOWN} == KNOWN
    assert label_of(118321) == "HIP 118321"
    assert label_of(0) == ""


def test_every_bright_star_has_a_designation():
    """Stars over V = 3.0 all have a Bayer letter or a Flamsteed number, but for the few of
    Lacaille's and Gould's south.
    """
    catalog = load_catalog()
    bright = catalog.hip[catalog.v_mag < 3.0].tolist()
    without = [hip for hip in bright if not star_names().get(hip, ("", ""))[0]]
    assert len(bright) > 150
    assert len(without) <= 5, without
