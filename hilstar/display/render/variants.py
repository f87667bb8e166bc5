"""Renderers for measurements only: one with another splat, for the study of trade-offs, and one
that times its stages.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import moderngl
import numpy as np

from hilstar.basics.units import NS_PER_MS
from hilstar.display.render.encoder import Shares, build_program, splat_program
from hilstar.display.render.renderer import FIRST_CAPACITY, Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.optics.psf import pixel_shares
from hilstar.optics.sprites import FrameLight

Profile = Literal["renderer", "erf", "exp erf", "table", "centre"]


@dataclass(frozen=True, slots=True)
class SplatVariant:
    """A variant of the splat: the profile, the linear image's texel, the footprint's side; by
    default the renderer's.

    `table_size` is the number of samples that the profile `table` interpolates between.
    """

    profile: Profile = "renderer"
    half_float: bool = False
    footprint_px: int | None = None
    table_size: int = 0


class VariantRenderer(Renderer):
    """A renderer of linear images whose splat is a variant's. Free it with `close`."""

    MAY_USE_CPU = False  # it is the splat that is compared

    def __init__(self, target: Target, variant: SplatVariant) -> None:
        super().__init__(target)
        self.footprint_px = variant.footprint_px or self.footprint_px
        with self._ctx:
            self._vary(variant)

    @property
    def texel(self) -> str:
        """The linear image's texel, as GL names it."""
        return {"f4": "R32F", "f2": "R16F"}[self._linear.dtype]

    def _vary(self, variant: SplatVariant) -> None:
        if variant.half_float:
            self._linear = self._ctx.texture(self.target.resolution_px, 1, dtype="f2")
            self._linear_fbo = self._ctx.framebuffer([self._linear])
        if variant.profile in ("renderer", "erf"):
            self._shares = Shares(self._ctx, self.target.psf, self.footprint_px)
            if variant.profile == "erf":  # where a polynomial would do
                self._shares.defines = ()
            self._splat = splat_program(self._ctx, self.target.resolution_px, self._shares)
        else:
            define = variant.profile.upper().replace(" ", "_")
            self._splat = build_program(self._ctx, "star.vert", "study/splat.frag", (define,))
            self._splat["resolution_px"] = self.target.resolution_px
            if variant.profile == "table":
                # Shares along x and y, the two channels of one row, from a star's centre to past
                # its footprint's edge
                reach_px = self.footprint_px / 2 + 1
                size = variant.table_size
                offset_px = np.linspace(0, reach_px, size)
                shares = np.stack(
                    [pixel_shares(offset_px, sigma) for sigma in self.target.psf.width_px], axis=-1
                )
                self._table = self._ctx.texture(
                    (size, 1), 2, shares.astype(np.float32).tobytes(), dtype="f4"
                )
                self._table.filter = (moderngl.NEAREST, moderngl.NEAREST)
                self._table.use(0)
                self._splat["samples_per_px"] = (size - 1) / reach_px
            else:
                self._splat["sigma_px"] = self.target.psf.width_px
            self._splat["footprint_px"] = self.footprint_px
        self._reserve(FIRST_CAPACITY)

    def draw_and_wait(self, sprites: FrameLight) -> None:
        """Draw the linear image of `sprites`, and return when it is done."""
        self.draw(sprites)
        with self._ctx:
            self._ctx.finish()


class StagedRenderer(Renderer):
    """A renderer that waits after each stage. `stage_ms` is the last frame's wall time (ms) of
    erase, upload, splat, encode, choose and read_back.

    `gpu_splat` and `gpu_encode` are measured by the driver's own timers, where it has them.
    """

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.stage_ms: dict[str, float] = {}
        with self._ctx:
            self._queries = {stage: self._ctx.query(time=True) for stage in ("splat", "encode")}

    def levels(self) -> Levels:
        """See `Backend.levels`; its time is that of `read_back`."""
        begin = time.perf_counter()
        levels = super().levels()
        self.stage_ms["read_back"] = (time.perf_counter() - begin) * 1e3
        return levels

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        query = self._queries.get(name)
        begin = time.perf_counter()
        if query is None:
            yield
        else:
            with query:
                yield
        self._ctx.finish()
        self.stage_ms[name] = (time.perf_counter() - begin) * 1e3
        if query is not None and query.elapsed:
            self.stage_ms[f"gpu_{name}"] = query.elapsed / NS_PER_MS
