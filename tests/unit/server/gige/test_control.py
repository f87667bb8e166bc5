"""The control channel of the camera: who may do what, and that nothing else happens."""

from __future__ import annotations

import ipaddress
import struct
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilstar.basics.units import NS_PER_MS
from hilstar.server.gige.control import (
    ControlChannel,
    ControlCounts,
    FeatureCommand,
    Released,
    Resend,
)
from hilstar.server.gige.description import describe
from hilstar.server.gige.features import ADDRESSES, FEATURES, PIXEL_FORMATS
from hilstar.server.gige.registers import (
    DESCRIPTION_AT,
    HEARTBEAT_MS,
    CameraIdentity,
    CameraSettings,
    GvcpStatus,
    RegisterError,
    Registers,
)
from tests.support.gige_client import (
    CONTROL,
    DISCOVER,
    PACKET_BYTES,
    PRIVILEGE,
    READ,
    READ_MEMORY,
    RESEND,
    STREAM_ADDRESS,
    STREAM_PORT,
    WRITE,
    command,
    write_of,
)

CLIENT, OTHER = ("127.0.0.1", 40_000), ("127.0.0.1", 40_001)
HERE = int(ipaddress.IPv4Address("127.0.0.1"))
ELSEWHERE = int(ipaddress.IPv4Address("192.168.7.7"))
IDENTITY = CameraIdentity(ipaddress.IPv4Address("127.0.0.2"), "virtual tracker", "1", "abc")


def channel(bits: int = 12) -> ControlChannel:
    camera = CameraSettings(64, 48, bits, exposure_s=0.05, rate_hz=10.0)
    return ControlChannel(Registers(IDENTITY, camera, describe(IDENTITY.model, camera)))


class Asker:
    """Sends commands to a channel, each with a number of its own."""

    def __init__(self, to: ControlChannel, peer: tuple[str, int] = CLIENT) -> None:
        self.to, self.peer, self.number = to, peer, 0
        self.now_ns = 0

    def ask(self, kind: int, body: bytes = b"") -> tuple[int, bytes]:
        self.number += 1
        answer = self.to.receive(command(kind, body, self.number), self.peer, self.now_ns)
        assert answer is not None
        status, answered, size, number = struct.unpack(">HHHH", answer[:8])
        assert (answered, size, number) == (kind + 1, len(answer) - 8, self.number)
        return status, answer[8:]

    def write(self, address: int, value: int) -> int:
        return self.ask(WRITE, write_of(address, value))[0]

    def read(self, address: int) -> int:
        status, body = self.ask(READ, struct.pack(">I", address))
        assert status == GvcpStatus.SUCCESS
        return int.from_bytes(body, "big")


def test_a_discovery_gives_the_first_registers_with_the_cameras_name_and_address():
    status, body = Asker(channel()).ask(DISCOVER)
    assert status == 0 and len(body) == 0xF8
    assert body[0x48:0x50] == b"hilstar\0" and body[0x68:0x78] == b"virtual tracker\0"
    assert body[0x24:0x28] == ipaddress.IPv4Address("127.0.0.2").packed


def test_a_peer_without_the_privilege_reads_and_writes_nothing():
    camera = channel()
    asker = Asker(camera)
    assert asker.read(ADDRESSES["Width"]) == 64
    assert asker.write(ADDRESSES["TriggerMode"], 1) == GvcpStatus.ACCESS_DENIED
    assert asker.write(STREAM_PORT, 5000) == GvcpStatus.ACCESS_DENIED
    assert camera.destination is None and not camera.registers.settings.triggered


