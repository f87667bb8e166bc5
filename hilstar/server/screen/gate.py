"""A bench on its display, past the start-up gate: swaps are timed, and a display whose timing
cannot be trusted is refused.
"""

import datetime
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import MachineError
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import ERROR_OF_MEDIAN, NS_PER_MS
from hilstar.display.identity import TABLE
from hilstar.display.render.driver import sleep_in_waits
from hilstar.display.render.presenter import window_context
from hilstar.display.window.output_settings import Finding, findings
from hilstar.display.window.this_monitor import identity_here
from hilstar.display.window.window import Window, WindowSettings
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.config import Monitor
from hilstar.server.bench.measured_on import SHOWN_ANYWAY, MonitorCheck, check_monitor
from hilstar.server.bench.monitor import orientation_of
from hilstar.server.screen.screen import DrawBudget, Screen

GATE_FRAMES = 120
REFRESH_TOLERANCE = 0.01  # of the period: 59.94 Hz passes for 60 Hz, 59 Hz does not
DROPPED = 1.5  # periods
MAX_DROPPED = 2  # among GATE_FRAMES: a desktop that is still busy with the new window
BURSTS, BURST = 3, 8  # bursts of swaps, to find how many are queued
BURST_AT = 0.25  # share of a period after a swap: far from the next one
# in periods: where a burst ends on a variable refresh, off the grid of a fixed one
OFF_GRID = (0.125, 0.75)
DRAINED = 6  # periods after which a driver's queue is empty
# The first is today's and serves most drivers; a 4K display or a slow X server needs more.
GUARDS_MS = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
GUARD_TRIALS = 4
PLAIN_BITS = 8
VRR_FRAMES = 5
# periods after a swap: when the next frame is submitted, and the latest that it is shown with
VRR_AT, VRR_UNDER = 1.5, 1.75
UNPACED = 0.1  # share of the known period: swaps faster by more do not wait for it
# A refresh that the system does not know is believed where at least this share of swaps is on it
# within UNPACED: on a busy machine the median of swaps without any may lie on it by chance.
MIN_ON_TIME = 0.5
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Timing:
    """What the gate measured: the median period, how many frames were dropped, and who keeps time.

    `paced_by_screen` is true where the screen itself keeps time, and `waits` false where it could,
    but swaps do not wait. `modes_hz` are the refresh rates that the display has. The driver holds
    `queued` finished frames back, a refresh each, and takes a frame for a swap up to `guard_ms`
    before it. With `variable` the display shows a frame when it comes. `period_error_ms` is the
    standard error of the median.
    """

    period_ms: float
    dropped: int
    paced_by_screen: bool
    waits: bool = True
    modes_hz: tuple[int, ...] = ()
    queued: int = 0
    guard_ms: float = DrawBudget.GUARD_NS / NS_PER_MS
    variable: bool = False
    period_error_ms: float = 0.0


@contextmanager
def open_screen(
    file: BenchFile, today: datetime.date, *, windowed: bool, force: bool, timed: bool
) -> Iterator[Screen]:
    """The bench of a file on its display, past the gate; `timed` as in `open_bench`. Raises
    InputError or MachineError.

    The monitor has to be the one that the bench's files were measured on, not too long before
    `today`.
    """
    monitor = file.config.monitor
    monitor_check = check_monitor(file, identity_here(monitor.display), today)
    monitor_check.refuse(force)
    display = None if windowed else monitor.display
    size_px = orientation_of(monitor).screen_px(monitor.resolution_px)
    sleep_in_waits()
    settings = WindowSettings(size_px, monitor.bits, display, monitor.refresh_hz)
    with Window(settings) as window:
        fault = size_fault(window, monitor)
        if fault and not force:  # said before anything is drawn on it
            raise MachineError(f"{fault}; or add --force")
        with _bench_on(window, file, monitor_check, timed=timed, force=force) as screen:
            yield screen


