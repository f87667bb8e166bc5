"""RandR by libXrandr, on a connection of its own: how an output is set, and its gamma ramp. Nothing
is changed.

Only what the server already knows is asked for, so that no request makes it probe a monitor.
"""

import ctypes
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from hilstar.basics.process.closing import Closing
from hilstar.display.window.output_settings import (
    IDENTITY,
    NVIDIA_ATTRIBUTES,
    OutputState,
    Pair,
    property_value,
)
from hilstar.display.window.property_rules import NVIDIA, Value
from hilstar.display.window.x11 import (
    INT,
    NUMBER,
    POINTER,
    TEXT,
    Survival,
    has_extension,
    is_composited,
    load_library,
    xlib,
)

XRANDR_LIBRARY = "libXrandr.so.2"
ROTATE_0 = 1  # randr.h
FIXED_ONE = 65536.0  # XFixed
MAX_ITEMS = 4096  # items of four bytes
NVIDIA_S = 3.0
BYTE_BITS = 8
_Id, _Ids, UINT = NUMBER, ctypes.POINTER(NUMBER), ctypes.c_uint
XRANDR_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "XRRGetScreenResourcesCurrent": (POINTER, POINTER, _Id),
    "XRRGetOutputInfo": (POINTER, POINTER, POINTER, _Id),
    "XRRGetCrtcInfo": (POINTER, POINTER, POINTER, _Id),
    "XRRGetCrtcGamma": (POINTER, POINTER, _Id),
    "XRRGetCrtcTransform": (INT, POINTER, _Id, POINTER),
    "XRRListOutputProperties": (_Ids, POINTER, _Id, POINTER),
    "XRRGetOutputProperty": (
        INT,
        POINTER,
        _Id,
        _Id,
        *[ctypes.c_long] * 2,
        *[INT] * 2,
        _Id,
        *[POINTER] * 5,
    ),
    "XRRGetProviderResources": (POINTER, POINTER, _Id),
    "XRRGetProviderInfo": (POINTER, POINTER, POINTER, _Id),
} | {
    f"XRRFree{what}": (None, POINTER)
    for what in (
        "ScreenResources",
        "OutputInfo",
        "CrtcInfo",
        "Gamma",
        "ProviderResources",
        "ProviderInfo",
    )
}


# of `sync`: a line's pixels and a frame's lines, blank ones too
H_TOTAL, V_TOTAL = 2, 6
RR_INTERLACE, RR_DOUBLE_SCAN = 0x10, 0x20  # randr.h: flags of a mode


class ModeInfo(ctypes.Structure):
    """XRRModeInfo of libXrandr."""

    _fields_ = (
        *(
            ("id", _Id),
            ("width", UINT),
            ("height", UINT),
            ("dot_clock", NUMBER),
            ("sync", UINT * 7),
        ),
        *(("name", POINTER), ("name_length", UINT), ("flags", NUMBER)),
    )


class _Resources(ctypes.Structure):  # XRRScreenResources
    _fields_ = (
        *(
            ("times", NUMBER * 2),
            ("ncrtc", INT),
            ("crtcs", _Ids),
            ("noutput", INT),
            ("outputs", _Ids),
        ),
        *(("nmode", INT), ("modes", ctypes.POINTER(ModeInfo))),
    )


class _Output(ctypes.Structure):  # XRROutputInfo
    _fields_ = (
        *(
            ("time", NUMBER),
            ("crtc", _Id),
            ("name", TEXT),
            ("name_length", INT),
            ("size_mm", NUMBER * 2),
        ),
        *(
            ("connection", ctypes.c_ushort),
            ("subpixels", ctypes.c_ushort),
            ("ncrtc", INT),
            ("crtcs", _Ids),
        ),
        *(("nclone", INT), ("clones", _Ids), ("nmode", INT), ("npreferred", INT), ("modes", _Ids)),
    )


