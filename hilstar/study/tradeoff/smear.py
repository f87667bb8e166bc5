"""The trade-off of smear: sprites along a turning star's path."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.phases import measure
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Target
from hilstar.render.variants import SplatVariant, VariantRenderer
from hilstar.scene.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import Stars, make_stars
from hilstar.study.shared.predictors import ORION
from hilstar.study.tradeoff.demo import demo_config
from hilstar.study.tradeoff.table import Figure, Trial, Trials

TRACKER = demo_config().tracker
CAMERA = monitor_camera(TRACKER.resolution_px, TRACKER.pixel_pitch_um, TRACKER.focal_length_mm, np.array([1.0, 0, 0, 0]))
SIZE_PX = CAMERA.resolution_px[0]
RATE_DEG_S = (0.7, -0.7, 5.0)
EVENLY = (4, 8, 16, 32, 64)
GAUSS = (8, 16, 24, 32)
# 200 nodes on 28 sigmas at most: six times what the module's rule asks for.
EXACT_NODES = 200
# Wider than the path's own footprints, so that the steps' error is not their cut; 24 px are 21 sigma on either side.
WIDE_PX = 24
STARS_ACROSS = 16
# float32 fluxes and fractions of the sprites: 6e-8 of each.
ROUNDING_SHARE = 1e-7


def smear(stack: ExitStack, quick: bool) -> Trials:
    """Sprites on a turning star's path: worst pixel, share of the star's flux, and centroid, px, over a grid of stars."""
    across = STARS_ACROSS // 2 if quick else STARS_ACROSS
    motion = Motion(ORION, np.radians(np.array(RATE_DEG_S)), TRACKER.exposure_s)
    few, many = grid_stars(across, motion), grid_stars(STARS_ACROSS, motion)
    renderer = stack.enter_context(VariantRenderer(Target(TRACKER.resolution_px, TRACKER.psf_sigma_px), SplatVariant()))
    exact = _image(gauss_sprites(EXACT_NODES, few, motion))
    trials = []
    for name, sprites_of in smear_methods(few, motion).items():
        image = _image(sprites_of(few, motion))
        off_px = measure(exact, image, len(exact) // across).centroid_max_px
        work = partial(_draw_path, renderer, sprites_of, many, motion)
        worst, is_exact = float(np.abs(image - exact).max()), name == gauss_name(EXACT_NODES)
        trials.append(Trial(name, worst, off_px, work, sprites_of is own_sprites, is_exact))
    paths = path_lengths_px(many, motion)
    return Trials(
        "smear",
        f"linear image of {len(many)} stars, paths of {paths.min():.0f} to {paths.max():.0f} px, {SIZE_PX} px squared",
        Figure("largest pixel error, share of its star", "1", ROUNDING_SHARE),
        Figure("centre of gravity, worst", "px"),
        "its error does not grow with the path, as that of a fixed number does",
        trials,
    )


SpritesOf = Callable[[Stars, Motion], Sprites]


def smear_methods(stars: Stars, motion: Motion) -> dict[str, SpritesOf]:
    """Every method by name: sprites of stars over an exposure."""
    mean = len(own_sprites(stars, motion)) / len(stars)
    methods: dict[str, SpritesOf] = {f"Gauss-Legendre by length, {mean:.0f} on average": own_sprites}
    methods |= {gauss_name(count): partial(gauss_sprites, count) for count in (*GAUSS, EXACT_NODES)}
    return methods | {f"evenly in time, {count}": partial(even_sprites, count) for count in EVENLY}


def gauss_name(count: int) -> str:
    """The name of the method with `count` nodes for every star."""
    return f"Gauss-Legendre, {count}"


def grid_stars(across: int, motion: Motion) -> Stars:
    """Stars of one electron per second, across^2 of them evenly over the detector in the middle of the exposure."""
    place = (np.arange(across) + 0.5) * SIZE_PX / across - 0.5
    x_px, y_px = (axis.ravel() - (SIZE_PX - 1) / 2 for axis in np.meshgrid(place, place))
    image = np.column_stack([x_px, y_px, np.full(across**2, CAMERA.focal_length_px)])
    vectors = image / np.linalg.norm(image, axis=1, keepdims=True) @ motion.icrs_to_image(MIDDLE_S, CAMERA)[0]
    zero = np.zeros(across**2)
    catalog = plain_catalog("star", across**2, {"v_mag": zero, "ra_deg": zero, "dec_deg": zero})
    return make_stars(catalog, vectors, zero, zero + 1)


def path_lengths_px(stars: Stars, motion: Motion) -> FloatArray:
    """How far each star moves over the exposure, px (n,), by its two ends."""
    x_px, y_px = _places_px(stars, motion, np.array([-0.5, 0.5]))
    return np.asarray(np.hypot(np.diff(x_px, axis=0), np.diff(y_px, axis=0))[0])


def own_sprites(stars: Stars, motion: Motion) -> Sprites:
    """The sprites that hilstar draws (scene/exposure_motion.py)."""
    return smeared_sprites(stars, motion, CAMERA, footprint_px(TRACKER.psf_sigma_px), TRACKER.psf_sigma_px)


def gauss_sprites(count: int, stars: Stars, motion: Motion) -> Sprites:
    """`count` sprites for each star, at the nodes of Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return _chain(stars, motion, nodes / 2, weights / 2)


def even_sprites(count: int, stars: Stars, motion: Motion) -> Sprites:
    """`count` sprites of equal weight for each star, in the middles of equal parts of the exposure."""
    return _chain(stars, motion, (np.arange(count) + 0.5) / count - 0.5, np.full(count, 1 / count))


def _chain(stars: Stars, motion: Motion, at: FloatArray, share: FloatArray) -> Sprites:
    x_px, y_px = _places_px(stars, motion, at)
    light = np.outer(share, stars.electrons_per_s)
    star = np.broadcast_to(np.arange(len(stars)), x_px.shape)
    side = footprint_px(TRACKER.psf_sigma_px)
    return pack_sprites(x_px.ravel(), y_px.ravel(), light.ravel(), star.ravel(), CAMERA.resolution_px, side)


def _places_px(stars: Stars, motion: Motion, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (k, n), px, at the parts `at` (k,) of the exposure, 0 its middle."""
    seen = stars.vectors @ motion.icrs_to_image(at * motion.exposure_s, CAMERA).transpose(0, 2, 1)
    x_px, y_px = CAMERA.project(seen.reshape(-1, 3))
    return x_px.reshape(len(at), -1), y_px.reshape(len(at), -1)


def _image(sprites: Sprites) -> FloatArray:
    return linear_image(sprites, CAMERA.resolution_px, TRACKER.psf_sigma_px, WIDE_PX)


def _draw_path(renderer: VariantRenderer, sprites_of: SpritesOf, stars: Stars, motion: Motion) -> None:
    renderer.draw_and_wait(sprites_of(stars, motion))
