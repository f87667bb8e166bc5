"""Make `pickles.npz` from the Pickles stellar spectral flux library (Pickles 1998, PASP 110, 863).

    pip download --no-deps EXOSIMS==3.6.6
    pip install speclite                              (an environment of its own will do)
    python tools/make_pickles.py exosims-3.6.6-py3-none-any.whl

EXOSIMS (BSD-3) carries 106 of the library's 131 spectra, as STScI's `pickles_uk_*.fits`: every
normal
star of solar abundance from O5 to M9 except M2.5V and M10III; the other 23 are metal-rich or
metal-poor. The
files' SHA-256 is checked. Samples stay where they are, every 0.5 nm, so nothing is rebinned:
float16 is the
only loss, and the script measures it.
"""

from __future__ import annotations

import hashlib
import io
import re
import sys
import zipfile
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.sky.electrons import (
    PACKAGED_LIBRARY,
    Library,
    Optics,
    Photometry,
    band_mean,
    library_electrons_per_s,
)
from hilstar.sky.spectrum import Curve, constant_curve, load_curve

MEMBER = re.compile(r"EXOSIMS/TargetList/dat_uvk/pickles_uk_(\d+)\.fits")
SOURCE_SHA256 = (
    # hash of all members, joined in the library's order
    "4460288203b3cea3fdf93a8f4e13b92b38ba8d3c179f9b688ec49d8fcd0d59c6"
)
SPECTRA = 106
# From the atmosphere's edge to past N-BK7's and silicon's: no tracker of this package sees more.
RANGE_NM = (250.0, 1600.0)
WORST_ROUNDING = 1e-4

# zp(f_lambda) of Bessell, Castelli & Plez 1998 (A&A 333, 231), table A2: Vega has colours 0
# (CALSPEC's
# alpha_lyr_stis_011 gives B-V = -0.008, V-I = 0.000 with them and these passbands).
ZERO_POINT_MAG = {"B": -0.602, "V": 0.000, "I": 1.271}
CHECK_SENSORS = ("ccd47-20", "kai-4021")


def main(source: Path, target: Path = PACKAGED_LIBRARY) -> None:
    """Write `target` from the EXOSIMS wheel at `source`."""
    library, digest = read_wheel(source)
    stored = replace(library, flux=library.flux.astype(np.float16).astype(np.float64))
    exact = check_rates_e_per_s(library)
    worst = float(np.abs(check_rates_e_per_s(stored) / exact - 1).max())
    if not worst < WORST_ROUNDING:
        raise InputError(
            f"{target}: rounding moves a rate by {worst:.1e}, more than {WORST_ROUNDING:g}"
        )
    np.savez_compressed(
        target,
        allow_pickle=False,
        wavelength_nm=library.wavelength_nm.astype(np.float32),
        flux=library.flux.astype(np.float16),
        spectral_type=np.array(library.spectral_type),
        bv_mag=library.bv_mag,
        vi_mag=library.vi_mag,
        check_rates_e_per_s=exact,
        source_sha256=np.array(digest),
    )
    print(
        f"{target}: {len(library.flux)} spectra, {target.stat().st_size} bytes, rounding at most"
        f" {worst:.1e}"
    )


def read_wheel(source: Path) -> tuple[Library, str]:
    """The library at full precision, and the SHA-256 of its files. Raises InputError where they
    are not the known ones.
    """
    with zipfile.ZipFile(source) as wheel:
        members = sorted(
            (int(m[1]), name) for name in wheel.namelist() if (m := MEMBER.fullmatch(name))
        )
        files = [wheel.read(name) for _, name in members]
    digest = hashlib.sha256(b"".join(files)).hexdigest()
    if digest != SOURCE_SHA256 or len(files) != SPECTRA:
        raise InputError(
            f"{source}: {len(files)} spectra, sha256 {digest}; wanted {SPECTRA}, {SOURCE_SHA256}"
        )
    spectra = [read_spectrum(file) for file in files]
    wavelength_nm = spectra[0][1]
    flux = np.array([flux for _, _, flux in spectra])
    unknown = np.zeros(len(flux))
    library = Library(wavelength_nm, flux, tuple(name for name, _, _ in spectra), unknown, unknown)
    mean = {band: band_mean(library, passband(band)) for band in ZERO_POINT_MAG}
    mag = {band: -2.5 * np.log10(mean[band]) - ZERO_POINT_MAG[band] for band in mean}
    flux = flux / mean["V"][:, None]
    return (
        replace(library, flux=flux, bv_mag=mag["B"] - mag["V"], vi_mag=mag["V"] - mag["I"]),
        digest,
    )


def read_spectrum(file: bytes) -> tuple[str, FloatArray, FloatArray]:
    """Spectral type, wavelengths [nm] in RANGE_NM and F_lambda of one `pickles_uk_*.fits`."""
    from astropy.io import fits

    with fits.open(io.BytesIO(file)) as hdus:
        name = hdus[0].header["COMMENT1"].removeprefix("spectral type:").strip()
        wavelength_nm = hdus[1].data["WAVELENGTH"].astype(np.float64) / 10
        flux = hdus[1].data["FLUX"].astype(np.float64)
    inside = (wavelength_nm >= RANGE_NM[0]) & (wavelength_nm <= RANGE_NM[1])
    return name, wavelength_nm[inside], flux[inside]


def passband(band: str) -> Curve:
    """Bessell 1990 B, V or I, an energy response, as speclite's ECSV stores it (angstrom -> nm)."""
    lines = (
        resources.files("speclite")
        .joinpath(f"data/filters/bessell-{band}.ecsv")
        .read_text()
        .splitlines()
    )
    rows = np.array(
        [line.split() for line in lines if line and line[0].isdigit()], dtype=np.float64
    )
    return Curve(rows[:, 0] / 10, rows[:, 1])


def check_rates_e_per_s(library: Library) -> FloatArray:
    """Rates of the library's stars through bare CHECK_SENSORS behind 30 mm, shape (sensors, m)."""
    sensors = [Optics(30.0, load_curve(name, name), constant_curve(1.0)) for name in CHECK_SENSORS]
    return np.array([library_electrons_per_s(library, optics, Photometry()) for optics in sensors])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
