"""Make configs/planar-1897.fits: the glass of P. Rudolph's double Gauss, US patent 583336 (1897),
example 2.

The prescription is the patent's, scaled to a focal length of 25 mm, with the modern Schott glasses
nearest to its own. It is stopped down to F/6.3, focused where its spots are small, and has an
assumed filter of 480 to 700 nm. Needs
`pip install 'hilstar[lens]'`: `python tools/make_planar.py`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.optics.glass.prescription import Plate, traced
from hilstar.optics.glass.psf_file import write_glass
from hilstar.sky.spectrum import Curve

# Radius of curvature and thickness behind it, mm, and the glass, for 49.389 mm of focal length.
# The second half mirrors the first about the stop.
FRONT = (
    (14.1615, 1.386, "N-BAK1"),
    (69.4080, 0.117, None),
    (16.1955, 2.313, "N-BAK1"),
    (-19.6650, 1.386, "N-BALF4"),
    (8.79300, 2.313, None),
)
BEHIND_MM, FOCUS_MM, SCALE = 42.3517, -0.25, 25 / 49.389
APERTURE_MM, FIELD_DEG = 4.0, 22.0
WAVELENGTHS_NM = (480.0, 580.0, 700.0)
PRIMARY_NM = 580.0
# assumed: the colours that are traced
FILTER = Curve(np.array([479.0, 480.0, 700.0, 701.0]), np.array([0.0, 1.0, 1.0, 0.0]))
PLATE = Plate((1024, 1024), 13.0, half_px=5)
SAMPLES, TOLERANCE = 3, 5e-3


def planar() -> Any:
    """The lens as optiland's."""
    from optiland.optic import Optic

    lens = Optic()
    radii = [radius for radius, _, _ in FRONT]
    gaps = [(thickness, glass) for _, thickness, glass in FRONT]
    # The stop's plane lies between two gaps of air; mirrored surfaces have the gap that was before
    # their image.
    back = [
        (-radius, *gap)
        for radius, gap in zip(
            radii[::-1], [*gaps[-2::-1], (BEHIND_MM + FOCUS_MM, None)], strict=True
        )
    ]
    lens.surfaces.add(index=0, radius=np.inf, thickness=np.inf)
    rows = [*FRONT, (np.inf, 2.313, None), *back]
    for number, (radius, thickness, glass) in enumerate(rows, start=1):
        material = {} if glass is None else {"material": (glass, "schott")}
        lens.surfaces.add(
            index=number,
            radius=SCALE * radius,
            thickness=SCALE * thickness,
            is_stop=number == len(FRONT) + 1,
            **material,
        )
    lens.surfaces.add(index=len(rows) + 1)
    lens.set_aperture(aperture_type="EPD", value=APERTURE_MM)
    lens.fields.set_type(field_type="angle")
    for share in (0.0, 0.7, 1.0):
        lens.fields.add(y=share * FIELD_DEG)
    for nm in WAVELENGTHS_NM:
        lens.wavelengths.add(value=nm / 1e3, is_primary=nm == PRIMARY_NM)
    return lens


def main() -> None:
    """Trace it and write the file."""
    made_by = (
        "tools/make_planar.py: US patent 583336 (P. Rudolph, 1897), example 2, scaled, at F/6.3,"
        " traced by optiland"
    )
    found = traced(planar(), PLATE, SAMPLES, TOLERANCE, made_by)
    path = Path(__file__).parent.parent / "configs" / "planar-1897.fits"
    write_glass(path, replace(found.glass, transmission=FILTER))
    print(
        f"f {found.focal_length_mm:.4f} mm, F/{found.f_number:.3f}, {len(found.glass.basis)}"
        " components"
    )


if __name__ == "__main__":
    main()
