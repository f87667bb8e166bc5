"""What one packet can ask of a frame: turns of 1 to 900 rad/s and retargets in a live stream."""

from __future__ import annotations

import json
import math
import signal
import time

import pytest

from tests.support.benches import MOVING
from tests.support.senders import publisher, send_attitudes
from tests.support.servers import serving, summary_of
from tests.support.waiting import PATIENCE_S, CoreWaits, missed_in

RATES_RAD_S = (1.0, 10.0, 57.0, 200.0, 900.0)
# A frame of the small bench takes 1 ms; one of 10 rad/s took 1500 ms and more. The margin is for
# busy machines.
MAX_FRAME_MS = 400.0


def turned_q(degrees: float) -> tuple[float, ...]:
    half = math.radians(degrees) / 2
    return (math.cos(half), 0.0, math.sin(half), 0.0)


def test_turns_of_any_rate_are_drawn_in_bounded_time_and_counted(tmp_path):
    turns = [
        ((0.5, 0.5, -0.5, 0.5), (0.6 * r, -0.7 * r, 0.2 * r))
        for r in RATES_RAD_S
        for _ in range(20)
    ]
    attitude = f"max_rate_deg_s = 1e6\n{MOVING}"
    with (
        publisher() as (sender, port),
        serving(tmp_path, port, attitude=attitude) as process,
        CoreWaits(process.pid) as waited,
    ):
        process.shows()
        send_attitudes(sender, turns, 100)
        process.has_received(len(turns))
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    assert summary["packets"]["accepted"] == 20 * len(RATES_RAD_S)
    assert summary["capped"] + missed_in(waited.s) > 15, summary
    assert summary["events"]["capped"] == 1
    assert summary["frame_ms"]["max"] < MAX_FRAME_MS + 1000 * waited.s, (summary, waited.s)


def test_a_rate_in_deg_s_is_refused_by_name_once_said_and_the_stream_goes_on(tmp_path):
    with publisher() as (sender, port), serving(tmp_path, port, attitude=MOVING) as process:
        still = (0.5, 0.5, -0.5, 0.5)
        send_attitudes(
            sender, [(still, (0.0, 0.0, 57.0 if k % 2 else 1.0)) for k in range(50)], 100
        )
        process.has_received(50)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    packets = json.loads(out)["packets"]
    assert (packets["accepted"], packets["refused_by"]["rate"]) == (25, 25)
    lines = [line for line in err.splitlines() if "max_rate_deg_s" in line]
    assert len(lines) == 1
    assert "send rates in rad/s" in lines[0]


@pytest.mark.parametrize("degrees", [20.0, 90.0, 180.0])
def test_a_sender_without_rates_that_retargets_stops_no_frame(tmp_path, degrees):
    """Half a second at 200 Hz, at rest, `degrees` further every 0.1 s, and never a discontinuity: each frame
    shows one place or the other.
    """
    with (
        publisher() as (sender, port),
        serving(tmp_path, port, attitude=MOVING) as process,
        CoreWaits(process.pid) as waited,
    ):
        send_attitudes(sender, [(turned_q(degrees * (k // 20 % 2)), None) for k in range(100)], 200)
        process.send_signal(signal.SIGTERM)
        asked_s = time.monotonic()
        summary = summary_of(process)
        took_s = time.monotonic() - asked_s
    assert took_s - waited.s < 10
    assert summary["frame_ms"]["max"] < MAX_FRAME_MS + 1000 * waited.s, (summary, waited.s)
    assert summary["capped"] == 0
