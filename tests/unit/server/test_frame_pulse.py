"""A pulse at each frame: its width and level, whose frames have one, what a slow or lost line
costs the frames: nothing.
"""

from __future__ import annotations

import threading
import time

import pytest

from hilstar.attitude.wire import serial_link
from hilstar.attitude.wire.serial_link import RtsLine
from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.notices import Notices
from hilstar.server.bench.config import SyncSettings
from hilstar.server.frame_pulse import MIN_BACK_OFF_S, FramePulse
from tests.support.rts_server import KeptLine
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.wire.ptys import serial_line

# Between frames here; a pulse is 1 ms. On a machine whose cores are busy a thread may be given none
# for some of them.
FRAME_S = 0.02


class Line(RtsLine):
    """RTS of a looped port in this process, that can be slow, and be lost."""

    def __init__(self, active_high=True):
        self.kept, self.slow_s, self.gone, self.tries = None, 0.0, False, 0
        super().__init__("loop://", active_high)

    def set(self, active):
        time.sleep(self.slow_s)
        if self.gone:
            raise OSError(5, "Input/output error")
        super().set(active)

    def open(self):
        self.tries += 1
        if self.gone:
            raise OSError(2, "No such file or directory")
        super().open()


@pytest.fixture
def kept(monkeypatch):
    """The ports that are opened, each with its edges."""
    made = []

    def make(url, **options):
        assert url == "loop://" and options["exclusive"]
        made.append(KeptLine(None))
        made[-1].port = url
        return made[-1]

    monkeypatch.setattr(serial_link.serial, "serial_for_url", make)
    return made


def pulse_settings(**keys):
    return SyncSettings(port="loop://", **keys)


def pulsed_frames(pulse, count, first=0):
    for number in range(first, first + count):
        pulse.frame(number, time.monotonic_ns())
        time.sleep(FRAME_S)


@pytest.mark.parametrize("active", ["high", "low"])
def test_each_frame_has_a_pulse_of_the_width_and_level_asked_for_and_the_line_ends_at_rest(
    kept, active
):
    high = active == "high"
    with FramePulse.of(pulse_settings(active=active, pulse_ms=3.0), Notices()) as pulse:
        for number in range(12):
            pulsed_frames(pulse, 1, number)
            wait_for(
                lambda number=number: pulse.summary().pulses == number + 1,
                "its pulse has ended",
                poll_s=0.0,
            )
    summary = pulse.summary()
    line = kept[-1]
    levels = [level for _, level in line.edges]
    assert levels[0] is levels[-1] is (not high)
    raised = [at_ns for at_ns, level in line.edges if level is high]
    fallen = [at_ns for at_ns, level in line.edges[1:] if level is not high]
    assert len(raised) == summary.pulses == 12 and summary.skipped == 0
    widths_ms = sorted((down - up) / 1e6 for up, down in zip(raised, fallen, strict=True))
    assert 3.0 <= widths_ms[0] < 3.0 + FRAME_S * 500  # a busy machine makes some of them wider
    assert not line.is_open
    assert (
        0 <= summary.delay_ms <= summary.max_delay_ms
        and summary.jitter_ms >= 0
        and summary.lost == 0
    )


def test_the_delay_is_the_one_from_the_frame_s_stamp_to_the_line(kept):
    stamps = []
    with FramePulse(Line(), pulse_settings(), Notices()) as pulse:
        for number in range(12):
            # swapped 20 ms ago, as far as the driver knows
            stamps.append(time.monotonic_ns() - 20_000_000)
            pulse.frame(number, stamps[-1])
            time.sleep(FRAME_S)
    raised = [at_ns for at_ns, level in kept[0].edges if level]
    if pulse.summary().skipped == 0:
        seen_ms = [(up - stamp) / 1e6 for up, stamp in zip(raised, stamps, strict=True)]
        # The line's own time lies between: microseconds here, and its mean is told.
        off_ms = sum(seen_ms) / 12 - pulse.summary().delay_ms
        assert 0 <= off_ms <= pulse.summary().line_ms + 0.01
    assert pulse.summary().delay_ms >= 20.0 > pulse.summary().line_ms


class HeldLine(Line):
    """One that returns from its rise only when it is let go."""

    def __init__(self):
        self.rises, self.let_go = threading.Event(), threading.Event()
        super().__init__()

    def set(self, active):
        super().set(active)
        if active:
            self.rises.set()
            self.let_go.wait(PATIENCE_S)


