"""Make the tables of the air over observatories, `extinction.csv` and `night_sky.csv`, from
Astropy's and desihub's tables.

    git clone https://github.com/astropy/specreduce-data
    python tools/make_air.py specreduce-data/specreduce_data/reference_data/extinction
    uves_paranal_sky_1nm.csv

Extinction: of Astropy's specreduce-data (BSD-3-Clause, commit dcba1c6), whose README names the
sources: CTIO Stone & Baldwin 1983, KPNO of IRAF, La Palma ING technical note 31, Mauna Kea Buton et
al. 2013, Lick its observatory's means, Paranal Patat et al. 2011 (scattering alone). Every 10 nm
from 300 to 1100 nm; beyond a table its end holds.

Night sky: Hanuschik 2003 (A&A 407, 1157), the UVES atlas as desihub/specter (BSD-3-Clause, commit
b8490d3) has stitched it, in means of 1 nm, in W per wavelength: the shape alone, over its largest
value.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

DATA = Path(__file__).resolve().parents[1] / "hilstar" / "sky" / "data"
NAMES = {
    "ctio": "ctio",
    "kpno": "kpno",
    "la-palma": "lapalma",
    "lick": "mtham",
    "mauna-kea": "mko",
    "paranal": "paranal",
}
GRID_NM = np.arange(300, 1101, 10)


def main(folder: Path, sky: Path) -> None:
    """Write both tables."""
    columns = []
    for name in NAMES.values():
        angstrom, mag = np.loadtxt(
            folder / f"{name}extinct.dat", comments="#", unpack=True, usecols=(0, 1)
        )
        columns.append(np.interp(GRID_NM, angstrom / 10, mag))
    head = (
        "# Extinction, mag an air mass: astropy/specreduce-data@dcba1c6, BSD-3-Clause; made by"
        " tools/make_air.py\n"
    )
    table = np.column_stack(columns)
    rows = "".join(
        f"{nm},{','.join(f'{mag:.4g}' for mag in row)}\n"
        for nm, row in zip(GRID_NM, table, strict=True)
    )
    (DATA / "extinction.csv").write_text(f"{head}wavelength_nm,{','.join(NAMES)}\n{rows}")
    nm, flux = np.loadtxt(sky, comments=("#", "w"), delimiter=",", unpack=True)
    head = (
        "# Night sky, relative F_lambda: Hanuschik 2003, desihub/specter@b8490d3, BSD-3-Clause;"
        " made by tools/make_air.py\n"
    )
    rows = "".join(
        f"{at:g},{value:.3g}\n"
        for at, value in zip(nm, np.maximum(flux, 0) / flux.max(), strict=True)
    )
    (DATA / "night_sky.csv").write_text(f"{head}wavelength_nm,value\n{rows}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
