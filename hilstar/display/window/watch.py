"""What is done to a display while a window is shown on it: somebody else's gamma ramp, and frames
copied or flipped.

A thread with connections of its own looks once a second, so that no frame ever asks the server.
"""

import contextlib
import ctypes
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.display.window.randr import Randr
from hilstar.display.window.x11 import INT, POINTER, TEXT, Survival, load_library

LOOK_S = 1.0
FULL_RAMP, RAMP_BITS = 65535, 16
COARSEST_BITS = 8
XCB_LIBRARY, PRESENT_LIBRARY = "libxcb.so.1", "libxcb-present.so.0"
GENERIC_EVENT, COMPLETE_NOTIFY, COMPLETE_MASK = 35, 1, 2  # xproto.h, present.h
KIND_PIXMAP = 0
EVENT_HEAD_BYTES = 12  # of the 32 of an event: all that says how a frame was shown
MODES = ("copy", "flip", "skip", "copy")  # the last is a copy that a flip could have been
UNKNOWN = "unknown"


def straight_ramp(steps: int) -> list[float]:
    """One colour of the gamma ramp that changes nothing: values (steps,) evenly from 0 to 1."""
    return list(np.linspace(0.0, 1.0, steps).tolist())


def is_straight(ramp: bytes | FloatArray) -> bool:
    """Whether a gamma ramp is the identity, to half a code of its own depth.

    Red, green and blue, in 16 bits a step or (3, steps) from 0 to 1. A driver that keeps 8 bits
    rounds to them. In a finer table half a code of 8 bits is a curve: a gamma of 1.005 has 6 % less
    light at the faintest code.
    """
    if isinstance(ramp, bytes):
        parts = np.frombuffer(ramp, np.uint16).reshape(3, -1) / FULL_RAMP
    else:
        parts = ramp
    if not parts.size:
        return False
    off = np.abs(parts - straight_ramp(parts.shape[1]))
    # An entry of 16 bits is rounded itself.
    return bool(np.all(off <= 0.5 / (2 ** ramp_bits(parts) - 1) + 0.5 / FULL_RAMP))


def ramp_bits(parts: FloatArray) -> int:
    """The depth in bits of a ramp's entries (3, steps) from 0 to 1: the coarsest, from 8, that
    holds each of them.
    """
    for bits in range(COARSEST_BITS, RAMP_BITS):
        full = 2**bits - 1
        rounded = np.rint(parts * full) / full
        if np.all(np.abs(parts - rounded) * FULL_RAMP <= 1.0):
            return bits
    return RAMP_BITS


def is_foreign(ramp: bytes, first: bytes) -> bool:
    """Whether a gamma ramp is another program's: neither the one of the start nor straight; b"" is
    none.
    """
    return bool(ramp) and ramp != first and not is_straight(ramp)


def shown_as(event: bytes, opcode: int) -> str:
    """How a frame was shown, "flip", "copy" or "skip", by an event of an XCB connection whose
    Present has this opcode; "" for an event of anything else.
    """
    # response_type, extension, sequence (2), length (4), event_type (2), kind, mode
    response, extension, event_type, kind, mode = (event[at] for at in (0, 1, 8, 10, 11))
    is_present = response & 0x7F == GENERIC_EVENT and extension == opcode
    is_complete = event_type == COMPLETE_NOTIFY and kind == KIND_PIXMAP
    if is_present and is_complete and mode < len(MODES):
        return MODES[mode]
    return ""


