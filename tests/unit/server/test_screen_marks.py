"""The square that a photodiode watches, the keys of a window, and its gamma ramp, on a model
display; and what a frame loop tells of a turn that is too fast and of a GPU that is lost.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.errors import GpuError
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.display.render.aids import CROSSHAIR, PATCH
from hilstar.server.loop import FrameLoop, Limit
from hilstar.server.operator import GAMMA
from hilstar.server.pulse_summary import SyncSummary
from hilstar.server.screen.screen import CODE, CODE_BITS, DisplayPacer, marker_light
from tests.support.model_display import model_screen

STILL = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 0, False)


def test_any_seven_bits_of_the_square_s_code_tell_its_frames():
    """A maximal sequence: each of the 127 windows is another, and 64 bits are light (Golomb)."""
    length = 2**CODE_BITS - 1
    assert (len(CODE), sum(CODE), set(CODE)) == (length, 2 ** (CODE_BITS - 1), {0, 1})
    twice = CODE + CODE
    windows = {twice[k : k + CODE_BITS] for k in range(length)}
    assert len(windows) == length and (0,) * CODE_BITS not in windows
    # its recurrence: x^7 + x^6 + 1
    assert all(twice[k + 7] == twice[k + 1] ^ twice[k] for k in range(length))
    light = [marker_light(number, "code") for number in range(2 * length + 3)]
    assert light == [*twice, *CODE[:3]]
    assert [marker_light(number, "toggle") for number in range(5)] == [0, 1, 0, 1, 0]


@pytest.mark.parametrize(
    ("keys", "marker", "square", "patch"),
    [
        ("photodiode_px = 40\n", 1, (40, 255), 64),
        ('photodiode_px = 40\nphotodiode = "code"\n', CODE[3], (40, 255 * CODE[3]), 64),
        ("", None, (0, 0), 64),
        ("bits = 10\nphotodiode_px = 20\n", 1, (20, 1023), 256),
    ],
)
def test_square_and_patch_have_codes_of_the_monitor_s_own_bits(
    tmp_path, keys, marker, square, patch
):
    screen, _ = model_screen(tmp_path, monitor=keys)
    shown = []
    screen.bench.renderer.present = lambda *values: shown.append(values)
    screen.aids.set("patch", True, 0.25)
    screen.aids.toggle("crosshair")
    assert screen.present(3) == marker
    assert shown == [(PATCH | CROSSHAIR, patch, square)]
    screen.window.gone = "unplugged"
    screen.present(4)
    assert len(shown) == 1  # nothing is drawn on a window that is gone


@pytest.mark.parametrize("quits", ["q", "escape"])
def test_keys_turn_the_aids_and_quit(tmp_path, quits):
    screen, model = model_screen(tmp_path)
    model.window.keys = deque(["b", "c", "x", "b", "g"])
    screen.swap()
    states = screen.aids.states()
    assert [name for name, on in states.items() if on] == ["crosshair", "grid"]
    assert not screen.closing
    model.window.keys.append(quits)
    screen.swap(timed=False)
    assert screen.closing


def test_a_swap_that_is_not_timed_leaves_the_grid(tmp_path):
    screen, model = model_screen(tmp_path)
    model.window.keys = deque()
    seen = []
    screen.clock = SimpleNamespace(update=seen.append, paced_by_screen=True, period_ns=1.0)
    screen.swap(timed=False)
    assert seen == []
    swap_ns = screen.swap()
    assert seen == [swap_ns]


def test_a_bent_gamma_ramp_is_told_while_it_lasts_with_its_frames_and_time(tmp_path):
    screen, model = model_screen(tmp_path)
    model.window.keys = deque()
    notices = Notices()
    model.window.timestamp_source = "a model"
    pacer = DisplayPacer(screen, notices, model.clock)
    for swap_ns, bent in ((100, False), (116, True), (133, True), (150, False), (166, False)):
        model.window.ramp_changed = bent
        pacer._look_at_ramp(swap_ns)
        assert (GAMMA in notices.lasting) is bent
    told = pacer.summary({"swaps": 7})
    assert told["gamma"] == {"frames": 2, "s": (133 - 100) / NS_PER_S}
    assert (told["swaps"], told["queued_frames"]) == (7, 0)
    assert notices.counts() == {GAMMA: 1, "gamma-straight": 1}


class LoopBench:
    """The bench of a model screen, as a frame loop takes it, whose paths are coarser in some
    frames.
    """

    def __init__(self, tmp_path) -> None:
        self.screen, self.model = model_screen(tmp_path)
        self.model.window.keys = deque()
        self.bench = self.screen.bench
        self.capped = [0, 3, 5, 0]
        self.bench.draw_sprites = self.drawn

    def drawn(self, sprites, number):
        """Frame by frame."""
        return SimpleNamespace(
            levels=None, star_count=0, clipped_hip=(), capped=self.capped[number],
            rate_cam_rad_s=None,
        )  # fmt: skip


def test_coarser_paths_are_told_with_the_first_frame_and_counted(tmp_path):
    made = LoopBench(tmp_path)
    notices = Notices()
    told = []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    loop = FrameLoop(made.bench, notices=notices)
    for number in range(4):
        loop.draw(number, number, STILL)
    capped = [detail for kind, detail in told if kind == "capped"]
    assert len(capped) == 1 and capped[0].startswith("frame 1: ") and "; 3 stars" in capped[0]
    assert loop.tally.capped_frames == 2


def test_a_gpu_that_is_lost_in_a_frame_is_told_and_ends_the_run(tmp_path):
    made = LoopBench(tmp_path)
    notices = Notices()
    loop = FrameLoop(made.bench, notices=notices)

    def lost(sprites, number):
        raise GpuError("the GPU was reset")

    made.bench.draw_sprites = lost
    with pytest.raises(GpuError):
        loop.draw(0, 0, STILL)
    assert notices.counts()["gpu-lost"] == 1
    assert loop.stop.is_set()


def test_a_fault_of_the_gpu_from_before_the_run_is_told(tmp_path):
    made = LoopBench(tmp_path)
    made.bench.renderer.fault = lambda: "an error was raised"
    notices = Notices()
    FrameLoop(made.bench, notices=notices)
    assert notices.counts() == {"gpu-error": 1}


def test_a_run_s_limit_is_the_smaller_of_periods_and_frames():
    assert Limit(slots=30, frames=20).shortest == 20
    assert Limit(slots=10).shortest == 10
    assert replace(Limit(), frames=5).shortest == 5


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {},
            "90 over COM3, 2 skipped, losses of the line: 1; 0.250 ms after their frames, jitter"
            " 0.125 ms",
        ),
        ({"lost": 0, "delay_ms": None}, "90 over COM3, 2 skipped"),
    ],
)
def test_pulses_are_said_with_their_delay_where_it_is_known(changes, line):
    known = {
        "port": "COM3", "pulses": 90, "skipped": 2, "lost": 1, "delay_ms": 0.25,
        "jitter_ms": 0.125, "max_delay_ms": 1.0, "line_ms": 0.5,
    }  # fmt: skip
    told = SyncSummary(**(known | changes)).line()
    assert told.removesuffix(" (standard deviation)") == line