class _Crtc(ctypes.Structure):  # XRRCrtcInfo, its beginning
    _fields_ = (
        ("time", NUMBER),
        ("corner", INT * 2),
        ("size", UINT * 2),
        ("mode", _Id),
        ("rotation", ctypes.c_ushort),
    )


class _Transform(ctypes.Structure):  # XRRCrtcTransformAttributes
    _fields_ = (
        *(
            ("pending", INT * 9),
            ("pending_filter", POINTER),
            ("pending_count", INT),
            ("pending_parameters", POINTER),
        ),
        *(("current", INT * 9), ("current_filter", POINTER)),
    )


class GammaInfo(ctypes.Structure):
    """XRRCrtcGamma of libXrandr."""

    _fields_ = (("size", INT), ("red", POINTER), ("green", POINTER), ("blue", POINTER))


class _Providers(ctypes.Structure):  # XRRProviderResources
    _fields_ = (("time", NUMBER), ("count", INT), ("ids", _Ids))


class _Provider(ctypes.Structure):  # XRRProviderInfo, its beginning
    _fields_ = (
        *(
            ("capabilities", UINT),
            ("ncrtcs", INT),
            ("crtcs", _Ids),
            ("noutputs", INT),
            ("outputs", _Ids),
        ),
        ("name", TEXT),
    )


