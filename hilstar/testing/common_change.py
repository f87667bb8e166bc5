"""What most stars of two images differ by together: all shifted, turned, scaled, dimmer; and which stars differ from that.

Missing stars are matched with extra ones first: after a shift by more than a star's width no star is in its place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.testing.plane_motion import MIN_SHARE, Motion, common_motion, figures_of, fitted_motion, rank_for
from hilstar.testing.star_difference import StarDifference
from hilstar.units import magnitude

MIN_STARS, MIN_STAR_SHARE = 4, 0.5  # that must differ alike
MAX_VOTERS, VOTE_PX, PAIR_PX = 80, 2.0, 3.0  # the brightest missing and extra ones; displacements closer than this are one
PAIR_ROUNDS = 3
EDGE_PX = 5.0  # a star so near to the edge, or beyond it, may come into view or leave it by a common shift


@dataclass(frozen=True, slots=True)
class CommonChange:
    """What is common: shift in the middle of the image, px, turn and scale there, and magnitudes (positive: too faint).

    A figure is 0 where the stars do not have it in common.
    `beyond` are the stars of both images once that is subtracted, `alone` those that only one image has. Stars that the shift
    brought into view or took out of it are in neither.
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


def common_change(stars: list[StarDifference], size_px: tuple[int, int]) -> CommonChange | None:
    """What most stars of images of `size_px` (width, height) differ by; None where that is nothing."""
    both, alone = matched(stars)
    golden = len(both) + sum(star.kind == "missing" for star in alone)
    if len(both) < max(MIN_STARS, MIN_STAR_SHARE * golden):
        return None
    middle = (np.array(size_px) - 1) / 2
    places = _places(both) - middle
    moves = np.array([(star.dx_px, star.dy_px) for star in both])
    limits_px = np.array([star.limits.centroid_px for star in both])
    motion = common_motion(places, moves, limits_px)
    flux_mag = _common_flux_mag(both)
    if motion is None and not flux_mag:
        return None
    model = motion or np.zeros_like
    beyond = [
        replace(star, flux_error_mag=star.flux_error_mag - flux_mag, dx_px=dx, dy_px=dy)
        for star, (dx, dy) in zip(both, (moves - model(places)).tolist(), strict=True)
    ]
    left = [star for star in alone if not _by_the_edge(star, model, middle)]
    figures = figures_of(model, middle, float(np.median(limits_px)))
    return CommonChange(figures.shift_px, figures.rotation_deg, figures.scale_error, flux_mag, beyond, left)


def matched(stars: list[StarDifference]) -> tuple[list[StarDifference], list[StarDifference]]:
    """The stars of both images, those that moved far among them, and the stars that only one image has."""
    both = [star for star in stars if star.kind in ("same", "changed")]
    missing, extra = ([star for star in stars if star.kind == kind] for kind in ("missing", "extra"))
    pairs = _pairs(missing, extra)
    for here, there in pairs:
        old, new = missing[here], extra[there]
        error_mag = magnitude(new.flux_e_per_s / old.flux_e_per_s)
        both.append(replace(old, flux_error_mag=error_mag, dx_px=new.x_px - old.x_px, dy_px=new.y_px - old.y_px))
    used = {here for here, _ in pairs}, {there for _, there in pairs}
    alone = [star for kind, taken in ((missing, used[0]), (extra, used[1])) for k, star in enumerate(kind) if k not in taken]
    return both, alone


def _pairs(missing: list[StarDifference], extra: list[StarDifference]) -> list[tuple[int, int]]:
    """Which missing star is which extra one, by one common motion; none where they have none."""
    old, new = _places(missing), _places(extra)
    voters = min(MAX_VOTERS, len(old), len(new))
    if voters < MIN_STARS:
        return []
    brightest = [np.argsort([-star.flux_e_per_s for star in kind], kind="stable")[:MAX_VOTERS] for kind in (missing, extra)]
    votes = (new[brightest[1]][None, :] - old[brightest[0]][:, None]).reshape(-1, 2)
    near = cKDTree(votes).query_ball_point(votes, VOTE_PX)
    winner = max(near, key=len)
    if len(winner) < max(MIN_STARS, MIN_STAR_SHARE * voters):
        return []
    predicted = old + np.median(votes[winner], axis=0)
    pairs: list[tuple[int, int]] = []
    for _ in range(PAIR_ROUNDS):
        pairs = _mutual(predicted, new)
        here, there = (np.array([pair[k] for pair in pairs], dtype=np.intp) for k in (0, 1))
        middle = old.mean(axis=0)
        motion = fitted_motion(old[here] - middle, new[there] - old[here], rank_for(len(pairs)))
        predicted = old + motion(old - middle)
    return pairs


def _mutual(predicted: FloatArray, new: FloatArray) -> list[tuple[int, int]]:
    """The pairs that are each other's nearest, within PAIR_PX."""
    distance, nearest = (np.asarray(found) for found in cKDTree(new).query(predicted))
    back = np.asarray(cKDTree(predicted).query(new)[1])
    return [(k, int(n)) for k, n in enumerate(nearest) if distance[k] <= PAIR_PX and back[n] == k]


def _places(stars: list[StarDifference]) -> FloatArray:
    return np.array([(star.x_px, star.y_px) for star in stars]).reshape(-1, 2)


def _common_flux_mag(both: list[StarDifference]) -> float:
    """The median flux error, where it exceeds the limit and makes up more than half of the median star's error; else 0."""
    flux_mag = np.array([star.flux_error_mag for star in both])
    common = float(np.median(flux_mag))
    left = float(np.median(np.abs(flux_mag - common)))
    limit = np.median([star.limits.flux_mag for star in both])
    return common if abs(common) > limit and left <= MIN_SHARE * abs(common) else 0.0


def _by_the_edge(star: StarDifference, motion: Motion, middle: FloatArray) -> bool:
    """Whether a star that one image has is, in the other, near the edge or beyond it."""
    here = np.array([[star.x_px, star.y_px]]) - middle
    there = here + motion(here) if star.kind == "missing" else here - motion(here)
    moved = bool(np.any(motion(here)))
    return moved and bool((np.abs(there) > middle - EDGE_PX).any())
