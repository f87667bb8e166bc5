"""The steps of warm-up and uniformity: light of dots against time, and against place on the
screen.
"""

import datetime
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.special import log_ndtr

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.charts import BLUE, MUTED, chart, label_ends, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAD_TO_SIGMA, MAG_PER_RELATIVE, NS_PER_S, magnitude
from hilstar.display.calibration import weights_of_grid, with_uniformity
from hilstar.instruments.calibrate.first_light.context import (
    HOT_FILL,
    DarkSubtracted,
    Figure,
    FittedFigure,
    KeyChange,
    StepContext,
    StepNumber,
    StepOutcome,
    Verdict,
    calibration_of,
)
from hilstar.instruments.calibrate.first_light.focus import dot_code
from hilstar.instruments.calibrate.first_light.image_sources import CodeImage, Pattern, black
from hilstar.instruments.calibrate.geometric.dots import DOT_PX
from hilstar.instruments.calibrate.warm_up import (
    AHEAD_S,
    S_PER_H,
    fitted_white,
    judge_warm_up,
    watch_white,
)
from hilstar.instruments.simulate.bench_geometry import PIXELS_AT_ONCE, BenchGeometry
from hilstar.server.bench.monitor import bench_calibration, calibration_source
from hilstar.tracker.centroids import noisiest_background

APART_TRACKER_PX, APART_SIGMAS = 10.0, 16.0  # from dot to dot
# Radius of the circle about a dot whose light is summed. At most a quarter of a period, so that no
# two of the four lattices share a pixel: else the dark frame's noise, common to all, would make a
# pattern that looks like the screen's.
REACH_SIGMAS, REACH = 4.5, 0.25
MAX_DOTS = 64  # in a lattice, along the screen's longer side
# the four lattices' offsets, in half periods: each dot meets other pixels
SHIFTS = ((0, 0), (1, 0), (0, 1), (1, 1))
MIN_DOTS = 40
# rows of the grids that are tried; the columns make their fields square
ROWS = (2, 3, 5, 7, 9, 13, 18, 26)
DOTS_A_FIELD = 6
FOLDS, SEED = 5, 0
SURE = 2.0  # standard errors by which a finer grid has to be better on held-out dots
WILD_SIGMAS = 5.0  # a dot on a dead pixel, or behind dust
JOINED = 1e-3  # relative to a dot's weight: smooths fields that have few dots
WORTH_MAG = 0.002  # rms over the field: less is within the error of a star's light
FAR_SIGMAS, FAR_MAG = 3.0, 0.01  # beyond both, noise does not explain how dots differ
UNEXPLAINED = 1.5  # times the dots' noise
FILE = "light.toml"
# a dot in the tracker's image, and the ring about it that tells the glow
LIT_SIGMAS, RING_PX = 5.0, 3


@dataclass(frozen=True, slots=True)
class DotLight:
    """Dots seen whole: centres (n,), monitor px, and light (n,), DN; `noise_mag` is the error of
    one.
    """

    x: IntArray
    y: IntArray
    light: FloatArray
    noise_mag: float


@dataclass(frozen=True, slots=True)
class UniformityMap:
    """Light against place: a grid (rows, columns), one field where light is even, and its value at
    each dot (n,), median 1.

    `left_mag` is the rms error on held-out dots, and `left_error_mag2` the standard error of its
    square; `used` marks the dots that are no outliers. `fit_mag` is the standard error of the fit
    at a
    dot; `missed_mag` the rms of what a finer map may show and this one does not.
    """

    grid: FloatArray
    at_dots: FloatArray
    left_mag: float
    left_error_mag2: float
    used: BoolArray
    fit_mag: float
    missed_mag: float

    def error_mag(self, noise_mag: float) -> float:
        """The map's standard error at a dot: that of its fit, and of what its form lacks.

        That is seen twice: by a finer map, and by held-out dots, which differ from this one by more
        than their noise. The larger counts.
        """
        beyond_mag2 = self.left_mag**2 - noise_mag**2 - self.fit_mag**2
        form_mag = math.sqrt(_not_negative(beyond_mag2, self.left_error_mag2))
        return math.hypot(self.fit_mag, max(form_mag, self.missed_mag))

    @property
    def is_even(self) -> bool:
        """Whether the light is even to within a star's error."""
        return self.grid.size == 1 or self.rms_mag < WORTH_MAG

    @property
    def rms_mag(self) -> float:
        """Standard deviation of the map over the dots, magnitudes."""
        return float(np.std(magnitude(self.at_dots[self.used])))


