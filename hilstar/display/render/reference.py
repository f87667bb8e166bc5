"""The oracle: what the renderer should draw, in NumPy float64 with an exact erf, and discs by
many rays a pixel.
"""

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
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
    side_px = footprint_px or sprites.footprint_px
    add_stars(image, sprites, psf, side_px)
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
        if isinstance(light, LightMap):
            e_per_s, cover = _map(light, region)
        elif isinstance(light, GlowLight):
            e_per_s = _glow(light, region)
            cover = np.zeros(1)
        else:
            e_per_s, cover = _disc(light, region)
        where = _part(region)
        # it hides what was there where it covers that
        behind = image[where] * (1 - cover)
        image[where] = behind + e_per_s
    return image


def _part(region: Rectangle, corner_px: tuple[int, int] = (0, 0)) -> tuple[slice, slice]:
    """Rows and columns of a region in an image whose first pixel is at `corner_px`."""
    x, y, width, height = region
    row = y - corner_px[1]
    column = x - corner_px[0]
    return slice(row, row + height), slice(column, column + width)


def _map(light: LightMap, region: Rectangle) -> tuple[FloatArray, FloatArray | Float32Array]:
    """A map's light and cover (height, width) in a region; a cover of 0 where it has none."""
    part = _part(region, light.corner_px)
    e_per_s = light.times * light.image[part].astype(np.float64)
    if light.cover is None:
        return e_per_s, np.zeros(1)
    return e_per_s, light.cover[part]


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
    flat = image.reshape(-1)
    data = sprites.data[some]
    x_px = sprites.x_px[some]
    y_px = sprites.y_px[some]
    rates = share * data["electrons_per_s"].astype(np.float64)
    at_once = max(1, MAX_AT_ONCE_PX // side_px**2)
    for begin in range(0, len(data), at_once):
        part = slice(begin, begin + at_once)
        pixel_x, pixel_y = data["pixel"][part].T
        columns = pixel_x[:, None] + steps
        rows = pixel_y[:, None] + steps
        away_x = columns - x_px[part, None]
        away_y = rows - y_px[part, None]
        shares = psf.shares(away_x[:, None, :], away_y[:, :, None])
        light = rates[part, None, None] * shares
        on_x = (columns >= 0) & (columns < width)
        on_y = (rows >= 0) & (rows < height)
        inside = on_y[:, :, None] & on_x[:, None, :]
        line_begins = rows.astype(np.intp) * width
        places = line_begins[:, :, None] + columns[:, None, :]
        np.add.at(flat, places[inside], light[inside])


def _glow(light: GlowLight, region: Rectangle) -> FloatArray:
    """The light (height, width) of a glow in a region, by its angle from the middle."""
    height, width = region[3], region[2]
    rows, columns = _part(region)
    y, x = np.mgrid[rows, columns].astype(np.float64)
    u, v = light.camera.tangents(x.ravel(), y.ravel())
    rays = np.stack([u, v, np.ones_like(u)], axis=1)
    across = np.linalg.norm(np.cross(light.direction_image, rays), axis=1)
    along = rays @ light.direction_image
    angle_rad = np.arctan2(across, along)
    scales = angle_rad / light.scale_rad
    profile = (1 + scales**2) ** (-light.exponent / 2)
    return np.asarray(light.peak_e_per_s * profile.reshape(height, width))


def _ray_places(first_px: int, size_px: int, margin_px: int) -> FloatArray:
    """Places along an axis of rays through pixels and a margin on either side, RAYS_ACROSS in
    each pixel.
    """
    count = (size_px + 2 * margin_px) * RAYS_ACROSS
    from_edge_px = (np.arange(count) + 0.5) / RAYS_ACROSS
    return from_edge_px - 0.5 - margin_px + first_px


def _disc(light: DiscLight, region: Rectangle) -> tuple[FloatArray, FloatArray]:
    """A disc's light and cover (height, width) in a region: sharp on a grid of rays, then spread
    by the Gaussian.
    """
    from scipy.ndimage import gaussian_filter

    x, y, width, height = region
    wide_x_px, wide_y_px = light.psf.width_px
    margin = int(np.ceil(REACH_SIGMAS * max(wide_x_px, wide_y_px)))
    columns = _ray_places(x, width, margin)
    rows = _ray_places(y, height, margin)
    at_once = max(1, RAYS_AT_ONCE // len(columns))
    parts = []
    for begin in range(0, len(rows), at_once):
        some = rows[begin : begin + at_once]
        parts.append(_rays(light, columns, some))
    sharp_light, sharp_cover = np.concatenate(parts, axis=1)
    sigma_rays = RAYS_ACROSS * wide_y_px, RAYS_ACROSS * wide_x_px
    inner = slice(margin, margin + height), slice(margin, margin + width)

    def in_pixels(sharp: FloatArray) -> FloatArray:
        fine = gaussian_filter(sharp, sigma_rays, mode="nearest", truncate=REACH_SIGMAS)
        by_pixel = fine.reshape(height + 2 * margin, RAYS_ACROSS, width + 2 * margin, RAYS_ACROSS)
        return np.asarray(by_pixel.mean(axis=(1, 3))[inner])

    return light.times * in_pixels(sharp_light), light.covers * in_pixels(sharp_cover)


def _rays(light: DiscLight, columns_px: FloatArray, rows_px: FloatArray) -> FloatArray:
    """Light to a pixel, and cover (2, rows, columns), along the rays of places (columns,) in
    rows (rows,).
    """
    camera = light.camera
    grid_x_px, grid_y_px = np.meshgrid(columns_px, rows_px)
    x_px = grid_x_px.ravel()
    y_px = grid_y_px.ravel()
    u, v = camera.tangents(x_px, y_px)
    rays = np.nan_to_num(np.stack([u, v, np.ones_like(u)], axis=1))
    if light.shear is not None:
        late_s = light.shear.late_s(x_px, y_px)
        rays = rays + late_s[:, None] * np.cross(light.shear.rate_image_rad_s, rays)
    a, b, c, d = camera.slopes(rays[:, 0], rays[:, 1])
    px_per_tangents = a * d - b * c
    distance = np.linalg.norm(rays, axis=1)
    sr = np.nan_to_num(1 / px_per_tangents) / distance**3
    radiance, cover = light.disc.with_air(rays @ light.icrs_to_image)
    flat = np.stack([radiance * sr, cover])
    return flat.reshape(2, len(rows_px), len(columns_px))
