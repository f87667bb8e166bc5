"""The steps with stars on the screen: the scale of the light, and the comparison with sky and twin."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import calibration_source, open_bench
from hilstar.bench.cameras import bench_camera, display_psf, tracker_camera
from hilstar.bench.config import Verify
from hilstar.bench.frame import Bench, Frame
from hilstar.calibrate.first_light.context import (
    MAX_FILL,
    DarkSubtracted,
    Figure,
    StepContext,
    StepNumber,
    StepOutcome,
    Verdict,
)
from hilstar.calibrate.first_light.image_sources import Pattern
from hilstar.calibrate.scale import UNSURE_MAG, MeasuredScale
from hilstar.charts import BLUE, INK, MUTED, SMALL_PT, chart
from hilstar.errors import InputError
from hilstar.monitor.quantise import shown_light
from hilstar.monitor.response import Levels
from hilstar.rotation import to_matrix
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background
from hilstar.twin.verify.summary import summarise
from hilstar.twin.verify.summary import verify as run_twin
from hilstar.units import ARCSEC_PER_RAD, ERROR_OF_MEDIAN, MAG_PER_RELATIVE, magnitude

ATTITUDES, SEED = 40, 3  # random ones, of which the fields with the most stars are shown
FIELDS = 3
MIN_STARS = 5
REACH_PX = 3.0  # tracker px, as in `verify`
ALONE_PX = 10.0
EDGE_PX = 12.0
THRESHOLD_SIGMA = 8.0
BRIGHT_SIGMAS = 60.0  # a star's peak over the noise of a pixel: its own noise is then under 0.02 px
WINDOW_SIGMA_PX, RADIUS_PX = 1.0, 4
WINDOW_PX = (2 * RADIUS_PX + 1) ** 2
SURE_MAG = 0.01  # the noise of a star whose light is judged
# Error beside noise and codes: what the window's sum, the response and the uniformity map leave on a well measured bench.
KNOWN_TO_MAG = 0.004
MOST = 0.5  # a share of the variance this large is named as its cause
FAR = 3.0  # times their errors: more scatter than this has another cause


@dataclass(frozen=True, slots=True)
class ExpectedStars:
    """Stars drawn whole and isolated: places (n, 2), tracker px, and light (n,), e-/s.

    `screen` (n, 2) is the place on the screen, -1 to 1 along each axis; `codes_mag` (n,) how much too faint the codes are.
    """

    place_px: FloatArray
    e_per_s: FloatArray
    screen: FloatArray
    codes_mag: FloatArray


@dataclass(frozen=True, slots=True)
class StarsSeen:
    """Bright isolated stars: their places by the sky (n, 2), tracker px, and the residuals of their images (n, 2).

    `dn` is the light of each (n,), `e_per_s` the light asked for, `noise_mag` its error, infinite where the tracker saturated.
    `screen` (n, 2) is the place on the screen, -1 to 1; `codes_mag` (n,) how much too faint the codes are.
    """

    place_px: FloatArray
    residual_px: FloatArray
    dn: FloatArray
    e_per_s: FloatArray
    noise_mag: FloatArray
    screen: FloatArray
    codes_mag: FloatArray
    lost: int
    images: tuple[Path, ...]

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """A mask of the stars whose light is known well enough (n,)."""
        return self.noise_mag < SURE_MAG

    def scatter(self, off_mag: FloatArray, used: npt.NDArray[np.bool_]) -> "Scatter":
        """The scatter of the used stars' light, `off_mag` (used,) fainter than asked for, and its errors."""
        left = off_mag - self.codes_mag[used]
        left = left - np.median(left)
        error = np.sqrt(self.noise_mag[used] ** 2 + KNOWN_TO_MAG**2)
        x, y = self.screen[used].T
        return Scatter(
            rms_mag=float(np.sqrt((left**2).mean())),
            error_mag=float(np.sqrt((error**2).mean())),
            by_place=_explained(left, x, y, x**2 + y**2),
            by_light=_explained(left, np.log(self.e_per_s[used])),
        )


