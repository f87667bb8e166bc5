"""The virtual tracker as a process: in real time, on its own clock, with errors that are planted,
it answers over a link.

An exposure is one of `exposure_s` every 1 / rate seconds. It is computed once a frame has come that
was lit after its end, or GRACE_PERIODS refreshes later. One that cannot begin in time, because
those before it took too long, is passed over and counted.
"""

import heapq
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilstar.attitude.wire.shown_frames import FrameWatch
from hilstar.basics.arrays import FloatArray
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    random_attitude,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.running_statistics import RunningStatistics
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S
from hilstar.instruments.simulate.exposure_times import (
    CameraExposures,
    ExposureTimes,
    FreeExposures,
)
from hilstar.instruments.simulate.live_exposure import LOST, TRACKING, LiveTracker, Solved
from hilstar.server.answers.answer import Answer
from hilstar.server.gige.camera import GigECamera

# An exposure's last frame may be late by some refreshes; a slow display has longer ones.
GRACE_PERIODS, MIN_GRACE_NS = 3, 50 * NS_PER_MS
SLICE_MS = 20
# errors about the boresight are this many times those across it, as stars have a fifth of the lever
ROLL = 4.0
FOV_PERIOD_PX = 400.0
MIN_FORWARD = 0.05
SILENT_AFTER_S = 5.0
MAX_ERRORS = 100_000


@dataclass(frozen=True, slots=True)
class Planted:
    """Errors planted in the simulated tracker, so that an assessment can be held against them.

    `bias_arcsec` is a constant turn about cam x, y and z. `fov_arcsec` and `pixel_arcsec` are one
    sigma about x and y, and ROLL times that about the boresight, of errors that repeat: a wave of
    400 px of the star field's place, and one of a pixel. `wrong` is the share of answers that are
    any attitude. Silence begins `after_s` and lasts `silent_s`.
    """

    bias_arcsec: tuple[float, ...] = (0.0, 0.0, 0.0)
    fov_arcsec: float = 0.0
    pixel_arcsec: float = 0.0
    wrong: float = 0.0
    silent_s: float = 0.0
    after_s: float = SILENT_AFTER_S
    latency_s: float = 0.0
    drift_ppm: float = 0.0
    offset_s: float = 0.0


class PlantedErrors:
    """Turns attitudes into those that a tracker with these errors reports."""

    def __init__(self, planted: Planted, focal_length_px: float, rng: np.random.Generator) -> None:
        self._planted = planted
        self._focal_px = focal_length_px
        self._rng = rng
        self._star: FloatArray | None = None  # on the boresight of the first answer, ICRS

    def reported(self, q_icrs_to_cam: FloatArray) -> tuple[FloatArray, bool]:
        """The attitude that is reported, and whether it is a wrong one."""
        if self._rng.random() < self._planted.wrong:
            return random_attitude(self._rng), True
        axes = to_matrix(q_icrs_to_cam)
        if self._star is None:
            self._star = axes[2].copy()
        star_in_cam = axes @ self._star
        place_px = self._focal_px * star_in_cam[:2] / max(star_in_cam[2], MIN_FORWARD)
        x, y = 2 * np.pi * place_px / FOV_PERIOD_PX
        of_field = np.array([np.sin(x), np.sin(y + 0.3), np.sin((x + y) / 1.7)])
        x, y = 2 * np.pi * place_px
        of_pixel = np.array([np.sin(x), np.sin(y), np.cos(x + 1)])
        waves = math.sqrt(2) * (
            self._planted.fov_arcsec * of_field + self._planted.pixel_arcsec * of_pixel
        )
        error = np.array(self._planted.bias_arcsec) + waves * [1.0, 1.0, ROLL]
        return multiply(from_rotation_vector(error / ARCSEC_PER_RAD), q_icrs_to_cam), False


