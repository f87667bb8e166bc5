"""Trade-offs of light: brightness integral, spectrum from colours, PSF, quantisation, depth of
the catalogue.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.integrate import quad_vec

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import LIGHT_M_S, flux_ratio, magnitude
from hilstar.display.phases import WHITE, fainter, measure
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.instruments.study.codes import (
    AIMS,
    FRAME_PX,
    JUDGE,
    STARS,
    WAYS,
    code_errors,
    response_of,
    star_field,
)
from hilstar.instruments.study.predictors import ORION
from hilstar.instruments.study.study_benches import (
    MAX_RELIABLE_VI_MAG,
    held_out_errors,
    study_optics,
)
from hilstar.instruments.study.tradeoff.places import (
    NO_LIMIT_V_MAG,
    SPRITE_PSF,
    demo_config,
    stars_to,
    turn_to_image,
)
from hilstar.instruments.study.trials import Figure, Trial, Trials
from hilstar.optics.psf import MAX_CUT
from hilstar.optics.sprites import FrameLight, make_sprites, pack_sprites
from hilstar.server.bench.cameras import ideal_monitor
from hilstar.server.bench.config import Monitor, RenderSettings, SkySettings
from hilstar.server.bench.monitor import bench_calibration
from hilstar.server.bench.scene import brightest_peak_e_per_s
from hilstar.sky import electrons
from hilstar.sky.catalog import load_catalog
from hilstar.sky.spectrum import (
    GAUSS_ORDER,
    PLANCK_J_S,
    TEMPERATURE_SCALES,
    Curve,
    blackbody_exitance_w_m2_m,
    load_curve,
)
from hilstar.sky.stars import Stars
from hilstar.tracker.centroiders import FAMILY

SENSOR = "ccd47-20"
ADAPTIVE = "adaptive quadrature"
COLOURS = 3000  # stars of the catalogue that stand for all
STEPS_NM = (1.0, 5.0, 10.0, 20.0)
ORDERS = (1, 2, 3, 4, GAUSS_ORDER)
DEGREES = (5, 10, 20, electrons.TABLE_DEGREE)
BV_TABLE_SIZES = (16, 128, 1024)
# quad_vec is asked for this, relative to the largest of all stars' integrals, each near 1 by its
# own scale.
QUAD = 1e-12
# Two float64 integrals of some hundred terms, each known to about 1e-13, and QUAD's own.
PHOTOMETRY_ROUNDING_MAG = 5e-12

# Wavelengths, nm, and weights, m, that integrate a product of curves.
Rule = Callable[..., tuple[FloatArray, FloatArray]]
Integrand = Callable[[FloatArray], FloatArray]
OWN_SPECTRUM = "each star's own spectrum"
# A library's spectra are known to about 0.01 mag; a tenth of that counts as none.
LIBRARY_MAG = 1e-3
PSF_PHASES = 16
SIZES_PX = (6, 8, 9, 10, 11, 12, 16, 24)
# Wider than every sprite here, so that no tile of the phases loses light to its neighbour: 13 px
# are 15 sigma.
TILE_PX = 26
# Two stars' brightnesses: white, and 8 magnitudes under it, as faint as a 10-bit monitor is asked
# to show.
FAINTER_MAG = 8.0
SMALL_SIGMA_PX = 0.4  # of a star that sampling at pixel centres spoils
TABLE_SIZES = (64, 512, 4096)
# float32 rounds a star's electrons by 6e-8, and its brightest pixels by as much again.
ROUNDING_MAG = 1e-7
PHASES = 32
TAKEN = "exact"  # by `auto`, the default, at this depth
LIMITS_V_MAG = (5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0, 10.0)


@dataclass(frozen=True, slots=True)
class BlackBodies:
    """Stars of V = 0 by their colours (n,) and temperatures (n,), behind a sensor, and ways to
    their electron rates.
    """

    bv_mag: FloatArray
    kelvin: FloatArray
    optics: electrons.Optics

    def by_rule(self, rule: Rule) -> FloatArray:
        """Rates (n,) by a rule of nodes and weights."""

        def integral(integrand: Integrand, *curves: Curve) -> FloatArray:
            nodes_nm, weight_m = rule(*curves)
            return np.asarray(integrand(nodes_nm) @ weight_m)

        return self._rates(integral)

    def adaptive(self) -> FloatArray:
        """Rates (n,) by adaptive quadrature between the curves' knots."""
        return self._rates(adaptive_integral)

    def by_table(self, degree: int) -> FloatArray:
        """Rates (n,) by a table over 1/T, made for this."""
        photometry = electrons.Photometry()
        zero = np.zeros(len(self.bv_mag))
        if degree == electrons.TABLE_DEGREE:
            table = electrons.tabulate("dgs", self.optics, photometry)
            return table.electrons_per_s(zero, self.kelvin)
        low_k, high_k = electrons.TABLE_RANGE_K

        def log_rate(per_kelvin: FloatArray) -> FloatArray:
            rate = electrons.dgs_electrons_per_s(1 / per_kelvin, self.optics, photometry)
            return np.asarray(np.log(rate))

        series = Chebyshev.interpolate(log_rate, degree, [1 / high_k, 1 / low_k])
        return electrons.RateTable(series).electrons_per_s(zero, self.kelvin)

    def by_colour(self, size: int) -> FloatArray:
        """Rates (n,) by straight lines over B-V."""
        at_mag = np.linspace(self.bv_mag.min(), self.bv_mag.max(), size)
        kelvin = electrons.star_temperatures_k(at_mag, SkySettings().temperature)
        rate = electrons.dgs_electrons_per_s(kelvin, self.optics, electrons.Photometry())
        return np.asarray(np.exp(np.interp(self.bv_mag, at_mag, np.log(rate))))

    def average(self) -> FloatArray:
        """Rates (n,) by the average model, which are all one."""
        rate = electrons.ags_electrons_per_s(self.optics, electrons.Photometry())
        return np.full(len(self.bv_mag), rate)

    def _rates(self, integral: Callable[..., FloatArray]) -> FloatArray:
        """Thesis eq. 3.1 by any way of integrating.

        Spectra are scaled to 1 at 550 nm, so that one tolerance fits all stars.
        """
        kelvin = self.kelvin[:, None]
        passband = load_curve("johnson-v", "johnson-v")
        efficiency = self.optics.quantum_efficiency
        transmission = self.optics.transmission
        scale = blackbody_exitance_w_m2_m(np.array([550.0]), kelvin)

        def spectrum(nm: FloatArray) -> FloatArray:
            return np.asarray(blackbody_exitance_w_m2_m(nm, kelvin) / scale)

        def photons(nm: FloatArray) -> FloatArray:
            return spectrum(nm) * (efficiency(nm) * transmission(nm) * nm * 1e-9)

        v_band = integral(lambda nm: spectrum(nm) * passband(nm), passband)
        width = integral(lambda nm: passband(nm)[None], passband)
        detected = integral(photons, efficiency, transmission)
        mean_w_m2_m = electrons.reference_mean_w_m2_m(electrons.Photometry())
        per_spectrum = self.optics.area_m2 * mean_w_m2_m / (PLANCK_J_S * LIGHT_M_S)
        return np.asarray(per_spectrum * detected * width / v_band)


