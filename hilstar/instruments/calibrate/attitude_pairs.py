"""Pairs of a commanded and a reported attitude, the one rotation that relates them, and conventions
that are not hilstar's.

Pairs come from a table of both attitudes, or from a tracker's telemetry and the ledger of the run
that it saw.

The rotation is a robust mean of the pairs' rotations. It starts at the one among them that has half
of all nearest to it, and is iterated in the tangent space with Tukey's weights (Beaton and Tukey
1974). Their scale is the median absolute deviation, taken separately across and about the
boresight: a tracker knows its roll several times worse.

A wrong convention (inverse, scalar last, mirrored) is recognised because all pairs agree when it is
undone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.text_tables import finite_numbers, is_valid, read_rows
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA, NS_PER_S
from hilstar.server.record.commanded_run import read_commanded

MAX_TABLE_BYTES = 200_000_000
MAX_ROWS = 100_000
COMMANDED, REPORTED = ("qw", "qx", "qy", "qz"), ("tw", "tx", "ty", "tz")
SKIP = "delete the row, or write valid = 0"
PAIRS_ADVICE = (
    f"write a CSV with the columns {','.join((*COMMANDED, *REPORTED))} (commanded, then the"
    " tracker's; scalar first)"
)
# two rotations further apart do not belong to one alignment, whatever the noise
AGREE_RAD = np.radians(1.0)
# one of them is near the truth with probability 1 - 2^-100 while fewer than half are wild
STARTS = 100
# Tukey's weights end here, in sigmas of three axes together: 7e-8 of a Gaussian lies beyond. The
# scale of a few pairs is itself uncertain, so for n of them it is 6 (1 + (10 / n)^2): 12 of 1000
# clean sets of 3 pairs then lose one, at most 2 of 4 and more.
CUT_SIGMAS, FEW = 6.0, 10.0
FLOOR_RAD = 0.01 / ARCSEC_PER_RAD  # smallest scale: the digits of written quaternions
ROUNDS, DONE_RAD = 50, 1e-13
MAX_PAIRS = 500  # enough, spread over the table, to recognise a convention
CLEARLY = 5.0  # how many times better another convention must fit where the pairs agree as they are
CLEARLY_RAD = 30.0 / ARCSEC_PER_RAD  # below this scatter no other convention is sought
# the simpler convention is named if its fit is at most this many times worse than the best
SIMPLER = 1.5

Change = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Pairs:
    """Commanded and reported unit q_icrs_to_cam, (n, 4) each, with each pair's line in its file.

    `rate_rad_s` (n, 3), cam, is the commanded rate, None without a ledger. `skipped` counts rows
    that are not valid or have no commanded attitude. `names` are the reported columns.
    """

    source: Path
    line: IntArray
    commanded: FloatArray
    reported: FloatArray
    skipped: int = 0
    rate_rad_s: FloatArray | None = None
    names: tuple[str, ...] = REPORTED

    def __len__(self) -> int:
        return len(self.line)


def read_pairs(path: Path) -> Pairs:
    """The pairs of a table; rows with valid = 0 are skipped. Raises InputError with the line of
    what is no attitude.
    """
    columns = (*COMMANDED, *REPORTED)
    lines: list[int] = []
    numbers: list[list[float]] = []
    skipped = 0
    for line, cells in read_rows(path, columns, PAIRS_ADVICE, MAX_TABLE_BYTES):
        if not is_valid(path, line, cells[-1]):
            skipped += 1
            continue
        lines.append(line)
        numbers.append(finite_numbers(path, line, columns, cells[:-1], SKIP))
        if len(lines) > MAX_ROWS:
            raise InputError(f"{path}: more than {MAX_ROWS} rows; write fewer")
    line_of = np.array(lines, dtype=np.intp)
    both = np.array(numbers).reshape(len(lines), len(columns))
    commanded = _unit(path, line_of, both[:, :4], COMMANDED)
    reported = _unit(path, line_of, both[:, 4:], REPORTED)
    return Pairs(path, line_of, commanded, reported, skipped)


def _unit(path: Path, lines: IntArray, q: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Unit quaternions (n, 4) of the columns `names`. Raises InputError with the line of one
    whose norm is not 1.
    """
    norm = np.sqrt((q * q).sum(axis=1))
    off = np.abs(norm - 1) > NORM_TOLERANCE
    if off.any():
        first = int(np.argmax(off))
        raise InputError(
            f"{path}:{lines[first]}: the norm of {','.join(names)} is {norm[first]:.6g}; write unit"
            f" quaternions, within {NORM_TOLERANCE:g}"
        )
    if len(q):
        return normalise(q)
    return q