class OwnClock:
    """The tracker's clock: off from the host's by `offset_s` when it begins, and fast by
    `drift_ppm`.
    """

    def __init__(self, planted: Planted, begun_ns: int) -> None:
        self._begun_ns = begun_ns
        self._rate = 1 + 1e-6 * planted.drift_ppm
        self._offset_ns = round(planted.offset_s * NS_PER_S)

    def of_host(self, host_ns: int) -> int:
        """Its time, ns."""
        return self._begun_ns + self._offset_ns + round((host_ns - self._begun_ns) * self._rate)

    def to_host(self, own_ns: int) -> int:
        """The host's time when it shows `own_ns`."""
        return self._begun_ns + round((own_ns - self._begun_ns - self._offset_ns) / self._rate)


Send = Callable[[Answer], None]


@dataclass(slots=True)
class TrackerTally:
    """Counts of a run, and the tracker's own error, arcsec about cam x, y, z, before anything
    was planted.
    """

    answers: int = 0
    valid: int = 0
    wrong: int = 0
    passed_over: int = 0
    unsent: int = 0
    modes: Counter[str] = field(default_factory=Counter)
    cpu_ms: RunningStatistics = field(default_factory=RunningStatistics)
    latency_ms: RunningStatistics = field(default_factory=RunningStatistics)
    stars: RunningStatistics = field(default_factory=RunningStatistics)
    errors_arcsec: list[FloatArray] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """The keys of `hilstar tracker --json`."""
        off = np.array(self.errors_arcsec).reshape(-1, 3)
        bias, sigma = (
            (None, None) if not len(off) else (off.mean(axis=0).tolist(), off.std(axis=0).tolist())
        )
        counts = {
            name: getattr(self, name) for name in ("answers", "valid", "wrong", "passed_over")
        }
        spread = {
            name: getattr(self, name).percentiles() for name in ("cpu_ms", "latency_ms", "stars")
        }
        return (
            counts
            | {"modes": dict(self.modes)}
            | spread
            | {"own_bias_arcsec": bias, "own_sigma_arcsec": sigma}
        )