def test_one_peer_controls_at_a_time_until_it_gives_back_or_falls_silent():
    camera = channel()
    first, second = Asker(camera), Asker(camera, OTHER)
    assert first.write(PRIVILEGE, CONTROL) == 0
    assert second.write(PRIVILEGE, CONTROL) == GvcpStatus.ACCESS_DENIED
    assert first.write(PRIVILEGE, 0) == 0
    assert camera.take_events() == [Released(silent=False)]
    assert second.write(PRIVILEGE, CONTROL) == 0
    second.now_ns = 2900 * NS_PER_MS
    assert second.read(PRIVILEGE) == CONTROL
    first.now_ns = 5800 * NS_PER_MS
    assert first.write(PRIVILEGE, CONTROL) == GvcpStatus.ACCESS_DENIED
    first.now_ns = 6000 * NS_PER_MS
    assert first.write(PRIVILEGE, CONTROL) == 0
    assert camera.take_events() == [Released(silent=True)]


def test_a_controller_that_was_silent_for_too_long_does_not_get_its_privilege_back_by_speaking():
    """Its stream has ended: what it writes next is refused, as anybody's."""
    camera = channel()
    asker = Asker(camera)
    assert asker.write(PRIVILEGE, CONTROL) == GvcpStatus.SUCCESS
    silent_ns = (asker.read(HEARTBEAT_MS) + 1) * NS_PER_MS
    last = command(WRITE, write_of(STREAM_PORT, 5000), number=400)
    assert camera.receive(last, CLIENT, 0)[:2] == b"\0\0"
    # not even by its last command once more, whose answer might have been lost
    assert camera.receive(last, CLIENT, silent_ns)[:2] == b"\x80\x06"
    asker.now_ns = silent_ns
    assert asker.write(STREAM_PORT, 5000) == GvcpStatus.ACCESS_DENIED
    assert camera.destination is None
    assert camera.take_events() == [Released(silent=True)]


@pytest.mark.parametrize("silent", [False, True])
def test_a_controller_that_is_gone_leaves_nothing_of_its_stream_to_the_next(silent):
    """Neither its port nor its address: no image goes where the next one listens for another."""
    camera = channel()
    first, second = Asker(camera), Asker(camera, OTHER)
    first.write(PRIVILEGE, CONTROL)
    first.write(STREAM_ADDRESS, HERE)
    first.write(STREAM_PORT, 5123)
    if silent:
        second.now_ns = (first.read(HEARTBEAT_MS) + 1) * NS_PER_MS
    else:
        first.write(PRIVILEGE, 0)
    assert second.write(PRIVILEGE, CONTROL) == 0
    assert camera.destination is None
    assert (second.read(STREAM_PORT), second.read(STREAM_ADDRESS)) == (0, 0)
    assert second.write(STREAM_PORT, 6000) == 0
    assert camera.destination == (OTHER[0], 6000)


def test_images_go_to_the_controllers_own_address_alone():
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    assert client.write(STREAM_ADDRESS, ELSEWHERE) == GvcpStatus.ACCESS_DENIED
    memory = struct.pack(">II", STREAM_ADDRESS, ELSEWHERE)
    assert client.ask(0x0086, memory)[0] == GvcpStatus.ACCESS_DENIED
    across = struct.pack(">I", STREAM_ADDRESS - 4) + struct.pack(">II", 0, ELSEWHERE)
    assert client.ask(0x0086, across)[0] != 0
    assert client.write(STREAM_ADDRESS, HERE) == 0
    assert camera.destination is None  # no port yet
    client.write(STREAM_PORT, 5123)
    assert camera.destination == ("127.0.0.1", 5123)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        command(DISCOVER)[:7],
        b"\x43" + command(DISCOVER)[1:],
        command(DISCOVER, number=0),
        command(DISCOVER) + bytes(4),
        command(READ, bytes(8))[:-4],
        command(READ, bytes(540)),  # the standard's 536 bytes, and a word
    ],
)
def test_what_is_no_command_is_dropped_and_counted_and_has_no_answer(data):
    camera = channel()
    assert camera.receive(data, CLIENT, 0) is None
    assert camera.counts == ControlCounts(dropped=1)


