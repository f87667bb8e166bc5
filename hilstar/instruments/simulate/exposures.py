"""Exposures of the virtual tracker along a log: their views, and the faults in them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.log_file import log_timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import rate_between_rad_s
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.simulate.simulator import (
    ExposurePiece,
    FaultyExposure,
    Simulator,
    pieces_of,
    simulator_view,
)
from hilstar.optics.layers.view import View
from hilstar.server.bench.scenario import Scenario, Timetable


def log_views(
    samples: list[AttitudeSample],
    frame_count: int | None,
    exposure_s: float,
    max_rate_rad_s: float = math.inf,
) -> list[View]:
    """The exposures along a log: in the middle of each its attitude, and the mean rate over the
    exposure.

    One at each sample, or `frame_count` of them evenly from the first to the last. Within half an
    exposure of the log's ends the rate is that of the part inside.
    """
    timeline = log_timeline(samples, Policy(0, NS_PER_S, max_rate_rad_s))
    first_ns = samples[0].t_ns
    last_ns = samples[-1].t_ns
    if frame_count is None:
        times_ns = [sample.t_ns for sample in samples]
    else:
        times_ns = np.rint(np.linspace(first_ns, last_ns, frame_count)).astype(int).tolist()
    views = []
    for t_ns in times_ns:
        views.append(view_at(timeline, (first_ns, last_ns), t_ns, exposure_s))
    return views


def view_at(timeline: Timeline, span_ns: tuple[int, int], t_ns: int, exposure_s: float) -> View:
    """The exposure around `t_ns` of a log that lasts over `span_ns` (see `log_views`)."""
    half_ns = round(exposure_s * NS_PER_S / 2)
    first_ns, last_ns = span_ns
    begin_ns = max(first_ns, t_ns - half_ns)
    end_ns = min(last_ns, t_ns + half_ns)
    begin = timeline.at(begin_ns)
    middle = timeline.at(t_ns)
    end = timeline.at(end_ns)
    if begin is None or middle is None or end is None:
        raise AssertionError("a log has a sample")
    rate = np.zeros(3)
    if end_ns > begin_ns:
        seconds = (end_ns - begin_ns) / NS_PER_S
        rate = rate_between_rad_s(begin.q_icrs_to_cam, end.q_icrs_to_cam, seconds)
    return View.exposure(middle.q_icrs_to_cam, rate, exposure_s, t_ns)


@dataclass(frozen=True, slots=True)
class LogFaults:
    """A scenario along a log, from whose first sample it counts."""

    scenario: Scenario
    samples: list[AttitudeSample]
    max_rate_rad_s: float = math.inf

    def pieces(self, simulator: Simulator, views: list[View]) -> list[tuple[ExposurePiece, ...]]:
        """Each exposure, cut where a fault begins or ends. Raises InputError for a fault that
        cannot be drawn.
        """
        faults = simulator_view(simulator, self.scenario)
        exposure_s = simulator.config.tracker.exposure_s
        timetable = Timetable(self.scenario, faults.prepare, exposure_s)
        timeline = log_timeline(self.samples, Policy(0, NS_PER_S, self.max_rate_rad_s))
        zero_ns = self.samples[0].t_ns

        def attitude_at(run_ns: int) -> FloatArray:
            state = timeline.at(zero_ns + run_ns)
            if state is None:
                raise AssertionError("a log has a sample")
            return state.q_icrs_to_cam

        pieces = []
        for view in views:
            run_ns = (view.t_ns or 0) - zero_ns
            pieces.append(pieces_of(view, run_ns, timetable, attitude_at))
        return pieces


def faulty_exposure(
    simulator: Simulator, views: Sequence[View], scenario: Scenario, run_ns: int
) -> FaultyExposure:
    """One exposure by the views of its pieces, one after the other, with the faults of a scenario;
    its middle is at `run_ns` of that. Raises InputError (see `FaultView.prepare`).
    """
    faults = simulator_view(simulator, scenario)
    timetable = Timetable(scenario, faults.prepare, simulator.config.tracker.exposure_s)
    half_lengths_ns = [round(view.exposure_s * NS_PER_S / 2) for view in views]
    at_ns = run_ns - sum(half_lengths_ns)
    pieces: list[ExposurePiece] = []
    for view, half_ns in zip(views, half_lengths_ns, strict=True):
        pieces += pieces_of(view, at_ns + half_ns, timetable)
        at_ns += 2 * half_ns
    return FaultyExposure(faults, pieces)
