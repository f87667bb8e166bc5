"""Centroids of the dots by frame and pose, from a table or measured in the tracker's images."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError, one_line
from hilstar.basics.fits_headers import FitsImage, read_fits_image
from hilstar.basics.image_files import ImageSizeError, is_fits, opened_picture
from hilstar.basics.reading import read_bytes
from hilstar.basics.text_tables import read_rows
from hilstar.instruments.calibrate.geometric.dot_shape import DotShape, without_s_curve
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background

MAX_OBSERVED_BYTES = 100_000_000
MAX_ROWS = 1_000_000
NEEDED = ("frame", "x_px", "y_px")
COLUMNS = ("frame", "pose", "x_px", "y_px", "sigma_px")  # of `Observed`
ADVICE = "write a CSV with the columns frame,x_px,y_px and, where known, flux, sigma_px and pose"
FITS_ENDINGS = (".fits", ".fit", ".fts")
MAX_IMAGE_BYTES = 500_000_000
# share of pixels at the image's largest possible value: a few hot pixels do not matter
SATURATED_SHARE, SATURATED_PIXELS = 1e-5, 20
FULL_DN = {2.0**bits - 1 for bits in (8, 10, 12, 14, 16)}
THRESHOLD_SIGMA = 8.0
# A narrower window than the dot sees noise alone where the dot is flat: 12.6 px wide dots scatter
# by 0.4 px in one of 1.5 px.
MIN_WINDOW_SIGMA_PX = 1.5
IMAGE_ADVICE = (
    "give the tracker's image of frame N as frame_N.fits or frame_N.png, 8 to 16 bits of grey"
)
NUMBER = re.compile(r"(\d+)(?!.*\d)")
POSE = re.compile(r"pose_?(\d+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Observed:
    """Centroids in the tracker's image: frame, pose (0 by default) and place in tracker px, (n,)
    each.

    `sigma_px` (n,) is each one's own error where the table has it, else 1: only ratios count then.
    `settings` are those that they were measured by, None for those of a table. No dot is measured
    nearer to the detector's edge than `edge_px`: its window leaves the image.
    """

    frame: IntArray
    pose: IntArray
    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray
    settings: CentroidSettings | None = None

    @property
    def edge_px(self) -> float:
        """Half the side of the window that they were measured in, 0 for those of a table."""
        if self.settings is None:
            return 0.0
        return float(self.settings.radius_px)

    def __len__(self) -> int:
        return len(self.frame)

    def at(self, chosen: IntArray) -> "Observed":
        """The centroids at indices `chosen`."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in COLUMNS})

    def joined(self, other: "Observed") -> "Observed":
        """These centroids and others, of other frames."""
        joined: dict[str, Any] = {}
        for name in COLUMNS:
            joined[name] = np.concatenate([getattr(self, name), getattr(other, name)])
        return replace(self, **joined)

    def without_s_curve(self, pose: int, shape: DotShape) -> "Observed":
        """The same centroids, those of a pose without the bias by a dot's place within a pixel,
        where its shape is known.
        """
        if self.settings is None:
            return self
        is_of_pose = self.pose == pose
        x_px, y_px = without_s_curve(self.x_px, self.y_px, shape, self.settings)
        return replace(
            self,
            x_px=np.where(is_of_pose, x_px, self.x_px),
            y_px=np.where(is_of_pose, y_px, self.y_px),
        )


def read_observed(path: Path) -> Observed:
    """Read a table of centroids. Raises InputError with the line that is wrong."""
    rows: list[tuple[float, ...]] = []
    for line, cells in read_rows(path, NEEDED, ADVICE, MAX_OBSERVED_BYTES, ("sigma_px", "pose")):
        try:
            frame_number = int(cells[0])
            x = float(cells[1])
            y = float(cells[2])
            sigma = float(cells[3] or 1.0)
            pose_number = int(cells[4] or 0)
            finite = math.isfinite(x) and math.isfinite(y) and 0 < sigma < math.inf
            if not (finite and 0 <= frame_number < 10**6 and 0 <= pose_number < 1000):
                raise ValueError
        except ValueError as error:
            wanted = (
                "a frame from 0, finite x_px and y_px, sigma_px above 0 and a pose from 0 are"
                " wanted"
            )
            raise InputError(f"{path}:{line}: {','.join(cells)[:80]!r}; {wanted}") from error
        rows.append((frame_number, x, y, sigma, pose_number))
        if len(rows) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} centroids; write fewer frames")
    if not rows:
        raise InputError(f"{path}: has no centroid; {ADVICE}")
    frame, x_px, y_px, sigma_px, pose = np.array(rows).T
    return Observed(frame.astype(np.intp), pose.astype(np.intp), x_px, y_px, sigma_px)


