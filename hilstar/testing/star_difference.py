"""One star of two images: what became of it, and by how much it may differ."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from hilstar.errors import InputError

# A tenth or less of the smallest fault that must be seen (0.01 mag, 0.02 px); 500 times the largest difference between two
# correct drivers (2e-6 mag, 1.5e-6 px), for a star that no brighter one overlaps. tests/unit/testing measures both.
FLUX_MAG = 1e-3
CENTROID_PX = 1e-3


@dataclass(frozen=True, slots=True)
class Limits:
    """By how much a star may differ: magnitudes and pixels. Raises InputError where one is not above 0."""

    flux_mag: float = FLUX_MAG
    centroid_px: float = CENTROID_PX

    def __post_init__(self) -> None:
        for name in ("flux_mag", "centroid_px"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"compare: {name} = {getattr(self, name):g}; write a number above 0")


@dataclass(frozen=True, slots=True)
class StarDifference:
    """One star of the golden image (an extra one: of the other image), and the other image minus the golden one.

    `flux_error_mag` is positive where the star is too faint, infinite where it is missing, minus infinity where it is extra;
    `hip` has every star of a blend, a body by its name.
    """

    hip: tuple[int | str, ...]
    x_px: float
    y_px: float
    flux_e_per_s: float
    flux_error_mag: float
    dx_px: float
    dy_px: float
    limits: Limits

    @property
    def centroid_error_px(self) -> float:
        """The distance of the star from its place, px."""
        return math.hypot(self.dx_px, self.dy_px)

    @property
    def kind(self) -> Literal["same", "changed", "missing", "extra"]:
        """What became of the star."""
        if math.isinf(self.flux_error_mag):
            return "missing" if self.flux_error_mag > 0 else "extra"
        return "same" if self.error_over_limit <= 1 else "changed"

    @property
    def error_over_limit(self) -> float:
        """The larger of its two errors, each divided by its limit."""
        return max(abs(self.flux_error_mag) / self.limits.flux_mag, self.centroid_error_px / self.limits.centroid_px)

    @property
    def name(self) -> str:
        """Its HIP number, those of its blend, or its place."""
        if self.hip:
            hips, bodies = ([one for one in self.hip if isinstance(one, kind)] for kind in (int, str))
            return " + ".join([*(f"HIP {one}" if k == 0 else str(one) for k, one in enumerate(hips)), *map(str, bodies)])
        return f"star at ({self.x_px:.1f}, {self.y_px:.1f})"

    def line(self) -> str:
        """What is wrong with the star, for a person."""
        place = f" at ({self.x_px:.2f}, {self.y_px:.2f}) px" if self.hip else ""
        if self.kind in ("missing", "extra"):
            return f"{self.name}{place}: {self.kind}, {self.flux_e_per_s:.4g} electrons/s"
        return (
            f"{self.name}{place}: {self.flux_error_mag:+z.4f} mag, {self.centroid_error_px:.4f} px"
            f" ({self.dx_px:+z.4f}, {self.dy_px:+z.4f}) off"
        )


def worst_first(stars: list[StarDifference]) -> list[StarDifference]:
    """The stars in the order in which a person looks at them; of those missing and extra the brightest first."""
    return sorted(stars, key=lambda star: (-star.error_over_limit, -star.flux_e_per_s))
