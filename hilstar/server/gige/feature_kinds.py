"""What a feature and a pixel format of a GenICam camera are."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A GenICam pixel format: its number, bits of a value, and bits that a pixel takes."""

    number: int
    bits: int
    stored_bits: int


@dataclass(frozen=True, slots=True)
class Feature:
    """A register of the camera's own, as GenICam's naming convention (SFNC) calls it.

    `access` is RO, RW or WO; `entries` are an enumeration's names and numbers.
    """

    name: str
    kind: Literal["integer", "float", "enumeration", "command"]
    category: str
    access: Literal["RO", "RW", "WO"]
    about: str
    unit: str = ""
    entries: Mapping[str, int] = field(default_factory=dict)
