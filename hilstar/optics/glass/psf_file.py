"""The file of a tracker's glass: point spread functions over the field, wavelength and focus, and
what belongs with them.

The layout is one FITS file. docs/optics.md states it for writers; `read_glass` and `write_glass`
keep it:

- the first HDU has the basis, float32 (components, height, width): x right, y down, `OVERSAMP`
  samples a tracker pixel, the
  chief ray in the middle of the middle sample. `PIXINT` says whether the pixel is integrated in it;
- the table POINTS has a row for each field point, wavelength and focus: `x_px`, `y_px`,
  `wavelength_nm`, `focus_um`,
  `relative_illumination`, `outside_share`, `lateral_x_px`, `lateral_y_px`, and `weights`: that
  row's PSF is the sum of weight times basis image, and sums to 1;
- the table TRANSMISSION (`wavelength_nm`, `transmission`) and the keys `K1` to `P2` are there where
  they are known.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.files import written
from hilstar.basics.image_files import opened_fits
from hilstar.basics.reading import named_bytes
from hilstar.basics.version import __version__
from hilstar.optics.camera import Lens
from hilstar.optics.psf import SampledPsf, read_psf
from hilstar.sky.spectrum import Curve

if TYPE_CHECKING:
    from astropy.io import fits

VERSION = 1
POINTS, TRANSMISSION = "POINTS", "TRANSMISSION"
LENS_KEYS = ("K1", "K2", "K3", "P1", "P2")
AXES = ("x_px", "y_px", "wavelength_nm", "focus_um")
FACTS = ("relative_illumination", "outside_share", "lateral_x_px", "lateral_y_px")
TOLERANCE = 1e-3  # share of a PSF's light that its basis may put elsewhere
MAX_FILE_BYTES, MAX_IMAGES = 500_000_000, 20_000
PHASES = 4  # places along a pixel's side at which what pixels get is compared
MIN_SAMPLES = 4  # a tracker pixel, where --oversampling does not say
FEW_IMAGES = 7  # no basis has fewer components
# share of a stamp's side; a PSF whose centroid lies farther from the middle is not centred on its
# chief ray
MAX_OFF = 0.25
MAX_NEGATIVE = 0.1  # share of a PSF's light, summed over pixels
SUM_TOLERANCE = 2e-3
ADVICE = "give a FITS file with one image, or one that `hilstar optics` wrote"


@dataclass(frozen=True, slots=True)
class Glass:
    """PSFs at F field points, L wavelengths and Z focus positions, as K basis images.

    `places_px` (F, 2) are tracker pixels, `wavelengths_nm` (L,) and `focuses_um` (Z,) rise; one
    wavelength of NaN counts for all light. `basis` (K, height, width) and `weights` (F, L, Z, K)
    give PSFs that sum to 1. (F, L, Z) are `illumination`, relative to the axis, and the share of
    light `outside` the image. `lateral_px` (F, L, Z, 2) is where a wavelength's chief ray meets the
    detector, from the camera's place of the point: images do not have it. `residual` is the largest
    share of a PSF's light that the basis puts elsewhere.
    """

    places_px: FloatArray
    wavelengths_nm: FloatArray
    focuses_um: FloatArray
    basis: Float32Array
    weights: FloatArray
    illumination: FloatArray
    outside: FloatArray
    lateral_px: FloatArray
    per_px: int = 1
    pixel_integrated: bool = False
    residual: float = 0.0
    lens: Lens | None = None
    transmission: Curve | None = None
    history: tuple[str, ...] = ()

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    def images(self) -> FloatArray:
        """All PSFs (F, L, Z, height, width)."""
        return np.tensordot(self.weights, self.basis.astype(np.float64), axes=1)


@dataclass(frozen=True, slots=True)
class Stack:
    """Images (n, height, width) of PSFs and where each belongs: `at` (n, 4) in the order of
    AXES, `facts` (n, 4) of FACTS.
    """

    images: FloatArray
    at: FloatArray
    facts: FloatArray
    per_px: int = 1
    pixel_integrated: bool = False


def facts_of(count: int) -> FloatArray:
    """FACTS (n, 4) where nothing is known: full light, none outside, no lateral colour."""
    return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))


def glass_of(
    stack: Stack,
    tolerance: float = TOLERANCE,
    lens: Lens | None = None,
    transmission: Curve | None = None,
    history: Sequence[str] = (),
) -> Glass:
    """The glass of a stack, whose images need not be normalised. Raises InputError for one that
    is not of PSFs.
    """
    images = stack.images
    count = len(stack.images)
    per_px = stack.per_px
    if images.ndim != 3 or not all(side % 2 for side in images.shape[1:]):
        shape_text = " x ".join(map(str, images.shape[::-1]))
        raise InputError(
            f"a stack of {shape_text} has no middle samples; write images (n, height, width) of odd"
            " sides"
        )
    if not 1 <= count <= MAX_IMAGES:
        raise InputError(f"{count} images; write 1 to {MAX_IMAGES}")
    if len(stack.at) != count:
        raise InputError(
            f"{count} images and {len(stack.at)} points; write one point for each image"
        )
    for number, image in enumerate(images, start=1):
        if not np.isfinite(image).all() or image.sum() <= 0:
            raise InputError(
                f"image {number} has samples that are not finite, or no light; write finite ones"
                " with a positive sum"
            )
    images = images / images.sum(axis=(1, 2), keepdims=True)
    if per_px < 1:
        raise InputError(f"PSFs of {per_px} samples a pixel; write 1 or more")
    width = 1 if stack.pixel_integrated else per_px
    flat_images = images.reshape(count, -1)
    basis, weights, residual = principal(flat_images, images.shape[1:], tolerance, width)
    sums = basis.sum(axis=1, dtype=np.float64)
    weights /= (weights @ sums)[:, None]
    axes, place = _product(stack.at)
    shape = tuple(len(axis) for axis in axes)
    made = Glass(
        *axes,
        basis=basis.reshape(-1, *images.shape[1:]),
        weights=_ordered(weights, place, shape),
        illumination=_ordered(stack.facts[:, 0], place, shape),
        outside=_ordered(stack.facts[:, 1], place, shape),
        lateral_px=_ordered(stack.facts[:, 2:], place, shape),
        per_px=stack.per_px,
        pixel_integrated=stack.pixel_integrated,
        residual=residual,
        lens=lens,
        transmission=transmission,
        history=tuple(history),
    )
    _check(made)
    return made


def pupil_places(count: int) -> FloatArray:
    """The middles (count,) of equal parts of a pupil's axis, -1 to 1."""
    return np.asarray((np.arange(count) + 0.5) / count * 2 - 1)


