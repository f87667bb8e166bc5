"""The steps of light: the monitor's response by lattices of dots, and what white is worth by stars."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench
from hilstar.calibrate.first_light.photometer import Assumed, Photometer, Readings
from hilstar.calibrate.first_light.pictures import draw_light, draw_response_error
from hilstar.calibrate.first_light.records import Change, Figure, Outcome, Verdict
from hilstar.calibrate.first_light.rooms import Room
from hilstar.calibrate.first_light.stars import MIN_STARS, see_stars
from hilstar.calibrate.measurements import PRIMARIES
from hilstar.calibrate.photometric import PhotometricSummary, Provenance, calibrate_photometric, draw_calibration
from hilstar.calibrate.plan import Patch, PlanSettings, plan_patches
from hilstar.calibrate.scale import UNSURE_MAG, Scale
from hilstar.errors import InputError
from hilstar.monitor.calibration import BUILT_IN, Calibration, add_uniformity, load_calibration, primary_lights
from hilstar.monitor.response import Response
from hilstar.scene.psf import peak_share
from hilstar.units import ERROR_OF_MEDIAN, MAG_PER_RELATIVE, magnitude

SEED = 0
PHOTOMETRY_FILES = ("measured.csv", "response.toml", "response.png", "response-before.png")
MIN_LEVELS = 10  # as `calibrate photometric` needs
DIM_LIGHT = 1e-3  # of white: how far down responses are compared
AGREE_SIGMAS = 3.0  # less is no reason to change the bench file
# Of full scale, beside the stars' scatter: nine sessions on six planted benches were 0.002 mag rms from the truth.
SYSTEMATIC_MAG = 0.002


def photometry(room: Room) -> Outcome:
    """Measure the response and name its file in the bench file. Raises InputError."""
    monitor = room.file.config.monitor
    if not room.patches:
        how = "give --patches N, or use a photometer (`hilstar calibrate plan --show`, then `hilstar calibrate photometric`)"
        return Outcome("skipped", f"not measured, the bench file's {monitor.calibration} stays: {how}")
    assumed = calibration_of(room)
    sigma_px = float(room.known.get("focus.psf_sigma_px", np.mean(room.file.config.tracker.psf_sigma_px)))
    channels = "".join(PRIMARIES) if room.file.config.render.bit_stealing else "w"
    planned = plan_for(monitor.bits, room.patches, channels)
    readings = Photometer(room, sigma_px, _assumed(room, assumed, channels)).read(planned)
    measured, output, picture, before = (room.session / name for name in PHOTOMETRY_FILES)
    readings.write(measured)
    instrument = f"the tracker, exposed for {readings.exposure_s:.4g} s, hilstar first-light"
    found = calibrate_photometric(measured, output, Provenance("", "", instrument, "DN/s"), monitor.bits)
    files = [output, output.with_suffix(".csv"), measured, picture, before, *readings.images]
    if assumed.uniformity is not None:
        files.append(add_uniformity(output, assumed.uniformity))
    draw_calibration(measured, picture, monitor.bits)
    written = load_calibration(output, monitor.bits)
    now = written.response
    figures = _response_figures(room, readings, found, assumed.response, now)
    if written.weights is not None:
        figures["shares_of_white"] = ", ".join(f"{n} {share:.4f}" for n, share in zip(channels, written.weights, strict=True))
    off = f"{figures['bench_file_off_rms_mag']:.3f} mag rms, {figures['bench_file_off_max_mag']:.3f} max"
    draw_response_error(before, now, response_error_mag(assumed.response, now), f"The bench file's response is off by {off}")
    return _judged(room, figures, tuple(dict.fromkeys(files)), (picture, before))


def _assumed(room: Room, calibration: Calibration, channels: str) -> Assumed:
    """What the bench file says of each channel."""
    if channels == "w":
        return Assumed({"w": calibration.response.light}, calibration.response.black)
    lights = primary_lights(calibration_source(room.file), room.file.config.monitor.bits)
    return Assumed(dict(zip(channels, lights, strict=True)), calibration.response.black)


def plan_for(bits: int, patches: int, channels: str = "w") -> list[Patch]:
    """The plan of the most levels that has no more than so many patches. Raises InputError where they are too few."""
    best: list[Patch] = []
    for levels in range(MIN_LEVELS, min(patches, 2**bits) + 1):
        planned = plan_patches(PlanSettings(bits, levels, 1, channels), np.random.default_rng(SEED))
        if len(planned) <= patches:
            best = planned
    if not best:
        fewest = len(plan_patches(PlanSettings(bits, MIN_LEVELS, 1, channels), np.random.default_rng(SEED)))
        raise InputError(f"--patches {patches}: a response needs {fewest} or more; write that, or 0 for none")
    return best


def calibration_of(room: Room) -> Calibration:
    """The monitor's light as the bench file has it, code by code."""
    return load_calibration(calibration_source(room.file), room.file.config.monitor.bits)


