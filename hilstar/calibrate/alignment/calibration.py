"""From pairs of attitudes to a geometry file: the rotation between them, taken out of `q_cam_to_mon`.

The screen shows the star at v (ICRS) where the camera Q C v has it, with C the commanded attitude and Q the file's
q_cam_to_mon; the tracker, which truly stands at Q', sees it in the direction Q'* Q C v, and so reports T = Q'* Q C. The
rotation M = T C* of all pairs is then Q'* Q, and Q' = Q M*.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.cameras import bench_camera
from hilstar.calibrate.alignment.conventions import refuse_conventions
from hilstar.calibrate.alignment.ledger import pair_with_ledger
from hilstar.calibrate.alignment.pairs import Pairs, read_pairs, read_telemetry
from hilstar.calibrate.alignment.residual import Residual, groups_of, residual_of
from hilstar.calibrate.alignment.rotation_fit import RotationFit, fit_rotation
from hilstar.errors import InputError
from hilstar.rotation import conjugate, from_matrix, multiply, normalise, to_rotation_vector
from hilstar.scene.camera import Camera
from hilstar.units import ARCSEC_PER_RAD

MIN_PAIRS = 3


@dataclass(frozen=True, slots=True)
class Aligned:
    """What was found: the rotation from the commanded to the reported attitudes, and the alignment that takes it out.

    `camera` is the bench's present geometry. `wild` are the lines of the file whose pairs are not of that rotation.
    """

    pairs: Pairs
    fit: RotationFit
    residual: Residual
    camera: Camera
    q_cam_to_mon: FloatArray
    sigma_arcsec: tuple[float, float, float]
    wild: tuple[int, ...]

    @property
    def rotation_arcsec(self) -> tuple[float, float, float]:
        """The rotation vector from the commanded to the reported attitude, cam axes: x, y, and z about the boresight."""
        x, y, z = (ARCSEC_PER_RAD * to_rotation_vector(self.fit.q)).tolist()
        return x, y, z


def align_files(file: BenchFile, table: Path, ledger: Path | None, offset_s: float) -> Aligned:
    """Align a bench by a table of pairs, or by the telemetry of a run with its ledger. Raises InputError."""
    pairs = read_pairs(table) if ledger is None else pair_with_ledger(table, read_telemetry(table), ledger, offset_s)
    return align(pairs, bench_camera(file.config, file.folder))


def align(pairs: Pairs, camera: Camera) -> Aligned:
    """Find the alignment of a tracker behind the monitor's `camera`.

    Raises InputError, with the cure, for too few pairs, other conventions, and half or more of wild ones.
    """
    if len(pairs) < MIN_PAIRS:
        skipped = f" ({pairs.skipped} more are not valid)" if pairs.skipped else ""
        raise InputError(f"{pairs.source}: {len(pairs)} pairs{skipped} and {MIN_PAIRS} are needed; measure more attitudes")
    refuse_conventions(pairs, camera.field_radius_rad(0.0))
    fit = fit_rotation(multiply(pairs.reported, conjugate(pairs.commanded)))
    used = fit.used
    if 2 * used.sum() <= len(pairs):
        raise InputError(
            f"{pairs.source}: half or more of the reported attitudes are wild: {used.sum()} of {len(pairs)} agree; look for"
            " lost stars, and rows of other times"
        )
    kept = Pairs(
        pairs.source,
        pairs.line[used],
        pairs.commanded[used],
        pairs.reported[used],
        pairs.skipped,
        None if pairs.rate_rad_s is None else pairs.rate_rad_s[used],
        pairs.names,
    )
    x, y, z = (ARCSEC_PER_RAD * fit.sigma_rad(groups_of(pairs.commanded))).tolist()
    return Aligned(
        pairs=pairs,
        fit=fit,
        residual=residual_of(kept, fit.residual_rad[used], fit.q),
        camera=camera,
        q_cam_to_mon=corrected(from_matrix(camera.cam_to_image), fit.q),
        sigma_arcsec=(x, y, z),
        wild=tuple(pairs.line[~used].tolist()),
    )


def corrected(q_cam_to_mon: FloatArray, q_commanded_to_reported: FloatArray) -> FloatArray:
    """The alignment (4,), w >= 0, with which the tracker reports what is commanded: Q' = Q M*."""
    q = normalise(multiply(q_cam_to_mon, conjugate(q_commanded_to_reported)))
    return np.asarray(-q if q[0] < 0 else q)
