"""Whether a property of a display's output is right for codes of so many bits, and the command that
mends it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Value = str | int | tuple[int, ...]
Judge = Callable[[Value, int], str]
WRONG, DOUBTFUL, RIGHT = "wrong", "doubtful", "right"
NVIDIA = "nvidia-settings: "
ONE = (0, 1)  # as a drm_color_ctm has it
IDENTITY_HALVES = [*ONE, *[0] * 6, *ONE, *[0] * 6, *ONE]


@dataclass(frozen=True, slots=True)
class PropertyRule:
    """A property: whether a value is right for codes of some bits, why not, and the command that
    mends it.

    `mend` is a template: `output` and `name` are those of the output and the property, `bits` the
    codes'.
    """

    name: str
    judge: Judge
    why: str
    mend: str


def one_of(right: str, doubtful: str = "") -> Judge:
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


def doubtful_unless(right: str) -> Judge:
    """Right are these values, separated by commas, in any case; all others are doubtful."""
    good = right.lower().split(",")

    def judge(value: Value, bits: int) -> str:
        if str(value).lower() in good:
            return RIGHT
        return DOUBTFUL

    return judge


def at_least_the_bits(value: Value, bits: int) -> str:
    """Right is a number of bits that is not under the codes'."""
    if isinstance(value, int) and value < bits:
        return WRONG
    return RIGHT


def identity_matrix(value: Value, bits: int) -> str:
    """A matrix of drm_color_ctm: nine numbers of sign, 31 and 32 bits, the low half first; all 0
    where none is set.
    """
    if not value:
        return RIGHT
    items = np.atleast_1d(value).astype(np.int64)
    halves = (items & 0xFFFFFFFF).tolist()
    if not any(halves) or halves == IDENTITY_HALVES:
        return RIGHT
    return WRONG


def set_by_xrandr(value: str) -> str:
    """The command that sets a property by RandR."""
    return f'xrandr --output {{output}} --set "{{name}}" "{value}"'


def by_nvidia(attribute: str) -> str:
    """The command that sets an attribute of NVIDIA's driver."""
    return f'nvidia-settings -a "[DPY:{{output}}]/{attribute}"'
