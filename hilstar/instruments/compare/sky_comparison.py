"""How two skies differ: each star, the change common to most stars (shift, turn, scale, dimming),
and the verdict.

The common motion is a shift, with turn and scale, or a homography, fitted so that outliers do not
matter. Missing stars are matched with extra ones first: after a shift by more than a star's width
no star is in its place.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from hilstar.basics.arrays import FloatArray
from hilstar.basics.error_spread import ErrorSpread, error_spread
from hilstar.basics.errors import InputError
from hilstar.basics.units import magnitude
from hilstar.instruments.compare.star_fit import nearest_places

MORE_STARS = 0.1  # share of all stars that a motion with more parameters has to explain in addition
# rounds of reweighted least squares, which converge to the minimum sum of absolute residuals
ROUNDS = 40
FINEST_PX = 1e-4  # smaller residuals all weigh the same
MIN_SHARE = 0.5  # share of the median star's displacement that a motion must explain

# Displacements (n, 2), px, of places (n, 2), px from the middle of the image.
Motion = Callable[[FloatArray], FloatArray]
# A tenth or less of the smallest fault that must be seen (0.01 mag, 0.02 px); 500 times the largest
# difference between two correct drivers (2e-6 mag, 1.5e-6 px), for a star that no brighter one
# overlaps. tests/unit/instruments/compare measures both.
FLUX_MAG = 1e-3
CENTROID_PX = 1e-3
MIN_STARS, MIN_STAR_SHARE = 4, 0.5  # that must differ alike
# the brightest missing and extra ones; displacements closer than this are one
MAX_VOTERS, VOTE_PX, PAIR_PX = 80, 2.0, 3.0
PAIR_ROUNDS = 3
CHANNEL_KEYS = ("stars", "flux_error_mag", "centroid_error_px", "missing", "extra", "same")
# a star so near to the edge, or beyond it, may come into view or leave it by a common shift
EDGE_PX = 5.0


def common_motion(places: FloatArray, moves: FloatArray, limits_px: FloatArray) -> Motion | None:
    """The simplest motion that explains the moves (n, 2) of stars at `places` (n, 2) from the
    middle; None for none.
    """
    before_px = np.hypot(*moves.T)
    limit_px = np.median(limits_px)
    if np.median(before_px) <= limit_px:
        return None
    best: Motion | None = None
    rest_px = before_px
    for rank in range(1, rank_for(len(places)) + 1):
        motion = fitted_motion(places, moves, rank)
        then_px = np.hypot(*(moves - motion(places)).T)
        explained = (then_px <= limits_px).mean()
        explained_before = (rest_px <= limits_px).mean()
        more = explained > explained_before + MORE_STARS
        median_px = np.median(rest_px)
        is_off = median_px > limit_px
        nearer = is_off and np.median(then_px) < MIN_SHARE * median_px
        if rank == 1 or more or nearer:
            best = motion
            rest_px = then_px
    if np.median(rest_px) <= MIN_SHARE * np.median(before_px):
        return best
    return None


def rank_for(stars: int) -> int:
    """The rank of the richest motion that `stars` stars determine: 1 a shift, 2 with turn and
    scale, 3 a homography.
    """
    if stars >= 16:
        return 3
    if stars >= 6:
        return 2
    return 1


def fitted_motion(places: FloatArray, moves: FloatArray, rank: int) -> Motion:
    """The motion of a rank that has the minimum sum of absolute residuals."""
    scale = float(np.abs(places).max()) or 1.0
    x, y = (places / scale).T
    u, v = ((places + moves) / scale).T
    ones = np.ones_like(x)
    zeros = np.zeros_like(x)
    columns = [(ones, zeros), (zeros, ones)]
    if rank == 2:
        columns += [(x, y), (-y, x)]
    elif rank == 3:
        # a homography, as of a camera that turns: u (1 + g x + h y) = a x + b y + c is linear in
        # its eight numbers
        columns += [(x, zeros), (y, zeros), (zeros, x), (zeros, y)]
        columns += [(-u * x, -v * x), (-u * y, -v * y)]
    terms = [np.stack(column, axis=-1) for column in columns]
    design = np.stack(terms, axis=-1)
    wanted = np.stack([u - x, v - y], axis=-1)
    coefficients = _least_absolute(design, wanted, FINEST_PX / scale)

    def motion(at: FloatArray) -> FloatArray:
        """The moves (n, 2) of places (n, 2)."""
        x, y = at.T / scale
        right, down, *more = coefficients
        if rank == 1:
            moved = np.broadcast_to(coefficients, at.shape)
        elif rank == 2:
            grow, turn = more
            moved_x = right + grow * x - turn * y
            moved_y = down + grow * y + turn * x
            moved = np.stack([moved_x, moved_y], axis=-1)
        else:
            a, b, d, e, g, h = more
            wide = 1 + g * x + h * y
            moved_x = (a * x + b * y + right + x) / wide - x
            moved_y = (d * x + e * y + down + y) / wide - y
            moved = np.stack([moved_x, moved_y], axis=-1)
        return np.asarray(moved * scale)

    return motion


def _least_absolute(design: FloatArray, wanted: FloatArray, finest: float) -> FloatArray:
    """Coefficients (k,) of design (n, 2, k) to wanted (n, 2) with the minimum sum of distances."""
    weight: npt.NDArray[np.floating[Any]] = np.ones(len(wanted))
    solution: FloatArray = np.zeros(design.shape[2])
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        weighted_design = (design * root[..., None]).reshape(-1, design.shape[2])
        weighted = (wanted * root).ravel()
        solution, *_ = np.linalg.lstsq(weighted_design, weighted, rcond=None)
        residual = wanted - design @ solution
        weight = 1 / np.maximum(np.hypot(*residual.T), finest)
    return np.asarray(solution, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Limits:
    """By how much a star may differ: magnitudes and pixels. Raises InputError where one is not
    above 0.
    """

    flux_mag: float = FLUX_MAG
    centroid_px: float = CENTROID_PX

    def __post_init__(self) -> None:
        for name in ("flux_mag", "centroid_px"):
            limit = getattr(self, name)
            if not isinstance(limit, (int, float, np.number)) or not 0 < limit < math.inf:
                raise InputError(f"compare: {name} = {limit!r}; write a number above 0")


@dataclass(frozen=True, slots=True)
class StarDifference:
    """One star of the golden image (an extra one: of the other image), and the other image minus
    the golden one.

    `flux_error_mag` is positive where the star is too faint, infinite where it is missing, minus
    infinity where it is extra; `hip` has every star of a blend, a body by its name.
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
        if self.error_over_limit <= 1:
            return "same"
        return "changed"

    @property
    def error_over_limit(self) -> float:
        """The larger of its two errors, each divided by its limit."""
        flux_error = abs(self.flux_error_mag) / self.limits.flux_mag
        return max(flux_error, self.centroid_error_px / self.limits.centroid_px)

    @property
    def name(self) -> str:
        """Its HIP number, those of its blend, or its place."""
        if not self.hip:
            return f"star at ({self.x_px:.1f}, {self.y_px:.1f})"
        hips = [str(number) for number in self.hip if isinstance(number, int)]
        bodies = [body for body in self.hip if isinstance(body, str)]
        if hips:
            hips[0] = f"HIP {hips[0]}"
        return " + ".join([*hips, *bodies])

    def line(self) -> str:
        """What is wrong with the star, for a person."""
        place = ""
        if self.hip:
            place = f" at ({self.x_px:.2f}, {self.y_px:.2f}) px"
        if self.kind in ("missing", "extra"):
            return f"{self.name}{place}: {self.kind}, {self.flux_e_per_s:.4g} electrons/s"
        return (
            f"{self.name}{place}: {self.flux_error_mag:+z.4f} mag, {self.centroid_error_px:.4f} px"
            f" ({self.dx_px:+z.4f}, {self.dy_px:+z.4f}) off"
        )


