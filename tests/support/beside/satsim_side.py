"""SatSim (AFRL): photon transfer, read noise, ADC and full well of its detector, and its stars in
pixels.

SatSim is of TensorFlow, so that it runs in an environment of its own: the environment's SATSIM is
that one's Python.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import two_digits
from hilstar.basics.errors import MachineError
from hilstar.optics.psf import GaussianPsf
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from tests.support.beside.steps import Beside, Step

SCRIPT = Path(__file__).with_name("satsim_run.py")
SCENARIO: dict[str, Any] = {
    "full_well_e": 15_000,
    "gain_e_per_dn": 4.0,
    "side_px": 1000,
    "read_noise_e": 12.0,
    "bias_dn": 100.0,
    "levels_e": [200.0, 1000.0, 4000.0, 12_000.0],
    "sigma_px": 0.55,
    "star_px": 13,
    "finer": [1, 5, 15, 45],
}
MEAN, VARIANCE, SHAPE = (
    "photon transfer: mean",
    "photon transfer: variance",
    "photon transfer: distribution of DN",
)
WELL, STAR = "light over the full well", "PSF: Gaussian in pixels"
SECONDS = 1.0
# of the largest of four comparisons of two samples of n, over sqrt(n / 2): Smirnov 1948
CHANCE_95 = 1.59


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Run SatSim's chain and hilstar's on the same levels. Raises MachineError without SatSim."""
    images = satsim_images(folder)
    steps = (*transfer_steps(images), *well_steps(images), *star_steps(images))
    version = str(images["version"])
    variance = two_digits(100 * Beside("", "", "", steps).size(VARIANCE, "as both come"))
    finding = (
        f"SatSim's photon transfer is hilstar's within {variance} %; its bias takes a part of the"
        " full well"
    )
    return Beside("SatSim", version, finding, steps)


def satsim_images(folder: Path) -> dict[str, FloatArray]:
    """SatSim's images of the scenario."""
    python = os.environ.get("SATSIM", sys.executable)
    scenario, images = folder / "satsim.json", folder / "satsim.npz"
    scenario.write_text(json.dumps(SCENARIO))
    told = subprocess.run(
        [python, str(SCRIPT), str(scenario), str(images)],
        capture_output=True,
        text=True,
        check=False,
    )
    if told.returncode:
        last = told.stderr.strip().splitlines()[-1]
        raise MachineError(
            f"SatSim does not run ({last}); pip install satsim in an environment of its own, and"
            " give its Python as the environment's SATSIM"
        )
    with np.load(images) as found:
        return dict(found)


def exposed(level_e: float, offset_dn: float, rng: np.random.Generator) -> FloatArray:
    """One exposure of an even light by hilstar, DN."""
    settings = DetectorSettings(
        gain_e_per_dn=SCENARIO["gain_e_per_dn"],
        full_well_e=float(SCENARIO["full_well_e"]),
        bits=16,
        offset_dn=offset_dn,
        read_noise_e=SCENARIO["read_noise_e"],
    )
    side = SCENARIO["side_px"]
    detector = Detector(settings, (side, side))
    return detector.expose(np.full((side, side), level_e), SECONDS, rng).astype(np.float64)


def transfer_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """Means, variances of differences of two exposures, and distributions, by level."""
    rng = np.random.default_rng(58)
    side, bias_dn = SCENARIO["side_px"], SCENARIO["bias_dn"]
    means, ratios = [], []
    shapes: dict[float, list[float]] = {bias_dn: [], bias_dn - 0.5: []}
    for number, level_e in enumerate(SCENARIO["levels_e"]):
        theirs = images[f"level_{number}"]
        ours = [exposed(level_e, bias_dn, rng) for _ in range(2)]
        means.append(np.mean(ours) - theirs.mean())
        ratios.append(np.var(ours[0] - ours[1]) / np.var(theirs[0] - theirs[1]))
        for offset_dn, found in shapes.items():
            mine = exposed(level_e, offset_dn, rng)
            found.append(float(ks_2samp(mine.ravel(), theirs[0].ravel()).statistic))
    unit = "DN, largest"
    yield Step(MEAN, unit, "as both come: SatSim's ADC cuts off", float(np.abs(means).max()))
    yield Step(MEAN, unit, "half a DN for that", float(np.abs(np.array(means) - 0.5).max()))
    sigma_dn = np.sqrt(max(SCENARIO["levels_e"])) / SCENARIO["gain_e_per_dn"] / side
    yield Step(MEAN, unit, "one sigma of such a difference", float(sigma_dn))
    off = float(np.abs(np.array(ratios) - 1).max())
    yield Step(VARIANCE, "relative", "as both come", off)
    yield Step(VARIANCE, "relative", "one sigma of such a ratio", 2 / side)
    plain, cut = shapes.values()
    yield Step(SHAPE, "share, largest", "as both come", max(plain))
    yield Step(SHAPE, "share, largest", "with half a DN less in hilstar's offset", max(cut))
    chance = CHANCE_95 * np.sqrt(2) / side
    yield Step(SHAPE, "share, largest", "by chance, 95 %", float(chance))


def well_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """Twice the full well, with an offset and without."""
    rng = np.random.default_rng(59)
    light_e = 2.0 * SCENARIO["full_well_e"]
    for step, name, bias_dn in (
        ("as both come: SatSim's bias is in its well", "biased", SCENARIO["bias_dn"]),
        ("without a bias", "plain", 0.0),
    ):
        ours = exposed(light_e, bias_dn, rng)
        yield Step(WELL, "DN, mean", step, float(abs(ours.mean() - images[name].mean())))


def star_steps(images: dict[str, FloatArray]) -> Iterator[Step]:
    """A star in the middle of a pixel: hilstar integrates, SatSim adds points of a grid."""
    sigma, side = SCENARIO["sigma_px"], SCENARIO["star_px"]
    along = np.arange(side) - side // 2.0
    exact = GaussianPsf((sigma, sigma)).shares(along, along[:, None])
    for finer in SCENARIO["finer"]:
        apart = np.abs(images[f"star_{finer}"] - exact / exact.sum()).max()
        step = f"SatSim's grid of {finer} x {finer} points a pixel"
        yield Step(STAR, "share of a star's light", step, float(apart))