@dataclass(frozen=True, slots=True)
class Scatter:
    """The rms scatter of stars' light and its expected error, without codes and common zero point.

    `by_place` and `by_light` are the shares of the variance that follow the place on the screen and the light asked for.
    """

    rms_mag: float
    error_mag: float
    by_place: float
    by_light: float

    @property
    def finding(self) -> str:
        """What is wrong and what to do where the scatter is far above its error; else ""."""
        if self.rms_mag <= FAR * self.error_mag:
            return ""
        told = f"the light of stars scatters by {self.rms_mag:.3f} mag rms where they are known to {self.error_mag:.3f}"
        if max(self.by_place, self.by_light) < MOST:
            why = "it follows neither place nor light: look at stray light, local dimming, and whether the light is steady"
        elif self.by_place > self.by_light:
            why = f"{self.by_place:.0%} of it follows the place on the screen: measure that (--again uniformity)"
        else:
            why = (
                f"{self.by_light:.0%} of it follows the light asked for: measure the response (--again photometry, --patches N)"
            )
        return f"{told}; {why}"


def _explained(off: FloatArray, *shapes: FloatArray) -> float:
    """The share of the variance of `off` (n,) that a linear fit of `shapes` (n,) explains, corrected for chance."""
    design = np.stack([np.ones_like(off), *shapes], axis=1)
    free = len(off) - design.shape[1]
    total = float(((off - off.mean()) ** 2).sum())
    if free < 1 or not total:
        return 0.0
    left = off - design @ np.linalg.lstsq(design, off, rcond=None)[0]
    return float(1 - (left**2).sum() / free / (total / (len(off) - 1)))


def see_stars(context: StepContext) -> StarsSeen:
    """Show the bench's own fields of stars and measure them. Raises InputError where too few stars can be compared."""
    with open_bench(context.file) as bench:
        rng, shown = np.random.default_rng(SEED), []
        attitudes = [q / np.linalg.norm(q) for q in rng.normal(size=(ATTITUDES, 4))]
        fullest = sorted(attitudes, key=lambda q: -len(bench.sprites(q)))[:FIELDS]
        for frame in [bench.frame(q) for q in fullest]:
            levels: tuple[Levels, ...] = (frame.levels,)
            exposed = bench.quantiser.exposure(0, bench.config.exposure_frames)  # with `temporal` the frames of an exposure
            if len(exposed) > 1:
                levels = tuple(Levels(bench.draw(frame.q_icrs_to_cam, number).levels.copy()) for number in exposed)
            codes = tuple(bench.code_values(each).astype(np.uint16) for each in levels)
            shown.append((codes, _alone(bench, context, frame, levels)))
    dark_path = context.dark()
    dark = context.read(dark_path)
    fields = [
        _compared(context, context.look(Pattern(f"stars_{number:03}", frames[0], frames[1:]), dark), wanted)
        for number, (frames, wanted) in enumerate(shown)
    ]
    arrays = [field.name for field in dataclasses.fields(StarsSeen) if field.name not in {"lost", "images"}]
    seen = StarsSeen(
        **{name: np.concatenate([getattr(each, name) for each in fields]) for name in arrays},
        lost=sum(each.lost for each in fields),
        images=(dark_path, *(path for each in fields for path in each.images)),
    )
    if len(seen.dn) < MIN_STARS:
        raise InputError(
            f"{len(seen.dn)} bright stars are where the sky has them and {MIN_STARS} are needed; {seen.lost} bright ones are"
            " not there: expose longer, set a fainter [render] brightest_v_mag, or run the geometry again"
        )
    return seen


