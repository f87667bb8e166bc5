"""Images that are cut off below the saturation that a bench file states."""

import numpy as np
import pytest
from msgspec.structs import replace

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.first_light.focus import MAX_PIXEL_SHARE, Sharpness, why_blurred
from hilstar.instruments.calibrate.full_well import check_full_well, cut_off_dn
from hilstar.instruments.calibrate.geometric.dots import DOT_PX
from hilstar.instruments.calibrate.grabbed_dots import is_too_bright
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings

STATED = DetectorSettings(
    full_well_e=70_000.0, gain_e_per_dn=24.0, bits=12, offset_dn=40.0, read_noise_e=8.0
)
SIDE_PX = 13  # of a dot whose monitor pixels are 4.2 tracker px


def exposed(true: DetectorSettings, peak_e: float) -> tuple[FloatArray, FloatArray]:
    """An image of flat dots of `peak_e` electrons a pixel, and its dark frame, DN."""
    light_e = np.zeros((200, 200))
    for row in range(20, 180, 40):
        for column in range(20, 180, 40):
            light_e[row : row + SIDE_PX, column : column + SIDE_PX] = peak_e
    device = Detector(true, light_e.shape)
    rng = np.random.default_rng(3)
    image = device.expose(light_e, 0.1, rng)
    dark = device.expose(np.zeros_like(light_e), 0.1, rng)
    return image.astype(np.float64), dark.astype(np.float64)


def test_a_full_well_that_is_less_than_stated_is_told_with_its_electrons():
    """Flat dots of 1290 DN made a PSF of 0.58 px "0.297 +- 0.013, done": their pixel came out as
    4.68 px instead of 4.21.
    """
    image, dark = exposed(replace(STATED, full_well_e=30_000.0), 100_000.0)
    level_dn = cut_off_dn(image.ravel(), dark, float(np.median(dark)), STATED)
    assert level_dn == pytest.approx(40 + 30_000 / 24, abs=1.5)
    with pytest.raises(InputError, match=r"cut off at 1290 DN, .* full_well_e = (29|30)\d{3}, or"):
        check_full_well(image.ravel(), dark, float(np.median(dark)), STATED)


@pytest.mark.parametrize("true_gain", [24.0, 2.4, 240.0])
@pytest.mark.parametrize("share", [0.1, 0.4, 0.7])
def test_dots_that_scatter_as_light_does_are_not_cut_off(true_gain, share):
    """Also where the stated gain is ten times the true one, or a tenth."""
    true = replace(STATED, gain_e_per_dn=true_gain, full_well_e=2900 * true_gain)
    image, dark = exposed(true, share * true.full_well_e)
    assert cut_off_dn(image.ravel(), dark, float(np.median(dark)), STATED) is None
    check_full_well(image.ravel(), dark, float(np.median(dark)), STATED)


def test_the_stated_full_well_is_no_surprise():
    image, dark = exposed(STATED, 200_000.0)
    assert cut_off_dn(image.ravel(), dark, float(np.median(dark)), STATED) is None


def test_an_image_without_noise_is_not_cut_off():
    image = np.zeros((50, 50))
    image[10:30, 10:30] = 1000.0
    assert cut_off_dn(image.ravel(), np.zeros_like(image), 0.0, STATED) is None


@pytest.mark.parametrize(("wider", "is_refused"), [(0.9, False), (1.0, False), (1.11, True)])
def test_dots_wider_than_their_pixels_make_no_psf(wider, is_refused):
    """Gaps between subpixels make dots narrower; nothing but saturation makes them wider."""
    assert MAX_PIXEL_SHARE < 1.11
    seen_pixel_px = 4.21
    place = np.zeros(5)
    sharp = Sharpness(place, place, place, 0.55, 0.01, DOT_PX * wider * seen_pixel_px, 0.05)
    reason = why_blurred(sharp, 0.55, seen_pixel_px)
    assert ("full_well_e" in reason) == is_refused


@pytest.mark.parametrize(
    ("peak_dn", "is_bright"), [(2456.0, False), (2458.0, True), (4095.0, True), (4096.0, False)]
)
def test_dots_are_too_bright_from_six_tenths_of_saturation_on_hot_pixels_apart(peak_dn, is_bright):
    """Of 12 bits; an image of more bits is another detector's, of which nothing is known."""
    detector = DetectorSettings(bits=12, gain_e_per_dn=4.0, full_well_e=1e6, offset_dn=0.0)
    dark = np.full((6, 8), 50.0)
    dark[1, 1], dark[4, 5] = 2100.0, 2040.0
    image = np.full((6, 8), 50.0)
    image[1, 1], image[3, 3] = 4000.0, peak_dn
    assert is_too_bright(image, dark, detector) is is_bright
