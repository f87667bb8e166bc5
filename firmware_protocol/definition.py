"""protocol.toml as frozen records, checked against itself."""

from __future__ import annotations

import struct
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STRUCT = {"u8": "B", "u16": "H", "u32": "I", "i64": "q", "f32": "f", "f64": "d"}
FRAMING_BYTES = 2  # the COBS byte and the 0x00


@dataclass(frozen=True)
class Field:
    """One field of a packet; `offset` in bytes, `value` where it is fixed."""

    name: str
    type: str
    offset: int
    meaning: str
    count: int = 1
    unit: str = ""
    bits: str = ""
    value: int | None = None
    crc: bool = False

    @property
    def item_bytes(self) -> int:
        """Size of one element."""
        return struct.calcsize(f"<{STRUCT[self.type]}")

    @property
    def size(self) -> int:
        """Size of all elements."""
        return self.count * self.item_bytes

    @property
    def said(self) -> str:
        """The meaning, with its unit."""
        return f"{self.meaning} [{self.unit}]" if self.unit else self.meaning


@dataclass(frozen=True)
class Packet:
    """One kind of packet."""

    name: str
    kind: int
    size: int
    sender: str
    meaning: str
    fields: tuple[Field, ...]

    @property
    def body(self) -> str:
        """The struct format of all but the CRC."""
        return "<" + "".join(
            f"{f.count if f.count > 1 else ''}{STRUCT[f.type]}" for f in self.fields if not f.crc
        )

    @property
    def direction(self) -> str:
        """Who sends it to whom."""
        ways = {
            "simulator": "simulator to hilstar",
            "hilstar": "hilstar to simulator",
            "tracker": "tracker to hilstar",
        }
        return ways.get(self.sender, "either way")

    @property
    def variable(self) -> list[Field]:
        """The fields that a sender chooses."""
        return [f for f in self.fields if f.value is None and not f.crc]


@dataclass(frozen=True)
class Bit:
    """One bit of a field of flags."""

    name: str
    meaning: str


@dataclass(frozen=True)
class Number:
    """A number in the upper bits of a packet's field, from `first_bit` to the field's last."""

    name: str
    packet: str
    field: str
    first_bit: int
    max: int
    meaning: str


@dataclass(frozen=True)
class Limit:
    """A number that a value may not exceed."""

    name: str
    value: float
    meaning: str
    unit: str = ""


@dataclass(frozen=True)
class Wire:
    """All of protocol.toml."""

    version: int
    packets: tuple[Packet, ...]
    bits: dict[str, tuple[Bit, ...]]
    numbers: tuple[Number, ...]
    limits: tuple[Limit, ...]
    bauds: list[int]


def load(path: Path) -> Wire:
    """Read protocol.toml. Raises SystemExit where it contradicts itself."""
    table = tomllib.loads(path.read_text())
    packets = tuple(
        _packet(name, entry, table["version"]) for name, entry in table["packet"].items()
    )
    bits = {
        group: tuple(Bit(**entry) for entry in entries) for group, entries in table["bits"].items()
    }
    limits = tuple(Limit(name, **entry) for name, entry in table["limit"].items())
    numbers = tuple(Number(name, **entry) for name, entry in table["number"].items())
    return Wire(table["version"], packets, bits, numbers, limits, table["baud_rates"])


def _packet(name: str, entry: dict[str, Any], version: int) -> Packet:
    fields: list[Field] = []
    offset = 0
    for line in entry["fields"]:
        fields.append(Field(offset=offset, **line))
        offset += fields[-1].size
    if offset != entry["size_bytes"]:
        raise SystemExit(
            f"packet.{name}: the fields have {offset} bytes, but size_bytes is"
            f" {entry['size_bytes']}"
        )
    head = [(f.name, f.type, f.value) for f in fields[:2]]
    if head != [("version", "u8", version), ("kind", "u8", entry["kind"])] or not fields[-1].crc:
        raise SystemExit(
            f"packet.{name}: the first fields must be version and kind, each with its value, and"
            " the last the CRC"
        )
    return Packet(name, entry["kind"], offset, entry["sender"], entry["meaning"], tuple(fields))
