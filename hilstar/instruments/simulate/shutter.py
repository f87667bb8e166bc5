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
    return replace(
        view,
        scan=Scan((0, 1 if detector.row_direction == "down" else -1), readout_s, view.scan.hold_s),
    )


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
        return range(first, math.ceil((reach_s - self.phase_s) / self.period_s) + 1)

    def begin_s(self, frame: int) -> float:
        """When a frame lights the screen's middle row."""
        return self.phase_s + frame * self.period_s

    def shares(self, frame: int, screen_late_s: FloatArray, row_late_s: FloatArray) -> FloatArray:
        """The share (n,) that a frame has of the light of an exposure at n places, relative to the
        screen's mean light.

        `screen_late_s` (n,) is how long after its middle row the screen lights a place,
        `row_late_s` (n,) how long after its middle row the tracker exposes it.
        """
        begin = self.begin_s(frame) + screen_late_s
        exposed = row_late_s - self.rows.hold_s / 2
        lit = np.minimum(begin + self.hold_s, exposed + self.rows.hold_s) - np.maximum(
            begin, exposed
        )
        return np.asarray(np.maximum(lit, 0.0) * (self.period_s / (self.hold_s * self.rows.hold_s)))


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
    turn = view.turn
    beat = RowBeat(view.scan, screen, 1 / config.monitor.refresh_hz, phase_s)
    sizes = config.monitor.resolution_px, config.tracker.resolution_px
    changes = (
        bool(turn.rate_cam_rad_s.any()) or len(bench.quantiser.exposure(0, len(beat.frames))) > 1
    )
    changes |= moving is not None and moving.satellites is not None
    compensated = config.render.motion == "on"
    total = np.zeros((len(panel.primaries) or 1, *sizes[0][::-1]))
    shown = None
    y, x = (part.ravel().astype(np.float64) for part in np.indices(sizes[1][::-1]))
    glow_late_s = np.nan_to_num(
        screen.late_s(*geometry.shown_at(*geometry.to_monitor(x, y)), sizes[0])
    )
    glow_rows_s = view.scan.late_s(x, y, sizes[1])
    glow = np.zeros(x.shape)
    for number, frame in enumerate(beat.frames):
        if changes or shown is None:
            seconds = beat.begin_s(frame) + (0.0 if compensated else beat.hold_s / 2)
            q = propagate(view.q_icrs_to_cam, turn.rate_cam_rad_s, seconds)
            if view.t_ns is None:
                t_ns = None
            else:
                t_ns = view.t_ns + round(seconds * NS_PER_S)
            rate = turn.rate_cam_rad_s if compensated else None
            shown = np.array(primary_lights(bench.draw(q, number, rate, t_ns=t_ns).levels, panel))
            rows, columns = np.nonzero(shown.any(axis=0))
            places = columns.astype(np.float64), rows.astype(np.float64)
            screen_late_s = screen.late_s(*places, sizes[0])
            row_late_s = np.nan_to_num(view.scan.late_s(*geometry.to_tracker(*places), sizes[1]))
        total[:, rows, columns] += shown[:, rows, columns] * beat.shares(
            frame, screen_late_s, row_late_s
        )
        glow += beat.shares(frame, glow_late_s, glow_rows_s)
    return total, glow.reshape(sizes[1][::-1])
