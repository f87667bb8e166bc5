"""The steps with stars on the screen: the scale of the light, and the comparison with sky and
twin.
"""

import dataclasses
import math
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
from hilstar.instruments.calibrate.scale import UNSURE_MAG, scale_of
from hilstar.instruments.verify.summary import summarise
from hilstar.instruments.verify.summary import verify as run_twin
from hilstar.instruments.verify.verdict import Verdict as TwinVerdict
from hilstar.instruments.verify.verdict import judge
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
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
    off_px = np.hypot(*stars_seen.residual_px.T)
    rms_px = float(np.sqrt((off_px**2).mean()))
    figures: dict[str, Figure] = {
        "stars": len(off_px),
        "lost": stars_seen.lost,
        "star_rms_px": rms_px,
        "star_p95_px": float(np.percentile(off_px, 95)),
        "star_max_px": float(off_px.max()),
        "star_rms_arcsec": rms_px * ARCSEC_PER_RAD / context.geometry().tracker.focal_length_px,
        "star_noise_px": math.sqrt(2) * float(np.sqrt((stars_seen.place_noise_px**2).mean())),
        "star_beyond_noise_p95_px": P95_OF_TWO * stars_seen.beyond_px.sigma,
        "star_beyond_noise_max_px": P95_OF_TWO * stars_seen.beyond_px.high,
        "frames": stars_seen.frames,
    }
    reasons: list[str] = []
    picture = context.session / "verify.svg"
    light = context.session / "verify-light.svg"
    rms = f"{figures['star_rms_px']:.3f} px ({figures['star_rms_arcsec']:.2f} arcsec) rms"
    width_px = context.file.config.tracker.resolution_px[0]
    draw_residuals(
        picture,
        stars_seen.place_px,
        stars_seen.residual_px,
        width_px,
        f"{len(stars_seen.place_px)} stars are {rms} from the sky",
    )
    line = (
        f"{len(stars_seen.place_px)} stars on the screen are {rms} from where the sky has them,"
        f" {noise_words(stars_seen)}"
    )
    line += f"; beyond it {figures['star_beyond_noise_p95_px']:.3f} px at 95 %"
    pictures = [picture]
    if stars_seen.sure.sum() >= MIN_STARS:
        light_figures, finding = _light_figures(context, stars_seen, light)
        figures |= light_figures
        pictures.append(light)
        line += (
            f", and {figures['flux_p95_mag']:.3f} mag from its light (95 % of"
            f" {figures['flux_stars']})"
        )
        reasons += [finding] if finding else []
    else:
        line += f"; the light of {int(stars_seen.sure.sum())} can be read, too few to judge it"
    is_scattered = bool(reasons)
    reasons += place_reasons(stars_seen, context.file.config.verify.centroid_px)
    reasons += _star_reasons(context, figures, is_scattered=is_scattered)
    context.stage(f"the twin looks at {VERIFY_FIELDS} fields")
    twin = summarise(_twin(context))
    reasons += [f"the twin: {reason}" for reason in twin["reasons"]]
    figures |= {
        "twin_passed": str(twin["passed"]).lower(),
        "twin_stars": twin["stars"],
        "twin_zero_point_mag": (
            "not known" if twin["zero_point_mag"] is None else twin["zero_point_mag"]
        ),
        "twin_flux_p95_mag": twin["flux_error_mag"].p95 or 0.0,
        "twin_centroid_p95_px": twin["centroid_error_px"].p95 or 0.0,
    }
    if context.truth is not None:
        figures |= _against_truth(context)
        line += (
            f"; against the truth, places are {figures['truth_rms_arcsec']:.2f} arcsec rms off, and"
            f" stars of the twin {figures['twin_flux_p95_mag']:.3f} mag at 95 %"
        )
    line += f": {'; '.join(reasons)}" if reasons else ""
    verdict: Verdict = "failed" if reasons else "done"
    rms_arcsec = float(figures["star_rms_arcsec"])
    error = rms_arcsec / math.sqrt(4 * len(off_px))  # from an rms over two axes
    number = StepNumber(
        rms_arcsec,
        error,
        "arcsec",
        f"rms distance of {len(off_px)} stars from where the sky has them",
    )
    return StepOutcome(
        verdict, line, figures, (*pictures, *stars_seen.images), tuple(pictures), number=number
    )


