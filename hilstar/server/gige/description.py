"""The description of the camera's features, as GenICam's XML (GenApi schema 1.1), from the table
of its registers.
"""

from xml.sax.saxutils import escape

from hilstar.server.gige.feature_kinds import Feature
from hilstar.server.gige.features import ADDRESSES, FEATURES, PIXEL_FORMATS
from hilstar.server.gige.registers import (
    CURRENT_IP,
    HEARTBEAT_MS,
    MANUFACTURER,
    MAX_EXPOSURE_US,
    MAX_GAIN_DB,
    MAX_PACKET_BYTES,
    MIN_EXPOSURE_US,
    MIN_PACKET_BYTES,
    MIN_RATE_HZ,
    MODEL,
    SERIAL,
    STREAM_ADDRESS,
    STREAM_DELAY,
    STREAM_PACKET_BYTES,
    STREAM_PORT,
    TICKS_HIGH,
    TIME_CONTROL,
    TIME_HIGH,
    USER_NAME,
    CameraSettings,
)

PORT = "<pPort>Device</pPort>"
BIG_ENDIAN = "<Endianess>BigEndian</Endianess>"
HEAD = (
    '<?xml version="1.0" encoding="utf-8"?>\n'
    '<RegisterDescription ModelName="{model}" VendorName="hilstar" StandardNameSpace="GEV"'
    ' SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1"'
    ' MinorVersion="0" SubMinorVersion="0" ToolTip="The virtual star tracker of a bench."'
    ' ProductGuid="8b3d6f2e-5a0c-4c55-9d0e-6a1c2f4b7e10"'
    ' VersionGuid="0f5d2c1a-7e64-4b1c-8a39-d1b7c65e9f32"'
    ' xmlns="http://www.genicam.org/GenApi/Version_1_1"'
    ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
    ' xsi:schemaLocation="http://www.genicam.org/GenApi/Version_1_1'
    ' http://www.genicam.org/GenApi/GenApiSchema_Version_1_1.xsd">\n'
)
BOUNDS = {
    "ExposureTime": (MIN_EXPOSURE_US, MAX_EXPOSURE_US),
    "AcquisitionFrameRate": (MIN_RATE_HZ, 1e6 / MIN_EXPOSURE_US),
    "Gain": (0.0, MAX_GAIN_DB),
}
# Name, address, bytes and access of texts and numbers of the bootstrap registers.
TEXTS = (
    ("DeviceVendorName", MANUFACTURER, 32, "RO"),
    ("DeviceModelName", MODEL, 32, "RO"),
    ("DeviceID", SERIAL, 16, "RO"),
    ("DeviceSerialNumber", SERIAL, 16, "RO"),
    ("DeviceUserID", USER_NAME, 16, "RW"),
)
NUMBERS = (
    ("GevCurrentIPAddress", CURRENT_IP, 4, "RO"),
    ("GevHeartbeatTimeout", HEARTBEAT_MS, 4, "RW"),
    ("GevTimestampTickFrequency", TICKS_HIGH, 8, "RO"),
    ("GevTimestampValue", TIME_HIGH, 8, "RO"),
    ("GevSCPHostPort", STREAM_PORT, 4, "RW"),
    ("GevSCPD", STREAM_DELAY, 4, "RW"),
    ("GevSCDA", STREAM_ADDRESS, 4, "RW"),
)
LATCH_COMMAND = "GevTimestampControlLatch"


def describe(model: str, settings: CameraSettings) -> bytes:
    """The description of a camera with these settings, UTF-8."""
    parts = [HEAD.format(model=escape(model, {'"': "&quot;"})), _categories()]
    parts += [_text(*row) for row in TEXTS]
    parts += [_number(*row) for row in NUMBERS]
    parts.append(_packet_size())
    parts.append(_command(LATCH_COMMAND, "Latch GevTimestampValue.", TIME_CONTROL, 2))
    for feature in FEATURES:
        parts.append(_feature(feature, settings))
    parts.append('<Port Name="Device"/>\n</RegisterDescription>\n')
    return "".join(parts).encode()


def _categories() -> str:
    members: dict[str, list[str]] = {
        "DeviceControl": [name for name, *_ in TEXTS],
        "ImageFormatControl": [],
        "AcquisitionControl": [],
        "AnalogControl": [],
        "TransportLayerControl": [name for name, *_ in NUMBERS],
    }
    members["TransportLayerControl"] += ["GevSCPSPacketSize", LATCH_COMMAND]
    for feature in FEATURES:
        members[feature.category].append(feature.name)
    lines = ['<Category Name="Root" NameSpace="Standard">']
    lines += [f"<pFeature>{name}</pFeature>" for name in members]
    lines.append("</Category>")
    for name, features in members.items():
        lines.append(f'<Category Name="{name}" NameSpace="Standard">')
        lines += [f"<pFeature>{feature}</pFeature>" for feature in features]
        lines.append("</Category>")
    return "\n".join(lines) + "\n"


