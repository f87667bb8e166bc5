"""The syntax and the status model of SCPI-1999 and IEEE 488.2: parses lines into program units, and
has an instrument's registers and error queue; no I/O.

Laws:
1. A line gives units up to its end or its first syntax error (a standard number of the -100s).
   No other exception is raised.
2. A keyword has a short and a long form, in upper or lower case. Nodes in brackets may be omitted.
   A header after `;` continues at the node before the last keyword of the previous header; `:`
   returns to the root, and a common command (`*`) changes nothing.
3. Memory is limited: a line to MAX_LINE_BYTES, the error queue to MAX_ERRORS, of which the last
   then reports the overflow.
4. Bytes that no test stand sends end the connection (`NotScpi`): a web page can make a browser send
   a line of SCPI, but only after the request line of HTTP, or after the first byte of TLS or STUN,
   which is a control character.
"""

import itertools
import math
import re
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

MAX_LINE_BYTES = 4096
MAX_ERRORS = 20
MAX_MNEMONIC = 12  # by IEEE 488.2
MAX_DIGITS = 255  # by IEEE 488.2
HEAD_BYTES, END_BYTES = 128, 64  # stored of a line of any length, to recognise HTTP
MAX_DETAIL = 200  # SCPI-1999 vol. 2, 21.8: 255 characters with the description
NOT_A_NUMBER = "9.91E37"  # SCPI-1999 vol. 1, 7.2.1.5

DESCRIPTIONS = {
    0: "No error",
    -101: "Invalid character",
    -102: "Syntax error",
    -103: "Invalid separator",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -110: "Command header error",
    -112: "Program mnemonic too long",
    -113: "Undefined header",
    -121: "Invalid character in number",
    -123: "Exponent too large",
    -124: "Too many digits",
    -128: "Numeric data not allowed",
    -131: "Invalid suffix",
    -138: "Suffix not allowed",
    -141: "Invalid character data",
    -148: "Character data not allowed",
    -151: "Invalid string data",
    -158: "String data not allowed",
    -168: "Block data not allowed",
    -178: "Expression data not allowed",
    -203: "Command protected",
    -221: "Settings conflict",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -250: "Mass storage error",
    -310: "System error",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
    -365: "Time out error",
}
# Bits of the standard event register (IEEE 488.2, 11.5.1), by the hundreds of an error's number.
OPERATION_COMPLETE = 1
EVENT_BITS = {1: 32, 2: 16, 3: 8, 4: 4}
# Bits of the status byte (IEEE 488.2, 11.2; SCPI-1999 vol. 1, 5.2).
ERRORS_WAIT, QUESTIONABLE, MESSAGE_WAITS, STANDARD_EVENT, MASTER, OPERATION = 4, 8, 16, 32, 64, 128

Kind = Literal["number", "word", "string"]
# The error for a parameter of that kind in the place of another.
KINDS: dict[Kind, int] = {"number": -128, "word": -148, "string": -158}
NODE = re.compile(r"(\[)?:?([A-Za-z*]+)\]?")
HEADER = re.compile(
    r"(\*[A-Za-z][A-Za-z0-9_]*|:?[A-Za-z][A-Za-z0-9_]*(?::[A-Za-z][A-Za-z0-9_]*)*)(\?)?(?:[ \t]+|$)"
)
NUMBER = re.compile(
    r"([+-]?)(\d+(?:\.\d*)?|\.\d+)(?:[ \t]*[Ee][ \t]*([+-]?\d+))?["
    r" \t]*([A-Za-z/%][A-Za-z0-9/.^-]*)?"
)
INTEGER = re.compile(r"#(?:[Hh]([0-9A-Fa-f]+)|[Qq]([0-7]+)|[Bb]([01]+))")
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Control characters other than tab, LF and CR.
CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
WHITE = re.compile(rb"[ \t\r]+")
# A request line of HTTP (RFC 9112, 3): a method in any case, a target, and since HTTP/1.0 a
# version. Either end tells it from SCPI, whose headers have a colon before what follows a blank,
# and whose lines never end with a version.
REQUEST_BEGINS = re.compile(rb"[ \t]*[A-Za-z][A-Za-z0-9_-]*[ \t]+(?:/|[A-Za-z][A-Za-z0-9+.-]*://)")
REQUEST_ENDS = re.compile(rb"[ ]HTTP/\d+(?:\.\d+)?[ ]?\Z", re.IGNORECASE)