@dataclass(frozen=True, slots=True)
class CommonChange:
    """What is common: shift in the middle of the image, px, turn and scale there, and magnitudes
    (positive: too faint).

    A figure is 0 where the stars do not have it in common. `beyond` are the stars of both images
    once that is subtracted, `alone` those that only one image has. Stars that the shift brought
    into view or took out of it are in neither.
    """

    shift_px: tuple[float, float]
    rotation_deg: float
    scale_error: float
    flux_mag: float
    beyond: list[StarDifference]
    alone: list[StarDifference]

    @property
    def differing(self) -> list[StarDifference]:
        """The stars that differ beyond the common change."""
        return [star for star in self.beyond if star.kind != "same"] + self.alone

    def line(self) -> str:
        """What is common, for a person."""
        right, down = self.shift_px
        digits = 2 if math.hypot(right, down) >= 0.1 else 4
        parts = []
        if any(self.shift_px):
            parts.append(f"shifted by ({right:z.{digits}f}, {down:z.{digits}f}) px")
        if self.rotation_deg:
            parts.append(f"turned by {self.rotation_deg:+.4f} deg")
        if self.scale_error:
            parts.append(f"scaled by {self.scale_error:+.4%}")
        if self.flux_mag:
            dimmer = "dimmer" if self.flux_mag > 0 else "brighter"
            digits = 2 if abs(self.flux_mag) >= 0.1 else 4
            parts.append(f"{dimmer} by {abs(self.flux_mag):.{digits}f} mag")
        odd = len(self.differing)
        rest = ""
        if odd == 1:
            rest = "; 1 star differs from that"
        elif odd:
            rest = f"; {odd} stars differ from that"
        return f"all {', '.join(parts) or 'moved alike'}{rest}"

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
    """What most stars of images of `size_px` (width, height) differ by; None where that is
    nothing.
    """
    both = [star for star in stars if star.kind in ("same", "changed")]
    missing = [star for star in stars if star.kind == "missing"]
    extra = [star for star in stars if star.kind == "extra"]
    pairs = dict(_pairs(missing, extra))
    for before, after in pairs.items():  # stars that moved far are in both images
        both.append(_moved(missing[before], extra[after]))
    in_golden = len(both) + len(missing) - len(pairs)
    if len(both) < max(MIN_STARS, MIN_STAR_SHARE * in_golden):
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
    beyond = []
    rest_px = moves - model(places)
    for star, (dx_px, dy_px) in zip(both, rest_px.tolist(), strict=True):
        error_mag = star.flux_error_mag - flux_mag
        beyond.append(replace(star, flux_error_mag=error_mag, dx_px=dx_px, dy_px=dy_px))
    matched_extra = set(pairs.values())
    alone = [star for k, star in enumerate(missing) if k not in pairs]
    alone += [star for k, star in enumerate(extra) if k not in matched_extra]
    in_view = []
    for star in alone:  # but those that the motion brought into view or took out of it
        place = _places([star]) - middle
        move = model(place)
        if star.kind == "extra":
            move = -move
        is_shown = np.abs(place + move) <= middle - EDGE_PX
        if not move.any() or is_shown.all():
            in_view.append(star)
    limit_px = float(np.median(limits_px))
    shift_px, rotation_deg, scale_error = _in_the_middle(model, middle, limit_px)
    return CommonChange(shift_px, rotation_deg, scale_error, flux_mag, beyond, in_view)


