"""Answers of a campaign's cases with errors that are planted, as arrays: no case is run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.cases import (
    FRAME_ERRORS,
    FRAME_RATE_ERRORS,
    FRAME_RATES,
    STAR_LISTS,
)
from hilstar.instruments.campaign.planted import aberration_rad
from hilstar.instruments.campaign.star_motion import (
    OBSERVER_KM_S,
    PARALLAX_TURN,
    YEARLY_TURN,
    YEARS,
)

SCALE = Scale(1500.0, (512, 512))
CASES, FRAMES = 60, 8
RATE_NOISE_DEG_S = 0.01
NOISE_ARCSEC = 2.0
STARS = 30  # of a case
WILD_SIGMAS = 20.0


def noise_of(
    rng: np.random.Generator, cases: int, frames: int, planted: dict[str, Any]
) -> FloatArray:
    """Noise (cases, frames) of variance 1: of it a share `together` lasts for a case, and a share
    `wild` of the frames are far off besides.
    """
    together = planted.get("together", 0.0)
    lasting = math.sqrt(together) * rng.standard_normal((cases, 1))
    noise = lasting + math.sqrt(1 - together) * rng.standard_normal((cases, frames))
    is_wild = rng.random((cases, frames)) < planted.get("wild", 0.0)
    return np.asarray(noise + is_wild * WILD_SIGMAS * rng.standard_normal((cases, frames)))


def answers(rng: np.random.Generator, cases: int = CASES, **planted: Any) -> Columns:
    """The answers of slews whose errors are planted: rates in deg/s, stamps in s, shares."""
    rate = rng.uniform(-0.5, 0.5, (cases, 3))
    acceleration = rng.uniform(-0.1, 0.1, (cases, 3))
    bias = np.array(planted.get("rate_bias", (0.0, 0.0, 0.0)))
    numbers: dict[str, Any] = {"case": np.arange(cases, dtype=float)}
    numbers["frames"] = np.full(cases, float(FRAMES))
    velocity = rng.uniform(-30, 30, (cases, 3))
    q = np.array([from_radec_roll_deg(*rng.uniform(-80, 80, 3).tolist()) for _ in range(cases)])
    off = np.zeros((cases, 3))
    for k in range(cases):
        off[k] = planted.get("aberration", 0.0) * aberration_rad(q[k], velocity[k])
    error = np.degrees(off) * 3600 + NOISE_ARCSEC * noise_of(rng, cases, 3, planted)
    for k, axis in enumerate("xyz"):
        numbers[f"vary.acceleration_deg_s2.{axis}"] = acceleration[:, k]
        numbers[f"vary.sky.observer_velocity_km_s.{k}"] = velocity[:, k]
        numbers[f"error_{axis}_arcsec"] = error[:, k]
    for k, name in enumerate(("qw", "qx", "qy", "qz")):
        numbers[name] = q[:, k]
    lists: dict[str, list[Any]] = {}
    steps = 0.2 * np.arange(FRAMES)
    noise = planted.get("rate_noise", RATE_NOISE_DEG_S)
    delay = planted.get("stamp_bias", 0.0)
    delay = delay + planted.get("stamp_jitter", 0.0) * rng.standard_normal((cases, FRAMES))
    for k in range(3):
        true = rate[:, k, None] + acceleration[:, k, None] * steps
        told = bias[k] + planted.get("rate_scale", 0.0) * true
        told = told - planted.get("rate_lag", 0.0) * acceleration[:, k, None]
        told = told + noise * noise_of(rng, cases, FRAMES, planted)
        of_stamp = 3600 * true * delay + 5.0 * (k + 1)
        of_stamp = of_stamp + NOISE_ARCSEC * noise_of(rng, cases, FRAMES, planted)
        lists[FRAME_RATES[k]] = list(true)
        lists[FRAME_RATE_ERRORS[k]] = list(told)
        lists[FRAME_ERRORS[k]] = list(of_stamp)
    return Columns(cases, numbers, {}, lists)


def reported_stars(rng: np.random.Generator, cases: int = CASES, **planted: Any) -> Columns:
    """Reported stars with planted errors: px, magnitudes, and false stars a frame."""
    lists: dict[str, list[Any]] = {name: [] for name in STAR_LISTS}
    false = rng.poisson(planted.get("false", 0.2), cases)
    wild = planted.get("wild", 0.0)
    for _ in range(cases):
        n = STARS
        x, y = rng.uniform(8, 503, (2, n))
        v_mag = rng.uniform(2, 7, n)
        bv = rng.uniform(-0.2, 1.8, n)
        wave = math.sqrt(2) * planted.get("fov", 0.0) * np.sin(2 * np.pi * x / 512)
        noise = planted.get("noise", 0.1) * rng.standard_normal((2, n))
        noise = noise * (1 + WILD_SIGMAS * (rng.random(n) < wild))
        dx, dy = wave + noise
        signal = 3.0 + planted.get("colour", 0.0) * bv + 0.02 * rng.standard_normal(n)
        seen = rng.random(n) < 1 / (1 + np.exp((v_mag - planted.get("limit", 5.5)) / 0.1))
        for column in (dx, dy, signal):
            column[~seen] = np.nan
        columns = (x, y, v_mag, bv, dx, dy, signal, v_mag - 10.0)
        for name, column in zip(STAR_LISTS, columns, strict=True):
            lists[name].append(column)
    numbers = {
        "case": np.arange(cases, dtype=float),
        "frames": np.ones(cases),
        "star_frames": np.ones(cases),
        "star_false": false.astype(float),
    }
    return Columns(cases, numbers, {}, lists)


def old_places(rng: np.random.Generator, cases: int = CASES, **planted: Any) -> Columns:
    """Attitudes by stars that moved, at dates over 20 years, and with a parallax: some fields turn
    by much more than most.
    """
    numbers: dict[str, Any] = {"case": np.arange(cases, dtype=float), "frames": np.ones(cases)}
    turns = rng.lognormal(-2.0, 1.0, (cases, 2)) * rng.choice([-1.0, 1.0], (cases, 2))
    years = rng.uniform(-10, 10, cases)
    left = planted.get("proper_motion", 0.0) * years + planted.get("age", 0.0)
    velocity = rng.uniform(-30, 30, (cases, 3))
    q = np.array([from_radec_roll_deg(*rng.uniform(-80, 80, 3).tolist()) for _ in range(cases)])
    noise = planted.get("noise_arcsec", 0.1) * noise_of(rng, cases, 2, planted)
    by_age = left[:, None] * turns
    by_parallax = planted.get("parallax", 0.0) * turns
    error = by_age + by_parallax + noise
    for k, axis in enumerate("xy"):
        numbers[YEARLY_TURN.format(axis)] = turns[:, k]
        numbers[PARALLAX_TURN.format(axis)] = turns[:, k]
        numbers[f"error_{axis}_arcsec"] = error[:, k]
    numbers["error_z_arcsec"] = np.zeros(cases)
    numbers[YEARS] = years
    for k, axis in enumerate("xyz"):
        numbers[OBSERVER_KM_S.format(axis)] = velocity[:, k]
    for k, name in enumerate(("qw", "qx", "qy", "qz")):
        numbers[name] = q[:, k]
    return Columns(cases, numbers, {}, {})
