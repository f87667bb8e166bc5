"""Where methods fail between sprites and codes: narrow and wide stars, edges, crowds, popping,
uneven and coarse panels.

Each case draws, so that its figures are those of the machine that runs it. Popping is one star's
light from frame to frame while the camera turns slowly.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.special import erf, ndtr

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.basics.units import flux_ratio, magnitude
from hilstar.display.geometry import monitor_camera
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantisation, shown_light
from hilstar.display.render.context import create_context
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Levels, Response, srgb_response
from hilstar.instruments.study.codes import AIMS
from hilstar.instruments.study.stability import CaseFigures, FailureCase
from hilstar.optics.psf import MAX_CUT, SQRT2, GaussianPsf, pixel_shares
from hilstar.optics.sprites import FrameLight, join_sprites, make_sprites, pack_sprites
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, load_catalog
from hilstar.sky.stars import make_stars, unit_vectors_icrs

IMAGE_PX = (512, 512)
MIDDLE_PX = 256
OFF_MIDDLE_PX = (256.3, 256.0)
SIGMA_PX = 0.85  # of sprites by default
SEED = 1
# The shader's erf (tests/gpu/test_renderer.py); a share along an axis is half the difference of
# two.
ERF_ERROR = 4.4e-7
# The footprint cuts MAX_CUT of a star's light, and the outermost edges along both axes are off by
# ERF_ERROR.
FLUX_ERROR = MAX_CUT + 2 * ERF_ERROR
# The share of the peak along an axis is 1 / (sqrt(2 pi) 20) at sigma 20, and there are two axes.
PEAK_ERROR = 2 * ERF_ERROR * float(np.sqrt(2 * np.pi)) * 20
CENTROID_PX = 1.1e-5  # README.md promises it of the linear image
NOTHING = 0.0
CROWD, CROWD_PX, CORNER_PX = 100_000, (1024, 1024), 128
# Ten stars on a pixel are added in float32: half of 1.2e-7 each time, on top of each star's own
# error.
CROWD_ERROR = FLUX_ERROR + 10 * 6e-8
# Popping: the demo's lens and pitch (configs/demo.toml), and a star that moves by PATH_PX in STEPS
# frames.
FOCAL_LENGTH_MM, PITCH_UM, ALIGNED = 350.0, 57.65, np.array([1.0, 0.0, 0.0, 0.0])
STEPS, PATH_PX, MOVING_PX = 1000, (3.0, 1.7), (32, 32)
RIPPLE = 1e-4  # mag, a two-hundredth of the finest aim for codes: larger ripples are the monitor's
CODES_MAG_UNDER_WHITE, CODES_BITS = 6.0, 8
POINT_SAMPLED = "the Gaussian's value at the middle of each pixel"

# splat.frag's, from the highest power of x^2 down.
ERF_NUMERATOR = (
    *(-2.72614225801306e-10, 2.77068142495902e-08, -2.10102402082508e-06, -5.69250639462346e-05),
    *(-7.34990630326855e-04, -2.95459980854025e-03, -1.60960333262415e-02),
)
ERF_DENOMINATOR = (
    *(-1.45660718464996e-05, -2.13374055278905e-04, -1.68282697438203e-03),
    *(-7.37332916720468e-03, -1.42647390514189e-02),
)

Draw = Callable[[FrameLight], FloatArray]
CODES_SEED = 6
# groups of stars along either side of the image, and the side of each one's part of it
COUNT, TILE_PX = 8, 22
SIDE_PX = COUNT * TILE_PX
WHITE = 1.0  # light of white, of which errors are shares
FAINT_MAG = 6.0  # under the star whose peak is white
NARROW_PX = 0.3
# A star of equal steps can have its light within half of one and no nearer; where steps differ it
# comes nearer than that.
STEPS_A_STAR = 0.5
# A star of so few pixels, lit by codes whose steps are several of the smallest.
NARROW_STEPS = 0.6
ROUNDING = 'quantisation = "round"'
TOGETHER = (
    "exact chooses the codes of a star's own pixels together, for what of its light is to be seen"
    " there"
)


def target(sigma_px: float, size_px: tuple[int, int] = IMAGE_PX) -> Target:
    """A linear image with round stars."""
    return Target(size_px, GaussianPsf((sigma_px, sigma_px)))


def one_star(x_px: float, y_px: float, on: Target, electrons_per_s: float = 1.0) -> FrameLight:
    """One star with the sigma of a target."""
    star = np.zeros(1, dtype=np.intp)
    x, y, rate = np.array([[x_px], [y_px], [electrons_per_s]])
    return pack_sprites(x, y, rate, star, on.resolution_px, on.psf.footprint_px)


@contextmanager
def by_renderer(on: Target) -> Iterator[Draw]:
    """A function that draws the linear image (h, w) of sprites as hilstar does."""
    with Renderer(on) as gl:

        def draw(sprites: FrameLight) -> FloatArray:
            gl.draw(sprites)
            return gl.linear().astype(np.float64)

        yield draw


def drawn(on: Target, sprites: FrameLight) -> FloatArray:
    """The linear image (h, w) of sprites as hilstar draws them."""
    with by_renderer(on) as draw:
        return draw(sprites)


def _outer(
    on: Target, sprites: FrameLight, shares: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """One star's image from its shares along each axis.

    `shares` takes the pixels' offsets from the star, px, and its sigma, px.
    """
    width, height = on.resolution_px
    sigma_x, sigma_y = on.psf.width_px
    x_offset_px = np.arange(width) - sprites.x_px[0]
    along_x = shares(x_offset_px, sigma_x)
    y_offset_px = np.arange(height) - sprites.y_px[0]
    along_y = shares(y_offset_px, sigma_y)
    rate = float(sprites.data["electrons_per_s"][0])
    return np.asarray(rate * np.outer(along_y, along_x))


def point_sampled(on: Target, sprites: FrameLight) -> FloatArray:
    """One star with the Gaussian's value at the middle of each pixel, (h, w)."""

    def gaussian(offset_px: FloatArray, sigma_px: float) -> FloatArray:
        exponential = np.exp(-0.5 * (offset_px / sigma_px) ** 2)
        area_px = sigma_px * np.sqrt(2 * np.pi)
        return np.asarray(exponential / area_px)

    return _outer(on, sprites, gaussian)