def samples_a_px(pitch_um: float, shortest_um: float, f_number: float, most: int) -> int:
    """Samples to a pixel, two to the finest detail of the shortest wave: MIN_SAMPLES to `most`."""
    finest_um = shortest_um * f_number / 2
    wanted = math.ceil(pitch_um / finest_um)
    return min(most, max(MIN_SAMPLES, wanted))


def offsets(count: int) -> IntArray:
    """How far each of so many samples of a row is from the middle one, samples."""
    return np.arange(count) - count // 2


def moment_carriers(shape: tuple[int, int], sigma: float) -> tuple[FloatArray, FloatArray]:
    """Six images (6, m) that carry one moment each, and the moments' own terms (m, 6), of images of
    a shape (height, width).

    The moments are flux, x, y, x^2, xy and y^2 about the middle sample. An image less what its
    moments' carriers have of it has none of these moments, and neither has any sum of such images.
    """
    middle = np.array(shape)[:, None, None] // 2
    from_middle = (np.indices(shape) - middle) / sigma
    y, x = from_middle.reshape(2, -1)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    weight = np.exp(-(x * x + y * y) / 2)
    weighted = weight[:, None] * terms
    to_moments = np.linalg.pinv(terms.T @ weighted)
    return to_moments @ weighted.T, terms


