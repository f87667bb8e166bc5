"""A geometric calibration from centroids to a file: matched, fitted, chosen, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.cameras import ideal_monitor, tracker_camera
from hilstar.calibrate.geometric.choose import Candidate, best_of, candidates, final_fit
from hilstar.calibrate.geometric.dots import BoolArray, DotPlan, read_plan
from hilstar.calibrate.geometric.fit import Fit, Matched, Problem, fit, noise_of_repeats
from hilstar.calibrate.geometric.images import measure_images
from hilstar.calibrate.geometric.match import FirstLook, first_look, match_by_geometry, match_by_maps, refuse_motion
from hilstar.calibrate.geometric.model import BROWN_CONRADY, PINHOLE, RADIAL, TRACKER_STEPS, Model, Nominal, directions_in_cam
from hilstar.calibrate.geometric.observed import Observed, read_observed
from hilstar.calibrate.geometric.uncertainty import Uncertainty, uncertainty_of
from hilstar.errors import InputError
from hilstar.rotation import to_matrix
from hilstar.units import ARCSEC_PER_RAD

SEED = 1  # of the random samples of dots: one calibration gives one file
MIN_DOTS = 12
KNOWN_MARGIN = 1.01  # of the angle to the corner of the tracker's field
MIN_CELL_SHARE = 0.33  # of the dots that should be seen in a part of the screen
CELLS = (("left", "middle", "right"), ("upper", "middle", "lower"))
REACH_PX = 0.5  # of the tracker: a centroid this close to where the fit puts a dot is that dot
REACH_SIGMAS = 8.0
MATCH_ROUNDS = 2
DEFAULT_NOISE_PX = 0.05
# A held-out error this many times that of the centroids' noise alone is no lens: a dot's mean is off by noise / sqrt(frames).
MAX_MISFIT = 4.0
MISFIT_FLOOR_ARCSEC = 1.0


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What was found: the fit, the models it was chosen from, how well it is known, and what became of the centroids."""

    plan: DotPlan
    problem: Problem
    data: Matched
    fit: Fit
    models: list[Candidate]
    chosen: Candidate
    uncertainty: Uncertainty
    centroids: int
    tracker_known: bool

    @property
    def lost(self) -> int:
        """Lit dots in the tracker's field that have no centroid."""
        return _expected(self.plan, self.problem, self.fit) - len(self.data)

    @property
    def false(self) -> int:
        """Centroids that are no dot."""
        return self.centroids - len(self.data)

    @property
    def noise_arcsec(self) -> float:
        """The error of one centroid, one axis."""
        return self.problem.noise_px * ARCSEC_PER_RAD / self.problem.nominal.tracker.focal_length_px

    @property
    def held_out_noise_arcsec(self) -> float:
        """What noise alone would make of the held-out dots' rms."""
        count = np.bincount(self.data.dot)
        return float(np.sqrt(2 * np.mean(1 / count[count > 0])) * self.noise_arcsec)


def calibrate_files(
    file: BenchFile, observed: Sequence[Path], plan: Path, dark: Path | None, *, tracker_is_ideal: bool
) -> Calibrated:
    """Fit the geometry of a bench file to a table of centroids, or to the tracker's images. Raises InputError."""
    config = file.config
    monitor = ideal_monitor(config)
    nominal = Nominal(monitor, np.array(config.collimator.q_cam_to_mon), tracker_camera(config.tracker, file.folder))
    dots = read_plan(plan)
    _refuse_other_screen(plan, dots, monitor.resolution_px)
    if observed[0].suffix.lower() == ".csv":
        if len(observed) > 1:
            raise InputError(f"{observed[1]}: one table is read; write all centroids into {observed[0]}")
        seen = read_observed(observed[0])
    else:
        seen = measure_images(observed, dark, config.tracker.resolution_px)
    known = tracker_is_ideal or config.tracker.distortion is not None
    return calibrate_geometry(dots, nominal, seen, np.random.default_rng(SEED), tracker_known=known)


def _refuse_other_screen(plan: Path, dots: DotPlan, resolution_px: tuple[int, int]) -> None:
    if dots.x_px.max() > resolution_px[0] - 1 or dots.y_px.max() > resolution_px[1] - 1:
        raise InputError(f"{plan}: has dots off this monitor of {resolution_px[0]} x {resolution_px[1]} px; plan them anew")


def calibrate_geometry(
    plan: DotPlan, nominal: Nominal, seen: Observed, rng: np.random.Generator, *, tracker_known: bool
) -> Calibrated:
    """Fit a bench's geometry to what the tracker saw of the dots.

    With `tracker_known` the tracker's own lens is held as it is; else it is fitted too, which takes two poses or more.
    Raises InputError, with the cure, for an image that is mirrored or turned, for codes or frames that match nothing, for too
    few dots, and for a fit that its data contradict.
    """
    poses = int(seen.pose.max()) + 1
    if not tracker_known and poses == 1:
        raise InputError(
            "with one pose the tracker's own distortion cannot be told from the collimator's; give its flight model as"
            " [tracker] distortion, take a second pose (turn the tracker by 90 or 180 degrees about its boresight),"
            " or add --tracker-is-ideal"
        )
    tracker_names = () if tracker_known else tuple(TRACKER_STEPS)
    look = first_look(plan, nominal, seen, rng)
    problem, data = matched(plan, nominal, seen, look, tracker_names)
    found = len(np.unique(data.dot))
    if found < MIN_DOTS:
        raise InputError(f"{found} dots were recognised and {MIN_DOTS} are needed; show more --dots or more --frames")
    models = candidates(problem, data, tracker_names)
    chosen = best_of(models)
    final = bounded_to_field(problem, final_fit(problem, chosen, data))
    calibrated = Calibrated(
        plan, problem, data, final, models, chosen, uncertainty_of(problem, final, data), len(seen), tracker_known
    )
    _refuse_gaps(calibrated)
    _refuse_misfit(calibrated)
    return calibrated


