"""A run as the process of its page reads it from the shared memory: every point of its charts, its
pacing, its events and its pictures, against what was written.
"""

from __future__ import annotations

import json
import statistics
import struct
import zlib
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector, multiply
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.calibration import load_calibration
from hilstar.display.geometry import monitor_camera
from hilstar.display.render.aids import BLANK, AidLevels
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console.messages import (
    FRAME,
    HAS_AGE,
    FrameNumbers,
    NewAnswer,
    PictureHead,
    RunEvent,
    RunState,
    Setup,
    SharedMemory,
)
from hilstar.server.console.overlay import CameraMarks, OverlayScene
from hilstar.server.console.page_figures import RunCounts
from hilstar.server.console.protocol import (
    HISTORY_S,
    AttitudeSource,
    ChartPoint,
    EventLine,
    Hello,
    NewestFrame,
    Pacing,
    SkyMap,
)
from hilstar.server.console.server import reader
from hilstar.server.console.server.reader import PicturePacker, RunReader, utc_text

BEGUN_NS, BEGUN_UNIX_S = 7_000 * NS_PER_S, 1_764_457_200.0  # 2025-11-29, 23:00 UTC
WIDTH, HEIGHT = 5, 3
HELLO = Hello(
    version="0",
    command="hilstar serve",
    bench="bench.toml",
    started_utc="",
    resolution_px=(WIDTH, HEIGHT),
    white_level=255,
    bits=8,
    refresh_hz=60.0,
    control=False,
)
SETUP = Setup(
    hello=HELLO,
    source=AttitudeSource("udp", "udp://127.0.0.1:5560"),
    hosts=[],
    names=[],
    any_address=False,
    port=1,
    token="",
    picture_bytes=2 * WIDTH * HEIGHT,
    pace="clock",
)
WELL = NewestFrame(number=1, missing=False, blank=False)


class WatchedRun:
    """A run whose memory and clocks are the test's, and the reader of its page: times are ms after
    the reader's begin.
    """

    def __init__(self, monkeypatch) -> None:
        self.at_ms = 0.0
        clocks = SimpleNamespace(
            monotonic_ns=lambda: self.now_ns, time=lambda: BEGUN_UNIX_S + self.at_ms / 1e3
        )
        monkeypatch.setattr(reader, "time", clocks)
        self.memory = SharedMemory.make(SETUP.picture_bytes)
        self.reader = RunReader(self.memory, SETUP)

    @property
    def now_ns(self) -> int:
        """Host time now."""
        return BEGUN_NS + round(self.at_ms * NS_PER_MS)

    def frame(
        self,
        swap_ms: float,
        took_ms: float,
        age_ms: float | None,
        counts: tuple[int, int, int],
        missed_before: int = 0,
    ) -> None:
        """A frame is shown; `counts` are the run's frames, missed frames and refused packets."""
        swap_ns = BEGUN_NS + round(swap_ms * NS_PER_MS)
        numbers = FrameNumbers(
            number=counts[0] - 1,
            draw_ns=swap_ns - round(took_ms * NS_PER_MS),
            swap_ns=swap_ns,
            predicted_swap_ns=swap_ns + 1,
            age_ns=round((900.0 if age_ms is None else age_ms) * NS_PER_MS),
            missed_before=missed_before,
            frames=counts[0],
            missed=counts[1],
            refused=counts[2],
            flags=HAS_AGE * (age_ms is not None),
        )
        self.memory.frames.put(FRAME.pack(*numbers))

    def look(self, at_ms: float, frames: int, missed: int, received: int) -> ChartPoint:
        """The run writes its state with these counts, and the reader looks; the chart's point."""
        self.at_ms = at_ms
        counts = RunCounts(frames=frames, missed=missed, received=received)
        state = RunState(host_ns=self.now_ns, alive_ns=self.now_ns, frame=WELL, counts=counts)
        self.memory.states.put(msgspec.json.encode(state))
        self.reader.look()
        return self.reader.points[-1]


@pytest.fixture
def run(monkeypatch) -> WatchedRun:
    return WatchedRun(monkeypatch)


