"""ULog files of PX4, written by the published format (docs.px4.io, "ULog File Format"), message by message."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from typing import Any

MAGIC = b"ULog\x01\x12\x35"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
CODES = {"uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "uint8_t": "B", "float": "f", "double": "d"}
# The fields of uORB messages that matter here, with paddings as PX4 writes them.
SAMPLED = "uint64_t timestamp;uint64_t timestamp_sample;"
TURNS = "float[4] q;float[4] delta_q_reset;uint8_t quat_reset_counter;uint8_t[7] _padding0;"
FIX = "int32_t timestamp_time_relative;uint8_t fix_type;uint8_t[3] _padding0;"
TURNING = SAMPLED + "float[3] xyz;uint8_t[4] _padding0;"
ATTITUDE = SAMPLED + TURNS
GPS = "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;" + FIX
OLD = {  # before 2019
    "vehicle_attitude": "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;" + TURNS,
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;" + FIX,
}
FORMATS = {
    "vehicle_attitude": ATTITUDE,
    "estimator_attitude": ATTITUDE,
    "vehicle_attitude_groundtruth": ATTITUDE,
    "vehicle_angular_velocity": TURNING,
    "vehicle_angular_velocity_groundtruth": TURNING,
    "vehicle_global_position": SAMPLED + "double lat;double lon;float alt;uint8_t[4] _padding0;",
    "vehicle_gps_position": GPS,
    "sensor_gps": GPS,
    "battery_status": "uint64_t timestamp;float[64] voltage_v;",
}


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


class ULogWriter:
    """A log in memory: the formats of all topics, then subscriptions and messages in the order given."""

    def __init__(
        self,
        start_us: int = 0,
        appended: Iterable[int] = (),
        incompatible: bytes = bytes(8),
        formats: Mapping[str, str] = FORMATS,
    ) -> None:
        offsets = [*appended, 0, 0, 0][:3]
        flags = bytes([1, *incompatible[1:]]) if offsets[0] else incompatible
        self.data = bytearray(MAGIC + b"\x01" + struct.pack("<Q", start_us))
        self.data += message("B", bytes(8) + flags + struct.pack("<3Q", *offsets))
        self.data += message("I", bytes([len(b"char[4] sys_name")]) + b"char[4] sys_name" + b"PX4\0")
        self._formats = {name: [field for field in fields.split(";") if field] for name, fields in formats.items()}
        for name, fields in formats.items():
            self.data += message("F", f"{name}:{fields}".encode())
        self._ids: dict[tuple[str, int], int] = {}

    def topic(self, name: str, instance: int = 0) -> None:
        """Subscribe to a topic."""
        number = len(self._ids)
        self._ids[name, instance] = number
        self.data += message("A", struct.pack("<BH", instance, number) + name.encode())

    def add(self, name: str, instance: int = 0, **values: Any) -> None:
        """One message; fields that are not given are 0, and padding at the end is left out, as PX4 does."""
        content = struct.pack("<H", self._ids[name, instance])
        for field in self._formats[name]:
            kind, label = field.split(" ")
            base, _, count = kind.rstrip("]").partition("[")
            if label.startswith("_padding"):
                continue
            given = values.get(label, [0] * int(count) if count else 0)
            content += struct.pack(f"<{count or ''}{CODES[base]}", *(given if count else [given]))
        self.data += message("D", content)

    def dropout(self, milliseconds: int) -> None:
        self.data += message("O", struct.pack("<H", milliseconds))

    def sync(self) -> None:
        self.data += message("S", SYNC)
