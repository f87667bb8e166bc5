"""What a backend draws: an image, its sprites, and the monitor that shows it."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantisation
from hilstar.display.response import Response
from hilstar.optics.psf import Psf
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight

APART_DTYPE = np.dtype([*SPRITE_DTYPE.descr, ("primaries_e_per_s", "<f4", 3)])

MAX_SIDES = 8  # as in star.vert


@dataclass(frozen=True, slots=True)
class SpriteSide:
    """The side of the sprites of stars below a rate."""

    below_e_per_s: float
    side_px: int


SpriteSides = tuple[SpriteSide, ...]


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

    def panel(self) -> Panel | None:
        """The monitor, None without a response. Raises InputError for a map that does not fit."""
        if self.response is None:
            return None
        width, height = self.resolution_px
        if self.uniformity is not None and self.uniformity.shape != (height, width):
            size_text = " x ".join(map(str, self.uniformity.shape[::-1]))
            raise InputError(
                f"the uniformity map is {size_text} px and the monitor {width} x {height}; give one"
                " value per pixel"
            )
        return Panel(self.response, self.flux_at_white_e_per_s, self.uniformity)


@dataclass(frozen=True, slots=True)
class Planes:
    """The planes of an image: one, or one for each of the primaries that a target drives apart.

    `panels` are theirs, `share` (planes,) what of white's light each has, and `footprint_px` the
    side of sprites that hold the light of all: it lies up to `margin_px` from the star.
    """

    panels: tuple[Panel, ...]
    share: tuple[float, ...]
    footprint_px: int
    margin_px: tuple[float, float]
    defines: tuple[str, ...]
    places_px: list[tuple[float, float]]

    @classmethod
    def of(cls, target: Target) -> "Planes":
        """Those of a target."""
        white_e_per_s = target.flux_at_white_e_per_s
        panel = target.panel()
        panels = target.primaries or (() if panel is None else (panel,))
        if target.primaries:
            away = np.abs(np.array(target.places_px)).max(axis=0)
        else:
            away = np.zeros(2)
        defines = ["APART"] * bool(target.primaries) + ["OFFSETS"] * bool(away.any())
        share = tuple(one.flux_at_white_e_per_s / white_e_per_s for one in panels)
        margin_px = float(away[0]), float(away[1])
        side_px = target.psf.footprint_px + 2 * math.ceil(max(margin_px))
        return cls(
            panels,
            share,
            side_px,
            margin_px,
            tuple(defines),
            [(float(x), float(y)) for x, y in target.places_px],
        )

    @property
    def dtype(self) -> np.dtype[Any]:
        """A sprite's: SPRITE_DTYPE, with the light of each primary after it."""
        return APART_DTYPE if self.apart else SPRITE_DTYPE

    @property
    def apart(self) -> bool:
        """Whether there is a plane for each primary."""
        return len(self.panels) > 1

    @property
    def texel(self) -> int:
        """Components of a texel."""
        return 4 if self.apart else 1

    @property
    def lit(self) -> Panel:
        """A grey panel whose first level takes as little light as that of any plane."""
        first, share = min(
            zip(self.panels, self.share, strict=True),
            key=lambda one: float(one[0].response.threshold[0]),
        )
        return replace(first, flux_at_white_e_per_s=first.flux_at_white_e_per_s / share)

    def packed(self, sprites: FrameLight) -> FrameLight:
        """Sprites with `dtype`; their rate is then that of the white that they need for the
        primary that needs most.
        """
        if not self.apart or sprites.primaries is None:
            return sprites
        data = np.empty(len(sprites), dtype=APART_DTYPE)
        fields = data.view(np.int32).reshape(len(sprites), APART_DTYPE.itemsize // 4)
        fields[:, :5] = sprites.data.view(np.int32).reshape(-1, 5)
        data["primaries_e_per_s"] = sprites.primaries
        data["electrons_per_s"] = (sprites.primaries / np.array(self.share, dtype=np.float32)).max(
            axis=1
        )
        return replace(sprites, data=data)
