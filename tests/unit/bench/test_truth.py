"""The truth table: what the catalogue says of each star, and blanks for what is in no catalogue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.frame.truth import truth_table
from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import make_stars, unit_vectors_icrs


def test_each_star_has_its_own_variability_and_companion():
    catalog = load_catalog().brighter_than(3.5)
    ones = np.ones(len(catalog))
    stars = make_stars(catalog, unit_vectors_icrs(catalog, 2026.0), ones, ones)
    every = np.arange(len(stars))
    truth = truth_table(stars, every, ones, ones)
    by_hip = {int(row["hip"]): row for row in truth}
    mizar = by_hip[65378]
    assert (mizar["double"], mizar["separation_arcsec"], mizar["variable"]) == ("C", 14.431, "")
    algol = by_hip[14576]
    assert (algol["variable"], algol["range_mag"], algol["double"]) == ("P", 0.14, "O")
    assert np.isnan(algol["period_d"])

    unlisted = replace(stars, row=np.where(stars.hip == 65378, -1, stars.row))
    row = truth_table(unlisted, np.flatnonzero(stars.hip == 65378), ones[:1], ones[:1])[0]
    assert (row["double"], row["variable"]) == ("", "")
    assert np.isnan([row["separation_arcsec"], row["range_mag"], row["period_d"]]).all()
