"""Calls to X11 and GLX through ctypes: when a swap reached the screen, whether a compositor runs,
and whether the server
or the window is gone.

Each answer is None or False where the system has no such thing: Wayland, or a driver without the
extension.
"""

import ctypes
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from hilstar.basics.units import NS_PER_US

GL_LIBRARY, X11_LIBRARY = "libGL.so.1", "libX11.so.6"
GL_DRAW_FRAMEBUFFER, GL_BACK_LEFT, GL_SAMPLES = 0x8CA9, 0x0402, 0x80A9
# GL_FRAMEBUFFER_ATTACHMENT_RED_SIZE, _GREEN_SIZE, _BLUE_SIZE
GL_COLOUR_SIZES = (0x8212, 0x8213, 0x8214)
CLOCK = "after-swap clock"
SYNC_EXTENSION = b"GLX_OML_sync_control"
# A UST further back is of another clock than this host's monotonic one, or of another swap.
MAX_UST_AGE_NS = 1_000_000_000
MAX_GAPS = 30  # swaps in a row without a time stamp that can be right
# X.h; those of extensions are GLX's here
BAD_WINDOW, BAD_DRAWABLE, FIRST_EXTENSION_ERROR = 3, 9, 128
SERVER_GONE = "the X server is gone, or has closed the window's connection"
WINDOW_GONE = "the window is gone: another program has closed it"


POINTER, NUMBER, INT, TEXT = ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int, ctypes.c_char_p

log = logging.getLogger(__name__)


def load_library(name: str, **functions: tuple[Any, ...]) -> Any:
    """A library whose `functions` have these types: of the result, then of the arguments. Raises
    OSError or AttributeError.
    """
    library: Any = ctypes.CDLL(name)
    for function, (result, *arguments) in functions.items():
        symbol = getattr(library, function)
        symbol.restype = result
        symbol.argtypes = arguments
    return library


@cache
def xlib() -> Any:
    """libX11 with the types of what is called here. Raises OSError without it."""
    return load_library(
        X11_LIBRARY,
        XOpenDisplay=(POINTER, TEXT),
        XCloseDisplay=(INT, POINTER),
        XConnectionNumber=(INT, POINTER),
        XDefaultRootWindow=(NUMBER, POINTER),
        XFree=(INT, POINTER),
        XGetAtomName=(POINTER, POINTER, NUMBER),
        XGetGeometry=(INT, POINTER, NUMBER, *[POINTER] * 7),
        XGetSelectionOwner=(NUMBER, POINTER, NUMBER),
        XInternAtom=(NUMBER, POINTER, TEXT, INT),
        XNextEvent=(INT, POINTER, POINTER),
        XPending=(INT, POINTER),
        XQueryExtension=(INT, POINTER, TEXT, *[POINTER] * 3),
        XSelectInput=(INT, POINTER, NUMBER, ctypes.c_long),
        XServerVendor=(TEXT, POINTER),
        XSync=(INT, POINTER, INT),
        XTranslateCoordinates=(INT, POINTER, NUMBER, NUMBER, INT, INT, *[POINTER] * 3),
        XVendorRelease=(INT, POINTER),
    )


def server_of() -> str:
    """The X server of `DISPLAY`: its maker and release; "" without one. Raises OSError without
    libX11.
    """
    library = xlib()
    display = library.XOpenDisplay(None)
    if not display:
        return ""
    release = library.XVendorRelease(display)
    major = release // 10_000_000
    minor = release // 100_000 % 100
    patch = release // 1000 % 100
    vendor = library.XServerVendor(display).decode(errors="replace")
    library.XCloseDisplay(display)
    return f"{vendor} {major}.{minor}.{patch}"


class _ErrorEvent(ctypes.Structure):  # XErrorEvent of Xlib
    _fields_ = (
        *(("type", INT), ("display", POINTER), ("resource", NUMBER), ("serial", NUMBER)),
        *((name, ctypes.c_ubyte) for name in ("error", "request", "minor")),
    )


_IoHandler = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_ExitHandler = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
_ErrorHandler = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(_ErrorEvent))


def is_end_of_window(code: int) -> bool:
    """Whether an X error, of a request for the window, means that the window is gone."""
    return code in {BAD_WINDOW, BAD_DRAWABLE} or code >= FIRST_EXTENSION_ERROR


class Survival:
    """Xlib ends the process when the server or a window goes away; while this object lives, it
    calls `on_end(why)` instead.
    """

    def __init__(self, on_end: Callable[[str], None]) -> None:
        self._undecided: set[int] = set()  # connections whose errors say nothing of the window

        def io_error(display: int) -> int:
            on_end(SERVER_GONE)
            return 0

        def error(display: int, event: Any) -> int:
            if display in self._undecided:
                return 0
            if is_end_of_window(event.contents.error):
                on_end(WINDOW_GONE)
            return 0

        self._library: Any = ctypes.CDLL(X11_LIBRARY)
        self._handlers = (
            _IoHandler(io_error),
            _ErrorHandler(error),
            _ExitHandler(lambda display, data: None),
        )
        self._library.XSetIOErrorHandler.argtypes, self._library.XSetErrorHandler.argtypes = (
            [_IoHandler],
            [_ErrorHandler],
        )
        self._library.XSetIOErrorHandler.restype, self._library.XSetErrorHandler.restype = (
            _IoHandler,
            _ErrorHandler,
        )
        self._before = (
            self._library.XSetIOErrorHandler(self._handlers[0]),
            self._library.XSetErrorHandler(self._handlers[1]),
        )

    def close(self) -> None:
        """Let Xlib handle errors as before."""
        self._library.XSetIOErrorHandler(self._before[0])
        self._library.XSetErrorHandler(self._before[1])

    def cover(self, x_display: int, decides: bool = True) -> None:
        """Survive the end of this connection; unless it `decides`, errors of its requests say
        nothing of the window.
        """
        if not decides:
            self._undecided.add(x_display)
        # libX11 1.7 of 2020; with an older one the process ends
        if hasattr(self._library, "XSetIOErrorExitHandler"):
            self._library.XSetIOErrorExitHandler.argtypes = [
                ctypes.c_void_p,
                _ExitHandler,
                ctypes.c_void_p,
            ]
            self._library.XSetIOErrorExitHandler(x_display, self._handlers[2], None)


