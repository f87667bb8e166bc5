"""The bench file: TOML in, checked and frozen tables out.

Each key's type, limits, default and meaning stand once, in the class of its table;
docs/bench-file.md is made from them.
"""

from hilstar.server.bench.config.answers import AnswersSettings
from hilstar.server.bench.config.attitude import AttitudeSettings, FaultSettings
from hilstar.server.bench.config.bench_config import (
    BenchConfig,
    config_of,
    parse_config,
    read_config,
)
from hilstar.server.bench.config.certify import CertifySettings
from hilstar.server.bench.config.hardware import (
    DEFAULT_PSF_SIGMA_PX,
    GAUSSIAN,
    Collimator,
    Monitor,
    SyncSettings,
    Tracker,
    Verify,
)
from hilstar.server.bench.config.render import DEFAULT_BRIGHTEST_V_MAG, RenderSettings
from hilstar.server.bench.config.sky import GEOCENTRE, SOURCE, Background, Bodies, SkySettings
from hilstar.server.bench.config.values import Vector

__all__ = [
    "DEFAULT_BRIGHTEST_V_MAG",
    "DEFAULT_PSF_SIGMA_PX",
    "GAUSSIAN",
    "GEOCENTRE",
    "SOURCE",
    "AnswersSettings",
    "AttitudeSettings",
    "Background",
    "BenchConfig",
    "Bodies",
    "CertifySettings",
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
