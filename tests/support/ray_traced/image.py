"""What a camera's pixels collect of a body, by many rays a pixel, and where an image has its
limb.
"""

from __future__ import annotations

from collections.abc import Callable
from math import erf

import numpy as np
from scipy.ndimage import map_coordinates

from tests.support.ray_traced.bodies import Body, traced

Directions = Callable[[np.ndarray, np.ndarray], np.ndarray]
STEP_PX = 1e-3  # of the solid angle's differences
BLOCK = 1 << 14  # rays at once: they stay in a cache


def image(
    body: Body,
    rays: Directions,
    resolution_px: tuple[int, int],
    rng: np.random.Generator,
    across: int = 4,
    at_limb: int = 24,
) -> np.ndarray:
    """Of radiance times solid angle, each pixel's (height, width); `rays` gives the directions
    (n, 3) of pixels (n,), (n,).

    Each pixel has `across` squared rays, one anywhere in each of as many squares; those where one
    ray in some meets the body and another does not, or where brightness changes by much, have
    `at_limb` squared.
    """
    width, height = resolution_px
    y, x = (part.ravel().astype(float) for part in np.mgrid[:height, :width])
    mean, low, high, mixed = _sampled(body, rays, x, y, across, rng)
    brightest = max(float(high.max()), 1e-300)
    found = (mixed | (high - low > 0.02 * brightest)).reshape(height, width)
    around = np.zeros((height + 2, width + 2), dtype=bool)
    for row, column in np.ndindex(3, 3):  # a sliver may lie between the rays of the pixel beside
        around[row : row + height, column : column + width] |= found
    rough = np.flatnonzero(around[1:-1, 1:-1])
    if len(rough) and at_limb > across:
        mean[rough], *_ = _sampled(body, rays, x[rough], y[rough], at_limb, rng)
    return (mean * solid_angles(rays, x, y)).reshape(height, width)


def spread_image(
    body: Body,
    rays: Directions,
    resolution_px: tuple[int, int],
    sigma_px: tuple[float, float],
    rng: np.random.Generator,
    finer: int = 3,
) -> np.ndarray:
    """The same after a Gaussian that spreads all light, that of what is beside the image too."""
    margin = int(np.ceil(5 * max(sigma_px)))
    width, height = (size + 2 * margin for size in resolution_px)

    def within(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return rays((x - (finer - 1) / 2) / finer - margin, (y - (finer - 1) / 2) / finer - margin)

    sharp = image(body, within, (finer * width, finer * height), rng, across=2, at_limb=8)
    fine = blurred(sharp, (finer * sigma_px[0], finer * sigma_px[1]))
    whole = fine.reshape(height, finer, width, finer).sum(axis=(1, 3))
    return whole[margin:-margin, margin:-margin]


def solid_angles(rays: Directions, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Steradians to a square pixel at pixels (n,)."""

    def unit(dx: float, dy: float) -> np.ndarray:
        d = rays(x + dx, y + dy)
        return d / np.linalg.norm(d, axis=1, keepdims=True)

    right = (unit(STEP_PX, 0) - unit(-STEP_PX, 0)) / (2 * STEP_PX)
    down = (unit(0, STEP_PX) - unit(0, -STEP_PX)) / (2 * STEP_PX)
    return np.linalg.norm(np.cross(right, down), axis=1)


def _sampled(
    body: Body,
    rays: Directions,
    x: np.ndarray,
    y: np.ndarray,
    across: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean, lowest and highest radiance of pixels (n,), and whether the limb crosses them."""
    cells = (np.arange(across) - (across - 1) / 2) / across
    offset = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2)
    out = [np.empty(len(x)) for _ in range(4)]
    step = max(1, BLOCK // len(offset))
    for begin in range(0, len(x), step):
        part = slice(begin, begin + step)
        jitter = rng.uniform(-0.5, 0.5, size=(len(x[part]), len(offset), 2)) / across
        px = (x[part, None] + offset[:, 0] + jitter[..., 0]).ravel()
        py = (y[part, None] + offset[:, 1] + jitter[..., 1]).ravel()
        radiance, through = (v.reshape(-1, len(offset)) for v in traced(body, rays(px, py)))
        met = through < 0.5
        found = radiance.mean(1), radiance.min(1), radiance.max(1), met.any(1) != met.all(1)
        for whole, value in zip(out, found, strict=True):
            whole[part] = value
    return out[0], out[1], out[2], out[3] > 0


def blurred(sharp: np.ndarray, sigma_px: tuple[float, float]) -> np.ndarray:
    """An image whose pixels' light is spread by a Gaussian, each as if it came evenly from its
    own square; dark beyond it.
    """
    return _kernel(sharp.shape[0], sigma_px[1]) @ sharp @ _kernel(sharp.shape[1], sigma_px[0]).T


def _kernel(size: int, sigma_px: float) -> np.ndarray:
    """What each pixel of a line gets of each other's light (size, size): a Gaussian averaged
    over both pixels.
    """

    def twice(t: float) -> float:  # the integral of the integral of a Gaussian
        return (
            t * (1 + erf(t / (sigma_px * 2**0.5))) / 2
            + sigma_px * np.exp(-((t / sigma_px) ** 2) / 2) / (2 * np.pi) ** 0.5
        )

    reach = [twice(n + 1.0) - 2 * twice(float(n)) + twice(n - 1.0) for n in range(size)]
    apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return np.array(reach)[apart]


def edge_px(
    picture: np.ndarray, places: np.ndarray, outward: np.ndarray, reach_px: float = 5.0
) -> np.ndarray:
    """How far outward of places (n, 2) on a limb an image falls to half of what it has `reach_px`
    inside, px.

    `outward` (n, 2) are unit vectors. NaN where the image is dark inside. Between pixels the image
    is a cubic spline.
    """
    steps = np.arange(-reach_px, reach_px + 0.05, 0.05)
    at = places[:, None, :] + steps[None, :, None] * outward[:, None, :]
    profile = map_coordinates(picture, [at[..., 1], at[..., 0]], order=3, mode="nearest")
    level = profile[:, :1] / 2
    below = profile < level
    first = np.argmax(below, axis=1)
    rows = np.arange(len(profile))
    high, low = profile[rows, first - 1], profile[rows, first]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = steps[first - 1] + 0.05 * (high - level[:, 0]) / (high - low)
    return np.where((first > 0) & (level[:, 0] > 0), place, np.nan)
