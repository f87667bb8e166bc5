"""What an X server, its drivers and a monitor say, byte for byte as their definitions have it, and
what is made of it. No server is asked: tests/screen has real ones.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.display.window import randr, x11
from hilstar.display.window.awake import Blanking, SetAside, _Server
from hilstar.display.window.output_settings import OutputState
from hilstar.display.window.randr import (
    GammaInfo,
    ModeInfo,
    ramp_of,
    refresh_hz_of,
    side_by_side,
)
from hilstar.display.window.this_monitor import ddc_settings, edid_of_drm
from hilstar.display.window.visibility import ScreenArea, WindowView, off_place
from hilstar.display.window.watch import is_foreign, presented_as, shown_as
from hilstar.display.window.x11 import (
    CLOCK,
    MAX_GAPS,
    MAX_UST_AGE_NS,
    SERVER_GONE,
    SYNC_EXTENSION,
    WINDOW_GONE,
    Survival,
    SwapStamps,
    SyncControl,
    back_buffer,
    is_end_of_window,
    sync_control,
)

NO_SERVER = ":59999"
# X.h
VISIBILITY_NOTIFY, DESTROY_NOTIFY, UNMAP_NOTIFY, MAP_NOTIFY, CONFIGURE_NOTIFY = 15, 17, 18, 19, 22
UNOBSCURED, PARTIALLY_OBSCURED, FULLY_OBSCURED = 0, 1, 2
SEEN = (VISIBILITY_NOTIFY, UNOBSCURED)
COVERED = (VISIBILITY_NOTIFY, FULLY_OBSCURED)
# Present's major opcode, which each server chooses
OPCODE = 148
# types of functions of OpenGL and of GLX_OML_sync_control
GET_ATTACHMENT = ctypes.CFUNCTYPE(
    None, ctypes.c_uint, ctypes.c_uint, ctypes.c_uint, ctypes.POINTER(ctypes.c_int)
)
GET_INTEGER = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.POINTER(ctypes.c_int))
COUNTER = ctypes.POINTER(ctypes.c_int64)
WAIT_FOR_SBC = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int64, COUNTER, COUNTER, COUNTER
)


@pytest.mark.parametrize(
    ("events", "hidden"),
    [
        ([], ""),
        ([COVERED], "covered"),
        ([(VISIBILITY_NOTIFY, PARTIALLY_OBSCURED)], "covered in part"),
        ([COVERED, SEEN], ""),
        ([(UNMAP_NOTIFY, 0)], "not on the screen"),
        ([COVERED, (UNMAP_NOTIFY, 0), (MAP_NOTIFY, 0), SEEN], ""),
        ([COVERED, (CONFIGURE_NOTIFY, UNOBSCURED)], "covered"),  # no event of visibility
    ],
)
def test_a_window_is_hidden_as_the_last_events_of_its_kind_say(events, hidden):
    view = WindowView()
    for kind, state in events:
        view.take(kind, state)
    assert view.is_there
    assert view.why_hidden("", is_asleep=False) == hidden


def test_of_several_reasons_that_a_window_is_not_seen_the_widest_is_told():
    view = WindowView()
    assert view.why_hidden("", is_asleep=True) == "on a display that sleeps"
    assert view.why_hidden("off the screen", is_asleep=True) == "off the screen"
    view.take(*COVERED)
    assert view.why_hidden("", is_asleep=True) == "covered"
    assert view.why_hidden("off the screen", is_asleep=False) == "off the screen"
    view.take(UNMAP_NOTIFY, 0)
    assert view.why_hidden("off the screen", is_asleep=True) == "not on the screen"
    view.take(DESTROY_NOTIFY, 0)
    assert not view.is_there


@pytest.mark.parametrize(
    ("corner_px", "size_px", "is_seen"),
    [
        ((0, 0), (1920, 1080), True),  # it fills the screen to its last pixel
        ((0, 0), (1921, 1080), False),
        ((0, 0), (1920, 1081), False),
        ((1, 0), (1920, 1080), False),
        ((-1, 0), (640, 480), False),
        ((0, -1), (640, 480), False),
        ((1280, 600), (640, 480), True),
        ((1281, 600), (640, 480), False),
        ((1280, 601), (640, 480), False),
    ],
)
def test_a_window_is_on_the_screen_where_all_of_its_pixels_are(corner_px, size_px, is_seen):
    area = ScreenArea(corner_px, size_px)
    assert (off_place(area, None, (1920, 1080)) == "") is is_seen
    # one that has to fill a display is right there alone, wherever the screen ends
    assert off_place(area, area, (1, 1)) == ""
    moved = ScreenArea((corner_px[0] + 1, corner_px[1]), size_px)
    assert off_place(moved, area, (1920, 1080)) == "moved off its display"
    larger = ScreenArea(corner_px, (size_px[0], size_px[1] + 1))
    assert off_place(area, larger, (1920, 1080)) == "moved off its display"


def present_event(
    mode: int, kind: int = 0, event_type: int = 1, opcode: int = OPCODE, response: int = 35
) -> bytes:
    """PresentCompleteNotify of presentproto 1.2, section 8: a generic event (35) of the extension,
    of type 1, of a pixmap (0) or of a notice (1).
    """
    return struct.pack("<BBHIHBB20x", response, opcode, 7, 2, event_type, kind, mode)


@pytest.mark.parametrize(
    ("fields", "shown"),
    [
        ({"mode": 0}, "copy"),
        ({"mode": 1}, "flip"),
        ({"mode": 2}, "skip"),
        ({"mode": 3}, "copy"),  # SuboptimalCopy
        ({"mode": 1, "response": 35 | 0x80}, "flip"),  # one that a program sent
        ({"mode": 4}, ""),
        ({"mode": 1, "kind": 1}, ""),  # NotifyMSC: no frame of anybody's
        ({"mode": 1, "event_type": 2}, ""),  # IdleNotify
        ({"mode": 1, "opcode": OPCODE + 1}, ""),
        ({"mode": 1, "response": 22}, ""),
    ],
)
def test_a_frame_was_shown_as_presents_event_of_its_pixmap_says(fields, shown):
    event = present_event(**fields)
    assert len(event) == 32
    assert shown_as(event, OPCODE) == shown


def ramp(gamma: float, steps: int = 256, gain: float = 1.0) -> bytes:
    curve = gain * np.linspace(0, 1, steps) ** gamma
    return np.tile(np.rint(curve * 65535).astype(np.uint16), (3, 1)).tobytes()


@pytest.mark.parametrize(
    ("now", "first", "foreign"),
    [
        (ramp(1.0), ramp(1.0), False),
        (ramp(1.4), ramp(1.0), True),
        (ramp(1.0, gain=0.5), ramp(1.0), True),
        (ramp(1.4), ramp(1.4), False),  # the display's own, which it does not let go
        (ramp(1.0), ramp(1.4), False),  # straight, whoever set it
        (b"", ramp(1.0), False),  # the output is dark
    ],
)
def test_a_ramp_is_anothers_where_it_is_neither_the_first_nor_straight(now, first, foreign):
    assert is_foreign(now, first) is foreign


def test_a_ramp_is_every_step_of_red_then_of_green_then_of_blue():
    curves = np.arange(12, dtype=np.uint16).reshape(3, 4)
    made = GammaInfo(4, *(curve.ctypes.data for curve in curves))
    assert ramp_of(made) == curves.tobytes()


@pytest.mark.parametrize(
    ("code", "ends"),
    # X.h: BadValue, BadWindow, BadMatch, BadDrawable, BadAccess; from 128 on those of extensions
    [(2, False), (3, True), (8, False), (9, True), (10, False), (127, False), (128, True)],
)
def test_errors_of_windows_drawables_and_extensions_are_the_windows_end(code, ends):
    assert is_end_of_window(code) is ends


def test_an_x_error_ends_the_run_unless_its_connection_says_nothing_of_the_window(monkeypatch):
    handlers = []

    def take(handler):
        """Xlib gives the handler that it had."""
        handlers.append(handler)
        return f"before {len(handlers)}"

    # Xlib calls what these two are given: once for a lost server, and once for each error
    library = SimpleNamespace(
        XSetIOErrorHandler=take,
        XSetErrorHandler=take,
    )
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    ends: list[str] = []
    survival = Survival(ends.append)
    window, outputs = 0x10, 0x20
    survival.cover(window)
    survival.cover(outputs, decides=False)
    lost_server, error = handlers
    event_kind = error._argtypes_[1]._type_

    def fail(connection: int, code: int) -> None:
        error(connection, ctypes.pointer(event_kind(error=code)))

    bad_value, bad_window = 2, 3  # X.h
    fail(outputs, bad_window)
    fail(window, bad_value)
    assert ends == []
    fail(window, bad_window)
    assert ends == [WINDOW_GONE]
    lost_server(window)
    assert ends == [WINDOW_GONE, SERVER_GONE]
    survival.close()
    assert handlers[2:] == ["before 1", "before 2"]


# VESA DMT 1.13, CEA-861 (1080i), and xorg's 320 x 240 of double scan: size, dot clock in Hz, a
# line's pixels, a frame's lines, the flags of randr.h, and the refresh
MODES = [
    ((640, 480), 25_175_000, 800, 525, 0, 59.940),
    ((1920, 1080), 148_500_000, 2200, 1125, 0, 60.000),
    ((1920, 1200), 154_000_000, 2080, 1235, 0, 59.950),
    ((2560, 1440), 241_500_000, 2720, 1481, 0, 59.951),
    ((1920, 1080), 74_250_000, 2200, 1125, 0x10, 60.000),  # 1080i, fields
    ((320, 240), 12_587_500, 400, 262, 0x20, 60.055),  # half of 640 x 480, each line twice
]


@pytest.mark.parametrize(("size", "dot_clock", "h_total", "v_total", "flags", "refresh_hz"), MODES)
def test_a_modes_refresh_is_its_dot_clock_over_all_of_its_pixels(
    size, dot_clock, h_total, v_total, flags, refresh_hz
):
    width, height = size
    # XRRModeInfo: begin, end and total of a line, its skew, begin, end and total of a frame
    sync = (width + 16, width + 60, h_total, 0, height + 3, height + 8, v_total)
    mode = ModeInfo(1, width, height, dot_clock, (ctypes.c_uint * 7)(*sync), flags=flags)
    assert refresh_hz_of(mode) == pytest.approx(refresh_hz, abs=0.0006)  # three decimals
    assert refresh_hz_of(ModeInfo(1, width, height, dot_clock)) == 0.0


def test_each_lit_output_knows_the_others_and_not_itself():
    lit = [OutputState(name, (640, 480)) for name in ("DP-1", "DP-2", "HDMI-1")]
    states = side_by_side(lit, ("Intel", "NVIDIA"))
    assert [state.others for state in states] == [
        ("DP-2", "HDMI-1"),
        ("DP-1", "HDMI-1"),
        ("DP-1", "DP-2"),
    ]
    assert all(state.providers == ("Intel", "NVIDIA") for state in states)
    (alone,) = side_by_side(lit[:1], ())
    assert alone.others == ()


def test_a_monitors_settings_are_what_it_has_now_and_not_what_it_can_have():
    """The forms of `ddcutil getvcp --terse`: continuous (C), simple (SNC) and complex (CNC) values."""
    printed = "VCP 10 C 40 100\nVCP 12 C 75 80\nVCP 14 SNC x05\nVCP C0 CNC x00 xff x04 xb0\n"
    assert ddc_settings(printed) == {
        "brightness": 40,
        "contrast": 75,
        "colour_preset": 5,
        "hours": 0x04B0,
    }
    assert ddc_settings("VCP 10 ERR\nVCP 12 C 75 80\nVCP 60 SNC x0f\n") == {"contrast": 75}


def test_the_kernels_edid_is_found_by_its_own_name_of_a_connector_and_by_xs(tmp_path):
    for name, block in (
        ("card0-DP-1", b""),
        ("card0-HDMI-A-1", b"first"),
        ("card1-HDMI-A-2", b"second"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "edid").write_bytes(block)
    names = ("DP-1", "HDMI-A-1", "HDMI-2", "VGA-1")
    blocks = {name: edid_of_drm(name, tmp_path) for name in names}
    assert blocks == {"DP-1": b"", "HDMI-A-1": b"first", "HDMI-2": b"second", "VGA-1": b""}


@pytest.mark.parametrize(
    ("timeout_s", "dpms", "happens"),
    [(0, False, False), (600, False, True), (0, True, True), (600, True, True)],
)
def test_a_screen_goes_dark_by_its_saver_or_by_standby(timeout_s, dpms, happens):
    set_before = Blanking(timeout_s, 600, 1, 1, dpms)
    aside = SetAside()
    assert aside.takes(set_before) is happens
    nothing = Blanking(0, 600, 0, 1, False)
    assert aside.to_restore(nothing) == (set_before if happens else None)


def test_what_somebody_sets_meanwhile_comes_back_and_what_stands_at_the_end_stays():
    nothing = Blanking(0, 600, 0, 1, False)
    saver = Blanking(600, 600, 1, 1, False)
    standby = Blanking(0, 600, 0, 1, True)
    aside = SetAside()
    assert [aside.takes(now) for now in (saver, nothing, standby, nothing)] == [
        True,
        False,
        True,
        False,
    ]
    assert aside.to_restore(nothing) == standby
    assert aside.to_restore(saver) is None


class StandIn:
    """Stands for libX11 and libXext before a server with DPMS: no server that runs without a
    monitor has it.
    """

    def __init__(self) -> None:
        self.saver, self.level, self.on, self.calls = [600, 300, 1, 1], 3, 1, []
        self.XOpenDisplay = lambda _: 1  # takes an attribute, as a function of ctypes does

    def DPMSQueryExtension(self, *_: object) -> int:
        return 1

    def DPMSCapable(self, _: object) -> int:
        return 1

    def DPMSInfo(self, _: object, level: ctypes.c_ushort, on: ctypes.c_ubyte) -> None:
        level._obj.value, on._obj.value = self.level, self.on

    def XGetScreenSaver(self, _: object, *parts: ctypes.c_int) -> None:
        for part, value in zip(parts, self.saver, strict=True):
            part._obj.value = value

    def XSetScreenSaver(self, _: object, *parts: int) -> None:
        self.saver = list(parts)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda _, *words: self.calls.append((name, *words))


def test_standby_is_ended_prevented_and_restored(monkeypatch):
    library = StandIn()
    monkeypatch.setattr(ctypes, "CDLL", lambda _: library)
    server = _Server()
    before = server.blanking()
    assert before == (600, 300, 1, 1, True) and before.happens
    server.prevent(before)
    assert [name for name, *_ in library.calls] == [
        "DPMSForceLevel",
        "DPMSDisable",
        "XForceScreenSaver",
        "XSync",
    ]
    library.on = 0  # as the server has it after that
    assert not server.blanking().happens
    server.restore(before)
    assert library.calls[-2][0] == "DPMSEnable" and library.saver == [600, 300, 1, 1]
    library.calls.clear()
    server.restore(before._replace(dpms=False))
    assert [name for name, *_ in library.calls] == ["XSync"]


class Driver:
    """A driver with GLX_OML_sync_control and framebuffers, called as its definitions say."""

    def __init__(self, swap_us: int | None = None, sizes: tuple[int, int, int] = (8, 8, 8)) -> None:
        self.swap_us = swap_us
        self.sizes = dict(zip((0x8212, 0x8213, 0x8214), sizes, strict=True))  # glext.h
        self._wait = WAIT_FOR_SBC(self._last_swap)
        self._attachment = GET_ATTACHMENT(self._size)
        self._integer = GET_INTEGER(self._samples)

    def glXGetProcAddress(self, name: bytes) -> int:
        assert name == b"glXWaitForSbcOML"
        return self._address(self._wait)

    def address_of(self, name: str) -> int:
        functions = {
            "glGetFramebufferAttachmentParameteriv": self._attachment,
            "glGetIntegerv": self._integer,
        }
        return self._address(functions[name])

    @staticmethod
    def _address(function: object) -> int:
        return ctypes.cast(function, ctypes.c_void_p).value or 0

    def _last_swap(self, display, drawable, target, ust, msc, sbc) -> int:
        if self.swap_us is None:
            return 0
        ust[0], msc[0], sbc[0] = self.swap_us, 3, 3
        return 1

    def _size(self, target, attachment, what, value) -> None:
        value[0] = self.sizes[what]

    def _samples(self, what, value) -> None:
        assert what == 0x80A9  # GL_SAMPLES
        value[0] = 4


def test_the_time_of_a_swap_is_the_drivers_microseconds_in_nanoseconds():
    """GLX_OML_sync_control: "UST is ... in microseconds"."""
    assert SyncControl(Driver(1_234_567_891), 1, 2).swap_ns() == 1_234_567_891_000
    assert SyncControl(Driver(None), 1, 2).swap_ns() is None


def test_without_a_driver_that_tells_of_swaps_there_is_no_sync_control():
    assert sync_control(None, None) is None
    assert sync_control(0, 5) is None
    assert sync_control(5, 0) is None


@pytest.mark.parametrize("sizes", [(8, 8, 8), (2, 10, 10), (5, 6, 5), (11, 11, 10)])
def test_a_back_buffer_is_as_deep_as_its_coarsest_colour(sizes):
    found = back_buffer(Driver(sizes=sizes).address_of)
    assert (found.bits, found.samples) == (min(sizes), 4)


def test_gaps_between_a_drivers_times_are_counted_only_where_they_follow_one_another():
    """A driver that misses all but one of many keeps its times; one that has none loses them."""
    now_ns = 10**12
    stamp_ns = now_ns - 1
    rare = [*[None] * (MAX_GAPS - 1), stamp_ns]
    none = [None] * MAX_GAPS
    told_ns = iter([*rare * 3, *none, stamp_ns])
    stamps = SwapStamps(told_ns.__next__, 16_666_667, lambda: now_ns)
    for wanted_ns in rare * 3:
        assert stamps.after_swap(lambda: None) == (wanted_ns or now_ns)
    assert stamps.source == SYNC_EXTENSION.decode()
    for _ in none:
        assert stamps.after_swap(lambda: None) == now_ns
    assert stamps.after_swap(lambda: None) == now_ns  # its stamp is not asked for any more
    assert stamps.source == CLOCK


def test_an_output_is_found_by_its_whole_name_and_none_without_a_server(monkeypatch):
    outputs = [OutputState(name, (640, 480)) for name in ("HDMI-10", "HDMI-1", "DP-1")]
    assert randr.named(outputs, "HDMI-1") is outputs[1]
    assert randr.named(outputs, "HDMI") is None
    monkeypatch.setenv("DISPLAY", NO_SERVER)
    assert randr.output_named("HDMI-1") is None
    assert randr.lit_outputs() == []


@pytest.mark.parametrize(
    ("age_ns", "is_taken"),
    [
        (-16_666_667, True),  # a stamp of the end of the blank that has begun
        (-16_666_668, False),
        (0, True),
        (MAX_UST_AGE_NS - 1, True),
        (MAX_UST_AGE_NS, False),
    ],
)
def test_a_driver_s_time_is_of_this_swap_from_a_refresh_ahead_to_a_second_ago(age_ns, is_taken):
    now_ns = 10**12
    waited: list[int] = []
    stamps = SwapStamps(lambda: now_ns - age_ns, 16_666_667, lambda: now_ns)
    swap_ns = stamps.after_swap(lambda: waited.append(1))
    assert swap_ns == (now_ns - age_ns if is_taken else now_ns)
    assert (stamps.source, len(waited)) == (
        (SYNC_EXTENSION.decode(), 0) if is_taken else (CLOCK, 1)
    )


def test_frames_were_shown_in_the_ways_of_which_the_server_counted_some():
    assert presented_as({"flip": 5, "copy": 0}) == "flip"
    assert presented_as({"flip": 0, "copy": 3, "skip": 2}) == "copy"
    assert presented_as({"copy": 3, "flip": 5}) == "flip and copy"
    assert presented_as({"skip": 2}) == presented_as({}) == "unknown"


def test_a_server_s_release_is_three_numbers(monkeypatch):
    """X.Org writes 1.21.1.4 as 12101004; the last is a snapshot's."""
    closed: list[int] = []
    library = SimpleNamespace(
        XOpenDisplay=lambda name: 7,
        XVendorRelease=lambda display: 12_101_004,
        XServerVendor=lambda display: b"The X.Org Foundation",
        XCloseDisplay=closed.append,
    )
    monkeypatch.setattr(x11, "xlib", lambda: library)
    assert x11.server_of() == "The X.Org Foundation 1.21.1"
    assert closed == [7]
    library.XOpenDisplay = lambda name: None
    assert x11.server_of() == ""


@pytest.mark.parametrize("is_there", [True, False])
def test_an_extension_is_there_as_the_server_says_and_nowhere_without_one(monkeypatch, is_there):
    asked: list[tuple[int, bytes]] = []

    def query(display, name, opcode, event, error):
        asked.append((display, name))
        return int(is_there)

    monkeypatch.setattr(x11, "xlib", lambda: SimpleNamespace(XQueryExtension=query))
    assert not x11.has_extension(None, b"Present")
    assert not asked
    assert x11.has_extension(7, b"Present") is is_there
    assert asked == [(7, b"Present")]
