"""hilstar optics: the file of a tracker's glass, from a map of images, or from a pupil's aberrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilstar.cli.options import Json, check_files
from hilstar.console.terminal import print_json
from hilstar.files import FITS, check_ending

if TYPE_CHECKING:
    from hilstar.optics.psf_file import Glass

Output = Annotated[Path, typer.Option("-o", "--output", metavar="PSF.fits", help="The file for [tracker.optics] psf.")]
Oversampling = Annotated[int, typer.Option(help="Samples a tracker pixel along each axis.", min=1, max=64)]
Tolerance = Annotated[
    float, typer.Option(help="Share of a PSF's light that the file's basis may put elsewhere.", min=0, max=0.1)
]


def map_(
    stack: Annotated[
        Path, typer.Argument(metavar="STACK.fits", help="Images (n, height, width), the chief ray in the middle.")
    ],
    points: Annotated[Path, typer.Argument(metavar="POINTS.csv", help="x_px,y_px[,wavelength_nm,...] of each image.")],
    output: Output,
    oversampling: Oversampling = 1,
    pixel_integrated: Annotated[
        bool, typer.Option("--pixel-integrated", help="The pixel is integrated in the images, as in measured ones.")
    ] = False,
    tolerance: Tolerance = 1e-3,
    as_json: Json = False,
) -> None:
    """Make a tracker's glass of measured or simulated PSF images at field points and wavelengths."""
    from hilstar.optics.maps import glass_of_map

    check_ending("-o", output, FITS)
    check_files([stack, points], [output])
    _tell(output, glass_of_map(stack, points, oversampling, pixel_integrated, tolerance), as_json)


def zernike(
    pupil: Annotated[
        Path, typer.Argument(metavar="FILE.toml", help="Aperture, aberrations, field points, wavelengths, focus.")
    ],
    output: Output,
    oversampling: Annotated[
        int | None,
        typer.Option(help="Samples a tracker pixel along each axis; by default as diffraction needs.", min=1, max=64),
    ] = None,
    tolerance: Tolerance = 1e-3,
    as_json: Json = False,
) -> None:
    """Make a tracker's glass of an aperture and Zernike or Seidel coefficients, by diffraction (needs hilstar[optics])."""
    from hilstar.optics.zernike import glass_of_pupil

    check_ending("-o", output, FITS)
    check_files([pupil], [output])
    _tell(output, glass_of_pupil(pupil, oversampling, tolerance), as_json)


def _tell(output: Path, glass: Glass, as_json: bool) -> None:
    """Write a glass and say what it holds."""
    import numpy as np

    from hilstar.optics.psf_file import write_glass

    write_glass(output, glass)
    known = bool(np.isfinite(glass.wavelengths_nm[0]))
    facts = {
        "points": len(glass.places_px),
        "wavelengths_nm": glass.wavelengths_nm.tolist() if known else [],
        "focuses_um": glass.focuses_um.tolist(),
        "components": len(glass.basis),
        "residual": glass.residual,
        "outside_share": float(glass.outside.max()),
        "relative_illumination": float(glass.illumination.min()),
        "written": [str(output)],
    }
    if as_json:
        print_json(facts)
        return
    colours = f"{len(glass.wavelengths_nm)} wavelengths" if known else "one PSF for all light"
    typer.echo(
        f"{len(glass.places_px)} field points, {colours}, {len(glass.focuses_um)} focus positions: {len(glass.basis)} "
        f"components, which put up to {glass.residual:.1e} of a PSF's light elsewhere; wrote {output}"
    )
