"""The demo: a sender process streams a slew, and this process shows it."""

import math
import shlex
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.attitude.logs.log_file import write_log
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqReceiver
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import MachineError
from hilstar.basics.files import make_directory
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import from_radec_roll_deg, propagate, rate_between_rad_s, slerp
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.response import Codes
from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.frame_files import write_codes_png, write_preview_png
from hilstar.server.loop import Limit
from hilstar.server.pacer import FrameSink, Shown
from hilstar.server.serve import Outlet, serve
from hilstar.server.summary import RunSummary

SEND_HZ = 100.0
SLEW_LOG = "slew.jsonl"
# From Orion's belt to Sirius and on to Procyon, with the roll that a real manoeuvre drags along.
WAYPOINTS_DEG = ((84.057, -1.2, 0.0), (101.287, -16.716, 25.0), (114.825, 5.225, -10.0))
# To and fro about the first of them, as a tracker at work: degrees, and the seconds of a turn, of
# RA, declination and roll.
SCAN = ((2.0, 67.0), (2.0, 47.0), (10.0, 91.0))
# 40 deg/s at most; a shorter run ends within the slew. Receivers refuse 60 deg/s
LEAST_SLEW_S = 5.0
SETTLE_FRACTION = 0.15  # share of each leg, at rest at its end
JITTER_ARCSEC = (1.5, 1.5, 6.0)  # 1 sigma about cam x, y, z: a good wheel-controlled satellite
JITTER_SECONDS = 0.4  # its correlation time
REST_S = 5.0  # at the slew's end: a busy machine's loop may end later than its sender's slew
PICTURES_AT = (0.0625, 0.25, 0.5, 0.9375)  # shares of the run
LISTENER_WITHIN_S = 120.0


@dataclass(frozen=True, slots=True)
class Demo:
    """The result of the demo: its summary, and the codes of a few frames, of `bits` each, by
    frame number.
    """

    summary: RunSummary
    kept: dict[int, Codes]
    bits: int


def slew_samples(duration_s: float, rng: np.random.Generator) -> list[AttitudeSample]:
    """A rest-to-rest slew through WAYPOINTS_DEG at SEND_HZ, quintic in angle, with jitter, then
    REST_S at rest.
    """
    points = [from_radec_roll_deg(*waypoint) for waypoint in WAYPOINTS_DEG]

    def slew(t_s: float) -> FloatArray:
        progress = min(t_s / max(duration_s, LEAST_SLEW_S), 1.0) * (len(points) - 1)
        leg = min(int(progress), len(points) - 2)
        s = min((progress - leg) / (1 - SETTLE_FRACTION), 1.0)
        return slerp(points[leg], points[leg + 1], s**3 * (10 - 15 * s + 6 * s * s))

    return _jittered(slew, duration_s, rng)


def scan_samples(duration_s: float, rng: np.random.Generator) -> list[AttitudeSample]:
    """A slow scan about the first of WAYPOINTS_DEG, 0.3 deg/s and less across the boresight,
    with jitter.
    """

    def scan(t_s: float) -> FloatArray:
        radec_roll_deg = []
        for middle_deg, (size_deg, period_s) in zip(WAYPOINTS_DEG[0], SCAN, strict=True):
            turn_deg = size_deg * math.sin(2 * math.pi * t_s / period_s)
            radec_roll_deg.append(middle_deg + turn_deg)
        return from_radec_roll_deg(*radec_roll_deg)

    return _jittered(scan, duration_s, rng)


