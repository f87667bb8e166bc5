"""SatSim's detector by a scenario of plain numbers: python satsim_run.py SCENARIO.json IMAGES.npz

It runs in an environment of its own, with TensorFlow.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow as tf
from satsim.image.fpa import analog_to_digital, downsample
from satsim.image.noise import add_photon_noise, add_read_noise
from satsim.image.psf import gen_gaussian


def exposure(scenario: dict[str, Any], level_e: float, bias_dn: float) -> np.ndarray:
    """DN of an even light that makes so many electrons in a pixel."""
    side = scenario["side_px"]
    light = add_photon_noise(tf.fill([side, side], tf.constant(level_e, tf.float32)))
    read, _ = add_read_noise(light, scenario["read_noise_e"])
    dn = analog_to_digital(read, scenario["gain_e_per_dn"], scenario["full_well_e"], bias_dn)
    return np.asarray(dn).astype(np.float64)


def star(scenario: dict[str, Any], finer: int) -> np.ndarray:
    """A star's light in pixels, of a Gaussian at `finer` points along a pixel, with a sum of 1."""
    side = scenario["star_px"]
    sigma = scenario["sigma_px"] * finer
    fine = gen_gaussian(side * finer, side * finer, sigma)
    pixels = np.asarray(downsample(fine, finer, "block_sum")).astype(np.float64)
    return pixels / pixels.sum()


def main(scenario: dict[str, Any], path: Path) -> None:
    """Write every level's two exposures, those over the well, and stars by their fineness."""
    tf.compat.v1.set_random_seed(58)
    images: dict[str, Any] = {"version": importlib.metadata.version("satsim")}
    for number, level_e in enumerate(scenario["levels_e"]):
        pair = [exposure(scenario, level_e, scenario["bias_dn"]) for _ in range(2)]
        images[f"level_{number}"] = np.array(pair)
    for name, bias_dn in (("biased", scenario["bias_dn"]), ("plain", 0.0)):
        images[name] = exposure(scenario, 2.0 * scenario["full_well_e"], bias_dn)
    for finer in scenario["finer"]:
        images[f"star_{finer}"] = star(scenario, finer)
    np.savez(path, **images)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
