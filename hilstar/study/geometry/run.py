"""How far stars are off after a geometric calibration: against dots, against noise, and by model, with where each fails.

The bench is traced by Snell's law (see `doublet`): no model here is of its family. The tracker has 38 arcsec per pixel and sees
the whole screen; 5 % of the dots are lost and as many false.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.calibrate.geometric.calibration import matched
from hilstar.calibrate.geometric.dots import plan_dots
from hilstar.calibrate.geometric.fit import (
    BROWN_CONRADY,
    PINHOLE,
    RADIAL,
    Geometry,
    MatchedDots,
    Model,
    Nominal,
    Problem,
    fit,
    held_out,
)
from hilstar.calibrate.geometric.match import first_look
from hilstar.charts import INK, SERIES, chart, label_ends, plain_ticks, write_records
from hilstar.monitor.geometry import monitor_camera
from hilstar.scene.camera import Camera
from hilstar.study.geometry.doublet import TracedBench
from hilstar.study.geometry.observed_dots import Faults, observed_dots
from hilstar.units import ARCSEC_PER_RAD

BENCH = TracedBench(lens_shift_mm=(8.0, -5.0), lens_tilt_deg=(4.0, 2.5))
TRACKER = Camera((2048, 2048), ARCSEC_PER_RAD / 38.0, (1023.5, 1023.5), np.eye(3))


@dataclass(frozen=True, slots=True)
class LensModel:
    """A model of the lens: what it is called, its free parameters, and the degree of its residual field (0: none)."""

    name: str
    parameters: tuple[str, ...]
    field_degree: int = 0


@dataclass(frozen=True, slots=True, order=True)
class Frames:
    """What was shown and seen: frames, dots lit in each, and the noise of a centroid."""

    count: int
    dots: int
    noise_px: float


MODELS = (
    LensModel("a pinhole", PINHOLE),
    LensModel("a pinhole with k1", RADIAL),
    LensModel("Brown-Conrady with tilt", BROWN_CONRADY),
    LensModel("the same with a field of degree 4", BROWN_CONRADY, 4),
)
SIZES = ((8, 10), (10, 25), (14, 40), (20, 60), (30, 100))
NOISES_PX = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
USUAL_SIZE, USUAL_NOISE_PX = (20, 60), 0.02
STARS = 4000
FAIL_ARCSEC = 1.0
SEED = 7
MARKERS = "osd^"
SHORT = {"the same with a field of degree 4": "with a field, degree 4", "Brown-Conrady with tilt": "Brown-Conrady, tilt"}


@dataclass(frozen=True, slots=True)
class Outcome:
    """One model on one set of frames: what dots that were held out say, and where stars all over the screen really are."""

    frames: int
    dots_per_frame: int
    noise_px: float
    model: str
    centroids: int
    held_out_arcsec: float
    stars_rms_arcsec: float
    stars_max_arcsec: float


def run(directory: Path, quick: bool = False) -> list[str]:
    """Measure, and write `geometry.csv` and its chart; a line for each model. Raises InputError."""
    sizes = SIZES[1:4:2] if quick else SIZES
    noises = (USUAL_NOISE_PX, NOISES_PX[-1]) if quick else NOISES_PX
    shown = {Frames(*size, USUAL_NOISE_PX) for size in sizes} | {Frames(*USUAL_SIZE, noise) for noise in noises}
    outcomes = [outcome for frames in sorted(shown) for outcome in _outcomes(frames)]
    write_records(directory / "geometry.csv", outcomes)
    usual = [o for o in outcomes if (o.frames, o.dots_per_frame) == USUAL_SIZE and o.noise_px == USUAL_NOISE_PX]
    best = min(usual, key=lambda o: o.held_out_arcsec)
    finding = (
        f"Uncalibrated stars are off by {ideal_arcsec():.0f} arcsec rms, by {usual[0].model} {usual[0].stars_rms_arcsec:.0f},"
        f" by the model that held-out dots choose ({best.model}) {best.stars_rms_arcsec:.2g}"
    )
    _draw(directory / "geometry", finding, outcomes)
    return [finding, *(_line(outcome) for outcome in usual)]


def ideal_arcsec() -> float:
    """How far stars are off with no calibration at all, rms over the screen."""
    nominal = _nominal()
    return float(np.sqrt((_star_errors(Geometry(nominal.monitor, nominal.q_cam_to_mon, TRACKER, np.eye(4)[:1])) ** 2).mean()))


def _nominal() -> Nominal:
    aligned = np.array([1.0, 0.0, 0.0, 0.0])
    return Nominal(monitor_camera(BENCH.resolution_px, BENCH.pitch_mm * 1e3, BENCH.focal_mm, aligned), aligned, TRACKER)


def _outcomes(frames: Frames) -> list[Outcome]:
    """Every model on the same centroids."""
    rng = np.random.default_rng(SEED)
    plan = plan_dots(BENCH.resolution_px, frames.count, frames.dots, rng)
    x_px, y_px = TRACKER.project(BENCH.directions(plan.x_px, plan.y_px))
    seen = observed_dots(plan, x_px, y_px, TRACKER.resolution_px, Faults(frames.noise_px), rng)
    nominal = _nominal()
    problem, data = matched(plan, nominal, seen, first_look(plan, nominal, seen, rng))
    return [_outcome(problem, data, frames, model) for model in MODELS]


def _outcome(problem: Problem, data: MatchedDots, frames: Frames, model: LensModel) -> Outcome:
    free = Model(model.parameters)
    candidate = held_out(problem, model.name, free, model.field_degree, data)
    errors = _star_errors(fit(problem, free, model.field_degree, data).geometry)
    rms = float(np.sqrt((errors**2).mean()))
    return Outcome(
        frames=frames.count,
        dots_per_frame=frames.dots,
        noise_px=frames.noise_px,
        model=model.name,
        centroids=len(data),
        held_out_arcsec=candidate.rms_arcsec,
        stars_rms_arcsec=rms,
        stars_max_arcsec=float(errors.max()),
    )


def _star_errors(geometry: Geometry) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """How far stars all over the screen are shown from where the traced rays put them, arcsec."""
    rng = np.random.default_rng(SEED)
    width, height = BENCH.resolution_px
    x, y = rng.uniform(-0.5, width - 0.5, STARS), rng.uniform(-0.5, height - 0.5, STARS)
    monitor = geometry.monitor
    shown_x, shown_y = monitor.project(BENCH.directions(x, y) @ monitor.cam_to_image.T)
    return np.asarray(np.hypot(shown_x - x, shown_y - y) * ARCSEC_PER_RAD / monitor.focal_length_px)


def _line(outcome: Outcome) -> str:
    fails = "" if outcome.stars_max_arcsec < FAIL_ARCSEC else f"; FAILS: over {FAIL_ARCSEC:g} arcsec"
    stars = f"stars {outcome.stars_rms_arcsec:.3g} arcsec rms, {outcome.stars_max_arcsec:.3g} maximum"
    return f"{outcome.model}: {stars}; held-out dots {outcome.held_out_arcsec:.3g} rms{fails}"


def _draw(path: Path, finding: str, outcomes: list[Outcome]) -> None:
    note = f"Solid: stars all over the screen. Dotted: dots that were held out. {USUAL_SIZE[0]} frames of {USUAL_SIZE[1]} dots"
    note += f" with {USUAL_NOISE_PX:g} px of noise, one of the two varied."
    with chart(path, finding, panels=2, share_x=False, note=note) as (dots, noise):
        for model, marker, colour in zip(MODELS, MARKERS, SERIES, strict=False):
            mine = [o for o in outcomes if o.model == model.name]
            by_dots = sorted((o.centroids, o.stars_rms_arcsec, o.held_out_arcsec) for o in mine if o.noise_px == USUAL_NOISE_PX)
            by_noise = sorted(
                (o.noise_px, o.stars_rms_arcsec, o.held_out_arcsec) for o in mine if (o.frames, o.dots_per_frame) == USUAL_SIZE
            )
            for axes, rows in ((dots, by_dots), (noise, by_noise)):
                places, stars, held = zip(*rows, strict=True)
                axes.loglog(places, stars, marker=marker, color=colour, label=SHORT.get(model.name, model.name))
                axes.loglog(places, held, ":", color=colour, lw=1.2, label="_held out")
        for axes in (dots, noise):
            axes.axhline(FAIL_ARCSEC, color=INK, ls="--", lw=1.2, label="fails above")
            axes.set_ylabel("error, rms [arcsec]")
            label_ends(axes)
        dots.set_xlabel("centroids [number]")
        noise.set_xlabel("noise of a centroid [px]")
        plain_ticks(noise.xaxis, sorted({o.noise_px for o in outcomes}))
