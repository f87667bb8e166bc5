"""Which monitor this is: EDIDs of 30 real monitors, 10 000 damaged ones, and how two identities
differ.
"""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from hilstar.basics.reading import parse_toml
from hilstar.basics.toml_tables import toml_text
from hilstar.display.identity import TABLE, MonitorIdentity, differences, edid_identity

SEED, MUTATED = 37, 10_000
THIS = MonitorIdentity(
    maker="DEL", model="U2412M", serial="F00BAR", edid_sha256="a" * 64, connector="DP-1", mode="1920x1200@59.95", bits=8,
    gamma_ramp="straight", brightness=40, contrast=75, colour_preset=5, hours=1200,
)  # fmt: skip


class Known(NamedTuple):
    """A real EDID, and what edid-decode reads in it."""

    block: bytes
    maker: str
    product: int
    made: str
    name: str


def real() -> list[Known]:
    text = Path("tests/data/edids.txt").read_text()
    found = re.findall(r"^# .+?\|(.+)\|(.+)\|(.*)\|(.*)\n([0-9a-f]+)$", text, re.MULTILINE)
    return [
        Known(bytes.fromhex(block), maker, int(product), made, name)
        for maker, product, made, name, block in found
    ]


def read_back(identity: MonitorIdentity) -> MonitorIdentity:
    return msgspec.convert(
        parse_toml(Path("a.toml"), toml_text({TABLE: identity.known()})).get(TABLE, {}),
        MonitorIdentity,
    )


def test_30_real_edids_are_read_as_edid_decode_reads_them():
    known = real()
    assert len(known) == 30
    for one in known:
        found = edid_identity(one.block)
        assert (found.maker, found.model) == (
            one.maker,
            " ".join(one.name.split()) or f"{one.product:04x}",
        )
        made = re.fullmatch(r"(?:week (\d+) of )?(\d{4})", one.made)
        if made:
            assert (found.week, found.year) == (
                None if made[1] is None else int(made[1]),
                int(made[2]),
            )
        assert bool(found.doubt) == (not found.serial)
    assert len({edid_identity(one.block).edid_sha256 for one in known}) == 30


def test_10_000_damaged_blocks_are_read_or_doubted_and_never_taken_for_the_whole_one():
    """Bits turned, bytes drawn anew, blocks cut short or made of noise; every other one with its
    checksum mended.
    """
    drawn, blocks, read = random.Random(SEED), [one.block for one in real()], 0
    for number in range(MUTATED):
        whole = drawn.choice(blocks)
        block = bytearray(whole)
        for _ in range(drawn.choice((1, 2, 8, 64))):
            block[drawn.randrange(128)] = drawn.randrange(256)
        if number % 7 == 0:
            block = bytearray(drawn.randbytes(drawn.choice((0, 1, 127, 128, 256))))
        elif number % 11 == 0:
            del block[drawn.randrange(128) :]
        if number % 2 and len(block) >= 128:
            block[:8] = whole[:8] if number % 4 == 1 else block[:8]
            block[127] = -sum(block[:127]) % 256
        identity = edid_identity(bytes(block))
        read += bool(identity.maker)
        assert identity.maker or "told apart by connector and mode alone" in identity.doubt
        assert list(differences(edid_identity(whole), identity)) or bytes(block) == whole
        if number % 10 == 0:
            assert read_back(identity) == identity
    assert MUTATED / 4 < read < MUTATED  # both ways are taken


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"edid_sha256": "b" * 64, "serial": "F00BAZ"}, ["another monitor"]),
        ({"edid_sha256": "", "serial": "", "maker": ""}, ["another monitor"]),
        (
            {"edid_sha256": "b" * 64},
            ["the same monitor with another EDID (another input, or a setting of its menu)"],
        ),
        ({"connector": "DP-2"}, ["connector DP-1, now DP-2"]),
        ({"mode": "1920x1200@30.00"}, ["mode 1920x1200@59.95, now 1920x1200@30.00"]),
        ({"bits": 10}, ["bits 8, now 10"]),
        ({"gamma_ramp": "c" * 64}, [f"gamma ramp straight, now {'c' * 20}"]),
        ({"brightness": 41, "contrast": 70}, ["brightness 40, now 41", "contrast 75, now 70"]),
        ({"colour_preset": 11}, ["colour preset 5, now 11"]),
        (
            {"window_system": ("a compositing manager",)},
            ["the window system added nothing, and adds a compositing manager now"],
        ),
        ({"hours": 1300}, []),
        ({"brightness": None, "gamma_ramp": ""}, []),
    ],
)
def test_what_differs_is_said_with_both_values(changed, words):
    now = msgspec.structs.replace(THIS, **changed)
    assert list(differences(THIS, now)) == words
    assert read_back(now) == now


