"""The budget of a bench's light: the magnitudes that its monitor, sprites and quantisation can
show, and the error of each.

Every error is measured: single stars at a grid of sub-pixel phases through the bench's own method.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hilstar.basics.arrays import IntArray
from hilstar.basics.charts import BLUE, MUTED, ORANGE, RED, SERIES, chart, label_ends, write_csv
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.display.balance import Balance
from hilstar.display.panel import Panel
from hilstar.display.phases import WHITE, fainter, line_places, phase_grid, phase_image, shown_by
from hilstar.display.primaries import PRIMARIES, ChannelMatrix, channel_matrix, reddest_nm
from hilstar.display.quantisers import QUANTISERS
from hilstar.server.bench.frame import Bench, clipping_hip, named
from hilstar.server.bench.monitor import bench_primaries
from hilstar.server.bench.star_rates import named_channels
from hilstar.server.bench.star_size import StarSize, star_size
from hilstar.sky.electrons import Optics, all_channels
from hilstar.sky.spectral_types import class_shares
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge, StarErrors

PHASES = 16  # along a side of a pixel
STEP_MAG = 0.5
MAX_BELOW_WHITE_MAG = 15.0
SOLAR_BV, LIKE_SOLAR_BV = 0.65, 0.1
FLUX_LIMITS_MAG = (0.02, 0.05)
CENTROID_LIMIT_PX = 0.01
USUAL: Centroider = "fit"  # what most trackers do
COMPARED_MAG = 6.0
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
    render = bench.config.render
    white = bench.flux_at_white_e_per_s
    # A star of rate r has V = zero_mag + magnitude(r).
    zero_mag = zero_point_mag(bench)
    white /= solar_drive(bench)
    clips = zero_mag + magnitude(white * bench.darkest / bench.psf.peak_share)
    # Below this a star lights no pixel, wherever it is; for dithers, it lights one in half of the
    # frames.
    dark = (
        bench.faintest_shown_e_per_s / solar_drive(bench)
        or bench.calibration.response.half_step * white
    )
    nothing = zero_mag + magnitude(dark)
    half = np.array([-0.5, 0.5])
    # a star on the corner of four pixels
    corner_share = float(bench.psf.shares(half, half[:, None]).max())
    channels = named_channels(bench.config.tracker, bench.file.folder)
    spectra = bench_primaries(bench.config.monitor, bench.file.folder)
    if spectra is None:
        primaries = None
    else:
        primaries = channel_matrix(spectra, channels, bench.flux_at_white_e_per_s)
    if spectra is None:
        ends_nm = [RED_NM]
    else:
        ends_nm = [RED_NM, reddest_nm(spectra)]
    rows = [_row(bench, mag, errors, by, clips) for mag, errors in errors_by_mag]
    return LightBudget(
        method=render.quantisation
        + (
            " with bit stealing"
            if render.bit_stealing
            else ", each primary"
            if bench.colours
            else ""
        ),
        bits=bench.config.monitor.bits,
        clips_v_mag=clips,
        clips_v_mag_at_best=zero_mag + magnitude(white / corner_share),
        nothing_v_mag=nothing,
        range_mag=nothing - clips,
        within=_within(rows),
        clipped_hip=clipping_hip(bench),
        left_out=not_drawn(bench),
        black_e_per_s_px=bench.calibration.response.black * bench.flux_at_white_e_per_s,
        rows=rows,
        centroider=by,
        centroid_rms_px=next(
            (row.axis_rms_px for row in rows if row.below_white_mag == COMPARED_MAG),
            dict.fromkeys(FAMILY),
        ),
        primaries=primaries,
        near_infrared=red_shares(channels, ends_nm),
        out_of_gamut=out_of_gamut(bench),
        star=star_size(bench.config, bench.file.folder, bench.camera),
    )


def out_of_gamut(bench: Bench) -> float | None:
    """The share of a bench's stars whose colour its primaries cannot show; None where they are
    not driven apart.
    """
    colours = bench.colours
    count = len(bench.stars.rates_e_per_s)
    if colours is None:
        return None
    alone = np.arange(count)
    off = colours.off(colours.wanted(bench.stars, alone), colours.shares_of(bench.stars, alone))
    return float(1 - colours.in_gamut(off).mean())


def red_shares(channels: dict[str, Optics], ends_nm: list[float]) -> list[dict[str, Any]]:
    """The shares of light `from_nm` on `by_class` of spectra, in "all" channels together, and in
    each `channel` of several.
    """
    every = {
        "all": all_channels(list(channels.values())),
        **(channels if len(channels) > 1 else {}),
    }
    return [
        {"channel": name, "from_nm": nm, "by_class": class_shares(channel_shares, nm)}
        for nm in ends_nm
        for name, channel_shares in every.items()
    ]


def zero_point_mag(bench: Bench) -> float:
    """V of a star of the Sun's colour that gives one electron a second, by the bench's own stars of
    about that colour.

    Raises InputError where it has none.
    """
    rates_e_per_s = bench.stars.rates_e_per_s
    alike = _like_the_sun(bench)
    return float(np.median(bench.stars.v_mag[alike] - magnitude(rates_e_per_s[alike])))


def _like_the_sun(bench: Bench) -> IntArray:
    """The stars within LIKE_SOLAR_BV of the Sun's B-V, or else those nearest to it."""
    distance = np.abs(bench.stars.bv_mag[: len(bench.stars.rates_e_per_s)] - SOLAR_BV)
    return np.flatnonzero(distance <= max(LIKE_SOLAR_BV, float(distance.min())))


