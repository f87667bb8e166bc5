"""The step of photometry: the tracker as a photometer, by dots on lattices that do not saturate
it.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import INK, MUTED, chart
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAG_PER_RELATIVE, magnitude
from hilstar.display.calibration import (
    add_uniformity,
    load_calibration,
    primary_lights,
    primary_responses,
    read_toml,
)
from hilstar.display.primaries import channel_matrix
from hilstar.display.response import Response
from hilstar.instruments.calibrate.first_light.context import (
    Figure,
    StepContext,
    StepNumber,
    StepOutcome,
    calibration_of,
)
from hilstar.instruments.calibrate.first_light.photometer import (
    LONGEST_S,
    Assumed,
    Photometer,
    Readings,
)
from hilstar.instruments.calibrate.measurements import PRIMARIES
from hilstar.instruments.calibrate.photometric import (
    Provenance,
    calibrate_photometric,
    draw_calibration,
)
from hilstar.instruments.calibrate.plan import Patch, PlanSettings, plan_patches
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.bench_config import drives_apart
from hilstar.server.bench.monitor import bench_calibration, bench_primaries, calibration_source
from hilstar.server.bench.star_rates import named_channels
from hilstar.tracker.settings import DetectorSettings

SEED = 0
PHOTOMETRY_FILES = ("measured.csv", "response.toml", "response.svg", "response-before.svg")
MIN_LEVELS = 10  # as `calibrate photometric` needs
DITHER_DN = 0.4  # of read noise: the mean of rounded values is then off by 0.02 DN at most
PAIRS = 2  # of images, by which two ranges are compared
SURE_SIGMAS = 3.0  # beyond which noise does not explain a deviation
DIM_LIGHT = 1e-3  # relative to white: how far down responses are compared


def photometry(context: StepContext) -> StepOutcome:
    """Measure the response and name its file in the bench file. Raises InputError."""
    monitor = context.monitor
    if not context.patches:
        how = (
            "give --patches N, or use a photometer (`hilstar calibrate plan --show`, then `hilstar"
            " calibrate photometric`)"
        )
        return StepOutcome(
            "skipped", f"not measured, the bench file's {monitor.calibration} stays: {how}"
        )
    assumed = calibration_of(context)
    by_channel = _assumed_light(context.file, assumed.response)
    channels = "".join(by_channel)
    planned = plan_for(monitor.bits, context.patches, channels)
    light = Assumed(by_channel, assumed.response.black)
    photometer = Photometer(context, context.psf_sigma_px, light, PAIRS, LONGEST_S)
    readings = photometer.read(planned)
    measured, output, picture, before = (context.session / name for name in PHOTOMETRY_FILES)
    readings.write(measured)
    instrument = f"the tracker, exposed for {readings.exposure_s:.4g} s, hilstar first-light"
    calibration = calibrate_photometric(
        measured,
        output,
        Provenance("", "", instrument, "DN/s"),
        monitor.bits,
        context.source.monitor,
    )
    files = [output, output.with_suffix(".csv"), measured, picture, before, *readings.images]
    if assumed.uniformity is not None:
        files.append(add_uniformity(output, assumed.uniformity, assumed.uniformity_relative))
    draw_calibration(measured, picture, monitor.bits)
    written = load_calibration(output, monitor.bits)
    now = written.response
    errors = read_toml(output).errors
    black_error = 0.0
    if errors is not None:
        black_error = errors.black
    responses = (assumed.response, now)
    figures = _response_figures(context.truth, readings, calibration, responses, black_error)
    if written.weights is not None:
        shares = []
        for name, share in zip(channels, written.weights, strict=True):
            shares.append(f"{name} {share:.4f}")
        figures["shares_of_white"] = ", ".join(shares)
    _draw_before(before, figures, responses)
    return _judged(context, figures, tuple(dict.fromkeys(files)), (picture, before))


def _assumed_light(file: BenchFile, response: Response) -> dict[str, FloatArray]:
    """Light above black by channel and code, relative to white, as the bench file has it: of the
    primaries where the bench drives them apart, or one by one; else of white.
    """
    monitor = file.config.monitor
    source = calibration_source(monitor, file.folder)
    if drives_apart(file.config):
        light = {}
        responses = primary_responses(source, monitor.bits)
        for name, share, primary in zip(PRIMARIES, shares_of_white(file), responses, strict=True):
            light[name] = share * primary.light
        return light
    if file.config.render.bit_stealing:
        return dict(zip(PRIMARIES, primary_lights(source, monitor.bits), strict=True))
    return {"w": response.light}


def _draw_before(
    picture: Path, figures: dict[str, Figure], responses: tuple[Response, Response]
) -> None:
    """Draw how far the bench file's response is off the measured one."""
    before, now = responses
    off_mag = response_error_mag(before, now)
    rms = f"{figures['bench_file_off_rms_mag']:.3f} mag rms"
    largest = f"{figures['bench_file_off_max_mag']:.3f} max"
    with chart(picture, f"The bench file's response is off by {rms}, {largest}") as (axes,):
        axes.plot(now.light[-len(off_mag) :], off_mag, color=INK)
        axes.axhline(0, color=MUTED, linewidth=0.8)
        axes.set_xscale("log")
        axes.set(
            xlabel="measured light over white [share]",
            ylabel="fainter than in the bench file [mag]",
        )
        axes.invert_yaxis()


