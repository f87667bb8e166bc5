"""How the error depends on the frame: the field's rate, its brightness, and the display's own
error.

For the display's own error, the twin's noiseless tracker looks at the display and at the sky, at
attitudes of the run. A star's place differs between the two: codes are too coarse for a place
between pixels, or the true lens is not the assumed one. The display's attitude error is the small
rotation e that turns the sky's directions v into the shown ones, v + e x v. Stars are weighted by
their light.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import normalise, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.instruments.assess.budget import Axes, axes_of_variance
from hilstar.instruments.simulate.glass import MIN_STARS as MIN_SPLIT_STARS
from hilstar.instruments.simulate.glass import split_errors, told_psf
from hilstar.instruments.simulate.noise import attitude_limits_arcsec, field_stars
from hilstar.instruments.simulate.star_finder import star_finder
from hilstar.instruments.simulate.twin import Twin
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera, tracker_psf
from hilstar.server.bench.star_glass import star_glass
from hilstar.server.bench.star_light import bench_stars
from hilstar.tracker.centroiders import star_places

BINS, MIN_IN_BIN = 5, 20
# attitudes at which the field's light is summed; other answers take the nearest of them
FIELDS = 400
LIMIT_FIELDS = 12  # attitudes whose stars tell the limit of the noise
MIN_STARS = 3
Centroids = Sequence[tuple[float, float, float | None, int | None]]
FILE = "PSF file"
SEEN_FIELDS, WRONG_SHARE = 400, 5.0
# attitudes, and the brightest stars of each, that tell a glass's part
GLASS_FIELDS, GLASS_STARS = 40, 20
SURE = 3.0


@dataclass(frozen=True, slots=True)
class Slice:
    """Answers between two values of a quantity: count, noise (one sigma) and whole error (rms
    about the bias), arcsec.
    """

    low: float
    high: float
    answers: int
    noise_cross_arcsec: float
    noise_roll_arcsec: float
    rms_cross_arcsec: float
    rms_roll_arcsec: float


def slices_of(
    value: FloatArray, residual: FloatArray, error: FloatArray, freedom: float
) -> tuple[Slice, ...]:
    """Up to five slices with equal numbers of answers, by a value (n,), of noise (n, 3) and errors
    about the bias (n, 3).

    `freedom` is the number of degrees of freedom that the fits took.
    """
    known = np.isfinite(value)
    value = value[known]
    residual = residual[known]
    error = error[known]
    count = len(value)
    if count < MIN_IN_BIN:
        return ()
    growth = len(known) / max(len(known) - freedom, 1.0)
    spread = float(np.ptp(value))
    if spread > 1e-3 * max(abs(float(np.median(value))), 1e-6):
        bins = min(BINS, count // MIN_IN_BIN)
    else:
        bins = 1
    edges = np.unique(np.quantile(value, np.linspace(0, 1, bins + 1)))
    if len(edges) < 2:
        edges = np.array([value.min(), value.max()])
    place = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    slices = []
    for k in range(len(edges) - 1):
        rows = place == k
        if rows.sum() >= MIN_IN_BIN:
            noise = growth * (residual[rows] ** 2).mean(axis=0)
            whole = (error[rows] ** 2).mean(axis=0)
            axes = []
            for bounds in (noise, whole):
                for part in ((bounds[0] + bounds[1]) / 2, bounds[2]):
                    axes.append(float(np.sqrt(part)))
            slices.append(Slice(float(edges[k]), float(edges[k + 1]), int(rows.sum()), *axes))
    return tuple(slices)


def field_magnitudes(file: BenchFile, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The V magnitude of all catalogued light in the field, sampled along attitudes (n, 4); NaN
    without a star.

    The precision of an attitude grows with the light of all stars together. Raises InputError for a
    wrong catalogue.
    """
    stars = bench_stars(file.config, file.folder)
    camera = tracker_camera(file.config.tracker, file.folder)
    width, height = camera.resolution_px
    some = np.unique(np.linspace(0, len(q_icrs_to_cam) - 1, FIELDS).astype(int))
    axes = to_matrix(q_icrs_to_cam[some])
    reach = 2 * np.sin(min(camera.field_radius_rad(0.0), np.pi / 2) / 2)
    light = np.zeros(len(some))
    near: list[IntArray] = [
        np.array(star_rows, dtype=np.intp)
        for star_rows in cKDTree(stars.vectors).query_ball_point(axes[:, 2], reach)
    ]
    for k, star_rows in enumerate(near):
        x_px, y_px = camera.project(stars.vectors[star_rows] @ axes[k].T)
        inside = (x_px > -0.5) & (x_px < width - 0.5) & (y_px > -0.5) & (y_px < height - 0.5)
        light[k] = float(flux_ratio(stars.v_mag[star_rows][inside]).sum())
    field = np.where(light > 0, magnitude(np.maximum(light, 1e-30)), np.nan)
    nearest = np.abs(np.searchsorted(some, np.arange(len(q_icrs_to_cam))).clip(0, len(some) - 1))
    return np.asarray(field[nearest])


