"""A worker's session: it checks that its rows would be the campaign's, and runs cases one after the
other.

Rows are the same bit for bit on every worker that has the campaign's `Identity`. One tracker serves
all cases of a session, and changes with their bench files.
"""

import contextlib
import os
import time
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import HilstarError, InputError, MachineError, one_line
from hilstar.basics.files import make_directory
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.cases import (
    Case,
    CaseMaker,
    Kind,
    columns,
    failed,
    first_row,
)
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.campaign.job import (
    Answered,
    Identity,
    Job,
    files_sha256,
    identity_of,
    peak_bytes,
)
from hilstar.instruments.campaign.plan import Plan, parse_plan
from hilstar.instruments.campaign.planted import CaseConditions, CaseTracker
from hilstar.instruments.campaign.solvers import CENTROIDS, SolverFault, choose_solver
from hilstar.instruments.campaign.star_motion import StarMotion
from hilstar.instruments.campaign.store import Row
from hilstar.instruments.campaign.tally import CaseTally
from hilstar.instruments.simulate.pictures import write_exposure_fits
from hilstar.instruments.simulate.simulator import FrameNoise, Simulator
from hilstar.optics.frame_motion import CameraTurn
from hilstar.server.bench.bench_file import BenchFile, bench_file_of

IMAGES = "images"
OWN_THREADS = "LP_NUM_THREADS", "OMP_NUM_THREADS"  # threads that draw, and that make noise
IMAGES_A_FOLDER = 1000


Imaging = Simulator | DisplayTracker  # a tracker that exposes, of the sky or of the display


