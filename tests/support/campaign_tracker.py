"""A tracker before a campaign on the bench, in a process of its own: it sees what `now.json` says
is lit, and answers over UDP.

`python -m tests.support.campaign_tracker '{"now": "out/now.json", "port": 5000}'`; the keys are
those of `Planted`. An exposure that was not lit by one attitude alone has no answer that is valid.
It prints the wild answers' times when its input ends.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.rotation import from_rotation_vector, multiply, propagate, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD

FOCAL_PX = 2000.0
MIDDLE_PX = 511.5  # of a detector of 1024 x 1024
HALF_FIELD = (0.15, 0.11)  # tangents, a little within the display of tests/support/benches.py
WAVE_PX = 100.0  # of the field-of-view error
FIRST_DIRECTION = np.array([0.163, 0.926, 0.342])  # RA 80, Dec 20: its phase is the pixel error's


@dataclass(frozen=True)
class Planted:
    """What is planted: one sigma an axis, arcsec, across the boresight (`noise_arcsec` about x,
    y, z), and shares.
    """

    now: str
    port: int
    answer_hz: float = 100.0
    exposure_s: float = 0.004
    latency_s: float = 0.002
    bias_arcsec: tuple[float, float, float] = (15.0, -9.0, 40.0)
    fov_arcsec: float = 6.0
    pixel_arcsec: float = 4.0
    noise_arcsec: tuple[float, float, float] = (2.0, 2.0, 12.0)
    wild: float = 0.01
    drift_arcsec_s: float = 0.0
    dim_mag_s: float = 0.0
    blind: tuple[int, ...] = ()  # cases in which it never has an attitude
    # it tells its rate where that has a bias, about x, y, z; its stamps are late by so much
    rate_bias_deg_s: tuple[float, float, float] | None = None
    stamp_bias_s: float = 0.0
    seed: int = 1
    # a JSON list of stars that it reports, each x, y, z (ICRS, unit), V, B-V and e-/s, as far as
    # they are within HALF_FIELD and `star_limit_v_mag`: places with noise, px, signals off by so
    # much a magnitude of B-V, and false stars a frame
    star_file: str = ""
    star_noise_px: float = 0.0
    star_colour: float = 0.0
    star_limit_v_mag: float = 99.0
    false_stars: float = 0.0


def seen(
    planted: Planted, middle_ns: int, known: list[dict[str, Any]]
) -> tuple[int, np.ndarray] | None:
    """The case and the attitude that were lit over the whole exposure; None where none was.
    `known`: the last two cases.
    """
    with contextlib.suppress(OSError, ValueError):
        told = json.loads(Path(planted.now).read_text())
        if told not in known[-1:]:
            known[:] = [*known[-1:], told]
    half_ns, end_ns = planted.exposure_s / 2 * 1e9, math.inf
    for told in reversed(known):
        if told["light_ns"] <= middle_ns - half_ns and middle_ns + half_ns <= end_ns:
            q, rate = np.array(told["q_icrs_to_cam"]), np.array(told["rate_cam_rad_s"])
            return told["case"], propagate(q, rate, (middle_ns - told["light_ns"]) / 1e9)
        end_ns = told["light_ns"]
    return None


def wave(q: np.ndarray, length_px: float) -> np.ndarray:
    """A wave (..., 2) of rms 1 over many lengths, in x and y, of where attitudes (..., 4) put
    FIRST_DIRECTION.
    """
    star = to_matrix(q) @ FIRST_DIRECTION
    return np.asarray(
        np.sqrt(2) * np.sin(2 * np.pi * FOCAL_PX * star[..., :2] / star[..., 2:] / length_px)
    )


def error_arcsec(
    planted: Planted, q: np.ndarray, at_s: float, rng: np.random.Generator
) -> np.ndarray:
    """The planted error at an attitude, so long after the start."""
    error = np.array(planted.bias_arcsec) + np.array(planted.noise_arcsec) * rng.standard_normal(3)
    error[:2] += planted.fov_arcsec * wave(q, WAVE_PX) + planted.pixel_arcsec * wave(q, 1.0)
    error[0] += planted.drift_arcsec_s * at_s
    return error


def reported_stars(
    planted: Planted, stars: np.ndarray, q: np.ndarray, rng: np.random.Generator
) -> list[list[float]]:
    """The stars (n, 6) that it reports at an attitude: x, y, px, and signal."""
    seen = stars[:, :3] @ to_matrix(q).T
    x, y, z = seen.T
    half_x, half_y = HALF_FIELD
    inside = (z > 0) & (np.abs(x) < half_x * z) & (np.abs(y) < half_y * z)
    inside &= stars[:, 3] <= planted.star_limit_v_mag
    places = MIDDLE_PX + FOCAL_PX * seen[inside, :2] / seen[inside, 2:]
    places = places + planted.star_noise_px * rng.standard_normal(places.shape)
    signal = stars[inside, 5] * 10 ** (-0.4 * planted.star_colour * stars[inside, 4])
    rows = np.column_stack([places, signal]).tolist()
    for _ in range(rng.poisson(planted.false_stars)):
        rows.append([*rng.uniform(0, 2 * MIDDLE_PX, 2).tolist(), 1000.0])
    return rows


def main() -> None:
    """Answer until standard input ends."""
    planted = Planted(**json.loads(sys.argv[1]))
    rng = np.random.default_rng((planted.seed, os.getpid()))
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stars = None
    if planted.star_file:
        stars = np.array(json.loads(Path(planted.star_file).read_text()))
    begun_ns, k, wild, known = time.monotonic_ns(), 0, [], []
    while not select.select([sys.stdin], [], [], 0)[0]:
        middle_ns = begun_ns + round(k / planted.answer_hz * 1e9)
        k += 1
        time.sleep(
            max(
                0.0,
                (middle_ns - time.monotonic_ns()) / 1e9
                + planted.exposure_s / 2
                + planted.latency_s,
            )
        )
        found, at_s = seen(planted, middle_ns, known), (middle_ns - begun_ns) / 1e9
        stamp_ns = middle_ns + round(planted.stamp_bias_s * 1e9)
        told: dict[str, object] = {"t_ns": stamp_ns, "q": [1.0, 0.0, 0.0, 0.0], "valid": False}
        if found is not None and found[0] not in planted.blind:
            turn = from_rotation_vector(error_arcsec(planted, found[1], at_s, rng) / ARCSEC_PER_RAD)
            if rng.random() < planted.wild:
                turn = from_rotation_vector(rng.uniform(0.3, 1.5) * np.array([0.6, -0.8, 0.0]))
                wild.append(found[0])
            dn = 1000.0 * 10 ** (-0.4 * planted.dim_mag_s * at_s)
            told |= {"q": multiply(turn, found[1]).tolist(), "valid": True, "stars": 7}
            if planted.rate_bias_deg_s is not None:
                rate = np.array(known[-1]["rate_cam_rad_s"]) + np.radians(planted.rate_bias_deg_s)
                told["rate"] = rate.tolist()
            told["centroids"] = [[100.0 + 50 * star, 200.0, dn * (1 + star)] for star in range(7)]
            if stars is not None:
                told["centroids"] = reported_stars(planted, stars, found[1], rng)
        line.sendto(json.dumps(told).encode(), ("127.0.0.1", planted.port))
        # exposures that are under way have their answers, too; those that were missed have none
        behind_s = (time.monotonic_ns() - begun_ns) / 1e9 - planted.latency_s
        k = max(k, int(behind_s * planted.answer_hz))
    print(json.dumps(wild))


if __name__ == "__main__":
    main()