def noise_limit(file: BenchFile, q_icrs_to_cam: FloatArray) -> Axes:
    """The smallest noise of an answer by the bench's tracker (Cramer and Rao): the median along
    attitudes (n, 4).

    One exposure at rest, arcsec; None for fields of too few stars. Raises InputError.
    """
    some = np.unique(np.linspace(0, len(q_icrs_to_cam) - 1, LIMIT_FIELDS).astype(int))
    median = np.median(attitude_limits_arcsec(file, q_icrs_to_cam[some]), axis=0).tolist()
    return Axes(*(axis_arcsec if math.isfinite(axis_arcsec) else None for axis_arcsec in median))


def display_errors(file: BenchFile, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The display's attitude errors (n, 3), arcsec, cam axes, at attitudes (n, 4); NaN where it
    shows too few stars.

    Raises InputError for a bench that cannot be built, and MachineError without OpenGL.
    """
    errors = np.full((len(q_icrs_to_cam), 3), np.nan)
    with Twin(file) as twin:
        finder = star_finder(twin.bench, twin.monitor_px_per_px)
        for number, q in enumerate(q_icrs_to_cam):
            field = twin.field(q, number)
            sky, shown = (
                finder.match(image, field.x_px, field.y_px)
                for image in (field.sky_e, field.shown_e)
            )
            both = (sky.index >= 0) & (shown.index >= 0)
            if both.sum() >= MIN_STARS:
                i = sky.index[both]
                j = shown.index[both]
                true = normalise(twin.camera.rays(sky.found.x_px[i], sky.found.y_px[i]))
                rays = normalise(twin.camera.rays(shown.found.x_px[j], shown.found.y_px[j]))
                errors[number] = ARCSEC_PER_RAD * turn_between(true, rays, sky.found.flux[i])
    return errors


def turn_between(true: FloatArray, seen: FloatArray, weight: FloatArray) -> FloatArray:
    """The small rotation (3,), rad, that turns unit vectors (n, 3) into others with the smallest
    weighted error.
    """
    cross = np.zeros((len(true), 3, 3))  # e x v = -[v] e
    x, y, z = true.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = z, -y, x
    cross -= np.swapaxes(cross, 1, 2)
    root = np.sqrt(weight)[:, None]
    turn, *_ = np.linalg.lstsq(
        (cross * root[:, :, None]).reshape(-1, 3), ((seen - true) * root).ravel(), rcond=None
    )
    return np.asarray(turn)


@dataclass(frozen=True, slots=True)
class GlassCost:
    """What glass does to the places of stars, by the centroids that answers hold (`source`), or
    else by the bench's PSF file.

    `rms_px` and `fov_arcsec` have all of it (`total`), and what each correction would leave: a
    distortion file, one by catalogue colour, both. `fov_arcsec` is the attitude's error about its
    mean over `attitudes`, one sigma.
    """

    source: str
    centroider: str
    stars: int
    attitudes: int
    rms_px: dict[str, float]
    fov_arcsec: dict[str, Axes]

    def line(self) -> str:
        """For a person."""
        figures = {name: f"{axes.cross or 0.0:.2g}" for name, axes in self.fov_arcsec.items()}
        return (
            f"{figures['total']} arcsec across by the {self.source}, as `{self.centroider}` finds"
            f" {self.stars} stars; distortion corrected {figures['without_distortion']}, colour"
            f" {figures['without_colour']}, both {figures['without_both']}"
        )


def glass_cost(file: BenchFile, q_icrs_to_cam: FloatArray) -> GlassCost | None:
    """The glass's part of the field-of-view error along attitudes (n, 4); None without a glass,
    or with too few stars.
    """
    tracker = file.config.tracker
    fields = []
    psf = tracker_psf(tracker, file.folder)
    camera = tracker_camera(tracker, file.folder)
    glass = star_glass(file, psf)
    if glass is None:
        return None
    stars = bench_stars(file.config, file.folder)
    kind = file.config.verify.judge or "window"
    reach = math.ceil(4 * max(1.0, *psf.width_px))
    some = np.unique(np.linspace(0, len(q_icrs_to_cam) - 1, GLASS_FIELDS).astype(int))
    for q in normalise(q_icrs_to_cam[some]):
        rows = field_stars(stars, camera, q)[:GLASS_STARS]
        pixels = np.rint(rows["y_px"]).astype(np.intp), np.rint(rows["x_px"]).astype(np.intp)
        true = np.stack([rows["x_px"] - pixels[1], rows["y_px"] - pixels[0]], axis=1)
        stamps = told_psf(psf, pixels, 2 * reach + 1, glass.shares_of(stars, rows["hip"]))(*true.T)
        places_px = np.stack(star_places(stamps, kind, psf.width_px), axis=1)
        lit = stamps.sum(axis=(1, 2)) > 0  # a corner may be dark
        if lit.sum() >= MIN_STARS:
            fields.append((rows[lit], (places_px - true)[lit]))
    return _cost(FILE, kind, camera, fields)


def seen_cost(
    file: BenchFile, q_icrs_to_cam: FloatArray, centroids: Sequence[Centroids]
) -> GlassCost | None:
    """The same by the stars that answers name, [x_px, y_px, dn, hip], against the bench's camera at
    their attitudes (n, 4).

    The tracker's noise is in it. None for too few stars.
    """
    camera = tracker_camera(file.config.tracker, file.folder)
    stars = bench_stars(file.config, file.folder)
    fields = []
    named = []
    for k, reported_stars in enumerate(centroids):
        if len([star for star in reported_stars if star[3]]) >= MIN_STARS:
            named.append(k)
    if not named:
        return None
    spread = np.linspace(0, len(named) - 1, SEEN_FIELDS).astype(int)
    for k in sorted({named[place] for place in spread.tolist()}):
        at = {star[3]: star[:2] for star in centroids[k] if star[3]}
        rows = field_stars(stars, camera, q_icrs_to_cam[k])
        rows = rows[np.isin(rows["hip"], list(at))]
        reported_px = np.array([at[hip] for hip in rows["hip"].tolist()]).reshape(-1, 2)
        fields.append((rows, reported_px - np.stack([rows["x_px"], rows["y_px"]], axis=1)))
    far_px = np.concatenate([np.hypot(*off.T) for _, off in fields])
    # a star by another's name is no error of places
    usual_px = max(WRONG_SHARE * float(np.median(far_px)), 1.0)
    near = [np.hypot(*off.T) < usual_px for _, off in fields]
    good_fields = [
        (rows[good], off[good])
        for (rows, off), good in zip(fields, near, strict=True)
        if good.sum() >= MIN_STARS
    ]
    return _cost("answers' stars", "tracker", camera, good_fields)


def _cost(
    source: str,
    kind: str,
    camera: Camera,
    fields: Sequence[tuple[npt.NDArray[np.void], FloatArray]],
) -> GlassCost | None:
    """By stars of fields, rows of TRUTH_DTYPE, and errors of their places (n, 2), px; None for
    too few stars.
    """
    if sum(len(rows) for rows, _ in fields) < MIN_SPLIT_STARS:
        return None
    rows, errors = (np.concatenate(parts) for parts in zip(*fields, strict=True))
    split = split_errors(
        np.stack([rows["x_px"], rows["y_px"]], axis=1), rows["bv"], errors, camera.resolution_px
    )
    parts = {
        "total": split.total,
        "without_distortion": split.total - split.distortion,
        "without_colour": split.total - split.colour,
        "without_both": split.psf,
    }
    ends = np.cumsum([len(field_rows) for field_rows, _ in fields])[:-1]
    fov = {}
    for name, off in parts.items():
        turns = np.array(
            [
                _field_turn(camera, field_rows, px)
                for (field_rows, _), px in zip(fields, np.split(off, ends), strict=True)
            ]
        )
        fov[name] = axes_of_variance(turns.var(axis=0))
    rms_px = {name: float(np.sqrt((off**2).sum(axis=1).mean())) for name, off in parts.items()}
    return GlassCost(source, kind, len(rows), len(fields), rms_px, fov)


def _field_turn(camera: Camera, rows: npt.NDArray[np.void], off_px: FloatArray) -> FloatArray:
    """The attitude's error (3,), arcsec, by stars whose places are off by `off_px` (n, 2)."""
    true, shown = (
        normalise(camera.rays(rows["x_px"] + dx, rows["y_px"] + dy))
        for dx, dy in ((0.0, 0.0), off_px.T)
    )
    return ARCSEC_PER_RAD * turn_between(true, shown, rows["electrons_per_s"])


@dataclass(frozen=True, slots=True)
class DisplayCost:
    """The display's own error, one sigma across and about the boresight, arcsec, at `attitudes` of
    the run.

    `seen` is the share of it in the tracker's answers, with one sigma: 1 if the tracker looked at
    this display, 0 if not.
    """

    cross_arcsec: float
    roll_arcsec: float
    attitudes: int
    seen: float
    sigma_seen: float

    @property
    def subtracted(self) -> float:
        """The share of the display's variance that is subtracted from the noise; 0 unless `seen`
        exceeds three sigma.
        """
        if self.seen > SURE * self.sigma_seen:
            return min(self.seen, 1.0) ** 2
        return 0.0


def display_cost(error_arcsec: FloatArray, left_arcsec: FloatArray) -> DisplayCost | None:
    """The cost from the display's errors (n, 3), NaN for none, and the tracker's noise (n, 3) at
    the same attitudes.
    """
    known = np.isfinite(error_arcsec).all(axis=1)
    if known.sum() < MIN_STARS:
        return None
    error = error_arcsec[known] - error_arcsec[known].mean(axis=0)
    residual = left_arcsec[known]
    variance = np.maximum((residual**2).mean(axis=0), 1e-12)
    information = float((error**2 / variance).sum())
    share = float((error * residual / variance).sum()) / max(information, 1e-30)
    power = (error**2).sum(axis=0) / max(len(error) - 1, 1)
    return DisplayCost(
        cross_arcsec=float(np.sqrt(power[:2].mean())),
        roll_arcsec=float(np.sqrt(power[2])),
        attitudes=int(known.sum()),
        seen=share,
        sigma_seen=1 / float(np.sqrt(max(information, 1e-30))),
    )
