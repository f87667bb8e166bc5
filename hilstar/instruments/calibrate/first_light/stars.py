"""The steps with stars on the screen: the scale of the light, and the comparison with sky and
twin.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, MUTED, SMALL_PT, chart, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, magnitude
from hilstar.instruments.calibrate.first_light.context import (
    Figure,
    StepContext,
    StepNumber,
    StepOutcome,
    Verdict,
)
from hilstar.instruments.calibrate.first_light.seen_stars import (
    FAR,
    MIN_STARS,
    READ_MAG,
    Beyond,
    StarsSeen,
    see_stars,
)
from hilstar.instruments.calibrate.scale import UNSURE_MAG, MeasuredScale, scale_of
from hilstar.instruments.verify.measure import GlowFit
from hilstar.instruments.verify.summary import summarise
from hilstar.instruments.verify.summary import verify as run_twin
from hilstar.instruments.verify.verdict import Verdict as TwinVerdict
from hilstar.instruments.verify.verdict import judge
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import full_scale_e_per_s
from hilstar.server.bench.cameras import bench_camera, display_psf
from hilstar.server.bench.config import Verify
from hilstar.server.bench.monitor import calibration_source

VERIFY_FIELDS, VERIFY_SEED = 3, 0
LOST_SHARE = 0.1
# keys of [verify], also before a truth
LIMITS = ("flux_mag", "centroid_px", "lost_share", "black_e_per_s_px")
# sigmas that 95 % of distances in two axes, and in one, are within
P95_OF_TWO, P95_OF_ONE = 2.4477, 1.9600
MAX_FRAMES = 25  # of a field that are taken without being asked for
MAX_ASKED_FRAMES = 1000  # of a field: the most that first-light --average takes
GRID = 21  # places along each side of the screen at which a truth is compared
READINGS_FILE = "readings.csv"  # stars and their DN, as `calibrate scale --reading` takes them
BLACK_LEVEL, BLACK_ERROR = "photometry.black_level", "photometry.black_level_error"
AGREE_SIGMAS = 3.0  # less is no reason to change the bench file
# Error of full scale beside the stars' scatter: nine sessions on six planted benches were 0.002 mag
# rms from the truth.
SYSTEMATIC_MAG = 0.002
MAX_ARROW_SHARE = 0.06  # relative to the image's width


def verify(context: StepContext) -> StepOutcome:
    """Show stars with the calibrated bench, compare them with the sky, and run the twin. Raises
    InputError.
    """
    stars_seen = _enough_frames(context)
    count = len(stars_seen.place_px)
    figures = _place_figures(stars_seen, context.geometry().tracker.focal_length_px)
    rms_arcsec = float(figures["star_rms_arcsec"])
    rms = f"{figures['star_rms_px']:.3f} px ({rms_arcsec:.2f} arcsec) rms"
    picture = context.session / "verify.svg"
    draw_residuals(
        picture,
        stars_seen.place_px,
        stars_seen.residual_px,
        context.file.config.tracker.resolution_px[0],
        f"{count} stars are {rms} from the sky",
    )
    line = (
        f"{count} stars on the screen are {rms} from where the sky has them,"
        f" {noise_words(stars_seen.residual_px, stars_seen.place_noise_px)}; beyond it"
        f" {figures['star_beyond_noise_p95_px']:.3f} px at 95 %"
    )
    reasons: list[str] = []
    pictures = [picture]
    sure_stars = int(stars_seen.sure.sum())
    if sure_stars >= MIN_STARS:
        light = context.session / "verify-light.svg"
        light_figures, finding = _light_figures(context, stars_seen, light)
        figures |= light_figures
        pictures.append(light)
        line += (
            f", and {figures['flux_p95_mag']:.3f} mag from its light (95 % of"
            f" {figures['flux_stars']})"
        )
        if finding:
            reasons.append(finding)
    else:
        line += f"; the light of {sure_stars} can be read, too few to judge it"
    is_scattered = bool(reasons)
    limits = context.file.config.verify
    reasons += place_reasons(stars_seen.beyond_px, stars_seen.frames, limits.centroid_px)
    reasons += _star_reasons(figures, limits.flux_mag, is_scattered=is_scattered)
    twin_figures, twin_reasons = _twin_figures(context)
    figures |= twin_figures
    reasons += twin_reasons
    if context.truth is not None:
        figures |= _against_truth(context.file, context.truth)
        line += (
            f"; against the truth, places are {figures['truth_rms_arcsec']:.2f} arcsec rms off, and"
            f" stars of the twin {figures['twin_flux_p95_mag']:.3f} mag at 95 %"
        )
    verdict: Verdict = "done"
    if reasons:
        verdict = "failed"
        line += f": {'; '.join(reasons)}"
    number = StepNumber(
        rms_arcsec,
        rms_arcsec / math.sqrt(4 * count),  # from an rms over two axes
        "arcsec",
        f"rms distance of {count} stars from where the sky has them",
    )
    files = (*pictures, *stars_seen.images)
    return StepOutcome(verdict, line, figures, files, tuple(pictures), number=number)


def _place_figures(seen: StarsSeen, focal_length_px: float) -> dict[str, Figure]:
    """How far stars are from where the sky has them, and how much of that is beyond noise, before
    a tracker of this focal length.
    """
    off_px = np.hypot(*seen.residual_px.T)
    rms_px = float(np.sqrt((off_px**2).mean()))
    noise_px = float(np.sqrt((seen.place_noise_px**2).mean()))
    beyond = seen.beyond_px
    p95_px = float(np.percentile(off_px, 95))
    return {
        "stars": len(off_px),
        "lost": seen.lost,
        "star_rms_px": rms_px,
        "star_p95_px": p95_px,
        "star_max_px": float(off_px.max()),
        "star_rms_arcsec": rms_px * ARCSEC_PER_RAD / focal_length_px,
        "star_noise_px": math.sqrt(2) * noise_px,
        "star_beyond_noise_p95_px": P95_OF_TWO * beyond.sigma,
        "star_beyond_noise_max_px": P95_OF_TWO * beyond.high,
        "frames": seen.frames,
    }


def _twin_figures(context: StepContext) -> tuple[dict[str, Figure], list[str]]:
    """The figures of the twin's own comparison, and what speaks against it."""
    context.stage(f"the twin looks at {VERIFY_FIELDS} fields")
    twin = summarise(_twin(context))
    zero_point_mag: Figure = "not known"
    if twin["zero_point_mag"] is not None:
        zero_point_mag = twin["zero_point_mag"]
    figures: dict[str, Figure] = {
        "twin_passed": str(twin["passed"]).lower(),
        "twin_stars": twin["stars"],
        "twin_zero_point_mag": zero_point_mag,
        "twin_flux_p95_mag": twin["flux_error_mag"].p95 or 0.0,
        "twin_centroid_p95_px": twin["centroid_error_px"].p95 or 0.0,
    }
    return figures, [f"the twin: {reason}" for reason in twin["reasons"]]


