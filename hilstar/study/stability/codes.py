"""Where the codes of a star go wrong: at edges, among neighbours, narrow, on uneven, coarse and fine panels, over white."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.monitor.quantise import Panel, Quantisation, shown_light
from hilstar.monitor.response import Codes, Response, srgb_response
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.psf import footprint_px, peak_share
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.study.stability.failure_case import FailureCase, Figures
from hilstar.study.stability.image import NOTHING, SIGMA_PX
from hilstar.units import flux_ratio

SEED = 6
COUNT, TILE_PX = 8, 22  # groups of stars along either side of the image, and the side of each one's part of it
SIDE_PX = COUNT * TILE_PX
WHITE = 1.0
FAINT_MAG = 6.0  # under the star whose peak is white
NARROW_PX = 0.3
# A star of equal steps can have its light within half of one and no nearer; where steps differ it comes nearer than that.
STEPS_A_STAR = 0.5
# A star of so few pixels, lit by codes whose steps are several of the smallest.
NARROW_STEPS = 0.6
ROUNDING = 'quantisation = "round"'
TOGETHER = "exact chooses the codes of a star's own pixels together, for what of its light is to be seen there"

Groups = tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class Scene:
    """Groups of `stars` stars, each group alone in its part of the image, on a panel."""

    sprites: Sprites
    sigma_px: float
    panel: Panel
    stars: int = 1

    def wanted(self) -> FloatArray:
        """The light (h, w) that a panel of any number of levels would show."""
        even = 1.0 if self.panel.uniformity is None else self.panel.uniformity
        return np.asarray(np.minimum(linear_image(self.sprites, (SIDE_PX, SIDE_PX), (self.sigma_px,) * 2), WHITE * even))


def codes_of(scene: Scene, quantisation: Quantisation) -> Codes:
    """The codes (h, w) as hilstar draws them."""
    panel, sigma_px = scene.panel, (scene.sigma_px, scene.sigma_px)
    on = Target((SIDE_PX, SIDE_PX), sigma_px, panel.response, WHITE, quantisation, panel.uniformity)
    with Renderer(on) as gl:
        gl.draw(scene.sprites)
        return gl.codes().copy()


def exact_codes(scene: Scene) -> Codes:
    """The codes (h, w) of `exact`."""
    return codes_of(scene, "exact")


def error_steps(codes: Codes, scene: Scene) -> float:
    """The error of the groups' light, rms, in the panel's smallest steps."""
    wanted = scene.wanted()
    parts = [
        image.reshape(COUNT, TILE_PX, COUNT, TILE_PX).sum(axis=(1, 3)) for image in (shown_light(codes, scene.panel), wanted)
    ]
    off = (parts[0] - parts[1])[parts[1] > 0]
    return float(np.sqrt(np.mean(np.square(off))) / (scene.panel.response.light[1] * WHITE))


def sprites_of(x_px: FloatArray, y_px: FloatArray, under_white_mag: FloatArray, sigma_px: float) -> Sprites:
    """Stars at places (n,), so many magnitudes (n,) under the one whose peak is white."""
    sigma = (sigma_px, sigma_px)
    light = WHITE * flux_ratio(under_white_mag) / peak_share(sigma)
    return pack_sprites(x_px, y_px, light, np.arange(len(x_px)), (SIDE_PX, SIDE_PX), footprint_px(sigma))


def middles() -> tuple[FloatArray, FloatArray]:
    """A place in each part of the image, each at another sub-pixel phase: x and y."""
    place = (np.arange(COUNT) + 0.5) * TILE_PX - 0.5 + (np.arange(COUNT) + 0.5) / COUNT - 0.5
    x_px, y_px = np.meshgrid(place, place)
    return x_px.ravel(), y_px.ravel()


def lone_stars(
    under_white_mag: float, response: Response, sigma_px: float = SIGMA_PX, uniformity: Float32Array | None = None
) -> Scene:
    """A star in each part of the image."""
    x_px, y_px = middles()
    mags = np.full(len(x_px), under_white_mag)
    return Scene(sprites_of(x_px, y_px, mags, sigma_px), sigma_px, Panel(response, WHITE, uniformity))


def neighbours(mags: tuple[float, float], apart_px: float) -> Scene:
    """Two stars in each part, in all directions from each other."""
    x_px, y_px = middles()
    angle = np.linspace(0, 2 * np.pi, len(x_px), endpoint=False)
    both = np.append(x_px, x_px + apart_px * np.cos(angle)), np.append(y_px, y_px + apart_px * np.sin(angle))
    return Scene(sprites_of(*both, np.repeat(mags, len(x_px)), SIGMA_PX), SIGMA_PX, Panel(srgb_response(8), WHITE), 2)


def half_off() -> Scene:
    """Stars whose middles lie on the screen's edges, at every phase along them and across."""
    along = middles()[0][1 : COUNT - 1]
    across = (np.roll(np.arange(COUNT - 2), 2) + 0.5) / (COUNT - 2) - 1.0
    x_px = np.concatenate([across, SIDE_PX - 1 - across, along, along])
    y_px = np.concatenate([along, along, across, SIDE_PX - 1 - across])
    sprites = sprites_of(x_px, y_px, np.full(len(x_px), FAINT_MAG), SIGMA_PX)
    return Scene(sprites, SIGMA_PX, Panel(srgb_response(8), WHITE))