def calibration_source(file: BenchFile) -> str | Path:
    """What [monitor] calibration names: a built-in name, or a path."""
    name = file.config.monitor.calibration
    return name if name in BUILT_IN else file.folder / name


def _response_figures(
    room: Room, readings: Readings, found: PhotometricSummary, before: Response, now: Response
) -> dict[str, Figure]:
    off = response_error_mag(before, now)
    first = found.first
    figures: dict[str, Figure] = {
        "gamma": exponent(now),
        "gamma_in_bench_file": exponent(before),
        "bench_file_off_rms_mag": float(np.sqrt((off**2).mean())),
        "bench_file_off_max_mag": float(np.abs(off).max()),
        "black_level": now.black,
        "black_level_in_bench_file": before.black,
        "black_level_measured": "yes" if readings.black_known else "no: give --dark, an image with the monitor switched off",
        "held_out_rms_mag": max(each.holdout.rms_mag for each in found.channels.values()),
        "held_out_p95_mag": max(MAG_PER_RELATIVE * each.holdout.p95_percent / 100 for each in found.channels.values()),
        "held_out_max_mag": max(each.holdout.max_mag for each in found.channels.values()),
        "noise_percent": 100 * found.noise_relative,
        "drift_percent": float("nan") if found.drift_percent is None else found.drift_percent,
        "patches": len(readings.patches),
        "codes": first.codes,
        "exposure_s": readings.exposure_s,
        "links": ", ".join(f"{link.ratio:.4f}" for link in readings.links) or "none",
        "links_max_mag": max((abs(float(magnitude(link.ratio))) for link in readings.links), default=0.0),
        **{f"error_at_{decade}_percent": value for decade, value in first.error_percent.items()},
    }
    if room.truth is not None:
        true = load_calibration(calibration_source(room.truth), room.truth.config.monitor.bits).response
        figures["truth_max_mag"] = float(np.abs(response_error_mag(now, true)).max())
        figures["truth_black_level"] = true.black
    return figures


def _judged(room: Room, figures: dict[str, Figure], files: tuple[Path, ...], pictures: tuple[Path, ...]) -> Outcome:
    """Done, with the response named in the bench file, unless it is not known as well as [verify] needs it."""
    limit_mag = room.file.config.verify.flux_mag
    monitor = room.file.config.monitor
    line = (
        f"the bench file's {monitor.calibration} is off by {figures['bench_file_off_rms_mag']:.3f} mag rms,"
        f" {figures['bench_file_off_max_mag']:.3f} max (gamma {figures['gamma']:.3f}, not"
        f" {figures['gamma_in_bench_file']:.3f});"
        f" measured: held-out levels {figures['held_out_rms_mag']:.4f} mag rms, {figures['held_out_max_mag']:.4f} max;"
        f" black {figures['black_level']:.2e} of white"
        f"{'' if figures['black_level_measured'] == 'yes' else ' as the bench file has it, not measured (--dark)'}"
    )
    if float(figures["links_max_mag"]) > limit_mag:
        why = "switch off dynamic contrast and local dimming, or is the tracker not linear?"
        line = f"dense and sparse dots of one code differ by {figures['links_max_mag']:.3f} mag: {why}"
        return Outcome("failed", line, figures, files, pictures)
    if float(figures["held_out_p95_mag"]) > limit_mag:
        why = "take more readings (--patches), look at stray light, and at whether the monitor was warm"
        return Outcome("failed", f"{line}: the levels do not make one smooth response; {why}", figures, files, pictures)
    name = os.path.relpath(room.session / "response.toml", room.file.folder)
    changes = (
        ()
        if monitor.calibration == name
        else (Change(table="monitor", key="calibration", before=monitor.calibration, after=name),)
    )
    return Outcome("done", line, figures, files, pictures, changes)


