"""The frame loop against a bench whose sprites sometimes take too long: given up, counted, never two in a row."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields

import numpy as np

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Bench
from hilstar.run.loop import FrameLoop, Limit

REFRESH_HZ = 20.0  # 50 ms a frame: this machine's own pauses are shorter
STALL_S = 0.25
STILL = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 0, False)


def run_with_stalls(bench, stalled: set[int], slots: int) -> tuple[FrameLoop, list[int]]:
    """A paced run in which the sprites of the `stalled` frames take STALL_S; the numbers that were shown."""
    shown: list[int] = []
    drawing = [0]

    @dataclass(frozen=True, eq=False, kw_only=True)
    class Stalling(Bench):
        def frame_sprites(self, *arguments):
            if drawing[0] in stalled:
                time.sleep(STALL_S)
            return super().frame_sprites(*arguments)

    bench = Stalling(**{field.name: getattr(bench, field.name) for field in fields(bench)})
    loop = FrameLoop(bench, lambda frame: shown.append(frame.number))

    def draw_slot(slot: int) -> None:
        drawing[0] = slot
        loop.draw(slot, 0, STILL)

    bench.warm_up()
    with loop.watch:
        loop.paced(REFRESH_HZ, Limit(slots=slots), draw_slot)
    return loop, shown


def test_a_frame_whose_sprites_took_too_long_is_given_up_and_the_next_is_shown(bench_with):
    bench = bench_with()
    loop, shown = run_with_stalls(bench, {3}, 20)
    assert 3 not in shown
    assert loop.stats.given_up_frames >= 1
    assert loop.stats.frames + loop.stats.missed_frames == 20
    assert loop.notices.counts()["frame-given-up"] == loop.stats.given_up_frames
    assert shown[-1] >= 15


def test_a_machine_that_is_always_too_slow_still_shows_every_second_frame(bench_with):
    loop, shown = run_with_stalls(bench_with(), set(range(100)), 40)
    begun = len(shown) + loop.stats.given_up_frames
    assert len(shown) >= begun // 2 >= 2
    assert loop.stats.frames + loop.stats.missed_frames == 40
