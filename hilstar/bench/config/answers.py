"""[answers]: where a tracker's answers come from, and what their bytes mean."""

import re
from collections.abc import Iterator
from itertools import chain
from typing import Annotated, Literal

from msgspec import Meta

from hilstar.attitude.wire.endpoint import ALLOW_FORM, AllowedSenders, UdpPlace, bound_place
from hilstar.bench.config.values import NotNegative, Positive, Signed
from hilstar.errors import InputError, shortened
from hilstar.toml_tables import Table

QUATERNION = ("qw", "qx", "qy", "qz")
RATE = ("wx", "wy", "wz")
MAX_FRAME_BYTES = 4096
MAX_POLL_BYTES = 1024
FIELD_TYPE = re.compile(r"([uif])(8|16|24|32|64)(le|be)?")
PLACE_FORM = 'write "HOST:PORT", such as "127.0.0.1:7000"'
TYPES = "u8, i8, u16 to u64, i16 to i64, u24, i24, f32 or f64"
HexBytes = Annotated[str, Meta(pattern=r"^\s*([0-9A-Fa-f]{2}\s*)+$")]
Byte = Annotated[int, Meta(ge=-MAX_FRAME_BYTES, le=MAX_FRAME_BYTES)]


class Convention(Table, frozen=True):
    """What the tracker's quaternion turns into what.

    Compositions are Hamilton's. `hilstar answers --explain` shows an answer under every convention beside what is shown.
    """

    scalar: Annotated[
        Literal["first", "last"],
        Meta(description='Where the scalar of `q` stands, `"first"` or `"last"`, in JSON and in what a Python function gives.'),
    ] = "first"
    direction: Annotated[
        Literal["icrs_to_cam", "cam_to_icrs"],
        Meta(
            description='`"icrs_to_cam"`: it turns ICRS components into the tracker\'s. `"cam_to_icrs"`: the other way round.'
        ),
    ] = "icrs_to_cam"
    frame: Annotated[
        Literal["cam", "body"],
        Meta(description='`"cam"`: the camera\'s axes. `"body"`: the spacecraft\'s, which `[tracker] q_body_to_cam` relates.'),
    ] = "cam"


class FrameField(Table, frozen=True):
    """A number in a frame: raw x scale + add."""

    name: Literal["qw", "qx", "qy", "qz", "t_s", "t_sub", "t_ns", "valid", "mode", "stars", "wx", "wy", "wz"]
    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    type: str
    scale: Signed = 1.0
    add: Signed = 0.0
    mask: Annotated[int, Meta(ge=1, le=2**63 - 1)] | None = None


class FrameLength(Table, frozen=True):
    """A field that says how long its frame is: raw + add bytes, from the frame's first to its last."""

    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    type: str = "u8"
    add: Annotated[int, Meta(ge=-MAX_FRAME_BYTES, le=MAX_FRAME_BYTES)] = 0


class FrameMatch(Table, frozen=True):
    """Bytes by which the frames with an attitude are told from the tracker's others."""

    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    hex: HexBytes


