"""A Bayer mosaic: light by channel to the pixels that see it; and the image in which a tracker's
software finds stars: the luminance of a mosaic, and what a black screen is in it.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.tracker.settings import DetectorSettings

CHANNELS = "rgb"
# The pixel's weight in its own superpixels' mean, along an axis. Their light is spread by half a
# pixel squared more.
SUPERPIXEL = np.array([0.25, 0.5, 0.25])
SUPERPIXEL_VARIANCE_PX2 = 0.5
EVEN_DARK_DN = 1.0  # a step of the ADC, from the darkest pixel of a black screen to the brightest


def in_pixels(images: Iterable[npt.NDArray[Any]], bayer: str | None) -> FloatArray:
    """The light of a sensor's pixels (height, width), by images of each channel: a pixel has that
    of its own colour. A mono sensor has one image.

    Images may share their memory, where they come one after the other.
    """
    if bayer is None:
        (image,) = images
        return image
    mosaic = np.empty(0)
    for channel, image in zip(CHANNELS, images, strict=True):
        if not mosaic.size:
            mosaic = np.empty(image.shape)
        for part in of_colour(bayer, channel):
            mosaic[part] = image[part]
    return mosaic


def of_colour(bayer: str, channel: str) -> list[tuple[slice, slice]]:
    """The pixels of a channel in an image of a pattern, whose first row is the top: green has
    two of four.
    """
    return [
        np.s_[place // 2 :: 2, place % 2 :: 2]
        for place, colour in enumerate(bayer)
        if colour == channel
    ]


def luminance(image: npt.NDArray[Any]) -> FloatArray:
    """The mean of the four superpixels of 2 x 2 that each pixel belongs to: of red, green and blue
    1, 2 and 1 parts everywhere.

    It has the mosaic's pixels, all of its light, and no pattern where the light has none; beyond
    its edges it is mirrored.
    """
    from scipy.ndimage import correlate1d

    smooth = correlate1d(np.asarray(image, dtype=np.float64), SUPERPIXEL, axis=0, mode="mirror")
    return np.asarray(correlate1d(smooth, SUPERPIXEL, axis=1, mode="mirror"))


def software_image(dn: npt.NDArray[Any], detector: DetectorSettings) -> npt.NDArray[Any]:
    """The image of an exposure in which a tracker's software finds stars: its DN, or the
    luminance of its superpixels.
    """
    if detector.takes_superpixels:
        return luminance(dn)
    return dn


def software_psf_px(psf_px: tuple[float, float], detector: DetectorSettings) -> tuple[float, float]:
    """The sigma (x, y), px, of a star in the software's image, by that of the optics."""
    if not detector.takes_superpixels:
        return psf_px
    x, y = (float(np.sqrt(sigma**2 + SUPERPIXEL_VARIANCE_PX2)) for sigma in psf_px)
    return x, y


def uneven_dark_dn(under_e: FloatArray, detector: DetectorSettings) -> FloatArray | None:
    """The level (h, w), DN, that electrons under the stars have in the software's image; None where
    it is even.

    A screen that is seen whole glows over a part of the field, which is one large spot to software
    that takes one level for the whole image.
    """
    dark_dn = detector.offset_dn + under_e / detector.gain_e_per_dn
    dark_dn = software_image(np.clip(dark_dn, 0.0, 2.0**detector.bits - 1), detector)
    if np.ptp(dark_dn) > EVEN_DARK_DN:
        return dark_dn
    return None