def _alone(bench: Bench, context: StepContext, frame: Frame, levels: tuple[Levels, ...]) -> ExpectedStars:
    """The isolated stars of a frame that are drawn whole, with their expected places in the tracker's image."""
    camera = tracker_camera(context.file.config.tracker, context.file.folder)
    truth, vectors = frame.rows, bench.stars.directions(frame.star)
    place = np.stack(camera.project(vectors @ to_matrix(frame.q_icrs_to_cam).T), axis=1)
    width, height = camera.resolution_px
    screen = np.stack([truth["x_px"], truth["y_px"]], axis=1)
    limits = np.array(context.resolution_px) - 1 - EDGE_PX
    # No planets: their light is known to 0.05 mag only, and a disc may be wide.
    kept = truth["drawn"] & ~truth["clipped"] & np.isfinite(place).all(axis=1)
    kept &= bench.stars.row[frame.star] >= 0
    kept &= (place > EDGE_PX).all(axis=1) & (place < np.array([width, height]) - 1 - EDGE_PX).all(axis=1)
    kept &= (screen > EDGE_PX).all(axis=1) & (screen < limits).all(axis=1)
    finite = np.where(np.isfinite(place), place, -1e6)
    near = cKDTree(finite).query_ball_point(finite, ALONE_PX, return_length=True)
    kept &= near == 1
    middle = (np.array(context.resolution_px) - 1) / 2
    return ExpectedStars(
        place_px=place[kept],
        e_per_s=truth["electrons_per_s"][kept],
        screen=(screen[kept] - middle) / middle,
        codes_mag=_codes_mag(bench, context, frame, levels, screen[kept]),
    )


def _codes_mag(
    bench: Bench, context: StepContext, frame: Frame, levels: tuple[Levels, ...], screen_px: FloatArray
) -> FloatArray:
    """How much fainter the codes are than the light asked for (n,), magnitudes, within the tracker's window."""
    shown = np.mean([shown_light(each, bench.panel) for each in levels], axis=0)
    geometry = context.geometry()
    reach = math.ceil((RADIUS_PX + 0.5) * geometry.monitor.focal_length_px / geometry.tracker.focal_length_px)
    off = []
    for x, y in np.rint(screen_px).astype(np.intp):
        part = slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1)
        wanted = float(frame.linear[part].sum(dtype=np.float64))
        off.append(magnitude(float(shown[part].sum()) / wanted) if wanted > 0 else 0.0)
    return np.asarray(np.nan_to_num(np.array(off), posinf=0.0))  # such a star is not shown, and will not be found


def _compared(context: StepContext, looked: DarkSubtracted, wanted: ExpectedStars) -> StarsSeen:
    background, spot_px = noisiest_background(looked.image), _spot_sigma_px(context)
    settings = CentroidSettings(
        THRESHOLD_SIGMA, 2, window_sigma_px=WINDOW_SIGMA_PX, window_radius_px=RADIUS_PX, psf_sigma_px=spot_px
    )
    found, noise_dn = find_stars(looked.image, settings, background), background.noise
    seen = np.stack([found.x_px, found.y_px], axis=1)
    count = len(wanted.e_per_s)
    far, nearest = np.full(count, np.inf), np.zeros(count, dtype=np.intp)
    if len(seen) and count:
        far, nearest = (np.asarray(part) for part in cKDTree(seen).query(wanted.place_px))
    near = far < REACH_PX
    matched = near.copy()
    matched[near] = found.peak[nearest[near]] > BRIGHT_SIGMAS * noise_dn
    # A star as bright as the matched ones counts as lost where it is not found.
    faintest = np.median(wanted.e_per_s[matched]) if matched.any() else 0.0
    chosen = nearest[matched]
    dn, gain = found.flux[chosen], context.file.config.tracker.detector.gain_e_per_dn
    noise = np.sqrt(np.maximum(dn, 0.0) / gain + WINDOW_PX * noise_dn**2) / np.maximum(dn, 1e-9)
    # The gain changes from pixel to pixel; a star averages it over its own pixels.
    prnu = context.file.config.tracker.detector.prnu / math.sqrt(4 * math.pi * math.prod(spot_px))
    noise = np.hypot(noise, prnu)
    saturated = found.peak[chosen] > MAX_FILL * context.full_dn - looked.floor_dn
    return StarsSeen(
        place_px=wanted.place_px[matched],
        residual_px=seen[chosen] - wanted.place_px[matched],
        dn=dn,
        e_per_s=wanted.e_per_s[matched],
        noise_mag=np.where(saturated, np.inf, MAG_PER_RELATIVE * noise),
        screen=wanted.screen[matched],
        codes_mag=wanted.codes_mag[matched],
        lost=int((~near & (wanted.e_per_s >= faintest)).sum()),
        images=(looked.path,),
    )


