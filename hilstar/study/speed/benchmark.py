"""How long a frame takes, stage by stage, beside other ways to the same image, in one run and on the same stars."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.bench.build import open_bench
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.render.renderer import Renderer, Target
from hilstar.render.stages import StagedRenderer
from hilstar.rotation import from_radec_roll_deg, to_matrix
from hilstar.scene.clipping import clipped_sprites
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.cells import cell_grid
from hilstar.sky.stars import Stars
from hilstar.study.speed.others import Other, others

Size = tuple[int, int]
SIZES: tuple[Size, ...] = ((1024, 1024), (1920, 1080), (2560, 2048), (3840, 2160))
COUNTS = (100, 1000, 10_000, 50_000)
REFERENCE_PX = (1920, 1080)
MOST_STARS = 200_000  # NumPy's way takes 2.9 kB of memory for each
RADEC_ROLL_DEG = (84.057, -1.2, 10.0)
# A cap this much wider than the monitor's own: culling must have something to throw away.
SKY_BEYOND = 1.5
STAGES = ("cull", "project", "erase", "upload", "splat", "encode", "read_back")
START = ("import_ms", "first_frame_ms", "memory_mb")
GPU_STAGES = ("gpu_splat", "gpu_encode")
# What the project set itself for REFERENCE_PX on two cores; by stars, ms.
AIMS_MS = {1000: 7.0, 10_000: 25.0}
PYTHON_AIM_MS = 0.6  # at 1000 stars
START_AIM_MS = 1500.0
BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [1024, 1024]
quantum_efficiency = "ccd47-20"
[sky]
faintest_v_mag = 14
[monitor]
resolution_px = [{}, {}]
pixel_pitch_um = 57.65
[collimator]
focal_length_mm = 200
[render]
flux_at_white_e_per_s = 2e6
"""
FRESH = """
import re, sys, time
from pathlib import Path
begin = time.perf_counter()
from hilstar import load
imported = time.perf_counter()
import numpy as np
with load(sys.argv[1]) as bench:
    bench.draw(np.array([float(part) for part in sys.argv[2:]])).levels
    drawn = time.perf_counter()
# Not getrusage: its maximum is inherited from the process that started this one.
most_kb = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print((imported - begin) * 1e3, (drawn - imported) * 1e3, int(most_kb) / 1024)
"""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to measure: image sizes (px), star counts, and at most how many rounds and seconds for a way in one cell.

    `file` stands in for the benchmark's own bench; `sizes` is then its own size.
    """

    sizes: tuple[Size, ...] = SIZES
    counts: tuple[int, ...] = COUNTS
    rounds: int = 100
    budget_s: float = 10.0
    starts: int = 3
    file: BenchFile | None = None


QUICK = Plan(sizes=(REFERENCE_PX,), counts=COUNTS[:3], rounds=30, budget_s=2.0)


def run(plan: Plan, rng: np.random.Generator, advance: Callable[[int], object]) -> dict[str, Any]:
    """Measure; the JSON object of the command. `advance` hears how many cells are done. Raises InputError, MachineError."""
    found, missing = others()
    result: dict[str, Any] = {"machine": _machine(), "gl_renderer": "", "rows": [], "scenes": [], "agreement": []}
    result |= {"startup": [], "python_ms": [], "does": {other.name: other.does for other in found}}
    result["skipped"] = [{"method": name, "why": why} for name, why in missing.items()]
    q = from_radec_roll_deg(*RADEC_ROLL_DEG)
    with TemporaryDirectory() as folder:
        for place, size in enumerate(plan.sizes):
            file = plan.file or _own_bench(Path(folder) / "bench.toml", size)
            with open_bench(file) as bench:
                result["gl_renderer"] = bench.renderer.gl_renderer
                every = bench.shown_stars
                for k, count in enumerate(plan.counts):
                    stars, catalogue = scene(bench, every, q, (count, rng))
                    cell = {"width": size[0], "height": size[1], "stars": count}
                    result["scenes"].append(cell | {"catalogue": catalogue, "random": count - catalogue})
                    with Cell(bench.with_stars(stars), q, cell, result) as measured:
                        measured.measure(plan, found)
                    advance(place * len(plan.counts) + k + 1)
            result["startup"] += [_fresh_start(file.path, q, size) for _ in range(plan.starts)]
    return result | _start_summary(result["startup"], plan.sizes) | {"aims": _aims(result)}


def _own_bench(path: Path, size: Size) -> BenchFile:
    path.write_text(BENCH.format(*size))
    return read_bench_file(path)


def scene(bench: Bench, every: Stars, q: FloatArray, count_and_rng: tuple[int, np.random.Generator]) -> tuple[Stars, int]:
    """Exactly `count` stars in view at `q`: the brightest of `every`, and past the catalogue random ones in and around the
    view, as bright as random stars of its fainter half. Also how many in view are the catalogue's.
    """
    count, rng = count_and_rng
    if not len(every):
        raise InputError("bench: the bench file leaves no star to show; write a larger [sky] faintest_v_mag")
    seen = bench.sprites(q, every).star
    ranked = seen[np.argsort(every.v_mag[seen], kind="stable")]
    if len(ranked) >= count:
        kept = every.v_mag <= every.v_mag[ranked[count - 1]]
        kept[ranked[count:]] = False
        return _sorted(every, np.flatnonzero(kept), every.vectors[kept]), count
    vectors = _directions(bench, q, count - len(ranked), rng)
    faint = np.flatnonzero(every.v_mag >= np.median(every.v_mag))
    sources = np.concatenate([np.arange(len(every)), rng.choice(faint, len(vectors))])
    return _sorted(every, sources, np.concatenate([every.vectors, vectors])), len(ranked)


def _sorted(every: Stars, sources: Any, vectors: FloatArray) -> Stars:
    """Stars at `vectors` (n, 3) that are otherwise those of `every` at `sources` (n,), by cell."""
    grid = cell_grid(vectors)
    names = [field.name for field in fields(Stars) if field.name not in ("grid", "vectors")]
    columns = {name: getattr(every, name)[sources[grid.order]] for name in names}
    return replace(every, vectors=np.ascontiguousarray(vectors[grid.order]), grid=grid, **columns)


def _directions(bench: Bench, q: FloatArray, wanted: int, rng: np.random.Generator) -> FloatArray:
    """ICRS unit vectors, even over a cap around the view, of which `wanted` are in view."""
    camera, footprint_px = bench.camera, bench.renderer.footprint_px
    cos_cap = np.cos(min(SKY_BEYOND * camera.field_radius_rad(footprint_px), np.pi))
    tries = 4 * wanted
    while True:
        z, turn = 1 - rng.uniform(size=tries) * (1 - cos_cap), rng.uniform(0, 2 * np.pi, tries)
        across = np.sqrt(1 - z**2)
        vectors = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
        x_px, y_px = camera.project(vectors)
        seen = pack_sprites(x_px, y_px, z, np.arange(tries), camera.resolution_px, footprint_px).star
        if len(seen) >= wanted:
            return np.asarray(vectors[: seen[wanted - 1] + 1] @ (camera.cam_to_image @ to_matrix(q)))
        tries *= 2


class Cell:
    """One image size and star count, measured into `result`; close it to free its two GL contexts."""

    def __init__(self, bench: Bench, q: FloatArray, cell: dict[str, int], result: dict[str, Any]) -> None:
        self.bench, self.q, self.cell, self.result = bench, q, cell, result
        self.shape = cell["height"], cell["width"]
        self.sigma_px = bench.config.render.sprite_sigma_px
        self.sprites = bench.sprites(q)
        self.icrs_to_image = bench.camera.cam_to_image @ to_matrix(q)
        self.staged = StagedRenderer(bench.renderer.target)
        self.linear = Renderer(Target(bench.camera.resolution_px, self.sigma_px))
        self.stage_ms: dict[str, list[float]] = {}

    def measure(self, plan: Plan, found: list[Other]) -> None:
        """Every way in turn, so that a noisy machine is noisy to all."""
        works: dict[str, Callable[[], object]] = {
            "whole_frame": lambda: self.bench.draw(self.q).levels,
            "linear_only": self._draw_linear,
            "stages": self._draw_stages,
            "python": self._python,
        }
        images: dict[str, Float32Array] = {}
        for other in found:
            if (why := self._too_long(other, plan.budget_s)) is not None:
                self.result["skipped"].append(self.cell | {"method": other.name, "why": why})
                continue
            works[other.name] = lambda other=other: images.update({other.name: self._draw_other(other)})  # type: ignore[misc]
        self._keep(interleaved(works, plan.rounds, plan.budget_s))
        ours = self._draw_linear()
        for name, image in images.items():
            worst = float(np.abs(image - ours).max() / ours.max())
            self.result["agreement"].append(self.cell | {"method": name, "worst_of_peak": worst})

    def _keep(self, times_ms: dict[str, list[float]]) -> None:
        self.result["python_ms"].append(self.cell | {"ms": _spread(times_ms.pop("python"))})
        del times_ms["stages"]  # with its waits; its parts are kept
        rows = [("hilstar", kind, times_ms.pop(kind)) for kind in ("whole_frame", "linear_only")]
        for kind in (*STAGES, *GPU_STAGES):
            if stage_ms := self.stage_ms.get(kind):
                rows.append(("hilstar", kind, stage_ms[1:] or stage_ms))  # as `interleaved` leaves the first turn out
        rows += [(name, "linear_only", times) for name, times in times_ms.items()]
        for method, kind, times in rows:
            self.result["rows"].append(self.cell | {"method": method, "kind": kind, "ms": _spread(times)})

    def _too_long(self, other: Other, budget_s: float) -> str | None:
        """Why a way is left out here: its time for all stars, told from that for a hundred and for one."""
        few = [_first(self.sprites, count) for count in (1, 101)]
        if len(self.sprites) <= len(few[1]):
            return None
        one_s, more_s = (self._least_s(other, part) for part in few)
        frame_s = one_s + (more_s - one_s) / 100 * len(self.sprites)
        return f"n/a: about {frame_s:.0f} s a frame, over the budget of {budget_s:g} s" if frame_s > budget_s else None

    def _least_s(self, other: Other, part: Sprites) -> float:
        return min(_seconds(lambda: other.draw(part, self.sigma_px, self.shape)) for _ in range(2))

    def _draw_other(self, other: Other) -> Float32Array:
        return other.draw(self.sprites, self.sigma_px, self.shape)

    def _draw_linear(self) -> Float32Array:
        self.linear.draw(self.sprites)
        return self.linear.linear()

    def _draw_stages(self) -> None:
        stars, camera, footprint_px = self.bench.shown_stars, self.bench.camera, self.staged.footprint_px
        begin = time.perf_counter()
        near = stars.grid.near(self.icrs_to_image[2], camera.field_radius_rad(footprint_px / 2 + 1))
        culled = time.perf_counter()
        # make_sprites in its two halves.
        x_px, y_px = camera.project(stars.vectors[near] @ self.icrs_to_image.T)
        sprites = pack_sprites(x_px, y_px, stars.electrons_per_s[near], near, camera.resolution_px, footprint_px)
        projected = time.perf_counter()
        self.staged.draw(sprites)
        self.staged.codes()
        cull_ms, project_ms = (culled - begin) * 1e3, (projected - culled) * 1e3
        for kind, ms in {"cull": cull_ms, "project": project_ms, **self.staged.stage_ms}.items():
            self.stage_ms.setdefault(kind, []).append(ms)

    def _python(self) -> None:
        """All of a frame that is not OpenGL."""
        white, size_px = self.bench.flux_at_white_e_per_s, self.bench.camera.resolution_px
        clipped_sprites(self.bench.sprites(self.q), self.sigma_px, white, size_px, self.bench.uniformity, self.bench.darkest)

    def __enter__(self) -> Cell:
        return self

    def __exit__(self, *exception: object) -> None:
        self.staged.close()
        self.linear.close()


def interleaved(works: dict[str, Callable[[], object]], rounds: int, budget_s: float) -> dict[str, list[float]]:
    """Times in ms of each work, taken in turn; slow ones take fewer turns, evenly, to stay within `budget_s` each.

    A first turn is left out unless it is the only one that fits.
    """
    first_s = {name: _seconds(work) for name, work in works.items()}
    turns = {name: min(rounds, int(budget_s / seconds) - 1) for name, seconds in first_s.items()}
    times = {name: [first_s[name] * 1e3] if turns[name] < 1 else [] for name in works}
    for k in range(rounds):
        for name, work in works.items():
            if turns[name] > 0 and (k + 1) * turns[name] // rounds > k * turns[name] // rounds:
                times[name].append(_seconds(work) * 1e3)
    return times


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _spread(times_ms: list[float]) -> dict[str, float]:
    return {"median": float(np.median(times_ms)), "min": min(times_ms), "max": max(times_ms)}


def _first(sprites: Sprites, count: int) -> Sprites:
    parts = {name: getattr(sprites, name)[:count] for name in ("data", "star", "x_px", "y_px")}
    return replace(sprites, **parts)


def _machine() -> dict[str, Any]:
    names = [line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name")]
    return {
        "cpu": next(iter(names), platform.machine()),
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 2),  # of the last minute: what others run is in our times
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _cpu_lines() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []


def _fresh_start(path: Path, q: FloatArray, size: Size) -> dict[str, float]:
    """Import and first frame in a process of its own, and the memory that it then has had at most."""
    command = [sys.executable, "-c", FRESH, str(path), *map(repr, q.tolist())]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    import_ms, first_frame_ms, memory_mb = map(float, done.stdout.split())
    return {
        "width": size[0],
        "height": size[1],
        "import_ms": import_ms,
        "first_frame_ms": first_frame_ms,
        "memory_mb": memory_mb,
    }


def _start_summary(starts: list[dict[str, float]], sizes: tuple[Size, ...]) -> dict[str, Any]:
    """Medians at REFERENCE_PX, or at the first size."""
    width, height = REFERENCE_PX if REFERENCE_PX in sizes else sizes[0]
    here = [start for start in starts if (start["width"], start["height"]) == (width, height)]
    return {name: float(np.median([start[name] for start in here])) for name in START}


def _aims(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The aims that this run can judge."""
    aims = []
    for row in result["rows"]:
        if row["kind"] == "whole_frame" and _at_reference(row) and row["stars"] in AIMS_MS:
            aims.append((f"whole frame to codes, {row['stars']} stars", AIMS_MS[row["stars"]], row["ms"]["median"]))
    for row in result["python_ms"]:
        if row["stars"] == 1000 and _at_reference(row):
            aims.append(("Python outside GL, 1000 stars", PYTHON_AIM_MS, row["ms"]["median"]))
    starts = [start["import_ms"] + start["first_frame_ms"] for start in result["startup"] if _at_reference(start)]
    if starts:
        aims.append(("import and first frame", START_AIM_MS, float(np.median(starts))))
    return [{"what": what, "aim_ms": aim, "measured_ms": ms, "reached": ms <= aim} for what, aim, ms in aims]


def _at_reference(row: dict[str, Any]) -> bool:
    return (row["width"], row["height"]) == REFERENCE_PX