def test_each_point_of_the_charts_has_what_came_since_the_one_before(run):
    run.frame(42.5, 12.5, -2.5, (1, 0, 1))
    run.frame(59.0, 9.0, 7.0, (2, 0, 1))
    assert run.look(100.0, 2, 0, 40) == ChartPoint(
        t_s=0.1, age_ms=7.0, frame_ms=12.5, interval_ms=16.5
    )
    # two refreshes without a frame, three packets refused; the next frame has no attitude
    run.frame(110.0, 20.0, 3.0, (3, 2, 4), missed_before=2)
    run.frame(125.25, 5.25, None, (4, 2, 5))
    assert run.look(200.0, 4, 2, 46) == ChartPoint(
        t_s=0.2, age_ms=3.0, frame_ms=20.0, interval_ms=51.0, missed=2, refused=4, packets_hz=60.0
    )
    # two frames were overwritten before they were read: no interval and no difference over them
    run.frame(304.0, 4.0, 1.0, (7, 4, 8))
    assert run.look(350.0, 7, 4, 61) == ChartPoint(
        t_s=0.35, age_ms=1.0, frame_ms=4.0, packets_hz=84.0
    )
    run.frame(320.0, 4.5, 0.5, (8, 5, 10))
    run.frame(336.0, 4.25, 0.25, (9, 5, 10))
    assert run.look(360.0, 9, 5, 61) == ChartPoint(
        t_s=0.36,
        age_ms=0.5,
        frame_ms=4.5,
        interval_ms=16.0,
        missed=1,
        refused=2,
        packets_hz=80.77,  # 21 in 260 ms
    )
    # nothing further came; of the packets those of the last second count
    assert run.look(1300.0, 9, 5, 100) == ChartPoint(t_s=1.3, packets_hz=41.05)  # 39 in 950 ms


@pytest.mark.parametrize(
    ("frames", "missed", "share"), [(9, 11, "55 %"), (29, 1, None), (0, 20, "100 %")]
)
def test_the_share_of_missed_frames_is_of_those_that_were_due_in_the_last_second(
    run, frames, missed, share
):
    run.look(0.0, 1000, 5000, 0)  # long before
    run.look(1200.0, 1060, 5007, 0)
    run.look(1900.0, 1060 + frames, 5007 + missed, 0)
    health = run.reader.health_now()
    if share is None:
        assert health.headline == "Sky is right"
    else:
        assert (health.ok, health.late) == (False, True)
        assert health.headline == f"{share} of frames missed in the last second"


def shown_at(run: WatchedRun, intervals_ms: list[float], late_each: int) -> float:
    """Show frames at intervals, of which each so many come after a missed one; the last swap, ms."""
    swap_ms = 1.0
    run.frame(swap_ms, 1.0, None, (1, 0, 0))
    for k, interval_ms in enumerate(intervals_ms, start=1):
        late = late_each and not k % late_each
        swap_ms += interval_ms
        run.frame(swap_ms, 1.0, None, (k + 1, 0, 0), missed_before=int(bool(late)))
    return swap_ms


def test_pacing_is_of_the_intervals_without_a_missed_frame(run):
    """The percentiles and the deviation of the standard library."""
    intervals_ms = [16.0, 17.5, 15.0, 300.0, 16.25, 19.0, 16.5, 400.0]
    intervals_ms += [15.5, 16.75, 18.0, 500.0, 14.0, 17.0, 16.0]
    plain = [interval_ms for interval_ms in intervals_ms if interval_ms < 100.0]
    count = len(intervals_ms) + 1
    last_ms = shown_at(run, intervals_ms, 4)
    run.look(last_ms, count, 0, 0)
    wanted = Pacing(
        statistics.median(plain),
        round(statistics.quantiles(plain, n=100, method="inclusive")[98], 3),
        round(statistics.stdev(plain), 4),
    )
    assert run.reader.state().pacing == wanted
    # it is found anew each second
    run.frame(last_ms + 90.0, 1.0, None, (count + 1, 0, 0))
    run.look(last_ms + 999.0, count + 1, 0, 0)
    assert run.reader.state().pacing == wanted
    run.look(last_ms + 1001.0, count + 1, 0, 0)
    assert run.reader.state().pacing.sd_ms == round(statistics.stdev([*plain, 90.0]), 4)
    # a minute later those of that minute count alone
    late_ms = last_ms + HISTORY_S * 1e3
    for k in range(len(plain)):
        numbers = (count + 2 + k, 0, 0)
        run.frame(late_ms + 20.0 * k, 1.0, None, numbers, missed_before=int(k == 0))
    run.look(late_ms + 2000.0, count + 1 + len(plain), 0, 0)
    assert run.reader.state().pacing.sd_ms == 0.0
    # and of none there is no pacing
    run.look(late_ms + HISTORY_S * 1e3 + 4000.0, count + 1 + len(plain), 0, 0)
    assert run.reader.state().pacing is None