def pair_with_ledger(path: Path, ledger: Path, offset_s: float) -> Pairs:
    """Pair each valid row of telemetry with the attitude that a run commanded at the row's time
    plus `offset_s`.

    A ledger's `light_ns` is on the sender's clock, when the middle row lights. Rows before, after
    or within a gap or a jump of the frames are skipped. Raises InputError for telemetry or a ledger
    that cannot be read, and where no row is left.
    """
    telemetry = read_telemetry(path, rising=False)
    run = read_commanded(ledger)
    valid = telemetry.valid
    row_ns = telemetry.t_ns[valid] + round(offset_s * NS_PER_S)
    t_s = run.seconds(row_ns)
    moments = run.commanded.at(t_s)
    known = moments.known
    if not known.any():
        zero_s = run.zero_ns / NS_PER_S
        times = _span(t_s + zero_s)
        lit = _span(run.commanded.t_s + zero_s)
        raise InputError(
            f"{path}: its times, {times}, meet no frame of {ledger}, lit from {lit} on the sender's"
            " clock; write t_s on that clock, or add --offset-s"
        )
    line = telemetry.line[valid]
    reported = telemetry.q[valid]
    skipped = len(valid) - int(known.sum())
    return Pairs(
        source=path,
        line=line[known],
        commanded=moments.q[known],
        reported=reported[known],
        skipped=skipped,
        rate_rad_s=moments.rate_rad_s[known],
        names=COMMANDED,
    )


def _span(t_s: FloatArray) -> str:
    """The first and the last of times, in words."""
    return f"{t_s.min():.3f} to {t_s.max():.3f} s"


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The rotation (4,), and each pair's residual (n, 3), rad, and weight (n,), 0 for a wild
    pair.
    """

    q: FloatArray
    residual_rad: FloatArray
    weight: FloatArray

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which pairs (n,) are not wild."""
        return np.asarray(self.weight > 0)

    def covariance_rad2(self, group: IntArray) -> tuple[FloatArray, int]:
        """Covariance (3, 3) of the rotation, cam axes, if errors within each `group` (n,) are
        common to it, and its freedom.

        The pairs of a single group count as independent, so that an error of that attitude itself
        is not included.
        """
        used_groups = np.unique(group[self.used])
        if len(used_groups) == 1:
            group = np.arange(len(group))
            used_groups = group[self.used]
        weighted = self.weight[:, None] * self.residual_rad
        sums = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], axis=1)
        groups = max(len(used_groups), 2)
        total = float(self.weight.sum())
        return np.asarray(sums.T @ sums * groups / (groups - 1) / total**2), groups - 1


