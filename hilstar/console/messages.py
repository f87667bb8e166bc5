"""Messages between a run and its page's process: frames, states, events and pictures in shared memory; orders and answers."""

from __future__ import annotations

import math
import struct
from typing import Literal, NamedTuple

import msgspec

from hilstar.console.protocol import (
    PATCH_SHARE,
    AttitudeSource,
    Hello,
    LedgerState,
    NewestFrame,
    RunCounts,
    ShownAttitude,
    ShownClock,
)

FRAME = struct.Struct("<12qI")
PICTURE = struct.Struct("<3q4I4d")
STALE, MISSING, BLANK, HAS_AGE = 1, 2, 4, 8


class FrameNumbers(NamedTuple):
    """One frame and the counts up to it, as FRAME packs them; host times, ns.

    `flags` combines STALE, MISSING, BLANK and HAS_AGE.
    """

    number: int
    draw_ns: int
    swap_ns: int
    predicted_swap_ns: int
    age_ns: int
    missed_before: int
    frames: int
    missed: int
    stale: int
    given_up: int
    received: int
    refused: int
    flags: int


class PictureHead(NamedTuple):
    """The head of a picture, as PICTURE packs it: frame, swap (host time, ns), attitude `q_w` to `q_z`, NaN without one.

    Levels of `item_bytes` each follow, `width` by `height`, then `sprites` records of `shared_memory.SPRITE`.
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


class RunState(msgspec.Struct, frozen=True, kw_only=True):
    """The run at a host time, ns; `alive_ns` is when the frame loop last moved, 0 before it began."""

    host_ns: int
    alive_ns: int = 0
    frame: NewestFrame = NewestFrame()
    attitude: ShownAttitude | None = None
    clock: ShownClock | None = None
    counts: RunCounts = RunCounts()
    operator: dict[str, bool] = {}
    operator_text: str = ""
    overlay: int = 0
    patch_share: float = 0.0
    hidden: str = ""
    display_lost: str = ""
    gamma: str = ""
    ledger: LedgerState | None = None
    note: str = ""
    faults: list[str] = []
    rates: str = ""
    failed: list[str] = []


class RunEvent(msgspec.Struct, frozen=True):
    """An event of the run, at UTC, seconds."""

    unix_s: float
    kind: str
    line: str


class Order(msgspec.Struct, kw_only=True):
    """An operator's order: a name of CONTROLS, the wanted state, and who gave it."""

    id: int
    name: str
    who: str
    on: bool = True
    level: float = PATCH_SHARE
    text: str = ""
    fault: str = ""


class OrderAnswer(msgspec.Struct, kw_only=True):
    """The answer to an order: an HTTP status and a line."""

    id: int
    status: int
    line: str


Pace = Literal["clock", "asked", "session"]


class Setup(msgspec.Struct, kw_only=True):
    """What the page's process is given at its start; `hello` is the first message to every page.

    `pace` says when frames come: at their due time ("clock"), when a simulator asks or as fast as possible ("asked"), or not
    at all, in a first-light session ("session"). Without a `token` anybody who reaches the page may see it.
    """

    hello: Hello
    source: AttitudeSource
    hosts: list[str]
    names: list[str]
    any_address: bool
    port: int
    token: str
    picture_bytes: int
    pace: Pace
    scene: bytes = b""  # a pickled `overlay.OverlayScene`
