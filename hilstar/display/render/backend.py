"""`Backend`, which draws frames of a `Target`: by OpenGL (`renderer`) or by NumPy
(`numpy_backend`).

Nothing here imports moderngl, so a bench can be planned, and drawn by NumPy, on a machine without
OpenGL.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.exact import COMPUTE_VERSION, KEPT, KEPT_BEFORE, ExactQuantiser
from hilstar.display.quantise import LevelCost, Panel, Quantiser
from hilstar.display.quantisers import QUANTISERS, Quantisation
from hilstar.display.response import Levels, Response
from hilstar.optics.extended import LightMap
from hilstar.optics.frame_motion import Orientation
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import FrameLight, by_channel, by_primary, without_stars
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from moderngl import Context

EGL_LIBRARY = "libEGL.so.1"
NO_FRAME = -1  # before the first frame of a sequence
MAX_SIDES = 8  # as in star.vert
# what draws levels: "CPU" is `cpu_stars`, and "NumPy" the quantisers' own code, star by star
Path = Literal[
    "CPU", "CPU, then compute shaders", "points", "points, then compute shaders", "NumPy"
]
WAY_VARIABLE = "HILSTAR_DRAW"
Way = Literal["gl", "cpu"]
WAYS: tuple[Way, ...] = ("gl", "cpu")


@dataclass(frozen=True, slots=True)
class SpriteSide:
    """The side of the sprites of stars below a rate."""

    below_e_per_s: float
    side_px: int


SpriteSides = tuple[SpriteSide, ...]


class Turn(NamedTuple):
    """One of a target's panels: for how much of what stars left in each, in its steps, they make
    up here; choices kept.
    """

    plane: int
    makes_up: list[float]
    kept: int = KEPT


@dataclass(frozen=True, slots=True)
class Target:
    """The image that a backend draws: its pixels, its sprites, and a monitor's response where codes
    are wanted.

    `uniformity` float32 (height, width) is each pixel's light relative to the response (None: 1
    everywhere). `sides` are those of fainter stars' sprites, by falling rates, of the same parity
    as the footprint. `seen` is how the tracker sees the monitor, for `exact` and `temporal`. Where
    the `primaries` are driven apart, each has its panel, and its light lies at its place of
    `places_px` (3, 2) within a pixel; `together` (3, 3) are products of two primaries' electrons
    over the channels.
    """

    resolution_px: tuple[int, int]
    psf: Psf
    response: Response | None = None
    flux_at_white_e_per_s: float = 1.0
    quantisation: Quantisation = "round"
    uniformity: Float32Array | None = None
    sides: SpriteSides = ()
    seen: Seen = AS_USUAL
    primaries: tuple[Panel, ...] = ()
    places_px: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    together: FloatArray = field(default_factory=lambda: np.eye(1))

    def in_turn(self) -> list[Turn]:
        """The order in which `exact` chooses the primaries' levels: by falling electrons a step,
        for the last leave least.

        Each makes up for those before it, by the light of the channels; in `temporal` for its own
        light alone.
        """
        panels = self.primaries
        if not panels:
            return [Turn(0, [0.0])]
        step = np.array([panel.response.light[1] * panel.flux_at_white_e_per_s for panel in panels])
        order, alone = (
            np.argsort(-step, kind="stable").tolist(),
            getattr(QUANTISERS[self.quantisation], "remembers", False),
        )
        share = self.together / self.together.diagonal() * step[:, None] / step
        # What a primary leaves has in it what it began with: `own` (3, 3) are its own errors by
        # what each leaves.
        own, found = np.zeros_like(share), []
        for k in order:
            makes_up = np.zeros(len(panels)) if alone else share[:, k] @ own
            own[k] = -makes_up
            own[k, k] += 1
            found.append(
                Turn(k, makes_up.tolist(), KEPT if alone or k == order[-1] else KEPT_BEFORE)
            )
        return found

    def quantisers(self) -> dict[int, Quantiser]:
        """NumPy's quantiser of each panel, in the order in which they choose; none without a
        response.
        """
        panel, made = self.panel(), QUANTISERS[self.quantisation]
        panels = self.primaries or (() if panel is None else (panel,))
        found = {
            k: made(panels[k], self.resolution_px, self.psf, self.seen)
            for k, *_ in self.in_turn()
            if panels
        }
        for k, makes_up, kept in self.in_turn() if self.primaries else ():
            if isinstance(one := found[k], ExactQuantiser):
                one.kept, one.given = kept, [(part, found[j]) for j, part in enumerate(makes_up)]
        return found

    def by_plane(
        self, sprites: FrameLight | None, levels: Callable[[int, FrameLight | None], Levels]
    ) -> Levels:
        """The levels of a frame by those of each primary, if primaries are driven apart, chosen
        in their order.
        """
        if not self.primaries or sprites is None:
            found = {k: levels(k, sprites) for k, *_ in self.in_turn()}
        else:
            found = {
                k: levels(k, by_primary(sprites, self.places_px, k)) for k, *_ in self.in_turn()
            }
        return (
            found[0]
            if not self.primaries
            else Levels(np.stack([found[k] for k in range(len(found))], -1))
        )

    def panel(self) -> Panel | None:
        """The monitor, None without a response. Raises InputError for a map that does not fit."""
        if self.response is None:
            return None
        width, height = self.resolution_px
        if self.uniformity is not None and self.uniformity.shape != (height, width):
            found = " x ".join(map(str, self.uniformity.shape[::-1]))
            raise InputError(
                f"the uniformity map is {found} px and the monitor {width} x {height}; give one"
                " value per pixel"
            )
        return Panel(self.response, self.flux_at_white_e_per_s, self.uniformity)


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


def wanted_way() -> Way | None:
    """The way of drawing stars that HILSTAR_DRAW wants, None for the machine's own. InputError for
    another word.
    """
    wanted = os.environ.get(WAY_VARIABLE, "")
    if not wanted:
        return None
    for way in WAYS:
        if wanted == way:
            return way
    raise InputError(f"{WAY_VARIABLE}={wanted}: no way to draw stars; write {' or '.join(WAYS)}")


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
    def show_on(self, view: ScreenView) -> None:
        """Present frames on this screen from now on: by OpenGL that of the window whose context
        it draws in.
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
    if sprites.primaries is not None:
        parts = (
            as_maps(by_primary(sprites, target.places_px, k), target)
            for k in range(len(target.primaries))
        )
        lights = tuple(() if part is None else part.extended for part in parts)
        return replace(without_stars(sprites), extended=lights[0], lights=lights)
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


def level_cost(quantiser: type[Quantiser], psf: Psf, context: "Context | None" = None) -> LevelCost:
    """The tabulated cost of a quantiser by the OpenGL of a context.

    Where NumPy draws everything (None) no frame waits for a screen, so the bench is planned as for
    a usual GL.
    """
    return quantiser.cost(psf, COMPUTE_VERSION if context is None else context.version_code)