def uniformity(context: StepContext) -> StepOutcome:
    """Measure light against place, and write a calibration with the map where the bench's is
    wrong. Raises InputError.
    """
    dots, images = see_dots(context)
    size_px, assumed = context.resolution_px, calibration_of(context)
    known = assumed.uniformity_map(size_px)
    as_known = (
        np.ones(len(dots.light)) if known is None else known[dots.y, dots.x].astype(np.float64)
    )
    against = map_of(dots, dots.light / as_known, size_px)
    light_map = map_of(dots, dots.light, size_px)
    figures = _figures(context, dots, light_map, against)
    if against.is_even:
        # The bench file keeps its map, and the error is that map's.
        figures["map_error_mag"] = math.hypot(against.error_mag(dots.noise_mag), against.rms_mag)
    elif light_map.is_even:
        figures["map_error_mag"] = math.hypot(
            light_map.error_mag(dots.noise_mag), light_map.rms_mag
        )
    picture = context.session / "uniformity.svg"
    line = (
        f"{_said(light_map, known is not None)}; {len(dots.light)} dots differ from that by"
        f" {light_map.left_mag:.4f} mag"
    )
    line += f" (noise {dots.noise_mag:.4f})"
    draw_uniformity(picture, dots, light_map, line)
    files: list[Path] = [picture, *images]
    changes: tuple[KeyChange, ...] = ()
    if against.is_even:
        line += "; the bench file has it so" if known is not None else "; nothing was written"
    else:
        source, path = (
            calibration_source(context.file.config.monitor, context.file.folder),
            context.session / FILE,
        )
        grid, today = (
            None if light_map.is_even else light_map.grid,
            datetime.datetime.now(datetime.UTC).date().isoformat(),
        )
        relative, bits = (
            float(figures["map_error_mag"]) / MAG_PER_RELATIVE,
            context.file.config.monitor.bits,
        )
        files += with_uniformity(
            source, bits, path, grid, context.source.monitor, today, relative=relative
        )
        changes = context.names("monitor", "calibration", path)
        line += "; what the tracker's own lens darkens is part of it"
    noisy = light_map.left_mag > max(FAR_SIGMAS * dots.noise_mag, FAR_MAG)
    if noisy:
        why = (
            "dust, a panel uneven from pixel to pixel, or light that is not steady; look at the"
            " images"
        )
        line = f"{line}: that is far above their noise: {why}"
    verdict: Verdict = "failed" if noisy else "done"
    darkest = 100 * float(figures["darkest_of_brightest"])
    error = darkest * math.sqrt(2) * float(figures["map_error_mag"]) / MAG_PER_RELATIVE
    number = StepNumber(
        darkest, error, "%", "light at the darkest place of the screen, of that at the brightest"
    )
    # A finer map than the last was not tried: where dots still differ by more than their noise, it
    # may be needed.
    ends = FittedFigure("the map's rows", light_map.grid.shape[0], 0.0, ROWS[-1])
    fitted = (ends,) if light_map.left_mag > UNEXPLAINED * dots.noise_mag else ()
    return StepOutcome(verdict, line, figures, tuple(files), (picture,), changes, number, fitted)


