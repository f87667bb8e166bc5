"""A geometric calibration from centroids to a file: matching, fit, checks, summary, notes and
chart.
"""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.charts import BLUE, SMALL_PT, chart
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.basics.version import __version__
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, write_geometry
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.geometric import fit as fits
from hilstar.instruments.calibrate.geometric.dot_shape import SMOOTH_PSF_PX
from hilstar.instruments.calibrate.geometric.dots import MIN_DOTS, DotPlan, SeenScreen, read_plan
from hilstar.instruments.calibrate.geometric.match import (
    FirstLook,
    first_look,
    match_by_geometry,
    match_by_maps,
    refuse_motion,
    turned,
)
from hilstar.instruments.calibrate.geometric.observed import Observed, measure_images, read_observed
from hilstar.optics.camera import Lens
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
    ideal_monitor,
    tracker_camera,
)

SEED = 1  # for the random samples of dots: one calibration gives one file
KNOWN_MARGIN = 1.01  # relative to the angle to the corner of the tracker's field
# In a part of the screen, of so many dots that should be seen the share that is: two or three may
# be lost to neighbours.
MIN_CELL_DOTS, MIN_CELL_SHARE = 4, 0.33
CELLS = (("left", "middle", "right"), ("upper", "middle", "lower"))
# along each side of the screen, by which it is known whether the tracker sees all of it
SCREEN_PLACES = 17
REACH_PX = 0.5  # tracker px: a centroid this close to a dot's fitted place is that dot
REACH_SIGMAS = 8.0
MATCH_ROUNDS = 2
DEFAULT_NOISE_PX = 0.05
# A held-out error this many times that of the centroids' noise alone is no lens: a dot's mean is
# off by noise / sqrt(frames).
MAX_MISFIT = 4.0
# Windowed centroids of a Gaussian of 0.5 px are up to 0.009 px off by its place in a pixel, of
# 0.44 px 0.018 px, of 0.37 px 0.038 px. That is taken off by the PSF that is stated or measured;
# of one that is 15 % off about a half stays.
NARROW_DOT_PX = 0.5
MISFIT_FLOOR_ARCSEC = 1.0
ONE_POSE = (
    "one pose: the tracker's own distortion and the collimator's cannot be told apart; this file"
    " holds both"
)
COLLIMATOR_ALONE = (
    "one pose, with the tracker's lens as its flight model says: this file holds the collimator"
    " alone"
)
ROUND = (
    "poses turned about the boresight do not tell apart distortions that are round about it; they"
    " are in the stated error"
)
WIDE_INCH = 5.6  # width of a panel
ARROW_SHARE = 0.03  # length of the median residual's arrow, relative to the screen's width


class MisfitError(InputError):
    """Dots that were left out of a fit are further off than their noise makes."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The result of a geometric calibration: the fit and its uncertainty, the models that were
    compared, and how many `centroids` were given.
    """

    problem: fits.Problem
    data: fits.MatchedDots
    fit: fits.Fit
    models: list[fits.Candidate]
    chosen: fits.Candidate
    uncertainty: fits.Uncertainty
    centroids: int
    tracker_known: bool

    @property
    def plan(self) -> DotPlan:
        """The dots that were shown."""
        return self.problem.plan

    @property
    def recognised(self) -> int:
        """Dots that were recognised."""
        return len(np.unique(self.data.dot))

    @property
    def lost(self) -> int:
        """Lit dots in the tracker's field that have no centroid."""
        expected = 0
        for inside in self.measurable:
            expected += int(self.plan.lit[inside].sum())
        return expected - len(self.data)

    @property
    def measurable(self) -> list[BoolArray]:
        """For each pose, a mask of the dots (dots,) whose windows are in the tracker's image."""
        edge_px = self.data.centroids.edge_px
        return in_view(self.fit.geometry, self.plan.x_px, self.plan.y_px, edge_px)

    @property
    def false(self) -> int:
        """Centroids that are no dot."""
        return self.centroids - len(self.data)

    @property
    def noise_arcsec(self) -> float:
        """The error of one centroid along one axis."""
        focal_length_px = self.problem.nominal.tracker.focal_length_px
        return self.problem.noise_px * ARCSEC_PER_RAD / focal_length_px

    @property
    def held_out_noise_arcsec(self) -> float:
        """The rms that noise alone would give held-out dots."""
        count = np.bincount(self.problem.sites(self.data))
        # of the mean of a place's dots, along both axes
        share2 = 2 * np.mean(1 / count[count > 0])
        return float(np.sqrt(share2) * self.noise_arcsec)