def test_each_command_is_counted_and_says_what_it_did_or_why_not():
    camera = channel()
    client = Asker(camera)
    names = (0x0048, PRIVILEGE, STREAM_PORT, STREAM_ADDRESS)
    assert client.ask(WRITE, write_of(PRIVILEGE, 0xFF)) == (0, b"\0\0\0\1")
    three = write_of(STREAM_PORT, 7) + write_of(STREAM_ADDRESS, HERE) + write_of(STREAM_PORT, 8)
    assert client.ask(WRITE, three) == (0, b"\0\0\0\3")
    # of the privilege's bits the camera keeps control and exclusive access
    status, body = client.ask(READ, struct.pack(">4I", *names))
    assert (status, body) == (0, b"hils" + struct.pack(">3I", 3, 8, HERE))
    assert len(client.ask(READ, bytes(536))[1]) == 536
    assert client.ask(0x0086, struct.pack(">I8s", NAME, b"bench 7")) == (0, b"\0\0\0\x08")
    refused = [
        (0x0086, struct.pack(">II", PRIVILEGE, 0), GvcpStatus.INVALID_ADDRESS),
        (0x0086, struct.pack(">I", NAME), WRONG),
        (READ_MEMORY, struct.pack(">IHH", DESCRIPTION_AT, 0, 540), WRONG),
        (READ_MEMORY, struct.pack(">IH", DESCRIPTION_AT, 0), WRONG),
        (READ, bytes(6), WRONG),
        (READ, b"", WRONG),
        (WRITE, bytes(4), WRONG),
        (0x0077, b"", GvcpStatus.NOT_IMPLEMENTED),
    ]
    for kind, body, status in refused:
        assert client.ask(kind, body) == (status, b"")
    assert camera.counts == ControlCounts(5 + len(refused), len(refused))
    assert camera.controller == CLIENT
    # a command that wants no answer is obeyed all the same
    quiet = command(WRITE, write_of(STREAM_PORT, 9), number=500, flags=0)
    assert camera.receive(quiet, CLIENT, 0) is None and camera.destination == (CLIENT[0], 9)


def test_a_trigger_whose_answer_was_lost_begins_one_exposure():
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    again = command(WRITE, write_of(ADDRESSES["TriggerSoftware"], 1), number=77)
    answers = [camera.receive(again, CLIENT, 0) for _ in range(3)]
    assert answers[0] is not None and answers == answers[:1] * 3
    assert camera.take_events() == [FeatureCommand("TriggerSoftware")]


def test_packets_are_sent_again_for_the_controller_alone():
    camera = channel()
    Asker(camera).write(PRIVILEGE, CONTROL)
    body = struct.pack(">HHII", 0, 5, 3, 9)
    assert camera.receive(command(RESEND, body, 9, flags=0), OTHER, 0) is None
    assert camera.take_events() == []
    assert camera.receive(command(RESEND, body, 9, flags=0), CLIENT, 0) is None
    assert camera.take_events() == [Resend(5, 3, 9)]


@pytest.mark.parametrize(
    ("last", "sent"), [(4097, 4097), (4098, 4098), (4099, 4098), (0xFF_FFFF, 4098)]
)
def test_one_request_has_4096_packets_at_most(last, sent):
    camera = channel()
    Asker(camera).write(PRIVILEGE, CONTROL)
    body = struct.pack(">HHII", 0, 5, 3, last)
    assert camera.receive(command(RESEND, body, 9, flags=0), CLIENT, 0) is None
    assert camera.take_events() == [Resend(5, 3, sent)]


def test_packets_are_sent_again_to_the_socket_that_takes_the_images():
    """Aravis asks from it, and not from the one that controls."""
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    client.write(STREAM_PORT, OTHER[1])
    body = struct.pack(">HHII", 0, 5, 3, 9)
    assert camera.receive(command(RESEND, body, 9, flags=0), OTHER, 0) is None
    assert camera.take_events() == [Resend(5, 3, 9)]
    assert Asker(camera, OTHER).write(ADDRESSES["TriggerMode"], 1) == GvcpStatus.ACCESS_DENIED


