"""The methods from light to levels: flux and centroid errors against magnitude, and against
time.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, ORANGE, SMALL_PT
from hilstar.basics.units import flux_ratio
from hilstar.display.phases import USUAL_PSF, WHITE
from hilstar.display.quantise import EXPOSURE_FRAMES
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.instruments.study import codes
from hilstar.instruments.study.engine import (
    ChartSpec,
    DotsSpec,
    LineSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    row_panels,
    write_rows,
)
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, medians_ms
from hilstar.optics.sprites import FrameLight
from hilstar.tracker.centroiders import FAMILY

ROUNDS, QUICK_ROUNDS = 31, 3
MIN_ERROR = 1e-5  # as drawn
MIDDLE_BITS = codes.BITS[1]  # those that titles and lines state
MARKERS = dict(zip(codes.BITS, "os^", strict=True))
AIM_LABEL: Any = {"textcoords": "offset points", "fontsize": SMALL_PT}
STEALING_STYLE = {True: ":", False: "-"}
MAGNITUDES_NOTE = (
    "Largest errors over sub-pixel phases, sRGB; places by a PSF fit. Dotted: with bit stealing."
)
TIMES_NOTE = (
    f"{codes.STARS} stars, {codes.FRAME_PX[0]} x {codes.FRAME_PX[1]}. Circles, squares, triangles:"
    " 8, 10 and 12 bits, at the faint end."
)
EACH_NOTE = (
    "Errors are rms along an axis, over sub-pixel phases. At the right: what exact leaves of the"
    " error of round."
)
EACH_LOOKS = SeriesLook("round", ORANGE), SeriesLook("exact", BLUE)


@dataclass(frozen=True, slots=True)
class WayErrors:
    """The errors of one way at one magnitude under white."""

    bits: int
    method: str
    mag_under_white: float
    figures: codes.ErrorFigures


@dataclass(frozen=True, slots=True)
class TimedWay:
    """The median time of a frame of one way, and its errors at the faint end of its aim."""

    bits: int
    method: str
    frame_ms: float
    mag_under_white: float
    figures: codes.ErrorFigures


@dataclass(frozen=True, slots=True)
class CentroiderErrors:
    """Centroid errors with the codes of `round` and `exact` by one centroider, rms along an axis,
    px.
    """

    bits: int
    centroider: str
    round_px: float
    exact_px: float

    @property
    def share(self) -> float:
        """The error with `exact` relative to that with `round`."""
        return self.exact_px / self.round_px


@dataclass(frozen=True, slots=True)
class QuantisationMeasured:
    """The errors of every way, the times with the work of others meanwhile, and the errors over
    several frames.
    """

    rows: Sequence[WayErrors]
    timed: Sequence[TimedWay]
    load: Load
    over_frames: Sequence[codes.OverFrames]


def run(directory: Path, quick: bool = False) -> Judged:
    """Write the charts and their tables (CSV) into `directory`; a line for each finding."""
    return report(directory, measure(quick))


def measure(quick: bool) -> QuantisationMeasured:
    """Every way's errors over magnitudes, its times, and its errors over frames."""
    rows = way_errors(quick)
    others = OtherWork()
    timed = timed_ways(rows, QUICK_ROUNDS if quick else ROUNDS)
    load = others.load()
    return QuantisationMeasured(rows, timed, load, codes.measure_frames(quick))


def report(directory: Path, measured: QuantisationMeasured) -> Judged:
    """Write what was measured; a line for each finding. Raises InputError."""
    rows, timed, load = measured.rows, measured.timed, measured.load
    write_rows(directory / "quantisation.csv", rows)
    by_centroider = centroider_errors(rows)
    draw_magnitudes(directory / "quantisation", rows)
    draw_each(directory / "quantisation_centroiders", by_centroider)
    draw_times(directory / "quantisation_time", timed, load)
    write_rows(directory / "quantisation_time.csv", timed)
    lines = []
    for bits in codes.BITS:
        lines.append(summary(bits, rows))
    lines += [centroiders_line(by_centroider), times_line(timed)]
    lines.append(codes.report_frames(directory, measured.over_frames))
    return load.judged(lines)


