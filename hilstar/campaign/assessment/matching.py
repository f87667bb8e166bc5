"""Telemetry brought onto a run's clock, or refused with what is wrong with it."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.alignment.conventions import refuse_conventions
from hilstar.calibrate.alignment.pairs import COMMANDED, Pairs
from hilstar.campaign.assessment.run_ledger import RunLedger
from hilstar.campaign.assessment.telemetry import Telemetry
from hilstar.campaign.budget.coarse_clock import CoarseClock, coarse_offset, speed_offsets
from hilstar.errors import InputError
from hilstar.rotation import to_matrix, to_rotation_vector
from hilstar.units import NS_PER_S

AGREE_RAD = np.radians(1.0)  # half of the answers of one sky are this near to one rotation
MAX_TURN_RAD = np.radians(5.0)  # from commanded to reported: more is another frame
NEAR_AXES_RAD = np.radians(5.0)
MIN_PAIRS = 8


def tau_of(run: RunLedger, telemetry: Telemetry) -> tuple[FloatArray, float]:
    """The telemetry's times (n,), s, near the run's where the two overlap as they are, and what was subtracted from them, s."""
    end_ns = run.zero_ns + round(run.commanded.t_s[-1] * NS_PER_S)
    overlap = telemetry.t_ns[0] <= end_ns and telemetry.t_ns[-1] >= run.zero_ns
    base_ns = run.zero_ns if overlap else int(telemetry.t_ns[0])
    return (telemetry.t_ns - base_ns) / NS_PER_S, (base_ns - run.zero_ns) / NS_PER_S


def matched(run: RunLedger, telemetry: Telemetry, tau_s: FloatArray, q: FloatArray) -> CoarseClock:
    """Where valid answers (n, 4) at times (n,) lie on the run's clock.

    Raises InputError for other conventions than hilstar's, for another frame, and for answers of another run.
    """
    commanded = run.commanded
    coarse = coarse_offset(commanded, tau_s, q)
    if coarse is not None and coarse.spread_rad <= AGREE_RAD and coarse.turn_rad <= MAX_TURN_RAD:
        return coarse
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        named = _other_axes(coarse.rotation)
        if named:
            raise InputError(f"{telemetry.path}: {_turned(coarse.rotation)}: {named}")
    offsets = [] if coarse is None else [coarse.offset_s]
    for offset in [*offsets, *speed_offsets(commanded, tau_s, q).tolist()]:
        _refuse(run, telemetry, tau_s + offset, q)
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        w, x, y, z = (float(value) for value in coarse.rotation * [1, -1, -1, -1])
        cure = f"turn them back by the quaternion {w:.6f},{x:.6f},{y:.6f},{z:.6f} from the left"
        raise InputError(f"{telemetry.path}: {_turned(coarse.rotation)}: another frame or mounting; {cure}")
    raise InputError(
        f"{telemetry.path}: at no offset of its clock do the reported attitudes follow those of {run.path}, lit for"
        f" {commanded.t_s[-1]:.6g} s; give the telemetry of this run, of which no more than half may be wild"
    )


def _refuse(run: RunLedger, telemetry: Telemetry, t_s: FloatArray, q: FloatArray) -> None:
    """Refuse answers that agree with the run at these times by another convention; nothing where none fits."""
    moments = run.commanded.at(t_s)
    if moments.known.sum() < max(MIN_PAIRS, 0.1 * len(t_s)):
        return
    rows = np.flatnonzero(moments.known)
    pairs = Pairs(telemetry.path, telemetry.line[telemetry.valid][rows], moments.q[rows], q[rows], names=COMMANDED)
    try:
        refuse_conventions(pairs, float(np.arctan(0.5 * np.hypot(*run.scale.resolution_px) / run.scale.focal_px)))
    except InputError as refusal:
        if "wild" not in str(refusal) and "out of view" not in str(refusal):
            raise


def _turned(rotation: FloatArray) -> str:
    turn = to_rotation_vector(rotation)
    angle = float(np.linalg.norm(turn))
    axis = ",".join(f"{value:.3f}" for value in turn / max(angle, 1e-12))
    return f"the reported attitudes are turned by {np.degrees(angle):.4g} degrees about {axis} (cam) from the commanded ones"


def _other_axes(rotation: FloatArray) -> str:
    """Which axes a large constant rotation (4,) stands for, "" where it is none of the 24 ways to name right-handed axes."""
    matrix = to_matrix(rotation)
    nearest = np.zeros((3, 3))
    for row in range(3):
        column = int(np.argmax(np.abs(matrix[row])))
        nearest[row, column] = np.sign(matrix[row, column])
    off = np.arccos(np.clip((np.trace(matrix @ nearest.T) - 1) / 2, -1, 1))
    if abs(np.linalg.det(nearest) - 1) > 1e-9 or off > NEAR_AXES_RAD:
        return ""
    names = ["xyz"[int(np.argmax(np.abs(row)))] for row in nearest]
    signs = ["-" if row.sum() < 0 else "+" for row in nearest]
    axes = ", ".join(f"{own} = {sign}{name}" for own, sign, name in zip("xyz", signs, names, strict=True))
    return f"they fit axes with {axes} of hilstar's; write them for x right, y down in the image, z boresight"
