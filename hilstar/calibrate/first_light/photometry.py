"""The step of photometry: the tracker as a photometer, by dots on lattices that do not saturate it."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import bench_calibration, bench_primaries, calibration_source, named_channels
from hilstar.bench.config.bench_config import drives_apart
from hilstar.calibrate.first_light.context import HOT_FILL, MAX_FILL, Figure, StepContext, StepNumber, StepOutcome
from hilstar.calibrate.first_light.image_sources import CodeImage, Pattern, black
from hilstar.calibrate.measurements import PRIMARIES
from hilstar.calibrate.photometric import Provenance, calibrate_photometric, draw_calibration
from hilstar.calibrate.plan import Patch, PlanSettings, in_channel, plan_patches
from hilstar.charts import INK, MUTED, chart
from hilstar.errors import InputError
from hilstar.files import write_whole
from hilstar.monitor.calibration import (
    Calibration,
    add_uniformity,
    load_calibration,
    primary_lights,
    primary_responses,
)
from hilstar.monitor.primaries import channel_matrix
from hilstar.monitor.response import Response
from hilstar.tracker.settings import DetectorSettings
from hilstar.twin.optics import BenchGeometry
from hilstar.units import MAG_PER_RELATIVE, magnitude

SHARE = 0.5  # relative to the smaller side of what both screen and tracker have
MAX_SIDE_TRACKER_PX = 200.0
APART_TRACKER_PX = 8.0  # distance of the sparsest lattice's dots: their wings do not add up
MIN_DOTS = 4  # along a side of the sparsest lattice
MARGIN_SIGMAS, MARGIN_PX = 6.0, 3.0
PHASES = 24


@dataclass(frozen=True, slots=True)
class DotField:
    """A square of the monitor (left, top, side; px) and the part of the tracker's image with its light (slices).

    `monitor_px` is the number of monitor pixels seen in that part.
    """

    left: int
    top: int
    side: int
    rows: slice
    columns: slice
    monitor_px: float

    def lattice(self, resolution_px: tuple[int, int], period: int, patch: Patch) -> CodeImage:
        """Every `period`-th pixel of the square, across and down, in a patch's code and channel."""
        codes = black(resolution_px)
        first = period // 2
        inside = codes[self.top : self.top + self.side, self.left : self.left + self.side]
        inside[first::period, first::period] = patch.code
        return in_channel(codes, patch.channel)

    def lit(self, period: int) -> int:
        """The number of lit pixels of such a lattice."""
        return (self.side // period) ** 2


def field_for(geometry: BenchGeometry, sigma_px: float) -> tuple[DotField, tuple[int, ...]]:
    """The square for lattices, and their periods from dense to sparse; `sigma_px` is the tracker's PSF.

    Raises InputError where too little of the monitor is seen.
    """
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sides = *(ratio * size for size in geometry.monitor.resolution_px), *geometry.tracker.resolution_px
    side = min(SHARE * min(sides), MAX_SIDE_TRACKER_PX) / ratio
    sparsest = 2 ** math.ceil(math.log2(max(APART_TRACKER_PX / ratio, 1.0)))
    cells = int(side // sparsest)
    if cells < MIN_DOTS:
        raise InputError("the tracker sees too little of the monitor for the response; look at focal lengths and pixel pitches")
    (x,), (y,) = geometry.to_monitor(*(np.array([(size - 1) / 2]) for size in geometry.tracker.resolution_px))
    corner = []  # the top left of a square about the middle of what is seen, kept on the screen
    for middle, size in zip((x, y), geometry.monitor.resolution_px, strict=True):
        wanted = middle if math.isfinite(middle) else (size - 1) / 2
        corner.append(int(np.clip(round(wanted - (cells * sparsest - 1) / 2), 0, size - cells * sparsest)))
    left, top = corner
    margin = MARGIN_PX + MARGIN_SIGMAS * math.hypot(sigma_px, ratio / math.sqrt(12))
    rows, columns = _seen(geometry, (left, top), cells * sparsest, margin)
    area = (rows.stop - rows.start) * (columns.stop - columns.start)
    periods = tuple(2**power for power in range(int(math.log2(sparsest)) + 1))
    return DotField(left, top, cells * sparsest, rows, columns, area / ratio**2), periods


def _seen(geometry: BenchGeometry, corner: tuple[int, int], side: int, margin: float) -> tuple[slice, slice]:
    """The rows and columns of the tracker's image that the square and its wings cover."""
    along = np.linspace(0, side - 1, 33)
    low, high = np.zeros_like(along), np.full_like(along, side - 1)
    x = corner[0] + np.concatenate([along, along, low, high])
    y = corner[1] + np.concatenate([low, high, along, along])
    seen = geometry.to_tracker(x, y)
    if not all(np.isfinite(part).all() for part in seen):
        raise InputError("the middle of the tracker's field sees no screen; run the geometry again")
    ends = []
    for part, size in zip(seen, geometry.tracker.resolution_px, strict=True):
        first, last = math.floor(part.min() - margin), math.ceil(part.max() + margin) + 1
        if first < 0 or last > size:
            raise InputError("the dots are not whole in the tracker's field; look at [collimator] and run the geometry again")
        ends.append(slice(first, last))
    return ends[1], ends[0]


def peak_shares(periods: tuple[int, ...], ratio: float, sigma_px: float) -> FloatArray:
    """The share of a lit pixel's light in the brightest tracker pixel, per lattice; `ratio` is tracker px per monitor px."""
    sigma = math.hypot(sigma_px, ratio / math.sqrt(12))
    shares = []
    for period in periods:
        step = period * ratio
        reach = np.arange(-math.ceil(MARGIN_SIGMAS * sigma / step) - 1, math.ceil(MARGIN_SIGMAS * sigma / step) + 2) * step
        phase = np.linspace(-0.5, 0.5, PHASES)[:, None] * step + reach
        along = (ndtr((phase + 0.5) / sigma) - ndtr((phase - 0.5) / sigma)).sum(axis=1)
        shares.append(float(along.max()) ** 2)
    return np.array(shares)


FILL = 0.5  # peak that a lattice is chosen for, relative to the tracker's range
LESS = 4.0  # by which the exposure is shortened while white saturates
MAX_PROBES = 10
BLACK = Patch(0, "w")


@dataclass(frozen=True, slots=True)
class LatticeRatio:
    """A lit pixel's light on a dense lattice relative to a sparse one, both of one code: 1 where light is additive.

    `ratio` is the mean of `pairs`, of one pair of images each.
    """

    patch: Patch
    dense: int
    sparse: int
    ratio: float
    pairs: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Readings:
    """Light (n,) of a lit pixel for each patch, black level included, DN/s; the exposure; how lattices agree.

    `above_black` (n,) is without it, and may be negative by noise, which `light` is not. `period` (n,) is each one's lattice.
    `black_known` says whether the black level was measured; else it is the bench file's.
    """

    patches: list[Patch]
    light: FloatArray
    exposure_s: float
    links: list[LatticeRatio]
    black_known: bool
    images: tuple[Path, ...]
    above_black: FloatArray
    period: IntArray

    def write(self, path: Path) -> None:
        """MEASURED.csv, as `calibrate photometric` reads it. Raises InputError."""
        head = [f"# light of one monitor pixel in the tracker, DN/s, by dots on lattices; exposed for {self.exposure_s:.6g} s"]
        head += [
            f"# code {link.patch.code} of {link.patch.channel}: a pixel of every {link.dense} is {link.ratio:.5f} times"
            f" one of every {link.sparse}"
            for link in self.links
        ]
        rows = [
            f"{order},{patch.code},{patch.channel},{value!r}"
            for order, (patch, value) in enumerate(zip(self.patches, self.light.tolist(), strict=True), start=1)
        ]
        write_whole(path, "\n".join([*head, "order,code,channel,value", *rows]) + "\n")


@dataclass(frozen=True, slots=True)
class Assumed:
    """The bench file's light above black by channel and code (2^bits,), relative to white, and its black level."""

    light: dict[str, FloatArray]
    black: float


class Photometer:
    """The tracker as a photometer. Raises InputError where the lattices are not whole in its field."""

    def __init__(self, context: StepContext, sigma_px: float, assumed: Assumed, pairs: int = 1) -> None:
        geometry = context.real_geometry()
        self.context, self.assumed, self.pairs = context, assumed, pairs
        self.field, self.periods = field_for(geometry, sigma_px)
        self.shares = peak_shares(self.periods, geometry.tracker.focal_length_px / geometry.monitor.focal_length_px, sigma_px)
        self.exposure_s = context.exposure_s
        self._dark_screen = context.take(Pattern("black_screen", black(context.resolution_px)))
        self.images = [self._dark_screen]
        self._cold = self._part(self._dark_screen) < HOT_FILL * context.full_dn

    def read(self, planned: list[Patch]) -> Readings:
        """Show and read the planned patches. Raises InputError where white saturates the tracker."""
        white_dn = self._expose()
        chosen = {patch: self._period(patch, white_dn) for patch in planned if patch.code}
        sums: list[float] = []
        for order, patch in enumerate(planned):
            while True:
                period = chosen.get(patch, 1)
                total, fill = self._look(f"patch_{order:03}_{period}", period, patch)
                if fill <= MAX_FILL or period == self.periods[-1]:
                    break
                chosen[patch] = 2 * period  # brighter than the bench file says
            sums.append(total)
        links = [link for channel in self.assumed.light for link in self._links(channel, chosen)]
        above = self._above_black(planned, np.array(sums), chosen, links)
        light, black_known = self._with_black(planned, above)
        periods = np.array([chosen.get(patch, self.periods[-1]) for patch in planned], dtype=np.intp)
        return Readings(planned, light, self.exposure_s, links, black_known, tuple(self.images), above, periods)

    def _expose(self) -> float:
        """Choose an exposure in which white does not saturate, first the bench file's; returns a white dot's peak, DN."""
        brightest = max(self.assumed.light, key=lambda name: float(self.assumed.light[name][-1]))
        white = Patch(self.context.white, brightest)
        for probe in range(MAX_PROBES):
            fill = self._look(f"white_{probe:02}", self.periods[-1], white)[1]
            if fill <= MAX_FILL:
                break
            if not self.context.source.sets_exposure:
                raise InputError(
                    f"one pixel at white saturates the tracker in {self.exposure_s:g} s: let --grab set the exposure"
                    " ({exposure_s}), turn the monitor's brightness down, or use a photometer (hilstar calibrate plan)"
                )
            self.exposure_s /= LESS
        else:
            raise InputError(f"one pixel at white saturates the tracker even in {self.exposure_s:.2g} s; look at stray light")
        if probe:
            self.exposure_s *= FILL / fill
        dark = self._part(self._take("black", 1, BLACK))
        bright = self._part(self._take("white", self.periods[-1], white))
        share = float(self.assumed.light[white.channel][white.code])
        return float((bright - dark)[self._cold].max(initial=1.0)) / share

    def _period(self, patch: Patch, white_dn: float) -> int:
        """The period of a patch's densest lattice that does not saturate, by the bench file's response."""
        peaks = white_dn * self.assumed.light[patch.channel][patch.code] * self.shares / self.shares[-1]
        fits = np.flatnonzero(peaks <= FILL * self.context.full_dn)
        return self.periods[int(fits[0])] if len(fits) else self.periods[-1]

    def _links(self, channel: str, chosen: dict[Patch, int]) -> Iterator[LatticeRatio]:
        """Compare each two successive lattices of a channel by one code shown on both."""
        periods = {patch: period for patch, period in chosen.items() if patch.channel == channel}
        for dense, sparse in itertools.pairwise(sorted({*periods.values(), self.periods[-1]})):
            patch = max(patch for patch, period in periods.items() if period == dense)
            ratios = []
            for pair in range(self.pairs):
                name = f"link_{channel}_{sparse}" + (f"_{pair}" if pair else "")
                # Each pair has a black image of its own: the noise of one for all would be in no scatter of the pairs.
                dark = self._look(f"{name}_black", 1, BLACK)[0]
                dots = [
                    (self._look(f"{name}_{period}", period, patch)[0] - dark) / self.field.lit(period)
                    for period in (dense, sparse)
                ]
                if dots[1] <= 0:
                    raise InputError(f"dots of code {patch.code} have no light in the tracker; look at what the screen shows")
                ratios.append(dots[0] / dots[1])
            yield LatticeRatio(patch, dense, sparse, float(np.mean(ratios)), tuple(ratios))

    def _above_black(
        self, planned: list[Patch], sums: FloatArray, chosen: dict[Patch, int], links: list[LatticeRatio]
    ) -> FloatArray:
        """Light (n,) above black of a pixel of each patch on the sparsest lattice's scale, DN/s."""
        order, dark = np.arange(len(planned)), np.array([patch.code == 0 for patch in planned])
        under = np.interp(order, order[dark], sums[dark])
        factor = {(channel, self.periods[-1]): 1.0 for channel in self.assumed.light}
        for link in reversed(links):
            channel = link.patch.channel
            factor[channel, link.dense] = factor[channel, link.sparse] * link.ratio
        periods = [chosen.get(patch, self.periods[-1]) for patch in planned]
        lit = [self.field.lit(p) * factor[patch.channel, p] for patch, p in zip(planned, periods, strict=True)]
        light = (sums - under) / (np.array(lit) * self.exposure_s)
        # On a black screen every pixel glows alike; the repeats tell how well that is known.
        light[dark] = (sums[dark] - sums[dark].mean()) / (self.field.monitor_px * self.exposure_s)
        return np.asarray(light)

    def _with_black(self, planned: list[Patch], light: FloatArray) -> tuple[FloatArray, bool]:
        """Light (n,) with the black level, DN/s, and whether that was measured."""
        unlit = self.context.unlit()
        if unlit is not None:  # a black screen minus one that is switched off
            self.images.append(unlit)
            more = float((self._part(self._dark_screen) - self._part(unlit)).sum())
            glow = max(more / (self.field.monitor_px * self.context.exposure_s), 0.0)
            return np.maximum(light + glow, 0.0), True
        whites = [light[[patch == Patch(self.context.white, name) for patch in planned]].mean() for name in self.assumed.light]
        return np.maximum(light + self.assumed.black * float(np.sum(whites)), 0.0), False

    def _look(self, name: str, period: int, patch: Patch) -> tuple[float, float]:
        """The sum over a lattice's field, DN, and its brightest pixel relative to full scale."""
        part = self._part(self._take(name, period, patch))
        return float(part.sum()), float(part[self._cold].max(initial=0.0)) / self.context.full_dn

    def _take(self, name: str, period: int, patch: Patch) -> Path:
        pattern = Pattern(name, self.field.lattice(self.context.resolution_px, period, patch))
        self.images.append(self.context.take(pattern, self.exposure_s))
        return self.images[-1]

    def _part(self, path: Path) -> FloatArray:
        return self.context.pixels(path)[self.field.rows, self.field.columns]


SEED = 0
PHOTOMETRY_FILES = ("measured.csv", "response.toml", "response.svg", "response-before.svg")
MIN_LEVELS = 10  # as `calibrate photometric` needs
DITHER_DN = 0.4  # of read noise: the mean of rounded values is then off by 0.02 DN at most
DIM_LIGHT = 1e-3  # relative to white: how far down responses are compared


def photometry(context: StepContext) -> StepOutcome:
    """Measure the response and name its file in the bench file. Raises InputError."""
    monitor = context.file.config.monitor
    if not context.patches:
        how = "give --patches N, or use a photometer (`hilstar calibrate plan --show`, then `hilstar calibrate photometric`)"
        return StepOutcome("skipped", f"not measured, the bench file's {monitor.calibration} stays: {how}")
    assumed = calibration_of(context)
    apart = drives_apart(context.file.config)
    channels = "".join(PRIMARIES) if context.file.config.render.bit_stealing or apart else "w"
    planned = plan_for(monitor.bits, context.patches, channels)
    by_channel = {"w": assumed.response.light}
    if apart:
        responses = primary_responses(calibration_source(monitor, context.file.folder), monitor.bits)
        shares = shares_of_white(context.file)
        by_channel = {name: share * one.light for name, share, one in zip(channels, shares, responses, strict=True)}
    elif channels != "w":
        by_channel = dict(
            zip(channels, primary_lights(calibration_source(monitor, context.file.folder), monitor.bits), strict=True)
        )
    readings = Photometer(context, context.psf_sigma_px, Assumed(by_channel, assumed.response.black)).read(planned)
    measured, output, picture, before = (context.session / name for name in PHOTOMETRY_FILES)
    readings.write(measured)
    instrument = f"the tracker, exposed for {readings.exposure_s:.4g} s, hilstar first-light"
    found = calibrate_photometric(
        measured, output, Provenance("", "", instrument, "DN/s"), monitor.bits, context.source.monitor
    )
    files = [output, output.with_suffix(".csv"), measured, picture, before, *readings.images]
    if assumed.uniformity is not None:
        files.append(add_uniformity(output, assumed.uniformity, assumed.uniformity_relative))
    draw_calibration(measured, picture, monitor.bits)
    written = load_calibration(output, monitor.bits)
    now = written.response
    figures = _response_figures(context, readings, found, assumed.response, now)
    if written.weights is not None:
        figures["shares_of_white"] = ", ".join(f"{n} {share:.4f}" for n, share in zip(channels, written.weights, strict=True))
    off = f"{figures['bench_file_off_rms_mag']:.3f} mag rms, {figures['bench_file_off_max_mag']:.3f} max"
    off_mag = response_error_mag(assumed.response, now)
    with chart(before, f"The bench file's response is off by {off}") as (axes,):
        axes.plot(now.light[-len(off_mag) :], off_mag, color=INK)
        axes.axhline(0, color=MUTED, linewidth=0.8)
        axes.set_xscale("log")
        axes.set(xlabel="measured light over white [share]", ylabel="fainter than in the bench file [mag]")
        axes.invert_yaxis()
    return _judged(context, figures, tuple(dict.fromkeys(files)), (picture, before))


def plan_for(bits: int, patches: int, channels: str = "w") -> list[Patch]:
    """The plan with the most levels that has at most `patches` patches. Raises InputError where they are too few."""
    plans = [
        plan_patches(PlanSettings(bits, levels, 1, channels), np.random.default_rng(SEED))
        for levels in range(MIN_LEVELS, max(MIN_LEVELS, min(patches, 2**bits)) + 1)
    ]
    if len(plans[0]) > patches:
        raise InputError(f"--patches {patches}: a response needs {len(plans[0])} or more; write that, or 0 for none")
    return [planned for planned in plans if len(planned) <= patches][-1]


def shares_of_white(file: BenchFile) -> FloatArray:
    """Each primary's share (3,) of the electrons of white, by the spectra of a bench file. Raises InputError."""
    primaries = bench_primaries(file.config.monitor, file.folder)
    if primaries is None:
        raise InputError("[monitor.primaries] file: first-light measures each primary's light; write it, or xy_r to xy_b")
    matrix = channel_matrix(primaries, named_channels(file.config.tracker, file.folder), 1.0)
    return np.asarray(matrix.e_per_s.sum(axis=0))


def calibration_of(context: StepContext) -> Calibration:
    """The calibration that the bench file names."""
    monitor = context.file.config.monitor
    return load_calibration(calibration_source(monitor, context.file.folder), monitor.bits)


def _response_figures(
    context: StepContext, readings: Readings, found: dict[str, Any], before: Response, now: Response
) -> dict[str, Figure]:
    off = response_error_mag(before, now)
    held = [channel["holdout"] for channel in found["channels"].values()]
    figures: dict[str, Figure] = {
        "gamma": exponent(now),
        "gamma_in_bench_file": exponent(before),
        "bench_file_off_rms_mag": float(np.sqrt((off**2).mean())),
        "bench_file_off_max_mag": float(np.abs(off).max()),
        "black_level": now.black,
        "black_level_in_bench_file": before.black,
        "black_level_measured": "yes" if readings.black_known else "no: give --dark, an image with the monitor switched off",
        "held_out_rms_mag": max(each["rms_mag"] for each in held),
        "held_out_p95_mag": max(MAG_PER_RELATIVE * each["p95_percent"] / 100 for each in held),
        "held_out_max_mag": max(each["max_mag"] for each in held),
        "noise_percent": 100 * found["noise_relative"],
        "drift_percent": float("nan") if found["drift_percent"] is None else found["drift_percent"],
        "patches": len(readings.patches),
        "codes": found["codes"],
        "exposure_s": readings.exposure_s,
        "links": ", ".join(f"{link.ratio:.4f}" for link in readings.links) or "none",
        "links_max_mag": max((abs(float(magnitude(link.ratio))) for link in readings.links), default=0.0),
        **{f"error_at_{decade}_percent": value for decade, value in found["error_percent"].items()},
    }
    if context.truth is not None:
        true = bench_calibration(context.truth.config, context.truth.folder).response
        figures["truth_max_mag"] = float(np.abs(response_error_mag(now, true)).max())
        figures["truth_black_level"] = true.black
    return figures


def rounds_alike(detector: DetectorSettings) -> bool:
    """Whether an ADC takes light of under half a DN away: nothing but enough read noise spreads it over the steps."""
    return detector.read_noise_e < DITHER_DN * detector.gain_e_per_dn


def _judged(
    context: StepContext, figures: dict[str, Figure], files: tuple[Path, ...], pictures: tuple[Path, ...]
) -> StepOutcome:
    """The step's outcome: done, with the response named in the bench file, unless it misses the limits of [verify]."""
    limit_mag = context.file.config.verify.flux_mag
    monitor = context.file.config.monitor
    line = (
        f"the bench file's {monitor.calibration} is off by {figures['bench_file_off_rms_mag']:.3f} mag rms,"
        f" {figures['bench_file_off_max_mag']:.3f} max (gamma {figures['gamma']:.3f}, not"
        f" {figures['gamma_in_bench_file']:.3f});"
        f" measured: held-out levels {figures['held_out_rms_mag']:.4f} mag rms, {figures['held_out_max_mag']:.4f} max;"
        f" black {figures['black_level']:.2e} of white"
        f"{'' if figures['black_level_measured'] == 'yes' else ' as the bench file has it, not measured (--dark)'}"
    )
    rms_mag = float(figures["held_out_rms_mag"])
    error = rms_mag / math.sqrt(2 * float(figures["codes"]))
    number = StepNumber(rms_mag, error, "mag", "rms distance of held-out levels from the response")
    if float(figures["links_max_mag"]) > limit_mag:
        why = "switch off dynamic contrast and local dimming, or is the tracker not linear?"
        line = f"dense and sparse dots of one code differ by {figures['links_max_mag']:.3f} mag: {why}"
        return StepOutcome("failed", line, figures, files, pictures, number=number)
    if float(figures["held_out_p95_mag"]) > limit_mag:
        why = "take more readings (--patches), look at stray light, and at whether the monitor was warm"
        if context.truth is not None and rounds_alike(context.truth.config.tracker.detector):
            why += "; the virtual tracker's ADC rounds faint codes alike: write the truth's [tracker.detector] read_noise_e"
        line = f"{line}: the levels do not make one smooth response; {why}"
        return StepOutcome("failed", line, figures, files, pictures, number=number)
    changes = context.names("monitor", "calibration", context.session / "response.toml")
    return StepOutcome("done", line, figures, files, pictures, changes, number)


def response_error_mag(assumed: Response, true: Response) -> FloatArray:
    """How much fainter each code is than assumed (n,), magnitudes, from three decades below white to white."""
    seen = true.light[1:] >= DIM_LIGHT
    return np.asarray(magnitude(true.light[1:][seen] / assumed.light[1:][seen]))


def exponent(response: Response) -> float:
    """The exponent of a power law fitted to the response over three decades."""
    light = response.light[1:]
    used = light >= DIM_LIGHT
    signal = np.arange(1, len(response.light))[used] / response.white
    return float(np.polyfit(np.log(signal), np.log(light[used]), 1)[0])
