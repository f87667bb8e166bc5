"""What the frame loop itself spends on the operator's page: python -m
tests.benchmarks.bench_console_feed.
"""

from __future__ import annotations

import time

import numpy as np

import hilstar
from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.resources import resource_path
from hilstar.server.console.messages import PictureRequest, SharedMemory
from hilstar.server.console.publisher import FramePublisher
from hilstar.server.loop import FrameLoop
from hilstar.server.pacer import Shown
from hilstar.server.run_progress import Running
from tests.support.benches import ORION_Q

FRAMES, PICTURES = 20_000, 300
PERIOD_NS = 16_666_667


def main() -> None:
    """Measure, and print."""
    with hilstar.load(resource_path("configs", "demo.toml")) as bench:
        drawn = bench.draw(np.array(ORION_Q))
        levels = drawn.levels
        feed = FramePublisher(memory := SharedMemory.make(levels.nbytes))
        feed.follow(Running(FrameLoop(bench), PacketCounts()))
        attitude = Attitude(np.array(ORION_Q), 5_000_000, False)
        base_ns = time.monotonic_ns()
        shown = [
            Shown(k, 0, attitude, drawn, swap_ns=base_ns + k * PERIOD_NS) for k in range(FRAMES)
        ]
        took_us = []
        for frame in shown:
            begin_ns = time.perf_counter_ns()
            feed.see(frame)
            took_us.append((time.perf_counter_ns() - begin_ns) / 1e3)
        print(
            f"numbers of a frame: {np.median(took_us):.1f} us median,"
            f" {np.percentile(took_us, 99):.1f} us p99"
        )
        memory.want = PictureRequest(1, 2**62)
        took_us = []
        for k in range(PICTURES):
            later = Shown(k, 0, attitude, drawn, swap_ns=base_ns + (FRAMES + 10 * k) * PERIOD_NS)
            begin_ns = time.perf_counter_ns()
            feed.see(later)
            took_us.append((time.perf_counter_ns() - begin_ns) / 1e3)
        size = "x".join(map(str, levels.shape[::-1]))
        print(
            f"with a picture of {size}: {np.median(took_us):.0f} us median,"
            f" {np.percentile(took_us, 99):.0f} us p99"
        )
        took_us = []
        for k in range(50):
            fresh = bench.draw(np.array(ORION_Q), k)
            bench.renderer.context.finish()
            begin_ns = time.perf_counter_ns()
            _ = fresh.levels
            took_us.append((time.perf_counter_ns() - begin_ns) / 1e3)
        print(f"levels read back for it, as from a screen: {np.median(took_us):.0f} us median")


if __name__ == "__main__":
    main()