def phases_and_mags(quick: bool) -> tuple[int, FloatArray]:
    """Sub-pixel phases along an axis, and magnitudes under white."""
    if quick:
        return 8, np.linspace(0, 8, 5)
    return 32, np.linspace(0, 10, 41)


def way_errors(quick: bool) -> list[WayErrors]:
    """The errors of every way over magnitudes."""
    phases, mags = phases_and_mags(quick)
    rows = []
    for bits, way in product(codes.BITS, codes.WAYS):
        errors = codes.code_errors(bits, way, phases, mags)
        for mag, of_mag in zip(mags.tolist(), errors, strict=True):
            rows.append(WayErrors(bits, way.name, mag, codes.error_figures(of_mag)))
    return rows


def faintest(rows: Sequence[WayErrors], bits: int, method: str) -> WayErrors:
    """The errors of a way at the faint end of its aim."""
    limit_mag = codes.AIMS[bits][1]
    for row in rows:
        if (row.bits, row.method) == (bits, method) and row.mag_under_white >= limit_mag:
            return row
    raise AssertionError("magnitudes reach the faint end of every aim")


def draw_levels(renderer: Renderer, sprites: FrameLight, frame: int) -> object:
    """Draw a frame and read its levels back."""
    renderer.draw(sprites, frame)
    return renderer.levels()


def timed_ways(rows: Sequence[WayErrors], rounds: int) -> list[TimedWay]:
    """The time of drawing STARS stars and reading their levels back, the ways of a number of bits
    in turn.
    """
    sprites = codes.star_field(codes.FRAME_PX, USUAL_PSF.footprint_px)
    timed = []
    for bits in codes.BITS:
        works: dict[str, Callable[[int], object]] = {}
        with ExitStack() as stack:
            for way in codes.WAYS:
                response = codes.response_of(bits, way)
                target = Target(codes.FRAME_PX, USUAL_PSF, response, WHITE, way.method)
                renderer = stack.enter_context(Renderer(target))
                works[way.name] = partial(draw_levels, renderer, sprites)
            times_ms = medians_ms(works, rounds)
        for name, frame_ms in times_ms.items():
            row = faintest(rows, bits, name)
            limit_mag = codes.AIMS[bits][1]
            timed.append(TimedWay(bits, name, frame_ms, limit_mag, row.figures))
    return timed


def centroider_errors(rows: Sequence[WayErrors]) -> list[CentroiderErrors]:
    """The errors at the faint end by bits and centroider."""
    table = []
    for bits, kind in product(codes.BITS, FAMILY):
        round_px = faintest(rows, bits, "round").figures.axis_rms_px(kind)
        exact_px = faintest(rows, bits, "exact").figures.axis_rms_px(kind)
        table.append(CentroiderErrors(bits, kind, round_px, exact_px))
    return table


def summary(bits: int, rows: Sequence[WayErrors]) -> str:
    """The largest errors of every way on a panel of these bits, beside its aim."""
    aim_mag, limit = codes.AIMS[bits]
    largest = {}
    for way in codes.WAYS:
        largest[way.name] = largest_words(rows, bits, way.name)
    others = ", ".join(f"{way.method} {largest[way.name]}" for way in codes.WAYS[:3])
    exact = largest["exact"]
    stealing = largest["exact" + codes.STEALING]
    half_step_px = srgb_response(bits).half_step * USUAL_PSF.peak_share / flux_ratio(limit)
    aim = f"aim {aim_mag:g} mag, {codes.AIM_PX:g} px"
    return (
        f"{bits} bits, sRGB, {limit:g} magnitudes ({aim}): largest errors, places by a PSF fit, of"
        f" exact {exact}, with bit stealing {stealing}; {others} (over {EXPOSURE_FRAMES}"
        " frames). Half the smallest step of light moves a centroid by"
        f" {half_step_px:.3f} px along each axis"
    )


