"""The start-up gate: which displays it refuses, by the intervals between their swaps and by what
the system says of them.
"""

from __future__ import annotations

import datetime
import itertools
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import MachineError
from hilstar.display.identity import TABLE, MonitorIdentity
from hilstar.display.window.output_settings import OutputState
from hilstar.display.window.window import WindowSettings
from hilstar.display.window.x11 import BackBuffer
from hilstar.server.bench import build
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.config import parse_config
from hilstar.server.screen import gate
from hilstar.server.screen.gate import (
    GATE_FRAMES,
    Timing,
    faults,
    follows_frames,
    pass_gate,
    timing_of,
)
from tests.support.benches import SMALL_BENCH
from tests.support.model_display import model_screen, plain_window

PERIOD_MS = 1000 / 60
GOOD = Timing(PERIOD_MS, 0, True)


@pytest.fixture
def monitor(tmp_path):
    return parse_config(tmp_path / "bench.toml", SMALL_BENCH).monitor


@pytest.mark.parametrize(
    ("period_ms", "known_hz", "by_screen", "waits"),
    [
        (PERIOD_MS, 60.0, True, True),
        (PERIOD_MS * 1.05, 60.0, True, True),  # another refresh, which is a fault of its own
        (0.4, 60.0, False, False),  # swaps that do not wait
        (PERIOD_MS, 0.0, True, True),
        (0.4, 0.0, False, True),  # no refresh at all, as a virtual screen's
        # the bench file's refresh within REFRESH_TOLERANCE, faster and slower
        (PERIOD_MS * 0.991, 0.0, True, True),
        (PERIOD_MS * 1.009, 0.0, True, True),
        (PERIOD_MS * 0.989, 0.0, False, True),
        (PERIOD_MS * 1.011, 0.0, False, True),
    ],
)
def test_the_screen_keeps_time_where_its_swaps_wait(monitor, period_ms, known_hz, by_screen, waits):
    timing = timing_of(np.full(GATE_FRAMES, period_ms), monitor, known_hz)
    assert (timing.paced_by_screen, timing.waits) == (by_screen, waits)


def test_swaps_of_a_busy_machine_are_no_refresh_though_their_median_lies_on_one(monitor, rng):
    """A virtual screen's swaps, which wait for nothing: half as long to twice as long."""
    busy_ms = PERIOD_MS * np.exp(rng.uniform(-np.log(2), np.log(2), GATE_FRAMES))
    busy_ms *= PERIOD_MS / np.median(busy_ms)
    timing = timing_of(busy_ms, monitor, 0.0)
    assert not timing.paced_by_screen and timing.dropped > 2
    assert list(faults(plain_window(), monitor, timing)) == []


def test_a_refresh_that_the_system_does_not_know_is_kept_through_dropped_frames(monitor):
    periods_ms = np.full(GATE_FRAMES, PERIOD_MS)
    periods_ms[::3] = 2 * PERIOD_MS
    timing = timing_of(periods_ms, monitor, 0.0)
    assert timing.paced_by_screen
    assert "dropped 40 of 120" in next(iter(faults(plain_window(), monitor, timing)))


def test_intervals_of_more_than_a_period_and_a_half_are_dropped_frames(monitor):
    periods_ms = np.full(GATE_FRAMES, PERIOD_MS)
    periods_ms[[5, 50, 90]] = 2 * PERIOD_MS
    timing = timing_of(periods_ms, monitor, 60.0)
    assert timing.dropped == 3
    assert timing.period_ms == pytest.approx(PERIOD_MS)
    assert [
        fault for fault in faults(plain_window(), monitor, timing) if "dropped 3 of 120" in fault
    ]


@pytest.mark.parametrize(
    ("changes", "timing"),
    [
        ({}, GOOD),
        # at the limits: two dropped frames, 1 % of the period, one sample, a ramp of as many steps
        ({}, Timing(PERIOD_MS, 2, True)),
        ({}, Timing(PERIOD_MS * 1.0099, 0, True)),
        ({}, Timing(PERIOD_MS * 0.9901, 0, True)),
        ({"back_buffer": BackBuffer(8, 1), "ramp_size": 0}, GOOD),
        # a display without a refresh of its own drops none
        ({}, Timing(1.7 * PERIOD_MS, 60, False)),
    ],
)
def test_a_display_as_the_bench_file_has_it_has_no_fault(monitor, changes, timing):
    assert list(faults(plain_window(**changes), monitor, timing)) == []