def measure_images(
    paths: Sequence[Path],
    dark: Path | None,
    resolution_px: tuple[int, int],
    dot_sigma_px: float = MIN_WINDOW_SIGMA_PX,
) -> Observed:
    """Centroids of all images, of dots of about `dot_sigma_px` in the tracker's image.

    The frame is the last number in a file's name, the pose that of `poseN` in its folder, else 0.
    Raises InputError for an image that cannot be read, has another size than the tracker's, or is
    saturated.
    """
    paths_of = numbered(paths)
    if dark is None:
        under = None
    else:
        under = read_image(dark, resolution_px)
    settings = dot_centroids(dot_sigma_px)
    places = [_centroids(path, resolution_px, under, settings) for path in paths_of.values()]
    count = [len(x) for x, _ in places]
    if not sum(count):
        raise InputError(
            f"{paths[0]}: no dot was found in it nor in the other images; show the dots brighter or"
            " expose longer"
        )
    frame_of, pose_of = (
        np.repeat(np.array(part, dtype=np.intp), count) for part in zip(*paths_of, strict=True)
    )
    x_px, y_px = (np.concatenate(part) for part in zip(*places, strict=True))
    return Observed(frame_of, pose_of, x_px, y_px, np.ones(len(x_px)), settings)


def dot_centroids(dot_sigma_px: float) -> CentroidSettings:
    """How the places of dots of about `dot_sigma_px` in the tracker's image are measured."""
    window_sigma_px = max(dot_sigma_px, MIN_WINDOW_SIGMA_PX)
    return CentroidSettings(
        threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=2, window_sigma_px=window_sigma_px
    )


def numbered(paths: Sequence[Path]) -> dict[tuple[int, int], Path]:
    """Images by frame and pose, as `measure_images` takes them from their names. Raises
    InputError.
    """
    path_by_number: dict[tuple[int, int], Path] = {}
    for path in paths:  # all names before the first image, which takes a second
        number = NUMBER.search(path.stem)
        pose_number = POSE.search(str(path.parent.name))
        if number is None or int(number[1]) > 10**6:
            raise InputError(f"{path}: its name has no frame number; {IMAGE_ADVICE}")
        frame = int(number[1])
        pose = int(pose_number[1]) if pose_number else 0
        if (frame, pose) in path_by_number:
            raise InputError(
                f"{path}: is frame {frame} of pose {pose}, and so is {path_by_number[frame, pose]};"
                f" {IMAGE_ADVICE}"
            )
        path_by_number[frame, pose] = path
    return path_by_number


def _centroids(
    path: Path, resolution_px: tuple[int, int], under: FloatArray | None, settings: CentroidSettings
) -> tuple[FloatArray, FloatArray]:
    image = read_image(path, resolution_px)
    saturated = saturated_pixels(image)
    if saturated:
        raise InputError(
            f"{path}: {saturated} pixels are saturated at {image.max():.0f}; expose shorter, or"
            " show the dots darker"
        )
    if under is not None:
        image = image - under
    stars = find_stars(image, settings, noisiest_background(image))
    is_whole = ~stars.at_edge
    return stars.x_px[is_whole], stars.y_px[is_whole]


def saturated_pixels(image: npt.NDArray[Any]) -> int:
    """How many pixels of an image (h, w), DN, are at full scale; 0 where they may be hot ones."""
    top = float(image.max())
    count = int((image == top).sum())
    if top in FULL_DN and count > max(SATURATED_PIXELS, SATURATED_SHARE * image.size):
        return count
    return 0


def read_image(
    path: Path, resolution_px: tuple[int, int] | None = None, advice: str = IMAGE_ADVICE
) -> FloatArray:
    """A grey image (h, w) as float64, first row at the top, of this (width, height) if any.
    Raises InputError.
    """
    return read_exposed(path, resolution_px, advice)[0]


def read_exposed(
    path: Path, resolution_px: tuple[int, int] | None = None, advice: str = IMAGE_ADVICE
) -> tuple[FloatArray, float | None]:
    """A grey image as `read_image` gives it, and its exposure, s, where a FITS header says it.
    Raises InputError.
    """
    data = read_bytes(path, advice, MAX_IMAGE_BYTES)
    exposure_s = None
    # A grabbing script may write FITS under any name.
    if path.suffix.lower() in FITS_ENDINGS or is_fits(data):
        fits_image = _fits(path, data, advice, resolution_px)
        image = fits_image.pixels
        exposure_s = fits_image.exposure_s
    else:
        image = _picture(path, data, advice, resolution_px)
    if image.ndim != 2:
        raise InputError(f"{path}: is no grey image of one plane; {advice}")
    return np.asarray(image, dtype=np.float64), exposure_s


def _fits(path: Path, data: bytes, advice: str, size_px: tuple[int, int] | None) -> FitsImage:
    try:
        return read_fits_image(data, size_px)
    except (ImageSizeError, InputError) as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # whatever a damaged header makes Astropy raise
        reason = one_line(str(error))
        raise InputError(f"{path}: cannot be read as FITS ({reason}); {advice}") from error


def _picture(
    path: Path, data: bytes, advice: str, size_px: tuple[int, int] | None
) -> npt.NDArray[Any]:
    from PIL import Image

    try:
        with opened_picture(data, size_px) as picture:
            return np.asarray(picture)
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be read as a picture ({error}); {advice}") from error
