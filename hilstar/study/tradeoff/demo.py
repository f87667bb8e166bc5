"""The bench of `hilstar demo`, its stars to any magnitude, and the attitudes that the trade-offs of the sky look at."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.build import bench_stars
from hilstar.bench.config import BenchConfig, RenderSettings, read_config
from hilstar.resources import resource_path
from hilstar.rotation import normalise, to_matrix
from hilstar.scene.camera import Camera
from hilstar.sky.stars import Stars
from hilstar.study.shared.predictors import ORION

SIGMA_PX = RenderSettings().sprite_sigma_px
NO_LIMIT_V_MAG = 20.0
ATTITUDES = 60
SEED = 1


@cache
def demo_config() -> BenchConfig:
    """The bench of `hilstar demo`."""
    return read_config(resource_path("configs", "demo.toml"))


@cache
def stars_to(faintest_v_mag: float) -> Stars:
    """The demo's stars to a magnitude."""
    config = demo_config()
    sky = msgspec.structs.replace(config.sky, faintest_v_mag=faintest_v_mag)
    return bench_stars(msgspec.structs.replace(config, sky=sky), Path())


def turn_to_image(q: FloatArray, camera: Camera) -> FloatArray:
    """ICRS to image axes, (3, 3), at an attitude."""
    return np.asarray(camera.cam_to_image @ to_matrix(q))


def random_attitudes(count: int) -> list[FloatArray]:
    """Unit quaternions, any attitude as likely as any other; ORION is the first."""
    drawn = np.random.default_rng(SEED).normal(size=(count - 1, 4))
    return [ORION, *normalise(drawn)]