class SyncControl:
    """GLX_OML_sync_control of one window: the time at which its last swap was scanned out."""

    def __init__(self, library: Any, x_display: int, drawable: int) -> None:
        function = library.glXGetProcAddress(b"glXWaitForSbcOML")
        if not function:
            raise OSError("glXWaitForSbcOML is not there")
        counter = ctypes.POINTER(ctypes.c_int64)
        prototype = ctypes.CFUNCTYPE(
            ctypes.c_int, ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int64, counter, counter, counter
        )
        self._wait_for_swap = prototype(function)
        self._window = (x_display, drawable)

    def swap_ns(self) -> int | None:
        """Wait for the last swap; the driver's time of it (host's monotonic clock), None where
        it does not say.
        """
        ust, msc, sbc = (ctypes.c_int64() for _ in range(3))
        if not self._wait_for_swap(
            *self._window, 0, ctypes.byref(ust), ctypes.byref(msc), ctypes.byref(sbc)
        ):
            return None
        return ust.value * NS_PER_US


class SwapStamps:
    """When each swap reached the screen: by the driver where it says, else by the host's clock once
    the swap is done.

    Linux stamps the *end* of a vertical blank, when the first row is lit, and tells of it at its
    beginning: up to a millisecond ahead of now. So a stamp may be a refresh period ahead; a single
    one that cannot be right is passed over. `stamp_ns` asks the driver, which may have none of the
    last swap; it is None where the driver has none at all.
    """

    def __init__(
        self,
        stamp_ns: Callable[[], int | None] | None,
        period_ns: float,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._stamp_ns = stamp_ns
        self._period_ns = period_ns
        self._now_ns = now_ns
        self._gaps = 0
        self.source = CLOCK if stamp_ns is None else SYNC_EXTENSION.decode()

    def after_swap(self, wait: Callable[[], None]) -> int:
        """Time of the swap just asked for, host ns; `wait` returns once it is done, where the
        driver does not say.
        """
        if self._stamp_ns is not None:
            swap_ns = self._stamp_ns()
            if (
                swap_ns is not None
                and -self._period_ns <= self._now_ns() - swap_ns < MAX_UST_AGE_NS
            ):
                self._gaps = 0
                self.source = SYNC_EXTENSION.decode()
                return swap_ns
            self._gaps += 1
            if self._gaps == MAX_GAPS:
                log.warning(
                    "%s gives no time of swaps; the host's clock after them is used instead",
                    SYNC_EXTENSION.decode(),
                )
                self._stamp_ns = None
        wait()
        self.source = CLOCK
        return self._now_ns()


def sync_control(x_display: int | None, drawable: int | None) -> SyncControl | None:
    """The sync control of a GLX window; None where its driver has none."""
    if not x_display or not drawable:
        return None
    try:
        library = load_library(
            GL_LIBRARY,
            glXQueryExtensionsString=(TEXT, POINTER, INT),
            glXGetProcAddress=(POINTER, TEXT),
        )
        extensions = library.glXQueryExtensionsString(x_display, 0) or b""
        if SYNC_EXTENSION in extensions.split():
            return SyncControl(library, x_display, drawable)
        return None
    except (OSError, AttributeError):
        return None


@dataclass(frozen=True, slots=True)
class BackBuffer:
    """A back buffer: bits of each colour (the fewest of the three), and samples of a pixel (0 or
    1: one).
    """

    bits: int
    samples: int


def back_buffer(address_of: Callable[[str], Any]) -> BackBuffer:
    """The back buffer of the context that is current, by GL functions of those addresses."""

    def integer(name: str, *arguments: int) -> int:
        value = ctypes.c_int()
        function = ctypes.CFUNCTYPE(
            None, *[ctypes.c_uint] * len(arguments), ctypes.POINTER(ctypes.c_int)
        )(address_of(name))
        function(*arguments, ctypes.byref(value))
        return value.value

    bits = (
        integer("glGetFramebufferAttachmentParameteriv", GL_DRAW_FRAMEBUFFER, GL_BACK_LEFT, size)
        for size in GL_COLOUR_SIZES
    )
    return BackBuffer(min(bits), integer("glGetIntegerv", GL_SAMPLES))


def has_extension(x_display: int | None, name: bytes) -> bool:
    """Whether an X server has an extension."""
    if not x_display:
        return False
    parts = (ctypes.byref(ctypes.c_int()) for _ in range(3))
    return bool(xlib().XQueryExtension(x_display, name, *parts))


def is_composited(x_display: int | None) -> bool:
    """True where a compositing manager owns the screen (ICCCM selection _NET_WM_CM_S0); it may
    delay frames.
    """
    if not x_display:
        return False
    try:
        atom = xlib().XInternAtom(x_display, b"_NET_WM_CM_S0", 1)
        return bool(atom and xlib().XGetSelectionOwner(x_display, atom))
    except (OSError, AttributeError):
        return False
