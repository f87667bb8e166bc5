"""Trade-offs of light: brightness integral, spectrum from colours, PSF, quantisation, depth of
the catalogue.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path

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
COLOURS = 3000
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
SMALL_SIGMA_PX = 0.4
TABLE_SIZES = (64, 512, 4096)
# float32 rounds a star's electrons by 6e-8, and its brightest pixels by as much again.
ROUNDING_MAG = 1e-7
PHASES = 32
TAKEN = "exact"  # by `auto`, the default, at this depth
LIMITS_V_MAG = (5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0, 10.0)


def brightness(stack: ExitStack, quick: bool) -> Trials:
    """The integral of black bodies through a sensor: error, mag, worst over COLOURS of the
    catalogue and at the median one.
    """
    del stack, quick
    # Equal shares of the catalogue, the bluest and the reddest star among them.
    bv_mag = np.quantile(load_catalog().bv_mag, np.linspace(0, 1, COLOURS), method="nearest")
    optics = study_optics(SENSOR)
    photometry = electrons.Photometry()
    temperature = SkySettings().temperature
    kelvin = electrons.star_temperatures_k(bv_mag, temperature)

    def by_rule(rule: Rule) -> FloatArray:
        def integral(integrand: Callable[[FloatArray], FloatArray], *curves: Curve) -> FloatArray:
            nodes_nm, weight_m = rule(*curves)
            return np.asarray(integrand(nodes_nm) @ weight_m)

        return _rates(kelvin, optics, integral)

    def by_table(degree: int) -> FloatArray:
        if degree == electrons.TABLE_DEGREE:
            return electrons.tabulate("dgs", optics, photometry).electrons_per_s(
                np.zeros(COLOURS), kelvin
            )
        domain = [1 / electrons.TABLE_RANGE_K[1], 1 / electrons.TABLE_RANGE_K[0]]
        log_rate = Chebyshev.interpolate(
            lambda x: np.log(electrons.dgs_electrons_per_s(1 / x, optics, photometry)),
            degree,
            domain,
        )
        return electrons.RateTable(log_rate).electrons_per_s(np.zeros(COLOURS), kelvin)

    def by_colour(size: int) -> FloatArray:
        at_mag = np.linspace(bv_mag.min(), bv_mag.max(), size)
        rate = electrons.dgs_electrons_per_s(
            electrons.star_temperatures_k(at_mag, temperature), optics, photometry
        )
        return np.asarray(np.exp(np.interp(bv_mag, at_mag, np.log(rate))))

    tables = {degree: f"table over 1/T, degree {degree}" for degree in DEGREES}
    works: dict[str, Callable[[], FloatArray]] = {ADAPTIVE: partial(adaptive_rates, kelvin, optics)}
    works |= {f"trapezoid, {h:g} nm": partial(by_rule, partial(trapezoid, h)) for h in STEPS_NM}
    works |= {f"Gauss-Legendre, {n} per knot": partial(by_rule, partial(gauss, n)) for n in ORDERS}
    works |= {name: partial(by_table, degree) for degree, name in tables.items()}
    works |= {f"straight lines over B-V, {n}": partial(by_colour, n) for n in BV_TABLE_SIZES}
    works["AGS"] = lambda: np.full(COLOURS, electrons.ags_electrons_per_s(optics, photometry))
    exact = adaptive_rates(kelvin, optics)
    trials = []
    for name, work in works.items():
        error = np.abs(magnitude(work() / exact))
        figures = float(error.max()), float(np.median(error))
        trials.append(
            Trial(name, *figures, work, name == tables[electrons.TABLE_DEGREE], name == ADAPTIVE)
        )
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


def adaptive_rates(kelvin: FloatArray, optics: electrons.Optics) -> FloatArray:
    """Electron rates of V = 0 black bodies (n,) by adaptive quadrature between the curves'
    knots.
    """

    def integral(integrand: Callable[[FloatArray], FloatArray], *curves: Curve) -> FloatArray:
        knots = shared_knots(*curves)
        ends = float(knots[0]), float(knots[-1])

        def at(nm: float) -> FloatArray:
            return integrand(np.array([nm]))[:, 0]

        return (
            np.asarray(quad_vec(at, *ends, epsabs=0, epsrel=QUAD, norm="max", points=knots)[0])
            * 1e-9
        )

    return _rates(kelvin, optics, integral)


def _rates(
    kelvin: FloatArray, optics: electrons.Optics, integral: Callable[..., FloatArray]
) -> FloatArray:
    """Thesis eq. 3.1 with whatever integrates; spectra are scaled to 1 at 550 nm, so that one
    tolerance fits all stars.
    """
    passband = load_curve("johnson-v", "johnson-v")
    curves = (optics.quantum_efficiency, optics.transmission)
    scale = blackbody_exitance_w_m2_m(np.array([550.0]), kelvin[:, None])

    def spectrum(nm: FloatArray) -> FloatArray:
        return np.asarray(blackbody_exitance_w_m2_m(nm, kelvin[:, None]) / scale)

    v_band = integral(lambda nm: spectrum(nm) * passband(nm), passband)
    width = integral(lambda nm: passband(nm)[None], passband)
    detected = integral(
        lambda nm: spectrum(nm) * (curves[0](nm) * curves[1](nm) * nm * 1e-9), *curves
    )
    per_spectrum = (
        optics.area_m2
        * electrons.reference_mean_w_m2_m(electrons.Photometry())
        / (PLANCK_J_S * LIGHT_M_S)
    )
    return np.asarray(per_spectrum * detected * width / v_band)


def trapezoid(step_nm: float, *curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Nodes, nm, and weights, m, of the trapezoid rule over the curves' range in steps of at
    most `step_nm`.
    """
    knots = shared_knots(*curves)
    nodes = np.linspace(knots[0], knots[-1], int(np.ceil((knots[-1] - knots[0]) / step_nm)) + 1)
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
    return (knots[:-1, None] + half * (1 + at)).ravel(), (half * weight).ravel() * 1e-9


