"""[answers]: where a tracker's answers come from, and what their bytes mean."""

import re
from collections.abc import Iterator
from itertools import chain
from typing import Annotated, Literal

from msgspec import Meta

from hilstar.attitude.wire.endpoint import ALLOW_FORM, AllowedSenders, UdpPlace, bound_place
from hilstar.attitude.wire.source import HILSTARS, Convention
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.values import NotNegative, Positive, Signed

QUATERNION = ("qw", "qx", "qy", "qz")
RATE = ("wx", "wy", "wz")
MAX_FRAME_BYTES = 4096
MAX_POLL_BYTES = 1024
FIELD_TYPE = re.compile(r"([uif])(8|16|24|32|64)(le|be)?")
PLACE_FORM = 'write "HOST:PORT", such as "127.0.0.1:7000"'
TYPES = "u8, i8, u16 to u64, i16 to i64, u24, i24, f32 or f64"
HexBytes = Annotated[str, Meta(pattern=r"^\s*([0-9A-Fa-f]{2}\s*)+$")]
Byte = Annotated[int, Meta(ge=-MAX_FRAME_BYTES, le=MAX_FRAME_BYTES)]
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


class FrameField(Table, frozen=True):
    """A number in a frame: raw x scale + add."""

    name: Literal[
        "qw", "qx", "qy", "qz", "t_s", "t_sub", "t_ns", "valid", "mode", "stars", "wx", "wy", "wz"
    ]
    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    type: str
    scale: Signed = 1.0
    add: Signed = 0.0
    mask: Annotated[int, Meta(ge=1, le=2**63 - 1)] | None = None


class FrameLength(Table, frozen=True):
    """A field that says how long its frame is: raw + add bytes, from the frame's first to its
    last.
    """

    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    type: str = "u8"
    add: Annotated[int, Meta(ge=-MAX_FRAME_BYTES, le=MAX_FRAME_BYTES)] = 0


class FrameMatch(Table, frozen=True):
    """Bytes by which the frames with an attitude are told from the tracker's others."""

    at: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)]
    hex: HexBytes


class AnswersSettings(Table, frozen=True):
    """Where the answers of the star tracker come from, and what their bytes mean (see
    [answers](answers.md)).
    """

    #: The road: a `"serial"` line, `"udp"`, `"tcp"`, `"zmq"`, or a `"file"` to which something
    #: appends: what is appended after the start counts.
    source: Literal["serial", "udp", "tcp", "zmq", "file"]
    #: `"packet"`: hilstar's own (kind 5). `"json"`: an object a line or a message. `"frame"`:
    #: declared by the keys below. `"python:..."`: bytes in, answers out ([what
    #: runs](bench-pc.md#what-a-file-can-run)).
    format: Annotated[
        str, Meta(extra={"form": '"packet", "json", "frame" or "python:MODULE:FUNCTION"'})
    ] = "packet"
    #: `"python:..."`: installed packages that MODULE may belong to, as well as to the bench file's
    #: folder (see
    #: [what runs](bench-pc.md#what-a-file-can-run)).
    trust: Annotated[tuple[str, ...], Meta(extra={"form": '["PACKAGE", ...]'})] = ()
    #: ZeroMQ: the address to which hilstar's SUB socket connects. UDP: `udp://ADDRESS:PORT`,
    #: another way to write `bind`. Default: `tcp://127.0.0.1:5562` for ZeroMQ
    endpoint: str | None = None
    #: ZeroMQ: `true` when hilstar binds. UDP: the address and port listened on. Default: `false`;
    #: `"127.0.0.1:5562"` over UDP
    bind: bool | str | None = None
    #: TCP: the tracker's `"HOST:PORT"`. UDP: the same, where the tracker has to be asked
    #: (`poll_hex`). Default: none
    connect: str | None = None
    listen: str | None = None  #: TCP: where hilstar listens, `"ADDRESS:PORT"`. Default: none
    #: File: its path, relative to the bench file. Default: none; required for file
    path: str | None = None
    #: UDP, and TCP with `listen`: who may send: addresses and networks. Default: this machine;
    #: required where the address is not loopback
    allow: Annotated[tuple[str, ...], Meta(extra={"form": '["ADDRESS", ...]'})] = ()
    #: ZeroMQ: the file of hilstar's own secret key. Default: none
    curve_secret_key: str | None = None
    #: ZeroMQ: the file of the binding side's public key, when hilstar connects. Default: none
    curve_server_key: str | None = None
    #: ZeroMQ: the directory with the public keys that may connect. Default: none
    allowed_clients: str | None = None
    #: Serial: the device, such as `"/dev/ttyUSB0"`. UDP: the port, where `bind` has none. Default:
    #: none; required for serial
    port: str | int = ""
    baud: Annotated[int, Meta(ge=1, le=12_000_000)] = 115_200  #: Serial: the speed, 8N1.
    #: What is sent to a tracker that answers only when it is asked, in hexadecimal. Default: none
    poll_hex: Annotated[HexBytes | None, Meta(extra={"form": '"55 AA 01 ..."'})] = None
    poll_hz: Annotated[float, Meta(ge=0.01, le=1000)] = 10.0  #: How often that is sent.
    convention: Convention = HILSTARS
    #: Where in the exposure the tracker's stamp stands: in its `"middle"`, at its `"start"` or
    #: `"end"`. `"arrival"`: it is not used, or there is none.
    stamp: Literal["middle", "start", "end", "arrival"] = "middle"
    #: The stamps' clock. `"own"`: the tracker's, fitted from the answers. `"unix"`: UTC since 1970,
    #: of a tracker that PTP or NTP disciplines. `"host"`: this machine's monotonic clock.
    clock: Literal["own", "unix", "host"] = "own"
    #: How much later than the middle of its exposure an answer comes, where it is known. Default:
    #: fitted
    latency_ms: NotNegative | None = None
    #: An answer further than this from what was lit is a wrong one.
    wrong_arcsec: Positive = 3600.0
    #: How frames are told apart: by `sync_hex`; SLIP (RFC 1055); COBS; all of one `length`; or
    #: CCSDS Space Packets (133.0-B). Default: none; required for frame
    framing: Literal["sync", "slip", "cobs", "fixed", "ccsds"] | None = None
    #: The bytes with which a frame begins. Default: none
    sync_hex: Annotated[HexBytes | None, Meta(extra={"form": '"1A CF"'})] = None
    #: Bytes of a frame, sync and checksum among them; or the field that says it, `{ at = 2, type =
    #: "u8", add = 5 }`: raw + add. Default: none; required for sync and fixed
    length: Annotated[
        Annotated[int, Meta(ge=1, le=MAX_FRAME_BYTES)] | FrameLength | None,
        Meta(extra={"form": 'N or { at = N, type = "u8", add = N }'}),
    ] = None
    #: A frame's checksum: `"crc16-ccitt-false"`, `"crc16-xmodem"`, `"crc32"`, `"sum8"`, `"xor8"`.
    #: With `"none"` a damaged frame may be taken for an answer.
    checksum: Literal["none", "crc16-ccitt-false", "crc16-xmodem", "crc32", "sum8", "xor8"] = "none"
    #: Its first byte; below 0 from the end. Default: the end of the frame
    checksum_at: Byte | None = None
    #: The first byte that it covers.
    checksum_from: Annotated[int, Meta(ge=0, lt=MAX_FRAME_BYTES)] = 0
    #: The order of its bytes, `"big"` or `"little"` end first.
    checksum_order: Literal["big", "little"] = "big"
    #: Bytes that frames with an attitude have; others are counted (`other`) and not decoded.
    #: Default: all frames
    match: Annotated[
        tuple[FrameMatch, ...], Meta(extra={"form": '[{ at = N, hex = "21" }, ...]'})
    ] = ()
    #: The numbers in a frame. Default: none; required for frame
    fields: Annotated[
        tuple[FrameField, ...],
        Meta(extra={"form": '[{ name = "qw", at = N, type = "f32be" }, ...]'}),
    ] = ()