def largest_words(rows: Sequence[WayErrors], bits: int, method: str) -> str:
    """The largest errors of a way down to the faint end of its aim, in words."""
    limit_mag = codes.AIMS[bits][1]
    flux_mag = 0.0
    place_px = 0.0
    for row in rows:
        if (row.bits, row.method) == (bits, method) and row.mag_under_white <= limit_mag:
            flux_mag = max(flux_mag, row.figures.flux_max_mag)
            place_px = max(place_px, row.figures.max_px_fit)
    return f"{flux_mag:.3f} mag and {place_px:.3f} px"


def centroiders_line(rows: Sequence[CentroiderErrors]) -> str:
    """The error of `exact` relative to `round` on the coarsest panel, by centroider."""
    coarsest = codes.BITS[0]
    ratios = []
    for row in rows:
        if row.bits == coarsest:
            ratios.append(f"{row.centroider} {row.share:.2f} ({row.exact_px:.4f} px)")
    return (
        f"{coarsest} bits, {codes.AIMS[coarsest][1]:g} magnitudes under white: of the error of"
        f" round (rms along an axis) exact leaves, by each centroider, {', '.join(ratios)}"
    )


def times_line(timed: Sequence[TimedWay]) -> str:
    """The times of the ways without bit stealing."""
    ms = {row.method: row.frame_ms for row in timed if row.bits == MIDDLE_BITS}
    times = ", ".join(f"{way.method} {ms[way.name]:.1f} ms" for way in codes.WAYS[:4])
    width, height = codes.FRAME_PX
    return (
        f"{codes.STARS} stars, {width} x {height}, {MIDDLE_BITS} bits, from light to levels in"
        f" memory: {times}"
    )


def way_of(row: WayErrors | TimedWay) -> str:
    """The series of a row: its way."""
    return row.method


def draw_magnitudes(path: Path, rows: Sequence[WayErrors]) -> None:
    """The largest errors against magnitude, a row of panels for each number of bits."""
    limit = codes.AIMS[MIDDLE_BITS][1]
    exact = largest_words(rows, MIDDLE_BITS, "exact")
    rounded = largest_words(rows, MIDDLE_BITS, "round")
    finding = (
        f"On {MIDDLE_BITS} bits every star to {limit:g} magnitudes under white is within {exact}"
        f" with exact, {rounded} with round"
    )
    panels = []
    for bits in codes.BITS:
        xlabel = "magnitudes under a white peak" if bits == codes.BITS[-1] else ""
        flux = magnitude_lines(bits, "flux_max_mag")
        place = magnitude_lines(bits, "max_px_fit")
        log_y: dict[str, Any] = {"xlabel": xlabel, "scales": ("linear", "log")}
        title = f"{bits} bits"
        panels.append(PanelSpec(flux, "flux error [mag]", title=title, names=False, **log_y))
        panels.append(PanelSpec(place, "place error [monitor px]", **log_y))
    looks = {}
    for way in codes.WAYS:
        looks[way.name] = SeriesLook(way.name.replace("mean of ", ""), way.colour)
    spec = ChartSpec(tuple(panels), way_of, looks, MAGNITUDES_NOTE, 2, {"share_y": "col"})
    with row_panels(path, finding, spec, rows) as grid:
        for bits, flux_axes, place_axes in zip(codes.BITS, grid[::2], grid[1::2], strict=True):
            aim_mag, limit = codes.AIMS[bits]
            for axes, aim in ((flux_axes, aim_mag), (place_axes, codes.AIM_PX)):
                down_at_limit = [0, limit, limit], [aim, aim, MIN_ERROR]
                axes.plot(*down_at_limit, "--", color=INK, lw=1.1, label="_aim")
                axes.annotate("aim", (0, aim), (2, 3), **AIM_LABEL)


