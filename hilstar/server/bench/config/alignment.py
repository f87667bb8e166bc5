"""The table [alignment]: how the display stands to the tracker's alignment cube or mounting
plane.
"""

import math
from typing import Annotated

from msgspec import Meta

from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.errors import InputError
from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.values import Positive, Rotation

Variance = Annotated[float, Meta(ge=-1e12, le=1e12)]
Row = tuple[Variance, Variance, Variance]


class AlignmentSettings(Table, frozen=True):
    """The reference by which an integrator mounts the tracker: its alignment cube, or its mounting
    plane. `hilstar calibrate reference` writes it.
    """

    #: The unit quaternion that turns mon components into those of the reference.
    q_mon_to_reference: Rotation
    #: Covariance of that rotation about mon x, y and z, arcsec squared. Default: not known
    covariance_arcsec2: Annotated[
        tuple[Row, Row, Row] | None, Meta(extra={"form": "[[xx, xy, xz], ...]"})
    ] = None
    #: Degrees of freedom of that covariance. Default: not limited
    dof: Positive | None = None
    name: str = ""  #: What the reference is, such as the cube's serial number.
    date: str = ""  #: The day of the readings.


def check_alignment(settings: AlignmentSettings) -> None:
    """Refuse (InputError) a rotation or a covariance that is none."""
    norm = math.hypot(*settings.q_mon_to_reference)
    if abs(norm - 1) > NORM_TOLERANCE:
        raise InputError(
            f"[alignment] q_mon_to_reference: its norm is {norm:.6g}; write a unit quaternion w, x,"
            " y, z"
        )
    rows = settings.covariance_arcsec2
    if rows is None:
        return
    for i in range(3):
        for j in range(i):
            bound = math.sqrt(max(rows[i][i] * rows[j][j], 0.0))
            if rows[i][j] != rows[j][i] or abs(rows[i][j]) > bound * (1 + 1e-9):
                raise InputError(
                    "[alignment] covariance_arcsec2: is no covariance; write what `hilstar"
                    " calibrate reference` prints"
                )
        if rows[i][i] < 0:
            raise InputError(
                "[alignment] covariance_arcsec2: a variance is below 0; write what `hilstar"
                " calibrate reference` prints"
            )
