"""The bench file: TOML in, checked and frozen tables out.

Each key's type, limits, default and meaning stand once, in the class of its table; docs/bench-file.md is made from them.
"""

from hilstar.bench.config.background import Background
from hilstar.bench.config.bench import BenchConfig
from hilstar.bench.config.collimator import Collimator
from hilstar.bench.config.faults import FaultSettings
from hilstar.bench.config.monitor import Monitor
from hilstar.bench.config.read import config_of, parse_config, read_config
from hilstar.bench.config.render import DEFAULT_BRIGHTEST_V_MAG, RenderSettings
from hilstar.bench.config.sky import Bodies, SkySettings
from hilstar.bench.config.spacecraft import GEOCENTRE, SOURCE
from hilstar.bench.config.stream.attitude import AttitudeSettings
from hilstar.bench.config.sync import SyncSettings
from hilstar.bench.config.tracker import Tracker
from hilstar.bench.config.values import Vector
from hilstar.bench.config.verify import Verify

__all__ = [
    "DEFAULT_BRIGHTEST_V_MAG",
    "GEOCENTRE",
    "SOURCE",
    "AttitudeSettings",
    "Background",
    "BenchConfig",
    "Bodies",
    "Collimator",
    "FaultSettings",
    "Monitor",
    "RenderSettings",
    "SkySettings",
    "SyncSettings",
    "Tracker",
    "Vector",
    "Verify",
    "config_of",
    "parse_config",
    "read_config",
]