def plan_for(bits: int, patches: int, channels: str = "w") -> list[Patch]:
    """The plan with the most levels that has at most `patches` patches. Raises InputError where
    they are too few.
    """
    plans = []
    most_levels = max(MIN_LEVELS, min(patches, 2**bits))
    for levels in range(MIN_LEVELS, most_levels + 1):
        settings = PlanSettings(bits, levels, 1, channels)
        plans.append(plan_patches(settings, np.random.default_rng(SEED)))
    fewest = len(plans[0])
    if fewest > patches:
        raise InputError(
            f"--patches {patches}: a response needs {fewest} or more; write that, or 0 for none"
        )
    return [planned for planned in plans if len(planned) <= patches][-1]


def shares_of_white(file: BenchFile) -> FloatArray:
    """Each primary's share (3,) of the electrons of white, by the spectra of a bench file.
    Raises InputError.
    """
    primaries = bench_primaries(file.config.monitor, file.folder)
    if primaries is None:
        raise InputError(
            "[monitor.primaries] file: first-light measures each primary's light; write it, or xy_r"
            " to xy_b"
        )
    channels = named_channels(file.config.tracker, file.folder)
    matrix = channel_matrix(primaries, channels, 1.0)
    return np.asarray(matrix.e_per_s.sum(axis=0))


def _response_figures(
    truth: BenchFile | None,
    readings: Readings,
    found: dict[str, Any],
    responses: tuple[Response, Response],
    black_error: float,
) -> dict[str, Figure]:
    """The figures of a response: against the bench file's, its black level, held-out levels, and
    how ranges compare.
    """
    before, now = responses
    off_mag = response_error_mag(before, now)
    black_measured = "no: give --dark, an image with the monitor switched off"
    if readings.black_known:
        black_measured = "yes"
    drift_percent = math.nan
    if found["drift_percent"] is not None:
        drift_percent = found["drift_percent"]
    holdouts = [channel["holdout"] for channel in found["channels"].values()]
    p95_percent = max(holdout["p95_percent"] for holdout in holdouts)
    ratios = [f"{link.ratio:.4f}" for link in readings.links]
    links_mag = [abs(float(magnitude(link.ratio))) for link in readings.links]
    links_sigmas = [link.sigmas for link in readings.links]
    off_rms_mag = float(np.sqrt((off_mag**2).mean()))
    off_max_mag = float(np.abs(off_mag).max())
    held_out_rms_mag = max(holdout["rms_mag"] for holdout in holdouts)
    held_out_max_mag = max(holdout["max_mag"] for holdout in holdouts)
    held_out_sigmas = max(holdout["p95_sigmas"] for holdout in holdouts)
    figures: dict[str, Figure] = {
        "gamma": exponent(now),
        "gamma_in_bench_file": exponent(before),
        "bench_file_off_rms_mag": off_rms_mag,
        "bench_file_off_max_mag": off_max_mag,
        "black_level": now.black,
        "black_level_error": black_error,
        "black_level_in_bench_file": before.black,
        "black_level_measured": black_measured,
        "held_out_rms_mag": held_out_rms_mag,
        "held_out_p95_mag": MAG_PER_RELATIVE * p95_percent / 100,
        "held_out_p95_sigmas": held_out_sigmas,
        "held_out_max_mag": held_out_max_mag,
        "noise_percent": 100 * found["noise_relative"],
        "drift_percent": drift_percent,
        "patches": len(readings.patches),
        "codes": found["codes"],
        "exposure_s": readings.exposure_s,
        "links": ", ".join(ratios) or "none",
        "links_max_mag": max(links_mag, default=0.0),
        "links_max_sigmas": max(links_sigmas, default=0.0),
    }
    for decade, value in found["error_percent"].items():
        figures[f"error_at_{decade}_percent"] = value
    if truth is not None:
        true = bench_calibration(truth.config, truth.folder).response
        figures["truth_max_mag"] = float(np.abs(response_error_mag(now, true)).max())
        figures["truth_black_level"] = true.black
    return figures


