"""How two skies differ: star by star, what all stars have in common, and the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hilstar.errors import InputError
from hilstar.twin.verdict import spread

if TYPE_CHECKING:
    from hilstar.testing.common_difference import Common

# A tenth of the smallest fault that must be seen (0.01 mag, 0.02 px) or less; 500 times what two right drivers make of a star
# that no brighter one stands on (2e-6 mag, 1.5e-6 px at worst). tests/unit/test_testing.py measures both.
FLUX_MAG = 1e-3
CENTROID_PX = 1e-3
MAG_PER_SHARE = 2.5 / math.log(10)


@dataclass(frozen=True, slots=True)
class Limits:
    """By how much a star may differ: magnitudes and pixels."""

    flux_mag: float = FLUX_MAG
    centroid_px: float = CENTROID_PX

    def __post_init__(self) -> None:
        for name in ("flux_mag", "centroid_px"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"compare: {name} = {getattr(self, name):g}; write a number over 0")


@dataclass(frozen=True, slots=True)
class StarDifference:
    """One star of the golden image (an extra one: of the other), and the other image less the golden one.

    `flux_error_mag` is positive where the star is too faint, infinite where it is missing; `hip` has every star of a blend.
    """

    hip: tuple[int, ...]
    x_px: float
    y_px: float
    flux_e_per_s: float
    flux_error_mag: float
    dx_px: float
    dy_px: float
    limits: Limits

    @property
    def centroid_error_px(self) -> float:
        """How far the star is from its place."""
        return math.hypot(self.dx_px, self.dy_px)

    @property
    def kind(self) -> Literal["same", "changed", "missing", "extra"]:
        """What became of the star."""
        if math.isinf(self.flux_error_mag):
            return "missing" if self.flux_error_mag > 0 else "extra"
        return "same" if self.badness <= 1 else "changed"

    @property
    def badness(self) -> float:
        """Its larger error in its limits."""
        return max(abs(self.flux_error_mag) / self.limits.flux_mag, self.centroid_error_px / self.limits.centroid_px)

    @property
    def name(self) -> str:
        """Its HIP number, those of its blend, or its place."""
        if self.hip:
            return "HIP " + " + ".join(map(str, self.hip))
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


@dataclass(frozen=True, slots=True)
class SkyComparison:
    """Every star compared, those missing, and those too many; `unmeasured` stars have too little light of their own in view.

    `common` is what most stars differ by together, None where there is no such thing.
    """

    stars: list[StarDifference]
    limits: Limits
    unmeasured: int
    common: Common | None = None

    def of(self, *kinds: str) -> list[StarDifference]:
        """The stars of these kinds."""
        return [star for star in self.stars if star.kind in kinds]

    @property
    def bad(self) -> list[StarDifference]:
        """The stars beyond their limits, worst first; of those missing and extra the brightest."""
        return worst_first(self.of("changed", "missing", "extra"))

    @property
    def differing(self) -> list[StarDifference]:
        """The stars beyond their limits, less what is common to all, worst first."""
        return self.bad if self.common is None else worst_first(self.common.differing)

    @property
    def same(self) -> bool:
        """Whether both images are one sky."""
        return not self.bad

    @property
    def widened(self) -> int:
        """How many stars have limits of their own, for the light around them or the image's edge."""
        return sum(star.limits != self.limits for star in self.of("same", "changed"))

    def summary(self) -> dict[str, Any]:
        """The figures as JSON has them; infinite errors are null there."""
        both = self.of("same", "changed")
        extra = len(self.of("extra"))
        return {
            "stars": len(self.stars) - extra,
            "flux_error_mag": spread(np.array([abs(star.flux_error_mag) for star in both])),
            "centroid_error_px": spread(np.array([star.centroid_error_px for star in both])),
            "limits": {"flux_mag": self.limits.flux_mag, "centroid_px": self.limits.centroid_px},
            "missing": len(self.of("missing")),
            "extra": extra,
            "blends": sum(len(star.hip) > 1 for star in self.stars),
            "widened": self.widened,
            "unmeasured": self.unmeasured,
            "common": None if self.common is None else self.common.summary(),
            "bad": [
                {"kind": star.kind, "hip": star.hip, "x_px": star.x_px, "y_px": star.y_px, "flux_e_per_s": star.flux_e_per_s}
                | {"flux_error_mag": star.flux_error_mag, "dx_px": star.dx_px, "dy_px": star.dy_px}
                for star in self.bad
            ],
            "same": self.same,
        }


def worst_first(stars: list[StarDifference]) -> list[StarDifference]:
    """The stars in the order in which a person looks at them."""
    return sorted(stars, key=lambda star: (-star.badness, -star.flux_e_per_s))


def told(comparison: SkyComparison, most: int, rest: str) -> list[str]:
    """A line for each star that differs from what is common to all: `most` of them; `rest` says where more are."""
    stars = comparison.differing
    lines = [star.line() for star in stars[:most]]
    return [*lines, f"and {len(stars) - most} more{rest}"] if len(stars) > most else lines


def finding(comparison: SkyComparison) -> str:
    """The verdict in one sentence."""
    figures = comparison.summary()
    counts = {name: len(comparison.of(name)) for name in ("changed", "missing", "extra")}
    if comparison.same:
        worst = figures["flux_error_mag"]["max"], figures["centroid_error_px"]["max"]
        return f"The same sky: {figures['stars']} stars, {worst[0]:.2g} mag and {worst[1]:.2g} px off at most"
    if comparison.common is not None:
        odd = comparison.differing[:1]
        return f"Not the same sky: {comparison.common.line()}" + "".join(f"; worst is {star.line()}" for star in odd)
    rest = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return f"Not the same sky: of {figures['stars']} stars {rest}; worst is {comparison.bad[0].line()}"
