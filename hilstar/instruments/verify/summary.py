"""`hilstar verify`: the twin over random fields, its figures as JSON and text, the table of
stars and the charts.
"""

import math
from collections.abc import Callable
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, MUTED, RED, SMALL_PT, chart, label_ends, write_csv
from hilstar.basics.error_spread import ErrorSpread, error_spread
from hilstar.basics.rotation import random_attitude
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.quantise import MASK_TURNS
from hilstar.instruments.simulate.star_finder import USUAL
from hilstar.instruments.simulate.twin import Twin
from hilstar.instruments.verify.faulty_fields import FaultyFields, fault_lines
from hilstar.instruments.verify.measure import Comparison, GeometryFit, Star
from hilstar.instruments.verify.verdict import DisplayErrors, Verdict, judge, p95
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.scenario import Scenario
from hilstar.server.bench.star_size import StarSize

MIN_SHARE = 1e-4  # share of the limit at which smaller errors are drawn
ARROW_SHARE = 0.06  # share of the chart's width, for the residual that 95 % of stars are within
GEOMETRY_KEYS = (
    *("scale_error", "rotation_arcsec", "offset_px"),
    *("tilt_deg", "k1", "distortion_px"),
)


def verify(
    file: BenchFile,
    fields: int,
    rng: np.random.Generator,
    on_field: Callable[[int], None] = lambda done: None,
    scenario: Scenario | None = None,
) -> Verdict:
    """Show `fields` random attitudes and judge the bench by them; then each fault of a scenario,
    which is only measured.

    Raises InputError (see `Twin`, `FaultView.prepare`).
    """
    # Separate streams: the noise draws a number of values that depends on the light, and all
    # benches shall see the same fields.
    attitudes, noise, of_faults = rng.spawn(3)
    with Twin(file) as twin:
        comparison = Comparison(twin)
        faulty = None
        if scenario is not None:
            faulty = FaultyFields(twin, scenario, of_faults)
        for number in range(fields):
            q_icrs_to_cam = random_attitude(attitudes)
            first_frame = int(attitudes.integers(0, MASK_TURNS))
            comparison.add(twin.field(q_icrs_to_cam, first_frame), noise)
            on_field(number + 1)
        verdict = judge(comparison.measured())
        if faulty is None:
            return verdict
        return replace(verdict, faults=faulty.seen())


def summarise(verdict: Verdict) -> dict[str, Any]:
    """The figures of a verdict by the keys of --json; centroids in tracker pixels, and arcsec in
    the middle of its field.

    They are as `centroider` finds the stars; `centroid_error_px_by` has those of each kind.
    `black_e_per_s_px` is the glow of the screen's black, electrons per second in a tracker pixel;
    `estimator_floor` the estimator's own errors, of the linear image against the catalogue;
    `codes_alone` those of the codes with all else as assumed; `noisy` the same with all of the
    detector's noise.
    """
    measured = verdict.measured
    errors = verdict.errors
    tally = measured.tally
    centroid_px = errors.centroid_px()
    arcsec_per_px = ARCSEC_PER_RAD / measured.camera.focal_length_px
    noisy_mag = np.abs(np.array(tally.noisy_mag) - errors.zero_point_mag)
    noisy_px = np.array(tally.noisy_px)
    glow = measured.glow
    calibration = measured.calibration
    by_centroider = {}
    for kind, off_px in tally.off_px.items():
        by_centroider[kind] = error_spread(np.array(off_px))
    channels_mag = {}
    channels = measured.config.tracker.quantum_efficiencies
    for key, errors_mag in zip(channels, tally.channels_mag, strict=False):
        channels_mag[key] = error_spread(np.array(errors_mag))

    def spread(name: str) -> ErrorSpread:
        return error_spread(np.abs(errors.of(name)))

    return {
        "fields": measured.field_count,
        "stars": len(errors.stars),
        "flux_error_mag": spread("flux_mag"),
        "centroid_error_px": error_spread(centroid_px),
        "centroid_error_arcsec": error_spread(centroid_px * arcsec_per_px),
        "centroider": measured.config.verify.centroider or USUAL,
        "centroid_error_px_by": by_centroider,
        "lost": len(errors.lost),
        "passed": verdict.passed,
        "reasons": verdict.reasons,
        "blended": tally.blended,
        "clipped": tally.clipped,
        "not_shown": tally.not_shown,
        "at_edge": tally.at_edge,
        "summed": tally.summed,
        "channels_mag": channels_mag,
        "out_of_gamut": tally.out_of_gamut,
        "zero_point_mag": _finite(errors.zero_point_mag),
        **_geometry_keys(errors.geometry),
        "black_e_per_s_px": {"assumed": glow.assumed_e_per_s_px, "seen": glow.seen_e_per_s_px},
        "estimator_floor": {"flux_mag": spread("floor_mag"), "centroid_px": spread("floor_px")},
        "codes_alone": {
            "flux_mag": spread("codes_mag"),
            "centroid_px": spread("codes_px"),
            "zero_point_mag": _finite(errors.codes_zero_point_mag),
        },
        "noisy": {
            "stars": len(noisy_px),
            "flux_mag": error_spread(noisy_mag),
            "centroid_px": error_spread(noisy_px),
        },
        "by_magnitude": _by_magnitude(errors),
        "calibration": {"name": calibration.name, "sha256": calibration.sha256},
        "gl_renderer": measured.gl_renderer,
        "drawn_as_discs": measured.wide_bodies,
        "star": measured.star.keys(),
        "faults": verdict.faults,
    }


