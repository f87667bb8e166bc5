"""A map of light that stands on the sky: read from FITS, kept as tangent images whose unit is stars
of V = 0 per steradian.

Each WCS image of a file becomes a tangent (gnomonic) image of its own resolution. One that is wider
than MAX_HALF_DEG from its middle, or a HEALPix map, becomes the six faces of a cube. Between pixels
all are bilinear.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError, MachineError, cannot_read
from hilstar.basics.image_files import ImageSizeError, opened_fits, unpacked
from hilstar.basics.reading import named_bytes
from hilstar.sky.electrons import VEGA_V0_W_M2_M

MAP_ADVICE = "give a FITS image with a WCS, or a HEALPix map in FITS"
UNIT_ADVICE = (
    "write BUNIT (of a HEALPix column TUNITn) as astropy does, such as mag/arcsec2, MJy/sr or W/(m2"
    " um sr)"
)
MAX_FILE_BYTES = 1_000_000_000
V_NM = 545.0  # effective wavelength of V, for which VEGA_V0_W_M2_M is given (Bessell 1998)
MAX_HALF_DEG = 40.0  # a tangent image's pixels are 1.7 times as long at its edge
MAX_SIDE_PX, MAX_CUBE_PX, MAX_NSIDE = 4096, 2048, 1024  # finer maps are binned
MIN_SIGMA = 0.2  # in its pixels: a narrower Gaussian changes nothing between them
EDGE_PX = 2  # around a face of the cube: between pixels there is always a neighbour


# The light (n,) in unit directions (n, 3), ICRS.
Sampled = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class TangentImage:
    """A square image on a tangent plane, stars of V = 0 per steradian; `axes` (3, 3) are its x, y
    and normal, ICRS.

    The direction (u, v, 1) in its axes is at `px_per_tangent` (u, v) from the middle. Nothing of it
    lies beyond `max_tangent`, which is 1 for a face of a cube.
    """

    image: Float32Array
    axes: FloatArray
    px_per_tangent: float
    max_tangent: float = math.inf
    bv_mag: float | None = None

    def places_px(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns and rows of directions (..., 3), ICRS; NaN behind the plane."""
        x, y, z = np.moveaxis(directions @ self.axes.T, -1, 0)
        scale = self.px_per_tangent / np.where(z > 0, z, np.nan)
        middle = (self.image.shape[0] - 1) / 2
        return x * scale + middle, y * scale + middle

    def seen_by(self, px_rad: float, sigma_px: float) -> "TangentImage":
        """The image for a camera whose finest pixels have `px_rad`: with pixels nearly as large,
        and spread by a Gaussian of `sigma_px` of these.
        """
        from scipy.ndimage import gaussian_filter

        whole = self._binned(int(px_rad * self.px_per_tangent))
        sigma = sigma_px * px_rad * whole.px_per_tangent
        if sigma < MIN_SIGMA:
            return whole
        # The sky goes on beyond a face of a cube. Any other image ends in darkness, into which
        # its light spreads.
        is_of_cube = math.isfinite(self.max_tangent)
        if is_of_cube:
            image = gaussian_filter(whole.image, sigma, mode="nearest")
        else:
            padded = np.pad(whole.image, math.ceil(4 * sigma))
            image = gaussian_filter(padded, sigma, mode="constant")
        return replace(whole, image=image)

    def _binned(self, count: int) -> "TangentImage":
        """The image in blocks of `count` by `count` pixels, with more dark around it for whole
        ones.
        """
        if count < 2:
            return self
        half = -self.image.shape[0] % (2 * count) // 2  # sides are even: the middle stays
        image = block_means(np.pad(self.image, half), count)
        return TangentImage(image, self.axes, self.px_per_tangent / count, self.max_tangent)


