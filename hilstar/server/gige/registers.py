"""The memory of a GigE Vision camera: bootstrap registers, features, and their description.

Addresses and bits of the bootstrap registers are those of GigE Vision 1.2 (table "Bootstrap
registers"). Everything is big-endian; a register is 4 bytes, at an address that 4 divides.

    0x00000  bootstrap registers
    0x10000  features, one register each, in the order of FEATURES
    0x20000  the description, as XML (`description`)

Laws:
1. A read or a write is either whole or refused with the standard's status; a refused write changes
   nothing.
2. Only registers that this table calls writable are written, and only with values that the camera
   keeps: a value that it would round or clip is refused.
3. What a client must not change while images flow (the pixel format) is refused then.
"""

import ipaddress
import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from hilstar.server.gige.feature_kinds import Feature
from hilstar.server.gige.features import (
    ACQUISITION_MODES,
    BY_ADDRESS,
    FEATURES,
    FEATURES_AT,
    FORMAT_NAMES,
    PIXEL_FORMATS,
    WORD_BYTES,
)

BOOTSTRAP_BYTES = 0x1000
DESCRIPTION_AT = 0x2_0000
DISCOVERY_BYTES = 0xF8  # a discovery's answer is the beginning of the memory

VERSION, DEVICE_MODE, MAC_HIGH, MAC_LOW = 0x0000, 0x0004, 0x0008, 0x000C
SUPPORTED_IP, CURRENT_IP_KIND, CURRENT_IP, CURRENT_MASK = 0x0010, 0x0014, 0x0024, 0x0034
MANUFACTURER, MODEL, DEVICE_VERSION, ABOUT = 0x0048, 0x0068, 0x0088, 0x00A8
SERIAL, USER_NAME, FIRST_URL, INTERFACES = 0x00D8, 0x00E8, 0x0200, 0x0600
STREAM_CHANNELS, CAPABILITY, HEARTBEAT_MS = 0x0904, 0x0934, 0x0938
TICKS_HIGH, TICKS_LOW, TIME_CONTROL, TIME_HIGH, TIME_LOW = 0x093C, 0x0940, 0x0944, 0x0948, 0x094C
PRIVILEGE = 0x0A00
STREAM_PORT, STREAM_PACKET_BYTES, STREAM_DELAY = 0x0D00, 0x0D04, 0x0D08
STREAM_ADDRESS, STREAM_SOURCE_PORT = 0x0D18, 0x0D1C

VERSION_1_2 = 0x0001_0002
BIG_ENDIAN_UTF8 = 0x8000_0001
PERSISTENT_AND_LINK_LOCAL, PERSISTENT = 0b101, 0b001
# packet resend, concatenation of reads, write memory; serial number and name are there
CAN = 1 << 2 | 1 << 0 | 1 << 1 | 1 << 30 | 1 << 31
TICKS_PER_S = 1_000_000_000
EXCLUSIVE, CONTROL = 1 << 0, 1 << 1
FIRE_TEST_PACKET = 1 << 31
DO_NOT_FRAGMENT = 1 << 30
PACKET_SIZE_MASK = 0xFFFF
MIN_PACKET_BYTES, DEFAULT_PACKET_BYTES, MAX_PACKET_BYTES = 576, 1500, 9000
DEFAULT_HEARTBEAT_MS, MIN_HEARTBEAT_MS = 3000, 500
LATCH, RESET = 1 << 1, 1 << 0
USER_NAME_BYTES = 16

MIN_EXPOSURE_US, MAX_EXPOSURE_US = 10.0, 60e6
MIN_RATE_HZ, MAX_GAIN_DB = 0.01, 24.0
ROUNDED = 1e-6  # a register's float has 24 bits: a limit may be written a little beyond
# A client that grabs holds these: images of two formats would look alike on the wire.
LOCKED_WHILE_STREAMING = {"PixelFormat", "AcquisitionMode", "AcquisitionFrameCount"}


class GvcpStatus(IntEnum):
    """GvcpStatus codes of GVCP acknowledgements."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    PACKET_UNAVAILABLE = 0x800C


class RegisterError(Exception):
    """A read or write that the standard refuses, with its status."""

    def __init__(self, status: GvcpStatus) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """What a camera says of itself, and the address (IPv4) that it is bound to."""

    address: ipaddress.IPv4Address
    model: str
    version: str
    serial: str
    manufacturer: str = "hilstar"
    about: str = "virtual star tracker"


@dataclass(slots=True)
class CameraSettings:
    """What a client sets: an exposure, s; exposures a second; gain over the bench file's, dB."""

    width_px: int
    height_px: int
    bits: int
    exposure_s: float
    rate_hz: float
    gain_db: float = 0.0
    pixel_format: str = ""
    mode: int = ACQUISITION_MODES["Continuous"]
    frame_count: int = 1
    triggered: bool = False
    streaming: bool = False

    def __post_init__(self) -> None:
        self.pixel_format = self.pixel_format or self.pixel_formats()[0]

    def pixel_formats(self) -> list[str]:
        """The formats of this detector, its own first: DN as they are, or their upper 8 bits."""
        formats = [name for name, form in PIXEL_FORMATS.items() if form.bits == self.bits]
        wider = ["Mono16"] if self.bits < 16 else []
        upper = ["Mono8"] if self.bits > 8 else []
        return [*formats, *wider, *upper]

    @property
    def payload_bytes(self) -> int:
        """Bytes of an image as it is sent."""
        pixels = self.width_px * self.height_px
        stored_bits = PIXEL_FORMATS[self.pixel_format].stored_bits
        if stored_bits == 12:
            return 3 * math.ceil(pixels / 2)
        return pixels * stored_bits // 8


