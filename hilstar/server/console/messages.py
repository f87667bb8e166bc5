"""The messages between a run and the process of its page, and the memory that both share.

The memory has rings of numbered records, which are written without waiting and read without a lock.
Each slot holds the number of the record being written, the number of the complete record (a
seqlock) and a CRC, so that a reader notices a record that is incomplete or was overwritten. Each
ring has one writer. The memory has no name (memfd): it disappears with the last process that has it
open.
"""

import math
import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console import protocol

FRAME = struct.Struct("<9qI")
PICTURE = struct.Struct("<3q4I4d")
STALE, MISSING, BLANK, HAS_AGE = 1, 2, 4, 8
_HEAD = struct.Struct("<Q")
_SLOT = struct.Struct("<QQII")  # number being written, number that is complete, bytes, CRC-32
_REQUEST = struct.Struct("<QQ")  # interval of pictures, and end of the request (host time), ns
_WRONG_SINCE = struct.Struct("<d")  # UTC, s
_PAGE = 4096
FRAMES, FRAME_BYTES = 512, 128  # 8 s at 60 Hz
STATES, STATE_BYTES = 4, 60_000
EVENTS, EVENT_BYTES = 512, 2_000
ANSWERS, ANSWER_BYTES = 16, 12_000
PICTURES = 3
MAX_SPRITES = 20_000
SPRITE = np.dtype([("star", "<i4"), ("x_px", "<f4"), ("y_px", "<f4")])
PICTURE_HEAD_BYTES = 128


class FrameNumbers(NamedTuple):
    """A frame's number, its host times, ns, the age of its attitude, ns, and the run's counts so
    far, as FRAME packs them. `flags` combines STALE, MISSING, BLANK and HAS_AGE.
    """

    number: int
    draw_ns: int
    swap_ns: int
    predicted_swap_ns: int
    age_ns: int
    missed_before: int
    frames: int
    missed: int
    refused: int
    flags: int


class PictureHead(NamedTuple):
    """The head of a picture, as PICTURE packs it: the frame's number, its swap (host time, ns), its
    time `t_ns` on the timeline, and q_icrs_to_cam `q_w` to `q_z`, NaN without an attitude.

    After it follow `height` rows of `width` levels of `item_bytes` bytes, then `sprites` records of
    SPRITE.
    """

    frame: int
    swap_ns: int
    t_ns: int
    width: int
    height: int
    item_bytes: int
    sprites: int
    q_w: float = math.nan
    q_x: float = math.nan
    q_y: float = math.nan
    q_z: float = math.nan


class RunState(protocol.SkyState, frozen=True, kw_only=True):
    """The state of the run at the host time `host_ns`, ns. `alive_ns` is the host time of the frame
    loop's last step, 0 before the first.

    `operator_text` names the operator's switches that are on; `overlay` combines the aids that are
    drawn, `patch_share` is the patch's level relative to white. The other texts report a fault, ""
    without one: of the window, the display, the gamma ramp, a monitor shown by --force, and the
    reading of the state itself (`note`). `failed` are the failed steps of a first-light session.
    """

    host_ns: int
    alive_ns: int = 0
    operator_text: str = ""
    overlay: int = 0
    patch_share: float = 0.0
    hidden: str = ""
    display_lost: str = ""
    gamma: str = ""
    forced: str = ""
    note: str = ""
    failed: list[str] = msgspec.field(default_factory=list)


class NewAnswer(msgspec.Struct, frozen=True):
    """The tracker's newest answer: the statistics up to it, q_icrs_to_cam that was lit during its
    exposure, and the reported centroids (x, y), tracker pixels.
    """

    figures: TrackerFigures
    q_lit: tuple[float, float, float, float] | None = None
    centroids: list[tuple[float, float]] = []


class RunEvent(msgspec.Struct, frozen=True):
    """An event of the run at Unix time `unix_s`, s: its kind and its text."""

    unix_s: float
    kind: str
    line: str


