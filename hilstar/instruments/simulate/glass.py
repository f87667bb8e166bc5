"""A glass to who measures stars: the PSF that a centroider is told, and errors of places by what
would take them away.
"""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.optics.psf import Psf
from hilstar.tracker.centroiders import Pixels, ToldPsf

MIN_STARS = 40  # for 26 coefficients


def told_psf(psf: Psf, pixels: Pixels, side_px: int, shares: FloatArray | None = None) -> ToldPsf:
    """What `psf_places` fits: a PSF in squares of `side_px` about `pixels`, rows and columns (n,),
    each at its place.

    `shares` (n, L) are the stars' spectra as a glass has them, by default those of light without a
    spectrum.
    """
    rows, columns = pixels
    near = np.arange(side_px) - side_px // 2

    def of(x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        if not psf.by_colour:
            stamps = []
            for x, y in zip(x_px, y_px, strict=True):
                across = near - x
                down = near - y
                stamps.append(psf.shares(across[None, :], down[:, None]))
            return np.stack(stamps)
        at_x_px = columns + x_px
        at_y_px = rows + y_px
        spectra = psf.mean_shares if shares is None else shares
        light = psf.stamps_at(at_x_px, at_y_px, spectra)
        glass_side = light.shape[1]
        light = np.pad(light, ((0, 0), (1, 1), (1, 1)))
        stars = np.arange(len(x_px))[:, None, None]
        column = _in_glass_square(columns[:, None] + near, at_x_px, glass_side)
        row = _in_glass_square(rows[:, None] + near, at_y_px, glass_side)
        squares = light[stars, row[:, :, None], column[:, None, :]]
        return np.asarray(squares, dtype=np.float64)

    return of


def _in_glass_square(pixels: IntArray, stars_px: FloatArray, side_px: int) -> IntArray:
    """Where pixels (n, m) along an axis lie in the glass's squares about stars (n,), padded by one
    dark pixel, which all beyond them have.

    The glass's square is about the pixel nearest to the star, and not about the centroider's.
    """
    nearest = np.floor(stars_px + 0.5).astype(np.intp)
    from_first = pixels - nearest[:, None] + side_px // 2
    return np.asarray(np.clip(from_first + 1, 0, side_px + 1))


@dataclass(frozen=True, slots=True)
class ErrorSplit:
    """Errors of stars' places, px (n, 2): in all, what a distortion takes, what B-V takes
    besides, and the rest.
    """

    total: FloatArray
    distortion: FloatArray
    colour: FloatArray

    @property
    def psf(self) -> FloatArray:
        """The part that is neither distortion nor colour: of the PSF's shape in pixels and window,
        and of noise where the errors have it.
        """
        return np.asarray(self.total - self.distortion - self.colour)

    def rms_px(self) -> dict[str, float]:
        """The rms distance of each part, px."""
        parts = {
            "total": self.total,
            "distortion": self.distortion,
            "colour": self.colour,
            "psf": self.psf,
        }
        rms = {}
        for name, part in parts.items():
            distance2 = (part**2).sum(axis=1)
            rms[name] = float(np.sqrt(distance2.mean()))
        return rms


def split_errors(
    places_px: FloatArray, bv_mag: FloatArray, errors_px: FloatArray, size_px: tuple[int, int]
) -> ErrorSplit:
    """Errors (n, 2) of stars at places (n, 2): by least squares a cubic of the place, and B-V times
    a line of the place.

    A distortion file can hold the first, a correction by catalogue colour the second. Raises
    ValueError for under MIN_STARS.
    """
    if len(places_px) < MIN_STARS:
        raise ValueError(f"{len(places_px)} stars; a split takes {MIN_STARS}")
    width, height = size_px
    u = (places_px[:, 0] - (width - 1) / 2) / (width / 2)
    v = (places_px[:, 1] - (height - 1) / 2) / (height / 2)
    cubic = []
    for j in range(4):
        for k in range(4 - j):
            cubic.append(u**j * v**k)
    by_place = np.stack(cubic, axis=1)
    line = np.stack([np.ones_like(u), u, v], axis=1)
    by_colour = (bv_mag - bv_mag.mean())[:, None] * line
    terms = np.hstack([by_place, by_colour])
    solution = np.linalg.lstsq(terms, errors_px, rcond=None)[0]
    count = by_place.shape[1]
    return ErrorSplit(errors_px, by_place @ solution[:count], by_colour @ solution[count:])
