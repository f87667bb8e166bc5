"""The virtual tracker's processor times: an exposure, its stars found, a case, a field of `verify`;
other programs in turn.

Each exposure has 1024 x 1024 pixels and all noise. Peers are given hilstar's expected image, so
their times have no sky and no drawing: NumPy's and GalSim's noise beside the whole exposure, and
the finders of photutils and sep on hilstar's own DN.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.campaign.job import Job, files_sha256
from hilstar.instruments.campaign.plan import parse_plan
from hilstar.instruments.campaign.session import OWN_THREADS, Session
from hilstar.instruments.campaign.solvers import CENTROIDS
from hilstar.instruments.simulate.simulator import Exposure, Simulator
from hilstar.instruments.study.speed.report import Cell, MethodTiming, Skipped, TimeSpread
from hilstar.instruments.study.sweep import Spent, in_turn
from hilstar.instruments.study.trials import called
from hilstar.instruments.verify.summary import verify
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.tracker.centroids import find_stars
from hilstar.tracker.settings import DetectorSettings

RADEC_ROLL_DEG = (84.057, -1.2, 10.0)
SEED = 1
PLAN = f'bench = "demo.toml"\ncases = 1000\nseed = {SEED}\n'
KINDS = ("exposure", "find_stars", "case", "verify")
FINDER_SIGMAS, FWHM_PX = 5.0, 2.0
Work = Callable[[], object]
WorkKey = tuple[str, str]  # a program and a kind


class Exposing:
    """The works of the demo's tracker, each with a new noise at every call."""

    def __init__(self, file: BenchFile, folder: Path) -> None:
        self.file = file
        self.folder = folder
        self.rng = np.random.default_rng(SEED)
        self.simulator = Simulator(file)
        self.view = self.simulator.view(from_radec_roll_deg(*RADEC_ROLL_DEG), np.zeros(3))
        self.exposure: Exposure = self.simulator.expose(self.view, self.rng)
        self.detector = file.config.tracker.detector
        self.case = 0

    def expose(self) -> None:
        """A whole exposure of hilstar's."""
        self.simulator.expose(self.view, self.rng)

    def numpy_noise(self) -> npt.NDArray[np.uint16]:
        """NumPy's own draws of the same exposure."""
        return numpy_dn(self.exposure.mean_e, self.detector, self.rng)

    def galsim_noise(self) -> Work:
        """GalSim's CCD noise on the same image. Raises ImportError."""
        galsim = import_module("galsim")
        random = galsim.BaseDeviate(SEED)

        def work() -> None:
            image = galsim.Image(self.exposure.mean_e.copy())
            image.addNoise(galsim.CCDNoise(random, gain=1.0, read_noise=self.detector.read_noise_e))

        return work

    def photutils_stars(self) -> Work:
        """photutils' DAOStarFinder on the same DN. Raises ImportError."""
        finder = import_module("photutils.detection").DAOStarFinder
        clipped = import_module("astropy.stats").sigma_clipped_stats
        dn = self.exposure.dn.astype(float)

        def work() -> None:
            _, middle, sigma = clipped(dn, sigma=3.0)
            finder(threshold=FINDER_SIGMAS * sigma, fwhm=FWHM_PX)(dn - middle)

        return work

    def sep_stars(self) -> Work:
        """sep (SExtractor as a library) on the same DN. Raises ImportError."""
        sep = import_module("sep")
        dn = self.exposure.dn.astype(np.float32)

        def work() -> None:
            background = sep.Background(dn)
            sep.extract(dn - background.back(), FINDER_SIGMAS, err=background.globalrms)

        return work

    def session(self) -> Session:
        """A campaign's worker on this bench."""
        path = self.folder / "plan.toml"
        plan = parse_plan(path, PLAN)
        own_files = (self.file.text, self.file.sha256, files_sha256(plan, self.folder))
        here = str(self.folder)
        return Session(
            Job(
                str(path),
                PLAN,
                str(self.file.path),
                *own_files,
                CENTROIDS,
                here,
                60.0,
                here,
                images=False,
            )
        )


