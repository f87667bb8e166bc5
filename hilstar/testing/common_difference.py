"""What most stars of two images differ by together: the whole image shifted, turned, scaled, dimmer; and who differs from that.

Missing stars are matched with extra ones first: an image that is shifted by more than a star's width has no star in place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.testing.sky_difference import MAG_PER_SHARE, StarDifference

MIN_STARS = 4  # that can have something in common
MOST = 0.5  # of the stars must differ alike, and what is common must explain so much of the median star's difference
VOTERS, VOTE_PX, PAIR_PX = 80, 2.0, 3.0  # the brightest missing and extra ones; displacements nearer than this are one
PAIR_ROUNDS = 3
EDGE_PX = 5.0  # a star so near to the edge, or beyond it, may come into view or leave it by a common shift
MORE_STARS = 0.1  # of all: a richer motion has to explain so many more
ROUNDS = 40  # of reweighted least squares, which come to the least sum of absolute residuals: outliers do not matter
FINEST_PX = 1e-4  # residuals under this weigh alike

Motion = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Common:
    """What is common: the shift in the middle of the image, px, the turn there and the scale, and magnitudes, + too faint.

    Zero is what the stars do not have in common. `beyond` are the stars of both images less that, `alone` those that only one
    image has; stars that came into view or left it by the shift are in neither.
    """

    shift_px: tuple[float, float]
    rotation_deg: float
    scale_error: float
    flux_mag: float
    beyond: list[StarDifference]
    alone: list[StarDifference]

    @property
    def differing(self) -> list[StarDifference]:
        """The stars that differ from what is common."""
        return [star for star in self.beyond if star.kind != "same"] + self.alone

    def line(self) -> str:
        """What is common, for a person."""
        right, down = self.shift_px
        digits = 2 if math.hypot(right, down) >= 0.1 else 4
        found = [f"shifted by ({right:z.{digits}f}, {down:z.{digits}f}) px"] if any(self.shift_px) else []
        found += [f"turned by {self.rotation_deg:+.4f} deg"] if self.rotation_deg else []
        found += [f"scaled by {self.scale_error:+.4%}"] if self.scale_error else []
        dimmer, digits = "dimmer" if self.flux_mag > 0 else "brighter", 2 if abs(self.flux_mag) >= 0.1 else 4
        found += [f"{dimmer} by {abs(self.flux_mag):.{digits}f} mag"] if self.flux_mag else []
        odd = len(self.differing)
        rest = "" if not odd else "; 1 star differs from that" if odd == 1 else f"; {odd} stars differ from that"
        return f"all {', '.join(found) or 'moved alike'}{rest}"

    def summary(self) -> dict[str, Any]:
        """The figures as JSON has them."""
        return {
            "shift_px": self.shift_px,
            "rotation_deg": self.rotation_deg,
            "scale_error": self.scale_error,
            "flux_mag": self.flux_mag,
            "stars": sum(star.kind == "same" for star in self.beyond),
            "differ": len(self.differing),
        }


def common_change(stars: list[StarDifference], size_px: tuple[int, int]) -> Common | None:
    """What most stars of images of `size_px` (width, height) differ by; None where that is nothing."""
    both, alone = matched(stars)
    golden = len(both) + sum(star.kind == "missing" for star in alone)
    if len(both) < max(MIN_STARS, MOST * golden):
        return None
    middle = (np.array(size_px) - 1) / 2
    places, moves, limits_px, flux = _columns(both)
    motion = _common_motion(places - middle, moves, limits_px)
    flux_mag = _common_flux(flux, np.array([star.limits.flux_mag for star in both]))
    if motion is None and not flux_mag:
        return None
    model = motion or np.zeros_like
    less = moves - model(places - middle)
    beyond = [
        replace(star, flux_error_mag=star.flux_error_mag - flux_mag, dx_px=dx, dy_px=dy)
        for star, (dx, dy) in zip(both, less.tolist(), strict=True)
    ]
    left = [star for star in alone if not _by_the_edge(star, model, middle)]
    return Common(*_figures(model, middle, float(np.median(limits_px))), flux_mag, beyond, left)


def matched(stars: list[StarDifference]) -> tuple[list[StarDifference], list[StarDifference]]:
    """The stars of both images, those that moved far among them, and the stars that only one image has."""
    both = [star for star in stars if star.kind in ("same", "changed")]
    missing, extra = ([star for star in stars if star.kind == kind] for kind in ("missing", "extra"))
    pairs = _pairs(missing, extra)
    for here, there in pairs:
        old, new = missing[here], extra[there]
        error_mag = MAG_PER_SHARE * math.log(old.flux_e_per_s / new.flux_e_per_s)
        dx, dy = new.x_px - old.x_px, new.y_px - old.y_px
        both.append(replace(old, flux_error_mag=error_mag, dx_px=dx, dy_px=dy))
    used = {here for here, _ in pairs}, {there for _, there in pairs}
    alone = [star for kind, taken in ((missing, used[0]), (extra, used[1])) for k, star in enumerate(kind) if k not in taken]
    return both, alone


def _pairs(missing: list[StarDifference], extra: list[StarDifference]) -> list[tuple[int, int]]:
    """Which missing star is which extra one, by one common motion; none where they have none."""
    old, new = _places(missing), _places(extra)
    voters = min(VOTERS, len(old), len(new))
    if voters < MIN_STARS:
        return []
    brightest = [np.argsort([-star.flux_e_per_s for star in kind], kind="stable")[:VOTERS] for kind in (missing, extra)]
    votes = (new[brightest[1]][None, :] - old[brightest[0]][:, None]).reshape(-1, 2)
    near = cKDTree(votes).query_ball_point(votes, VOTE_PX)
    winner = max(near, key=len)
    if len(winner) < max(MIN_STARS, MOST * voters):
        return []
    predicted = old + np.median(votes[winner], axis=0)
    pairs: list[tuple[int, int]] = []
    for _ in range(PAIR_ROUNDS):
        pairs = _mutual(predicted, new)
        here, there = (np.array([pair[k] for pair in pairs], dtype=np.intp) for k in (0, 1))
        middle = old.mean(axis=0)
        motion = _fitted(old[here] - middle, new[there] - old[here], _rank(len(pairs)))
        predicted = old + motion(old - middle)
    return pairs


def _mutual(predicted: FloatArray, new: FloatArray) -> list[tuple[int, int]]:
    """The pairs that are each other's nearest, within PAIR_PX."""
    distance, nearest = (np.asarray(found) for found in cKDTree(new).query(predicted))
    back = np.asarray(cKDTree(predicted).query(new)[1])
    return [(k, int(n)) for k, n in enumerate(nearest) if distance[k] <= PAIR_PX and back[n] == k]


