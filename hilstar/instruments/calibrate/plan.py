"""Patches for a monitor's response: the plan of codes in order, written as pictures or shown on
a display.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory, write_whole
from hilstar.basics.reading import read_text
from hilstar.display.render.backend import ScreenView
from hilstar.display.render.presenter import Presenter, level_texture, window_context
from hilstar.display.response import code_dtype
from hilstar.instruments.calibrate.measurements import CHANNELS, PRIMARIES
from hilstar.instruments.calibrate.until_key import stays_until_key
from hilstar.server.bench.frame_files import write_codes_png

MAX_PLAN_BYTES = 100_000_000
# relative to white: a little beyond three decades, so that nothing is extrapolated there
MIN_PLANNED_LIGHT = 10**-3.2
# relative to white; levels below it are planned twice as often, because the black level drowns them
FAINT_LIGHT = 1e-2
PATCHES_PER_REFERENCE = 8  # between two rounds of black, half and white
PATCH_SHARE = 1 / 3  # relative to the screen's smaller side


@dataclass(frozen=True, slots=True, order=True)
class Patch:
    """One patch to measure: its code and channel (w, r, g or b)."""

    code: int
    channel: str


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """The plan's size: bits of a code, levels from black to white, repeats of each, channels.
    Raises InputError.
    """

    bits: int
    levels: int = 32
    repeats: int = 3
    channels: str = "w"

    def __post_init__(self) -> None:
        is_possible = 1 <= self.bits <= 16 and 2 <= self.levels <= 2**self.bits
        if not is_possible or not 1 <= self.repeats <= 1000:
            raise InputError(
                f"plan of {self.levels} levels, {self.repeats} repeats, {self.bits} bits; write 1"
                " to 16 bits, 2 to 2^bits levels and 1 to 1000 repeats"
            )
        channels = set(self.channels)
        if not channels or channels - set(CHANNELS) or len(channels) < len(self.channels):
            raise InputError(
                f"channels = {self.channels}; write one or more of w, r, g and b, each once"
            )


def plan_patches(settings: PlanSettings, rng: np.random.Generator) -> list[Patch]:
    """The patches in the order of measurement.

    Levels run from black to white in equal steps of log light. Each comes `repeats` times, those
    below 1 % of white twice as often, in random order, with black, half and white between every
    eight as a reference for drift.
    """
    codes = planned_codes(settings.bits, settings.levels)
    white = 2**settings.bits - 1
    faint = [code for code in codes if (code / white) ** 2.2 < FAINT_LIGHT]
    ordered: list[Patch] = []
    references: list[Patch] = []
    for name in settings.channels:
        for code in (*codes, *faint):
            ordered += [Patch(code, name)] * settings.repeats
        for code in (0, white // 2, white):
            references.append(Patch(code, name))
    shuffled = [ordered[place] for place in rng.permutation(len(ordered))]
    at_once = PATCHES_PER_REFERENCE * len(settings.channels)
    patches: list[Patch] = []
    for start in range(0, len(shuffled), at_once):
        patches += [*references, *shuffled[start : start + at_once]]
    return [*patches, *references]


def planned_codes(bits: int, levels: int) -> list[int]:
    """Black, and codes in equal steps of the log light of an sRGB monitor, from 3.2 decades
    below white up to white.
    """
    white = 2**bits - 1
    light = np.geomspace(MIN_PLANNED_LIGHT, 1, levels - 1)
    # IEC 61966-2-1
    power = 1.055 * light ** (1 / 2.4) - 0.055
    signal = np.where(light <= 0.0031308, 12.92 * light, power)
    codes = [0]
    for place, code in enumerate(np.rint(signal * white).astype(int)):
        largest = white - (levels - 2 - place)  # leaves a code for each level that follows
        codes.append(int(min(max(code, codes[-1] + 1), largest)))
    codes[-1] = white
    return codes


def write_plan(path: Path, patches: list[Patch]) -> None:
    """Write PLAN.csv, order,code,channel,value with value left empty. Raises InputError where it
    cannot be written.
    """
    rows = []
    for order, patch in enumerate(patches, start=1):
        rows.append(f"{order},{patch.code},{patch.channel},")
    write_whole(path, "\n".join(["order,code,channel,value", *rows]) + "\n")


def is_filled_in(path: Path) -> bool:
    """Whether a plan has measurements in it."""
    try:
        lines = read_text(path, "", MAX_PLAN_BYTES).splitlines()
    except InputError:
        return path.is_file()
    for line in lines[1:]:
        row = line.strip()
        if row and not row.endswith(","):
            return True
    return False


Level = TypeVar("Level", bound=np.unsignedinteger)
log = logging.getLogger(__name__)


def patch_image(
    patch: Patch, resolution_px: tuple[int, int], bits: int
) -> npt.NDArray[np.uint8 | np.uint16]:
    """A square patch in the middle of a black screen: (height, width) for w, (height, width, 3)
    for one primary.
    """
    width, height = resolution_px
    side = max(1, round(min(width, height) * PATCH_SHARE))
    top = (height - side) // 2
    first_column = (width - side) // 2
    grey = np.zeros((height, width), dtype=code_dtype(bits))
    rows = slice(top, top + side)
    columns = slice(first_column, first_column + side)
    grey[rows, columns] = patch.code
    return in_channel(grey, patch.channel)


def in_channel(codes: npt.NDArray[Level], channel: str) -> npt.NDArray[Level]:
    """Codes (h, w) in one primary (h, w, 3); unchanged for w."""
    if channel == "w":
        return codes
    colours = np.zeros((*codes.shape, 3), dtype=codes.dtype)
    colours[..., PRIMARIES.index(channel)] = codes
    return colours


def write_patches(
    folder: Path, planned: Sequence[Patch], resolution_px: tuple[int, int], bits: int
) -> None:
    """Write a PNG of `resolution_px` (width, height) for each different patch. Raises InputError
    where that cannot be done.
    """
    make_directory(folder)
    patches = sorted(set(planned))
    if bits > 8 and any(patch.channel != "w" for patch in patches):
        raise InputError(
            "patches of r, g or b are written as PNG for up to 8 bits; leave the directory out, and"
            " show the codes of the plan"
        )
    for patch in patches:
        path = folder / f"{patch.channel}-{patch.code:05d}.png"
        write_codes_png(path, patch_image(patch, resolution_px, bits), bits)


def show_patches(
    planned: Sequence[Patch], bits: int, display: int | str, seconds: float | None
) -> int:
    """Show each patch on a display until space is pressed, or for `seconds`; q quits. Returns how
    many were shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not
    there.
    """
    from hilstar.display.window.window import Window, WindowSettings

    with Window(WindowSettings((640, 480), bits, display)) as window:
        size_px = window.size_px
        square = (patch_image(Patch(1, "w"), size_px, 8) > 0).astype(np.uint8)
        nothing = np.zeros((2, 3), dtype=np.uint16)
        view = ScreenView(size_px, size_px, bits, triples=nothing)
        presenter = Presenter(level_texture(window_context(), square), view)
        for shown, patch in enumerate(planned):
            lit = [0, 1, 2]
            if patch.channel in PRIMARIES:
                lit = [PRIMARIES.index(patch.channel)]
            triples = nothing.copy()
            triples[1, lit] = patch.code
            presenter.set_triples(triples)
            log.warning(
                "patch %d of %d: code %d, channel %s",
                shown + 1,
                len(planned),
                patch.code,
                patch.channel,
            )
            if not stays_until_key(window, presenter, seconds):
                return shown
    return len(planned)
