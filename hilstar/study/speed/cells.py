"""One cell of the benchmark, an image size and a number of stars: every method and stage timed in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.bench.frame import Bench
from hilstar.render.renderer import Renderer, Target
from hilstar.render.stages import StagedRenderer
from hilstar.rotation import to_matrix
from hilstar.scene.sprites import Sprites, clipped_sprites, pack_sprites
from hilstar.study.speed.other_methods import OtherMethod
from hilstar.study.speed.result import Agreement, Cell, PythonTime, Result, Skipped, Spread, Timing

STAGES = ("cull", "project", "erase", "upload", "splat", "encode", "read_back")
GPU_STAGES = ("gpu_splat", "gpu_encode")
# 10 deg/s about an axis across and along the boresight: each star is drawn along its path while its row is lit.
TURN_RAD_S = np.radians(10.0) * np.array([0.64, -0.74, 0.21])


class CellMeasurement:
    """One image size and star count, measured into `result`; close it to free its two GL contexts."""

    def __init__(self, bench: Bench, q_icrs_to_cam: FloatArray, cell: Cell, result: Result) -> None:
        self.bench, self.q, self.result = bench, q_icrs_to_cam, result
        self.cell_key = cell.width, cell.height, cell.stars
        self.shape = cell.height, cell.width
        self.sigma_px = bench.config.render.sprite_sigma_px
        self.sprites = bench.sprites(self.q)
        self.icrs_to_image = bench.camera.cam_to_image @ to_matrix(self.q)
        self.staged = StagedRenderer(bench.renderer.target)
        self.linear = Renderer(Target(bench.camera.resolution_px, self.sigma_px))
        self.stage_ms: dict[str, list[float]] = {}

    def measure(self, methods: list[OtherMethod], rounds: int, budget_s: float) -> None:
        """Time every method in turn, so that what else the machine does is in the times of all."""
        works: dict[str, Callable[[], object]] = {
            "whole_frame": lambda: self.bench.draw(self.q).levels,
            "turning": lambda: self.bench.draw(self.q, 0, TURN_RAD_S).levels,
            "linear_only": self._draw_linear,
            "stages": self._draw_stages,
            "python": self._python,
        }
        images: dict[str, Float32Array] = {}
        for other in methods:
            if (why := self._too_long(other, budget_s)) is not None:
                self.result.skipped.append(Skipped(*self.cell_key, other.name, why))
                continue
            works[other.name] = lambda other=other: images.update({other.name: self._draw_other(other)})  # type: ignore[misc]
        self._keep(interleaved(works, rounds, budget_s))
        ours = self._draw_linear()
        for name, image in images.items():
            worst = float(np.abs(image - ours).max() / ours.max())
            self.result.agreement.append(Agreement(*self.cell_key, name, worst))

    def _keep(self, times_ms: dict[str, list[float]]) -> None:
        self.result.python_ms.append(PythonTime(*self.cell_key, _spread(times_ms.pop("python"))))
        del times_ms["stages"]  # with its waits; its parts are kept
        rows = [("hilstar", kind, times_ms.pop(kind)) for kind in ("whole_frame", "turning", "linear_only")]
        for kind in (*STAGES, *GPU_STAGES):
            if stage_ms := self.stage_ms.get(kind):
                rows.append(("hilstar", kind, stage_ms[1:] or stage_ms))  # without the first turn, as in `interleaved`
        rows += [(name, "linear_only", times) for name, times in times_ms.items()]
        for method, kind, times in rows:
            self.result.rows.append(Timing(*self.cell_key, method, kind, _spread(times)))

    def _too_long(self, other: OtherMethod, budget_s: float) -> str | None:
        """Why a method is skipped here: its time for all stars, estimated from that for one star and for a hundred more."""
        few = [_first(self.sprites, count) for count in (1, 101)]
        if len(self.sprites) <= len(few[1]):
            return None
        one_s, more_s = (self._minimum_s(other, part) for part in few)
        frame_s = one_s + (more_s - one_s) / 100 * len(self.sprites)
        return f"n/a: about {frame_s:.0f} s a frame, over the budget of {budget_s:g} s" if frame_s > budget_s else None

    def _minimum_s(self, other: OtherMethod, part: Sprites) -> float:
        return min(_seconds(lambda: other.draw(part, self.sigma_px, self.shape)) for _ in range(2))

    def _draw_other(self, other: OtherMethod) -> Float32Array:
        return other.draw(self.sprites, self.sigma_px, self.shape)

    def _draw_linear(self) -> Float32Array:
        self.linear.draw(self.sprites)
        return self.linear.linear()

    def _draw_stages(self) -> None:
        stars, camera, footprint_px = self.bench.shown_stars, self.bench.camera, self.staged.footprint_px
        begin = time.perf_counter()
        margin_px = footprint_px / 2 + 1
        near, directions, rates_e_per_s = self.bench.candidates.near(stars, self.icrs_to_image, camera, margin_px)
        culled = time.perf_counter()
        # make_sprites in its two halves.
        x_px, y_px = camera.project((self.icrs_to_image @ directions).T)
        sprites = pack_sprites(x_px, y_px, rates_e_per_s, near, camera.resolution_px, footprint_px)
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

    def __enter__(self) -> CellMeasurement:
        return self

    def __exit__(self, *exception: object) -> None:
        self.staged.close()
        self.linear.close()


def interleaved(works: dict[str, Callable[[], object]], rounds: int, budget_s: float) -> dict[str, list[float]]:
    """Times in ms of each work, taken in turn; slow ones take fewer turns, evenly, to stay within `budget_s` each.

    The first turn counts only where no other fits.
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


def _spread(times_ms: list[float]) -> Spread:
    return Spread(float(np.median(times_ms)), min(times_ms), max(times_ms))


def _first(sprites: Sprites, count: int) -> Sprites:
    parts = {name: getattr(sprites, name)[:count] for name in ("data", "star", "x_px", "y_px")}
    return replace(sprites, **parts)