def _spot_sigma_px(context: StepContext) -> tuple[float, float]:
    """The sigma of a star in the tracker's image: its own and the sprite's, (x, y)."""
    geometry = context.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sprite = display_psf(context.file.config, context.file.folder, geometry.monitor)[0].width_px
    x, y = (math.hypot(a, ratio * b) for a, b in zip(context.tracker_psf.width_px, sprite, strict=True))
    return x, y


VERIFY_FIELDS, VERIFY_SEED = 3, 0
LOST_SHARE = 0.1
LIMITS = ("flux_mag", "centroid_px", "lost_share", "black_e_per_s_px")  # keys of [verify], also before a truth
GRID = 21  # places along each side of the screen at which a truth is compared


def verify(context: StepContext) -> StepOutcome:
    """Show stars with the calibrated bench, compare them with the sky, and run the twin. Raises InputError."""
    seen = see_stars(context)
    off_px = np.hypot(*seen.residual_px.T)
    rms_px = float(np.sqrt((off_px**2).mean()))
    figures: dict[str, Figure] = {
        "stars": len(off_px),
        "lost": seen.lost,
        "star_rms_px": rms_px,
        "star_p95_px": float(np.percentile(off_px, 95)),
        "star_max_px": float(off_px.max()),
        "star_rms_arcsec": rms_px * ARCSEC_PER_RAD / context.geometry().tracker.focal_length_px,
    }
    reasons: list[str] = []
    picture, light = context.session / "verify.svg", context.session / "verify-light.svg"
    rms = f"{figures['star_rms_px']:.3f} px ({figures['star_rms_arcsec']:.2f} arcsec) rms"
    width_px = context.file.config.tracker.resolution_px[0]
    draw_residuals(picture, seen.place_px, seen.residual_px, width_px, f"{len(seen.place_px)} stars are {rms} from the sky")
    line = f"{len(seen.place_px)} stars on the screen are {rms} from where the sky has them"
    pictures = [picture]
    if seen.sure.sum() >= MIN_STARS:
        found, finding = _light_figures(context, seen, light)
        figures |= found
        pictures.append(light)
        line += f", and {figures['flux_p95_mag']:.3f} mag from its light (95 % of {figures['flux_stars']})"
        reasons += [finding] if finding else []
    else:
        line += f"; the light of {int(seen.sure.sum())} can be read, too few to judge it"
    reasons += _star_reasons(context, figures)
    twin = summarise(run_twin(_twin_file(context), VERIFY_FIELDS, np.random.default_rng(VERIFY_SEED)))
    reasons += [f"the twin: {reason}" for reason in twin["reasons"]]
    figures |= {
        "twin_passed": str(twin["passed"]).lower(),
        "twin_stars": twin["stars"],
        "twin_zero_point_mag": "not known" if twin["zero_point_mag"] is None else twin["zero_point_mag"],
        "twin_flux_p95_mag": twin["flux_error_mag"].p95 or 0.0,
        "twin_centroid_p95_px": twin["centroid_error_px"].p95 or 0.0,
    }
    if context.truth is not None:
        figures |= _against_truth(context)
        line += (
            f"; against the truth, places are {figures['truth_rms_arcsec']:.2f} arcsec rms off, and stars of the twin"
            f" {figures['twin_flux_p95_mag']:.3f} mag at 95 %"
        )
    line += f": {'; '.join(reasons)}" if reasons else ""
    verdict: Verdict = "failed" if reasons else "done"
    rms_arcsec = float(figures["star_rms_arcsec"])
    error = rms_arcsec / math.sqrt(4 * len(off_px))  # from an rms over two axes
    number = StepNumber(rms_arcsec, error, "arcsec", f"rms distance of {len(off_px)} stars from where the sky has them")
    return StepOutcome(verdict, line, figures, (*pictures, *seen.images), tuple(pictures), number=number)


