"""Basilisk's VizMessage by Google's own protobuf library: the fields that hilstar reads, and two
that it skips.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

# Numbers and types as in Basilisk's vizMessage.proto: name, number, type (a message's by its name),
# repeated.
FIELDS: dict[str, list[tuple[str, int, str, bool]]] = {
    "TimeStamp": [("frameNumber", 1, "int64", False), ("simTimeElapsed", 2, "double", False)],
    "Spacecraft": [
        ("spacecraftName", 1, "string", False),
        ("position", 2, "double", True),
        ("velocity", 3, "double", True),
        ("rotation", 4, "double", True),
        ("spacecraftSprite", 9, "string", False),
        ("parentSpacecraftName", 19, "string", False),
    ],
    "CameraConfig": [
        ("cameraID", 1, "int64", False),
        ("fieldOfView", 3, "double", False),
        ("resolution", 4, "int64", True),
        ("cameraDir_B", 8, "double", True),
        ("renderRate", 9, "uint64", False),
    ],
    "CelestialBody": [
        ("bodyName", 1, "string", False),
        ("position", 2, "double", True),
        ("velocity", 3, "double", True),
        ("rotation", 4, "double", True),
    ],
    "VizMessage": [
        ("currentTime", 1, "TimeStamp", False),
        ("celestialBodies", 2, "CelestialBody", True),
        ("spacecraft", 3, "Spacecraft", True),
        ("cameras", 4, "CameraConfig", True),
    ],
}


def _library() -> dict[str, type[Any]]:
    file = descriptor_pb2.FileDescriptorProto(name="viz.proto", package="viz", syntax="proto3")
    kinds = descriptor_pb2.FieldDescriptorProto
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind, repeated in fields:
            label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            made = message.field.add(name=field, number=number, label=label)
            if kind in FIELDS:
                made.type, made.type_name = kinds.TYPE_MESSAGE, f".viz.{kind}"
            else:
                made.type = getattr(kinds, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"viz.{name}"))
        for name in FIELDS
    }


_CLASSES = _library()


def viz_message(
    t_ns: float | None = 1e9,
    spacecraft: list[dict[str, Any]] | None = None,
    cameras: list[dict[str, Any]] | None = None,
    frame: int = 7,
    bodies: list[dict[str, Any]] | None = None,
) -> bytes:
    """A VizMessage; without a time where `t_ns` is None."""
    whole = _CLASSES["VizMessage"](
        spacecraft=spacecraft or [], cameras=cameras or [], celestialBodies=bodies or []
    )
    if t_ns is not None:
        whole.currentTime.frameNumber, whole.currentTime.simTimeElapsed = frame, t_ns
    return whole.SerializeToString()


def craft(name: str = "sat", sigma: Any = (0.1, 0.2, 0.3), **more: Any) -> dict[str, Any]:
    """A spacecraft of such a message."""
    return {
        "spacecraftName": name,
        "rotation": list(sigma),
        "position": [7e6, 0, 0],
        "velocity": [0, 7.5e3, 0],
    } | more
