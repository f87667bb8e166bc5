"""GalSim (BSD-3): PSFs in pixels, places by a FITS header, electrons of spectra, whole exposures,
and noise.

GalSim draws by Fourier transforms of its own, reads SIP by its own code, integrates spectra by its
own tables, and has Poisson numbers of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import galsim
import numpy as np
from astropy.io import fits
from scipy.stats import ks_2samp

import hilstar
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import two_digits
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.glass import zernike
from hilstar.optics.glass.zernike import Pupil, Term, diffracted
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.frame_files import world_coordinates
from hilstar.sky.electrons import VEGA_V0_W_M2_M, Optics, Photometry, dgs_electrons_per_s
from hilstar.sky.spectrum import blackbody_exitance_w_m2_m, load_curve
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import bench_tables
from tests.support.beside.steps import Beside, Step

GAUSSIAN, LIGHT = "PSF: Gaussian in pixels", "light: electrons of V = 0"
SIGMA_PX, STARS, STAMP_PX = 0.55, 200, 33
TIGHT = galsim.GSParams(
    folding_threshold=1e-7,
    maxk_threshold=1e-9,
    kvalue_accuracy=1e-12,
    xvalue_accuracy=1e-12,
    realspace_relerr=1e-12,
    realspace_abserr=1e-14,
    stepk_minimum_hlr=30,
)
RADEC_ROLL_DEG = (84.057, -1.2, 20.0)
BENCH = bench_tables({"tracker": {"psf_sigma_px": [SIGMA_PX, SIGMA_PX], "exposure_s": 0.1}})
# k1 to k3, and p1 and p2, of a strong lens: 6 px at the corner of 1024 x 1024
RADIAL, TANGENTIAL = (-0.5, 0.3, 0.0), (4e-4, -3e-4)
TEMPERATURES_K = (3000.0, 4500.0, 5772.0, 9602.0, 20_000.0)
ZERNIKES_NM = {4: 50.0, 5: 40.0, 6: -30.0, 7: 35.0, 8: -45.0, 9: 20.0, 10: 25.0, 11: 40.0}
PER_PX, HALF_PX, PUPIL_NM = 8, 4, 550.0
NOISE = DetectorSettings(gain_e_per_dn=4.0, read_noise_e=12.0, full_well_e=60_000.0, bits=14)
LEVELS_E = (10.0, 100.0, 1000.0, 10_000.0)


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Everything that GalSim can be held beside, in two minutes; `quick`: in a quarter of one."""
    rng = np.random.default_rng(58)
    steps = (*psf_steps(rng), *aberrated_steps(quick), *place_steps(rng), *light_steps())
    steps = (*steps, *exposure_steps(quick), *noise_steps(rng))
    beside = Beside("GalSim", galsim.__version__, "", steps)
    share = two_digits(beside.size(GAUSSIAN, "with GalSim's"))
    electrons = two_digits(beside.size(LIGHT, "and the zero point"))
    finding = (
        f"with GalSim's transforms as fine, a star's pixels agree to {share} of its light, and"
        f" electrons to {electrons} with one zero point"
    )
    return replace(beside, finding=finding)


def gaussian_stamps(x_px: FloatArray, y_px: FloatArray, parameters: Any) -> FloatArray:
    """GalSim's pixels (n, STAMP_PX, STAMP_PX) of stars of 1 electron off the middle."""
    profile = galsim.Gaussian(sigma=SIGMA_PX, gsparams=parameters)
    stamps = []
    for x, y in zip(x_px, y_px, strict=True):
        image = galsim.ImageD(STAMP_PX, STAMP_PX)
        profile.drawImage(image, scale=1.0, offset=(x, y))
        stamps.append(image.array.copy())
    return np.array(stamps)


def psf_steps(rng: np.random.Generator) -> Iterator[Step]:
    """A Gaussian in pixels, at places within a pixel, as the shaders draw it."""
    at = rng.uniform(-0.5, 0.5, (2, STARS))
    rates = np.ones(STARS, dtype=np.float32)
    psf = GaussianPsf((SIGMA_PX, SIGMA_PX))
    drawn = np.moveaxis(
        psf.drawn_stamps(at.astype(np.float32), rates, STAMP_PX, psf.footprint_px), 2, 0
    )
    exact = psf.shares(*_offsets(at))
    plain = gaussian_stamps(at[0], at[1], galsim.GSParams())
    fine = gaussian_stamps(at[0], at[1], TIGHT)
    subject, unit = GAUSSIAN, "share of a star's light"
    yield Step(subject, unit, "as both come", float(np.abs(drawn - plain).max()))
    yield Step(subject, unit, "with GalSim's GSParams tight", float(np.abs(drawn - fine).max()))
    yield Step(subject, unit, "and hilstar's float64", float(np.abs(exact - fine).max()))
    middle = np.arange(STAMP_PX) - STAMP_PX // 2
    subject, unit = "PSF: centroid in pixels", "px"
    for step, other in (("as both come", plain), ("with GalSim's GSParams tight", fine)):
        apart = (drawn - other).sum(axis=1) @ middle
        yield Step(subject, unit, step, float(np.abs(apart).max()))


