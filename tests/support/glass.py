"""A glass in closed form: coma, field curvature, axial and lateral colour, and its PSFs by brute
force.
"""

from __future__ import annotations

import numpy as np

from hilstar.optics.glass.psf_file import FACTS, Stack
from tests.support.psfs import in_pixels

SIDE_PX = 256
WAVELENGTHS_NM = (450.0, 550.0, 650.0, 750.0)
HALF_PX = 7


def profile(x_px: float, y_px: float, nm: float, focus_um: float = 0.0):
    """Light a px^2 at x, y px from the camera's place of a star: two Gaussians, off the chief
    ray towards the corners.
    """
    u, v = (2 * np.array([x_px, y_px]) - SIDE_PX + 1) / SIDE_PX
    colour = (nm - 600) / 150
    sigma = np.sqrt(0.5**2 + 0.06 * (u * u + v * v) + 0.03 * colour**2 + (focus_um / 40) ** 2)
    off_x, off_y = (0.15 * w * (u * u + v * v) + 0.15 * w * colour for w in (u, v))

    def light(x, y):
        found = 0.0
        for share, far, wide in ((0.75, 0.0, 1.0), (0.25, 0.5, 1.4)):
            s = sigma * wide
            away = (x - off_x - far * u) ** 2 + (y - off_y - far * v) ** 2
            found = found + share * np.exp(-away / (2 * s * s)) / (2 * np.pi * s * s)
        return found

    return light


def illumination(x_px: float, y_px: float) -> float:
    """Light relative to the middle of the field."""
    return (
        1 - 0.2 * ((x_px - (SIDE_PX - 1) / 2) ** 2 + (y_px - (SIDE_PX - 1) / 2) ** 2) / SIDE_PX**2
    )


def stack(
    points: int = 5,
    wavelengths_nm=WAVELENGTHS_NM,
    focuses_um=(0.0,),
    per_px: int = 4,
    integrated: bool = False,
) -> Stack:
    """Its images at `points` squared places of the detector."""
    at = np.arange(-HALF_PX * per_px, HALF_PX * per_px + 1) / per_px
    images, places, facts = [], [], []
    for x in np.linspace(0, SIDE_PX - 1, points) if points > 1 else [(SIDE_PX - 1) / 2]:
        for y in np.linspace(0, SIDE_PX - 1, points) if points > 1 else [(SIDE_PX - 1) / 2]:
            for nm in wavelengths_nm:
                for focus in focuses_um:
                    light = profile(x, y, nm, focus)
                    images.append(
                        in_pixels(light, at, at, 4) if integrated else light(at[None], at[:, None])
                    )
                    places.append((x, y, nm, focus))
                    facts.append((illumination(x, y), *[0.0] * (len(FACTS) - 1)))
    return Stack(np.array(images), np.array(places), np.array(facts), per_px, integrated)


def truth(
    x_px: float,
    y_px: float,
    shares,
    side_px: int,
    focus_um: float = 0.0,
    wavelengths_nm=WAVELENGTHS_NM,
) -> np.ndarray:
    """A star's light (side, side) in the pixels about the nearest to it, by quadrature."""
    pixel = np.arange(side_px) - side_px // 2
    x, y = (np.floor(place + 0.5) + pixel - place for place in (x_px, y_px))
    return sum(
        s * in_pixels(profile(x_px, y_px, nm, focus_um), x, y)
        for s, nm in zip(shares, wavelengths_nm, strict=True)
    )


def moments(light: np.ndarray) -> np.ndarray:
    """Flux, centroid x and y, px from the middle, and second central moments along x and y."""
    at = np.arange(len(light)) - len(light) // 2
    flux, across, down = light.sum(), light.sum(axis=0), light.sum(axis=1)
    x, y = across @ at / flux, down @ at / flux
    return np.array([flux, x, y, across @ (at - x) ** 2 / flux, down @ (at - y) ** 2 / flux])
