"""A map of PSF images, measured or simulated, with a table of where each belongs, as a tracker's
glass.
"""

from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.image_files import ImageSizeError, opened_fits
from hilstar.basics.reading import read_bytes
from hilstar.basics.text_tables import finite_numbers, read_rows
from hilstar.optics.glass.psf_file import (
    AXES,
    FACTS,
    MAX_FILE_BYTES,
    Glass,
    Stack,
    facts_of,
    glass_of,
)

STACK_ADVICE = (
    "give a FITS cube (n, height, width) of odd sides, the chief ray in the middle of each image"
)
POINTS_ADVICE = f"write x_px,y_px, and as far as known {', '.join((*AXES[2:], *FACTS))}"
MAX_CSV_BYTES = 10_000_000


def glass_of_map(
    stack: Path, points: Path, per_px: int, pixel_integrated: bool, tolerance: float
) -> Glass:
    """The glass of a stack's images, image k at row k of the points. Raises InputError."""
    images = _images(stack)
    at, facts = _points(points)
    try:
        history = (f"hilstar optics map of {stack.name} and {points.name}",)
        return glass_of(
            Stack(images, at, facts, per_px, pixel_integrated), tolerance, history=history
        )
    except InputError as error:
        raise InputError(f"{stack}, {points}: {error}") from error


def _images(path: Path) -> FloatArray:
    content = read_bytes(path, STACK_ADVICE, MAX_FILE_BYTES)
    try:
        with opened_fits(content) as hdus:
            images: FloatArray = np.asarray(hdus[0].data, dtype=np.float64)
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}; {STACK_ADVICE}") from error
    except Exception as error:  # astropy raises whatever a broken header causes in its layers
        raise InputError(f"{path}: not a FITS image; {STACK_ADVICE}") from error
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3:
        raise InputError(f"{path}: an array of {images.ndim} axes; {STACK_ADVICE}")
    return images


def _points(path: Path) -> tuple[FloatArray, FloatArray]:
    """Places (n, 4) in the order of AXES and facts (n, 4) in that of FACTS; what has no column
    or cell is not known.
    """
    more = (*AXES[2:], *FACTS)
    rows = []
    defaults = [np.nan, 0.0, *facts_of(1)[0]]
    for line, cells in read_rows(path, AXES[:2], POINTS_ADVICE, MAX_CSV_BYTES, more):
        named = [(name, cell) for name, cell in zip(more, cells[2:], strict=True) if cell]
        place = finite_numbers(path, line, AXES[:2], cells[:2], POINTS_ADVICE)
        given = finite_numbers(
            path, line, tuple(n for n, _ in named), [cell for _, cell in named], POINTS_ADVICE
        )
        known = dict(zip((name for name, _ in named), given, strict=True))
        rows.append(
            [
                *place,
                *(known.get(name, default) for name, default in zip(more, defaults, strict=True)),
            ]
        )
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    return table[:, :4], table[:, 4:]