def noise_words(seen: StarsSeen) -> str:
    """How much of the stars' distances is noise: all of it where they are no farther off than
    their noise makes them.
    """
    rms_px = float(np.sqrt((np.hypot(*seen.residual_px.T) ** 2).mean()))
    noise_px = math.sqrt(2) * float(np.sqrt((seen.place_noise_px**2).mean()))
    if noise_px >= rms_px:
        return f"no more than their noise makes ({noise_px:.3f} px)"
    return f"of which noise is {noise_px:.3f} px"


def _enough_frames(context: StepContext) -> StarsSeen:
    """The stars of as many frames as it takes to tell their places from noise, or as many as
    were asked for.
    """
    stars_seen = see_stars(context, context.frames or 1)
    wanted = frames_for(stars_seen, context.file.config.verify.centroid_px)
    if context.frames or context.source.by_hand or not 1 < wanted <= MAX_FRAMES:
        return stars_seen
    return see_stars(context, wanted)


def frames_for(seen: StarsSeen, limit_px: float) -> int:
    """How many frames would tell whether the stars' places are within the limit at 95 %; those
    seen where they tell it.
    """
    beyond = seen.beyond_px
    limit = limit_px / P95_OF_TWO
    if beyond.high <= limit or beyond.low > limit:
        return seen.frames
    room = limit**2 - beyond.sigma**2
    doubt = beyond.high**2 - beyond.sigma**2
    return max(math.ceil(seen.frames * doubt / max(room, limit**2 / 4)), seen.frames + 1)


def place_reasons(seen: StarsSeen, limit_px: float) -> list[str]:
    """What speaks against the stars' places: geometry where they are off beyond their noise, or
    noise that hides it.
    """
    beyond = seen.beyond_px
    at_least = P95_OF_TWO * beyond.low
    at_most = P95_OF_TWO * beyond.high
    if at_least > limit_px:
        off = (
            f"beyond their noise stars are {P95_OF_TWO * beyond.sigma:.3f} px off at 95 % (limit"
            f" {limit_px:g})"
        )
        return [f"{off}: run the geometry again (--again geometry)"]
    wanted = frames_for(seen, limit_px)
    if at_most <= limit_px or wanted == seen.frames:
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
    """The twin's verdict; its black level is judged no closer than the session knows it, and the
    light of white, by which it glows.
    """
    twin_run = run_twin(_twin_file(context), VERIFY_FIELDS, np.random.default_rng(VERIFY_SEED))
    glow = twin_run.measured.glow
    figures = context.known
    known = float(figures.get("scale.error_mag", 0.0)) / MAG_PER_RELATIVE
    black = float(figures.get(BLACK_LEVEL, 0.0))
    if black > 0:
        known = math.hypot(known, float(figures.get(BLACK_ERROR, 0.0)) / black)
    limit = max(glow.limit_e_per_s_px, AGREE_SIGMAS * known * glow.assumed_e_per_s_px)
    return judge(
        dataclasses.replace(
            twin_run.measured, glow=dataclasses.replace(glow, limit_e_per_s_px=limit)
        )
    )