def solar_drive(bench: Bench) -> float:
    """How much of white a star of the Sun's colour asks for, relative to a white star as bright."""
    return float(np.median(np.broadcast_to(bench.drive, len(bench.stars))[_like_the_sun(bench)]))


def not_drawn(bench: Bench) -> NotDrawn:
    """The bench's stars that are not drawn; bodies, whose light is that of all stars many times
    over, do not count.
    """
    rates = bench.stars.rates_e_per_s
    missing = rates[
        (bench.stars.electrons_per_s * bench.drive)[: len(rates)] < bench.faintest_shown_e_per_s
    ]
    return NotDrawn(len(missing), float(missing.sum() / rates.sum()))


def _errors(bench: Bench) -> list[tuple[float, StarErrors]]:
    """The errors at each magnitude below full scale, down to the first at which a star shows
    nothing.
    """
    target = bench.renderer.target
    frames = bench.config.exposure_frames
    psf = bench.psf
    sprites, _ = phase_grid(PHASES, psf)
    bright = phase_image(sprites, psf)
    judge = Judge(
        bright, line_places(sprites), psf.width_px, target.seen.blur_px, target.seen.pixel_px
    )
    panel = Panel(bench.calibration.response, WHITE)
    balance = Balance(psf, target.seen)
    error_rows = []
    for mag in np.arange(0.0, MAX_BELOW_WHITE_MAG + STEP_MAG / 2, STEP_MAG).tolist():
        wanted = (bright * flux_ratio(mag)).astype(np.float32)
        stars = fainter(sprites, mag)
        kind = QUANTISERS[target.quantisation]
        shown = shown_by(kind, frames, panel, wanted, stars, balance)
        error_rows.append((mag, judge.errors(shown, flux_ratio(mag))))
        if not np.isfinite(error_rows[-1][1].flux_mag).all():
            break
    return error_rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _row(bench: Bench, mag: float, errors: StarErrors, by: By, clips_v_mag: float) -> MagnitudeRow:
    arcsec_per_px = ARCSEC_PER_RAD / bench.camera.scales_px_rad()[0]  # where a pixel is widest
    kind = errors.worst() if by == "all" else by
    max_px = errors.max_px(kind)
    return MagnitudeRow(
        v_mag=clips_v_mag + mag,
        below_white_mag=mag,
        flux_rms_mag=_finite(errors.flux_rms_mag),
        flux_max_mag=_finite(errors.flux_max_mag),
        centroid_rms_px=_finite(math.sqrt(2) * errors.axis_rms_px(kind)),
        centroid_max_px=_finite(max_px),
        centroid_max_arcsec=_finite(max_px * arcsec_per_px),
        axis_rms_px={each: _finite(errors.axis_rms_px(each)) for each in FAMILY},
    )


