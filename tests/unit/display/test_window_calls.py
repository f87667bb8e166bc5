"""What a window asks GLFW for, in which order, and what it makes of what GLFW says: against a GLFW
of two monitors that notes each call. tests/screen has the real one on a real X server.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hilstar.basics.errors import MachineError, NoDisplayError, NotThereError
from hilstar.basics.units import NS_PER_S
from hilstar.display.window import library as library_module
from hilstar.display.window import window as window_module
from hilstar.display.window.awake import Awake
from hilstar.display.window.library import glfw as real_glfw
from hilstar.display.window.window import Window, WindowSettings, displays
from tests.support.refusals import line_of
from tests.unit.display.test_displays import mode

Call = tuple[Any, ...]
WINDOW = "the window"
FIRST, SECOND = "monitor of the first", "monitor of the second"
SETTINGS = WindowSettings((640, 480), bits=10, display="DP-2", refresh_hz=75)
COLUMNS = ([0.0, 0.2, 0.6, 1.0], [0.0, 0.3, 0.7, 1.0], [0.0, 0.5, 0.8, 1.0])
RAMP = real_glfw._GLFWgammaramp.GLFWgammaramp(*COLUMNS)


class Glfw:
    """GLFW's functions of what Window asks, by GLFW's own constants, of two monitors side by side.
    Each call that changes something stands in `calls`.
    """

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self.hints: dict[int, Any] = {}
        self.callbacks: dict[str, Any] = {}
        self.monitors = {FIRST: (b"DP-1", (0, 0)), SECOND: (b"DP-2", (1920, -120))}
        self.modes = {FIRST: mode((1920, 1080), 60), SECOND: mode((1280, 1024), 60, (10, 10, 6))}
        self.newest = (3, 3)  # the OpenGL that its driver has
        self.robust = True
        self.window_monitor: Any = None
        self.ramp: Any = RAMP
        self.holds_ramps = True
        self.sizes_px = ((640, 480), (640, 480))
        self.at_swap: Callable[[], object] = int

    def __getattr__(self, name: str) -> Any:
        if name.isupper():
            return getattr(real_glfw, name)

        def noted(*arguments: Any) -> None:
            self.calls.append((name, *arguments))

        return noted

    def of(self, name: str) -> list[Call]:
        return [call[1:] for call in self.calls if call[0] == name]

    def init(self) -> bool:
        return True

    def window_hint(self, hint: int, value: Any) -> None:
        self.hints[hint] = value

    def create_window(self, *arguments: Any) -> Any:
        version = (self.hints[self.CONTEXT_VERSION_MAJOR], self.hints[self.CONTEXT_VERSION_MINOR])
        robustness = self.hints[self.CONTEXT_ROBUSTNESS]
        self.calls.append(("create_window", *arguments, version, robustness))
        is_robust = robustness == self.LOSE_CONTEXT_ON_RESET
        if version > self.newest or (is_robust and not self.robust):
            return None
        self.window_monitor = arguments[3]
        return WINDOW

    def get_platform(self) -> int:
        return int(real_glfw.PLATFORM_NULL)

    def get_monitors(self) -> list[str]:
        return list(self.monitors)

    def get_monitor_name(self, monitor: str) -> bytes:
        return self.monitors[monitor][0]

    def get_monitor_pos(self, monitor: str) -> tuple[int, int]:
        return self.monitors[monitor][1]

    def get_monitor_physical_size(self, monitor: str) -> tuple[int, int]:
        return 520, 290

    def get_monitor_content_scale(self, monitor: str) -> tuple[float, float]:
        return 1.5, 2.0

    def get_video_mode(self, monitor: str) -> Any:
        return self.modes[monitor]

    def get_video_modes(self, monitor: str) -> list[Any]:
        size = self.modes[monitor].size
        return [mode((size.width, size.height), hz) for hz in (60, 75)]

    def get_primary_monitor(self) -> str:
        return FIRST

    def get_window_monitor(self, window: str) -> Any:
        return self.window_monitor

    def set_window_monitor(self, window: str, monitor: str, *place: int) -> None:
        self.calls.append(("set_window_monitor", monitor, *place))
        self.window_monitor = monitor

    def get_gamma_ramp(self, monitor: str) -> Any:
        return self.ramp

    def set_gamma_ramp(self, monitor: str, ramp: Any) -> None:
        columns = [list(column) for column in ramp]
        self.calls.append(("set_gamma_ramp", monitor, columns))
        if self.holds_ramps:
            self.ramp = real_glfw._GLFWgammaramp.GLFWgammaramp(*columns)

    def set_key_callback(self, window: str, callback: Any) -> None:
        self.callbacks["key"] = callback

    def set_monitor_callback(self, callback: Any) -> None:
        self.callbacks["monitor"] = callback

    def set_window_iconify_callback(self, window: str, callback: Any) -> None:
        self.callbacks["iconify"] = callback

    def get_window_size(self, window: str) -> tuple[int, int]:
        return self.sizes_px[0]

    def get_framebuffer_size(self, window: str) -> tuple[int, int]:
        return self.sizes_px[1]

    def swap_buffers(self, window: str) -> None:
        self.calls.append(("swap_buffers", window))
        self.at_swap()

    def window_should_close(self, window: str) -> bool:
        return False

    def unplug(self, monitor: str) -> Any:
        self.window_monitor = None
        self.callbacks["monitor"](monitor, self.DISCONNECTED)
        return self.monitors.pop(monitor)


@pytest.fixture
def library(monkeypatch) -> Glfw:
    made = Glfw()
    monkeypatch.setattr(window_module, "glfw", made)
    monkeypatch.setenv("DISPLAY", ":nowhere")  # whose processes find no server, and end
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    closed = Awake.close

    def noted(awake: Awake) -> None:
        made.calls.append(("awake closed",))
        closed(awake)

    monkeypatch.setattr(Awake, "close", noted)
    return made


def lacking(kind: type[MachineError], asked: Callable[..., object], *arguments: object) -> str:
    """The line by which a machine that lacks something refuses a call."""
    with pytest.raises(MachineError) as caught:
        asked(*arguments)
    assert type(caught.value) is kind
    return line_of(caught.value)


STRAIGHT = [pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])] * 3


def test_a_window_fills_its_display_and_leaves_it_as_it_was(library):
    """Its size is the display's, whatever the settings say; each colour has the bits asked for."""
    with Window(SETTINGS) as window:
        hints = library.hints
        assert hints[library.REFRESH_RATE] == 75
        bits = (library.RED_BITS, library.GREEN_BITS, library.BLUE_BITS)
        assert [hints[colour] for colour in bits] == [10, 10, 10]
        assert hints[library.OPENGL_PROFILE] == library.OPENGL_CORE_PROFILE
        off = ("RESIZABLE", "AUTO_ICONIFY", "SCALE_TO_MONITOR", "SRGB_CAPABLE")
        assert [hints[getattr(library, name)] for name in off] == [False] * 4
        asked = library.of("create_window")
        assert {call[:5] for call in asked} == {(1280, 1024, "hilstar", SECOND, None)}
        assert [call[5] for call in asked] == [(4, 6), (4, 5), (4, 3), (3, 3)]
        assert {call[6] for call in asked} == {library.LOSE_CONTEXT_ON_RESET}
        assert library.of("make_context_current") == [(WINDOW,)]
        assert library.of("swap_interval") == [(1,)]
        assert library.of("set_input_mode") == [(WINDOW, library.CURSOR, library.CURSOR_HIDDEN)]
        assert library.of("set_gamma_ramp") == [(SECOND, STRAIGHT)]
        assert not window.ramp_refused
        assert window.display is not None
        assert (window.display.name, window.display.position_px) == ("DP-2", (1920, -120))
        assert (window.display.scale, window.display.bits) == (1.5, 6)
        assert (window.ramp_size, window.screen_bits, window.modes_hz) == (4, 6, (60, 75))
        assert (window.others, window.mirrored) == (("DP-1",), None)
        assert (window.hidden, window.closing, window.scaled) == ("", False, False)
        library.calls.clear()
    kept = [list(column) for column in RAMP]
    assert library.calls == [
        ("set_gamma_ramp", SECOND, kept),
        ("terminate",),
        ("awake closed",),
    ]


