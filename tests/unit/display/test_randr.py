"""The outputs and GPUs of an X server that is not there: libXrandr's replies byte for byte as
Xrandr.h lays them out. tests/screen has real servers.
"""

from __future__ import annotations

import ctypes
import struct
from collections import Counter

import pytest

from hilstar.display.window import randr

EDID_ATOM, EDID_BYTES = 9, bytes(range(128))
ROTATE_0, ROTATE_90 = 1, 2  # randr.h
HALF, ONE = 1 << 15, 1 << 16  # XFixed
NONE = 0
# XRRModeInfo: id, size, dot clock, seven timings with the totals third and seventh, name, flags
MODE = "@LIIL7IPIL"
PROVIDERS = {70: b"AMD", 71: b"Intel", 72: b"NVIDIA-0"}


class Replies:
    """libXrandr before a screen of three outputs: one that shows a mode, one that is turned and
    scaled, and one that is connected and dark. `owed` counts replies that were not given back.
    """

    def __init__(self) -> None:
        self.owed: Counter[str] = Counter()
        self._memory: list[object] = []
        modes = [(11, 1920, 1080, 148_500_000, 2200, 1125), (12, 1280, 720, 74_250_000, 1650, 750)]
        packed = b"".join(
            struct.pack(MODE, number, x, y, clock, 0, 0, across, 0, 0, 0, down, 0, 0, 0)
            for number, x, y, clock, across, down in modes
        )
        self._modes = self._kept(packed), len(modes)
        crtcs = {31: (11, ROTATE_0), 32: (12, ROTATE_90)}
        self._crtcs = {
            number: struct.pack("@LiiIILH6x", 0, 0, 0, 0, 0, mode, rotation)
            for number, (mode, rotation) in crtcs.items()
        }
        self._outputs = {
            21: (31, b"DP-1", (12, 11)),
            22: (32, b"HDMI-1", (12, 11)),
            23: (NONE, b"VGA-1", (11,)),
        }

    def _kept(self, data: bytes) -> int:
        buffer = ctypes.create_string_buffer(data, len(data))
        self._memory.append(buffer)
        return ctypes.addressof(buffer)

    def _numbers(self, numbers: tuple[int, ...]) -> int:
        return self._kept(struct.pack(f"@{len(numbers)}L", *numbers))

    def _lent(self, what: str, data: bytes) -> int:
        self.owed[what] += 1
        return self._kept(data)

    def __getattr__(self, name: str) -> object:
        if not name.startswith("XRRFree"):
            raise AttributeError(name)
        what = name.removeprefix("XRRFree")
        return lambda address: self.owed.subtract([what])

    def XRRGetScreenResourcesCurrent(self, display: int, root: int) -> int:
        outputs = self._numbers(tuple(self._outputs))
        modes, count = self._modes
        sizes = len(self._outputs), outputs, count, modes
        return self._lent("ScreenResources", struct.pack("@LLiPiPiP", 0, 0, 0, 0, *sizes))

    def XRRGetOutputInfo(self, display: int, resources: object, number: int) -> int:
        crtc, name, modes = self._outputs[number]
        text = self._kept(name + b"\0")
        # the first of an output's modes is the one that it prefers
        lists = 0, 0, 0, 0, len(modes), 1, self._numbers(modes)
        data = struct.pack("@LLPiLLHHiPiPiiP", 0, crtc, text, len(name), 0, 0, 0, 0, *lists)
        return self._lent("OutputInfo", data)

    def XRRGetCrtcInfo(self, display: int, resources: object, number: int) -> int:
        return self._lent("CrtcInfo", self._crtcs[number])

    def XRRGetCrtcTransform(self, display: int, number: int, at: object) -> int:
        scales = {31: (ONE, ONE), 32: (HALF, HALF)}
        right, down = scales[number]
        matrix = right, 0, 0, 0, down, 0, 0, 0, ONE
        pending = (7 * ONE,) * 9
        address = self._lent("XFree", struct.pack("@9iPiP9iP", *pending, 0, 0, 0, *matrix, 0))
        ctypes.cast(at, ctypes.POINTER(ctypes.c_void_p))[0] = address
        return 1

    def XRRListOutputProperties(self, display: int, output: int, count: object) -> object:
        ctypes.cast(count, ctypes.POINTER(ctypes.c_int))[0] = 1
        return ctypes.cast(
            self._lent("XFree", struct.pack("@L", EDID_ATOM)), ctypes.POINTER(ctypes.c_ulong)
        )

    def XRRGetOutputProperty(self, *parts: object) -> int:
        _, form, count, _, data = parts[8:]
        ctypes.cast(form, ctypes.POINTER(ctypes.c_int))[0] = 8
        ctypes.cast(count, ctypes.POINTER(ctypes.c_ulong))[0] = len(EDID_BYTES)
        address = self._lent("XFree", EDID_BYTES)
        ctypes.cast(data, ctypes.POINTER(ctypes.c_void_p))[0] = address
        return 0

    def XRRGetProviderResources(self, display: int, root: int) -> int:
        numbers = self._numbers(tuple(PROVIDERS))
        return self._lent("ProviderResources", struct.pack("@LiP", 0, len(PROVIDERS), numbers))

    def XRRGetProviderInfo(self, display: int, resources: object, number: int) -> int:
        name = self._kept(PROVIDERS[number] + b"\0")
        return self._lent("ProviderInfo", struct.pack("@IiPiPP", 0, 0, 0, 0, 0, name))

    def XGetAtomName(self, display: int, atom: int) -> int:
        return self._lent("XFree", {EDID_ATOM: b"EDID\0"}[atom])

    def XFree(self, address: object) -> None:
        self.owed["XFree"] -= 1


@pytest.fixture
def replies(monkeypatch):
    monkeypatch.setattr(randr, "has_extension", lambda display, name: False)
    return Replies()


def connected(replies: Replies) -> randr.Randr:
    """A connection that asks `replies`."""
    connection = object.__new__(randr.Randr)
    parts = {"_x11": replies, "_xrandr": replies, "_display": 1, "_root": 2}
    vars(connection).update(parts)
    return connection


def test_the_lit_outputs_of_a_screen_are_read_as_they_are(replies):
    straight, turned = connected(replies).outputs()
    assert (straight.name, straight.others) == ("DP-1", ("HDMI-1",))
    assert (turned.name, turned.others) == ("HDMI-1", ("DP-1",))
    assert (straight.mode_px, turned.mode_px) == ((1920, 1080), (1280, 720))
    assert (straight.refresh_hz, turned.refresh_hz) == (60.0, 60.0)
    assert straight.preferred_px == turned.preferred_px == ((1280, 720),)
    assert (straight.rotated, turned.rotated) == (False, True)
    assert straight.transform == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    assert turned.transform == (0.5, 0, 0, 0, 0.5, 0, 0, 0, 1)
    assert straight.edid == turned.edid == EDID_BYTES
    assert straight.providers == ("AMD", "Intel", "NVIDIA-0")
    assert not any(replies.owed.values()), replies.owed  # all was given back
