"""Pyxel (ESA, MIT): photon transfer, read noise, PRNU, ADC and dark current of its detector.

Pyxel asks for an Astropy of its own, so that it runs in an environment of its own: the
environment's PYXEL is that one's Python.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import two_digits
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import BOLTZMANN_EV_PER_K, DetectorSettings
from tests.support.beside.own_python import images_by
from tests.support.beside.steps import Beside, Step

SCRIPT = Path(__file__).with_name("pyxel_run.py")
SCENARIO: dict[str, Any] = {
    "bits": 12,
    "full_well_e": 15_000,
    "gain_e_per_dn": 4.0,
    "side_px": 500,
    "pitch_um": 13.0,
    "read_noise_e": 12.0,
    "device_seed": 58,
    "levels_e": [200.0, 1000.0, 4000.0, 12_000.0],
    "prnu_level_e": 4000.0,
    "prnu": 0.02,
    "frames": 16,
    "dark_na_cm2": 0.1,
    "temperatures_k": [300.0, 293.0, 263.0, 233.0],
}
# Silicon's gap in Pyxel (Varshni 1967): eV at 0 K, eV/K and K.
PYXEL_GAP = (1.1557, 7.021e-4, 1108.0)
VARIANCE, PRNU = "photon transfer: variance", "PRNU of 2 %"
SECONDS = 1.0


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Run Pyxel's chain and hilstar's on the same levels. Raises MachineError without Pyxel."""
    images = images_by("Pyxel", "pyxel-sim", SCRIPT, SCENARIO, folder)
    steps = (*transfer_steps(images), *prnu_steps(images), *dark_steps(images))
    version = str(images["version"])
    beside = Beside("Pyxel", version, "", steps)
    variance = two_digits(100 * beside.size(VARIANCE, "as both come"))
    finding = (
        f"Pyxel's photon transfer is hilstar's within {variance} %, and its fixed pattern noise"
        " doubles the light"
    )
    return Beside("Pyxel", version, finding, steps)


def settings(**keys: Any) -> DetectorSettings:
    """The scenario's detector."""
    return DetectorSettings(
        gain_e_per_dn=SCENARIO["gain_e_per_dn"],
        full_well_e=float(SCENARIO["full_well_e"]),
        bits=SCENARIO["bits"],
        read_noise_e=SCENARIO["read_noise_e"],
        device_seed=SCENARIO["device_seed"],
        **keys,
    )


def exposed(detector: Detector, level_e: float, rng: np.random.Generator) -> FloatArray:
    """One exposure of an even light, DN."""
    mean_e = np.full(detector.shape, level_e)
    return detector.expose(mean_e, SECONDS, rng).astype(np.float64)


def transfer_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """Means and variances of differences of two exposures, by level."""
    side = SCENARIO["side_px"]
    detector = Detector(settings(), (side, side))
    rng = np.random.default_rng(58)
    means = []
    ratios = []
    for number, level_e in enumerate(SCENARIO["levels_e"]):
        ours = [exposed(detector, level_e, rng) for _ in range(2)]
        theirs = images[f"level_{number}"]
        means.append(np.mean(ours) - theirs.mean())
        ratios.append(np.var(ours[0] - ours[1]) / np.var(theirs[0] - theirs[1]))
    subject, unit = "photon transfer: mean", "DN, largest"
    yield Step(subject, unit, "as both come: Pyxel's ADC cuts off", float(np.abs(means).max()))
    rounded = np.array(means) - 0.5
    yield Step(subject, unit, "half a DN for that", float(np.abs(rounded).max()))
    largest_e = max(SCENARIO["levels_e"])
    sigma_dn = np.sqrt(largest_e) / SCENARIO["gain_e_per_dn"] / side
    yield Step(subject, unit, "one sigma of such a difference", float(sigma_dn))
    yield Step(VARIANCE, "relative", "as both come", float(np.abs(np.array(ratios) - 1).max()))
    sigma = 2 / side
    yield Step(VARIANCE, "relative", "one sigma of such a ratio", float(sigma))


def prnu_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """The light and the scatter of a flat field's mean over pixels, with noise taken out."""
    side, level_e = SCENARIO["side_px"], SCENARIO["prnu_level_e"]
    detector = Detector(settings(prnu=SCENARIO["prnu"]), (side, side))
    rng = np.random.default_rng(59)
    frames = [exposed(detector, level_e, rng) for _ in range(SCENARIO["frames"])]
    ours = np.mean(frames, axis=0)
    theirs = images["prnu"] + 0.5
    light = theirs.mean() / ours.mean()
    unit = "relative"
    yield Step(PRNU, unit, "light as both come: Pyxel's gain is 1 + log-normal", abs(light - 1))
    yield Step(PRNU, unit, "light, Pyxel's halved", abs(light / 2 - 1))
    scatters = []
    # Pyxel multiplies after the shot noise, which doubles with the light.
    for image, factor in ((ours, 1.0), (theirs, 2.0)):
        noise_e2 = factor**2 * level_e + SCENARIO["read_noise_e"] ** 2
        noise_dn2 = noise_e2 / SCENARIO["gain_e_per_dn"] ** 2 / SCENARIO["frames"]
        scatters.append(np.sqrt(image.var() - noise_dn2) / image.mean())
    ratio = scatters[1] / scatters[0]
    yield Step(PRNU, unit, "scatter as both come: half of 2 %", abs(ratio - 1))
    yield Step(PRNU, unit, "scatter to Pyxel's doubled light", abs(2 * ratio - 1))


def dark_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """Dark current by temperature, relative to 293 K."""
    kelvins = SCENARIO["temperatures_k"]
    theirs = images["dark"] / images["dark"][kelvins.index(293.0)]
    arrhenius = [settings(dark_e_per_s=1.0, temperature_k=kelvin).dark_factor for kelvin in kelvins]
    depletion = [
        settings(dark_e_per_s=1.0, temperature_k=kelvin, dark_law="diffusion-depletion").dark_factor
        for kelvin in kelvins
    ]
    zero_ev, slope, offset_k = PYXEL_GAP
    kelvin = np.array(kelvins)
    gap_ev = zero_ev - slope * kelvin**2 / (kelvin + offset_k)
    exponent = -gap_ev / (2 * BOLTZMANN_EV_PER_K * kelvin)
    law = kelvin**1.5 * np.exp(exponent)
    subject, unit = "dark current, 233 to 300 K", "relative"
    for step, ours in (
        ("hilstar's default, one activation energy", np.array(arrhenius)),
        ("hilstar's depletion current", np.array(depletion)),
        ("with the gap that Pyxel has, 1.1557 eV at 0 K", law / law[kelvins.index(293.0)]),
    ):
        yield Step(subject, unit, step, float(np.abs(ours / theirs - 1).max()))
