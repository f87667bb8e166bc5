"""A detector whose rows are exposed one after the other, before the sky or a screen that lights
row by row.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import propagate
from hilstar.basics.units import NS_PER_S
from hilstar.display.panel import Panel
from hilstar.display.quantise import primary_lights
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.layers.view import View
from hilstar.optics.scan import Scan
from hilstar.server.bench.config import Tracker
from hilstar.server.bench.frame import Bench
from hilstar.server.sync import SHORTEST_LIT

S_PER_US = 1e-6


def rolled(view: View, tracker: Tracker) -> View:
    """An exposure with the rows of a tracker's shutter; the same where all pixels are exposed at
    once.

    `q_icrs_to_cam` and `t_ns` are then those in the middle of the middle row's exposure.
    """
    detector = tracker.detector
    if detector.shutter != "rolling":
        return view
    readout_s = tracker.resolution_px[1] * detector.row_time_us * S_PER_US
    down = 1 if detector.row_direction == "down" else -1
    return replace(view, scan=Scan((0, down), readout_s, view.scan.hold_s))


@dataclass(frozen=True, slots=True)
class RowBeat:
    """A screen that lights row by row before rows that are exposed in turn: `rows` of the tracker,
    `screen` of the display.

    Frame k lights the screen's middle row `phase_s` + k periods after the middle of the exposure of
    the tracker's middle row.
    """

    rows: Scan
    screen: Scan
    period_s: float
    phase_s: float

    @property
    def hold_s(self) -> float:
        """How long a row of the screen is lit by a frame."""
        return min(max(self.screen.hold_s, SHORTEST_LIT * self.period_s), self.period_s)

    @property
    def frames(self) -> range:
        """The frames that any row may see."""
        reach_s = (self.rows.whole_s + self.screen.scanout_s) / 2
        first = math.floor((-reach_s - self.hold_s - self.phase_s) / self.period_s)
        last = math.ceil((reach_s - self.phase_s) / self.period_s)
        return range(first, last + 1)

    def begin_s(self, frame: int) -> float:
        """When a frame lights the screen's middle row."""
        return self.phase_s + frame * self.period_s

    def shares(self, frame: int, screen_late_s: FloatArray, row_late_s: FloatArray) -> FloatArray:
        """The share (n,) that a frame has of the light of an exposure at n places, relative to the
        screen's mean light.

        `screen_late_s` (n,) is how long after its middle row the screen lights a place,
        `row_late_s` (n,) how long after its middle row the tracker exposes it.
        """
        lit_begin_s = self.begin_s(frame) + screen_late_s
        exposed_begin_s = row_late_s - self.rows.hold_s / 2
        both_begin_s = np.maximum(lit_begin_s, exposed_begin_s)
        both_end_s = np.minimum(lit_begin_s + self.hold_s, exposed_begin_s + self.rows.hold_s)
        both_s = np.maximum(both_end_s - both_begin_s, 0.0)
        return np.asarray(both_s * (self.period_s / (self.hold_s * self.rows.hold_s)))


def rolling_light(
    bench: Bench, geometry: BenchGeometry, panel: Panel, view: View, phase_s: float
) -> tuple[FloatArray, FloatArray]:
    """The mean light (primaries, H, W) of a display over each place's own exposure, and the glow's
    share of its mean (h, w).

    Frames begin at the view's time, at `phase_s` as in `RowBeat`.
    """
    config = bench.config
    screen = bench.scan
    moving = bench.moving
    rate_cam_rad_s = view.turn.rate_cam_rad_s
    beat = RowBeat(view.scan, screen, 1 / config.monitor.refresh_hz, phase_s)
    screen_px, tracker_px = config.monitor.resolution_px, config.tracker.resolution_px
    # a frame is drawn anew only where it differs from the one before
    drawn_frames = bench.quantiser.exposure(0, len(beat.frames))
    changes = bool(rate_cam_rad_s.any()) or len(drawn_frames) > 1
    changes |= moving is not None and moving.satellites is not None
    compensated = config.render.motion == "on"
    total = np.zeros((len(panel.primaries) or 1, *screen_px[::-1]))
    shown = None
    y_px, x_px = np.indices(tracker_px[::-1]).reshape(2, -1).astype(np.float64)
    glow_places = geometry.shown_at(*geometry.to_monitor(x_px, y_px))
    glow_late_s = np.nan_to_num(screen.late_s(*glow_places, screen_px))
    glow_rows_s = view.scan.late_s(x_px, y_px, tracker_px)
    glow = np.zeros(x_px.shape)
    for number, frame in enumerate(beat.frames):
        if changes or shown is None:
            seconds = beat.begin_s(frame)
            if not compensated:
                seconds += beat.hold_s / 2
            q = propagate(view.q_icrs_to_cam, rate_cam_rad_s, seconds)
            t_ns = None
            if view.t_ns is not None:
                t_ns = view.t_ns + round(seconds * NS_PER_S)
            rate = rate_cam_rad_s if compensated else None
            levels = bench.draw(q, number, rate, t_ns=t_ns).levels
            shown = np.array(primary_lights(levels, panel))
            rows, columns = np.nonzero(shown.any(axis=0))
            places = columns.astype(np.float64), rows.astype(np.float64)
            screen_late_s = screen.late_s(*places, screen_px)
            tracker_places = geometry.to_tracker(*places)
            row_late_s = np.nan_to_num(view.scan.late_s(*tracker_places, tracker_px))
        shares = beat.shares(frame, screen_late_s, row_late_s)
        total[:, rows, columns] += shown[:, rows, columns] * shares
        glow += beat.shares(frame, glow_late_s, glow_rows_s)
    return total, glow.reshape(tracker_px[::-1])
