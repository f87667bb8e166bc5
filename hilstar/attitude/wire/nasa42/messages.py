"""The text that 42 sends: bytes in, a body's attitude out for each message; no I/O.

A message is lines of text: `TIME YYYY-DDD-hh:mm:ss.sssssssss` (UTC), then `NAME = [a b c]` for each variable with one of the
prefixes in Inp_IPC.txt, then `[ENDMSG]`. Until 2025 there were no brackets around the values, and `[EOF]` ended a message: both
are read. (42's own Source/AutoCode/TxRxIPC.c and, before that, Source/IPC/SimWriteToSocket.c.)

Laws:
1. However the bytes are cut into chunks, the messages are the same.
2. Each message gives exactly one event, an attitude or a `Refusal`; nothing raises.
3. At most MAX_MESSAGE_BYTES are kept of a message that does not end.
"""

from __future__ import annotations

import re
from datetime import date

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.attitude.wire.source import Conventions, Mounting, components
from hilstar.errors import InputError, shortened
from hilstar.units import NS_PER_S

MAX_MESSAGE_BYTES = 65_536  # 42's own buffer holds 16 384
TOO_LONG = b""
END = re.compile(rb"^\[(?:ENDMSG|EOF)\][^\n]*\n", re.MULTILINE)
TIME = re.compile(r"^TIME +(\d{4})-(\d{1,3})-(\d{1,2}):(\d{1,2}):(\d{1,2})(?:\.(\d{1,9})\d*)?\s*$", re.MULTILINE)
SPACECRAFT = re.compile(r"(?:SC\[)?(\d{1,3})\]?")
EPOCH_DAY = date(1970, 1, 1).toordinal()
SECONDS_PER_DAY = 86_400
SHOWN_CHARACTERS = 60


def written(q_icrs_to_body: FloatArray) -> str:
    """A body's attitude as 42 writes it: scalar last, of opposite sign to a Hamilton quaternion that turns N into B."""
    w, x, y, z = q_icrs_to_body
    return f"qn = {components(np.array([-x, -y, -z, w]))}"


CONVENTIONS = Conventions(
    "NASA's 42",
    "SC[i].B[0].qn is the attitude of body 0 in N, wn its rate in body components; N is taken as the ICRS, which holds (within"
    " 23 mas) where the reference orbit is about the Earth: about any other world 42's N is that world's own equator",
    "scalar last (x, y, z, w); as a Hamilton quaternion it turns body components into those of N",
    "UTC, every day of 86400 s, from 1970-01-01",
    of_body=True,
    written=written,
)


def spacecraft_number(name: str | int | None) -> int:
    """The number of the spacecraft that 0 or "SC[0]" names; 0 for None. Raises InputError."""
    match = SPACECRAFT.fullmatch(str(0 if name is None else name))
    if match is None:
        raise InputError(f'spacecraft = "{shortened(name)}": write 42\'s number of it, such as spacecraft = "SC[0]"')
    return int(match[1])


class MessageSplitter:
    """Bytes in, whole messages out, each with the line that ends it; TOO_LONG in the place of one that is."""

    def __init__(self) -> None:
        self._kept = bytearray()
        self._line = 0  # where its last line begins: what is before it was looked at
        self._overlong = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """The messages that `chunk` completes, in order."""
        messages: list[bytes] = []
        self._kept += chunk
        if b"\n" in chunk:
            while (end := END.search(self._kept, self._line)) is not None:
                overlong = self._overlong or end.end() > MAX_MESSAGE_BYTES
                messages.append(TOO_LONG if overlong else bytes(self._kept[: end.end()]))
                del self._kept[: end.end()]
                self._line, self._overlong = 0, False
            self._line = self._kept.rfind(b"\n") + 1
        if len(self._kept) > MAX_MESSAGE_BYTES:
            # The last line may be the beginning of the end.
            self._overlong, self._kept, self._line = True, self._kept[self._line :][:MAX_MESSAGE_BYTES], 0
        return messages


class MessageReader:
    """Decodes the messages for one spacecraft; `sequence` counts them."""

    def __init__(self, spacecraft: int, mounting: Mounting) -> None:
        self._mounting = mounting
        self._name = f"SC[{spacecraft}].B[0]"
        # The spacecraft's own qn and wn are those of its body 0; versions until 2025 do not send them.
        names = "|".join(re.escape(name) for name in (self._name, f"SC[{spacecraft}]"))
        self._line = re.compile(rf"^(?:{names})\.(qn|wn) *= *\[?([^\]\n]*)\]?\s*$", re.MULTILINE)
        self._sequence = 0

    def decode(self, message: bytes) -> AttitudeSample | Refusal:
        """The camera's attitude that a whole message holds, or why there is none."""
        self._sequence += 1
        if message == TOO_LONG:
            return Refusal("format", f"a message of over {MAX_MESSAGE_BYTES} bytes; write fewer prefixes in Inp_IPC.txt")
        text = message.decode("latin-1")
        t_ns = _time_ns(text)
        if t_ns is None:
            return Refusal("format", f"no TIME YYYY-DDD-hh:mm:ss, but {text[:SHOWN_CHARACTERS]!r}")
        found = {name: _numbers(values) for name, values in self._line.findall(text)}
        if "qn" not in found:
            return Refusal("format", f'no {self._name}.qn; write the prefix "{self._name}" in Inp_IPC.txt')
        q, rate = found["qn"], found.get("wn", ())
        if q is None or len(q) != 4 or rate is None or len(rate) not in {0, 3}:
            return Refusal("format", f"{self._name}.qn must have four numbers, and wn three")
        x, y, z, w = q
        body = checked_sample(t_ns, (w, -x, -y, -z), tuple(rate) or None, self._sequence)
        return body if isinstance(body, Refusal) else self._mounting.sample(body)


def _numbers(text: str) -> tuple[float, ...] | None:
    try:
        return tuple(float(word) for word in text.split())
    except ValueError:
        return None


def _time_ns(text: str) -> int | None:
    """Nanoseconds since 1970-01-01, every day of 86400 s; None where no time is written."""
    match = TIME.search(text)
    if match is None:
        return None
    year, day_of_year, hour, minute, second = (int(part) for part in match.groups()[:5])
    if not (year >= 1 and 1 <= day_of_year <= 366 and hour < 24 and minute < 60 and second <= 60):
        return None
    days = date(year, 1, 1).toordinal() - 1 + day_of_year - EPOCH_DAY
    seconds = days * SECONDS_PER_DAY + hour * 3600 + minute * 60 + second
    return seconds * NS_PER_S + int((match[6] or "").ljust(9, "0"))