def test_an_ordinary_window_has_the_size_that_is_asked_for_and_touches_no_ramp(library):
    """A driver without robust contexts is asked again without; one of OpenGL 4.3 gives that."""
    library.robust, library.newest = False, (4, 3)
    library.sizes_px = ((640, 480), (1280, 960))
    with Window(WindowSettings((640, 480), bits=8)) as window:
        assert library.of("create_window")[-1] == (
            640, 480, "hilstar", None, None, (4, 3), library.NO_ROBUSTNESS,
        )  # fmt: skip
        assert len(library.of("create_window")) == 4 + 3
        assert library.REFRESH_RATE not in library.hints
        assert library.of("set_input_mode") == [(WINDOW, library.CURSOR, library.CURSOR_NORMAL)]
        assert window.scaled
        assert window.size_px == (1280, 960)
        assert (window.ramp_size, window.others, window.mirrored) == (0, (), None)
        assert (window.modes_hz, window.output, window.presented) == ((), None, {})
        assert window.screen_bits == 8  # of the first monitor, where it is on none
    assert library.of("set_gamma_ramp") == []


@pytest.mark.parametrize("holds", [True, False])
def test_a_display_that_keeps_a_curved_ramp_is_seen(library, holds):
    library.holds_ramps = holds
    with Window(SETTINGS) as window:
        assert window.ramp_refused is not holds


