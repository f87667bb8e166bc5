"""The budget of a bench's light: the magnitudes that its monitor, sprites and quantisation can
show, and the error of each.

Every error is measured: single stars at a grid of sub-pixel phases through the bench's own method.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import BLUE, MUTED, ORANGE, RED, SERIES, chart, label_ends, write_csv
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.display.balance import Balance
from hilstar.display.panel import Panel
from hilstar.display.phases import WHITE, fainter, line_places, phase_grid, phase_image, shown_by
from hilstar.display.primaries import PRIMARIES, ChannelMatrix, channel_matrix, reddest_nm
from hilstar.display.quantisers import QUANTISERS
from hilstar.optics.camera import Camera
from hilstar.server.bench.frame import Bench, clipping_hip, named
from hilstar.server.bench.monitor import bench_primaries
from hilstar.server.bench.star_rates import named_channels
from hilstar.server.bench.star_size import StarSize, star_size
from hilstar.sky.electrons import Optics, all_channels
from hilstar.sky.spectral_types import class_shares
from hilstar.sky.stars import Stars
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge, StarErrors

PHASES = 16  # along a side of a pixel
STEP_MAG = 0.5
MAX_BELOW_WHITE_MAG = 15.0  # darker than the last code of 16 bits, 12 mag
SOLAR_BV, LIKE_SOLAR_BV = 0.65, 0.1  # the Sun's; stars as near to it count as of its colour
FLUX_LIMITS_MAG = (0.02, 0.05)
CENTROID_LIMIT_PX = 0.01
USUAL: Centroider = "fit"  # what most trackers do
COMPARED_MAG = 6.0  # below full scale, where kinds of centroiders are compared
By = Centroider | Literal["all"]
MAX_NAMED = 20
RED_NM = 700.0  # beyond it a monitor has next to no light
MIN_ERROR = 1e-6  # the smallest error that the chart draws


@dataclass(frozen=True, slots=True)
class MagnitudeRow:
    """One magnitude: rms and maximum errors over phases, mag and monitor pixels; None where a star
    shows nothing.

    `centroid_rms_px` and `centroid_max_px` are distances as the budget's centroider finds them;
    `axis_rms_px` has each kind's error along an axis.
    """

    v_mag: float
    below_white_mag: float
    flux_rms_mag: float | None
    flux_max_mag: float | None
    centroid_rms_px: float | None
    centroid_max_px: float | None
    centroid_max_arcsec: float | None
    axis_rms_px: dict[str, float | None]


@dataclass(frozen=True, slots=True)
class NotDrawn:
    """The bench's stars that are too faint to be drawn: how many, and their share of all light."""

    stars: int
    flux_share: float


@dataclass(frozen=True, slots=True)
class LightBudget:
    """The range of stars that a bench can show; its fields are the keys of the JSON object of
    `hilstar budget`.

    Magnitudes are those of a star of the Sun's colour: it clips in the middle of a pixel where the
    screen is darkest (`clips_v_mag`), on a corner of four pixels (`clips_v_mag_at_best`), and shows
    nothing from `nothing_v_mag` on. `within` has the magnitudes below full scale over which the
    worst star stays within each limit. Places in `rows` are as `centroider` finds them, those of
    the worst of its kind if that is `all`; `centroid_rms_px` has the error along an axis that each
    kind finds COMPARED_MAG below full scale.
    """

    method: str
    bits: int
    clips_v_mag: float
    clips_v_mag_at_best: float
    nothing_v_mag: float
    range_mag: float
    within: dict[str, float | None]
    clipped_hip: list[int | str]
    left_out: NotDrawn
    black_e_per_s_px: float
    rows: list[MagnitudeRow]
    centroider: By
    centroid_rms_px: dict[str, float | None]
    primaries: ChannelMatrix | None
    near_infrared: list[dict[str, Any]]
    out_of_gamut: float | None
    star: StarSize

    def __repr__(self) -> str:
        return (
            f"<hilstar budget: {self.method}, {self.bits} bits, stars from V ="
            f" {self.clips_v_mag:.2f} (clips) to {self.nothing_v_mag:.2f} (shows nothing)>"
        )


