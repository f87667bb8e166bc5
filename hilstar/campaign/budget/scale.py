"""The sizes of a tracker that turn angles into pixels."""

from __future__ import annotations

from dataclasses import dataclass

from hilstar.units import ARCSEC_PER_RAD

ROLL_SHARE = 0.3  # of the detector's side: the usual distance of a star from the boresight


@dataclass(frozen=True, slots=True)
class Scale:
    """A tracker's focal length and detector's sides, in pixels."""

    focal_px: float
    resolution_px: tuple[int, int]

    @property
    def roll_px(self) -> float:
        """How far from the boresight stars usually stand."""
        return ROLL_SHARE * min(self.resolution_px)

    @property
    def pixel_arcsec(self) -> float:
        """A pixel in the middle of the field."""
        return ARCSEC_PER_RAD / self.focal_px