def _moved(before: StarDifference, after: StarDifference) -> StarDifference:
    """A missing star and an extra one as one star that moved."""
    error_mag = magnitude(after.flux_e_per_s / before.flux_e_per_s)
    dx_px = after.x_px - before.x_px
    dy_px = after.y_px - before.y_px
    return replace(before, flux_error_mag=error_mag, dx_px=dx_px, dy_px=dy_px)


def _common_flux_mag(stars: list[StarDifference]) -> float:
    """The median flux error, where it exceeds the limit and makes up more than half of the median
    star's error; else 0.
    """
    errors_mag = np.array([star.flux_error_mag for star in stars])
    limit_mag = np.median([star.limits.flux_mag for star in stars])
    flux_mag = float(np.median(errors_mag))
    rest_mag = np.median(np.abs(errors_mag - flux_mag))
    if abs(flux_mag) <= limit_mag or rest_mag > MIN_SHARE * abs(flux_mag):
        return 0.0
    return flux_mag


def _in_the_middle(
    motion: Motion, middle: FloatArray, limit_px: float
) -> tuple[tuple[float, float], float, float]:
    """A motion's shift, px, turn, deg, and scale error in the middle of the image: 0 for what moves
    no star by more than its limit.
    """
    reach_px = float(np.hypot(*middle))
    steps_px = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    shift, right, down = motion(steps_px)
    xx, yx = right - shift
    xy, yy = down - shift
    turn_rad = math.atan2(yx - xy, 2 + xx + yy)
    area = (1 + xx) * (1 + yy) - xy * yx
    scale_error = math.sqrt(area) - 1
    shift_px = (float(shift[0]), float(shift[1]))
    if np.hypot(*shift) <= limit_px:
        shift_px = (0.0, 0.0)
    if abs(turn_rad) * reach_px <= limit_px:
        turn_rad = 0.0
    if abs(scale_error) * reach_px <= limit_px:
        scale_error = 0.0
    return shift_px, math.degrees(turn_rad), scale_error


