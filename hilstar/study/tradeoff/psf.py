"""The trade-off of the point spread function: a star's profile on the GPU."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import RenderSettings
from hilstar.monitor.phases import WHITE, fainter, measure
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Target
from hilstar.render.variants import SplatVariant, VariantRenderer
from hilstar.scene.psf import MAX_CUT, footprint_px, peak_share
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.study.shared.codes import FRAME_PX, STARS, star_field
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import flux_ratio, magnitude

SIGMA_PX = RenderSettings().sprite_sigma_px
PHASES = 16
SIZES_PX = (6, 8, 9, 10, 11, 12, 16, 24)
# Wider than every sprite here, so that no tile of the phases loses light to its neighbour: 13 px are 15 sigma.
TILE_PX = 26
# Two stars' brightnesses: white, and 8 magnitudes under it, as faint as a 10-bit monitor is asked to show.
FAINTER_MAG = 8.0
SMALL_SIGMA_PX = 0.4
TABLE_SIZES = (64, 512, 4096)
# float32 rounds a star's electrons by 6e-8, and its brightest pixels by as much again.
ROUNDING_MAG = 1e-7


def psf(stack: ExitStack, quick: bool) -> Trials:
    """How a star is spread over pixels: flux error, mag, and centroid error, px, over PHASES^2 phases and two brightnesses."""
    del quick  # every error is found in one draw
    trials = [_exact_psf(), *(_drawn_psf(stack, name, variant) for name, variant in splat_variants().items())]
    return Trials(
        "psf",
        f"linear image of {STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}",
        Figure("flux error, worst", "mag", ROUNDING_MAG),
        Figure("centre of gravity, worst", "px"),
        "methods this close change order from run to run; the default has the smallest footprint that cuts at most"
        f" {MAX_CUT:g} of a star's light at any phase, and needs no table",
        trials,
        _centre_remark(),
    )


def _centre_remark() -> str:
    """What the two sums hide of a profile that is sampled at pixel centres."""

    def flux(sigma_px: float, phase_px: np.ndarray) -> FloatArray:
        offset_px = np.arange(-TILE_PX, TILE_PX + 1) - phase_px[:, None]
        return np.asarray((np.exp(-0.5 * (offset_px / sigma_px) ** 2) / (sigma_px * np.sqrt(2 * np.pi))).sum(axis=1))

    excess = 1 / (2 * np.pi * SIGMA_PX[0] * SIGMA_PX[1] * peak_share(SIGMA_PX)) - 1
    worst = np.abs(magnitude(flux(SMALL_SIGMA_PX, np.arange(PHASES) / PHASES) ** 2)).max()
    return (
        f"sampling at pixel centres gives a wide star the right sum and the wrong shape: its middle pixel is"
        f" {100 * excess:.0f} % too bright, and at sigma {SMALL_SIGMA_PX:g} px its flux is off by {worst:.2f} mag"
    )


def splat_variants() -> dict[str, SplatVariant]:
    """The GPU's ways, by name; the renderer's own is the `SplatVariant()` that changes nothing."""
    own = footprint_px(SIGMA_PX)
    variants = {f"GL polynomial, R32F, {own} px": SplatVariant()}
    variants |= {f"GL polynomial, R32F, {size} px": SplatVariant(footprint_px=size) for size in SIZES_PX if size != own}
    variants |= {f"GL polynomial, R16F, {own} px": SplatVariant(half_float=True)}
    variants |= {f"GL erf, {own} px": SplatVariant("erf")}
    variants |= {f"GL erf by exp, {own} px": SplatVariant("exp erf")}
    variants |= {f"GL table of {size}, {own} px": SplatVariant("table", table_size=size) for size in TABLE_SIZES}
    variants |= {f"GL pixel centre, {own} px": SplatVariant("centre")}
    return variants


def _drawn_psf(stack: ExitStack, name: str, variant: SplatVariant) -> Trial:
    renderer = stack.enter_context(VariantRenderer(Target(FRAME_PX, SIGMA_PX), variant))
    side = PHASES * TILE_PX

    def image(sprites: Sprites) -> FloatArray:
        renderer.draw(sprites)
        return renderer.linear()[:side, :side].astype(np.float64)

    work = partial(renderer.draw_and_wait, star_field(FRAME_PX, renderer.footprint_px))
    return Trial(name, *_psf_errors(renderer.footprint_px, image), work, variant == SplatVariant())


def _exact_psf() -> Trial:
    def image(sprites: Sprites) -> FloatArray:
        return linear_image(sprites, (PHASES * TILE_PX,) * 2, SIGMA_PX)

    work = partial(linear_image, star_field(FRAME_PX, TILE_PX), FRAME_PX, SIGMA_PX)
    return Trial("exact integral, erfc in float64", *_psf_errors(TILE_PX, image), work, is_exact=True)


def _psf_errors(size_px: int, image: Callable[[Sprites], FloatArray]) -> tuple[float, float]:
    """Worst flux error, mag, and centroid error, px, of what `image` makes of stars with such footprints."""
    side = PHASES * TILE_PX
    place = (np.arange(PHASES) + 0.5) * TILE_PX + (np.arange(PHASES) + 0.5) / PHASES - 0.5
    x_px, y_px = (axis.ravel() for axis in np.meshgrid(place, place))
    flux, star = np.full(PHASES**2, WHITE / peak_share(SIGMA_PX)), np.arange(PHASES**2)
    sprites = pack_sprites(x_px, y_px, flux, star, (side, side), size_px)
    bright = linear_image(sprites, (side, side), SIGMA_PX, TILE_PX)
    errors = [measure(bright * flux_ratio(mag), image(fainter(sprites, mag)).copy(), TILE_PX) for mag in (0.0, FAINTER_MAG)]
    return max(e.flux_max_mag for e in errors), max(e.centroid_max_px for e in errors)
