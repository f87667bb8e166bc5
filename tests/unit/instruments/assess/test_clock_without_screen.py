"""A rehearsal without a screen, assessed: frames that are begun late at random leave no bias of the
time of measurement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.assess.assessment import AssessSettings, assess_files
from hilstar.instruments.assess.report import budget_of
from hilstar.server.answers.pairing import LitFrame, LitFrames
from tests.support.benches import bench_text
from tests.support.planted_run import write_ledger, write_telemetry
from tests.support.planted_tracker import attitude, scalar_first

SECONDS, EXPOSURE_S, LATE_PERIODS = 60.0, 0.05, 0.8
NOISE_ARCSEC, ANSWER_HZ = 0.5, 5.0
# Of what held frames are late by: frames that fade and frames that are held are then told apart.
# The clock's own sigma has room for a field-of-view error, which this tracker does not have.
SHARE, SIGMAS = 0.5, 3.0
# The mean of a span of a turn that accelerates is not that of its middle; over the swings its part
# that goes with the rate is below this.
CURVED_MS = 0.01


def swings(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slews of both signs, up to 1 deg/s across and 0.5 about the boresight."""
    turn = 2 * np.pi * t_s
    return 84 + 10 * np.sin(turn / 63), 5 * np.sin(turn / 41 + 0.4), 6 * np.sin(turn / 75)


@pytest.mark.parametrize("refresh_hz", [30.0, 100.0])
@pytest.mark.parametrize("fades", [True, False])
def test_frames_that_are_late_at_random_are_no_bias_of_the_trackers_clock(
    tmp_path: Path, rng: np.random.Generator, refresh_hz: float, fades: bool
) -> None:
    """Held until the next one, as a screen does, they are late by a closed form."""
    slots = np.arange(round(SECONDS * refresh_hz))
    frames_s = (slots + LATE_PERIODS * rng.random(len(slots))) / refresh_hz
    frames_q = scalar_first(attitude(swings, frames_s))
    bench = bench_text(
        {"monitor": {"refresh_hz": refresh_hz}, "tracker": {"exposure_s": EXPOSURE_S}}
    )
    ledger = write_ledger(tmp_path / "run.mcap", frames_s, frames_q, bench=bench)
    lit = LitFrames(1e9 / refresh_hz)
    numbers = np.arange(round(ANSWER_HZ * (SECONDS - 2)))
    at_s = 1.0 + (numbers + rng.random(len(numbers))) / ANSWER_HZ
    ends = np.searchsorted(frames_s, at_s + 4 / refresh_hz + EXPOSURE_S)
    reported, begun = [], 0
    for middle_s, end in zip(at_s.tolist(), ends.tolist(), strict=True):
        for number in range(begun, end):
            moment_ns = round(frames_s[number] * 1e9)
            q = frames_q[number]
            lit.add(LitFrame(number, moment_ns, moment_ns, q, fades=fades))
        begun = end
        half_s = EXPOSURE_S / 2
        seen = lit.over(round((middle_s - half_s) * 1e9), round((middle_s + half_s) * 1e9))
        reported.append(seen.q)
    noise = rng.normal(0, np.radians(NOISE_ARCSEC / 3600), (len(at_s), 3))
    seen_q = Rotation.from_quat(np.roll(np.array(reported), -1, axis=1))
    answers = scalar_first(Rotation.from_rotvec(noise) * seen_q)
    telemetry = write_telemetry(tmp_path / "telemetry.csv", at_s, answers)
    found = assess_files(ledger, telemetry, AssessSettings(display_attitudes=0))
    clock = budget_of(found)["clock"]
    gap_s = np.diff(frames_s)
    late_s = ((gap_s**2).sum() / gap_s.sum() - 1 / refresh_hz) / 2
    expected_ms = 0.0 if fades else 1e3 * late_s
    off_ms = clock["offset_ms"] - expected_ms
    assert abs(off_ms) < CURVED_MS + SHARE * 1e3 * late_s
    assert abs(off_ms) < CURVED_MS + SIGMAS * clock["sigma_ms"]
