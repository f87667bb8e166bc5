"""Pyxel's detector by a scenario of plain numbers: python pyxel_run.py SCENARIO.json IMAGES.npz

It runs in an environment of its own, whose Astropy Pyxel chooses.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyxel
from pyxel.detectors import CCD, CCDGeometry, Characteristics, Environment
from pyxel.detectors.charge_to_volt_settings import ChargeToVoltSettings
from pyxel.models import (
    charge_collection,
    charge_generation,
    charge_measurement,
    photon_collection,
    readout_electronics,
)

VOLTS_PER_E = 1e-5


def detector_of(scenario: dict[str, Any], temperature_k: float) -> CCD:
    """A CCD whose ADC's step is `gain_e_per_dn`."""
    steps = 2 ** scenario["bits"]
    characteristics = Characteristics(
        quantum_efficiency=1.0,
        charge_to_volt=ChargeToVoltSettings(value=VOLTS_PER_E),
        pre_amplification=1.0,
        full_well_capacity=scenario["full_well_e"],
        adc_bit_resolution=scenario["bits"],
        adc_voltage_range=(0.0, (steps - 1) * scenario["gain_e_per_dn"] * VOLTS_PER_E),
    )
    side, pitch_um = scenario["side_px"], scenario["pitch_um"]
    geometry = CCDGeometry(row=side, col=side, pixel_vert_size=pitch_um, pixel_horz_size=pitch_um)
    return CCD(
        geometry=geometry,
        environment=Environment(temperature=temperature_k),
        characteristics=characteristics,
    )


def exposure(scenario: dict[str, Any], level_e: float, seed: int, prnu: float) -> np.ndarray:
    """DN of an even light that makes so many electrons in a pixel."""
    detector = detector_of(scenario, 293.0)
    detector.set_readout(times=[1.0], non_destructive=False)
    detector.time, detector.time_step = 1.0, 1.0
    detector.empty()
    photon_collection.illumination(detector, level=level_e)
    photon_collection.shot_noise(detector, seed=seed)
    charge_generation.simple_conversion(detector, binomial_sampling=False)
    charge_collection.simple_collection(detector)
    if prnu:
        charge_collection.fixed_pattern_noise(
            detector, fixed_pattern_noise_factor=prnu, seed=scenario["device_seed"]
        )
    charge_collection.simple_full_well(detector)
    charge_measurement.simple_measurement(detector)
    noise_v = scenario["read_noise_e"] * VOLTS_PER_E
    charge_measurement.output_node_noise(detector, std_deviation=noise_v, seed=seed + 1)
    readout_electronics.simple_amplifier(detector)
    readout_electronics.simple_adc(detector)
    return np.asarray(detector.image.array).astype(np.float64)


def dark_e_per_s(scenario: dict[str, Any], temperature_k: float) -> float:
    """The mean of a dark second."""
    detector = detector_of(scenario, temperature_k)
    detector.set_readout(times=[1.0], non_destructive=False)
    detector.time, detector.time_step = 1.0, 1.0
    detector.empty()
    charge_generation.dark_current(
        detector, figure_of_merit=scenario["dark_na_cm2"], temporal_noise=False
    )
    return float(np.mean(detector.charge.array))


def main(scenario: dict[str, Any], path: Path) -> None:
    """Write every level's two exposures, those with PRNU, and dark rates by temperature."""
    images: dict[str, Any] = {"version": pyxel.__version__}
    for number, level_e in enumerate(scenario["levels_e"]):
        pair = [exposure(scenario, level_e, 100 * number + 2 * k, 0.0) for k in range(2)]
        images[f"level_{number}"] = np.array(pair)
    level_e = scenario["prnu_level_e"]
    for name, prnu in (("flat", 0.0), ("prnu", scenario["prnu"])):
        frames = [exposure(scenario, level_e, 1000 + k, prnu) for k in range(scenario["frames"])]
        images[name] = np.mean(frames, axis=0)
    images["dark"] = [dark_e_per_s(scenario, kelvin) for kelvin in scenario["temperatures_k"]]
    np.savez(path, **images)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