class TrackerProcess:
    """A live tracker, its watch, its clock and its errors; each answer's `host_ns` is that of
    mid-exposure.
    """

    def __init__(
        self,
        tracker: LiveTracker,
        watch: FrameWatch,
        planted: Planted,
        rate_hz: float,
        rng: np.random.Generator,
        camera: GigECamera | None = None,
    ) -> None:
        self.tally = TrackerTally()
        self._camera = camera
        self._tracker = tracker
        self._watch = watch
        self._planted = planted
        self._period_ns = round(NS_PER_S / rate_hz)
        refresh_ns = NS_PER_S / tracker.config.monitor.refresh_hz
        self._grace_ns = max(round(GRACE_PERIODS * refresh_ns), MIN_GRACE_NS)
        self._errors = PlantedErrors(planted, tracker.camera.focal_length_px, rng)
        self._waiting: list[tuple[int, int, Answer]] = []  # when it is due, ns, and its number
        self._host: HostClock = HOST_CLOCK
        self._begun_ns = self._host.now_ns()
        self._clock = OwnClock(planted, self._begun_ns)

    def run(self, send: Send | None, stop: threading.Event, duration_s: float = math.inf) -> None:
        """Expose, and answer where there is a `send`, until stopped, or for a duration from the
        first frame on. Raises InputError for frames of another display.
        """
        while not self._tracker.frames.received and not stop.is_set():
            self._take(SLICE_MS)
        begun_ns = self._begun_ns = self._tracker.frames.newest_ns
        clock = self._clock = OwnClock(self._planted, begun_ns)
        end_ns = begun_ns + duration_s * NS_PER_S
        if self._camera is None:
            times: ExposureTimes = FreeExposures(clock, begun_ns, self._period_ns)
        else:
            self._camera.own_ns = clock.of_host
            times = CameraExposures(clock, begun_ns, self._camera, always=send is not None)
        while not stop.is_set():
            begin_ns = times.next_ns()
            if (self._host.now_ns() if begin_ns is None else begin_ns) >= end_ns:
                break
            if begin_ns is None:
                self._take(SLICE_MS)
                self._put(send)
                continue
            self._expose(begin_ns, send, stop, times)
        while self._waiting and not stop.is_set():
            self._host.wait_until(self._waiting[0][0], stop)
            self._put(send)

    def _expose(
        self, begin_ns: int, send: Send | None, stop: threading.Event, times: ExposureTimes
    ) -> None:
        """One exposure: its image to the camera, its answer to `send`."""
        tracker = self._tracker
        camera = self._camera
        if camera is not None:
            tracker.adjust(camera.settings.exposure_s, camera.settings.gain_db)
        end_ns = begin_ns + round(tracker.exposure_s * NS_PER_S)
        self._await(end_ns, send, stop)
        exposed = tracker.frames.exposed(begin_ns, end_ns)
        if exposed is None or stop.is_set():
            times.done()
            return
        cpu_s = time.process_time()
        dn = tracker.expose(exposed)
        if camera is not None:
            camera.take(dn, begin_ns)
        if send is None:
            solved = None
        else:
            solved = tracker.solve(exposed, dn)
        self.tally.cpu_ms.add(1e3 * (time.process_time() - cpu_s))
        times.done()
        acquired = False
        if solved is not None:
            self._report(solved)
            self._put(send)
            acquired = solved.mode == LOST and solved.identified is not None
        # the exposure after one that was acquired tells the rate, however long the solver took
        if not acquired:
            self.tally.passed_over += times.pass_over(end_ns, self._host.now_ns())

    def _await(self, end_ns: int, send: Send | None, stop: threading.Event) -> None:
        """Take frames until one was lit after an exposure's end, or none comes any more."""
        # those that came while the exposure before was solved, however late it is now
        self._take(0)
        while (
            not stop.is_set()
            and self._tracker.frames.newest_ns < end_ns
            and self._host.now_ns() < end_ns + self._grace_ns
        ):
            due_ns = min([end_ns + self._grace_ns, *(waiting[0] for waiting in self._waiting[:1])])
            self._take(min(SLICE_MS, max(1, math.ceil((due_ns - self._host.now_ns()) / NS_PER_MS))))
            self._put(send)

    def _take(self, timeout_ms: int) -> None:
        for frame in self._watch.frames(timeout_ms):
            self._tracker.take(frame)

    def _report(self, solved: Solved) -> None:
        """Count an exposure's answer and, unless the tracker is silent then, queue it for when it
        is due.
        """
        tally = self.tally
        q = None
        wrong = False
        middle_ns = solved.exposed.middle_ns
        since_s = (middle_ns - self._begun_ns) / NS_PER_S
        tally.modes[solved.mode] += 1
        tally.stars.add(0 if solved.identified is None else len(solved.identified.star))
        if solved.identified is not None:
            true = solved.exposed.q_icrs_to_cam
            if true is not None and len(tally.errors_arcsec) < MAX_ERRORS:
                off = to_rotation_vector(multiply(solved.identified.q_icrs_to_cam, conjugate(true)))
                tally.errors_arcsec.append(off * ARCSEC_PER_RAD)
            q, wrong = self._errors.reported(solved.identified.q_icrs_to_cam)
        if self._planted.after_s <= since_s < self._planted.after_s + self._planted.silent_s:
            tally.unsent += 1
            return
        tally.answers += 1
        tally.valid += q is not None
        tally.wrong += wrong
        if solved.identified is None:
            stars = 0
        else:
            stars = len(solved.identified.star)
        answer = Answer(
            host_ns=middle_ns,
            raw=b"",
            t_ns=self._clock.of_host(middle_ns),
            q_icrs_to_cam=q,
            rate_cam_rad_s=(
                self._tracker.rate_cam_rad_s()
                if q is not None and solved.mode == TRACKING
                else None
            ),
            valid=q is not None,
            mode=solved.mode,
            star_count=stars,
            rms_arcsec=(
                None if solved.identified is None else solved.identified.rms_rad * ARCSEC_PER_RAD
            ),
            centroids=self._tracker.reported_stars(solved),
        )
        heapq.heappush(
            self._waiting,
            (middle_ns + round(self._planted.latency_s * NS_PER_S), tally.answers, answer),
        )

    def _put(self, send: Send | None) -> None:
        """Send the answers that are due."""
        if send is None:
            return
        while self._waiting and self._waiting[0][0] <= self._host.now_ns():
            answer = heapq.heappop(self._waiting)[-1]
            send(answer)
            self.tally.latency_ms.add((self._host.now_ns() - answer.host_ns) / NS_PER_MS)
