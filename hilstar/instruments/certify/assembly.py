"""From a bench, and its readings where there are some, to the inputs of its budget and the model
that they go through.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, magnitude
from hilstar.display.calibration import BUILT_IN, read_toml, weights_of_grid
from hilstar.display.geometry import load_notes
from hilstar.instruments.certify.budget import Distribution, Input, Model
from hilstar.instruments.certify.estimates import (
    Evenness,
    LightDeviation,
    evenness,
    light_deviation,
    place_errors,
)
from hilstar.instruments.certify.lens import LensFit, lens_fit
from hilstar.instruments.certify.model import Deviations, Figures, reference_stars
from hilstar.instruments.certify.readings import Reader, dot_places, geometry_of
from hilstar.instruments.certify.structure import in_time, lasting_root
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.catalogue import sigma_instrument_mag
from hilstar.server.bench.config.certify import TrackerReferenceSettings
from hilstar.server.bench.monitor import bench_calibration
from hilstar.server.bench.star_light import catalogue_choice
from hilstar.server.bench.star_rates import star_flux, star_kinds, star_rates
from hilstar.sky.facts import errors_of, motion_at
from hilstar.sky.star_table import choose_catalog, table_facts

SEED = 5  # for the order of readings
DOT_IMAGES = 4
PLACES_IN_SQUARE = 7  # along each side
READINGS_A_ROUND = 8  # between one black and white and the next
# stars' light by library spectra of their V-I: results/tradeoff.csv, 0.026 mag at 95 %
LIBRARY_MAG = 0.013
SKY = (("star_flux", "mag"), ("star_place_along", "arcsec"), ("star_place_across", "arcsec"))
KINDS = (
    ("levels", "levels"),
    ("even", "even"),
    ("place_arcsec", "place"),
    ("delay_ms", "delay"),
    ("late_ms", "late"),
)


@dataclass(frozen=True, slots=True)
class Effect:
    """An input and its slopes: on relative light at the model's levels (size, levels) and at stars
    (size, stars), places (size, stars, 2), delay and lateness (size,), ms, and on what the sky adds
    to each star (size, 3, stars).
    """

    input: Input
    levels: FloatArray | None = None
    even: FloatArray | None = None
    place: FloatArray | None = None
    delay: FloatArray | None = None
    late: FloatArray | None = None
    sky: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Read:
    """A bench's readings, fitted; what could not be read is None."""

    light: LightDeviation
    even: Evenness
    place: LensFit
    delays_ms: FloatArray


def read_bench(file: BenchFile, reader: Reader) -> Read:
    """Read a bench for a certificate: its response, one pattern of dots, its delay. Raises
    InputError, MachineError.
    """
    certify = file.config.certify
    rng = np.random.default_rng(SEED)
    codes = planned_codes(2**file.config.monitor.bits - 1, certify.levels, certify.repeats, rng)
    light = light_deviation(file, reader.light(codes))
    dots = reader.dots(*dot_places(geometry_of(file)), DOT_IMAGES)
    place = lens_fit(file, dots, place_errors(file, dots))
    return Read(light, evenness(file, dots), place, reader.delays_ms())


def planned_codes(white: int, levels: int, repeats: int, rng: np.random.Generator) -> IntArray:
    """Codes to read (n,), in even steps of their logarithm, the faintest all of them; black and
    white before every eight.
    """
    count = min(levels, white)
    wanted = next(
        distinct
        for n in itertools.count(count)
        if len(distinct := np.unique(np.rint(np.geomspace(1, white, n)))) >= count
    )
    order = rng.permutation(np.repeat(wanted.astype(np.intp), repeats))
    rounds = []
    for k in range(0, len(order), READINGS_A_ROUND):
        rounds.append(np.concatenate([[0, white], order[k : k + READINGS_A_ROUND]]))
    return np.asarray(np.concatenate([*rounds, [0, white]]), dtype=np.intp)


@dataclass(frozen=True, slots=True)
class Assembled:
    """Inputs, the model of all figures, each figure's (quantity, star or field, unit), and what
    was not assessed.
    """

    inputs: list[Input]
    model: Model
    names: list[tuple[str, int, str]]
    figures: Figures
    not_assessed: list[str]