def _twin_file(context: StepContext) -> BenchFile:
    """The bench file for the twin; in a virtual session with the truth's calibration and geometry as true."""
    truth, file = context.truth, context.file
    if truth is None:
        return file
    monitor, collimator, folder = truth.config.monitor, truth.config.collimator, truth.folder.resolve()
    limits = {name: getattr(file.config.verify, name) for name in LIMITS}
    known = Verify(
        **limits, true_calibration=str(calibration_source(monitor, folder)), true_flux_at_white_e_per_s=_white_e_per_s(truth)
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


def _light_figures(context: StepContext, seen: StarsSeen, picture: Path) -> tuple[dict[str, Figure], str]:
    """The errors of the stars' light without their common zero point, and what is wrong where they scatter too far."""
    gain, exposure_s = context.file.config.tracker.detector.gain_e_per_dn, context.exposure_s
    off = np.asarray(magnitude(seen.dn * gain / (seen.e_per_s * exposure_s)))[seen.sure]
    zero_point = float(np.median(off))
    spread = np.abs(off - zero_point)
    p95 = float(np.percentile(spread, 95))
    finding = f"the light of {len(off)} stars is {p95:.3f} mag from the sky's at 95 %, {zero_point:+.3f} mag in common"
    from_middle = np.hypot(*seen.screen[seen.sure].T)
    draw_light(picture, seen.e_per_s[seen.sure], off, seen.noise_mag[seen.sure], finding, from_middle)
    scatter = seen.scatter(off, seen.sure)
    figures: dict[str, Figure] = {
        "flux_stars": len(off),
        "flux_rms_mag": float(np.sqrt((spread**2).mean())),
        "flux_p95_mag": p95,
        "flux_max_mag": float(spread.max()),
        "flux_zero_point_mag": zero_point,
        "flux_scatter_mag": scatter.rms_mag,
        "flux_error_mag": scatter.error_mag,
        "flux_by_place": scatter.by_place,
    }
    return figures, scatter.finding


def _star_reasons(context: StepContext, figures: dict[str, Figure]) -> list[str]:
    """The limits of [verify] that the stars miss, with advice."""
    limits, found = context.file.config.verify, []
    if float(figures["star_p95_px"]) > limits.centroid_px:
        off = f"stars are {figures['star_p95_px']:.3f} px off at 95 % (limit {limits.centroid_px:g})"
        found.append(f"{off}: run the geometry again")
    if float(figures["lost"]) > LOST_SHARE * (float(figures["lost"]) + float(figures["stars"])):
        found.append(f"{figures['lost']} bright stars are not there")
    if float(figures.get("flux_p95_mag", 0.0)) > limits.flux_mag:
        off = f"the light of stars is {figures['flux_p95_mag']:.3f} mag off at 95 % (limit {limits.flux_mag:g})"
        found.append(f"{off}: measure the response (photometry)")
    if abs(float(figures.get("flux_zero_point_mag", 0.0))) > limits.flux_mag:
        off = f"all stars are {figures['flux_zero_point_mag']:+.3f} mag off (limit {limits.flux_mag:g})"
        found.append(f"{off}: measure what white is worth (scale)")
    return found


def _against_truth(context: StepContext) -> dict[str, Figure]:
    """The error of the directions of places on the screen against the truth.

    Only places that the tracker sees were calibrated; the others have no direction.
    """
    truth = context.truth
    assert truth is not None
    width, height = context.resolution_px
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID)))
    mine, its = (bench_camera(file.config, file.folder).rays(x, y) for file in (context.file, truth))
    mine, its = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (mine, its))
    off = np.linalg.norm(np.cross(mine, its), axis=1) * ARCSEC_PER_RAD
    known = np.isfinite(off)
    if not known.any():
        raise InputError("no place of the screen has a direction both in the bench file and in the truth; look at the truth")
    rms, largest = float(np.sqrt((off[known] ** 2).mean())), float(off[known].max())
    return {"truth_rms_arcsec": rms, "truth_max_arcsec": largest, "truth_share_of_screen": float(known.mean())}