def adaptive_integral(integrand: Integrand, *curves: Curve) -> FloatArray:
    """An integral over the range that curves share, by adaptive quadrature between their knots."""
    knots = shared_knots(*curves)
    low_nm, high_nm = float(knots[0]), float(knots[-1])

    def at(nm: float) -> FloatArray:
        return integrand(np.array([nm]))[:, 0]

    exactly: Any = {"epsabs": 0, "epsrel": QUAD, "norm": "max", "points": knots}
    return np.asarray(quad_vec(at, low_nm, high_nm, **exactly)[0]) * 1e-9


def brightness(stack: ExitStack, quick: bool) -> Trials:
    """The integral of black bodies through a sensor: errors, mag, of the worst and the median of
    COLOURS stars of the catalogue.
    """
    del stack, quick
    # Equal shares of the catalogue, the bluest and the reddest star among them.
    shares = np.linspace(0, 1, COLOURS)
    bv_mag = np.quantile(load_catalog().bv_mag, shares, method="nearest")
    kelvin = electrons.star_temperatures_k(bv_mag, SkySettings().temperature)
    bodies = BlackBodies(bv_mag, kelvin, study_optics(SENSOR))
    default = table_name(electrons.TABLE_DEGREE)
    works: dict[str, Callable[[], FloatArray]] = {ADAPTIVE: bodies.adaptive}
    for step_nm in STEPS_NM:
        works[f"trapezoid, {step_nm:g} nm"] = partial(bodies.by_rule, partial(trapezoid, step_nm))
    for order in ORDERS:
        works[f"Gauss-Legendre, {order} per knot"] = partial(bodies.by_rule, partial(gauss, order))
    for degree in DEGREES:
        works[table_name(degree)] = partial(bodies.by_table, degree)
    for size in BV_TABLE_SIZES:
        works[f"straight lines over B-V, {size}"] = partial(bodies.by_colour, size)
    works["AGS"] = bodies.average
    exact = bodies.adaptive()
    trials = []
    for name, work in works.items():
        error = np.abs(magnitude(work() / exact))
        figures = float(error.max()), float(np.median(error))
        trials.append(Trial(name, *figures, work, name == default, name == ADAPTIVE))
    return Trials(
        "brightness",
        f"{COLOURS} black bodies, tables included",
        Figure("error of the integral, worst colour", "mag", PHOTOMETRY_ROUNDING_MAG),
        Figure("median colour", "mag"),
        "made once, it serves every star of a catalogue, for any curves of the sensor",
        trials,
        f"a bench asks for at most {len(load_catalog())} stars, each once: this time is spent when"
        " it is loaded",
    )


