"""[collimator]."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from hilstar.bench.config.values import Point, Positive, Rotation
from hilstar.toml_tables import Table


class Collimator(Table, frozen=True):
    """The lens between monitor and tracker, and the tracker's alignment with it."""

    focal_length_mm: Annotated[Positive, Meta(description="Focal length of the collimating lens.")]
    q_cam_to_mon: Annotated[
        Rotation,
        Meta(description="Misalignment: the unit quaternion that turns cam components into mon components."),
    ] = (1.0, 0.0, 0.0, 0.0)
    principal_point_px: Annotated[
        Point | None,
        Meta(
            description="Where the optical axis of the collimator meets the monitor, in monitor pixels.",
            extra={"default": "the middle of the screen"},
        ),
    ] = None
    geometry: Annotated[
        str | None,
        Meta(
            description="The path of a file that `hilstar calibrate geometric` or `alignment` wrote: the lens and "
            "the real alignment. It takes the place of the other keys of this table.",
            extra={"default": "an ideal lens"},
        ),
    ] = None