class Order(msgspec.Struct, kw_only=True):
    """An operator's order: a name of CONTROLS, who gave it, and its arguments: the switch `on` or
    off, the patch's `level` relative to white, a mark's `text`, the name of a `fault`.
    """

    id: int
    name: str
    who: str
    on: bool = True
    level: float = protocol.PATCH_SHARE
    text: str = ""
    fault: str = ""


class OrderAnswer(msgspec.Struct, kw_only=True):
    """The answer to the order `id`: an HTTP status and a line of text."""

    id: int
    status: int
    line: str


Pace = Literal["clock", "asked", "session"]


class ScpiSetup(msgspec.Struct, frozen=True):
    """The settings of SCPI: its token ("" for none), the run's source of attitudes, the run's UDP
    port to which SCPI sends attitudes (0: it may not), and the largest rate, deg/s.
    """

    token: str
    source: str
    steer_port: int = 0
    max_rate_deg_s: float = 0.0


class Setup(msgspec.Struct, kw_only=True):
    """The settings that the page's process gets at its start; `hello` is the first message to every
    page.

    `hosts`, `names`, `any_address`, `port` and `token` are those of the PageListener. `pace` says
    when frames are due: at fixed times ("clock"), when a simulator asks or as fast as possible
    ("asked"), or never, in a first-light session ("session"). Without a `token` anybody who reaches
    the page may see it. `picture_bytes` is the size of a picture's levels.
    """

    hello: protocol.Hello
    source: protocol.AttitudeSource
    hosts: list[str]
    names: list[str]
    any_address: bool
    port: int
    token: str
    picture_bytes: int
    pace: Pace
    scene: bytes = b""  # a pickled `overlay.OverlayScene`
    scpi: ScpiSetup | None = None


class Ring:
    """A ring of `slots` records in shared memory, numbered from 1, of at most `slot_bytes` each.
    Only one process may write to it.
    """

    def __init__(self, memory: memoryview, slots: int, slot_bytes: int) -> None:
        self._memory = memory
        self._slots = slots
        self._stride = _SLOT.size + slot_bytes
        self.slot_bytes = slot_bytes
        self._next = self.newest + 1

    @staticmethod
    def size(slots: int, slot_bytes: int) -> int:
        """The size of a ring in memory, bytes."""
        return _HEAD.size + slots * (_SLOT.size + slot_bytes)

    @property
    def newest(self) -> int:
        """The number of the newest complete record, 0 for none."""
        return int(_HEAD.unpack_from(self._memory, 0)[0])

    def put(self, data: bytes) -> None:
        """Write a record; bytes beyond `slot_bytes` are cut off."""
        data = data[: self.slot_bytes]
        place = self.begin()
        self._memory[place : place + len(data)] = data
        self.end(len(data), zlib.crc32(data))

    def begin(self) -> int:
        """Mark the next slot as being written; returns the offset of its bytes in the memory."""
        place = self._place(self._next)
        _SLOT.pack_into(self._memory, place, self._next, 0, 0, 0)
        return place + _SLOT.size

    def end(self, length: int, crc: int) -> None:
        """Mark the slot as complete, with `length` bytes; a `crc` of 0 is not checked."""
        _SLOT.pack_into(self._memory, self._place(self._next), self._next, self._next, length, crc)
        _HEAD.pack_into(self._memory, 0, self._next)
        self._next += 1

    def room(self, length: int) -> memoryview:
        """The memory of the first `length` bytes of the slot that `begin` opened."""
        place = self._place(self._next) + _SLOT.size
        return self._memory[place : place + length]

    def read(self, number: int) -> bytes | None:
        """The record of a number; None if it is incomplete or was overwritten."""
        place = self._place(number)
        begun, whole, length, crc = _SLOT.unpack_from(self._memory, place)
        if not number or begun != number or whole != number or length > self.slot_bytes:
            return None
        data = bytes(self._memory[place + _SLOT.size : place + _SLOT.size + length])
        # The writer may have begun the slot anew while the bytes were copied.
        if _SLOT.unpack_from(self._memory, place) != (begun, whole, length, crc):
            return None
        if not crc or zlib.crc32(data) == crc:
            return data
        return None

    def last(self) -> tuple[int, bytes] | None:
        """The number and bytes of the newest complete record; None if there is none yet."""
        newest = self.newest
        for number in range(newest, max(newest - self._slots + 1, 0), -1):
            data = self.read(number)
            if data is not None:
                return number, data
        return None

    def after(self, number: int) -> Iterator[tuple[int, bytes]]:
        """The numbers and bytes of the complete records after `number` that are not overwritten
        yet, oldest first.
        """
        newest = self.newest
        # The oldest slot is left out: the writer takes it next.
        for k in range(max(number + 1, newest - self._slots + 2, 1), newest + 1):
            data = self.read(k)
            if data is not None:
                yield k, data

    def _place(self, number: int) -> int:
        return _HEAD.size + (number % self._slots) * self._stride


