"""Which patches to measure for a monitor's response, and in which order: PLAN.csv, to be filled in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.calibrate.measurements import CHANNELS
from hilstar.errors import InputError
from hilstar.files import write_whole
from hilstar.reading import read_text

MAX_PLAN_BYTES = 100_000_000
MIN_PLANNED_LIGHT = 10**-3.2  # of white: a little beyond three decades, so that nothing is extrapolated there
FAINT_LIGHT = 1e-2  # of white; levels below it are planned twice as often, because the black level drowns them
PATCHES_PER_REFERENCE = 8  # between two rounds of black, half and white


@dataclass(frozen=True, slots=True, order=True)
class Patch:
    """One patch to be measured: its code, and which of w, r, g, b it lights."""

    code: int
    channel: str


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """What to plan: bits of a code, levels from black to white, repeats of each, and channels.

    Raises InputError for a plan that cannot be measured.
    """

    bits: int
    levels: int = 32
    repeats: int = 3
    channels: str = "w"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16 or not 2 <= self.levels <= 2**self.bits or not 1 <= self.repeats <= 1000:
            raise InputError(
                f"plan of {self.levels} levels, {self.repeats} repeats, {self.bits} bits; write 1 to 16 bits, 2 to 2^bits"
                " levels and 1 to 1000 repeats"
            )
        channels = set(self.channels)
        if not channels or channels - set(CHANNELS) or len(channels) < len(self.channels):
            raise InputError(f"channels = {self.channels}; write one or more of w, r, g and b, each once")


def plan_patches(settings: PlanSettings, rng: np.random.Generator) -> list[Patch]:
    """The patches in the order of measurement.

    Levels run from black to white in equal steps of log light. Each comes `repeats` times, those below 1 % of white twice as
    often, in random order, with black, half and white between every eight as a reference for drift.
    """
    codes, white = planned_codes(settings.bits, settings.levels), 2**settings.bits - 1
    light = (np.array(codes) / white) ** 2.2
    faint = [code for code, is_faint in zip(codes, light < FAINT_LIGHT, strict=True) if is_faint]
    drawn = [Patch(code, name) for name in settings.channels for code in [*codes, *faint] for _ in range(settings.repeats)]
    shuffled = [drawn[place] for place in rng.permutation(len(drawn))]
    references = [Patch(code, name) for name in settings.channels for code in (0, white // 2, white)]
    at_once = PATCHES_PER_REFERENCE * len(settings.channels)
    patches: list[Patch] = []
    for start in range(0, len(shuffled), at_once):
        patches += [*references, *shuffled[start : start + at_once]]
    return [*patches, *references]


def planned_codes(bits: int, levels: int) -> list[int]:
    """Black, and codes in equal steps of the log light of an sRGB monitor, from 3.2 decades below white up to white."""
    white = 2**bits - 1
    light = np.geomspace(MIN_PLANNED_LIGHT, 1, levels - 1)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    codes = [0]
    for place, code in enumerate(np.rint(signal * white).astype(int)):
        room = white - (levels - 2 - place)  # for those that follow
        codes.append(int(min(max(code, codes[-1] + 1), room)))
    codes[-1] = white
    return codes


def write_plan(path: Path, patches: list[Patch]) -> None:
    """Write PLAN.csv, order,code,channel,value with value left empty. Raises InputError where it cannot be written."""
    rows = [f"{order},{patch.code},{patch.channel}," for order, patch in enumerate(patches, start=1)]
    write_whole(path, "\n".join(["order,code,channel,value", *rows]) + "\n")


def is_filled_in(path: Path) -> bool:
    """Whether somebody has written measurements into a plan."""
    try:
        lines = read_text(path, "", MAX_PLAN_BYTES).splitlines()
    except InputError:
        return path.is_file()
    return any(line.strip() and not line.rstrip().endswith(",") for line in lines[1:])
