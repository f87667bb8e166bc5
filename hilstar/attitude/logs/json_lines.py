"""Logs of JSON: each object is the wire's JSON form of an attitude.

The objects stand one a line (JSON lines), over several lines, or in one array, as Python's
`json.dump` of a list writes it: all on one line, however long.
"""

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

import msgspec

from hilstar.attitude.logs.csv_log import CUT_KIND, invalid_notice
from hilstar.attitude.logs.entries import (
    MAX_QUOTED_CHARACTERS,
    LogEntry,
    LogReading,
    Stated,
)
from hilstar.attitude.logs.log_formats import (
    MAX_LOG_BYTES,
    LogFormat,
    LogHead,
    Writing,
    readable,
)
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import JSON_FORM, AttitudeSample, Refusal, decode_json
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import open_lines
from hilstar.basics.text_tables import validity_of_name

JSON_LINES = "JSON lines"  # the format's name
JSON_KEYS = ('"t_ns"', '"q"', '"rate"', '"sequence"', '"discontinuity"')
# Of a key that may say whether an attitude holds, by the words of text tables.
VALIDITY_WORD = re.compile(r"valid|lost", re.IGNORECASE)
VALIDITY = {"true": True, "1": True, "false": False, "0": False}
# An array or an object that begins; "[time]" would be a heading of a table.
ARRAY_BEGINS = re.compile(r"\[(?:\{|\[|\]|$)")
# A whole string, a brace, or the quote of a string that goes on in the next piece.
TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[{}"]')
# A whole string, or one that a file's end cuts.
STRING = re.compile(r'"(?:[^"\\]|\\.)*(?:"|\\?$)')
# A brace that begins no value of an object or an array: an object that follows one without an end.
NO_VALUE = re.compile(r"[^:,\[\s]\s*\{")
# What may stand between objects.
BETWEEN = re.compile(r"[\s,\[\]]*")
MAX_OBJECT_CHARACTERS = 65_536  # an answer with the centroids of a thousand stars
MAX_OBJECT_BYTES = 4 * MAX_OBJECT_CHARACTERS
ADVICE = f"write JSON lines, or an array, of objects {JSON_FORM}"
STARS_KEY = '"centroids"'
STARS_ADVICE = (
    "write centroids as [[x_px, y_px, dn, hip, width_px], ...], null for what is not known"
)
CUT_OBJECT = "the last object has no end, as of a file that was cut off, and is left out"
NO_END = "the array has no ] at its end, as of a file that was cut off; what it has is read"


@contextlib.contextmanager
def read_json(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of JSON. Raises InputError."""
    with open_lines(path, readable(), MAX_LOG_BYTES, whole_lines=False) as pieces:
        notices: list[tuple[str, str]] = []
        reading = of_packets(path, _read_objects(pieces, notices), JSON_LINES, stated)
        yield reading
        # Complete when the last object is read.
        reading.told.extend(notices)


def _read_objects(pieces: Iterable[str], told: list[tuple[str, str]]) -> Iterator[LogEntry]:
    """The attitudes of JSON; at their end `told` gets a notice of those that say `"valid":
    false`, and of an array without an end.
    """
    invalid = 0
    objects = JsonObjects()
    for where, text in objects.split(pieces):
        event = _json_fault(text) or decode_json(text.encode(), MAX_OBJECT_BYTES)
        if isinstance(event, Refusal) and "null" in text and _has_no_quaternion(text):
            # What has no number of JSON is null, as pandas writes NaN.
            event = replace(event, unset=True)
        if VALIDITY_WORD.search(text):
            validity = _validity(text)
            if validity is False:
                invalid += 1
                continue
            if isinstance(validity, Refusal):
                event = validity
        yield LogEntry(where, event)
    if invalid:
        told.append(invalid_notice(invalid, "line"))
    if objects.is_cut:
        told.append((CUT_KIND, CUT_OBJECT))
    elif objects.depth > 0:
        told.append((CUT_KIND, NO_END))


class JsonStars(msgspec.Struct, frozen=True):
    """The stars of a tracker's answer in its JSON form, rows [x_px, y_px, dn, hip, width_px], and
    its time.
    """

    t_ns: int
    centroids: list[list[float | None]] = []


def json_stars(path: Path) -> dict[int, list[list[float | None]]]:
    """The stars of a log's objects that have any, by `t_ns`. Raises InputError for `centroids` of
    another form.
    """
    stars: dict[int, list[list[float | None]]] = {}
    with open_lines(path, readable(), MAX_LOG_BYTES, whole_lines=False) as pieces:
        for where, text in JsonObjects().split(pieces):
            if STARS_KEY not in text:
                continue
            try:
                answer = msgspec.json.decode(text, type=JsonStars)
            except msgspec.MsgspecError as error:
                raise InputError(f"{path}{where}: {error}; {STARS_ADVICE}") from error
            stars[answer.t_ns] = answer.centroids
    return stars


class JsonObjects:
    """Splits JSON into the texts of its objects; `depth` is that of the arrays around them, and
    `is_cut` whether the file ended within the last object, which is left out.
    """

    def __init__(self) -> None:
        self.depth = 0
        self.is_cut = False
        self._count = 0
        # The line of what is read, and the one on which what waits began.
        self._line = 1
        self._first_line = 1

    def split(self, pieces: Iterable[str]) -> Iterator[tuple[str, str]]:
        """Each object with its place (":12"), and what else stands between objects, as it is."""
        waiting = ""
        for piece in pieces:
            ends_line = piece.endswith(("\n", "\r"))
            text = waiting + piece
            place = self._next_object(text, 0)
            while end := _end_of_object(text, place, ends_line):
                yield self._where(), text[place:end].strip()
                place = self._next_object(text, end)
            waiting = text[place:]
            if len(waiting) > MAX_OBJECT_CHARACTERS:
                break
            self._line += ends_line
            if not waiting:
                self._first_line = self._line
        if self._is_cut_off(waiting):
            self.is_cut = True
        elif waiting:
            yield self._where(), waiting.strip()

    def _is_cut_off(self, waiting: str) -> bool:
        """Whether what is left is one object that a cut file ends in. One without an end between
        others has their keys or their braces, too, and is refused.
        """
        is_begun = self._count > 0 and waiting.startswith("{")
        is_short = len(waiting) <= MAX_OBJECT_CHARACTERS
        if not (is_begun and is_short):
            return False
        has_key_twice = any(waiting.count(key) > 1 for key in JSON_KEYS)
        return not has_key_twice and NO_VALUE.search(STRING.sub('""', waiting)) is None

    def _next_object(self, text: str, place: int) -> int:
        """The place of what follows the commas, blanks and brackets from a place on."""
        between = BETWEEN.match(text, place)
        assert between is not None
        end = between.end()
        self.depth += text.count("[", place, end) - text.count("]", place, end)
        if end > place:
            self._first_line = self._line
        return end

    def _where(self) -> str:
        self._count += 1
        # All of an array may stand on one line.
        return f":{self._first_line}" + (f", object {self._count}" if self.depth > 0 else "")


def _end_of_object(text: str, place: int, ends_line: bool) -> int:
    """Where the object at a place ends, or the line of what is none; 0 where that is to come."""
    if not text.startswith("{", place):
        has_line = ends_line and place < len(text)
        return len(text) if has_line else 0
    depth = 0
    for token in TOKEN.finditer(text, place):
        if token[0] == '"':
            return 0
        if token[0] == "{":
            depth += 1
        elif token[0] == "}":
            depth -= 1
        if depth == 0:
            return token.end()
    return 0


def _json_fault(text: str) -> Refusal | None:
    """What msgspec would not say of an object: that it is none, or too long to be an attitude, or
    has a key twice (it takes the last).
    """
    if not text.startswith("{"):
        quoted = text[:MAX_QUOTED_CHARACTERS]
        return Refusal("format", f"{quoted!r} is no JSON object; {ADVICE}")
    if len(text) > MAX_OBJECT_CHARACTERS:
        long = f"a JSON object of over {MAX_OBJECT_CHARACTERS} characters, or one without an end"
        return Refusal("format", f"{long}; {ADVICE}")
    for key in JSON_KEYS:
        if text.count(key) > 1:
            twice = f"key {key} is there twice"
            if text.count("{") > 1:
                twice += " (an object without an end, or with others within it)"
            return Refusal("format", f"{twice}; write each once")
    return None


def _validity(text: str) -> bool | Refusal:
    """Whether an object says that its attitude is valid. A program may write the word as a
    string.
    """
    try:
        keys = msgspec.json.decode(text, type=dict[str, object])
    except msgspec.MsgspecError:
        return True  # refused by `decode`
    holds = True
    for key, stated in keys.items():
        meaning = validity_of_name(key)
        if meaning is None:
            continue
        word = str(stated).lower()
        if word not in VALIDITY:
            return Refusal("format", f"{key} is {shortened(stated)!r}; write true or false")
        holds = holds and VALIDITY[word] == meaning
    return holds


def _has_no_quaternion(text: str) -> bool:
    """Whether an object has null in place of its quaternion, or of each of its numbers."""
    try:
        q = msgspec.json.decode(text, type=dict[str, object]).get("q", 0)
    except msgspec.MsgspecError:
        return False
    return q in (None, [None] * 4)


def _write_json_lines(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    encoder = msgspec.json.Encoder()
    for sample in samples:
        form: dict[str, object] = {"t_ns": sample.t_ns, "q": sample.q_icrs_to_cam.tolist()}
        if sample.rate_cam_rad_s is not None:
            form["rate"] = sample.rate_cam_rad_s.tolist()
        form |= {"sequence": sample.sequence, "discontinuity": sample.discontinuity}
        file.write(encoder.encode(form) + b"\n")


def _begins(beginning: LogHead) -> bool:
    word = beginning.word
    return word.startswith("{") or ARRAY_BEGINS.match(word) is not None


log_format = LogFormat(
    JSON_LINES,
    read_json,
    listed=JSON_LINES,
    uses=LIKE_PACKETS,
    begins=_begins,
    endings=(".jsonl", ".json"),
    write=_write_json_lines,
)
