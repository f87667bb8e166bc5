"""Frames drawn by NumPy where a machine has no OpenGL.

Stars are those of `cpu_stars`; extended light is that of `reference` in float32, slower than
OpenGL's. The quantisers are those that the shaders follow.
"""

import ctypes
import logging
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import MachineError, NotThereError
from hilstar.display.quantise import UnquantisedFrame, level_dtype
from hilstar.display.render.aids import LINE_SHARE, lay_over
from hilstar.display.render.backend import NO_FRAME, Backend, ScreenView, as_maps
from hilstar.display.render.cpu_stars import CpuImage, CpuStars
from hilstar.display.render.light_units import LightUnits
from hilstar.display.render.reference import extended_image
from hilstar.display.render.target import Planes, Target
from hilstar.display.render.turns import levels_by_plane, quantisers_of
from hilstar.display.render.way import EGL_LIBRARY, wanted_way
from hilstar.display.response import Levels
from hilstar.optics.extended import ExtendedLight
from hilstar.optics.sprites import FrameLight

if TYPE_CHECKING:
    from moderngl import Context

NUMPY = "NumPy"
NO_OPENGL = "HILSTAR_DRAW=gl, and there is no OpenGL ({}); unset it, or see 'hilstar doctor'"
log = logging.getLogger(__name__)


def open_backend(target: Target, context: "Context | None") -> Backend:
    """The backend of a target: OpenGL in a context, NumPy without one (see `headless_context`)."""
    if context is None:
        return NumpyBackend(target)
    # moderngl, which nothing needs where NumPy draws
    from hilstar.display.render.renderer import Renderer

    return Renderer(target, context)


def headless_context(gpu: int | str | None = None) -> "Context | None":
    """A headless GL context on a GPU (see `create_context`); None where this machine has no OpenGL,
    so that NumPy draws.

    Raises InputError where the machine has no such GPU, and MachineError where HILSTAR_DRAW=gl
    wants one.
    """
    if gpu is None:
        try:
            ctypes.CDLL(EGL_LIBRARY)
        except OSError as error:
            if wanted_way() == "gl":
                raise MachineError(NO_OPENGL.format(f"{EGL_LIBRARY} is missing")) from error
            _say_once(f"{EGL_LIBRARY} is missing")
            return None
    from hilstar.display.render.context import create_context  # moderngl

    try:
        return create_context(gpu)
    except NotThereError:  # a named one is meant, and no other draws in its place
        raise
    except MachineError as error:
        if wanted_way() == "gl":
            raise MachineError(NO_OPENGL.format(error)) from error
        _say_once(str(error))
        return None


@lru_cache(maxsize=1)
def _say_once(why: str) -> None:
    log.warning(
        "no OpenGL here (%s): the processor draws, discs and `exact` slower than OpenGL would;"
        " 'hilstar doctor' says what to install",
        why,
    )


