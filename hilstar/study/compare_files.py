"""What `hilstar compare` reads, the FITS and CSV of `hilstar frame`, and what it writes: a table and a chart."""

from __future__ import annotations

import csv
import gzip
import io
import math
import warnings
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.assembly import TRUTH_DTYPE
from hilstar.errors import InputError
from hilstar.reading import read_bytes, read_text, size_text
from hilstar.study.charts import chart, write_csv
from hilstar.study.compare import MAG_PER_SHARE, SkyComparison, StarDifference, Truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNIT = "electron/s"
TRUTH_COLUMNS = ("hip", "x_px", "y_px", "electrons_per_s")
MAX_TRUTH_BYTES = 50_000_000
MAX_FITS_BYTES = 600_000_000  # a frame of 8K has 133 MB
NAMED_STARS = 12  # in the chart; the table has all
LEAST_ERROR = 1e-8  # drawn: a tenth of float32's rounding
COLUMNS = (
    "kind",
    "hip",
    "x_px",
    "y_px",
    "flux_e_per_s",
    "flux_error_mag",
    "dx_px",
    "dy_px",
    "centroid_error_px",
    "flux_limit_mag",
    "centroid_limit_px",
)


def read_frame_fits(path: Path) -> FloatArray:
    """The linear image (height, width), electrons/s, of a FITS of `hilstar frame`. Raises InputError for another file."""
    from astropy.io import fits

    wanted = "give the FITS that `hilstar frame -o OUT.fits` writes"
    raw = _inflated(path, read_bytes(path, wanted, MAX_FITS_BYTES), wanted)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of astropy, about cards; what matters is checked below
            image, header = fits.getdata(io.BytesIO(raw), header=True)
    except Exception as error:  # astropy lets through whatever a header makes its layers raise
        raise InputError(f"{path}: no FITS image; {wanted}") from error
    if header.get("BUNIT") != UNIT or image is None or image.ndim != 2 or image.dtype.kind != "f":
        raise InputError(f"{path}: no linear image in {UNIT} (BUNIT is {header.get('BUNIT')!r}); {wanted}")
    return np.asarray(image, dtype=np.float64)


def _inflated(path: Path, raw: bytes, wanted: str) -> bytes:
    """A file's bytes, unpacked where they are gzip's, to no more than a FITS may have. Raises InputError."""
    if raw[:2] != b"\x1f\x8b":
        return raw
    try:
        with gzip.open(io.BytesIO(raw)) as file:
            plain = file.read(MAX_FITS_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: cannot be read (it is a damaged gzip file); {wanted}") from error
    if len(plain) > MAX_FITS_BYTES:
        raise InputError(f"{path}: unpacks to more than {size_text(MAX_FITS_BYTES)}; {wanted}")
    return plain


def read_truth_csv(path: Path) -> Truth:
    """The stars of a CSV of `hilstar frame --truth`, TRUTH_DTYPE, only the columns of TRUTH_COLUMNS filled."""
    wanted = "give the CSV that `hilstar frame --truth OUT.csv` writes"
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, wanted, MAX_TRUTH_BYTES), newline="")))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}); {wanted}") from error
    truth = np.zeros(len(rows), dtype=TRUTH_DTYPE)
    for line, row in enumerate(rows):
        for name in TRUTH_COLUMNS:
            try:
                truth[name][line] = float(row[name])
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise InputError(f"{path}:{line + 2}: no number in the column {name}; {wanted}") from error
    if not all(np.isfinite(truth[name]).all() for name in TRUTH_COLUMNS):
        raise InputError(f"{path}: a number is NaN or infinite; {wanted}")
    return truth


def write_report(directory: Path, comparison: SkyComparison) -> None:
    """compare.csv, a row for each star, and compare.png, errors against magnitude. Raises InputError where they cannot be."""
    write_csv(directory / "compare.csv", COLUMNS, map(_row, comparison.stars))
    _draw(directory / "compare.png", comparison)


def _row(star: StarDifference) -> tuple[object, ...]:
    hip = " ".join(map(str, star.hip))
    errors = star.flux_error_mag, star.dx_px, star.dy_px, star.centroid_error_px
    return star.kind, hip, star.x_px, star.y_px, star.flux_e_per_s, *errors, star.limits.flux_mag, star.limits.centroid_px


def finding(comparison: SkyComparison) -> str:
    """The verdict in one sentence."""
    figures = comparison.summary()
    counts = {name: len(comparison.of(name)) for name in ("changed", "missing", "extra")}
    if comparison.same:
        worst = figures["flux_error_mag"]["max"], figures["centroid_error_px"]["max"]
        return f"The same sky: {figures['stars']} stars, {worst[0]:.2g} mag and {worst[1]:.2g} px off at most"
    rest = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return f"Not the same sky: of {figures['stars']} stars {rest}; worst is {comparison.bad[0].line()}"


def _draw(path: Path, comparison: SkyComparison) -> None:
    with chart(path, finding(comparison), 2) as axes:
        for axis, what, unit in ((axes[0], "flux error", "mag"), (axes[1], "centroid error", "px")):
            _panel(axis, comparison, unit)
            axis.set(yscale="log", ylabel=f"{what} [{unit}], drawn at {LEAST_ERROR:g} where under it")
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        axes[1].set_xlabel("magnitudes under the brightest star")


def _panel(axis: Axes, comparison: SkyComparison, unit: str) -> None:
    """Errors and limits of one kind; stars that only one image has stand in rows above, named once, in the flux's panel."""
    brightest = max(star.flux_e_per_s for star in comparison.stars)
    limit = comparison.limits.flux_mag if unit == "mag" else comparison.limits.centroid_px

    def point(star: StarDifference) -> tuple[float, float, float]:
        mag = MAG_PER_SHARE * math.log(brightest / star.flux_e_per_s)
        if unit == "mag":
            return mag, max(abs(star.flux_error_mag), LEAST_ERROR), star.limits.flux_mag
        return mag, max(star.centroid_error_px, LEAST_ERROR), star.limits.centroid_px

    both = comparison.of("same", "changed")
    row = 4 * max([limit, *(max(point(star)[1:]) for star in both)])
    rows = {"missing": row, "extra": 8 * row}
    for kind, style in (("same", "C0."), ("changed", "C3o"), ("missing", "C3v"), ("extra", "C1^")):
        mags, errors = [[point(star)[k] for star in comparison.of(kind)] for k in (0, 1)]
        heights = [rows[kind]] * len(mags) if kind in rows else errors
        axis.plot(mags, heights, style, ms=5 if kind == "same" else 7, label=f"{kind}: {len(mags)}")
    axis.axhline(limit, color="k", ls="--", lw=1.2, label=f"limit: {limit:g} {unit}")
    wider = [point(star) for star in both if point(star)[2] > limit]
    if wider:
        axis.plot([p[0] for p in wider], [p[2] for p in wider], "k_", ms=8, label=f"a star's own limit: {len(wider)}")
    for star in comparison.bad[:NAMED_STARS]:
        mag, error, own = point(star)
        if unit == "mag" if star.kind in rows else error > own:
            name = star.name if star.hip else f"({star.x_px:.0f}, {star.y_px:.0f})"
            tilt: Any = {"rotation": 30, "rotation_mode": "anchor"} if star.kind in rows else {}
            height = rows.get(star.kind, error)
            axis.annotate(name, (mag, height), xytext=(6, 4), textcoords="offset points", fontsize=8, **tilt)
    axis.set_ylim(LEAST_ERROR / 2, 300 * row)
    axis.set_xlim(right=axis.get_xlim()[1] + 0.5)