def budget(bench: Bench, centroider: By | None = None) -> LightBudget:
    """The budget of a bench, places as `centroider` finds them in the tracker's pixels after its
    blur.

    None takes the bench's own. Raises InputError for a bench without stars.
    """
    by = centroider or bench.config.verify.judge or USUAL
    errors_by_mag = _errors(bench)
    white = bench.flux_at_white_e_per_s
    response = bench.calibration.response
    # A star of rate r has V = zero_mag + magnitude(r).
    zero_mag = zero_point_mag(bench.stars)
    white /= solar_drive(bench)
    clips = zero_mag + magnitude(white * bench.darkest / bench.psf.peak_share)
    # Below this a star lights no pixel, wherever it is; for dithers, it lights one in half of the
    # frames.
    faintest_e_per_s = bench.faintest_shown_e_per_s / solar_drive(bench)
    nothing = zero_mag + magnitude(faintest_e_per_s or response.half_step * white)
    half = np.array([-0.5, 0.5])
    # a star on the corner of four pixels
    corner_share = float(bench.psf.shares(half, half[:, None]).max())
    channels = named_channels(bench.config.tracker, bench.file.folder)
    spectra = bench_primaries(bench.config.monitor, bench.file.folder)
    primaries = None
    ends_nm = [RED_NM]
    if spectra is not None:
        primaries = channel_matrix(spectra, channels, bench.flux_at_white_e_per_s)
        ends_nm.append(reddest_nm(spectra))
    rows = [magnitude_row(mag, errors, by, clips, bench.camera) for mag, errors in errors_by_mag]
    axis_rms_px: dict[str, float | None] = dict.fromkeys(FAMILY)
    for row in rows:
        if row.below_white_mag == COMPARED_MAG:
            axis_rms_px = row.axis_rms_px
    return LightBudget(
        method=_method(bench),
        bits=bench.config.monitor.bits,
        clips_v_mag=clips,
        clips_v_mag_at_best=zero_mag + magnitude(white / corner_share),
        nothing_v_mag=nothing,
        range_mag=nothing - clips,
        within=_within(rows),
        clipped_hip=clipping_hip(bench),
        left_out=not_drawn(bench.stars, bench.drive, bench.faintest_shown_e_per_s),
        black_e_per_s_px=response.black * bench.flux_at_white_e_per_s,
        rows=rows,
        centroider=by,
        centroid_rms_px=axis_rms_px,
        primaries=primaries,
        near_infrared=red_shares(channels, ends_nm),
        out_of_gamut=out_of_gamut(bench),
        star=star_size(bench.config, bench.file.folder, bench.camera),
    )


def _method(bench: Bench) -> str:
    """A bench's quantisation, and what drives its subpixels."""
    quantisation = bench.config.render.quantisation
    if bench.config.render.bit_stealing:
        return f"{quantisation} with bit stealing"
    if bench.colours:
        return f"{quantisation}, each primary"
    return quantisation


def out_of_gamut(bench: Bench) -> float | None:
    """The share of a bench's stars whose colour its primaries cannot show; None where they are
    not driven apart.
    """
    colours = bench.colours
    if colours is None:
        return None
    stars = np.arange(len(bench.stars.rates_e_per_s))
    wanted = colours.wanted(bench.stars, stars)
    off = colours.off(wanted, colours.shares_of(bench.stars, stars))
    return float(1 - colours.in_gamut(off).mean())


def red_shares(channels: dict[str, Optics], ends_nm: list[float]) -> list[dict[str, Any]]:
    """The shares of light `from_nm` on `by_class` of spectra, in "all" channels together, and in
    each `channel` of several.
    """
    every = {"all": all_channels(list(channels.values()))}
    if len(channels) > 1:
        every |= channels
    rows = []
    for from_nm in ends_nm:
        for name, optics in every.items():
            by_class = class_shares(optics, from_nm)
            rows.append({"channel": name, "from_nm": from_nm, "by_class": by_class})
    return rows


