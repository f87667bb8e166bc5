"""A tracker whose errors are known: attitudes by SciPy's rotations, errors written as functions
of where a star is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.instruments.assess.places import Scale

ARCSEC_PER_RAD = 180 * 3600 / np.pi
SCALE = Scale(5384.6, (1024, 1024))  # 70 mm and 13 um: the demo's tracker, 38 arcsec a pixel
ROLL = 4.0  # every error about the boresight is this many times that across it
FRAME_S = 0.1

Motion = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


def scan(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right ascension, declination and roll, degrees: three degrees to and fro, rolling by ten."""
    turn = 2 * np.pi * t_s
    return 84 + 3 * np.sin(turn / 391), -1.2 + 3 * np.sin(turn / 271 + 0.4), 10 * np.sin(turn / 603)


def slew(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A slew of a constant 0.02 deg/s."""
    return 30 + 0.02 * t_s, np.full_like(t_s, 10.0), np.zeros_like(t_s)


def still(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One attitude."""
    return np.full_like(t_s, 84.0), np.full_like(t_s, 10.0), np.zeros_like(t_s)


def attitude(motion: Motion, t_s: FloatArray) -> Rotation:
    """q_icrs_to_cam: A3(-roll) A1(90 - dec) A3(90 - ra) of vectors, as the thesis' eq. 2.3 has
    it the other way round.
    """
    ra, dec, roll = motion(t_s)
    from_cam = Rotation.from_euler("ZXZ", np.stack([ra - 90, dec - 90, roll], axis=1), degrees=True)
    return from_cam.inv()


def rate_rad_s(motion: Motion, t_s: FloatArray) -> FloatArray:
    """The rate of a motion (n, 3), cam, by v_cam' = -omega x v_cam and a central difference."""
    step_s = 1e-3
    turn = attitude(motion, t_s + step_s) * attitude(motion, t_s - step_s).inv()
    return np.asarray(-turn.as_rotvec() / (2 * step_s))


def scalar_first(rotation: Rotation) -> FloatArray:
    """Quaternions (n, 4), w first."""
    return np.roll(rotation.as_quat(), 1, axis=1)


@dataclass(frozen=True)
class Sizes:
    """One sigma of the errors across the boresight, arcsec, and the clock's offset and drift."""

    bias: float = 20.0
    fov: float = 2.0
    pixel: float = 0.6
    noise: float = 1.0
    drift_ppm: float = 20.0
    offset_s: float = 0.0
    wild: int = 40
    slow: float = 0.0  # of a change in time, as by warmth: up to a whole wave in the run


@dataclass(frozen=True)
class Planted:
    """A run and a tracker's telemetry, and what was planted in it; `fov` (3,) is the rms that
    came of it, and `slow` (3,) that of the change in time.
    """

    frames_s: FloatArray
    frames_q: FloatArray
    tau_s: FloatArray
    reported: FloatArray
    wild: IntArray
    bias: FloatArray
    fov: FloatArray
    slow: FloatArray


def star_px(rotation: Rotation, q_at: Rotation) -> FloatArray:
    """Where the star that stands on the boresight at `q_at` is seen, px from the middle (n, 2)."""
    seen = rotation.apply(q_at.inv().apply([0.0, 0.0, 1.0]))
    return SCALE.focal_px * seen[:, :2] / seen[:, 2:]


def odometer_px(rotation: Rotation) -> FloatArray:
    """How far the field has moved across the boresight, px (n, 2), summed over the turns from
    answer to answer.
    """
    step = (rotation[1:] * rotation[:-1].inv()).as_rotvec()
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(step[:, 1::-1] * [1, -1], axis=0)])
    return SCALE.focal_px * moved


def sines(place_px: FloatArray, period_px: float) -> FloatArray:
    """A field-of-view error (n, 3) of rms 1."""
    x, y = 2 * np.pi * place_px.T / period_px
    return np.sqrt(2) * np.stack([np.sin(x), np.sin(y + 0.3), np.sin((x + y) / 1.7)], axis=1)


def polynomial(place_px: FloatArray, side_px: float) -> FloatArray:
    """A field-of-view error (n, 3) like a lens's, of rms 1."""
    x, y = place_px.T / side_px
    error = np.stack([x**3 + x * y**2 + 0.3 * y, y**3 + x**2 - 0.5 * x * y, x * y], axis=1)
    error -= error.mean(axis=0)
    return np.asarray(error / error.std(axis=0))


def waves(place_px: FloatArray) -> FloatArray:
    """A pixel error (n, 3) of rms 1, with a second harmonic."""
    x, y = 2 * np.pi * place_px.T
    parts = [
        np.sin(x) + 0.3 * np.sin(2 * x),
        np.sin(y) - 0.3 * np.sin(2 * y),
        1.044 * np.cos(x + 1),
    ]
    return np.sqrt(2 / 1.09) * np.stack(parts, axis=1)


def slow_change(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A change (n, 3) of rms about 1 over shares (n,) of a run: a half to a whole wave an axis."""
    turns = rng.uniform(0.5, 1.0, 3)
    phase = rng.uniform(0, 2 * np.pi, 3)
    return np.sqrt(2) * np.sin(2 * np.pi * turns * share[:, None] + phase)


def plant(
    motion: Motion,
    sizes: Sizes,
    rng: np.random.Generator,
    seconds: float = 1800.0,
    rate_hz: float = 10.0,
    fov: Callable[[FloatArray], FloatArray] = lambda place: sines(place, 400.0),
    pixel_place: Callable[[Rotation, Rotation], FloatArray] = star_px,
) -> Planted:
    """A run's frames, and telemetry with six gaps, wild answers and signs at random."""
    frames_s = np.arange(0.0, seconds, FRAME_S)
    t_s = np.arange(0.3, seconds - 0.3, 1 / rate_hz) + 0.013
    for start in rng.uniform(0, seconds, 6):
        t_s = t_s[(t_s < start) | (t_s > start + rng.uniform(0.003, 0.015) * seconds)]
    true, first = attitude(motion, t_s), attitude(motion, np.zeros(1))[0]
    place = star_px(true, first)
    scale = np.array([1.0, 1.0, ROLL])
    of_field = sizes.fov * fov(place) * scale
    bias = sizes.bias * np.array([0.6, -0.8, 2.0])
    error = (
        bias
        + of_field
        + scale
        * (
            sizes.pixel * waves(pixel_place(true, first))
            + sizes.noise * rng.normal(size=of_field.shape)
        )
    )
    slow = np.zeros_like(error)
    if sizes.slow:
        slow = sizes.slow * scale * slow_change(t_s / seconds, rng)
    error = error + slow
    reported = scalar_first(Rotation.from_rotvec(error / ARCSEC_PER_RAD) * true)
    wild = np.sort(rng.choice(len(t_s), sizes.wild, replace=False))
    reported[wild] = (
        scalar_first(Rotation.random(sizes.wild, random_state=rng))
        if sizes.wild
        else reported[wild]
    )
    reported *= rng.choice([-1.0, 1.0], len(t_s))[:, None]
    tau_s = t_s * (1 + 1e-6 * sizes.drift_ppm) + sizes.offset_s
    frames_q = scalar_first(attitude(motion, frames_s))
    rms = of_field.std(axis=0), slow.std(axis=0)
    return Planted(frames_s, frames_q, tau_s, reported, wild, bias, *rms)