def block_means(image: Any, count: int) -> Any:
    """The means of blocks of `count` by `count` pixels, dark beyond the last row and column."""
    height, width = image.shape
    rows, columns = -(-height // count), -(-width // count)
    padded = np.pad(image, [(0, rows * count - height), (0, columns * count - width)])
    blocks = padded.reshape(rows, count, columns, count)
    return blocks.mean(axis=(1, 3))


def read_diffuse_map(path: Path) -> tuple[TangentImage, ...]:
    """The map in a FITS file. Raises InputError, and MachineError where a HEALPix map needs its
    library.
    """
    raw = named_bytes(path, MAP_ADVICE, MAX_FILE_BYTES)
    try:
        with opened_fits(unpacked(raw, MAX_FILE_BYTES)) as units:
            table = next((unit for unit in units if unit.header.get("PIXTYPE") == "HEALPIX"), None)
            images = [unit for unit in units if unit.is_image and unit.data is not None]
            if table is not None:
                return _of_healpix(path, table)
            if images:
                faces: list[TangentImage] = []
                for image in images:
                    faces.extend(_of_image(path, image))
                return tuple(faces)
    except (InputError, MachineError):
        raise
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}; {MAP_ADVICE}") from error
    except Exception as error:  # each library raises its own for a damaged file
        raise cannot_read(path, f"{type(error).__name__}: {error}", MAP_ADVICE) from error
    raise InputError(f"{path}: has neither an image nor a HEALPix table; {MAP_ADVICE}")


def brightness(path: Path, values: Any, unit_name: str | None) -> FloatArray:
    """Values in any unit of surface brightness as stars of V = 0 per steradian; what is negative or
    not finite is dark.

    Magnitudes are V. Other units are spectral densities at V_NM: of energy or photons, per
    wavelength or frequency.
    """
    from astropy import units as u

    try:
        unit = u.Unit(unit_name or "")
        if "mag" in str(unit):
            square = (u.mag / unit).to(u.sr)
            w_m2_m_sr = 10 ** (-0.4 * np.asarray(values, dtype=np.float64)) / square
        else:
            scale = (1 * unit).to(u.W / u.m**3 / u.sr, u.spectral_density(V_NM * u.nm)).value
            w_m2_m_sr = np.asarray(values, dtype=np.float64) * (scale / VEGA_V0_W_M2_M)
    except (ValueError, TypeError) as error:
        if not unit_name:
            unit_text = "no unit"
        else:
            unit_text = f"unit {unit_name!r}, which is no surface brightness"
        raise InputError(f"{path}: {unit_text}; {UNIT_ADVICE}") from error
    finite = np.nan_to_num(w_m2_m_sr, nan=0.0, posinf=0.0)
    return np.asarray(np.maximum(finite, 0.0))


def _of_image(path: Path, hdu: Any) -> tuple[TangentImage, ...]:
    """The tangent image about a picture's middle, or a cube's faces where it is too wide."""
    from astropy.wcs import WCS
    from astropy.wcs.utils import proj_plane_pixel_scales, wcs_to_celestial_frame
    from scipy.ndimage import map_coordinates

    wcs = WCS(hdu.header)
    if hdu.data.ndim != 2 or not wcs.has_celestial:
        raise InputError(
            f"{path}: an image of shape {hdu.data.shape} without a place on the sky; {MAP_ADVICE}"
        )
    light = brightness(path, hdu.data, hdu.header.get("BUNIT"))
    frame = wcs_to_celestial_frame(wcs)
    px_rad = math.radians(float(np.min(proj_plane_pixel_scales(wcs))))
    count = max(math.ceil(max(light.shape) / MAX_SIDE_PX), 1)
    light = block_means(light, count)
    wcs = wcs[::count, ::count]
    px_rad = px_rad * count
    rows, columns = light.shape

    to_frame = _turned(frame)

    def sampled(directions: FloatArray) -> FloatArray:
        x, y, z = (directions @ to_frame.T).T
        lon_deg = np.degrees(np.arctan2(y, x))
        lat_deg = np.degrees(np.arcsin(np.clip(z, -1.0, 1.0)))
        column, row = wcs.world_to_pixel_values(lon_deg, lat_deg)
        place = np.nan_to_num((row, column), nan=-9.0)
        return np.asarray(map_coordinates(light, place, order=1, mode="grid-constant"))

    x, y = np.meshgrid(np.linspace(-0.5, columns - 0.5, 33), np.linspace(-0.5, rows - 0.5, 33))
    world = np.radians(wcs.pixel_to_world_values(x.ravel(), y.ravel()))
    lon, lat = world[:, np.isfinite(world).all(axis=0)]
    celestial = np.stack([np.cos(lon) * np.cos(lat), np.sin(lon) * np.cos(lat), np.sin(lat)])
    frame_directions = to_frame.T @ celestial
    middle = frame_directions.mean(axis=1)
    middle /= np.linalg.norm(middle) or 1.0
    smallest_cosine = float((middle @ frame_directions).min())
    reach = math.acos(np.clip(smallest_cosine, -1.0, 1.0))
    is_partly_nowhere = world.shape[1] != frame_directions.shape[1]
    if reach > math.radians(MAX_HALF_DEG) or is_partly_nowhere:
        return _cube(sampled, math.ceil(2 / px_rad))
    axes = _axes_about(middle)
    half = math.tan(reach + px_rad)
    side = 2 * math.ceil(half / px_rad)
    return (_face(sampled, axes, side, side / (2 * half)),)


