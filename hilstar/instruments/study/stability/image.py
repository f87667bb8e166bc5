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
from hilstar.instruments.study.stability import FailureCase, Figures
from hilstar.optics.psf import MAX_CUT, SQRT2, GaussianPsf, pixel_shares
from hilstar.optics.sprites import FrameLight, join_sprites, make_sprites, pack_sprites
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, load_catalog
from hilstar.sky.stars import make_stars, unit_vectors_icrs

IMAGE_PX = (512, 512)
SIGMA_PX = 0.85
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
WHITE = 1.0
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
    """A linear image, whose stars are round."""
    return Target(size_px, GaussianPsf((sigma_px, sigma_px)))


def one_star(x_px: float, y_px: float, on: Target, electrons_per_s: float = 1.0) -> FrameLight:
    """A star of a target's sigma."""
    place = np.array([x_px]), np.array([y_px]), np.array([electrons_per_s])
    return pack_sprites(*place, np.zeros(1, dtype=np.intp), on.resolution_px, on.psf.footprint_px)


@contextmanager
def by_renderer(on: Target) -> Iterator[Draw]:
    """A function that draws the linear image (h, w) of sprites as hilstar does."""
    with Renderer(on) as gl:

        def draw(sprites: FrameLight) -> FloatArray:
            gl.draw(sprites)
            return gl.linear().astype(np.float64)

        yield draw


