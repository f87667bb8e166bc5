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
        if pairs.skipped:
            skipped = f" ({pairs.skipped} more are not valid)"
        else:
            skipped = ""
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
    if pairs.rate_rad_s is None:
        rate_rad_s = None
    else:
        rate_rad_s = pairs.rate_rad_s[used]
    covariance, dof = fit.covariance_rad2(groups_of(pairs.commanded))
    return Aligned(
        pairs=pairs,
        fit=fit,
        residual=residual_of(pairs.commanded[used], rate_rad_s, fit.residual_rad[used], fit.q),
        camera=camera,
        q_cam_to_mon=corrected(from_matrix(camera.cam_to_image), fit.q),
        covariance_arcsec2=ARCSEC_PER_RAD**2 * covariance,
        dof=dof,
        wild=tuple(pairs.line[~used].tolist()),
    )


def corrected(q_cam_to_mon: FloatArray, q_commanded_to_reported: FloatArray) -> FloatArray:
    """The alignment (4,), w >= 0, with which the tracker reports what is commanded: Q' = Q M*."""
    q = normalise(multiply(q_cam_to_mon, conjugate(q_commanded_to_reported)))
    return np.asarray(-q if q[0] < 0 else q)


def groups_of(commanded: FloatArray) -> IntArray:
    """The group (n,) of each commanded attitude (n, 4); attitudes within SAME_ATTITUDE have one
    group.
    """
    largest = np.argmax(np.abs(commanded), axis=1)
    sign = np.sign(np.take_along_axis(commanded, largest[:, None], axis=1))
    rounded = np.round(commanded * sign / SAME_ATTITUDE).astype(np.int64)
    return np.asarray(np.unique(rounded, axis=0, return_inverse=True)[1]).reshape(-1)


def residual_of(
    commanded: FloatArray, rate_rad_s: FloatArray | None, residual_rad: FloatArray, q: FloatArray
) -> Residual:
    """Judge the residuals (n, 3), rad, of pairs without wild ones; `q` is the fitted rotation."""
    group = groups_of(commanded)
    cross = residual_rad[:, :2]
    roll = residual_rad[:, 2:]
    dof = max(1.0 - 1.0 / len(group), 0.5)
    rms = AxesArcsec(
        *(ARCSEC_PER_RAD * float(np.sqrt((part**2).mean() / dof)) for part in (cross, roll))
    )
    repeat = unexplained = None
    if len(group) - group.max() - 1 >= MIN_REPEATS:
        judged = (_against_repeats(part, group) for part in (cross, roll))
        repeat, unexplained = (AxesArcsec(*of_axes) for of_axes in zip(*judged, strict=True))
    return Residual(
        rms,
        repeat,
        unexplained,
        int(group.max()) + 1,
        _causes(commanded, rate_rad_s, residual_rad, q, group),
    )


def _against_repeats(part: FloatArray, group: IntArray) -> tuple[float, float]:
    """The scatter of repeats, and the excess scatter of the attitudes' means over it, arcsec."""
    count = np.bincount(group)
    pairs = len(group)
    groups = len(count)
    axes = part.shape[1]
    means = _means(part, group)
    within = float(((part - means[group]) ** 2).sum()) / (axes * (pairs - groups))
    repeat = ARCSEC_PER_RAD * float(np.sqrt(within))
    within = max(within, FLOOR_RAD**2)
    if groups < 2:
        return repeat, 0.0
    between = float((count[:, None] * (means - part.mean(axis=0)) ** 2).sum()) / (
        axes * (groups - 1)
    )
    if between / within <= _f_limit(axes * (groups - 1), axes * (pairs - groups)):
        return repeat, 0.0
    usual = (pairs - float((count**2).sum()) / pairs) / (groups - 1)
    return repeat, ARCSEC_PER_RAD * float(np.sqrt((between - within) / usual))


def _causes(
    commanded: FloatArray,
    rate_rad_s: FloatArray | None,
    residual_rad: FloatArray,
    q: FloatArray,
    group: IntArray,
) -> tuple[str, ...]:
    """Causes that explain most of the residual: a turned reference frame, a clock's offset, a
    drift.

    They are fitted to the mean of each attitude's pairs, so that an attitude counts once however
    often it was repeated.
    """
    row = np.linspace(-0.5, 0.5, len(group))[:, None]
    if group.max() == 0:
        group = np.arange(len(group))
    if group.max() + 1 < MIN_ATTITUDES:
        return ()
    means = _means(residual_rad, group)
    causes = []
    # A turn n of the reference frame: C R(n) C* is a turn by C n in cam.
    frames = np.stack(
        [
            to_matrix(q_commanded)
            for q_commanded in commanded[np.unique(group, return_index=True)[1]]
        ]
    )
    turn = _explained(means, frames)
    if turn is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(turn))
        causes.append(
            f"a reference frame turned by {size:.3g} arcsec explains most of it: does the tracker"
            " report in ICRS, not of date?"
        )
    if rate_rad_s is not None:
        late = _explained(means, -_means(rate_rad_s @ to_matrix(q).T, group)[:, :, None])
        if late is not None:
            causes.append(
                f"times that are {late[0]:+.4f} s off explain most of it: add that to --offset-s"
            )
    drift = _explained(means, _means(row, group)[:, :, None] * np.eye(3))
    if drift is not None:
        size = ARCSEC_PER_RAD * float(np.linalg.norm(drift))
        causes.append(
            f"a drift by {size:.3g} arcsec from the first row to the last explains most of it: did"
            " the mount move?"
        )
    return tuple(causes)


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    return (
        np.stack([np.bincount(group, column) for column in values.T], axis=1)
        / np.bincount(group)[:, None]
    )


