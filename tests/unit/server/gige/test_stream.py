"""The stream of the camera: every DN arrives as it is, in each pixel format."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from hilstar.server.gige.features import PIXEL_FORMATS
from hilstar.server.gige.registers import CameraSettings
from hilstar.server.gige.stream import HEADERS_BYTES, image_block, next_block, packed

RNG = np.random.default_rng(5)


def unpacked_threes(data: bytes, bits: int, count: int) -> np.ndarray:
    """Pixels of GigE Vision's packed formats, from the standard's figure, one by one."""
    low = bits - 8
    values = []
    for first, middle, second in struct.iter_unpack("BBB", data):
        values += [first << low | middle & 0xF, second << low | middle >> 4]
    return np.array(values[:count], np.uint16)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_every_format_of_a_detector_gives_its_dn_back(bits):
    dn = RNG.integers(0, 2**bits, (6, 10), dtype=np.uint16)
    camera = CameraSettings(10, 6, bits, 0.1, 1.0)
    for name in camera.pixel_formats():
        camera.pixel_format = name
        data = packed(dn, bits, name)
        assert len(data) == camera.payload_bytes
        form = PIXEL_FORMATS[name]
        if form.stored_bits == 16:
            values = np.frombuffer(data, "<u2")
        elif form.stored_bits == 8:
            values = np.frombuffer(data, np.uint8)
        else:
            values = unpacked_threes(data, form.bits, dn.size)
        expected = dn >> max(bits - form.bits, 0)
        np.testing.assert_array_equal(values.reshape(dn.shape), expected)


# EMVA's list of PFNC values; the packed ones are GigE Vision's
PFNC = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono10Packed": 0x010C0004,
    "Mono12": 0x01100005,
    "Mono12Packed": 0x010C0006,
    "Mono14": 0x01100025,
    "Mono16": 0x01100007,
}


def test_a_pixel_format_s_number_is_the_convention_s_and_has_the_bits_that_a_pixel_takes():
    numbers = {name: form.number for name, form in PIXEL_FORMATS.items()}
    assert numbers == PFNC
    for form in PIXEL_FORMATS.values():
        assert form.number >> 16 & 0xFF == form.stored_bits


def test_an_odd_number_of_packed_pixels_takes_whole_bytes():
    dn = RNG.integers(0, 4096, (3, 5), dtype=np.uint16)
    camera = CameraSettings(5, 3, 12, 0.1, 1.0, pixel_format="Mono12Packed")
    data = packed(dn, 12, "Mono12Packed")
    assert len(data) == camera.payload_bytes == 24
    np.testing.assert_array_equal(unpacked_threes(data, 12, 15), dn.ravel())


@pytest.mark.parametrize("packet_bytes", [576, 1500, 9000])
def test_a_block_has_leader_data_and_trailer_numbered_from_0(packet_bytes):
    dn = RNG.integers(0, 4096, (48, 64), dtype=np.uint16)
    camera = CameraSettings(64, 48, 12, 0.1, 1.0)
    block = image_block(7, dn, 0x1_2345_6789_ABCD, camera, packet_bytes)
    packets = [b"".join(packet) for packet in block.packets()]
    assert all(len(packet) <= packet_bytes - 28 for packet in packets)
    heads = [struct.unpack(">HHI", packet[:8]) for packet in packets]
    assert [head[2] & 0xFF_FFFF for head in heads] == list(range(len(packets)))
    assert [head[2] >> 24 for head in heads] == [1, *[3] * (len(packets) - 2), 2]
    assert {head[:2] for head in heads} == {(0, 7)}
    _, kind, stamp, form, width, height = struct.unpack(">HHQIII", packets[0][8:32])
    assert (kind, stamp, width, height) == (1, 0x1_2345_6789_ABCD, 64, 48)
    assert form == 0x0110_0005
    data = b"".join(packet[8:] for packet in packets[1:-1])
    np.testing.assert_array_equal(np.frombuffer(data, "<u2").reshape(48, 64), dn)


def test_an_image_that_fills_its_packets_has_no_empty_one_after():
    camera = CameraSettings(64, 48, 8, 0.1, 1.0, pixel_format="Mono8")
    dn = np.zeros((48, 64), np.uint16)
    whole = 64 * 48 // 3
    for data_bytes, packets in ((whole, 3), (whole - 1, 4), (whole + 1, 3)):
        block = image_block(7, dn, 0, camera, data_bytes + HEADERS_BYTES)
        assert block.last == packets + 1
        sizes = [len(b"".join(packet)) - 8 for packet in block.packets()][1:-1]
        assert (len(sizes), sum(sizes), min(sizes) > 0) == (packets, 64 * 48, True)


def test_blocks_are_numbered_from_1_again_after_the_last():
    assert [next_block(number) for number in (0, 1, 0xFFFE, 0xFFFF)] == [1, 2, 0xFFFF, 1]