class ScpiError(Exception):
    """An error with its standard number (a key of DESCRIPTIONS) and a detail for the user."""

    def __init__(self, number: int, detail: str = "") -> None:
        super().__init__(number, detail)
        self.number = number
        self.detail = detail

    @property
    def text(self) -> str:
        """The answer to `SYST:ERR?`, in printable ASCII: number, description and detail."""
        clean = "".join(
            c if " " <= c <= "~" and c != '"' else "'" if c == '"' else "?" for c in self.detail
        )[:MAX_DETAIL]
        return f'{self.number},"{DESCRIPTIONS[self.number]}{";" if clean else ""}{clean}"'


class Parameter(NamedTuple):
    """One parameter of a command: a number with its suffix (the unit in upper case, "" for none),
    a word in upper case, or a string without its quotes.
    """

    kind: Kind
    text: str
    suffix: str = ""


class Unit(NamedTuple):
    """A command or query: its pattern (such as `SKY:ATTitude?`) and its parameters."""

    pattern: str
    parameters: tuple[Parameter, ...]


class Headers:
    """Parses lines by the headers that an instrument knows, which are given as patterns such as
    `SYSTem:ERRor[:NEXT]?` and `*CLS`.
    """

    def __init__(self, patterns: Iterable[str]) -> None:
        self._patterns = {form: pattern for pattern in patterns for form in _forms(pattern)}

    def units(self, line: str) -> Iterator[Unit]:
        """The program units of a line, which comes without its LF. Raises ScpiError at the first
        wrong one, after those before it.
        """
        path: tuple[str, ...] = ()
        for text in _split(line, ";"):
            text = text.strip(" \t")
            if not text:
                continue
            if any(not " " <= c <= "~" and c != "\t" for c in text):
                raise ScpiError(-101, "only printable ASCII is understood")
            match = HEADER.match(text)
            if match is None:
                raise ScpiError(*_of_header(text))
            name = match[1].upper()
            query = match[2] or ""
            if any(len(mnemonic) > MAX_MNEMONIC for mnemonic in name.lstrip("*:").split(":")):
                raise ScpiError(-112, f"{name[:40]}; a keyword has at most {MAX_MNEMONIC} letters")
            if name.startswith("*"):
                known = self._patterns.get(name + query)
            else:
                nodes = (() if name.startswith(":") else path) + tuple(name.lstrip(":").split(":"))
                name = ":".join(nodes)
                known = self._patterns.get(name + query)
                path = nodes[:-1]
            if known is None:
                raise ScpiError(-113, name[:80] + query)
            rest = text[match.end() :]
            yield Unit(known, tuple(map(_parameter, _split(rest, ","))) if rest else ())


def _forms(pattern: str) -> Iterator[str]:
    """All headers that a pattern allows, in upper case: short, long, without optional nodes."""
    if pattern.startswith("*"):
        yield pattern
        return
    nodes = []
    for optional, name in NODE.findall(pattern.removesuffix("?")):
        forms = {name.upper(), "".join(c for c in name if c.isupper())}
        nodes.append(forms | {""} if optional else forms)
    for chosen in itertools.product(*nodes):
        yield ":".join(filter(None, chosen)) + "?" * pattern.endswith("?")


def _split(text: str, at: str) -> Iterator[str]:
    """The parts of a text between separators `at`; those within a quoted string do not separate.
    Raises ScpiError (-151) for a string without an end.
    """
    quote = ""
    begin = 0
    for k, c in enumerate(text):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'":
            quote = c
        elif c == at:
            yield text[begin:k]
            begin = k + 1
    if quote:
        raise ScpiError(-151, f"a string has no closing {quote.replace(chr(34), 'quotation mark')}")
    yield text[begin:]


