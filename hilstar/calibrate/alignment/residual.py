"""What of the residual is noise, and what no rotation explains: attitudes against their own repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.alignment.pairs import Pairs
from hilstar.rotation import to_matrix
from hilstar.units import ARCSEC_PER_RAD

SAME_ATTITUDE = (
    5e-5  # of a quaternion's component: 10 arcsec, within which two attitudes show the same stars at the same places
)
MIN_REPEATS = 3  # degrees of freedom of the repeats' scatter
FALSE_ALARM = 1e-3
FLOOR_RAD = 1e-3 / ARCSEC_PER_RAD  # of the noise: quaternions without any are still rounded
MIN_EXPLAINED = 0.5  # of the residual's squares, before a cause is named
MIN_ATTITUDES = 6  # before a cause is sought


@dataclass(frozen=True, slots=True)
class AxesArcsec:
    """An rms of one axis, arcsec: across the boresight (x and y together) and about it."""

    cross: float
    roll: float


@dataclass(frozen=True, slots=True)
class Residual:
    """The residual of the pairs that are used: whole, of repeats of one attitude (None without any), and what is beyond these.

    `unexplained` is 0 where the repeats' scatter explains the whole; `causes` are lines that name what goes with it.
    """

    rms: AxesArcsec
    repeat: AxesArcsec | None
    unexplained: AxesArcsec | None
    attitudes: int
    causes: tuple[str, ...]


def groups_of(commanded: FloatArray) -> IntArray:
    """A number (n,) for each commanded attitude (n, 4): the same for those within SAME_ATTITUDE."""
    largest = np.argmax(np.abs(commanded), axis=1)
    sign = np.sign(np.take_along_axis(commanded, largest[:, None], axis=1))
    rounded = np.round(commanded * sign / SAME_ATTITUDE).astype(np.int64)
    return np.asarray(np.unique(rounded, axis=0, return_inverse=True)[1]).reshape(-1)


def residual_of(pairs: Pairs, residual_rad: FloatArray, q: FloatArray) -> Residual:
    """Judge the residuals (n, 3), rad, of pairs of which none is wild; `q` is the rotation that was fitted."""
    group = groups_of(pairs.commanded)
    cross, roll = residual_rad[:, :2], residual_rad[:, 2:]
    judged = [_against_repeats(part, group) for part in (cross, roll)]
    dof = max(1.0 - 1.0 / len(pairs), 0.5)
    rms = AxesArcsec(*(ARCSEC_PER_RAD * float(np.sqrt((part**2).mean() / dof)) for part in (cross, roll)))
    found = [each for each in judged if each is not None]
    repeat = unexplained = None
    if len(found) == 2:
        repeat = AxesArcsec(found[0][0], found[1][0])
        unexplained = AxesArcsec(found[0][1], found[1][1])
    return Residual(rms, repeat, unexplained, int(group.max()) + 1, _causes(pairs, residual_rad, q, group))


def _against_repeats(part: FloatArray, group: IntArray) -> tuple[float, float] | None:
    """One axis's scatter of repeats, and what the attitudes' means scatter beyond it, arcsec; None where too few repeat."""
    count = np.bincount(group)
    pairs, groups, axes = len(group), len(count), part.shape[1]
    if pairs - groups < MIN_REPEATS:
        return None
    means = _means(part, group)
    within = float(((part - means[group]) ** 2).sum()) / (axes * (pairs - groups))
    repeat = ARCSEC_PER_RAD * float(np.sqrt(within))
    within = max(within, FLOOR_RAD**2)
    if groups < 2:
        return repeat, 0.0
    between = float((count[:, None] * (means - part.mean(axis=0)) ** 2).sum()) / (axes * (groups - 1))
    if between / within <= _f_limit(axes * (groups - 1), axes * (pairs - groups)):
        return repeat, 0.0
    usual = (pairs - float((count**2).sum()) / pairs) / (groups - 1)
    return repeat, ARCSEC_PER_RAD * float(np.sqrt((between - within) / usual))


def _causes(pairs: Pairs, residual_rad: FloatArray, q: FloatArray, group: IntArray) -> tuple[str, ...]:
    """What goes with the residual and explains most of it: a turned reference frame, a clock's offset, a drift.

    By the means of each attitude's pairs: what repeats share would count as often as they repeat.
    """
    row = np.linspace(-0.5, 0.5, len(pairs))[:, None]
    if group.max() == 0:
        group = np.arange(len(pairs))
    if group.max() + 1 < MIN_ATTITUDES:
        return ()
    means = _means(residual_rad, group)
    causes = []
    # A turn n of the reference frame: C R(n) C* is a turn by C n in cam.
    frames = np.stack([to_matrix(each) for each in pairs.commanded[np.unique(group, return_index=True)[1]]])
    turn = _explained(means, frames)
    if turn is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(turn))
        causes.append(
            f"a reference frame turned by {size:.3g} arcsec explains most of it: does the tracker report in ICRS, not of date?"
        )
    if pairs.rate_rad_s is not None:
        late = _explained(means, -_means(pairs.rate_rad_s @ to_matrix(q).T, group)[:, :, None])
        if late is not None:
            causes.append(f"times that are {late[0]:+.4f} s off explain most of it: add that to --offset-s")
    drift = _explained(means, _means(row, group)[:, :, None] * np.eye(3))
    if drift is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(drift))
        causes.append(f"a drift by {size:.3g} arcsec from the first row to the last explains most of it: did the mount move?")
    return tuple(causes)


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """The means (g, k) of each group's rows of (n, k)."""
    return np.stack([np.bincount(group, column) for column in values.T], axis=1) / np.bincount(group)[:, None]


def _explained(residual_rad: FloatArray, columns: FloatArray) -> FloatArray | None:
    """The amounts (p,) of the columns (n, 3, p), beside a constant turn, where they explain most of (n, 3); else None."""
    pairs, _, amounts = columns.shape
    scale = np.sqrt((residual_rad**2).mean(axis=0))
    cross = max(float(np.sqrt((scale[0] ** 2 + scale[1] ** 2) / 2)), FLOOR_RAD)
    weight = 1 / np.array([cross, cross, max(float(scale[2]), FLOOR_RAD)])
    wanted = (residual_rad - residual_rad.mean(axis=0)) * weight
    design = ((columns - columns.mean(axis=0)) * weight[:, None]).reshape(3 * pairs, amounts)
    found, _, rank, _ = np.linalg.lstsq(design, wanted.ravel(), rcond=1e-6)
    free = 3 * pairs - 3 - rank
    whole, left = float((wanted**2).sum()), float(((wanted.ravel() - design @ found) ** 2).sum())
    if rank < amounts or free < 3 or left > (1 - MIN_EXPLAINED) * whole or whole < pairs * (FLOOR_RAD / cross) ** 2:
        return None
    ratio = (whole - left) / amounts / max(left / free, 1e-30)
    return np.asarray(found) if ratio > _f_limit(amounts, free) else None


def _f_limit(above: float, below: float) -> float:
    from scipy.special import fdtri  # F's quantile; scipy.stats has the same one and takes half a second to import

    return float(fdtri(above, below, 1 - FALSE_ALARM))