class Session:
    """A worker's part of a campaign. Raises InputError where the plan or the bench cannot be
    used here, or differ.
    """

    def __init__(self, job: Job) -> None:
        for name in OWN_THREADS:  # workers fill the cores
            os.environ.setdefault(name, "1")
        self.job = job
        self.plan: Plan = parse_plan(Path(job.plan_path), job.plan_text)
        self.file = bench_file_of(Path(job.bench_path), job.bench_text)
        if self.file.sha256 != job.bench_sha256:
            raise InputError(
                f"its bench {self.file.sha256:.12} is not the campaign's {job.bench_sha256:.12}: a"
                f" file that {job.bench_path} names has another content there; copy it"
            )
        if files_sha256(self.plan, Path(job.plan_path).parent) != job.files_sha256:
            raise InputError(
                f"its log or scenario is not the campaign's: a file that {job.plan_path} names"
                " differs there; copy it"
            )
        self.maker = CaseMaker(self.plan, self.file, Path(job.plan_path).parent)
        self.columns: dict[str, Kind] = columns(
            self.maker.parameters, job.solver == CENTROIDS, self.plan.columns
        )
        self._solver = choose_solver(
            job.solver,
            self.plan.centroids,
            Path(job.solver_folder),
            job.timeout_s,
            Path(job.plan_path).parent,
        )
        self._tracker: Imaging | None = None
        self._motion: StarMotion | None = None
        self._at(self.maker.file)

    def identity(self) -> Identity:
        """This worker's identity."""
        return identity_of(self._at(self.maker.file).gl_renderer)

    def run(self, begin: int, points: FloatArray) -> Answered:
        """The rows of the cases from `begin` on at their points (n, dimensions)."""
        start_s = time.perf_counter()
        rows = [self.row(begin + k, point) for k, point in enumerate(points)]
        return Answered(rows, time.perf_counter() - start_s, peak_bytes())

    def row(self, number: int, point: FloatArray) -> Row:
        """The row of one case; a failed one says why."""
        case = self.maker.case(number, point)
        row = first_row(case, self.columns)
        try:
            file = self.maker.bench(case)
            row["bench_sha256"] = file.sha256
            return self._exposed(case, self._at(file), row)
        except MachineError:
            raise
        except HilstarError as error:
            return failed(row, one_line(str(error)))
        except (
            ArithmeticError,
            ValueError,
            LookupError,
            MemoryError,
            np.linalg.LinAlgError,
        ) as error:
            self._tracker = None
            return failed(row, one_line(f"{type(error).__name__}: {error}"))

    def _exposed(self, case: Case, tracker: Imaging, row: Row) -> Row:
        exposure_s = tracker.config.tracker.exposure_s
        length_s = (self.plan.frames - 1) * self.plan.step_s + exposure_s
        fault_end_s = self.maker.fault_end_s(case, length_s)

        def commanded(seconds: float) -> CameraTurn:
            # along a log the rate is the mean over the exposure
            return self.maker.after(case, round(seconds * NS_PER_S), exposure_s).turn

        tally = CaseTally(
            "stars" in self.columns,
            self.plan.wrong_above_arcsec,
            commanded,
            fault_end_s,
            further=self.plan.columns,
        )
        noise = FrameNoise(self.plan.noise, case.noise_seed)
        conditions = CaseConditions(
            _velocity_km_s(tracker),
            case.motion,
            tracker.config.tracker.detector.false_stars,
            case.body_deg,
            fault_end_s,
            self._old_places_rad(case, tracker),
        )
        with_rate = "rate" in self.plan.columns
        reporter = CaseTracker(self.plan.planted, case.noise_seed, conditions, with_rate)
        for frame in range(self.plan.frames):
            view = self.maker.view(case, frame, exposure_s)
            # A case of one frame has the noise of `hilstar simulate --seed` for the same bench and
            # attitude.
            if self.plan.frames == 1:
                rng = noise.rng()
            else:
                rng = noise.rng(frame)
            if isinstance(tracker, Simulator):
                exposure = tracker.expose(view, rng, faults=self.maker.faults(case, view, tracker))
            else:
                exposure = tracker.expose(view, rng)
            if self.job.images:
                stem = f"{IMAGES}/{case.number // IMAGES_A_FOLDER:06d}/case_{case.number:09d}"
                first, this = ("" if self.plan.frames == 1 else f"_{k:05d}" for k in (0, frame))
                row["image"] = f"{stem}{first}.fits"
                path = Path(self.job.directory) / f"{stem}{this}.fits"
                make_directory(path.parent)
                write_exposure_fits(path, tracker, exposure, noise)
            tally.see(exposure)
            try:
                solved = self._solver.solve(exposure, tracker)
                at_s = frame * self.plan.step_s
                answer = reporter.reported(solved, exposure, at_s)
                tally.hear(exposure, answer, at_s)
            except SolverFault as error:
                return failed(tally.into(row), one_line(str(error)))
        return tally.into(row)

    def _old_places_rad(self, case: Case, tracker: Imaging) -> FloatArray:
        """The turn (3,), cam, that planted old places give a case, and places without parallax."""
        planted = self.plan.planted
        if planted is None:
            return np.zeros(3)
        if not (planted.proper_motion or planted.catalogue_age_yr or planted.parallax):
            return np.zeros(3)
        if self._motion is None:
            self._motion = StarMotion.of(self.maker.file)
        years = tracker.config.sky.epoch_jyear - self._motion.jyear
        old_yr = planted.proper_motion * years + planted.catalogue_age_yr
        settings = tracker.config.tracker
        scale = Scale(
            settings.focal_length_mm * 1e3 / settings.pixel_pitch_um, settings.resolution_px
        )
        q = case.first.q_icrs_to_cam
        turn_rad = old_yr * self._motion.whole_turn_rad(q, scale)
        if planted.parallax and tracker.moving is not None:
            by_parallax = self._motion.by_parallax(tracker.moving)
            turn_rad = turn_rad + planted.parallax * by_parallax.whole_turn_rad(q, scale)
        return turn_rad

    def _at(self, file: BenchFile) -> Imaging:
        """The tracker, switched to a bench file; where that fails, the next case gets a new one."""
        tracker = self._tracker
        self._tracker = None
        if tracker is None:
            if self.plan.through == "tracker":
                tracker = Simulator(file)
            else:
                tracker = DisplayTracker(file)
        else:
            try:
                tracker.change(file)
            except BaseException:
                with contextlib.suppress(Exception):  # parts of it may be closed already
                    tracker.close()
                raise
        self._tracker = tracker
        return tracker

    def close(self) -> None:
        """Free the GL contexts."""
        if self._tracker is not None:
            self._tracker.close()


def _velocity_km_s(tracker: Imaging) -> FloatArray:
    """The velocity (3,) of the observer about the barycentre, ICRS."""
    if tracker.moving is not None:
        return tracker.moving.sight(0).view.velocity_km_s
    return np.array(tracker.config.sky.observer_velocity_km_s)