def principal(
    images: FloatArray, shape: tuple[int, int], tolerance: float, width: int
) -> tuple[Float32Array, FloatArray, float]:
    """Basis (K, m), weights (n, K) and the residual of images (n, m) that sum to 1, for pixels of
    `width` samples.

    Flux, centroids and second moments are kept exactly; of the rest there are as few principal
    components as leave at most `tolerance`: half the sum of a residual's absolute values, which is
    the share of light that lies elsewhere. Both are of what pixels get (`_by_pixels`): detail finer
    than a pixel moves no electron.
    """
    if len(images) <= FEW_IMAGES:
        return images.astype(np.float32), np.eye(len(images)), 0.0
    mean = images.mean(axis=0)
    # a Gaussian of this sigma has the mean image's sum of squares
    squares = mean @ mean
    sigma = float(1 / np.sqrt(4 * np.pi * squares))
    carriers, terms = moment_carriers(shape, sigma)
    moments = images @ terms
    rest = images - moments @ carriers
    in_pixels = _by_pixels(rest.reshape(-1, *shape), width)
    values, vectors = np.linalg.eigh(in_pixels @ in_pixels.T)
    residual = 1.0
    count = 0
    for count in range(len(images) + 1):
        residual = _elsewhere(in_pixels)
        if residual <= tolerance or count == len(images):
            break
        # what is left is rounding
        if values[-1 - count] <= 1e-14 * values[-1]:
            break
        vector = vectors[:, -1 - count]
        in_pixels -= np.outer(vector, vector @ in_pixels)
    strongest_first = vectors[:, ::-1]
    leading = strongest_first[:, :count]
    components = leading.T @ rest
    size = np.maximum(np.linalg.norm(components, axis=1), 1e-300)
    basis = np.concatenate([carriers, components / size[:, None]])
    weights = np.hstack([moments, leading * size])
    return basis.astype(np.float32), weights, residual


def _by_pixels(images: FloatArray, width: int) -> FloatArray:
    """What pixels of `width` samples get of images (n, height, width), at about PHASES places in a
    pixel along each axis.

    The result (n, m) is divided by the number of these places: of one image its absolute values sum
    to its mean light.
    """
    apart = max(1, round(width / PHASES))
    pixel_sums = images
    for axis in (1, 2):
        margins = [(0, 0), (0, 0), (0, 0)]
        margins[axis] = (width, width - 1)
        summed = np.cumsum(np.pad(pixel_sums, margins), axis=axis)
        last = np.arange(width, summed.shape[axis], apart)
        pixel_sums = summed.take(last, axis) - summed.take(last - width, axis)
    mean_of_places = (apart / width) ** 2
    return np.asarray(pixel_sums.reshape(len(images), -1) * mean_of_places)


def _elsewhere(residuals: FloatArray) -> float:
    """The largest share of light that lies elsewhere, of residuals (n, m) by `_by_pixels`."""
    absolute = np.abs(residuals).sum(axis=1)
    return 0.5 * float(absolute.max())


def _product(
    at: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], tuple[IntArray, ...]]:
    """Field points (F, 2), wavelengths (L,) and focus positions (Z,), and the place of each row
    among them.

    Raises InputError where a field point lacks a wavelength or a focus, or has one twice.
    """
    if not np.isfinite(at[:, [0, 1, 3]]).all():
        raise InputError("x_px, y_px or focus_um is not finite; write numbers")
    places_px, of_place = np.unique(at[:, :2], axis=0, return_inverse=True)
    wavelengths_nm, of_wavelength = np.unique(at[:, 2], return_inverse=True)
    focuses_um, of_focus = np.unique(at[:, 3], return_inverse=True)
    place = of_place.ravel(), of_wavelength.ravel(), of_focus.ravel()
    counts = np.zeros((len(places_px), len(wavelengths_nm), len(focuses_um)), dtype=int)
    np.add.at(counts, place, 1)
    if (counts != 1).any():
        f, wavelength, focus = np.argwhere(counts != 1)[0]
        x, y = places_px[f]
        raise InputError(
            f"the point ({x:g}, {y:g}) px has {counts[f, wavelength, focus]} images of"
            f" {wavelengths_nm[wavelength]:g} nm at focus {focuses_um[focus]:g} um; give each point"
            " one image of each wavelength and focus"
        )
    if np.isnan(wavelengths_nm).any() and len(wavelengths_nm) > 1:
        raise InputError(
            "some points have a wavelength and others none; write wavelength_nm for each, or for"
            " none"
        )
    return (places_px, wavelengths_nm, focuses_um), place