@dataclass(frozen=True, slots=True)
class PictureRequest:
    """The interval at which the page needs pictures, ns, and the host time until which it needs
    them, ns; 0 where it needs none.
    """

    each_ns: int = 0
    until_ns: int = 0


class SharedMemory:
    """The rings of a run (frames, states, events, answers, pictures) and the page's request for
    pictures, in the file `fd`, for pictures of at most `picture_bytes`.
    """

    def __init__(self, fd: int, picture_bytes: int) -> None:
        self.fd = fd
        slot_bytes = PICTURE_HEAD_BYTES + picture_bytes + MAX_SPRITES * SPRITE.itemsize
        shapes = [
            (FRAMES, FRAME_BYTES),
            (STATES, STATE_BYTES),
            (EVENTS, EVENT_BYTES),
            (ANSWERS, ANSWER_BYTES),
            (PICTURES, slot_bytes),
        ]
        starts = [_PAGE]
        for shape in shapes:
            starts.append(-(-(starts[-1] + Ring.size(*shape)) // _PAGE) * _PAGE)
        if os.fstat(fd).st_size == 0:
            os.ftruncate(fd, starts[-1])
        self._memory = memoryview(mmap.mmap(fd, starts[-1]))
        rings = [
            Ring(self._memory[start:], *shape) for start, shape in zip(starts, shapes, strict=False)
        ]
        self.frames, self.states, self.events, self.answers, self.pictures = rings

    @classmethod
    def make(cls, picture_bytes: int) -> "SharedMemory":
        """Create a new memory for pictures of at most `picture_bytes`."""
        return cls(os.memfd_create("hilstar-console"), picture_bytes)

    def put_picture(
        self, head: PictureHead, levels: np.ndarray, sprites: Sequence[np.ndarray] = ()
    ) -> None:
        """Write a picture: its levels (h, w), and the star number, x and y, monitor px, of its
        sprites, (n,) each. Raises ValueError if it does not fit.
        """
        end = PICTURE_HEAD_BYTES + levels.nbytes
        whole = end + head.sprites * SPRITE.itemsize
        self.pictures.begin()
        room = self.pictures.room(whole)
        room[: PICTURE.size] = PICTURE.pack(*head)
        np.copyto(
            np.frombuffer(room[PICTURE_HEAD_BYTES:end], dtype=levels.dtype).reshape(levels.shape),
            levels,
        )
        if head.sprites:
            target = np.frombuffer(room[end:], dtype=SPRITE)
            target["star"], target["x_px"], target["y_px"] = sprites
        self.pictures.end(whole, 0)

    @property
    def want(self) -> PictureRequest:
        """The page's present request for pictures."""
        return PictureRequest(*_REQUEST.unpack_from(self._memory, 0))

    @want.setter
    def want(self, want: PictureRequest) -> None:
        _REQUEST.pack_into(self._memory, 0, want.each_ns, want.until_ns)

    @property
    def wrong_since_s(self) -> float:
        """The Unix time, s, since which the page has judged the sky wrong; 0 while it is right. A
        page's process that is started again reads it.
        """
        return float(_WRONG_SINCE.unpack_from(self._memory, _REQUEST.size)[0])

    @wrong_since_s.setter
    def wrong_since_s(self, since_s: float) -> None:
        _WRONG_SINCE.pack_into(self._memory, _REQUEST.size, since_s)
