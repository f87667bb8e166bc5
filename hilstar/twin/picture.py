"""A picture of a tracker's frame for a person: discs tell bright stars apart where their saturated pixels cannot."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

BOX_PX = 5  # side of the square over which a star's light is summed: where the middle is full, the wings still grow
MAX_RADIUS_PX = 8  # of the brightest star's disc
# A disc's radius goes with this power of the star's share of the brightest: enough for a sum that saturates, in which five
# magnitudes are only a factor of ten.
RADIUS_POWER = 0.77
STAR_SIGMA = 8.0  # a sum further above the background is a star
PIXEL_GREY = 0.7  # the brightest grey of a pixel that no disc covers


def exposure_picture(dn: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """Greys (height, width) of a frame: asinh of the light above the background, and a disc for each star."""
    from scipy.ndimage import maximum_filter, uniform_filter

    light = dn.astype(np.float32)
    light -= np.median(light)
    low, high = np.percentile(light, (16, 84))
    noise = max(float(high - low) / 2, 1.0)
    flux = np.maximum(uniform_filter(light, BOX_PX), 0) * BOX_PX**2
    grey = _stretched(flux, noise * BOX_PX)
    picture = PIXEL_GREY * _stretched(light, noise)
    peaks = np.nonzero((flux == maximum_filter(flux, BOX_PX)) & (flux > STAR_SIGMA * noise * BOX_PX))
    if len(peaks[0]):
        radius = MAX_RADIUS_PX * (flux[peaks] / flux.max()) ** RADIUS_POWER
        _draw_discs(picture, peaks, np.rint(radius).astype(np.intp), grey[peaks])
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def _stretched(light: npt.NDArray[Any], noise: float) -> npt.NDArray[Any]:
    top = max(float(light.max()) / noise, 1.0)
    return np.asarray(np.arcsinh(np.maximum(light, 0) / noise) / np.arcsinh(top))


def _draw_discs(picture: npt.NDArray[Any], peaks: Any, radius: npt.NDArray[np.intp], grey: npt.NDArray[Any]) -> None:
    """Draw a disc about each peak (rows, columns); where two overlap the brighter one shows."""
    reach = np.arange(-MAX_RADIUS_PX, MAX_RADIUS_PX + 1)
    for down in reach:
        for across in reach:
            inside = radius >= np.hypot(down, across)
            rows, columns = peaks[0][inside] + down, peaks[1][inside] + across
            on = (rows >= 0) & (rows < picture.shape[0]) & (columns >= 0) & (columns < picture.shape[1])
            np.maximum.at(picture, (rows[on], columns[on]), grey[inside][on])