def half_float(on: Target, sprites: FrameLight) -> FloatArray:
    """One star by erf differences in float16, the minimum that GLES calls mediump."""
    return _by_erf(on, sprites, lambda edge: erf(edge).astype(np.float16))


def bare_polynomial(on: Target, sprites: FrameLight) -> FloatArray:
    """One star by the shader's polynomial in float32, without its max(difference, 0)."""
    return _by_erf(on, sprites, erf_float32)


def _by_erf(
    on: Target, sprites: FrameLight, erf_of: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    def shares(offset_px: FloatArray, sigma_px: float) -> FloatArray:
        width_px = sigma_px * SQRT2
        far = erf_of((offset_px + 0.5) / width_px)
        near = erf_of((offset_px - 0.5) / width_px)
        return np.asarray((far - near).astype(np.float64) / 2)

    return _outer(on, sprites, shares)


def nearest_pixel(on: Target, sprites: FrameLight) -> FloatArray:
    """One star with all of its light in the nearest pixel."""

    def shares(offset_px: FloatArray, _: float) -> FloatArray:
        nearest = np.zeros(len(offset_px))
        nearest[np.abs(offset_px).argmin()] = 1.0
        return nearest

    return _outer(on, sprites, shares)


def erf_float32(value: FloatArray) -> FloatArray:
    """erf by splat.frag's rational polynomial, every step in float32; same shape."""
    x = np.clip(value, -4, 4).astype(np.float32)
    square = x * x
    numerator = np.array(ERF_NUMERATOR, dtype=np.float32)
    above = np.polyval(numerator, square)
    denominator = np.array(ERF_DENOMINATOR, dtype=np.float32)
    below = np.polyval(denominator, square)
    return np.asarray(x * above / below)


@dataclass(frozen=True, slots=True)
class PhaseErrors:
    """The largest errors over sub-pixel phases of a star's flux, relative, and of its centre of
    gravity, px.

    `peak` is that of its middle pixel's light, relative to the true share and with its sign.
    """

    flux: float
    centroid_px: float
    peak: float


def star_errors(draw: Draw, on: Target, phases_px: FloatArray) -> PhaseErrors:
    """The largest errors of a star's image over sub-pixel phases (n,)."""
    sigma_x, sigma_y = on.psf.width_px
    columns = np.arange(IMAGE_PX[0])
    true_down = pixel_shares(np.zeros(1), sigma_y)[0]
    flux_error = 0.0
    off_px = 0.0
    peak_error = 0.0
    for phase in phases_px:
        image = draw(one_star(MIDDLE_PX + phase, float(MIDDLE_PX), on))
        light = float(image.sum())
        centre_px = float(image.sum(axis=0) @ columns) / light
        middle = np.rint(phase)
        across_px = middle - phase
        true_across = pixel_shares(np.array([across_px]), sigma_x)[0]
        peak = float(image[MIDDLE_PX, int(MIDDLE_PX + middle)])
        flux_error = max(flux_error, abs(light - 1))
        light_off_centre_px = centre_px - MIDDLE_PX - phase
        off_px = max(off_px, abs(light_off_centre_px))
        true_peak = float(true_across * true_down)
        peak_error = max(peak_error, peak / true_peak - 1, key=abs)
    return PhaseErrors(flux_error, off_px, peak_error)


def narrow_star() -> FailureCase:
    """Sigma 0.1 px."""
    ours, sampled = narrow_errors(0.1)
    wider, wider_sampled = narrow_errors(0.5)
    places = f"{sampled.centroid_px:.2f} px ({wider_sampled.centroid_px:.4f} at sigma 0.5)"
    own_places = f"{ours.centroid_px:.2f} px ({wider.centroid_px:.4f} at sigma 0.5)"
    fails = f"flux off by up to {100 * sampled.flux:.0f} %, centre of gravity by {places}"
    happens = f"flux off by {ours.flux:.1e}; centre of gravity by {own_places}"
    why = (
        "the Gaussian is integrated over pixels; pixels of any display keep that centroid error:"
        " write 0.5 px or more"
    )
    figures = CaseFigures(ours.flux, sampled.flux, FLUX_ERROR)
    return FailureCase("sigma 0.1 px", POINT_SAMPLED, fails, happens, why, figures)


def narrow_errors(sigma_px: float) -> tuple[PhaseErrors, PhaseErrors]:
    """The errors of the renderer, and those of point sampling."""
    on = target(sigma_px)
    phases = np.linspace(-0.5, 0.5, 21)
    with by_renderer(on) as draw:
        ours = star_errors(draw, on, phases)
    sampled = star_errors(partial(point_sampled, on), on, phases)
    return ours, sampled


def wide_star() -> FailureCase:
    """Sigma 20 px."""
    on = target(20.0)
    sprites = one_star(*OFF_MIDDLE_PX, on)
    exact = linear_image(sprites, on.resolution_px, on.psf)
    image = drawn(on, sprites)
    brightest = exact.max()
    error = float(np.abs(image - exact).max() / brightest)
    half_floats = half_float(on, sprites)
    fault = float(np.abs(half_floats - exact).max() / brightest)
    case = "sigma 20 px"
    method = "erf differences in half floats"
    fails = f"a pixel off by up to {100 * fault:.0f} % of the peak"
    flux_off = image.sum() - 1
    happens = f"{error:.0e} of the peak; the star's flux off by {flux_off:+.0e}"
    why = "float32 differences are small against the flux, and their errors cancel in the sum"
    figures = CaseFigures(error, fault, PEAK_ERROR)
    return FailureCase(case, method, fails, happens, why, figures)


def negative_wings() -> FailureCase:
    """Far from a star both erfs are 1 but for rounding."""
    on = target(20.0)
    sprites = one_star(*OFF_MIDDLE_PX, on)
    bare = bare_polynomial(on, sprites)
    error = int((drawn(on, sprites) < 0).sum())
    fault = int((bare < 0).sum())
    case = "the wings of a star, sigma 20 px"
    method = "float32 erf differences as they come"
    fails = f"{fault} pixels of negative light, down to {bare.min():.0e} of the star's"
    happens = f"{error} negative pixels"
    why = "the shader takes the larger of difference and 0"
    figures = CaseFigures(float(error), float(fault), NOTHING)
    return FailureCase(case, method, fails, happens, why, figures)


def floored_wings() -> FailureCase:
    """A floor of 1e-7 under each pixel's share."""
    on = target(SIGMA_PX)
    sprites = one_star(*OFF_MIDDLE_PX, on)
    error = float(abs(drawn(on, sprites).sum() - 1))
    floored = np.maximum(_outer(on, sprites, pixel_shares), 1e-7)
    fault = float(floored.sum() - 1)
    width, height = IMAGE_PX
    case = "a floor of 1e-7 of a star's light"
    method = "max(share, 1e-7) in every pixel"
    fails = f"adds {100 * fault:.1f} % to each star, over {width} x {height} pixels"
    happens = f"flux off by {error:.0e}"
    why = "no floor: outside its footprint a star has no light"
    figures = CaseFigures(error, fault, FLUX_ERROR)
    return FailureCase(case, method, fails, happens, why, figures)


def absurd_sigmas() -> FailureCase:
    """Sigmas that no sprite can hold."""
    context = create_context()
    point_px = int(context.info["GL_POINT_SIZE_RANGE"][1])
    context.release()
    refusals = []
    cuts = []
    silently_cut = NOTHING
    for sigma_px in (60.0, 1e6):
        psf = GaussianPsf((sigma_px, sigma_px))
        cuts.append(psf.cut_share(point_px))
        try:
            Renderer(Target(IMAGE_PX, psf)).close()
            silently_cut = max(silently_cut, cuts[-1])
        except InputError as refusal:
            refusals.append(str(refusal))
    method = f"GL's largest point, {point_px} px, whatever the sigma"
    first_percent = 100 * cuts[0]
    last_percent = 100 * cuts[1]
    fails = f"cuts {first_percent:.1f} % and {last_percent:.5f} % of a star's light"
    reasons = " | ".join(refusals)
    happens = f"refused: {reasons}"
    why = "a point of GL is a star's footprint"
    figures = CaseFigures(silently_cut, max(cuts), MAX_CUT)
    return FailureCase("sigma 60 and 1e6 px", method, fails, happens, why, figures)


def star_on_pixel_edge() -> FailureCase:
    """A star where two pixels meet, and a hair to either side."""
    on = target(SIGMA_PX)
    phases = np.array([-0.5, 0.5 - 1e-9, 0.5, 0.5 + 1e-9])
    with by_renderer(on) as draw:
        off_px = star_errors(draw, on, phases).centroid_px
    by_nearest = partial(nearest_pixel, on)
    fault_px = star_errors(by_nearest, on, phases).centroid_px
    case = "a star on a pixel's edge"
    method = "the nearest pixel"
    fails = f"centre {fault_px:.2f} px off, to either side"
    happens = f"centre {off_px:.0e} px off"
    why = "light goes to both pixels; place is whole pixel and float32 fraction"
    figures = CaseFigures(off_px, fault_px, CENTROID_PX)
    return FailureCase(case, method, fails, happens, why, figures)


def star_on_image_edge() -> FailureCase:
    """Stars whose centres are on and beyond the image's edges and corner."""
    last = IMAGE_PX[0] - 1.0
    on = target(SIGMA_PX)
    beyond = last + 0.6
    error = 0.0
    fault = 0.0
    for x_px, y_px in (
        *((-0.5, 256.0), (-0.6, 256.0), (beyond, 256.0)),
        *((256.0, -2.0), (-0.6, beyond)),
    ):
        places = np.array([x_px, y_px])
        before = ndtr((places - last - 0.5) / SIGMA_PX)
        until = ndtr((places + 0.5) / SIGMA_PX)
        shares = until - before
        exact = float(np.prod(shares))
        pixel = np.rint(places)
        on_image = (pixel >= 0) & (pixel <= last)
        inside = bool(on_image.all())
        sprites = one_star(x_px, y_px, on)
        light = float(drawn(on, sprites).sum())
        error = max(error, abs(light - exact))
        fault = max(fault, abs(float(inside) - exact))
    case = "stars on the image's edge"
    method = "a star drawn whole or not at all, by its centre"
    fails = f"up to {100 * fault:.0f} % of its light too much or too little"
    happens = f"light on the image off by {error:.0e} of the star's"
    why = "a star is drawn where its footprint touches the image, and cut there"
    figures = CaseFigures(error, fault, FLUX_ERROR)
    return FailureCase(case, method, fails, happens, why, figures)


def indexed_light(sprites: FrameLight, size_px: tuple[int, int]) -> FloatArray:
    """The image (h, w) of stars by `image[rows, columns] += light`."""
    half_px = (sprites.footprint_px - 1) // 2
    steps = np.arange(sprites.footprint_px) - half_px
    columns = sprites.data["pixel"][:, 0, None] + steps
    rows = sprites.data["pixel"][:, 1, None] + steps
    share_x = pixel_shares(columns - sprites.x_px[:, None], SIGMA_PX)
    share_y = pixel_shares(rows - sprites.y_px[:, None], SIGMA_PX)
    light = share_y * sprites.data["electrons_per_s"][:, None]
    image = np.zeros(size_px[::-1])
    pixels = light[:, :, None] * share_x[:, None, :]
    image[rows[:, :, None], columns[:, None, :]] += pixels
    return image


def many_stars() -> FailureCase:
    """100 000 stars in view."""
    rng = np.random.default_rng(SEED)
    x_px, y_px = rng.uniform(10, CROWD_PX[0] - 11, (2, CROWD))
    flux = 10 ** rng.uniform(0, 4, CROWD)
    star = np.arange(CROWD)
    on = target(SIGMA_PX, CROWD_PX)
    side_px = on.psf.footprint_px
    sprites = pack_sprites(x_px, y_px, flux, star, CROWD_PX, side_px)
    image = drawn(on, sprites)
    corner_px = (CORNER_PX, CORNER_PX)
    in_corner = pack_sprites(x_px, y_px, flux, star, corner_px, side_px)
    corner = linear_image(in_corner, corner_px, on.psf)
    off = np.abs(image[:CORNER_PX, :CORNER_PX] - corner)
    pixel_error = float(off.max() / corner.max())
    indexed = indexed_light(sprites, CROWD_PX)
    wanted_flux = flux.sum()
    error = float(abs(image.sum() / wanted_flux - 1))
    fault = float(abs(indexed.sum() / wanted_flux - 1))
    case = f"{CROWD} stars in view"
    fails = f"{100 * fault:.0f} % of the light lost: a repeated index is added once"
    happens = (
        f"light off by {error:.0e}; {pixel_error:.0e} of the brightest pixel, over {CORNER_PX} x"
        f" {CORNER_PX}"
    )
    why = "the GPU blends every sprite, in float32"
    figures = CaseFigures(max(error, pixel_error), fault, CROWD_ERROR)
    return FailureCase(case, "image[rows, columns] += light", fails, happens, why, figures)


def flux_range() -> FailureCase:
    """Twelve decades side by side."""
    bright_e, faint_e = 1e12, 1.0
    on = target(SIGMA_PX)
    bright = one_star(100.3, 256.0, on, bright_e)
    faint = one_star(120.3, 256.0, on, faint_e)
    both = join_sprites([bright, faint], bright.footprint_px)
    image = drawn(on, both)
    full_scale = image.max()
    scaled = np.rint(image / full_scale * 65535) * full_scale / 65535

    def flux_errors(shown: FloatArray) -> tuple[float, float]:
        """The errors of both stars' light, relative."""
        bright_light = float(shown[:, :110].sum())
        faint_light = float(shown[:, 110:].sum())
        return abs(bright_light / bright_e - 1), abs(faint_light / faint_e - 1)

    errors = flux_errors(image)
    faults = flux_errors(scaled)
    case = "flux range 1e12"
    method = "16 bits, scaled to the brightest pixel"
    fails = f"fluxes off by {faults[0]:.0e} and {faults[1]:.0e}: the faint star is gone"
    happens = f"fluxes off by {errors[0]:.0e} and {errors[1]:.0e}"
    why = "float32, and each star in its own footprint"
    figures = CaseFigures(max(errors), max(faults), FLUX_ERROR)
    return FailureCase(case, method, fails, happens, why, figures)


def moving_star(on: Target, electrons_per_s: float = 1.0) -> Iterator[FrameLight]:
    """Sirius at a given flux in STEPS frames of the demo's camera, which turns until the star
    has moved by PATH_PX.
    """
    sirius = load_catalog().brighter_than(-1.0)
    vectors = unit_vectors_icrs(sirius, HIPPARCOS_EPOCH_JYEAR)
    rates = np.full(1, electrons_per_s)
    unknown_mag = np.full(1, np.nan)
    stars = make_stars(sirius, vectors, unknown_mag, rates)
    camera = monitor_camera(on.resolution_px, PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    sirius_ra_deg = float(sirius.ra_deg[0])
    sirius_dec_deg = float(sirius.dec_deg[0])
    start = from_radec_roll_deg(sirius_ra_deg, sirius_dec_deg, 20.0)
    across_px, down_px = PATH_PX
    # A turn about x moves stars up the image, one about -y to the right.
    turn_rad = np.array([-down_px, -across_px, 0.0]) / camera.focal_length_px
    for share in np.linspace(0, 1, STEPS):
        turn = to_matrix(propagate(start, share * turn_rad, 1.0))
        yield make_sprites(stars, turn, camera, on.psf.footprint_px)


def moving_fluxes(draw: Draw, on: Target) -> FloatArray:
    """The moving star's light (steps,) in each image."""
    return np.array([draw(sprites).sum() for sprites in moving_star(on)])


@cache  # a case and a chart
def moving_code_fluxes(quantisation: Quantisation) -> FloatArray:
    """The light (steps,) of the moving star on an sRGB monitor, relative to the wanted light.

    It is CODES_MAG_UNDER_WHITE fainter than a star whose peak is white.
    """
    psf = GaussianPsf((SIGMA_PX, SIGMA_PX))
    response = srgb_response(CODES_BITS)
    flux = flux_ratio(CODES_MAG_UNDER_WHITE) / psf.peak_share
    on = Target(MOVING_PX, psf, response, 1.0, quantisation)
    light = []
    with Renderer(on) as gl:
        for sprites in moving_star(on, flux):
            gl.draw(sprites)
            shown = response.light[gl.levels()]
            light.append(shown.sum())
    return np.array(light) / flux


def ripple(fluxes: FloatArray) -> float:
    """The range of a star's fluxes, relative to their mean."""
    fluxes_range = fluxes.max() - fluxes.min()
    return float(fluxes_range / fluxes.mean())


def ripple_mag(fluxes: FloatArray) -> float:
    """The range of a star's fluxes, mag."""
    share = float(fluxes.min() / fluxes.max())
    return float(magnitude(share))


def popping() -> FailureCase:
    """A star's light in the linear image while the camera turns by parts of a pixel."""
    on = target(0.5, MOVING_PX)
    with by_renderer(on) as draw:
        error = ripple(moving_fluxes(draw, on))
    by_samples = partial(point_sampled, on)
    fault = ripple(moving_fluxes(by_samples, on))
    case = f"a star over {STEPS} sub-pixel steps, sigma 0.5 px"
    fails = f"its light varies by {100 * fault:.1f} %"
    happens = f"varies by {error:.1e} in the linear image"
    why = "integrated over pixels, and cut where 1e-6 of the light remains"
    figures = CaseFigures(error, fault, RIPPLE)
    return FailureCase(case, POINT_SAMPLED, fails, happens, why, figures)


def popping_codes() -> FailureCase:
    """The same star's light through 8-bit codes."""
    fault = ripple_mag(moving_code_fluxes("round"))
    error = ripple_mag(moving_code_fluxes("exact"))
    under_white = f"{CODES_MAG_UNDER_WHITE:g} mag under white"
    case = f"the same, {under_white} on {CODES_BITS} bits, sigma {SIGMA_PX:g} px"
    fails = f"its light varies by {fault:.3f} mag"
    happens = f'quantisation = "exact", what `auto` takes there: {error:.3f} mag'
    why = "round adds up the errors of its pixels; exact chooses a star's codes together"
    figures = CaseFigures(error, fault, AIMS[CODES_BITS][0])
    return FailureCase(case, ROUNDING, fails, happens, why, figures)


@dataclass(frozen=True, slots=True)
class CodeScene:
    """Groups of `stars` stars, each group alone in its part of the image, on a panel."""

    sprites: FrameLight
    sigma_px: float
    panel: Panel
    stars: int = 1

    @property
    def psf(self) -> GaussianPsf:
        """The spread of a star."""
        return GaussianPsf((self.sigma_px, self.sigma_px))

    def linear(self) -> FloatArray:
        """The light (h, w) of the stars."""
        return linear_image(self.sprites, (SIDE_PX, SIDE_PX), self.psf)

    def wanted(self) -> FloatArray:
        """The light (h, w) that a panel of any number of levels would show."""
        light = self.linear()
        if self.panel.uniformity is None:
            return np.asarray(np.minimum(light, WHITE))
        return np.asarray(np.minimum(light, WHITE * self.panel.uniformity))


def codes_of(scene: CodeScene, quantisation: Quantisation) -> Levels:
    """The codes (h, w) as hilstar draws them."""
    panel = scene.panel
    size_px = (SIDE_PX, SIDE_PX)
    on = Target(size_px, scene.psf, panel.response, WHITE, quantisation, panel.uniformity)
    with Renderer(on) as gl:
        gl.draw(scene.sprites)
        return gl.levels().copy()


def exact_codes(scene: CodeScene) -> Levels:
    """The codes (h, w) of `exact`."""
    return codes_of(scene, "exact")


def light_by_part(image: FloatArray) -> FloatArray:
    """The light of each part of an image, (COUNT, COUNT)."""
    parts = image.reshape(COUNT, TILE_PX, COUNT, TILE_PX)
    return np.asarray(parts.sum(axis=(1, 3)))


def error_steps(codes: Levels, scene: CodeScene) -> float:
    """The error of the groups' light, rms, in the panel's smallest steps."""
    shown = light_by_part(shown_light(codes, scene.panel))
    wanted = light_by_part(scene.wanted())
    off = (shown - wanted)[wanted > 0]
    step = scene.panel.response.light[1] * WHITE
    mean_square = np.mean(np.square(off))
    return float(np.sqrt(mean_square) / step)


def sprites_of(
    x_px: FloatArray, y_px: FloatArray, under_white_mag: FloatArray, sigma_px: float
) -> FrameLight:
    """Stars at places (n,), px, in magnitudes (n,) under the one whose peak is white."""
    psf = GaussianPsf((sigma_px, sigma_px))
    light = WHITE * flux_ratio(under_white_mag) / psf.peak_share
    star = np.arange(len(x_px))
    size_px = (SIDE_PX, SIDE_PX)
    return pack_sprites(x_px, y_px, light, star, size_px, psf.footprint_px)


def middles() -> tuple[FloatArray, FloatArray]:
    """A place in each part of the image, each at another sub-pixel phase: x and y."""
    number = np.arange(COUNT) + 0.5
    place = number * TILE_PX - 0.5 + number / COUNT - 0.5
    x_px, y_px = np.meshgrid(place, place)
    return x_px.ravel(), y_px.ravel()


def lone_stars(
    under_white_mag: float,
    response: Response,
    sigma_px: float = SIGMA_PX,
    uniformity: Float32Array | None = None,
) -> CodeScene:
    """A star in each part of the image."""
    x_px, y_px = middles()
    mags = np.full(len(x_px), under_white_mag)
    sprites = sprites_of(x_px, y_px, mags, sigma_px)
    panel = Panel(response, WHITE, uniformity)
    return CodeScene(sprites, sigma_px, panel)


def neighbours(mags: tuple[float, float], apart_px: float) -> CodeScene:
    """Two stars in each part, in all directions from each other."""
    x_px, y_px = middles()
    angle = np.linspace(0, 2 * np.pi, len(x_px), endpoint=False)
    across_px = apart_px * np.cos(angle)
    both_x = np.append(x_px, x_px + across_px)
    down_px = apart_px * np.sin(angle)
    both_y = np.append(y_px, y_px + down_px)
    both_mag = np.repeat(mags, len(x_px))
    sprites = sprites_of(both_x, both_y, both_mag, SIGMA_PX)
    panel = Panel(srgb_response(8), WHITE)
    return CodeScene(sprites, SIGMA_PX, panel, 2)


def half_off() -> CodeScene:
    """Stars centred on the screen's edges, at every place within a pixel along and across them."""
    count = COUNT - 2
    along = middles()[0][1 : COUNT - 1]
    across = (np.roll(np.arange(count), 2) + 0.5) / count - 1.0
    far = SIDE_PX - 1 - across
    x_px = np.concatenate([across, far, along, along])
    y_px = np.concatenate([along, along, across, far])
    mags = np.full(len(x_px), FAINT_MAG)
    sprites = sprites_of(x_px, y_px, mags, SIGMA_PX)
    panel = Panel(srgb_response(8), WHITE)
    return CodeScene(sprites, SIGMA_PX, panel)


def uneven_panel() -> CodeScene:
    """Stars on pixels that differ by 5 %, with a fall to the corners."""
    y_px, x_px = np.mgrid[:SIDE_PX, :SIDE_PX] / SIDE_PX - 0.5
    fall = 1 - 0.3 * np.hypot(x_px, y_px)
    rng = np.random.default_rng(CODES_SEED)
    noise = rng.normal(0, 0.05, x_px.shape)
    uniformity = (fall + noise).astype(np.float32)
    return lone_stars(FAINT_MAG, srgb_response(8), uniformity=uniformity)


def judged(
    case: str, scene: CodeScene, why: str = TOGETHER, steps_a_star: float = STEPS_A_STAR
) -> FailureCase:
    """Compares rounding with `exact` by the light of each group of stars."""
    fault = error_steps(codes_of(scene, "round"), scene)
    error = error_steps(exact_codes(scene), scene)
    fails = f"a star's light off by {fault:.2g} of the panel's smallest steps rms"
    happens = f"by {error:.2g} steps"
    figures = CaseFigures(error, fault, steps_a_star * scene.stars)
    return FailureCase(case, ROUNDING, fails, happens, why, figures)


def coded_half_off() -> FailureCase:
    """Stars on the screen's edges."""
    case = f"stars half off the screen, {FAINT_MAG:g} mag under white on 8 bits"
    return judged(case, half_off())


def coded_neighbours() -> FailureCase:
    """Two stars that share pixels."""
    case = f"two stars 1 px apart, {FAINT_MAG:g} mag under white"
    why = (
        "a pixel is the star's that gives more than half of its light, and it is chosen for the"
        " light of both"
    )
    return judged(case, neighbours((FAINT_MAG, FAINT_MAG), 1.0), why)


def coded_narrow() -> FailureCase:
    """Stars of few pixels."""
    mag = FAINT_MAG / 2
    case = f"codes of stars of sigma {NARROW_PX:g} px, {mag:g} mag under white"
    scene = lone_stars(mag, srgb_response(8), NARROW_PX)
    return judged(case, scene, steps_a_star=NARROW_STEPS)


def coded_uneven() -> FailureCase:
    """Pixels of different light."""
    case = f"pixels 5 % apart, stars {FAINT_MAG:g} mag under white"
    return judged(case, uneven_panel(), "each pixel's own steps are weighed")


def coded_coarse() -> FailureCase:
    """The coarsest panel."""
    case = "a panel of 2 bits, stars whose peak is white"
    return judged(case, lone_stars(0.0, srgb_response(2)))


def coded_fine() -> FailureCase:
    """The finest panel."""
    case = "a panel of 16 bits, stars 10 mag under white"
    return judged(case, lone_stars(10.0, srgb_response(16)))


def spilled_beside() -> FailureCase:
    """A star over white beside a faint one."""
    case = "a star 2.5 mag over white, 5 px from one 4 mag under it"
    return spilled(case, neighbours((-2.5, 4.0), 5.0))


def spilled_everywhere() -> FailureCase:
    """Every star over white."""
    return spilled("every star 4 mag over white", lone_stars(-4.0, srgb_response(8)))


def spilled(case: str, scene: CodeScene) -> FailureCase:
    """The largest excess of a pixel's light: error diffusion hands light over white to
    neighbours.
    """
    response = scene.panel.response
    wanted = scene.wanted()
    corner = slice(2 * TILE_PX), slice(2 * TILE_PX)
    corner_light = scene.linear()[corner]
    diffused = diffused_light(corner_light, response) - wanted[corner]
    excess = shown_light(exact_codes(scene), scene.panel) - wanted
    error = float(excess.max())
    fault = float(diffused.max())
    steps = np.diff(response.light)
    largest_step = float(steps.max()) * WHITE
    method = "error diffusion (Floyd and Steinberg 1976)"
    fails = (
        f"pixels beside it have up to {fault:.2g} of white too much: what is over white is"
        " handed on"
    )
    happens = f"no pixel has more than {error:.1e} of white too much"
    why = "what is over white is lost, and told; no neighbour makes up for it"
    figures = CaseFigures(error, fault, largest_step)
    return FailureCase(case, method, fails, happens, why, figures)


def diffused_light(linear: FloatArray, response: Response) -> FloatArray:
    """A panel's light of an image (h, w) by error diffusion: each pixel hands its error to the
    next and to those below.
    """
    height, width = linear.shape
    remaining = np.zeros((height + 1, width + 2))
    remaining[:height, 1:-1] = linear / WHITE
    shown = np.zeros((height, width))
    below = np.array([3, 5, 1]) / 16
    for row in range(height):
        for column in range(1, width + 1):
            asked = remaining[row, column]
            code = np.searchsorted(response.threshold, asked, side="right")
            light = response.light[code]
            shown[row, column - 1] = light
            off = asked - light
            remaining[row, column + 1] += off * 7 / 16
            remaining[row + 1, column - 1 : column + 2] += off * below
    return shown * WHITE


def no_stars() -> FailureCase:
    """Nothing in view."""
    nothing = np.zeros(0)
    sprites = sprites_of(nothing, nothing, nothing, SIGMA_PX)
    panel = Panel(srgb_response(8), WHITE)
    scene = CodeScene(sprites, SIGMA_PX, panel)
    wanted = scene.wanted()
    with np.errstate(invalid="ignore"):
        scaled = wanted / wanted.max()
    lit = exact_codes(scene) != 0
    error = float(lit.mean())
    no_number = 100 * np.isnan(scaled).mean()
    case = "no star in view"
    method = "an image scaled to its brightest pixel"
    fails = f"{no_number:.0f} % of the pixels are no number"
    happens = f"{100 * error:.0f} % of the pixels are lit"
    why = "full scale is the bench's, whatever a frame has"
    figures = CaseFigures(error, float(scaled.sum()), NOTHING)
    return FailureCase(case, method, fails, happens, why, figures)


Case = Callable[[], FailureCase]
# Cases whose codes are rounded, or chosen by `exact`.
CODES: tuple[Case, ...] = (
    *(coded_half_off, coded_neighbours, coded_narrow),
    *(coded_uneven, coded_coarse, coded_fine),
)
# In the order of the light's way; the codes of some spill light over white to neighbours.
DRAWN: tuple[Case, ...] = (
    *(narrow_star, wide_star, negative_wings, floored_wings, absurd_sigmas),
    *(star_on_pixel_edge, star_on_image_edge, many_stars, flux_range),
    *(popping, popping_codes),
    *(*CODES, spilled_beside, spilled_everywhere, no_stars),
)
