"""The methods from light to levels: flux and centroid errors against magnitude, and against
time.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import (
    BLUE,
    INK,
    ORANGE,
    SMALL_PT,
    chart,
    label_ends,
    name_at_side,
    write_csv,
)
from hilstar.basics.units import flux_ratio
from hilstar.display.phases import USUAL_PSF, WHITE
from hilstar.display.quantise import EXPOSURE_FRAMES
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.instruments.study import codes
from hilstar.instruments.study.row_charts import PairSpec, SeriesLook, draw_pairs, name_places
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, medians_ms
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import StarErrors

Found = dict[tuple[int, str], list[StarErrors]]
MIN_ERROR = 1e-5  # as drawn
EACH_NOTE = (
    "Errors are rms along an axis, over sub-pixel phases. At the right: what exact leaves of the"
    " error of round."
)
EACH_PAIRS = PairSpec(
    "round_px", "exact_px", (SeriesLook("round", ORANGE), SeriesLook("exact", BLUE))
)
BESIDE: Any = {"textcoords": "offset points", "va": "center", "fontsize": SMALL_PT}
MARKERS = dict(zip(codes.BITS, "os^", strict=True))


def run(directory: Path, quick: bool = False) -> Judged:
    """Write the charts and their tables (CSV) into `directory`; a line for each finding."""
    phases, mags = (8, np.linspace(0, 8, 5)) if quick else (32, np.linspace(0, 10, 41))
    errors_by_way: Found = {}
    rows = []
    for bits in codes.BITS:
        for way in codes.WAYS:
            errors = codes.code_errors(bits, way, phases, mags)
            errors_by_way[bits, way.name] = errors
            for mag, of_mag in zip(mags.tolist(), errors, strict=True):
                rows.append((bits, way.name, mag, *codes.error_cells(of_mag)))
    write_csv(
        directory / "quantisation.csv",
        ("bits", "method", "mag_under_white", *codes.ERROR_COLUMNS),
        rows,
    )
    faintest = {
        key: errors[int(np.searchsorted(mags, codes.AIMS[key[0]][1]))]
        for key, errors in errors_by_way.items()
    }
    others = OtherWork()
    times = _frame_times_ms(3 if quick else 31)
    load = others.load()
    _draw_magnitudes(directory / "quantisation", errors_by_way, mags)
    draw_each(directory / "quantisation_centroiders", centroider_errors(faintest))
    _draw_times(directory / "quantisation_time", faintest, times, load)
    time_rows = []
    for key, of_faintest in faintest.items():
        mag_under_white = codes.AIMS[key[0]][1]
        time_rows.append((*key, times[key], mag_under_white, *codes.error_cells(of_faintest)))
    write_csv(
        directory / "quantisation_time.csv",
        ("bits", "method", "frame_ms", "mag_under_white", *codes.ERROR_COLUMNS),
        time_rows,
    )
    coarsest = codes.BITS[0]
    ratios = []
    for kind in FAMILY:
        rounded_px = faintest[coarsest, "round"].axis_rms_px(kind)
        exact_px = faintest[coarsest, "exact"].axis_rms_px(kind)
        ratios.append(f"{kind} {exact_px / rounded_px:.2f} ({exact_px:.4f} px)")
    ratios_text = ", ".join(ratios)
    ms = ", ".join(f"{way.method} {times[10, way.name]:.1f} ms" for way in codes.WAYS[:4])
    lines = [
        *(_summary(bits, errors_by_way, mags) for bits in codes.BITS),
        (
            f"{coarsest} bits, {codes.AIMS[coarsest][1]:g} magnitudes under white: of the error of"
            f" round (rms along an axis) exact leaves, by each centroider, {ratios_text}"
        ),
        (
            f"{codes.STARS} stars, {codes.FRAME_PX[0]} x {codes.FRAME_PX[1]}, 10 bits, from light"
            f" to levels in memory: {ms}"
        ),
        codes.study_frames(directory, quick),
    ]
    return load.judged(lines)


def _frame_times_ms(rounds: int) -> dict[tuple[int, str], float]:
    """The median time of drawing STARS stars and reading their levels back, ms, by bits and way;
    the ways in turn.
    """
    sprites = codes.star_field(codes.FRAME_PX, USUAL_PSF.footprint_px)
    times: dict[tuple[int, str], float] = {}

    def draw(renderer: Renderer, frame: int) -> object:
        renderer.draw(sprites, frame)
        return renderer.levels()

    for bits in codes.BITS:
        with ExitStack() as stack:
            targets = {}
            for way in codes.WAYS:
                targets[way.name] = Target(
                    codes.FRAME_PX, USUAL_PSF, codes.response_of(bits, way), WHITE, way.method
                )
            works = {
                name: partial(draw, stack.enter_context(Renderer(on)))
                for name, on in targets.items()
            }
            times |= {(bits, name): ms for name, ms in medians_ms(works, rounds).items()}
    return times


def _summary(bits: int, found: Found, mags: FloatArray) -> str:
    aim_mag, limit = codes.AIMS[bits]
    worst = {way: _worst(found[bits, way.name], mags, limit) for way in codes.WAYS}
    others = ", ".join(f"{way.method} {worst[way]}" for way in codes.WAYS[:3])
    half_step_px = srgb_response(bits).half_step * USUAL_PSF.peak_share / flux_ratio(limit)
    return (
        f"{bits} bits, sRGB, {limit:g} magnitudes (aim {aim_mag:g} mag, {codes.AIM_PX:g} px):"
        f" largest errors, places by a PSF fit, of exact {worst[codes.WAYS[3]]}, with bit stealing"
        f" {worst[codes.WAYS[5]]}; {others} (over {EXPOSURE_FRAMES} frames). Half the smallest step"
        f" of light moves a centroid by {half_step_px:.3f} px along each axis"
    )


def _worst(errors: list[StarErrors], mags: FloatArray, limit_mag: float) -> str:
    within = [e for e, mag in zip(errors, mags, strict=True) if mag <= limit_mag]
    return (
        f"{max(e.flux_max_mag for e in within):.3f} mag and"
        f" {max(e.max_px(codes.JUDGE) for e in within):.3f} px"
    )


def _draw_magnitudes(path: Path, found: Found, mags: FloatArray) -> None:
    bits = codes.BITS[1]
    limit = codes.AIMS[codes.BITS[1]][1]
    exact, rounded = (_worst(found[bits, name], mags, limit) for name in ("exact", "round"))
    finding = (
        f"On {bits} bits every star to {limit:g} magnitudes under white is within {exact} with"
        f" exact, {rounded} with round"
    )
    note = (
        "Largest errors over sub-pixel phases, sRGB; places by a PSF fit. Dotted: with bit"
        " stealing."
    )
    with chart(path, finding, len(codes.BITS), 2, note=note, share_y="col") as grid:
        for bits, flux, place in zip(codes.BITS, grid[::2], grid[1::2], strict=True):
            aim_mag, limit = codes.AIMS[bits]
            for way in codes.WAYS:
                errors = found[bits, way.name]
                for axes, values in (
                    (flux, [e.flux_max_mag for e in errors]),
                    (place, [e.max_px(codes.JUDGE) for e in errors]),
                ):
                    shown = np.where(np.isfinite(values), np.maximum(values, MIN_ERROR), np.nan)
                    label = way.name.replace("mean of ", "")
                    style = ":" if way.stealing else "-"
                    axes.semilogy(mags, shown, style, color=way.colour, lw=1.5, label=label)
            for axes, aim in ((flux, aim_mag), (place, codes.AIM_PX)):
                axes.plot(
                    [0, limit, limit], [aim, aim, MIN_ERROR], "--", color=INK, lw=1.1, label="_aim"
                )
                axes.annotate(
                    "aim", (0, aim), (2, 3), textcoords="offset points", fontsize=SMALL_PT
                )
            flux.set(title=f"{bits} bits", ylabel="flux error [mag]")
            place.set_ylabel("place error [monitor px]")
            label_ends(place)
        for axes in grid[-2:]:
            axes.set_xlabel("magnitudes under a white peak")


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


def centroider_errors(faintest: dict[tuple[int, str], StarErrors]) -> list[CentroiderErrors]:
    """The errors at the faint end by bits and centroider."""
    rows = []
    for bits, kind in product(codes.BITS, FAMILY):
        rounded = faintest[bits, "round"]
        exact = faintest[bits, "exact"]
        errors_px = rounded.axis_rms_px(kind), exact.axis_rms_px(kind)
        rows.append(CentroiderErrors(bits, kind, *errors_px))
    return rows


def draw_each(path: Path, rows: list[CentroiderErrors]) -> None:
    """The errors of round and exact by each centroider, a panel for each number of bits."""
    shares = [row.share for row in rows]
    finding = (
        f"Whichever centroider the tracker has, exact leaves {min(shares):.2f} to"
        f" {max(shares):.2f} of the error that round makes at the faint end"
    )
    count = len(codes.BITS)
    with chart(path, finding, 1, count, note=EACH_NOTE, share_y=True, height_inch=3.6) as grid:
        for bits, axes in zip(codes.BITS, grid, strict=True):
            of_bits = [row for row in rows if row.bits == bits]
            draw_pairs(axes, EACH_PAIRS, of_bits)
            for place, row in enumerate(of_bits):
                axes.annotate(f"{row.share:.2f}", (row.round_px, place), (6, 0), **BESIDE)
            title = f"{bits} bits, {codes.AIMS[bits][1]:g} mag under white"
            axes.set(title=title, xlabel="error [monitor px]")
            axes.margins(x=0.2, y=0.12)
        name_places(grid[0], FAMILY)
        names = grid[0].get_legend_handles_labels()
        grid[0].figure.legend(*names, loc="outside upper right", ncols=2)


def _draw_times(
    path: Path,
    faintest: dict[tuple[int, str], StarErrors],
    times: dict[tuple[int, str], float],
    load: Load,
) -> None:
    width, height = codes.FRAME_PX
    note = (
        f"{codes.STARS} stars, {width} x {height}. Circles, squares, triangles: 8, 10 and 12 bits,"
        " at the faint end."
    )
    ms = {way.name: times[codes.BITS[1], way.name] for way in codes.WAYS}
    took = f"exact takes {ms['exact']:.1f} ms and round {ms['round']:.1f} ms"
    finding = load.title(f"From light to codes in memory {took}, on {codes.BITS[1]} bits")
    with chart(path, finding, 2, note=load.note(note)) as panels:
        for way in codes.WAYS:
            for bits, marker in MARKERS.items():
                for axes, error in zip(panels, _rms(faintest[bits, way.name]), strict=True):
                    face = "none" if way.stealing else way.colour
                    axes.loglog(
                        times[bits, way.name], error, marker, color=way.colour, mfc=face, ms=8
                    )
        for axes, number, what in zip(
            panels, (0, 1), ("flux error, rms [mag]", "place error, rms [monitor px]"), strict=True
        ):
            axes.set_ylabel(what)
            axes.margins(0.1)
            names = []
            for way in codes.WAYS:
                key = codes.BITS[0], way.name
                place = times[key], _rms(faintest[key])[number]
                names.append((way.name, place, way.colour))
            name_at_side(axes, names)
        panels[-1].set_xlabel("time of a frame [ms]")


def _rms(errors: StarErrors) -> tuple[float, float]:
    return errors.flux_rms_mag, float(np.sqrt(2)) * errors.axis_rms_px(codes.JUDGE)