def calibrate_files(
    file: BenchFile,
    observed: Sequence[Path],
    plan: Path,
    dark: Path | None,
    *,
    tracker_is_ideal: bool,
) -> Calibrated:
    """Fit the geometry of a bench file to a table of centroids, or to the tracker's images.
    Raises InputError.
    """
    config = file.config
    dots = read_plan(plan)
    width, height = config.monitor.resolution_px
    is_beyond = dots.x_px.max() > width - 1 or dots.y_px.max() > height - 1
    if is_beyond:
        raise InputError(
            f"{plan}: has dots off this monitor of {width} x {height} px; plan them anew"
        )
    if observed[0].suffix.lower() == ".csv":
        if len(observed) > 1:
            raise InputError(
                f"{observed[1]}: one table is read; write all centroids into {observed[0]}"
            )
        observed_dots = read_observed(observed[0])
    else:
        resolution_px = config.tracker.resolution_px
        observed_dots = measure_images(observed, dark, resolution_px, dot_sigma_px(file))
    return calibrate_seen(file, dots, observed_dots, tracker_is_ideal=tracker_is_ideal)


def calibrate_seen(
    file: BenchFile,
    plan: DotPlan,
    seen: Observed,
    *,
    tracker_is_ideal: bool,
    psf_sigma_px: float | None = None,
) -> Calibrated:
    """Fit the geometry of a bench file to centroids of planned dots, seen through a PSF of this
    sigma (default: the bench file's). Raises InputError.
    """
    nominal = nominal_of(file)
    if psf_sigma_px is None:
        psf_sigma_px = psf_sigma_of(file)
    seen = without_s_curves(plan, nominal, seen, psf_sigma_px)
    known = is_tracker_known(file, is_ideal=tracker_is_ideal)
    rng = np.random.default_rng(SEED)
    try:
        return calibrate_geometry(plan, nominal, seen, rng, tracker_known=known)
    except MisfitError as error:
        raise MisfitError(misfit_words(str(error), dot_sigma_px(file))) from error


def misfit_words(misfit: str, sigma_px: float) -> str:
    """What is said of a misfit where dots have this sigma, tracker px."""
    if sigma_px > NARROW_DOT_PX:
        return misfit
    return (
        f"{misfit}, or dots of sigma {sigma_px:.2f} px lie within a tracker pixel, whose centroids"
        " depend on where: write [tracker] psf_sigma_px as `hilstar calibrate focus` measures it,"
        " or defocus the tracker a little"
    )


def is_tracker_known(file: BenchFile, *, is_ideal: bool) -> bool:
    """Whether the tracker's own lens is held: it is ideal, or the bench file states it."""
    return is_ideal or file.config.tracker.distortion is not None


def nominal_of(file: BenchFile) -> fits.Nominal:
    """The geometry that a bench file has without its geometry file. Raises InputError."""
    config = file.config
    q_cam_to_mon = np.array(config.collimator.q_cam_to_mon)
    tracker = tracker_camera(config.tracker, file.folder)
    return fits.Nominal(ideal_monitor(config), q_cam_to_mon, tracker)


def seen_screen_of(file: BenchFile) -> SeenScreen:
    """What the tracker sees of the screen by a bench file: surely by its geometry file, else
    about. Raises InputError.
    """
    tracker = tracker_camera(file.config.tracker, file.folder)
    monitor = bench_camera(file.config, file.folder)
    is_sure = file.config.collimator.geometry is not None
    return SeenScreen(monitor, tracker, is_sure, psf_sigma_of(file))


def dot_sigma_px(file: BenchFile) -> float:
    """The sigma of a dot in the tracker's image by the bench file, tracker px. Raises
    InputError.
    """
    nominal = nominal_of(file)
    psf_sigma_px = psf_sigma_of(file)
    screen = SeenScreen(nominal.monitor, nominal.tracker, is_sure=False, psf_sigma_px=psf_sigma_px)
    return screen.dot_sigma_px


