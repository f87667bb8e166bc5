"""From pairs of attitudes to a geometry file: the rotation between them, taken out of
`q_cam_to_mon`.

The screen shows the star at v (ICRS) where the camera Q C v has it, with C the commanded attitude
and Q the file's q_cam_to_mon; the tracker, which truly stands at Q', sees it in the direction Q'* Q
C v, and so reports T = Q'* Q C. The rotation M = T C* of all pairs is then Q'* Q, and Q' = Q M*.

The residual is judged by attitudes that were repeated: their scatter is noise, and what exceeds it
no rotation explains.
"""

import datetime
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    conjugate,
    from_matrix,
    multiply,
    normalise,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.basics.version import __version__
from hilstar.display.geometry import (
    ErrorTable,
    MadeTable,
    Notes,
    load_geometry,
    load_notes,
    write_geometry,
)
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.attitude_pairs import (
    Pairs,
    RotationFit,
    fit_rotation,
    pair_with_ledger,
    read_pairs,
    refuse_conventions,
)
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import bench_camera

MIN_PAIRS = 3
# Two attitudes whose quaternions agree to this, 10 arcsec, show the same stars at the same places.
SAME_ATTITUDE = 5e-5
MIN_REPEATS = 3  # degrees of freedom of the repeats' scatter
FALSE_ALARM = 1e-3
FLOOR_RAD = 1e-3 / ARCSEC_PER_RAD  # smallest noise: quaternions are rounded
MIN_EXPLAINED = 0.5  # share of the residual's squares that a named cause explains
MIN_ATTITUDES = 6  # minimum from which a cause is sought
MAX_NAMED = 10  # wild rows
ONE_ATTITUDE = (
    "one attitude: it determines the rotation, but does not tell what changes with attitude; take"
    " several, all over the sky"
)
NO_REPEATS = (
    "no attitude was repeated: the residual cannot be told from the tracker's noise; take some"
    " attitudes several times"
)


@dataclass(frozen=True, slots=True)
class AxesArcsec:
    """Rms across the boresight, per axis (x and y together), and about it, arcsec."""

    cross: float
    roll: float


@dataclass(frozen=True, slots=True)
class Residual:
    """The residual of the pairs used: the whole, the scatter of repeated attitudes (None without
    any), and the excess over it.

    `unexplained` is 0 where the repeats' scatter explains the whole; `causes` are lines that name a
    likely cause.
    """

    rms: AxesArcsec
    repeat: AxesArcsec | None
    unexplained: AxesArcsec | None
    attitudes: int
    causes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Aligned:
    """The rotation from the commanded to the reported attitudes, and the alignment that takes it
    out.

    `camera` is the bench's present geometry. `wild` are the lines of the file whose pairs do not
    fit the rotation.
    """

    pairs: Pairs
    fit: RotationFit
    residual: Residual
    camera: Camera
    q_cam_to_mon: FloatArray
    covariance_arcsec2: FloatArray
    dof: int
    wild: tuple[int, ...]

    @property
    def sigma_arcsec(self) -> tuple[float, float, float]:
        """One sigma of the rotation about x, y and z, cam axes."""
        x, y, z = np.sqrt(np.diag(self.covariance_arcsec2)).tolist()
        return x, y, z

    @property
    def rotation_arcsec(self) -> tuple[float, float, float]:
        """The rotation vector from the commanded to the reported attitude, cam axes: x, y, and z
        about the boresight.
        """
        x, y, z = (ARCSEC_PER_RAD * to_rotation_vector(self.fit.q)).tolist()
        return x, y, z


def align_files(file: BenchFile, table: Path, ledger: Path | None, offset_s: float) -> Aligned:
    """Align a bench by a table of pairs, or by the telemetry of a run with its ledger. Raises
    InputError.
    """
    if ledger is None:
        pairs = read_pairs(table)
    else:
        pairs = pair_with_ledger(table, ledger, offset_s)
    return align(pairs, bench_camera(file.config, file.folder))


