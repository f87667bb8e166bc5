"""The oracle: what the renderer should draw, in NumPy float64 with an exact erf, and discs by
many rays a pixel.
"""

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.optics.extended import DiscLight, ExtendedLight, GlowLight, LightMap, Rectangle
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight

RAYS_ACROSS = 5  # a pixel, along either axis: a limb is then within 0.02 px
MAX_AT_ONCE_PX = 2**20  # pixels of sprites that are computed at once, which bounds memory
RAYS_AT_ONCE = 2**14  # of a disc that are computed at once: few enough for a cache
REACH_SIGMAS = 5  # reach of a disc's light beyond its rectangle


def linear_image(
    sprites: FrameLight, resolution_px: tuple[int, int], psf: Psf, footprint_px: int | None = None
) -> FloatArray:
    """Electrons per second of each pixel, float64, shape (height, width): extended light, then
    sprites.

    `footprint_px` larger than the sprites' own shows what their footprints cut.
    """
    image = extended_image(sprites.extended, resolution_px)
    add_stars(image, sprites, psf, sprites.footprint_px if footprint_px is None else footprint_px)
    return image


def extended_image(lights: tuple[ExtendedLight, ...], resolution_px: tuple[int, int]) -> FloatArray:
    """Electrons per second of each pixel, float64 (height, width), from discs, stray light and
    maps alone.
    """
    image = np.zeros(resolution_px[::-1])
    for light in lights:
        region = light.region(resolution_px)
        if region is None:
            continue
        left, top, width, height = region
        if isinstance(light, LightMap):
            x, y = light.corner_px
            part = slice(top - y, top - y + height), slice(left - x, left - x + width)
            own = light.times * light.image[part].astype(np.float64)
            cover = np.zeros(1) if light.cover is None else light.cover[part]
        elif isinstance(light, GlowLight):
            own, cover = _glow(light, region), np.zeros(1)
        else:
            own, cover = _disc(light, region)
        where = slice(top, top + height), slice(left, left + width)
        # it hides what was there where it covers that
        image[where] = image[where] * (1 - cover) + own
    return image


def add_stars(
    image: FloatArray,
    sprites: FrameLight,
    psf: Psf,
    side_px: int,
    some: IntArray | slice = slice(None),
    share: float = 1.0,
) -> None:
    """Add a share of the light of `some` sprites to an image (height, width), each in a square
    of `side_px`, one by one.
    """
    height, width = image.shape
    steps = np.arange(side_px) - (side_px - 1) // 2
    data = sprites.data[some]
    x_px = sprites.x_px[some]
    y_px = sprites.y_px[some]
    at_once = max(1, MAX_AT_ONCE_PX // side_px**2)
    for begin in range(0, len(data), at_once):
        part = slice(begin, begin + at_once)
        columns, rows = (data["pixel"][part, axis, None] + steps for axis in (0, 1))
        of_pixels = psf.shares(
            (columns - x_px[part, None])[:, None, :], (rows - y_px[part, None])[:, :, None]
        )
        light = share * data["electrons_per_s"][part, None, None].astype(np.float64) * of_pixels
        on_x = (columns >= 0) & (columns < width)
        on_y = (rows >= 0) & (rows < height)
        inside = on_y[:, :, None] & on_x[:, None, :]
        places = rows[:, :, None].astype(np.intp) * width + columns[:, None, :]
        np.add.at(image.reshape(-1), places[inside], light[inside])


def _glow(light: GlowLight, region: Rectangle) -> FloatArray:
    left, top, width, height = region
    y, x = np.mgrid[top : top + height, left : left + width].astype(np.float64)
    u, v = light.camera.tangents(x.ravel(), y.ravel())
    rays = np.stack([u, v, np.ones_like(u)], axis=1)
    angle = np.arctan2(
        np.linalg.norm(np.cross(light.direction_image, rays), axis=1), rays @ light.direction_image
    )
    profile = (1 + (angle / light.scale_rad) ** 2) ** (-light.exponent / 2)
    return np.asarray(light.peak_e_per_s * profile.reshape(height, width))


def _ray_places(first_px: int, size_px: int, margin_px: int) -> FloatArray:
    """Places along an axis of rays through pixels and a margin on either side, RAYS_ACROSS in
    each pixel.
    """
    rays = np.arange((size_px + 2 * margin_px) * RAYS_ACROSS)
    return (rays + 0.5) / RAYS_ACROSS - 0.5 - margin_px + first_px


def _disc(light: DiscLight, region: Rectangle) -> tuple[FloatArray, FloatArray]:
    """A disc's light and cover (height, width) in a region: sharp on a grid of rays, then spread
    by the Gaussian.
    """
    from scipy.ndimage import gaussian_filter

    left, top, width, height = region
    margin = int(np.ceil(REACH_SIGMAS * max(light.psf.width_px)))
    columns = _ray_places(left, width, margin)
    rows = _ray_places(top, height, margin)
    at_once = max(1, RAYS_AT_ONCE // len(columns))
    sharp = np.concatenate(
        [_rays(light, columns, rows[k : k + at_once]) for k in range(0, len(rows), at_once)], axis=1
    )
    sigma = [RAYS_ACROSS * width_px for width_px in reversed(light.psf.width_px)]
    parts = []
    for part in sharp:
        fine = gaussian_filter(part, sigma, mode="nearest", truncate=REACH_SIGMAS)
        whole = fine.reshape(
            height + 2 * margin, RAYS_ACROSS, width + 2 * margin, RAYS_ACROSS
        ).mean(axis=(1, 3))
        parts.append(whole[margin : margin + height, margin : margin + width])
    return light.times * parts[0], light.covers * parts[1]


def _rays(light: DiscLight, columns_px: FloatArray, rows_px: FloatArray) -> FloatArray:
    """Light to a pixel, and cover (2, rows, columns), along the rays of places (columns,) in
    rows (rows,).
    """
    camera = light.camera
    x_px, y_px = (part.ravel() for part in np.meshgrid(columns_px, rows_px))
    u, v = camera.tangents(x_px, y_px)
    rays = np.nan_to_num(np.stack([u, v, np.ones_like(u)], axis=1))
    if light.shear is not None:
        late_s = light.shear.late_s(x_px, y_px)
        rays = rays + late_s[:, None] * np.cross(light.shear.rate_image_rad_s, rays)
    a, b, c, d = camera.slopes(rays[:, 0], rays[:, 1])
    sr = np.nan_to_num(1 / (a * d - b * c)) / np.linalg.norm(rays, axis=1) ** 3
    radiance, cover = light.disc.with_air(rays @ light.icrs_to_image)
    return np.stack([radiance * sr, cover]).reshape(2, len(rows_px), len(columns_px))