def _twin_file(context: StepContext) -> BenchFile:
    """The bench file for the twin; in a virtual session with the truth's calibration and
    geometry as true.
    """
    truth = context.truth
    file = context.file
    if truth is None:
        return file
    monitor = truth.config.monitor
    collimator = truth.config.collimator
    folder = truth.folder.resolve()
    limits = {name: getattr(file.config.verify, name) for name in LIMITS}
    known = Verify(
        **limits,
        true_calibration=str(calibration_source(monitor, folder)),
        true_flux_at_white_e_per_s=_white_e_per_s(truth),
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
    gain = context.file.config.tracker.detector.gain_e_per_dn
    exposure_s = context.exposure_s
    off = np.asarray(magnitude(seen.dn * gain / (seen.e_per_s * exposure_s)))[seen.sure]
    zero_point = float(np.median(off))
    spread = np.abs(off - zero_point)
    p95 = float(np.percentile(spread, 95))
    finding = (
        f"the light of {len(off)} stars is {p95:.3f} mag from the sky's at 95 %, {zero_point:+.3f}"
        " mag in common"
    )
    from_middle = np.hypot(*seen.screen[seen.sure].T)
    draw_light(
        picture, seen.e_per_s[seen.sure], off, seen.noise_mag[seen.sure], finding, from_middle
    )
    scatter = seen.scatter(off, seen.sure)
    figures: dict[str, Figure] = {
        "flux_stars": len(off),
        "flux_rms_mag": float(np.sqrt((spread**2).mean())),
        "flux_p95_mag": p95,
        "flux_max_mag": float(spread.max()),
        "flux_beyond_noise_p95_mag": (
            P95_OF_ONE * Beyond.of(off - zero_point, seen.noise_mag[seen.sure]).sigma
        ),
        "flux_zero_point_mag": zero_point,
        "flux_scatter_mag": scatter.rms_mag,
        "flux_error_mag": scatter.error_mag,
        "flux_by_place": scatter.by_place,
    }
    return figures, scatter.finding


def _star_reasons(
    context: StepContext, figures: dict[str, Figure], *, is_scattered: bool
) -> list[str]:
    """The limits of [verify] that the stars miss, with advice; not their light again where its
    scatter has been told.
    """
    limits = context.file.config.verify
    reasons = []
    if float(figures["lost"]) > LOST_SHARE * (float(figures["lost"]) + float(figures["stars"])):
        reasons.append(f"{figures['lost']} bright stars are not there")
    is_off = float(figures.get("flux_beyond_noise_p95_mag", 0.0)) > limits.flux_mag
    if is_off and not is_scattered:
        off = (
            f"beyond noise the light of stars is {figures['flux_beyond_noise_p95_mag']:.3f} mag off"
            " at 95 %"
        )
        off += f" (limit {limits.flux_mag:g})"
        reasons.append(f"{off}: measure the response (photometry)")
    if abs(float(figures.get("flux_zero_point_mag", 0.0))) > limits.flux_mag:
        off = (
            f"all stars are {figures['flux_zero_point_mag']:+.3f} mag off (limit"
            f" {limits.flux_mag:g})"
        )
        reasons.append(f"{off}: measure what white is worth (scale)")
    return reasons


def _against_truth(context: StepContext) -> dict[str, Figure]:
    """The error of the directions of places on the screen against the truth.

    Only places that the tracker sees were calibrated; the others have no direction.
    """
    truth = context.truth
    assert truth is not None
    width, height = context.resolution_px
    x, y = (
        part.ravel()
        for part in np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    )
    mine, its = (
        bench_camera(file.config, file.folder).rays(x, y) for file in (context.file, truth)
    )
    mine, its = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (mine, its))
    off = np.linalg.norm(np.cross(mine, its), axis=1) * ARCSEC_PER_RAD
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


