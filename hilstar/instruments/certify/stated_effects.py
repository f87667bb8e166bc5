"""What a bench file, its `[certify]` and its calibration files say of their own errors: effects on
a bench's deviations, and what is missing.

`missing` gets what they do not say, each a line for the page. What stands before its colon names
the figures that are then not assessed (certificate.UNKNOWN).
"""

import math
from collections.abc import Iterator

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE
from hilstar.display.calibration import BUILT_IN, read_toml, weights_of_grid
from hilstar.display.geometry import load_notes
from hilstar.instruments.certify.bench_readings import geometry_of
from hilstar.instruments.certify.budget import Distribution, Input
from hilstar.instruments.certify.effects import (
    Effect,
    of_all_stars,
    root_mean_square,
    smooth_root,
)
from hilstar.instruments.certify.model import Deviations, Figures
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.certify import TrackerReferenceSettings
from hilstar.server.bench.monitor import bench_calibration

NEIGHBOURS = (
    "pixels that change each other's light: a star's is taken as the sum of its pixels, each as it"
    " is read among others of its code or of black"
)
DRIFTS = ("brightness", "shift_x", "shift_y", "rotation", "scale", "latency")
RECTANGLE = math.sqrt(3)  # half of a range over its standard deviation


def of_files(
    file: BenchFile, figures: Figures, value: Deviations, missing: list[str]
) -> Iterator[Effect]:
    """The effects of a bench's calibration files and stated errors, and in `value` what the
    response has wrong.
    """
    missing.append(NEIGHBOURS)
    yield from _of_response(file, figures, value, missing)
    certify = file.config.certify
    white = certify.flux_at_white_relative
    if white is not None:
        dof = certify.flux_at_white_dof or math.inf
        source = "[certify] flux_at_white_relative"
        scale = Input("full scale", _by_freedom(dof), source, 1, white, "relative", dof)
        yield Effect(scale, even=of_all_stars(len(figures.stars), white))
    else:
        missing.append(
            "full scale: nothing was read, and [certify] flux_at_white_relative is not written"
        )
    yield from _of_evenness(file, figures, missing)
    yield from _of_geometry(file, figures, missing)
    yield from stated_delay(file, missing)


def _of_response(
    file: BenchFile, figures: Figures, value: Deviations, missing: list[str]
) -> Iterator[Effect]:
    """The effect of the levels of a calibration file, and in `value` what its curve has wrong at
    them.
    """
    name = file.config.monitor.calibration
    errors = None
    if name not in BUILT_IN:
        errors = read_toml(file.folder / name).errors
    if errors is None:
        missing.append(f"flux: [monitor] calibration = {name!r} does not say how well it is known")
        return
    light = np.log(np.array(errors.light))
    relative = np.array(errors.relative)
    unit = np.eye(len(light))
    spline = CubicSpline(light, unit, bc_type="natural")
    join = spline(np.clip(figures.log_light, light[0], light[-1]))
    join = join - unit[-1]  # relative to white, whose light is full scale
    value.levels[0] += join @ np.array(errors.off)
    common = errors.common
    if common is None:
        common = errors.black
    black = common / np.array(errors.light)  # common to all levels
    own_relative = np.sqrt(np.maximum(relative**2 - black**2, 0.0))
    source = f"levels of {name}"
    error = float(np.median(relative))
    response = Input("response", "Student t", source, len(light) + 1, error, "relative", errors.dof)
    of_levels = (join * own_relative).T
    of_black = join @ black
    yield Effect(response, levels=np.concatenate([of_levels, of_black[None]]))


