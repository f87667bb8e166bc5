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

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import normalise, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.instruments.assess.budget import Axes, axes_of_variance
from hilstar.instruments.assess.places import spread_rows
from hilstar.instruments.simulate.glass import MIN_STARS as MIN_SPLIT_STARS
from hilstar.instruments.simulate.glass import split_errors, told_psf
from hilstar.instruments.simulate.noise import attitude_limits_arcsec, field_stars
from hilstar.instruments.simulate.star_finder import Matched, star_finder
from hilstar.instruments.simulate.twin import Twin
from hilstar.optics.camera import Camera
from hilstar.server.answers.answer import ReportedStar
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
Centroids = Sequence[ReportedStar]
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
    usual = abs(float(np.median(value)))
    if spread > 1e-3 * max(usual, 1e-6):
        bins = min(BINS, count // MIN_IN_BIN)
    else:
        bins = 1
    shares = np.linspace(0, 1, bins + 1)
    edges = np.unique(np.quantile(value, shares))
    if len(edges) < 2:
        edges = np.array([value.min(), value.max()])
    last = len(edges) - 2
    above = np.searchsorted(edges, value, side="right")
    place = np.clip(above - 1, 0, last)
    slices = []
    for k in range(last + 1):
        rows = place == k
        answers = int(rows.sum())
        if answers < MIN_IN_BIN:
            continue
        noise = growth * (residual[rows] ** 2).mean(axis=0)
        whole = (error[rows] ** 2).mean(axis=0)
        low = float(edges[k])
        high = float(edges[k + 1])
        slices.append(Slice(low, high, answers, *_across_about(noise), *_across_about(whole)))
    return tuple(slices)


def _across_about(variance: FloatArray) -> tuple[float, float]:
    """One sigma across and about the boresight from variances (3,)."""
    x, y, z = variance
    cross = float(np.sqrt((x + y) / 2))
    roll = float(np.sqrt(z))
    return cross, roll


def field_magnitudes(file: BenchFile, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The V magnitude of all catalogued light in the field, sampled along attitudes (n, 4); NaN
    without a star.

    The precision of an attitude grows with the light of all stars together. Raises InputError for a
    wrong catalogue.
    """
    stars = bench_stars(file.config, file.folder)
    camera = tracker_camera(file.config.tracker, file.folder)
    width, height = camera.resolution_px
    answers = len(q_icrs_to_cam)
    some = spread_rows(answers, FIELDS)
    axes = to_matrix(q_icrs_to_cam[some])
    radius_rad = min(camera.field_radius_rad(0.0), np.pi / 2)
    reach = 2 * np.sin(radius_rad / 2)  # a chord
    light = np.zeros(len(some))
    near = cKDTree(stars.vectors).query_ball_point(axes[:, 2], reach)
    for k, near_rows in enumerate(near):
        star_rows = np.array(near_rows, dtype=np.intp)
        x_px, y_px = camera.project(stars.vectors[star_rows] @ axes[k].T)
        inside_x = (x_px > -0.5) & (x_px < width - 0.5)
        inside_y = (y_px > -0.5) & (y_px < height - 0.5)
        v_mag = stars.v_mag[star_rows][inside_x & inside_y]
        light[k] = float(flux_ratio(v_mag).sum())
    field_mag = magnitude(np.maximum(light, 1e-30))
    field_mag = np.where(light > 0, field_mag, np.nan)
    nearest = np.searchsorted(some, np.arange(answers))
    nearest = np.abs(nearest.clip(0, len(some) - 1))
    return np.asarray(field_mag[nearest])


def noise_limit(file: BenchFile, q_icrs_to_cam: FloatArray) -> Axes:
    """The smallest noise of an answer by the bench's tracker (Cramer and Rao): the median along
    attitudes (n, 4).

    One exposure at rest, arcsec; None for fields of too few stars. Raises InputError.
    """
    some = spread_rows(len(q_icrs_to_cam), LIMIT_FIELDS)
    limits_arcsec = attitude_limits_arcsec(file, q_icrs_to_cam[some])
    cross_arcsec, roll_arcsec = np.median(limits_arcsec, axis=0).tolist()
    return Axes(_finite(cross_arcsec), _finite(roll_arcsec))


def _finite(value: float) -> float | None:
    if math.isfinite(value):
        return value
    return None


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
            sky = finder.match(field.sky_e, field.x_px, field.y_px)
            shown = finder.match(field.shown_e, field.x_px, field.y_px)
            errors[number] = matched_turn(twin.camera, sky, shown)
    return errors


def matched_turn(camera: Camera, sky: Matched, shown: Matched) -> FloatArray:
    """The turn (3,), arcsec, cam axes, from the stars of the sky to the same ones as shown, by the
    sky's light; NaN for fewer than MIN_STARS that are found in both.
    """
    both = (sky.index >= 0) & (shown.index >= 0)
    if both.sum() < MIN_STARS:
        return np.full(3, np.nan)
    i = sky.index[both]
    j = shown.index[both]
    true_rays = camera.rays(sky.found.x_px[i], sky.found.y_px[i])
    shown_rays = camera.rays(shown.found.x_px[j], shown.found.y_px[j])
    light = sky.found.flux[i]
    return ARCSEC_PER_RAD * turn_between(normalise(true_rays), normalise(shown_rays), light)


def turn_between(true: FloatArray, seen: FloatArray, weight: FloatArray) -> FloatArray:
    """The small rotation (3,), rad, that turns unit vectors (n, 3) into others with the smallest
    weighted error.
    """
    cross = np.zeros((len(true), 3, 3))  # e x v = -[v] e
    x, y, z = true.T
    cross[:, 0, 1] = z
    cross[:, 0, 2] = -y
    cross[:, 1, 2] = x
    cross -= np.swapaxes(cross, 1, 2)
    root = np.sqrt(weight)[:, None]
    design = (cross * root[:, :, None]).reshape(-1, 3)
    difference = ((seen - true) * root).ravel()
    turn, *_ = np.linalg.lstsq(design, difference, rcond=None)
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
        """The cost in one line of text."""
        total = self._across("total")
        distortion = self._across("without_distortion")
        colour = self._across("without_colour")
        both = self._across("without_both")
        means = f"by the {self.source}, as `{self.centroider}` finds {self.stars} stars"
        corrected = f"distortion corrected {distortion}, colour {colour}, both {both}"
        return f"{total} arcsec across {means}; {corrected}"

    def _across(self, part: str) -> str:
        cross_arcsec = self.fov_arcsec[part].cross or 0.0
        return f"{cross_arcsec:.2g}"


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
    side_px = 2 * reach + 1
    some = spread_rows(len(q_icrs_to_cam), GLASS_FIELDS)
    for q in normalise(q_icrs_to_cam[some]):
        rows = field_stars(stars, camera, q)[:GLASS_STARS]
        row_px = np.rint(rows["y_px"]).astype(np.intp)
        column_px = np.rint(rows["x_px"]).astype(np.intp)
        true_px = np.stack([rows["x_px"] - column_px, rows["y_px"] - row_px], axis=1)
        shares = glass.shares_of(stars, rows["hip"])
        star_psf = told_psf(psf, (row_px, column_px), side_px, shares)
        stamps = star_psf(*true_px.T)
        places_px = np.stack(star_places(stamps, kind, psf.width_px), axis=1)
        errors_px = places_px - true_px
        lit = stamps.sum(axis=(1, 2)) > 0  # a corner may be dark
        if lit.sum() >= MIN_STARS:
            fields.append((rows[lit], errors_px[lit]))
    return _cost(FILE, kind, camera, fields)


def seen_cost(
    file: BenchFile, q_icrs_to_cam: FloatArray, centroids: Sequence[Centroids]
) -> GlassCost | None:
    """What the glass does to the stars that answers name: their places against those of the
    bench's camera at attitudes (n, 4).

    The tracker's noise is in it. None for too few stars.
    """
    camera = tracker_camera(file.config.tracker, file.folder)
    stars = bench_stars(file.config, file.folder)
    named = []
    for k, reported_stars in enumerate(centroids):
        named_stars = [star for star in reported_stars if star.hip]
        if len(named_stars) >= MIN_STARS:
            named.append(k)
    if not named:
        return None
    fields = []
    distances_px = []
    for place in spread_rows(len(named), SEEN_FIELDS).tolist():
        k = named[place]
        at = {star.hip: (star.x_px, star.y_px) for star in centroids[k] if star.hip}
        rows = field_stars(stars, camera, q_icrs_to_cam[k])
        rows = rows[np.isin(rows["hip"], list(at))]
        reported = [at[hip] for hip in rows["hip"].tolist()]
        reported_px = np.array(reported).reshape(-1, 2)
        true_px = np.stack([rows["x_px"], rows["y_px"]], axis=1)
        errors_px = reported_px - true_px
        fields.append((rows, errors_px))
        distances_px.append(np.hypot(*errors_px.T))
    median_px = float(np.median(np.concatenate(distances_px)))
    # a star by another's name is no error of places
    usual_px = max(WRONG_SHARE * median_px, 1.0)
    good_fields = []
    for (rows, errors_px), distance_px in zip(fields, distances_px, strict=True):
        good = distance_px < usual_px
        if good.sum() >= MIN_STARS:
            good_fields.append((rows[good], errors_px[good]))
    return _cost("answers' stars", "tracker", camera, good_fields)


def _cost(
    source: str,
    kind: str,
    camera: Camera,
    fields: Sequence[tuple[npt.NDArray[np.void], FloatArray]],
) -> GlassCost | None:
    """The cost by the stars of each field, rows of TRUTH_DTYPE, and the errors of their places
    (n, 2), px; None for too few stars.
    """
    counts = [len(field_rows) for field_rows, _ in fields]
    if sum(counts) < MIN_SPLIT_STARS:
        return None
    stars_of_fields, errors_of_fields = zip(*fields, strict=True)
    rows = np.concatenate(stars_of_fields)
    errors_px = np.concatenate(errors_of_fields)
    places_px = np.stack([rows["x_px"], rows["y_px"]], axis=1)
    split = split_errors(places_px, rows["bv"], errors_px, camera.resolution_px)
    parts = {
        "total": split.total,
        "without_distortion": split.total - split.distortion,
        "without_colour": split.total - split.colour,
        "without_both": split.psf,
    }
    ends = np.cumsum(counts)[:-1]
    rms_px = {}
    fov_arcsec = {}
    for name, off_px in parts.items():
        turns_arcsec = []
        off_of_fields = np.split(off_px, ends)
        for field_rows, field_off_px in zip(stars_of_fields, off_of_fields, strict=True):
            turns_arcsec.append(_field_turn(camera, field_rows, field_off_px))
        variance = np.array(turns_arcsec).var(axis=0)
        fov_arcsec[name] = axes_of_variance(variance)
        squared_px = (off_px**2).sum(axis=1)
        rms_px[name] = float(np.sqrt(squared_px.mean()))
    return GlassCost(source, kind, len(rows), len(fields), rms_px, fov_arcsec)


def _field_turn(camera: Camera, rows: npt.NDArray[np.void], off_px: FloatArray) -> FloatArray:
    """The attitude's error (3,), arcsec, by stars whose places are off by `off_px` (n, 2)."""
    x_px = rows["x_px"]
    y_px = rows["y_px"]
    dx_px, dy_px = off_px.T
    true = normalise(camera.rays(x_px, y_px))
    shown = normalise(camera.rays(x_px + dx_px, y_px + dy_px))
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
    error = error_arcsec[known]
    error = error - error.mean(axis=0)
    residual = left_arcsec[known]
    variance = np.maximum((residual**2).mean(axis=0), 1e-12)
    information = float((error**2 / variance).sum())
    information = max(information, 1e-30)
    common = float((error * residual / variance).sum())
    count = len(error)
    power = (error**2).sum(axis=0) / max(count - 1, 1)
    return DisplayCost(
        cross_arcsec=float(np.sqrt(power[:2].mean())),
        roll_arcsec=float(np.sqrt(power[2])),
        attitudes=count,
        seen=common / information,
        sigma_seen=1 / float(np.sqrt(information)),
    )