def _within(rows: list[MagnitudeRow]) -> dict[str, float | None]:
    """The magnitudes below full scale over which the worst star stays within each limit."""

    def reach(values: list[float | None], limit: float) -> float | None:
        good = 0
        while good < len(rows) and (value := values[good]) is not None and value <= limit:
            good += 1
        return rows[good - 1].below_white_mag if good else None

    flux = [row.flux_max_mag for row in rows]
    centroid = [row.centroid_max_px for row in rows]
    limits = {f"{limit:g}_mag": reach(flux, limit) for limit in FLUX_LIMITS_MAG}
    return limits | {f"{CENTROID_LIMIT_PX:g}_px": reach(centroid, CENTROID_LIMIT_PX)}


def write_report(directory: Path, found: LightBudget) -> None:
    """budget.csv, and its chart as budget.png and budget.svg. Raises InputError where one cannot
    be written.
    """
    rows = []
    for row in found.rows:
        columns = asdict(row)
        # each kind of centroider has a column of its own
        for kind, value in columns.pop("axis_rms_px").items():
            columns[f"axis_rms_px_{kind}"] = value
        rows.append(columns)
    write_csv(directory / "budget.csv", list(rows[0]), [list(row.values()) for row in rows])
    reach = found.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    finding = (
        f"{found.bits} bits, {found.method}: from V = {found.clips_v_mag:.1f}, where stars clip,"
        " within "
    )
    finding += (
        f"{FLUX_LIMITS_MAG[1]:g} mag over {'no' if reach is None else f'{reach:g}'} magnitudes"
    )
    shown = [row for row in found.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    note = (
        f"Left of the first grey line stars clip (V = {found.clips_v_mag:.2f}), right of the second"
        " they show nothing (V ="
    )
    note += (
        f" {found.nothing_v_mag:.2f}). Over sub-pixel phases; places by {found.centroider} but in"
        " the last panel."
    )
    with chart(directory / "budget", finding, 3, note=note) as axes:
        for axis, kind, limits, label in (
            (axes[0], "flux", FLUX_LIMITS_MAG, "flux error [mag]"),
            (axes[1], "centroid", (CENTROID_LIMIT_PX,), "place error [monitor px]"),
        ):
            unit = "mag" if kind == "flux" else "px"
            for name, word, colour in (("max", "largest to V", ORANGE), ("rms", "rms", BLUE)):
                values = np.array([getattr(row, f"{kind}_{name}_{unit}") for row in shown])
                if name == "max":
                    values = np.maximum.accumulate(values.astype(float))
                axis.semilogy(v_mag, np.maximum(values, MIN_ERROR), color=colour, label=word)
            for limit in limits:
                axis.axhline(
                    limit, color=RED, linestyle=":", linewidth=1.4, label=f"limit {limit:g} {unit}"
                )
            axis.set_ylabel(label)
        for kind, colour in zip(FAMILY, SERIES, strict=True):
            values = np.array([row.axis_rms_px[kind] for row in shown])
            axes[2].semilogy(
                v_mag,
                np.maximum(values, MIN_ERROR),
                "--" if kind == "fit" else "-",
                color=colour,
                label=kind,
            )
        axes[2].set_ylabel("rms along an axis [monitor px]")
        axes[2].set_xlabel("V of a star of the Sun's colour [mag]")
        for axis in axes:
            for edge in (found.clips_v_mag, found.nothing_v_mag):
                axis.axvline(edge, color=MUTED, linewidth=1)
            label_ends(axis)


def budget_lines(found: LightBudget) -> list[str]:
    """The budget for a person."""
    within = ", ".join(
        f"{_number(value, 'g')} mag within {limit.replace('_', ' ')}"
        for limit, value in found.within.items()
    )
    centroid_text = ", ".join(
        f"{kind} {_number(value, '.4f')}" for kind, value in found.centroid_rms_px.items()
    )
    lines = [
        f"{'method':22}{found.method}, {found.bits} bits",
        (
            f"{'clips at':22}V = {found.clips_v_mag:.2f} in the middle of a pixel,"
            f" {found.clips_v_mag_at_best:.2f} on a corner"
        ),
        (
            f"{'shows nothing':22}from V = {found.nothing_v_mag:.2f}, a range of"
            f" {found.range_mag:.1f} mag"
        ),
        f"{'below full scale':22}{within}",
        f"{'centroider':22}{found.centroider}, in the tracker's pixels after its blur",
        f"{f'{COMPARED_MAG:g} mag below it':22}{centroid_text} px rms along an axis",
        f"{'clipped stars':22}{named(found.clipped_hip, MAX_NAMED)}",
        (
            f"{'not drawn':22}{found.left_out.stars} stars, too faint:"
            f" {found.left_out.flux_share:.2e} of all light"
        ),
        f"{'black':22}{found.black_e_per_s_px:.4g} e-/s in a monitor pixel",
        f"{'in the tracker':22}{found.star.line()}",
    ]
    if found.primaries is not None:
        primaries = found.primaries
        figure = _number(primaries.condition, ".2f")
        lines.append(
            f"{'condition number':22}{figure}, electrons of each channel by each primary at full"
            " light:"
        )
        if found.out_of_gamut is not None:
            if len(primaries.channels) > 1:
                what = "electrons by channel"
            else:
                what = "mean wavelength"
            lines.insert(
                -1,
                f"{'out of gamut':22}{found.out_of_gamut:.2%} of stars, whose {what} the primaries"
                " cannot show",
            )
        for channel, rates in zip(primaries.channels, primaries.e_per_s.tolist(), strict=True):
            shares = (
                f"{name} {rate:.4g} e-/s" for name, rate in zip(PRIMARIES, rates, strict=True)
            )
            lines.append(f"{channel:22}{', '.join(shares)}")
    for red in found.near_infrared:
        by_class = " ".join(f"{kind} {100 * share:.1f}" for kind, share in red["by_class"].items())
        name = f"from {red['from_nm']:.0f} nm, % of e-"
        lines.append(
            f"{name:22}{by_class}" + ("" if red["channel"] == "all" else f"  {red['channel']}")
        )
    every = found.centroider == "all"
    if every:
        kinds = f"{'':4}{''.join(f'{kind:>9}' for kind in FAMILY)}"
    else:
        kinds = f"{'centroid rms':>14}"
    lines += [
        "",
        f"{'V':>6}{'flux rms':>12}{'max mag':>10}{kinds}{'max px':>9}"
        + ("" if every else f"{'max arcsec':>12}"),
    ]
    for row in found.rows:
        rms_mag, max_mag = (_number(mag, ".4f") for mag in (row.flux_rms_mag, row.flux_max_mag))
        line = f"{row.v_mag:6.2f}{rms_mag:>12}{max_mag:>10}"
        if every:
            line += " " * 4 + "".join(
                f"{_number(row.axis_rms_px[kind], '.4f'):>9}" for kind in FAMILY
            )
        else:
            line += f"{_number(row.centroid_rms_px, '.4f'):>14}"
        line += f"{_number(row.centroid_max_px, '.4f'):>9}"
        lines.append(line if every else f"{line}{_number(row.centroid_max_arcsec, '.2f'):>12}")
    return lines


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
