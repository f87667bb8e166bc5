"""What the study of colour finds: a Bayer tracker sees each star's own colour, and what no
monitor can show is stated.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.display.response import srgb_response
from hilstar.instruments.study import colour
from hilstar.instruments.study.colour import (
    MONO,
    MONO_SENSOR,
    NM,
    PANELS,
    PUBLISHED_SUBTYPES,
    SENSORS,
    class_rows,
    curve_of,
    light_by_primary,
    write_spectrum,
)
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.spectral_types import LETTERS
from tests.support.claims import holds
from tests.support.recorded import assert_recorded, assert_row
from tests.support.studies import times_are_watched

AIM_SUBTYPES, AIM_PERCENT, AIM_LATERAL = 3.0, 2.0, 0.1


@pytest.fixture(scope="module")
def study(whole_study):
    with pytest.MonkeyPatch.context() as patch, times_are_watched():
        patch.setattr(colour, "QUICK_ROUNDS", 1)  # no claim here is of a time
        measured = colour.measure(True)
    found = whole_study.reported("colour", {"colour"}, measured)
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


def test_the_places_of_a_mosaic_s_stars_are_those_recorded(tmp_path):
    colour.write_spectra(tmp_path)
    tracker = colour.file_of(tmp_path, "OLED", colour.TRACKERS["Bayer"]).config.tracker
    rows = list(colour.study_mosaic(colour.bench_channels(tracker, tmp_path)))
    assert len(rows) == 4 * 3 * 2
    for row in rows:
        keys = {"sigma_px": row.sigma_px, "temperature_k": row.temperature_k, "image": row.image}
        assert_row("colour_mosaic.csv", keys, {"rms_px": row.rms_px, "max_px": row.max_px})


def test_a_mosaic_s_stars_stand_in_tiles_row_by_row():
    side, tile = colour.PHASES, colour.TILE_PX
    x_px, y_px = np.full(side**2, 10.0), np.full(side**2, 13.0)
    x_px[1], y_px[side] = 11.3, 9.4
    image = colour.mosaic_image(0.8, x_px, y_px)
    assert image.shape == (side * tile, side * tile)
    at = np.arange(tile)

    def wanted(x, y):
        across = ndtr((at + 0.5 - x) / 0.8) - ndtr((at - 0.5 - x) / 0.8)
        down = ndtr((at + 0.5 - y) / 0.8) - ndtr((at - 0.5 - y) / 0.8)
        return np.outer(down, across)

    np.testing.assert_allclose(image[:tile, tile : 2 * tile], wanted(11.3, 13.0), atol=1e-9)
    np.testing.assert_allclose(image[tile : 2 * tile, :tile], wanted(10.0, 9.4), atol=1e-9)


def test_a_star_s_shift_by_its_colour_is_against_the_sun_s_at_the_same_place():
    """By a lens that moves a star to the right by its red share, and up by half of its blue."""

    def centroids_px(x_px, y_px, spectra):
        red, blue = np.broadcast_to(spectra, (len(x_px), 2)).T
        return x_px + 0.01 * x_px * red, y_px - 0.5 * blue, red + blue

    places_px = np.array([[100.0, 200.0, 50.0], [7.0, 8.0, 9.0]])
    spectra = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    moved = colour.moved_px(centroids_px, places_px, spectra, 1)
    np.testing.assert_allclose(moved, [[0.5, 0.0, -0.25], [0.25, 0.0, -0.25]], atol=1e-12)
    nm = np.array([[450.0], [600.0], [700.0]])
    np.testing.assert_allclose(colour.linear_px(nm, 1), [[-1.5, 0.0, 1.0]])
    row = colour.lateral_colour("a lens", "OLED", "white", moved, moved * 1.5)
    size_px = math.sqrt((0.25 + 0.0625 + 0.0625 + 0.0625) / 3)
    assert asdict(row) == pytest.approx(
        {
            **{"lens": "a lens", "panel": "OLED", "colour": "white"},
            **{"sky_px": size_px, "off_px": size_px / 2, "off_share": 0.5},
        }
    )


def test_the_colours_that_one_panel_shows_are_those_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(colour, "PANELS", {"OLED": PANELS["OLED"]})
    colour.write_spectra(tmp_path)
    rows, by_class = colour.study_gamut(tmp_path)
    assert [row.sensor for row in rows] == [*MONO, *SENSORS]
    for row in rows:
        figures = asdict(row)
        keys = {name: figures.pop(name) for name in ("panel", "sensor")}
        figures = {name: figures[name] for name in ("out_share", "subtypes", "subtypes_white")}
        assert_row("colour_gamut.csv", keys, figures | {"off_median": row.off_median})
    assert len(by_class) == 7 * len(MONO)
    for row in by_class:
        keys = {"panel": row.panel, "sensor": row.sensor, "class": row.class_}
        figures = {"off_nm": row.off_nm, "subtypes": row.subtypes, "mean_nm": row.mean_nm}
        assert_row("colour_class.csv", keys, figures | {"stars": row.stars})


def test_the_lens_of_1897_moves_white_as_the_sky_and_a_star_s_own_mixture_little(
    tmp_path, monkeypatch
):
    """White is one spectrum for all stars, so it is off by all of the sky's own shift; each star's
    own mixture has its mean wavelength.
    """
    monkeypatch.setattr(colour, "PANELS", {"OLED": PANELS["OLED"], "laser": PANELS["laser"]})
    monkeypatch.setattr(colour, "FAINTEST_V_MAG", 2.0)
    colour.write_spectra(tmp_path)
    rows = {(row.lens, row.colour): row for row in colour.study_lateral(tmp_path)}
    assert {row.panel for row in rows.values()} == {"OLED"}  # a laser's blue is blocked
    for lens in ("planar-1897", "linear"):
        assert rows[lens, "white"].off_share == pytest.approx(1.0)
        assert rows[lens, "white"].sky_px == rows[lens, "star"].sky_px > 1e-3
    assert rows["planar-1897", "star"].off_share < 0.1
    assert rows["linear", "star"].off_share < 1e-5


def test_the_chart_of_choices_has_a_point_of_each(figures, tmp_path):
    rows = []
    for number, (tracker, ink, method) in enumerate(
        itertools.product(colour.MARKERS, colour.INKS, colour.METHODS), start=1
    ):
        errors = (number + 0.25, 1.0, number / 1e3, 2.0, number / 1e2)
        rows.append(colour.ColourChoice(tracker, ink, method, 9, 3.0, 2.0 + number, *errors))
    text = colour.draw(tmp_path / "colour", rows, colour.Load())
    subtypes = {(row.tracker, row.colour, row.method): row.subtypes for row in rows}
    star, white = (subtypes["Bayer", ink, "exact"] for ink in ("star", "white"))
    assert f"mixture is {star:.2g} subtypes off before a Bayer tracker, white {white:.0f}" in text
    (figure,) = figures
    for axes, column in zip(figure.axes, ("subtypes", "mag", "px"), strict=True):
        drawn = {}
        for line in axes.get_lines():
            if len(line.get_xdata()) == 1 and np.isfinite(line.get_xdata()).all():
                (x,), (y,) = line.get_data()
                drawn[x] = y, line.get_marker(), line.get_markerfacecolor()
        for row in rows:
            y, marker, fill = drawn[row.cpu_ms]
            assert y == getattr(row, column)
            assert marker == colour.MARKERS[row.tracker]
            assert (fill == "none") == (row.method == "round")


def test_a_study_s_tables_and_lines_are_of_what_each_part_measures(small_run, tmp_path):
    """The share of red light by class is measured here; the other parts are planted."""
    colour.write_spectra(tmp_path)
    red = colour.red_shares(tmp_path)
    gamut = [colour.GamutRow("OLED", "a", 1.0, 0.5, 0.25, 0.75, 3.0, 2.0, 9.0)]
    by_class = [colour.GamutClass("OLED", "a", "G", 7, 550.0, 2.0, 1.0, 8.0)]
    lateral = [colour.LateralColour("planar-1897", "OLED", "star", 0.02, 0.001, 0.05)]
    choices = []
    for number, (tracker, ink, method) in enumerate(
        itertools.product(colour.QUICK_TRACKERS, colour.INKS, colour.METHODS), start=1
    ):
        choices.append(
            colour.ColourChoice(tracker, ink, method, 9, 3.0, 2.0 + number, number, 1, 1, 1, 1)
        )
    mosaic = []
    for sigma_px, image in itertools.product((0.55, 1.0, 1.5), ("mosaic", "superpixel")):
        mosaic.append(colour.MosaicPlaces(sigma_px, 5000.0, image, sigma_px / 8, sigma_px / 4))
    measured = colour.ColourMeasured(choices, gamut, by_class, lateral, red, mosaic, colour.Load())
    run = small_run(colour.report, measured)
    for name, rows in (
        ("colour", choices),
        ("colour_gamut", gamut),
        ("colour_class", by_class),
        ("colour_lateral", lateral),
        ("colour_mosaic", mosaic),
    ):
        written = run.rows(name)
        assert len(written) == len(rows)
        for row, planted in zip(written, rows, strict=True):
            assert list(row.values()) == [str(value) for value in asdict(planted).values()]
    assert "class" in run.rows("colour_class")[0]
    assert_recorded(run.folder / "colour_red.csv", ("sensor",), tuple("OBAFGKM"))
    assert run.levels("colour", 0) == {"published, 6.55": 6.55}
    findings = run.told[0]
    assert findings[0] == run.title("colour")
    assert findings[1] == "lateral colour of planar-1897 by star on OLED: off by 5% of the sky's"
    assert findings[2:] == [
        "a star of 1 px, 5000 K, is 0.125 px off rms in a mosaic",
        "a star of 1 px, 5000 K, is 0.125 px off rms in a superpixel",
    ]


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
    np.testing.assert_array_equal(light_by_primary(levels, 8, rgb), srgb.light[triples])


def test_a_class_s_figures_are_of_its_own_stars():
    """Of stars O, B, A, F, G, K and M in turn, two of each."""
    count = len(LETTERS)
    kinds = np.tile(np.arange(count, dtype=float), 2)
    figure = np.arange(2.0 * count)
    wanted = np.stack([500 + figure, figure], axis=1)
    errors = (figure, 2 * figure, 3 * figure)
    stars = colour.GamutStars(kinds, wanted, *errors, 1.0, 0.0, 0.0)
    rows = class_rows("panel", "sensor", stars)
    assert [row.class_ for row in rows] == list(LETTERS)
    for place, row in enumerate(rows):
        mean = place + count / 2
        assert (row.stars, row.off_nm, row.mean_nm) == (2, mean, 500 + mean)
        assert (row.subtypes, row.subtypes_white) == (2 * mean, 3 * mean)


def test_a_shown_star_s_place_and_light_are_of_its_primaries_where_they_stand():
    """Three stars, of which two are not judged. Red stands a third of a pixel to the left, blue as
    far to the right; white is 5, 3 and 2.
    """
    x_px, y_px = np.array([20.2, 60.4, 100.0]), np.array([30.1, 29.8, 30.0])
    levels = np.zeros((60, 120, 3), dtype=np.uint16)
    levels[30, 60] = 255, 255, 0
    levels[30, 61] = 0, 255, 255
    levels[30, [20, 100]] = 255
    sprites = pack_sprites(x_px, y_px, np.array([90.0, 40.0, 20.0]), np.arange(3), (120, 60), 9)
    images = light_by_primary(levels, 8, None) * [5.0, 3.0, 2.0]
    places_px = np.array([[-1 / 3, 0.0], [0.0, 0.0], [1 / 3, 0.0]])
    found = colour.lone_light(images, sprites, np.array([False, True, False]), places_px)
    assert found.numbers.tolist() == [1]
    # red once, green twice, blue once
    by_primary = np.array([5.0, 6.0, 2.0])
    np.testing.assert_allclose(found.by_primary, [by_primary])
    middle_px = by_primary @ [60 - 1 / 3, 60.5, 61 + 1 / 3] / by_primary.sum()
    np.testing.assert_allclose(found.off_px, [[middle_px - 60.4, 30 - 29.8]], atol=1e-5)
    for mono, whole in ((True, 13.0), (False, 40.0)):
        shares = colour.primary_shares(found.by_primary, np.array([40.0]), mono)
        np.testing.assert_allclose(shares, [by_primary / whole])
    assert len(colour.lone_light(images, sprites, np.zeros(3, bool), places_px).off_px) == 0


def test_the_stars_of_several_frames_are_those_between_two_magnitudes(tmp_path):
    """Each with its own colour, and near its own light."""
    colour.write_spectra(tmp_path)
    file = colour.file_of(tmp_path, "sRGB LCD", "Bayer, wide dyes", quantisation="exact")
    with open_bench(file) as bench:
        colours = colour.colours_of(file, bench.stars)
        shown = colour.shown_stars(bench, colours, 2)
        judged = colour.is_judged(bench.shown_stars.v_mag)
        wanted = colours.wanted(bench.shown_stars, np.flatnonzero(judged))
    assert len(shown.light) == len(shown.wanted) == len(shown.shares) == len(shown.off_px) > 10
    np.testing.assert_allclose(shown.light, 1.0, atol=0.05)
    assert {tuple(row) for row in shown.wanted} <= {tuple(row) for row in wanted}
    ends_mag = np.array([colour.BRIGHTEST_V_MAG, colour.FAINTEST_V_MAG])
    assert colour.is_judged(np.concatenate([ends_mag, ends_mag + 0.01])).tolist() == [
        *(False, False, True, False)
    ]


def test_stars_that_are_off_alike_have_that_as_their_figures(tmp_path):
    """Every channel by 3 %, which is no change of colour, all light by a tenth of a magnitude, and
    places by a common shift and up to 5 px about it.
    """
    colour.write_spectra(tmp_path)
    step = np.arange(-20.0, 21.0)
    shares = np.random.default_rng(5).uniform(0.2, 1.0, (len(step), 3))
    light = np.full(len(step), 10**0.04)
    off_px = np.array([7.0, -2.0]) + step[:, None] * np.array([0.15, 0.2])

    def subtypes(colours):
        return 50 * colours[:, 0]

    for sensor in ("Bayer, wide dyes", MONO_SENSOR):
        file = colour.file_of(tmp_path, "sRGB LCD", sensor)
        stars = bench_stars(file.config, tmp_path)
        colours = colour.colours_of(file, stars)
        shown = colours.shown(shares)
        wanted = colours.wanted(stars, np.arange(len(step)))
        wanted[:, : shown.shape[1]] = shown / 1.03
        told = colour.ShownStars(wanted, shares, light, off_px)
        off_subtypes, off_percent_k, mag, channel, px = colour.colour_figures(
            told, colours, subtypes
        )
        assert off_subtypes == pytest.approx(50 * (shown[:, 0] * (1 - 1 / 1.03)).mean())
        assert mag == pytest.approx(0.1)
        assert px == pytest.approx(np.percentile(0.25 * np.abs(step), 95))
        if colours.mono:
            assert channel == pytest.approx(100 * (10**0.04 - 1))
        else:
            assert channel == pytest.approx(3.0)
            assert off_percent_k == pytest.approx(0.0, abs=1e-6)


def test_the_worst_place_in_a_mosaic_is_the_furthest_to_either_side():
    row = colour.mosaic_places(1.0, 5000.0, "mosaic", np.array([-0.3, 0.1]))
    assert (row.image, row.max_px, row.rms_px) == ("mosaic", 0.3, pytest.approx(math.sqrt(0.05)))
