"""The test instrument: a log or a spin, sent over ZeroMQ at a steady rate."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.links import ZmqSender
from hilstar.attitude.logs import log_timeline
from hilstar.attitude.packet import AttitudeSample, encode
from hilstar.attitude.quaternion import from_radec_roll_deg, propagate, rate_between_rad_s
from hilstar.attitude.timeline import NS_PER_S, Policy
from hilstar.bench.pacing import wait_until
from hilstar.errors import InputError

SPIN_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
FASTEST_SPIN_RAD_S = 1e6
MOST_RESAMPLED = 10_000_000  # some GB of samples
SPIN_FORM = "--spin AXIS,DEG_PER_S, AXIS being x, y, z or three numbers (cam axes), such as --spin z,0.5"


def parse_spin(text: str) -> FloatArray:
    """The rate in rad/s, cam components (3,), of "AXIS,DEG_PER_S"."""
    *axis, rate_text = [part.strip() for part in text.split(",")]
    try:
        rate = math.radians(float(rate_text))
        vector = np.array(SPIN_AXES[axis[0].lower()] if len(axis) == 1 else [float(part) for part in axis])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"--spin {text}: write {SPIN_FORM}") from error
    length = math.hypot(*vector)
    if len(vector) != 3 or not (abs(rate) <= FASTEST_SPIN_RAD_S and 0 < length < math.inf):
        raise InputError(f"--spin {text}: write {SPIN_FORM}")
    return np.asarray(vector / length * rate)


def parse_numbers(text: str, count: int, option: str, form: str) -> list[float]:
    """`count` finite numbers with commas between them. Raises InputError that shows `form`."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"{option} {text}: write {form}") from error
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option} {text}: write {count} finite numbers, {form}")
    return numbers


def parse_radec(text: str) -> tuple[float, float, float]:
    """Right ascension, declination and roll in degrees."""
    ra_deg, dec_deg, roll_deg = parse_numbers(text, 3, "--radec", "RA,DEC,ROLL in degrees")
    if not -90 <= dec_deg <= 90:
        raise InputError(f"--radec {text}: the declination is from -90 to 90")
    return ra_deg, dec_deg, roll_deg


def parse_rate(text: str) -> FloatArray:
    """A rate in rad/s, cam components (3,), of "X,Y,Z" in deg/s."""
    return np.radians(parse_numbers(text, 3, "--rate", "X,Y,Z in deg/s"))


def parse_target(text: str) -> str:
    """The ZeroMQ endpoint of --to."""
    if text.startswith("serial:"):
        raise InputError(f"--to {text}: serial is not in this version; write tcp://HOST:PORT")
    return text


def spin_samples(
    rate_cam_rad_s: FloatArray, rate_hz: float, radec_roll_deg: tuple[float, float, float]
) -> Iterator[AttitudeSample]:
    """A constant turn without end, from t = 0."""
    start = from_radec_roll_deg(*radec_roll_deg)
    k = 0
    while True:
        seconds = k / rate_hz
        yield AttitudeSample(round(seconds * NS_PER_S), propagate(start, rate_cam_rad_s, seconds), rate_cam_rad_s, k)
        k += 1


def log_samples(samples: list[AttitudeSample], rate_hz: float | None) -> Iterator[AttitudeSample]:
    """A log from t = 0: its own samples, or at `rate_hz` between them. A rate that the log lacks is the next step's."""
    if rate_hz is not None:
        samples = _resampled(samples, rate_hz)
    first_ns = samples[0].t_ns
    for k, sample in enumerate(samples):
        rate = sample.rate_cam_rad_s
        if rate is None and k + 1 < len(samples) and not samples[k + 1].discontinuity:
            after = samples[k + 1]
            seconds = (after.t_ns - sample.t_ns) / NS_PER_S
            rate = rate_between_rad_s(sample.q_icrs_to_cam, after.q_icrs_to_cam, seconds)
        yield AttitudeSample(sample.t_ns - first_ns, sample.q_icrs_to_cam, rate, k, sample.discontinuity)


def _resampled(samples: list[AttitudeSample], rate_hz: float) -> list[AttitudeSample]:
    timeline = log_timeline(samples, Policy(0, NS_PER_S))
    count = int((samples[-1].t_ns - samples[0].t_ns) * rate_hz / NS_PER_S + 1e-6) + 1
    if count > MOST_RESAMPLED:
        raise InputError(f"--rate {rate_hz:g}: makes {count} packets of this log; write a lower rate")
    resampled = []
    for k in range(count):
        t_ns = samples[0].t_ns + round(k * NS_PER_S / rate_hz)
        attitude = timeline.at(t_ns)
        if attitude is not None:
            resampled.append(AttitudeSample(t_ns, attitude.q_icrs_to_cam))
    return resampled


def send(
    sender: ZmqSender,
    samples: Iterator[AttitudeSample],
    stop: threading.Event,
    on_sent: Callable[[int], None] = lambda count: None,
) -> int:
    """Send each sample at its time, stamped with this machine's monotonic clock; how many were sent.

    A sample never goes out early. One that is late goes out at once: none is dropped.
    """
    start_ns = time.monotonic_ns()
    count = 0
    for sample in samples:
        due_ns = start_ns + sample.t_ns
        if wait_until(due_ns, stop):
            break
        stamped = AttitudeSample(due_ns, sample.q_icrs_to_cam, sample.rate_cam_rad_s, sample.sequence, sample.discontinuity)
        sender.send(encode(stamped))
        count += 1
        on_sent(count)
    return count
