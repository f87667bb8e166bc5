"""The file of a glass: what is written is read, a small basis keeps what it says, and what is
wrong is one line.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from scipy.ndimage import uniform_filter

from hilstar.optics.camera import Lens
from hilstar.optics.glass.psf_file import (
    Glass,
    Stack,
    facts_of,
    glass_of,
    pupil_places,
    read_glass,
    samples_a_px,
    write_glass,
)
from hilstar.optics.psf import SampledPsf
from hilstar.sky.spectrum import Curve
from tests.support.glass import stack
from tests.support.refusals import refusal

FLOAT32 = 1e-6  # of the largest sample: the basis is float32


@pytest.fixture(scope="module")
def glass():
    lens, curve = (
        Lens((0.01, -0.002, 0.0), (1e-4, 0.0)),
        Curve(np.array([400.0, 700.0]), np.array([0.8, 0.9])),
    )
    return glass_of(stack(3, (450.0, 650.0), (0.0, 5.0)), 1e-3, lens, curve, ("made by a test",))


def test_what_is_written_is_read(glass, tmp_path):
    write_glass(tmp_path / "psf.fits", glass)
    found = read_glass(tmp_path / "psf.fits")
    assert isinstance(found, Glass)
    for name in (
        "places_px",
        "wavelengths_nm",
        "focuses_um",
        "basis",
        "weights",
        "illumination",
        "outside",
        "lateral_px",
    ):
        assert (getattr(found, name) == getattr(glass, name)).all(), name
    assert (found.lens, found.per_px, found.pixel_integrated, found.history) == (
        glass.lens,
        4,
        False,
        glass.history,
    )
    assert found.residual == pytest.approx(glass.residual, rel=1e-9) and found.residual > 1e-5
    assert found.transmission is not None
    assert (found.transmission.value == [0.8, 0.9]).all()
    assert read_glass(tmp_path / "psf.fits") is found  # again without reading it anew


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 0.0])
def test_the_basis_keeps_each_psf_to_its_tolerance_and_its_moments_exactly(tolerance):
    given = stack(3)
    images = given.images[:, :, 8:-8]
    images[::2, -1, -1] += 0.01 * images.max()  # light to the last sample of all
    found = glass_of(replace(given, images=images), tolerance)
    images = images / images.sum(axis=(1, 2), keepdims=True)
    kept = found.images.reshape(images.shape)
    # 4 samples a pixel
    by_pixels = uniform_filter(np.pad(kept - images, ((0, 0), (4, 4), (4, 4))), (0, 4, 4))
    assert 0.5 * np.abs(by_pixels).sum(axis=(1, 2)).max() == pytest.approx(found.residual, abs=1e-5)
    assert found.residual <= max(tolerance, 1e-6)
    y, x = (np.indices(images.shape[1:]) - np.array(images.shape[1:])[:, None, None] // 2) / 4
    for term in (x * 0 + 1, x, y, x * x, x * y, y * y):
        assert (kept * term).sum(axis=(1, 2)) == pytest.approx(
            (images * term).sum(axis=(1, 2)), abs=1e-5
        )


@pytest.mark.parametrize("axis", [1, 2], ids=["from row to row", "from column to column"])
def test_light_below_nothing_within_a_pixel_is_no_fault_where_pixels_have_none(axis):
    """Noise of samples, four to a pixel: as much above as below."""
    given = stack(2, (450.0, 650.0))
    places = np.indices(given.images.shape)[axis]
    noisy = given.images * (1 + 1.8 * (-1.0) ** places)
    assert (noisy < 0).sum() > noisy.size / 3
    assert glass_of(replace(given, images=noisy)).images.sum() == pytest.approx(len(noisy))


def test_a_looser_tolerance_needs_fewer_components():
    counts = [len(glass_of(stack(3), tolerance).basis) for tolerance in (3e-2, 3e-3, 3e-4)]
    assert counts == sorted(set(counts))


def test_one_image_is_what_it_was(tmp_path):
    image = np.exp(-(np.arange(-5, 6)[None] ** 2 + np.arange(-5, 6)[:, None] ** 2) / 4)
    fits.writeto(tmp_path / "one.fits", image, fits.Header({"OVERSAMP": 3}))
    found = read_glass(tmp_path / "one.fits")
    assert isinstance(found, SampledPsf)
    assert found.per_px == 3


def spoilt(**changes):
    return lambda given: replace(
        given, **{name: change(getattr(given, name).copy()) for name, change in changes.items()}
    )


def put_value(place, value):
    def change(array):
        array[place] = value
        return array

    return change


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        (
            lambda s: replace(s, images=s.images[:, :-1]),
            "write images (n, height, width) of odd sides",
        ),
        (spoilt(images=put_value((2, 0, 0), np.nan)), "image 3 has samples that are not finite"),
        (spoilt(images=put_value(1, 0.0)), "image 2 has samples that are not finite, or no light"),
        (lambda s: replace(s, at=s.at[:-1]), "write one point for each image"),
        (spoilt(at=put_value((0, 2), 999.0)), "give each point one image of each wavelength"),
        (spoilt(images=lambda i: i - 0.3 * i.mean()), "subtract its background"),
        (spoilt(facts=put_value((0, 0), 3.0)), "relative_illumination is not within 0 to 2"),
        (spoilt(facts=put_value((0, 1), -0.1)), "outside_share is not within 0 to 1"),
        (spoilt(at=lambda at: at * [1, 1, -1, 1]), "write wavelengths over 0 nm"),
        (lambda s: replace(s, per_px=0), "0 samples a pixel; write 1 or more"),
    ],
)
def test_what_is_no_glass_is_one_line(change, advice):
    assert advice in refusal(glass_of, change(stack(2, (450.0, 650.0))))


@pytest.mark.parametrize(
    ("header", "table", "advice"),
    [
        ({"PSFVERS": 2}, {}, "PSFVERS is 2"),
        ({"OVERSAMP": 1.5}, {}, "write a whole number, and T or F"),
        ({}, {"focus_um": None}, "no column focus_um"),
        ({}, {"weights": np.ones((8, 3))}, "write one weight for each"),
        ({}, {"outside_share": np.full(8, 2.0)}, "outside_share"),
        ({}, {"x_px": np.full(8, np.nan)}, "x_px, y_px or focus_um is not finite"),
    ],
)
def test_a_file_that_another_program_spoilt_is_one_line(tmp_path, header, table, advice):
    write_glass(tmp_path / "psf.fits", glass_of(stack(2, (450.0, 650.0))))
    with fits.open(tmp_path / "psf.fits") as hdus:
        hdus[0].header.update(header)
        columns = [
            fits.Column(c.name, c.format, array=hdus[1].data[c.name])
            for c in hdus[1].columns
            if c.name not in table
        ]
        columns += [
            fits.Column(name, f"{value[0].size}D", array=value)
            for name, value in table.items()
            if value is not None
        ]
        spoilt_table = fits.BinTableHDU.from_columns(columns, name="POINTS")
        fits.HDUList([hdus[0], spoilt_table]).writeto(tmp_path / "bad.fits")
    line = refusal(read_glass, tmp_path / "bad.fits")
    assert advice in line
    assert "bad.fits" in line


def test_a_cube_of_images_without_points_is_refused_as_before(tmp_path):
    fits.writeto(tmp_path / "cube.fits", np.ones((3, 5, 5)))
    assert "holds 3 images" in refusal(read_glass, tmp_path / "cube.fits")


def test_images_without_wavelengths_count_for_all_light():
    given = stack(2, (550.0,))
    given.at[:, 2] = np.nan
    found = glass_of(Stack(given.images, given.at, facts_of(len(given.images)), 4))
    assert np.isnan(found.wavelengths_nm).all()
    assert found.weights.shape[:3] == (4, 1, 1)


def test_detail_finer_than_a_pixel_asks_for_no_component(rng):
    given = stack(3)
    grain = np.where(np.indices(given.images.shape[1:]).sum(axis=0) % 2, 1.0, -1.0) * rng.uniform(
        -0.5, 0.5, (len(given.images), 1, 1)
    )
    grained = replace(given, images=given.images * (1 + grain))
    # by samples there would be 37
    assert len(glass_of(grained).basis) < len(glass_of(given).basis) + 5


def test_a_pupil_s_places_are_the_middles_of_its_equal_parts():
    assert pupil_places(4).tolist() == [-0.75, -0.25, 0.25, 0.75]


@pytest.mark.parametrize("is_tall", [False, True])
def test_a_pixel_s_negative_light_counts_over_the_whole_of_an_image_that_is_not_square(is_tall):
    """Of 9 x 21 samples, 3 to a pixel: a pixel at the far end of the longer side has a share of
    -0.2 of the light.
    """
    image = np.zeros((9, 21))
    image[4, 10] = 1.2
    image[3:6, 18:] = -0.2 / 9
    if is_tall:
        image = image.T
    spoilt_stack = Stack(image[None], np.array([[5.0, 6.0, np.nan, 0.0]]), facts_of(1), 3)
    assert "20.0% of its light is negative" in refusal(glass_of, spoilt_stack)


def test_a_file_s_transmission_rises_from_wavelength_to_wavelength(tmp_path, glass):
    for nm in ([400.0, 700.0, 700.0], [400.0]):
        curve = Curve(np.array(nm), np.full(len(nm), 0.8))
        write_glass(tmp_path / "psf.fits", replace(glass, transmission=curve))
        said = refusal(read_glass, tmp_path / "psf.fits")
        assert "TRANSMISSION has wavelengths that do not rise" in said


@pytest.mark.parametrize(
    ("pitch_um", "shortest_um", "f_number", "most", "wanted"),
    [
        (10.0, 0.5, 4.0, 32, 10),
        (10.1, 0.5, 4.0, 32, 11),
        (10.0, 0.5, 4.0, 8, 8),  # no more than there is time for
        (10.0, 0.5, 40.0, 32, 4),  # as a spline wants them
    ],
)
def test_half_a_fringe_of_the_pupil_s_edges_has_a_sample(
    pitch_um, shortest_um, f_number, most, wanted
):
    """The finest fringes of a pupil are those of its ends, wavelength times F-number apart."""
    assert samples_a_px(pitch_um, shortest_um, f_number, most) == wanted