def assemble(
    file: BenchFile,
    read: Read | None,
    warm_up: float | None = None,
    checked: dict[str, float] | None = None,
) -> Assembled:
    """The budget of a bench. Raises InputError.

    White was seen to change by `warm_up` in ten minutes, relative, and its checks' figures by
    `checked`; None: not looked at.
    """
    figures = Figures(file, reference_stars(file))
    count = len(figures.stars)
    lights = len(figures.log_light)
    value = Deviations(
        np.ones((1, lights)), np.zeros((1, count)), np.zeros((1, count, 2)),
        np.array([file.config.monitor.panel_delay_ms]), np.zeros(1),
    )  # fmt: skip
    missing: list[str] = []
    if read is None:
        effects = list(_of_files(file, figures, value, missing))
    else:
        value, effects = _of_readings(file, figures, read, missing)
    effects += [
        *_of_settings(file, figures, missing),
        *_of_warm_up(file, count, warm_up, missing),
        *_of_drift(figures, checked, missing),
        *_of_sky(file, figures, missing),
    ]
    names = [
        *figures.names,
        *((quantity, star, unit) for quantity, unit in SKY for star in range(count)),
    ]
    quantised = np.array([star.quantised_mag for star in figures.stars])

    def model(variables: list[FloatArray]) -> FloatArray:
        def total(name: str) -> FloatArray | float:
            parts = [
                (z, getattr(effect, name)) for z, effect in zip(variables, effects, strict=True)
            ]
            return sum(
                (np.tensordot(z, slopes, axes=1) for z, slopes in parts if slopes is not None),
                start=0.0,
            )

        trials = len(variables[0])
        off = Deviations(
            *(
                np.zeros((trials, *getattr(value, n).shape[1:])) + getattr(value, n) + total(m)
                for n, m in KINDS
            )
        )
        figure_values = figures.of(off)
        sky = np.zeros((trials, len(SKY), count)) + total("sky")
        sky += figure_values[:, : 3 * count].reshape(trials, 3, count)
        sky[:, 0] += quantised
        return np.concatenate([figure_values, sky.reshape(trials, -1)], axis=1)

    return Assembled([each.input for each in effects], model, names, figures, missing)


def _of_readings(
    file: BenchFile, figures: Figures, read: Read, missing: list[str]
) -> tuple[Deviations, list[Effect]]:
    light = read.light
    join = light.weights(figures.log_light)
    dark = (join @ light.dark_factors).T
    lasting = (join @ light.lasting_factors).T
    fit = read.even.fit
    read_px = _places_in(light.square_px)
    even = fit.terms(figures.x_px, figures.y_px) - fit.terms(*read_px).mean(axis=0)
    place = read.place.at(figures.x_px, figures.y_px)
    form = fit.bowed(figures.x_px, figures.y_px) - fit.bowed(*read_px).mean()
    half = np.abs(form) / 2 / math.sqrt(3)
    bent = light.bent(figures.log_light) / 2 / math.sqrt(6)  # the spline is the more likely of both
    rough = light.rough(figures.log_light)
    late_ms = read.delays_ms
    if len(late_ms) > 1:
        delay = float(late_ms.mean())
    else:
        delay = file.config.monitor.panel_delay_ms
    value = Deviations(
        (join @ light.value)[None],
        (even @ fit.value[:, 0] - form / 2)[None],
        place.value[None],
        np.array([delay]),
        np.zeros(1),
    )
    if read.even.found.total:
        white = math.sqrt(read.even.found.noise_variance) / fit.noise
    else:
        white = 1.0
    effects = [
        Effect(
            Input(
                "response",
                "Student t",
                "patches of light",
                light.factors.shape[1],
                light.noise,
                "relative",
                light.dof,
            ),
            levels=(join @ light.factors).T,
        ),
        Effect(
            Input(
                "dark readings",
                "Student t",
                "scatter of black",
                len(dark),
                light.dark,
                "of white",
                light.dark_dof,
            ),
            levels=dark,
        ),
        Effect(
            Input(
                "form of the response",
                "triangular",
                "a spline, or straight between codes",
                1,
                _rms(bent),
                "relative",
            ),
            levels=bent[None],
        ),
        Effect(
            Input(
                "evenness",
                "Student t",
                "light of dots",
                even.shape[1],
                white * fit.noise,
                "relative",
                fit.dof,
            ),
            even=white * (even @ fit.factors).T,
        ),
        Effect(
            Input(
                "form of the light map",
                "rectangular",
                "smooth, or linear between a map's places",
                1,
                _rms(half),
                "relative",
            ),
            even=half[None],
        ),
        Effect(
            Input(
                "geometry",
                "Student t",
                "places of dots",
                len(place.noise),
                math.sqrt(place.found.noise_variance),
                "arcsec",
                place.noise_dof,
            ),
            place=place.noise,
        ),
    ]
    effects += _of_structure(figures, read, lasting, rough)
    if len(late_ms) > 1:
        effects += _of_delays(late_ms)
    else:
        effects += _stated_delay(file, missing)
    return value, effects