@pytest.mark.parametrize(
    ("changes", "timing", "words"),
    [
        ({"size_px": (640, 480)}, GOOD, "640 x 480 px and the bench file says 320 x 240"),
        ({"composited": True}, GOOD, "compositing manager"),
        ({"mirrored": "HDMI-2"}, GOOD, "HDMI-2 mirrors this one"),
        ({"scaled": True}, GOOD, "set its scale to 100 %"),
        ({"by_wayland": True}, GOOD, "use an Xorg session"),
        ({"ramp_refused": True}, GOOD, "gamma ramp that is not straight"),
        ({"back_buffer": BackBuffer(6, 0)}, GOOD, "6 bits per colour and the bench file says 8"),
        ({"back_buffer": BackBuffer(10, 0)}, GOOD, "10 bits per colour and the bench file says 8"),
        (
            {"screen_bits": 10},
            GOOD,
            "the X screen has 10 bits per colour and the window 8, so that X converts codes",
        ),
        ({"back_buffer": BackBuffer(8, 2)}, GOOD, "2 samples a pixel"),
        ({}, Timing(PERIOD_MS, 3, True), "dropped 3 of 120 frames"),
        ({}, Timing(PERIOD_MS, 0, True, queued=1), "holds 1 finished frame back, and light comes"),
        ({}, Timing(PERIOD_MS * 1.02, 0, True), "58.82 Hz and the bench file says 60"),
        ({}, Timing(PERIOD_MS * 0.98, 0, True), "61.22 Hz and the bench file says 60"),
        ({}, Timing(0.4, 0, False, waits=False), "switch vertical sync on"),
    ],
)
def test_each_fault_of_a_display_is_said_with_what_to_do(monitor, changes, timing, words):
    (fault,) = faults(plain_window(**changes), monitor, timing)
    assert words in fault


def test_frames_that_are_held_back_are_told_by_their_number_and_the_delay_of_all_of_them(monitor):
    timing = Timing(PERIOD_MS, 0, True, queued=2)
    (fault,) = faults(plain_window(), monitor, timing)
    assert "holds 2 finished frames back, and light comes 33.3 ms after the swap" in fault


def test_a_screen_s_size_is_that_of_an_image_as_it_is_turned(tmp_path):
    keys = "rotate_deg = 90\n[collimator]"
    turned = parse_config(tmp_path / "bench.toml", SMALL_BENCH.replace("[collimator]", keys))
    assert list(faults(plain_window(size_px=(240, 320)), turned.monitor, GOOD)) == []
    (fault,) = faults(plain_window(), turned.monitor, GOOD)
    assert "320 x 240 px and the bench file says 240 x 320" in fault


@pytest.mark.parametrize(
    ("steps", "is_enough"), [(0, True), (512, False), (1023, False), (1024, True)]
)
def test_a_gamma_ramp_has_a_step_for_each_code(tmp_path, steps, is_enough):
    bench = SMALL_BENCH.replace("[collimator]", "bits = 10\n[collimator]")
    monitor = parse_config(tmp_path / "bench.toml", bench).monitor
    window = plain_window(back_buffer=BackBuffer(10, 0), screen_bits=10, ramp_size=steps)
    assert (list(faults(window, monitor, GOOD)) == []) is is_enough


def test_a_period_s_error_is_the_scatter_of_intervals_without_dropped_frames(monitor):
    """Of the median of n: sqrt(pi / 2) sigma / sqrt(n)."""
    periods_ms = PERIOD_MS + 0.1 * (-1.0) ** np.arange(GATE_FRAMES)
    wanted_ms = np.sqrt(np.pi / 2) * 0.1 / np.sqrt(GATE_FRAMES)
    assert timing_of(periods_ms, monitor, 60.0).period_error_ms == pytest.approx(wanted_ms)
    periods_ms[:20] *= 2
    assert timing_of(periods_ms, monitor, 60.0).period_error_ms == pytest.approx(wanted_ms)
    assert timing_of(np.full(GATE_FRAMES, 99.0), monitor, 60.0).period_error_ms == 0.0


