"""Basilisk's live stream: its REQ socket connects, and hilstar's REP socket stands in Vizard's place.

Basilisk asks and waits: PING until somebody answers, then for each step SIM_UPDATE (four parts: the word, two that are empty,
a VizMessage), REQUEST_INPUT where it shows a display, and REQUEST_IMAGE_<id> for each camera whose time has come. Every
request has exactly one answer, and Basilisk stops where a SIM_UPDATE is not answered with OK.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import zmq

from hilstar.attitude.wire.keys import NO_KEYS
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.vizard.attitude import Follower
from hilstar.attitude.wire.vizard.message import SimUpdate
from hilstar.attitude.wire.vizard.parts import MAX_UPDATE_BYTES, SIM_UPDATE, check_loopback, update_of
from hilstar.attitude.wire.zmq_socket import ZmqSocket
from hilstar.errors import shortened
from hilstar.notices import Notices

REQUEST_IMAGE, MAX_DIGITS = b"REQUEST_IMAGE_", 20
# What is the same at every request: a pulse, and what a person has typed into Vizard (an empty VizInput: nothing).
PLAIN_ANSWERS = {b"PING": [b"PONG"], b"REQUEST_INPUT": [b"VIZARD_INPUT", b""]}
OK, ERROR = b"OK", b"ERROR"


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the simulation: the camera's attitude or why there is none, and the whole message where it is one."""

    host_ns: int
    event: AttitudeSample | Refusal
    update: SimUpdate | None
    raw: bytes


@dataclass(frozen=True, slots=True)
class ImageRequest:
    """Basilisk asks for the picture of a camera, by its number."""

    camera: int


class VizardLive(ZmqSocket):
    """A REP socket in Vizard's place; it binds, or connects with `bind=False`."""

    max_part_bytes = MAX_UPDATE_BYTES

    def __init__(self, endpoint: str, follower: Follower, *, bind: bool = True, notices: Notices | None = None) -> None:
        check_loopback(endpoint)
        super().__init__(zmq.REP, endpoint, bind=bind, keys=NO_KEYS, notices=notices)
        self._follower, self.conventions = follower, follower.conventions

    def receive(self, timeout_ms: int) -> Step | ImageRequest | None:
        """The next request that needs more than a plain answer, or None; it must be answered before the next can arrive."""
        parts = self._take_parts() if self._waits(timeout_ms) else None
        if parts is None:
            return None
        host_ns, word = time.monotonic_ns(), parts[0]
        if word == SIM_UPDATE:
            message = update_of(parts)
            if message is None:
                refusal = Refusal("format", f"SIM_UPDATE of {len(parts)} parts; Basilisk sends four")
                return Step(host_ns, refusal, None, parts[-1])
            return Step(host_ns, *self._follower.take(message), message)
        if word.startswith(REQUEST_IMAGE) and (number := word[len(REQUEST_IMAGE) :][:MAX_DIGITS]).isdigit():
            return ImageRequest(int(number))
        if word not in PLAIN_ANSWERS:
            self._notices.tell("unknown-request", f"{shortened(repr(word[:40]))} is none of Basilisk's requests")
        self._answer(PLAIN_ANSWERS.get(word, [ERROR]))
        return None

    def answer_step(self, taken: bool) -> None:
        """Let the simulation go on; or, where its step was refused, end it."""
        self._answer([OK if taken else ERROR])

    def answer_image(self, image: bytes) -> None:
        """Hand over a picture; an empty one says that there is none. Its length goes ahead, 4 bytes, big-endian."""
        self._answer([len(image).to_bytes(4, "big"), image])

    def _answer(self, parts: list[bytes]) -> None:
        """A simulation that is gone, or does not read, gets no answer."""
        with contextlib.suppress(zmq.Again):
            self._ready().send_multipart(parts, zmq.NOBLOCK)