def _jittered(
    path: Callable[[float], FloatArray], duration_s: float, rng: np.random.Generator
) -> list[AttitudeSample]:
    count = round((duration_s + REST_S) * SEND_HZ) + 1
    times_s = np.arange(count) / SEND_HZ
    # Jitter about cam axes: first-order Gauss-Markov noise.
    keep = np.exp(-1.0 / (SEND_HZ * JITTER_SECONDS))
    jitter = rng.normal(size=(count, 3)) * np.array(JITTER_ARCSEC) / ARCSEC_PER_RAD
    fresh = np.sqrt(1 - keep**2)
    for k in range(1, count):
        jitter[k] = keep * jitter[k - 1] + fresh * jitter[k]
    attitudes = [propagate(path(t), jitter[k], -1.0) for k, t in enumerate(times_s.tolist())]
    samples = []
    for k, q in enumerate(attitudes):
        before = max(k - 1, 0)
        after = min(k + 1, count - 1)
        span_s = (after - before) / SEND_HZ
        rate = rate_between_rad_s(attitudes[before], attitudes[after], span_s)
        t_ns = round(times_s[k] * NS_PER_S)
        samples.append(AttitudeSample(t_ns, q, rate, k))
    return samples


Watching = Callable[[Bench, str], AbstractContextManager[tuple[FrameSink, Outlet]]]


@dataclass(frozen=True, slots=True)
class Shows:
    """What a demo shows: its bench file, the attitudes that are sent, and whether all who watch
    are there before they are.
    """

    bench_file: Path
    samples: list[AttitudeSample]
    ready: Callable[[], bool] = lambda: True


def run_demo(directory: Path, duration_s: float, shows: Shows, watching: Watching) -> Demo:
    """Stream attitudes from a process of their own through a loopback socket, and serve them.

    The sender begins once the loop has drawn its first frame, and the run once an attitude has
    come. `watching` opens the sink of all frames and the run's outlet, for a bench and its
    endpoint. Raises InputError or MachineError.
    """
    make_directory(directory)
    log_path = directory / SLEW_LOG
    write_log(log_path, shows.samples)
    with (
        load(shows.bench_file) as bench,
        ZmqApart(ZmqReceiver(bench.config.attitude.address, bind=True)) as link,
        _DemoSender(log_path, link.endpoint) as sender,
        watching(bench, link.endpoint) as (watch, outlet),
    ):
        frame_count = round(duration_s * bench.config.monitor.refresh_hz)
        wanted = {int(frame_count * part) for part in PICTURES_AT}
        codes_by_frame: dict[int, Codes] = {}

        def sink(shown: Shown) -> None:
            if shown.missing and shows.ready():
                sender.tend()
            elif not shown.missing and wanted and shown.number >= min(wanted):
                wanted.remove(min(wanted))
                codes_by_frame[shown.number] = bench.code_values(shown.drawn.levels).copy()
            watch(shown)

        link.await_ready()
        limit = Limit(slots=frame_count, from_first_attitude=True)
        summary = serve(bench, link, limit, sink, outlet)
    return Demo(summary, codes_by_frame, bench.config.monitor.bits)


class _DemoSender(Closing):
    def __init__(self, log_path: Path, endpoint: str) -> None:
        arguments = ["send", str(log_path), "--to", endpoint, "--connect"]
        arguments += ["--wait", f"{LISTENER_WITHIN_S:g}"]
        self._command = [sys.executable, "-m", "hilstar", *arguments]
        self._process: subprocess.Popen[bytes] | None = None

    def tend(self) -> None:
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
        elif self._process.poll() is not None:
            command = shlex.join(["hilstar", *self._command[3:]])
            raise MachineError(
                f"the demo's sender ended before an attitude came; to see why, run: {command}"
            )

    def close(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def write_pictures(directory: Path, demo: Demo, advance: Callable[[int], None]) -> None:
    """Two pictures of each frame that was kept: its codes, and a preview; `advance` is told how
    many are written.
    """
    for written, (number, codes) in enumerate(demo.kept.items()):
        stem = f"frame_{number:04d}"
        write_codes_png(directory / f"{stem}_codes.png", codes, demo.bits)
        advance(2 * written + 1)
        write_preview_png(directory / f"{stem}_preview.png", codes)
        advance(2 * written + 2)
