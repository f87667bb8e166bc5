"""The window on the monitor: full screen on a chosen display, or an ordinary window. The only
user of glfw.
"""

import contextlib
import ctypes
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hilstar.basics.errors import MachineError, NoDisplayError, NotThereError, did_you_mean
from hilstar.basics.process.closing import Closing
from hilstar.basics.units import GL_VERSIONS, NS_PER_S
from hilstar.display.egl import leave_contexts
from hilstar.display.window.awake import Awake
from hilstar.display.window.displays import Display, display_of
from hilstar.display.window.library import glfw
from hilstar.display.window.output_settings import OutputState
from hilstar.display.window.randr import output_named
from hilstar.display.window.visibility import ScreenArea, Visibility
from hilstar.display.window.watch import DisplayWatch, is_straight, straight_ramp
from hilstar.display.window.x11 import (
    BackBuffer,
    Survival,
    SwapStamps,
    back_buffer,
    has_extension,
    is_composited,
    sync_control,
)

TITLE = "hilstar"
USUAL_REFRESH_HZ = 60
GL_RENDERER = 0x1F01
NO_DISPLAY = "no display to open a window on; set DISPLAY"
DEAD_DISPLAY = (
    "no X server answers there, or it does not let us in (XAUTHORITY); start it, or set DISPLAY"
    " to one that runs"
)
WAYLAND = (
    "no X11 display: this session is Wayland's, where a program can neither time its frames nor set"
    " the gamma ramp; use an Xorg session"
)
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """`display` is an index or a part of a name, None for an ordinary window; `bits` are requested
    per colour.

    `refresh_hz` is asked for where the display has it; by default the display keeps its own.
    """

    resolution_px: tuple[int, int]
    bits: int
    display: int | str | None = None
    refresh_hz: float | None = None


def displays() -> list[Display]:
    """The monitors of this machine. Raises MachineError without a display."""
    with _glfw():
        return _displays()


def window_renderer() -> str:
    """The GL_RENDERER that draws a window here; "" where none opens. Raises MachineError without
    a display.
    """
    with _glfw():
        glfw.window_hint(glfw.VISIBLE, False)
        window = _newest_window(64, 64, None)
        if not window:
            return ""
        glfw.make_context_current(window)
        address: Any = glfw.get_proc_address
        get_string = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_uint)(address("glGetString"))
        return str((get_string(GL_RENDERER) or b"").decode(errors="replace"))


@contextlib.contextmanager
def _glfw() -> Any:
    _start()
    try:
        yield
    finally:
        glfw.terminate()


def _start() -> None:
    """Begin GLFW, on X11 alone. Raises NoDisplayError without a display."""
    glfw.ERROR_REPORTING = "ignore"
    glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
    display = os.environ.get("DISPLAY")
    if not display:
        raise NoDisplayError(WAYLAND if os.environ.get("WAYLAND_DISPLAY") else NO_DISPLAY)
    if not glfw.init():
        raise NoDisplayError(f"DISPLAY={display}: {DEAD_DISPLAY}")


def _describe(index: int, monitor: Any) -> Display:
    """A monitor of GLFW's as it is now."""
    return display_of(
        index,
        glfw.get_monitor_name(monitor),
        glfw.get_video_mode(monitor),
        _pair(glfw.get_monitor_pos(monitor)),
        size_mm=_pair(glfw.get_monitor_physical_size(monitor)),
        scale=float(glfw.get_monitor_content_scale(monitor)[0]),
    )


def _displays() -> list[Display]:
    return [_describe(index, monitor) for index, monitor in enumerate(glfw.get_monitors())]


def _pair(values: Any) -> tuple[int, int]:
    first, second = values
    return int(first), int(second)