def _of_evenness(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The effect of the fields of a calibration file's light map."""
    name = file.config.monitor.calibration
    light_map = bench_calibration(file.config, file.folder)
    field = light_map.uniformity_relative
    if light_map.uniformity is None or field is None:
        missing.append(
            f"evenness: nothing was read, and {name} has no [uniformity] with its standard error"
        )
        return
    width, height = file.config.monitor.resolution_px
    fields_down, fields_along = light_map.uniformity.shape
    row = np.rint(figures.y_px).astype(np.intp)
    column = np.rint(figures.x_px).astype(np.intp)
    rows = weights_of_grid(height, fields_down)[row]
    columns = weights_of_grid(width, fields_along)[column]
    weights = (rows[:, :, None] * columns[:, None]).reshape(len(figures.stars), -1)
    # each field is known by itself, and stars share them
    slopes = field * np.linalg.qr(weights.T)[1]
    even = Input("evenness", "normal", f"fields of {name}", len(slopes), field, "relative")
    yield Effect(even, even=slopes)


def _by_freedom(dof: float) -> Distribution:
    return "normal" if math.isinf(dof) else "Student t"


def _of_geometry(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The effects of a geometry file: the covariance of its fit over the screen, and that of an
    alignment.
    """
    name = file.config.collimator.geometry
    error = None
    if name is not None:
        error = load_notes(file.folder / name).error
    if error is None or (error.map_arcsec is None and error.alignment_covariance_arcsec2 is None):
        missing.append(
            "place and attitude: [collimator] geometry names no file with its errors (hilstar"
            " calibrate geometric)"
        )
        return
    if error.map_arcsec is not None:
        yield _of_map(file, figures, np.array(error.map_arcsec), error.modes_arcsec)
    else:
        missing.append(
            f"lens: {name} has no errors of the lens, and those of its alignment alone count"
        )
    if error.alignment_covariance_arcsec2 is not None:
        size, axes = np.linalg.eigh(np.array(error.alignment_covariance_arcsec2))
        turns = (axes * np.sqrt(np.maximum(size, 0.0))).T
        dof = error.alignment_dof or math.inf
        source = f"covariance of the rotation of {name}"
        rms = math.sqrt(max(float(size.mean()), 0.0))
        alignment = Input("alignment", _by_freedom(dof), source, 3, rms, "arcsec", dof)
        yield Effect(alignment, place=figures.turned(turns))


def _of_map(
    file: BenchFile,
    figures: Figures,
    map_arcsec: FloatArray,
    modes_arcsec: list[list[float]] | None,
) -> Effect:
    """The effect of a geometry's errors over the screen (rows, columns), by their modes where the
    file has them; negative ones are unknown.
    """
    name = file.config.collimator.geometry
    wide, high = file.config.monitor.resolution_px
    down, along = map_arcsec.shape
    at_down = (figures.y_px + 0.5) / high * (down - 1)
    at_along = (figures.x_px + 0.5) / wide * (along - 1)
    at = at_down, at_along

    def seen(values: FloatArray) -> FloatArray:
        return np.asarray(map_coordinates(values, at, order=1, mode="nearest"))

    largest = float(map_arcsec.max())
    known = seen(np.where(map_arcsec < 0, largest, map_arcsec)) / math.sqrt(2)
    if modes_arcsec is None:
        place = np.eye(2)[:, None] * known[:, None]
        source = f"map of errors of {name}, all stars together"
    else:
        axes = np.array(modes_arcsec).reshape(-1, down, along)
        at_stars = np.stack([seen(axis) for axis in axes])
        place = at_stars.reshape(-1, 2, len(known)).transpose(0, 2, 1)
        source = f"covariance of {name}"
    error = root_mean_square(known)
    return Effect(Input("geometry", "normal", source, len(place), error, "arcsec"), place=place)


def stated_delay(file: BenchFile, missing: list[str]) -> Iterator[Effect]:
    """The effect of a delay that a bench file states."""
    known = file.config.certify.panel_delay_u_ms
    if known is None:
        missing.append(
            "latency: no photodiode read it, and [certify] panel_delay_u_ms is not written"
        )
        return
    stated = Input("delay", "normal", "[certify] panel_delay_u_ms", 1, known, "ms")
    yield Effect(stated, delay=np.array([known]))


def of_warm_up(
    file: BenchFile, count: int, change: float | None, missing: list[str]
) -> Iterator[Effect]:
    """The effect of white's change in ten minutes, relative, on stars (count,): as it was seen,
    else as `[certify]` states it.
    """
    source = "white in the next ten minutes (--warm-up)"
    stated = file.config.certify.warm_up_percent
    if change is None and stated is not None:
        change = stated / 100
        source = "[certify] warm_up_percent"
    if change is None:
        missing.append(
            "warm-up: not measured (--warm-up, or first light's), and [certify] warm_up_percent is"
            " not written"
        )
        return
    u = change / RECTANGLE
    warm_up = Input("warm-up", "rectangular", source, 1, u, "relative")
    yield Effect(warm_up, even=of_all_stars(count, u))


def of_drift(
    figures: Figures, checked: dict[str, float] | None, missing: list[str]
) -> Iterator[Effect]:
    """The effect of drift since the last check: anywhere within the largest change that was seen,
    of each quantity by itself.
    """
    if checked is None:
        missing.append(
            "drift since the certificate: no check has been made (hilstar certify --check)"
        )
        return
    size = len(DRIFTS)
    light, x, y, turn, scale, late = (checked.get(name, 0.0) / RECTANGLE for name in DRIFTS)
    count = len(figures.stars)
    even = np.zeros((size, count))
    even[0] = light / 100
    place = np.zeros((size, count, 2))
    place[1, :, 0] = x
    place[2, :, 1] = y
    place[3] = figures.turned(np.array([[0.0, 0.0, turn]]))[0]
    place[4] = 1e-6 * scale * ARCSEC_PER_RAD * figures.tangent
    delay = np.zeros(size)
    delay[5] = late
    source = f"largest changes over all checks: {', '.join(DRIFTS)}"
    drift = Input("drift", "rectangular", source, size, light / 100, "relative")
    yield Effect(drift, even=even, place=place, delay=delay)


def of_settings(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The effects of instrument, tracker, temperature, clock and prediction, as [certify] states
    them.
    """
    certify = file.config.certify
    count = len(figures.stars)
    instrument = certify.instrument
    if instrument.name:
        scale = instrument.relative_expanded / instrument.k
        name = _dated(instrument.name, instrument.date)
        source = f"certificate of {name}, k = {instrument.k:g}"
        photometer = Input("instrument", "normal", source, 1, scale, "relative")
        yield Effect(photometer, even=of_all_stars(count, scale))
    else:
        missing.append(
            "absolute scale of the light: no [certify.instrument]; light is in the tracker's own"
            " electrons"
        )
    yield from _of_tracker(file, figures, missing)
    if certify.temperature_k and (certify.flux_mag_per_k or certify.place_arcsec_per_k):
        kelvin = certify.temperature_k / RECTANGLE
        light = np.zeros((3, count))
        light[0] = certify.flux_mag_per_k * kelvin / MAG_PER_RELATIVE
        moved = np.zeros((3, count, 2))
        moved[1, :, 0] = moved[2, :, 1] = certify.place_arcsec_per_k * kelvin
        source = f"[certify] temperature_k = {certify.temperature_k:g}, half of a range"
        warmth = Input("temperature", "rectangular", source, 3, kelvin, "K")
        yield Effect(warmth, even=light, place=moved)
    else:
        missing.append("temperature: no range or no coefficient in [certify]")
    if not certify.rate_deg_s:
        missing.append("motion: [certify] rate_deg_s is 0, so clock and prediction move no star")
        return
    for name, key in (("clock", "clock_ms"), ("prediction", "jitter_ms")):
        error = getattr(certify, key)
        if error:
            late = Input(name, "normal", f"[certify] {key}", 1, error, "ms")
            yield Effect(late, late=np.array([error]))


def _dated(name: str, date: str) -> str:
    """An instrument's name, and its date where there is one."""
    return ", ".join(part for part in (name, date) if part)


def _of_tracker(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The effects of the tracker itself, by whose lens and detector all is read, as
    [certify.tracker] states how well it is known.

    Its errors of direction and of evenness are taken as smooth: correlated over half of its field.
    """
    stated = file.config.certify.tracker
    count = len(figures.stars)
    name = _dated(stated.name, stated.date) or "without a name"
    source = f"[certify.tracker] {name}, k = {stated.k:g}"
    tracker = geometry_of(file).tracker
    half = min(tracker.resolution_px) / 2 / tracker.focal_length_px
    at = np.concatenate([figures.tangent, np.zeros((1, 2))])  # the last is the middle of the field
    apart = ((at[:, None] - at) ** 2).sum(axis=2)
    smooth = smooth_root(np.exp(-apart / (2 * half**2)))
    direction = stated.direction_expanded_arcsec
    if direction is None:
        missing.append(
            "place and attitude: they are seen through the tracker's own lens, taken as [tracker]"
            " has it, and how well that is known is not written ([certify.tracker]"
            " direction_expanded_arcsec)"
        )
    elif direction:
        error = direction / stated.k
        place = np.zeros((2, len(at), count, 2))
        place[0, :, :, 0] = place[1, :, :, 1] = error * smooth[:, :count]
        lens = Input("tracker's lens", "normal", source, 2 * len(at), error, "arcsec")
        yield Effect(lens, place=place.reshape(-1, count, 2))
    yield from _of_radial_errors(stated, figures.tangent, half, source)
    even = stated.evenness_expanded_relative
    if even is None:
        missing.append(
            "vignetting: light over the field is as the tracker itself collects it, which counts as"
            " the screen's ([certify.tracker] evenness_expanded_relative is not written)"
        )
    elif even:
        error = even / stated.k
        # Relative to the middle two places are off by a half each, in variance, where they are far
        # apart.
        from_middle = error * (smooth[:, :count] - smooth[:, count:])
        vignetting = Input("tracker's evenness", "normal", source, len(at), error, "relative")
        yield Effect(vignetting, even=from_middle)
    linear = stated.linearity_expanded_relative
    if linear is None:
        missing.append(
            "linearity: light is in the scale of what reads it, taken as linear ([certify.tracker]"
            " linearity_expanded_relative is not written)"
        )
    elif linear:
        error = linear / stated.k
        scale = Input("tracker's linearity", "normal", source, 1, error, "relative")
        yield Effect(scale, even=of_all_stars(count, error))


def _of_radial_errors(
    stated: TrackerReferenceSettings, tangent: FloatArray, half: float, source: str
) -> Iterator[Effect]:
    """The effects of the focal length and of the distortion of the tracker's lens: radial at
    directions (n, 2), 0 at the boresight; `half` is the tangent at the edge of the field.
    """
    focal = stated.focal_expanded_relative / stated.k
    if focal:
        moved = focal * ARCSEC_PER_RAD * tangent
        scale = Input("tracker's focal length", "normal", source, 1, focal, "relative")
        yield Effect(scale, place=moved[None])
    edge_arcsec = stated.distortion_expanded_arcsec / stated.k
    if edge_arcsec:
        radius = np.linalg.norm(tangent, axis=1, keepdims=True) / half
        moved = edge_arcsec * radius**2 * tangent / half
        bent = Input("tracker's distortion", "normal", source, 1, edge_arcsec, "arcsec")
        yield Effect(bent, place=moved[None])