def magnitude_lines(bits: int, error: str) -> tuple[LineSpec, ...]:
    """An error on a panel against magnitude: solid, and dotted with bit stealing."""
    stealing_ways = {way.name: way.stealing for way in codes.WAYS}
    lines = []
    for is_stealing, style in STEALING_STYLE.items():

        def is_drawn(row: WayErrors, is_stealing: bool = is_stealing) -> bool:
            return row.bits == bits and stealing_ways[row.method] == is_stealing

        line = LineSpec("mag_under_white", as_drawn(error), style, where=is_drawn, look={"lw": 1.5})
        lines.append(line)
    return tuple(lines)


def as_drawn(error: str) -> Callable[[WayErrors], float]:
    """An error for a logarithmic axis: at least MIN_ERROR, NaN where a star shows nothing."""

    def value(row: WayErrors) -> float:
        size = float(getattr(row.figures, error))
        if math.isfinite(size):
            return max(size, MIN_ERROR)
        return math.nan

    return value


def draw_each(path: Path, rows: Sequence[CentroiderErrors]) -> None:
    """The errors of round and exact by each centroider, a panel for each number of bits."""
    shares = [row.share for row in rows]
    finding = (
        f"Whichever centroider the tracker has, exact leaves {min(shares):.2f} to"
        f" {max(shares):.2f} of the error that round makes at the faint end"
    )
    panels = tuple(centroiders_panel(bits) for bits in codes.BITS)
    layout = {"share_y": True, "height_inch": 3.6}
    spec = ChartSpec(panels, lambda row: row.bits, {}, EACH_NOTE, len(panels), layout)
    with row_panels(path, finding, spec, rows) as grid:
        names = grid[0].get_legend_handles_labels()
        grid[0].figure.legend(*names, loc="outside upper right", ncols=2)


def centroiders_panel(bits: int) -> PanelSpec:
    """The errors on a panel of these bits; the first panel has the names for all."""
    first, second = EACH_LOOKS
    dots = DotsSpec(
        (("round_px", first), ("exact_px", second)),
        where=lambda row: row.bits == bits,
        name=(lambda row: row.centroider) if bits == codes.BITS[0] else None,
        note=lambda row: f"{row.share:.2f}",
    )
    return PanelSpec(
        xlabel="error [monitor px]",
        title=f"{bits} bits, {codes.AIMS[bits][1]:g} mag under white",
        dots=dots,
        names=False,
        margins=(0.2, 0.12),
    )


def draw_times(path: Path, timed: Sequence[TimedWay], load: Load) -> None:
    """The errors at the faint end against the time of a frame."""
    ms = {row.method: row.frame_ms for row in timed if row.bits == MIDDLE_BITS}
    took = f"exact takes {ms['exact']:.1f} ms and round {ms['round']:.1f} ms"
    finding = load.title(f"From light to codes in memory {took}, on {MIDDLE_BITS} bits")
    looks = {}
    for way in codes.WAYS:
        looks[way.name] = SeriesLook(way.name, way.colour, is_open=way.stealing)
    log: dict[str, Any] = {"scales": ("log", "log"), "margins": (0.1, 0.1)}
    light = PanelSpec(time_points(flux_rms_mag), "flux error, rms [mag]", **log)
    place = PanelSpec(
        time_points(distance_rms_px),
        "place error, rms [monitor px]",
        "time of a frame [ms]",
        **log,
    )
    draw_rows(path, finding, ChartSpec((light, place), way_of, looks, TIMES_NOTE), timed, load)


def time_points(error: Callable[[TimedWay], float]) -> tuple[LineSpec, ...]:
    """An error against time: a marker for each number of bits, of which the first is named."""
    points = []
    for bits, marker in MARKERS.items():

        def is_drawn(row: TimedWay, bits: int = bits) -> bool:
            return row.bits == bits

        named = bits == codes.BITS[0]
        large = {"ms": 8}
        point = LineSpec("frame_ms", error, "", marker, named, where=is_drawn, look=large)
        points.append(point)
    return tuple(points)


def flux_rms_mag(row: TimedWay) -> float:
    """The error of light, rms."""
    return row.figures.flux_rms_mag


def distance_rms_px(row: TimedWay) -> float:
    """The distance by which a PSF fit is off, rms."""
    return math.sqrt(2) * row.figures.axis_rms_px_fit
