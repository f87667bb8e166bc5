"""A glass to who measures stars: the PSF that a centroider is told, and errors of places by what
would take them away.
"""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
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

    def of(x: FloatArray, y: FloatArray) -> FloatArray:
        if not psf.by_colour:
            stamps = []
            for across, down in zip(near - x[:, None], near - y[:, None], strict=True):
                stamps.append(psf.shares(across[None, :], down[:, None]))
            return np.stack(stamps)
        places = columns + x, rows + y
        light = psf.stamps_at(*places, psf.mean_shares if shares is None else shares)
        own_size = light.shape[1]
        light = np.pad(light, ((0, 0), (1, 1), (1, 1)))
        # The glass's square is about the pixel nearest to the star, this one about its own.
        to = []
        for place, middle in zip(places, (columns, rows), strict=True):
            to.append(
                np.clip(
                    middle[:, None]
                    + near
                    - np.floor(place + 0.5).astype(np.intp)[:, None]
                    + own_size // 2
                    + 1,
                    0,
                    own_size + 1,
                )
            )
        return np.asarray(
            light[np.arange(len(x))[:, None, None], to[1][:, :, None], to[0][:, None, :]],
            dtype=np.float64,
        )

    return of


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
        return {name: float(np.sqrt((part**2).sum(axis=1).mean())) for name, part in parts.items()}


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
    u, v = (
        (place - (size - 1) / 2) / (size / 2)
        for place, size in zip(places_px.T, size_px, strict=True)
    )
    by_place = np.stack([u**j * v**k for j in range(4) for k in range(4 - j)], axis=1)
    by_colour = (bv_mag - bv_mag.mean())[:, None] * np.stack([np.ones_like(u), u, v], axis=1)
    solution = np.linalg.lstsq(np.hstack([by_place, by_colour]), errors_px, rcond=None)[0]
    count = by_place.shape[1]
    return ErrorSplit(errors_px, by_place @ solution[:count], by_colour @ solution[count:])
