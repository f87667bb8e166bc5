"""The program that draws a star's light: by a polynomial for each axis where one is exact enough, else by error functions."""

from __future__ import annotations

from functools import reduce
from itertools import zip_longest

import moderngl

from hilstar.render.encoder import build_program
from hilstar.scene.psf import SQRT2, share_polynomial


def splat_program(
    ctx: moderngl.Context,
    resolution_px: tuple[int, int],
    sigma_px: tuple[float, float],
    footprint_px: int,
    by_erf: bool = False,
    in_units: bool = False,
) -> moderngl.Program:
    """The program of star.vert and splat.frag for sprites of one sigma, up to `footprint_px` a side.

    `by_erf` has error functions where polynomials would do, for the study of trade-offs. `in_units` draws light in the whole
    units of a LightUnits.
    """
    define = (() if by_erf else share_define(sigma_px, footprint_px)) + (("UNITS",) if in_units else ())
    program = build_program(ctx, "star.vert", "splat.frag", define, "shares.glsl")
    set_sigma(program, sigma_px)
    program["resolution_px"] = resolution_px
    program["footprint_px"] = footprint_px
    return program


def set_sigma(program: moderngl.Program | moderngl.ComputeShader, sigma_px: tuple[float, float]) -> None:
    """Set the sigma of a program of shares.glsl, where its shares are by error functions."""
    if "inverse_sigma_sqrt2" in program:
        program["inverse_sigma_sqrt2"] = tuple(1 / (sigma * SQRT2) for sigma in sigma_px)


def share_define(sigma_px: tuple[float, float], footprint_px: int) -> tuple[str, ...]:
    """LOG2_SHARE for a shader, in a footprint; nothing where only error functions are exact enough."""
    axes = [share_polynomial(sigma, footprint_px / 2 + 0.5) for sigma in sigma_px]
    if axes[0] is None or axes[1] is None:
        return ()
    terms = [f"vec2({x:.9e}, {y:.9e})" for x, y in zip_longest(axes[0], axes[1], fillvalue=0.0)]
    # Written out: from an array of uniforms llvmpipe takes twice as long.
    polynomial = reduce(lambda sum, term: f"({sum} * square + {term})", reversed(terms))
    return (f"LOG2_SHARE(square) {polynomial}",)