AGREE_SIGMAS = 3.0  # less is no reason to change the bench file
# Error of full scale beside the stars' scatter: nine sessions on six planted benches were 0.002 mag rms from the truth.
SYSTEMATIC_MAG = 0.002


def scale(context: StepContext) -> StepOutcome:
    """Find what white is worth by stars, and set it in the bench file. Raises InputError."""
    seen = see_stars(context)
    white = _white_e_per_s(context.file)
    drawn, _ = display_psf(context.file.config, context.file.folder, context.geometry().monitor)
    used = seen.sure & (seen.e_per_s * drawn.peak_share <= white)
    if used.sum() < MIN_STARS:
        raise InputError(
            f"the light of {used.sum()} stars can be read and {MIN_STARS} are needed; the others of {len(used)} saturate the"
            " tracker, are noisy, or clip on the monitor: look at [tracker] exposure_s and [render] brightest_v_mag"
        )
    wanted, noise_mag = seen.e_per_s[used], seen.noise_mag[used]
    ratios = seen.dn[used] * context.file.config.tracker.detector.gain_e_per_dn / (wanted * context.exposure_s)
    found = MeasuredScale(white * float(np.median(ratios)), white, ratios)
    scatter = seen.scatter(np.asarray(magnitude(ratios)), used)
    by_mag = float(magnitude(found.flux_at_white_e_per_s / white))
    error_mag = float(np.hypot(ERROR_OF_MEDIAN * found.scatter_mag / np.sqrt(len(ratios)), SYSTEMATIC_MAG))
    trend_mag, trend_error_mag = trend(wanted, np.asarray(magnitude(ratios)))
    figures: dict[str, Figure] = {
        "flux_at_white_e_per_s": found.flux_at_white_e_per_s,
        "in_bench_file_e_per_s": white,
        "off_mag": by_mag,
        "error_mag": error_mag,
        "scatter_mag": found.scatter_mag,
        "trend_mag": trend_mag,
        "trend_error_mag": trend_error_mag,
        "stars": len(ratios),
    }
    if context.truth is not None:
        figures["truth_off_mag"] = magnitude(found.flux_at_white_e_per_s / _white_e_per_s(context.truth))
    figures["scatter_error_mag"] = scatter.error_mag
    brighter = f"{abs(by_mag):.3f} +- {error_mag:.3f} mag {'fainter' if by_mag > 0 else 'brighter'} than the bench file has it"
    line = f"white is worth {found.flux_at_white_e_per_s:.4g} e-/s, {brighter}, by {len(ratios)} stars"
    picture = context.session / "scale.svg"
    draw_light(picture, wanted, magnitude(ratios), noise_mag, f"{line}; they agree to {found.scatter_mag:.3f} mag")
    files = (picture, *seen.images)
    error_e_per_s = found.flux_at_white_e_per_s * error_mag / MAG_PER_RELATIVE
    number = StepNumber(found.flux_at_white_e_per_s, error_e_per_s, "e-/s", "light of one pixel at white, in the tracker")
    wrong = [f"they disagree by {found.scatter_mag:.3f} mag"] if found.scatter_mag > UNSURE_MAG else []
    if abs(trend_mag) > max(UNSURE_MAG, AGREE_SIGMAS * trend_error_mag):
        wrong.append(f"from the faintest to the brightest it changes by {abs(trend_mag):.3f} +- {trend_error_mag:.3f} mag")
    if wrong:
        why = "the response is not as the bench file has it (photometry), or the background is not dark; nothing was changed"
        return StepOutcome("failed", f"{line}, but {' and '.join(wrong)}: {why}", figures, files, (picture,), number=number)
    verdict: Verdict = "failed" if scatter.finding else "done"
    line += f", but {scatter.finding}" if scatter.finding else ""
    changes = (
        *context.change("render", "flux_at_white_e_per_s", float(f"{found.flux_at_white_e_per_s:.6g}")),
        *context.change("certify", "flux_at_white_relative", float(f"{error_mag / MAG_PER_RELATIVE:.3g}")),
    )
    agrees = abs(by_mag) < AGREE_SIGMAS * error_mag
    return StepOutcome(verdict, line, figures, files, (picture,), () if agrees else changes, number)