class NumpyBackend(Backend):
    """Draws sprites of one Target in NumPy; `back_buffer` has the codes (height, width, 3) that
    were presented.
    """

    back_buffer: npt.NDArray[np.uint16]

    context = None
    gl_renderer = NUMPY
    gl_version = np.__version__

    def __init__(self, target: Target) -> None:
        self.target = target
        self._quantisers = quantisers_of(target)
        self.path = "NumPy"
        self._stars: CpuStars | None = None
        self._level_image = np.empty((0, 0, 0), dtype=np.uint8)
        self._planes = Planes.of(target)
        if self._planes.panels and target.quantisation == "round":
            self.path = "CPU"
            self._build_stars()
        self._image_of_stars = CpuImage(target.resolution_px, target.psf)
        self._last_frame = NO_FRAME
        self._linear: Float32Array | None = None  # that of `_sprites`, once somebody asks
        self._sprites: FrameLight | None = None
        self._levels: Levels | None = None
        # the last of each primary, and its image
        self._lights: dict[int, tuple[tuple[ExtendedLight, ...], FloatArray]] = {}

    def draw(self, sprites: FrameLight | None, frame: int = 0) -> None:
        """Draw `sprites` (None: blank); see `Backend.draw`."""
        if frame <= self._last_frame:
            self.begin_anew()
        self._last_frame = frame
        self._sprites = sprites
        self._linear = None
        if self._stars is not None and self._draws_stars_alone(self._stars, sprites):
            return
        if self._quantisers:
            self._levels = levels_by_plane(self.target, sprites, partial(self._plane, frame))

    def _build_stars(self) -> None:
        """Make what draws the nearest levels of frames of stars alone."""
        target = self.target
        planes = self._planes
        units = LightUnits(planes, target.resolution_px, target.psf, target.sides)
        shape = *target.resolution_px[::-1], len(planes.panels)
        self._level_image = np.zeros(shape, dtype=level_dtype(planes.panels[0].response))
        self._stars = CpuStars(units, self._level_image)
        self._units = units

    def _draws_stars_alone(self, stars: CpuStars, sprites: FrameLight | None) -> bool:
        """Whether the levels of a frame are those of stars alone, which are drawn then."""
        light = as_maps(sprites, self.target)
        if light is not None and light.extended:
            return False
        stars.lay(None)
        if light is not None and len(light):
            packed = self._planes.packed(light)
            stars.add(packed, self._units.unit_for(packed))
            stars.encode()
        image = self._level_image
        if not self.target.primaries:
            image = image[..., 0]
        self._levels = Levels(image)
        return True

    def _plane(self, frame: int, k: int, light: FrameLight | None) -> Levels:
        image = partial(self._image, light, True, k)
        alone = partial(self._image, light, False, k, stars=False)
        return self._quantisers[k].draw(UnquantisedFrame(light, image, alone, frame))

    def draw_linear(self, sprites: FrameLight) -> None:
        """Draw the linear image of `sprites` alone; see `Backend.draw_linear`."""
        self._sprites = sprites
        self._linear = None

    def linear(self) -> Float32Array:
        """The linear image of the last draw, electrons per second, float32 (height, width)."""
        if self._linear is None:
            self._linear = self._image(self._sprites, shrunk=False)
        return self._linear

    def levels(self) -> Levels:
        """The levels of the last draw (height, width); TypeError for a target without a
        response.
        """
        if self._levels is None:
            raise TypeError("this target has no monitor response, so no levels")
        return self._levels

    def show_on(self, view: ScreenView) -> None:
        """See `Backend.show_on`."""
        self._screen = view

    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """See `Backend.present`."""
        view = self._screen
        turn, (width, height) = view.orientation, view.orientation.screen_px(view.screen_px)
        shown = self.levels()[:height, :width]
        if view.triples is not None:
            shown = view.triples[shown]
        codes = np.zeros((height, width, 3), dtype=np.uint16)
        codes[: shown.shape[0], : shown.shape[1]] = shown if shown.ndim == 3 else shown[..., None]
        cross_x, cross_y = map(round, view.cross_px)
        lay_over(
            codes, overlay, patch_code, int(LINE_SHARE * (2**view.bits - 1)), (cross_x, cross_y)
        )
        codes = np.rot90(codes, -turn.quarter_turns)[
            :: -1 if turn.flip_y else 1, :: -1 if turn.flip_x else 1
        ].copy()
        codes[len(codes) - marker[0] :, : marker[0]] = marker[1]
        self.back_buffer = codes

    def take_back_buffer(self) -> None:
        """Return at once: nothing swaps it."""

    def remember_tables(self) -> None:
        """The host's memory keeps them."""

    def begin_anew(self) -> None:
        """The next frame is the first of a sequence."""
        self._last_frame = NO_FRAME
        for quantiser in self._quantisers.values():
            quantiser.begin_anew()

    def finish(self) -> None:
        """Return at once: `draw` has drawn."""

    def close(self) -> None:
        """Do nothing."""

    def _image(
        self, sprites: FrameLight | None, shrunk: bool, plane: int = 0, stars: bool = True
    ) -> Float32Array:
        """The linear image of a plane, or its extended light; `shrunk` draws fainter stars
        within the target's `sides`.
        """
        width, height = self.target.resolution_px
        if stars:
            sprites = as_maps(sprites, self.target)
        zeros = np.zeros((height, width), dtype=np.float32)
        if sprites is None:
            return zeros
        if sprites.extended:
            extended = self._extended(sprites.extended, plane)
        else:
            extended = None
        if not stars:
            if extended is None:
                return zeros
            return extended.astype(np.float32)
        self._image_of_stars.draw(sprites, self._sides_px(sprites, shrunk, plane))
        image = self._image_of_stars.image
        if extended is None:
            return image
        return (image + extended).astype(np.float32)

    def _sides_px(self, sprites: FrameLight, shrunk: bool, plane: int) -> IntArray:
        """The sides (n,) of the squares of sprites."""
        sides_px = np.full(len(sprites), self.target.psf.footprint_px)
        rate = sprites.data["electrons_per_s"] * sprites.per_star
        if self.target.primaries:
            white_e_per_s = self.target.primaries[plane].flux_at_white_e_per_s
            rate = rate * (self.target.flux_at_white_e_per_s / white_e_per_s)
        for side in self.target.sides if shrunk else ():
            sides_px[rate < side.below_e_per_s] = side.side_px
        return sides_px

    def _extended(self, lights: tuple[ExtendedLight, ...], plane: int) -> FloatArray:
        """The light of discs and stray light alone (height, width); the same lights again are
        not drawn again.
        """
        if plane not in self._lights or self._lights[plane][0] != lights:
            self._lights[plane] = lights, extended_image(lights, self.target.resolution_px)
        return self._lights[plane][1]