def _of_header(text: str) -> tuple[int, str]:
    if text[0] in "*:" or text[0].isalpha():
        return (
            -103 if re.match(r"[*:]?[A-Za-z][A-Za-z0-9_:]*\??[^A-Za-z0-9_:? \t]", text) else -110
        ), text[:40]
    return -102, text[:40]


def _parameter(text: str) -> Parameter:
    text = text.strip(" \t")
    if not text:
        raise ScpiError(-109, "nothing stands between two commas")
    if text[0] in "\"'":
        return Parameter("string", _string(text))
    if text[0] == "#":
        return _by_base(text)
    if text[0] == "(":
        raise ScpiError(-178, text[:40])
    if WORD.fullmatch(text):
        return Parameter("word", text.upper())
    return _decimal(text)


def _by_base(text: str) -> Parameter:
    """A whole number in base 16, 8 or 2, as `#HFF` (IEEE 488.2, 7.7.4). Raises ScpiError."""
    match = INTEGER.fullmatch(text)
    if match is None:
        raise ScpiError(-168, text[:40])
    digits, base = next(
        (each, base) for each, base in zip(match.groups(), (16, 8, 2), strict=True) if each
    )
    if len(digits) > MAX_DIGITS:
        raise ScpiError(-124)
    return Parameter("number", str(int(digits, base)))


def _decimal(text: str) -> Parameter:
    match = NUMBER.fullmatch(text)
    if match is None:
        begins = NUMBER.match(text)
        if begins is None:
            raise ScpiError(-121 if text[0] in "+-." else -141, text[:40])
        raise ScpiError(-103 if text[begins.end() - 1] in " \t" else -121, text[:40])
    sign, mantissa, exponent, suffix = match.groups(default="")
    if len(mantissa) > MAX_DIGITS:
        raise ScpiError(-124)
    if len(exponent) > len("+32000") or abs(int(exponent or 0)) > 32000:
        raise ScpiError(-123)
    return Parameter("number", f"{sign}{mantissa}e{exponent or 0}", suffix.upper())


def _string(text: str) -> str:
    quote = text[0]
    inner = text[1:-1]
    if len(text) < 2 or text[-1] != quote or quote in inner.replace(2 * quote, ""):
        raise ScpiError(-151, text[:40])
    return inner.replace(2 * quote, quote)


def count(unit: Unit, at_least: int, at_most: int | None = None) -> tuple[Parameter, ...]:
    """The parameters of a unit, from `at_least` to `at_most` (None: exactly `at_least`). Raises
    ScpiError for another number of them.
    """
    at_most = at_least if at_most is None else at_most
    if len(unit.parameters) < at_least:
        raise ScpiError(-109, f"{unit.pattern} takes {at_least}")
    if len(unit.parameters) > at_most:
        raise ScpiError(-108, f"{unit.pattern} takes {at_most or 'none'}")
    return unit.parameters


def number(parameter: Parameter, suffix: str = "") -> float:
    """The finite number of a parameter, whose suffix may be "" or `suffix`. Raises ScpiError for
    anything else.
    """
    if parameter.kind != "number":
        raise ScpiError(KINDS[parameter.kind], "write a number")
    if parameter.suffix not in {"", suffix}:
        raise ScpiError(
            -131 if suffix else -138,
            f"{parameter.suffix}{f'; write {suffix}, or nothing' if suffix else ''}",
        )
    value = float(parameter.text)
    if not math.isfinite(value):
        raise ScpiError(-222, "too large")
    return value


def integer(parameter: Parameter, maximum: int) -> int:
    """The number of a parameter, rounded, from 0 to `maximum`. Raises ScpiError for anything
    else.
    """
    value = round(number(parameter))
    if not 0 <= value <= maximum:
        raise ScpiError(-222, f"write 0 to {maximum}")
    return value


def boolean(parameter: Parameter) -> bool:
    """Whether a parameter is ON, or a number that does not round to 0. Raises ScpiError for
    anything but ON, OFF or a number.
    """
    if parameter.kind == "word":
        if parameter.text not in {"ON", "OFF"}:
            raise ScpiError(-224, f"{parameter.text[:40]}; write ON or OFF")
        return parameter.text == "ON"
    return round(number(parameter)) != 0