def _outer(
    on: Target, sprites: FrameLight, shares: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """One star's image from its shares along each axis, by a pixel's offset from it and sigma,
    px.
    """
    places = zip((sprites.x_px[0], sprites.y_px[0]), on.resolution_px, on.psf.width_px, strict=True)
    along_x, along_y = (shares(np.arange(size) - at, sigma_px) for at, size, sigma_px in places)
    return np.asarray(float(sprites.data["electrons_per_s"][0]) * np.outer(along_y, along_x))


def point_sampled(on: Target, sprites: FrameLight) -> FloatArray:
    """One star with the Gaussian's value at the middle of each pixel, (h, w)."""
    return _outer(
        on,
        sprites,
        lambda offset, sigma: np.exp(-0.5 * (offset / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)),
    )


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
        far, near = (erf_of((offset_px + side) / (sigma_px * SQRT2)) for side in (0.5, -0.5))
        return np.asarray((far - near).astype(np.float64) / 2)

    return _outer(on, sprites, shares)


def nearest_pixel(on: Target, sprites: FrameLight) -> FloatArray:
    """One star with all of its light in the nearest pixel."""
    return _outer(
        on,
        sprites,
        lambda offset, _: (np.arange(len(offset)) == np.abs(offset).argmin()).astype(np.float64),
    )


def erf_float32(value: FloatArray) -> FloatArray:
    """erf by splat.frag's rational polynomial, every step in float32; same shape."""
    x = np.clip(value, -4, 4).astype(np.float32)
    above, below = (
        np.polyval(np.array(terms, dtype=np.float32), x * x)
        for terms in (ERF_NUMERATOR, ERF_DENOMINATOR)
    )
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
    flux_error = 0.0
    off_px = 0.0
    peak_error = 0.0
    for phase in phases_px:
        image = draw(one_star(256 + phase, 256.0, on))
        light = float(image.sum())
        flux_error = max(flux_error, abs(light - 1))
        off_px = max(
            off_px, abs(float(image.sum(axis=0) @ np.arange(IMAGE_PX[0])) / light - 256 - phase)
        )
        middle = np.rint(phase)
        across, down = (
            pixel_shares(np.array([at]), sigma)
            for at, sigma in zip((middle - phase, 0.0), on.psf.width_px, strict=True)
        )
        off = float(image[256, int(256 + middle)]) / float(across[0] * down[0]) - 1
        peak_error = max(peak_error, off, key=abs)
    return PhaseErrors(flux_error, off_px, peak_error)


def narrow_star() -> FailureCase:
    """Sigma 0.1 px."""
    ours, sampled = narrow_errors(0.1)
    wider, wider_sampled = narrow_errors(0.5)
    return FailureCase(
        "sigma 0.1 px",
        POINT_SAMPLED,
        f"flux off by up to {100 * sampled.flux:.0f} %, centre of gravity by"
        f" {sampled.centroid_px:.2f} px ({wider_sampled.centroid_px:.4f} at sigma 0.5)",
        f"flux off by {ours.flux:.1e}; centre of gravity by {ours.centroid_px:.2f} px"
        f" ({wider.centroid_px:.4f} at sigma 0.5)",
        "the Gaussian is integrated over pixels; pixels of any display keep that centroid error:"
        " write 0.5 px or more",
        Figures(ours.flux, sampled.flux, FLUX_ERROR),
    )


def narrow_errors(sigma_px: float) -> tuple[PhaseErrors, PhaseErrors]:
    """The errors of the renderer, and those of point sampling."""
    on = target(sigma_px)
    phases = np.linspace(-0.5, 0.5, 21)
    with by_renderer(on) as draw:
        return star_errors(draw, on, phases), star_errors(partial(point_sampled, on), on, phases)


def wide_star() -> FailureCase:
    """Sigma 20 px."""
    on = target(20.0)
    sprites = one_star(256.3, 256.0, on)
    exact = linear_image(sprites, on.resolution_px, on.psf)
    with by_renderer(on) as draw:
        image = draw(sprites)
    error, fault = (
        float(np.abs(shown - exact).max() / exact.max())
        for shown in (image, half_float(on, sprites))
    )
    return FailureCase(
        "sigma 20 px",
        "erf differences in half floats",
        f"a pixel off by up to {100 * fault:.0f} % of the peak",
        f"{error:.0e} of the peak; the star's flux off by {image.sum() - 1:+.0e}",
        "float32 differences are small against the flux, and their errors cancel in the sum",
        Figures(error, fault, PEAK_ERROR),
    )


def negative_wings() -> FailureCase:
    """Far out both erfs are 1 but for rounding."""
    on = target(20.0)
    sprites = one_star(256.3, 256.0, on)
    with by_renderer(on) as draw:
        image = draw(sprites)
    bare = bare_polynomial(on, sprites)
    error, fault = (int((shown < 0).sum()) for shown in (image, bare))
    return FailureCase(
        "the wings of a star, sigma 20 px",
        "float32 erf differences as they come",
        f"{fault} pixels of negative light, down to {bare.min():.0e} of the star's",
        f"{error} negative pixels",
        "the shader takes the larger of difference and 0",
        Figures(float(error), float(fault), NOTHING),
    )


def floored_wings() -> FailureCase:
    """A floor of 1e-7 under each pixel's share."""
    on = target(SIGMA_PX)
    sprites = one_star(256.3, 256.0, on)
    with by_renderer(on) as draw:
        error = float(abs(draw(sprites).sum() - 1))
    fault = float(np.maximum(_outer(on, sprites, pixel_shares), 1e-7).sum() - 1)
    return FailureCase(
        "a floor of 1e-7 of a star's light",
        "max(share, 1e-7) in every pixel",
        f"adds {100 * fault:.1f} % to each star, over {IMAGE_PX[0]} x {IMAGE_PX[1]} pixels",
        f"flux off by {error:.0e}",
        "no floor: outside its footprint a star has no light",
        Figures(error, fault, FLUX_ERROR),
    )


def absurd_sigmas() -> FailureCase:
    """Sigmas that no sprite can hold."""
    context = create_context()
    point_px = int(context.info["GL_POINT_SIZE_RANGE"][1])
    context.release()
    lines = []
    silently_cut = NOTHING
    for sigma_px in (60.0, 1e6):
        try:
            Renderer(Target(IMAGE_PX, GaussianPsf((sigma_px, sigma_px)))).close()
            silently_cut = max(silently_cut, GaussianPsf((sigma_px, sigma_px)).cut_share(point_px))
        except InputError as refusal:
            lines.append(str(refusal))
    cuts = [GaussianPsf((sigma_px, sigma_px)).cut_share(point_px) for sigma_px in (60.0, 1e6)]
    return FailureCase(
        "sigma 60 and 1e6 px",
        f"GL's largest point, {point_px} px, whatever the sigma",
        f"cuts {100 * cuts[0]:.1f} % and {100 * cuts[1]:.5f} % of a star's light",
        "refused: " + " | ".join(lines),
        "a point of GL is a star's footprint",
        Figures(silently_cut, max(cuts), MAX_CUT),
    )


def star_on_pixel_edge() -> FailureCase:
    """A star where two pixels meet, and a hair to either side."""
    on = target(SIGMA_PX)
    phases = np.array([-0.5, 0.5 - 1e-9, 0.5, 0.5 + 1e-9])
    with by_renderer(on) as draw:
        off_px, fault_px = (
            star_errors(by, on, phases).centroid_px for by in (draw, partial(nearest_pixel, on))
        )
    return FailureCase(
        "a star on a pixel's edge",
        "the nearest pixel",
        f"centre {fault_px:.2f} px off, to either side",
        f"centre {off_px:.0e} px off",
        "light goes to both pixels; place is whole pixel and float32 fraction",
        Figures(off_px, fault_px, CENTROID_PX),
    )


def star_on_image_edge() -> FailureCase:
    """Stars whose centres are on and beyond the image's edges and corner."""
    errors = []
    faults = []
    last = IMAGE_PX[0] - 1.0
    on = target(SIGMA_PX)
    for x_px, y_px in (
        (-0.5, 256.0),
        (-0.6, 256.0),
        (last + 0.6, 256.0),
        (256.0, -2.0),
        (-0.6, last + 0.6),
    ):
        places = np.array([x_px, y_px])
        shares = ndtr((places + 0.5) / SIGMA_PX) - ndtr((places - last - 0.5) / SIGMA_PX)
        exact = float(np.prod(shares))
        inside = 0 <= np.rint(x_px) <= last and 0 <= np.rint(y_px) <= last
        with by_renderer(on) as draw:
            errors.append(abs(float(draw(one_star(x_px, y_px, on)).sum()) - exact))
        faults.append(abs(float(inside) - exact))
    error = max(errors)
    fault = max(faults)
    return FailureCase(
        "stars on the image's edge",
        "a star drawn whole or not at all, by its centre",
        f"up to {100 * fault:.0f} % of its light too much or too little",
        f"light on the image off by {error:.0e} of the star's",
        "a star is drawn where its footprint touches the image, and cut there",
        Figures(error, fault, FLUX_ERROR),
    )


def many_stars() -> FailureCase:
    """100 000 stars in view."""
    rng = np.random.default_rng(SEED)
    x_px, y_px = rng.uniform(10, CROWD_PX[0] - 11, (2, CROWD))
    flux = 10 ** rng.uniform(0, 4, CROWD)
    on = target(SIGMA_PX, CROWD_PX)
    size = (CORNER_PX, CORNER_PX)
    sprites = pack_sprites(x_px, y_px, flux, np.arange(CROWD), CROWD_PX, on.psf.footprint_px)
    with by_renderer(on) as draw:
        image = draw(sprites)
    corner = linear_image(
        pack_sprites(x_px, y_px, flux, np.arange(CROWD), size, sprites.footprint_px),
        size,
        GaussianPsf((SIGMA_PX,) * 2),
    )
    pixel_error = float(np.abs(image[:CORNER_PX, :CORNER_PX] - corner).max() / corner.max())
    steps = np.arange(sprites.footprint_px) - (sprites.footprint_px - 1) // 2
    columns, rows = (sprites.data["pixel"][:, axis, None] + steps for axis in (0, 1))
    share_x, share_y = (
        pixel_shares(pixel - place[:, None], SIGMA_PX)
        for pixel, place in ((columns, sprites.x_px), (rows, sprites.y_px))
    )
    light = share_y * sprites.data["electrons_per_s"][:, None]
    indexed = np.zeros(CROWD_PX[::-1])
    indexed[rows[:, :, None], columns[:, None, :]] += light[:, :, None] * share_x[:, None, :]
    error, fault = (float(abs(shown.sum() / flux.sum() - 1)) for shown in (image, indexed))
    return FailureCase(
        f"{CROWD} stars in view",
        "image[rows, columns] += light",
        f"{100 * fault:.0f} % of the light lost: a repeated index is added once",
        f"light off by {error:.0e}; {pixel_error:.0e} of the brightest pixel, over {CORNER_PX} x"
        f" {CORNER_PX}",
        "the GPU blends every sprite, in float32",
        Figures(max(error, pixel_error), fault, CROWD_ERROR),
    )


def flux_range() -> FailureCase:
    """Twelve decades side by side."""
    flux = np.array([1e12, 1.0])
    on = target(SIGMA_PX)
    stars = [
        one_star(x_px, 256.0, on, light) for x_px, light in zip((100.3, 120.3), flux, strict=True)
    ]
    with by_renderer(on) as draw:
        image = draw(join_sprites(stars, stars[0].footprint_px))
    scaled = np.rint(image / image.max() * 65535) * image.max() / 65535

    def flux_errors(shown: FloatArray) -> list[float]:
        bright, faint = float(shown[:, :110].sum()), float(shown[:, 110:].sum())
        return [abs(bright / flux[0] - 1), abs(faint / flux[1] - 1)]

    errors, faults = flux_errors(image), flux_errors(scaled)
    return FailureCase(
        "flux range 1e12",
        "16 bits, scaled to the brightest pixel",
        f"fluxes off by {faults[0]:.0e} and {faults[1]:.0e}: the faint star is gone",
        f"fluxes off by {errors[0]:.0e} and {errors[1]:.0e}",
        "float32, and each star in its own footprint",
        Figures(max(errors), max(faults), FLUX_ERROR),
    )


def moving_star(on: Target, electrons_per_s: float = 1.0) -> Iterator[FrameLight]:
    """Sirius at a given flux in STEPS frames of the demo's camera, which turns until the star
    has moved by PATH_PX.
    """
    sirius = load_catalog().brighter_than(-1.0)
    vectors = unit_vectors_icrs(sirius, HIPPARCOS_EPOCH_JYEAR)
    stars = make_stars(sirius, vectors, np.full(1, np.nan), np.full(1, electrons_per_s))
    camera = monitor_camera(on.resolution_px, PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    start = from_radec_roll_deg(float(sirius.ra_deg[0]), float(sirius.dec_deg[0]), 20.0)
    # A turn about x moves stars up the image, one about -y to the right.
    turn_rad = np.array([-PATH_PX[1], -PATH_PX[0], 0.0]) / camera.focal_length_px
    for share in np.linspace(0, 1, STEPS):
        yield make_sprites(
            stars, to_matrix(propagate(start, share * turn_rad, 1.0)), camera, on.psf.footprint_px
        )


def moving_fluxes(draw: Draw, on: Target) -> FloatArray:
    """Its light (steps,) in each image."""
    return np.array([draw(sprites).sum() for sprites in moving_star(on)])


@cache  # a case and a chart
def moving_code_fluxes(quantisation: Quantisation) -> FloatArray:
    """The light (steps,) that an sRGB monitor makes of it, relative to the light wanted.

    It is CODES_MAG_UNDER_WHITE fainter than a star whose peak is white.
    """
    sigma = (SIGMA_PX, SIGMA_PX)
    response = srgb_response(CODES_BITS)
    flux = flux_ratio(CODES_MAG_UNDER_WHITE) / GaussianPsf(sigma).peak_share
    on = Target(MOVING_PX, GaussianPsf(sigma), response, 1.0, quantisation)
    light = []
    with Renderer(on) as gl:
        for sprites in moving_star(on, flux):
            gl.draw(sprites)
            light.append(response.light[gl.levels()].sum())
    return np.array(light) / flux


def ripple(fluxes: FloatArray) -> float:
    """From the faintest to the brightest of a star's fluxes, relative to their mean."""
    return float((fluxes.max() - fluxes.min()) / fluxes.mean())


def popping() -> FailureCase:
    """A star's light in the linear image while the camera turns by parts of a pixel."""
    on = target(0.5, MOVING_PX)
    with by_renderer(on) as draw:
        error, fault = (ripple(moving_fluxes(by, on)) for by in (draw, partial(point_sampled, on)))
    return FailureCase(
        f"a star over {STEPS} sub-pixel steps, sigma 0.5 px",
        POINT_SAMPLED,
        f"its light varies by {100 * fault:.1f} %",
        f"varies by {error:.1e} in the linear image",
        "integrated over pixels, and cut where 1e-6 of the light remains",
        Figures(error, fault, RIPPLE),
    )


def popping_codes() -> FailureCase:
    """The same star's light through 8-bit codes."""
    fluxes = moving_code_fluxes("round"), moving_code_fluxes("exact")
    fault, error = (magnitude(float(f.min() / f.max())) for f in fluxes)
    return FailureCase(
        f"the same, {CODES_MAG_UNDER_WHITE:g} mag under white on {CODES_BITS} bits, sigma"
        f" {SIGMA_PX:g} px",
        ROUNDING,
        f"its light varies by {fault:.3f} mag",
        f'quantisation = "exact", what `auto` takes there: {error:.3f} mag',
        "round adds up the errors of its pixels; exact chooses a star's codes together",
        Figures(error, fault, AIMS[CODES_BITS][0]),
    )


@dataclass(frozen=True, slots=True)
class CodeScene:
    """Groups of `stars` stars, each group alone in its part of the image, on a panel."""

    sprites: FrameLight
    sigma_px: float
    panel: Panel
    stars: int = 1

    def linear(self) -> FloatArray:
        """The light (h, w) of the stars."""
        return linear_image(self.sprites, (SIDE_PX, SIDE_PX), GaussianPsf((self.sigma_px,) * 2))

    def wanted(self) -> FloatArray:
        """The light (h, w) that a panel of any number of levels would show."""
        even = 1.0 if self.panel.uniformity is None else self.panel.uniformity
        return np.asarray(np.minimum(self.linear(), WHITE * even))


def codes_of(scene: CodeScene, quantisation: Quantisation) -> Levels:
    """The codes (h, w) as hilstar draws them."""
    panel = scene.panel
    sigma_px = (scene.sigma_px, scene.sigma_px)
    on = Target(
        (SIDE_PX, SIDE_PX),
        GaussianPsf(sigma_px),
        panel.response,
        WHITE,
        quantisation,
        panel.uniformity,
    )
    with Renderer(on) as gl:
        gl.draw(scene.sprites)
        return gl.levels().copy()


def exact_codes(scene: CodeScene) -> Levels:
    """The codes (h, w) of `exact`."""
    return codes_of(scene, "exact")


def error_steps(codes: Levels, scene: CodeScene) -> float:
    """The error of the groups' light, rms, in the panel's smallest steps."""
    shown, wanted = (
        image.reshape(COUNT, TILE_PX, COUNT, TILE_PX).sum(axis=(1, 3))
        for image in (shown_light(codes, scene.panel), scene.wanted())
    )
    off = (shown - wanted)[wanted > 0]
    return float(np.sqrt(np.mean(np.square(off))) / (scene.panel.response.light[1] * WHITE))


def sprites_of(
    x_px: FloatArray, y_px: FloatArray, under_white_mag: FloatArray, sigma_px: float
) -> FrameLight:
    """Stars at places (n,), so many magnitudes (n,) under the one whose peak is white."""
    sigma = (sigma_px, sigma_px)
    light = WHITE * flux_ratio(under_white_mag) / GaussianPsf(sigma).peak_share
    return pack_sprites(
        x_px, y_px, light, np.arange(len(x_px)), (SIDE_PX, SIDE_PX), GaussianPsf(sigma).footprint_px
    )


def middles() -> tuple[FloatArray, FloatArray]:
    """A place in each part of the image, each at another sub-pixel phase: x and y."""
    place = (np.arange(COUNT) + 0.5) * TILE_PX - 0.5 + (np.arange(COUNT) + 0.5) / COUNT - 0.5
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
    return CodeScene(
        sprites_of(x_px, y_px, mags, sigma_px), sigma_px, Panel(response, WHITE, uniformity)
    )


def neighbours(mags: tuple[float, float], apart_px: float) -> CodeScene:
    """Two stars in each part, in all directions from each other."""
    x_px, y_px = middles()
    angle = np.linspace(0, 2 * np.pi, len(x_px), endpoint=False)
    both = (
        np.append(x_px, x_px + apart_px * np.cos(angle)),
        np.append(y_px, y_px + apart_px * np.sin(angle)),
    )
    return CodeScene(
        sprites_of(*both, np.repeat(mags, len(x_px)), SIGMA_PX),
        SIGMA_PX,
        Panel(srgb_response(8), WHITE),
        2,
    )


def judged(
    case: str, scene: CodeScene, why: str = TOGETHER, steps_a_star: float = STEPS_A_STAR
) -> FailureCase:
    """Compares rounding with `exact` by the light of each group of stars."""
    fault = error_steps(codes_of(scene, "round"), scene)
    error = error_steps(exact_codes(scene), scene)
    return FailureCase(
        case,
        ROUNDING,
        f"a star's light off by {fault:.2g} of the panel's smallest steps rms",
        f"by {error:.2g} steps",
        why,
        Figures(error, fault, steps_a_star * scene.stars),
    )


# Cases whose codes are rounded, or chosen by `exact`.
CODES: tuple[Callable[[], FailureCase], ...] = (
    lambda: judged(
        f"stars half off the screen, {FAINT_MAG:g} mag under white on 8 bits", half_off()
    ),
    lambda: judged(
        f"two stars 1 px apart, {FAINT_MAG:g} mag under white",
        neighbours((FAINT_MAG, FAINT_MAG), 1.0),
        "a pixel is the star's that gives more than half of its light, and it is chosen for the"
        " light of both",
    ),
    lambda: judged(
        f"codes of stars of sigma {NARROW_PX:g} px, {FAINT_MAG / 2:g} mag under white",
        lone_stars(FAINT_MAG / 2, srgb_response(8), NARROW_PX),
        steps_a_star=NARROW_STEPS,
    ),
    lambda: judged(
        f"pixels 5 % apart, stars {FAINT_MAG:g} mag under white",
        uneven_panel(),
        "each pixel's own steps are weighed",
    ),
    lambda: judged(
        "a panel of 2 bits, stars whose peak is white", lone_stars(0.0, srgb_response(2))
    ),
    lambda: judged(
        "a panel of 16 bits, stars 10 mag under white", lone_stars(10.0, srgb_response(16))
    ),
)
# Cases whose light over white goes to neighbours by error diffusion.
SPILLED: tuple[Callable[[], FailureCase], ...] = (
    lambda: spilled(
        "a star 2.5 mag over white, 5 px from one 4 mag under it", neighbours((-2.5, 4.0), 5.0)
    ),
    lambda: spilled("every star 4 mag over white", lone_stars(-4.0, srgb_response(8))),
)


def half_off() -> CodeScene:
    """Stars whose middles lie on the screen's edges, at every phase along them and across."""
    along = middles()[0][1 : COUNT - 1]
    across = (np.roll(np.arange(COUNT - 2), 2) + 0.5) / (COUNT - 2) - 1.0
    x_px = np.concatenate([across, SIDE_PX - 1 - across, along, along])
    y_px = np.concatenate([along, along, across, SIDE_PX - 1 - across])
    sprites = sprites_of(x_px, y_px, np.full(len(x_px), FAINT_MAG), SIGMA_PX)
    return CodeScene(sprites, SIGMA_PX, Panel(srgb_response(8), WHITE))


def uneven_panel() -> CodeScene:
    """Stars on pixels that differ by 5 %, with a fall to the corners."""
    y_px, x_px = np.mgrid[:SIDE_PX, :SIDE_PX] / SIDE_PX - 0.5
    uneven = (
        1
        - 0.3 * np.hypot(x_px, y_px)
        + np.random.default_rng(CODES_SEED).normal(0, 0.05, x_px.shape)
    )
    return lone_stars(FAINT_MAG, srgb_response(8), uniformity=uneven.astype(np.float32))


def spilled(case: str, scene: CodeScene) -> FailureCase:
    """The largest excess of a pixel's light: error diffusion hands light over white to
    neighbours.
    """
    wanted = scene.wanted()
    corner = slice(2 * TILE_PX), slice(2 * TILE_PX)
    diffused = diffused_light(scene.linear()[corner], scene.panel.response) - wanted[corner]
    error = float((shown_light(exact_codes(scene), scene.panel) - wanted).max())
    fault = float(diffused.max())
    return FailureCase(
        case,
        "error diffusion (Floyd and Steinberg 1976)",
        f"pixels beside it have up to {fault:.2g} of white too much: what is over white is"
        " handed on",
        f"no pixel has more than {error:.1e} of white too much",
        "what is over white is lost, and told; no neighbour makes up for it",
        Figures(error, fault, float(np.diff(scene.panel.response.light).max()) * WHITE),
    )


def diffused_light(linear: FloatArray, response: Response) -> FloatArray:
    """A panel's light of an image (h, w) by error diffusion: each pixel hands its error to the
    next and to those below.
    """
    height, width = linear.shape
    remaining = np.zeros((height + 1, width + 2))
    remaining[:height, 1:-1] = linear / WHITE
    shown = np.zeros((height, width))
    for row in range(height):
        for column in range(1, width + 1):
            asked = remaining[row, column]
            shown[row, column - 1] = response.light[
                np.searchsorted(response.threshold, asked, side="right")
            ]
            off = asked - shown[row, column - 1]
            remaining[row, column + 1] += off * 7 / 16
            remaining[row + 1, column - 1 : column + 2] += off * np.array([3, 5, 1]) / 16
    return shown * WHITE


def no_stars() -> FailureCase:
    """Nothing in view."""
    nothing = np.zeros(0)
    none = CodeScene(
        sprites_of(nothing, nothing, nothing, SIGMA_PX), SIGMA_PX, Panel(srgb_response(8), WHITE)
    )
    with np.errstate(invalid="ignore"):
        scaled = none.wanted() / none.wanted().max()
    error = float((exact_codes(none) != 0).mean())
    return FailureCase(
        "no star in view",
        "an image scaled to its brightest pixel",
        f"{100 * np.isnan(scaled).mean():.0f} % of the pixels are no number",
        f"{100 * error:.0f} % of the pixels are lit",
        "full scale is the bench's, whatever a frame has",
        Figures(error, float(scaled.sum()), NOTHING),
    )