def shared_knots(*curves: Curve) -> FloatArray:
    """Knots of all curves, nm, within the range that they share."""
    low = max(c.wavelength_nm[0] for c in curves)
    high = min(c.wavelength_nm[-1] for c in curves)
    knots = np.unique(np.concatenate([c.wavelength_nm for c in curves]))
    return np.asarray(knots[(knots >= low) & (knots <= high)])


def spectrum(stack: ExitStack, quick: bool) -> Trials:
    """Spectra from colours: error, mag, 95 % and median of the Pickles library bluer than V-I =
    2.5.
    """
    del stack, quick
    library = electrons.load_library()
    optics = study_optics(SENSOR)
    exact = electrons.library_electrons_per_s(library, optics, electrons.Photometry())
    zero = np.zeros(len(library.spectral_type))
    sure = library.vi_mag < MAX_RELIABLE_VI_MAG
    sky = SkySettings()
    real = electrons.tabulate_pickles(optics, electrons.Photometry())
    bodies = electrons.tabulate("dgs", optics, electrons.Photometry())
    average = electrons.tabulate("ags", optics, electrons.Photometry())

    def trial(
        name: str, rates: FloatArray, work: Callable[[], object], settings: tuple[str, ...]
    ) -> Trial:
        error = np.abs(magnitude(rates / exact))[sure]
        default = (sky.brightness, sky.spectrum, sky.temperature)[: len(settings)]
        figures = float(np.percentile(error, 95)), float(np.median(error))
        return Trial(name, *figures, work, settings == default, name == OWN_SPECTRUM)

    by_own = partial(electrons.library_electrons_per_s, library, optics, electrons.Photometry())
    colours = zero, library.bv_mag, library.vi_mag
    held_out = exact * (1 + held_out_errors(exact))
    trials = [
        trial(OWN_SPECTRUM, by_own(), by_own, ("dgs", "own")),
        trial(
            "real spectra by V-I",
            held_out,
            partial(real.electrons_per_s, *colours),
            ("dgs", "pickles"),
        ),
    ]
    for scale in TEMPERATURE_SCALES:

        def body(scale: str = scale) -> FloatArray:
            return bodies.electrons_per_s(
                zero, electrons.star_temperatures_k(library.bv_mag, scale)
            )

        trials.append(trial(f"black body, {scale}", body(), body, ("dgs", "blackbody", scale)))
    ags = partial(average.electrons_per_s, zero, np.full(len(zero), 9602.0))
    trials.append(trial("AGS, one average", ags(), ags, ("ags",)))
    return Trials(
        "spectrum",
        f"{len(zero)} stars by a table made before",
        Figure("error of the electron rate, 95 % of library stars", "mag", LIBRARY_MAG),
        Figure("median star", "mag"),
        "a catalogue has colours and no spectra",
        trials,
    )