@dataclass(slots=True)
class Register:
    """A SCPI status register: the present `condition`, the bits that have turned on since the last
    reading (`event`), and the mask of events that the status byte reports (`enable`).
    """

    condition: int = 0
    event: int = 0
    enable: int = 0

    def see(self, condition: int) -> None:
        """Set the present condition; bits that turn on are added to the events."""
        self.event |= condition & ~self.condition
        self.condition = condition

    def read(self) -> int:
        """The events since the last reading; this clears them."""
        event = self.event
        self.event = 0
        return event


@dataclass(slots=True)
class InstrumentStatus:
    """The status of one connection by IEEE 488.2 and SCPI: the error queue, the registers, and
    whether an `*OPC` waits.
    """

    errors: deque[str] = field(default_factory=deque)
    standard: Register = field(default_factory=Register)
    service_enable: int = 0
    operation: Register = field(default_factory=Register)
    questionable: Register = field(default_factory=Register)
    completes: bool = False  # whether `*OPC` waits

    def add(self, error: ScpiError) -> None:
        """Queue an error, and set its bit in the standard event register. In a full queue the last
        error becomes -350 (SCPI-1999).
        """
        self.standard.event |= EVENT_BITS[-error.number // 100]
        if len(self.errors) < MAX_ERRORS:
            self.errors.append(error.text)
        else:
            self.errors[-1] = ScpiError(-350).text
            self.standard.event |= EVENT_BITS[3]

    def next_error(self) -> str:
        """Remove the oldest error from the queue, and return its text; "No error" without one."""
        if self.errors:
            return self.errors.popleft()
        return ScpiError(0).text

    def clear(self) -> None:
        """`*CLS`: clear events and errors; the enable masks stay."""
        self.errors.clear()
        self.standard.event = self.operation.event = self.questionable.event = 0
        self.completes = False

    def preset(self) -> None:
        """`STAT:PRES`: clear the enable masks of the operation and questionable registers."""
        self.operation.enable = self.questionable.enable = 0

    def byte(self, message_waits: bool) -> int:
        """The status byte of `*STB?`; `message_waits` sets its bit of a waiting answer."""
        status_byte = ERRORS_WAIT * bool(self.errors) | MESSAGE_WAITS * message_waits
        status_byte |= STANDARD_EVENT * bool(self.standard.event & self.standard.enable)
        status_byte |= QUESTIONABLE * bool(self.questionable.event & self.questionable.enable)
        status_byte |= OPERATION * bool(self.operation.event & self.operation.enable)
        return status_byte | MASTER * bool(status_byte & self.service_enable)


class NotScpi(Exception):
    """Bytes arrived that no test stand sends: the connection must be closed. The message names
    them.
    """


class LineBuffer:
    """Cuts a stream of bytes into lines, which end with LF; a CR before it is removed."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        # The beginning and the end of the present line, also where it is too long to be stored.
        self._head = b""
        self._end = b""
        self._too_long = False

    def feed(self, data: bytes) -> Iterator[str | None]:
        """The lines that `data` completes; None for one over MAX_LINE_BYTES. Raises NotScpi for
        bytes that no test stand sends.
        """
        *whole, rest = data.split(b"\n")
        for part in whole:
            self._add(part)
            if REQUEST_ENDS.search(self._end):
                raise NotScpi("the request line of HTTP")
            yield None if self._too_long else self._bytes.decode("latin-1").rstrip("\r")
            self._bytes.clear()
            self._head = b""
            self._end = b""
            self._too_long = False
        self._add(rest)

    def _add(self, part: bytes) -> None:
        if CONTROL.search(part):
            raise NotScpi("a control character, as TLS begins with one")
        self._head += part[: HEAD_BYTES - len(self._head)]
        self._end = WHITE.sub(b" ", self._end + part)[-END_BYTES:]
        if REQUEST_BEGINS.match(self._head):
            raise NotScpi("the request line of HTTP")
        self._too_long |= len(self._bytes) + len(part) > MAX_LINE_BYTES
        if self._too_long:
            self._bytes.clear()
        else:
            self._bytes += part