def test_frames_that_come_while_the_line_is_busy_are_heard_and_counted_as_skipped(kept):
    """A pulse's width counts from when the line is known to be raised."""
    line, heard = HeldLine(), []
    with FramePulse(line, pulse_settings(pulse_ms=10.0), Notices()) as pulse:
        pulse.counted = heard.append
        none = pulse.summary()
        for number in range(3):
            pulse.frame(number, time.monotonic_ns())
        assert line.rises.wait(PATIENCE_S)
        time.sleep(0.01)  # longer than the pulse that is asked for
        known_ns = time.monotonic_ns()
        line.let_go.set()
    assert heard == ["skipped", "skipped", "sent"]
    fallen_ns = [at_ns for at_ns, level in kept[0].edges if not level][-1]
    assert fallen_ns - known_ns >= 10_000_000
    summary = pulse.summary()
    assert (summary.pulses, summary.skipped, summary.lost) == (1, 2, 0)
    told = (none.delay_ms, none.jitter_ms, none.max_delay_ms, none.line_ms)
    assert (none.pulses, *told) == (0, None, None, None, None)


def test_of_every_third_frame(kept):
    with FramePulse(Line(), pulse_settings(every_frames=3), Notices()) as pulse:
        pulsed_frames(pulse, 9, first=1)
    summary = pulse.summary()
    assert summary.pulses + summary.skipped == 3


@pytest.mark.timing
def test_a_slow_line_keeps_no_frame_waiting_and_what_it_misses_is_counted(kept):
    line = Line()
    with FramePulse(line, pulse_settings(), Notices()) as pulse:
        line.slow_s = 0.1
        begin_s, asked_s = time.thread_time(), time.monotonic()
        costs_s = []
        for number in range(20):
            start_s = time.monotonic()
            pulse.frame(number, time.monotonic_ns())
            costs_s.append(time.monotonic() - start_s)
            time.sleep(0.01)
        # A frame that waited for the line would cost 0.1 s, each of them; a busy machine holds up
        # some.
        assert sorted(costs_s)[5] < 0.005, costs_s
        assert time.thread_time() - begin_s < 0.1
        busy_s = time.monotonic() - asked_s
    summary = pulse.summary()
    assert summary.pulses + summary.skipped == 20
    assert 1 <= summary.pulses <= 1 + busy_s / 0.2  # the line takes 0.1 s to rise and 0.1 s to fall
    assert summary.line_ms >= 100


def test_a_line_that_is_lost_is_told_once_and_tried_until_it_is_back(kept):
    notices, line = Notices(), Line()
    with FramePulse(line, pulse_settings(), notices) as pulse:
        pulsed_frames(pulse, 2)
        line.gone, line.tries = True, 0
        lost_s = time.monotonic()
        pulsed_frames(pulse, 10)
        wait_for(notices.counts, "the line is told to be lost")
        assert notices.counts() == {"sync-lost": 1}
        # the pauses between tries double: 2^n - 1 of the first one are over before try n + 1
        tries, gone_s = line.tries, time.monotonic() - lost_s
        assert (2**tries - 1) * MIN_BACK_OFF_S <= gone_s
        line.gone = False
        deadline_s, number = time.monotonic() + PATIENCE_S, 12
        before = pulse.summary().pulses
        while pulse.summary().pulses == before and time.monotonic() < deadline_s:
            pulsed_frames(pulse, 1, number)
            number += 1
    assert notices.counts() == {"sync-lost": 1, "sync-back": 1}
    summary = pulse.summary()
    assert summary.lost == 1 and summary.skipped >= 10 and summary.pulses >= before + 1
    assert summary.pulses + summary.skipped == number  # the frame of the lost one is skipped, too
    assert "losses of the line: 1" in summary.line()


def test_a_port_without_modem_lines_is_refused_in_a_line():
    """A pty has none: the kernel says so when RTS is set, which pyserial keeps to itself while
    it opens.
    """
    said = r"\[sync\] port = /dev/pts/\d+: has no line RTS .*write a serial port with modem"
    with serial_line() as (_, port), pytest.raises(InputError, match=said):
        RtsLine(port, True)


@pytest.mark.parametrize(
    ("port", "said", "refusal"),
    [
        ("/dev/nothing-there", "no such device; plug it in", MachineError),
        ("rfc2217://127.0.0.1:1", "Connection refused.*start the server", MachineError),
        ("smoke://signals", "protocol 'smoke' not known", InputError),
    ],
)
def test_a_port_that_is_not_there_is_refused_in_a_line(port, said, refusal):
    with pytest.raises(refusal, match=rf"\[sync\] port = {port}: .*{said}"):
        RtsLine(port, True)


def test_the_frames_that_have_a_pulse_are_the_multiples(kept):
    with FramePulse(Line(), pulse_settings(every_frames=3), Notices()) as pulse:
        pulsed_frames(pulse, 2, first=1)
        assert pulse.summary().pulses + pulse.summary().skipped == 0
        pulsed_frames(pulse, 1, first=3)
        assert pulse.summary().pulses + pulse.summary().skipped == 1