def _offsets(at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets (n, STAMP_PX, STAMP_PX) of pixels' centres from the stars."""
    grid = np.arange(STAMP_PX) - STAMP_PX // 2
    x_px = grid[None, None, :] - at[0][:, None, None] + np.zeros((1, STAMP_PX, 1))
    y_px = grid[None, :, None] - at[1][:, None, None] + np.zeros((1, 1, STAMP_PX))
    return x_px, y_px


def aberrated_steps(quick: bool) -> Iterator[Step]:
    """A pupil with an obstruction and eight Zernike terms by Noll's index.

    GalSim's y is up and hilstar's down: both turn the image, so the samples are compared as they
    come.
    """
    terms = tuple(Term(kind="zernike", noll=noll, nm=nm) for noll, nm in ZERNIKES_NM.items())
    pupil = Pupil(
        aperture_mm=30.0,
        focal_length_mm=60.0,
        pixel_pitch_um=5.0,
        resolution_px=(512, 512),
        wavelengths_nm=(PUPIL_NM,),
        points=1,
        half_px=HALF_PX,
        obstruction=0.3,
        terms=terms,
    )
    image = diffracted(pupil, PER_PX).images[0]
    settings = [("as both come", 1.5, 4.0), ("with GalSim's oversampling at 4", 4.0, 4.0)]
    if not quick:
        settings.append(("and its pad_factor at 8", 4.0, 8.0))
    subject, unit = "PSF: eight aberrations", "of the peak"
    for step, oversampling, padding in settings:
        other = _aberrated(oversampling, padding)
        yield Step(subject, unit, step, _apart(image, other))
    if not quick:
        with patch.object(zernike, "PUPIL", 4 * zernike.PUPIL):
            fine = diffracted(pupil, PER_PX).images[0]
        yield Step(subject, unit, "and hilstar's pupil 4 times as fine", _apart(fine, other))


def _apart(image: FloatArray, other: FloatArray) -> float:
    return float(np.abs(image / image.max() - other / other.max()).max())


def _aberrated(oversampling: float, padding: float) -> FloatArray:
    """GalSim's samples of the same pupil."""
    aberrations = np.zeros(12)
    for noll, nm in ZERNIKES_NM.items():
        aberrations[noll] = nm / PUPIL_NM
    psf = galsim.OpticalPSF(
        lam_over_diam=PUPIL_NM * 1e-3 * 60.0 / 30.0 / 5.0,
        aberrations=aberrations,
        obscuration=0.3,
        oversampling=oversampling,
        pad_factor=padding,
        suppress_warning=True,
    )
    side = 2 * HALF_PX * PER_PX + 1
    image = psf.drawImage(nx=side, ny=side, scale=1 / PER_PX, method="no_pixel", dtype=float)
    return np.asarray(image.array)


def place_steps(rng: np.random.Generator) -> Iterator[Step]:
    """Directions to pixels by the header that hilstar writes, which GalSim reads by itself."""
    q = from_radec_roll_deg(*RADEC_ROLL_DEG)
    ideal = Camera((1024, 1024), 70 / 13e-3, (511.5, 511.5), np.eye(3))
    bent = replace(ideal, lens=Lens(RADIAL, TANGENTIAL))
    x_px, y_px = rng.uniform(-0.5, 1023.5, (2, STARS))
    for subject, camera in (("places: pinhole", ideal), ("places: SIP of a lens", bent)):
        header = fits.Header(world_coordinates(camera, q))
        directions = camera.rays(x_px, y_px) @ to_matrix(q)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        ra = np.arctan2(directions[:, 1], directions[:, 0])
        dec = np.arcsin(directions[:, 2])
        wcs = galsim.GSFitsWCS(header=galsim.FitsHeader(header))
        theirs = np.array(wcs.radecToxy(ra, dec, galsim.radians)) - 1  # from 1 in FITS
        apart = np.hypot(theirs[0] - x_px, theirs[1] - y_px).max()
        yield Step(subject, "px", "largest of 200 stars", float(apart))
        if camera.lens is not None:
            stated = float(header["LENSERR"])
            yield Step(subject, "px", "the header's own LENSERR", stated)


def light_steps() -> Iterator[Step]:
    """Electrons per second of black bodies of V = 0 through a quantum efficiency and glass."""
    qe = load_curve("ccd47-20", "ccd47-20")
    glass = load_curve("n-bk7-10mm", "n-bk7-10mm")
    optics = Optics(30.0, qe, glass)
    ours = np.array([dgs_electrons_per_s(k, optics, Photometry()) for k in TEMPERATURES_K])
    johnson = load_curve("johnson-v", "johnson-v")
    nm = np.arange(optics.range_nm[0], optics.range_nm[1] + 0.25, 0.5)
    detected = galsim.Bandpass(galsim.LookupTable(nm, qe(nm) * glass(nm), "linear"), "nm")
    v_nm = johnson.wavelength_nm
    photons = galsim.Bandpass(galsim.LookupTable(v_nm, johnson.value, "linear"), "nm")
    fine_nm = np.arange(v_nm[0], v_nm[-1] + 0.25, 0.5)
    energy_value = johnson(fine_nm) / fine_nm * 550.0
    energy = galsim.Bandpass(galsim.LookupTable(fine_nm, energy_value, "linear"), "nm")
    zero = _flat(VEGA_V0_W_M2_M)
    subject, unit = LIGHT, "relative"
    for step, band in (
        ("GalSim's Vega, V a photon's response", photons.withZeropoint("Vega")),
        ("V an energy response", energy.withZeropoint("Vega")),
        ("and the zero point of Bessell 1998", energy.withZeropoint(zero)),
    ):
        theirs = np.array([_electrons(k, band, detected, optics) for k in TEMPERATURES_K])
        yield Step(subject, unit, step, float(np.abs(theirs / ours - 1).max()))


def _flat(w_m2_m: float) -> Any:
    """A spectrum of one F_lambda, W/m2/m: its mean through V by energy is that."""
    erg_s_cm2_nm = w_m2_m * 1e-6
    return galsim.SED(lambda nm: erg_s_cm2_nm + 0 * nm, "nm", "flambda")


def _electrons(kelvin: float, band: Any, detected: Any, optics: Optics) -> float:
    nm = np.arange(250.0, 1200.5, 0.5)
    table = galsim.LookupTable(nm, blackbody_exitance_w_m2_m(nm, kelvin), "spline")
    spectrum = galsim.SED(table, "nm", "flambda").withMagnitude(0.0, band)
    return float(spectrum.calculateFlux(detected) * optics.area_m2 * 1e4)


def exposure_steps(quick: bool) -> Iterator[Step]:
    """The mean electrons of a whole exposure, star by star at the truth's places."""
    with hilstar.load(BENCH) as bench:
        exposure = bench.simulate(from_radec_roll_deg(*RADEC_ROLL_DEG), noise="none")
    settings = [("as both come", galsim.GSParams()), ("with GalSim's GSParams tight", TIGHT)]
    for step, parameters in settings[quick:]:
        image = galsim.ImageD(1024, 1024)
        for row in exposure.truth:
            add_star(image, row, parameters)
        apart = np.abs(exposure.mean_e - image.array).max() / exposure.mean_e.max()
        yield Step("exposure: 1024 x 1024 px", "of the brightest pixel", step, float(apart))


def add_star(image: Any, row: Any, parameters: Any) -> None:
    """Draw a row of the truth on GalSim's image; its pixels count from 1."""
    at = galsim.PositionD(float(row["x_px"]) + 1, float(row["y_px"]) + 1)
    near = galsim.PositionI(round(at.x), round(at.y))
    box = galsim.BoundsI(near).withBorder(STAMP_PX // 2)
    profile = galsim.Gaussian(sigma=SIGMA_PX, gsparams=parameters)
    stamp = galsim.ImageD(box)
    (profile * float(row["electrons_per_s"] * 0.1)).drawImage(stamp, scale=1.0, center=at)
    seen = box & image.bounds
    if seen.isDefined():
        image[seen] += stamp[seen]


def noise_steps(rng: np.random.Generator) -> Iterator[Step]:
    """Variance of DN by level, and the whole distribution of a noisy image, both rounded to DN."""
    side = 1000
    mean_e = np.repeat(np.array(LEVELS_E), side * side // len(LEVELS_E)).reshape(side, side)
    ours = Detector(NOISE, (side, side)).expose(mean_e, 1.0, rng).astype(np.float64)
    image = galsim.ImageD(mean_e / NOISE.gain_e_per_dn)
    noise = galsim.CCDNoise(
        galsim.BaseDeviate(58), gain=NOISE.gain_e_per_dn, read_noise=NOISE.read_noise_e
    )
    image.addNoise(noise)
    raw = image.array.copy()
    clipped = np.clip(raw, 0, None)
    counted = np.clip(np.rint(raw), 0, None)
    subject, unit = "noise: variance of DN", "relative"
    for step, theirs in (
        ("GalSim's image as it comes", raw),
        ("clipped at 0, as an ADC does", clipped),
        ("and rounded", counted),
    ):
        ratios = []
        for level in LEVELS_E:
            here = mean_e == level
            ratios.append(ours[here].var() / theirs[here].var())
        yield Step(subject, unit, step, float(np.abs(np.array(ratios) - 1).max()))
    error = np.sqrt(4 / (mean_e.size / len(LEVELS_E)))
    yield Step(subject, unit, "one sigma of such a ratio", float(error))
    subject, unit = "noise: distribution of DN", "largest step between both"
    for step, theirs in (("clipped at 0", clipped), ("and rounded", counted)):
        distance = ks_2samp(ours.ravel(), theirs.ravel()).statistic
        yield Step(subject, unit, step, float(distance))
    chance = 1.36 * np.sqrt(2 / mean_e.size)
    yield Step(subject, unit, "by chance, 95 %", float(chance))
