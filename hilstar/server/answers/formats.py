"""Decodes a tracker's bytes into answers: cuts frames out of a stream, checks and decodes them; no
I/O.

Laws:
1. No bytes that a tracker sends raise an exception. Bytes that are no answer give a
   `RefusedAnswer`, which states the reason.
2. The answers do not depend on how a stream is cut into chunks, as long as no pause lasts PAUSE_NS.
   After such a pause a new frame begins: the buffered bytes are searched for whole frames, and
   dropped.
3. At most MAX_KEPT_BYTES are buffered between chunks.
4. A frame with a wrong checksum is never an answer.
"""

import binascii
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain
from operator import xor
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from cobs import cobs

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import INT64, AnswerPacket, Refusal, checked_sample, decode
from hilstar.attitude.wire.source import Components, Mounting, SentAttitudes
from hilstar.basics.errors import InputError, one_line, printable, shortened
from hilstar.basics.process.user_code import PREFIX, UserCodeError, user_function
from hilstar.basics.units import NS_PER_S
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.bench.config.answers import (
    MAX_FRAME_BYTES,
    AnswersSettings,
    FrameField,
    FrameLength,
    field_format,
)

MAX_KEPT_BYTES = 2 * MAX_FRAME_BYTES
MAX_JSON_BYTES = 65_536  # with the centroids of a thousand stars
# A number beyond its limit is dropped without refusing the answer; a longer mode is cut.
MAX_STARS, MAX_HIP, MAX_MODE_CHARACTERS = 1_000_000, 2**31 - 1, 64
MAX_WIDTH_PX = 1000.0
STAR_BLANKS = (None,) * len(ReportedStar._fields)
PAUSE_NS = NS_PER_S // 10  # after a longer silence on the line a new frame begins
CCSDS_HEADER_BYTES, CCSDS_VERSION_MASK = 6, 0xE0
SLIP_END, SLIP_ESC, SLIP_ESC_END, SLIP_ESC_ESC = b"\xc0", b"\xdb", b"\xdc", b"\xdd"
CHECKSUMS: dict[str, tuple[Callable[[bytes], int], int]] = {
    "crc16-ccitt-false": (lambda data: binascii.crc_hqx(data, 0xFFFF), 2),
    "crc16-xmodem": (lambda data: binascii.crc_hqx(data, 0), 2),
    "crc32": (zlib.crc32, 4),
    "sum8": (lambda data: sum(data) & 0xFF, 1),
    "xor8": (lambda data: reduce(xor, data, 0), 1),
}
MODES = (
    (protocol.ANSWER_BLINDED, "blinded"),
    (protocol.ANSWER_TOO_FEW_STARS, "too few stars"),
    (protocol.ANSWER_LOST_IN_SPACE, "lost in space"),
    (protocol.ANSWER_TRACKING, "tracking"),
)


@dataclass(frozen=True, slots=True)
class RefusedAnswer:
    """Bytes that are no answer: the `reason` in one word (`docs/answers.md` lists them), and the
    `detail`, a line of text for the user.
    """

    reason: str
    detail: str
    raw: bytes = b""


class JsonAnswer(msgspec.Struct, frozen=True):
    """The content of one answer in the tracker's own convention, as a JSON object or a user's
    Python function gives it, and as the other formats are decoded to.

    `t_ns` is on the tracker's clock; `q` has the order and direction of `[answers] convention`;
    `rate` is in rad/s; `centroids` are rows [x_px, y_px, dn, hip, width_px].
    """

    t_ns: int | None = None
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    valid: bool = True
    mode: str | int | None = None
    stars: int | None = None
    rms_arcsec: float | None = None
    centroids: list[list[float | None]] = []


