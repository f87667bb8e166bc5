"""From the reference that an integrator mounts by (cube or plane) to the tracker's boresight, with
its 95 %.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import integrate, optimize
from scipy.special import stdtrit

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import (
    conjugate,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
    to_matrix,
)
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.certificate_file import Certificate, CubeToBoresight

HALF_OF_95 = 1.959964  # sigmas of a normal distribution
SAME = 1e-12


@dataclass(frozen=True, slots=True)
class Turned:
    """The tracker's bias (3,), arcsec, cam: from the commanded to the reported attitude; and half
    its 95 % interval (3,).
    """

    bias_arcsec: FloatArray
    half_arcsec: FloatArray


def cube_to_boresight(
    file: BenchFile, certificate: Certificate | None, turned: Turned | None = None
) -> CubeToBoresight | None:
    """From the reference to the tracker's boresight; None where the bench file has no [alignment].

    The tracker stands as the bench file has it, or turned from that by the bias of its answers.
    Parts of the uncertainty: the reference's covariance, the certificate's attitude, the bias's
    interval.
    """
    settings = file.config.alignment
    if settings is None:
        return None
    q_cam_to_mon = from_matrix(bench_camera(file.config, file.folder).cam_to_image)
    q_mon_to_reference = normalise(np.array(settings.q_mon_to_reference))
    q_cam_to_reference = multiply(q_mon_to_reference, q_cam_to_mon)
    if turned is not None:
        turn = from_rotation_vector(turned.bias_arcsec / ARCSEC_PER_RAD)
        q_cam_to_reference = multiply(q_cam_to_reference, conjugate(turn))
    without = []
    cross = roll = None
    if settings.covariance_arcsec2 is None:
        without.append("the reference's own uncertainty")
    else:
        to_cam = to_matrix(q_cam_to_mon).T
        covariance = to_cam @ np.array(settings.covariance_arcsec2) @ to_cam.T
        factor = 1.0
        if settings.dof is not None:
            factor = float(stdtrit(settings.dof, 0.975)) / HALF_OF_95
        covariance = covariance * factor**2
        if certificate is None or certificate.attitude_arcsec is None:
            without.append("the bench's own (no certificate states it)")
        else:
            across, about = certificate.attitude_arcsec
            covariance += np.diag(np.square([across, across, about]) / HALF_OF_95**2)
        if turned is None:
            without.append("the tracker's bias, which an assessment finds")
        else:
            covariance += np.diag(np.square(turned.half_arcsec / HALF_OF_95))
        cross = radius_of_95(covariance[:2, :2])
        roll = HALF_OF_95 * math.sqrt(max(float(covariance[2, 2]), 0.0))
    w, x, y, z = (q_cam_to_reference * np.sign(q_cam_to_reference[0] or 1.0)).tolist()
    bx, by, bz = to_matrix(q_cam_to_reference)[:, 2].tolist()
    return CubeToBoresight(
        reference=settings.name,
        boresight=(bx, by, bz),
        q_tracker_to_reference=(w, x, y, z),
        cross_arcsec=cross,
        roll_arcsec=roll,
        without=tuple(without),
    )


def radius_of_95(covariance: FloatArray) -> float:
    """The radius that holds 95 % of a two-dimensional normal distribution of this covariance
    (2, 2).
    """
    small, large = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0)).tolist()
    if large <= SAME:
        return 0.0
    ratio = small / large

    def held(radius: float) -> float:
        """The probability within a radius, in units of the larger sigma."""

        # a thousandth of the time of scipy.stats' distributions, which are asked 3000 times
        def at(u: float) -> float:
            room = math.sqrt(max(radius**2 - u**2, 0.0))
            across = 1.0 if ratio < SAME else math.erf(room / ratio / math.sqrt(2))
            return math.exp(-(u**2) / 2) / math.sqrt(2 * math.pi) * across

        return float(integrate.quad(at, -radius, radius)[0])

    radius = float(optimize.brentq(lambda radius: held(radius) - 0.95, 1.9, 2.5))
    return float(large) * radius