def test_events_are_told_once_and_kept_with_their_time_of_day(run):
    run.memory.events.put(msgspec.json.encode(RunEvent(BEGUN_UNIX_S + 0.25, "stale", "it is")))
    run.memory.events.put(b'{"unix_s": 3, "kind": "cut off')
    run.memory.events.put(msgspec.json.encode(RunEvent(BEGUN_UNIX_S + 61.0625, "fresh", "again")))
    told = [
        EventLine("2025-11-29T23:00:00.250Z", "stale", "it is"),
        EventLine("2025-11-29T23:01:01.062Z", "fresh", "again"),
    ]
    assert run.reader.look() == told
    assert run.reader.look() == []
    run.memory.events.put(msgspec.json.encode(RunEvent(BEGUN_UNIX_S, "last", "one")))
    newest = EventLine("2025-11-29T23:00:00.000Z", "last", "one")
    assert run.reader.look() == [newest]
    assert list(run.reader.events) == [*told, newest]


def test_a_state_that_cannot_be_read_leaves_the_one_before(run):
    run.look(100.0, 3, 1, 9)
    run.memory.states.put(b'{"host_ns": 12')
    run.reader.look()
    assert run.reader.state().counts == RunCounts(frames=3, missed=1, received=9)
    assert run.reader.state().utc == "2025-11-29T23:00:00.100Z"
    assert run.reader.state().source == SETUP.source


def test_since_when_the_sky_is_wrong_outlives_the_page_s_process(run):
    run.reader.look()  # the run has not begun
    assert run.memory.wrong_since_s == BEGUN_UNIX_S
    run.look(5_000.0, 1, 0, 0)
    assert (run.memory.wrong_since_s, run.reader.health_now().ok) == (0.0, True)
    run.at_ms = 9_000.0  # the state is too old now
    run.reader.look()
    assert run.memory.wrong_since_s == BEGUN_UNIX_S + 9
    run.at_ms = 60_000.0
    anew = RunReader(run.memory, SETUP)
    anew.look()
    assert anew.health_now().since == utc_text(BEGUN_UNIX_S + 9)
    assert run.memory.wrong_since_s == BEGUN_UNIX_S + 9


def test_wrong_answers_are_counted_by_point_and_a_right_residual_stands_in_its_own_alone(run):
    def answered(wrong: int, verdict: str, residual: list[float] | None) -> None:
        figures = TrackerFigures(wrong=wrong, verdict=verdict, residual_arcsec=residual)
        run.memory.answers.put(msgspec.json.encode(NewAnswer(figures)))
        run.reader.new_answer()

    answered(2, "right", [1.5, -2.5, 30.0])
    answered(4, "wrong", [9e4, 8e4, 7e4])
    point = run.look(100.0, 1, 0, 0)
    assert (point.wrong, point.x_arcsec, point.y_arcsec, point.z_arcsec) == (4, 1.5, -2.5, 30.0)
    assert run.look(200.0, 1, 0, 0) == ChartPoint(t_s=0.2, packets_hz=0.0)
    answered(5, "right", [0.5, 0.25, -4.0])
    point = run.look(300.0, 1, 0, 0)
    assert (point.wrong, point.x_arcsec, point.y_arcsec, point.z_arcsec) == (1, 0.5, 0.25, -4.0)


def scene(aids_in_levels: bool = False) -> OverlayScene:
    """A scene of four stars, the last of which is a body without a number."""
    monitor = monitor_camera((WIDTH, HEIGHT), 100.0, 500.0, np.array([1.0, 0.0, 0.0, 0.0]), None)
    tracker = monitor_camera((6, 4), 50.0, 500.0, np.array([1.0, 0.0, 0.0, 0.0]), None)
    return OverlayScene(
        marks=CameraMarks(monitor, tracker),
        hip=np.array([101, 24436, 103, 0], np.int32),
        v_mag=np.array([5.25, 0.125, 3.5, np.inf], np.float32),
        names={3: "Vesta"},
        sky=SkyMap(),
        aids=AidLevels(load_calibration("gamma2.2", 8).response, 8, (2, 1)),
        aids_in_levels=aids_in_levels,
        colours={2: "red 40%"},
    )


LEVELS = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 17


def put_picture(run: WatchedRun, q=(), levels=LEVELS) -> None:
    """A picture of frame 70 with sprites: the body, a star that moves in three, and two others."""
    star = np.array([3, 2, 0, 2, 1, 2])
    x_px = np.array([4.25, 1.0, 0.5, 2.0, 3.125, 2.25])
    y_px = np.array([0.25, 2.0, 1.5, 1.0, 0.75, 0.75])
    head = PictureHead(70, 5, 6, WIDTH, HEIGHT, levels.itemsize, len(star), *q)
    run.memory.put_picture(head, levels, (star, x_px, y_px))