def _ordered(values: FloatArray, place: tuple[IntArray, ...], shape: tuple[int, ...]) -> FloatArray:
    """Values of rows (n, ...) by field point, wavelength and focus (F, L, Z, ...)."""
    grid = np.empty((*shape, *values.shape[1:]))
    grid[place] = values
    return grid


def _check(glass: Glass) -> None:
    """Refuse (InputError) what cannot be a glass: first its numbers, then each PSF."""
    _check_numbers(glass)
    _check_psfs(glass)


def _check_numbers(glass: Glass) -> None:
    """Raise InputError for figures that are not finite, or beyond what their kind can have."""
    if glass.per_px < 1:
        raise InputError(f"PSFs of {glass.per_px} samples a pixel; write 1 or more")
    numbers = (
        *(glass.places_px, glass.focuses_um, glass.weights, glass.basis),
        *(glass.outside, glass.lateral_px),
    )
    if not all(np.isfinite(part).all() for part in numbers):
        raise InputError("a place, a focus, a weight or a sample is not finite; write numbers")
    has_none = np.isnan(glass.wavelengths_nm).all()
    if not (has_none or (glass.wavelengths_nm > 0).all()):
        raise InputError(
            f"wavelength_nm from {glass.wavelengths_nm.min():g}; write wavelengths over 0 nm"
        )
    illumination = glass.illumination
    if not ((illumination >= 0) & (illumination <= 2)).all():
        raise InputError(
            "relative_illumination is not within 0 to 2; write each point's light relative to the"
            " axis"
        )
    if not ((glass.outside >= 0) & (glass.outside < 1)).all():
        raise InputError(
            "outside_share is not within 0 to 1; write the share of light that an image has not"
        )


def _check_psfs(glass: Glass) -> None:
    """Raise InputError for a PSF that does not sum to 1, lies beside its chief ray, or is too
    negative.
    """
    binned = [_binned(image, glass.per_px) for image in glass.basis]
    _, height, width = glass.basis.shape
    light = glass.basis.sum(axis=(1, 2))
    moment_x = glass.basis.sum(axis=1) @ offsets(width)
    moment_y = glass.basis.sum(axis=2) @ offsets(height)
    moments = np.stack([light, moment_x, moment_y], axis=1)
    for f, wavelength, focus in np.ndindex(*glass.weights.shape[:3]):
        weights = glass.weights[f, wavelength, focus]
        where = f"the PSF at ({glass.places_px[f, 0]:g}, {glass.places_px[f, 1]:g}) px"
        if not np.isnan(glass.wavelengths_nm[wavelength]):
            where += f", {glass.wavelengths_nm[wavelength]:g} nm"
        total, off_x, off_y = weights @ moments
        if abs(total - 1) > SUM_TOLERANCE:
            raise InputError(f"{where} sums to {total:.4g}; write weights whose PSF sums to 1")
        if abs(off_x) > MAX_OFF * width or abs(off_y) > MAX_OFF * height:
            raise InputError(
                f"{where} has its centroid {off_x:.1f}, {off_y:.1f} samples from the middle of"
                f" {width} x {height}; put the chief ray there"
            )
        negative = -np.tensordot(weights, binned, axes=1).clip(max=0).sum()
        if negative > MAX_NEGATIVE:
            raise InputError(
                f"{where}: {negative:.1%} of its light is negative; subtract its background"
            )


