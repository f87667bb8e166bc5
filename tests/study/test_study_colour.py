"""What the study of colour finds: a Bayer tracker sees each star's own colour, and what no
monitor can show is stated.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.display.response import srgb_response
from hilstar.instruments.study import colour
from hilstar.instruments.study.colour import (
    MONO,
    NM,
    PANELS,
    PUBLISHED_SUBTYPES,
    SENSORS,
    class_rows,
    curve_of,
    light_by_primary,
    write_spectrum,
)
from hilstar.sky.spectral_types import LETTERS
from tests.support.claims import holds
from tests.support.recorded import assert_recorded

AIM_SUBTYPES, AIM_PERCENT, AIM_LATERAL = 3.0, 2.0, 0.1


@pytest.fixture(scope="module")
def study(whole_study):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(colour, "QUICK_ROUNDS", 1)  # no claim here is of a time
        found = whole_study("colour", {"colour"})
    return found.folder, found.rows


def test_codes_of_stars_own_mixtures_keep_every_channel_and_colour_before_a_bayer_tracker(study):
    _, rows = study
    at = {(row["tracker"], row["colour"], row["method"]): row for row in rows("colour")}
    assert len(at) == 12
    star, white = (at["Bayer", colour, "exact"] for colour in ("star", "white"))
    assert float(star["subtypes"]) < AIM_SUBTYPES < PUBLISHED_SUBTYPES < float(white["subtypes"])
    assert float(star["channel"]) < AIM_PERCENT < float(white["channel"])
    assert float(star["px"]) < 0.01 and float(star["mag"]) < 0.005
    assert float(at["Bayer", "star", "round"]["subtypes"]) > float(star["subtypes"])


def test_mixtures_reach_every_star_of_a_mosaic_and_not_the_near_infrared_of_a_mono_sensor(study):
    _, rows = study
    gamut = rows("colour_gamut")
    assert {(row["panel"], row["sensor"]) for row in gamut} == {
        (one, two) for one in PANELS for two in (*MONO, *SENSORS)
    }
    assert all(float(row["subtypes"]) < AIM_SUBTYPES for row in gamut if row["sensor"] in SENSORS)
    assert all(
        float(row["subtypes"]) < 1e-3 for row in gamut if row["sensor"] == "ccd47-20 to 700 nm"
    )
    by_class = {
        (row["panel"], row["sensor"], row["class"]): float(row["subtypes"])
        for row in rows("colour_class")
    }
    # the near infrared is what is missing
    assert all(by_class["OLED", "ccd47-20", kind] < AIM_SUBTYPES for kind in "OBAF")
    assert all(by_class["OLED", "ccd47-20", kind] > AIM_SUBTYPES for kind in "GKM")
    wide = [row for row in gamut if row["sensor"] == "ccd47-20"]
    assert all(
        0.3 < float(row["out_share"]) < 0.7 and float(row["subtypes"]) > AIM_SUBTYPES
        for row in wide
    )
    red = {row["sensor"]: [float(row[kind]) for kind in "OBAFGKM"] for row in rows("colour_red")}
    assert all(shares == sorted(shares) for shares in red.values())
    assert red["ccd47-20"][-1] > 0.7 and red["Bayer, infrared cut"][-1] < 0.01


def test_lateral_colour_of_a_known_glass_and_of_one_that_is_linear_in_wavelength_is_the_skys(study):
    _, rows = study
    off = {
        (row["lens"], row["panel"], row["colour"]): float(row["off_share"])
        for row in rows("colour_lateral")
    }
    # the planar's filter has none of a laser's blue
    assert {panel for _, panel, _ in off} == {"OLED", "sRGB LCD"}
    assert {lens for lens, *_ in off} == {"planar-1897", "linear"}
    assert all((share < AIM_LATERAL) == (colour == "star") for (_, _, colour), share in off.items())


@pytest.mark.parametrize(
    ("name", "keys", "figures"),
    [
        ("colour_gamut", ("panel", "sensor"), ("out_share", "subtypes", "subtypes_white")),
        ("colour_class", ("panel", "sensor", "class"), ("off_nm", "subtypes")),
        ("colour_red", ("sensor",), tuple("OBAFGKM")),
        ("colour_lateral", ("lens", "panel", "colour"), ("sky_px", "off_share")),
        ("colour_mosaic", ("sigma_px", "temperature_k", "image"), ("rms_px", "max_px")),
    ],
)
def test_the_pages_tables_are_of_what_is_measured_now(study, name, keys, figures):
    assert_recorded(study[0] / f"{name}.csv", keys, figures)


def test_superpixels_have_less_bias_than_the_raw_mosaic_and_wide_stars_little(study):
    _, rows = study
    rms = {
        (row["image"], row["sigma_px"], row["temperature_k"]): float(row["rms_px"])
        for row in rows("colour_mosaic")
    }
    assert all(
        rms["superpixel", *key] < off for (image, *key), off in rms.items() if image == "mosaic"
    )
    holds("mosaic-sharp", rms["superpixel", "0.55", "3500.0"])
    holds("mosaic-wide", rms["superpixel", "1.5", "3500.0"])


def test_a_star_s_class_is_that_of_its_own_spectrum(tmp_path):
    """From O to M dwarfs and giants are ever redder, so that each class has a longer mean
    wavelength than the one before, as a mono sensor sees it.
    """
    colour.write_spectra(tmp_path)
    stars = colour.gamut_stars("sRGB LCD", colour.MONO_SENSOR, tmp_path)
    rows = colour.class_rows("sRGB LCD", colour.MONO_SENSOR, stars)
    mean_nm = [row.mean_nm for row in rows]
    assert [row.class_ for row in rows] == list("OBAFGKM")
    # O stars are few, and reddened by the dust of their birthplaces
    assert mean_nm[1:] == sorted(mean_nm[1:])
    assert min(np.diff(mean_nm[1:])) > 5
    assert sum(row.stars for row in rows) <= len(stars.kinds)


def test_a_dye_falls_to_one_over_e_at_its_half_width():
    curve = curve_of(((600.0, 40.0, 0.5), (850.0, 20.0, 0.2)))
    at = dict(zip(NM.tolist(), curve.tolist(), strict=True))
    assert at[600.0] == pytest.approx(0.5)
    assert at[640.0] == at[560.0] == pytest.approx(0.5 / np.e)
    assert at[870.0] == pytest.approx(0.2 / np.e, rel=1e-6)


def test_a_spectrum_s_file_has_its_columns(tmp_path):
    write_spectrum(
        tmp_path / "s.csv", "nm,a,b", np.array([400.0, 402.0]), np.array([1.0, 0.25]), NM[:2]
    )
    lines = (tmp_path / "s.csv").read_text().splitlines()
    assert lines == ["nm,a,b", "400,1,380", "402,0.25,382"]


@pytest.mark.parametrize("kind", ["triples", "grey", "stealing"])
def test_light_by_primary_is_each_one_s_own_code(kind):
    """Relative to its own white, by sRGB; grey has all three alike."""
    srgb = srgb_response(8)
    triples = np.array([[[10, 20, 30], [255, 0, 128]]], dtype=np.uint16)
    levels, rgb = triples, None
    if kind == "grey":
        levels = np.array([[7, 200]], dtype=np.uint16)
        triples = np.repeat(levels[..., None], 3, axis=2)
    if kind == "stealing":
        rgb = triples[0]
        levels = np.array([[0, 1]], dtype=np.uint16)
    bench = SimpleNamespace(
        config=SimpleNamespace(monitor=SimpleNamespace(bits=8)),
        calibration=SimpleNamespace(response=SimpleNamespace(rgb=rgb)),
    )
    np.testing.assert_array_equal(light_by_primary(bench, levels), srgb.light[triples])


def test_a_class_s_figures_are_of_its_own_stars():
    """Of stars O, B, A, F, G, K and M in turn, two of each."""
    count = len(LETTERS)
    kinds = np.tile(np.arange(count, dtype=float), 2)
    figure = np.arange(2.0 * count)
    stars = SimpleNamespace(
        kinds=kinds,
        wanted=np.stack([500 + figure, figure], axis=1),
        off=figure,
        subtypes=2 * figure,
        subtypes_white=3 * figure,
    )
    rows = class_rows("panel", "sensor", stars)
    assert [row.class_ for row in rows] == list(LETTERS)
    for place, row in enumerate(rows):
        mean = place + count / 2
        assert (row.stars, row.off_nm, row.mean_nm) == (2, mean, 500 + mean)
        assert (row.subtypes, row.subtypes_white) == (2 * mean, 3 * mean)