def _of_healpix(path: Path, hdu: Any) -> tuple[TangentImage, ...]:
    """A cube's faces of a HEALPix table."""
    try:
        from astropy_healpix import HEALPix
    except ImportError as error:
        raise MachineError(f"{path}: a HEALPix map; pip install 'hilstar[healpix]'") from error
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    header = hdu.header
    frames = {"G": "galactic", "C": "icrs", "Q": "icrs", "E": "barycentricmeanecliptic"}
    system = str(header.get("COORDSYS", "")).strip().upper()[:1]
    if system not in frames:
        raise InputError(
            f"{path}: COORDSYS = {header.get('COORDSYS')!r}; write G (galactic), C (ICRS) or E"
            " (ecliptic)"
        )
    light = brightness(path, np.ravel(hdu.data.field(0)), header.get("TUNIT1"))
    grid = HEALPix(int(header["NSIDE"]), str(header["ORDERING"]).strip().lower())
    if header.get("INDXSCHM", "IMPLICIT").strip() != "IMPLICIT" or len(light) != grid.npix:
        raise InputError(f"{path}: {len(light)} pixels of {grid.npix}; give a map of the whole sky")
    if grid.nside > MAX_NSIDE:
        nested = light
        if grid.order != "nested":
            nested = light[grid.nested_to_ring(np.arange(grid.npix))]
        grid = HEALPix(MAX_NSIDE, "nested")
        light = nested.reshape(grid.npix, -1).mean(axis=1)

    to_frame = _turned(SkyCoord(0, 0, unit="deg", frame=frames[system]).frame)

    def sampled(directions: FloatArray) -> FloatArray:
        x, y, z = (directions @ to_frame.T).T
        # Its interpolation divides by zero at longitudes below 0.
        lon = np.arctan2(y, x) % (2 * np.pi) * u.rad
        lat = np.arcsin(np.clip(z, -1.0, 1.0)) * u.rad
        return np.asarray(grid.interpolate_bilinear_lonlat(lon, lat, light))

    px_rad = grid.pixel_resolution.to_value("rad")
    return _cube(sampled, math.ceil(2 / px_rad))


def _turned(frame: Any) -> FloatArray:
    """The rotation (3, 3) from ICRS to a frame of Astropy: its axes differ by a turn alone."""
    from astropy.coordinates import SkyCoord

    axes = SkyCoord(np.eye(3), representation_type="cartesian", frame="icrs").transform_to(frame)
    return np.asarray(axes.cartesian.xyz.value)


def _axes_about(normal: FloatArray) -> FloatArray:
    """Axes (3, 3) of a tangent plane: any x and y across its normal."""
    # the axis that the normal is farthest from
    farthest = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(normal, farthest)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _cube(sampled: Sampled, side: int) -> tuple[TangentImage, ...]:
    """The six faces, `side` pixels wide and somewhat more; those without light are left out."""
    px_per_tangent = min(side, MAX_CUBE_PX) / 2
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    full = 2 * (math.ceil(px_per_tangent) + EDGE_PX)
    faces = []
    for normal in normals:
        face = _face(sampled, _axes_about(normal), full, px_per_tangent, 1.0)
        if face.image.any():
            faces.append(face)
    return tuple(faces)


def _face(
    sampled: Sampled,
    axes: FloatArray,
    side: int,
    px_per_tangent: float,
    max_tangent: float = math.inf,
) -> TangentImage:
    """A square tangent image, row block by row block."""
    at = (np.arange(side) - (side - 1) / 2) / px_per_tangent
    image = np.empty((side, side), dtype=np.float32)
    for first in range(0, side, 256):
        block = slice(first, first + 256)
        v, u = np.meshgrid(at[block], at, indexing="ij")
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ axes
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        image[block] = sampled(rays).reshape(u.shape)
    return TangentImage(image, axes, px_per_tangent, max_tangent)
