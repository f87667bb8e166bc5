"""The benchmark: a frame's time by stage, beside other methods for the same image of the same
stars, timed in turn.

Other methods are NumPy and, where installed, numba, GalSim and photutils. Each is given the places
and the light that hilstar found: its time has no culling and no projecting, and it makes no codes.
A cell is one image size and one number of stars. They are the catalogue's and, where it has too
few, random ones. Import and first frame are timed in fresh processes.
"""

import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.special import erf

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import held
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.render.variants import StagedRenderer
from hilstar.instruments.study.speed import report, tracker
from hilstar.instruments.study.study_benches import FULL_HD, Table, Value, bench_text
from hilstar.instruments.study.sweep import OtherWork
from hilstar.optics.psf import SQRT2, GaussianPsf
from hilstar.optics.sprites import Candidates, FrameLight, clipped_sprites, pack_sprites
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import Bench
from hilstar.sky.stars import Stars, cell_grid

# A cap this much wider than the monitor's own: culling must have something to throw away.
SKY_BEYOND = 1.5
STAR_COLUMNS = ("hip", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")
INSTALL = "pip install 'hilstar[benchmark]'"
FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
Sigma = tuple[float, float]
_ONE = np.ones(1)
FIRST = pack_sprites(_ONE, _ONE, _ONE, np.zeros(1, dtype=np.intp), (8, 8), 4)
# The linear image, (height, width), of sprites with their sigma, px.
Draw = Callable[[FrameLight, Sigma, tuple[int, int]], Float32Array]
FRESH = """
import re, sys, time
from pathlib import Path
begin = time.perf_counter()
from hilstar.server.bench.build import load
imported = time.perf_counter()
import numpy as np
with load(sys.argv[1]) as bench:
    bench.draw(np.array([float(part) for part in sys.argv[2:]])).levels
    drawn = time.perf_counter()
# Not getrusage: its maximum is inherited from the process that started this one.
most_kb = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print((imported - begin) * 1e3, (drawn - imported) * 1e3, int(most_kb) / 1024)
"""
STAGES = ("cull", "project", "erase", "upload", "splat", "encode", "read_back")
GPU_STAGES = ("gpu_splat", "gpu_encode")
# 10 deg/s about an axis across and along the boresight: each star is drawn along its path while its
# row is lit.
TURN_RAD_S = np.radians(10.0) * np.array([0.64, -0.74, 0.21])
SIZES: tuple[report.Size, ...] = ((1024, 1024), report.REFERENCE_PX, (2560, 2048), (3840, 2160))
COUNTS = (100, 1000, 10_000, 50_000)
MAX_STARS = 200_000  # NumPy's method takes 2.9 kB of memory for each
RADEC_ROLL_DEG = (84.057, -1.2, 10.0)
# What the project set itself on two cores, ms: whole frames by image and stars, Python at
# REFERENCE_PX by stars; how many times a still frame one may take that turns by 10 deg/s.
AIMS_MS = {
    (report.REFERENCE_PX, 1000): 3.5,
    (report.REFERENCE_PX, 10_000): 10.0,
    ((3840, 2160), 50_000): 40.0,
}
PYTHON_AIMS_MS = {1000: 0.2, 10_000: 1.0}
TURNING_TIMES = 2.0
START_AIM_MS = 1500.0


@dataclass(frozen=True, slots=True)
class BenchmarkScene:
    """Stars, and how many of those in view are the catalogue's."""

    stars: Stars
    catalogue_count: int


def scene(
    bench: Bench, every: Stars, q_icrs_to_cam: FloatArray, count: int, rng: np.random.Generator
) -> BenchmarkScene:
    """A scene with exactly `count` stars in view: the brightest of `every`, then random ones in and
    around the view.

    The random ones are as bright as random stars of the fainter half of `every`. Raises InputError
    where `every` is empty.
    """
    if not len(every):
        raise InputError(
            "bench: the bench file leaves no star to show; write a larger [sky] faintest_v_mag"
        )
    visible = bench.sprites(q_icrs_to_cam, every).star
    visible_mag = every.v_mag[visible]
    by_light = np.argsort(visible_mag, kind="stable")
    ranked = visible[by_light]
    if len(ranked) >= count:
        faintest = ranked[count - 1]
        is_shown = every.v_mag <= every.v_mag[faintest]
        is_shown[ranked[count:]] = False
        shown = np.flatnonzero(is_shown)
        stars = _sorted(every, shown, every.vectors[is_shown])
        return BenchmarkScene(stars, count)
    random_count = count - len(ranked)
    random_vectors = _directions(bench, q_icrs_to_cam, random_count, rng)
    is_faint = every.v_mag >= np.median(every.v_mag)
    faint = np.flatnonzero(is_faint)
    drawn = rng.choice(faint, len(random_vectors))
    own_sources = np.arange(len(every))
    sources = np.concatenate([own_sources, drawn])
    vectors = np.concatenate([every.vectors, random_vectors])
    stars = _sorted(every, sources, vectors)
    return BenchmarkScene(stars, len(ranked))


def _sorted(every: Stars, sources: IntArray, vectors: FloatArray) -> Stars:
    """Stars at `vectors` (n, 3) that are otherwise those of `every` at `sources` (n,), by cell."""
    grid = cell_grid(vectors)
    columns = {}
    for name in STAR_COLUMNS:
        columns[name] = getattr(every, name)[sources[grid.order]]
    by_cell = np.asfortranarray(vectors[grid.order])
    return replace(every, vectors=by_cell, grid=grid, **columns)


def _directions(bench: Bench, q: FloatArray, wanted: int, rng: np.random.Generator) -> FloatArray:
    """ICRS unit vectors, even over a cap around the view, of which `wanted` are in view."""
    camera = bench.camera
    footprint_px = bench.psf.footprint_px
    cap_rad = SKY_BEYOND * camera.field_radius_rad(footprint_px)
    cos_cap = np.cos(min(cap_rad, np.pi))
    icrs_to_image = camera.cam_to_image @ to_matrix(q)
    tries = 4 * wanted
    while True:
        depth = rng.uniform(size=tries) * (1 - cos_cap)
        z = 1 - depth
        turn = rng.uniform(0, 2 * np.pi, tries)
        across = np.sqrt(1 - z**2)
        x = across * np.cos(turn)
        y = across * np.sin(turn)
        vectors = np.stack([x, y, z], axis=1)
        x_px, y_px = camera.project(vectors)
        star = np.arange(tries)
        sprites = pack_sprites(x_px, y_px, z, star, camera.resolution_px, footprint_px)
        visible = sprites.star
        if len(visible) >= wanted:
            last = visible[wanted - 1]
            return np.asarray(vectors[: last + 1] @ icrs_to_image)
        tries *= 2


def other_methods() -> tuple[dict[str, Draw], dict[str, str]]:
    """The installed methods, imported and compiled; and how to install each of the others."""
    draws: dict[str, Draw] = {}
    missing: dict[str, str] = {}
    for name, _, make in METHODS:
        try:
            draw = make()
        except ImportError as error:
            missing[name] = f"not installed ({error}): {INSTALL}"
            continue
        # numba compiles, and LLVM calls Python back meanwhile: an exception there is printed, and
        # lost
        with held():
            draw(FIRST, (0.85, 0.85), (8, 8))
        draws[name] = draw
    return draws, missing


def numpy_linear(sprites: FrameLight, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
    """The baseline: separable erf differences and np.add.at. float32 (height, width), electrons
    per second.
    """
    image = np.zeros(shape, np.float32)
    height, width = shape
    sigma_x, sigma_y = sigma_px
    half_px = (sprites.footprint_px - 1) // 2
    steps = np.arange(sprites.footprint_px) - half_px
    columns = sprites.data["pixel"][:, :1] + steps
    rows = sprites.data["pixel"][:, 1:] + steps
    share_x = _shares(columns, sprites.x_px, sigma_x)
    rates = sprites.data["electrons_per_s"][:, None]
    share_y = _shares(rows, sprites.y_px, sigma_y) * rates
    light = (share_y[:, :, None] * share_x[:, None, :]).astype(np.float32)
    inside_x = (columns >= 0) & (columns < width)
    inside_y = (rows >= 0) & (rows < height)
    inside = inside_y[:, :, None] & inside_x[:, None, :]
    place = rows[:, :, None] * width + columns[:, None, :]
    np.add.at(image.ravel(), place[inside], light[inside])
    return image


def _shares(pixels: IntArray, centre_px: FloatArray, sigma_px: float) -> FloatArray:
    before = pixels - 0.5
    last = pixels[:, -1:] + 0.5
    edges = np.concatenate([before, last], axis=1)
    offset = (edges - centre_px[:, None]) / (sigma_px * SQRT2)
    return np.asarray(0.5 * np.diff(erf(offset), axis=1))


def _add_stars(
    image: Any, first: Any, centre_px: Any, electrons_per_s: Any, scale: Any, size: int
) -> None:
    """The plain loop that numba compiles: `first` (n, 2) is each footprint's first pixel,
    `scale` is 1 / (sigma sqrt 2).
    """
    height, width = image.shape
    share = np.empty((2, size))
    for k in range(len(first)):
        for axis in range(2):
            before = math.erf((first[k, axis] - 0.5 - centre_px[axis, k]) * scale[axis])
            for i in range(size):
                after = math.erf((first[k, axis] + i + 0.5 - centre_px[axis, k]) * scale[axis])
                share[axis, i] = 0.5 * (after - before)
                before = after
        for j in range(max(0, -first[k, 1]), min(size, height - first[k, 1])):
            row = share[1, j] * electrons_per_s[k]
            for i in range(max(0, -first[k, 0]), min(size, width - first[k, 0])):
                image[first[k, 1] + j, first[k, 0] + i] += row * share[0, i]


def _make_numba() -> Draw:
    add_stars = import_module("numba").njit(_add_stars)

    def draw(sprites: FrameLight, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        image = np.zeros(shape, np.float32)
        first = sprites.data["pixel"] - (sprites.footprint_px - 1) // 2
        centre_px = np.stack([sprites.x_px, sprites.y_px])
        light = np.ascontiguousarray(sprites.data["electrons_per_s"])
        scale = 1 / (np.array(sigma_px) * SQRT2)
        add_stars(image, first, centre_px, light, scale, sprites.footprint_px)
        return image

    return draw


def _make_galsim() -> Draw:
    galsim = import_module("galsim")

    def draw(sprites: FrameLight, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        image = galsim.ImageF(np.zeros(shape, np.float32), xmin=0, ymin=0)
        profile = galsim.Gaussian(sigma=1.0).transform(sigma_px[0], 0, 0, sigma_px[1])
        last = sprites.footprint_px - 1
        first = (sprites.data["pixel"] - last // 2).tolist()
        light = sprites.data["electrons_per_s"].tolist()
        x_px = sprites.x_px.tolist()
        y_px = sprites.y_px.tolist()
        for (column, row), x, y, electrons in zip(first, x_px, y_px, light, strict=True):
            stamp = galsim.BoundsI(column, column + last, row, row + last)
            star = profile.withFlux(electrons)
            style = {"scale": 1.0, "center": galsim.PositionD(x, y), "add_to_image": True}
            star.drawImage(image=image[stamp & image.bounds], **style)
        return np.asarray(image.array)

    return draw


def _make_photutils() -> Draw:
    make_model_image = import_module("photutils.datasets").make_model_image
    model = import_module("photutils.psf").GaussianPRF
    table = import_module("astropy.table").QTable

    def draw(sprites: FrameLight, sigma_px: Sigma, shape: tuple[int, int]) -> Float32Array:
        flux = sprites.data["electrons_per_s"].astype(float)
        stars = table({"x_0": sprites.x_px, "y_0": sprites.y_px, "flux": flux})
        fwhm = {"x_fwhm": sigma_px[0] * FWHM_PER_SIGMA, "y_fwhm": sigma_px[1] * FWHM_PER_SIGMA}
        side = sprites.footprint_px | 1
        image = make_model_image(shape, model(**fwhm), stars, model_shape=(side, side))
        return np.asarray(image, dtype=np.float32)

    return draw


METHODS: tuple[tuple[str, str, Callable[[], Draw]], ...] = (
    ("numpy", "separable erf differences and np.add.at; our stamps", lambda: numpy_linear),
    ("numba", "the same as a compiled loop on one core, compiled before; our stamps", _make_numba),
    (
        "galsim",
        "drawImage of a Gaussian convolved with the pixel, by FFT; our stamps",
        _make_galsim,
    ),
    (
        "photutils",
        "make_model_image of GaussianPRF, exact in the pixel; stamps of the next odd side",
        _make_photutils,
    ),
)


def fresh_start(path: Path, q_icrs_to_cam: FloatArray, size: report.Size) -> report.ProcessStart:
    """Start a process that imports hilstar and draws one frame of the bench file."""
    attitude = map(repr, q_icrs_to_cam.tolist())
    command = [sys.executable, "-c", FRESH, str(path), *attitude]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    import_ms, first_frame_ms, memory_mb = map(float, done.stdout.split())
    return report.ProcessStart(*size, import_ms, first_frame_ms, memory_mb)


def this_machine() -> report.Machine:
    """The processor, and the versions that the times depend on."""
    load = round(os.getloadavg()[0], 2)
    cores = len(os.sched_getaffinity(0))
    return report.Machine(
        cpu=cpu_name(),
        cores=cores,
        load=load,
        python=platform.python_version(),
        numpy=np.__version__,
    )


def cpu_name() -> str:
    """The processor's model, or its architecture where Linux does not tell it."""
    cpus = Path("/proc/cpuinfo")
    if cpus.is_file():
        for line in cpus.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine()


def _keep_image(
    images: dict[str, Float32Array], name: str, draw: Callable[[], Float32Array]
) -> None:
    """Draw a method's image, and keep it to be compared."""
    images[name] = draw()


CellKey = tuple[int, int, int]  # width and height, px, and the number of stars


class CellMeasurement(Closing):
    """One image size and star count, measured into `result`; close it to free its two GL
    contexts.
    """

    def __init__(
        self, bench: Bench, q_icrs_to_cam: FloatArray, cell: report.Cell, result: report.Result
    ) -> None:
        self.bench = bench
        self.q = q_icrs_to_cam
        self.result = result
        self.cell_key = cell.width, cell.height, cell.stars
        self.shape = cell.height, cell.width
        self.sigma_px = bench.config.render.sprite_sigma_px
        self.candidates = Candidates()
        self.sprites = bench.sprites(self.q)
        self.icrs_to_image = bench.camera.cam_to_image @ to_matrix(self.q)
        self.staged = StagedRenderer(bench.renderer.target)
        target = Target(bench.camera.resolution_px, GaussianPsf(self.sigma_px))
        self.linear = Renderer(target)
        self.stage_ms: dict[str, list[float]] = {}

    def measure(self, methods: dict[str, Draw], rounds: int, budget_s: float) -> None:
        """Time every method in turn, so that other load on the machine is in the times of all."""
        works: dict[str, Callable[[], object]] = {
            "whole_frame": lambda: self.bench.draw(self.q).levels,
            "turning": lambda: self.bench.draw(self.q, 0, TURN_RAD_S).levels,
            "linear_only": self._draw_linear,
            "stages": self._draw_stages,
            "python": self._python,
        }
        images: dict[str, Float32Array] = {}
        for name, draw in methods.items():
            of_stars = self._of_stars(draw)
            why = too_long(of_stars, self.sprites, budget_s)
            if why is not None:
                skipped = report.Skipped(*self.cell_key, name, why)
                self.result.skipped.append(skipped)
                continue
            works[name] = partial(_keep_image, images, name, partial(of_stars, self.sprites))
        times_ms = interleaved(works, rounds, budget_s)
        rows, python = cell_times(self.cell_key, times_ms, self.stage_ms)
        self.result.rows += rows
        self.result.python_ms.append(python)
        ours = self._draw_linear()
        for name, image in images.items():
            off = np.abs(image - ours).max()
            worst = float(off / ours.max())
            agreement = report.Agreement(*self.cell_key, name, worst)
            self.result.agreement.append(agreement)

    def _of_stars(self, draw: Draw) -> Callable[[FrameLight], Float32Array]:
        """A method that is asked for stars alone."""
        return lambda sprites: draw(sprites, self.sigma_px, self.shape)

    def _draw_linear(self) -> Float32Array:
        self.linear.draw(self.sprites)
        return self.linear.linear()

    def _draw_stages(self) -> None:
        stars = self.bench.shown_stars
        camera = self.bench.camera
        footprint_px = self.staged.footprint_px
        begin = time.perf_counter()
        margin_px = footprint_px / 2 + 1
        near, directions, rates_e_per_s = self.candidates.near(
            stars, self.icrs_to_image, camera, margin_px
        )
        culled = time.perf_counter()
        # make_sprites in its two halves.
        x_px, y_px = camera.project((self.icrs_to_image @ directions).T)
        sprites = pack_sprites(x_px, y_px, rates_e_per_s, near, camera.resolution_px, footprint_px)
        projected = time.perf_counter()
        self.staged.draw(sprites)
        self.staged.levels()
        cull_ms = (culled - begin) * 1e3
        project_ms = (projected - culled) * 1e3
        stages_ms = {"cull": cull_ms, "project": project_ms}
        stages_ms |= self.staged.stage_ms
        for kind, ms in stages_ms.items():
            self.stage_ms.setdefault(kind, []).append(ms)

    def _python(self) -> None:
        """All of a frame that is not OpenGL."""
        white = self.bench.flux_at_white_e_per_s
        size_px = self.bench.camera.resolution_px
        sprites = self.bench.sprites(self.q)
        psf = GaussianPsf(self.sigma_px)
        clipped_sprites(
            sprites,
            psf,
            white,
            size_px,
            self.bench.uniformity,
            self.bench.darkest,
        )

    def close(self) -> None:
        """Free the GL contexts."""
        self.staged.close()
        self.linear.close()


def cell_times(
    cell_key: CellKey, times_ms: dict[str, list[float]], stages_ms: dict[str, list[float]]
) -> tuple[list[report.MethodTiming], report.PythonTime]:
    """A cell's rows: of hilstar's images, of their stages and of the other methods; and the time
    outside OpenGL.
    """
    named = []
    for kind in report.OF_AN_IMAGE:
        named.append(("hilstar", kind, times_ms[kind]))
    for kind in (*STAGES, *GPU_STAGES):
        stage_ms = stages_ms.get(kind)
        if stage_ms:
            # without the first turn, as in `interleaved`
            named.append(("hilstar", kind, stage_ms[1:] or stage_ms))
    for name, method_ms in times_ms.items():
        # "stages" has its waits in it; its parts are kept
        if name not in (*report.OF_AN_IMAGE, "stages", "python"):
            named.append((name, "linear_only", method_ms))
    rows = []
    for method, kind, kind_ms in named:
        rows.append(report.MethodTiming(*cell_key, method, kind, _spread(kind_ms)))
    return rows, report.PythonTime(*cell_key, _spread(times_ms["python"]))


def too_long(
    draw: Callable[[FrameLight], object], sprites: FrameLight, budget_s: float
) -> str | None:
    """Why a method is skipped for these stars, or None.

    Its time for all of them is estimated from that for one and for a hundred more.
    """
    if len(sprites) <= 101:
        return None

    def fastest_s(count: int) -> float:
        few = {}
        for name in ("data", "star", "x_px", "y_px"):
            few[name] = getattr(sprites, name)[:count]
        work = partial(draw, replace(sprites, **few))
        return min(_seconds(work), _seconds(work))

    one_s = fastest_s(1)
    hundred_s = fastest_s(101) - one_s
    star_s = hundred_s / 100
    frame_s = one_s + star_s * len(sprites)
    if frame_s > budget_s:
        return f"n/a: about {frame_s:.0f} s a frame, over the budget of {budget_s:g} s"
    return None


def interleaved(
    works: dict[str, Callable[[], object]], rounds: int, budget_s: float
) -> dict[str, list[float]]:
    """Times of each work, ms, in turn; a slow work gets fewer turns, to stay within `budget_s`.

    The first turn counts only where no other fits.
    """
    first_s = {}
    for name, work in works.items():
        first_s[name] = _seconds(work)
    turns = {}
    for name, seconds in first_s.items():
        turns[name] = min(rounds, int(budget_s / seconds) - 1)
    times: dict[str, list[float]] = {name: [] for name in works}
    for number in range(rounds):
        for name, work in works.items():
            before = number * turns[name] // rounds
            after = (number + 1) * turns[name] // rounds
            if after > before:
                work_ms = _seconds(work) * 1e3
                times[name].append(work_ms)
    for name, seconds in first_s.items():
        if turns[name] < 1:
            times[name] = [seconds * 1e3]
    return times


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _spread(times_ms: list[float]) -> report.TimeSpread:
    median_ms = float(np.median(times_ms))
    return report.TimeSpread(median_ms, min(times_ms), max(times_ms))


@dataclass(frozen=True, slots=True)
class BenchmarkPlan:
    """What to measure: image sizes (px), star counts, and the maximum rounds and seconds of a
    method in one cell.

    `file` replaces the benchmark's own bench file; `sizes` is then that file's image size.
    """

    sizes: tuple[report.Size, ...] = SIZES
    counts: tuple[int, ...] = COUNTS
    rounds: int = 100
    budget_s: float = 10.0
    starts: int = 3
    exposures: int = 20
    file: BenchFile | None = None


QUICK: BenchmarkPlan = BenchmarkPlan(
    sizes=(report.REFERENCE_PX,), counts=COUNTS[:3], rounds=30, budget_s=2.0, exposures=1
)


def run(
    plan: BenchmarkPlan, rng: np.random.Generator, advance: Callable[[int], object]
) -> report.Result:
    """Measure every cell of a plan; `advance` hears how many are done. Raises InputError,
    MachineError.
    """
    methods, missing = other_methods()
    others = OtherWork()
    does = {name: does for name, does, _ in METHODS if name in methods}
    machine = this_machine()
    result = report.Result(machine, does=does)
    for name, why in missing.items():
        skipped = report.Skipped(method=name, why=why)
        result.skipped.append(skipped)
    q_icrs_to_cam = from_radec_roll_deg(*RADEC_ROLL_DEG)
    cells_done = 0
    with TemporaryDirectory() as folder:
        for size in plan.sizes:
            path = Path(folder) / "bench.toml"
            file = plan.file or own_bench_file(path, size, motion="on")
            with open_bench(file) as bench:
                result.gl_renderer = bench.renderer.gl_renderer
                every = bench.shown_stars
                for count in plan.counts:
                    shown = scene(bench, every, q_icrs_to_cam, count, rng)
                    known = shown.catalogue_count
                    others_count = count - known
                    origin = report.SceneOrigin(*size, count, known, others_count)
                    result.scenes.append(origin)
                    own_bench = bench.with_stars(shown.stars)
                    cell = report.Cell(*size, count)
                    with CellMeasurement(own_bench, q_icrs_to_cam, cell, result) as measurement:
                        measurement.measure(methods, plan.rounds, plan.budget_s)
                    cells_done += 1
                    advance(cells_done)
            for _ in range(plan.starts):
                started = fresh_start(file.path, q_icrs_to_cam, size)
                result.startup.append(started)
    if plan.exposures:
        result.tracker, without = tracker.tracker_rows(plan.exposures, plan.budget_s)
        result.skipped += without
    tell_starts(result, plan.sizes)
    result.others_cores = round(others.cores(), 2)
    result.aims += _aims(result)
    return result


def tell_starts(result: report.Result, sizes: Sequence[report.Size]) -> None:
    """The medians of fresh processes at REFERENCE_PX, or at the first of sizes without it."""
    size = sizes[0]
    if report.REFERENCE_PX in sizes:
        size = report.REFERENCE_PX
    starts = [start for start in result.startup if start.size == size]
    for name in ("import_ms", "first_frame_ms", "memory_mb"):
        median = np.median([getattr(start, name) for start in starts])
        setattr(result, name, float(median))


def own_bench_file(path: Path, size_px: report.Size, **render: Value) -> BenchFile:
    """The benchmark's own bench file for an image size, written to `path`; `render` are further
    keys of [render].
    """
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "sky": {"faintest_v_mag": 14},
        "monitor": {**FULL_HD, "resolution_px": size_px},
        "collimator": {"focal_length_mm": 200},
        "render": {"flux_at_white_e_per_s": 2e6, "quantisation": "round", **render},
    }
    path.write_text(bench_text(tables))
    return read_bench_file(path)


def _aims(result: report.Result) -> list[report.Aim]:
    """The project's aims, beside the measured times."""
    frame_aims = _frame_aims(result.rows)
    python_aims = _python_aims(result.python_ms)
    aims = [*frame_aims, *python_aims]
    starts_ms = []
    for start in result.startup:
        if start.size == report.REFERENCE_PX:
            start_ms = start.import_ms + start.first_frame_ms
            starts_ms.append(start_ms)
    if starts_ms:
        median_ms = float(np.median(starts_ms))
        aims.append(("import and first frame", START_AIM_MS, median_ms))
    judged = []
    for what, aim_ms, ms in aims:
        reached = None if result.load.busy else ms <= aim_ms
        judged.append(report.Aim(what, aim_ms, ms, reached))
    return judged


def _frame_aims(rows: Sequence[report.MethodTiming]) -> Iterator[tuple[str, float, float]]:
    """Aims of frames and images: what, the aim and the time, ms."""
    at = {(row.size, row.stars, row.method, row.kind): row.ms.median for row in rows}
    for (size, stars, method, kind), ms in at.items():
        where = f"{stars} stars, {size[0]} x {size[1]}"
        still = at.get((size, stars, "hilstar", "whole_frame"))
        numba = at.get((size, stars, "numba", "linear_only"))
        if kind == "whole_frame" and (size, stars) in AIMS_MS:
            yield f"whole frame to codes, {where}", AIMS_MS[size, stars], ms
        elif kind == "turning" and still is not None:
            what = f"turning by 10 deg/s, {where}, {TURNING_TIMES:g} still frames"
            yield what, TURNING_TIMES * still, ms
        elif kind == "linear_only" and method == "hilstar" and numba is not None:
            yield f"linear image, {where}, numba's time", numba, ms


def _python_aims(rows: Sequence[report.PythonTime]) -> Iterator[tuple[str, float, float]]:
    """Aims of what is not OpenGL: what, the aim and the time, ms."""
    for row in rows:
        if row.size == report.REFERENCE_PX and row.stars in PYTHON_AIMS_MS:
            what = f"Python outside GL, {row.stars} stars"
            yield what, PYTHON_AIMS_MS[row.stars], row.ms.median
