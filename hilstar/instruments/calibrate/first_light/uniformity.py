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
    WarmUp,
    fitted_white,
    judge_warm_up,
    watch_white,
)
from hilstar.instruments.simulate.bench_geometry import PIXELS_AT_ONCE, BenchGeometry
from hilstar.server.bench.config.certify import VirtualSettings
from hilstar.server.bench.monitor import bench_calibration, calibration_source
from hilstar.tracker.centroids import noisiest_background
from hilstar.tracker.settings import DetectorSettings

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
    at a dot; `missed_mag` the rms of what a finer map may show and this one does not.
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

    def is_far(self, noise_mag: float) -> bool:
        """Whether held-out dots are farther from the map than their noise explains."""
        return self.left_mag > max(FAR_SIGMAS * noise_mag, FAR_MAG)

    @property
    def is_even(self) -> bool:
        """Whether the light is even to within a star's error."""
        return self.grid.size == 1 or self.rms_mag < WORTH_MAG

    @property
    def rms_mag(self) -> float:
        """Standard deviation of the map over the dots, magnitudes."""
        return float(np.std(magnitude(self.at_dots[self.used])))

    @property
    def darkest_of_brightest(self) -> float:
        """The map's smallest value at a dot over its largest."""
        light = self.at_dots[self.used]
        return float(light.min() / light.max())


def uniformity(context: StepContext) -> StepOutcome:
    """Measure light against place, and write a calibration with the map where the bench's is
    wrong. Raises InputError.
    """
    dots, images = see_dots(context)
    size_px = context.resolution_px
    known = calibration_of(context).uniformity_map(size_px)
    light_map = map_of(dots, dots.light, size_px)
    # what the bench file's own map leaves; a map of many dots takes a second
    against = light_map
    if known is not None:
        known_light = known[dots.y, dots.x].astype(np.float64)
        against = map_of(dots, dots.light / known_light, size_px)
    error_mag = known_error_mag(light_map, against, dots.noise_mag)
    figures = _figures(context, dots, light_map, against)
    figures["map_error_mag"] = error_mag
    line = (
        f"{_in_words(light_map, known is not None)}; {len(dots.light)} dots differ from that by"
        f" {light_map.left_mag:.4f} mag (noise {dots.noise_mag:.4f})"
    )
    picture = context.session / "uniformity.svg"
    draw_uniformity(picture, dots, light_map, line)
    files: list[Path] = [picture, *images]
    changes: tuple[KeyChange, ...] = ()
    if not against.is_even:
        written, changes = _write_map(context, light_map, error_mag)
        files += written
        line += "; what the tracker's own lens darkens is part of it"
    elif known is not None:
        line += "; the bench file has it so"
    else:
        line += "; nothing was written"
    verdict: Verdict = "done"
    if light_map.is_far(dots.noise_mag):
        verdict = "failed"
        line += (
            ": that is far above their noise: dust, a panel uneven from pixel to pixel, or light"
            " that is not steady; look at the images"
        )
    darkest_percent = 100 * float(figures["darkest_of_brightest"])
    # a ratio of two places, each with the map's error
    error_percent = darkest_percent * math.sqrt(2) * error_mag / MAG_PER_RELATIVE
    number = StepNumber(
        darkest_percent,
        error_percent,
        "%",
        "light at the darkest place of the screen, of that at the brightest",
    )
    fitted: tuple[FittedFigure, ...] = ()
    if light_map.left_mag > UNEXPLAINED * dots.noise_mag:
        # A finer map than the last was not tried: where dots still differ by more than their
        # noise, it may be needed.
        fitted = (FittedFigure("the map's rows", light_map.grid.shape[0], 0.0, ROWS[-1]),)
    return StepOutcome(verdict, line, figures, tuple(files), (picture,), changes, number, fitted)


def known_error_mag(light_map: UniformityMap, against: UniformityMap, noise_mag: float) -> float:
    """The error of the light at a dot that the bench file then has, by dots with this noise:
    where light is called even, what its map has adds to that map's own.

    `against` is the map of what the bench file's own leaves.
    """
    if against.is_even:
        # the bench file keeps its map
        return math.hypot(against.error_mag(noise_mag), against.rms_mag)
    own_error_mag = light_map.error_mag(noise_mag)
    if light_map.is_even:
        return math.hypot(own_error_mag, light_map.rms_mag)
    return own_error_mag


