"""Stray light over an image: a gradient and a measured map, as one camera sees them.

Both are computed once, in the camera's own pixels: what each collects of the light of a tracker
pixel.
"""

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError, cannot_read
from hilstar.basics.fits_headers import read_fits_image
from hilstar.basics.image_files import ImageSizeError, is_fits, npy_array, opened_picture
from hilstar.basics.reading import named_bytes
from hilstar.optics.camera import Camera
from hilstar.optics.layers.fault_kinds import Gradient, MeasuredMap

# a camera's pixels lie smoothly in another's: splines between every eighth are right to 1e-4 px
GRID_PX = 8
MAX_FILE_BYTES = 200_000_000
MAX_SIDE_PX = 16_384  # a map of this side takes 2 GB as float64
MAP_ADVICE = "give a FITS image, a greyscale PNG or an npy array of the whole detector"


def gradient_image(fault: Gradient, camera: Camera, tracker: Camera) -> Float32Array:
    """Electrons per second of each camera pixel (h, w) where the brightest corner of the
    detector has 1 in a tracker pixel.
    """
    x_px, y_px, area = pixels_in(camera, tracker)
    width, height = tracker.resolution_px
    right = math.cos(math.radians(fault.towards_deg))
    down = math.sin(math.radians(fault.towards_deg))
    extent_px = abs(right) * width + abs(down) * height
    along_px = (x_px - (width - 1) / 2) * right + (y_px - (height - 1) / 2) * down
    rise = 0.5 + along_px / extent_px
    return as_light(np.maximum(rise, 0.0) * area)


def map_image(
    values: FloatArray, fault: MeasuredMap, camera: Camera, source: Camera
) -> Float32Array:
    """Electrons per second of each camera pixel (h, w) of a map over the whole image of
    `source`; nothing outside it.
    """
    from scipy.ndimage import map_coordinates

    x_px, y_px, area = pixels_in(camera, source)
    width, height = source.resolution_px
    rows, columns = values.shape
    inside = source.contains_px(x_px, y_px)
    row = (y_px + 0.5) * rows / height - 0.5
    column = (x_px + 0.5) * columns / width - 0.5
    place = np.stack([row, column])
    sampled = map_coordinates(values, np.where(inside, place, 0.0), order=1, mode="nearest")
    return as_light(np.where(inside, sampled * area, 0.0))


def as_light(image: FloatArray) -> Float32Array:
    """A map for the renderer: places without one are dark."""
    return np.ascontiguousarray(np.nan_to_num(image, nan=0.0, posinf=0.0), dtype=np.float32)


class PixelsIn(NamedTuple):
    """Where each pixel of a camera is in another's pixels, and how many of those it covers: (h,
    w) each, NaN for nowhere.
    """

    x_px: FloatArray
    y_px: FloatArray
    area: FloatArray


def pixels_in(camera: Camera, other: Camera) -> PixelsIn:
    """Where each pixel of `camera` is in `other`'s pixels."""
    width, height = camera.resolution_px
    if camera is other:
        y, x = np.mgrid[0:height, 0:width].astype(np.float64)
        return PixelsIn(x, y, np.ones((height, width)))
    from scipy.interpolate import RectBivariateSpline

    across = np.linspace(0, width - 1, max(5, width // GRID_PX))
    down = np.linspace(0, height - 1, max(5, height // GRID_PX))
    x_px, y_px = _places_in(other, camera, across, down)
    if not np.isfinite(x_px).all() or not np.isfinite(y_px).all():
        return _every_pixel_in(camera, other)
    along_x = RectBivariateSpline(down, across, x_px)
    along_y = RectBivariateSpline(down, across, y_px)
    x_right = along_x(down, across, dy=1)
    y_right = along_y(down, across, dy=1)
    x_down = along_x(down, across, dx=1)
    y_down = along_y(down, across, dx=1)
    area = RectBivariateSpline(down, across, np.abs(x_right * y_down - x_down * y_right))
    rows, columns = np.arange(height), np.arange(width)
    return PixelsIn(along_x(rows, columns), along_y(rows, columns), area(rows, columns))


def _every_pixel_in(camera: Camera, other: Camera) -> PixelsIn:
    """As `pixels_in`, each pixel by itself: where a part of the image is nowhere in the other's."""
    width, height = camera.resolution_px
    columns = np.arange(width, dtype=np.float64)
    rows = np.arange(height, dtype=np.float64)
    x_px, y_px = _places_in(other, camera, columns, rows)
    x_down, x_right = np.gradient(x_px)
    y_down, y_right = np.gradient(y_px)
    return PixelsIn(x_px, y_px, np.abs(x_right * y_down - x_down * y_right))


def _places_in(
    other: Camera, camera: Camera, columns: FloatArray, rows: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixel x and y (rows, columns), in another camera's image, of a grid of a camera's pixels."""
    x, y = np.meshgrid(columns, rows)
    x_px, y_px = other.pixels_from(camera, x.ravel(), y.ravel())
    return x_px.reshape(x.shape), y_px.reshape(x.shape)


def map_sha256(path: Path) -> str:
    """The SHA-256 of a map's file. Raises InputError."""
    return hashlib.sha256(named_bytes(path, MAP_ADVICE, MAX_FILE_BYTES)).hexdigest()


def read_map(path: Path) -> FloatArray:
    """The image (h, w) in a file, its first row at the top. Raises InputError for one that is no
    map of light.
    """
    raw = named_bytes(path, MAP_ADVICE, MAX_FILE_BYTES)
    values = _decoded(path, raw)
    if values.ndim != 2 or min(values.shape) < 2 or max(values.shape) > MAX_SIDE_PX:
        raise InputError(
            f"{path}: an array of shape {values.shape}; {MAP_ADVICE}, 2 to {MAX_SIDE_PX} px on a"
            " side"
        )
    if values.dtype.kind not in "fiub":
        raise InputError(f"{path}: values of type {values.dtype}; {MAP_ADVICE}")
    image = values.astype(np.float64)
    if not (np.isfinite(image).all() and image.min() >= 0):
        raise InputError(
            f"{path}: a value is negative or not finite; give electrons per second, 0 or more"
        )
    if not image.max() > 0:
        raise InputError(f"{path}: is dark everywhere; {MAP_ADVICE}")
    return image


def _decoded(path: Path, raw: bytes) -> npt.NDArray[Any]:
    try:
        if raw.startswith(b"\x93NUMPY"):
            return npy_array(raw)
        if raw.startswith(b"\x89PNG"):
            with opened_picture(raw, formats=("PNG",)) as picture:
                return np.asarray(picture)
        if is_fits(raw):
            return read_fits_image(raw).pixels
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}; {MAP_ADVICE}") from error
    except Exception as error:  # each library raises its own for a damaged file
        raise cannot_read(path, f"{type(error).__name__}: {error}", MAP_ADVICE) from error
    raise cannot_read(path, "it is neither FITS, PNG nor npy", MAP_ADVICE)