@contextmanager
def _bench_on(
    window: Window, file: BenchFile, found: MonitorCheck, *, timed: bool, force: bool
) -> Iterator[Screen]:
    """The bench of a file in a window, past the gate."""
    with open_bench(file, window_context(), timed=timed, on_screen=True) as bench:
        wanted = file.config.render.gpu
        draws = bench.renderer.gl_renderer
        if isinstance(wanted, str) and wanted.lower() not in draws.lower():
            log.warning(
                "[render] gpu = %r is for headless frames; %s draws this window", wanted, draws
            )
        screen = Screen(window, bench)
        screen.forced += found.told(log)
        bench.warm_up()
        pass_gate(screen, force)
        if screen.output is not None:
            bench.output.update(screen.output.fields())
        bench.output[TABLE] = {} if found.now is None else found.now.known()
        bench.output["forced"] = screen.forced
        yield screen


def pass_gate(screen: Screen, force: bool, clock: HostClock = HOST_CLOCK) -> Timing:
    """Time GATE_FRAMES swaps, refuse (MachineError) a display that is not the bench file's
    unless `force`; its timing.
    """
    window = screen.window
    monitor = screen.bench.config.monitor
    screen.bench.draw(None)
    swaps_ns = []
    for number in range(GATE_FRAMES + 1):
        screen.present(number)
        swaps_ns.append(screen.swap())
    reported_hz = 0 if window.display is None else window.display.refresh_hz
    timing = timing_of(np.diff(swaps_ns) / NS_PER_MS, monitor, reported_hz)
    timing = replace(timing, modes_hz=window.modes_hz)
    screen.keep_time(timing.period_ms, timing.paced_by_screen, swaps_ns[-1])
    if timing.paced_by_screen and window.gone is None:
        queued, variable = queue_of(screen, clock)
        timing = replace(timing, queued=queued, variable=variable)
        if not queued and not variable:
            timing = replace(timing, guard_ms=needed_guard_ms(screen, clock))
        screen.keep_ahead(timing.guard_ms, timing.queued)
    if not timing.paced_by_screen:
        ms = timing.period_ms
        log.warning(
            "the display has no refresh of its own (swaps take %.2f ms): frames are paced by"
            " software",
            ms,
        )
    if window.gone is not None:
        raise MachineError(window.gone)
    screen.output = window.output
    _look_for_faults(screen, timing, force)
    return timing


def _look_for_faults(screen: Screen, timing: Timing, force: bool) -> None:
    """Log what may be wrong with a display, and refuse (MachineError) one that is; with `force`
    that is logged and kept.
    """
    window, monitor = screen.window, screen.bench.config.monitor
    changed = screen.bench.renderer.changed_codes()
    if changed:
        changed += (
            "; switch dithering, colour transforms and antialiasing off in the display's driver"
        )
    output_findings: tuple[Finding, ...] = ()
    if screen.output is not None:
        output_findings = tuple(findings(screen.output, monitor.bits, monitor.pixel_pitch_um))
    doubts = [finding.text for finding in output_findings if not finding.refused]
    if window.others:
        others = (
            f"the X screen has other displays, {', '.join(window.others)}: frames may be copied"
            " instead of flipped, or"
        )
        doubts.insert(
            0,
            f"{others} follow another's refresh; switch them off, or give this one an X screen of"
            " its own",
        )
    for doubt in doubts:
        log.warning("%s", doubt)
    wrong = [finding.text for finding in output_findings if finding.refused]
    for fault in (*wrong, *faults(window, monitor, timing), *[changed] * bool(changed)):
        if not force:
            raise MachineError(f"{fault}; or add --force")
        screen.forced.append(fault)
        log.warning("%s: %s", fault, SHOWN_ANYWAY)