def _explained(residual_rad: FloatArray, columns: FloatArray) -> FloatArray | None:
    """The amounts (p,) of the columns (n, 3, p) that, beside a constant turn, explain most of
    residuals (n, 3); else None.
    """
    pairs, _, amounts = columns.shape
    scale = np.sqrt((residual_rad**2).mean(axis=0))
    cross = max(float(np.sqrt((scale[0] ** 2 + scale[1] ** 2) / 2)), FLOOR_RAD)
    weight = 1 / np.array([cross, cross, max(float(scale[2]), FLOOR_RAD)])
    wanted = (residual_rad - residual_rad.mean(axis=0)) * weight
    design = ((columns - columns.mean(axis=0)) * weight[:, None]).reshape(3 * pairs, amounts)
    solution, _, rank, _ = np.linalg.lstsq(design, wanted.ravel(), rcond=1e-6)
    free = 3 * pairs - 3 - rank
    whole = float((wanted**2).sum())
    unexplained = float(((wanted.ravel() - design @ solution) ** 2).sum())
    if (
        rank < amounts
        or free < 3
        or unexplained > (1 - MIN_EXPLAINED) * whole
        or whole < pairs * (FLOOR_RAD / cross) ** 2
    ):
        return None
    ratio = (whole - unexplained) / amounts / max(unexplained / free, 1e-30)
    if ratio > _f_limit(amounts, free):
        return np.asarray(solution)
    return None


def _f_limit(above: float, below: float) -> float:
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
    write_geometry(
        path, camera, found.q_cam_to_mon, Notes(sigma, error, made, identity or notes.identity)
    )


def summary_of(found: Aligned) -> dict[str, Any]:
    """An alignment in figures, by the keys of --json.

    `rotation_arcsec` is the rotation vector from the commanded to the reported attitude, cam axes,
    with `sigma_arcsec` of each axis. `wild_rows` are lines of the file. `repeat_arcsec` and
    `unexplained_arcsec` are None where too few attitudes repeat.
    """
    residual = found.residual
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
        "repeat_arcsec": None if residual.repeat is None else asdict(residual.repeat),
        "unexplained_arcsec": (
            None if residual.unexplained is None else asdict(residual.unexplained)
        ),
        "q_cam_to_mon": found.q_cam_to_mon.tolist(),
        "notes": remarks_of(found),
    }


def remarks_of(found: Aligned) -> tuple[str, ...]:
    """What the figures alone do not say."""
    residual = found.residual
    remarks = []
    unexplained = residual.unexplained
    if residual.attitudes == 1:
        remarks.append(ONE_ATTITUDE)
    elif unexplained is None:
        remarks.append(NO_REPEATS)
    elif unexplained.cross > 0 or unexplained.roll > 0:
        parts = (("across", unexplained.cross), ("about", unexplained.roll))
        excess = " and ".join(
            f"{value:.3g} arcsec rms {where} the boresight" for where, value in parts if value > 0
        )
        remarks.append(
            f"a rotation does not explain {excess}: calibrate the geometry with dots (hilstar"
            " calibrate geometric)"
        )
    return (*remarks, *residual.causes)


def lines_of(found: Aligned) -> list[str]:
    """The alignment for a person."""
    residual = found.residual
    wild = found.wild
    pairs = found.pairs
    parts = zip(found.rotation_arcsec, found.sigma_arcsec, strict=True)
    x, y, z = (f"{value:.2f} +- {sigma:.2f}" for value, sigma in parts)
    named = ", ".join(map(str, wild[:MAX_NAMED])) + (", ..." if len(wild) > MAX_NAMED else "")
    if pairs.skipped:
        skipped = f", {pairs.skipped} skipped"
    else:
        skipped = ""
    if residual.attitudes == 1:
        of = "all of one attitude"
    else:
        of = f"of {residual.attitudes} attitudes"
    rows = [
        ("pairs", f"{int(found.fit.used.sum())} of {len(pairs)} used, {of}{skipped}"),
        ("wild", f"{len(wild)}, on lines {named}" if wild else "none"),
        ("reported - commanded", f"x {x}, y {y}, about the boresight {z} arcsec"),
        ("residual", _both(residual.rms)),
    ]
    if residual.repeat is not None and residual.unexplained is not None:
        rows += [
            ("repeats of an attitude", _both(residual.repeat)),
            ("not a rotation", _both(residual.unexplained)),
        ]
    width = max(len(name) for name, _ in rows) + 2
    return [f"{name:{width}}{text}" for name, text in rows] + list(remarks_of(found))


def _both(axes: AxesArcsec) -> str:
    return f"{axes.cross:.3g} arcsec rms across the boresight, {axes.roll:.3g} about it"
