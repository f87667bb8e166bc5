"""Files of a monitor's geometry, spectra and evenness that are refused, and calls that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.calibration import read_grid
from hilstar.display.footprints import FootprintMap
from hilstar.display.geometry import KIND, ErrorTable, load_geometry
from hilstar.display.primaries import read_ccss
from hilstar.display.render.way import WAY_VARIABLE, wanted_way
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.spectrum import RANGE_NM
from tests.support.refusals import assert_file_refused, refusal, says
from tests.support.stars import sprites_at

SIZE = (64, 48)
GEOMETRY = f"""\
kind = "{KIND}"
resolution_px = [64, 48]
focal_length_px = 500.0
principal_point_px = [31.5, 23.5]
q_cam_to_mon = [1.0, 0.0, 0.0, 0.0]
"""
FIELD = "[field]\nx_px = {}\ny_px = {}\n"
TURNED = "q_cam_to_mon = [1.0, 0.2, 0.0, 0.0]"
GEOMETRIES = [
    (GEOMETRY.replace(KIND, "other"), ": kind = 'other' and"),
    (GEOMETRY.replace("[64, 48]", "[48, 64]"), ": is of a monitor of 48 x 64 px and ... 64 x 48; "),
    (
        GEOMETRY.replace("q_cam_to_mon = [1.0, 0.0, 0.0, 0.0]", TURNED),
        ": q_cam_to_mon: its norm is",
    ),
    (
        GEOMETRY.replace("q_cam_to_mon = [1.0, 0.0", "q_cam_to_mon = [0.9, 0.0"),
        ": q_cam_to_mon: its norm is 0.9; ",
    ),
    (
        GEOMETRY + FIELD.format("[[0.1, 0.2]]", "[[0.1, 0.2]]"),
        ": [field] has no two squares of one s",
    ),
    (
        GEOMETRY + FIELD.format("[[0.1]]", "[[0.1, 0.2], [0.3, 0.4]]"),
        ": [field] has no two squares",
    ),
    (GEOMETRY + FIELD.format("[]", "[]"), ": [field] has no two squares of one size"),
    (GEOMETRY + "[error]\nmap_arcsec = [[1.0, 2.0], [3.0]]\n", ": ...rows of different lengths"),
    (
        GEOMETRY + "[error]\nmap_arcsec = [[1.0, 2.0]]\nmodes_arcsec = [[1.0, 2.0, 3.0]]\n",
        ": ...modes_arcsec are not x and y of each place",
    ),
    (
        GEOMETRY + "[error]\nmodes_arcsec = [[1.0, 2.0]]\n",
        ": ...modes_arcsec are not x and y of ea",
    ),
    (
        GEOMETRY + "[error]\nalignment_covariance_arcsec2 = [[1.0, 0.0], [0.0, 1.0]]\n",
        ": ...alignment_covariance_arcsec2 is not 3 by 3",
    ),
    (
        GEOMETRY + "[error]\nalignment_covariance_arcsec2 = [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]\n",
        ": ...alignment_covariance_arcsec2 is not 3 by 3",
    ),
]


def load(path):
    return load_geometry(path, SIZE)


@pytest.mark.parametrize(("text", "words"), GEOMETRIES, ids=range(len(GEOMETRIES)))
def test_what_is_no_geometry_is_refused(tmp_path, text, words):
    (tmp_path / "geometry.toml").write_text(text)
    assert_file_refused(load, tmp_path / "geometry.toml", words)


def test_a_geometry_s_map_and_its_modes_fit_each_other(tmp_path):
    assert ErrorTable(
        map_arcsec=[[1.0, 2.0], [3.0, 4.0]],
        modes_arcsec=[[0.1] * 8, [0.2] * 8],
        alignment_covariance_arcsec2=np.eye(3).tolist(),
    ).map_arcsec == [[1.0, 2.0], [3.0, 4.0]]
    (tmp_path / "geometry.toml").write_text(GEOMETRY + FIELD.format("[[0.1]]", "[[0.2]]"))
    camera = load(tmp_path / "geometry.toml")
    assert camera.lens is not None
    assert camera.lens.field is not None


def ccss(samples: list[list[float]], bands: int = 4, ends: tuple[float, float] = (400, 700)) -> str:
    names = " ".join(f"SPEC_{k}" for k in range(len(samples[0])))
    rows = "\n".join(" ".join(map(str, [k, *row])) for k, row in enumerate(samples, 1))
    return (
        f'CCSS\nSPECTRAL_BANDS "{bands}"\nSPECTRAL_START_NM "{ends[0]}"\n'
        f'SPECTRAL_END_NM "{ends[1]}"\nBEGIN_DATA_FORMAT\nSAMPLE_ID {names}\nEND_DATA_FORMAT\n'
        f"BEGIN_DATA\n{rows}\nEND_DATA\n"
    )


COLOURS = [[0.0, 0.0, 1.0, 3.0], [0.0, 2.0, 1.0, 0.0], [3.0, 1.0, 0.0, 0.0]]
SPECTRA = [
    (ccss(COLOURS[:2]), ": 2 samples with light, where three primaries are wanted; "),
    (ccss([*COLOURS[:2], [0.0] * 4]), ": 2 samples with light, where three primaries are wanted"),
    (ccss(COLOURS, bands=5), ": 3 samples of 4 bands; "),
    (ccss(COLOURS, ends=(700, 400)), ": 3 samples of 4 bands; "),
    (ccss(COLOURS, ends=(RANGE_NM[0], 700)), ": 3 samples of 4 bands; "),
    (ccss(COLOURS, ends=(400, RANGE_NM[1])), ": 3 samples of 4 bands; "),
    (ccss([*COLOURS[:2], [0.0, float("nan"), 1.0, 0.0]]), ": 3 samples of 4 bands; "),
    (ccss(COLOURS).replace("SPECTRAL_BANDS", "BANDS"), ": 'SPECTRAL_BANDS' is wrong or missing; "),
]


@pytest.mark.parametrize(("text", "words"), SPECTRA, ids=range(len(SPECTRA)))
def test_what_is_no_spectra_of_three_primaries_is_refused(tmp_path, text, words):
    (tmp_path / "panel.ccss").write_text(ccss(COLOURS))
    red, green, blue = read_ccss(tmp_path / "panel.ccss")
    means_nm = [
        curve.wavelength_nm @ curve.value / curve.value.sum() for curve in (red, green, blue)
    ]
    assert means_nm == sorted(means_nm, reverse=True)
    (tmp_path / "panel.ccss").write_text(text)
    assert_file_refused(read_ccss, tmp_path / "panel.ccss", words)


@pytest.mark.parametrize(("light", "counts"), [(0.018, False), (0.022, True)])
def test_a_sample_under_a_fiftieth_of_the_brightest_is_black(tmp_path, light, counts):
    """Of light that no mixture has; the brightest sample has 4."""
    dim = [0.0, 0.0, 0.0, 4 * light]
    (tmp_path / "panel.ccss").write_text(ccss([*COLOURS, dim]))
    if counts:
        assert_file_refused(read_ccss, tmp_path / "panel.ccss", ": no three of its 4 samples are")
    else:
        assert len(read_ccss(tmp_path / "panel.ccss")) == 3


@pytest.mark.parametrize(("red", "is_third"), [(0.003, False), (0.005, True)])
def test_a_mixture_of_two_is_no_third_primary(tmp_path, red, is_third):
    """Blue and green stand at 82 degrees; a mixture of theirs leaves their plane by red / 4.1, and a
    volume of 0.03 squared, 0.0009, is that of no three colours.
    """
    blue, green, _ = COLOURS
    (tmp_path / "panel.ccss").write_text(ccss([blue, green, [red, 2.0, 2.0, 3.0]]))
    if is_third:
        assert len(read_ccss(tmp_path / "panel.ccss")) == 3
    else:
        assert_file_refused(read_ccss, tmp_path / "panel.ccss", ": no three of its 3 samples are")


@pytest.mark.parametrize(("times", "is_sum"), [(1.1, True), (1.2, False)])
def test_white_has_no_more_light_than_its_primaries_and_a_seventh(tmp_path, times, is_sum):
    """A screen that dims with what it shows has less; a white subpixel adds to it."""
    white = (times * np.sum(COLOURS, axis=0)).tolist()
    (tmp_path / "panel.ccss").write_text(ccss([*COLOURS, white]))
    if is_sum:
        assert len(read_ccss(tmp_path / "panel.ccss")) == 3
    else:
        words = ": a sample has 1.20 times the light of its primaries: a white subpixel"
        assert_file_refused(read_ccss, tmp_path / "panel.ccss", words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n", ":1: ...is no row of numbers"),
        ("1,0\n1,2\n", ": a field of the screen has no"),
    ],
)
def test_what_is_no_grid_of_light_is_refused(tmp_path, text, words):
    (tmp_path / "grid.csv").write_text(text)
    assert_file_refused(lambda path: read_grid(path, []), tmp_path / "grid.csv", words)


def test_sprites_of_another_psf_have_no_footprints():
    narrow, wide = GaussianPsf((0.6, 0.6)), GaussianPsf((1.5, 1.5))
    sprites = sprites_at(np.array([[10.0, 10.0]]), np.ones(1), narrow.footprint_px)
    FootprintMap(SIZE, narrow).find(sprites)
    line = refusal(FootprintMap(SIZE, wide).find, sprites)
    assert says(line, f"sprites of {narrow.footprint_px} px where the PSF needs ... px")


@pytest.mark.parametrize(("word", "way"), [("", None), ("gl", "gl"), ("cpu", "cpu")])
def test_the_way_of_drawing_is_one_of_two_words(monkeypatch, word, way):
    monkeypatch.setenv(WAY_VARIABLE, word)
    assert wanted_way() == way
    monkeypatch.setenv(WAY_VARIABLE, "GPU")
    with pytest.raises(InputError, match="GPU: no way to draw stars; write gl or cpu"):
        wanted_way()


def test_a_spectrometer_s_noise_below_0_is_no_light(tmp_path):
    """A dark band of -0.2 is that of a primary without light there."""
    noisy = [[-0.2 if power == 0 else power for power in sample] for sample in COLOURS]
    (tmp_path / "noisy.ccss").write_text(ccss(noisy))
    (tmp_path / "plain.ccss").write_text(ccss(COLOURS))
    nm = np.array([400.0, 500.0, 600.0, 700.0])
    of_noisy = [curve(nm) for curve in read_ccss(tmp_path / "noisy.ccss")]
    of_plain = [curve(nm) for curve in read_ccss(tmp_path / "plain.ccss")]
    assert np.array(of_noisy) == pytest.approx(np.array(of_plain))
    assert np.min(of_noisy) == 0