def warm_up(context: StepContext) -> StepOutcome:
    """Watch the light of dots until it is stable. Raises InputError for dots that saturate the
    tracker.
    """
    if not context.watched_s:
        how = (
            "give --warm-up MINUTES, 30 for most monitors, right after the monitor was switched on"
        )
        return StepOutcome("skipped", f"not measured, the monitor is taken to be warm: {how}")
    period = _spacing(context).period
    firsts = [period // 2, period // 2]
    dark, file, lit, number = (
        context.read(context.dark()),
        context.file,
        np.zeros(0, dtype=np.bool_),
        0,
    )
    code, _ = _unsaturated(context, dark, "white", [firsts], period)
    codes = _shown(firsts, period, code, context.resolution_px)
    cold, beside = dark < HOT_FILL * context.full_dn, lit

    def read() -> float:
        nonlocal lit, beside, number
        pattern, number = Pattern(f"white_{number:03}", codes), number + 1
        context.watch(pattern)
        path = context.source.look(file, pattern, context.folder / pattern.name, context.exposure_s)
        looked = context.looked(path, dark)
        path.unlink()  # hundreds are taken, and an interrupted watch begins anew
        _check_brightness(context, looked, code)
        if not lit.size:
            lit = (looked.image > LIT_SIGMAS * noisiest_background(looked.image).noise) & cold
            if not lit.any():
                raise InputError(
                    f"no dot of code {code} is seen; look at the focus, and whether the screen"
                    " is on"
                )
            beside = binary_dilation(lit, iterations=RING_PX) & cold & ~lit
        # What black pixels glow more than in the dark frame is no light of the dots.
        return float(looked.image[lit].sum() - looked.image[beside].mean() * lit.sum())

    hold = Pattern("white", codes)
    t_s, light = watch_white(
        read,
        context.source.clock_ns,
        lambda seconds: context.source.hold(file, hold, seconds),
        context.watched_s,
    )
    judged, ended_s = judge_warm_up(t_s, light), context.source.clock_ns() / NS_PER_S
    table, picture = context.session / "warm-up.csv", context.session / "warm-up.svg"
    write_csv(table, ("t_s", "light_dn"), zip(t_s.tolist(), light.tolist(), strict=True))
    with chart(picture, judged.line) as (axes,):
        axes.plot(t_s / 60, 100 * light / light[-1], ".", color=MUTED, markersize=4)
        axes.plot(
            t_s / 60,
            100 * fitted_white(judged, t_s, light) / light[-1],
            color=BLUE,
            label=judged.law,
        )
        axes.set(xlabel="time [min]", ylabel="white over the last reading [%]")
        label_ends(axes)
    figures: dict[str, Figure] = {
        name: value for name, value in asdict(judged).items() if name != "is_stable"
    }
    figures |= {"readings": len(light), "stable": "yes" if judged.is_stable else "no"}
    if context.truth is not None:
        virtual = context.truth.config.certify.virtual
        tau_s, change = 60 * virtual.warm_up_min, virtual.cold_percent / 100
        slope = (
            change / tau_s * math.exp(-ended_s / tau_s)
            + virtual.drift_percent_per_h / 100 / S_PER_H
        )
        figures["truth_drift_percent_per_h"] = 100 * S_PER_H * slope
        stable_s = tau_s * math.log(
            max(abs(change) * -math.expm1(-AHEAD_S / tau_s), 1e-300) / judged.limit
        )
        # by its exponential alone
        figures["truth_stable_after_s"] = max(stable_s - (ended_s - float(t_s[-1])), 0.0)
    changes = (
        context.change("certify", "warm_up_percent", float(f"{100 * judged.bound:.3g}"))
        if judged.is_stable
        else ()
    )
    per_h = StepNumber(
        judged.drift_percent_per_h,
        judged.drift_error_percent_per_h,
        "%/h",
        "drift of white at the last reading",
    )
    return StepOutcome(
        "done" if judged.is_stable else "failed",
        judged.line if judged.is_stable else f"{judged.line}; {judged.cure}",
        figures,
        (table, picture),
        (picture,),
        changes,
        number=per_h if judged.law != "none" else None,
    )


class DotSpacing(NamedTuple):
    """The sigma of a dot in the tracker's image, tracker px; period and reach of a lattice of
    dots, monitor px.
    """

    sigma_px: float
    period: int
    reach: float


def _spacing(context: StepContext) -> DotSpacing:
    geometry = context.real_geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sigma_px = math.hypot(context.psf_sigma_px, DOT_PX * ratio / math.sqrt(12))
    apart_px = max(APART_TRACKER_PX, APART_SIGMAS * sigma_px) / ratio
    period = max(
        math.ceil(apart_px / 2) * 2, math.ceil(max(context.resolution_px) / MAX_DOTS / 2) * 2
    )
    return DotSpacing(sigma_px, period, min(REACH * period, REACH_SIGMAS * sigma_px / ratio))


def _check_brightness(context: StepContext, looked: DarkSubtracted, code: int) -> None:
    if context.is_too_bright(looked):
        raise InputError(
            f"dots of code {code} saturate the tracker; run the focus again (--again focus), then"
            " this step"
        )


def _said(found: UniformityMap, assumed: bool) -> str:
    if found.is_even:
        return "the light is even over the screen" + (
            ", where the bench file has it uneven" if assumed else ""
        )
    seen = found.at_dots[found.used]
    rows, columns = found.grid.shape
    return (
        f"the darkest place has {seen.min() / seen.max():.1%} of the brightest's light, in a map of"
        f" {rows} x {columns}"
    )


def _figures(
    context: StepContext, dots: DotLight, found: UniformityMap, against: UniformityMap
) -> dict[str, Figure]:
    seen_light = found.at_dots[found.used]
    figures: dict[str, Figure] = {
        "dots": len(dots.light),
        "wild_dots": int((~found.used).sum()),
        "grid": " x ".join(map(str, found.grid.shape)),
        "darkest_of_brightest": float(seen_light.min() / seen_light.max()),
        "change_rms_mag": found.rms_mag,
        "off_bench_file_rms_mag": against.rms_mag,
        "left_rms_mag": found.left_mag,
        "dot_noise_mag": dots.noise_mag,
        "map_error_mag": found.error_mag(dots.noise_mag),
    }
    if context.truth is not None:
        monitor = context.truth.config.monitor
        true = bench_calibration(context.truth.config, context.truth.folder).uniformity_map(
            monitor.resolution_px
        )
        if monitor.resolution_px == context.resolution_px:
            if true is None:
                its = np.ones(len(dots.light))
            else:
                its = true[dots.y, dots.x].astype(np.float64)
            figures["truth_rms_mag"] = float(np.std(magnitude(found.at_dots / its)))
    return figures


def _unsaturated(
    context: StepContext,
    dark: FloatArray,
    name: str,
    lattices: list[list[int]],
    period: int,
) -> tuple[int, list[DarkSubtracted]]:
    """The images of lattices, each from its first dot (x, y) on, and their code.

    It is the brightest of the codes from the focus's down at which no dot saturates the tracker:
    the
    focus saw other dots, and light differs from place to place. Raises InputError where none is
    left.
    """
    code = dot_code(context)
    while True:
        looks: list[DarkSubtracted] = []
        for number, firsts in enumerate(lattices):
            codes = _shown(firsts, period, code, context.resolution_px)
            looked = context.look(Pattern(f"{name}_{code:05}_{number:03}", codes), dark)
            # DN are whole numbers: half of float64 for four images of up to 16 million pixels.
            looks.append(replace(looked, image=looked.image.astype(np.float32)))
            if context.is_too_bright(looks[-1]):
                break
        else:
            return code, looks
        code = context.darker(code)


def see_dots(context: StepContext) -> tuple[DotLight, tuple[Path, ...]]:
    """Measure dots on lattices over the whole screen; their light, and the images.

    Raises InputError for too few whole dots.
    """
    geometry = context.real_geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sigma_px, period, reach = _spacing(context)
    dark_path = context.dark()
    dark = context.read(dark_path)
    bad = dark > HOT_FILL * context.full_dn
    # a dot that reaches the detector's edge has lost light
    bad[[0, -1]], bad[:, [0, -1]] = True, True
    # their first dots' places; shifts are in half periods
    lattices = [[period // 2 * (1 + right), period // 2 * (1 + down)] for right, down in SHIFTS]
    _, looks = _unsaturated(context, dark, "lattice", lattices, period)
    noise_dn = noisiest_background(looks[-1].image).noise
    size = np.array(context.resolution_px)
    sums = [LatticeSums(np.array(firsts), period, reach, size) for firsts in lattices]
    images = [looked.image for looked in looks]
    _add_rows(geometry, sums, images, bad)
    paths = [dark_path, *(looked.path for looked in looks)]
    whole = [lattice.whole() for lattice in sums]
    columns, rows, light = (np.concatenate(part) for part in zip(*whole, strict=True))
    lit = light > 0
    if lit.sum() < MIN_DOTS:
        few = f"{int(lit.sum())} dots are seen whole and {MIN_DOTS} are needed"
        raise InputError(f"{few}; look at the geometry and the focus")
    detector = context.file.config.tracker.detector
    dn = float(np.median(light[lit]))
    pixels = math.pi * (reach * ratio) ** 2
    # The noise of the dark frame is in that of the image above it; PRNU averages over a dot's
    # pixels.
    shared = detector.prnu**2 / (4 * math.pi * sigma_px**2)
    noise = math.sqrt((dn / detector.gain_e_per_dn + pixels * noise_dn**2) / dn**2 + shared)
    return DotLight(columns[lit], rows[lit], light[lit], MAG_PER_RELATIVE * noise), tuple(paths)


def _shown(firsts: list[int], period: int, code: int, resolution_px: tuple[int, int]) -> CodeImage:
    """Squares of DOT_PX about every `period`-th pixel from `firsts` (x, y) on."""
    codes = black(resolution_px)
    half = DOT_PX // 2
    for down in range(-half, half + 1):
        for right in range(-half, half + 1):
            codes[firsts[1] + down :: period, firsts[0] + right :: period] = code
    return codes


class DotSums(NamedTuple):
    """Column and row of dots, monitor px, and the light of each, DN, (n,) each."""

    column: IntArray
    row: IntArray
    light: FloatArray


class LatticeSums:
    """Sums of the light in reach of a lattice's dots on a monitor of `size`, px: one every
    `period` from `firsts` (x, y) on.
    """

    def __init__(self, firsts: IntArray, period: int, reach: float, size: IntArray) -> None:
        self._firsts = firsts
        self._period = period
        self._reach = reach
        self._counts = (size - firsts - DOT_PX // 2 - 1) // period + 1
        total = int(self._counts[0] * self._counts[1])
        self._light, self._pixels, self._bad = (np.zeros(total) for _ in range(3))

    def add(self, looked_at: FloatArray, image: FloatArray, bad: BoolArray) -> None:
        """Add pixels (n,) of the tracker, which look at places (2, n) on the monitor, px."""
        firsts = self._firsts
        counts = self._counts
        total = len(self._light)
        place = (np.nan_to_num(looked_at, nan=-1e9) - firsts[:, None]) / self._period
        nearest = np.rint(place)
        inside = (nearest >= 0).all(axis=0) & (nearest[0] < counts[0]) & (nearest[1] < counts[1])
        inside &= np.hypot(*(place - nearest)) * self._period <= self._reach
        index = (nearest[1][inside] * counts[0] + nearest[0][inside]).astype(np.intp)
        self._light += np.bincount(index, image[inside], minlength=total)
        self._pixels += np.bincount(index, minlength=total)
        self._bad += np.bincount(index, bad[inside], minlength=total)

    def whole(self) -> DotSums:
        """The dots without a bad pixel in reach."""
        which = np.flatnonzero((self._pixels > 0) & (self._bad == 0))
        return DotSums(
            self._firsts[0] + which % self._counts[0] * self._period,
            self._firsts[1] + which // self._counts[0] * self._period,
            self._light[which],
        )


def _add_rows(
    geometry: BenchGeometry, sums: list[LatticeSums], images: list[FloatArray], bad: BoolArray
) -> None:
    """Add the image (h, w) of each lattice to its sums, some rows at a time: where all pixels
    look, and what follows from it, took 1 GB of 5 million.
    """
    width, height = geometry.tracker.resolution_px
    rows = max(1, PIXELS_AT_ONCE // width)
    for top in range(0, height, rows):
        part = slice(top, min(top + rows, height))
        y, x = np.mgrid[part, 0:width].astype(np.float64)
        looked_at = np.stack(geometry.to_monitor(x.ravel(), y.ravel()))
        for lattice, image in zip(sums, images, strict=True):
            lattice.add(looked_at, image[part].ravel(), bad[part].ravel())


def map_of(dots: DotLight, light: FloatArray, resolution_px: tuple[int, int]) -> UniformityMap:
    """The simplest map of light (n,) at the dots: the coarsest grid that no finer one beats
    significantly.
    """
    width, height = resolution_px
    shapes = [(1, 1), *((rows, max(round(rows * width / height), 1)) for rows in ROWS)]
    determined = [shape for shape in shapes if math.prod(shape) * DOTS_A_FIELD <= len(light)]
    shapes = determined or shapes[:1]
    designs = [_design(dots, shape, resolution_px) for shape in shapes]
    relative = light / np.median(light)
    used = _tame(relative, designs[-1], shapes[-1])
    fold = np.random.default_rng(SEED).integers(0, FOLDS, len(light))
    squares = [
        _held_out(relative, design, shape, used, fold)
        for design, shape in zip(designs, shapes, strict=True)
    ]
    best = min(squares, key=lambda square: float(square[used].mean()))
    # the coarsest grid that the best one does not surely beat
    place = 0
    while _is_surely_larger(squares[place][used], best[used]):
        place += 1
    grid = _fitted(relative[used], designs[place][used], shapes[place])
    square = float(squares[place][used].mean())
    count = int(used.sum())
    error = float(squares[place][used].std()) / math.sqrt(count)
    freedoms = _Freedoms(designs, shapes, used)
    missed = 0.0
    if finer := range(place + 1, len(shapes)):
        nearest = min(finer, key=lambda k: float(squares[k][used].mean()))
        gain = (squares[place] - squares[nearest])[used]
        # A finer map errs more by its fields' own noise, which hides as much of what it shows.
        noise = square * (freedoms.of(nearest) - freedoms.of(place)) / count
        missed = _not_negative(float(gain.mean()) + noise, float(gain.std()) / math.sqrt(count))
    return UniformityMap(
        grid.reshape(shapes[place]),
        designs[place] @ grid,
        left_mag=MAG_PER_RELATIVE * math.sqrt(square),
        left_error_mag2=MAG_PER_RELATIVE**2 * error,
        used=used,
        fit_mag=MAG_PER_RELATIVE * math.sqrt(square * freedoms.of(place) / count),
        missed_mag=MAG_PER_RELATIVE * math.sqrt(missed),
    )


def _is_surely_larger(squares: FloatArray, others: FloatArray) -> bool:
    """Whether the mean of squares (n,) is larger than that of others by SURE standard errors."""
    more = squares - others
    return bool(more.mean() > SURE * more.std() / math.sqrt(len(more)))


def _not_negative(found: float, error: float) -> float:
    """The mean of a square that was found as `found` with a normal `error`, and cannot be
    negative.
    """
    if error <= 0:
        return max(found, 0.0)
    place = found / error
    log_ratio = -(place**2) / 2 - float(log_ndtr(place)) - math.log(2 * math.pi) / 2
    return max(found + error * math.exp(log_ratio), 0.0)


class _Freedoms(NamedTuple):
    """The designs of maps (dots, fields) with their shapes, and the dots that are used."""

    designs: list[Any]
    shapes: list[tuple[int, int]]
    used: BoolArray

    def of(self, place: int) -> float:
        """How many fields the dots determine: the trace of the fit's matrix from light to map."""
        design = self.designs[place][self.used]
        normal = (design.T @ design).toarray()
        fit = np.linalg.solve(normal + _smoothness(self.shapes[place]), normal)
        return float(np.trace(fit))


def _design(dots: DotLight, shape: tuple[int, int], resolution_px: tuple[int, int]) -> Any:
    """The weight of each field at each dot (n, fields), sparse, interpolated as in a
    calibration's map.
    """
    from scipy.sparse import csr_array

    across = _two(weights_of_grid(resolution_px[0], shape[1])[dots.x])
    down = _two(weights_of_grid(resolution_px[1], shape[0])[dots.y])
    dot = np.arange(len(dots.x))
    sides = [(y, x) for y in down for x in across]
    fields = np.concatenate([y[0] * shape[1] + x[0] for y, x in sides])
    weights = np.concatenate([y[1] * x[1] for y, x in sides])
    return csr_array(
        (weights, (np.tile(dot, len(sides)), fields)), shape=(len(dot), math.prod(shape))
    )


def _two(weights: FloatArray) -> list[tuple[IntArray, FloatArray]]:
    """The one or two non-zero fields of each row of weights (n, fields): their numbers and
    weights, (n,) each.
    """
    row = np.arange(len(weights))
    last = weights.shape[1] - 1
    lower_field = np.minimum((weights != 0).argmax(axis=1), max(last - 1, 0))
    return [(field, weights[row, field]) for field in (lower_field, lower_field + 1)[: last + 1]]


def _fitted(light: FloatArray, design: Any, shape: tuple[int, int]) -> FloatArray:
    """The fields (rows * columns,) by least squares; a field without dots follows its
    neighbours.
    """
    normal = (design.T @ design).toarray() + _smoothness(shape)
    solution = np.linalg.solve(normal, design.T @ light)
    # a field that no dot reaches has light, too
    return np.asarray(np.maximum(solution, light.min() / 2))


def _smoothness(shape: tuple[int, int]) -> FloatArray:
    """The penalty (fields, fields) on differences between neighbouring fields."""
    number = np.arange(math.prod(shape)).reshape(shape)
    penalty = np.zeros((number.size, number.size))
    for field_number, other in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1])):
        a = field_number.ravel()
        b = other.ravel()
        np.add.at(penalty, (np.concatenate([a, b]), np.concatenate([a, b])), JOINED)
        np.add.at(penalty, (np.concatenate([a, b]), np.concatenate([b, a])), -JOINED)
    return penalty


def _tame(light: FloatArray, design: Any, shape: tuple[int, int]) -> BoolArray:
    """A mask of the dots (n,) that are no outliers from the finest map."""
    used = np.ones(len(light), dtype=np.bool_)
    for _ in range(3):
        off = light / (design @ _fitted(light[used], design[used], shape)) - 1
        used = np.abs(off) < WILD_SIGMAS * max(
            MAD_TO_SIGMA * float(np.median(np.abs(off[used]))), 1e-6
        )
    return used


def _held_out(
    light: FloatArray, design: Any, shape: tuple[int, int], used: BoolArray, fold: IntArray
) -> FloatArray:
    """The squared relative error of each dot (n,) in a map made without it."""
    squares = np.zeros(len(light))
    for fold_number in range(FOLDS):
        out = fold == fold_number
        is_fitted = used & (fold != fold_number)
        squares[out] = (
            light[out] / (design[out] @ _fitted(light[is_fitted], design[is_fitted], shape)) - 1
        ) ** 2
    return squares


def draw_uniformity(path: Path, dots: DotLight, found: UniformityMap, finding: str) -> None:
    """Draw how much fainter each used dot is than the brightest place, and than the map, over
    the screen.
    """
    x, y, light, mapped = (
        values[found.used]
        for values in (dots.x, dots.y, dots.light / np.median(dots.light), found.at_dots)
    )
    panels = {
        "fainter than the brightest place [mag]": np.asarray(magnitude(light / mapped.max())),
        "fainter than the map has it [mag]": np.asarray(magnitude(light / mapped)),
    }
    with chart(path, finding, panels=2) as both:
        for axes, (name, off_mag) in zip(both, panels.items(), strict=True):
            low, high = (float(value) for value in np.percentile(off_mag, (0.5, 99.5)))
            shown = axes.scatter(
                x, y, c=off_mag, s=8, cmap="viridis_r", vmin=low, vmax=max(high, low + 1e-4)
            )
            shown.set_rasterized(True)  # thousands of dots
            axes.figure.colorbar(shown, ax=axes, label=name)
            axes.set(aspect="equal", ylabel="monitor y [px]")
            axes.invert_yaxis()
        both[-1].set_xlabel("monitor x [px]")