class AnswersSettings(Table, frozen=True):
    """Where the answers of the star tracker come from, and what their bytes mean (see [answers](answers.md)).

    Without this table nobody listens. A process of its own reads, decodes and stamps. At most 500 kB and 200 answers a second
    are taken; what is beyond, and what is no answer, is counted by reason.

    A field of `fields` is `{ name = "qw", at = 6, type = "i32be", scale = 4.656612873077393e-10 }`: `name` is one of qw, qx,
    qy, qz, t_s (s), t_sub (s, added to t_s), t_ns, valid (not 0), mode, stars, wx, wy, wz (rad/s). `at` counts bytes from the
    frame's first, which is that of the sync bytes, or of what SLIP or COBS hold. `type` is u8, i8, u16 to u64, i16 to i64, u24,
    i24, f32 or f64, with `le` (the default) or `be` at its end. The value is raw x `scale` (1) + `add` (0); `mask` takes some
    bits of a whole number, as a number of their own.
    """

    source: Annotated[
        Literal["serial", "udp", "tcp", "zmq", "file"],
        Meta(
            description='The road: a `"serial"` line, `"udp"`, `"tcp"`, `"zmq"`, or a `"file"` to which something appends: '
            "what is appended after the start counts."
        ),
    ]
    format: Annotated[
        str,
        Meta(
            description='`"packet"`: hilstar\'s own (kind 5), as COBS frames over serial lines, TCP and files. `"json"`: an '
            'object a line or a message. `"frame"`: the tracker\'s own telemetry, declared by the keys below. '
            '`"python:MODULE:FUNCTION"`: bytes in, answers out.',
            extra={"form": '"packet", "json", "frame" or "python:MODULE:FUNCTION"'},
        ),
    ] = "packet"
    endpoint: Annotated[
        str | None,
        Meta(
            description="ZeroMQ: the address to which hilstar's SUB socket connects. UDP: `udp://ADDRESS:PORT`, another way to "
            "write `bind`.",
            extra={"default": "`tcp://127.0.0.1:5562` for ZeroMQ"},
        ),
    ] = None
    bind: Annotated[
        bool | str | None,
        Meta(
            description="ZeroMQ: `true` when hilstar binds. UDP: the address and port listened on.",
            extra={"default": '`false`; `"127.0.0.1:5562"` over UDP'},
        ),
    ] = None
    connect: Annotated[
        str | None,
        Meta(
            description='TCP: the tracker\'s `"HOST:PORT"`. UDP: the same, where the tracker has to be asked (`poll_hex`).',
            extra={"default": "none"},
        ),
    ] = None
    listen: Annotated[
        str | None, Meta(description='TCP: where hilstar listens, `"ADDRESS:PORT"`.', extra={"default": "none"})
    ] = None
    path: Annotated[
        str | None,
        Meta(description="File: its path, relative to the bench file.", extra={"default": "none; required for file"}),
    ] = None
    allow: Annotated[
        tuple[str, ...],
        Meta(
            description="UDP, and TCP with `listen`: who may send: addresses and networks.",
            extra={"default": "this machine; required where the address is not loopback", "form": '["ADDRESS", ...]'},
        ),
    ] = ()
    curve_secret_key: Annotated[
        str | None, Meta(description="ZeroMQ: the file of hilstar's own secret key.", extra={"default": "none"})
    ] = None
    curve_server_key: Annotated[
        str | None,
        Meta(
            description="ZeroMQ: the file of the binding side's public key, when hilstar connects.", extra={"default": "none"}
        ),
    ] = None
    allowed_clients: Annotated[
        str | None, Meta(description="ZeroMQ: the directory with the public keys that may connect.", extra={"default": "none"})
    ] = None
    port: Annotated[
        str | int,
        Meta(
            description='Serial: the device, such as `"/dev/ttyUSB0"`. UDP: the port, where `bind` has none.',
            extra={"default": "none; required for serial"},
        ),
    ] = ""
    baud: Annotated[int, Meta(ge=1, le=12_000_000, description="Serial: the speed, 8N1.")] = 115_200
    poll_hex: Annotated[
        HexBytes | None,
        Meta(
            description="What is sent to a tracker that answers only when it is asked, in hexadecimal.",
            extra={"default": "none", "form": '"55 AA 01 ..."'},
        ),
    ] = None
    poll_hz: Annotated[Annotated[float, Meta(ge=0.01, le=1000)], Meta(description="How often that is sent.")] = 10.0
    convention: Annotated[Convention, Meta(description="What the quaternion turns into what.")] = Convention()
    stamp: Annotated[
        Literal["middle", "start", "end", "arrival"],
        Meta(
            description='Where in the exposure the tracker\'s stamp stands: in its `"middle"`, at its `"start"` or `"end"`. '
            '`"arrival"`: it is not used, or there is none.'
        ),
    ] = "middle"
    clock: Annotated[
        Literal["own", "unix", "host"],
        Meta(
            description='The stamps\' clock. `"own"`: the tracker\'s, fitted from the answers. `"unix"`: UTC since 1970, of a '
            'tracker that PTP or NTP disciplines. `"host"`: this machine\'s monotonic clock.'
        ),
    ] = "own"
    latency_ms: Annotated[
        NotNegative | None,
        Meta(
            description="How much later than the middle of its exposure an answer comes, where it is known.",
            extra={"default": "fitted"},
        ),
    ] = None
    wrong_arcsec: Annotated[Positive, Meta(description="An answer further than this from what was lit is a wrong one.")] = (
        3600.0
    )
    framing: Annotated[
        Literal["sync", "slip", "cobs", "fixed", "ccsds"] | None,
        Meta(
            description='How frames are told apart. `"sync"`: by `sync_hex`. `"slip"` (RFC 1055), `"cobs"`. `"fixed"`: each as '
            'long as `length`. `"ccsds"`: Space Packets (133.0-B), by the length in their header.',
            extra={"default": "none; required for frame"},
        ),
    ] = None
    sync_hex: Annotated[
        HexBytes | None, Meta(description="The bytes with which a frame begins.", extra={"default": "none", "form": '"1A CF"'})
    ] = None
    length: Annotated[
        Annotated[int, Meta(ge=1, le=MAX_FRAME_BYTES)] | FrameLength | None,
        Meta(
            description="Bytes of a frame, sync and checksum among them; or the field that says it, "
            '`{ at = 2, type = "u8", add = 5 }`: raw + add.',
            extra={"default": "none; required for sync and fixed", "form": 'N or { at = N, type = "u8", add = N }'},
        ),
    ] = None
    checksum: Annotated[
        Literal["none", "crc16-ccitt-false", "crc16-xmodem", "crc32", "sum8", "xor8"],
        Meta(
            description='A frame\'s checksum: `"crc16-ccitt-false"`, `"crc16-xmodem"`, `"crc32"`, `"sum8"`, `"xor8"`. '
            'With `"none"` a damaged frame may be taken for an answer.'
        ),
    ] = "none"
    checksum_at: Annotated[
        Byte | None, Meta(description="Its first byte; below 0 from the end.", extra={"default": "the end of the frame"})
    ] = None
    checksum_from: Annotated[
        Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)], Meta(description="The first byte that it covers.")
    ] = 0
    checksum_order: Annotated[
        Literal["big", "little"], Meta(description='The order of its bytes, `"big"` or `"little"` end first.')
    ] = "big"
    match: Annotated[
        tuple[FrameMatch, ...],
        Meta(
            description="Bytes that frames with an attitude have; others are counted (`other`) and not decoded.",
            extra={"default": "all frames", "form": '[{ at = N, hex = "21" }, ...]'},
        ),
    ] = ()
    fields: Annotated[
        tuple[FrameField, ...],
        Meta(
            description="The numbers in a frame.",
            extra={"default": "none; required for frame", "form": '[{ name = "qw", at = N, type = "f32be" }, ...]'},
        ),
    ] = ()