def start_of(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation among (n, 4) that has half of all nearest to it, and the angle (n,) of each
    to it, rad.
    """
    chosen = np.unique(np.linspace(0, len(rotations) - 1, STARTS).astype(int))
    best = rotations[0]
    angles = np.zeros(len(rotations))
    reach = np.inf
    for candidate in rotations[chosen]:
        angle = _angles_to(rotations, candidate)
        half = float(np.quantile(angle, 0.5, method="higher"))
        if half < reach:
            best = candidate
            angles = angle
            reach = half
    return best, angles


def _angles_to(rotations: FloatArray, q: FloatArray) -> FloatArray:
    """Angles (n,) between rotations (n, 4) and the rotation q, rad."""
    product = rotations @ q
    # q and -q are one rotation
    sign = np.where(product[:, None] < 0, -1.0, 1.0)
    cosine = np.abs(product)
    chord = np.linalg.norm(rotations - sign * q, axis=1)
    # The chord is exact for tiny angles, where the cosine is not.
    by_chord = 4 * np.arcsin(np.minimum(chord / 2, 1.0))
    by_cosine = 2 * np.arccos(np.minimum(cosine, 1.0))
    return np.where(cosine > 0.5, by_chord, by_cosine)


def fit_rotation(rotations: FloatArray) -> RotationFit:
    """The robust mean of rotations (n, 4), of which more than half agree within AGREE_RAD."""
    q, angle = start_of(rotations)
    near = angle <= AGREE_RAD
    q = _moved(q, np.median(_residuals(rotations[near], q), axis=0))
    pairs = max(int(near.sum()), 1)
    cut = CUT_SIGMAS * (1 + (FEW / pairs) ** 2)
    for _ in range(ROUNDS):
        residual = _residuals(rotations, q)
        weight = _weights(residual, near, cut)
        step = (weight[:, None] * residual).sum(axis=0) / weight.sum()
        q = _moved(q, step)
        if np.linalg.norm(step) < DONE_RAD:
            break
    residual = _residuals(rotations, q)
    return RotationFit(q, residual, _weights(residual, near, cut))


def _residuals(rotations: FloatArray, q: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3), rad, from the rotation q to others (n, 4)."""
    return to_rotation_vector(multiply(rotations, conjugate(q)))


def _moved(q: FloatArray, step_rad: FloatArray) -> FloatArray:
    """The rotation after a step, rad."""
    return normalise(multiply(from_rotation_vector(step_rad), q))


def _weights(residual: FloatArray, near: npt.NDArray[np.bool_], cut: float) -> FloatArray:
    """Tukey's weights (n,) of residuals (n, 3); all those that are near where none is within the
    cut.
    """
    off = np.abs(residual[near])
    cross = max(MAD_TO_SIGMA * float(np.median(off[:, :2])), FLOOR_RAD)
    roll = max(MAD_TO_SIGMA * float(np.median(off[:, 2])), FLOOR_RAD)
    x, y, z = residual.T
    cross_squared = (x**2 + y**2) / cross**2
    squared = cross_squared + z**2 / roll**2
    is_within = near & (squared < cut**2)
    weight = np.where(is_within, (1 - squared / cut**2) ** 2, 0.0)
    if weight.any():
        return weight
    return near.astype(np.float64)


def _as_is(q: FloatArray) -> FloatArray:
    return q


def _scalar_last(q: FloatArray) -> FloatArray:
    return np.roll(q, 1, axis=-1)  # (x, y, z, w) read as (w, x, y, z)


def _conventions(names: tuple[str, ...]) -> Iterator[tuple[Change, Change, str]]:
    """The usual mistakes, the most usual first: the changes of commanded and of reported
    quaternions, and the cure.
    """
    w, x, y, z = names
    tracker = f"the tracker's quaternions ({','.join(names)})"
    inverse = f"are the inverse (cam to ICRS); write {w},-{x},-{y},-{z}"
    last = f"have the scalar last; write it first, as {w}"
    yield _as_is, conjugate, f"{tracker} {inverse}"
    yield _as_is, _scalar_last, f"{tracker} {last}"
    yield _as_is, lambda q: conjugate(_scalar_last(q)), f"{tracker} {last}; and they {inverse}"
    for axis, signs in (("x", (1, 1, -1, -1)), ("y", (1, -1, 1, -1)), ("z", (1, -1, -1, 1))):
        mirror = partial(np.multiply, np.array(signs, dtype=np.float64))
        cure = (
            f"are mirrored in {axis}: write them for right-handed axes, x right and y down in the"
            " image"
        )
        yield _as_is, mirror, f"{tracker} {cure}"
    both = (
        "either both quaternions are the inverse (cam to ICRS) or have the scalar last, or the"
        " tracker's reference frame is not"
    )
    yield conjugate, conjugate, f"{both} ICRS; write q_icrs_to_cam, scalar first, in ICRS"
    yield _scalar_last, _as_is, "the commanded quaternions have the scalar last; write w first"
    yield (
        _scalar_last,
        conjugate,
        f"the commanded quaternions have the scalar last, and the tracker's {inverse}",
    )


def refuse_conventions(pairs: Pairs, field_radius_rad: float) -> None:
    """Refuse (InputError) pairs that agree only by another convention than hilstar's, or half or
    more of which are wild.

    Also where the rotation would turn the screen, of `field_radius_rad`, out of the tracker's view.
    """
    few = np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(int))
    commanded = pairs.commanded[few]
    reported = pairs.reported[few]
    rotation, spread = _spread(commanded, reported)
    agrees = spread <= AGREE_RAD
    out_of_view = _boresight_rad(rotation) > field_radius_rad
    cures = []
    for change_commanded, change_reported, cure in _conventions(pairs.names):
        other, reach = _spread(change_commanded(commanded), change_reported(reported))
        if reach <= AGREE_RAD and _boresight_rad(other) <= field_radius_rad:
            cures.append((reach, cure))
    best = min((reach for reach, _ in cures), default=np.inf)
    cure = next((cure for reach, cure in cures if reach <= SIMPLER * best), "")
    is_clearly_better = spread > CLEARLY_RAD and CLEARLY * best < spread
    if cure and (not agrees or is_clearly_better):
        raise InputError(
            f"{pairs.source}: no one rotation leads from the commanded to the reported attitudes;"
            f" {cure}"
        )
    if not agrees:
        raise InputError(
            f"{pairs.source}: half or more of the reported attitudes are wild: no more than half of"
            f" {len(pairs)} agree within {np.degrees(AGREE_RAD):g} degree of one rotation; look for"
            " lost stars, rows of other times, or another sky"
        )
    if out_of_view:
        off_deg = np.degrees(_boresight_rad(rotation))
        advice = "write them for cam axes (z boresight, x right, y down)"
        if cure:
            advice = f"{advice}, or {cure}"
        raise InputError(
            f"{pairs.source}: the z axis of the reported attitudes is {off_deg:.3g} degrees off the"
            f" boresight, and the screen would be out of view; {advice}"
        )


def _spread(commanded: FloatArray, reported: FloatArray) -> tuple[FloatArray, float]:
    """The rotation with half of all pairs nearest to it, and the angle within which they lie,
    rad.
    """
    rotations = multiply(reported, conjugate(commanded))
    rotation, angle = start_of(rotations)
    return rotation, float(np.quantile(angle, 0.5, method="higher"))


def _boresight_rad(rotation: FloatArray) -> float:
    """How far a rotation turns the boresight, rad."""
    x, y, z = to_matrix(rotation)[:, 2]
    return float(np.arctan2(np.hypot(x, y), z))