def _write_map(
    context: StepContext, light_map: UniformityMap, error_mag: float
) -> tuple[list[Path], tuple[KeyChange, ...]]:
    """Write the bench's calibration with this map, or with none where light is even; the files,
    and the bench file's key that names them.
    """
    monitor = context.monitor
    grid = None
    if not light_map.is_even:
        grid = light_map.grid
    path = context.session / FILE
    source = calibration_source(monitor, context.file.folder)
    now = datetime.datetime.now(datetime.UTC)
    files = with_uniformity(
        source,
        monitor.bits,
        path,
        grid,
        context.source.monitor,
        now.date().isoformat(),
        relative=error_mag / MAG_PER_RELATIVE,
    )
    return list(files), context.names("monitor", "calibration", path)


def warm_up(context: StepContext) -> StepOutcome:
    """Watch the light of dots until it is stable. Raises InputError for dots that saturate the
    tracker.
    """
    if not context.watched_s:
        how = (
            "give --warm-up MINUTES, 30 for most monitors, right after the monitor was switched on"
        )
        return StepOutcome("skipped", f"not measured, the monitor is taken to be warm: {how}")
    white = _White(context)
    t_s, light = watch_white(white.read, context.source.clock_ns, white.hold, context.watched_s)
    judged = judge_warm_up(t_s, light)
    ended_s = context.source.clock_ns() / NS_PER_S
    table = context.session / "warm-up.csv"
    picture = context.session / "warm-up.svg"
    write_csv(table, ("t_s", "light_dn"), zip(t_s.tolist(), light.tolist(), strict=True))
    _draw_warm_up(picture, judged, t_s, light)
    figures: dict[str, Figure] = asdict(judged)
    del figures["is_stable"]
    figures["readings"] = len(light)
    figures["stable"] = "yes" if judged.is_stable else "no"
    if context.truth is not None:
        virtual = context.truth.config.certify.virtual
        figures |= _warm_up_truth(virtual, judged.limit, ended_s, float(t_s[-1]))
    number = None
    if judged.law != "none":
        number = StepNumber(
            judged.drift_percent_per_h,
            judged.drift_error_percent_per_h,
            "%/h",
            "drift of white at the last reading",
        )
    files = (table, picture)
    if not judged.is_stable:
        line = f"{judged.line}; {judged.cure}"
        return StepOutcome("failed", line, figures, files, (picture,), number=number)
    percent = float(f"{100 * judged.bound:.3g}")
    changes = context.change("certify", "warm_up_percent", percent)
    return StepOutcome("done", judged.line, figures, files, (picture,), changes, number=number)


