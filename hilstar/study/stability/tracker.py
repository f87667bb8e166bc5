"""Where methods fail in the virtual tracker: a great deal of light, none, no exposure, and NaN."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import read_bench_file
from hilstar.errors import InputError
from hilstar.rotation import from_radec_roll_deg
from hilstar.study.shared.bench_text import Table, bench_text
from hilstar.study.stability.failure_case import FailureCase, Figures
from hilstar.tracker.centroids import find_stars
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from hilstar.twin.simulator import Simulator

SEED = 1
SIZE_PX = (64, 64)
BILLION_E = 1e9
GAIN_E_PER_DN = 2e4  # 1e9 electrons are 50 000 DN of 16 bits
STANDARD_ERRORS = 5.0  # a correct figure exceeds this once in two million runs; the seeds are fixed
HALF_DN = 0.5  # an ADC's rounding
NOTHING = 0.0


def standard_errors(sample: FloatArray, mean: float, sigma: float) -> float:
    """The error of a sample's mean or sigma against a normal law's, whichever is larger, in standard errors."""
    n = sample.size
    return float(max(abs(sample.mean() - mean) / (sigma / n**0.5), abs(sample.std() - sigma) / (sigma / (2 * n) ** 0.5)))


def by_product(mean: float, count: int, rng: np.random.Generator) -> FloatArray:
    """Poisson counts (count,) by Knuth's product of uniform numbers, which stops at exp(-mean)."""
    left = np.cumprod(rng.random((count, 2000)), axis=1)
    return np.asarray((left > np.exp(-mean)).sum(axis=1), dtype=np.float64)


def billion_electrons() -> FailureCase:
    """1e9 electrons in each pixel of a deep well."""
    deep = Detector(DetectorSettings(gain_e_per_dn=GAIN_E_PER_DN, full_well_e=1e12, bits=16), SIZE_PX)
    dn = deep.expose(np.full(SIZE_PX, BILLION_E), 1.0, np.random.default_rng(SEED))
    drawn_e = dn.astype(np.float64) * GAIN_E_PER_DN
    product_e = by_product(BILLION_E, drawn_e.size, np.random.default_rng(SEED))
    sigma_e = float(np.hypot(np.sqrt(BILLION_E), GAIN_E_PER_DN / np.sqrt(12)))
    error, fault = (standard_errors(sample, BILLION_E, sigma_e) for sample in (drawn_e, product_e))
    return FailureCase(
        "1e9 electrons in a pixel",
        "Poisson by a product of uniform numbers",
        f"exp(-1e9) is 0: mean {product_e.mean():.0f} electrons",
        f"mean {drawn_e.mean():.7g} and sigma {drawn_e.std():.0f}, {error:.1f} standard errors off",
        "drawn by transformed rejection; more than 1e12 are refused",
        Figures(error, fault, STANDARD_ERRORS),
    )


def full_well() -> FailureCase:
    """1e9 electrons in each pixel of a CCD47-20."""
    settings = DetectorSettings()
    dn = Detector(settings, SIZE_PX).expose(np.full(SIZE_PX, BILLION_E), 1.0, np.random.default_rng(SEED))
    wanted = settings.full_well_e / settings.gain_e_per_dn
    wrapped = np.rint(np.full(SIZE_PX, BILLION_E) / settings.gain_e_per_dn).astype(np.int64).astype(np.uint16)
    error, fault = (float(np.abs(shown - wanted).max()) for shown in (dn, wrapped))
    return FailureCase(
        "a full well",
        "electrons / gain as uint16",
        f"wraps round to {wrapped[0, 0]} DN",
        f"{dn.max()} DN = {settings.full_well_e:g} e- / {settings.gain_e_per_dn:g}",
        "charge is clipped at the full well, then codes at the largest one",
        Figures(error, fault, HALF_DN),
    )


def simulated_dn(exposure_s: float, background_e: float, faintest_v_mag: float) -> tuple[FloatArray, int]:
    """Orion on a small detector, DN (256, 256), and how many stars are in it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        tables: dict[str, Table] = {
            "tracker": {"resolution_px": (256, 256), "exposure_s": exposure_s},
            "tracker.detector": {"offset_dn": 100, "read_noise_e": 48},
            "monitor": {"resolution_px": (256, 256), "pixel_pitch_um": 13},
            "collimator": {"focal_length_mm": 70},
            "background": {"electrons_per_px": background_e},
            "sky": {"faintest_v_mag": faintest_v_mag},
        }
        path.write_text(bench_text(tables))
        with Simulator(read_bench_file(path)) as simulator:
            motion = simulator.motion(from_radec_roll_deg(84.057, -1.2, 0.0), np.zeros(3))
            exposure = simulator.expose(motion, np.random.default_rng(SEED))
    return exposure.dn.astype(np.float64), len(exposure.truth)


def empty_field() -> FailureCase:
    """No star in view."""
    dn, stars = simulated_dn(0.1, 2400.0, faintest_v_mag=-1.4)
    nothing = np.zeros_like(dn)
    with np.errstate(invalid="ignore"):
        scaled = nothing / nothing.max()
    # 2400 electrons and an offset of 100: 200 DN; their shot noise, 48 e- read noise and the rounding.
    sigma_dn = float(np.sqrt((2400 + 48**2) / 24**2 + 1 / 12))
    error = standard_errors(dn, 200.0, sigma_dn)
    return FailureCase(
        "an empty field",
        "light / its brightest pixel",
        f"NaN in {int(np.isnan(scaled).sum())} pixels",
        f"{stars} stars, mean {dn.mean():.2f} DN for 2400 e- and an offset of 100, {error:.1f} standard errors off",
        "nothing is scaled to a frame's own light",
        Figures(error, standard_errors(scaled, 200.0, sigma_dn), STANDARD_ERRORS),
    )


def no_exposure() -> FailureCase:
    """An exposure of 0 s."""
    dn, stars = simulated_dn(0.0, 0.0, faintest_v_mag=7.5)
    with np.errstate(invalid="ignore"):
        rate = np.zeros_like(dn) / 0.0
    sigma_dn = float(np.sqrt((48 / 24) ** 2 + 1 / 12))
    error = standard_errors(dn, 100.0, sigma_dn)
    return FailureCase(
        "exposure 0 s",
        "electrons / exposure",
        f"NaN in {int(np.isnan(rate).sum())} pixels",
        f"{stars} stars in view, no electrons: mean {dn.mean():.2f} DN, sigma {dn.std():.2f}, {error:.1f} standard errors off",
        "rates are multiplied by the exposure; bias and read noise remain",
        Figures(error, standard_errors(rate, 100.0, sigma_dn), STANDARD_ERRORS),
    )


def nan_pixel() -> FailureCase:
    """One pixel that is NaN."""
    image = np.zeros(SIZE_PX)
    image[30:33, 30:33] = 1000.0
    image[5, 5] = np.nan
    centre = float(image.sum(axis=0) @ np.arange(SIZE_PX[0]) / image.sum())
    lines, taken = [], 0
    for road in (
        find_stars,
        lambda light: Detector(DetectorSettings(), SIZE_PX).expose(light, 1.0, np.random.default_rng(SEED)),
    ):
        try:
            road(image)
            taken += 1
        except InputError as refusal:
            lines.append(str(refusal))
    return FailureCase(
        "a pixel that is NaN",
        "the centre of gravity of the image",
        f"{centre:g} for one pixel of {image.size}",
        "refused: " + " | ".join(lines),
        "one NaN makes every sum NaN",
        Figures(float(taken), float(np.isnan(centre)), NOTHING),
    )