def rounds_alike(detector: DetectorSettings) -> bool:
    """Whether the read noise is too small to spread light of under half a DN over codes: the ADC
    then rounds all of it to none.
    """
    return detector.read_noise_e < DITHER_DN * detector.gain_e_per_dn


def _judged(
    context: StepContext,
    figures: dict[str, Figure],
    files: tuple[Path, ...],
    pictures: tuple[Path, ...],
) -> StepOutcome:
    """The step's outcome: done, with the response named in the bench file, unless it misses the
    limits of [verify].
    """
    limit_mag = context.file.config.verify.flux_mag
    monitor = context.monitor
    is_black_measured = figures["black_level_measured"] == "yes"
    black = f"black {figures['black_level']:.2e} of white as the bench file has it, not measured"
    if is_black_measured:
        black_error = figures["black_level_error"]
        black = f"black {figures['black_level']:.2e} +- {black_error:.1e} of white"
    else:
        black += " (--dark)"
    line = (
        f"the bench file's {monitor.calibration} is off by {figures['bench_file_off_rms_mag']:.3f}"
        " mag rms,"
        f" {figures['bench_file_off_max_mag']:.3f} max (gamma {figures['gamma']:.3f}, not"
        f" {figures['gamma_in_bench_file']:.3f});"
        f" measured: held-out levels {figures['held_out_rms_mag']:.4f} mag rms,"
        f" {figures['held_out_max_mag']:.4f} max;"
        f" {black}"
    )
    rms_mag = float(figures["held_out_rms_mag"])
    error = rms_mag / math.sqrt(2 * float(figures["codes"]))
    number = StepNumber(rms_mag, error, "mag", "rms distance of held-out levels from the response")
    differs = float(figures["links_max_mag"]) > limit_mag
    if differs and float(figures["links_max_sigmas"]) > SURE_SIGMAS:
        why = "switch off dynamic contrast and local dimming, or is the tracker not linear?"
        line = (
            f"dense and sparse dots of one code differ by {figures['links_max_mag']:.3f} mag: {why}"
        )
        return StepOutcome("failed", line, figures, files, pictures, number=number)
    is_off = float(figures["held_out_p95_mag"]) > limit_mag
    if is_off and float(figures["held_out_p95_sigmas"]) > SURE_SIGMAS:
        why = (
            "take more readings (--patches), look at stray light, and at whether the monitor was"
            " warm"
        )
        if context.truth is not None and rounds_alike(context.truth.config.tracker.detector):
            why += (
                "; the virtual tracker's ADC rounds faint codes alike: write the truth's"
                " [tracker.detector] read_noise_e"
            )
        line = f"{line}: the levels do not make one smooth response; {why}"
        return StepOutcome("failed", line, figures, files, pictures, number=number)
    changes = context.names("monitor", "calibration", context.session / "response.toml")
    return StepOutcome("done", line, figures, files, pictures, changes, number)


def response_error_mag(assumed: Response, true: Response) -> FloatArray:
    """How much fainter each code is than assumed (n,), magnitudes, from three decades below
    white to white.
    """
    true_light = true.light[1:]
    is_bright = true_light >= DIM_LIGHT
    ratio = true_light[is_bright] / assumed.light[1:][is_bright]
    return np.asarray(magnitude(ratio))


def exponent(response: Response) -> float:
    """The exponent of a power law fitted to the response over three decades."""
    light = response.light[1:]
    used = light >= DIM_LIGHT
    signal = np.arange(1, len(response.light))[used] / response.white
    return float(np.polyfit(np.log(signal), np.log(light[used]), 1)[0])