PLACEHOLDERS = (
    "01010101", "01010101h", "deadbeef", "0xDEADBEEF", "12345678h", "ABCDEFG", "No Serial", "System Serial",
    "0000000000001", "0x00000000", "0x01010101", "16843009", "N/A", "n/a", "serial", "Serial Number", "demoset-1", "123456789",
    "1234567890", "0123456789", "987654321", "0x88888888", "2290649224", "0x20202020", "XXXXXXXX", "11111111", "none", "-",
    "SN000001", "SERIAL123456", "No. 1", "1010101010", "0xBAADF00D", "PROTOTYPE", "LCD Panel", "HDMI", "Linux #0",
)  # fmt: skip
SERIALS = (
    "F00BAR",
    "CN0ABC1234",
    "SN00042317",
    "S/N 1045387",
    "ABC123",
    "7",
    "16843010",
    "0x01010102",
    "1234567891234",
    "AH1234567",
    "NA4711X",
    "L3CMTF012345",
)


def with_serial_text(text):
    """A real EDID whose number is 0 and whose last descriptor, that of its serial number, holds
    this text.
    """
    block = bytearray(real()[0].block)
    block[12:16] = bytes(4)
    block[108:126] = b"\0\0\0\xff\0" + f"{text}\n".encode()[:13].ljust(13)
    block[127] = -sum(block[:127]) % 256
    return bytes(block)


@pytest.mark.parametrize("text", PLACEHOLDERS)
def test_a_placeholder_is_no_serial_number(text):
    identity = edid_identity(with_serial_text(text))
    assert identity.serial == ""
    assert "has no serial number" in identity.doubt


@pytest.mark.parametrize("text", SERIALS)
def test_a_serial_number_is_kept_as_it_stands(text):
    identity = edid_identity(with_serial_text(text))
    assert identity.serial == text
    assert not identity.doubt


def test_a_number_of_one_byte_repeated_is_no_serial_number():
    for number in (0x88888888, 0x20202020, 0x01010101, 1, 0, 0xFFFFFFFF):
        block = bytearray(with_serial_text("N/A"))
        block[12:16] = number.to_bytes(4, "little")
        block[127] = -sum(block[:127]) % 256
        assert edid_identity(bytes(block)).serial == ""


def test_a_monitor_without_a_serial_number_is_doubted():
    assert not THIS.doubt and THIS.name() == "DEL U2412M, serial F00BAR, on DP-1 at 1920x1200@59.95"
    numberless = msgspec.structs.replace(THIS, serial="")
    assert (
        numberless.doubt
        == "DEL U2412M has no serial number: another one of its kind on DP-1 passes for it"
    )
    assert (
        MonitorIdentity().doubt == "no EDID: the monitor is told apart by connector and mode alone"
    )
    assert edid_identity(b"\0" * 128).doubt.startswith("EDID unreadable")


@pytest.mark.parametrize(("byte", "week"), [(0, None), (1, 1), (54, 54), (55, None), (255, None)])
def test_a_week_is_one_of_54_or_not_known(byte, week):
    """VESA E-EDID 1.4, 3.4.4: 0 is none, and 255 says that the year is the model's."""
    block = bytearray(real()[0].block)
    block[16] = byte
    block[127] = -sum(block[:127]) % 256
    assert edid_identity(bytes(block)).week == week


@pytest.mark.parametrize(
    ("text", "serial"), [("AAA", "AAA"), ("AAAA", ""), ("123", "123"), ("1234", ""), ("CDE", "CDE")]
)
def test_characters_in_a_row_are_a_placeholder_from_four_on(text, serial):
    assert edid_identity(with_serial_text(text)).serial == serial


def test_a_monitor_is_doubted_by_its_maker_or_by_its_edid():
    """One that says its model and no maker has an EDID that cannot be trusted."""
    nameless = MonitorIdentity(model="0a1b", edid_sha256="a" * 64, connector="DP-1")
    assert nameless.doubt.startswith("EDID unreadable: the monitor is told apart by connector")
    named = MonitorIdentity(maker="DEL", edid_sha256="a" * 64, connector="DP-2")
    assert named.doubt.endswith("another one of its kind on DP-2 passes for it")


def test_two_monitors_of_a_kind_without_a_number_are_not_the_same():
    numberless = msgspec.structs.replace(THIS, serial="")
    other = msgspec.structs.replace(numberless, edid_sha256="b" * 64)
    assert list(differences(numberless, other)) == ["another monitor"]