def psf_sigma_of(file: BenchFile) -> float:
    """How wide the tracker sees a point of the screen by the bench file, its sigma in tracker
    px. Raises InputError.
    """
    psf = before_detector(file.config, file.folder, ideal_monitor(file.config))
    return float(np.mean(psf.width_px))


def rough_geometry(file: BenchFile, plan: DotPlan, seen: Observed) -> SeenScreen:
    """Which part of the screen the tracker sees, by a few dots: enough to put the others there.
    Raises InputError.
    """
    nominal = nominal_of(file)
    look = first_look(plan, nominal, seen, np.random.default_rng(SEED))
    problem, data = matched(plan, nominal, seen, look)
    refuse_few(data)
    rough = fits.fit(problem, fits.Model(fits.RADIAL), 0, data).geometry
    return SeenScreen(rough.monitor, rough.tracker, is_sure=True, psf_sigma_px=psf_sigma_of(file))


def without_s_curves(
    plan: DotPlan, nominal: fits.Nominal, seen: Observed, psf_sigma_px: float
) -> Observed:
    """Centroids without the bias by a dot's place within a pixel, its side and turn by a first
    fit; as they are where the PSF is smooth. Raises InputError.
    """
    if psf_sigma_px > SMOOTH_PSF_PX:
        return seen
    look = first_look(plan, nominal, seen, np.random.default_rng(SEED))
    problem, data = matched(plan, nominal, seen, look)
    refuse_few(data)
    poses = len(look.q_poses)
    rough = fits.fit(problem, fits.Model(fits.RADIAL, (), poses), 0, data).geometry
    for pose, q_cam_to_pose in enumerate(rough.q_poses):
        screen = seen_in_pose(rough, q_cam_to_pose, psf_sigma_px)
        seen = seen.without_s_curve(pose, screen.dot_shape)
    return seen


def seen_in_pose(
    geometry: fits.Geometry, q_cam_to_pose: FloatArray, psf_sigma_px: float
) -> SeenScreen:
    """The part of the screen seen in a pose, to which a quaternion (4,) turns the cam frame."""
    turned_axes = geometry.tracker.cam_to_image @ to_matrix(q_cam_to_pose)
    tracker = replace(geometry.tracker, cam_to_image=turned_axes)
    return SeenScreen(geometry.monitor, tracker, is_sure=True, psf_sigma_px=psf_sigma_px)


def refuse_few(data: fits.MatchedDots) -> None:
    """Refuse (InputError) fewer dots than a fit needs, however many centroids they have."""
    dots = len(np.unique(data.dot))
    if dots < MIN_DOTS:
        raise InputError(
            f"{dots} dots were recognised and {MIN_DOTS} are needed: look at focus, exposure and"
            " stray light, and at whether the tracker sees the part of the screen where the dots"
            " are (plan.csv)"
        )


def calibrate_geometry(
    plan: DotPlan,
    nominal: fits.Nominal,
    seen: Observed,
    rng: np.random.Generator,
    *,
    tracker_known: bool,
) -> Calibrated:
    """Fit a bench's geometry to what the tracker saw of the dots.

    With `tracker_known` the tracker's own lens is held as it is; else it is fitted too, which takes
    two poses or more. Raises InputError, with the cure, for an image that is mirrored or turned,
    for codes or frames that match nothing, for too few dots, and for a fit that its data
    contradict.
    """
    poses = int(seen.pose.max()) + 1
    if not tracker_known and poses == 1:
        raise InputError(
            "with one pose the tracker's own distortion cannot be told from the collimator's; give"
            " its flight model as [tracker] distortion, take a second pose (turn the tracker by 90"
            " or 180 degrees about its boresight), or add --tracker-is-ideal"
        )
    tracker_names: tuple[str, ...] = ()
    if not tracker_known:
        tracker_names = tuple(fits.TRACKER_STEPS)
    look = first_look(plan, nominal, seen, rng)
    problem, data = matched(plan, nominal, seen, look, tracker_names)
    refuse_few(data)
    models = fits.candidates(problem, data, tracker_names)
    chosen = fits.best_of(models)
    fit = fits.fit(problem, chosen.model, chosen.field_degree, data)
    bounded = bounded_to_field(problem, fit)
    calibrated = Calibrated(
        problem=problem,
        data=data,
        fit=bounded,
        models=models,
        chosen=chosen,
        uncertainty=fits.uncertainty_of(problem, bounded, data),
        centroids=len(seen),
        tracker_known=tracker_known,
    )
    is_expected = np.any(calibrated.measurable, axis=0)
    is_seen = np.zeros(len(plan), dtype=bool)
    is_seen[np.unique(calibrated.data.dot)] = True
    refuse_gaps(plan, nominal.monitor.resolution_px, is_expected, is_seen)
    refuse_misfit(chosen.rms_arcsec, calibrated.held_out_noise_arcsec)
    return calibrated


