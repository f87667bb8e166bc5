"""What a backend draws: an image, its sprites, and the monitor that shows it."""

from dataclasses import dataclass, field

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.exact import Turn
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantisation
from hilstar.display.response import Response
from hilstar.optics.psf import Psf

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
    over the channels. The target `of_primary` has one of them alone, and its `turn` among them.
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
    turn: Turn = field(default_factory=Turn)

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

    def of_primary(self, k: int, turn: Turn) -> "Target":
        """The target of primary `k` alone: a grey monitor with that primary's light."""
        panel = self.primaries[k]
        # the sides are by stars' rates of white
        share = panel.flux_at_white_e_per_s / self.flux_at_white_e_per_s
        sides = [SpriteSide(share * side.below_e_per_s, side.side_px) for side in self.sides]
        return Target(
            resolution_px=self.resolution_px,
            psf=self.psf,
            response=panel.response,
            flux_at_white_e_per_s=panel.flux_at_white_e_per_s,
            quantisation=self.quantisation,
            uniformity=panel.uniformity,
            sides=tuple(sides),
            seen=self.seen,
            turn=turn,
        )
