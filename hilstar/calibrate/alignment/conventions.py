"""Quaternions that are written by another convention than hilstar's, told by which one makes all pairs agree."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.calibrate.alignment.pairs import Pairs
from hilstar.calibrate.alignment.rotation_fit import AGREE_RAD, start_of
from hilstar.errors import InputError
from hilstar.rotation import conjugate, multiply, to_matrix
from hilstar.units import ARCSEC_PER_RAD

MAX_PAIRS = 500  # spread over the table, are enough to tell a convention
CLEARLY = 5.0  # how many times better another convention must fit before it is believed where the pairs agree as they are
CLEARLY_RAD = 30.0 / ARCSEC_PER_RAD  # of scatter: no convention is sought behind less
SIMPLER = 1.5  # the simpler of two conventions that fit about as well is named

Change = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Convention:
    """What could have been done to the commanded and to the reported quaternions, and the cure."""

    commanded: Change
    reported: Change
    cure: str


def _as_is(q: FloatArray) -> FloatArray:
    return q


def _scalar_last(q: FloatArray) -> FloatArray:
    return np.roll(q, 1, axis=-1)  # (x, y, z, w) read as (w, x, y, z)


def _inverse_last(q: FloatArray) -> FloatArray:
    return conjugate(_scalar_last(q))


def _flipped(kept: int) -> Change:
    signs = np.array([1.0, -1.0, -1.0, -1.0])
    signs[kept] = 1.0
    return lambda q: q * signs


def _conventions(names: tuple[str, ...]) -> Iterator[Convention]:
    """The usual mistakes, the most usual first."""
    w, x, y, z = names
    these = ",".join(names)
    inverse = f"are the inverse (cam to ICRS); write {w},-{x},-{y},-{z}"
    last = f"have the scalar last; write it first, as {w}"
    yield Convention(_as_is, conjugate, f"the tracker's quaternions ({these}) {inverse}")
    yield Convention(_as_is, _scalar_last, f"the tracker's quaternions ({these}) {last}")
    yield Convention(_as_is, _inverse_last, f"the tracker's quaternions ({these}) {last}; and they {inverse}")
    for axis, kept in zip("xyz", (1, 2, 3), strict=True):
        cure = f"are mirrored in {axis}: write them for right-handed axes, x right and y down in the image"
        yield Convention(_as_is, _flipped(kept), f"the tracker's quaternions ({these}) {cure}")
    both = (
        "either both quaternions are the inverse (cam to ICRS) or have the scalar last, or the tracker's reference frame is not"
    )
    yield Convention(conjugate, conjugate, f"{both} ICRS; write q_icrs_to_cam, scalar first, in ICRS")
    yield Convention(_scalar_last, _as_is, "the commanded quaternions have the scalar last; write w first")
    yield Convention(_scalar_last, conjugate, f"the commanded quaternions have the scalar last, and the tracker's {inverse}")


def refuse_conventions(pairs: Pairs, field_radius_rad: float) -> None:
    """Refuse (InputError) pairs that agree by another convention than hilstar's, or of which half or more are wild.

    Also where the rotation would turn the screen, of `field_radius_rad`, out of the tracker's view.
    """
    few = np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(int))
    commanded, reported = pairs.commanded[few], pairs.reported[few]
    rotation, spread = _spread(commanded, reported)
    out_of_view = _boresight_rad(rotation) > field_radius_rad
    found = []
    for convention in _conventions(pairs.names):
        other, reach = _spread(convention.commanded(commanded), convention.reported(reported))
        if reach <= AGREE_RAD and _boresight_rad(other) <= field_radius_rad:
            found.append((reach, convention.cure))
    best = min((reach for reach, _ in found), default=np.inf)
    cure = next((cure for reach, cure in found if reach <= SIMPLER * best), "")
    agrees = spread <= AGREE_RAD
    if cure and (not agrees or out_of_view or (spread > CLEARLY_RAD and CLEARLY * best < spread)):
        raise InputError(f"{pairs.source}: no one rotation leads from the commanded to the reported attitudes; {cure}")
    if not agrees:
        raise InputError(
            f"{pairs.source}: half or more of the reported attitudes are wild: no more than half of {len(pairs)} agree within"
            f" {np.degrees(AGREE_RAD):g} degree of one rotation; look for lost stars, rows of other times, or another sky"
        )
    if out_of_view:
        raise InputError(
            f"{pairs.source}: the z axis of the reported attitudes is {np.degrees(_boresight_rad(rotation)):.3g} degrees off"
            " the boresight, and the screen would be out of view; write them for cam axes (z boresight, x right, y down)"
        )


def _spread(commanded: FloatArray, reported: FloatArray) -> tuple[FloatArray, float]:
    """The rotation that half of all pairs are nearest to, and how near, rad."""
    rotations = multiply(reported, conjugate(commanded))
    rotation, angle = start_of(rotations)
    return rotation, float(np.quantile(angle, 0.5, method="higher"))


def _boresight_rad(rotation: FloatArray) -> float:
    """How far a rotation turns the boresight."""
    turned = to_matrix(rotation)[:, 2]
    return float(np.arctan2(np.hypot(turned[0], turned[1]), turned[2]))