def field_format(type_name: str) -> tuple[str, int, bool] | None:
    """Kind ("u", "i", "f"), size in bytes and whether big-endian of a type such as "i32be"; None for no such type."""
    match = FIELD_TYPE.fullmatch(type_name)
    if match is None or (match[1] == "f" and match[2] not in {"32", "64"}):
        return None
    return match[1], int(match[2]) // 8, match[3] == "be"


def answers_place(settings: AnswersSettings) -> tuple[UdpPlace, AllowedSenders]:
    """Where UDP or TCP listens, and who may send. Raises InputError."""
    bind = settings.listen if settings.source == "tcp" else settings.bind
    place = bound_place(bind if bind is not None else "127.0.0.1:5562", settings.port, settings.endpoint)
    allowed = AllowedSenders(settings.allow)
    if not allowed and not place.loopback:
        raise InputError(f"{place} is open to other machines, and allow does not say which may send; {ALLOW_FORM}")
    return place, allowed


def host_and_port(text: str) -> tuple[str, int]:
    """The parts of "HOST:PORT" or "[IPv6]:PORT". Raises InputError."""
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:\[\]/\s]+)):(\d{1,5})", text)
    if match is None or not 0 < int(match[3]) < 65_536:
        raise InputError(f'"{text}" is no place of a tracker; {PLACE_FORM}')
    return match[1] or match[2], int(match[3])


ROADS = {
    "port": ("serial", "udp"),
    "endpoint": ("zmq", "udp"),
    "bind": ("zmq", "udp"),
    "connect": ("tcp", "udp"),
    "listen": ("tcp",),
    "path": ("file",),
    "allow": ("udp", "tcp"),
    "curve_secret_key": ("zmq",),
    "curve_server_key": ("zmq",),
    "allowed_clients": ("zmq",),
    "poll_hex": ("serial", "udp", "tcp"),
}
OF_FRAMES = ("framing", "sync_hex", "length", "match", "fields", "checksum_at")
Faults = Iterator[tuple[bool, str]]  # what is wrong, and what is said of it


def check_answers(settings: AnswersSettings) -> None:
    """Refuse (InputError) keys of another road or format, and what a road or a frame lacks."""
    of_frame = settings.format == "frame"
    for wrong, said in chain(_road_faults(settings), _frame_faults(settings) if of_frame else _format_faults(settings)):
        if wrong:
            raise InputError(said)
    if settings.connect is not None:
        host_and_port(settings.connect)
    elif settings.source == "udp" or settings.listen is not None:
        answers_place(settings)