def test_a_window_returns_to_its_display_once_it_is_back(library, caplog):
    """Its place and its ramp are set anew; the ramp of before is that of the display now."""
    with Window(SETTINGS) as window:
        library.calls.clear()
        window.look_at_events()
        assert library.calls == [("poll_events",)]
        kept = library.unplug(SECOND)
        window.look_at_events()
        assert window.lost
        assert window.ramp_size == 0
        library.callbacks["iconify"](WINDOW, 1)
        assert window.hidden == "without its display"
        window.look_at_events()
        assert library.of("set_window_monitor") == []
        library.monitors[SECOND] = kept
        library.ramp = RAMP
        library.callbacks["monitor"](SECOND, library.CONNECTED)
        window.look_at_events()
        assert not window.lost
        assert library.of("set_window_monitor") == [(SECOND, 0, 0, 1280, 1024, 60)]
        assert library.of("set_gamma_ramp") == [(SECOND, STRAIGHT)]
        assert window.hidden == "minimised"
        library.callbacks["iconify"](WINDOW, 0)
        assert window.hidden == ""
        assert window.ramp_size == 4
    told = [record.getMessage() for record in caplog.records]
    assert told == [
        "the display DP-2 is gone; frames go on, and the window returns to it when it is back",
        "the display DP-2 is back",
    ]


def test_the_last_64_keys_that_were_pressed_wait_in_their_order(library):
    with Window(SETTINGS) as window:
        letters = [chr(ord("a") + k % 26) for k in range(70)]
        for letter in letters:
            for action in (library.PRESS, library.REPEAT, library.RELEASE):
                library.callbacks["key"](WINDOW, ord(letter.upper()), 0, action, 0)
        assert list(window.keys) == letters[-64:]


def test_a_swap_is_timed_once_it_is_done_and_none_is_asked_of_a_window_that_is_gone(library):
    with Window(SETTINGS) as window:
        done: list[str] = []
        window.swap(lambda: done.append("waited"))
        assert library.of("swap_buffers") == [(WINDOW,)]
        assert done == ["waited"]
        window._on_end("the X server is gone")
        window._on_end("the window is gone")
        assert window.gone == "the X server is gone"
        assert window.swap(lambda: done.append("again")) > 0
        assert (done, len(library.of("swap_buffers"))) == (["waited"], 1)
        library.calls.clear()
        window.look_at_events()
        assert window.closing
        assert (window.modes_hz, window.others, window.output) == ((), (), None)
    # there is no server left to tell
    assert library.calls == [("awake closed",)]