def _of_delays(late_ms: FloatArray) -> Iterator[Effect]:
    """The effects of edges (n,) that a photodiode saw: of each by itself, and of what correlates
    from one to the next.
    """
    count = len(late_ms)
    order = np.arange(len(late_ms), dtype=np.float64)
    lasts = in_time(order, late_ms - late_ms.mean(), np.ones((count, 1)))
    source = f"{count} edges of a photodiode"
    error = math.sqrt(lasts.noise_variance / count)
    yield Effect(
        Input("delay", "Student t", source, 1, error, "ms", count - 1.0), delay=np.array([error])
    )
    if lasts.total:
        error = float(np.linalg.norm(lasting_root(order, lasts).mean(axis=0)))
        several = Input(
            "delay that lasts", "Student t", f"{source}, which correlate", 1, error, "ms", lasts.dof
        )
        yield Effect(several, delay=np.array([error]))


def _places_in(square_px: tuple[int, int, int]) -> tuple[FloatArray, FloatArray]:
    """Places (n,) all over a square of the screen, left, top and side, px."""
    left, top, side = square_px
    if side > 1:
        along = (np.arange(PLACES_IN_SQUARE) + 0.5) / PLACES_IN_SQUARE * side - 0.5
    else:
        along = np.zeros(1)
    x, y = np.meshgrid(left + along, top + along)
    return x.ravel(), y.ravel()


def _of_structure(
    figures: Figures, read: Read, lasting: FloatArray, rough: FloatArray
) -> Iterator[Effect]:
    """The effects of what the residuals have left of structure, where they have it: in time, of
    codes, of light, of places.
    """
    light = read.light
    even = read.even
    place = read.place.at(figures.x_px, figures.y_px)
    if light.lasting.total:
        error = light.noise * math.sqrt(light.lasting.total)
        source = "readings that correlate from one to the next"
        yield Effect(
            Input(
                "noise that lasts",
                "Student t",
                source,
                len(lasting),
                error,
                "relative",
                light.lasting.dof,
            ),
            levels=lasting,
        )
    if light.common_factors.size:
        common = (light.weights(figures.log_light) @ light.common_factors).T
        error = float(np.abs(light.common_factors).max())
        source = (
            "ratios of lattices by pairs of images, the ADC's rounding and its lowest code, black"
        )
        shared = Input("what readings share", "normal", source, len(common), error, "relative")
        yield Effect(shared, levels=common)
    if rough.any():
        source = "codes read, each foretold by the others: those not read"
        yield Effect(
            Input(
                "roughness of the response",
                "normal",
                source,
                len(rough),
                _rms(rough[rough > 0]),
                "relative",
            ),
            levels=np.diag(rough),
        )
    if even.found.total:
        count = len(figures.stars)
        read_px = _places_in(light.square_px)
        shares = np.concatenate(
            [np.eye(count), np.full((count, len(read_px[0])), -1 / len(read_px[0]))], axis=1
        )
        x = np.append(figures.x_px, read_px[0])
        y = np.append(figures.y_px, read_px[1])
        scatter = even.scatter(x, y, shares)
        error = math.sqrt(even.found.total)
        length = even.found.mean_length
        source = (
            f"light of dots about its map, over {length:.0f} px: the screen's, at each star's place"
        )
        yield Effect(
            Input(
                "uneven light", "Student t", source, len(scatter), error, "relative", even.found.dof
            ),
            even=scatter,
        )
    if place.found.total:
        error = math.sqrt(place.found.total)
        length = place.found.mean_length
        source = f"places of dots about the lens, which correlate over {length:.0f} px"
        yield Effect(
            Input(
                "dots that correlate",
                "Student t",
                source,
                len(place.structure),
                error,
                "arcsec",
                place.found.dof,
            ),
            place=place.structure,
        )


