"""Which monitor, in which mode and with which settings: what calibration files carry, and how
two of them differ.
"""

import hashlib
import re
import struct
from collections.abc import Iterator
from typing import Any

import msgspec

from hilstar.basics.errors import printable
from hilstar.basics.toml_tables import Table

TABLE = "monitor_identity"  # in a calibration or geometry file
STRAIGHT = "straight"
# What makers write who number nothing: 0, 1, or a number of one byte repeated (0x01010101,
# 0x20202020), which is told
# apart from a count by its size; digits in a row; words, with or without digits behind them.
NO_SERIALS = frozenset({0, 1})
DIGITS_IN_A_ROW = ("01234567890", "12345678901234567890", "9876543210")
LETTERS_IN_A_ROW = ("abcdefghijklmnopqrstuvwxyz", "0123456789abcdef")
SAMPLE_NUMBERS = frozenset({0xDEADBEEF, 0xBAADF00D, 0xCAFEBABE, 0x12345678})
# What stands before a number, and says nothing of it.
LABEL = re.compile(r"(?:serial|sn|no|number|nr)+(?=\d)")
ONE_BYTE = re.compile(r"(..)\1{3,}")  # written as text: 01010101 and longer
MIN_IN_A_ROW = 4  # characters: fewer are a count
SERIAL_BYTES = 4  # of the number in an EDID's head
NO_SERIAL_WORDS = frozenset(
    {
        *(
            "na",
            "none",
            "null",
            "nil",
            "no",
            "unknown",
            "undefined",
            "default",
            "empty",
            "blank",
            "tbd",
        ),
        *("system", "string", "default", "value"),
        *("serial", "serialno", "serialnumber", "sn", "number", "monitor", "display"),
        *("demo", "demoset", "sample", "test", "dummy", "tobefilledbyoem"),
        *("prototype", "engsample", "generic", "panel", "lcd", "hdmi"),
        "linux",  # of the EDIDs that the kernel has built in: "Linux #0"
        *("notavailable", "notapplicable", "notspecified", "notset"),
    }
)
MAX_WEEK = 54  # 0: not stated; 255: the year is the model's (VESA E-EDID 1.4, 3.4.4)
SHOWN_DIGITS = 20  # a SHA-256 in a line; names and modes are shorter
NOT_KNOWN = ("", None, ())
# settings of a MonitorIdentity that change light or time; hours only grow
COMPARED = ("connector", "mode", "bits", "gamma_ramp", "brightness", "contrast", "colour_preset")


class MonitorIdentity(Table, frozen=True):
    """The monitor of a calibration: what it says of itself, how it is connected and driven, and its
    own settings.

    Empty, or None, is what is not known. `gamma_ramp` is "straight" or the SHA-256 of the ramp that
    the window system has set (hilstar's own full-screen window sets a straight one for its time).
    `brightness`, `contrast`, `colour_preset` and `hours` are by DDC/CI; hours are not compared.
    `window_system` has what stands between a frame and the panel, as the start-up gate words it.
    """

    maker: str = ""
    model: str = ""
    serial: str = ""
    week: int | None = None
    year: int | None = None
    edid_sha256: str = ""
    connector: str = ""
    mode: str = ""  # "1920x1080@59.95", px and Hz
    bits: int | None = None
    gamma_ramp: str = ""
    brightness: int | None = None
    contrast: int | None = None
    colour_preset: int | None = None
    hours: int | None = None
    window_system: tuple[str, ...] = ()

    def name(self) -> str:
        """The monitor and its connection for a person."""
        monitor_name = f"{self.maker} {self.model}".strip()
        monitor_name = monitor_name or "a monitor that does not say what it is"
        if self.serial:
            monitor_name += f", serial {self.serial}"
        connector = self.connector or "a connector not known"
        mode = self.mode or "a mode not known"
        return f"{monitor_name}, on {connector} at {mode}"

    @property
    def doubt(self) -> str:
        """Why another monitor could pass for this one; "" where its EDID has a serial number."""
        if self.serial:
            return ""
        if self.maker:
            return (
                f"{self.maker} {self.model} has no serial number: another one of its kind on"
                f" {self.connector} passes for it"
            )
        if self.edid_sha256:
            why = "EDID unreadable"
        else:
            why = "no EDID"
        return f"{why}: the monitor is told apart by connector and mode alone"

    def known(self) -> dict[str, Any]:
        """What is known, by its keys."""
        fields = msgspec.to_builtins(self)
        return {key: value for key, value in fields.items() if value not in NOT_KNOWN}