def test_a_window_that_goes_while_it_is_swapped_is_asked_for_no_time(library):
    with Window(SETTINGS) as window:
        library.at_swap = lambda: window._on_end("the window is gone")
        assert window.swap(lambda: pytest.fail("it waits for a window that is gone")) > 0


@pytest.mark.parametrize(
    ("display", "asked_hz", "mode_hz", "wanted_hz"),
    [("DP-2", 75, 50, 50), ("DP-2", 75, 0, 75), ("DP-2", None, 0, 60), (None, 75, 50, 75)],
)
def test_a_period_is_that_of_the_display_else_that_which_is_asked_for(
    library, monkeypatch, display, asked_hz, mode_hz, wanted_hz
):
    library.modes[SECOND] = mode((1280, 1024), mode_hz)
    periods_ns: list[float] = []
    stamps = window_module.SwapStamps

    def noted(sync: Any, period_ns: float) -> Any:
        periods_ns.append(period_ns)
        return stamps(sync, period_ns)

    monkeypatch.setattr(window_module, "SwapStamps", noted)
    with Window(WindowSettings((640, 480), 8, display, asked_hz)):
        assert periods_ns == [NS_PER_S / wanted_hz]


def test_without_a_window_or_a_display_one_line_says_what_is_missing(library, monkeypatch):
    library.newest = (3, 2)
    line = lacking(MachineError, Window, SETTINGS)
    assert line.startswith("no window with OpenGL 3.3 can be opened; install it: apt-get install")
    assert library.calls[-2:] == [("terminate",), ("awake closed",)]
    nowhere = WindowSettings((640, 480), 8, "DP-3")
    assert lacking(NotThereError, Window, nowhere) == (
        "[monitor] display = 'DP-3': no such display; did you mean DP-2? plug it in, or write the"
        " index or name of one of 0: DP-1, 1920 x 1080, 60 Hz, 520 x 290 mm; 1: DP-2, 1280 x 1024,"
        " 60 Hz, 520 x 290 mm"
    )
    library.calls.clear()
    assert [display.line() for display in displays()] == [
        "0: DP-1, 1920 x 1080, 60 Hz, 520 x 290 mm",
        "1: DP-2, 1280 x 1024, 60 Hz, 520 x 290 mm",
    ]
    assert library.calls[-1] == ("terminate",)
    monkeypatch.setattr(Glfw, "init", lambda _: False)
    assert lacking(NoDisplayError, displays).startswith("DISPLAY=:nowhere: no X server")
    monkeypatch.delenv("DISPLAY")
    assert lacking(NoDisplayError, displays) == ("no display to open a window on; set DISPLAY")
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert lacking(NoDisplayError, displays).startswith("no X11 display: this session is")


def test_glfw_s_own_library_for_x11_is_taken_unless_another_is_named(monkeypatch):
    """Whatever the session: GLFW's own choice would take Wayland's there."""
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    monkeypatch.setenv("PYGLFW_LIBRARY", "/opt/glfw/libglfw.so")
    importlib.reload(library_module)
    assert os.environ["PYGLFW_LIBRARY"] == "/opt/glfw/libglfw.so"
    monkeypatch.setenv("PYGLFW_LIBRARY", "")
    importlib.reload(library_module)
    chosen = Path(os.environ["PYGLFW_LIBRARY"])
    assert chosen.is_file()
    assert chosen.parts[-3:] == ("glfw", "x11", "libglfw.so")


def test_what_begins_the_keeper_of_the_screen_is_waited_for(tmp_path, monkeypatch):
    """It closes its stdout, and ends a moment later."""
    beginner = tmp_path / "beginner"
    beginner.write_text("#!/bin/sh\nexec >&-\nsleep 0.2\n")
    beginner.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(beginner))
    awake = Awake()
    awake.close()
    assert awake._process.returncode == 0