def float_word(value: float) -> bytes:
    """A float's register."""
    return struct.pack(">f", value)


class Registers:
    """The camera's memory: what is read, and what a write changes (`settings`, `commands`).

    `commands` are the names of the command features written since they were last taken.
    """

    def __init__(
        self, identity: CameraIdentity, settings: CameraSettings, description: bytes
    ) -> None:
        self.settings = settings
        self.commands: list[str] = []
        self.time_ns = 0  # the camera's clock, set before each datagram
        self._description = description
        self._boot = bytearray(BOOTSTRAP_BYTES)
        self._locked = 0
        self._identify(identity)

    def _identify(self, identity: CameraIdentity) -> None:
        address = int(identity.address)
        boot_words = {
            VERSION: VERSION_1_2,
            DEVICE_MODE: BIG_ENDIAN_UTF8,
            # a locally administered address (IEEE 802: bit 1 of the first byte) that holds the IP
            MAC_HIGH: 0x0200,
            MAC_LOW: address,
            SUPPORTED_IP: PERSISTENT_AND_LINK_LOCAL,
            CURRENT_IP_KIND: PERSISTENT,
            CURRENT_IP: address,
            CURRENT_MASK: 0xFF00_0000 if identity.address.is_loopback else 0xFFFF_FF00,
            INTERFACES: 1,
            STREAM_CHANNELS: 1,
            CAPABILITY: CAN,
            HEARTBEAT_MS: DEFAULT_HEARTBEAT_MS,
            TICKS_HIGH: TICKS_PER_S >> 32,
            TICKS_LOW: TICKS_PER_S & 0xFFFF_FFFF,
            STREAM_PACKET_BYTES: DEFAULT_PACKET_BYTES,
        }
        for at, value in boot_words.items():
            self.put_word(at, value)
        size = len(self._description)
        texts = {
            MANUFACTURER: (identity.manufacturer, 32),
            MODEL: (identity.model, 32),
            DEVICE_VERSION: (identity.version, 32),
            ABOUT: (identity.about, 48),
            SERIAL: (identity.serial, 16),
            FIRST_URL: (f"Local:hilstar.xml;{DESCRIPTION_AT:X};{size:X}", 512),
        }
        for at, (text, room) in texts.items():
            # the last byte stays 0: a client reads up to it
            text_bytes = text.encode()[: room - 1].decode(errors="ignore").encode()
            self._boot[at : at + len(text_bytes)] = text_bytes

    def word(self, address: int) -> int:
        """A bootstrap register."""
        return int.from_bytes(self._boot[address : address + WORD_BYTES], "big")

    def put_word(self, address: int, value: int) -> None:
        """Set a bootstrap register, of the camera's own accord."""
        self._boot[address : address + WORD_BYTES] = value.to_bytes(WORD_BYTES, "big")

    def discovery(self) -> bytes:
        """What answers a discovery."""
        return bytes(self._boot[:DISCOVERY_BYTES])

    def read(self, address: int, count: int) -> bytes:
        """Bytes of the memory. Raises RegisterError."""
        if address % WORD_BYTES or count % WORD_BYTES:
            raise RegisterError(GvcpStatus.BAD_ALIGNMENT)
        if address + count <= BOOTSTRAP_BYTES:
            return bytes(self._boot[address : address + count])
        features_end = FEATURES_AT + WORD_BYTES * len(FEATURES)
        if address >= FEATURES_AT and address + count <= features_end:
            word_places = range(address, address + count, WORD_BYTES)
            return b"".join(self._feature_word(BY_ADDRESS[at]) for at in word_places)
        offset = address - DESCRIPTION_AT
        room = math.ceil(len(self._description) / WORD_BYTES) * WORD_BYTES
        if offset >= 0 and offset + count <= room:
            return self._description[offset : offset + count].ljust(count, b"\0")
        raise RegisterError(GvcpStatus.INVALID_ADDRESS)

    def _feature_word(self, feature: Feature) -> bytes:
        settings = self.settings
        if feature.access == "WO":
            return bytes(WORD_BYTES)
        floats = {
            "AcquisitionFrameRate": settings.rate_hz,
            "ExposureTime": settings.exposure_s * 1e6,
            "Gain": settings.gain_db,
        }
        if feature.name in floats:
            return float_word(floats[feature.name])
        integers = {
            "Width": settings.width_px,
            "Height": settings.height_px,
            "SensorWidth": settings.width_px,
            "SensorHeight": settings.height_px,
            "PixelFormat": PIXEL_FORMATS[settings.pixel_format].number,
            "PayloadSize": settings.payload_bytes,
            "TLParamsLocked": self._locked,
            "AcquisitionMode": settings.mode,
            "AcquisitionFrameCount": settings.frame_count,
            "TriggerMode": int(settings.triggered),
        }
        return integers.get(feature.name, 0).to_bytes(WORD_BYTES, "big")

    def write(self, address: int, data: bytes) -> None:
        """Write a register (4 bytes), or the user's name. Raises RegisterError."""
        if address % WORD_BYTES:
            raise RegisterError(GvcpStatus.BAD_ALIGNMENT)
        if address == USER_NAME and len(data) <= USER_NAME_BYTES:
            self._boot[address : address + USER_NAME_BYTES] = data.ljust(USER_NAME_BYTES, b"\0")
            return
        # One at a time: of several a later one may be refused when the first is written.
        if len(data) != WORD_BYTES:
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
        self._write_word(address, data)

    def _write_word(self, address: int, data: bytes) -> None:
        feature = BY_ADDRESS.get(address)
        if feature is not None:
            self._write_feature(feature, data)
            return
        value = int.from_bytes(data, "big")
        if address == HEARTBEAT_MS:
            if value < MIN_HEARTBEAT_MS:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            self.put_word(address, value)
        elif address == TIME_CONTROL:
            # Only the reading is latched: the tracker's clock is not a client's to set back.
            if value & RESET or not value & LATCH:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            self.put_word(TIME_HIGH, self.time_ns >> 32 & 0xFFFF_FFFF)
            self.put_word(TIME_LOW, self.time_ns & 0xFFFF_FFFF)
        elif address == STREAM_PACKET_BYTES:
            size = value & PACKET_SIZE_MASK
            if not MIN_PACKET_BYTES <= size <= MAX_PACKET_BYTES:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            self.put_word(address, value & (DO_NOT_FRAGMENT | PACKET_SIZE_MASK))
        elif address in {STREAM_PORT, STREAM_DELAY, STREAM_ADDRESS, PRIVILEGE}:
            self.put_word(address, value)
        elif address < BOOTSTRAP_BYTES or DESCRIPTION_AT <= address < DESCRIPTION_AT + len(
            self._description
        ):
            raise RegisterError(GvcpStatus.WRITE_PROTECT)
        else:
            raise RegisterError(GvcpStatus.INVALID_ADDRESS)

    def _write_feature(self, feature: Feature, data: bytes) -> None:
        if feature.access == "RO":
            raise RegisterError(GvcpStatus.WRITE_PROTECT)
        if feature.name in LOCKED_WHILE_STREAMING and self.settings.streaming:
            raise RegisterError(GvcpStatus.ACCESS_DENIED)
        if feature.kind == "float":
            self._write_float(feature.name, struct.unpack(">f", data)[0])
            return
        value = int.from_bytes(data, "big")
        if feature.kind == "command":
            if value != 1:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            self.commands.append(feature.name)
        elif feature.kind == "enumeration":
            self._write_entry(feature, value)
        elif feature.name == "AcquisitionFrameCount":
            if not value:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            self.settings.frame_count = value
        else:
            self._locked = value

    def _write_entry(self, feature: Feature, value: int) -> None:
        settings = self.settings
        if feature.name == "PixelFormat":
            name = FORMAT_NAMES.get(value)
            if name not in settings.pixel_formats():
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            settings.pixel_format = name
            return
        if value not in feature.entries.values():
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
        if feature.name == "AcquisitionMode":
            settings.mode = value
        elif feature.name == "TriggerMode":
            settings.triggered = bool(value)

    def _write_float(self, name: str, value: float) -> None:
        settings = self.settings
        if not math.isfinite(value):
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
        if name == "ExposureTime":
            if not MIN_EXPOSURE_US <= value <= MAX_EXPOSURE_US:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            settings.exposure_s = value / 1e6
            # Exposures do not overlap: a long one lowers the rate, as in a camera.
            settings.rate_hz = min(settings.rate_hz, 1 / settings.exposure_s)
        elif name == "AcquisitionFrameRate":
            low_hz, high_hz = MIN_RATE_HZ, 1 / settings.exposure_s
            if not low_hz * (1 - ROUNDED) <= value <= high_hz * (1 + ROUNDED):
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            settings.rate_hz = value
        elif 0 <= value <= MAX_GAIN_DB:
            settings.gain_db = value
        else:
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