def zero_point_mag(stars: Stars) -> float:
    """V of a star of the Sun's colour that gives one electron a second, by stars of about that
    colour.
    """
    alike = _like_the_sun(stars)
    zero_mags = stars.v_mag[alike] - magnitude(stars.rates_e_per_s[alike])
    return float(np.median(zero_mags))


def _like_the_sun(stars: Stars) -> IntArray:
    """The stars within LIKE_SOLAR_BV of the Sun's B-V, or else those nearest to it."""
    bv_mag = stars.bv_mag[: len(stars.rates_e_per_s)]
    distance = np.abs(bv_mag - SOLAR_BV)
    return np.flatnonzero(distance <= max(LIKE_SOLAR_BV, float(distance.min())))


def solar_drive(bench: Bench) -> float:
    """How much of white a star of the Sun's colour asks for, relative to a white star as bright."""
    drive = np.broadcast_to(bench.drive, len(bench.stars))
    return float(np.median(drive[_like_the_sun(bench.stars)]))


def not_drawn(stars: Stars, drive: FloatArray | float, faintest_shown_e_per_s: float) -> NotDrawn:
    """The stars that are not drawn, of those that ask for `drive` (n,) of white; bodies, whose
    light is that of all stars many times over, do not count.
    """
    rates = stars.rates_e_per_s
    driven_e_per_s = (stars.electrons_per_s * drive)[: len(rates)]
    missing = rates[driven_e_per_s < faintest_shown_e_per_s]
    flux_share = missing.sum() / rates.sum()
    return NotDrawn(len(missing), float(flux_share))


def _errors(bench: Bench) -> list[tuple[float, StarErrors]]:
    """The errors at each magnitude below full scale, down to the first at which a star shows
    nothing.
    """
    target = bench.renderer.target
    frames = bench.config.exposure_frames
    psf = bench.psf
    sprites, _ = phase_grid(PHASES, psf)
    bright = phase_image(sprites, psf)
    pixels = target.seen
    judge = Judge(bright, line_places(sprites), psf.width_px, pixels.blur_px, pixels.pixel_px)
    panel = Panel(bench.calibration.response, WHITE)
    balance = Balance(psf, pixels)
    kind = QUANTISERS[target.quantisation]
    error_rows = []
    for mag in np.arange(0.0, MAX_BELOW_WHITE_MAG + STEP_MAG / 2, STEP_MAG).tolist():
        ratio = flux_ratio(mag)
        wanted = (bright * ratio).astype(np.float32)
        stars = fainter(sprites, mag)
        shown = shown_by(kind, frames, panel, wanted, stars, balance)
        errors = judge.errors(shown, ratio)
        error_rows.append((mag, errors))
        if not np.isfinite(errors.flux_mag).all():
            break
    return error_rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def magnitude_row(
    mag: float, errors: StarErrors, by: By, clips_v_mag: float, monitor: Camera
) -> MagnitudeRow:
    """The row of stars `mag` magnitudes below full scale, where they clip at `clips_v_mag`."""
    arcsec_per_px = ARCSEC_PER_RAD / monitor.scales_px_rad()[0]  # where a pixel is widest
    kind = errors.worst() if by == "all" else by
    max_px = errors.max_px(kind)
    axis_rms_px: dict[str, float | None] = {}
    for family_kind in FAMILY:
        axis_rms_px[family_kind] = _finite(errors.axis_rms_px(family_kind))
    return MagnitudeRow(
        v_mag=clips_v_mag + mag,
        below_white_mag=mag,
        flux_rms_mag=_finite(errors.flux_rms_mag),
        flux_max_mag=_finite(errors.flux_max_mag),
        centroid_rms_px=_finite(math.sqrt(2) * errors.axis_rms_px(kind)),
        centroid_max_px=_finite(max_px),
        centroid_max_arcsec=_finite(max_px * arcsec_per_px),
        axis_rms_px=axis_rms_px,
    )


