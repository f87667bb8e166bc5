"""Where stars pop: one star's light from frame to frame while the camera turns slowly."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.quantise import Quantisation
from hilstar.monitor.response import srgb_response
from hilstar.render.renderer import Renderer, Target
from hilstar.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.scene.psf import footprint_px, peak_share
from hilstar.scene.sprites import Sprites, make_sprites
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, load_catalog
from hilstar.sky.stars import make_stars, unit_vectors_icrs
from hilstar.study.shared.codes import AIMS
from hilstar.study.stability.failure_case import FailureCase, Figures
from hilstar.study.stability.field import ALIGNED, FOCAL_LENGTH_MM, PITCH_UM
from hilstar.study.stability.image import POINT_SAMPLED, SIGMA_PX, Draw, by_renderer, point_sampled, target
from hilstar.units import flux_ratio, magnitude

STEPS, PATH_PX = 1000, (3.0, 1.7)
IMAGE_PX = (32, 32)
# 1e-4 mag: a two-hundredth of the finest aim for codes, so that what ripples is the monitor's doing alone.
RIPPLE = 1e-4
CODES_MAG_UNDER_WHITE, CODES_BITS = 6.0, 8
CODES_RIPPLE_MAG = AIMS[CODES_BITS][0]


def moving_star(on: Target, electrons_per_s: float = 1.0) -> Iterator[Sprites]:
    """Sirius at a given flux in STEPS frames of the demo's camera, which turns until the star has moved by PATH_PX."""
    sirius = load_catalog().brighter_than(-1.0)
    vectors = unit_vectors_icrs(sirius, HIPPARCOS_EPOCH_JYEAR)
    stars = make_stars(sirius, vectors, np.full(1, np.nan), np.full(1, electrons_per_s))
    camera = monitor_camera(on.resolution_px, PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    start = from_radec_roll_deg(float(sirius.ra_deg[0]), float(sirius.dec_deg[0]), 20.0)
    # A turn about x moves stars up the image, one about -y to the right.
    turn_rad = np.array([-PATH_PX[1], -PATH_PX[0], 0.0]) / camera.focal_length_px
    for share in np.linspace(0, 1, STEPS):
        yield make_sprites(stars, to_matrix(propagate(start, share * turn_rad, 1.0)), camera, footprint_px(on.sigma_px))


def moving_fluxes(draw: Draw, on: Target) -> FloatArray:
    """Its light (steps,) in each image."""
    return np.array([draw(sprites).sum() for sprites in moving_star(on)])


def moving_code_fluxes(quantisation: Quantisation) -> FloatArray:
    """The light (steps,) that an sRGB monitor makes of it, relative to the light wanted.

    It is CODES_MAG_UNDER_WHITE fainter than a star whose peak is white.
    """
    sigma, response = (SIGMA_PX, SIGMA_PX), srgb_response(CODES_BITS)
    flux = flux_ratio(CODES_MAG_UNDER_WHITE) / peak_share(sigma)
    on, light = Target(IMAGE_PX, sigma, response, 1.0, quantisation), []
    with Renderer(on) as gl:
        for sprites in moving_star(on, flux):
            gl.draw(sprites)
            light.append(response.light[gl.codes()].sum())
    return np.array(light) / flux


def ripple(fluxes: FloatArray) -> float:
    """From the faintest to the brightest of a star's fluxes, relative to their mean."""
    return float((fluxes.max() - fluxes.min()) / fluxes.mean())


def popping() -> FailureCase:
    """A star's light in the linear image while the camera turns by parts of a pixel."""
    on = target(0.5, IMAGE_PX)
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
    fluxes = [moving_code_fluxes("round"), moving_code_fluxes("exact")]
    fault, error = (magnitude(float(f.min() / f.max())) for f in fluxes)
    return FailureCase(
        f"the same, {CODES_MAG_UNDER_WHITE:g} mag under white on {CODES_BITS} bits, sigma {SIGMA_PX:g} px",
        'quantisation = "round"',
        f"its light varies by {fault:.3f} mag",
        f'quantisation = "exact", what `auto` takes there: {error:.3f} mag',
        "round adds up the errors of its pixels; exact chooses a star's codes together",
        Figures(error, fault, CODES_RIPPLE_MAG),
    )