@pytest.mark.parametrize(
    ("feature", "value", "status"),
    [
        ("Width", 32, GvcpStatus.WRITE_PROTECT),
        ("PixelFormat", 0x0110_0003, GvcpStatus.INVALID_PARAMETER),  # Mono10 of a 12 bit detector
        ("PixelFormat", PIXEL_FORMATS["Mono12Packed"].number, GvcpStatus.SUCCESS),
        ("TriggerMode", 2, GvcpStatus.INVALID_PARAMETER),
        ("AcquisitionFrameCount", 0, GvcpStatus.INVALID_PARAMETER),
        ("TriggerSoftware", 0, GvcpStatus.INVALID_PARAMETER),
    ],
)
def test_a_value_that_the_camera_would_not_keep_is_refused(feature, value, status):
    client = Asker(channel())
    client.write(PRIVILEGE, CONTROL)
    assert client.write(ADDRESSES[feature], value) == status


@pytest.mark.parametrize(
    ("feature", "kept", "refused"),
    [
        ("ExposureTime", [10.0, 60e6], [float("nan"), float("inf"), -1.0, 0.0, 9.99, 60.1e6]),
        # of an exposure of 50 ms
        ("AcquisitionFrameRate", [0.01, 20.0], [0.0, 0.0099, 20.001, float("nan")]),
        ("Gain", [0.0, 24.0], [-0.1, 24.1, float("nan")]),
    ],
)
def test_a_number_is_kept_within_its_limits_and_refused_beyond(feature, kept, refused):
    client = Asker(channel())
    client.write(PRIVILEGE, CONTROL)
    before = client.read(ADDRESSES[feature])
    for value in refused:
        assert client.write(ADDRESSES[feature], _word(value)) == GvcpStatus.INVALID_PARAMETER
        assert client.read(ADDRESSES[feature]) == before
    for value in kept:
        assert client.write(ADDRESSES[feature], _word(value)) == 0
        assert client.read(ADDRESSES[feature]) == _word(value)


def test_a_longer_exposure_lowers_the_rate_and_a_rate_beyond_it_is_refused():
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    assert client.write(ADDRESSES["ExposureTime"], _word(1000.0)) == 0
    assert camera.registers.settings.rate_hz == 10.0  # a shorter one does not raise it
    assert client.write(ADDRESSES["ExposureTime"], _word(500_000.0)) == 0
    assert camera.registers.settings.rate_hz == pytest.approx(2.0)
    assert client.write(ADDRESSES["AcquisitionFrameRate"], _word(3.0)) != 0
    assert client.write(ADDRESSES["AcquisitionFrameRate"], _word(1.5)) == 0


def test_a_refused_write_changes_nothing_and_no_heartbeat_is_rounded():
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    several = struct.pack(">IIII", STREAM_PORT, 5123, 2000, 7)  # port, packet size and delay
    assert client.ask(0x0086, several)[0] == GvcpStatus.INVALID_PARAMETER
    assert camera.destination is None and camera.packet_bytes == 1500
    assert client.write(0x0938, 10) == GvcpStatus.INVALID_PARAMETER
    assert client.read(0x0938) == 3000


def test_the_pixel_format_holds_while_images_flow():
    camera = channel()
    client = Asker(camera)
    client.write(PRIVILEGE, CONTROL)
    camera.registers.settings.streaming = True
    number = PIXEL_FORMATS["Mono8"].number
    assert client.write(ADDRESSES["PixelFormat"], number) == GvcpStatus.ACCESS_DENIED