def _within(rows: list[MagnitudeRow]) -> dict[str, float | None]:
    """The magnitudes below full scale over which the worst star stays within each limit."""
    flux = [row.flux_max_mag for row in rows]
    centroid = [row.centroid_max_px for row in rows]
    limits = {}
    for limit_mag in FLUX_LIMITS_MAG:
        limits[f"{limit_mag:g}_mag"] = last_within(rows, flux, limit_mag)
    limits[f"{CENTROID_LIMIT_PX:g}_px"] = last_within(rows, centroid, CENTROID_LIMIT_PX)
    return limits


def last_within(rows: list[MagnitudeRow], errors: list[float | None], limit: float) -> float | None:
    """The magnitude below full scale up to which the errors of rows are within a limit; None where
    the first is not.
    """
    within_mag = None
    for row, error in zip(rows, errors, strict=True):
        if error is None or error > limit:
            break
        within_mag = row.below_white_mag
    return within_mag


def write_report(directory: Path, budget: LightBudget) -> None:
    """budget.csv, and its chart as budget.png and budget.svg. Raises InputError where one cannot
    be written.
    """
    rows = []
    for row in budget.rows:
        columns = asdict(row)
        # each kind of centroider has a column of its own
        for kind, value in columns.pop("axis_rms_px").items():
            columns[f"axis_rms_px_{kind}"] = value
        rows.append(columns)
    write_csv(directory / "budget.csv", list(rows[0]), [list(row.values()) for row in rows])
    reach = budget.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    reach_text = "no" if reach is None else f"{reach:g}"
    finding = (
        f"{budget.bits} bits, {budget.method}: from V = {budget.clips_v_mag:.1f}, where stars clip,"
        f" within {FLUX_LIMITS_MAG[1]:g} mag over {reach_text} magnitudes"
    )
    note = (
        f"Left of the first grey line stars clip (V = {budget.clips_v_mag:.2f}), right of the"
        f" second they show nothing (V = {budget.nothing_v_mag:.2f}). Over sub-pixel phases; places"
        f" by {budget.centroider} but in the last panel."
    )
    with chart(directory / "budget", finding, 3, note=note) as axes:
        _draw_errors(axes, budget)
        for axis in axes:
            for edge in (budget.clips_v_mag, budget.nothing_v_mag):
                axis.axvline(edge, color=MUTED, linewidth=1)
            label_ends(axis)