class Randr(Closing):
    """A connection to the X server of DISPLAY. Free it with `close`. Raises OSError without a
    server or libXrandr.

    Requests for an output that has just gone fail in silence: `survival` is a window's, by default
    one of its own.
    """

    def __init__(self, survival: Survival | None = None) -> None:
        self._x11 = xlib()
        self._xrandr = load_library(XRANDR_LIBRARY, **XRANDR_FUNCTIONS)
        self._display: Any = self._x11.XOpenDisplay(None)
        if not self._display:
            raise OSError("no X server")
        self._own = Survival(lambda why: None) if survival is None else None
        for errors in (survival, self._own):
            if errors is not None:
                errors.cover(self._display, decides=False)
        if not has_extension(self._display, b"RANDR"):
            self.close()
            raise OSError("the X server has no RandR")
        self._root = self._x11.XDefaultRootWindow(self._display)

    def close(self) -> None:
        """End the connection."""
        self._x11.XCloseDisplay(self._display)
        if self._own is not None:
            self._own.close()

    def outputs(self) -> list[OutputState]:
        """The outputs that are lit."""
        lit: list[OutputState] = []
        with self._resources() as resources:
            if resources is None:
                return []
            modes = {mode.id: mode for mode in resources.modes[: resources.nmode]}
            for number in resources.outputs[: resources.noutput]:
                with self._output(resources, number) as output:
                    state = None
                    # an output without a CRTC is connected at most, and shows nothing
                    if output is not None and output.crtc:
                        state = self._state(resources, number, output, modes)
                if state is not None:
                    lit.append(state)
        return side_by_side(lit, self._providers())

    def ramp(self, name: str) -> bytes:
        """The gamma ramp of an output: 16 bits for each step of red, then green, then blue; b""
        where it is not lit.
        """
        with self._resources() as resources:
            for number in () if resources is None else resources.outputs[: resources.noutput]:
                with self._output(resources, number) as output:
                    crtc = output.crtc if output is not None and _name(output) == name else 0
                if not crtc:
                    continue
                crtc_gamma = self._xrandr.XRRGetCrtcGamma(self._display, crtc)
                with self._got(GammaInfo, self._xrandr.XRRFreeGamma, crtc_gamma) as gamma:
                    return b"" if gamma is None else ramp_of(gamma)
        return b""

    def additions(self) -> dict[str, bool]:
        """What may stand between X and the displays, and whether it does."""
        return {
            "XWayland": has_extension(self._display, b"XWAYLAND"),
            "a compositing manager": is_composited(self._display),
        }

    def _state(
        self, resources: Any, number: int, output: Any, modes: dict[int, ModeInfo]
    ) -> OutputState | None:
        """An output that is lit; None where its CRTC shows no known mode."""
        crtc = self._xrandr.XRRGetCrtcInfo(self._display, ctypes.byref(resources), output.crtc)
        with self._got(_Crtc, self._xrandr.XRRFreeCrtcInfo, crtc) as now:
            if now is None or now.mode not in modes:
                return None
            mode = modes[now.mode]
            rotated = now.rotation != ROTATE_0
        properties = dict(self._properties(number))
        edid = properties.pop("EDID", b"")
        name = _name(output)
        preferred = [k for k in output.modes[: output.npreferred] if k in modes]
        preferred_px = [_size_px(modes[k]) for k in preferred]
        readable = {k: value for k, value in properties.items() if not isinstance(value, bytes)}
        return OutputState(
            name=name,
            mode_px=_size_px(mode),
            refresh_hz=refresh_hz_of(mode),
            preferred_px=tuple(dict.fromkeys(preferred_px)),
            transform=self._transform(output.crtc),
            rotated=rotated,
            properties=readable | self._of_nvidia(name),
            edid=edid if isinstance(edid, bytes) else b"",
        )

    def _transform(self, crtc: int) -> tuple[float, ...]:
        """The rows of a CRTC's 3 x 3 transform; IDENTITY where it has none."""
        pointer = ctypes.POINTER(_Transform)()
        if (
            not self._xrandr.XRRGetCrtcTransform(self._display, crtc, ctypes.byref(pointer))
            or not pointer
        ):
            return IDENTITY
        current = tuple(value / FIXED_ONE for value in pointer.contents.current)
        self._x11.XFree(ctypes.cast(pointer, POINTER))
        return current if any(current) else IDENTITY

    def _properties(self, output: int) -> Iterator[tuple[str, Value | bytes]]:
        """Name and value of each property of an output; the EDID as bytes."""
        count = ctypes.c_int()
        atoms = self._xrandr.XRRListOutputProperties(self._display, output, ctypes.byref(count))
        for atom in atoms[: count.value] if atoms else ():
            name = self._atom(atom)
            value = self._property(output, atom, name == "EDID")
            if value is not None:
                yield name, value
        if atoms:
            self._x11.XFree(ctypes.cast(atoms, POINTER))

    def _property(self, output: int, atom: int, raw: bool) -> Value | bytes | None:
        """The value of a property, None for none or a table; `raw` bytes as they are."""
        kind = ctypes.c_ulong()
        form = ctypes.c_int()
        count = ctypes.c_ulong()
        rest = ctypes.c_ulong()
        data = POINTER()
        results = (ctypes.byref(part) for part in (kind, form, count, rest, data))
        failed = self._xrandr.XRRGetOutputProperty(
            self._display, output, atom, 0, MAX_ITEMS, 0, 0, 0, *results
        )
        if failed or not data.value:
            return None
        # Xlib gives 32 bits as long
        item = {8: ctypes.c_ubyte, 16: ctypes.c_ushort}.get(form.value, ctypes.c_ulong)
        items = tuple(ctypes.cast(data, ctypes.POINTER(item))[: count.value])
        self._x11.XFree(data)
        if raw and form.value == BYTE_BITS:
            return bytes(items)
        kind_name = self._atom(kind.value) if kind.value else ""
        return property_value(kind_name, form.value, items, self._atom)

    def _atom(self, atom: int) -> str:
        """The name of an atom, "" for none."""
        name = self._x11.XGetAtomName(self._display, atom)
        if not name:
            return ""
        text = ctypes.string_at(name).decode(errors="replace")
        self._x11.XFree(name)
        return text

    def _providers(self) -> tuple[str, ...]:
        """The names of the screen's GPUs."""
        pointer = self._xrandr.XRRGetProviderResources(self._display, self._root)
        with self._got(_Providers, self._xrandr.XRRFreeProviderResources, pointer) as providers:
            if providers is None:
                numbers = []
            else:
                numbers = providers.ids[: providers.count]
        names = []
        with self._resources() as resources:
            for number in () if resources is None else numbers:
                info = self._xrandr.XRRGetProviderInfo(
                    self._display, ctypes.byref(resources), number
                )
                with self._got(_Provider, self._xrandr.XRRFreeProviderInfo, info) as provider:
                    names.append("" if provider is None else _name(provider))
        return tuple(names)

    def _of_nvidia(self, output: str) -> dict[str, Value]:
        """What nvidia-settings says of an output, where NVIDIA's driver runs: RandR has none of
        it.
        """
        if has_extension(self._display, b"NV-CONTROL"):
            tool = shutil.which("nvidia-settings")
        else:
            tool = None
        values: dict[str, Value] = {}
        for attribute in () if tool is None else NVIDIA_ATTRIBUTES:
            command = [str(tool), "-t", "-q", f"[DPY:{output}]/{attribute}"]
            try:
                completed = subprocess.run(
                    command, capture_output=True, text=True, timeout=NVIDIA_S, check=False
                ).stdout.strip()
            except (OSError, subprocess.TimeoutExpired):
                break
            if completed.removeprefix("-").isdecimal():
                values[NVIDIA + attribute] = int(completed)
        return values

    @contextmanager
    def _resources(self) -> Iterator[Any]:
        pointer = self._xrandr.XRRGetScreenResourcesCurrent(self._display, self._root)
        with self._got(_Resources, self._xrandr.XRRFreeScreenResources, pointer) as resources:
            yield resources

    @contextmanager
    def _output(self, resources: Any, number: int) -> Iterator[Any]:
        pointer = self._xrandr.XRRGetOutputInfo(self._display, ctypes.byref(resources), number)
        with self._got(_Output, self._xrandr.XRRFreeOutputInfo, pointer) as output:
            yield output

    @contextmanager
    def _got(self, kind: type[ctypes.Structure], free: Any, address: int | None) -> Iterator[Any]:
        """What Xlib returned, None where it failed; freed afterwards."""
        if not address:
            yield None
            return
        try:
            yield kind.from_address(address)
        finally:
            free(address)


