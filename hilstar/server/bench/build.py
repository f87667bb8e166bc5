"""From a bench file to the parts that it describes: stars, geometry, light, effort and a
renderer.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantisation
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.numpy_backend import headless_context, open_backend
from hilstar.display.render.target import Target
from hilstar.optics.layers.layers import NO_SOURCES, Sources
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
)
from hilstar.server.bench.colours import Colours
from hilstar.server.bench.config.values import MIN_POSITIVE
from hilstar.server.bench.effort import (
    BEST,
    CHEAP,
    IN_TIME_SHARE,
    SURELY_IN_TIME,
    TIMED_RATE_RAD_S,
    Effort,
    FieldCost,
    plan_effort,
)
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.monitor import bench_calibration, scan_of
from hilstar.server.bench.primary_panels import bench_colours, primary_panels
from hilstar.server.bench.scene import (
    Display,
    Scene,
    path_of,
    plan_scene,
    scenes_of,
    turning_of,
)
from hilstar.server.bench.star_glass import star_glass
from hilstar.server.bench.star_light import (
    bench_sources,
    bench_stars,
    moved,
)
from hilstar.sky.stars import (
    Stars,
    split_by_rate,
)

if TYPE_CHECKING:
    from hilstar.display.render.context import Context

# Codes are timed in fields spread evenly over the sky, turning at 1 deg/s, as often as these times
# allow. The fastest frame of each field counts.
TIMED_RADEC_DEG = ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))
TIMED_FIELDS = [from_radec_roll_deg(ra_deg, dec_deg, 0.0) for ra_deg, dec_deg in TIMED_RADEC_DEG]
TIMED_EXACT_S, TIMED_ROUND_S, MAX_TIMED = 0.1, 0.05, 10


def load(path: str | Path) -> Bench:
    """Assemble the bench that a file describes; NumPy draws where OpenGL is missing. Raises
    InputError.
    """
    return open_bench(read_bench_file(Path(path)))


def open_bench(
    file: BenchFile, context: Context | None = None, *, timed: bool = False, on_screen: bool = False
) -> Bench:
    """Assemble the bench of a file, in a `context` if one is given; NumPy draws where OpenGL is
    missing. Raises InputError.

    `on_screen` is for runs whose frames a screen lights row by row. `timed` is for runs that a
    clock paces: where `quantisation = "auto"` depends on what codes cost, that is measured here.
    """
    sources = bench_sources(file.config, file.folder)
    stars = bench_stars(file.config, file.folder, sources.moving)
    return assembled(file, stars, context, sources, timed=timed, on_screen=on_screen)


def full_scale_e_per_s(file: BenchFile) -> float:
    """Light of a pixel at white, electrons per second in the tracker: as the file states it, else
    as its bench has it. Raises InputError.
    """
    stated = file.config.render.flux_at_white_e_per_s
    if stated is not None:
        return stated
    with open_bench(file) as bench:
        return bench.flux_at_white_e_per_s


def assembled(
    file: BenchFile,
    stars: Stars,
    context: Context | None = None,
    sources: Sources = NO_SOURCES,
    *,
    timed: bool = False,
    on_screen: bool = False,
) -> Bench:
    """The bench of a file whose stars are made already, as `bench_stars` makes them. Raises
    InputError.
    """
    if context is not None:  # a window's context, which the window frees
        return _bench(_parts(file, stars, sources, context, on_screen), timed)
    context = headless_context(file.config.render.gpu)
    try:
        return _bench(_parts(file, stars, sources, context, on_screen), timed)
    except BaseException:
        if context is not None:
            context.release()
        raise


@dataclass(frozen=True)
class Parts:
    """What a bench consists of with any effort: read from its files, and planned once.

    `stars` have the light of the primaries where there are any. `spectra` gives stars' shares of
    the PSF's wavelengths; None where the PSF is of one light.
    """

    file: BenchFile
    stars: Stars
    sources: Sources
    display: Display
    uniformity: Float32Array | None
    colours: Colours | None
    panels: tuple[Panel, ...]
    scene: Scene
    spectra: Callable[[Stars, IntArray], FloatArray] | None
    planned: Effort

    def with_effort(self, effort: Effort) -> Bench:
        """The bench that draws with an effort, by a renderer of its own."""
        file, scene, calibration = self.file, self.scene, self.display.calibration
        codes = effort.quantisation
        render = replace(
            file.config.render, quantisation=codes, motion_above_px=effort.motion_above_px
        )
        config = replace(file.config, render=render)
        faintest = QUANTISERS[codes].faintest_e_per_s(scene.light.panel, scene.psf)
        shown, faint = split_by_rate(self.stars, faintest, self.display.drive)
        return Bench(
            file=file,
            config=config,
            effort=effort,
            camera=self.display.camera,
            scan=scan_of(config.monitor),
            calibration=calibration,
            uniformity=self.uniformity,
            darkest=self.display.darkest,
            flux_at_white_e_per_s=scene.white_e_per_s,
            faintest_shown_e_per_s=faintest,
            stars=self.seen_stars(self.stars),
            shown_stars=self.seen_stars(shown),
            faint_stars=faint,
            sources=self.sources,
            tracker_psf=before_detector(config, file.folder, self.display.camera),
            spectra=self.spectra,
            drawn=scene.choice,
            renderer=open_backend(self.target(effort), self.display.context),
            colours=self.colours,
            panel=Panel(calibration.response, scene.white_e_per_s, self.uniformity, self.panels),
        )

    def target(self, effort: Effort) -> Target:
        """What a renderer draws with an effort."""
        target = Target(
            resolution_px=self.file.config.monitor.resolution_px,
            psf=self.scene.psf,
            response=self.display.calibration.response,
            flux_at_white_e_per_s=self.scene.white_e_per_s,
            quantisation=effort.quantisation,
            uniformity=self.uniformity,
            sides=effort.sides,
            seen=self.scene.light.seen,
        )
        colours = self.colours
        if colours is None:
            return target
        together = colours.by_primary.T @ colours.by_primary
        return dataclasses.replace(
            target, primaries=self.panels, places_px=colours.places_px, together=together
        )

    def seen_stars(self, stars: Stars) -> Stars:
        """Stars as a camera that moves with the bench's sources sees them, in its colours."""
        apparent = moved(stars, self.sources.moving)
        if self.colours is None:
            return apparent
        return self.colours.on(apparent)