def _of_files(
    file: BenchFile, figures: Figures, value: Deviations, missing: list[str]
) -> Iterator[Effect]:
    """The effects of a bench's calibration files and stated errors, and in `value` what the
    response has wrong.
    """
    monitor = file.config.monitor
    certify = file.config.certify
    count = len(figures.stars)
    name = monitor.calibration
    if name in BUILT_IN:
        known = None
    else:
        known = read_toml(file.folder / name)
    errors = None if known is None else known.errors
    light_map = bench_calibration(file.config, file.folder)
    if errors is None:
        missing.append(f"flux: [monitor] calibration = {name!r} does not say how well it is known")
    else:
        light = np.log(np.array(errors.light))
        relative = np.array(errors.relative)
        join = CubicSpline(light, np.eye(len(light)), bc_type="natural")(
            np.clip(figures.log_light, light[0], light[-1])
        )
        join = join - np.eye(len(light))[-1]  # relative to white, whose light is full scale
        value.levels[0] += join @ np.array(errors.off)
        if errors.common is None:
            common = errors.black
        else:
            common = errors.common
        black = common / np.array(errors.light)  # common to all levels
        own_relative = np.sqrt(np.maximum(relative**2 - black**2, 0.0))
        source = f"levels of {name}"
        yield Effect(
            Input(
                "response",
                "Student t",
                source,
                len(light) + 1,
                float(np.median(relative)),
                "relative",
                errors.dof,
            ),
            levels=np.concatenate([(join * own_relative).T, (join @ black)[None]]),
        )
    if (white := certify.flux_at_white_relative) is not None:
        dof = certify.flux_at_white_dof or math.inf
        source = "[certify] flux_at_white_relative"
        kind = _by_freedom(dof)
        yield Effect(
            Input("full scale", kind, source, 1, white, "relative", dof),
            even=np.full((1, count), white),
        )
    else:
        missing.append(
            "full scale: nothing was read, and [certify] flux_at_white_relative is not written"
        )
    if light_map.uniformity is None or light_map.uniformity_relative is None:
        missing.append(
            f"evenness: nothing was read, and {name} has no [uniformity] with its standard error"
        )
    else:
        field = light_map.uniformity_relative
        sides = zip(
            (figures.y_px, figures.x_px),
            monitor.resolution_px[::-1],
            light_map.uniformity.shape,
            strict=True,
        )
        rows, columns = (
            weights_of_grid(side, n)[np.rint(at).astype(np.intp)] for at, side, n in sides
        )
        weights = (rows[:, :, None] * columns[:, None]).reshape(count, -1)
        # each field is known by itself, and stars share them
        slopes = field * np.linalg.qr(weights.T)[1]
        yield Effect(
            Input("evenness", "normal", f"fields of {name}", len(slopes), field, "relative"),
            even=slopes,
        )
    yield from _of_geometry(file, figures, missing)
    yield from _stated_delay(file, missing)


def _by_freedom(dof: float) -> Distribution:
    return "normal" if math.isinf(dof) else "Student t"