def noise_words(residual_px: FloatArray, place_noise_px: FloatArray) -> str:
    """How much of the stars' distances (n, 2) is noise, of which each has (n,) along an axis: all
    where they are no farther off than it makes them.
    """
    rms_px = float(np.sqrt((np.hypot(*residual_px.T) ** 2).mean()))
    noise_px = math.sqrt(2) * float(np.sqrt((place_noise_px**2).mean()))
    if noise_px >= rms_px:
        return f"no more than their noise makes ({noise_px:.3f} px)"
    return f"of which noise is {noise_px:.3f} px"


def _enough_frames(context: StepContext) -> StarsSeen:
    """The stars of as many frames as it takes to tell their places from noise, or as many as
    were asked for.
    """
    stars_seen = see_stars(context, context.frames or 1)
    limit_px = context.file.config.verify.centroid_px
    wanted = frames_for(stars_seen.beyond_px, stars_seen.frames, limit_px)
    if context.frames or context.source.by_hand or not 1 < wanted <= MAX_FRAMES:
        return stars_seen
    return see_stars(context, wanted)


def frames_for(beyond: Beyond, frames: int, limit_px: float) -> int:
    """How many frames would tell whether the stars' places, by `frames` so far off beyond their
    noise, are within the limit at 95 %; those where they tell it.
    """
    limit = limit_px / P95_OF_TWO
    if beyond.high <= limit or beyond.low > limit:
        return frames
    room = limit**2 - beyond.sigma**2
    doubt = beyond.high**2 - beyond.sigma**2
    # the doubt shrinks with the frames; a scatter near the limit itself takes four times as many
    wanted = math.ceil(frames * doubt / max(room, limit**2 / 4))
    return max(wanted, frames + 1)