def test_every_feature_of_the_description_is_a_register_that_can_be_read():
    client = Asker(channel())
    root = ElementTree.fromstring(_description(client))
    space = "{http://www.genicam.org/GenApi/Version_1_1}"
    names = {node.get("Name") for node in root}
    listed = {node.text for node in root.iter(f"{space}pFeature")}
    assert listed <= names
    # and each is in a category, without which no client's tree shows it
    for kind in ("Integer", "Float", "Enumeration", "Command", "StringReg"):
        assert {node.get("Name") for node in root.iter(f"{space}{kind}")} <= listed
    for node in root.iter(f"{space}pValue"):
        assert node.text in names
    for node in root.iter(f"{space}Address"):
        client.read(int(node.text or "", 16))
    assert {feature.name for feature in FEATURES} <= names


def test_a_side_has_the_detector_s_limits():
    client = Asker(channel())
    root = ElementTree.fromstring(_description(client))
    space = "{http://www.genicam.org/GenApi/Version_1_1}"
    for name in ("Width", "Height", "OffsetX"):
        node = root.find(f"{space}Integer[@Name='{name}']")
        value = client.read(ADDRESSES[name])
        assert node is not None
        assert [node.findtext(f"{space}{end}") for end in ("Min", "Max")] == [str(value)] * 2


def test_a_packet_s_size_is_the_lower_half_of_its_register_and_a_command_its_bit():
    """GenApi counts the bits of a big-endian register from its highest."""
    root = ElementTree.fromstring(_description(Asker(channel())))
    space = "{http://www.genicam.org/GenApi/Version_1_1}"
    size = root.find(f"{space}MaskedIntReg[@Name='GevSCPSPacketSizeRegister']")
    assert size is not None
    assert [size.findtext(f"{space}{name}") for name in ("MSB", "LSB")] == ["16", "31"]
    values = {
        node.get("Name"): node.findtext(f"{space}CommandValue")
        for node in root.iter(f"{space}Command")
    }
    assert values.pop("GevTimestampControlLatch") == "2"  # GigE Vision's bit 30; bit 31 resets it
    assert values and set(values.values()) == {"1"}


def test_memory_beyond_the_description_is_no_memory():
    client = Asker(channel())
    size = len(_description(client).encode())
    for count, is_there in ((4, True), (8, False)):
        at = DESCRIPTION_AT + -(-size // 4) * 4 - 4
        status, _ = client.ask(READ_MEMORY, struct.pack(">IHH", at, 0, count))
        assert (status == GvcpStatus.SUCCESS) is is_there
    # as many bytes as a datagram of 576 holds beside its heads
    status, body = client.ask(READ_MEMORY, struct.pack(">IHH", DESCRIPTION_AT, 0, 536))
    assert status == GvcpStatus.SUCCESS and len(body) == 4 + 536
    # its last word is filled up with zeros
    camera = CameraSettings(64, 48, 12, exposure_s=0.05, rate_hz=10.0)
    registers = Registers(IDENTITY, camera, b"<xml>")
    assert registers.read(DESCRIPTION_AT, 8) == b"<xml>\0\0\0"
    with pytest.raises(RegisterError):
        registers.read(DESCRIPTION_AT + 8, 4)


def _description(client: Asker) -> str:
    size = int(
        client.ask(READ_MEMORY, struct.pack(">IHH", 0x200, 0, 512))[1][4:]
        .split(b";")[2]
        .split(b"\0")[0],
        16,
    )
    parts = []
    for at in range(0, size, 512):
        count = -(-min(512, size - at) // 4) * 4
        status, body = client.ask(READ_MEMORY, struct.pack(">IHH", DESCRIPTION_AT + at, 0, count))
        assert status == 0
        parts.append(body[4:])
    return b"".join(parts)[:size].decode()


def _word(value: float) -> int:
    return int.from_bytes(struct.pack(">f", value), "big")


KINDS = st.sampled_from([DISCOVER, READ, WRITE, READ_MEMORY, RESEND, 0x0086, 0x0004, 0x00C0])
ADDRESS = st.sampled_from(
    [PRIVILEGE, STREAM_PORT, PACKET_BYTES, STREAM_ADDRESS, 0x938, 0x944, *ADDRESSES.values()]
) | st.integers(0, 2**32 - 1)
WORDS = st.lists(ADDRESS | st.integers(0, 2**32 - 1), max_size=6)


@settings(max_examples=400, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.builds(
                lambda kind, words, number, tail: command(
                    kind, struct.pack(f">{len(words)}I", *words) + tail, number
                ),
                KINDS,
                WORDS,
                st.integers(0, 65535),
                st.binary(max_size=3),
            ),
        ),
        max_size=12,
    ),
    st.lists(st.sampled_from([CLIENT, OTHER, ("192.168.7.7", 9)]), min_size=12, max_size=12),
)
def test_whatever_comes_nothing_is_raised_and_images_go_to_the_controller_alone(datagrams, peers):
    camera = channel()
    for datagram, peer in zip(datagrams, peers, strict=False):
        answer = camera.receive(datagram, peer, 0)
        assert answer is None or len(answer) <= 8 + 540
        if camera.destination is not None:
            assert camera.controller is not None
            assert camera.destination[0] == camera.controller[0]
        settings_now = camera.registers.settings
        assert 0 < settings_now.exposure_s <= 60 and 0 <= settings_now.gain_db <= 24
        assert settings_now.rate_hz * settings_now.exposure_s <= 1 + 1e-5