def psf(stack: ExitStack, quick: bool) -> Trials:
    """Methods that spread a star over pixels: flux error, mag, and centroid error, px, over
    PSF_PHASES^2 phases.
    """
    del quick  # every error is found in one draw
    side = PSF_PHASES * TILE_PX
    errors = _psf_errors(TILE_PX, lambda sprites: linear_image(sprites, (side, side), SPRITE_PSF))
    work: Callable[[], object] = partial(
        linear_image, star_field(FRAME_PX, TILE_PX), FRAME_PX, SPRITE_PSF
    )
    trials = [Trial("exact integral, erfc in float64", *errors, work, is_exact=True)]
    for name, variant in splat_variants().items():
        renderer = stack.enter_context(VariantRenderer(Target(FRAME_PX, SPRITE_PSF), variant))

        def image(sprites: FrameLight, renderer: VariantRenderer = renderer) -> FloatArray:
            renderer.draw(sprites)
            return renderer.linear()[:side, :side].astype(np.float64)

        work = partial(renderer.draw_and_wait, star_field(FRAME_PX, renderer.footprint_px))
        trials.append(
            Trial(name, *_psf_errors(renderer.footprint_px, image), work, variant == SplatVariant())
        )

    def sampled_flux(phase_px: FloatArray) -> FloatArray:
        offset_px = (np.arange(-TILE_PX, TILE_PX + 1) - phase_px[:, None]) / SMALL_SIGMA_PX
        return np.asarray(
            (np.exp(-0.5 * offset_px**2) / (SMALL_SIGMA_PX * np.sqrt(2 * np.pi))).sum(axis=1)
        )

    excess = 1 / (2 * np.pi * math.prod(SPRITE_PSF.width_px) * SPRITE_PSF.peak_share) - 1
    worst = np.abs(magnitude(sampled_flux(np.arange(PSF_PHASES) / PSF_PHASES) ** 2)).max()
    return Trials(
        "psf",
        f"linear image of {STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}",
        Figure("flux error, worst", "mag", ROUNDING_MAG),
        Figure("centre of gravity, worst", "px"),
        "methods this close change order from run to run; the default has the smallest footprint"
        f" that cuts at most {MAX_CUT:g} of a star's light at any phase, and needs no table",
        trials,
        "sampling at pixel centres gives a wide star the right sum and the wrong shape: its middle"
        f" pixel is {100 * excess:.0f} % too bright, and at sigma {SMALL_SIGMA_PX:g} px its flux is"
        f" off by {worst:.2f} mag",
    )


def splat_variants() -> dict[str, SplatVariant]:
    """The GPU's ways, by name; the renderer's own is the `SplatVariant()` that changes nothing."""
    footprint_px = SPRITE_PSF.footprint_px
    variants = {f"GL polynomial, R32F, {footprint_px} px": SplatVariant()}
    variants |= {
        f"GL polynomial, R32F, {size} px": SplatVariant(footprint_px=size)
        for size in SIZES_PX
        if size != footprint_px
    }
    variants |= {f"GL polynomial, R16F, {footprint_px} px": SplatVariant(half_float=True)}
    variants |= {f"GL erf, {footprint_px} px": SplatVariant("erf")}
    variants |= {f"GL erf by exp, {footprint_px} px": SplatVariant("exp erf")}
    variants |= {
        f"GL table of {size}, {footprint_px} px": SplatVariant("table", table_size=size)
        for size in TABLE_SIZES
    }
    variants |= {f"GL pixel centre, {footprint_px} px": SplatVariant("centre")}
    return variants


def _psf_errors(size_px: int, image: Callable[[FrameLight], FloatArray]) -> tuple[float, float]:
    """Worst flux error, mag, and centroid error, px, of stars of a footprint, as `image` draws
    them.
    """
    side = PSF_PHASES * TILE_PX
    place = (
        (np.arange(PSF_PHASES) + 0.5) * TILE_PX + (np.arange(PSF_PHASES) + 0.5) / PSF_PHASES - 0.5
    )
    x_px, y_px = (axis.ravel() for axis in np.meshgrid(place, place))
    flux = np.full(PSF_PHASES**2, WHITE / SPRITE_PSF.peak_share)
    star = np.arange(PSF_PHASES**2)
    sprites = pack_sprites(x_px, y_px, flux, star, (side, side), size_px)
    bright = linear_image(sprites, (side, side), SPRITE_PSF, TILE_PX)
    errors = []
    for mag in (0.0, FAINTER_MAG):
        errors.append(
            measure(bright * flux_ratio(mag), image(fainter(sprites, mag)).copy(), TILE_PX)
        )
    return max(e.flux_max_mag for e in errors), max(e.centroid_max_px for e in errors)


