"""hilstar optics: the file of a tracker's glass, from a prescription, a map of images, or a
pupil's aberrations.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import FITS, check_ending
from hilstar.cli.options import Json, check_files, parse_numbers
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.optics.glass.psf_file import Glass

RESOLUTION_FORM = "--resolution W,H in pixels, such as 1024,1024"
Output = Annotated[
    Path, Option("-o", "--output", metavar="PSF.fits", help="The file for [tracker.optics] psf.")
]
Oversampling = Annotated[
    int, Option(metavar="N", help="Samples a tracker pixel along each axis.", min=1, max=64)
]
Tolerance = Annotated[
    float,
    Option(
        metavar="SHARE",
        help="Share of a PSF's light that the file's basis may put elsewhere.",
        min=0,
        max=0.1,
    ),
]


def map_(
    stack: Annotated[
        Path,
        Argument(
            metavar="STACK.fits", help="Images (n, height, width), the chief ray in the middle."
        ),
    ],
    points: Annotated[
        Path, Argument(metavar="POINTS.csv", help="x_px,y_px[,wavelength_nm,...] of each image.")
    ],
    output: Output,
    oversampling: Oversampling = 1,
    pixel_integrated: Annotated[
        bool,
        Option(
            "--pixel-integrated", help="The pixel is integrated in the images, as in measured ones."
        ),
    ] = False,
    tolerance: Tolerance = 1e-3,
    as_json: Json = False,
) -> None:
    """Make a tracker's glass of measured or simulated PSF images at field points and
    wavelengths.
    """
    from hilstar.optics.glass.maps import glass_of_map

    check_ending("-o", output, FITS)
    check_files([stack, points], [output])
    with busy("finding the basis"):
        glass = glass_of_map(stack, points, oversampling, pixel_integrated, tolerance)
    _tell(output, glass, as_json)


def zernike(
    pupil: Annotated[
        Path,
        Argument(
            metavar="FILE.toml", help="Aperture, aberrations, field points, wavelengths, focus."
        ),
    ],
    output: Output,
    oversampling: Annotated[
        int | None,
        Option(
            metavar="N",
            help="Samples a tracker pixel along each axis; by default as diffraction needs.",
            min=1,
            max=64,
        ),
    ] = None,
    tolerance: Tolerance = 1e-3,
    as_json: Json = False,
) -> None:
    """Make a tracker's glass of an aperture and Zernike or Seidel coefficients, by diffraction
    (needs hilstar[optics]).
    """
    from hilstar.optics.glass.zernike import glass_of_pupil

    check_ending("-o", output, FITS)
    check_files([pupil], [output])
    with busy("computing the PSFs"):
        glass = glass_of_pupil(pupil, oversampling, tolerance)
    _tell(output, glass, as_json)


def lens(
    prescription: Annotated[
        Path,
        Argument(
            metavar="PRESCRIPTION", help="A lens: .zmx of Zemax, .seq of CODE V, .json of optiland."
        ),
    ],
    output: Output,
    bench: Annotated[
        Path | None,
        Option(
            metavar="BENCH.toml", help="A bench whose tracker has the pixel pitch and resolution."
        ),
    ] = None,
    pitch_um: Annotated[
        float | None,
        Option(
            "--pitch-um",
            metavar="UM",
            help="The tracker's pixel pitch, in place of the bench's.",
            min=0.1,
            max=1000,
        ),
    ] = None,
    resolution: Annotated[
        str | None,
        Option(metavar="W,H", help="The tracker's resolution, px, in place of the bench's."),
    ] = None,
    focuses_um: Annotated[
        str,
        Option(
            "--focuses-um",
            metavar="UM[,...]",
            help="Focus positions; positive: farther from the lens.",
        ),
    ] = "0",
    half_px: Annotated[
        int, Option("--half-px", metavar="PX", help="Half of a stamp's side, px.", min=1, max=100)
    ] = 8,
    oversampling: Annotated[
        int | None,
        Option(
            metavar="N",
            help="Samples a tracker pixel along each axis; by default as diffraction needs.",
            min=1,
            max=64,
        ),
    ] = None,
    tolerance: Tolerance = 1e-3,
    as_json: Json = False,
) -> None:
    """Make a tracker's glass of a lens's prescription, by tracing it (needs hilstar[lens]).

    Wavelengths and the field are the prescription's; pixel pitch and resolution those of --bench,
    or as given.
    """
    from hilstar.optics.glass.prescription import Plate, glass_of_prescription
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", output, FITS)
    check_files([prescription, bench], [output])
    size: tuple[int, int] | None = None
    if resolution is not None:
        wide, high = parse_numbers(resolution, 2, "--resolution", RESOLUTION_FORM)
        if not (1 <= wide <= 32768 and 1 <= high <= 32768):
            raise InputError(f"--resolution {resolution}: write {RESOLUTION_FORM}")
        size = round(wide), round(high)
    if bench is not None:
        tracker = read_bench_file(bench).config.tracker
        pitch_um = pitch_um or tracker.pixel_pitch_um
        size = size or tracker.resolution_px
    if pitch_um is None or size is None:
        raise InputError(
            "a lens's PSFs need the tracker's pixels; add --bench BENCH.toml, or --pitch-um and"
            " --resolution W,H"
        )
    focuses = parse_numbers(
        focuses_um,
        focuses_um.count(",") + 1,
        "--focuses-um",
        "--focuses-um in um, such as -20,0,20",
    )
    plate = Plate(size, pitch_um, tuple(focuses), half_px)
    with busy("tracing the lens"):
        glass = glass_of_prescription(prescription, plate, oversampling, tolerance)
    for note in glass.notes:
        say(f"{prescription}: {note}")
    facts: dict[str, Any] = {"focal_length_mm": glass.focal_length_mm, "f_number": glass.f_number}
    _tell(output, glass.glass, as_json, {**facts, "notes": list(glass.notes)})
    if not as_json:
        typer.echo(
            f"in the bench file, under [tracker]: focal_length_mm = {glass.focal_length_mm:.6g}  #"
            f" F/{glass.f_number:.3g}"
        )


def _tell(output: Path, glass: "Glass", as_json: bool, more: dict[str, Any] | None = None) -> None:
    import numpy as np

    from hilstar.optics.glass.psf_file import write_glass

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
        **(more or {}),
        "written": [str(output)],
    }
    if known:
        colours = f"{len(glass.wavelengths_nm)} wavelengths"
    else:
        colours = "one PSF for all light"
    line = (
        f"{len(glass.places_px)} field points, {colours}, {len(glass.focuses_um)} focus positions:"
        f" {len(glass.basis)}"
    )
    off = f"components, which put up to {glass.residual:.1e} of a PSF's light elsewhere"
    print_found(as_json, facts, [f"{line} {off}; wrote {output}"])