def bounded_to_field(problem: Problem, fit: Fit) -> Fit:
    """The fit with its lens used no farther than the tracker's field, where that leaves part of the screen unseen."""
    geometry, plan = fit.geometry, problem.plan
    monitor = geometry.monitor
    if monitor.lens is None or all(inside.all() for inside in _in_view(plan, problem, fit)):
        return fit
    width, height = geometry.tracker.resolution_px
    corners = np.array([-0.5, width - 0.5, -0.5, width - 0.5]), np.array([-0.5, -0.5, height - 0.5, height - 0.5])
    reach = 0.0
    for pose in range(len(geometry.q_poses)):
        rays = directions_in_cam(geometry, np.full(4, pose), *corners) @ monitor.cam_to_image.T
        reach = max(reach, float(np.nanmax(np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2])))
    lens = replace(monitor.lens, max_tangent=KNOWN_MARGIN * reach)
    return replace(fit, geometry=replace(geometry, monitor=replace(monitor, lens=lens)))


def matched(
    plan: DotPlan, nominal: Nominal, seen: Observed, look: FirstLook, tracker_names: tuple[str, ...] = ()
) -> tuple[Problem, Matched]:
    """The centroids with their dots, by the codes' map first and by a fitted lens then; and what is to be fitted to them.

    Raises InputError where the image moved between frames.
    """
    data = match_by_maps(plan, nominal, seen, look)
    refuse_motion(data)
    for _ in range(MATCH_ROUNDS):
        problem = Problem(plan, nominal, look.q_poses, noise_of_repeats(data) or DEFAULT_NOISE_PX)
        model = Model(_names_for(len(data)), tracker_names if len(data) > 2 * len(BROWN_CONRADY) else (), len(look.q_poses))
        rough = fit(problem, model, 0, data)
        reach_px = max(REACH_PX, REACH_SIGMAS * problem.noise_px) * problem.monitor_px_per_px
        data = match_by_geometry(plan, seen, rough.geometry, reach_px)
        if len(data) < MIN_DOTS:
            break
    return Problem(plan, nominal, look.q_poses, noise_of_repeats(data) or DEFAULT_NOISE_PX), data


def _names_for(centroids: int) -> tuple[str, ...]:
    """The largest model that this number of centroids can determine."""
    for names in (BROWN_CONRADY, RADIAL):
        if centroids > 2 * len(names):
            return names
    return PINHOLE


def _expected(plan: DotPlan, problem: Problem, fit: Fit) -> int:
    """How many centroids there would be if none were lost."""
    return sum(int(plan.lit[inside].sum()) for inside in _in_view(plan, problem, fit))


def _in_view(plan: DotPlan, problem: Problem, fit: Fit) -> list[BoolArray]:
    """For each pose, which dots (n,) are in the tracker's field."""
    geometry = fit.geometry
    directions = geometry.monitor.rays(plan.x_px, plan.y_px)
    width, height = geometry.tracker.resolution_px
    found = []
    for q in geometry.q_poses:
        x, y = geometry.tracker.project(directions @ to_matrix(q).T)
        found.append((x > 0) & (x < width - 1) & (y > 0) & (y < height - 1))
    return found


def _refuse_gaps(calibrated: Calibrated) -> None:
    """Refuse (InputError) a part of the screen that the tracker should see, and whose dots it did not see."""
    plan, problem = calibrated.plan, calibrated.problem
    wanted = np.any(_in_view(plan, problem, calibrated.fit), axis=0)
    found = np.zeros(len(plan), dtype=bool)
    found[np.unique(calibrated.data.dot)] = True
    width, height = problem.nominal.monitor.resolution_px
    column, row = (np.clip((place * 3 / size).astype(int), 0, 2) for place, size in ((plan.x_px, width), (plan.y_px, height)))
    for r, vertical in enumerate(CELLS[1]):
        for c, sideways in enumerate(CELLS[0]):
            here = (column == c) & (row == r) & wanted
            if here.sum() >= 2 and found[here].sum() < MIN_CELL_SHARE * here.sum():
                part = "middle" if vertical == sideways else f"{vertical} {sideways}"
                raise InputError(
                    f"only {found[here].sum()} of {here.sum()} dots were recognised in the {part} of the screen: look for what"
                    " covers or dims it, and take new frames"
                )


def _refuse_misfit(calibrated: Calibrated) -> None:
    expected = calibrated.held_out_noise_arcsec
    error = calibrated.chosen.rms_arcsec
    if error > max(MAX_MISFIT * expected, expected + MISFIT_FLOOR_ARCSEC):
        raise InputError(
            f"dots held out of the fit are {error:.3g} arcsec rms off, where the noise of the centroids makes {expected:.2g}:"
            " something moved between the frames, or the tracker's flight model is wrong"
        )