def place_reasons(beyond: Beyond, frames: int, limit_px: float) -> list[str]:
    """What speaks against the stars' places in so many frames: geometry where they are off beyond
    their noise, or noise that hides it.
    """
    at_least = P95_OF_TWO * beyond.low
    at_most = P95_OF_TWO * beyond.high
    if at_least > limit_px:
        off = (
            f"beyond their noise stars are {P95_OF_TWO * beyond.sigma:.3f} px off at 95 % (limit"
            f" {limit_px:g})"
        )
        return [f"{off}: run the geometry again (--again geometry)"]
    wanted = frames_for(beyond, frames, limit_px)
    if at_most <= limit_px or wanted == frames:
        return []
    cure = "write a longer [tracker] exposure_s"
    if wanted <= MAX_ASKED_FRAMES:
        cure = (
            f"{wanted} frames of each field would tell (--average {wanted}), or a longer [tracker]"
            " exposure_s"
        )
    return [
        f"noise hides whether stars are within {limit_px:g} px: they may be {at_most:.3f} px off at"
        f" 95 %; {cure}"
    ]


def _twin(context: StepContext) -> TwinVerdict:
    """The twin's verdict, its glow by what the session knows of it."""
    file = _twin_file(context.file, context.truth)
    twin_run = run_twin(file, VERIFY_FIELDS, np.random.default_rng(VERIFY_SEED))
    known_glow = _known_glow(twin_run.measured.glow, context.known)
    return judge(dataclasses.replace(twin_run.measured, glow=known_glow))


def _known_glow(glow: GlowFit, figures: Mapping[str, Figure]) -> GlowFit:
    """A glow that is judged no closer than the session knows the black level, and the light of
    white, by which it glows.
    """
    known = float(figures.get("scale.error_mag", 0.0)) / MAG_PER_RELATIVE
    black = float(figures.get(BLACK_LEVEL, 0.0))
    if black > 0:
        known = math.hypot(known, float(figures.get(BLACK_ERROR, 0.0)) / black)
    limit = max(glow.limit_e_per_s_px, AGREE_SIGMAS * known * glow.assumed_e_per_s_px)
    return dataclasses.replace(glow, limit_e_per_s_px=limit)


def _twin_file(file: BenchFile, truth: BenchFile | None) -> BenchFile:
    """The bench file for the twin; in a virtual session with the truth's calibration and
    geometry as true.
    """
    if truth is None:
        return file
    monitor = truth.config.monitor
    collimator = truth.config.collimator
    folder = truth.folder.resolve()
    limits = {name: getattr(file.config.verify, name) for name in LIMITS}
    known = Verify(
        **limits,
        true_calibration=str(calibration_source(monitor, folder)),
        true_flux_at_white_e_per_s=full_scale_e_per_s(truth),
    )
    if collimator.geometry is not None:
        known = replace(known, true_geometry=str(folder / collimator.geometry))
    else:
        known = replace(
            known,
            true_focal_length_mm=collimator.focal_length_mm,
            true_pixel_pitch_um=monitor.pixel_pitch_um,
            true_q_cam_to_mon=collimator.q_cam_to_mon,
        )
    return dataclasses.replace(file, config=replace(file.config, verify=known))