def _pairs(missing: list[StarDifference], extra: list[StarDifference]) -> list[tuple[int, int]]:
    """Which missing star is which extra one, by one common motion; none where they have none."""
    old = _places(missing)
    new = _places(extra)
    voters = min(MAX_VOTERS, len(old), len(new))
    if voters < MIN_STARS:
        return []
    votes = _displacements(_brightest(missing), _brightest(extra))
    near: Any = cKDTree(votes).query_ball_point(votes, VOTE_PX)
    winner = max(near, key=len)
    if len(winner) < max(MIN_STARS, MIN_STAR_SHARE * voters):
        return []
    predicted = old + np.median(votes[winner], axis=0)
    middle = old.mean(axis=0)
    pairs: list[tuple[int, int]] = []
    for _ in range(PAIR_ROUNDS):
        # Those that are each other's nearest, within PAIR_PX.
        distances_px, nearest = nearest_places(new, predicted)
        _, back = nearest_places(predicted, new)
        is_mutual = back[nearest] == np.arange(len(old))
        mutual = is_mutual & (distances_px <= PAIR_PX)
        before = np.flatnonzero(mutual)
        after = nearest[before]
        pairs = list(zip(before.tolist(), after.tolist(), strict=True))
        moves = new[after] - old[before]
        motion = fitted_motion(old[before] - middle, moves, rank_for(len(pairs)))
        predicted = old + motion(old - middle)
    return pairs


def _brightest(stars: list[StarDifference]) -> FloatArray:
    """Places (n, 2) of the brightest MAX_VOTERS stars, brightest first."""
    order = np.argsort([-star.flux_e_per_s for star in stars], kind="stable")
    return _places(stars)[order[:MAX_VOTERS]]


def _displacements(before: FloatArray, after: FloatArray) -> FloatArray:
    """The displacements (n m, 2) from each of n places to each of m others."""
    displacements = after[None, :] - before[:, None]
    return displacements.reshape(-1, 2)


def _places(stars: list[StarDifference]) -> FloatArray:
    """The places (n, 2) of stars, px."""
    places = [(star.x_px, star.y_px) for star in stars]
    return np.array(places).reshape(-1, 2)


def _worst_first(stars: list[StarDifference]) -> list[StarDifference]:
    """By the error over its limit, the largest first, and of equal ones the brightest."""
    return sorted(stars, key=lambda star: (-star.error_over_limit, -star.flux_e_per_s))