def _road_faults(settings: AnswersSettings) -> Faults:
    source = settings.source
    for key, roads in ROADS.items():
        said = " or ".join(f'"{road}"' for road in roads)
        given = getattr(settings, key) not in {None, "", ()}
        yield given and source not in roads, f'{key} is for source = {said}; remove it (source = "{source}")'
    no_device = source == "serial" and (not settings.port or isinstance(settings.port, int))
    yield no_device, 'source = "serial" needs port; write port = "/dev/ttyUSB0" or the like'
    yield source == "file" and not settings.path, 'source = "file" needs path; write path = "tracker.bin" or the like'
    one = (settings.connect is None) != (settings.listen is None)
    yield source == "tcp" and not one, f'source = "tcp" needs connect or listen, one of them; {PLACE_FORM}'
    asked = settings.poll_hex is not None
    nobody = source == "udp" and asked and settings.connect is None
    yield nobody, f"poll_hex over UDP needs connect, the tracker's place; {PLACE_FORM}"
    address = isinstance(settings.bind, str) and source == "zmq"
    yield address, f'bind = "{settings.bind}" is for source = "udp"; write true or false, and the address in endpoint'
    too_long = asked and len(bytes.fromhex(settings.poll_hex or "")) > MAX_POLL_BYTES
    yield too_long, f"poll_hex has over {MAX_POLL_BYTES} bytes; write what one question is"


def _format_faults(settings: AnswersSettings) -> Faults:
    form = settings.format
    given = [key for key in OF_FRAMES if getattr(settings, key) not in {None, ()}]
    given += ["checksum"] if settings.checksum != "none" else []
    yield bool(given), f'{"".join(given[:1])} is for format = "frame"; remove it (format = "{form}")'
    known = form in {"packet", "json"} or re.fullmatch(r"python:[\w.]+:\w+", form)
    yield not known, f'format = "{shortened(form)}"; "packet", "json", "frame" or "python:MODULE:FUNCTION" is wanted'


def _frame_faults(settings: AnswersSettings) -> Faults:
    framing, length, form = settings.framing, settings.length, 'format = "frame"'
    yield framing is None, f'{form} needs framing; write framing = "sync", "slip", "cobs", "fixed" or "ccsds"'
    without = (settings.sync_hex is None) == (framing == "sync")
    yield without, 'framing = "sync" needs sync_hex, and no other has it; write sync_hex = "1A CF" or the like'
    loose = framing == "fixed" and not isinstance(length, int)
    yield loose, 'framing = "fixed" needs length, in bytes; write length = 32 or the like'
    endless = framing == "sync" and length is None
    yield endless, 'framing = "sync" needs length; write length = 32, or length = { at = 2, type = "u8", add = 0 }'
    if isinstance(length, FrameLength):
        odd = (field_format(length.type) or "f")[0] != "u"
        yield odd, f'length = {{ type = "{length.type}" }}; u8, u16le, u16be, u32le or u32be is wanted'
    names = [field.name for field in settings.fields]
    twice = [name for name in names if names.count(name) > 1]
    yield bool(twice), f'fields has name = "{"".join(twice[:1])}" twice; write each once'
    missing = [name for name in QUATERNION if name not in names]
    yield bool(missing), f"fields lacks {', '.join(missing)}; write each of qw, qx, qy, qz"
    some = 0 < sum(name in names for name in RATE) < len(RATE)
    yield some, "fields has one or two of wx, wy, wz; write all of them, or none"
    both = "t_ns" in names and ("t_s" in names or "t_sub" in names)
    yield both, "fields has t_ns beside t_s or t_sub; write one kind of time"
    for field in settings.fields:
        kind, size, _ = field_format(field.type) or ("", 0, False)
        where = f"fields: {field.name}"
        yield not kind, f'{where} has type = "{field.type}"; {TYPES} is wanted, with le or be at its end'
        yield field.mask is not None and kind != "u", f"{where} has a mask, which is for u8 to u64; remove it"
        beyond = isinstance(length, int) and field.at + size > length
        yield beyond, f"{where} ends with byte {field.at + size - 1}, and length = {length}; mend one of them"
        yield field.scale == 0, f"{where} has scale = 0; write another number"