def answer_of(
    sent: SentAttitudes, host_ns: int, raw: bytes, said: JsonAnswer
) -> Answer | RefusedAnswer:
    """The answer with the content `said`, or the refusal of its numbers. `sent` converts the
    tracker's quaternion and rate to hilstar's; `host_ns` is the host time of the last byte.
    """
    t_ns = said.t_ns
    if t_ns is not None and t_ns not in INT64:
        return RefusedAnswer("time", f"t_ns {t_ns} does not fit 64 bits", raw)
    if said.mode is None:
        mode = ""
    else:
        mode = printable(shortened(said.mode, MAX_MODE_CHARACTERS))[:MAX_MODE_CHARACTERS]
    if said.stars is not None and 0 <= said.stars <= MAX_STARS:
        stars = said.stars
    else:
        stars = None
    plain = Answer(
        host_ns,
        raw,
        t_ns,
        None,
        None,
        said.valid,
        mode,
        stars,
        said.rms_arcsec,
        reported_stars(said.centroids),
    )
    # Without a valid attitude a tracker may send any numbers: these are not checked.
    if said.q is None or not said.valid:
        if said.q is None:
            return replace(plain, valid=False)
        return plain
    checked = checked_sample(0, said.q, said.rate)
    if isinstance(checked, Refusal):
        return RefusedAnswer(checked.reason, checked.detail, raw)
    camera = sent.sample(checked)
    return replace(plain, q_icrs_to_cam=camera.q_icrs_to_cam, rate_cam_rad_s=camera.rate_cam_rad_s)


def reported_stars(rows: list[list[float | None]]) -> tuple[ReportedStar, ...]:
    """The stars in rows [x_px, y_px, dn, hip, width_px], whose last three may be missing; rows
    without a finite position are dropped.
    """
    stars = []
    for row in rows:
        x_px, y_px, dn, hip, width_px = [*row, *STAR_BLANKS][: len(STAR_BLANKS)]
        if x_px is None or y_px is None or not (math.isfinite(x_px) and math.isfinite(y_px)):
            continue
        number = None
        if hip is not None and 0 < hip <= MAX_HIP:
            number = int(hip)
        if width_px is not None and not 0 < width_px <= MAX_WIDTH_PX:
            width_px = None
        stars.append(ReportedStar(x_px, y_px, dn, number, width_px))
    return tuple(stars)


# ---- frames out of a stream ----


class Cut(NamedTuple):
    """A piece of a stream: the bytes of a frame, or, if `reason` is not "", bytes that are no
    frame; `detail` says why, for the user.
    """

    body: bytes
    reason: str = ""
    detail: str = ""


class Delimited:
    """Cuts frames that end with a delimiter: COBS, SLIP and lines of text.

    `unstuff` turns the bytes before a delimiter into a frame (ValueError: they are none), `word`
    names a frame in refusals, and `max_bytes` limits its length. A stream may begin within a frame:
    the bytes before the first delimiter are refused only if `whole` says that they are complete.
    """

    def __init__(
        self,
        end: bytes,
        max_bytes: int,
        unstuff: Callable[[bytes], bytes],
        word: str,
        whole: bool = False,
    ) -> None:
        self._end = end
        self._max = max_bytes
        self._unstuff = unstuff
        self._word = word
        self._kept = bytearray()
        self._overlong = False
        self._whole = whole

    def cut(self, chunk: bytes) -> Iterator[Cut]:
        """The frames and refusals that `chunk` completes, in their order."""
        *bodies, rest = chunk.split(self._end)
        for body in bodies:
            self._keep(body)
            buffered = bytes(self._kept)
            overlong = self._overlong
            whole = self._whole
            self._kept.clear()
            self._overlong = False
            self._whole = True
            if overlong:
                yield Cut(buffered, "framing", f"no end of {self._word} within {self._max} bytes")
            elif buffered:
                try:
                    yield Cut(self._unstuff(buffered))
                except ValueError as error:
                    if whole:
                        yield Cut(buffered, "framing", f"not {self._word} ({error})")
        self._keep(rest)

    def _keep(self, part: bytes) -> None:
        room = self._max - len(self._kept)
        self._kept += part[:room]
        self._overlong = self._overlong or len(part) > room


def uncobs(body: bytes) -> bytes:
    """The content of a COBS frame without its delimiter. Raises ValueError if it is not COBS."""
    try:
        return bytes(cobs.decode(body))
    except cobs.DecodeError as error:
        raise ValueError(str(error)) from error


