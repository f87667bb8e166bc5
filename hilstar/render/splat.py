"""A PSF for the shaders of one context, and the program that draws stars by it."""

from __future__ import annotations

import moderngl

from hilstar.render.encoder import build_program
from hilstar.scene.psf import Psf

TABLE_UNIT = 15  # the last texture unit that every OpenGL has: nothing else takes it


class Shares:
    """What a program needs that comes after shares.glsl; `defines` stand before it. It lives in its renderer's context."""

    def __init__(self, ctx: moderngl.Context, psf: Psf, footprint_px: int | None = None) -> None:
        self.footprint_px = footprint_px or psf.footprint_px
        self.defines, self._uniforms, table = psf.shader(self.footprint_px)
        self._table: moderngl.Texture | None = None
        if table is not None:
            self._table = ctx.texture(table.shape[1::-1], table.shape[2], table, dtype="f4")
            self._table.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def set(self, program: moderngl.Program | moderngl.ComputeShader) -> None:
        """Set the uniforms of a program; compilers drop what a program does not need."""
        for name, value in self._uniforms.items():
            if name in program:
                program[name] = value
        if "share_table" in program:
            program["share_table"] = TABLE_UNIT

    def bind(self) -> None:
        """Bind the table, if there is one, for the next passes: another renderer of the context may have bound its own."""
        if self._table is not None:
            self._table.use(TABLE_UNIT)


def splat_program(
    ctx: moderngl.Context, resolution_px: tuple[int, int], shares: Shares, in_units: bool = False
) -> moderngl.Program:
    """The program of star.vert and splat.frag; `in_units` draws light in the whole units of a LightUnits."""
    program = build_program(ctx, "star.vert", "splat.frag", (*shares.defines, *["UNITS"] * in_units), "shares.glsl")
    shares.set(program)
    program["resolution_px"] = resolution_px
    program["footprint_px"] = shares.footprint_px
    return program