DENIED, WRONG = GvcpStatus.WRITE_PROTECT, GvcpStatus.INVALID_PARAMETER
NAME, TIME_CONTROL, TIME_HIGH, TIME_LOW = 0x00E8, 0x0944, 0x0948, 0x094C


@pytest.mark.parametrize(
    ("address", "value", "status", "kept"),
    [
        (HEARTBEAT_MS, 499, WRONG, 3000),
        (HEARTBEAT_MS, 500, 0, 500),
        (PACKET_BYTES, 575, WRONG, 1500),
        (PACKET_BYTES, 576, 0, 576),
        (PACKET_BYTES, 9000, 0, 9000),
        (PACKET_BYTES, 9001, WRONG, 1500),
        # that it may not be fragmented is kept, that one is fired is not
        (PACKET_BYTES, 1 << 31 | 1 << 30 | 1 << 29 | 8192, 0, 1 << 30 | 8192),
        (0x0048, 7, DENIED, int.from_bytes(b"hils", "big")),
        (0x0934, 0, DENIED, 1 << 31 | 1 << 30 | 0b111),
        (0x000C, 1, DENIED, int(IDENTITY.address)),
        (DESCRIPTION_AT, 0, DENIED, int.from_bytes(b"<?xm", "big")),
    ],
)
def test_a_register_of_the_standard_takes_what_the_standard_allows(address, value, status, kept):
    asker = Asker(channel())
    asker.write(PRIVILEGE, CONTROL)
    assert asker.write(address, value) == status
    assert asker.read(address) == kept


@pytest.mark.parametrize(
    ("address", "status"),
    [(0x9000_0000, GvcpStatus.INVALID_ADDRESS), (HEARTBEAT_MS + 2, GvcpStatus.BAD_ALIGNMENT)],
)
def test_a_place_that_is_no_register_is_neither_read_nor_written(address, status):
    asker = Asker(channel())
    asker.write(PRIVILEGE, CONTROL)
    assert asker.write(address, 1) == status
    assert asker.ask(READ, struct.pack(">I", address))[0] == status