def unslip(body: bytes) -> bytes:
    """The content of a SLIP frame without its delimiter (RFC 1055). Raises ValueError for an escape
    that RFC 1055 does not define.
    """
    first, *others = body.split(SLIP_ESC)
    out = bytearray(first)
    for part in others:
        if part[:1] not in {SLIP_ESC_END, SLIP_ESC_ESC}:
            raise ValueError("an escape before another byte")
        out += (SLIP_END if part[:1] == SLIP_ESC_END else SLIP_ESC) + part[1:]
    return bytes(out)


class Measured:
    """Cuts frames that have no delimiter, by their sync bytes, their length field, a fixed length
    or a Space Packet's header.

    `check` returns what is wrong with a frame's checksum, "" for nothing; `certain` says that
    frames have a checksum. A wrong frame may have begun at the wrong byte: the search goes on at
    its second byte.
    """

    def __init__(
        self, settings: AnswersSettings, check: Callable[[bytes], str], certain: bool
    ) -> None:
        self._sync = b"" if settings.sync_hex is None else bytes.fromhex(settings.sync_hex)
        self._length = settings.length
        self._ccsds = settings.framing == "ccsds"
        self._check = check
        self._certain = certain
        self._kept = bytearray()
        self._silent_bytes = 0  # this many more lost bytes are not reported

    def pause(self) -> Iterator[Cut]:
        """The frames and refusals in the buffered bytes after a pause of the line, and an empty
        buffer: no frame begins at its first byte, or the frame's end is lost.
        """
        # Nothing in these bytes could show that a frame begins at a later one.
        if not self._certain and not self._sync and not self._ccsds:
            self._kept.clear()
        while self._kept:
            yield from self._lose(bytes(self._kept), "its end has not come")
            del self._kept[:1]
            yield from self._cut()

    def cut(self, chunk: bytes) -> Iterator[Cut]:
        """The frames and refusals that `chunk` completes, in their order."""
        # In pieces, so that no more than MAX_KEPT_BYTES are buffered.
        for begin in range(0, len(chunk), MAX_FRAME_BYTES):
            self._kept += chunk[begin : begin + MAX_FRAME_BYTES]
            yield from self._cut()

    def _cut(self) -> Iterator[Cut]:
        """The frames and refusals in the buffered bytes, which leave the buffer with them."""
        buffered = self._kept
        at = 0
        while at < len(buffered):
            if self._sync and not buffered.startswith(self._sync, at):
                sync_place = buffered.find(self._sync, at)
                # The last bytes may be the beginning of sync bytes, so that they stay.
                if sync_place >= 0:
                    beyond = sync_place
                else:
                    beyond = max(at, len(buffered) - len(self._sync) + 1)
                yield from self._lose(bytes(buffered[at:beyond]), "no sync bytes")
                at = beyond
                if sync_place < 0:
                    break
            size = self._size(at)
            if size is None or (size > 0 and at + size > len(buffered)):
                break
            body = bytes(buffered[at : at + size])
            if size <= 0:
                wrong = "a length that no frame has"
            else:
                wrong = self._check(body)
            if wrong and size > 0 and not self._certain:
                wrong = ""
            if wrong:
                yield from self._lose(body or bytes(buffered[at : at + 1]), wrong)
                at += 1
                continue
            self._silent_bytes = 0
            at += size
            yield Cut(body)
        del buffered[:at]

    def _lose(self, raw: bytes, detail: str) -> Iterator[Cut]:
        """Refuse lost bytes `raw`: every wrong checksum after sync bytes; of other losses one for
        as many bytes as a frame has.

        Without sync bytes every byte of a damaged frame is tried as a beginning, and would be
        refused.
        """
        of_checksum = "checksum" in detail
        is_reported = (of_checksum and bool(self._sync)) or self._silent_bytes <= 0
        self._silent_bytes -= 1
        if raw and is_reported:
            self._silent_bytes = len(raw) - 1 if of_checksum else MAX_FRAME_BYTES
            yield Cut(raw, "checksum" if of_checksum else "framing", detail)

    def _size(self, at: int) -> int | None:
        """The length, bytes, of the frame that begins at index `at` of the buffer; 0 where no frame
        can begin there, None where too few bytes have arrived to read its length.
        """
        buffered = self._kept
        if self._ccsds:
            if len(buffered) - at < CCSDS_HEADER_BYTES:
                return None
            # A Space Packet's length field is the number of its data bytes minus one.
            size = CCSDS_HEADER_BYTES + 1 + int.from_bytes(buffered[at + 4 : at + 6], "big")
            if isinstance(self._length, int):
                wanted = self._length
            else:
                wanted = size
            if not buffered[at] & CCSDS_VERSION_MASK and size == wanted and size <= MAX_FRAME_BYTES:
                return size
            return 0
        if not isinstance(self._length, FrameLength):
            return self._length
        end = self._length.at + (field_format(self._length.type) or ("u", 1, False))[1]
        if len(buffered) - at < end:
            return None
        size = (
            int(raw_number(bytes(buffered[at : at + end]), self._length.at, self._length.type))
            + self._length.add
        )
        return size if end <= size <= MAX_FRAME_BYTES else 0


