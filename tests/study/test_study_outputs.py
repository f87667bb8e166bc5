"""The seven outputs of a bench's fields: its images, tables, words and figures are of one scene."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from hilstar.cli.study import thesis_lines
from hilstar.instruments.study import outputs
from hilstar.instruments.study.fields import fields_of
from tests.support.tables import csv_rows

SIZE_PX = (220, 150)
READ_E, DARK_E_PER_S, EXPOSURE_S, GAIN_E_PER_DN, OFFSET_DN = 6.0, 400.0, 0.2, 2.5, 100.0
BENCH = f"""[tracker]
aperture_mm = 20
focal_length_mm = 35
pixel_pitch_um = 22
resolution_px = {list(SIZE_PX)}
exposure_s = {EXPOSURE_S}
quantum_efficiency = "kai-4021"
[tracker.detector]
read_noise_e = {READ_E}
dark_e_per_s = {DARK_E_PER_S}
gain_e_per_dn = {GAIN_E_PER_DN}
offset_dn = {OFFSET_DN}
bits = 12
full_well_e = 9000
[sky]
faintest_v_mag = 6.0
[monitor]
resolution_px = [800, 600]
pixel_pitch_um = 20
[collimator]
focal_length_mm = 127
"""
# sky and dark current of a pixel, and the codes' steps: e- squared
SKY_E2 = DARK_E_PER_S * EXPOSURE_S + READ_E**2
FIELD = (84.0, -1.2, 30.0)  # Orion, turned


@pytest.fixture(scope="module")
def scenes(small_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "own.toml"
    path.write_text(BENCH)
    with pytest.MonkeyPatch.context() as patch:
        # the thesis's fields are as any other
        patch.setattr(outputs, "fields_of", lambda radec: fields_of(radec)[-2:])
        # as its command writes them
        return small_run(lambda folder: thesis_lines("outputs", path, folder, FIELD))


def table_of(run):
    rows = csv_rows(run.folder / "field.csv")
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def test_each_field_has_its_files_and_one_of_one_s_own_is_the_last(scenes):
    names = {path.name for path in scenes.folder.iterdir()}
    wanted = set(outputs.output_files(fields_of(FIELD)[-2:]))
    assert names | {f"{stem}{end}" for stem in scenes.charts for end in (".png", ".svg")} == wanted
    assert [line.partition(":")[0] for line in scenes.told] == ["zeta_cas", "field"]
    assert scenes.title("field").startswith("RA 84, Dec -1.2, roll 30°, own.toml: ")
    for stem, line in zip(scenes.charts, scenes.told, strict=True):
        # those whose centre is on the image, as the line counts them
        on_image, saturated = re.search(r": (\d+) stars.*; (\d+) stars saturated", line).groups()
        count = saturated if int(saturated) else "none"
        assert f": {on_image} stars, {count} saturated; hottest" in scenes.title(stem)
    assert "more whose light reaches" in scenes.told[0]


def test_images_without_and_with_noise_are_of_one_sky(scenes):
    clean = fits.getdata(scenes.folder / "field_without_noise.fits").astype(float)
    noisy = fits.getdata(scenes.folder / "field.fits").astype(float)
    assert clean.shape == noisy.shape == SIZE_PX[::-1]
    dark = clean <= np.median(clean)
    off_dn = (noisy - clean)[dark]
    # noise of the sky and its rounding, and fixed patterns of none; 4 sigmas of so many pixels
    sigma_dn = np.sqrt(SKY_E2 / GAIN_E_PER_DN**2 + 1 / 6)
    assert off_dn.std() == pytest.approx(sigma_dn, rel=4 / np.sqrt(2 * dark.sum()) + 0.03)
    assert abs(off_dn.mean()) < 5 * sigma_dn / np.sqrt(dark.sum()) + 0.5
    kinds = []
    for name in ("field", "field_without_noise"):
        header = fits.getheader(scenes.folder / f"{name}.fits")
        kinds.append([value for key, value in header.items() if "NOISE" in key.upper()])
    assert kinds[0] != kinds[1] and "none" in map(str, kinds[1])
    middle = WCS(fits.getheader(scenes.folder / "field.fits")).pixel_to_world(109.5, 74.5)
    assert (middle.ra.deg, middle.dec.deg) == pytest.approx(FIELD[:2], abs=1e-6)


def test_a_scene_s_line_counts_what_its_table_has(scenes):
    table, line = table_of(scenes), scenes.told[-1]
    x_px, y_px = table["x_px"].astype(float), table["y_px"].astype(float)
    inside = (x_px >= -0.5) & (x_px < 219.5) & (y_px >= -0.5) & (y_px < 149.5)
    v_mag, kelvin = table["v_mag"].astype(float), table["temperature_k"].astype(float)
    assert inside.sum() > 10
    assert line.startswith(f"field: {inside.sum()} stars")
    beyond = (~inside).sum()
    assert (f", {beyond} more whose light reaches the image" in line) == bool(beyond)
    assert f"V {v_mag.min():.2f} to {v_mag.max():.2f}, mean {v_mag.mean():.2f}; hottest" in line
    assert f"hottest {kelvin.max():.0f} K, mean {kelvin.mean():.0f} K" in line
    if beyond:
        assert f"({kelvin[inside].mean():.0f} K on the image)" in line
    saturated = (table["clipped"] == "True").sum()
    assert f"; {saturated} stars saturated; " in line
    noisy = fits.getdata(scenes.folder / "field.fits")
    assert f"sky {np.median(noisy):.0f} DN; n_TOT of a pixel of sky" in line
    noise_e = float(re.search(r"sky (\d+) e-$", line)[1])
    # sky, dark current and read noise, and what gain and rounding add
    assert np.sqrt(SKY_E2) - 0.5 < noise_e < np.sqrt(SKY_E2 + 1) + 1.0


def test_the_figure_draws_the_table_and_both_images(scenes):
    table = table_of(scenes)
    x_px, y_px = table["x_px"].astype(float), table["y_px"].astype(float)
    inside = (x_px >= -0.5) & (x_px < 219.5) & (y_px >= -0.5) & (y_px < 149.5)
    ((_, x, y),) = scenes.lines("field", 0)
    assert (x, y) == (x_px[inside].tolist(), y_px[inside].tolist())
    axes = scenes.charts["field"].axes
    assert axes[0].get_xlim() == (-0.5, 219.5) and axes[0].get_ylim() == (149.5, -0.5)
    for panel, name in ((1, "v_mag"), (2, "temperature_k")):
        (_, numbers, drawn), (_, _, mean) = scenes.lines("field", panel)
        values = table[name].astype(float)
        assert (numbers, drawn) == (list(range(1, len(values) + 1)), values.tolist())
        assert mean == pytest.approx([values.mean()] * 2)
    assert f"mean {table['v_mag'].astype(float).mean():.2f} mag" in axes[1].get_title(loc="left")
    assert axes[2].get_yscale() == "log"
    clean = fits.getdata(scenes.folder / "field_without_noise.fits")
    noisy = fits.getdata(scenes.folder / "field.fits")
    for panel, image in ((3, clean), (4, clean), (6, noisy), (7, noisy)):
        (drawn,) = axes[panel].images
        np.testing.assert_array_equal(np.asarray(drawn.get_array()), image)
        low, high = drawn.get_clim()
        # from the darkest percent, over 10 sigmas of the sky's noise to 300
        assert low == pytest.approx(np.percentile(noisy, 1))
        wanted = np.percentile(noisy, 99.8) - low
        sigma_dn = np.sqrt(SKY_E2) / GAIN_E_PER_DN
        assert high - low == pytest.approx(np.clip(wanted, 10 * sigma_dn, 300 * sigma_dn), rel=0.1)
    # the zoom is about the brightest star, which is the table's first on the image
    first = int(np.flatnonzero(inside)[0])
    for panel in (4, 7):
        assert axes[panel].get_xlim() == pytest.approx((x_px[first] - 80, x_px[first] + 80))
        assert axes[panel].get_ylim() == pytest.approx((y_px[first] + 80, y_px[first] - 80))
        assert axes[panel].get_title(loc="left") == f"The same, HIP {table['hip'][first]}"
    facts = axes[5].texts[0].get_text()
    # 220 px of 22 um behind 35 mm, and 150
    assert "Field 7.91 x 5.4°" in facts and "Exposure 0.2 s" in facts
    assert "Focal length 35 mm" in facts and "Gain 2.5 e-/DN" in facts


def test_temperatures_that_nobody_knows_are_left_out():
    assert outputs.heat_words(np.array([np.nan, np.nan])) == ""
    assert outputs.heat_words(np.array([4000.0, np.nan, 7000.0])) == (
        "; hottest 7000 K, mean 5500 K"
    )


@pytest.mark.parametrize(
    ("brightest_dn", "noise_e", "white_dn"),
    [
        (500.0, 8.0, 500.0),
        (110.0, 8.0, 100 + 10 * 2.0),
        (9000.0, 8.0, 100 + 300 * 2.0),
        (110.0, 0.0, 110.0),
        (100.5, 0.0, 101.0),
        (9000.0, 0.0, 130.0),
    ],
)
def test_white_is_10_to_300_sigmas_of_the_sky_over_black(brightest_dn, noise_e, white_dn):
    """Of 8 e- and 4 e-/DN a sigma is 2 DN; of no noise it counts as 0.1 DN."""
    dn = np.full((50, 40), 100.0)
    dn[7] = brightest_dn
    assert outputs.stretch_dn(dn, noise_e, 4.0) == pytest.approx((100.0, white_dn))


def test_the_thesis_s_fields_are_shown_as_published_and_mended():
    wanted = []
    for stem, hip in (("orion", 26311), ("lyra", 92420), ("rosetta", 2920)):
        wanted.append((f"thesis-{stem}-as-published.toml", f"{stem}_as_published", hip))
        wanted.append((f"thesis-{stem}.toml", stem, hip))
    scenes = list(outputs.thesis_scenes())
    assert [(name, scene.stem, scene.zoom_hip) for name, scene in scenes] == wanted
    for _, scene in scenes:
        assert ("published" in scene.title) == scene.stem.endswith("_as_published")
        assert scene.field.name in scene.title