class Window(Closing):
    """A window whose GL context is current in the thread that opened it. Free it with `close`.

    `lost` is true while its display is unplugged; `gone` says why the window is no more. Raises
    MachineError without a display or GL, and for a display that is not there.
    """

    def __init__(self, settings: WindowSettings) -> None:
        _start()
        self.settings = settings
        self.keys: deque[str] = deque(maxlen=64)
        self._ramp: tuple[Any, Any] | None = None
        self._changed = False  # a monitor came or went
        self.ramp_refused = False  # the display keeps a gamma ramp that is not straight
        self.lost = False
        self.gone: str | None = None
        self._survival: Survival | None = None
        self._visibility: Visibility | None = None
        self._watch: DisplayWatch | None = None
        self._minimised = False
        self._awake = Awake()
        try:
            self._open()
        except BaseException:
            glfw.terminate()
            self._awake.close()
            raise

    def _open(self) -> None:
        settings = self.settings
        self.display: Display | None = None
        monitor = None
        if settings.display is not None:
            self.display, monitor = _find(settings.display)
            # Left to itself, GLFW switches a display to its highest refresh.
            modes_hz = self.display.rates_hz(glfw.get_video_modes(monitor))
            refresh_hz = self.display.refresh_for(settings.refresh_hz, modes_hz)
            glfw.window_hint(glfw.REFRESH_RATE, refresh_hz or glfw.DONT_CARE)
        for hint, value in (
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
            (glfw.RESIZABLE, False),
            (glfw.AUTO_ICONIFY, False),
            (glfw.SCALE_TO_MONITOR, False),
            (glfw.SRGB_CAPABLE, False),
            (glfw.RED_BITS, settings.bits),
            (glfw.GREEN_BITS, settings.bits),
            (glfw.BLUE_BITS, settings.bits),
        ):
            glfw.window_hint(hint, value)
        width, height = settings.resolution_px
        if self.display is not None:
            width, height = self.display.resolution_px
        self._window = _newest_window(width, height, monitor)
        if not self._window:
            raise MachineError(
                "no window with OpenGL 3.3 can be opened; install it: apt-get install libgl1"
                " libgl1-mesa-dri"
            )
        if self.display is not None:  # as it is now
            self.display = _describe(self.display.index, monitor)
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        cursor = glfw.CURSOR_HIDDEN if monitor else glfw.CURSOR_NORMAL
        glfw.set_input_mode(self._window, glfw.CURSOR, cursor)
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_monitor_callback(self._on_monitor)
        glfw.set_window_iconify_callback(self._window, self._on_iconify)
        x_display: Any = glfw.get_x11_display
        self._x_display = x_display() if glfw.get_platform() == glfw.PLATFORM_X11 else None
        if self._x_display:
            self._survival = Survival(self._on_end)
            self._survival.cover(self._x_display)
            window = glfw.get_x11_window(self._window)
            area = None if monitor is None else _area_of(monitor)
            self._visibility = Visibility.of(window, area, self._survival)
        glx_window = glfw.get_glx_window(self._window) if self._x_display else None
        sync = sync_control(self._x_display, glx_window)
        display_hz = 0 if self.display is None else self.display.refresh_hz
        period_ns = NS_PER_S / (display_hz or settings.refresh_hz or USUAL_REFRESH_HZ)
        self._stamps = SwapStamps(None if sync is None else sync.swap_ns, period_ns)
        if monitor is not None:
            self._set_identity_ramp(monitor)
        if self._survival is not None:
            if self.display is None:
                name = None
            else:
                name = self.display.name
            self._watch = DisplayWatch(name, glfw.get_x11_window(self._window), self._survival)

    def _set_identity_ramp(self, monitor: Any) -> None:
        """Set the identity: a correction by the system would change what the calibration
        measured.
        """
        ramp: Any = glfw.get_gamma_ramp(monitor)
        size = 0 if ramp is None else len(ramp.red)
        if not size:
            return
        self._ramp = (monitor, ([*ramp.red], [*ramp.green], [*ramp.blue]))
        straight = straight_ramp(size)
        identity: Any = (straight, straight, straight)
        glfw.set_gamma_ramp(monitor, identity)
        self.ramp_refused = not is_straight(np.array([*glfw.get_gamma_ramp(monitor)]))

    def _on_iconify(self, window: Any, minimised: int) -> None:
        self._minimised = bool(minimised)

    @property
    def hidden(self) -> str:
        """Why the window is not seen as drawn: minimised, covered, off the screen; "" where it
        is, or that is not known.
        """
        if self.lost:
            return "without its display"
        if self._minimised:
            return "minimised"
        if self._visibility is None:
            return ""
        return self._visibility.hidden

    def _on_end(self, why: str) -> None:
        """Xlib's word that the server or the window is gone; the first reason counts."""
        if self.gone is None:
            self.gone = why
        if self._watch is not None:
            self._watch.stop()

    def _on_monitor(self, monitor: Any, event: int) -> None:
        self._changed = True

    def _follow_display(self) -> None:
        """Say that the window's display is unplugged, or return to it once it is back."""
        self._changed = False
        display = self.display
        if display is None:
            return
        on_it = bool(glfw.get_window_monitor(self._window))
        monitor = _monitor_named(display.name)
        change = change_of(monitor is not None, self.lost, on_it)
        if change == "gone":
            self.lost = True
            self._ramp = None
            log.warning(
                "the display %s is gone; frames go on, and the window returns to it when it is"
                " back",
                display.name,
            )
        elif change == "back":
            width, height = display.resolution_px
            glfw.set_window_monitor(
                self._window, monitor, 0, 0, width, height, display.refresh_hz or glfw.DONT_CARE
            )
            self._set_identity_ramp(monitor)
            if self._visibility is not None:
                self._visibility.place = _area_of(monitor)
            self.lost = False
            log.warning("the display %s is back", display.name)

    def _on_key(self, window: Any, key: int, scancode: int, action: int, mods: int) -> None:
        """Queue the name of a key that is pressed, not of one that repeats or is released."""
        name = pressed_key(key, action)
        if name:
            self.keys.append(name)

    def make_current(self) -> None:
        """Take this window's GL context up again after another one was current in this thread."""
        leave_contexts()
        glfw.make_context_current(self._window)

    @property
    def size_px(self) -> tuple[int, int]:
        """The framebuffer's size."""
        width, height = glfw.get_framebuffer_size(self._window)
        return int(width), int(height)

    @property
    def back_buffer(self) -> BackBuffer:
        """The back buffer's depth and samples."""
        return back_buffer(glfw.get_proc_address)

    @property
    def ramp_size(self) -> int:
        """Steps of the display's gamma ramp; 0 where it has none, or is not known."""
        return 0 if self._ramp is None else len(self._ramp[1][0])

    @property
    def screen_bits(self) -> int:
        """Bits per colour of the screen's mode: the minimum of the three."""
        monitor = glfw.get_window_monitor(self._window) or glfw.get_primary_monitor()
        return _describe(0, monitor).bits

    @property
    def scaled(self) -> bool:
        """True where a pixel of the window is not one of the screen."""
        return tuple(glfw.get_window_size(self._window)) != self.size_px

    @property
    def closing(self) -> bool:
        """True once the user closed it, or it is gone."""
        return self.gone is not None or bool(glfw.window_should_close(self._window))

    @property
    def composited(self) -> bool:
        """True where a compositing manager is known to run."""
        return is_composited(self._x_display)

    @property
    def by_wayland(self) -> bool:
        """True where the X server is XWayland: a Wayland compositor draws the display."""
        return has_extension(self._x_display, b"XWAYLAND") or any(
            output.name.startswith("XWAYLAND") for output in _displays()
        )

    @property
    def others(self) -> tuple[str, ...]:
        """The names of the other displays of the same X screen, where this window fills one."""
        if self.display is None or self.gone is not None:
            return ()
        return tuple(output.name for output in _displays() if output.name != self.display.name)

    @property
    def mirrored(self) -> str | None:
        """The name of another display that shows the same part of the desktop, where there is
        one.
        """
        if self.display is None:
            return None
        return self.display.mirrored_by(_displays())

    @property
    def modes_hz(self) -> tuple[int, ...]:
        """The refresh rates that the display has at its size, whole Hz as the system gives them;
        none where it does not say.
        """
        display = self.display
        if self.gone is not None:
            monitor = None
        else:
            monitor = glfw.get_window_monitor(self._window)
        if not monitor or display is None:
            return ()
        return display.rates_hz(glfw.get_video_modes(monitor))

    @property
    def output(self) -> OutputState | None:
        """How the display's output is set; None in an ordinary window, and where RandR does not
        say.
        """
        if self.display is None or self.gone is not None:
            return None
        return output_named(self.display.name, self._survival)

    @property
    def ramp_changed(self) -> bool:
        """True while another program's gamma ramp lies on the display: looked at once a second."""
        return self._watch is not None and self._watch.ramp_changed

    @property
    def presented(self) -> dict[str, int]:
        """Frames that the X server flipped, copied or skipped up to now; empty where it does not
        say.
        """
        if self._watch is None or self.gone is not None:
            return {}
        return self._watch.presented

    @property
    def timestamp_source(self) -> str:
        """Where the times of `swap` come from."""
        return self._stamps.source

    def swap(self, wait: Callable[[], None] = lambda: None) -> int:
        """Show what was drawn; the host time, ns, of the swap: the driver's, else that once it is
        done.

        `wait` returns once the swap is done, where `glfwSwapBuffers` itself may return earlier and
        the driver has no times.
        """
        if self.gone is not None:
            return time.monotonic_ns()
        glfw.swap_buffers(self._window)
        # Mesa takes the size of a window that is gone from memory that nobody has set, and crashes.
        if self.gone is not None:
            return time.monotonic_ns()
        return self._stamps.after_swap(wait)

    def look_at_events(self) -> None:
        """Handle keys, and monitors that come and go."""
        if self.gone is None:
            glfw.poll_events()
        if self._changed and self.gone is None:
            self._follow_display()

    def close(self) -> None:
        """Restore the monitor's gamma ramp and its blanking, and close."""
        if self.gone is not None:  # there is no server left to tell, or no window
            self._awake.close()
            return
        if self._visibility is not None:
            self._visibility.close()
        if self._watch is not None:
            self._watch.close()
        if self._ramp is not None:
            monitor, ramp = self._ramp
            self._ramp = None
            with contextlib.suppress(glfw.GLFWError):
                glfw.set_gamma_ramp(monitor, ramp)
        glfw.terminate()
        self._awake.close()  # after GLFW, which restores what it had found: no blanking


