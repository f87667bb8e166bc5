"""What a feed hands on of each frame: its codes, its light and its attitude, with a screen and
without, and what it leaves out when nobody is fast enough.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.wire.shown_frames import ShownFrame
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.server.frame_feed import BUFFERS, FrameFeed, lit_codes
from hilstar.server.pacer import Shown
from tests.support.benches import bench_text
from tests.support.drawn import drawn, stars_at
from tests.support.waiting import PATIENCE_S, wait_for

Q = from_radec_roll_deg(84.057, -1.2, 30.0)
HOLD_S = 0.008
LEVELS = np.array([[0, 3, 0], [7, 0, 1]], np.uint8)
SEEN = drawn(LEVELS)


def bench_at(folder: Path, **monitor: object) -> Bench:
    """A bench of 50 Hz, whose rows light for HOLD_S."""
    path = folder / "bench.toml"
    keys = {"refresh_hz": 50.0, "hold_ms": 1e3 * HOLD_S} | monitor
    path.write_text(bench_text({"monitor": keys, "render": {"quantisation": "round"}}))
    return load(path)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_at(tmp_path_factory.mktemp("bench")) as opened:
        yield opened


class Watcher:
    """A sender whose watcher takes frames once it is `let`."""

    endpoint = "a test"

    def __init__(self, let: bool = True) -> None:
        self.frames: queue.SimpleQueue[ShownFrame] = queue.SimpleQueue()
        self.let = threading.Event()
        if let:
            self.let.set()

    def look(self) -> bool:
        return True

    def put_frame(self, frame: ShownFrame) -> None:
        self.let.wait(PATIENCE_S)
        self.frames.put(frame)

    def close(self) -> None:
        """Nothing to close."""


def handed_on(bench: Bench, shown: Shown) -> ShownFrame:
    """What a watcher gets of a frame on a screen, whose light comes 9 ms after its swap."""
    watcher = Watcher()
    with FrameFeed(watcher, bench, lambda: 9_000_000) as feed:  # type: ignore[arg-type]
        wait_for(lambda: feed.watched)
        feed.see(shown)
        frame = watcher.frames.get(timeout=PATIENCE_S)
        wait_for(lambda: feed.sent == 1)
    return frame


def test_a_frame_on_a_screen_is_lit_after_its_swap_and_has_each_of_its_figures(bench):
    attitude = Attitude(Q, 0, False)
    frame = handed_on(
        bench, Shown(70, 5, attitude, SEEN, draw_ns=1, predicted_swap_ns=10**9, swap_ns=2 * 10**9)
    )
    head = frame.head
    assert (head.frame, head.lit_ns, head.moment_ns) == (70, 2_009_000_000, None)
    assert (head.width, head.height, head.bits, head.channels) == (3, 2, 8, 1)
    assert head.q == pytest.approx(tuple(Q)) and head.bench_sha256 == bench.file.sha256
    assert frame.lit.tolist() == [1, 3, 5] and frame.codes.tolist() == [3, 7, 1]


def test_a_blank_frame_has_no_attitude_and_one_in_motion_that_of_its_middle(bench):
    assert handed_on(bench, Shown(1, 5, None, SEEN, swap_ns=2)).head.q is None
    # a turn of 1 rad/s about z: half of 8 ms later the sky has turned by 4 mrad the other way
    rate = np.array([0.0, 0.0, 1.0])
    frame = handed_on(
        bench,
        Shown(
            1,
            5,
            Attitude(Q, 0, False),
            drawn(LEVELS, stars_at([], [], rate_cam_rad_s=rate)),
            draw_ns=10**9,
        ),
    )
    half = HOLD_S / 4  # of half of the angle
    turn = np.array([np.cos(half), 0.0, 0.0, -np.sin(half)])
    w, x, y, z = Q
    wanted = [
        turn[0] * w - turn[3] * z,
        turn[0] * x - turn[3] * y,
        turn[0] * y + turn[3] * x,
        turn[0] * z + turn[3] * w,
    ]
    assert np.abs(np.dot(frame.head.q, wanted)) == pytest.approx(1.0, abs=1e-15)
    assert np.abs(np.array(frame.head.q) - np.array(wanted)).max() < 1e-12
    # a sample of the sky: its moment is that of the middle of the motion
    assert frame.head.moment_ns == 10**9 + round(HOLD_S * 1e9 / 2)


def test_codes_of_stolen_bits_are_triples_and_those_of_primaries_their_own(bench, tmp_path):
    path = tmp_path / "stolen.toml"
    render = {"quantisation": "round", "bit_stealing": True}
    path.write_text(bench_text({"render": render}))
    with load(path) as stealing:
        frame = handed_on(stealing, Shown(1, 5, None, SEEN, swap_ns=2))
        triples = stealing.calibration.response.rgb
    assert frame.head.channels == 3
    assert frame.codes.tolist() == triples[[3, 7, 1]].tolist()
    assert frame.codes.dtype == np.uint8
    primaries = np.zeros((2, 3, 3), np.uint8)
    primaries[0, 2], primaries[1, 0] = (0, 9, 0), (4, 5, 6)
    frame = handed_on(bench, Shown(1, 5, None, drawn(primaries), swap_ns=2))
    assert (frame.head.channels, frame.lit.tolist()) == (3, [2, 3])
    assert frame.codes.tolist() == [[0, 9, 0], [4, 5, 6]]


def test_lit_pixels_are_numbered_row_by_row():
    lit, codes = lit_codes(LEVELS)
    assert (lit.dtype, lit.tolist(), codes.tolist()) == (np.uint32, [1, 3, 5], [3, 7, 1])


def test_frames_that_nobody_takes_in_time_are_left_out_and_counted(bench):
    watcher = Watcher(let=False)
    with FrameFeed(watcher, bench) as feed:  # type: ignore[arg-type]
        wait_for(lambda: feed.watched)
        for number in range(BUFFERS + 3):
            feed.see(Shown(number, 5, None, SEEN, draw_ns=number))
        assert feed.skipped == 3
        watcher.let.set()
        numbers = [watcher.frames.get(timeout=PATIENCE_S).head.frame for _ in range(BUFFERS)]
        assert numbers == list(range(BUFFERS))
        wait_for(lambda: feed.sent == BUFFERS)
        # their buffers are there again
        feed.see(Shown(99, 5, None, SEEN, draw_ns=99))
        assert watcher.frames.get(timeout=PATIENCE_S).head.frame == 99
        assert feed.skipped == 3


def test_a_frame_is_a_copy_of_what_was_shown(bench):
    watcher = Watcher(let=False)
    levels = LEVELS.copy()
    with FrameFeed(watcher, bench) as feed:  # type: ignore[arg-type]
        wait_for(lambda: feed.watched)
        feed.see(Shown(1, 5, None, drawn(levels), draw_ns=1))
        levels[:] = 0  # the next frame is drawn
        watcher.let.set()
        assert watcher.frames.get(timeout=PATIENCE_S).codes.tolist() == [3, 7, 1]