def _geometry_keys(fit: GeometryFit | None) -> dict[str, Any]:
    """The keys of how monitor and lens stand, None for each with too few stars."""
    if fit is None:
        return dict.fromkeys(GEOMETRY_KEYS)
    return {
        "scale_error": fit.scale_error,
        "rotation_arcsec": fit.rotation_rad * ARCSEC_PER_RAD,
        "offset_px": fit.offset_px,
        "tilt_deg": tuple(map(math.degrees, fit.tilt_rad)),
        "k1": fit.k1,
        "distortion_px": fit.distortion_px,
    }


def _finite(value: float) -> float | None:
    """The value, or None for what JSON cannot hold."""
    return value if math.isfinite(value) else None


def _by_magnitude(errors: DisplayErrors) -> list[dict[str, Any]]:
    """The errors of the stars of each whole magnitude."""
    rows = []
    v_mag = errors.of("v_mag")
    flux = np.abs(errors.of("flux_mag"))
    centroid = errors.centroid_px()
    first = math.floor(v_mag.min(initial=0.0))
    last = math.ceil(v_mag.max(initial=0.0))
    for low in range(first, last + 1):
        there = (v_mag >= low) & (v_mag < low + 1)
        if not there.any():
            continue
        row: dict[str, Any] = {"v_from": low, "v_to": low + 1, "stars": int(there.sum())}
        row["flux_error_mag"] = error_spread(flux[there])
        row["centroid_error_px"] = error_spread(centroid[there])
        rows.append(row)
    return rows


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """The figures for a person."""

    def three(errors: ErrorSpread) -> str:
        return " / ".join(_number(value) for value in (errors.rms, errors.p95, errors.max))

    noisy = summary["noisy"]
    rest = f"{summary['lost']} lost, {summary['blended']} blended, {summary['clipped']} clipped"
    rest += f", {summary['not_shown']} not shown, {summary['at_edge']} at edge"
    if summary["summed"]:
        rest += f", {summary['summed']} part of a blend"
    centroid_px = three(summary["centroid_error_px"])
    centroid_arcsec = three(summary["centroid_error_arcsec"])
    by_kind = []
    for kind, errors in summary["centroid_error_px_by"].items():
        by_kind.append(f"{kind} {_number(errors.rms)}")
    lines = [
        f"{'stars':20}{summary['stars']} in {summary['fields']} fields; {rest}",
        f"{'flux error':20}{three(summary['flux_error_mag'])} mag (rms / 95 % / max)",
        (
            f"{'centroid error':20}{centroid_px} px, {centroid_arcsec} arcsec, by"
            f" {summary['centroider']}"
        ),
        f"{'by each centroider':20}{', '.join(by_kind)} px rms",
    ]
    for key, errors in summary["channels_mag"].items():
        lines.append(f"{key:21}{three(errors)} mag")
    if summary["channels_mag"]:
        lines.append(f"{'out of gamut':20}{summary['out_of_gamut']} stars, which are not in these")
    noisy_text = f"{three(noisy['flux_mag'])} mag, {three(noisy['centroid_px'])} px"
    lines.append(f"{'with detector noise':20}{noisy_text}")
    for row in summary["by_magnitude"]:
        span = f"V {row['v_from']} to {row['v_to']}"
        lines.append(
            f"{span:>17}   {row['flux_error_mag'].rms:.4f} mag rms,"
            f" {row['centroid_error_px'].rms:.4f} px rms, {row['stars']} stars"
        )
    lines += [f"{'':20}{line}" for line in summary["drawn_as_discs"]]
    lines.append(f"{'star':20}{_star_line(summary['star'])}")
    lines += fault_lines(summary["faults"])
    lines += [f"{'':20}{reason}" for reason in summary["reasons"]]
    verdict = "passed" if summary["passed"] else "NOT passed"
    lines.append(f"{'verdict':20}{verdict}")
    return lines


