"""The benches and the directions in which bodies are timed: one screen, one date, each body alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.build import load
from hilstar.bench.frame import Bench
from hilstar.rotation import from_radec_roll_deg
from hilstar.study.shared.bench_text import Table, bench_text
from hilstar.units import NS_PER_S

REFRESH_HZ = 60.0
EPOCH: Table = {"epoch_utc": "2026-11-21T00:00:00Z"}
# 400 km over a circle, made for that date
TLE = """\
1 99999U          26325.00000000  .00000000  00000-0  00000+0 0    05
2 99999  51.6000 150.0000 0001000   0.0000   0.0000 15.55820000    02
"""
DAY_SIDE_NS = 24 * 60 * NS_PER_S  # the Sun is 72 degrees from its zenith then
LOW_ORBIT: Table = {"orbit": "low.tle"}
GEOCENTRE: Table = {"orbit": "geocentre"}
# By the name of a bench: its bodies and its observer
BODIES: dict[str, tuple[Table, Table]] = {
    "nothing": ({}, {}),
    "observer": ({}, GEOCENTRE),
    "low orbit": ({}, LOW_ORBIT),
    "planets": ({"planets": True}, GEOCENTRE),
    "Moon": ({"moon": True}, GEOCENTRE),
    "Sun": ({"sun": True}, GEOCENTRE),
    "Earth": ({"earth": True}, LOW_ORBIT),
    "all": ({"planets": True, "moon": True, "sun": True, "earth": True}, LOW_ORBIT),
}


@dataclass(frozen=True, slots=True)
class Aim:
    """Where a bench looks: so far from a body's middle, or beyond the Earth's limb, or the other way."""

    body: str
    off_deg: float
    t_ns: int = 0


@contextmanager
def opened(names: tuple[str, ...]) -> Iterator[dict[str, Bench]]:
    """The benches of these names, which end with the context. Raises InputError or MachineError."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        (Path(folder) / "low.tle").write_text(TLE)
        yield {name: stack.enter_context(_open(Path(folder), name)) for name in names}


def _open(folder: Path, name: str) -> Bench:
    bodies, observer = BODIES[name]
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "monitor": {"resolution_px": (1920, 1080), "pixel_pitch_um": 57.65, "refresh_hz": REFRESH_HZ, "bits": 12},
        "collimator": {"focal_length_mm": 350.0},
        "sky": EPOCH,
        "render": {"quantisation": "round", "motion": "off", "brightest_v_mag": 2.0},
    }
    if bodies:
        tables["sky.bodies"] = bodies
    if observer:
        tables["spacecraft"] = observer
    path = folder / f"{name.replace(' ', '_')}.toml"
    path.write_text(bench_text(tables))
    return load(path)


def attitude(bench: Bench, aim: Aim) -> FloatArray:
    """The attitude (unit quaternion, scalar first) with the boresight at an aim, of a bench that has the body."""
    if bench.moving is None:
        raise AssertionError("a bench with bodies moves")
    disc = next(d for d in bench.moving.discs(np.array([0.0, 0.0, 1.0]), np.pi, 0.0, aim.t_ns) if d.name == aim.body)
    off_rad = np.radians(aim.off_deg) + (disc.radius_rad if aim.body == "Earth" else 0.0)
    # Along declination, away from the near pole; the Earth towards the Sun, where its limb is lit
    beside = disc.sun if aim.body == "Earth" else np.array([0.0, 0.0, -np.sign(disc.direction[2]) or 1.0])
    beside = beside - (beside @ disc.direction) * disc.direction
    beside /= np.linalg.norm(beside)
    x, y, z = np.cos(off_rad) * disc.direction + np.sin(off_rad) * beside
    return from_radec_roll_deg(float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(z))), 0.0)