def _light_figures(
    context: StepContext, seen: StarsSeen, picture: Path
) -> tuple[dict[str, Figure], str]:
    """The errors of the stars' light without their common zero point, and what is wrong where
    they scatter too far.
    """
    sure = seen.sure
    asked_e = seen.e_per_s[sure] * context.exposure_s
    seen_e = seen.dn[sure] * context.detector.gain_e_per_dn
    off_mag = np.asarray(magnitude(seen_e / asked_e))
    noise_mag = seen.noise_mag[sure]
    zero_point_mag = float(np.median(off_mag))
    spread_mag = np.abs(off_mag - zero_point_mag)
    p95_mag = float(np.percentile(spread_mag, 95))
    finding = (
        f"the light of {len(off_mag)} stars is {p95_mag:.3f} mag from the sky's at 95 %,"
        f" {zero_point_mag:+.3f} mag in common"
    )
    from_middle = np.hypot(*seen.screen[sure].T)
    draw_light(picture, seen.e_per_s[sure], off_mag, noise_mag, finding, from_middle)
    scatter = seen.scatter(off_mag, sure)
    beyond = Beyond.of(off_mag - zero_point_mag, noise_mag)
    rms_mag = float(np.sqrt((spread_mag**2).mean()))
    figures: dict[str, Figure] = {
        "flux_stars": len(off_mag),
        "flux_rms_mag": rms_mag,
        "flux_p95_mag": p95_mag,
        "flux_max_mag": float(spread_mag.max()),
        "flux_beyond_noise_p95_mag": P95_OF_ONE * beyond.sigma,
        "flux_zero_point_mag": zero_point_mag,
        "flux_scatter_mag": scatter.rms_mag,
        "flux_error_mag": scatter.error_mag,
        "flux_by_place": scatter.by_place,
    }
    return figures, scatter.finding


def _star_reasons(figures: dict[str, Figure], limit_mag: float, *, is_scattered: bool) -> list[str]:
    """The limits that the stars miss, of their light in magnitudes, with advice; not their light
    again where its scatter has been told.
    """
    lost = float(figures["lost"])
    reasons = []
    if lost > LOST_SHARE * (lost + float(figures["stars"])):
        reasons.append(f"{figures['lost']} bright stars are not there")
    beyond_mag = float(figures.get("flux_beyond_noise_p95_mag", 0.0))
    if beyond_mag > limit_mag and not is_scattered:
        reasons.append(
            f"beyond noise the light of stars is {beyond_mag:.3f} mag off at 95 % (limit"
            f" {limit_mag:g}): measure the response (photometry)"
        )
    zero_point_mag = float(figures.get("flux_zero_point_mag", 0.0))
    if abs(zero_point_mag) > limit_mag:
        reasons.append(
            f"all stars are {zero_point_mag:+.3f} mag off (limit {limit_mag:g}): measure what white"
            " is worth (scale)"
        )
    return reasons


def _against_truth(file: BenchFile, truth: BenchFile) -> dict[str, Figure]:
    """The error of the directions of places on the screen against the truth.

    Only places that the tracker sees were calibrated; the others have no direction.
    """
    width, height = file.config.monitor.resolution_px
    columns = np.linspace(0, width - 1, GRID)
    rows = np.linspace(0, height - 1, GRID)
    grid_x, grid_y = np.meshgrid(columns, rows)
    x = grid_x.ravel()
    y = grid_y.ravel()
    fitted = _directions(file, x, y)
    true = _directions(truth, x, y)
    off = np.linalg.norm(np.cross(fitted, true), axis=1) * ARCSEC_PER_RAD
    known = np.isfinite(off)
    if not known.any():
        raise InputError(
            "no place of the screen has a direction both in the bench file and in the truth; look"
            " at the truth"
        )
    rms = float(np.sqrt((off[known] ** 2).mean()))
    largest = float(off[known].max())
    return {
        "truth_rms_arcsec": rms,
        "truth_max_arcsec": largest,
        "truth_share_of_screen": float(known.mean()),
    }


