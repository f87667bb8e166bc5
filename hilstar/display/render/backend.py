"""`Backend`, which draws frames of a `Target`: by OpenGL (`renderer`) or by NumPy
(`numpy_backend`).

Nothing here imports moderngl, so a bench can be planned, and drawn by NumPy, on a machine without
OpenGL.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array
from hilstar.basics.units import COMPUTE_VERSION
from hilstar.display.quantise import LevelCost, Quantiser
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Orientation
from hilstar.optics.sprites import FrameLight, by_channel, without_stars
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from moderngl import Context

NO_FRAME = -1  # before the first frame of a sequence
# what draws levels: "CPU" is `cpu_stars`, and "NumPy" the quantisers' own code, star by star
Path = Literal[
    "CPU", "CPU, then compute shaders", "points", "points, then compute shaders", "NumPy"
]


@dataclass(frozen=True, slots=True)
class ScreenView:
    """The picture on a screen: an image of `resolution_px`, on a screen of `screen_px`, codes of
    `bits` bits.

    `cross_px` is where the crosshair goes, image pixels; `triples` (levels, 3) the codes of each
    level, None where level k is code k in all channels.
    """

    resolution_px: tuple[int, int]
    screen_px: tuple[int, int]
    bits: int
    orientation: Orientation = field(default_factory=Orientation)
    cross_px: tuple[float, float] = (0.0, 0.0)
    triples: npt.NDArray[np.uint16] | None = None


class Backend(ABC):
    """Draws the frames of one Target, and presents them on a screen. Free it with `close`.

    `gl_renderer` and `gl_version` are the driver's names, or "NumPy" and its version; `path` is
    what draws the levels of frames without extended light. `context` is the GL context, for another
    backend beside this one; None where NumPy draws.
    """

    target: Target
    gl_renderer: str
    gl_version: str
    path: Path
    context: "Context | None"

    def __init__(self, target: Target) -> None:
        """Raises ValueError for primaries that are driven apart: `open_backend` draws those."""
        if target.primaries:
            raise ValueError("a backend draws one panel; open those of primaries by open_backend")
        self.target = target

    @abstractmethod
    def draw(self, sprites: FrameLight | None, frame: int = 0) -> None:
        """Draw the linear image and the levels of `sprites` (None: blank); read them with `linear`
        and `levels`.

        A target of `primaries` takes `sprites.primaries` and `sprites.lights`, and has no linear
        image then.

        `frame` counts the frames shown, for `temporal` alone: a number not above the last one's
        begins a new sequence.
        """

    @abstractmethod
    def draw_linear(self, sprites: FrameLight) -> None:
        """Draw the linear image of `sprites` alone, no sprite smaller than the footprint; the next
        `levels` are undefined.

        What `temporal` carries from frame to frame stays as it is.
        """

    @abstractmethod
    def linear(self) -> Float32Array:
        """The linear image of the last draw, electrons per second, float32 (height, width); the
        next draw overwrites it.
        """

    @abstractmethod
    def levels(self) -> Levels:
        """The levels of the last draw (height, width), uint8 up to 256 levels, else uint16; the
        next draw overwrites them.

        Of a target of `primaries` they are (height, width, 3).

        A target without a response has none: TypeError.
        """

    @abstractmethod
    def show_on(self, view: ScreenView, beside: "Sequence[Backend]" = ()) -> None:
        """Present frames on this screen from now on: by OpenGL that of the window whose context
        it draws in.

        With two others `beside` it, of the same kind, its levels are red's, and theirs are green's
        and blue's.
        """

    @abstractmethod
    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """Draw the last levels on the screen's back buffer, turned and mirrored, as codes.

        Over them lie the bits of `overlay` (see `aids`), with a patch of `patch_code`, and in the
        lower left corner the photodiode's square: `marker` is its side, px, and code.
        """

    @abstractmethod
    def take_back_buffer(self) -> None:
        """Wait until the last swap is done, so that the next frame can be presented."""

    def changed_codes(self) -> str:
        """Which codes the screen's back buffer has otherwise than they are drawn, "" for none;
        it overwrites the buffer.
        """
        return ""

    def fault(self) -> str:
        """A reset or an error of the GPU since the last call; "" where all is well. It takes
        some microseconds.
        """
        return ""

    @abstractmethod
    def remember_tables(self) -> None:
        """Take the checksums of what turns light into codes, for `changed_tables`."""

    def changed_tables(self) -> int:
        """How many of the tables that were remembered have other bytes now."""
        return 0

    def forget_images(self) -> None:
        """Draw the next frame on black, with nothing kept from those before it: the GPU's memory
        may have been lost.
        """
        self.begin_anew()

    @abstractmethod
    def begin_anew(self) -> None:
        """Forget what `temporal` carries from frame to frame: the next frame is the first of a
        sequence.
        """

    @abstractmethod
    def finish(self) -> None:
        """Wait until everything that was asked for is drawn."""

    @abstractmethod
    def close(self) -> None:
        """Free what the backend holds."""


def as_maps(sprites: FrameLight | None, target: Target) -> FrameLight | None:
    """Sprites whose PSF changes over the field as one map of their light, which NumPy adds up;
    all others as they are.
    """
    psf = target.psf
    if sprites is None or sprites.spectra is None or not psf.by_colour:
        return sprites
    rates = sprites.data["electrons_per_s"]
    at_px = sprites.x_px, sprites.y_px
    light = psf.image(*at_px, sprites.spectra, rates, target.resolution_px)
    image = np.ascontiguousarray(light)
    return replace(
        without_stars(sprites), extended=(*sprites.extended, LightMap(image, lasting=False))
    )


def linear_light(
    backend: Backend, sprites: FrameLight, stars: Stars, drawn: bool = False
) -> Float32Array:
    """The linear image of sprites by channel: float32 (channels, height, width), electrons per
    second, in memory of its own.

    `stars` are those among which `sprites.star` has its places (see `by_channel`). One channel that
    is `drawn` already, whole, is only read.
    """
    channels = by_channel(sprites, stars)
    images = np.empty((len(channels), *backend.target.resolution_px[::-1]), np.float32)
    for image, light in zip(images, channels, strict=True):
        if len(channels) > 1 or not drawn:
            backend.draw_linear(light)
        image[:] = backend.linear()
    return images


def level_cost(quantiser: type[Quantiser], psf: Psf, gl_version: int | None = None) -> LevelCost:
    """The tabulated cost of a quantiser by an OpenGL of a version, 430 for 4.3.

    Where NumPy draws everything (None) no frame waits for a screen, so the bench is planned as for
    a usual GL.
    """
    return quantiser.cost(psf, COMPUTE_VERSION if gl_version is None else gl_version)