def scale(room: Room) -> Outcome:
    """Find what white is worth by stars, and set it in the bench file. Raises InputError."""
    seen = see_stars(room)
    white = _white_e_per_s(room.file)
    used = seen.sure & (seen.e_per_s * peak_share(room.file.config.render.sprite_sigma_px) <= white)
    if used.sum() < MIN_STARS:
        raise InputError(
            f"the light of {used.sum()} stars can be read and {MIN_STARS} are needed; the others of {len(used)} saturate the"
            " tracker, are noisy, or clip on the monitor: look at [tracker] exposure_s and [render] brightest_v_mag"
        )
    wanted, noise_mag = seen.e_per_s[used], seen.noise_mag[used]
    ratios = seen.dn[used] * room.file.config.tracker.detector.gain_e_per_dn / (wanted * room.exposure_s)
    found = Scale(white * float(np.median(ratios)), white, ratios)
    scatter = seen.scatter(np.asarray(magnitude(ratios)), used)
    figures = _scale_figures(room, found, wanted) | {"scatter_error_mag": scatter.error_mag}
    by_mag, error_mag = float(figures["off_mag"]), float(figures["error_mag"])
    brighter = f"{abs(by_mag):.3f} +- {error_mag:.3f} mag {'fainter' if by_mag > 0 else 'brighter'} than the bench file has it"
    line = f"white is worth {found.flux_at_white_e_per_s:.4g} e-/s, {brighter}, by {len(ratios)} stars"
    picture = room.session / "scale.png"
    draw_light(picture, wanted, magnitude(ratios), noise_mag, f"{line}; they agree to {found.scatter_mag:.3f} mag")
    files, wrong = (picture, *seen.images), _disagreement(figures)
    if wrong:
        why = "the response is not as the bench file has it (photometry), or the background is not dark; nothing was changed"
        return Outcome("failed", f"{line}, but {wrong}: {why}", figures, files, (picture,))
    verdict: Verdict = "failed" if scatter.finding else "done"
    line += f", but {scatter.finding}" if scatter.finding else ""
    if abs(by_mag) < AGREE_SIGMAS * error_mag:
        return Outcome(verdict, line, figures, files, (picture,))
    key, value = "flux_at_white_e_per_s", float(f"{found.flux_at_white_e_per_s:.6g}")
    change = Change(table="render", key=key, before=room.file.config.render.flux_at_white_e_per_s, after=value)
    return Outcome(verdict, line, figures, files, (picture,), (change,))


def _white_e_per_s(file: BenchFile) -> float:
    with open_bench(file) as bench:
        return bench.flux_at_white_e_per_s


def _scale_figures(room: Room, found: Scale, e_per_s: FloatArray) -> dict[str, Figure]:
    off_mag = np.asarray(magnitude(found.ratios))
    trend_mag, trend_error_mag = trend(e_per_s, off_mag)
    figures: dict[str, Figure] = {
        "flux_at_white_e_per_s": found.flux_at_white_e_per_s,
        "in_bench_file_e_per_s": found.assumed_e_per_s,
        "off_mag": magnitude(found.flux_at_white_e_per_s / found.assumed_e_per_s),
        "error_mag": float(np.hypot(ERROR_OF_MEDIAN * found.scatter_mag / np.sqrt(len(off_mag)), SYSTEMATIC_MAG)),
        "scatter_mag": found.scatter_mag,
        "trend_mag": trend_mag,
        "trend_error_mag": trend_error_mag,
        "stars": len(off_mag),
    }
    if room.truth is not None:
        figures["truth_off_mag"] = magnitude(found.flux_at_white_e_per_s / _white_e_per_s(room.truth))
    return figures


def _disagreement(figures: dict[str, Figure]) -> str:
    """Why the stars tell no one scale; "" where they do."""
    scatter, trend_mag, error = (float(figures[name]) for name in ("scatter_mag", "trend_mag", "trend_error_mag"))
    wrong = [f"they disagree by {scatter:.3f} mag"] if scatter > UNSURE_MAG else []
    if abs(trend_mag) > max(UNSURE_MAG, AGREE_SIGMAS * error):
        wrong.append(f"from the faintest to the brightest it changes by {abs(trend_mag):.3f} +- {error:.3f} mag")
    return " and ".join(wrong)


def trend(e_per_s: FloatArray, off_mag: FloatArray) -> tuple[float, float]:
    """How much more stars are off at the brightest than at the faintest, magnitudes, and its error, of light (n,)."""
    x = np.log(e_per_s) - np.log(e_per_s).mean()
    leverage, span = float((x**2).sum()), float(np.ptp(x))
    if leverage <= 0:
        return 0.0, 0.0
    slope = float(x @ off_mag) / leverage
    left = off_mag - off_mag.mean() - slope * x
    sigma = float(np.sqrt((left**2).sum() / max(len(x) - 2, 1)))
    return slope * span, sigma / np.sqrt(leverage) * span


def response_error_mag(assumed: Response, true: Response) -> FloatArray:
    """How much fainter the codes really are (n,), magnitudes, from three decades below white up to it; both code by code."""
    seen = true.light[1:] >= DIM_LIGHT
    return np.asarray(magnitude(true.light[1:][seen] / assumed.light[1:][seen]))


def exponent(response: Response) -> float:
    """The power of the signal that the light follows, fitted to its logarithm over three decades."""
    light = response.light[1:]
    used = light >= DIM_LIGHT
    signal = np.arange(1, len(response.light))[used] / response.white
    return float(np.polyfit(np.log(signal), np.log(light[used]), 1)[0])