def _directions(file: BenchFile, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Unit directions (n, 3) in cam of places on a bench's screen."""
    rays = bench_camera(file.config, file.folder).rays(x_px, y_px)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def scale(context: StepContext) -> StepOutcome:
    """Find what white is worth by stars, and set it in the bench file. Raises InputError."""
    stars_seen = see_stars(context)
    white = full_scale_e_per_s(context.file)
    drawn = display_psf(context.file.config, context.file.folder, context.geometry().monitor)
    clips = stars_seen.e_per_s * drawn.peak_share > white
    used = (stars_seen.noise_mag < READ_MAG) & ~clips
    if used.sum() < MIN_STARS:
        saturated = int(np.isinf(stars_seen.noise_mag).sum())
        raise InputError(
            f"the light of {used.sum()} stars can be read and {MIN_STARS} are needed; of"
            f" {len(used)}, {saturated} saturate the tracker (a shorter [tracker] exposure_s) and"
            f" {int(clips.sum())} clip on the monitor (a smaller [render] brightest_v_mag)"
        )
    asked = stars_seen.e_per_s[used]
    noise_mag = stars_seen.noise_mag[used]
    seen_e = stars_seen.dn[used] * context.detector.gain_e_per_dn
    ratios = seen_e / (asked * context.exposure_s)
    ratios_mag = np.asarray(magnitude(ratios))
    star_scale = scale_of(white, ratios, noise_mag)
    found_white = star_scale.flux_at_white_e_per_s
    scatter = stars_seen.scatter(ratios_mag, used)
    off_mag = float(magnitude(found_white / white))
    rounding_mag = stars_seen.rounding_mag[used]
    error_mag = _scale_error_mag(star_scale, rounding_mag)
    trend_mag, trend_error_mag = _scale_trend(asked, ratios_mag, star_scale.weights, rounding_mag)
    figures: dict[str, Figure] = {
        "flux_at_white_e_per_s": found_white,
        "in_bench_file_e_per_s": white,
        "off_mag": off_mag,
        "error_mag": error_mag,
        "scatter_mag": star_scale.scatter_mag,
        "trend_mag": trend_mag,
        "trend_error_mag": trend_error_mag,
        "stars": len(ratios),
    }
    if context.truth is not None:
        figures["truth_off_mag"] = magnitude(found_white / full_scale_e_per_s(context.truth))
    figures["scatter_error_mag"] = scatter.error_mag
    direction = "fainter" if off_mag > 0 else "brighter"
    line = (
        f"white is worth {found_white:.4g} e-/s, {abs(off_mag):.3f} +- {error_mag:.3f} mag"
        f" {direction} than the bench file has it, by {len(ratios)} stars"
    )
    picture = context.session / "scale.svg"
    agreement = f"they agree to {star_scale.scatter_mag:.3f} mag"
    draw_light(picture, asked, ratios_mag, noise_mag, f"{line}; {agreement}")
    readings = context.session / READINGS_FILE
    sigma_dn = noise_mag / MAG_PER_RELATIVE * stars_seen.dn[used]
    columns = (stars_seen.hip[used].tolist(), stars_seen.dn[used].tolist(), sigma_dn.tolist())
    write_csv(readings, ("hip", "dn", "sigma_dn"), zip(*columns, strict=True))
    number = StepNumber(
        found_white,
        found_white * error_mag / MAG_PER_RELATIVE,
        "e-/s",
        "light of one pixel at white, in the tracker",
    )
    outcome = StepOutcome(
        "done", line, figures, (picture, readings, *stars_seen.images), (picture,), number=number
    )
    contradictions = _contradictions(
        (star_scale.scatter_mag, scatter.error_mag), (trend_mag, trend_error_mag), error_mag
    )
    if contradictions:
        why = (
            "the response is not as the bench file has it (photometry), or the background is not"
            " dark; nothing was changed"
        )
        line += f", but {' and '.join(contradictions)}: {why}"
        return dataclasses.replace(outcome, verdict="failed", line=line)
    if scatter.finding:
        line += f", but {scatter.finding}"
        outcome = dataclasses.replace(outcome, verdict="failed", line=line)
    if abs(off_mag) < AGREE_SIGMAS * error_mag:
        return outcome
    new_white = float(f"{found_white:.6g}")
    relative = float(f"{error_mag / MAG_PER_RELATIVE:.3g}")
    changes = (
        *context.change("render", "flux_at_white_e_per_s", new_white),
        *context.change("certify", "flux_at_white_relative", relative),
    )
    return dataclasses.replace(outcome, changes=changes)


def _scale_error_mag(star_scale: MeasuredScale, rounding_mag: FloatArray) -> float:
    """The error of full scale: by the readings, by what sessions were off, and by the ADC, which
    rounds all stars (n, phases) by where its one dark level is.
    """
    common_mag = star_scale.weights @ rounding_mag / star_scale.weights.sum()
    rounding_rms_mag = float(np.sqrt((common_mag**2).mean()))
    by_readings_mag = MAG_PER_RELATIVE * (star_scale.relative_error or 0.0)
    return math.hypot(by_readings_mag, SYSTEMATIC_MAG, rounding_rms_mag)


def _scale_trend(
    e_per_s: FloatArray, ratios_mag: FloatArray, weights: FloatArray, rounding_mag: FloatArray
) -> tuple[float, float]:
    """The change of full scale (n,) from the faintest to the brightest star, mag, and its error,
    that by the ADC's rounding of stars (n, phases) in it.
    """
    root = np.sqrt(weights)
    trend_mag, error_mag = trend(e_per_s, ratios_mag, root)
    by_phase_mag = [trend(e_per_s, phase_mag, root)[0] for phase_mag in rounding_mag.T]
    by_rounding_mag = float(np.sqrt(np.mean(np.square(by_phase_mag))))
    return trend_mag, math.hypot(error_mag, by_rounding_mag)


def _contradictions(
    scatter: tuple[float, float], trend_over_light: tuple[float, float], error_mag: float
) -> list[str]:
    """What speaks against a scale that stars agree on: their scatter and their trend over light,
    mag, each with its error, and the scale's own error.
    """
    scatter_mag, scatter_error_mag = scatter
    trend_mag, trend_error_mag = trend_over_light
    contradictions = []
    if scatter_mag > max(UNSURE_MAG, FAR * scatter_error_mag):
        contradictions.append(f"they disagree by {scatter_mag:.3f} mag")
    if error_mag > UNSURE_MAG:
        contradictions.append("they are too noisy: write a longer [tracker] exposure_s")
    if abs(trend_mag) > max(UNSURE_MAG, AGREE_SIGMAS * trend_error_mag):
        contradictions.append(
            f"from the faintest to the brightest it changes by {abs(trend_mag):.3f} +-"
            f" {trend_error_mag:.3f} mag"
        )
    return contradictions


def trend(
    e_per_s: FloatArray, off_mag: FloatArray, weight: FloatArray | float = 1.0
) -> tuple[float, float]:
    """The change of `off_mag` (n,) from the faintest to the brightest star, magnitudes, and its
    error.

    `weight` (n,) is in proportion to one over each star's sigma.
    """
    along = np.log(e_per_s)
    weight = np.broadcast_to(np.asarray(weight, dtype=np.float64), along.shape)
    share = weight**2 / (weight**2).sum()
    x = along - float(share @ along)
    centred_mag = off_mag - float(share @ off_mag)
    leverage = float((share * x**2).sum())
    span = float(np.ptp(along))
    if leverage <= 0:
        return 0.0, 0.0
    slope = float((share * x * centred_mag).sum()) / leverage
    centred_mag = centred_mag - slope * x
    count = len(x)
    square_mag2 = float((share * centred_mag**2).sum())
    variance = square_mag2 * count / max(count - 2, 1)
    alike = 1 / float((share**2).sum())
    return slope * span, math.sqrt(variance / (alike * leverage)) * span


def draw_light(
    path: Path,
    e_per_s: FloatArray,
    off_mag: FloatArray,
    noise_mag: FloatArray,
    finding: str,
    from_middle: FloatArray | None = None,
) -> None:
    """Draw how much too faint stars are (n,) over the light asked for (n,), and over
    `from_middle` (n,), half sides.
    """
    panels = [("light asked for [e-/s]", e_per_s)]
    if from_middle is not None:
        panels.append(("from the middle of the screen [half sides]", from_middle))
    with chart(path, finding, panels=len(panels), share_x=False) as drawn:
        for axes, (name, along) in zip(drawn, panels, strict=True):
            axes.errorbar(along, off_mag, noise_mag, fmt="o", markersize=4, color=INK, ecolor=MUTED)
            axes.axhline(float(np.median(off_mag)), color=MUTED, linewidth=0.8)
            axes.invert_yaxis()
            axes.set(xlabel=name, ylabel="fainter than asked for [mag]")
        drawn[0].set_xscale("log")


def draw_residuals(
    path: Path, place: FloatArray, residual: FloatArray, width_px: int, finding: str
) -> None:
    """Draw places (n, 2) of stars on the tracker, and their residuals (n, 2) as arrows."""
    with chart(path, finding, height_inch=6.4) as (axes,):
        largest = max(float(np.hypot(*residual.T).max()), 1e-9)
        scale = largest / (MAX_ARROW_SHARE * width_px)
        look = {"angles": "xy", "scale_units": "xy", "width": 0.003, "color": BLUE}
        arrows = axes.quiver(*place.T, *residual.T, scale=scale, **look)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axes.quiverkey(arrows, 0.75, 1.03, largest, f"{largest:.3f} px, the longest", **key)
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()