def quantisation(stack: ExitStack, quick: bool) -> Trials:
    """From light to codes at the default depth: flux error, mag, and centroid error, px, of a
    star at its aim's faint end.
    """
    del quick  # every error is found at once
    bits = Monitor(resolution_px=FRAME_PX, pixel_pitch_um=1.0).bits
    mag = AIMS[bits][1]
    stealing = RenderSettings().bit_stealing
    trials = []
    for way in WAYS:
        code_error = code_errors(bits, way, PHASES, [mag])[0]
        target = Target(FRAME_PX, SPRITE_PSF, response_of(bits, way), WHITE, way.method)
        renderer = stack.enter_context(Renderer(target))
        work = partial(_codes, renderer, star_field(FRAME_PX, renderer.footprint_px), count())
        max_px_by_kind = {f"max_px_{kind}": code_error.max_px(kind) for kind in FAMILY}
        is_default = (way.method, way.stealing) == (TAKEN, stealing)
        trials.append(
            Trial(
                way.name,
                code_error.flux_max_mag,
                code_error.max_px(JUDGE),
                work,
                is_default,
                more=max_px_by_kind,
            )
        )
    taken = next(trial for trial in trials if trial.is_default)
    by_each = ", ".join(f"{kind} {taken.more[f'max_px_{kind}']:.3f}" for kind in FAMILY)
    return Trials(
        "quantisation",
        f"codes of {STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}, light to memory",
        Figure(
            f"flux error of a star {mag:g} mag under white, {bits} bits, worst", "mag", ROUNDING_MAG
        ),
        Figure("centroid error by a PSF fit, worst", "px"),
        "it needs no more than one frame and leaves no pattern that a tracker could take for a"
        " star",
        trials,
        f"by each centroider '{taken.method}' is off by at most: {by_each} px",
    )


def _codes(renderer: Renderer, field: FrameLight, numbers: Iterator[int]) -> None:
    renderer.draw(field, next(numbers))
    renderer.levels()


def depth(stack: ExitStack, quick: bool) -> Trials:
    """How deep the catalogue goes: light of the whole sky that is lost, %, and stars drawn in
    the field.
    """
    del quick
    config = demo_config()
    camera = ideal_monitor(demo_config())
    every = stars_to(NO_LIMIT_V_MAG)
    response = bench_calibration(config, Path()).response
    white = brightest_peak_e_per_s(every, SPRITE_PSF)
    renderer = stack.enter_context(
        Renderer(Target(camera.resolution_px, SPRITE_PSF, response, white))
    )
    default = SkySettings().faintest_v_mag
    turn = turn_to_image(ORION, camera)
    trials = []

    def frame(stars: Stars) -> None:
        renderer.draw(make_sprites(stars, turn, camera, renderer.footprint_px))
        renderer.levels()

    for limit in sorted({*LIMITS_V_MAG, default, NO_LIMIT_V_MAG}):
        stars = stars_to(limit)
        if len(stars) < len(every):
            lost = 100 * (1 - stars.electrons_per_s.sum() / every.electrons_per_s.sum())
        else:
            lost = 0.0
        drawn = len(make_sprites(stars, turn, camera, renderer.footprint_px))
        if limit == NO_LIMIT_V_MAG:
            name = "all of Hipparcos"
        else:
            name = f"V to {limit:g}"
        trials.append(
            Trial(
                name, lost, drawn, partial(frame, stars), limit == default, limit == NO_LIMIT_V_MAG
            )
        )
    return Trials(
        "depth",
        f"a frame of Orion to codes, {camera.resolution_px[0]} x {camera.resolution_px[1]}",
        Figure("light of the catalogue lost", "%", 0.1),
        Figure("sprites in the frame", "stars"),
        "Hipparcos is complete to about V = 7.5",
        trials,
        "stars missing from Hipparcos are in no figure; it is complete to V = 7.3 to 9, by position"
        " and type (ESA SP-1200)",
    )