def refuse_misfit(error_arcsec: float, expected_arcsec: float) -> None:
    """Refuse (MisfitError) dots that are farther off, rms, than the noise of their centroids is
    expected to put them.
    """
    if error_arcsec > max(MAX_MISFIT * expected_arcsec, expected_arcsec + MISFIT_FLOOR_ARCSEC):
        raise MisfitError(
            f"dots held out of the fit are {error_arcsec:.3g} arcsec rms off, where the noise of"
            f" the centroids makes {expected_arcsec:.2g}: something moved between the frames, or"
            " the tracker's flight model is wrong"
        )


def bounded_to_field(problem: fits.Problem, fit: fits.Fit) -> fits.Fit:
    """The fit with its lens limited to the tracker's field, where part of the screen lies
    outside of it.
    """
    geometry = fit.geometry
    monitor = fit.geometry.monitor
    # By places over the whole screen, not by the dots: those stand where the tracker sees it.
    screen_width, screen_height = monitor.resolution_px
    columns = np.linspace(-0.5, screen_width - 0.5, SCREEN_PLACES)
    rows = np.linspace(-0.5, screen_height - 0.5, SCREEN_PLACES)
    x_px, y_px = np.meshgrid(columns, rows)
    if all(inside.all() for inside in in_view(fit.geometry, x_px.ravel(), y_px.ravel())):
        return fit
    width, height = geometry.tracker.resolution_px
    corner_x = np.array([-0.5, width - 0.5, -0.5, width - 0.5])
    corner_y = np.array([-0.5, -0.5, height - 0.5, height - 0.5])
    reach = 0.0
    for pose in range(len(geometry.q_poses)):
        in_cam = fits.directions_in_cam(geometry, np.full(4, pose), corner_x, corner_y)
        x, y, z = (in_cam @ monitor.cam_to_image.T).T
        reach = max(reach, float(np.nanmax(np.hypot(x, y) / z)))
    # A pinhole is bounded, too: a tilt that it could not see within the field is 23 arcsec off at
    # the screen's far end.
    lens = replace(monitor.lens or Lens(), max_tangent=KNOWN_MARGIN * reach)
    bounded_monitor = replace(monitor, lens=lens)
    return replace(fit, geometry=replace(geometry, monitor=bounded_monitor))


def matched(
    plan: DotPlan,
    nominal: fits.Nominal,
    seen: Observed,
    look: FirstLook,
    tracker_names: tuple[str, ...] = (),
) -> tuple[fits.Problem, fits.MatchedDots]:
    """Match centroids to dots, first by the codes' map and then by a fitted lens; the problem to
    fit, and its data.

    Raises InputError where the image moved between frames.
    """
    data = match_by_maps(plan, nominal, seen, look)
    refuse_motion(data)
    nominal = turned(plan, nominal, look)
    poses = len(look.q_poses)
    for _ in range(MATCH_ROUNDS):
        problem = _problem(plan, nominal, look, data)
        # The largest model that these centroids can determine.
        if len(data) > 2 * len(fits.BROWN_CONRADY):
            model = fits.Model(fits.BROWN_CONRADY, tracker_names, poses)
        elif len(data) > 2 * len(fits.RADIAL):
            model = fits.Model(fits.RADIAL, (), poses)
        else:
            model = fits.Model(fits.PINHOLE, (), poses)
        rough = fits.fit(problem, model, 0, data)
        reach_px = max(REACH_PX, REACH_SIGMAS * problem.noise_px)
        reach_monitor_px = reach_px * problem.monitor_px_per_px
        data = match_by_geometry(plan, seen, rough.geometry, reach_monitor_px)
        if len(data) < MIN_DOTS:
            break
    return _problem(plan, nominal, look, data), data


