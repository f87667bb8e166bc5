"""For your own tests: two skies compared star by star, so that a golden frame holds on another
driver.
"""

from __future__ import annotations  # docs/python-api.md shows annotations as they are written

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.instruments.compare.compare_skies import (
    check_skies,
    compare_skies,
    read_frame_fits,
    read_truth_csv,
)
from hilstar.instruments.compare.sky_comparison import (
    CENTROID_PX,
    FLUX_MAG,
    Limits,
    SkyComparison,
    finding,
    star_lines,
)
from hilstar.instruments.compare.star_fit import Truth, describes
from hilstar.server.bench.frame import Frame

__all__ = ["assert_same_sky", "compare"]

MAX_LINES = 20

Sky = Frame | npt.NDArray[Any] | str | Path


def assert_same_sky(
    frame: Sky,
    golden: Sky,
    *,
    flux_mag: float = FLUX_MAG,
    centroid_px: float = CENTROID_PX,
    truth: Truth | str | Path | None = None,
) -> SkyComparison:
    """Assert that every star of two skies has the same flux (magnitudes) and place (px). Skies are
    those of `compare`.

    Raises AssertionError with the common difference of all stars and a line for each star that
    differs otherwise (at most 20). Raises InputError as `compare` does.

    >>> with hilstar.load("bench.toml") as bench:
    ...     frame = bench.frame([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    ...     comparison = hilstar.testing.assert_same_sky(frame, frame)
    """
    comparison = compare(frame, golden, flux_mag=flux_mag, centroid_px=centroid_px, truth=truth)
    if not comparison.same:
        lines = [finding(comparison), *star_lines(comparison, MAX_LINES, "")]
        raise AssertionError("\n".join(lines))
    return comparison


def compare(
    frame: Sky,
    golden: Sky,
    *,
    flux_mag: float = FLUX_MAG,
    centroid_px: float = CENTROID_PX,
    truth: Truth | str | Path | None = None,
) -> SkyComparison:
    """Compare two skies star by star: each a Frame, a linear image (height, width), or a FITS of
    `hilstar frame`.

    Light of three channels (3, height, width) is compared as a sum and by channel, and with light
    of one as a sum.

    Stars have HIP numbers by `truth` (a Frame's table, or the CSV of `hilstar frame --truth`), else
    by the Frames' own. Raises InputError for limits that are not above 0, images of different size
    or without a star, and files of another kind.

    >>> with hilstar.load("bench.toml") as bench:
    ...     frame = bench.frame([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    >>> hilstar.compare(frame, frame).same
    True
    """
    limits = Limits(flux_mag, centroid_px)
    if not (truth is None or isinstance(truth, (str, Path, np.ndarray))):
        raise InputError(
            f"compare: truth {shortened(repr(truth))}; give a Frame's truth, or the CSV that"
            " `hilstar frame --truth OUT.csv` writes"
        )
    light, golden_light = _image(frame), _image(golden)
    if light.ndim != golden_light.ndim:
        light, golden_light = _together(light), _together(golden_light)
    check_skies(light, golden_light)
    frame_truth = frame.truth if isinstance(frame, Frame) else None
    if isinstance(truth, str | Path):
        truth = read_truth_csv(Path(truth))
    elif truth is None and isinstance(golden, Frame):
        truth = golden.truth
    elif (
        truth is None
        and frame_truth is not None
        and describes(frame_truth, _together(golden_light))
    ):
        truth = frame_truth
    return compare_skies(light, golden_light, limits, truth, frame_truth)


def _together(image: FloatArray) -> FloatArray:
    """The sum of an image's channels."""
    return image.sum(axis=0) if image.ndim == 3 else image


def _image(sky: Sky) -> FloatArray:
    """A sky as a linear image (height, width), or (3, height, width). Raises InputError."""
    if isinstance(sky, str | Path):
        return read_frame_fits(Path(sky))
    if isinstance(sky, Frame):
        image = sky.light if len(sky.light) > 1 else sky.linear
    else:
        image = np.asarray(sky)
    if image.dtype.kind != "f":
        raise InputError(
            f"compare: an image of type {image.dtype}; give a Frame, or its linear image (float),"
            " not its codes"
        )
    return np.asarray(image, dtype=np.float64)
