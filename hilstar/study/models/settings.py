"""The sensors and settings that the charts of the brightness models go through."""

from __future__ import annotations

from hilstar.sky.electrons import Weighting

SENSORS = {"ccd47-20": "CCD47-20", "kai-4021": "KAI-4021 (approximate QE)"}
WEIGHTINGS: tuple[Weighting, ...] = ("energy", "photon")
BRIGHT_V_MAG = 7.5