def _draw_errors(axes: Any, budget: LightBudget) -> None:
    """The errors of flux and place, rms and up to each magnitude, and of each kind of centroider,
    on three axes.
    """
    shown = [row for row in budget.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    flux_axis, place_axis, kind_axis = axes
    for axis, name, unit, limits in (
        (flux_axis, "flux", "mag", FLUX_LIMITS_MAG),
        (place_axis, "centroid", "px", (CENTROID_LIMIT_PX,)),
    ):
        largest = np.array([getattr(row, f"{name}_max_{unit}") for row in shown])
        largest = np.maximum.accumulate(largest.astype(float))
        rms = np.array([getattr(row, f"{name}_rms_{unit}") for row in shown])
        for errors, label, colour in ((largest, "largest to V", ORANGE), (rms, "rms", BLUE)):
            axis.semilogy(v_mag, np.maximum(errors, MIN_ERROR), color=colour, label=label)
        for limit in limits:
            label = f"limit {limit:g} {unit}"
            axis.axhline(limit, color=RED, linestyle=":", linewidth=1.4, label=label)
    for kind, colour in zip(FAMILY, SERIES, strict=True):
        errors = np.array([row.axis_rms_px[kind] for row in shown])
        style = "--" if kind == "fit" else "-"
        drawn = np.maximum(errors, MIN_ERROR)
        kind_axis.semilogy(v_mag, drawn, style, color=colour, label=kind)
    flux_axis.set_ylabel("flux error [mag]")
    place_axis.set_ylabel("place error [monitor px]")
    kind_axis.set_ylabel("rms along an axis [monitor px]")
    kind_axis.set_xlabel("V of a star of the Sun's colour [mag]")


def budget_lines(budget: LightBudget) -> list[str]:
    """The budget for a person."""
    within = []
    for limit, reach in budget.within.items():
        within.append(f"{_number(reach, 'g')} mag within {limit.replace('_', ' ')}")
    centroids = []
    for kind, rms_px in budget.centroid_rms_px.items():
        centroids.append(f"{kind} {_number(rms_px, '.4f')}")
    lines = [
        f"{'method':22}{budget.method}, {budget.bits} bits",
        (
            f"{'clips at':22}V = {budget.clips_v_mag:.2f} in the middle of a pixel,"
            f" {budget.clips_v_mag_at_best:.2f} on a corner"
        ),
        (
            f"{'shows nothing':22}from V = {budget.nothing_v_mag:.2f}, a range of"
            f" {budget.range_mag:.1f} mag"
        ),
        f"{'below full scale':22}{', '.join(within)}",
        f"{'centroider':22}{budget.centroider}, in the tracker's pixels after its blur",
        f"{f'{COMPARED_MAG:g} mag below it':22}{', '.join(centroids)} px rms along an axis",
        f"{'clipped stars':22}{named(budget.clipped_hip, MAX_NAMED)}",
        (
            f"{'not drawn':22}{budget.left_out.stars} stars, too faint:"
            f" {budget.left_out.flux_share:.2e} of all light"
        ),
        f"{'black':22}{budget.black_e_per_s_px:.4g} e-/s in a monitor pixel",
        f"{'in the tracker':22}{budget.star.line()}",
    ]
    if budget.primaries is not None:
        lines += _primaries_lines(budget.primaries, budget.out_of_gamut)
    for red in budget.near_infrared:
        by_class = " ".join(f"{kind} {100 * share:.1f}" for kind, share in red["by_class"].items())
        name = f"from {red['from_nm']:.0f} nm, % of e-"
        line = f"{name:22}{by_class}"
        if red["channel"] != "all":
            line += f"  {red['channel']}"
        lines.append(line)
    return [*lines, "", *_magnitude_lines(budget)]


def _primaries_lines(primaries: ChannelMatrix, out_of_gamut_share: float | None) -> list[str]:
    """What each channel of the tracker has of each primary, and how many stars' colours these
    cannot show.
    """
    lines = []
    if out_of_gamut_share is not None:
        what = "electrons by channel" if len(primaries.channels) > 1 else "mean wavelength"
        lines.append(
            f"{'out of gamut':22}{out_of_gamut_share:.2%} of stars, whose {what} the primaries"
            " cannot show"
        )
    condition = _number(primaries.condition, ".2f")
    lines.append(
        f"{'condition number':22}{condition}, electrons of each channel by each primary at full"
        " light:"
    )
    for channel, rates in zip(primaries.channels, primaries.e_per_s.tolist(), strict=True):
        shares = []
        for name, rate in zip(PRIMARIES, rates, strict=True):
            shares.append(f"{name} {rate:.4g} e-/s")
        lines.append(f"{channel:22}{', '.join(shares)}")
    return lines


def _magnitude_lines(budget: LightBudget) -> list[str]:
    """The table of errors by magnitude, with all kinds of centroiders or the budget's."""
    by_kind = budget.centroider == "all"
    titles = f"{'V':>6}{'flux rms':>12}{'max mag':>10}"
    if by_kind:
        names = "".join(f"{kind:>9}" for kind in FAMILY)
        titles += f"{'':4}{names}{'max px':>9}"
    else:
        titles += f"{'centroid rms':>14}{'max px':>9}{'max arcsec':>12}"
    lines = [titles]
    for row in budget.rows:
        rms_mag = _number(row.flux_rms_mag, ".4f")
        max_mag = _number(row.flux_max_mag, ".4f")
        max_px = _number(row.centroid_max_px, ".4f")
        line = f"{row.v_mag:6.2f}{rms_mag:>12}{max_mag:>10}"
        if by_kind:
            line += " " * 4
            for kind in FAMILY:
                line += f"{_number(row.axis_rms_px[kind], '.4f'):>9}"
            line += f"{max_px:>9}"
        else:
            line += f"{_number(row.centroid_rms_px, '.4f'):>14}{max_px:>9}"
            line += f"{_number(row.centroid_max_arcsec, '.2f'):>12}"
        lines.append(line)
    return lines


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
