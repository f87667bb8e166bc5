"""The camera's own features, as GenICam's naming convention (SFNC) calls them: one register each,
from FEATURES_AT on, in the order of FEATURES.
"""

from hilstar.server.gige.feature_kinds import Feature, PixelFormat

WORD_BYTES = 4
FEATURES_AT = 0x1_0000
ACQUISITION_MODES = {"Continuous": 0, "SingleFrame": 1, "MultiFrame": 2}
PIXEL_FORMATS = {
    "Mono8": PixelFormat(0x0108_0001, 8, 8),
    "Mono10": PixelFormat(0x0110_0003, 10, 16),
    "Mono10Packed": PixelFormat(0x010C_0004, 10, 12),
    "Mono12": PixelFormat(0x0110_0005, 12, 16),
    "Mono12Packed": PixelFormat(0x010C_0006, 12, 12),
    "Mono14": PixelFormat(0x0110_0025, 14, 16),
    "Mono16": PixelFormat(0x0110_0007, 16, 16),
}
FORMAT_NAMES = {form.number: name for name, form in PIXEL_FORMATS.items()}
FEATURES = (
    Feature("Width", "integer", "ImageFormatControl", "RO", "Columns of an image.", "px"),
    Feature("Height", "integer", "ImageFormatControl", "RO", "Rows of an image.", "px"),
    Feature("SensorWidth", "integer", "ImageFormatControl", "RO", "Columns of the sensor.", "px"),
    Feature("SensorHeight", "integer", "ImageFormatControl", "RO", "Rows of the sensor.", "px"),
    Feature("OffsetX", "integer", "ImageFormatControl", "RO", "First column.", "px"),
    Feature("OffsetY", "integer", "ImageFormatControl", "RO", "First row.", "px"),
    Feature("PixelFormat", "enumeration", "ImageFormatControl", "RW", "How DN are packed."),
    Feature("PayloadSize", "integer", "TransportLayerControl", "RO", "Bytes of an image.", "B"),
    Feature("TLParamsLocked", "integer", "TransportLayerControl", "RW", "1 while a client grabs."),
    Feature(
        "AcquisitionMode",
        "enumeration",
        "AcquisitionControl",
        "RW",
        "How many images a start gives.",
        entries=ACQUISITION_MODES,
    ),
    Feature("AcquisitionStart", "command", "AcquisitionControl", "WO", "Begin."),
    Feature("AcquisitionStop", "command", "AcquisitionControl", "WO", "End."),
    Feature(
        "AcquisitionFrameCount", "integer", "AcquisitionControl", "RW", "Images of MultiFrame."
    ),
    Feature(
        "AcquisitionFrameRate", "float", "AcquisitionControl", "RW", "Exposures a second.", "Hz"
    ),
    Feature("ExposureTime", "float", "AcquisitionControl", "RW", "Of an image.", "us"),
    Feature(
        "TriggerSelector",
        "enumeration",
        "AcquisitionControl",
        "RW",
        "What is triggered.",
        entries={"FrameStart": 0},
    ),
    Feature(
        "TriggerMode",
        "enumeration",
        "AcquisitionControl",
        "RW",
        "On: an exposure begins with TriggerSoftware alone.",
        entries={"Off": 0, "On": 1},
    ),
    Feature(
        "TriggerSource",
        "enumeration",
        "AcquisitionControl",
        "RW",
        "Where triggers come from.",
        entries={"Software": 0},
    ),
    Feature("TriggerSoftware", "command", "AcquisitionControl", "WO", "Begin one exposure."),
    Feature("Gain", "float", "AnalogControl", "RW", "Over that of the bench file.", "dB"),
)
ADDRESSES = {
    feature.name: FEATURES_AT + WORD_BYTES * index for index, feature in enumerate(FEATURES)
}
BY_ADDRESS = {ADDRESSES[feature.name]: feature for feature in FEATURES}