@dataclass(frozen=True, slots=True)
class SkyComparison:
    """Every star compared, the missing and the extra ones; `unmeasured` stars have too little light
    of their own in view.

    `common` is the difference that most stars share, None without one. Of light of several channels
    this is their sum, and `channels` has each by its name.
    """

    stars: list[StarDifference]
    limits: Limits
    unmeasured: int
    common: CommonChange | None = None
    channels: "dict[str, SkyComparison]" = field(default_factory=dict)

    def of(self, *kinds: str) -> list[StarDifference]:
        """The stars of these kinds."""
        return [star for star in self.stars if star.kind in kinds]

    @property
    def bad(self) -> list[StarDifference]:
        """The stars beyond their limits, worst first; of those missing and extra the brightest
        first.
        """
        return _worst_first(self.of("changed", "missing", "extra"))

    @property
    def differing(self) -> list[StarDifference]:
        """The stars that are beyond their limits once the common difference is subtracted, worst
        first.
        """
        if self.common is None:
            return self.bad
        return _worst_first(self.common.differing)

    @property
    def same(self) -> bool:
        """Whether both images are one sky, in every channel."""
        return not self.bad and all(channel.same for channel in self.channels.values())

    def __bool__(self) -> bool:
        return self.same

    def __repr__(self) -> str:
        if self.same:
            return f"<hilstar comparison: the same sky, {self.star_count} stars>"
        return f"<hilstar comparison: NOT the same sky, {len(self.bad)} of {self.star_count} stars>"

    @property
    def star_count(self) -> int:
        """How many stars the golden image has."""
        return len(self.stars) - len(self.of("extra"))

    @property
    def widened(self) -> int:
        """How many stars have limits of their own, because of the light around them or the
        image's edge.
        """
        return sum(star.limits != self.limits for star in self.of("same", "changed"))

    @property
    def flux_error_mag(self) -> ErrorSpread:
        """The spread of the flux errors of stars that both images have."""
        errors_mag = [abs(star.flux_error_mag) for star in self.of("same", "changed")]
        return error_spread(np.array(errors_mag))

    @property
    def centroid_error_px(self) -> ErrorSpread:
        """The spread of the centroid errors of stars that both images have."""
        errors_px = [star.centroid_error_px for star in self.of("same", "changed")]
        return error_spread(np.array(errors_px))

    def summary(self) -> dict[str, Any]:
        """The JSON object of `hilstar compare`; infinite errors are null there."""
        channels = {}
        for name, channel in self.channels.items():
            figures = channel.summary()
            channels[name] = {key: figures[key] for key in figures if key in CHANNEL_KEYS}
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
            "bad": [_summary_of(star) for star in self.bad],
            "same": self.same,
            "channels": channels,
        }


def _summary_of(star: StarDifference) -> dict[str, Any]:
    """A star that differs, in the JSON object of `hilstar compare`."""
    return {
        "kind": star.kind,
        "hip": star.hip,
        "x_px": star.x_px,
        "y_px": star.y_px,
        "flux_e_per_s": star.flux_e_per_s,
        "flux_error_mag": star.flux_error_mag,
        "dx_px": star.dx_px,
        "dy_px": star.dy_px,
    }


def star_lines(comparison: SkyComparison, max_lines: int, rest: str) -> list[str]:
    """A line for each star that differs beyond the common difference, `max_lines` of them;
    `rest` says where more are.
    """
    other = _other_channel(comparison)
    if not comparison.bad and other is not None:
        return star_lines(comparison.channels[other], max_lines, rest)
    stars = comparison.differing
    lines = [star.line() for star in stars[:max_lines]]
    if len(stars) > max_lines:
        return [*lines, f"and {len(stars) - max_lines} more{rest}"]
    return lines


def _other_channel(comparison: SkyComparison) -> str | None:
    """The first channel that is not the same; None where all are."""
    for name, channel in comparison.channels.items():
        if not channel.same:
            return name
    return None


def finding(comparison: SkyComparison) -> str:
    """The verdict in one sentence."""
    other = _other_channel(comparison)
    if not comparison.bad and other is not None:
        return f"In channel {other}: {finding(comparison.channels[other])}"
    if comparison.same:
        flux_mag = comparison.flux_error_mag.max
        place_px = comparison.centroid_error_px.max
        return (
            f"The same sky: {comparison.star_count} stars, at most {flux_mag:.2g} mag and"
            f" {place_px:.2g} px off"
        )
    if comparison.common is not None:
        sentence = f"Not the same sky: {comparison.common.line()}"
        if comparison.differing:
            sentence += f"; the worst is {comparison.differing[0].line()}"
        return sentence
    counts = []
    for kind in ("changed", "missing", "extra"):
        count = len(comparison.of(kind))
        if count:
            counts.append(f"{count} {kind}")
    return (
        f"Not the same sky: of {comparison.star_count} stars {', '.join(counts)}; the worst is"
        f" {comparison.bad[0].line()}"
    )