def _places(stars: list[StarDifference]) -> FloatArray:
    return np.array([(star.x_px, star.y_px) for star in stars]).reshape(-1, 2)


def _columns(both: list[StarDifference]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    moves = np.array([(star.dx_px, star.dy_px) for star in both])
    limits_px = np.array([star.limits.centroid_px for star in both])
    return _places(both), moves, limits_px, np.array([star.flux_error_mag for star in both])


def _common_flux(flux_mag: FloatArray, limits_mag: FloatArray) -> float:
    """The median error, where it is over the limit and most of what the median star is off by; else 0."""
    common = float(np.median(flux_mag))
    left = float(np.median(np.abs(flux_mag - common)))
    return common if abs(common) > np.median(limits_mag) and left <= MOST * abs(common) else 0.0


def _common_motion(places: FloatArray, moves: FloatArray, limits_px: FloatArray) -> Motion | None:
    """The simplest motion that explains the moves (n, 2) of stars at `places` (n, 2) from the middle; None for none."""
    before = np.hypot(*moves.T)
    if np.median(before) <= np.median(limits_px):
        return None
    best, left = _fitted(places, moves, 1), np.zeros(0)
    left = _left(best, places, moves)
    for rank in range(2, _rank(len(places)) + 1):
        richer = _fitted(places, moves, rank)
        then = _left(richer, places, moves)
        more = (then <= limits_px).mean() > (left <= limits_px).mean() + MORE_STARS
        nearer = np.median(left) > np.median(limits_px) and np.median(then) < MOST * np.median(left)
        if more or nearer:
            best, left = richer, then
    return best if np.median(left) <= MOST * np.median(before) else None


def _left(motion: Motion, places: FloatArray, moves: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*(moves - motion(places)).T))