@pytest.mark.parametrize(
    ("early", "is_variable"),
    [("11111", True), ("10101", True), ("00111", True), ("11000", False), ("00001", False)],
)
def test_a_refresh_is_variable_where_most_early_frames_are_shown_at_once(early, is_variable):
    """The second swap of a pair comes 1.5 or 2 periods after the first."""
    times_ns = [0]
    for is_early in early:
        times_ns += [
            times_ns[-1] + 10 * 100,
            times_ns[-1] + 10 * 100 + (150 if is_early == "1" else 200),
        ]
    left = iter(times_ns[1:])
    screen = SimpleNamespace(
        present=lambda number: None,
        swap=lambda timed: next(left),
        clock=SimpleNamespace(period_ns=100),
    )
    clock = SimpleNamespace(wait_until=lambda due_ns, stop: None)
    assert follows_frames(screen, clock) is is_variable
    assert list(left) == []


@pytest.mark.parametrize("buffers", [2, 3])
@pytest.mark.parametrize("hz", [60, 120])
def test_a_fixed_refresh_is_not_taken_for_a_variable_one(tmp_path, buffers, hz):
    screen, display = model_screen(
        tmp_path, hz=hz, buffers=buffers, stamp_ns=200_000, deadline_ns=400_000
    )
    assert not pass_gate(screen, force=False, clock=display.clock).variable


@pytest.mark.parametrize("stamp_ns", [None, 200_000])
@pytest.mark.parametrize("queued", [0, 1])
def test_a_variable_refresh_is_recognised_and_refused(tmp_path, stamp_ns, queued):
    screen, display = model_screen(tmp_path, variable=True, stamp_ns=stamp_ns, buffers=2 + queued)
    with pytest.raises(MachineError, match=r"variable refresh.*VariableRefresh.*or add --force"):
        pass_gate(screen, force=False, clock=display.clock)
    timing = pass_gate(screen, force=True, clock=display.clock)
    # a driver that stamps its flips waits for the last one, and holds none back
    assert timing.variable and timing.queued == (queued if stamp_ns is None else 0)


def test_one_burst_that_the_machine_delays_hides_no_queue(tmp_path):
    screen, display = model_screen(tmp_path, buffers=3)
    pass_gate(screen, force=True, clock=display.clock)
    presents = []

    def delayed(*values):
        presents.append(values)
        if len(presents) == gate.BURST + 2:  # in the second burst
            display.clock.work(2.1 * display.period_ns)

    screen.bench.renderer.present = delayed
    assert gate.queue_of(screen, display.clock) == (1, False)
    assert len(presents) == gate.BURSTS * gate.BURST


def test_a_guard_is_one_with_which_no_frame_of_its_trials_is_late(tmp_path):
    """A driver that needs 1.9 ms for each fourth frame, else 0.2 ms."""
    screen, display = model_screen(tmp_path)
    pass_gate(screen, force=False, clock=display.clock)
    needs_ms = itertools.cycle([0.2] * (gate.GUARD_TRIALS - 1) + [1.9])

    def present(*values):
        display.deadline_ns = round(next(needs_ms) * 1e6)

    screen.bench.renderer.present = present
    assert gate.needed_guard_ms(screen, display.clock) == 2.0


def test_a_wrong_setting_of_the_output_is_refused_and_a_doubtful_one_is_told(tmp_path, caplog):
    output = OutputState(
        "DP-1", (320, 240), properties={"Broadcast RGB": "Limited 16:235", "TearFree": "on"}
    )
    screen, display = model_screen(tmp_path, output=output)
    with pytest.raises(
        MachineError, match=r"Broadcast RGB of DP-1.*xrandr --output DP-1 --set.*or add --force"
    ):
        pass_gate(screen, force=False, clock=display.clock)
    assert "TearFree of DP-1 is on" in caplog.text
    pass_gate(screen, force=True, clock=display.clock)
    assert screen.output is output


