"""Make a map of bright galaxies, globular clusters and nebulae for `[sky.diffuse] map`, from your
copy of OpenNGC.

    curl -LO https://github.com/mattiaverga/OpenNGC/raw/master/database_files/NGC.csv      (and addendum.csv)
    python tools/make_deep_sky.py NGC.csv addendum.csv -o deep_sky.fits.gz [--to 9.0]

OpenNGC is under CC-BY-SA 4.0, and so is the map: `examples/deep_sky.fits.gz`, of OpenNGC's commit
17397545, which is no part of the package. Each object is an image of its own: an ellipse with the
catalogue's axes, position angle and total V (B - 0.7 where that is missing). Galaxies are
exponential discs, ellipticals Sersic profiles of index 4, cut at the catalogue's axes (B = 25
mag/arcsec2). The scale length of a disc is 1 / 3.2 of that radius (Freeman 1970), an elliptical's
effective radius 1 / 3. Globular clusters are discs as well, nebulae even ellipses. Open clusters
are left out, as their stars are in the star catalogue; so are objects without a size or a
magnitude.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

SERSIC_4 = 7.669  # b of index 4: half of the light is within the effective radius
GALAXIES, DISCS, NEBULAE = (
    ("G", "GPair", "GTrpl"),
    ("GCl",),
    ("HII", "Neb", "RfN", "PN", "SNR", "EmN"),
)
# the middle of a profile is the mean of FINER by FINER places
MAX_SIDE_PX, MIN_SIDE_PX, FINER = 65, 33, 5
PX_DEG = 10 / 3600  # finer than a tracker's
BLUER_MAG = 0.7


def profile(row: dict[str, str], radii: np.ndarray) -> np.ndarray:
    """Relative light at radii (n,), 1 at the catalogue's axes."""
    if row["Type"] in NEBULAE:
        light = np.ones_like(radii)
    elif row["Type"] in GALAXIES and row["Hubble"].startswith("E"):
        light = np.exp(-SERSIC_4 * (3 * radii) ** 0.25)
    else:
        light = np.exp(-3.2 * radii)
    return np.where(radii <= 1, light, 0.0)


def image_of(row: dict[str, str], v_mag: float) -> Any:
    """An object as an image with its WCS, whose light sums to its magnitude."""
    major = float(row["MajAx"]) / 60 / 2
    minor = float(row["MinAx"] or row["MajAx"]) / 60 / 2
    side = max(MIN_SIDE_PX, min(MAX_SIDE_PX, 2 * math.ceil(major / PX_DEG) + 3))
    px_deg = 2 * major / (side - 3)
    at = (np.arange(side * FINER) - (side * FINER - 1) / 2) / FINER * px_deg
    north, west = np.meshgrid(at, at, indexing="ij")
    angle = math.radians(float(row["PosAng"] or 0.0))  # from north to east
    along, across = (
        north * math.cos(angle) - west * math.sin(angle),
        north * math.sin(angle) + west * math.cos(angle),
    )
    light = (
        profile(row, np.hypot(along / major, across / minor))
        .reshape(side, FINER, side, FINER)
        .mean(axis=(1, 3))
    )
    square_arcsec = (px_deg * 3600) ** 2
    with np.errstate(divide="ignore"):
        mag_arcsec2 = v_mag - 2.5 * np.log10(light / light.sum() / square_arcsec)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cdelt, wcs.wcs.crpix = (
        ("RA---TAN", "DEC--TAN"),
        [-px_deg, px_deg],
        [(side + 1) / 2] * 2,
    )
    (hours, *ra), (degrees, *dec) = row["RA"].split(":"), row["Dec"].split(":")
    sign = -1 if degrees.startswith("-") else 1
    wcs.wcs.crval = [15 * _sexagesimal(hours, *ra), sign * _sexagesimal(degrees.lstrip("+-"), *dec)]
    header = wcs.to_header()
    header["BUNIT"] = "mag/arcsec2"
    return fits.ImageHDU(
        np.where(light > 0, mag_arcsec2, np.nan).astype(np.float32), header, name=row["Name"]
    )


def _sexagesimal(whole: str, minutes: str, seconds: str) -> float:
    return int(whole) + int(minutes) / 60 + float(seconds) / 3600


def main(catalogues: list[Path], target: Path, faintest_v_mag: float) -> None:
    """Write the map of every object that has a size and a magnitude."""
    primary = fits.PrimaryHDU()
    primary.header["COMMENT"] = (
        "From OpenNGC (github.com/mattiaverga/OpenNGC), CC-BY-SA 4.0; so is this file"
    )
    images = [primary]
    for path in catalogues:
        with path.open(newline="", encoding="utf-8") as lines:
            for row in csv.DictReader(lines, delimiter=";"):
                mag = row["V-Mag"] or (row["B-Mag"] and str(float(row["B-Mag"]) - BLUER_MAG))
                if row["Type"] not in (*GALAXIES, *DISCS, *NEBULAE) or not row["MajAx"] or not mag:
                    continue
                if float(mag) <= faintest_v_mag:
                    images.append(image_of(row, float(mag)))
    fits.HDUList(images).writeto(target, overwrite=True)
    print(
        f"{target}: {len(images) - 1} objects to V = {faintest_v_mag:g}, {target.stat().st_size}"
        " bytes"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("catalogues", type=Path, nargs="+")
    parser.add_argument("-o", type=Path, required=True, dest="target")
    parser.add_argument("--to", type=float, default=9.0, dest="faintest_v_mag")
    main(**vars(parser.parse_args()))
