"""What draws frames, and for what: the `Backend` protocol, which OpenGL (`renderer`) and NumPy (`numpy_backend`) keep.

Nothing here imports moderngl, so a bench can be planned, and drawn by NumPy, on a machine without OpenGL.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from hilstar.arrays import Float32Array
from hilstar.errors import InputError
from hilstar.monitor.balance import AS_USUAL, Seen
from hilstar.monitor.footprints import PixelOrder
from hilstar.monitor.quantise import Panel, Quantisation
from hilstar.monitor.response import Levels, Response
from hilstar.scene.sprites import Sprites

if TYPE_CHECKING:
    from moderngl import Context

EGL_LIBRARY = "libEGL.so.1"
NO_FRAME = -1  # before the first frame of a sequence
MAX_SIDES = 8  # as in star.vert
MIN_COMPUTE_VERSION = 430  # the OpenGL that has compute shaders
MAX_NEAR = 128  # pixels of a star that exact.comp has bits for: sprites up to a sigma of 1.8 px
MAX_SIZE = 63  # largest footprint whose places fit into six bits
Path = Literal["compute shaders", "points", "points, then compute shaders", "NumPy"]


@dataclass(frozen=True, slots=True)
class SpriteSide:
    """The side of the sprites of stars below a rate."""

    below_e_per_s: float
    side_px: int


SpriteSides = tuple[SpriteSide, ...]


@dataclass(frozen=True, slots=True)
class Target:
    """What a backend draws for: an image's pixels, its sprites, and a monitor's response where codes are wanted.

    `uniformity` float32 (height, width) is each pixel's light relative to the response (None: 1 everywhere). `sides` are those
    of fainter stars' sprites, by falling rates, of the same parity as the footprint. `seen` is how the tracker sees the
    monitor, for `exact` and `temporal`.
    """

    resolution_px: tuple[int, int]
    sigma_px: tuple[float, float]
    response: Response | None = None
    flux_at_white_e_per_s: float = 1.0
    quantisation: Quantisation = "round"
    uniformity: Float32Array | None = None
    sides: SpriteSides = ()
    seen: Seen = AS_USUAL

    def panel(self) -> Panel | None:
        """What turns light into levels, None without a response. Raises InputError for a map that does not fit."""
        if self.response is None:
            return None
        width, height = self.resolution_px
        if self.uniformity is not None and self.uniformity.shape != (height, width):
            found = " x ".join(map(str, self.uniformity.shape[::-1]))
            raise InputError(f"the uniformity map is {found} px and the monitor {width} x {height}; give one value per pixel")
        return Panel(self.response, self.flux_at_white_e_per_s, self.uniformity)


class Backend(Protocol):
    """Draws the frames of one Target. Free it with `close`."""

    target: Target
    footprint_px: int

    @property
    def gl_renderer(self) -> str:
        """The name of the GL renderer as the driver gives it, or "NumPy"."""

    @property
    def gl_version(self) -> str:
        """The version of OpenGL as the driver gives it, or NumPy's."""

    @property
    def path(self) -> Path:
        """What draws the levels."""

    @property
    def context(self) -> Context | None:
        """The GL context, for another backend beside this one; None where NumPy draws."""

    def draw(self, sprites: Sprites | None, frame: int = 0) -> None:
        """Draw the linear image and the levels of `sprites` (None: blank); read them with `linear` and `levels`.

        `frame` counts the frames shown, for `temporal` alone: a number not above the last one's begins a new sequence.
        """

    def draw_linear(self, sprites: Sprites) -> None:
        """Draw the linear image of `sprites` alone, no sprite smaller than the footprint; the next `levels` are undefined.

        What `temporal` carries from frame to frame stays as it is.
        """

    def linear(self) -> Float32Array:
        """The linear image of the last draw, electrons per second, float32 (height, width); the next draw overwrites it."""

    def levels(self) -> Levels:
        """The levels of the last draw (height, width), uint8 up to 256 levels, else uint16; the next draw overwrites them.

        A target without a response has none: TypeError.
        """

    def begin_anew(self) -> None:
        """Forget what `temporal` carries from frame to frame: the next frame is the first of a sequence."""

    def finish(self) -> None:
        """Wait until everything that was asked for is drawn."""

    def close(self) -> None:
        """Free what the backend holds."""


def has_compute(context: Context | None) -> bool:
    """Whether this GL has compute shaders (OpenGL 4.3); without them `exact` and `temporal` choose their levels in NumPy.

    True where NumPy draws everything (None): no frame waits for a screen there, so the bench is planned, and its codes
    chosen, as for a usual GL.
    """
    return context is None or bool(context.version_code >= MIN_COMPUTE_VERSION)


def exact_shader_takes(sigma_px: tuple[float, float]) -> bool:
    """Whether exact.comp has bits enough for the pixels of such sprites."""
    order = PixelOrder(sigma_px)
    return order.near <= MAX_NEAR and order.size <= MAX_SIZE