def _problem(
    plan: DotPlan, nominal: fits.Nominal, look: FirstLook, data: fits.MatchedDots
) -> fits.Problem:
    """The problem of a fit to these centroids, whose repeats tell their noise."""
    noise_px = fits.noise_of_repeats(data) or DEFAULT_NOISE_PX
    return fits.Problem(plan, nominal, look.q_poses, noise_px)


def in_view(
    geometry: fits.Geometry, x_px: FloatArray, y_px: FloatArray, edge_px: float = 0.0
) -> list[BoolArray]:
    """For each pose, a mask of the monitor's pixels (n,) in the tracker's field, farther than
    `edge_px` from its edge.
    """
    directions = geometry.monitor.rays(x_px, y_px)
    width, height = geometry.tracker.resolution_px
    seen_by_pose = []
    for q in geometry.q_poses:
        x, y = geometry.tracker.project(directions @ to_matrix(q).T)
        across = (x > edge_px) & (x < width - 1 - edge_px)
        down = (y > edge_px) & (y < height - 1 - edge_px)
        seen_by_pose.append(across & down)
    return seen_by_pose


def refuse_gaps(
    plan: DotPlan, resolution_px: tuple[int, int], is_expected: BoolArray, is_seen: BoolArray
) -> None:
    """Refuse (InputError) a part of a screen of this size of which the tracker has a plan's dots
    (n,) in its field and has not seen them.
    """
    width, height = resolution_px
    column = np.clip((plan.x_px * 3 / width).astype(int), 0, 2)
    row = np.clip((plan.y_px * 3 / height).astype(int), 0, 2)
    for r, vertical in enumerate(CELLS[1]):
        for c, sideways in enumerate(CELLS[0]):
            in_cell = (column == c) & (row == r) & is_expected
            expected = in_cell.sum()
            recognised = is_seen[in_cell].sum()
            if expected < MIN_CELL_DOTS or recognised >= MIN_CELL_SHARE * expected:
                continue
            part = f"{vertical} {sideways}"
            if vertical == sideways:
                part = "middle"
            raise InputError(
                f"only {recognised} of {expected} dots were recognised in the {part} of the"
                " screen: look for what covers or dims it, and take new frames"
            )


class FittedParameter(NamedTuple):
    """A parameter's value and one sigma, in the unit of its name."""

    value: float
    sigma: float


def summary_of(found: Calibrated, written: Sequence[str]) -> dict[str, Any]:
    """The figures of a calibration, by the keys of --json; `tracker` says whether its own lens was
    "held" or "fitted".
    """
    chosen = found.chosen
    models = []
    for model in found.models:
        models.append({"name": model.name, **_both(model)})
    parameters = {}
    for name, parameter in parameters_of(found).items():
        parameters[name] = parameter._asdict()
    dots = {"planned": len(found.plan), "recognised": found.recognised}
    centroids = {
        "given": found.centroids,
        "matched": len(found.data),
        "lost": found.lost,
        "false": found.false,
    }
    held_out = {**_both(chosen), "noise_arcsec": found.held_out_noise_arcsec}
    tracker_lens = "fitted"
    if found.tracker_known:
        tracker_lens = "held"
    return {
        "model": chosen.name,
        "poses": len(found.problem.q_poses),
        "dots": dots,
        "centroids": centroids,
        "noise_px": found.problem.noise_px,
        "noise_arcsec": found.noise_arcsec,
        "held_out": held_out,
        "error": _both(found.uncertainty),
        "models": models,
        "parameters": parameters,
        "tracker": tracker_lens,
        "notes": notes_for_a_person(found),
        "written": written,
    }


def _both(error: fits.Candidate | fits.Uncertainty) -> dict[str, float]:
    return {"rms_arcsec": error.rms_arcsec, "max_arcsec": error.max_arcsec}