def _binned(image: Float32Array, per_px: int) -> FloatArray:
    """An image's sums over squares of about a pixel."""
    height, width = image.shape
    first_rows = np.arange(0, height, per_px)
    first_columns = np.arange(0, width, per_px)
    rows = np.add.reduceat(image.astype(np.float64), first_rows, axis=0)
    return np.asarray(np.add.reduceat(rows, first_columns, axis=1))


def write_glass(path: Path, glass: Glass) -> None:
    """Write the file of a glass, whole. Raises InputError where it cannot be written."""
    from astropy.io import fits  # 0.3 s of every command that needs none of it

    header = fits.Header()
    header["PSFVERS"] = (VERSION, "layout: docs/optics.md of hilstar")
    header["OVERSAMP"] = (glass.per_px, "samples a tracker pixel")
    header["PIXINT"] = (glass.pixel_integrated, "whether the pixel is integrated")
    header["RESIDUAL"] = (glass.residual, "max share of a PSF's light put elsewhere")
    if glass.lens is not None:
        coefficients = (*glass.lens.radial, *glass.lens.tangential)
        for key, value in zip(LENS_KEYS, coefficients, strict=False):
            header[key] = (value, "distortion, Brown-Conrady of tangents")
    header["CREATOR"] = f"hilstar {__version__}"
    for line in glass.history:
        header["HISTORY"] = line
    count = glass.weights.shape[-1]
    columns = [fits.Column(name, "D", array=value) for name, value in _point_columns(glass)]
    columns.append(fits.Column("weights", f"{count}D", array=glass.weights.reshape(-1, count)))
    points = fits.BinTableHDU.from_columns(columns, name=POINTS)
    hdus = [fits.PrimaryHDU(glass.basis, header), points]
    curve = glass.transmission
    if curve is not None:
        curve_columns = [
            fits.Column("wavelength_nm", "D", array=curve.wavelength_nm),
            fits.Column("transmission", "D", array=curve.value),
        ]
        hdus.append(fits.BinTableHDU.from_columns(curve_columns, name=TRANSMISSION))
    written(path, fits.HDUList(hdus).writeto)


def _point_columns(glass: Glass) -> Iterator[tuple[str, FloatArray]]:
    """The columns of AXES and FACTS of a glass's points, and their names."""
    point, wavelength, focus = np.indices(glass.illumination.shape).reshape(3, -1)
    x_px, y_px = glass.places_px[point].T
    lateral_x_px, lateral_y_px = glass.lateral_px.reshape(-1, 2).T
    axes = (x_px, y_px, glass.wavelengths_nm[wavelength], glass.focuses_um[focus])
    facts = (glass.illumination.ravel(), glass.outside.ravel(), lateral_x_px, lateral_y_px)
    yield from zip((*AXES, *FACTS), (*axes, *facts), strict=True)


def read_glass(path: Path) -> SampledPsf | Glass:
    """The glass of a file, or the one PSF of a FITS image (`read_psf`); the same file again is the
    same object.

    Raises InputError for any other file.
    """
    return _glass_in(path, named_bytes(path, ADVICE, MAX_FILE_BYTES)) or read_psf(path)


@lru_cache(maxsize=4)
def _glass_in(path: Path, content: bytes) -> Glass | None:
    """The glass in a file's bytes; None where they are an image or no FITS file."""
    try:
        with opened_fits(content) as hdus:
            if POINTS in hdus:
                return _checked_glass(path, hdus)
            return None
    except InputError:
        raise
    except Exception:
        # astropy raises whatever a broken header causes in its layers; `read_psf` says it
        return None


