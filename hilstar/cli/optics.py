"""hilstar optics: the file of a tracker's glass, from a prescription, a map of images, or a
pupil's aberrations.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import FITS, check_ending
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import (
    check_files,
    json_option,
    output_option,
    parse_numbers,
    parse_resolution,
)
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.optics.glass.psf_file import Glass

RESOLUTION_EXAMPLE = "1024,1024"


def glass_option() -> Any:
    """The option of the file of a tracker's glass."""
    return output_option("PSF.fits", "The file for [tracker.optics] psf.")


def tolerance_option() -> Any:
    """The option of the error of the file's basis."""
    return option(
        "SHARE",
        "Share of a PSF's light that the file's basis may put elsewhere.",
        default=1e-3,
        min=0,
        max=0.1,
    )


def sampling_option() -> Any:
    """The option of the samples of computed PSFs."""
    return option(
        "N",
        "Samples a tracker pixel along each axis; by default as diffraction needs.",
        min=1,
        max=64,
    )


@struct
class MapOptions:
    """The options of `hilstar optics map`."""

    stack: Path = argument("STACK.fits", "Images (n, height, width), the chief ray in the middle.")
    points: Path = argument("POINTS.csv", "x_px,y_px[,wavelength_nm,...] of each image.")
    output: Path = glass_option()
    oversampling: int = option(
        "N", "Samples a tracker pixel along each axis.", default=1, min=1, max=64
    )
    pixel_integrated: bool = switch("The pixel is integrated in the images, as in measured ones.")
    tolerance: float = tolerance_option()
    as_json: bool = json_option()


def map_(options: MapOptions) -> None:
    """Make a tracker's glass of measured or simulated PSF images at field points and
    wavelengths.
    """
    from hilstar.optics.glass.maps import glass_of_map

    check_ending("-o", options.output, FITS)
    check_files([options.stack, options.points], [options.output])
    with busy("finding the basis"):
        glass = glass_of_map(
            options.stack,
            options.points,
            options.oversampling,
            options.pixel_integrated,
            options.tolerance,
        )
    _tell(options.output, glass, options.as_json)


@struct
class ZernikeOptions:
    """The options of `hilstar optics zernike`."""

    pupil: Path = argument("FILE.toml", "Aperture, aberrations, field points, wavelengths, focus.")
    output: Path = glass_option()
    oversampling: int | None = sampling_option()
    tolerance: float = tolerance_option()
    as_json: bool = json_option()


def zernike(options: ZernikeOptions) -> None:
    """Make a tracker's glass of an aperture and Zernike or Seidel coefficients, by diffraction
    (needs hilstar[optics]).
    """
    from hilstar.optics.glass.zernike import glass_of_pupil

    check_ending("-o", options.output, FITS)
    check_files([options.pupil], [options.output])
    with busy("computing the PSFs"):
        glass = glass_of_pupil(options.pupil, options.oversampling, options.tolerance)
    _tell(options.output, glass, options.as_json)


@struct
class LensOptions:
    """The options of `hilstar optics lens`."""

    prescription: Path = argument(
        "PRESCRIPTION", "A lens: .zmx of Zemax, .seq of CODE V, .json of optiland."
    )
    output: Path = glass_option()
    bench: Path | None = option(
        "BENCH.toml", "A bench whose tracker has the pixel pitch and resolution."
    )
    pitch_um: float | None = option(
        "UM", "The tracker's pixel pitch, in place of the bench's.", min=0.1, max=1000
    )
    resolution: str | None = option("W,H", "The tracker's resolution, px, in place of the bench's.")
    focuses_um: str = option(
        "UM[,...]", "Focus positions; positive: farther from the lens.", default="0"
    )
    half_px: int = option("PX", "Half of a stamp's side, px.", default=8, min=1, max=100)
    oversampling: int | None = sampling_option()
    tolerance: float = tolerance_option()
    as_json: bool = json_option()


def lens(options: LensOptions) -> None:
    """Make a tracker's glass of a lens's prescription, by tracing it (needs hilstar[lens]).

    Wavelengths and the field are the prescription's; pixel pitch and resolution those of --bench,
    or as given.
    """
    from hilstar.optics.glass.prescription import Plate, glass_of_prescription
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", options.output, FITS)
    check_files([options.prescription, options.bench], [options.output])
    size_px: tuple[int, int] | None = None
    if options.resolution is not None:
        size_px = parse_resolution(options.resolution, RESOLUTION_EXAMPLE)
    pitch_um = options.pitch_um
    if options.bench is not None:
        tracker = read_bench_file(options.bench).config.tracker
        pitch_um = pitch_um or tracker.pixel_pitch_um
        size_px = size_px or tracker.resolution_px
    if pitch_um is None or size_px is None:
        raise InputError(
            "a lens's PSFs need the tracker's pixels; add --bench BENCH.toml, or --pitch-um and"
            " --resolution W,H"
        )
    count = options.focuses_um.count(",") + 1
    form = "--focuses-um in um, such as -20,0,20"
    focuses_um = parse_numbers(options.focuses_um, count, "--focuses-um", form)
    plate = Plate(size_px, pitch_um, tuple(focuses_um), options.half_px)
    with busy("tracing the lens"):
        glass = glass_of_prescription(
            options.prescription, plate, options.oversampling, options.tolerance
        )
    for note in glass.notes:
        say(f"{options.prescription}: {note}")
    facts = {
        "focal_length_mm": glass.focal_length_mm,
        "f_number": glass.f_number,
        "notes": list(glass.notes),
    }
    _tell(options.output, glass.glass, options.as_json, facts)
    if not options.as_json:
        typer.echo(
            f"in the bench file, under [tracker]: focal_length_mm = {glass.focal_length_mm:.6g}  #"
            f" F/{glass.f_number:.3g}"
        )


def _tell(output: Path, glass: "Glass", as_json: bool, facts: dict[str, Any] | None = None) -> None:
    """Write the file of a tracker's glass, and print what is in it, with `facts` of its source."""
    import numpy as np

    from hilstar.optics.glass.psf_file import write_glass

    write_glass(output, glass)
    wavelengths_nm = []
    colours = "one PSF for all light"
    if np.isfinite(glass.wavelengths_nm[0]):
        wavelengths_nm = glass.wavelengths_nm.tolist()
        colours = f"{len(wavelengths_nm)} wavelengths"
    summary = {
        "points": len(glass.places_px),
        "wavelengths_nm": wavelengths_nm,
        "focuses_um": glass.focuses_um.tolist(),
        "components": len(glass.basis),
        "residual": glass.residual,
        "outside_share": float(glass.outside.max()),
        "relative_illumination": float(glass.illumination.min()),
    }
    summary |= facts or {}
    summary["written"] = [str(output)]
    line = (
        f"{len(glass.places_px)} field points, {colours}, {len(glass.focuses_um)} focus positions:"
        f" {len(glass.basis)} components, which put up to {glass.residual:.1e} of a PSF's light"
        f" elsewhere; wrote {output}"
    )
    print_found(as_json, summary, [line])