def test_the_camera_s_time_is_latched_in_two_words_and_never_set_back():
    camera = channel()
    asker = Asker(camera)
    asker.write(PRIVILEGE, CONTROL)
    camera.registers.time_ns = 0x0123_4567_89AB_CDEF
    assert (asker.read(TIME_HIGH), asker.read(TIME_LOW)) == (0, 0)
    assert asker.write(TIME_CONTROL, 2) == 0
    camera.registers.time_ns += 10**12
    assert (asker.read(TIME_HIGH), asker.read(TIME_LOW)) == (0x0123_4567, 0x89AB_CDEF)
    for value in (0, 1, 3):
        assert asker.write(TIME_CONTROL, value) == WRONG
    assert asker.read(TIME_LOW) == 0x89AB_CDEF
    assert (asker.read(0x093C), asker.read(0x0940)) == (0, 10**9)  # ticks a second


def test_a_user_s_name_is_kept_to_its_length_and_a_shorter_one_clears_it():
    asker = Asker(channel())
    asker.write(PRIVILEGE, CONTROL)

    def named(name: bytes) -> int:
        return asker.ask(0x0086, struct.pack(">I", NAME) + name)[0]

    def shown() -> bytes:
        _, body = asker.ask(READ_MEMORY, struct.pack(">IHH", NAME, 0, 16))
        return body[4:]

    assert named(b"sixteen letters!") == 0
    assert shown() == b"sixteen letters!"
    assert named(b"bench 7\0") == 0
    assert shown() == b"bench 7".ljust(16, b"\0")
    assert named(b"seventeen letters!!!") == WRONG
    assert shown() == b"bench 7".ljust(16, b"\0")


@pytest.mark.parametrize(
    ("bits", "pixel_format", "payload_bytes"),
    [(8, "Mono8", 65 * 47), (16, "Mono16", 2 * 65 * 47), (12, "Mono8", 65 * 47)],
)
def test_an_image_s_bytes_are_those_of_its_format(bits, pixel_format, payload_bytes):
    camera = CameraSettings(65, 47, bits, exposure_s=0.05, rate_hz=10.0, pixel_format=pixel_format)
    assert camera.payload_bytes == payload_bytes


def test_a_packed_image_of_an_odd_count_ends_in_a_whole_triple():
    camera = CameraSettings(65, 47, 12, exposure_s=0.05, rate_hz=10.0)
    camera.pixel_format = next(
        name for name, form in PIXEL_FORMATS.items() if form.stored_bits == 12 and form.bits == 12
    )
    assert camera.payload_bytes == 3 * (65 * 47 + 1) // 2


@pytest.mark.parametrize(
    ("bits", "formats"),
    [(8, ["Mono8", "Mono16"]), (12, ["Mono12", "Mono12Packed", "Mono16", "Mono8"])],
)
def test_a_detector_s_own_format_is_the_first(bits, formats):
    camera = CameraSettings(64, 48, bits, exposure_s=0.05, rate_hz=10.0)
    assert camera.pixel_formats() == formats
    assert PIXEL_FORMATS[camera.pixel_format].bits == bits


@pytest.mark.parametrize(
    ("address", "mask"), [("127.0.0.2", 0xFF00_0000), ("10.1.2.3", 0xFFFF_FF00)]
)
def test_a_camera_says_its_address_its_network_and_where_it_is_described(address, mask):
    identity = CameraIdentity(ipaddress.IPv4Address(address), "m" * 40, "v", "serial 7")
    camera = CameraSettings(64, 48, 12, exposure_s=0.05, rate_hz=10.0)
    description = describe(identity.model, camera)
    registers = Registers(identity, camera, description)
    assert registers.word(0x0024) == int(identity.address)
    assert registers.word(0x000C) == int(identity.address)
    assert registers.word(0x0034) == mask
    # the last byte of a text stays 0
    assert registers.read(0x0068, 32) == b"m" * 31 + b"\0"
    assert registers.read(0x00D8, 16) == b"serial 7".ljust(16, b"\0")
    url = registers.read(0x0200, 512).rstrip(b"\0").decode()
    assert url == f"Local:hilstar.xml;{DESCRIPTION_AT:X};{len(description):X}"
    whole = registers.read(DESCRIPTION_AT, len(description) // 4 * 4)
    assert whole == description[: len(whole)]