def numpy_dn(
    mean_e: FloatArray, detector: DetectorSettings, rng: np.random.Generator
) -> npt.NDArray[np.uint16]:
    """NumPy's draws of an image (h, w): Poisson, normal read noise; DN."""
    charge = rng.poisson(mean_e) + rng.normal(0.0, detector.read_noise_e, mean_e.shape)
    dn = np.rint(charge / detector.gain_e_per_dn)
    return np.clip(dn, 0, 2**detector.bits - 1).astype(np.uint16)


@contextmanager
def threads_unset() -> Iterator[None]:
    """What a campaign's worker sets for its process is unset again."""
    unset = [name for name in OWN_THREADS if name not in os.environ]
    try:
        yield
    finally:
        for name in unset:
            os.environ.pop(name, None)


def peer_works(
    peers: Mapping[WorkKey, Callable[[], Work]],
) -> tuple[dict[WorkKey, Work], list[Skipped]]:
    """The works of the peers that are installed, and why the others are skipped."""
    works = {}
    skipped = []
    for (name, kind), make in peers.items():
        try:
            works[name, kind] = make()
        except ImportError as error:
            why = f"{kind}: not installed ({error}): pip install 'hilstar[benchmark]'"
            skipped.append(Skipped(method=name, why=why))
    return works, skipped


def tracker_timings(times: Mapping[WorkKey, Sequence[Spent]], cell: Cell) -> list[MethodTiming]:
    """Rows of processor times, by KINDS, hilstar's first."""
    rows = []
    for name, kind in sorted(
        times, key=lambda each: (KINDS.index(each[1]), each[0] != "hilstar", each[0])
    ):
        ms = [timing.cpu_ms for timing in times[name, kind]]
        spread = TimeSpread(float(np.median(ms)), min(ms), max(ms))
        rows.append(MethodTiming(cell.width, cell.height, cell.stars, name, kind, spread))
    return rows


def tracker_rows(rounds: int, budget_s: float) -> tuple[list[MethodTiming], list[Skipped]]:
    """Processor times of each work in turn, and the peers that are not installed. Raises
    InputError, MachineError.
    """
    file = read_bench_file(resource_path("configs", "demo.toml"))
    with ExitStack() as stack:
        stack.enter_context(threads_unset())
        folder = stack.enter_context(TemporaryDirectory())
        exposing = Exposing(file, Path(folder))
        stack.callback(exposing.simulator.close)
        session = stack.enter_context(closing(exposing.session()))
        dimensions = len(session.maker.parameters) + session.maker.attitude_dimensions
        points = np.random.default_rng(SEED).uniform(size=(rounds + 1, dimensions))

        def case() -> None:
            exposing.case += 1
            session.row(exposing.case, points[exposing.case % len(points)])

        works: dict[WorkKey, Work] = {
            ("hilstar", "exposure"): exposing.expose,
            ("numpy", "exposure"): exposing.numpy_noise,
            ("hilstar", "find_stars"): lambda: find_stars(exposing.exposure.dn),
            ("hilstar", "case"): case,
            ("hilstar", "verify"): lambda: verify(
                file, 1, np.random.default_rng(SEED), lambda done: None
            ),
        }
        of_peers, skipped = peer_works(
            {
                ("galsim", "exposure"): exposing.galsim_noise,
                ("photutils", "find_stars"): exposing.photutils_stars,
                ("sep", "find_stars"): exposing.sep_stars,
            }
        )
        by_name: dict[str, Callable[[int], object]] = {}
        keys = {}
        for (name, kind), work in (works | of_peers).items():
            by_name[f"{name} {kind}"] = partial(called, work)
            keys[f"{name} {kind}"] = name, kind
        times = in_turn(by_name, rounds, budget_s)
        width, height = file.config.tracker.resolution_px
        cell = Cell(width, height, len(exposing.exposure.rows))
    timed = {keys[name]: spent for name, spent in times.items()}
    return tracker_timings(timed, cell), skipped
