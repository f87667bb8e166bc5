"""The brightest stars in a camera's field, by which a person recognises where it looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.discs import HIDDEN
from hilstar.rotation import to_matrix
from hilstar.scene.camera import Camera
from hilstar.sky.stars import Stars


@dataclass(frozen=True, slots=True)
class StarInView:
    """A star in the field: its place in the sky (ICRS, apparent), in the image, and its angle from the boresight.

    A body has a `name`, and 0 for `hip`.
    """

    hip: int
    v_mag: float
    ra_deg: float
    dec_deg: float
    constellation: str
    x_px: float
    y_px: float
    from_boresight_deg: float
    name: str


def brightest_in_view(
    stars: Stars, camera: Camera, q_icrs_to_cam: FloatArray, count: int, through: FloatArray | None = None
) -> list[StarInView]:
    """The `count` brightest of `stars` that fall on the camera's pixels, the brightest first.

    Those of which less than HIDDEN comes `through` (n,) what is before them are left out.
    """
    vectors = stars.directions(np.arange(len(stars)))
    cam = vectors @ to_matrix(q_icrs_to_cam).T
    x_px, y_px = camera.project(cam @ camera.cam_to_image.T)
    width, height = camera.resolution_px
    with np.errstate(invalid="ignore"):  # NaN: behind the camera
        inside = (np.abs(x_px - (width - 1) / 2) <= width / 2) & (np.abs(y_px - (height - 1) / 2) <= height / 2)
    if through is not None:
        inside &= through >= HIDDEN
    found = np.flatnonzero(inside)
    found = found[np.argsort(stars.v_mag[found], kind="stable")][:count]
    off_rad = np.arctan2(np.hypot(cam[found, 0], cam[found, 1]), cam[found, 2])
    x, y, z = vectors[found].T
    ra_deg, dec_deg = np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))
    columns = (
        stars.hip[found].tolist(),
        stars.v_mag[found].tolist(),
        ra_deg.tolist(),
        dec_deg.tolist(),
        _constellations(ra_deg, dec_deg),
        x_px[found].tolist(),
        y_px[found].tolist(),
        np.degrees(off_rad).tolist(),
        stars.names(found),
    )
    return [StarInView(*row) for row in zip(*columns, strict=True)]


def _constellations(ra_deg: FloatArray, dec_deg: FloatArray) -> list[str]:
    """The constellations of places in the sky (IAU boundaries of 1930, through Astropy)."""
    from astropy.coordinates import SkyCoord, get_constellation  # takes half a second, which only this needs

    if not len(ra_deg):
        return []
    return [str(name) for name in get_constellation(SkyCoord(ra_deg, dec_deg, unit="deg"))]
