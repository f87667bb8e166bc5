"""Settings of a display's output that change codes on their way to the panel, or the time of a
frame: a table of them.

Names and values are those of the drivers (Linux DRM connectors, which modesetting, amdgpu, radeon
and nouveau pass on by RandR; xf86-video-amdgpu's own; nvidia-settings' attributes). `dithering
mode`, `Broadcast RGB`, `Colorspace`, `vrr_capable`, `max bpc` and vibrance were read in drivers'
sources; the other names are from their documentation. None was tried on hardware.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hilstar.display.window.property_rules import (
    NVIDIA,
    RIGHT,
    WRONG,
    PropertyRule,
    Value,
    at_least_the_bits,
    by_nvidia,
    doubtful_unless,
    identity_matrix,
    one_of,
    set_by_xrandr,
)

Pair = tuple[int, int]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
TRANSFORM_TOLERANCE = 1e-4  # X has 16 bits after the point
PITCH_TOLERANCE = 0.03
CM_ROUNDING_MM = 5.0
# numbers of a property; a longer one (a table of the colour hardware) is not listed
MAX_LISTED = 18
DITHERS = "the driver adds a pattern to every code"
SCALES = "frames are scaled to leave a margin"
FOLLOWS = "the refresh follows the frames"
RULES = (
    PropertyRule(
        "Broadcast RGB",
        one_of("full", "automatic"),
        "codes go to 16 to 235, always or at television modes",
        set_by_xrandr("Full"),
    ),
    PropertyRule(
        "output_csc", one_of("bypass"), "codes are converted on their way", set_by_xrandr("bypass")
    ),
    PropertyRule(
        "max bpc",
        at_least_the_bits,
        "the cable carries fewer bits than the bench's codes have",
        set_by_xrandr("{bits}"),
    ),
    PropertyRule("dithering mode", one_of("off"), DITHERS, set_by_xrandr("off")),
    PropertyRule("dither", one_of("off"), DITHERS, set_by_xrandr("off")),
    PropertyRule(
        "CTM",
        identity_matrix,
        "a colour matrix mixes the primaries",
        set_by_xrandr("0,1,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0,1"),
    ),
    PropertyRule(
        "Colorspace", one_of("default"), "the panel converts colours", set_by_xrandr("Default")
    ),
    PropertyRule(
        "HDR_OUTPUT_METADATA", one_of("0"), "the panel maps tones (HDR)", set_by_xrandr("0")
    ),
    PropertyRule(
        "underscan",
        one_of("off", "auto"),
        "frames are scaled down, always or on a television",
        set_by_xrandr("off"),
    ),
    PropertyRule("left margin", one_of("0"), SCALES, set_by_xrandr("0")),
    PropertyRule("right margin", one_of("0"), SCALES, set_by_xrandr("0")),
    PropertyRule("top margin", one_of("0"), SCALES, set_by_xrandr("0")),
    PropertyRule("bottom margin", one_of("0"), SCALES, set_by_xrandr("0")),
    PropertyRule(
        "abm level",
        one_of("0"),
        "the driver dims the backlight and lifts codes by the picture",
        set_by_xrandr("0"),
    ),
    PropertyRule("vibrant hue", one_of("90"), "the driver turns hues", set_by_xrandr("90")),
    PropertyRule(
        "color vibrance", one_of("150"), "the driver saturates colours", set_by_xrandr("150")
    ),
    PropertyRule("VRR_ENABLED", one_of("0,off"), FOLLOWS, set_by_xrandr("0")),
    PropertyRule("adaptive-sync", one_of("0,off"), FOLLOWS, set_by_xrandr("0")),
    PropertyRule("freesync", one_of("0,off"), FOLLOWS, set_by_xrandr("0")),
    PropertyRule(
        "TearFree",
        doubtful_unless("off,auto"),
        "frames are copied once more, and may come a refresh late",
        set_by_xrandr("off"),
    ),
    PropertyRule(
        "content type",
        doubtful_unless("no data,graphics"),
        "the monitor may process pictures by it",
        set_by_xrandr("Graphics"),
    ),
    PropertyRule(f"{NVIDIA}CurrentDithering", one_of("0"), DITHERS, by_nvidia("Dithering=2")),
    PropertyRule(
        f"{NVIDIA}CurrentColorRange",
        one_of("0"),
        "codes go to 16 to 235",
        by_nvidia("ColorRange=0"),
    ),
    PropertyRule(
        f"{NVIDIA}CurrentColorSpace",
        one_of("0"),
        "codes are converted to YCbCr",
        by_nvidia("ColorSpace=0"),
    ),
    PropertyRule(
        f"{NVIDIA}DigitalVibrance",
        one_of("0"),
        "the driver saturates colours",
        by_nvidia("DigitalVibrance=0"),
    ),
)
NVIDIA_ATTRIBUTES = tuple(
    rule.name.removeprefix(NVIDIA) for rule in RULES if rule.name.startswith(NVIDIA)
)


@dataclass(frozen=True, slots=True)
class OutputState:
    """An output as RandR describes it: its mode and the preferred ones (px), its refresh (0 where
    that is not known), its transform (rows of a 3 x 3 matrix), rotation, properties and EDID (b""
    for none); the other outputs that are lit, and the screen's providers (GPUs).
    """

    name: str
    mode_px: Pair
    refresh_hz: float = 0.0
    preferred_px: tuple[Pair, ...] = ()
    transform: tuple[float, ...] = IDENTITY
    rotated: bool = False
    properties: dict[str, Value] | None = None
    edid: bytes = b""
    others: tuple[str, ...] = ()
    providers: tuple[str, ...] = ()

    def fields(self) -> dict[str, object]:
        """Everything but the EDID, as `doctor --json` and a ledger have it."""
        return {
            "name": self.name,
            "mode_px": self.mode_px,
            "refresh_hz": self.refresh_hz or None,
            "preferred_px": self.preferred_px,
            "transform": self.transform,
            "rotated": self.rotated,
            "properties": self.properties or {},
            "size_mm": size_mm_of(self.edid),
            "others": self.others,
            "providers": self.providers,
        }

    def line(self) -> str:
        """The output for a person."""
        width, height = self.mode_px
        mode = f"{width} x {height}"
        if self.refresh_hz:
            mode += f", {self.refresh_hz:.4g} Hz"
        parts = [f"{self.name}, {mode}"]
        for name, value in sorted((self.properties or {}).items()):
            parts.append(f"{name} {_words(value)}")
        if not self.properties:
            parts.append("no properties")
        return "; ".join(parts)


class Finding(NamedTuple):
    """A fault of an output, and what mends it; `refused` where codes or times are known to be
    wrong by it.
    """

    text: str
    refused: bool


def property_value(
    kind: str, form: int, items: tuple[int, ...], names: Callable[[int], str]
) -> Value | None:
    """The value of a property of type `kind` with items of `form` bits; `names` resolves atoms.
    None for none, or a table.
    """
    if kind == "ATOM":
        return names(items[0]) if items else None
    if not items or len(items) > MAX_LISTED:
        return None
    if kind == "INTEGER" and form == 32:
        items = tuple((item + 2**31) % 2**32 - 2**31 for item in items)
    return items[0] if len(items) == 1 else items


def findings(
    state: OutputState, bits: int, pixel_pitch_um: float | None = None
) -> Iterator[Finding]:
    """The faults of an output that shows codes of `bits` bits on pixels of that pitch (None: not
    known).
    """
    properties = state.properties or {}
    for rule in RULES:
        value = properties.get(rule.name)
        if value is None:
            continue
        verdict = rule.judge(value, bits)
        if verdict != RIGHT:
            mend = rule.mend.format(output=state.name, name=rule.name, bits=bits)
            fault = f"{rule.name} of {state.name} is {_words(value)}: {rule.why}"
            yield Finding(f"{fault}; {mend}", verdict == WRONG)
    yield from _geometry_findings(state)
    if pixel_pitch_um is not None:
        yield from _pitch_findings(state, pixel_pitch_um)


def _pitch_findings(state: OutputState, pixel_pitch_um: float) -> Iterator[Finding]:
    """Whether the bench file's pitch is another than the EDID's."""
    edid_pitch_um = _edid_pitch_um(state.edid)
    if edid_pitch_um is None:
        return
    pitch_um, rounding_um = edid_pitch_um
    if abs(pitch_um - pixel_pitch_um) > PITCH_TOLERANCE * pitch_um + rounding_um:
        text = (
            f"{state.name} says by its EDID that its pixels are {pitch_um:.1f} um apart and"
            f" the bench file says {pixel_pitch_um:g}; measure it, and set [monitor] pixel_pitch_um"
        )
        yield Finding(text, False)


def _geometry_findings(state: OutputState) -> Iterator[Finding]:
    """What scales, turns or copies frames on their way to an output."""
    off = np.abs(np.subtract(state.transform, IDENTITY)).max()
    if off > TRANSFORM_TOLERANCE:
        mend = f"xrandr --output {state.name} --transform none"
        yield Finding(
            f"{state.name} has a transform (fractional scaling), which resamples every frame;"
            f" {mend}",
            True,
        )
    if state.preferred_px and state.mode_px not in state.preferred_px:
        width, height = state.mode_px
        wide, high = state.preferred_px[0]
        mode = (
            f"{state.name} runs at {width} x {height} and its own pixels are {wide} x {high}: it"
            " scales every frame"
        )
        scaling = (state.properties or {}).get("scaling mode")
        mode += "" if scaling is None else f" (scaling mode {_words(scaling)})"
        yield Finding(f"{mode}; xrandr --output {state.name} --mode {wide}x{high}", True)
    if state.rotated:
        mend = (
            f"xrandr --output {state.name} --rotate normal --reflect normal, and [monitor]"
            " rotate_deg, flip_x, flip_y"
        )
        yield Finding(f"X rotates or reflects {state.name}, by a copy of each frame; {mend}", False)
    if len(state.providers) > 1:
        gpus = f"the X screen has {len(state.providers)} GPUs ({', '.join(state.providers)})"
        mend = (
            "plug the monitor into the GPU that draws, or draw by its own (xrandr --listproviders;"
            " DRI_PRIME=0)"
        )
        yield Finding(
            f"{gpus}: frames may be copied from one to the other, a refresh late; {mend}", False
        )


def size_mm_of(edid: bytes) -> Pair | None:
    """The picture's size in mm by the first detailed timing of an EDID (VESA E-EDID 1.4,
    3.10.2); None where it has none.
    """
    timing = edid[54:72]
    if len(edid) < 128 or len(timing) < 18 or not timing[0] | timing[1]:
        return None
    width = timing[12] | (timing[14] & 0xF0) << 4
    height = timing[13] | (timing[14] & 0x0F) << 8
    # Some write an aspect ratio (16 x 9) there, and televisions nothing.
    if min(width, height) > 20:
        return (width, height)
    return None


def _edid_pitch_um(edid: bytes) -> tuple[float, float] | None:
    """The pitch of a monitor's own pixels by its EDID, um, and its uncertainty by rounding of the
    size.
    """
    timing = edid[54:72]
    if len(edid) < 128 or not timing[0] | timing[1]:
        return None
    wide_px = timing[2] | (timing[4] & 0xF0) << 4
    size_mm = size_mm_of(edid)
    width_cm = edid[21]
    height_cm = edid[22]
    if size_mm is not None:
        wide_mm, rounding_mm = size_mm[0], 0.5
    elif width_cm and height_cm:
        wide_mm, rounding_mm = 10 * width_cm, CM_ROUNDING_MM
    else:
        return None
    if not wide_px:
        return None
    um_per_mm = 1e3 / wide_px
    return wide_mm * um_per_mm, rounding_mm * um_per_mm


def _words(value: Value) -> str:
    if isinstance(value, tuple):
        return " ".join(str(part) for part in value)
    return str(value)
