"""How two skies differ: every star, what all of them have in common, and the verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilstar.error_spread import ErrorSpread, error_spread
from hilstar.testing.common_change import CommonChange
from hilstar.testing.star_difference import Limits, StarDifference, worst_first


@dataclass(frozen=True, slots=True)
class SkyComparison:
    """Every star compared, the missing and the extra ones; `unmeasured` stars have too little light of their own in view.

    `common` is what most stars differ by together, None where there is no such thing.
    """

    stars: list[StarDifference]
    limits: Limits
    unmeasured: int
    common: CommonChange | None = None

    def of(self, *kinds: str) -> list[StarDifference]:
        """The stars of these kinds."""
        return [star for star in self.stars if star.kind in kinds]

    @property
    def bad(self) -> list[StarDifference]:
        """The stars beyond their limits, worst first; of those missing and extra the brightest first."""
        return worst_first(self.of("changed", "missing", "extra"))

    @property
    def differing(self) -> list[StarDifference]:
        """The stars that are beyond their limits once what is common to all is subtracted, worst first."""
        return self.bad if self.common is None else worst_first(self.common.differing)

    @property
    def same(self) -> bool:
        """Whether both images are one sky."""
        return not self.bad

    @property
    def star_count(self) -> int:
        """How many stars the golden image has."""
        return len(self.stars) - len(self.of("extra"))

    @property
    def widened(self) -> int:
        """How many stars have limits of their own, because of the light around them or the image's edge."""
        return sum(star.limits != self.limits for star in self.of("same", "changed"))

    @property
    def flux_error_mag(self) -> ErrorSpread:
        """Of the stars that both images have."""
        return error_spread(np.array([abs(star.flux_error_mag) for star in self.of("same", "changed")]))

    @property
    def centroid_error_px(self) -> ErrorSpread:
        """Of the stars that both images have."""
        return error_spread(np.array([star.centroid_error_px for star in self.of("same", "changed")]))

    def summary(self) -> dict[str, Any]:
        """The JSON object of `hilstar compare`; infinite errors are null there."""
        return {
            "stars": self.star_count,
            "flux_error_mag": asdict(self.flux_error_mag),
            "centroid_error_px": asdict(self.centroid_error_px),
            "limits": asdict(self.limits),
            "missing": len(self.of("missing")),
            "extra": len(self.of("extra")),
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


def star_lines(comparison: SkyComparison, max_lines: int, rest: str) -> list[str]:
    """A line for each star that differs from what is common to all, `max_lines` of them; `rest` says where more are."""
    stars = comparison.differing
    lines = [star.line() for star in stars[:max_lines]]
    return [*lines, f"and {len(stars) - max_lines} more{rest}"] if len(stars) > max_lines else lines


def finding(comparison: SkyComparison) -> str:
    """The verdict in one sentence."""
    if comparison.same:
        largest = comparison.flux_error_mag.max, comparison.centroid_error_px.max
        return f"The same sky: {comparison.star_count} stars, at most {largest[0]:.2g} mag and {largest[1]:.2g} px off"
    if comparison.common is not None:
        odd = comparison.differing[:1]
        return f"Not the same sky: {comparison.common.line()}" + "".join(f"; the worst is {star.line()}" for star in odd)
    counts = {name: len(comparison.of(name)) for name in ("changed", "missing", "extra")}
    rest = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return f"Not the same sky: of {comparison.star_count} stars {rest}; the worst is {comparison.bad[0].line()}"