def _judged(case: str, scene: Scene, why: str = TOGETHER, steps_a_star: float = STEPS_A_STAR) -> FailureCase:
    """Rounding against `exact`, by the light of each group of stars."""
    fault, error = error_steps(codes_of(scene, "round"), scene), error_steps(exact_codes(scene), scene)
    return FailureCase(
        case,
        ROUNDING,
        f"a star's light off by {fault:.2g} of the panel's smallest steps rms",
        f"by {error:.2g} steps",
        why,
        Figures(error, fault, steps_a_star * scene.stars),
    )


def stars_half_off() -> FailureCase:
    """Stars cut by the screen's edge."""
    return _judged(f"stars half off the screen, {FAINT_MAG:g} mag under white on 8 bits", half_off())


def stars_a_pixel_apart() -> FailureCase:
    """Two stars that share most of their pixels."""
    why = "a pixel is the star's that gives more than half of its light, and it is chosen for the light of both"
    return _judged(f"two stars 1 px apart, {FAINT_MAG:g} mag under white", neighbours((FAINT_MAG, FAINT_MAG), 1.0), why)


def narrow_codes() -> FailureCase:
    """Stars of less than a pixel."""
    scene = lone_stars(FAINT_MAG / 2, srgb_response(8), NARROW_PX)
    case = f"codes of stars of sigma {NARROW_PX:g} px, {FAINT_MAG / 2:g} mag under white"
    return _judged(case, scene, steps_a_star=NARROW_STEPS)


def uneven_panel() -> FailureCase:
    """Pixels that differ by 5 %, and a fall to the corners."""
    y_px, x_px = np.mgrid[:SIDE_PX, :SIDE_PX] / SIDE_PX - 0.5
    uneven = 1 - 0.3 * np.hypot(x_px, y_px) + np.random.default_rng(SEED).normal(0, 0.05, x_px.shape)
    scene = lone_stars(FAINT_MAG, srgb_response(8), uniformity=uneven.astype(np.float32))
    return _judged(f"pixels 5 % apart, stars {FAINT_MAG:g} mag under white", scene, "each pixel's own steps are weighed")


def two_bits() -> FailureCase:
    """Four levels."""
    return _judged("a panel of 2 bits, stars whose peak is white", lone_stars(0.0, srgb_response(2)))


def sixteen_bits() -> FailureCase:
    """65 536 levels."""
    return _judged("a panel of 16 bits, stars 10 mag under white", lone_stars(10.0, srgb_response(16)))


def clipped_neighbours() -> FailureCase:
    """A star over white beside a faint one."""
    return _spilled("a star 2.5 mag over white, 5 px from one 4 mag under it", neighbours((-2.5, 4.0), 5.0))


def all_clipped() -> FailureCase:
    """Every star over white."""
    return _spilled("every star 4 mag over white", lone_stars(-4.0, srgb_response(8)))


def _spilled(case: str, scene: Scene) -> FailureCase:
    """The most light that a pixel has beyond what is wanted: what is over white there, its neighbours may be given."""
    wanted = scene.wanted()
    linear = linear_image(scene.sprites, (SIDE_PX, SIDE_PX), (scene.sigma_px,) * 2)[: 2 * TILE_PX, : 2 * TILE_PX]
    diffused = diffused_light(linear, scene.panel.response) - wanted[: 2 * TILE_PX, : 2 * TILE_PX]
    error, fault = float((shown_light(exact_codes(scene), scene.panel) - wanted).max()), float(diffused.max())
    return FailureCase(
        case,
        "error diffusion (Floyd and Steinberg 1976)",
        f"pixels beside it have up to {fault:.2g} of white too much: what is over white is handed on",
        f"no pixel has more than {error:.1e} of white too much",
        "what is over white is lost, and told; no neighbour makes up for it",
        Figures(error, fault, float(np.diff(scene.panel.response.light).max()) * WHITE),
    )


def diffused_light(linear: FloatArray, response: Response) -> FloatArray:
    """What a panel shows of an image (h, w) whose errors each pixel hands to the next and to those below."""
    height, width = linear.shape
    left = np.zeros((height + 1, width + 2))
    left[:height, 1:-1] = linear / WHITE
    shown = np.zeros((height, width))
    for row in range(height):
        for column in range(1, width + 1):
            asked = left[row, column]
            shown[row, column - 1] = response.light[np.searchsorted(response.threshold, asked, side="right")]
            off = asked - shown[row, column - 1]
            left[row, column + 1] += off * 7 / 16
            left[row + 1, column - 1 : column + 2] += off * np.array([3, 5, 1]) / 16
    return shown * WHITE


def no_stars() -> FailureCase:
    """Nothing in view."""
    nothing = np.zeros(0)
    none = Scene(sprites_of(nothing, nothing, nothing, SIGMA_PX), SIGMA_PX, Panel(srgb_response(8), WHITE))
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
