"""The trade-off of prediction: the attitude between the last sample and the light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import angle_between_rad
from hilstar.study.shared.predictors import (
    JITTER,
    NEAR,
    SLEW_DEG,
    SLEW_S,
    AttitudeAt,
    Predictor,
    predictors,
    slew_attitude,
    slew_sample,
)
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import NS_PER_MS, NS_PER_S

SAMPLE_MS = 50
FRAME_HZ = 60
PREDICTIONS = 60


def prediction(stack: ExitStack, quick: bool) -> Trials:
    """The attitude at the moment of light, after the newest sample: worst and rms error, arcsec, on a shaken slew."""
    del stack
    samples = [slew_sample(k * SAMPLE_MS * NS_PER_MS) for k in range((10 if quick else 60) * 1000 // SAMPLE_MS)]
    frames_ns = np.linspace(0, SAMPLE_MS * NS_PER_MS, PREDICTIONS, dtype=np.int64) + samples[-2].t_ns
    trials = []
    for predictor in predictors():
        error = prediction_errors_arcsec(predictor, samples)
        attitude_at = predictor.load(samples[-1 - NEAR : len(samples) if predictor.waits else -1])
        work = partial(_all_of, attitude_at, frames_ns.tolist())
        trials.append(Trial(predictor.name, float(error.max()), float(np.sqrt(np.mean(error**2))), work, predictor.is_default))
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    return Trials(
        "prediction",
        f"{PREDICTIONS} attitudes, samples every {SAMPLE_MS} ms",
        Figure("attitude error, worst", "arcsec"),
        Figure("rms", "arcsec"),
        "it needs nothing but the newest sample",
        trials,
        f"a swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken on each axis by {shaken};"
        f" waiting for a sample makes the attitude {SAMPLE_MS} ms older;"
        " the times of hold, of the linear predictors and of the blend include the timeline, those of the other two do not",
    )


def prediction_errors_arcsec(predictor: Predictor, samples: Sequence[AttitudeSample]) -> FloatArray:
    """The error at each frame, once NEAR samples are there."""
    frame_ns, errors = NS_PER_S / FRAME_HZ, []
    for after in range(NEAR, len(samples)):
        attitude_at = predictor.load(samples[after - NEAR : after + 1 if predictor.waits else after])
        first, last = (math.ceil(samples[k].t_ns / frame_ns) for k in (after - 1, after))
        for t_ns in (round(k * frame_ns) for k in range(first, last)):
            errors.append(angle_between_rad(slew_attitude(t_ns), attitude_at(t_ns)) * math.degrees(3600))
    return np.array(errors)


def _all_of(attitude_at: AttitudeAt, frames_ns: Sequence[int]) -> None:
    for t_ns in frames_ns:
        attitude_at(t_ns)
