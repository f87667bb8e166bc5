"""Star errors after a geometric calibration, by number of dots, by centroid noise and by lens
model.

The true lens belongs to no model's family: chief rays are traced by Snell's law through a real
doublet onto a screen (mm, cam axes; the tracker's pupil is at the origin and looks along +z). The
doublet has the prescription of a 100 mm achromat (N-BK7 and SF5, radii 62.8, -45.7 and -128.2 mm,
4.0 and 2.5 mm thick), scaled to the focal length. The tracker has 38 arcsec per pixel and sees the
whole screen; 5 % of the dots are lost and as many are false.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.calibrate.geometric.dots import DotPlan, plan_dots
from hilstar.instruments.calibrate.geometric.fit import (
    BROWN_CONRADY,
    PINHOLE,
    RADIAL,
    Model,
    Nominal,
    fit,
    held_out,
)
from hilstar.instruments.calibrate.geometric.geometry_fit import matched
from hilstar.instruments.calibrate.geometric.match import first_look
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.instruments.study.engine import (
    ChartSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    Where,
    draw_rows,
    looks_of,
    write_rows,
)
from hilstar.optics.camera import Camera

RADII_MM = (62.8, -45.7, -128.2)
THICKNESS_MM = (4.0, 2.5)
INDEX = (1.0, 1.5168, 1.6727, 1.0)
BACK_FOCUS_MM = 97.1
DESIGN_FOCAL_MM = 100.0
SIZES = ((8, 10), (10, 25), (14, 40), (20, 60), (30, 100))
NOISES_PX = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
USUAL_SIZE, USUAL_NOISE_PX = (20, 60), 0.02
STARS = 4000  # chance moves an rms over so many by about 1 %
FAIL_ARCSEC = 1.0
SEED = 7
MARKERS = "osd^"
SHORT = {
    "the same with a field of degree 4": "with a field, degree 4",
    "Brown-Conrady with tilt": "Brown-Conrady, tilt",
}
HELD_OUT_WIDTH = 1.2
NOTE = (
    f"Solid: stars all over the screen. Dotted: dots that were held out. {USUAL_SIZE[0]} frames"
    f" of {USUAL_SIZE[1]} dots with {USUAL_NOISE_PX:g} px of noise, one of the two varied."
)
TRACKER = Camera((2048, 2048), ARCSEC_PER_RAD / 38.0, (1023.5, 1023.5), np.eye(3))


@dataclass(frozen=True, slots=True)
class DotFaults:
    """The noise of a centroid, px (one sigma, one axis), and the shares of lit dots that are lost
    and that are false.
    """

    noise_px: float = 0.02
    lost: float = 0.05
    false: float = 0.05


def observed_dots(
    plan: DotPlan,
    x_px: FloatArray,
    y_px: FloatArray,
    resolution_px: tuple[int, int],
    faults: DotFaults,
    rng: np.random.Generator,
) -> Observed:
    """Centroids of the lit dots that are at (x, y) (n,) in a tracker's image of `resolution_px`,
    frame by frame.
    """
    width, height = resolution_px
    inside = (x_px > 0) & (x_px < width - 1)
    inside &= (y_px > 0) & (y_px < height - 1)

    def noisy_px(places: FloatArray, false_count: int, size: int) -> FloatArray:
        """Places along an axis with their noise, and false ones anywhere."""
        noise_px = rng.normal(0, faults.noise_px, len(places))
        scattered = places + noise_px
        false_px = rng.uniform(0, size, false_count)
        return np.concatenate([scattered, false_px])

    centroids: list[FloatArray] = []
    for frame in range(plan.frames):
        lit = plan.lit[:, frame]
        dots = np.flatnonzero(lit & inside)
        chance = rng.uniform(size=len(dots))
        dots = dots[chance >= faults.lost]
        false_mean = faults.false * len(dots)
        false_count = int(rng.poisson(false_mean))
        x = noisy_px(x_px[dots], false_count, width)
        y = noisy_px(y_px[dots], false_count, height)
        number = np.full(len(x), float(frame))
        centroids.append(np.stack([number, x, y]))
    frames, x, y = np.concatenate(centroids, axis=1)
    frame_of = frames.astype(np.intp)
    poses = np.zeros_like(frame_of)
    sigmas_px = np.ones(len(frame_of))
    return Observed(frame_of, poses, x, y, sigmas_px)


def turned(a_deg: float, b_deg: float, c_deg: float = 0.0) -> FloatArray:
    """Rotation about x, then y, then z: columns are the turned axes."""
    angles = np.radians([a_deg, b_deg, c_deg])
    cos_a, cos_b, cos_c = np.cos(angles)
    sin_a, sin_b, sin_c = np.sin(angles)
    x = np.array([[1, 0, 0], [0, cos_a, -sin_a], [0, sin_a, cos_a]])
    y = np.array([[cos_b, 0, sin_b], [0, 1, 0], [-sin_b, 0, cos_b]])
    z = np.array([[cos_c, -sin_c, 0], [sin_c, cos_c, 0], [0, 0, 1]])
    return np.asarray(z @ y @ x)


@dataclass(frozen=True, slots=True)
class TracedBench:
    """A tilted, decentred doublet before a tilted screen; angles in degrees, lengths in mm."""

    resolution_px: tuple[int, int] = (1920, 1080)
    pitch_mm: float = 0.05765
    focal_mm: float = 350.0
    to_lens_mm: float = 60.0
    lens_tilt_deg: tuple[float, float] = (0.6, -0.4)
    lens_shift_mm: tuple[float, float] = (0.8, -0.5)
    screen_tilt_deg: tuple[float, float, float] = (1.0, 0.3, 0.2)
    screen_shift_mm: tuple[float, float] = (0.5, 0.3)

    def places_px(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the rays of directions (n, 3) in cam meet the screen, px: x and y (n,)."""
        at, ray = self.behind_lens(directions)
        screen = turned(*self.screen_tilt_deg)
        scale = self.focal_mm / DESIGN_FOCAL_MM
        behind_mm = (BACK_FOCUS_MM + sum(THICKNESS_MM)) * scale
        to_screen_mm = self.to_lens_mm + behind_mm
        middle = np.array([*self.screen_shift_mm, to_screen_mm])
        normal = screen[:, 2]
        towards_mm = (middle - at) @ normal
        length = towards_mm / (ray @ normal)
        hit = at + ray * length[:, None]
        from_middle = hit - middle
        screen_axes = screen[:, :2]
        x, y = (from_middle @ screen_axes / self.pitch_mm).T
        width, height = self.resolution_px
        x_middle_px = (width - 1) / 2
        y_middle_px = (height - 1) / 2
        return x + x_middle_px, y + y_middle_px

    def behind_lens(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points on the last surface, mm, and directions behind it, (n, 3) in cam, of the rays of
        directions (n, 3) through the pupil.
        """
        scale = self.focal_mm / DESIGN_FOCAL_MM
        axes = turned(*self.lens_tilt_deg)
        vertex = np.array([*self.lens_shift_mm, self.to_lens_mm])
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        ray = unit @ axes
        at = np.broadcast_to((-vertex) @ axes, ray.shape)
        steps_mm = (*THICKNESS_MM, 0.0)
        surfaces = zip(RADII_MM, INDEX[:-1], INDEX[1:], steps_mm, strict=True)
        for radius, before, after, step in surfaces:
            surface_radius_mm = radius * scale
            at, ray = _refracted(at, ray, surface_radius_mm, before / after)
            at = at - along_axis(step * scale)
        thickness_mm = sum(THICKNESS_MM) * scale
        from_vertex = at + along_axis(thickness_mm)
        return from_vertex @ axes.T + vertex, ray @ axes.T

    def directions(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The directions (n, 3) in cam of pixels (n,), by Newton's method with differences."""
        width, height = self.resolution_px
        x_from_middle_px = np.asarray(x_px) - (width - 1) / 2
        u = x_from_middle_px * self.pitch_mm / self.focal_mm
        y_from_middle_px = np.asarray(y_px) - (height - 1) / 2
        v = y_from_middle_px * self.pitch_mm / self.focal_mm
        ones = np.ones_like(u)
        step = 1e-6
        for _ in range(12):
            x, y = self.places_px(np.column_stack([u, v, ones]))
            right = np.column_stack([u + step, v, ones])
            xu, yu = self.places_px(right)
            below = np.column_stack([u, v + step, ones])
            xv, yv = self.places_px(below)
            a = (xu - x) / step
            b = (xv - x) / step
            c = (yu - y) / step
            d = (yv - y) / step
            area = a * d - b * c
            off_x = x - x_px
            off_y = y - y_px
            u = u - (d * off_x - b * off_y) / area
            v = v - (a * off_y - c * off_x) / area
        length = np.sqrt(u**2 + v**2 + 1)
        slopes = np.column_stack([u, v, ones])
        return slopes / length[:, None]


def along_axis(mm: float) -> FloatArray:
    """A vector along the lens's axis, mm."""
    return np.array([0.0, 0.0, mm])


def _refracted(
    at: FloatArray, ray: FloatArray, radius: float, ratio: float
) -> tuple[FloatArray, FloatArray]:
    """Points on a sphere whose vertex is the origin, and directions behind it. `ratio` is n before
    over n after.
    """
    centre = along_axis(radius)
    to_centre = at - centre
    towards = ray * to_centre
    half = towards.sum(axis=1)
    square = (to_centre**2).sum(axis=1)
    root = np.sqrt(half**2 - square + radius**2)
    length = -half - np.sign(radius) * root
    hit = at + ray * length[:, None]
    normal = (hit - centre) / radius
    against = ray * normal
    cosine = -against.sum(axis=1)
    cosine_square = cosine**2
    sine_square = 1 - cosine_square
    cosine_behind = np.sqrt(1 - ratio**2 * sine_square)
    bend = ratio * cosine - cosine_behind
    along_normal = bend[:, None] * normal
    return hit, ratio * ray + along_normal


BENCH = TracedBench(lens_shift_mm=(8.0, -5.0), lens_tilt_deg=(4.0, 2.5))


@dataclass(frozen=True, slots=True)
class LensModel:
    """A model of the lens: its name, its free parameters, and the degree of its residual field
    (0: none).
    """

    name: str
    parameters: tuple[str, ...]
    field_degree: int = 0


@dataclass(frozen=True, slots=True, order=True)
class Frames:
    """A set of frames: their number, the dots lit in each, and the noise of a centroid."""

    count: int
    dots: int
    noise_px: float


MODELS: tuple[LensModel, ...] = (
    LensModel("a pinhole", PINHOLE),
    LensModel("a pinhole with k1", RADIAL),
    LensModel("Brown-Conrady with tilt", BROWN_CONRADY),
    LensModel("the same with a field of degree 4", BROWN_CONRADY, 4),
)


@dataclass(frozen=True, slots=True)
class CalibrationOutcome:
    """One lens model fitted to one set of frames: its errors at held-out dots and at stars over the
    screen.
    """

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
    outcomes: list[CalibrationOutcome] = []
    for frames in frames_of(quick):
        outcomes += _outcomes(frames)
    write_rows(directory / "geometry.csv", outcomes)
    usual = []
    for outcome in outcomes:
        if has_usual_noise(outcome) and has_usual_size(outcome):
            usual.append(outcome)
    uncalibrated = ideal_arcsec()
    finding = models_finding(usual, uncalibrated)
    draw(directory / "geometry", finding, outcomes, uncalibrated)
    lines = [finding]
    for outcome in usual:
        lines.append(line_of(outcome))
    return lines


def models_finding(usual: Sequence[CalibrationOutcome], uncalibrated_arcsec: float) -> str:
    """The error of stars without calibration, by the first model, and by that of the smallest error
    at held-out dots, which is all that a lab knows.
    """
    first = usual[0]
    best = min(usual, key=lambda outcome: outcome.held_out_arcsec)
    return (
        f"Uncalibrated stars are off by {uncalibrated_arcsec:.0f} arcsec rms, by {first.model}"
        f" {first.stars_rms_arcsec:.0f}, by the model that held-out dots choose ({best.model})"
        f" {best.stars_rms_arcsec:.2g}"
    )


def frames_of(quick: bool) -> list[Frames]:
    """The sets of frames that are measured: usual noise by size, and the usual size by noise."""
    sizes: tuple[tuple[int, int], ...] = SIZES
    noises: tuple[float, ...] = NOISES_PX
    if quick:
        sizes = SIZES[1:4:2]
        noises = (USUAL_NOISE_PX, NOISES_PX[-1])
    by_size = {Frames(*size, USUAL_NOISE_PX) for size in sizes}
    by_noise = {Frames(*USUAL_SIZE, noise) for noise in noises}
    return sorted(by_size | by_noise)


def line_of(outcome: CalibrationOutcome) -> str:
    """A model's errors in words."""
    stars = f"stars {outcome.stars_rms_arcsec:.3g} arcsec rms"
    largest = f"{outcome.stars_max_arcsec:.3g} maximum"
    dots = f"held-out dots {outcome.held_out_arcsec:.3g} rms"
    line = f"{outcome.model}: {stars}, {largest}; {dots}"
    if outcome.stars_max_arcsec < FAIL_ARCSEC:
        return line
    return f"{line}; FAILS: over {FAIL_ARCSEC:g} arcsec"


def ideal_arcsec() -> float:
    """The error of stars without any calibration, arcsec rms over the screen."""
    nominal = _nominal()
    errors = _star_errors(nominal.monitor)
    return float(np.sqrt(np.square(errors).mean()))


def _nominal() -> Nominal:
    aligned = np.array([1.0, 0.0, 0.0, 0.0])
    pitch_um = BENCH.pitch_mm * 1e3
    monitor = monitor_camera(BENCH.resolution_px, pitch_um, BENCH.focal_mm, aligned)
    return Nominal(monitor, aligned, TRACKER)


def _outcomes(frames: Frames) -> Iterator[CalibrationOutcome]:
    rng = np.random.default_rng(SEED)
    plan = plan_dots(BENCH.resolution_px, frames.count, frames.dots, rng)
    rays = BENCH.directions(plan.x_px, plan.y_px)
    x_px, y_px = TRACKER.project(rays)
    faults = DotFaults(frames.noise_px)
    dots = observed_dots(plan, x_px, y_px, TRACKER.resolution_px, faults, rng)
    nominal = _nominal()
    look = first_look(plan, nominal, dots, rng)
    problem, data = matched(plan, nominal, dots, look)
    for model in MODELS:
        free = Model(model.parameters)
        of_dots = held_out(problem, model.name, free, model.field_degree, data)
        fitted = fit(problem, free, model.field_degree, data)
        errors = _star_errors(fitted.geometry.monitor)
        stars_rms_arcsec = float(np.sqrt((errors**2).mean()))
        yield CalibrationOutcome(
            frames=frames.count,
            dots_per_frame=frames.dots,
            noise_px=frames.noise_px,
            model=model.name,
            centroids=len(data),
            held_out_arcsec=of_dots.rms_arcsec,
            stars_rms_arcsec=stars_rms_arcsec,
            stars_max_arcsec=float(errors.max()),
        )


def star_places_px(size_px: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Places (x, y) of STARS stars all over a screen of `size_px` (width, height)."""
    rng = np.random.default_rng(SEED)
    width, height = size_px
    x_px = rng.uniform(-0.5, width - 0.5, STARS)
    return x_px, rng.uniform(-0.5, height - 0.5, STARS)


def off_arcsec(
    monitor: Camera, x_px: FloatArray, y_px: FloatArray, directions: FloatArray
) -> FloatArray:
    """The distances (n,) from places on the screen to where a camera shows their directions."""
    shown_x, shown_y = monitor.project(directions @ monitor.cam_to_image.T)
    off_px = np.hypot(shown_x - x_px, shown_y - y_px)
    return np.asarray(off_px * ARCSEC_PER_RAD / monitor.focal_length_px)


def _star_errors(monitor: Camera) -> FloatArray:
    """The distances between shown stars and their traced places, arcsec (STARS,)."""
    x_px, y_px = star_places_px(BENCH.resolution_px)
    return off_arcsec(monitor, x_px, y_px, BENCH.directions(x_px, y_px))


def draw(
    path: Path, finding: str, outcomes: list[CalibrationOutcome], uncalibrated_arcsec: float
) -> None:
    """The errors of each model, by the number of centroids and by their noise."""
    models = dict.fromkeys(outcome.model for outcome in outcomes)
    labels = {}
    for name in models:
        labels[name] = SHORT.get(name, name)
    uncalibrated = LevelLine(uncalibrated_arcsec, "uncalibrated", style=":")
    fails = LevelLine(FAIL_ARCSEC, "fails above")
    levels = (
        uncalibrated,
        fails,
    )
    dots_panel = error_panel("centroids", has_usual_noise)
    by_dots = replace(dots_panel, xlabel="centroids [number]", levels=levels)
    noise_panel = error_panel("noise_px", has_usual_size)
    noises_px = sorted({outcome.noise_px for outcome in outcomes})
    by_noise = replace(
        noise_panel,
        xlabel="noise of a centroid [px]",
        levels=levels,
        xticks=noises_px,
    )
    looks = looks_of(labels, MARKERS)
    spec = ChartSpec(
        (by_dots, by_noise),
        lambda row: row.model,
        looks,
        NOTE,
        layout={"share_x": False},
    )
    draw_rows(path, finding, spec, outcomes)


def error_panel(x: str, where: Where) -> PanelSpec:
    """The errors of every model against one varied quantity."""
    return PanelSpec(lines_of(x, where), "error, rms [arcsec]", scales=("log", "log"))


def lines_of(x: str, where: Where) -> tuple[LineSpec, ...]:
    """The errors of stars against `x`, and dotted those of held-out dots."""
    stars = LineSpec(x, "stars_rms_arcsec", where=where)
    dotted = {"lw": HELD_OUT_WIDTH}
    held_out_dots = LineSpec(
        x, "held_out_arcsec", ":", marker="", named=False, where=where, look=dotted
    )
    return stars, held_out_dots


def has_usual_noise(outcome: CalibrationOutcome) -> bool:
    """Whether an outcome varies only the dots of its frames."""
    return outcome.noise_px == USUAL_NOISE_PX


def has_usual_size(outcome: CalibrationOutcome) -> bool:
    """Whether an outcome varies only the noise of its centroids."""
    size = (outcome.frames, outcome.dots_per_frame)
    return size == USUAL_SIZE