def field_format(type_name: str) -> tuple[str, int, bool] | None:
    """Kind ("u", "i", "f"), size in bytes and whether big-endian of a type such as "i32be"; None
    for no such type.
    """
    match = FIELD_TYPE.fullmatch(type_name)
    if match is None or (match[1] == "f" and match[2] not in {"32", "64"}):
        return None
    return match[1], int(match[2]) // 8, match[3] == "be"


def answers_place(settings: AnswersSettings) -> tuple[UdpPlace, AllowedSenders]:
    """Where UDP or TCP listens, and who may send. Raises InputError."""
    bind = settings.listen if settings.source == "tcp" else settings.bind
    place = bound_place(
        bind if bind is not None else "127.0.0.1:5562", settings.port, settings.endpoint
    )
    allowed = AllowedSenders(settings.allow)
    if not allowed and not place.loopback:
        raise InputError(
            f"{place} is open to other machines, and allow does not say which may send;"
            f" {ALLOW_FORM}"
        )
    return place, allowed


def host_and_port(text: str) -> tuple[str, int]:
    """The parts of "HOST:PORT" or "[IPv6]:PORT". Raises InputError."""
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:\[\]/\s]+)):(\d{1,5})", text)
    if match is None or not 0 < int(match[3]) < 65_536:
        raise InputError(f'"{text}" is no place of a tracker; {PLACE_FORM}')
    return match[1] or match[2], int(match[3])


Faults = Iterator[tuple[bool, str]]  # what is wrong, and what is said of it


def check_answers(settings: AnswersSettings) -> None:
    """Refuse (InputError) keys of another road or format, and what a road or a frame lacks."""
    of_frame = settings.format == "frame"
    of_python = settings.format.startswith("python:")
    if settings.trust and not of_python:
        raise InputError(
            'trust is for format = "python:MODULE:FUNCTION"; remove it (format ='
            f' "{shortened(settings.format)}")'
        )
    for package in settings.trust:
        if not package.isidentifier():
            raise InputError(
                f'trust = ["{shortened(package)}"]: no name of a package; write what `import` takes'
            )
    for wrong, fault in chain(
        _road_faults(settings), _frame_faults(settings) if of_frame else _format_faults(settings)
    ):
        if wrong:
            raise InputError(fault)
    if settings.connect is not None:
        host_and_port(settings.connect)
    elif settings.source == "udp" or settings.listen is not None:
        answers_place(settings)


