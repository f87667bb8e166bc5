"""Frames drawn by NumPy where a machine has no OpenGL: the oracle of the GL renderer as a backend, slower.

The linear image is that of `reference` in float32, and the quantisers are those of `monitor`, which the shaders follow.
"""

from __future__ import annotations

import ctypes
import logging
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.errors import MachineError
from hilstar.monitor.exact import ExactQuantiser
from hilstar.monitor.quantise import QUANTISERS, Panel, dither_levels, mask_turn, round_levels
from hilstar.monitor.response import Levels
from hilstar.monitor.temporal import star_quantiser
from hilstar.render.backend import EGL_LIBRARY, NO_FRAME, Backend, Path, Target
from hilstar.render.reference import add_stars, extended_image
from hilstar.scene.extended import ExtendedLight
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import Sprites

if TYPE_CHECKING:
    from moderngl import Context

NUMPY = "NumPy"
log = logging.getLogger(__name__)


def open_backend(target: Target, context: Context | None) -> Backend:
    """What draws for a target: OpenGL in a context, NumPy without one (see `headless_context`)."""
    if context is None:
        return NumpyBackend(target)
    from hilstar.render.renderer import Renderer  # moderngl, which nothing needs where NumPy draws

    return Renderer(target, context)


def headless_context(gpu: int | str | None = None) -> Context | None:
    """A headless GL context on a GPU (see `create_context`); None where this machine has no OpenGL, so that NumPy draws.

    Raises InputError where the machine has no such GPU.
    """
    if gpu is None and not _has_egl():
        _say_once(f"{EGL_LIBRARY} is missing")
        return None
    from hilstar.render.context import create_context  # moderngl

    try:
        return create_context(gpu)
    except MachineError as error:
        _say_once(str(error))
        return None


def _has_egl() -> bool:
    try:
        ctypes.CDLL(EGL_LIBRARY)
    except OSError:
        return False
    return True


@lru_cache(maxsize=1)
def _say_once(why: str) -> None:
    log.warning("NumPy draws, slower than OpenGL would (%s); 'hilstar doctor' says what to install", why)


class NumpyBackend:
    """Draws sprites of one Target in NumPy."""

    context = None
    gl_renderer = NUMPY
    gl_version = np.__version__
    path: Path = "NumPy"

    def __init__(self, target: Target) -> None:
        self.target = target
        self.footprint_px = footprint_px(target.sigma_px)
        self._panel = target.panel()
        self._last_frame = NO_FRAME
        self._linear: Float32Array | None = None  # that of `_sprites`, once somebody asks
        self._sprites: Sprites | None = None
        self._levels: Levels | None = None
        self._lights: tuple[ExtendedLight, ...] = ()
        self._lights_image: FloatArray | None = None
        self._chooser: ExactQuantiser | None = None
        self._quantiser = QUANTISERS[target.quantisation]
        if self._panel is not None and self._quantiser.by_star:
            chooser = star_quantiser(target.quantisation)
            self._chooser = chooser(self._panel, target.resolution_px, target.sigma_px, target.seen)

    def draw(self, sprites: Sprites | None, frame: int = 0) -> None:
        """Draw `sprites` (None: blank); see `Backend.draw`."""
        if frame <= self._last_frame:
            self.begin_anew()
        self._last_frame = frame
        self._sprites, self._linear = sprites, None
        if self._panel is not None:
            self._levels = self._chosen(sprites, frame, self._panel)

    def _chosen(self, sprites: Sprites | None, frame: int, panel: Panel) -> Levels:
        """The levels of a frame by the target's quantisation."""
        if self._chooser is None:
            image = self._image(sprites, shrunk=True)
            return dither_levels(image, panel) if self._quantiser.dithered else round_levels(image, panel)
        floor = None
        if sprites is not None and sprites.extended:  # stars are added to its dithered light
            turn = mask_turn(frame) if self._quantiser.over_frames else 0.0
            floor = dither_levels(self._extended(sprites).astype(np.float32), panel, turn)
        return self._chooser.levels(sprites, floor)

    def draw_linear(self, sprites: Sprites) -> None:
        """Draw the linear image of `sprites` alone; see `Backend.draw_linear`."""
        self._sprites, self._linear = sprites, None

    def linear(self) -> Float32Array:
        """The linear image of the last draw, electrons per second, float32 (height, width)."""
        if self._linear is None:
            self._linear = self._image(self._sprites, shrunk=False)
        return self._linear

    def levels(self) -> Levels:
        """The levels of the last draw (height, width); TypeError for a target without a response."""
        if self._levels is None:
            raise TypeError("this target has no monitor response, so no levels")
        return self._levels

    def begin_anew(self) -> None:
        """The next frame is the first of a sequence."""
        self._last_frame = NO_FRAME
        if self._chooser is not None:
            self._chooser.left = None

    def finish(self) -> None:
        """Nothing is ever under way."""

    def close(self) -> None:
        """Nothing to free."""

    def _image(self, sprites: Sprites | None, shrunk: bool) -> Float32Array:
        """The linear image; `shrunk` draws fainter stars within the target's `sides`, as their levels are."""
        width, height = self.target.resolution_px
        if sprites is None:
            return np.zeros((height, width), dtype=np.float32)
        image = self._extended(sprites).copy()
        sides_px = np.full(len(sprites), self.footprint_px)
        rate = sprites.data["electrons_per_s"] * sprites.per_star
        for side in self.target.sides if shrunk else ():
            sides_px[rate < side.below_e_per_s] = side.side_px
        for side_px in np.unique(sides_px).tolist():
            add_stars(image, sprites, self.target.sigma_px, side_px, np.flatnonzero(sides_px == side_px))
        return image.astype(np.float32)

    def _extended(self, sprites: Sprites) -> FloatArray:
        """The light of discs and stray light alone (height, width); the same lights again are not drawn again."""
        if self._lights_image is None or sprites.extended != self._lights:
            self._lights_image = extended_image(sprites.extended, self.target.resolution_px)
            self._lights = sprites.extended
        return self._lights_image