def align(pairs: Pairs, camera: Camera) -> Aligned:
    """Find the alignment of a tracker behind the monitor's `camera`.

    Raises InputError, with the cure, for too few pairs, other conventions, and half or more of wild
    ones.
    """
    if len(pairs) < MIN_PAIRS:
        skipped = ""
        if pairs.skipped:
            skipped = f" ({pairs.skipped} more are not valid)"
        raise InputError(
            f"{pairs.source}: {len(pairs)} pairs{skipped} and {MIN_PAIRS} are needed; measure more"
            " attitudes"
        )
    refuse_conventions(pairs, camera.field_radius_rad(0.0))
    fit = fit_rotation(multiply(pairs.reported, conjugate(pairs.commanded)))
    used = fit.used
    if 2 * used.sum() <= len(pairs):
        raise InputError(
            f"{pairs.source}: half or more of the reported attitudes are wild: {used.sum()} of"
            f" {len(pairs)} agree; look for lost stars, and rows of other times"
        )
    rate_rad_s = None
    if pairs.rate_rad_s is not None:
        rate_rad_s = pairs.rate_rad_s[used]
    covariance, dof = fit.covariance_rad2(groups_of(pairs.commanded))
    commanded = pairs.commanded[used]
    place = np.linspace(-0.5, 0.5, len(pairs))[used]
    residual = residual_of(commanded, rate_rad_s, fit.residual_rad[used], fit.q, place)
    q_nominal = from_matrix(camera.cam_to_image)
    wild = tuple(pairs.line[~used].tolist())
    return Aligned(
        pairs=pairs,
        fit=fit,
        residual=residual,
        camera=camera,
        q_cam_to_mon=corrected(q_nominal, fit.q),
        covariance_arcsec2=ARCSEC_PER_RAD**2 * covariance,
        dof=dof,
        wild=wild,
    )


def corrected(q_cam_to_mon: FloatArray, q_commanded_to_reported: FloatArray) -> FloatArray:
    """The alignment (4,), w >= 0, with which the tracker reports what is commanded: Q' = Q M*."""
    q = normalise(multiply(q_cam_to_mon, conjugate(q_commanded_to_reported)))
    # q and -q are one rotation
    if q[0] < 0:
        q = -q
    return np.asarray(q)


def groups_of(commanded: FloatArray) -> IntArray:
    """The group (n,) of each commanded attitude (n, 4); attitudes within SAME_ATTITUDE have one
    group.
    """
    # q and -q are one attitude: the largest component is made positive
    largest = np.argmax(np.abs(commanded), axis=1)
    sign = np.sign(np.take_along_axis(commanded, largest[:, None], axis=1))
    rounded = np.round(commanded * sign / SAME_ATTITUDE).astype(np.int64)
    _, group = np.unique(rounded, axis=0, return_inverse=True)
    return np.asarray(group).reshape(-1)


def residual_of(
    commanded: FloatArray,
    rate_rad_s: FloatArray | None,
    residual_rad: FloatArray,
    q: FloatArray,
    place: FloatArray,
) -> Residual:
    """Judge the residuals (n, 3), rad, of pairs without wild ones; `q` is the fitted rotation,
    and `place` (n,) each pair's from the first row, -0.5, to the last, 0.5, of all.
    """
    group = groups_of(commanded)
    attitudes = int(group.max()) + 1
    cross = residual_rad[:, :2]
    roll = residual_rad[:, 2:]
    # the mean rotation is taken from the residuals themselves
    dof = max(1.0 - 1.0 / len(group), 0.5)
    repeat = unexplained = None
    if len(group) - attitudes >= MIN_REPEATS:
        cross_repeat, cross_excess = _against_repeats(cross, group)
        roll_repeat, roll_excess = _against_repeats(roll, group)
        repeat = AxesArcsec(cross_repeat, roll_repeat)
        unexplained = AxesArcsec(cross_excess, roll_excess)
    return Residual(
        rms=AxesArcsec(_rms_arcsec(cross, dof), _rms_arcsec(roll, dof)),
        repeat=repeat,
        unexplained=unexplained,
        attitudes=attitudes,
        causes=_causes(commanded, rate_rad_s, residual_rad, q, group, place),
    )


def _rms_arcsec(residual_rad: FloatArray, dof: float) -> float:
    """The rms of residuals (n, axes) along an axis, where a share `dof` of them is free."""
    return ARCSEC_PER_RAD * float(np.sqrt((residual_rad**2).mean() / dof))


def _against_repeats(part: FloatArray, group: IntArray) -> tuple[float, float]:
    """The scatter of repeats, and the excess scatter of the attitudes' means over it, arcsec."""
    count = np.bincount(group)
    pairs = len(group)
    groups = len(count)
    axes = part.shape[1]
    means = _means(part, group)
    free_within = axes * (pairs - groups)
    within = float(((part - means[group]) ** 2).sum()) / free_within
    repeat = ARCSEC_PER_RAD * float(np.sqrt(within))
    if groups < 2:
        return repeat, 0.0
    within = max(within, FLOOR_RAD**2)
    free_between = axes * (groups - 1)
    off = means - part.mean(axis=0)
    squares = count[:, None] * off**2
    between = float(squares.sum()) / free_between
    if between / within <= _f_limit(free_between, free_within):
        return repeat, 0.0
    # the usual count of a group's pairs, of groups of several sizes
    usual = (pairs - float((count**2).sum()) / pairs) / (groups - 1)
    return repeat, ARCSEC_PER_RAD * float(np.sqrt((between - within) / usual))