def notes_for_a_person(found: Calibrated) -> tuple[str, ...]:
    """What the figures alone do not say."""
    if len(found.problem.q_poses) > 1:
        notes = []
        if not found.tracker_known:
            notes.append(ROUND)
    elif found.problem.nominal.tracker.lens is None:
        notes = [ONE_POSE]
    else:
        notes = [COLLIMATOR_ALONE]
    lens = found.fit.geometry.monitor.lens
    if lens is not None and math.isfinite(lens.max_tangent):
        known_deg = math.degrees(math.atan(lens.max_tangent))
        notes.append(
            f"the tracker sees {known_deg:.2f} deg from the axis: no star is shown farther out"
        )
    return tuple(notes)


def parameters_of(found: Calibrated) -> dict[str, FittedParameter]:
    """Each parameter's value and one sigma, in its own unit."""
    monitor = found.fit.geometry.monitor
    sigma = found.uncertainty.sigma
    lens = monitor.lens or Lens()
    cx, cy = monitor.principal_point_px
    tilt_x_rad, tilt_y_rad = lens.tilt_rad
    focal_px = monitor.focal_length_px
    # the fit's parameter is the logarithm of the focal length
    focal_sigma_px = focal_px * sigma.get("log_focal", 0.0)
    tilt_x_sigma_rad = sigma.get("tilt_x", 0.0)
    tilt_y_sigma_rad = sigma.get("tilt_y", 0.0)
    values = {
        "focal_length_px": (focal_px, focal_sigma_px),
        "principal_point_x_px": (cx, sigma.get("centre_x", 0.0)),
        "principal_point_y_px": (cy, sigma.get("centre_y", 0.0)),
        "rotation_x_arcsec": (0.0, ARCSEC_PER_RAD * sigma["rotation_x"]),
        "rotation_y_arcsec": (0.0, ARCSEC_PER_RAD * sigma["rotation_y"]),
        "rotation_z_arcsec": (0.0, ARCSEC_PER_RAD * sigma["rotation_z"]),
        "tilt_x_deg": (math.degrees(tilt_x_rad), math.degrees(tilt_x_sigma_rad)),
        "tilt_y_deg": (math.degrees(tilt_y_rad), math.degrees(tilt_y_sigma_rad)),
    }
    distortion = (*lens.radial, *lens.tangential)
    for name, value in zip(("k1", "k2", "k3", "p1", "p2"), distortion, strict=True):
        values[name] = (value, sigma.get(name, 0.0))
    tracker_lens = found.fit.geometry.tracker.lens or Lens()
    tracker_distortion = (*tracker_lens.radial[:2], *tracker_lens.tangential)
    for name, value in zip(fits.TRACKER_STEPS, tracker_distortion, strict=True):
        if name in found.fit.model.tracker_names:
            values[name] = (value, sigma[name])
    parameters = {}
    for name, (value, one_sigma) in values.items():
        parameters[name] = FittedParameter(float(value), float(one_sigma))
    return parameters


def write_calibrated(
    path: Path, found: Calibrated, plot: Path | None, identity: MonitorIdentity | None = None
) -> list[str]:
    """Write the geometry file with its errors and its monitor, and its chart if `plot`; their
    names. Raises InputError.
    """
    geometry = found.fit.geometry
    chosen = found.chosen
    uncertainty = found.uncertainty
    # -1: no place of the map that the tracker sees
    map_arcsec: list[list[float]] = []
    for row in np.nan_to_num(uncertainty.map_arcsec, nan=-1.0).tolist():
        map_arcsec.append([round(value, 4) for value in row])
    modes_arcsec: list[list[float]] = []
    for mode in uncertainty.modes_arcsec:
        modes_arcsec.append([float(f"{value:.5g}") for value in mode])
    error = ErrorTable(
        model=chosen.name,
        held_out_rms_arcsec=chosen.rms_arcsec,
        held_out_max_arcsec=chosen.max_arcsec,
        noise_px=found.problem.noise_px,
        rms_arcsec=uncertainty.rms_arcsec,
        max_arcsec=uncertainty.max_arcsec,
        map_arcsec=map_arcsec,
        modes_arcsec=modes_arcsec,
    )
    sigma = {name: parameter.sigma for name, parameter in parameters_of(found).items()}
    when = datetime.datetime.now(datetime.UTC).date().isoformat()
    made = MadeTable(by=f"hilstar {__version__}", when=when, poses=len(found.problem.q_poses))
    notes = Notes(sigma, error, made, identity)
    write_geometry(path, geometry.monitor, geometry.q_cam_to_mon, notes)
    if plot is None:
        return [str(path)]
    draw_geometry(plot, found)
    return [str(path), str(plot)]