class PresentEvents:
    """How the X server shows a window's frames, by the events of its Present extension on an XCB
    connection.

    Drivers that do not use Present (NVIDIA's, llvmpipe) cause none. Raises OSError without a
    server, XCB, or Present.
    """

    def __init__(self, window: int) -> None:
        number = ctypes.c_uint32
        self._xcb = load_library(
            XCB_LIBRARY,
            xcb_connect=(POINTER, TEXT, POINTER),
            xcb_connection_has_error=(INT, POINTER),
            xcb_get_extension_data=(ctypes.POINTER(ctypes.c_ubyte), POINTER, POINTER),
            xcb_generate_id=(number, POINTER),
            xcb_flush=(INT, POINTER),
            xcb_poll_for_event=(POINTER, POINTER),
            xcb_disconnect=(None, POINTER),
        )
        self._present = load_library(
            PRESENT_LIBRARY,
            xcb_present_select_input=(ctypes.c_uint, POINTER, number, number, number),
        )
        self._free: Any = ctypes.CDLL(None).free
        self._free.argtypes = [ctypes.c_void_p]
        self._connection: Any = self._xcb.xcb_connect(None, None)
        extension: Any = ctypes.addressof(ctypes.c_byte.in_dll(self._present, "xcb_present_id"))
        reply = None
        if not self._xcb.xcb_connection_has_error(self._connection):
            reply = self._xcb.xcb_get_extension_data(self._connection, extension)
        if not reply or not reply[8]:  # xcb_query_extension_reply_t: present, major_opcode
            self.close()
            raise OSError("the X server has no Present")
        self._opcode = reply[9]
        event_id = self._xcb.xcb_generate_id(self._connection)
        self._present.xcb_present_select_input(self._connection, event_id, window, COMPLETE_MASK)
        self._xcb.xcb_flush(self._connection)

    def modes(self) -> list[str]:
        """How each frame was shown that completed since the last call: "flip", "copy" or "skip"."""
        modes_shown = []
        while event := self._xcb.xcb_poll_for_event(self._connection):
            mode = shown_as(ctypes.string_at(event, EVENT_HEAD_BYTES), self._opcode)
            self._free(event)
            if mode:
                modes_shown.append(mode)
        return modes_shown

    def close(self) -> None:
        """End the connection."""
        self._xcb.xcb_disconnect(self._connection)


class PresentedModes:
    """Counts of frames by how the X server showed them; any thread may take the newest.

    `taken` gives the modes of the frames since its last call.
    """

    def __init__(self, taken: Callable[[], Iterable[str]]) -> None:
        self._taken = taken
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    def counts(self) -> dict[str, int]:
        """Frames up to now: flip, copy, skip."""
        with self._lock:
            self._counts.update(self._taken())
            return dict(self._counts)


class DisplayWatch:
    """Looks once a second whether the gamma ramp of `output` (None: of none) is another, and how a
    window's frames are shown.

    `ramp_changed` is true while the ramp is neither the one of the start nor straight.
    """

    def __init__(
        self, output: str | None, window: int, survival: Survival, look_s: float = LOOK_S
    ) -> None:
        self.ramp_changed = False
        self._output = output
        self._look_s = look_s
        self._randr: Randr | None = None
        self._events: PresentEvents | None = None
        self._modes: PresentedModes | None = None
        with contextlib.suppress(OSError):
            self._randr = Randr(survival) if output else None
        with contextlib.suppress(OSError, AttributeError, ValueError):
            self._events = PresentEvents(window)
            self._modes = PresentedModes(self._events.modes)
        self._first = self._ramp()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-display-watch", daemon=True)
        self._thread.start()

    def _ramp(self) -> bytes:
        if self._randr is None or self._output is None:
            return b""
        return self._randr.ramp(self._output)

    def _run(self) -> None:
        while not self._stop.wait(self._look_s):
            ramp = self._ramp()
            self.ramp_changed = is_foreign(ramp, self._first)
            # the server's events would fill its queue until somebody asks
            if self._modes is not None:
                self._modes.counts()

    @property
    def presented(self) -> dict[str, int]:
        """Frames by how the X server showed them up to now: flip, copy, skip; empty where it
        does not say.
        """
        return {} if self._modes is None else self._modes.counts()

    def stop(self) -> None:
        """Stop looking; the connections stay."""
        self._stop.set()

    def close(self) -> None:
        """Stop looking, and end the connections."""
        self.stop()
        self._thread.join(self._look_s)
        if self._thread.is_alive():
            return
        for connection in (self._randr, self._events):
            if connection is not None:
                connection.close()


def presented_as(shown: dict[str, int]) -> str:
    """In a word how frames were shown: "flip", "copy", "flip and copy", or "unknown" where the
    server did not say.
    """
    modes = [mode for mode in ("flip", "copy") if shown.get(mode)]
    return " and ".join(modes) or UNKNOWN