def _place(address: int, size: int, access: str) -> str:
    """Where a register is, and that nobody keeps a copy of it."""
    return (
        f"<Address>0x{address:X}</Address><Length>{size}</Length>"
        f"<AccessMode>{access}</AccessMode>{PORT}<Cachable>NoCache</Cachable>"
    )


def _text(name: str, address: int, size: int, access: str) -> str:
    place = _place(address, size, access)
    return f'<StringReg Name="{name}" NameSpace="Standard">{place}</StringReg>\n'


def _number(name: str, address: int, size: int, access: str) -> str:
    register = f"{name}Register"
    return (
        f'<Integer Name="{name}" NameSpace="Standard"><pValue>{register}</pValue></Integer>\n'
        f'<IntReg Name="{register}">{_place(address, size, access)}<Sign>Unsigned</Sign>'
        f"{BIG_ENDIAN}</IntReg>\n"
    )


def _packet_size() -> str:
    """The lower half of its register; bit 0 is the highest (GenApi counts big-endian bits so)."""
    return (
        '<Integer Name="GevSCPSPacketSize" NameSpace="Standard">'
        f"<pValue>GevSCPSPacketSizeRegister</pValue><Min>{MIN_PACKET_BYTES}</Min>"
        f"<Max>{MAX_PACKET_BYTES}</Max></Integer>\n"
        '<MaskedIntReg Name="GevSCPSPacketSizeRegister">'
        f"{_place(STREAM_PACKET_BYTES, 4, 'RW')}<LSB>31</LSB><MSB>16</MSB><Sign>Unsigned</Sign>"
        f"{BIG_ENDIAN}</MaskedIntReg>\n"
    )


def _command(name: str, about: str, address: int, value: int) -> str:
    register = f"{name}Register"
    return (
        f'<Command Name="{name}" NameSpace="Standard"><ToolTip>{escape(about)}</ToolTip>'
        f"<pValue>{register}</pValue><CommandValue>{value}</CommandValue></Command>\n"
        f'<IntReg Name="{register}">{_place(address, 4, "WO")}<Sign>Unsigned</Sign>'
        f"{BIG_ENDIAN}</IntReg>\n"
    )


def _integer_limits(feature: Feature, settings: CameraSettings) -> str:
    """The limits of a side or an offset, which a client's user interface takes for a slider's;
    none for other numbers. There is no region of interest: a side has one value.
    """
    if feature.name in {"OffsetX", "OffsetY"}:
        only = 0
    elif feature.name in {"Width", "SensorWidth"}:
        only = settings.width_px
    elif feature.name in {"Height", "SensorHeight"}:
        only = settings.height_px
    else:
        return ""
    return f"<Min>{only}</Min><Max>{only}</Max>"


def _feature(feature: Feature, settings: CameraSettings) -> str:
    address = ADDRESSES[feature.name]
    if feature.kind == "command":
        return _command(feature.name, feature.about, address, 1)
    register = f"{feature.name}Register"
    about = f"<ToolTip>{escape(feature.about)}</ToolTip>"
    opening = f'Name="{feature.name}" NameSpace="Standard">{about}'
    place = _place(address, 4, feature.access)
    if feature.kind == "float":
        low, high = BOUNDS[feature.name]
        return (
            f"<Float {opening}<pValue>{register}</pValue><Min>{low:g}</Min><Max>{high:g}</Max>"
            f"<Unit>{feature.unit}</Unit></Float>\n"
            f'<FloatReg Name="{register}">{place}{BIG_ENDIAN}</FloatReg>\n'
        )
    number = f'<IntReg Name="{register}">{place}<Sign>Unsigned</Sign>{BIG_ENDIAN}</IntReg>\n'
    if feature.kind == "integer":
        limits = _integer_limits(feature, settings)
        return f"<Integer {opening}<pValue>{register}</pValue>{limits}</Integer>\n{number}"
    entries = dict(feature.entries)
    if feature.name == "PixelFormat":
        entries = {name: PIXEL_FORMATS[name].number for name in settings.pixel_formats()}
    lines = "".join(
        f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
        for name, value in entries.items()
    )
    return f"<Enumeration {opening}{lines}<pValue>{register}</pValue></Enumeration>\n{number}"