class _White:
    """A lattice of dots that the tracker watches while the monitor warms up. Raises InputError for
    dots that saturate it.
    """

    def __init__(self, context: StepContext) -> None:
        period = _spacing(context).period
        firsts = [period // 2, period // 2]
        self._context = context
        self._dark = context.read(context.dark())
        self._code, _ = _unsaturated(context, self._dark, "white", [firsts], period)
        self._codes = _shown(firsts, period, self._code, context.resolution_px)
        self._cold = self._dark < HOT_FILL * context.full_dn
        # of the first image: which pixels have light, and which are beside those
        self._lit: BoolArray | None = None
        self._beside: BoolArray | None = None
        self._number = 0

    def hold(self, seconds: float) -> None:
        """Show the lattice for a time without looking."""
        self._context.source.hold(self._context.file, Pattern("white", self._codes), seconds)

    def read(self) -> float:
        """The light of all dots in one image, DN."""
        context = self._context
        pattern = Pattern(f"white_{self._number:03}", self._codes)
        self._number += 1
        context.watch(pattern)
        path = context.folder / pattern.name
        path = context.source.look(context.file, pattern, path, context.exposure_s)
        looked = context.looked(path, self._dark)
        path.unlink()  # hundreds are taken, and an interrupted watch begins anew
        _check_brightness(context, looked, self._code)
        if self._lit is None or self._beside is None:
            self._lit = self._lit_pixels(looked)
            near = binary_dilation(self._lit, iterations=RING_PX)
            self._beside = near & self._cold & ~self._lit
        return light_of_dots(looked.image, self._lit, self._beside)

    def _lit_pixels(self, looked: DarkSubtracted) -> BoolArray:
        """The pixels that the dots light. Raises InputError where there are none."""
        threshold = LIT_SIGMAS * noisiest_background(looked.image).noise
        lit = (looked.image > threshold) & self._cold
        if not lit.any():
            raise InputError(
                f"no dot of code {self._code} is seen; look at the focus, and whether the screen"
                " is on"
            )
        return np.asarray(lit)


def light_of_dots(image: FloatArray, lit: BoolArray, beside: BoolArray) -> float:
    """The light of dots, DN, in lit pixels of an image (h, w), of which those beside them tell the
    glow.
    """
    # what black pixels glow more than in the dark frame is no light of the dots
    glow = image[beside].mean() * lit.sum()
    return float(image[lit].sum() - glow)


def _draw_warm_up(picture: Path, judged: WarmUp, t_s: FloatArray, light: FloatArray) -> None:
    """Draw the readings and the law that was fitted, relative to the last reading."""
    minutes = t_s / 60
    fitted = fitted_white(judged, t_s, light)
    with chart(picture, judged.line) as (axes,):
        axes.plot(minutes, 100 * light / light[-1], ".", color=MUTED, markersize=4)
        axes.plot(minutes, 100 * fitted / light[-1], color=BLUE, label=judged.law)
        axes.set(xlabel="time [min]", ylabel="white over the last reading [%]")
        label_ends(axes)


def _warm_up_truth(
    virtual: VirtualSettings, limit: float, ended_s: float, last_s: float
) -> dict[str, Figure]:
    """The drift that was planted, and when it is within the limit; the watch ended at `ended_s` of
    the monitor's own time, at `last_s` of the watch's.
    """
    tau_s = 60 * virtual.warm_up_min
    change = virtual.cold_percent / 100
    exponential_slope = change / tau_s * math.exp(-ended_s / tau_s)
    slope = exponential_slope + virtual.drift_percent_per_h / 100 / S_PER_H
    # by its exponential alone
    change_ahead = abs(change) * -math.expm1(-AHEAD_S / tau_s)
    stable_s = tau_s * math.log(max(change_ahead, 1e-300) / limit)
    return {
        "truth_drift_percent_per_h": 100 * S_PER_H * slope,
        "truth_stable_after_s": max(stable_s - (ended_s - last_s), 0.0),
    }


class DotSpacing(NamedTuple):
    """The sigma of a dot in the tracker's image, tracker px; period and reach of a lattice of
    dots, monitor px.
    """

    sigma_px: float
    period: int
    reach: float


def _spacing(context: StepContext) -> DotSpacing:
    """The lattice of a bench's dots."""
    return spacing_for(context.real_geometry(), context.psf_sigma_px)


def spacing_for(geometry: BenchGeometry, psf_sigma_px: float) -> DotSpacing:
    """A lattice whose dots are apart in the tracker's image, and not too many."""
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sigma_px = math.hypot(psf_sigma_px, DOT_PX * ratio / math.sqrt(12))
    apart_px = max(APART_TRACKER_PX, APART_SIGMAS * sigma_px) / ratio
    fewest_px = max(geometry.monitor.resolution_px) / MAX_DOTS
    # even: a shift by half of it is whole
    period = 2 * math.ceil(max(apart_px, fewest_px) / 2)
    reach = min(REACH * period, REACH_SIGMAS * sigma_px / ratio)
    return DotSpacing(sigma_px, period, reach)


def _check_brightness(context: StepContext, looked: DarkSubtracted, code: int) -> None:
    if context.is_too_bright(looked):
        raise InputError(
            f"dots of code {code} saturate the tracker; run the focus again (--again focus), then"
            " this step"
        )


def _in_words(light_map: UniformityMap, is_known_uneven: bool) -> str:
    """How uneven the light is, in words."""
    if light_map.is_even:
        text = "the light is even over the screen"
        if is_known_uneven:
            text += ", where the bench file has it uneven"
        return text
    darkest = light_map.darkest_of_brightest
    rows, columns = light_map.grid.shape
    return (
        f"the darkest place has {darkest:.1%} of the brightest's light, in a map of"
        f" {rows} x {columns}"
    )


def _figures(
    context: StepContext, dots: DotLight, found: UniformityMap, against: UniformityMap
) -> dict[str, Figure]:
    wild_dots = int((~found.used).sum())
    rows, columns = found.grid.shape
    figures: dict[str, Figure] = {
        "dots": len(dots.light),
        "wild_dots": wild_dots,
        "grid": f"{rows} x {columns}",
        "darkest_of_brightest": found.darkest_of_brightest,
        "change_rms_mag": found.rms_mag,
        "off_bench_file_rms_mag": against.rms_mag,
        "left_rms_mag": found.left_mag,
        "dot_noise_mag": dots.noise_mag,
    }
    if context.truth is not None:
        monitor = context.truth.config.monitor
        calibration = bench_calibration(context.truth.config, context.truth.folder)
        true_map = calibration.uniformity_map(monitor.resolution_px)
        if monitor.resolution_px == context.resolution_px:
            true_light = np.ones(len(dots.light))
            if true_map is not None:
                true_light = true_map[dots.y, dots.x].astype(np.float64)
            error_mag = magnitude(found.at_dots / true_light)
            figures["truth_rms_mag"] = float(np.std(error_mag))
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
    the focus saw other dots, and light differs from place to place. Raises InputError where none is
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
    spacing = _spacing(context)
    _, period, reach = spacing
    dark_path = context.dark()
    dark = context.read(dark_path)
    bad = unusable_pixels(dark, context.full_dn)
    # their first dots' places; shifts are in half periods
    half_period = period // 2
    lattices = []
    for right, down in SHIFTS:
        lattices.append([half_period * (1 + right), half_period * (1 + down)])
    _, looks = _unsaturated(context, dark, "lattice", lattices, period)
    noise_dn = noisiest_background(looks[-1].image).noise
    size = np.array(context.resolution_px)
    sums = [LatticeSums(np.array(firsts), period, reach, size) for firsts in lattices]
    images = [looked.image for looked in looks]
    _add_rows(geometry, sums, images, bad)
    dots = [lattice.whole() for lattice in sums]
    column = np.concatenate([of_lattice.column for of_lattice in dots])
    row = np.concatenate([of_lattice.row for of_lattice in dots])
    light = np.concatenate([of_lattice.light for of_lattice in dots])
    lit = light > 0
    if lit.sum() < MIN_DOTS:
        few = f"{int(lit.sum())} dots are seen whole and {MIN_DOTS} are needed"
        raise InputError(f"{few}; look at the geometry and the focus")
    dn = float(np.median(light[lit]))
    reach_px = reach * ratio
    noise_mag = dot_noise_mag(dn, noise_dn, reach_px, spacing.sigma_px, context.detector)
    seen_dots = DotLight(column[lit], row[lit], light[lit], noise_mag)
    return seen_dots, (dark_path, *(looked.path for looked in looks))


def dot_noise_mag(
    dn: float, noise_dn: float, reach_px: float, sigma_px: float, detector: DetectorSettings
) -> float:
    """The noise of a dot's light, which is summed within its reach over a background of `noise_dn`
    in a pixel, tracker px.
    """
    pixels = math.pi * reach_px**2
    # The noise of the dark frame is in that of the image above it; PRNU averages over a dot's
    # pixels.
    sum_dn2 = dn / detector.gain_e_per_dn + pixels * noise_dn**2
    response2 = detector.prnu**2 / (4 * math.pi * sigma_px**2)
    return MAG_PER_RELATIVE * math.sqrt(sum_dn2 / dn**2 + response2)


def unusable_pixels(dark: FloatArray, full_dn: float) -> BoolArray:
    """Pixels (height, width) by whose light no dot is whole: hot ones in a dark frame, and the
    detector's outermost ones, beyond which a dot has lost light.
    """
    bad = dark > HOT_FILL * full_dn
    bad[[0, -1]] = True
    bad[:, [0, -1]] = True
    return np.asarray(bad)


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
        self._light = np.zeros(total)
        self._pixels = np.zeros(total)
        self._bad = np.zeros(total)

    def add(self, looked_at: FloatArray, image: FloatArray, bad: BoolArray) -> None:
        """Add pixels (n,) of the tracker, which look at places (2, n) on the monitor, px."""
        firsts = self._firsts
        counts = self._counts
        total = len(self._light)
        # what looks past the screen is far from every dot
        place = (np.nan_to_num(looked_at, nan=-1e9) - firsts[:, None]) / self._period
        nearest = np.rint(place)
        column, row = nearest
        inside = (nearest >= 0).all(axis=0) & (column < counts[0]) & (row < counts[1])
        distance = np.hypot(*(place - nearest)) * self._period
        inside &= distance <= self._reach
        dot = (row[inside] * counts[0] + column[inside]).astype(np.intp)
        self._light += np.bincount(dot, image[inside], minlength=total)
        self._pixels += np.bincount(dot, minlength=total)
        self._bad += np.bincount(dot, bad[inside], minlength=total)

    def whole(self) -> DotSums:
        """The dots without a bad pixel in reach."""
        dot = np.flatnonzero((self._pixels > 0) & (self._bad == 0))
        row, column = np.divmod(dot, self._counts[0])
        first_x, first_y = self._firsts
        return DotSums(
            first_x + column * self._period, first_y + row * self._period, self._light[dot]
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
    maps = _Maps.of(dots, light, resolution_px)
    used = maps.used
    squares = maps.held_out_squares()
    best = min(squares, key=lambda of_map: float(of_map.mean()))
    # the coarsest grid that the best one does not surely beat
    place = 0
    while _is_surely_larger(squares[place], best):
        place += 1
    design = maps.designs[place]
    shape = maps.shapes[place]
    grid = _fitted(maps.relative[used], design[used], shape)
    square = float(squares[place].mean())
    count = int(used.sum())
    error = float(squares[place].std()) / math.sqrt(count)
    freedom = maps.freedom(place)
    missed = 0.0
    finer = range(place + 1, len(maps.shapes))
    if finer:
        nearest = min(finer, key=lambda k: float(squares[k].mean()))
        gain = squares[place] - squares[nearest]
        # A finer map errs more by its fields' own noise, which hides as much of what it shows.
        noise = square * (maps.freedom(nearest) - freedom) / count
        gain_error = float(gain.std()) / math.sqrt(count)
        missed = _not_negative(float(gain.mean()) + noise, gain_error)
    fit_variance = square * freedom / count
    return UniformityMap(
        grid.reshape(shape),
        design @ grid,
        left_mag=MAG_PER_RELATIVE * math.sqrt(square),
        left_error_mag2=MAG_PER_RELATIVE**2 * error,
        used=used,
        fit_mag=MAG_PER_RELATIVE * math.sqrt(fit_variance),
        missed_mag=MAG_PER_RELATIVE * math.sqrt(missed),
    )


def _is_surely_larger(squares: FloatArray, others: FloatArray) -> bool:
    """Whether the mean of squares (n,) is larger than that of others by SURE standard errors."""
    more = squares - others
    return bool(more.mean() > SURE * more.std() / math.sqrt(len(more)))


def _not_negative(square: float, error: float) -> float:
    """The expectation of a mean square that was measured as `square` with a normal `error`, and
    cannot be negative.
    """
    if error <= 0:
        return max(square, 0.0)
    place = square / error
    # the normal density over its integral, at `place`: the mean of a normal cut at 0
    log_density = -(place**2) / 2
    log_ratio = log_density - float(log_ndtr(place)) - math.log(2 * math.pi) / 2
    return max(square + error * math.exp(log_ratio), 0.0)


@dataclass(frozen=True, slots=True)
class _Maps:
    """Maps from coarse to fine: their shapes (rows, columns) and designs (dots, fields), the dots'
    light relative to its median, and the dots that are used.
    """

    shapes: list[tuple[int, int]]
    designs: list[Any]
    relative: FloatArray
    used: BoolArray

    @classmethod
    def of(cls, dots: DotLight, light: FloatArray, resolution_px: tuple[int, int]) -> "_Maps":
        """Those that the dots can determine."""
        width, height = resolution_px
        shapes = [(1, 1)]
        for rows in ROWS:
            columns = max(round(rows * width / height), 1)
            if rows * columns * DOTS_A_FIELD <= len(light):
                shapes.append((rows, columns))
        designs = [_design(dots, shape, resolution_px) for shape in shapes]
        relative = light / np.median(light)
        used = _tame(relative, designs[-1], shapes[-1])
        return cls(shapes, designs, relative, used)

    def held_out_squares(self) -> list[FloatArray]:
        """Squared relative errors of the used dots in each map made without them."""
        fold = np.random.default_rng(SEED).integers(0, FOLDS, len(self.relative))
        squares = []
        for shape, design in zip(self.shapes, self.designs, strict=True):
            of_map = _held_out(self.relative, design, shape, self.used, fold)
            squares.append(of_map[self.used])
        return squares

    def freedom(self, place: int) -> float:
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

    rows, columns = shape
    across = _two(weights_of_grid(resolution_px[0], columns)[dots.x])
    down = _two(weights_of_grid(resolution_px[1], rows)[dots.y])
    fields = []
    weights = []
    for row, row_weight in down:
        for column, column_weight in across:
            fields.append(row * columns + column)
            weights.append(row_weight * column_weight)
    dot = np.tile(np.arange(len(dots.x)), len(fields))
    entries = (np.concatenate(weights), (dot, np.concatenate(fields)))
    return csr_array(entries, shape=(len(dots.x), rows * columns))


def _two(weights: FloatArray) -> list[tuple[IntArray, FloatArray]]:
    """The one or two non-zero fields of each row of weights (n, fields): their numbers and
    weights, (n,) each.
    """
    row = np.arange(len(weights))
    last = weights.shape[1] - 1
    lower = np.minimum((weights != 0).argmax(axis=1), max(last - 1, 0))
    lower_weight = weights[row, lower]
    if last == 0:
        return [(lower, lower_weight)]
    return [(lower, lower_weight), (lower + 1, weights[row, lower + 1])]


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
    rows = (number[1:], number[:-1])
    columns = (number[:, 1:], number[:, :-1])
    for field_number, neighbour in (rows, columns):
        a = field_number.ravel()
        b = neighbour.ravel()
        both = np.concatenate([a, b])
        np.add.at(penalty, (both, both), JOINED)
        np.add.at(penalty, (both, np.concatenate([b, a])), -JOINED)
    return penalty


def _tame(light: FloatArray, design: Any, shape: tuple[int, int]) -> BoolArray:
    """A mask of the dots (n,) that are no outliers from the finest map."""
    used = np.ones(len(light), dtype=np.bool_)
    for _ in range(3):
        fields = _fitted(light[used], design[used], shape)
        off = np.abs(light / (design @ fields) - 1)
        sigma = MAD_TO_SIGMA * float(np.median(off[used]))
        used = off < WILD_SIGMAS * max(sigma, 1e-6)
    return used


def _held_out(
    light: FloatArray, design: Any, shape: tuple[int, int], used: BoolArray, fold: IntArray
) -> FloatArray:
    """The squared relative error of each dot (n,) in a map made without it."""
    squares = np.zeros(len(light))
    for fold_number in range(FOLDS):
        is_held_out = fold == fold_number
        is_fitted = used & ~is_held_out
        fields = _fitted(light[is_fitted], design[is_fitted], shape)
        predicted = design[is_held_out] @ fields
        squares[is_held_out] = (light[is_held_out] / predicted - 1) ** 2
    return squares


def draw_uniformity(path: Path, dots: DotLight, found: UniformityMap, finding: str) -> None:
    """Draw how much fainter each used dot is than the brightest place, and than the map, over
    the screen.
    """
    used = found.used
    x = dots.x[used]
    y = dots.y[used]
    light = (dots.light / np.median(dots.light))[used]
    mapped = found.at_dots[used]
    with chart(path, finding, panels=2) as (against_brightest, against_map):
        name = "fainter than the brightest place [mag]"
        _scatter(against_brightest, x, y, np.asarray(magnitude(light / mapped.max())), name)
        name = "fainter than the map has it [mag]"
        _scatter(against_map, x, y, np.asarray(magnitude(light / mapped)), name)
        against_map.set_xlabel("monitor x [px]")


def _scatter(axes: Any, x: IntArray, y: IntArray, off_mag: FloatArray, name: str) -> None:
    """Draw dots over the screen, coloured by a magnitude; a few outliers do not set the scale."""
    low, high = np.percentile(off_mag, (0.5, 99.5)).tolist()
    highest = max(high, low + 1e-4)
    dots = axes.scatter(x, y, c=off_mag, s=8, cmap="viridis_r", vmin=low, vmax=highest)
    dots.set_rasterized(True)  # thousands of dots
    axes.figure.colorbar(dots, ax=axes, label=name)
    axes.set(aspect="equal", ylabel="monitor y [px]")
    axes.invert_yaxis()
