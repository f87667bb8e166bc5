"""A Bayer mosaic: which pixels get the light of each channel. And the image in which a tracker's
software looks for stars: the luminance of a mosaic, and how a black screen appears in it.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.tracker.settings import DetectorSettings

CHANNELS = "rgb"
# Along one axis: the weights of a pixel and its two neighbours in the mean of the superpixels that
# the pixel belongs to. This mean widens a star: its variance along the axis grows by 0.5 px^2.
SUPERPIXEL = np.array([0.25, 0.5, 0.25])
SUPERPIXEL_VARIANCE_PX2 = 0.5
# A black screen counts as even where its brightest pixel is at most one step of the ADC above its
# darkest.
EVEN_DARK_DN = 1.0


def in_pixels(images: Iterable[npt.NDArray[Any]], bayer: str | None) -> FloatArray:
    """The light in a sensor's pixels (height, width), from one image (height, width) of each
    channel, r, g and b in this order: each pixel gets the light of its own colour. With `bayer`
    None, the sensor is mono, and there is one image.

    The images of a mosaic may share one array, where an iterator gives them one after the other.
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
    """The slices (rows, columns) of an image that have the pixels of a channel: one for red and
    blue, two for green. `bayer` names the colours of the top left 2 x 2 pixels row by row ("rggb").
    """
    return [
        np.s_[place // 2 :: 2, place % 2 :: 2]
        for place, colour in enumerate(bayer)
        if colour == channel
    ]


def luminance(image: npt.NDArray[Any]) -> FloatArray:
    """The mean (height, width) of the four superpixels of 2 x 2 pixels that each pixel of a mosaic
    belongs to: 1, 2 and 1 parts of red, green and blue at every pixel.

    It has as many pixels as the mosaic, and all of its light. Even light gives an even image,
    without the mosaic's pattern. Beyond the edges the mosaic is continued as its mirror image.
    """
    from scipy.ndimage import correlate1d

    smooth = correlate1d(np.asarray(image, dtype=np.float64), SUPERPIXEL, axis=0, mode="mirror")
    return np.asarray(correlate1d(smooth, SUPERPIXEL, axis=1, mode="mirror"))


def software_image(dn: npt.NDArray[Any], detector: DetectorSettings) -> npt.NDArray[Any]:
    """The image (height, width), DN, in which a tracker's software looks for stars: the exposure
    `dn` itself, or the luminance of its superpixels where the detector takes those.
    """
    if detector.takes_superpixels:
        return luminance(dn)
    return dn


def software_psf_px(psf_px: tuple[float, float], detector: DetectorSettings) -> tuple[float, float]:
    """The sigma (x, y), px, of a star in the software's image, from its sigma by the optics."""
    if not detector.takes_superpixels:
        return psf_px
    x, y = (float(np.sqrt(sigma**2 + SUPERPIXEL_VARIANCE_PX2)) for sigma in psf_px)
    return x, y


def uneven_dark_dn(under_e: FloatArray, detector: DetectorSettings) -> FloatArray | None:
    """The dark level (height, width), DN, of the software's image, from the electrons `under_e`
    (height, width) that lie under the stars; None where it is even within EVEN_DARK_DN.

    A screen that fills only a part of the field glows there. Software that subtracts one level from
    the whole image takes that part for one large spot.
    """
    dark_dn = detector.offset_dn + under_e / detector.gain_e_per_dn
    dark_dn = software_image(np.clip(dark_dn, 0.0, 2.0**detector.bits - 1), detector)
    if np.ptp(dark_dn) > EVEN_DARK_DN:
        return dark_dn
    return None
