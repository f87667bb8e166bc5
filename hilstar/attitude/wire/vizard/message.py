"""Basilisk's VizMessage as far as hilstar needs it: bytes in, a frozen `SimUpdate` out, no I/O.

The numbers are those of Basilisk's vizMessage.proto (package vizProtobufferMessage), and what is not named here is skipped.
A field that is given twice counts as the last one, as protobuf has it; one that is not given is 0 or empty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from hilstar.attitude.wire.packet import INT64
from hilstar.attitude.wire.vizard.wire_format import (
    Field,
    Reader,
    Value,
    WireFormatError,
    as_double,
    as_doubles,
    as_int64,
    as_int64s,
    as_message,
    as_text,
)

CURRENT_TIME, CELESTIAL_BODIES, SPACECRAFT, CAMERAS = 1, 2, 3, 4  # of a VizMessage
FRAME_NUMBER, SIM_TIME_ELAPSED = 1, 2  # of a TimeStamp
NAME, POSITION, VELOCITY, ROTATION, PARENT_NAME = 1, 2, 3, 4, 19  # of a Spacecraft; of a CelestialBody the first three
CAMERA_ID, FIELD_OF_VIEW, RESOLUTION, CAMERA_DIR_B = 1, 3, 4, 8  # of a CameraConfig

Components = tuple[float, ...]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Spacecraft:
    """One spacecraft: position (m), velocity (m/s) and `sigma_bn` (MRP) in and from Basilisk's inertial frame N.

    Each has three components, or none where the message has none. A part of another spacecraft names it as its `parent`.
    """

    name: str = ""
    parent: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()
    sigma_bn: Components = ()


@dataclass(frozen=True, slots=True)
class CelestialBody:
    """A planet of the simulation: position (m) and velocity (m/s) in N, with three components each or none."""

    name: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()


@dataclass(frozen=True, slots=True)
class VizCamera:
    """A camera as Basilisk describes it to Vizard: degrees along its y axis, px, and `sigma` (MRP) from its body to Unity's."""

    identity: int = 0
    field_of_view_deg: float = 0.0
    resolution_px: tuple[int, ...] = ()
    sigma: Components = ()


@dataclass(frozen=True, slots=True)
class SimUpdate:
    """One step of a simulation: `t_ns` since its start, and what it has."""

    t_ns: int
    frame: int
    spacecraft: tuple[Spacecraft, ...]
    cameras: tuple[VizCamera, ...]
    bodies: tuple[CelestialBody, ...] = ()


def decode_update(message: bytes) -> SimUpdate:
    """A VizMessage. Raises WireFormatError for bytes that are none, and for one without a time."""
    stamp: dict[int, float] | None = None
    spacecraft: list[Spacecraft] = []
    cameras: list[VizCamera] = []
    bodies: list[CelestialBody] = []
    reader = Reader()
    for number, kind, value in reader.fields(memoryview(message)):
        if number == CURRENT_TIME:
            stamp = (stamp or {}) | _time_stamp(reader.fields(as_message(kind, value)))
        elif number == SPACECRAFT:
            spacecraft.append(_spacecraft(reader.fields(as_message(kind, value))))
        elif number == CELESTIAL_BODIES:
            body = _spacecraft(reader.fields(as_message(kind, value)), (POSITION, VELOCITY))
            bodies.append(CelestialBody(body.name, body.position_m, body.velocity_m_s))
        elif number == CAMERAS:
            cameras.append(_camera(reader.fields(as_message(kind, value))))
    if stamp is None:
        raise WireFormatError("no currentTime")
    time_ns = stamp.get(SIM_TIME_ELAPSED, 0.0)
    if not math.isfinite(time_ns) or round(time_ns) not in INT64:
        raise WireFormatError(f"simTimeElapsed {time_ns:g} ns")
    return SimUpdate(round(time_ns), int(stamp.get(FRAME_NUMBER, 0)), tuple(spacecraft), tuple(cameras), tuple(bodies))


def _time_stamp(fields: Iterator[Field]) -> dict[int, float]:
    readers: dict[int, Callable[[int, Value], float]] = {FRAME_NUMBER: as_int64, SIM_TIME_ELAPSED: as_double}
    return {number: readers[number](kind, value) for number, kind, value in fields if number in readers}


def _spacecraft(fields: Iterator[Field], wanted: tuple[int, ...] = (POSITION, VELOCITY, ROTATION)) -> Spacecraft:
    texts: dict[int, str] = {}
    vectors: dict[int, Components] = {}
    for number, kind, value in fields:
        if number in {NAME, PARENT_NAME}:
            texts[number] = as_text(kind, value)
        elif number in wanted:
            vectors[number] = _extended(vectors.get(number, ()), as_doubles(kind, value), 3)
    position, velocity, rotation = (vectors.get(number, ()) for number in (POSITION, VELOCITY, ROTATION))
    return Spacecraft(texts.get(NAME, ""), texts.get(PARENT_NAME, ""), position, velocity, rotation)


def _camera(fields: Iterator[Field]) -> VizCamera:
    identity, field_deg = 0, 0.0
    resolution: tuple[int, ...] = ()
    sigma: Components = ()
    for number, kind, value in fields:
        if number == CAMERA_ID:
            identity = as_int64(kind, value)
        elif number == FIELD_OF_VIEW:
            field_deg = as_double(kind, value)
        elif number == RESOLUTION:
            resolution = _extended(resolution, as_int64s(kind, value), 2)
        elif number == CAMERA_DIR_B:
            sigma = _extended(sigma, as_doubles(kind, value), 3)
    return VizCamera(identity, field_deg, resolution, sigma)


def _extended(so_far: tuple[T, ...], more: tuple[T, ...], wanted: int) -> tuple[T, ...]:
    if len(so_far) + len(more) > wanted:
        raise WireFormatError(f"over {wanted} components where {wanted} are wanted")
    return so_far + more
