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

Value = str | int | tuple[int, ...]
Pair = tuple[int, int]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
TRANSFORM_TOLERANCE = 1e-4  # X has 16 bits after the point
PITCH_TOLERANCE = 0.03
CM_ROUNDING_MM = 5.0
# numbers of a property; a longer one (a table of the colour hardware) is not listed
MAX_LISTED = 18
NVIDIA = "nvidia-settings: "
WRONG, DOUBTFUL, RIGHT = "wrong", "doubtful", "right"
DITHERS = "the driver adds a pattern to every code"
ONE = (0, 1)  # as a drm_color_ctm has it
IDENTITY_HALVES = [*ONE, *[0] * 6, *ONE, *[0] * 6, *ONE]


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
        parts = [f"{self.name}, {width} x {height}"]
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
    for rule in RULES:
        value = (state.properties or {}).get(rule.name)
        if value is None:
            verdict = RIGHT
        else:
            verdict = rule.judge(value, bits)
        if value is not None and verdict != RIGHT:
            mend = rule.mend.format(output=state.name, name=rule.name, bits=bits)
            yield Finding(
                f"{rule.name} of {state.name} is {_words(value)}: {rule.why}; {mend}",
                verdict == WRONG,
            )
    yield from _geometry_findings(state)
    edid_pitch_um = _own_pitch_um(state.edid)
    if (
        pixel_pitch_um is not None
        and edid_pitch_um is not None
        and abs(edid_pitch_um[0] - pixel_pitch_um)
        > PITCH_TOLERANCE * edid_pitch_um[0] + edid_pitch_um[1]
    ):
        text = (
            f"{state.name} says by its EDID that its pixels are {edid_pitch_um[0]:.1f} um apart and"
            f" the bench file says {pixel_pitch_um:g}; measure it, and set [monitor] pixel_pitch_um"
        )
        yield Finding(text, False)


def _geometry_findings(state: OutputState) -> Iterator[Finding]:
    off = max(abs(a - b) for a, b in zip(state.transform, IDENTITY, strict=True))
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


def _own_pitch_um(edid: bytes) -> tuple[float, float] | None:
    """The pitch of an EDID's own pixels, um, and its uncertainty by rounding of the size."""
    timing = edid[54:72]
    if len(edid) < 128 or not timing[0] | timing[1]:
        return None
    wide_px = timing[2] | (timing[4] & 0xF0) << 4
    fine = size_mm_of(edid)
    coarse_mm = 10 * edid[21]
    if not wide_px or not (fine or (coarse_mm and edid[22])):
        return None
    wide_mm, rounding_mm = (fine[0], 0.5) if fine else (coarse_mm, CM_ROUNDING_MM)
    return wide_mm / wide_px * 1e3, rounding_mm / wide_px * 1e3


def _words(value: Value) -> str:
    if isinstance(value, tuple):
        return " ".join(str(part) for part in value)
    return str(value)


Judge = Callable[[Value, int], str]


@dataclass(frozen=True, slots=True)
class _Rule:
    """A property: whether a value is right for codes of some bits, why not, and the command that
    mends it.
    """

    name: str
    judge: Judge
    why: str
    mend: str


def _one_of(right: str, doubtful: str = "") -> Judge:
    """Right are these values, separated by commas, in any case; some are doubtful; all others
    are wrong.
    """
    good = right.lower().split(",")
    unsure = doubtful.lower().split(",") if doubtful else []

    def judge(value: Value, bits: int) -> str:
        word = str(value).lower()
        if word in good:
            return RIGHT
        if word in unsure:
            return DOUBTFUL
        return WRONG

    return judge


def _doubtful_unless(right: str) -> Judge:
    good = right.lower().split(",")
    return lambda value, bits: RIGHT if str(value).lower() in good else DOUBTFUL


def _identity_matrix(value: Value, bits: int) -> str:
    """A matrix of drm_color_ctm: nine numbers of sign, 31 and 32 bits, the low half first; all 0
    where none is set.
    """
    if not value:
        return RIGHT
    halves = (np.atleast_1d(value).astype(np.int64) & 0xFFFFFFFF).tolist()
    if not any(halves) or halves == IDENTITY_HALVES:
        return RIGHT
    return WRONG


def _set(value: str) -> str:
    return f'xrandr --output {{output}} --set "{{name}}" "{value}"'


def _by_nvidia(attribute: str) -> str:
    return f'nvidia-settings -a "[DPY:{{output}}]/{attribute}"'


RULES = (
    _Rule(
        "Broadcast RGB",
        _one_of("full", "automatic"),
        "codes go to 16 to 235, always or at television modes",
        _set("Full"),
    ),
    _Rule("output_csc", _one_of("bypass"), "codes are converted on their way", _set("bypass")),
    _Rule(
        "max bpc",
        lambda value, bits: WRONG if isinstance(value, int) and value < bits else RIGHT,
        "the cable carries fewer bits than the bench's codes have",
        _set("{bits}"),
    ),
    _Rule("dithering mode", _one_of("off"), DITHERS, _set("off")),
    _Rule("dither", _one_of("off"), DITHERS, _set("off")),
    _Rule(
        "CTM",
        _identity_matrix,
        "a colour matrix mixes the primaries",
        _set("0,1,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0,1"),
    ),
    _Rule("Colorspace", _one_of("default"), "the panel converts colours", _set("Default")),
    _Rule("HDR_OUTPUT_METADATA", _one_of("0"), "the panel maps tones (HDR)", _set("0")),
    _Rule(
        "underscan",
        _one_of("off", "auto"),
        "frames are scaled down, always or on a television",
        _set("off"),
    ),
    *(
        _Rule(f"{side} margin", _one_of("0"), "frames are scaled to leave a margin", _set("0"))
        for side in ("left", "right", "top", "bottom")
    ),
    _Rule(
        "abm level",
        _one_of("0"),
        "the driver dims the backlight and lifts codes by the picture",
        _set("0"),
    ),
    _Rule("vibrant hue", _one_of("90"), "the driver turns hues", _set("90")),
    _Rule("color vibrance", _one_of("150"), "the driver saturates colours", _set("150")),
    _Rule("VRR_ENABLED", _one_of("0,off"), "the refresh follows the frames", _set("0")),
    _Rule("adaptive-sync", _one_of("0,off"), "the refresh follows the frames", _set("0")),
    _Rule("freesync", _one_of("0,off"), "the refresh follows the frames", _set("0")),
    _Rule(
        "TearFree",
        _doubtful_unless("off,auto"),
        "frames are copied once more, and may come a refresh late",
        _set("off"),
    ),
    _Rule(
        "content type",
        _doubtful_unless("no data,graphics"),
        "the monitor may process pictures by it",
        _set("Graphics"),
    ),
    _Rule(f"{NVIDIA}CurrentDithering", _one_of("0"), DITHERS, _by_nvidia("Dithering=2")),
    _Rule(
        f"{NVIDIA}CurrentColorRange",
        _one_of("0"),
        "codes go to 16 to 235",
        _by_nvidia("ColorRange=0"),
    ),
    _Rule(
        f"{NVIDIA}CurrentColorSpace",
        _one_of("0"),
        "codes are converted to YCbCr",
        _by_nvidia("ColorSpace=0"),
    ),
    _Rule(
        f"{NVIDIA}DigitalVibrance",
        _one_of("0"),
        "the driver saturates colours",
        _by_nvidia("DigitalVibrance=0"),
    ),
)
NVIDIA_ATTRIBUTES = tuple(
    rule.name.removeprefix(NVIDIA) for rule in RULES if rule.name.startswith(NVIDIA)
)