def edid_identity(edid: bytes) -> MonitorIdentity:
    """What an EDID says (VESA E-EDID 1.4, section 3), with its SHA-256; that alone where it is
    damaged, nothing for none.
    """
    known = MonitorIdentity(edid_sha256=sha256_of(edid))
    if not edid:
        return known
    from pyedid import parse_edid  # 0.1 s, with the HTTP library that it imports

    try:
        edid_fields = parse_edid(edid)
    except (ValueError, struct.error):
        return known
    # pyedid 1.0.3 reads these two numbers the wrong way round.
    product = int.from_bytes(edid[10:12], "little")
    number = int.from_bytes(edid[12:16], "little")
    serial = ""
    if isinstance(edid_fields.serial, str):
        serial = _stated_serial(_plain(edid_fields.serial))
    week = None
    if 0 < edid_fields.week <= MAX_WEEK:
        week = edid_fields.week
    return msgspec.structs.replace(
        known,
        maker=edid_fields.manufacturer_pnp_id,
        model=_plain(edid_fields.name or "") or f"{product:04x}",
        serial=serial or _stated_serial(str(number)),
        week=week,
        year=edid_fields.year,
    )


def _stated_serial(text: str) -> str:
    """The serial number that a text holds; "" where it is a placeholder, which each monitor of
    its kind has.
    """
    alphanumeric = "".join(character for character in text.casefold() if character.isalnum())
    plain = LABEL.sub("", alphanumeric)
    is_placeholder = _is_placeholder_number(plain) or _is_placeholder_word(text, plain)
    if len(plain) >= MIN_IN_A_ROW:
        is_one_character = len(set(plain)) == 1
        is_row = any(plain in row for row in (*DIGITS_IN_A_ROW, *LETTERS_IN_A_ROW))
        is_one_byte = ONE_BYTE.fullmatch(plain) is not None
        is_placeholder = is_placeholder or is_one_character or is_row or is_one_byte
    return "" if is_placeholder else text


def _is_placeholder_number(plain: str) -> bool:
    """Whether a text is a number that is none: in decimal; or in hex, as 0x01010101, 01010101h,
    or its eight digits.
    """
    try:
        if plain.startswith("0x"):
            return _is_no_serial(int(plain[2:], 16))
        if plain.endswith("h"):
            return _is_no_serial(int(plain[:-1], 16))
        is_hex = len(plain) == 2 * SERIAL_BYTES and _is_no_serial(int(plain, 16))
        return is_hex or _is_no_serial(int(plain, 10))
    except ValueError:
        return False


def _is_placeholder_word(text: str, plain: str) -> bool:
    """Whether a text is words that say that there is no number, with or without digits behind
    them.
    """
    letters = "".join(character for character in plain if not character.isdigit())
    if not plain or letters in NO_SERIAL_WORDS:
        return True
    parts = set(re.findall(r"[a-z]+|[0-9]+", LABEL.sub("", text.casefold())))
    return bool(parts) and parts <= NO_SERIAL_WORDS


def _is_no_serial(number: int) -> bool:
    """Whether a number is what makers write who number nothing."""
    size_bytes = (number.bit_length() + 7) // 8
    repeated = number.to_bytes(size_bytes, "little")
    is_known = number in NO_SERIALS or number in SAMPLE_NUMBERS
    return is_known or (size_bytes == SERIAL_BYTES and len(set(repeated)) == 1)


def _plain(text: str) -> str:
    return printable(" ".join(text.replace("\0", "").split()))


def sha256_of(data: bytes) -> str:
    """The SHA-256 of what was read; "" for nothing."""
    return hashlib.sha256(data).hexdigest() if data else ""


def differences(was: MonitorIdentity, now: MonitorIdentity) -> Iterator[str]:
    """How the present monitor differs from the one of a file, in words that give both.

    A setting that one of them does not know is passed over; but a monitor that said what it was,
    and says nothing now, differs.
    """
    if was.edid_sha256 != now.edid_sha256:
        monitor_before = was.maker, was.model, was.serial
        monitor_now = now.maker, now.model, now.serial
        if was.serial and monitor_before == monitor_now:
            yield "the same monitor with another EDID (another input, or a setting of its menu)"
        else:
            yield "another monitor"
    for key in COMPARED:
        before = getattr(was, key)
        after = getattr(now, key)
        if before in NOT_KNOWN or after in NOT_KNOWN or before == after:
            continue
        setting = key.replace("_", " ")
        yield f"{setting} {str(before)[:SHOWN_DIGITS]}, now {str(after)[:SHOWN_DIGITS]}"
    if was.window_system != now.window_system:
        added = ", ".join(was.window_system) or "nothing"
        adds = ", ".join(now.window_system) or "nothing"
        yield f"the window system added {added}, and adds {adds} now"