def scale(context: StepContext) -> StepOutcome:
    """Find what white is worth by stars, and set it in the bench file. Raises InputError."""
    stars_seen = see_stars(context)
    white = _white_e_per_s(context.file)
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
    wanted, noise_mag = stars_seen.e_per_s[used], stars_seen.noise_mag[used]
    ratios = (
        stars_seen.dn[used]
        * context.file.config.tracker.detector.gain_e_per_dn
        / (wanted * context.exposure_s)
    )
    star_scale = scale_of(white, ratios, noise_mag)
    scatter = stars_seen.scatter(np.asarray(magnitude(ratios)), used)
    by_mag = float(magnitude(star_scale.flux_at_white_e_per_s / white))
    # The ADC rounds all stars by where its one dark level is.
    rounding_mag = star_scale.weights @ stars_seen.rounding_mag[used] / star_scale.weights.sum()
    rounding_rms_mag = float(np.sqrt((rounding_mag**2).mean()))
    by_readings_mag = MAG_PER_RELATIVE * (star_scale.relative_error or 0.0)
    error_mag = math.hypot(by_readings_mag, SYSTEMATIC_MAG, rounding_rms_mag)
    weight = np.sqrt(star_scale.weights)
    trend_mag, trend_error_mag = trend(wanted, np.asarray(magnitude(ratios)), weight)
    rounding_trends_mag = [trend(wanted, one, weight)[0] for one in stars_seen.rounding_mag[used].T]
    rounding_trend_mag = float(np.sqrt(np.mean(np.square(rounding_trends_mag))))
    trend_error_mag = math.hypot(trend_error_mag, rounding_trend_mag)
    figures: dict[str, Figure] = {
        "flux_at_white_e_per_s": star_scale.flux_at_white_e_per_s,
        "in_bench_file_e_per_s": white,
        "off_mag": by_mag,
        "error_mag": error_mag,
        "scatter_mag": star_scale.scatter_mag,
        "trend_mag": trend_mag,
        "trend_error_mag": trend_error_mag,
        "stars": len(ratios),
    }
    if context.truth is not None:
        figures["truth_off_mag"] = magnitude(
            star_scale.flux_at_white_e_per_s / _white_e_per_s(context.truth)
        )
    figures["scatter_error_mag"] = scatter.error_mag
    brighter = (
        f"{abs(by_mag):.3f} +- {error_mag:.3f} mag {'fainter' if by_mag > 0 else 'brighter'} than"
        " the bench file has it"
    )
    white_text = f"{star_scale.flux_at_white_e_per_s:.4g} e-/s"
    line = f"white is worth {white_text}, {brighter}, by {len(ratios)} stars"
    picture = context.session / "scale.svg"
    draw_light(
        picture,
        wanted,
        magnitude(ratios),
        noise_mag,
        f"{line}; they agree to {star_scale.scatter_mag:.3f} mag",
    )
    readings = context.session / READINGS_FILE
    sigma_dn = noise_mag / MAG_PER_RELATIVE * stars_seen.dn[used]
    write_csv(
        readings,
        ("hip", "dn", "sigma_dn"),
        zip(
            *(column.tolist() for column in (stars_seen.hip[used], stars_seen.dn[used], sigma_dn)),
            strict=True,
        ),
    )
    files = (picture, readings, *stars_seen.images)
    error_e_per_s = star_scale.flux_at_white_e_per_s * error_mag / MAG_PER_RELATIVE
    number = StepNumber(
        star_scale.flux_at_white_e_per_s,
        error_e_per_s,
        "e-/s",
        "light of one pixel at white, in the tracker",
    )
    unsure_mag = max(UNSURE_MAG, FAR * scatter.error_mag)
    wrong = (
        [f"they disagree by {star_scale.scatter_mag:.3f} mag"]
        if star_scale.scatter_mag > unsure_mag
        else []
    )
    if error_mag > UNSURE_MAG:
        wrong.append("they are too noisy: write a longer [tracker] exposure_s")
    if abs(trend_mag) > max(UNSURE_MAG, AGREE_SIGMAS * trend_error_mag):
        wrong.append(
            f"from the faintest to the brightest it changes by {abs(trend_mag):.3f} +-"
            f" {trend_error_mag:.3f} mag"
        )
    if wrong:
        why = (
            "the response is not as the bench file has it (photometry), or the background is not"
            " dark; nothing was changed"
        )
        return StepOutcome(
            "failed",
            f"{line}, but {' and '.join(wrong)}: {why}",
            figures,
            files,
            (picture,),
            number=number,
        )
    verdict: Verdict = "failed" if scatter.finding else "done"
    line += f", but {scatter.finding}" if scatter.finding else ""
    changes = (
        *context.change(
            "render", "flux_at_white_e_per_s", float(f"{star_scale.flux_at_white_e_per_s:.6g}")
        ),
        *context.change(
            "certify", "flux_at_white_relative", float(f"{error_mag / MAG_PER_RELATIVE:.3g}")
        ),
    )
    agrees = abs(by_mag) < AGREE_SIGMAS * error_mag
    return StepOutcome(verdict, line, figures, files, (picture,), () if agrees else changes, number)


def _white_e_per_s(file: BenchFile) -> float:
    with open_bench(file) as bench:
        return bench.flux_at_white_e_per_s


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
    variance = float((share * centred_mag**2).sum()) * len(x) / max(len(x) - 2, 1)
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
    panels += (
        [] if from_middle is None else [("from the middle of the screen [half sides]", from_middle)]
    )
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
        look = {"angles": "xy", "scale_units": "xy", "width": 0.003, "color": BLUE}
        arrows = axes.quiver(
            *place.T, *residual.T, scale=largest / (MAX_ARROW_SHARE * width_px), **look
        )
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axes.quiverkey(arrows, 0.75, 1.03, largest, f"{largest:.3f} px, the longest", **key)
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()