def _newest_window(width: int, height: int, monitor: Any) -> Any:
    """A window with the newest OpenGL that its driver gives; None where it gives none of 3.3 or
    newer.

    A context without robustness never tells that its GPU was reset; some drivers have none with it.
    """
    leave_contexts()
    for robustness in (glfw.LOSE_CONTEXT_ON_RESET, glfw.NO_ROBUSTNESS):
        glfw.window_hint(glfw.CONTEXT_ROBUSTNESS, robustness)
        for major, minor in GL_VERSIONS:
            glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, major)
            glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, minor)
            if window := glfw.create_window(width, height, TITLE, monitor, None):
                return window
    return None


def change_of(is_there: bool, was_lost: bool, on_it: bool) -> Literal["gone", "back", ""]:
    """What has happened to a window's display: it is "gone", or it is "back", so that the window
    has to go there; "" for nothing. A window may be put elsewhere while its display stays.
    """
    if not is_there:
        return "" if was_lost else "gone"
    return "back" if was_lost or not on_it else ""


def pressed_key(key: int, action: int) -> str:
    """The name of a key that is pressed, by GLFW's numbers of key and action; "" for one that
    repeats or is released, and for a key without a name.
    """
    if action != glfw.PRESS:
        return ""
    names = {glfw.KEY_ESCAPE: "escape", glfw.KEY_SPACE: "space", glfw.KEY_F1: "f1"}
    if key in names:
        return names[key]
    return chr(key).lower() if 0 < key < 128 else ""


def _monitor_named(name: str) -> Any:
    """GLFW's monitor of a name, None where it is not plugged in."""
    for monitor in glfw.get_monitors():
        if _describe(0, monitor).name == name:
            return monitor
    return None


def _area_of(monitor: Any) -> ScreenArea:
    display = _describe(0, monitor)
    return ScreenArea(display.position_px, display.resolution_px)


def _find(wanted: int | str) -> tuple[Display, Any]:
    """The display of an index or a name, and GLFW's monitor. Raises NotThereError."""
    described = _displays()
    for display, monitor in zip(described, glfw.get_monitors(), strict=True):
        if display.is_named(wanted):
            return display, monitor
    known = "; ".join(display.line() for display in described)
    meant = did_you_mean(wanted, (display.name for display in described))
    advice = f"plug it in, or write the index or name of one of {known}"
    raise NotThereError(f"[monitor] display = {wanted!r}: no such display; {meant}{advice}")