def side_by_side(lit: list[OutputState], providers: tuple[str, ...]) -> list[OutputState]:
    """The outputs of a screen that are lit, each with the names of the others and of the screen's
    GPUs.
    """
    states: list[OutputState] = []
    for state in lit:
        others = tuple(other.name for other in lit if other.name != state.name)
        states.append(replace(state, others=others, providers=providers))
    return states


def ramp_of(gamma: GammaInfo) -> bytes:
    """A gamma ramp: 16 bits for each step of red, then green, then blue."""
    parts = (gamma.red, gamma.green, gamma.blue)
    return b"".join(ctypes.string_at(part, 2 * gamma.size) for part in parts)


def refresh_hz_of(mode: ModeInfo) -> float:
    """The refresh rate of a mode: its dot clock over all its pixels, blank ones too; 0 where it
    does not say these. Of interlaced modes that of their fields.
    """
    lines = float(mode.sync[V_TOTAL])
    if mode.flags & RR_INTERLACE:
        lines /= 2
    if mode.flags & RR_DOUBLE_SCAN:  # each line is drawn twice
        lines *= 2
    pixels = mode.sync[H_TOTAL] * lines
    return mode.dot_clock / pixels if pixels else 0.0


def output_named(name: str, survival: Survival | None = None) -> OutputState | None:
    """The output of that name; None where RandR does not have it."""
    try:
        with Randr(survival) as randr:
            return named(randr.outputs(), name)
    except OSError:
        return None


def named(outputs: Iterable[OutputState], name: str) -> OutputState | None:
    """The one of some outputs that has this whole name; None where none has it."""
    return next((state for state in outputs if state.name == name), None)


def lit_outputs() -> list[OutputState]:
    """The outputs of DISPLAY's X server that are lit; none without a server or RandR."""
    try:
        with Randr() as randr:
            return randr.outputs()
    except OSError:
        return []


def _size_px(mode: ModeInfo) -> Pair:
    return mode.width, mode.height


def _name(info: Any) -> str:
    return str((info.name or b"").decode(errors="replace"))
