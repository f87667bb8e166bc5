"""Frames drawn by NumPy where a machine has no OpenGL.

Stars are those of `cpu_stars`; extended light is that of `reference` in float32, slower than
OpenGL's. The quantisers are those that the shaders follow.
"""

import ctypes
import logging
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import MachineError, NotThereError
from hilstar.display.egl import EGL_LIBRARY
from hilstar.display.exact import ExactQuantiser
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantiser, UnquantisedFrame, level_dtype
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.aids import LINE_SHARE, lay_over
from hilstar.display.render.apart import ApartBackend
from hilstar.display.render.backend import NO_FRAME, Backend, ScreenView, as_maps
from hilstar.display.render.cpu_stars import CpuImage, CpuStars
from hilstar.display.render.light_units import LightUnits
from hilstar.display.render.reference import extended_image
from hilstar.display.render.target import Target
from hilstar.display.render.way import wanted_way
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
    open_panel = partial(_open_panel, context)
    if target.primaries:
        return ApartBackend(target, open_panel)
    return open_panel(target, ())


def _open_panel(context: "Context | None", target: Target, before: Sequence[Backend]) -> Backend:
    """The backend of a grey target, or of one primary and those `before` it (see `Target.turn`)."""
    if context is None:
        return NumpyBackend(target, before)
    # moderngl, which nothing needs where NumPy draws
    from hilstar.display.render.renderer import Renderer

    return Renderer(target, context, before)


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


def _exact_quantisers(backends: Sequence[Backend]) -> list[ExactQuantiser]:
    """The quantisers of backends that choose a star's levels together."""
    quantisers = []
    for backend in backends:
        if isinstance(backend, NumpyBackend) and isinstance(backend._quantiser, ExactQuantiser):
            quantisers.append(backend._quantiser)
    return quantisers


class NumpyBackend(Backend):
    """Draws sprites of one grey Target in NumPy; `back_buffer` has the codes (height, width, 3)
    that were presented.

    `before` are the backends of the target's `turn`, for whose stars' errors those here make up.
    """

    back_buffer: npt.NDArray[np.uint16]

    context = None
    gl_renderer = NUMPY
    gl_version = np.__version__

    def __init__(self, target: Target, before: Sequence[Backend] = ()) -> None:
        super().__init__(target)
        panel = target.panel()
        self._quantiser: Quantiser | None = None
        if panel is not None:
            kind = QUANTISERS[target.quantisation]
            self._quantiser = kind(panel, target.resolution_px, target.psf, target.seen)
        if isinstance(self._quantiser, ExactQuantiser):
            self._quantiser.turn = target.turn
            self._quantiser.before = _exact_quantisers(before)
        self.path = "NumPy"
        self._stars: CpuStars | None = None
        self._level_image = np.empty((0, 0), dtype=np.uint8)
        if panel is not None and target.quantisation == "round":
            self.path = "CPU"
            self._build_stars(panel)
        self._image_of_stars = CpuImage(target.resolution_px, target.psf)
        self._last_frame = NO_FRAME
        self._linear: Float32Array | None = None  # that of `_sprites`, once somebody asks
        self._sprites: FrameLight | None = None
        self._levels: Levels | None = None
        # the last ones, and their image
        self._lights: tuple[tuple[ExtendedLight, ...], FloatArray] | None = None

    def draw(self, sprites: FrameLight | None, frame: int = 0) -> None:
        """Draw `sprites` (None: blank); see `Backend.draw`."""
        if frame <= self._last_frame:
            self.begin_anew()
        self._last_frame = frame
        self._sprites = sprites
        self._linear = None
        if self._stars is not None and self._draws_stars_alone(self._stars, sprites):
            return
        if self._quantiser is not None:
            image = partial(self._image, sprites, True)
            alone = partial(self._image, sprites, False, stars=False)
            light = UnquantisedFrame(sprites, image, alone, frame)
            self._levels = self._quantiser.draw(light)

    def _build_stars(self, panel: Panel) -> None:
        """Make what draws the nearest levels of frames of stars alone."""
        target = self.target
        units = LightUnits(panel, target.resolution_px, target.psf, target.sides)
        shape = target.resolution_px[::-1]
        self._level_image = np.zeros(shape, dtype=level_dtype(panel.response))
        self._stars = CpuStars(units, self._level_image)
        self._units = units

    def _draws_stars_alone(self, stars: CpuStars, sprites: FrameLight | None) -> bool:
        """Whether the levels of a frame are those of stars alone, which are drawn then."""
        light = as_maps(sprites, self.target)
        if light is not None and light.extended:
            return False
        stars.lay(None)
        if light is not None and len(light):
            stars.add(light, self._units.unit_for(light))
            stars.encode()
        self._levels = Levels(self._level_image)
        return True

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

    def show_on(self, view: ScreenView, beside: Sequence[Backend] = ()) -> None:
        """See `Backend.show_on`."""
        self._screen = view
        self._shown = (self, *beside)

    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """See `Backend.present`."""
        view = self._screen
        turn, (width, height) = view.orientation, view.orientation.screen_px(view.screen_px)
        shown = np.stack([backend.levels()[:height, :width] for backend in self._shown], -1)
        if view.triples is not None:
            shown = view.triples[shown[..., 0]]
        codes = np.zeros((height, width, 3), dtype=np.uint16)
        codes[: shown.shape[0], : shown.shape[1]] = shown
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
        if self._quantiser is not None:
            self._quantiser.begin_anew()

    def finish(self) -> None:
        """Return at once: `draw` has drawn."""

    def close(self) -> None:
        """Do nothing."""

    def _image(self, sprites: FrameLight | None, shrunk: bool, stars: bool = True) -> Float32Array:
        """The linear image, or its extended light; `shrunk` draws fainter stars within the
        target's `sides`.
        """
        width, height = self.target.resolution_px
        if stars:
            sprites = as_maps(sprites, self.target)
        zeros = np.zeros((height, width), dtype=np.float32)
        if sprites is None:
            return zeros
        if sprites.extended:
            extended = self._extended(sprites.extended)
        else:
            extended = None
        if not stars:
            if extended is None:
                return zeros
            return extended.astype(np.float32)
        self._image_of_stars.draw(sprites, self._sides_px(sprites, shrunk))
        image = self._image_of_stars.image
        if extended is None:
            return image
        return (image + extended).astype(np.float32)

    def _sides_px(self, sprites: FrameLight, shrunk: bool) -> IntArray:
        """The sides (n,) of the squares of sprites."""
        sides_px = np.full(len(sprites), self.target.psf.footprint_px)
        rate = sprites.data["electrons_per_s"] * sprites.per_star
        for side in self.target.sides if shrunk else ():
            sides_px[rate < side.below_e_per_s] = side.side_px
        return sides_px

    def _extended(self, lights: tuple[ExtendedLight, ...]) -> FloatArray:
        """The light of discs and stray light alone (height, width); the same lights again are
        not drawn again.
        """
        if self._lights is None or self._lights[0] != lights:
            self._lights = lights, extended_image(lights, self.target.resolution_px)
        return self._lights[1]