def _parts(
    file: BenchFile, stars: Stars, sources: Sources, context: Context | None, on_screen: bool
) -> Parts:
    config = file.config
    calibration = bench_calibration(config, file.folder)
    camera = bench_camera(config, file.folder)
    colours = bench_colours(config, file.folder, stars.catalog)
    stars, drive = _in_colour(stars, colours)
    uniformity = calibration.uniformity_map(config.monitor.resolution_px)
    darkest = 1.0 if uniformity is None else float(uniformity.min())
    display = Display(
        calibration=calibration,
        camera=camera,
        context=context,
        drive=drive,
        turning=turning_of(config, on_screen),
        path_px=path_of(config, camera, on_screen),
        darkest=darkest,
    )
    scene, planned = plan_scene(config.render, scenes_of(file, stars, display))
    panels: tuple[Panel, ...] = ()
    if colours is not None:
        panels = primary_panels(file, colours, scene.white_e_per_s, uniformity)
    glass = star_glass(file, scene.psf)
    spectra = None if glass is None else glass.shares
    return Parts(
        file, stars, sources, display, uniformity, colours, panels, scene, spectra, planned
    )


def _bench(parts: Parts, timed: bool) -> Bench:
    """The bench with the planned effort; where a timed run's plan depends on what codes cost, with
    the effort that this machine's own times allow.
    """
    planned, light = parts.planned, parts.scene.light
    render = parts.file.config.render
    bench = parts.with_effort(planned)
    if not timed or not planned.by_cost or render.codes_ms is not None:
        return bench
    # The one that is not taken stays in the GL context until that is freed.
    benches: dict[Quantisation, Bench] = {planned.quantisation: bench}

    def frame_ms(method: Quantisation, for_s: float) -> float:
        if method not in benches:
            by_method = replace(render, quantisation=method)
            benches[method] = parts.with_effort(plan_effort(by_method, light))
        return timed_frame_ms(benches[method], for_s)

    limit_ms = IN_TIME_SHARE * light.refresh_ms
    cost = measured_cost(frame_ms, light.tabulated_cost(bench.psf), limit_ms)
    effort = plan_effort(render, dataclasses.replace(light, measured=cost))
    bench = benches[effort.quantisation]
    measured = replace(bench.config.render, codes_ms=(cost.cheap_ms, cost.best_ms))
    config = replace(bench.config, render=measured)
    return dataclasses.replace(bench, effort=effort, config=config)


def _in_colour(stars: Stars, colours: Colours | None) -> tuple[Stars, float | FloatArray]:
    """The stars with the light of each primary, and how much of white each asks for (1: as much as
    a white star).
    """
    if colours is None:
        return stars, 1.0
    stars = colours.on(stars)
    if stars.primaries is None:
        return stars, 1.0
    return stars, colours.drive(stars.primaries)


def measured_cost(
    frame_ms: Callable[[Quantisation, float], float], table: FieldCost, limit_ms: float
) -> FieldCost:
    """The cost of codes by `frame_ms`, which times a frame of a quantisation for so many seconds.

    Where `exact` is clearly in time, `round` is not timed: its share of that is the table's.
    """
    best_ms = frame_ms(BEST, TIMED_EXACT_S)
    if best_ms > limit_ms * SURELY_IN_TIME:
        cheap_ms = frame_ms(CHEAP, TIMED_ROUND_S)
    else:
        share = table.cheap_ms / table.best_ms if table.best_ms else 1.0
        cheap_ms = best_ms * share
    cheap_ms, best_ms = _written_ms(cheap_ms), _written_ms(best_ms)
    key = f"[render] codes_ms = [{cheap_ms:g}, {best_ms:g}]"
    return FieldCost(cheap_ms, best_ms, f"as measured here ({key} fixes it)")


def _written_ms(ms: float) -> float:
    """A time as a bench file would have it: three digits, and never 0."""
    return max(float(f"{ms:.3g}"), MIN_POSITIVE)


def timed_frame_ms(
    bench: Bench, for_s: float, now_ns: Callable[[], int] = time.monotonic_ns
) -> float:
    """The time of a frame of an average field that turns at 1 deg/s, ms, by drawing for about
    `for_s` after a warm-up.
    """
    bench.warm_up()
    took_ms: dict[int, float] = {}
    end_ns = now_ns() + round(for_s * NS_PER_S)
    for k, q_icrs_to_cam in [*enumerate(TIMED_FIELDS)] * MAX_TIMED:
        begin_ns = now_ns()
        if took_ms and begin_ns > end_ns:
            break
        bench.draw(q_icrs_to_cam, 0, TIMED_RATE_RAD_S)
        bench.renderer.finish()
        frame_ms = (now_ns() - begin_ns) / NS_PER_MS
        took_ms[k] = min(took_ms.get(k, math.inf), frame_ms)
    bench.renderer.begin_anew()
    return sum(took_ms.values()) / len(took_ms)
