"""A monitor as light becomes levels on it."""

from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import Float32Array
from hilstar.basics.errors import InputError
from hilstar.display.response import Response


@dataclass(frozen=True, slots=True)
class Panel:
    """A monitor as light becomes levels on it: its response, the light of white, and the relative
    light of each pixel.

    `uniformity` float32 (height, width) is each pixel's light relative to what the response says
    (None: 1 everywhere). `primaries` are the panels of red, green and blue alone where they are
    driven apart; `response` is then that of grey. Raises InputError where the uniformity is not
    positive and finite.
    """

    response: Response
    flux_at_white_e_per_s: float
    uniformity: Float32Array | None = None
    primaries: "tuple[Panel, ...]" = ()

    def __post_init__(self) -> None:
        if self.uniformity is not None and not (
            np.isfinite(self.uniformity).all() and (self.uniformity > 0).all()
        ):
            raise InputError(
                "the uniformity map has pixels that are not positive; give each pixel its light"
                " relative to the mean"
            )

    def in_part(self, part: tuple[slice, slice]) -> "Panel":
        """The panel of a part of the image, whose pixels are the part's."""
        if self.uniformity is None:
            return self
        primaries = tuple(primary.in_part(part) for primary in self.primaries)
        return replace(self, uniformity=self.uniformity[part], primaries=primaries)

    def gain(self) -> Float32Array | None:
        """The factor of the wanted light before it is quantised, float32 (height, width), or None
        for 1.

        A product and not a quotient: of the two only the product is rounded the same by every GL.
        """
        if self.uniformity is None:
            return None
        return np.reciprocal(self.uniformity, dtype=np.float32)

    def light_e_per_s(self) -> Float32Array:
        """The light of each level in the unit of the linear image, float32 (levels,)."""
        return np.asarray(self.response.light * self.flux_at_white_e_per_s, dtype=np.float32)