def _checked_glass(path: Path, hdus: "fits.HDUList") -> Glass:
    try:
        stack = _parsed(hdus)
        _check(stack)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:
        raise InputError(
            f"{path}: its tables cannot be read ({type(error).__name__}); make it with `hilstar"
            " optics`"
        ) from error
    return stack


def _parsed(hdus: "fits.HDUList") -> Glass:
    header = hdus[0].header
    basis = hdus[0].data
    table = hdus[POINTS].data
    _check_layout(header, basis, table)
    column = {name: np.asarray(table[name], dtype=np.float64) for name in (*AXES, *FACTS)}
    weights = np.asarray(table["weights"], dtype=np.float64).reshape(len(table), -1)
    if weights.shape[1] != len(basis) or not 1 <= len(table) <= MAX_IMAGES:
        raise InputError(
            f"{len(table)} points of {weights.shape[1]} weights and {len(basis)} basis images;"
            " write one weight for each"
        )
    axes, place = _product(np.stack([column[name] for name in AXES], axis=1))
    shape = tuple(len(axis) for axis in axes)
    lateral_px = np.stack([column["lateral_x_px"], column["lateral_y_px"]], axis=1)
    return Glass(
        *axes,
        basis=basis.astype(np.float32),
        weights=_ordered(weights, place, shape),
        illumination=_ordered(column["relative_illumination"], place, shape),
        outside=_ordered(column["outside_share"], place, shape),
        lateral_px=_ordered(lateral_px, place, shape),
        per_px=header.get("OVERSAMP", 1),
        pixel_integrated=header.get("PIXINT", False),
        residual=float(header.get("RESIDUAL", 0.0)),
        lens=_lens(header),
        transmission=_transmission(hdus),
        history=tuple(str(line) for line in header.get("HISTORY", ())),
    )


def _check_layout(header: "fits.Header", basis: Any, table: Any) -> None:
    """Raise InputError where keys, columns or images are not those of this layout's version."""
    per_px = header.get("OVERSAMP", 1)
    integrated = header.get("PIXINT", False)
    if header.get("PSFVERS") != VERSION:
        raise InputError(
            f"PSFVERS is {header.get('PSFVERS')!r}, and this hilstar reads {VERSION}; make it with"
            " `hilstar optics`"
        )
    if type(per_px) is not int or type(integrated) is not bool:
        raise InputError(
            f"OVERSAMP is {per_px!r} and PIXINT {integrated!r}; write a whole number, and T or F"
        )
    missing = [name for name in (*AXES, *FACTS, "weights") if name not in table.names]
    if missing:
        raise InputError(
            f"the table {POINTS} has no column {missing[0]}; make it with `hilstar optics`"
        )
    if basis is None or basis.ndim != 3 or not all(side % 2 for side in basis.shape[1:]):
        raise InputError(
            "its first image is no cube of odd width and height; make it with `hilstar optics`"
        )


def _lens(header: "fits.Header") -> Lens | None:
    """The lens in a header's keys; None where all of them are 0."""
    numbers: list[Any] = [header.get(key, 0.0) for key in LENS_KEYS]
    if not any(numbers):
        return None
    k1, k2, k3, p1, p2 = numbers
    return Lens((k1, k2, k3), (p1, p2))


def _transmission(hdus: "fits.HDUList") -> Curve | None:
    """The table TRANSMISSION; None without one. Raises InputError for one that is no curve."""
    if TRANSMISSION not in hdus:
        return None
    table = hdus[TRANSMISSION].data
    wavelength_nm = np.asarray(table["wavelength_nm"], dtype=np.float64)
    transmission = np.asarray(table["transmission"], dtype=np.float64)
    is_rising = len(wavelength_nm) > 1 and (np.diff(wavelength_nm) > 0).all()
    is_share = ((transmission >= 0) & (transmission <= 1)).all()
    if not is_rising or not is_share:
        raise InputError(
            f"the table {TRANSMISSION} has wavelengths that do not rise, or values beyond 0 to"
            " 1; write those"
        )
    return Curve(wavelength_nm, transmission)