def burst_periods(screen: Screen, clock: HostClock) -> float:
    """How long BURST swaps in a row take, in periods, from a quarter of a period after a swap on
    with no frame queued.

    The last swap returns once the frame that precedes it by the queue's length is shown. At a fixed
    refresh that is after BURST - 0.25 periods, less a period for each queued frame. A variable
    refresh shows the first frame at once, and its last swap returns off that grid.
    """
    took = []
    for _ in range(BURSTS):
        period_ns = screen.clock.period_ns
        begin_ns = round(
            screen.clock.next_after(clock.now_ns() + DRAINED * period_ns) + BURST_AT * period_ns
        )
        clock.wait_until(begin_ns, threading.Event())
        for number in range(BURST):
            screen.present(number)
            screen.swap(timed=False)
        took.append((clock.now_ns() - begin_ns) / period_ns)
    return sorted(took)[BURSTS // 2]


def queue_of(screen: Screen, clock: HostClock) -> tuple[int, bool]:
    """How many finished frames the driver holds back, and whether the refresh is variable."""
    took = burst_periods(screen, clock)
    off_grid = OFF_GRID[0] < (took + BURST_AT) % 1 < OFF_GRID[1]
    if off_grid and follows_frames(screen, clock):
        return max(0, BURST - 1 - round(took)), True
    return max(0, BURST - round(took + BURST_AT)), False


def follows_frames(screen: Screen, clock: HostClock) -> bool:
    """Whether the refresh is variable: a frame submitted 1.5 periods after a swap is shown at
    once, and not after 2 periods.
    """
    early = 0
    for _ in range(VRR_FRAMES):
        screen.present(0)
        before_ns = screen.swap(timed=False)
        screen.present(0)
        clock.wait_until(round(before_ns + VRR_AT * screen.clock.period_ns), threading.Event())
        early += screen.swap(timed=False) - before_ns < VRR_UNDER * screen.clock.period_ns
    return early > VRR_FRAMES // 2


def needed_guard_ms(screen: Screen, clock: HostClock) -> float:
    """The shortest of GUARDS_MS before a swap at which a finished frame is still taken for it."""
    for guard_ms in GUARDS_MS:
        if guard_ms * NS_PER_MS > screen.clock.period_ns / 2:
            break
        late = 0
        for _ in range(GUARD_TRIALS):
            period_ns = screen.clock.period_ns
            due_ns = screen.clock.next_after(clock.now_ns() + period_ns)
            screen.present(0)
            clock.wait_until(round(due_ns - guard_ms * NS_PER_MS), threading.Event())
            late += screen.swap() - due_ns > period_ns / 2
        if not late:
            return guard_ms
    return screen.clock.period_ns / 2 / NS_PER_MS


def timing_of(periods_ms: FloatArray, monitor: Monitor, known_hz: float) -> Timing:
    """What the intervals between swaps say of a display; `known_hz` is its refresh rate by the
    system, 0 if unknown.
    """
    wanted_ms = 1000.0 / monitor.refresh_hz
    period_ms = float(np.median(periods_ms))
    # A display whose swaps come faster than any refresh does not wait for one: nothing keeps time
    # but this program.
    on_time = abs(period_ms / wanted_ms - 1) < REFRESH_TOLERANCE
    if known_hz:
        by_screen = period_ms >= 1000.0 / known_hz * (1 - UNPACED)
    else:
        share_on_time = np.mean(np.abs(periods_ms / wanted_ms - 1) < UNPACED)
        by_screen = on_time and bool(share_on_time >= MIN_ON_TIME)
    dropped = periods_ms > DROPPED * wanted_ms
    if not dropped.all():
        error_ms = ERROR_OF_MEDIAN * float(np.std(periods_ms[~dropped])) / len(periods_ms) ** 0.5
    else:
        error_ms = 0.0
    return Timing(
        period_ms,
        int(dropped.sum()),
        by_screen,
        waits=by_screen or not known_hz,
        period_error_ms=error_ms,
    )


def size_fault(window: Window, monitor: Monitor) -> str:
    """What is wrong with the size of a display, and what to do about it; "" for nothing."""
    wanted_px = orientation_of(monitor).screen_px(monitor.resolution_px)
    if window.size_px == wanted_px:
        return ""
    (width, height), (wide, high) = window.size_px, wanted_px
    sizes = f"{width} x {height} px and the bench file says {wide} x {high}"
    return f"the display is {sizes}; set [monitor] resolution_px, or the display's mode"


def faults(window: Window, monitor: Monitor, timing: Timing) -> Iterator[str]:
    """What is wrong with a display, and what to do about it."""
    size = size_fault(window, monitor)
    if size:
        yield size
    yield from _desktop_faults(window)
    if timing.paced_by_screen:
        yield from _timing_faults(monitor, timing)
    if not timing.waits:
        yield "swaps do not wait for the display's refresh; switch vertical sync on in its driver"
    yield from _depth_faults(window, monitor)


def _desktop_faults(window: Window) -> Iterator[str]:
    if window.by_wayland:
        yield (
            "a Wayland compositor draws this display (XWayland), and holds frames back; use an Xorg"
            " session"
        )
    if window.ramp_refused:
        yield (
            "the display keeps a gamma ramp that is not straight; stop what sets it (night light,"
            " colour management)"
        )
    if window.composited:
        yield (
            "a compositing manager draws this display and may hold frames back; stop it, or use a"
            " plain X session"
        )
    if window.mirrored is not None:
        advice = "switch it off, or give this one an X screen of its own (docs/bench-pc.md)"
        yield f"the display {window.mirrored} mirrors this one; {advice}"
    if window.scaled:
        yield "the display is scaled by its desktop; set its scale to 100 %"


def _depth_faults(window: Window, monitor: Monitor) -> Iterator[str]:
    buffer = window.back_buffer
    wanted = monitor.bits
    if buffer.bits != wanted:
        depths = f"{buffer.bits} bits per colour and the bench file says {wanted}"
        yield f"the window has {depths}; set [monitor] bits, or the depth of the X screen"
    elif window.screen_bits != buffer.bits:
        depths = f"{window.screen_bits} bits per colour and the window {buffer.bits}"
        yield (
            f"the X screen has {depths}, so that X converts codes; set [monitor] bits, or"
            " DefaultDepth of the X screen"
        )
    if buffer.samples > 1:
        yield (
            f"the driver draws {buffer.samples} samples a pixel; switch forced antialiasing off in"
            " its settings"
        )
    if wanted > PLAIN_BITS and 0 < window.ramp_size < 2**wanted:
        yield (
            f"the display's gamma ramp has {window.ramp_size} steps, too few for {wanted} bits; set"
            " [monitor] bits = 8"
        )


def _timing_faults(monitor: Monitor, timing: Timing) -> Iterator[str]:
    if abs(timing.period_ms * monitor.refresh_hz / 1000.0 - 1) > REFRESH_TOLERANCE:
        hz = f"{1000.0 / timing.period_ms:.2f} Hz and the bench file says {monitor.refresh_hz:g}"
        yield f"the display refreshes at {hz}; set [monitor] refresh_hz, or the display's mode"
    if timing.dropped > MAX_DROPPED:
        yield (
            f"the display dropped {timing.dropped} of {GATE_FRAMES} frames; close other programs"
            " that draw on it"
        )
    if timing.variable:
        ways = (
            'Option "VariableRefresh" "false", adaptive_sync=false (Mesa), __GL_VRR_ALLOWED=0'
            " (NVIDIA), or the monitor's menu"
        )
        yield (
            "the display has a variable refresh: it shows a frame when it comes; switch that off"
            f" ({ways})"
        )
    if timing.queued:
        held = f"{timing.queued} finished frame{'s' * (timing.queued > 1)}"
        late = f"light comes {timing.queued * timing.period_ms:.1f} ms after the swap"
        ways = "use one with GLX_OML_sync_control, or __GL_MaxFramesAllowed=1 (NVIDIA)"
        yield f"the driver holds {held} back, and {late}; {ways}"
