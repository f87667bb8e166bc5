"""The virtual tracker before a display's frames without a clock: no machine misses one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import hilstar
from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply, propagate, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.simulate.live_exposure import LiveTracker, Solved
from hilstar.server.frame_feed import lit_codes


def shown_frame(
    bench: hilstar.Bench, number: int, lit_ns: int, q: FloatArray, rate_cam_rad_s: FloatArray
) -> ShownFrame:
    """A frame as a feed sends it, with the attitude of its middle."""
    drawn = bench.draw(q, number, rate_cam_rad_s if rate_cam_rad_s.any() else None)
    middle = q
    if drawn.rate_cam_rad_s is not None:
        middle = propagate(q, rate_cam_rad_s, bench.scan.hold_s / 2)
    width, height = bench.camera.resolution_px
    bits = bench.config.monitor.bits
    head = FrameHead(number, lit_ns, width, height, bits, tuple(middle.tolist()))
    return ShownFrame(head, *lit_codes(drawn.levels))


def turning(
    bench: hilstar.Bench,
    live: LiveTracker,
    q_start: FloatArray,
    rate_cam_rad_s: FloatArray,
    period_s: float,
) -> Iterator[Solved]:
    """What the tracker finds, an exposure each period, of a sky that turns from `q_start` on."""
    refresh_ns = round(NS_PER_S / bench.config.monitor.refresh_hz)
    begin_ns, number = refresh_ns, 0
    while True:
        end_ns = begin_ns + round(live.exposure_s * NS_PER_S)
        while live.frames.newest_ns < end_ns:
            q = propagate(q_start, rate_cam_rad_s, number * refresh_ns / NS_PER_S)
            live.take(shown_frame(bench, number, number * refresh_ns, q, rate_cam_rad_s))
            number += 1
        yield exposed_and_solved(live, begin_ns)
        begin_ns += round(period_s * NS_PER_S)


def exposed_and_solved(live: LiveTracker, begin_ns: int) -> Solved:
    """What the tracker finds in an exposure that begins then."""
    exposed = live.frames.exposed(begin_ns, begin_ns + round(live.exposure_s * NS_PER_S))
    assert exposed is not None
    return live.solve(exposed, live.expose(exposed))


def off_arcsec(solved: Solved) -> FloatArray:
    """How far an answer is from the mean attitude of its frames, about cam x, y and z."""
    true = solved.exposed.q_icrs_to_cam
    assert solved.identified is not None and true is not None
    turn = multiply(solved.identified.q_icrs_to_cam, conjugate(true))
    return np.asarray(ARCSEC_PER_RAD * to_rotation_vector(turn))
