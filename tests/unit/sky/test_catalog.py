"""The packaged catalogue, and a user's own hip_main.dat."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from hilstar.sky.catalog import COLUMN_COUNT, PACKAGED_CATALOG, load_catalog, plain_catalog
from tests.support.refusals import refusal

# Rows 1 and 2 of CDS I/239 and HIP 32349 (Sirius), as they stand in the file.
ROWS = (
    (
        "H|           1| |00 00 00.22|+01 05 20.4| 9.10| |H|000.00091185|+01.08901332| |   3.54|  "
        " -5.20|   -1.88|  1.32|  0.74|  1.39|  1.36|  0.81| 0.32|-0.07|-0.11|-0.24| 0.09|-0.01|"
        " 0.10|-0.01| 0.01| 0.34|  0| 0.74|     1| 9.643|0.020| 9.130|0.019| |"
        " 0.482|0.025|T|0.55|0.03|L| | 9.2043|0.0020|0.017| 87| | 9.17| 9.24|       | | | |        "
        "  | |  | 1| | | |  |   |       |     |     |    |S| | |224700|B+00 5077 |          |      "
        "    |0.66|F5          |S "
    ),
    (
        "H|           2| |00 00 00.91|-19 29 55.8| 9.27| |G|000.00379737|-19.49883745|+|  21.90| "
        " 181.21|   -0.93|  1.28|  0.70|  3.10|  1.74|  0.92| 0.12|-0.14|-0.24|-0.29| 0.01|"
        " 0.21|-0.02|-0.19|-0.28| 0.14|  2| 1.45|     2|10.519|0.033| 9.378|0.021| |"
        " 0.999|0.002|G|1.04|0.00|I| | 9.4017|0.0017|0.015|120| | 9.37| 9.44|       |C| | |        "
        "  | |  | 1|O| | |  |   |       |     |     |    | | | |224690|B-20 6688 |          |      "
        "    |1.04|K3V         |4 "
    ),
)

# Of the 116 812 stars that are used: types P, U and M of field H52, and those with a separation in
# field H64.
VARIABLES, RESOLVED = 11_189, 10_860


def with_field(row: str, column: int, text: str) -> str:
    fields = row.split("|")
    fields[column] = text
    return "|".join(fields)


def test_every_usable_row_is_there():
    catalog = load_catalog()
    assert catalog.rows_read == 118_218
    assert len(catalog) == 116_812
    assert len(np.unique(catalog.hip)) == 116_812
    for name in (
        "ra_deg",
        "dec_deg",
        "v_mag",
        "bv_mag",
        "vi_mag",
        "pm_ra_cosdec_mas_yr",
        "pm_dec_mas_yr",
    ):
        assert np.isfinite(getattr(catalog, name)).all(), name


def test_the_packaged_file_names_its_source():
    with np.load(PACKAGED_CATALOG) as packed:
        assert (
            str(packed["source_sha256"])
            == "58ceabb104d647160d9437ce6e513a02a036bb4ad9f8879a5a22fd52943616e0"
        )
    assert len(hashlib.sha256(PACKAGED_CATALOG.read_bytes()).hexdigest()) == 64
    assert PACKAGED_CATALOG.stat().st_size < 6_000_000


def test_the_magnitude_limit_is_inclusive():
    catalog = load_catalog()
    kept = catalog.brighter_than(4.0)
    assert kept.v_mag.max() == 4.0
    assert len(kept) == (catalog.v_mag <= 4.0).sum()


def test_a_user_s_own_hip_main_gives_the_packaged_figures(tmp_path):
    path = tmp_path / "hip_main.dat"
    path.write_text("\n".join(ROWS) + "\n")
    own, packaged = load_catalog(path), load_catalog()
    assert own.rows_read == 2
    for k in range(2):
        place = np.flatnonzero(packaged.hip == own.hip[k])[0]
        for name in (
            "ra_deg",
            "dec_deg",
            "v_mag",
            "bv_mag",
            "vi_mag",
            "pm_ra_cosdec_mas_yr",
            "pm_dec_mas_yr",
        ):
            assert getattr(own, name)[k] == getattr(packaged, name)[place]


def test_each_figure_of_a_row_is_kept_to_its_last_digit(tmp_path):
    """None of these is a binary fraction: 100 times 0.29 is less than 29."""
    row = ROWS[0]
    for column, text in ((5, "1.15"), (11, "0.57"), (12, "-0.29"), (37, "1.009"), (40, "1.13")):
        row = with_field(row, column, text)
    path = tmp_path / "hip_main.dat"
    path.write_text(row + "\n")
    one = load_catalog(path)
    kept = one.v_mag, one.parallax_mas, one.pm_ra_cosdec_mas_yr, one.bv_mag, one.vi_mag
    assert np.concatenate(kept) == pytest.approx([1.15, 0.57, -0.29, 1.009, 1.13], abs=1e-6)


def test_a_row_without_colour_is_read_and_left_out(tmp_path):
    path = tmp_path / "hip_main.dat"
    path.write_text(with_field(ROWS[0], 37, "      ") + "\n" + ROWS[1] + "\n")
    catalog = load_catalog(path)
    assert catalog.rows_read == 2
    assert catalog.hip.tolist() == [2]


def test_a_missing_v_minus_i_is_nan(tmp_path):
    path = tmp_path / "hip_main.dat"
    path.write_text(with_field(ROWS[0], 40, "    ") + "\n")
    assert np.isnan(load_catalog(path).vi_mag).tolist() == [True]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no star"),
        ("hello\n", "hip_main.dat:1: not a row"),
        (ROWS[0] + "\n" + ROWS[1].replace("|", ";") + "\n", "hip_main.dat:2: not a row"),
        (with_field(ROWS[0], 5, " bad ") + "\n", "hip_main.dat:1: field 5 (v_mag)"),
        (with_field(ROWS[0], 5, " inf ") + "\n", "hip_main.dat:1: field 5 (v_mag)"),
        ("\N{SNOWMAN}", "hip_main.dat:1: not a row"),
        (with_field(ROWS[0], 8, " nan ") + "\n", "hip_main.dat:1: field 8 (ra_deg)"),
        (with_field(ROWS[0], 8, "400") + "\n", "write a number from 0 to 360"),
        (
            with_field(ROWS[0], 9, "-90.01") + "\n",
            "field 9 (dec_deg) is '-90.01'; write a number from -90 to 90",
        ),
        (with_field(ROWS[0], 5, "-1000000") + "\n", "write a number from -30 to 40"),
        (with_field(ROWS[0], 1, "9" * 11) + "\n", "field 1 (hip)"),
        (with_field(ROWS[0], 1, "1" * 100_000) + "\n", "field 1 (hip) is '1111"),
        (with_field(ROWS[0], 52, "PP") + "\n", "field 52 (variable) is 'PP'"),
        (with_field(ROWS[0], 52, "\N{GREEK CAPITAL LETTER PI}") + "\n", "field 52 (variable) is"),
        (with_field(ROWS[0], 64, "-1") + "\n", "field 64 (separation_arcsec)"),
        (with_field(ROWS[0], 12, "1e9") + "\n", "field 12 (pm_ra_cosdec_mas_yr)"),
    ],
)
def test_a_file_that_is_no_catalogue_is_refused(tmp_path, text, words):
    assert len(ROWS[0].split("|")) == COLUMN_COUNT
    path = tmp_path / "hip_main.dat"
    path.write_text(text, encoding="utf-8")
    assert words in refusal(load_catalog, path)


def test_variables_and_doubles_are_as_the_catalogue_has_them():
    """CDS I/239, fields H49 to H52, H59 and H64 of Algol, Mira, Mizar and Vega."""
    catalog = load_catalog()
    rows = {int(hip): row for row, hip in enumerate(catalog.hip)}
    algol, mira, mizar, vega = (rows[hip] for hip in (14576, 10826, 65378, 91262))
    assert catalog.variable[[algol, mira, mizar, vega]].tolist() == [b"P", b"P", b"", b"U"]
    assert catalog.period_d[mira] == pytest.approx(333.80)
    assert catalog.range_mag[[algol, mira]] == pytest.approx([0.14, 3.64])
    assert np.isnan([catalog.range_mag[mizar], catalog.period_d[algol]]).all()
    assert catalog.multiple[[algol, mira, mizar]].tolist() == [b"O", b"", b"C"]
    assert catalog.separation_arcsec[mizar] == pytest.approx(14.431)
    assert (catalog.variable != b"").sum() == VARIABLES
    assert np.isfinite(catalog.separation_arcsec).sum() == RESOLVED


def test_a_star_is_called_by_its_catalogue():
    zero = np.zeros(2)
    columns = {"v_mag": zero, "ra_deg": zero, "dec_deg": zero}
    tycho = plain_catalog("TYC", 2, columns | {"identifier": np.array([9_537_003_861, 1_000_133])})
    gaia = plain_catalog(
        "Gaia DR3",
        2,
        columns | {"identifier": np.array([4_295_806_720, 2**62]), "hip": np.array([0, 7])},
    )
    assert [tycho.name(row) for row in range(2)] == ["TYC 9537-386-1", "TYC 1-13-3"]
    assert [gaia.name(row) for row in range(2)] == ["Gaia DR3 4295806720", "HIP 7"]


@pytest.mark.parametrize(
    ("designation", "name", "identifier"),
    [
        ("Gaia DR3", "Gaia DR3 4295806720", 4_295_806_720),
        ("TYC", "TYC 8-3041-2", 8_030_412),
        ("mine", "mine 12", 12),
    ],
)
def test_a_name_of_a_catalogue_s_own_leads_back_to_its_star(designation, name, identifier):
    columns = {
        "v_mag": np.zeros(1),
        "ra_deg": np.zeros(1),
        "dec_deg": np.zeros(1),
        "identifier": np.array([identifier]),
    }
    catalog = plain_catalog(designation, 1, columns)
    assert catalog.name(0) == name and catalog.identifier_of(name) == identifier
    assert [
        catalog.identifier_of(other)
        for other in ("HIP 3", f"{designation} x", f"{designation} {'9' * 20}", designation, "")
    ] == [None] * 5