def _rank(stars: int) -> int:
    """The richest motion that so many stars can tell: 1 a shift, 2 with turn and scale, 3 any view of the same plane."""
    return 3 if stars >= 16 else 2 if stars >= 6 else 1


def _fitted(places: FloatArray, moves: FloatArray, rank: int) -> Motion:
    """The motion of a rank whose residuals' absolute values have the least sum."""
    scale = float(np.abs(places).max()) or 1.0
    (x, y), (u, v) = (places / scale).T, ((places + moves) / scale).T
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    if rank == 1:
        columns = [(ones, zeros), (zeros, ones)]
    elif rank == 2:
        columns = [(ones, zeros), (zeros, ones), (x, y), (-y, x)]
    else:  # a homography, a camera that turns makes one: u (1 + g x + h y) = a x + b y + c is linear in its eight numbers
        columns = [
            (ones, zeros),
            (zeros, ones),
            (x, zeros),
            (y, zeros),
            (zeros, x),
            (zeros, y),
            (-u * x, -v * x),
            (-u * y, -v * y),
        ]
    design = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
    wanted = np.stack([u - x, v - y], axis=-1)
    found = _least_absolute(design, wanted, FINEST_PX / scale)
    return lambda at: _moved(at / scale, found) * scale


def _moved(at: FloatArray, found: FloatArray) -> FloatArray:
    """By how much a motion of 2, 4 or 8 numbers moves places (n, 2)."""
    x, y = at.T
    if len(found) == 2:
        return np.broadcast_to(found, at.shape).copy()
    if len(found) == 4:
        right, down, grow, turn = found
        return np.stack([right + grow * x - turn * y, down + grow * y + turn * x], axis=-1)
    c, f, a, b, d, e, g, h = found
    wide = 1 + g * x + h * y
    return np.stack([(a * x + b * y + c + x) / wide - x, (d * x + e * y + f + y) / wide - y], axis=-1)


def _least_absolute(design: FloatArray, wanted: FloatArray, finest: float) -> FloatArray:
    """Coefficients (k,) of design (n, 2, k) to wanted (n, 2), by the least sum of distances."""
    weight, found = np.ones(len(wanted)), np.zeros(design.shape[2])
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        weighted = (design * root[..., None]).reshape(-1, design.shape[2])
        found = np.asarray(np.linalg.lstsq(weighted, (wanted * root).ravel(), rcond=None)[0], dtype=np.float64)
        weight = 1 / np.maximum(np.hypot(*(wanted - design @ found).T), finest)
    return np.asarray(found)


def _figures(motion: Motion, middle: FloatArray, limit_px: float) -> tuple[tuple[float, float], float, float]:
    """Shift in the middle, turn, deg, and scale there; the last two 0 where they move no corner by more than the limit."""
    reach = float(np.hypot(*middle))
    step = 1.0
    here, right, down = motion(np.array([[0.0, 0.0], [step, 0.0], [0.0, step]]))
    (xx, yx), (xy, yy) = (right - here) / step, (down - here) / step
    turn, grow = math.atan2(yx - xy, 2 + xx + yy), math.sqrt((1 + xx) * (1 + yy) - xy * yx) - 1
    shift = float(here[0]), float(here[1])
    return (
        shift if math.hypot(*shift) > limit_px else (0.0, 0.0),
        math.degrees(turn) if abs(turn) * reach > limit_px else 0.0,
        grow if abs(grow) * reach > limit_px else 0.0,
    )


def _by_the_edge(star: StarDifference, motion: Motion, middle: FloatArray) -> bool:
    """Whether a star that one image has is, in the other, near the edge or beyond it."""
    here = np.array([[star.x_px, star.y_px]]) - middle
    there = here + motion(here) if star.kind == "missing" else here - motion(here)
    moved = bool(np.any(motion(here)))
    return moved and bool((np.abs(there) > middle - EDGE_PX).any())