def levels_of(picture: bytes) -> np.ndarray:
    """The levels in a binary message, by its own head."""
    (length,) = struct.unpack_from("<I", picture)
    form = json.loads(picture[4 : 4 + length])
    assert (form["frame"], form["deflate"]) == (70, True)
    data = zlib.decompress(picture[4 + length :])
    return np.frombuffer(data, f"<{form['dtype']}").reshape(form["h"], form["w"])


def test_a_picture_has_its_levels_and_a_mark_for_each_of_its_stars_the_brightest_first(run):
    packer = PicturePacker(run.memory, scene())
    seen = RunState(host_ns=1, frame=NewestFrame(clipped=[24436, "Vesta"]))
    assert packer.newest(0, seen) is None
    put_picture(run)
    packed = packer.newest(0, seen)
    assert packed is not None and packed.number == 1
    assert packer.newest(1, seen) is None
    assert levels_of(packed.picture).tolist() == LEVELS.tolist()
    truth = json.loads(packed.truth)["truth"]
    assert truth["frame"] == 70
    # x, y, V, HIP, label, clipped, colour; the star in three sprites stands at their mean
    assert truth["stars"] == [
        [3.12, 0.75, 0.12, 24436, "β Ori", 1, ""],
        [1.75, 1.25, 3.5, 103, "HIP 103", 0, "red 40%"],
        [0.5, 1.5, 5.25, 101, "HIP 101", 0, ""],
        [4.25, 0.25, None, 0, "Vesta", 1, ""],
    ]
    assert truth["boresight_px"] == [2.0, 1.0]


def test_aids_are_laid_over_a_picture_unless_its_levels_have_them(run):
    put_picture(run)
    blank = RunState(host_ns=1, overlay=BLANK)
    for aids_in_levels, is_dark in ((False, True), (True, False)):
        packed = PicturePacker(run.memory, scene(aids_in_levels)).newest(0, blank)
        assert packed is not None
        assert bool(levels_of(packed.picture).any()) is not is_dark


def test_a_session_s_picture_has_no_marks(run):
    put_picture(run, levels=(LEVELS // 2).astype(np.uint8))
    packed = PicturePacker(run.memory, None).newest(0, RunState(host_ns=1, overlay=BLANK))
    assert packed is not None
    assert levels_of(packed.picture).tolist() == (LEVELS // 2).tolist()
    assert json.loads(packed.truth) == {"truth": {"frame": 70, "stars": []}}


def test_an_answer_s_field_and_stars_stand_where_it_says_in_the_shown_sky(run):
    """A tracker whose attitude is turned by e takes a star at v for one at v + e x v: its middle z
    stands at z - e x z, by f times the error about x down, and about y to the left.
    """
    focal_px = 5000.0  # 500 mm and 100 um
    x_rad, y_rad = 2e-4, -3e-4
    lit = from_radec_roll_deg(84.057, -1.2, 30.0)
    # the sky has turned on since: about y, stars to the left
    shown = multiply(from_rotation_vector(np.array([0.0, -1e-4, 0.0])), lit)
    put_picture(run, tuple(shown))
    arcsec = np.degrees(np.array([x_rad, y_rad, 0.0])) * 3600
    figures = TrackerFigures(verdict="right", residual_arcsec=arcsec.tolist())
    answer = NewAnswer(figures, tuple(lit.tolist()), [(2.5, 1.5), (3.5, 0.5)])
    packed = PicturePacker(run.memory, scene()).newest(0, RunState(host_ns=1), answer)
    assert packed is not None
    truth = json.loads(packed.truth)["truth"]
    grid = json.loads(packed.truth_with_grid)["truth"]
    assert "grid" not in truth and grid.pop("grid") and grid == truth
    outline = np.array(truth["tracker_px"])
    moved = np.array(truth["reported_px"]) - outline
    wanted = [-focal_px * y_rad, focal_px * x_rad]
    assert moved == pytest.approx(np.tile(wanted, (len(outline), 1)), abs=0.011)
    # tracker pixels are half as large; the middle of the tracker is that of the monitor
    turned_px = focal_px * -1e-4
    wanted = [[2.0 + turned_px, 1.0], [2.5 + turned_px, 0.5]]
    assert np.array(truth["centroids_px"]) == pytest.approx(np.array(wanted), abs=0.011)
    # without an attitude neither is placed
    put_picture(run)
    packed = PicturePacker(run.memory, scene()).newest(1, RunState(host_ns=1), answer)
    assert packed is not None and "reported_px" not in json.loads(packed.truth)["truth"]