def raw_number(body: bytes, at: int, kind: str) -> int | float:
    """The number of type `kind` (as "u16be", see `[answers] fields`) at byte `at` of a frame.
    Raises IndexError where it extends beyond the frame's end.
    """
    form, size, big = field_format(kind) or ("u", 1, False)
    raw = body[at : at + size]
    if len(raw) < size:
        raise IndexError(f"byte {at + size - 1} of {len(body)}")
    if form == "f":
        (number,) = struct.unpack(f"{'>' if big else '<'}{'f' if size == 4 else 'd'}", raw)
        return float(number)
    return int.from_bytes(raw, "big" if big else "little", signed=form == "i")


class FrameDecoder:
    """Checks and decodes frames whose layout `[answers]` declares."""

    def __init__(self, settings: AnswersSettings) -> None:
        self.settings = settings
        self._matches = [(match.at, bytes.fromhex(match.hex)) for match in settings.match]

    def fault(self, body: bytes) -> str:
        """A line of text on a frame's wrong checksum; "" where it is right, or none is declared."""
        settings = self.settings
        if settings.checksum == "none":
            return ""
        calculate, size = CHECKSUMS[settings.checksum]
        if settings.checksum_at is None:
            at = -size
        else:
            at = settings.checksum_at
        at += len(body) if at < 0 else 0
        if at < settings.checksum_from or at + size > len(body):
            return f"too short for its checksum: {len(body)} bytes"
        stated = int.from_bytes(body[at : at + size], settings.checksum_order)
        wanted = calculate(body[settings.checksum_from : at])
        if stated == wanted:
            return ""
        return f"the {settings.checksum} checksum is {stated:#x}, and {wanted:#x} by the bytes"

    def decoded(self, body: bytes) -> JsonAnswer | RefusedAnswer:
        """The content of a frame, or its refusal: for a wrong checksum, for another kind of frame,
        or for a field beyond its end.
        """
        if fault := self.fault(body):
            return RefusedAnswer("checksum", fault, body)
        if any(body[at : at + len(wanted)] != wanted for at, wanted in self._matches):
            return RefusedAnswer("other", "a frame of another kind ([answers] match)", body)
        try:
            values: dict[str, int | float] = {}
            for field in self.settings.fields:
                values[field.name] = self.value(body, field)
        except IndexError as error:
            return RefusedAnswer("length", f"a field needs {error}", body)
        return said_by(values, body)

    def value(self, body: bytes, field: FrameField) -> int | float:
        """The value of a field after its mask, scale and sum; an int where all of these are whole.
        Raises IndexError where the field extends beyond the frame's end.
        """
        raw = raw_number(body, field.at, field.type)
        # The value is shifted down to the mask's lowest bit.
        if field.mask is not None and isinstance(raw, int):
            raw = (raw & field.mask) >> ((field.mask & -field.mask).bit_length() - 1)
        # In whole numbers, because a time in ns has more digits than a float.
        if isinstance(raw, int) and field.scale.is_integer() and field.add.is_integer():
            return raw * int(field.scale) + int(field.add)
        return raw * field.scale + field.add