def table_name(degree: int) -> str:
    """The name of a table of a degree."""
    return f"table over 1/T, degree {degree}"


def trapezoid(step_nm: float, *curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Nodes, nm, and weights, m, of the trapezoid rule over the curves' range in steps of at
    most `step_nm`.
    """
    knots = shared_knots(*curves)
    first_nm, last_nm = knots[0], knots[-1]
    steps = int(np.ceil((last_nm - first_nm) / step_nm))
    nodes = np.linspace(first_nm, last_nm, steps + 1)
    weight = np.full(len(nodes), nodes[1] - nodes[0])
    weight[[0, -1]] /= 2
    return nodes, weight * 1e-9


def gauss(order: int, *curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Nodes, nm, and weights, m, of Gauss-Legendre quadrature between every two knots of the
    curves.
    """
    at, weight = np.polynomial.legendre.leggauss(order)
    knots = shared_knots(*curves)
    half = np.diff(knots)[:, None] / 2
    nodes = knots[:-1, None] + half * (1 + at)
    return nodes.ravel(), (half * weight).ravel() * 1e-9


def shared_knots(*curves: Curve) -> FloatArray:
    """Knots of all curves, nm, within the range that they share."""
    by_curve = [curve.wavelength_nm for curve in curves]
    low = max(nm[0] for nm in by_curve)
    high = min(nm[-1] for nm in by_curve)
    knots = np.unique(np.concatenate(by_curve))
    return np.asarray(knots[(knots >= low) & (knots <= high)])


def spectrum(stack: ExitStack, quick: bool) -> Trials:
    """Spectra from colours: error, mag, 95 % and median of the Pickles library bluer than V-I =
    2.5.
    """
    del stack, quick
    library = electrons.load_library()
    optics = study_optics(SENSOR)
    photometry = electrons.Photometry()
    exact = electrons.library_electrons_per_s(library, optics, photometry)
    count = len(library.spectral_type)
    zero = np.zeros(count)
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    sky = SkySettings()

    def trial(
        name: str, rates: FloatArray, work: Callable[[], object], settings: tuple[str, ...]
    ) -> Trial:
        error = np.abs(magnitude(rates / exact))[sure]
        default = (sky.brightness, sky.spectrum, sky.temperature)[: len(settings)]
        figures = float(np.percentile(error, 95)), float(np.median(error))
        return Trial(name, *figures, work, settings == default, name == OWN_SPECTRUM)

    by_own = partial(electrons.library_electrons_per_s, library, optics, photometry)
    trials = [trial(OWN_SPECTRUM, by_own(), by_own, ("dgs", "own"))]
    table = electrons.tabulate_pickles(optics, photometry)
    by_vi = partial(table.electrons_per_s, zero, library.bv_mag, library.vi_mag)
    held_out = exact * (1 + held_out_errors(exact))
    trials.append(trial("real spectra by V-I", held_out, by_vi, ("dgs", "pickles")))
    bodies = electrons.tabulate("dgs", optics, photometry)
    for scale in TEMPERATURE_SCALES:
        body = partial(body_rates, bodies, library.bv_mag, scale)
        settings = ("dgs", "blackbody", scale)
        trials.append(trial(f"black body, {scale}", body(), body, settings))
    average = electrons.tabulate("ags", optics, photometry)
    ags = partial(average.electrons_per_s, zero, np.full(count, 9602.0))
    trials.append(trial("AGS, one average", ags(), ags, ("ags",)))
    return Trials(
        "spectrum",
        f"{count} stars by a table made before",
        Figure("error of the electron rate, 95 % of library stars", "mag", LIBRARY_MAG),
        Figure("median star", "mag"),
        "a catalogue has colours and no spectra",
        trials,
    )


def body_rates(table: electrons.RateTable, bv_mag: FloatArray, scale: str) -> FloatArray:
    """Electron rates (n,) of black bodies of V = 0 by their colours."""
    kelvin = electrons.star_temperatures_k(bv_mag, scale)
    return table.electrons_per_s(np.zeros(len(bv_mag)), kelvin)


def psf(stack: ExitStack, quick: bool) -> Trials:
    """Methods that spread a star over pixels: flux error, mag, and centroid error, px, over
    PSF_PHASES^2 phases.
    """
    del quick  # every error is found in one draw
    side = PSF_PHASES * TILE_PX

    def exact_image(sprites: FrameLight) -> FloatArray:
        return linear_image(sprites, (side, side), SPRITE_PSF)

    errors = _psf_errors(TILE_PX, exact_image)
    field = star_field(FRAME_PX, TILE_PX)
    work: Callable[[], object] = partial(linear_image, field, FRAME_PX, SPRITE_PSF)
    trials = [Trial("exact integral, erfc in float64", *errors, work, is_exact=True)]
    for name, variant in splat_variants().items():
        renderer = stack.enter_context(VariantRenderer(Target(FRAME_PX, SPRITE_PSF), variant))

        def image(sprites: FrameLight, renderer: VariantRenderer = renderer) -> FloatArray:
            renderer.draw(sprites)
            return renderer.linear()[:side, :side].astype(np.float64)

        side_px = renderer.footprint_px
        work = partial(renderer.draw_and_wait, star_field(FRAME_PX, side_px))
        is_default = variant == SplatVariant()
        trials.append(Trial(name, *_psf_errors(side_px, image), work, is_default))
    sigma_x, sigma_y = SPRITE_PSF.width_px
    middle_share = 1 / (2 * np.pi * sigma_x * sigma_y)
    excess = middle_share / SPRITE_PSF.peak_share - 1
    sampled = sampled_flux(np.arange(PSF_PHASES) / PSF_PHASES)
    worst = np.abs(magnitude(sampled**2)).max()
    width, height = FRAME_PX
    return Trials(
        "psf",
        f"linear image of {STARS} stars, {width} x {height}",
        Figure("flux error, worst", "mag", ROUNDING_MAG),
        Figure("centre of gravity, worst", "px"),
        "methods this close change order from run to run; the default has the smallest footprint"
        f" that cuts at most {MAX_CUT:g} of a star's light at any phase, and needs no table",
        trials,
        "sampling at pixel centres gives a wide star the right sum and the wrong shape: its middle"
        f" pixel is {100 * excess:.0f} % too bright, and at sigma {SMALL_SIGMA_PX:g} px its flux is"
        f" off by {worst:.2f} mag",
    )


def sampled_flux(phase_px: FloatArray) -> FloatArray:
    """The sum along an axis of a narrow star that is sampled at pixel centres, by phase (n,)."""
    pixels = np.arange(-TILE_PX, TILE_PX + 1)
    offset = (pixels - phase_px[:, None]) / SMALL_SIGMA_PX
    height = np.exp(-0.5 * offset**2) / (SMALL_SIGMA_PX * np.sqrt(2 * np.pi))
    return np.asarray(height.sum(axis=1))


def splat_variants() -> dict[str, SplatVariant]:
    """The GPU's ways, by name; the renderer's own is the `SplatVariant()` that changes nothing."""
    own_px = SPRITE_PSF.footprint_px
    variants = {f"GL polynomial, R32F, {own_px} px": SplatVariant()}
    for side_px in SIZES_PX:
        if side_px != own_px:
            variants[f"GL polynomial, R32F, {side_px} px"] = SplatVariant(footprint_px=side_px)
    variants[f"GL polynomial, R16F, {own_px} px"] = SplatVariant(half_float=True)
    variants[f"GL erf, {own_px} px"] = SplatVariant("erf")
    variants[f"GL erf by exp, {own_px} px"] = SplatVariant("exp erf")
    for size in TABLE_SIZES:
        variants[f"GL table of {size}, {own_px} px"] = SplatVariant("table", table_size=size)
    variants[f"GL pixel centre, {own_px} px"] = SplatVariant("centre")
    return variants


def _psf_errors(size_px: int, image: Callable[[FrameLight], FloatArray]) -> tuple[float, float]:
    """Worst flux error, mag, and centroid error, px, of stars of a footprint, as `image` draws
    them.
    """
    side = PSF_PHASES * TILE_PX
    number = np.arange(PSF_PHASES) + 0.5
    place = number * TILE_PX + number / PSF_PHASES - 0.5
    columns, rows = np.meshgrid(place, place)
    star = np.arange(PSF_PHASES**2)
    flux = np.full(len(star), WHITE / SPRITE_PSF.peak_share)
    sprites = pack_sprites(columns.ravel(), rows.ravel(), flux, star, (side, side), size_px)
    bright = linear_image(sprites, (side, side), SPRITE_PSF, TILE_PX)
    flux_mag = 0.0
    centroid_px = 0.0
    for mag in (0.0, FAINTER_MAG):
        drawn = image(fainter(sprites, mag)).copy()
        errors = measure(bright * flux_ratio(mag), drawn, TILE_PX)
        flux_mag = max(flux_mag, errors.flux_max_mag)
        centroid_px = max(centroid_px, errors.centroid_max_px)
    return flux_mag, centroid_px


def quantisation(stack: ExitStack, quick: bool) -> Trials:
    """From light to codes at the default depth: errors of a star at the faint end of its aim, mag
    and px.
    """
    del quick  # every error is found at once
    bits = Monitor(resolution_px=FRAME_PX, pixel_pitch_um=1.0).bits
    mag = AIMS[bits][1]
    stealing = RenderSettings().bit_stealing
    trials = []
    for way in WAYS:
        (errors,) = code_errors(bits, way, PHASES, [mag])
        target = Target(FRAME_PX, SPRITE_PSF, response_of(bits, way), WHITE, way.method)
        renderer = stack.enter_context(Renderer(target))
        work = partial(_codes, renderer, star_field(FRAME_PX, renderer.footprint_px), count())
        is_default = (way.method, way.stealing) == (TAKEN, stealing)
        figures = errors.flux_max_mag, errors.max_px(JUDGE)
        more = {}
        for kind in FAMILY:
            more[f"max_px_{kind}"] = errors.max_px(kind)
        trials.append(Trial(way.name, *figures, work, is_default, more=more))
    taken = next(trial for trial in trials if trial.is_default)
    by_kind = ", ".join(f"{kind} {taken.more[f'max_px_{kind}']:.3f}" for kind in FAMILY)
    light = f"flux error of a star {mag:g} mag under white, {bits} bits, worst"
    width, height = FRAME_PX
    return Trials(
        "quantisation",
        f"codes of {STARS} stars, {width} x {height}, light to memory",
        Figure(light, "mag", ROUNDING_MAG),
        Figure("centroid error by a PSF fit, worst", "px"),
        "it needs no more than one frame and leaves no pattern that a tracker could take for a"
        " star",
        trials,
        f"by each centroider '{taken.method}' is off by at most: {by_kind} px",
    )


def _codes(renderer: Renderer, field: FrameLight, numbers: Iterator[int]) -> None:
    renderer.draw(field, next(numbers))
    renderer.levels()


def depth(stack: ExitStack, quick: bool) -> Trials:
    """How faint the catalogue goes: the light of the whole sky that is lost, %, and the stars in
    the frame.
    """
    del quick
    config = demo_config()
    camera = ideal_monitor(config)
    every = stars_to(NO_LIMIT_V_MAG)
    response = bench_calibration(config, Path()).response
    white = brightest_peak_e_per_s(every, SPRITE_PSF)
    target = Target(camera.resolution_px, SPRITE_PSF, response, white)
    renderer = stack.enter_context(Renderer(target))
    default = SkySettings().faintest_v_mag
    turn = turn_to_image(ORION, camera)

    def frame(stars: Stars) -> None:
        renderer.draw(make_sprites(stars, turn, camera, renderer.footprint_px))
        renderer.levels()

    trials = []
    for limit in sorted({*LIMITS_V_MAG, default, NO_LIMIT_V_MAG}):
        stars = stars_to(limit)
        lost = 0.0
        if len(stars) < len(every):
            share = stars.electrons_per_s.sum() / every.electrons_per_s.sum()
            lost = 100 * (1 - share)
        name = f"V to {limit:g}"
        if limit == NO_LIMIT_V_MAG:
            name = "all of Hipparcos"
        drawn = len(make_sprites(stars, turn, camera, renderer.footprint_px))
        work = partial(frame, stars)
        is_exact = limit == NO_LIMIT_V_MAG
        trials.append(Trial(name, lost, drawn, work, limit == default, is_exact))
    width, height = camera.resolution_px
    return Trials(
        "depth",
        f"a frame of Orion to codes, {width} x {height}",
        Figure("light of the catalogue lost", "%", 0.1),
        Figure("sprites in the frame", "stars"),
        "Hipparcos is complete to about V = 7.5",
        trials,
        "stars missing from Hipparcos are in no figure; it is complete to V = 7.3 to 9, by position"
        " and type (ESA SP-1200)",
    )