def lines_of(found: Calibrated) -> list[str]:
    """The calibration as lines of text."""
    chosen = found.chosen
    error = found.uncertainty
    noise = found.held_out_noise_arcsec
    poses = len(found.problem.q_poses)
    rows = [
        ("dots", f"{found.recognised} of {len(found.plan)} recognised in {poses} pose(s)"),
        ("centroids", f"{len(found.data)} matched, {found.lost} lost, {found.false} false"),
        ("centroid noise", f"{found.problem.noise_px:.4f} px, {found.noise_arcsec:.2f} arcsec"),
    ]
    for model in found.models:
        errors = f"{model.rms_arcsec:.3f} / {model.max_arcsec:.3f} arcsec"
        rows.append((model.name, f"{errors} (rms / max of held-out dots)"))
    held_out = f"{chosen.rms_arcsec:.3f} arcsec rms, {chosen.max_arcsec:.3f} max"
    place = f"{error.rms_arcsec:.3f} arcsec rms, {error.max_arcsec:.3f} max"
    rows += [
        ("chosen", chosen.name),
        ("held-out dots", f"{held_out}; noise: {noise:.3f}"),
        ("a star's place", f"known to {place} (1 sigma)"),
    ]
    width = max(len(name) for name, _ in rows) + 2
    lines = [f"{name:{width}}{text}" for name, text in rows]
    return [*lines, *notes_for_a_person(found)]


def draw_geometry(path: Path, found: Calibrated) -> None:
    """Draw the error of a star's place over the screen, and the dots' residuals as arrows."""
    width, height = found.problem.nominal.monitor.resolution_px
    finding = (
        f"By {found.chosen.name} a star's place is known to {found.uncertainty.rms_arcsec:.2g}"
        f" arcsec rms, {found.uncertainty.max_arcsec:.2g} at most; held-out dots"
        f" {found.chosen.rms_arcsec:.2g} rms"
    )
    dot, place, count = np.unique(found.data.dot, return_inverse=True, return_counts=True)
    right_px, down_px = fits.residuals_px(found.problem, found.fit.geometry, found.data)
    right = np.bincount(place, right_px) / count
    down = np.bincount(place, down_px) / count
    to_arcsec = ARCSEC_PER_RAD / found.problem.nominal.tracker.focal_length_px
    median = max(float(np.median(np.hypot(right, down))), 1e-9)
    panel_inch = WIDE_INCH * height / width
    with chart(path, finding, panels=2, height_inch=1.4 + 2 * panel_inch) as (places, residuals):
        image = places.imshow(
            found.uncertainty.map_arcsec,
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            aspect="equal",
            cmap="viridis",
        )
        places.figure.colorbar(
            image, ax=[places, residuals], label="1 sigma of a star's place [arcsec]", shrink=0.5
        )
        places.set_title("Error of a star's place")
        x = found.plan.x_px[dot]
        y = found.plan.y_px[dot]
        look = {"angles": "xy", "scale_units": "xy", "width": 0.002, "color": BLUE}
        arrows = residuals.quiver(x, y, right, down, scale=median / (ARROW_SHARE * width), **look)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        residuals.quiverkey(arrows, 0.75, 1.05, median, f"{median * to_arcsec:.2g} arcsec", **key)
        residuals.set(
            xlim=(-0.5, width - 0.5),
            ylim=(height - 0.5, -0.5),
            aspect="equal",
            xlabel="monitor x [px]",
        )
        residuals.set_title("Mean residual of each dot; key: their median")
        for axes in (places, residuals):
            axes.set_ylabel("monitor y [px]")
            axes.grid(visible=False)