def said_by(found: Mapping[str, int | float], body: bytes) -> JsonAnswer | RefusedAnswer:
    """The answer's content from a frame's numbers by field name (`body` is the frame), or the
    refusal of a time that is not finite.
    """
    q = tuple(float(found[name]) for name in ("qw", "qx", "qy", "qz"))
    if "wx" in found:
        rate = tuple(float(found[name]) for name in ("wx", "wy", "wz"))
    else:
        rate = None
    # Each field is rounded to ns by itself, so that large whole seconds do not blur the fraction.
    times_ns = [
        found[name] * unit_ns
        for name, unit_ns in (("t_ns", 1), ("t_s", NS_PER_S), ("t_sub", NS_PER_S))
        if name in found
    ]
    if not all(map(math.isfinite, times_ns)):
        return RefusedAnswer("nan", "its time is not finite", body)
    t_ns = sum(map(round, times_ns)) if times_ns else None
    stars = found.get("stars")
    mode = found.get("mode")
    if not all(number is None or math.isfinite(number) for number in (stars, mode)):
        stars = mode = None
    valid = "valid" not in found or (math.isfinite(found["valid"]) and found["valid"] != 0)
    return JsonAnswer(
        t_ns, (q[0], q[1], q[2], q[3]),
        None if rate is None else (rate[0], rate[1], rate[2]), valid,
        None if mode is None else f"{mode:g}", None if stars is None else int(stars),
    )  # fmt: skip


# ---- the formats ----


class AnswerDecoder:
    """Decodes bytes into answers and refusals, by the format that a bench file names.

    `messages` says that each chunk is a complete message (UDP, ZeroMQ). A Python function's module
    is in `folder` or in a package that `trust` names; raises InputError if it cannot be loaded.
    """

    def __init__(
        self,
        settings: AnswersSettings,
        q_body_to_cam: Components | None,
        messages: bool,
        folder: Path | None = None,
    ) -> None:
        self.settings = settings
        self.q_body_to_cam = q_body_to_cam
        self.sent = SentAttitudes(settings.convention, Mounting(q_body_to_cam))
        self._messages = messages
        self._last_ns = 0
        self.frames = FrameDecoder(settings)
        self._function = _load(settings, folder) if settings.format.startswith(PREFIX) else None
        self._cutter = self._make_cutter()

    def _make_cutter(self) -> Delimited | Measured | None:
        settings = self.settings
        if settings.format == "frame":
            if settings.framing == "cobs":
                return Delimited(b"\0", MAX_KEPT_BYTES, uncobs, "a COBS frame")
            if settings.framing == "slip":
                return Delimited(SLIP_END, MAX_KEPT_BYTES, unslip, "a SLIP frame")
            return Measured(settings, self.frames.fault, certain=settings.checksum != "none")
        if self._messages or self._function is not None:
            return None
        if settings.format == "json":
            return Delimited(b"\n", MAX_JSON_BYTES, bytes.strip, "a line", whole=True)
        return Delimited(b"\0", MAX_KEPT_BYTES, uncobs, "a COBS frame")

    def feed(self, host_ns: int, chunk: bytes) -> list[Answer | RefusedAnswer]:
        """The answers and refusals that `chunk` completes; it arrived at host time `host_ns`."""
        cutter = self._cutter
        if cutter is None:
            return [self._answer(host_ns, statement, chunk) for statement in self._said(chunk)]
        cuts = cutter.cut(chunk + self._end() if self._messages else chunk)
        # A program that appends to a file may pause within a frame for any time.
        if (
            isinstance(cutter, Measured)
            and host_ns - self._last_ns > PAUSE_NS
            and self.settings.source != "file"
        ):
            cuts = chain(cutter.pause(), cuts)
        self._last_ns = host_ns
        answers: list[Answer | RefusedAnswer] = []
        for cut in cuts:
            if cut.reason:
                answers.append(RefusedAnswer(cut.reason, cut.detail, cut.body))
            else:
                answers += [
                    self._answer(host_ns, statement, cut.body) for statement in self._said(cut.body)
                ]
        return answers

    def _end(self) -> bytes:
        """The delimiter that is appended to a message: over UDP or ZeroMQ a frame may come without
        the one that it needs on a line.
        """
        return {"cobs": b"\0", "slip": SLIP_END}.get(self.settings.framing or "", b"")

    def _answer(
        self, host_ns: int, said: JsonAnswer | RefusedAnswer, raw: bytes
    ) -> Answer | RefusedAnswer:
        if isinstance(said, RefusedAnswer):
            return said
        return answer_of(self.sent, host_ns, raw, said)

    def _said(self, body: bytes) -> Iterable[JsonAnswer | RefusedAnswer]:
        if self._function is not None:
            return _of_function(self._function, body)
        if self.settings.format == "frame":
            return [self.frames.decoded(body)]
        if self.settings.format == "json":
            return [_of_json(line) for line in body.splitlines() if line.strip()]
        return [_of_packet(body)]


