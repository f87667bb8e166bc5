"""Basilisk's VizMessage, as much of it as hilstar needs: protobuf bytes in, a checked `SimUpdate`
out, no I/O.

Every message gives a `SimUpdate` or one `WireFormatError`. Field numbers are those of Basilisk's
vizMessage.proto (package vizProtobufferMessage); other fields are skipped, and one that is absent
is 0 or empty.
"""

import math
from functools import cache
from typing import Any, NamedTuple

from hilstar.attitude.wire.packet import INT64

MAX_PARTS = 1000  # spacecraft, celestial bodies and cameras, of each
MAX_COMPONENTS = 4  # kept of a vector: one more than it may have
# types of descriptor.proto; a text is read as bytes, for it may not be UTF-8
DOUBLE, INTEGER, MESSAGE, BYTES = 1, 3, 11, 12
ONE, SEVERAL = 1, 3  # its labels
Components = tuple[float, ...]
# Each message's fields, named as here: number, type, label.
FORMS = {
    "TimeStamp": {"frame": (1, INTEGER, ONE), "elapsed_ns": (2, DOUBLE, ONE)},
    "VizBody": {
        "name": (1, BYTES, ONE),
        "position_m": (2, DOUBLE, SEVERAL),
        "velocity_m_s": (3, DOUBLE, SEVERAL),
        "sigma_bn": (4, DOUBLE, SEVERAL),
        "parent": (19, BYTES, ONE),
    },
    "VizCamera": {
        "identity": (1, INTEGER, ONE),
        "field_of_view_deg": (3, DOUBLE, ONE),
        "resolution_px": (4, INTEGER, SEVERAL),
        "sigma": (8, DOUBLE, SEVERAL),
    },
}
PARTS = {"time": (1, "TimeStamp", ONE), "bodies": (2, "VizBody", SEVERAL)}


class WireFormatError(ValueError):
    """Bytes that are no protobuf message, or not the one that is wanted."""


class VizBody(NamedTuple):
    """A spacecraft or planet: position (m), velocity (m/s) and `sigma_bn` (MRP) in and from
    Basilisk's inertial frame N.

    Each has three components, or as many as the message has, up to MAX_COMPONENTS; a planet has no
    `sigma_bn`. A part of another spacecraft names it as its `parent`.
    """

    name: str = ""
    parent: str = ""
    position_m: Components = ()
    velocity_m_s: Components = ()
    sigma_bn: Components = ()


class VizCamera(NamedTuple):
    """A camera as Basilisk describes it to Vizard: degrees along its y axis, px, and `sigma`
    (MRP) from its body to Unity's.
    """

    identity: int = 0
    field_of_view_deg: float = 0.0
    resolution_px: tuple[int, ...] = ()
    sigma: Components = ()


class SimUpdate(NamedTuple):
    """One step of a simulation: `t_ns` since its start, and what it has."""

    t_ns: int
    frame: int
    spacecraft: tuple[VizBody, ...]
    cameras: tuple[VizCamera, ...]
    bodies: tuple[VizBody, ...] = ()


PARTS |= {"spacecraft": (3, "VizBody", SEVERAL), "cameras": (4, "VizCamera", SEVERAL)}


@cache
def _message_class() -> Any:
    """The class of a VizMessage with these fields; importing protobuf is not for every run."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(
        name="vizard.proto", package="hilstar", syntax="proto3"
    )
    for form, fields in FORMS.items():
        named = file.message_type.add(name=form)
        for name, (number, kind, label) in fields.items():
            named.field.add(name=name, number=number, type=kind, label=label)
    whole = file.message_type.add(name="VizMessage")
    for name, (number, form, label) in PARTS.items():
        whole.field.add(
            name=name, number=number, type=MESSAGE, label=label, type_name=f".hilstar.{form}"
        )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("hilstar.VizMessage"))


def decode_update(message: bytes) -> SimUpdate:
    """A VizMessage. Raises WireFormatError for bytes that are none, and for one without a time."""
    from google.protobuf.message import DecodeError

    try:
        read = _message_class().FromString(message)
    except DecodeError as error:
        raise WireFormatError(f"no protobuf message, or one that is cut short ({error})") from error
    for name in ("spacecraft", "bodies", "cameras"):
        if len(getattr(read, name)) > MAX_PARTS:
            raise WireFormatError(f"over {MAX_PARTS} {name}")
    if not read.HasField("time"):
        raise WireFormatError("no currentTime")
    time_ns = read.time.elapsed_ns
    if not math.isfinite(time_ns) or round(time_ns) not in INT64:
        raise WireFormatError(f"simTimeElapsed {time_ns:g} ns")
    return SimUpdate(
        round(time_ns),
        read.time.frame,
        tuple(_body(body) for body in read.spacecraft),
        tuple(
            VizCamera(c.identity, c.field_of_view_deg, _few(c.resolution_px), _few(c.sigma))
            for c in read.cameras
        ),
        tuple(_body(body)._replace(sigma_bn=()) for body in read.bodies),
    )


def _body(read: Any) -> VizBody:
    names = (name_bytes.decode("utf-8", "replace") for name_bytes in (read.name, read.parent))
    return VizBody(*names, *map(_few, (read.position_m, read.velocity_m_s, read.sigma_bn)))


def _few(components: Any) -> tuple[Any, ...]:
    return tuple(components[:MAX_COMPONENTS])