def _causes(
    commanded: FloatArray,
    rate_rad_s: FloatArray | None,
    residual_rad: FloatArray,
    q: FloatArray,
    group: IntArray,
    place: FloatArray,
) -> tuple[str, ...]:
    """Causes that explain most of the residual: a turned reference frame, a clock's offset, a
    drift.

    They are fitted to the mean of each attitude's pairs, so that an attitude counts once however
    often it was repeated.
    """
    if group.max() == 0:
        group = np.arange(len(group))
    if group.max() + 1 < MIN_ATTITUDES:
        return ()
    means = _means(residual_rad, group)
    causes = []
    # A turn n of the reference frame: C R(n) C* is a turn by C n in cam.
    _, first_pair = np.unique(group, return_index=True)
    frames = np.stack([to_matrix(attitude) for attitude in commanded[first_pair]])
    turn = _explained(means, frames)
    if turn is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(turn))
        causes.append(
            f"a reference frame turned by {size:.3g} arcsec explains most of it: does the tracker"
            " report in ICRS, not of date?"
        )
    if rate_rad_s is not None:
        rates = _means(rate_rad_s @ to_matrix(q).T, group)
        late = _explained(means, -rates[:, :, None])
        if late is not None:
            causes.append(
                f"times that are {late[0]:+.4f} s off explain most of it: add that to --offset-s"
            )
    along = _means(place[:, None], group)
    drift = _explained(means, along[:, :, None] * np.eye(3))
    if drift is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(drift))
        causes.append(
            f"a drift by {size:.3g} arcsec from the first row to the last explains most of it: did"
            " the mount move?"
        )
    return tuple(causes)


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """The mean (groups, k) of values (n, k) by group."""
    sums = np.stack([np.bincount(group, column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(group)[:, None])


def _explained(residual_rad: FloatArray, columns: FloatArray) -> FloatArray | None:
    """The amounts (p,) of the columns (n, 3, p) that, beside a constant turn, explain most of
    residuals (n, 3); else None.
    """
    pairs, _, amounts = columns.shape
    scale_x, scale_y, scale_z = np.sqrt((residual_rad**2).mean(axis=0))
    cross = max(float(np.sqrt((scale_x**2 + scale_y**2) / 2)), FLOOR_RAD)
    roll = max(float(scale_z), FLOOR_RAD)
    weight = 1 / np.array([cross, cross, roll])
    wanted = ((residual_rad - residual_rad.mean(axis=0)) * weight).ravel()
    varying = (columns - columns.mean(axis=0)) * weight[:, None]
    design = varying.reshape(3 * pairs, amounts)
    solution, _, rank, _ = np.linalg.lstsq(design, wanted, rcond=1e-6)
    free = 3 * pairs - 3 - rank
    if rank < amounts:
        return None
    whole = float((wanted**2).sum())
    unexplained = float(((wanted - design @ solution) ** 2).sum())
    # what rounding alone makes needs no cause
    if whole < pairs * (FLOOR_RAD / cross) ** 2:
        return None
    if unexplained > (1 - MIN_EXPLAINED) * whole:
        return None
    ratio = (whole - unexplained) / amounts / max(unexplained / free, 1e-30)
    if ratio > _f_limit(amounts, free):
        return np.asarray(solution)
    return None


def _f_limit(above: float, below: float) -> float:
    """The ratio of two variances that chance exceeds once in 1 / FALSE_ALARM, by their degrees of
    freedom.
    """
    # F's quantile; scipy.stats has the same one and takes half a second to import
    from scipy.special import fdtri

    return float(fdtri(above, below, 1 - FALSE_ALARM))


def write_alignment(
    path: Path, found: Aligned, file: BenchFile, identity: MonitorIdentity | None = None
) -> None:
    """Write the bench's present geometry with the alignment that was found. Raises InputError
    where it cannot be written.
    """
    name = file.config.collimator.geometry
    if name is None:
        camera = found.camera
        notes = Notes({}, ErrorTable(model="ideal lens"), MadeTable())
        lens_of = "the bench file"
    else:
        # As the file has it: the bench's own camera is bounded to what this screen needs.
        camera = load_geometry(file.folder / name, found.camera.resolution_px)
        notes = load_notes(file.folder / name)
        lens_of = f"{Path(name).name}, {notes.made.when or 'no date'}"
    axes = ("rotation_x_arcsec", "rotation_y_arcsec", "rotation_z_arcsec")
    made = MadeTable(
        by=f"hilstar {__version__}",
        when=datetime.datetime.now(datetime.UTC).date().isoformat(),
        poses=notes.made.poses,
        pairs=len(found.pairs),
        pairs_used=int(found.fit.used.sum()),
        wild_rows=list(found.wild),
        rotation_arcsec=found.rotation_arcsec,
        lens_of=lens_of,
    )
    rms = found.residual.rms
    error = replace(
        notes.error,
        alignment_cross_arcsec=rms.cross,
        alignment_roll_arcsec=rms.roll,
        alignment_covariance_arcsec2=found.covariance_arcsec2.tolist(),
        alignment_dof=float(found.dof),
    )
    sigma = notes.sigma | dict(zip(axes, found.sigma_arcsec, strict=True))
    new_notes = Notes(sigma, error, made, identity or notes.identity)
    write_geometry(path, camera, found.q_cam_to_mon, new_notes)


def summary_of(found: Aligned) -> dict[str, Any]:
    """An alignment in figures, by the keys of --json.

    `rotation_arcsec` is the rotation vector from the commanded to the reported attitude, cam axes,
    with `sigma_arcsec` of each axis. `wild_rows` are lines of the file. `repeat_arcsec` and
    `unexplained_arcsec` are None where too few attitudes repeat.
    """
    residual = found.residual
    repeat = unexplained = None
    if residual.repeat is not None and residual.unexplained is not None:
        repeat = asdict(residual.repeat)
        unexplained = asdict(residual.unexplained)
    return {
        "pairs": len(found.pairs),
        "used": int(found.fit.used.sum()),
        "wild": len(found.wild),
        "wild_rows": found.wild,
        "skipped": found.pairs.skipped,
        "attitudes": residual.attitudes,
        "rotation_arcsec": found.rotation_arcsec,
        "sigma_arcsec": found.sigma_arcsec,
        "residual_arcsec": asdict(residual.rms),
        "repeat_arcsec": repeat,
        "unexplained_arcsec": unexplained,
        "q_cam_to_mon": found.q_cam_to_mon.tolist(),
        "notes": remarks_of(found.residual),
    }


def remarks_of(residual: Residual) -> tuple[str, ...]:
    """What the figures of an alignment that leaves this alone do not say."""
    remarks = []
    unexplained = residual.unexplained
    if residual.attitudes == 1:
        remarks.append(ONE_ATTITUDE)
    elif unexplained is None:
        remarks.append(NO_REPEATS)
    elif unexplained.cross > 0 or unexplained.roll > 0:
        parts = []
        for value, where in ((unexplained.cross, "across"), (unexplained.roll, "about")):
            if value > 0:
                parts.append(f"{value:.3g} arcsec rms {where} the boresight")
        remarks.append(
            f"a rotation does not explain {' and '.join(parts)}: calibrate the geometry with dots"
            " (hilstar calibrate geometric)"
        )
    return (*remarks, *residual.causes)


def lines_of(found: Aligned) -> list[str]:
    """The alignment for a person."""
    residual = found.residual
    pairs = found.pairs
    axes = []
    for value, sigma in zip(found.rotation_arcsec, found.sigma_arcsec, strict=True):
        axes.append(f"{value:.2f} +- {sigma:.2f}")
    x, y, z = axes
    wild = "none"
    if found.wild:
        named = ", ".join(map(str, found.wild[:MAX_NAMED]))
        if len(found.wild) > MAX_NAMED:
            named += ", ..."
        wild = f"{len(found.wild)}, on lines {named}"
    used = f"{int(found.fit.used.sum())} of {len(pairs)} used"
    if residual.attitudes == 1:
        used += ", all of one attitude"
    else:
        used += f", of {residual.attitudes} attitudes"
    if pairs.skipped:
        used += f", {pairs.skipped} skipped"
    rows = [
        ("pairs", used),
        ("wild", wild),
        ("reported - commanded", f"x {x}, y {y}, about the boresight {z} arcsec"),
        ("residual", _both(residual.rms)),
    ]
    if residual.repeat is not None and residual.unexplained is not None:
        rows += [
            ("repeats of an attitude", _both(residual.repeat)),
            ("not a rotation", _both(residual.unexplained)),
        ]
    width = max(len(name) for name, _ in rows) + 2
    lines = [f"{name:{width}}{text}" for name, text in rows]
    return [*lines, *remarks_of(found.residual)]


def _both(axes: AxesArcsec) -> str:
    return f"{axes.cross:.3g} arcsec rms across the boresight, {axes.roll:.3g} about it"