def test_a_good_display_passes_and_its_swaps_are_predicted_from_the_last_one(tmp_path):
    screen, display = model_screen(tmp_path)
    timing = pass_gate(screen, force=False, clock=display.clock)
    assert timing.period_ms == pytest.approx(PERIOD_MS, rel=1e-6) and timing.paced_by_screen
    assert screen.clock.measured_hz == pytest.approx(1e3 / PERIOD_MS)
    periods = (screen.clock.next_after(display.clock.ns) - display.flips_ns[-1]) / display.period_ns
    assert periods == pytest.approx(round(periods), abs=1e-4)


def test_a_fault_is_refused_and_only_logged_with_force(tmp_path, caplog):
    screen, display = model_screen(tmp_path, composited=True, scaled=True)
    with pytest.raises(MachineError, match=r"compositing.*or add --force"):
        pass_gate(screen, force=False, clock=display.clock)
    pass_gate(screen, force=True, clock=display.clock)
    compositing, scale = screen.forced
    assert "compositing manager" in compositing and "scaled by its desktop" in scale
    assert "shown anyway (--force)" in caplog.text


def test_a_window_that_is_gone_is_refused_even_with_force(tmp_path):
    screen, display = model_screen(tmp_path, gone="its display was unplugged")
    with pytest.raises(MachineError, match="unplugged"):
        pass_gate(screen, force=True, clock=display.clock)


def test_a_wrong_size_is_said_before_the_bench_is_opened_or_a_frame_drawn(tmp_path, monkeypatch):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    file = read_bench_file(path)
    opened = []

    @contextmanager
    def window_of(settings):
        yield plain_window(size_px=(1, 2))

    monkeypatch.setattr(gate, "Window", window_of)
    monkeypatch.setattr(gate, "open_bench", lambda *arguments, **named: opened.append(arguments))
    with (
        pytest.raises(MachineError, match="the display is 1 x 2 px and the bench file says"),
        gate.open_screen(file, datetime.date(2024, 1, 1), windowed=True, force=False, timed=False),
    ):
        raise AssertionError("a display of another size is refused")
    assert opened == []


@pytest.mark.parametrize(("gpu", "is_told"), [("nUMp", False), ("GeForce", True)])
def test_a_run_s_output_is_what_the_gate_saw_with_the_monitor_and_what_was_forced(
    tmp_path, monkeypatch, caplog, gpu, is_told
):
    """The bench is real and drawn by NumPy; the window and the gate are not there."""
    output = OutputState("DP-1", (320, 240), properties={"TearFree": "off"})
    monitor = MonitorIdentity(maker="DEL", model="U2720Q", mode="320x240@60.00")

    def past_gate(screen, force):
        screen.output = output
        screen.forced.append("it is scaled")

    @contextmanager
    def window_of(settings):
        assert settings == WindowSettings((320, 240), 8, None, 60.0)
        yield plain_window()

    monkeypatch.setattr(build, "headless_context", lambda gpu: None)
    monkeypatch.setattr(gate, "window_context", lambda: None)
    monkeypatch.setattr(gate, "Window", window_of)
    monkeypatch.setattr(gate, "pass_gate", past_gate)
    monkeypatch.setattr(gate, "identity_here", lambda display: monitor)
    path = tmp_path / "bench.toml"
    path.write_text(f'{SMALL_BENCH}[render]\nquantisation = "round"\ngpu = "{gpu}"\n')
    today = datetime.date(2024, 1, 1)
    with gate.open_screen(
        read_bench_file(path), today, windowed=True, force=True, timed=False
    ) as screen:
        forced = screen.bench.output.pop("forced")
        assert forced == screen.forced and forced[-1] == "it is scaled"
        assert screen.bench.output == output.fields() | {TABLE: monitor.known()}
    assert (f"[render] gpu = '{gpu}' is for headless frames" in caplog.text) is is_told
