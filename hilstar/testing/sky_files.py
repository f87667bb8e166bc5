"""What `hilstar compare` reads: the FITS and the truth table of `hilstar frame`."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
import zlib
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.truth import TRUTH_DTYPE
from hilstar.errors import InputError, cannot_read
from hilstar.reading import read_bytes, read_text, size_text
from hilstar.testing.star_seeds import Truth

UNIT = "electron/s"
MAX_E_PER_S = 1e30  # whose square is still a number
TRUTH_COLUMNS = ("hip", "x_px", "y_px", "electrons_per_s")
MAX_TRUTH_BYTES = 50_000_000
MAX_FITS_BYTES = 600_000_000  # an 8K frame has 133 MB


def read_frame_fits(path: Path) -> FloatArray:
    """The linear image (height, width), electrons/s, of a FITS of `hilstar frame`. Raises InputError for another file."""
    from astropy.io import fits

    wanted = "give the FITS that `hilstar frame -o OUT.fits` writes"
    raw = _inflated(path, read_bytes(path, wanted, MAX_FITS_BYTES), wanted)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of astropy, about cards; what matters is checked below
            image, header = fits.getdata(io.BytesIO(raw), header=True)
    except Exception as error:  # astropy raises whatever a broken header causes in its layers
        raise InputError(f"{path}: not a FITS image; {wanted}") from error
    if header.get("BUNIT") != UNIT or image is None or image.ndim != 2 or image.dtype.kind != "f":
        raise InputError(f"{path}: not a linear image in {UNIT} (BUNIT is {header.get('BUNIT')!r}); {wanted}")
    light = np.asarray(image, dtype=np.float64)
    if (np.abs(light[np.isfinite(light)]) > MAX_E_PER_S).any():
        raise InputError(f"{path}: a pixel has more than {MAX_E_PER_S:g} {UNIT}; {wanted}")
    return light


def _inflated(path: Path, raw: bytes, wanted: str) -> bytes:
    """A file's bytes, unpacked where they are a gzip file's, up to the size that a FITS may have. Raises InputError."""
    if raw[:2] != b"\x1f\x8b":
        return raw
    try:
        with gzip.open(io.BytesIO(raw)) as file:
            plain = file.read(MAX_FITS_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise cannot_read(path, "it is a damaged gzip file", wanted) from error
    if len(plain) > MAX_FITS_BYTES:
        raise InputError(f"{path}: unpacks to more than {size_text(MAX_FITS_BYTES)}; {wanted}")
    return plain


def read_truth_csv(path: Path) -> Truth:
    """The stars of a CSV of `hilstar frame --truth`, TRUTH_DTYPE, only `name` and the columns of TRUTH_COLUMNS filled."""
    wanted = "give the CSV that `hilstar frame --truth OUT.csv` writes"
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, wanted, MAX_TRUTH_BYTES), newline="")))
    except csv.Error as error:
        raise cannot_read(path, error, wanted) from error
    truth = np.zeros(len(rows), dtype=TRUTH_DTYPE)
    for line, row in enumerate(rows):
        truth["name"][line] = row.get("name") or ""  # a table of stars alone may have no names
        for name in TRUTH_COLUMNS:
            try:
                truth[name][line] = float(row[name])
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise InputError(f"{path}:{line + 2}: no number in the column {name}; {wanted}") from error
    if not all(np.isfinite(truth[name]).all() for name in TRUTH_COLUMNS):
        raise InputError(f"{path}: a number is NaN or infinite; {wanted}")
    return truth
