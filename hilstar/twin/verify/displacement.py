"""What moves the stars: the smallest geometric model that explains where they are shown, by least squares.

A star of direction d is drawn where the assumed lens has it and seen at d', from where the true lens shows that place. So d is
a polynomial of d', in focal lengths from the middle of the detector: d = z d' (1 + k1 r'^2 + ...) + shift for a true lens where
an ideal one is assumed, whatever the size of each; the screen's tilt (a, b) adds d' (a y' - b x') to first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.scene.camera import Camera

MIN_RESIDUALS = 3  # to an unknown
MIN_STARS = 6  # for a scale, a rotation and a shift: twelve residuals, four unknowns
# A model explains a field where no larger one leaves much less: a quarter, and a tenth of the limit, beyond the best.
ENOUGH, ENOUGH_OF_LIMIT = 1.25, 0.1
TRIMS, WILD = 3, 6.0  # a star this many medians off, and more than the limit, is another one; 1e-11 of Gaussian ones are
ALIGNED, LENS, TILT, HIGHER, DECENTRED = "aligned", "lens", "tilt", "higher", "decentred"
MODELS = (
    (ALIGNED,),
    (ALIGNED, LENS),
    (ALIGNED, TILT),
    (ALIGNED, TILT, LENS),
    (ALIGNED, TILT, LENS, HIGHER),
    (ALIGNED, TILT, LENS, HIGHER, DECENTRED),
)


@dataclass(frozen=True, slots=True)
class Displaced:
    """A star's place on the detector, px, and how far from it, right and down, the display shows it."""

    x_px: float
    y_px: float
    dx_px: float
    dy_px: float


@dataclass(frozen=True, slots=True)
class GeometryFit:
    """What the smallest sufficient model explains of the displacements, as true minus assumed.

    Scale, rotation about the detector's middle and shift, and where the displacements ask for them the screen's tilt about its
    x and y axes and the lens, k1 of its tangents; `tilt_px` and `distortion_px` are the largest displacements by these.
    `left` is the share of the mean square that is not explained, corrected for the number of unknowns, `left_px` what 95 % of
    the stars are within of the model.
    """

    scale_error: float
    rotation_rad: float
    offset_px: tuple[float, float]
    tilt_rad: tuple[float, float]
    tilt_px: float
    k1: float
    distortion_px: float
    left: float
    left_px: float


def fit_geometry(displaced: Sequence[Displaced], tracker: Camera, limit_px: float) -> GeometryFit | None:
    """The smallest model by least squares; None with too few stars. `limit_px` is what the bench allows a centroid."""
    rows = np.array([(star.x_px, star.y_px, star.dx_px, star.dy_px) for star in displaced]).reshape(-1, 4)
    if len(rows) < MIN_STARS:
        return None
    focal_px = tracker.focal_length_px
    seen = (rows[:, :2] + rows[:, 2:] - tracker.principal_point_px) / focal_px
    back = -rows[:, 2:] / focal_px
    for _ in range(TRIMS):
        kept = _consistent(_fits(seen, back)[-1].rest, limit_px / focal_px)
        if kept.sum() < MIN_STARS:
            break
        seen, back = seen[kept], back[kept]
    fits = _fits(seen, back)
    good = ENOUGH * min(fit.noise for fit in fits) + ENOUGH_OF_LIMIT * limit_px / focal_px
    return _summed_up(next(fit for fit in fits if fit.noise <= good), back.T.ravel(), focal_px)


def _fits(seen: FloatArray, back: FloatArray) -> list[_Fit]:
    """Every model that so many stars (n, 2) can determine, the smallest first."""
    parts, wanted = _parts(*seen.T), back.T.ravel()
    fits = [_Fit.of({name: parts[name] for name in model}, wanted) for model in MODELS]
    return [fit for fit in fits if MIN_RESIDUALS * fit.unknowns <= len(wanted)]


def _consistent(rest: FloatArray, limit: float) -> npt.NDArray[np.bool_]:
    """The stars that a model leaves where most are: another one that was found near a star's place is none of them."""
    off = _lengths(rest)
    return np.asarray(off <= max(WILD * float(np.median(off)), limit))


def _parts(x: FloatArray, y: FloatArray) -> dict[str, FloatArray]:
    """What a unit of each part's unknowns moves (2 n, unknowns) by: along x, then along y."""
    one, none, r2 = np.ones_like(x), np.zeros_like(x), x * x + y * y
    pairs = {
        ALIGNED: [(x, y), (-y, x), (one, none), (none, one)],
        TILT: [(x * y, y * y), (-x * x, -x * y)],
        LENS: [(x * r2, y * r2)],
        HIGHER: [(x * r2**2, y * r2**2)],
        DECENTRED: [(2 * x * y, r2 + 2 * y * y), (r2 + 2 * x * x, 2 * x * y)],
    }
    return {name: np.column_stack([np.concatenate(pair) for pair in columns]) for name, columns in pairs.items()}


@dataclass(frozen=True, slots=True)
class _Fit:
    """A model's unknowns by its parts, the displacements (2 n,) by each, and what all of them leave."""

    found: dict[str, FloatArray]
    moved: dict[str, FloatArray]
    rest: FloatArray
    unknowns: int

    @classmethod
    def of(cls, parts: dict[str, FloatArray], wanted: FloatArray) -> _Fit:
        design = np.hstack(list(parts.values()))
        values = np.linalg.lstsq(design, wanted, rcond=None)[0]
        ends = np.cumsum([part.shape[1] for part in parts.values()])
        found = dict(zip(parts, np.split(values, ends[:-1]), strict=True))
        moved = {name: part @ found[name] for name, part in parts.items()}
        return cls(found, moved, wanted - design @ values, design.shape[1])

    @property
    def noise(self) -> float:
        """One sigma of what is left, of a residual."""
        return math.sqrt(float(self.rest @ self.rest) / (len(self.rest) - self.unknowns))

    def largest(self, *names: str) -> float:
        """The largest displacement by some parts together."""
        return float(_lengths(sum((self.moved[name] for name in names if name in self.moved), np.zeros_like(self.rest))).max())


def _lengths(residuals: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*np.split(residuals, 2)))


def _summed_up(fit: _Fit, wanted: FloatArray, focal_px: float) -> GeometryFit:
    scale, rotation, right, down = fit.found[ALIGNED].tolist()
    backwards = complex(1.0 + scale, rotation)
    forwards, shift = 1.0 / backwards, -complex(right, down) / backwards
    a, b = fit.found.get(TILT, np.zeros(2)).tolist()
    total = float(wanted @ wanted)
    return GeometryFit(
        scale_error=forwards.real - 1.0,
        rotation_rad=forwards.imag,
        offset_px=(shift.real * focal_px, shift.imag * focal_px),
        tilt_rad=(a, b),
        tilt_px=focal_px * fit.largest(TILT),
        k1=float(fit.found.get(LENS, np.zeros(1))[0]) / abs(backwards),
        distortion_px=focal_px * fit.largest(LENS, HIGHER, DECENTRED),
        left=fit.noise**2 * len(wanted) / total if total else 0.0,
        left_px=focal_px * float(np.percentile(_lengths(fit.rest), 95)),
    )