def _star_line(star: dict[str, Any]) -> str:
    return StarSize(**star).line()


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def write_report(directory: Path, verdict: Verdict) -> None:
    """stars.csv, and the charts errors and field, each as PNG and SVG. Raises InputError where
    one cannot be written.
    """
    errors = verdict.errors
    columns = [column.name for column in fields(Star)]
    write_csv(directory / "stars.csv", columns, map(astuple, errors.stars + errors.lost))
    _draw_field(directory / "field", errors, verdict.measured.camera.resolution_px)
    if errors.stars:
        _draw_errors(directory / "errors", verdict)


def _draw_errors(path: Path, verdict: Verdict) -> None:
    errors = verdict.errors
    limits = verdict.measured.config.verify
    v_mag = errors.of("v_mag")
    flux = errors.of("flux_mag")
    centroid = errors.centroid_px()
    word = "passes" if verdict.passed else "does not pass"
    finding = (
        f"The bench {word}: flux within {p95(np.abs(flux)):.3f} mag, places within"
        f" {p95(centroid):.3f} px, for 95 % of stars"
    )
    note = f"Each point is one of {len(v_mag)} stars. The limit is for 95 % of them."
    with chart(path, finding, 2, note=note) as axes:
        flux_axis, place_axis = axes
        _draw_stars(flux_axis, v_mag, np.abs(flux), limits.flux_mag)
        _draw_stars(place_axis, v_mag, centroid, limits.centroid_px)
        flux_axis.set_ylabel("flux error [mag]")
        place_axis.set_ylabel("place error [tracker px]")
        place_axis.set_xlabel("V [mag]")
        for axis in axes:
            label_ends(axis)


def _draw_stars(axis: Any, v_mag: FloatArray, errors: FloatArray, limit: float) -> None:
    """Stars' errors by magnitude, at least MIN_SHARE of the limit; the limit, and what 95 % of
    stars are within.
    """
    smallest = MIN_SHARE * limit
    drawn = np.maximum(errors, smallest)
    axis.semilogy(v_mag, drawn, ".", color=MUTED, ms=5, alpha=0.7, label="_star")
    axis.axhline(limit, color=RED, linestyle="--", linewidth=1.4, label="limit")
    within = max(p95(errors), smallest)
    axis.axhline(within, color=BLUE, linewidth=1.4, label="95 % of stars")


def _draw_field(path: Path, errors: DisplayErrors, resolution_px: tuple[int, int]) -> None:
    x, y = errors.of("x_px"), errors.of("y_px")
    dx, dy = errors.of("dx_px"), errors.of("dy_px")
    longest = max(p95(np.hypot(dx, dy)), 1e-9)
    arrow_px = ARROW_SHARE * resolution_px[0]
    finding = (
        f"Centroid errors of {len(x)} stars over the tracker's field; {len(errors.lost)} stars are"
        " lost"
    )
    note = f"Arrows are enlarged {arrow_px / longest:.0f} times."
    if errors.lost:
        note += " Red crosses: lost stars."
    with chart(path, finding, note=note, height_inch=7.4) as (axis,):
        axis.plot(x, y, ".", color=MUTED, markersize=3)
        axes_units = {"angles": "xy", "scale_units": "xy", "scale": longest / arrow_px}
        arrows = axis.quiver(x, y, dx, dy, **axes_units, width=0.002, color=BLUE)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axis.quiverkey(arrows, 0.86, 1.03, longest, f"{longest:.2g} px", **key)
        lost_x = [star.x_px for star in errors.lost]
        lost_y = [star.y_px for star in errors.lost]
        axis.plot(lost_x, lost_y, "x", color=RED)
        axis.set_xlim(0, resolution_px[0])
        axis.set_ylim(resolution_px[1], 0)
        axis.set_aspect("equal")
        axis.set_xlabel("x [tracker px]")
        axis.set_ylabel("y [tracker px]")
        if errors.lost:
            axis.annotate(
                "lost", (0.6, 1.015), xycoords="axes fraction", color=RED, fontsize=SMALL_PT
            )