def _white_e_per_s(file: BenchFile) -> float:
    with open_bench(file) as bench:
        return bench.flux_at_white_e_per_s


def trend(e_per_s: FloatArray, off_mag: FloatArray) -> tuple[float, float]:
    """The change of `off_mag` (n,) from the faintest to the brightest star, magnitudes, and its error."""
    x = np.log(e_per_s) - np.log(e_per_s).mean()
    leverage, span = float((x**2).sum()), float(np.ptp(x))
    if leverage <= 0:
        return 0.0, 0.0
    slope = float(x @ off_mag) / leverage
    left = off_mag - off_mag.mean() - slope * x
    sigma = float(np.sqrt((left**2).sum() / max(len(x) - 2, 1)))
    return slope * span, sigma / np.sqrt(leverage) * span


MAX_ARROW_SHARE = 0.06  # relative to the image's width


def draw_light(
    path: Path,
    e_per_s: FloatArray,
    off_mag: FloatArray,
    noise_mag: FloatArray,
    finding: str,
    from_middle: FloatArray | None = None,
) -> None:
    """Draw how much too faint stars are (n,) over the light asked for (n,), and over `from_middle` (n,), half sides."""
    panels = [("light asked for [e-/s]", e_per_s)]
    panels += [] if from_middle is None else [("from the middle of the screen [half sides]", from_middle)]
    with chart(path, finding, panels=len(panels), share_x=False) as drawn:
        for axes, (name, along) in zip(drawn, panels, strict=True):
            axes.errorbar(along, off_mag, noise_mag, fmt="o", markersize=4, color=INK, ecolor=MUTED)
            axes.axhline(float(np.median(off_mag)), color=MUTED, linewidth=0.8)
            axes.invert_yaxis()
            axes.set(xlabel=name, ylabel="fainter than asked for [mag]")
        drawn[0].set_xscale("log")


def draw_residuals(path: Path, place: FloatArray, residual: FloatArray, width_px: int, finding: str) -> None:
    """Draw places (n, 2) of stars on the tracker, and their residuals (n, 2) as arrows."""
    with chart(path, finding, height_inch=6.4) as (axes,):
        largest = max(float(np.hypot(*residual.T).max()), 1e-9)
        look = {"angles": "xy", "scale_units": "xy", "width": 0.003, "color": BLUE}
        arrows = axes.quiver(*place.T, *residual.T, scale=largest / (MAX_ARROW_SHARE * width_px), **look)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axes.quiverkey(arrows, 0.75, 1.03, largest, f"{largest:.3f} px, the longest", **key)
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()