def _of_packet(body: bytes) -> JsonAnswer | RefusedAnswer:
    """The content of an answer packet of the wire, or its refusal."""
    event = decode(body)
    # The wire's decoder expects an attitude packet: its refusal is reworded for an answer.
    if isinstance(event, Refusal):
        return RefusedAnswer(
            event.reason, event.detail.replace("an attitude of 64", "an answer of 68"), body
        )
    if not isinstance(event, AnswerPacket):
        return RefusedAnswer(
            "format", f"a packet of another kind; send kind {protocol.KIND_ANSWER}", body
        )
    w, x, y, z = event.q_icrs_to_cam
    rx, ry, rz = event.rate_cam_rad_s
    if event.flags & protocol.ANSWER_RATE_VALID:
        rate = (rx, ry, rz)
    else:
        rate = None
    mode = next((word for bit, word in MODES if event.flags & bit), "")
    return JsonAnswer(
        event.t_ns, (w, x, y, z), rate, bool(event.flags & protocol.ANSWER_VALID), mode, event.stars
    )


_json = msgspec.json.Decoder(JsonAnswer)


def _of_json(line: bytes) -> JsonAnswer | RefusedAnswer:
    """The content of a JSON object, or the refusal of a text that is none."""
    if len(line) > MAX_JSON_BYTES:
        return RefusedAnswer(
            "format", f"more than {MAX_JSON_BYTES} bytes of JSON", line[:MAX_FRAME_BYTES]
        )
    try:
        return _json.decode(line)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        # JSON has no such numbers: "nan" tells the user more than the parser's error.
        if b"NaN" in line or b"Infinity" in line:
            return RefusedAnswer("nan", "a number is NaN or Infinity", line)
        return RefusedAnswer("format", f'{error}; write {{"t_ns":..., "q":[w,x,y,z]}}', line)


def _load(settings: AnswersSettings, folder: Path | None) -> Callable[[bytes], Any]:
    try:
        return user_function(settings.format, folder or Path(), settings.trust)
    except UserCodeError as error:
        refusal = f'[answers] format = "{settings.format}": {error}'
        raise InputError(
            f"{one_line(refusal)}; name a module beside the bench file and its function"
        ) from error


def _of_function(
    function: Callable[[bytes], Any], chunk: bytes
) -> Iterator[JsonAnswer | RefusedAnswer]:
    """The answers that a user's function returns for the bytes `chunk`, each a dictionary with the
    keys of `JsonAnswer`; a refusal where it raises or returns anything else.
    """
    try:
        for statement in function(chunk) or ():
            try:
                yield msgspec.convert(statement, JsonAnswer, strict=False, builtin_types=())
            except msgspec.ValidationError as error:
                yield RefusedAnswer("format", f"the function gave {error}", chunk)
    except Exception as error:  # a fault of the user's code must not end the run
        yield RefusedAnswer("python", one_line(f"{type(error).__name__}: {error}"), chunk)