def _road_faults(settings: AnswersSettings) -> Faults:
    source = settings.source
    for key, roads in ROADS.items():
        roads_text = " or ".join(f'"{road}"' for road in roads)
        given = getattr(settings, key) not in {None, "", ()}
        yield (
            given and source not in roads,
            f'{key} is for source = {roads_text}; remove it (source = "{source}")',
        )
    no_device = source == "serial" and (not settings.port or isinstance(settings.port, int))
    yield no_device, 'source = "serial" needs port; write port = "/dev/ttyUSB0" or the like'
    yield (
        source == "file" and not settings.path,
        'source = "file" needs path; write path = "tracker.bin" or the like',
    )
    is_one_end = (settings.connect is None) != (settings.listen is None)
    yield (
        source == "tcp" and not is_one_end,
        f'source = "tcp" needs connect or listen, one of them; {PLACE_FORM}',
    )
    asked = settings.poll_hex is not None
    nobody = source == "udp" and asked and settings.connect is None
    yield nobody, f"poll_hex over UDP needs connect, the tracker's place; {PLACE_FORM}"
    address = isinstance(settings.bind, str) and source == "zmq"
    yield (
        address,
        (
            f'bind = "{settings.bind}" is for source = "udp"; write true or false, and the address'
            " in endpoint"
        ),
    )
    too_long = asked and len(bytes.fromhex(settings.poll_hex or "")) > MAX_POLL_BYTES
    yield too_long, f"poll_hex has over {MAX_POLL_BYTES} bytes; write what one question is"


def _format_faults(settings: AnswersSettings) -> Faults:
    form = settings.format
    given = [key for key in OF_FRAMES if getattr(settings, key) not in {None, ()}]
    given += ["checksum"] if settings.checksum != "none" else []
    yield (
        bool(given),
        f'{"".join(given[:1])} is for format = "frame"; remove it (format = "{form}")',
    )
    known = form in {"packet", "json"} or re.fullmatch(r"python:[\w.]+:\w+", form)
    yield (
        not known,
        (
            f'format = "{shortened(form)}"; "packet", "json", "frame" or "python:MODULE:FUNCTION"'
            " is wanted"
        ),
    )


def _frame_faults(settings: AnswersSettings) -> Faults:
    framing = settings.framing
    length = settings.length
    form = 'format = "frame"'
    yield (
        framing is None,
        f'{form} needs framing; write framing = "sync", "slip", "cobs", "fixed" or "ccsds"',
    )
    without = (settings.sync_hex is None) == (framing == "sync")
    yield (
        without,
        (
            'framing = "sync" needs sync_hex, and no other has it; write sync_hex = "1A CF" or the'
            " like"
        ),
    )
    loose = framing == "fixed" and not isinstance(length, int)
    yield loose, 'framing = "fixed" needs length, in bytes; write length = 32 or the like'
    endless = framing == "sync" and length is None
    yield (
        endless,
        (
            'framing = "sync" needs length; write length = 32, or length = { at = 2, type = "u8",'
            " add = 0 }"
        ),
    )
    if isinstance(length, FrameLength):
        odd = (field_format(length.type) or "f")[0] != "u"
        yield (
            odd,
            f'length = {{ type = "{length.type}" }}; u8, u16le, u16be, u32le or u32be is wanted',
        )
    names = [field.name for field in settings.fields]
    twice = [name for name in names if names.count(name) > 1]
    yield bool(twice), f'fields has name = "{"".join(twice[:1])}" twice; write each once'
    missing = [name for name in QUATERNION if name not in names]
    yield bool(missing), f"fields lacks {', '.join(missing)}; write each of qw, qx, qy, qz"
    ordered = settings.convention.scalar == "last"
    yield (
        ordered,
        (
            'convention = { scalar = "last" }: fields says by the name qw which number is the'
            " scalar; remove it"
        ),
    )
    some = 0 < sum(name in names for name in RATE) < len(RATE)
    yield some, "fields has one or two of wx, wy, wz; write all of them, or none"
    both = "t_ns" in names and ("t_s" in names or "t_sub" in names)
    yield both, "fields has t_ns beside t_s or t_sub; write one kind of time"
    for field in settings.fields:
        kind, size, _ = field_format(field.type) or ("", 0, False)
        where = f"fields: {field.name}"
        yield (
            not kind,
            f'{where} has type = "{field.type}"; {TYPES} is wanted, with le or be at its end',
        )
        yield (
            field.mask is not None and kind != "u",
            f"{where} has a mask, which is for u8 to u64; remove it",
        )
        beyond = isinstance(length, int) and field.at + size > length
        yield (
            beyond,
            (
                f"{where} ends with byte {field.at + size - 1}, and length = {length}; mend one of"
                " them"
            ),
        )
        yield field.scale == 0, f"{where} has scale = 0; write another number"
