"""The virtual tracker's processor times: an exposure, its stars found, a case, a field of `verify`;
other programs in turn.

Each exposure has 1024 x 1024 pixels and all noise. Peers are given hilstar's expected image, so
their times have no sky and no drawing: NumPy's and GalSim's noise beside the whole exposure, and
the finders of photutils and sep on hilstar's own DN.
"""

import os
from collections.abc import Callable
from contextlib import ExitStack, closing
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt

from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.campaign.job import Job, files_sha256
from hilstar.instruments.campaign.plan import parse_plan
from hilstar.instruments.campaign.session import OWN_THREADS, Session
from hilstar.instruments.campaign.solvers import CENTROIDS
from hilstar.instruments.simulate.simulator import Exposure, Simulator
from hilstar.instruments.study.speed.report import Cell, MethodTiming, Skipped, TimeSpread
from hilstar.instruments.study.sweep import in_turn
from hilstar.instruments.verify.summary import verify
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.tracker.centroids import find_stars

RADEC_ROLL_DEG = (84.057, -1.2, 10.0)
SEED = 1
PLAN = f'bench = "demo.toml"\ncases = 1000\nseed = {SEED}\n'
KINDS = ("exposure", "find_stars", "case", "verify")
FINDER_SIGMAS, FWHM_PX = 5.0, 2.0
Work = Callable[[], object]


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
        """NumPy's own draws: Poisson, normal read noise; DN (h, w)."""
        mean_e = self.exposure.mean_e
        charge = self.rng.poisson(mean_e) + self.rng.normal(
            0.0, self.detector.read_noise_e, mean_e.shape
        )
        dn = np.rint(charge / self.detector.gain_e_per_dn)
        return np.clip(dn, 0, 2**self.detector.bits - 1).astype(np.uint16)

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


def tracker_rows(rounds: int, budget_s: float) -> tuple[list[MethodTiming], list[Skipped]]:
    """Processor times of each work in turn, and the peers that are not installed. Raises
    InputError, MachineError.
    """
    unset = [name for name in OWN_THREADS if name not in os.environ]
    file = read_bench_file(resource_path("configs", "demo.toml"))
    skipped: list[Skipped] = []
    with ExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        exposing = Exposing(file, Path(folder))
        stack.callback(exposing.simulator.close)
        session = stack.enter_context(closing(exposing.session()))
        dimensions = len(session.maker.parameters) + session.maker.attitude_dimensions
        points = np.random.default_rng(SEED).uniform(size=(rounds + 1, dimensions))

        def case() -> None:
            exposing.case += 1
            session.row(exposing.case, points[exposing.case % len(points)])

        works: dict[tuple[str, str], Work] = {
            ("hilstar", "exposure"): exposing.expose,
            ("numpy", "exposure"): exposing.numpy_noise,
            ("hilstar", "find_stars"): lambda: find_stars(exposing.exposure.dn),
            ("hilstar", "case"): case,
            ("hilstar", "verify"): lambda: verify(
                file, 1, np.random.default_rng(SEED), lambda done: None
            ),
        }
        peers: dict[tuple[str, str], Callable[[], Work]] = {
            ("galsim", "exposure"): exposing.galsim_noise,
            ("photutils", "find_stars"): exposing.photutils_stars,
            ("sep", "find_stars"): exposing.sep_stars,
        }
        for (name, kind), make in peers.items():
            try:
                works[name, kind] = make()
            except ImportError as error:
                skipped.append(
                    Skipped(
                        method=name,
                        why=f"{kind}: not installed ({error}): pip install 'hilstar[benchmark]'",
                    )
                )
        by_name = {}
        for (name, kind), work in works.items():
            by_name[f"{name} {kind}"] = lambda turn, work=work: work()
        times = in_turn(by_name, rounds, budget_s)
        width, height = file.config.tracker.resolution_px
        cell = Cell(width, height, len(exposing.exposure.truth))
    for name in unset:  # a campaign's worker sets them for its process
        os.environ.pop(name, None)
    rows = []
    for name, kind in sorted(
        works, key=lambda each: (KINDS.index(each[1]), each[0] != "hilstar", each[0])
    ):
        ms = [timing.cpu_ms for timing in times[f"{name} {kind}"]]
        spread = TimeSpread(float(np.median(ms)), min(ms), max(ms))
        rows.append(MethodTiming(cell.width, cell.height, cell.stars, name, kind, spread))
    return rows, skipped