def _of_geometry(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The effects of a geometry file: the covariance of its fit over the screen, and that of an
    alignment.
    """
    name = file.config.collimator.geometry
    if name is None:
        error = None
    else:
        error = load_notes(file.folder / name).error
    if error is None or (error.map_arcsec is None and error.alignment_covariance_arcsec2 is None):
        missing.append(
            "place and attitude: [collimator] geometry names no file with its errors (hilstar"
            " calibrate geometric)"
        )
        return
    wide, high = file.config.monitor.resolution_px
    if error.map_arcsec is not None:
        rows = np.where(np.array(error.map_arcsec) < 0, np.nan, np.array(error.map_arcsec))
        at = (
            (figures.y_px + 0.5) / high * (rows.shape[0] - 1),
            (figures.x_px + 0.5) / wide * (rows.shape[1] - 1),
        )

        def seen(values: FloatArray) -> FloatArray:
            return np.asarray(map_coordinates(values, at, order=1, mode="nearest"))

        known = seen(np.where(np.isnan(rows), np.nanmax(rows), rows)) / math.sqrt(2)
        if error.modes_arcsec is None:
            place = np.eye(2)[:, None] * known[:, None]
            source = f"map of errors of {name}, all stars together"
        else:
            modes = np.array(error.modes_arcsec).reshape(-1, 2, *rows.shape)
            place = np.stack([[seen(axis) for axis in mode] for mode in modes]).transpose(0, 2, 1)
            source = f"covariance of {name}"
        yield Effect(
            Input("geometry", "normal", source, len(place), _rms(known), "arcsec"), place=place
        )
    else:
        missing.append(
            f"lens: {name} has no errors of the lens, and those of its alignment alone count"
        )
    if error.alignment_covariance_arcsec2 is not None:
        covariance = np.array(error.alignment_covariance_arcsec2)
        dof = error.alignment_dof or math.inf
        size, axes = np.linalg.eigh(covariance)
        turns = (axes * np.sqrt(np.maximum(size, 0.0))).T
        source = f"covariance of the rotation of {name}"
        rms = math.sqrt(max(float(size.mean()), 0.0))
        yield Effect(
            Input("alignment", _by_freedom(dof), source, 3, rms, "arcsec", dof),
            place=figures.turned(turns),
        )


def _stated_delay(file: BenchFile, missing: list[str]) -> Iterator[Effect]:
    known = file.config.certify.panel_delay_u_ms
    if known is None:
        missing.append(
            "latency: no photodiode read it, and [certify] panel_delay_u_ms is not written"
        )
    else:
        yield Effect(
            Input("delay", "normal", "[certify] panel_delay_u_ms", 1, known, "ms"),
            delay=np.array([known]),
        )


def _of_warm_up(
    file: BenchFile, count: int, seen: float | None, missing: list[str]
) -> Iterator[Effect]:
    source = "white in the next ten minutes (--warm-up)"
    known = file.config.certify.warm_up_percent
    if seen is None and known is not None:
        seen = known / 100
        source = "[certify] warm_up_percent"
    if seen is None:
        missing.append(
            "warm-up: not measured (--warm-up, or first light's), and [certify] warm_up_percent is"
            " not written"
        )
    else:
        u = seen / math.sqrt(3)
        yield Effect(
            Input("warm-up", "rectangular", source, 1, u, "relative"), even=np.full((1, count), u)
        )


def _of_drift(
    figures: Figures, checked: dict[str, float] | None, missing: list[str]
) -> Iterator[Effect]:
    """Drift since the last check: anywhere within the largest change that was seen, of each
    quantity by itself.
    """
    if checked is None:
        missing.append(
            "drift since the certificate: no check has been made (hilstar certify --check)"
        )
        return
    names = ("brightness", "shift_x", "shift_y", "rotation", "scale", "latency")
    count = len(figures.stars)
    light, x, y, turn, scale, late = (checked.get(name, 0.0) / math.sqrt(3) for name in names)
    even = np.zeros((6, count))
    place = np.zeros((6, count, 2))
    delay = np.zeros(6)
    even[0], place[1, :, 0], place[2, :, 1], delay[5] = light / 100, x, y, late
    place[3], place[4] = (
        figures.turned(np.array([[0.0, 0.0, turn]]))[0],
        1e-6 * scale * ARCSEC_PER_RAD * figures.tangent,
    )
    source = f"largest changes over all checks: {', '.join(names)}"
    yield Effect(
        Input("drift", "rectangular", source, 6, light / 100, "relative"),
        even=even,
        place=place,
        delay=delay,
    )


def _of_settings(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The instrument, temperature, clock and prediction, as [certify] states them."""
    certify = file.config.certify
    stars = len(figures.stars)
    ones = np.ones((1, stars))
    instrument = certify.instrument
    if instrument.name:
        scale = instrument.relative_expanded / instrument.k
        source = (
            f"certificate of {instrument.name}{f', {instrument.date}' if instrument.date else ''},"
            f" k = {instrument.k:g}"
        )
        yield Effect(Input("instrument", "normal", source, 1, scale, "relative"), even=scale * ones)
    else:
        missing.append(
            "absolute scale of the light: no [certify.instrument]; light is in the tracker's own"
            " electrons"
        )
    yield from _of_tracker(file, figures, missing)
    if certify.temperature_k and (certify.flux_mag_per_k or certify.place_arcsec_per_k):
        kelvin = certify.temperature_k / math.sqrt(3)
        flux = certify.flux_mag_per_k * kelvin / MAG_PER_RELATIVE
        place = certify.place_arcsec_per_k * kelvin
        moved = np.zeros((3, stars, 2))
        moved[1, :, 0], moved[2, :, 1] = place, place
        source = f"[certify] temperature_k = {certify.temperature_k:g}, half of a range"
        light = np.stack([flux * ones[0], 0 * ones[0], 0 * ones[0]])
        yield Effect(
            Input("temperature", "rectangular", source, 3, kelvin, "K"), even=light, place=moved
        )
    else:
        missing.append("temperature: no range or no coefficient in [certify]")
    if certify.rate_deg_s:
        for name, error, source in (
            ("clock", certify.clock_ms, "[certify] clock_ms"),
            ("prediction", certify.jitter_ms, "[certify] jitter_ms"),
        ):
            if error:
                yield Effect(Input(name, "normal", source, 1, error, "ms"), late=np.array([error]))
    else:
        missing.append("motion: [certify] rate_deg_s is 0, so clock and prediction move no star")


def _of_tracker(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """The tracker itself, by whose lens and detector all is read, as [certify.tracker] states how
    well it is known.

    Its errors of direction and of evenness are taken as smooth: correlated over half of its field.
    """
    stated = file.config.certify.tracker
    count = len(figures.stars)
    of = ", ".join(source_part for source_part in (stated.name, stated.date) if source_part)
    source = f"[certify.tracker] {of or 'without a name'}, k = {stated.k:g}"
    tracker = geometry_of(file).tracker
    half = min(tracker.resolution_px) / 2 / tracker.focal_length_px
    at = np.concatenate([figures.tangent, np.zeros((1, 2))])  # the last is the middle of the field
    apart = ((at[:, None] - at) ** 2).sum(axis=2)
    size, vectors = np.linalg.eigh(np.exp(-apart / (2 * half**2)))
    smooth = (vectors * np.sqrt(np.maximum(size, 0.0))).T
    if (direction := stated.direction_expanded_arcsec) is None:
        missing.append(
            "place and attitude: they are seen through the tracker's own lens, taken as [tracker]"
            " has it, and how well that is known is not written ([certify.tracker]"
            " direction_expanded_arcsec)"
        )
    elif direction:
        place = np.zeros((2, len(at), count, 2))
        place[0, :, :, 0] = place[1, :, :, 1] = direction / stated.k * smooth[:, :count]
        lens = Input(
            "tracker's lens", "normal", source, 2 * len(at), direction / stated.k, "arcsec"
        )
        yield Effect(lens, place=place.reshape(-1, count, 2))
    yield from _of_radial_errors(stated, figures.tangent, half, source)
    if (even := stated.evenness_expanded_relative) is None:
        missing.append(
            "vignetting: light over the field is as the tracker itself collects it, which counts as"
            " the screen's ([certify.tracker] evenness_expanded_relative is not written)"
        )
    elif even:
        # Relative to the middle two places are off by a half each, in variance, where they are far
        # apart.
        from_middle = even / stated.k * (smooth[:, :count] - smooth[:, count:])
        vignetting = Input(
            "tracker's evenness", "normal", source, len(at), even / stated.k, "relative"
        )
        yield Effect(vignetting, even=from_middle)
    if (linear := stated.linearity_expanded_relative) is None:
        missing.append(
            "linearity: light is in the scale of what reads it, taken as linear ([certify.tracker]"
            " linearity_expanded_relative is not written)"
        )
    elif linear:
        scale = Input("tracker's linearity", "normal", source, 1, linear / stated.k, "relative")
        yield Effect(scale, even=np.full((1, count), linear / stated.k))


def _of_radial_errors(
    stated: TrackerReferenceSettings, tangent: FloatArray, half: float, source: str
) -> Iterator[Effect]:
    """The effects of the focal length and of the distortion of the tracker's lens: radial at
    directions (n, 2), 0 at the boresight; `half` is the tangent at the edge of the field.
    """
    if focal := stated.focal_expanded_relative / stated.k:
        moved = focal * ARCSEC_PER_RAD * tangent
        scale = Input("tracker's focal length", "normal", source, 1, focal, "relative")
        yield Effect(scale, place=moved[None])
    if edge_arcsec := stated.distortion_expanded_arcsec / stated.k:
        radius = np.linalg.norm(tangent, axis=1, keepdims=True) / half
        moved = edge_arcsec * radius**2 * tangent / half
        bent = Input("tracker's distortion", "normal", source, 1, edge_arcsec, "arcsec")
        yield Effect(bent, place=moved[None])


def _of_sky(file: BenchFile, figures: Figures, missing: list[str]) -> Iterator[Effect]:
    """What the sky and the codes add to each star: catalogue, spectrum, quantisation; they are
    in the star_ figures alone.
    """
    stars = figures.stars
    count = len(stars)

    def each(values: FloatArray, kind: int) -> FloatArray:
        slopes = np.zeros((count, len(SKY), count))
        slopes[np.arange(count), kind, np.arange(count)] = values
        return slopes

    mag, arcsec = catalogue_errors(file, np.array([star.row for star in stars], dtype=np.intp))
    source = "each star's errors in the catalogue"
    rms = _rms(mag), _rms(arcsec)
    yield Effect(Input("catalogue light", "normal", source, count, rms[0], "mag"), sky=each(mag, 0))
    both = np.concatenate([each(arcsec, 1), each(arcsec, 2)])
    yield Effect(Input("catalogue place", "normal", source, 2 * count, rms[1], "arcsec"), sky=both)
    colour, source = spectrum_mag(file, np.array([star.b_v_mag for star in stars]))
    yield Effect(
        Input("spectrum", "normal", source, 1, _rms(colour), "mag"),
        sky=np.stack([colour, np.zeros(count), np.zeros(count)])[None],
    )
    lost = np.array([star.quantised_mag for star in stars])
    light = float(lost.std(ddof=1)) if count > 2 else 0.0
    source = "scatter of what the codes of the reference stars lose"
    yield Effect(
        Input("quantisation", "normal", source, count, light, "mag"),
        sky=each(np.full(count, light), 0),
    )


def catalogue_errors(file: BenchFile, row: IntArray) -> tuple[FloatArray, FloatArray]:
    """The catalogue's errors of stars (n,) by their rows: of light in the tracker, mag, and of
    place along an axis, arcsec.
    """
    sky = file.config.sky
    choice = catalogue_choice(file.config, file.folder)
    stars = choose_catalog(choice).taken(row)
    facts = table_facts(choice, stars, errors_of(stars))
    covariance = motion_at(stars, facts, sky.epoch_jyear).covariance
    place_mas = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    mag = sigma_instrument_mag(
        stars, facts, star_rates(file.config, file.folder), star_kinds(file.config, stars)
    )
    return np.nan_to_num(mag), np.nan_to_num(place_mas) / 1000


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def spectrum_mag(file: BenchFile, b_v_mag: FloatArray) -> tuple[FloatArray, str]:
    """The standard uncertainty of stars' light by the way from colour to spectrum (n,), mag, and
    its source.
    """
    if file.config.sky.spectrum != "blackbody" or file.config.sky.brightness != "dgs":
        return (
            np.full(len(b_v_mag), LIBRARY_MAG),
            "real stars of one colour (study tradeoff: 0.026 mag at 95 %)",
        )
    rates = []
    known = np.nan_to_num(b_v_mag, nan=0.65)
    for spectrum in ("pickles", "blackbody"):
        sky = msgspec.structs.replace(file.config.sky, spectrum=spectrum)
        flux = star_flux(msgspec.structs.replace(file.config, sky=sky), file.folder)
        rates.append(
            np.asarray(flux(np.zeros(len(known)), known, np.full(len(known), np.nan), None)).sum(
                axis=1
            )
        )
    return (
        np.abs(magnitude(rates[0] / rates[1])),
        "black bodies against library spectra of the same B-V",
    )
