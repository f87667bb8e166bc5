"""Chooses the cheapest sprites, paths and codes whose errors together are within a bench's
tolerance.

For each part of a frame (codes, sprites, paths) there is a list of candidates, each with its worst
error and its time. The errors of the parts add up, and all parts share one tolerance: the cheapest
combination whose sum is within it is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.panel import Panel
from hilstar.display.phases import USUAL_PSF
from hilstar.display.quantise import EXPOSURE_FRAMES, LevelCost, Quantisation, Quantiser
from hilstar.display.quantisers import BY_COST, QUANTISERS
from hilstar.display.render.backend import level_cost
from hilstar.display.render.target import MAX_SIDES, SpriteSide, SpriteSides
from hilstar.display.response import Response
from hilstar.optics.psf import MAX_CUT, Psf
from hilstar.server.bench.code_errors import CodeErrors, CodeStars, code_stars, worst_errors
from hilstar.server.bench.config import (
    RenderSettings,
)
from hilstar.server.bench.least_psf import MAG_PER_SHARE, Choice
from hilstar.tracker.centroiders import FAMILY, Centroider

TIMED_RATE_RAD_S = np.array([math.radians(1.0), 0.0, 0.0])

# A star gets a smaller sprite where its light beyond it is under this share of what lights a pixel:
# a code is then lower only where the wings of several stars meet.
UNLIT = 0.25
CUT_PHASES = 51  # places of a star across a pixel at which the shift of its centroid is computed
# The time of a sprite's pixel, and of a star on a path beyond that of one at a point, on the scale
# of the table of times (MS_A_STAR, EXACT_MS_A_STAR). Measured: sprites of 100 px in place of 22 add
# 0.3 ms for 1000 stars, and paths 0.7 ms, where `round` takes 3.9 ms in all and `exact` 7.0
# (llvmpipe, two busy cores, processor time, turning at 1 deg/s; in a ratio to 0.002 ms a star).
PIXEL_MS, PATH_MS = 2e-6, 4e-4
GLASS_MS_A_STAR = 0.01  # results/kinds_h200.csv: 27 ms more for 3615 stars
# Stars that move less than these shares of the tolerance may be drawn as points.
MOTION_SHARES = (0.05, 0.1, 0.25, 0.5)
# Where no combination is within the tolerance, sprites may add this share of it to the codes'
# error.
SLIGHT = 0.01
IN_TIME_SHARE = 0.5  # share of a refresh period that a frame may take
CHEAP, BEST = BY_COST[0], BY_COST[-1]
# A measured time between these two, in units of the limit, does not decide; the table of times then
# does, so that two starts of a run have the same codes. The range is wider above the limit, to a
# whole refresh period, as other programs slow frames down and nothing speeds them up.
SURELY_IN_TIME, SURELY_LATE = 0.8, 2.0
NO_ERROR = (0.0, 0.0)
# Errors are stated for frames that turn at most so fast. On longer paths `round` shows faint stars
# worse, and a centroider that looks for a point has no defined place along a path.
CLAIMED_TURN_DEG_S = 1.0
CLAIMED = f"errors are of turns up to {CLAIMED_TURN_DEG_S:g} deg/s; those of faster ones are larger"


@dataclass(frozen=True, slots=True)
class FieldCost:
    """The time, ms, of a frame of an average field that turns at 1 deg/s: `cheap_ms` by `round`,
    `best_ms` by `exact`.

    `where` says on which machine, `why` why `exact` takes long ("" where it does not).
    """

    cheap_ms: float
    best_ms: float
    where: str
    why: str = ""

    def in_time(self, limit_ms: float) -> bool:
        """Whether `exact` is drawn within a limit; True also where even `round` is late, as `exact`
        then loses nothing.
        """
        return self.best_ms <= limit_ms or self.cheap_ms > limit_ms


@dataclass(frozen=True, slots=True)
class Light:
    """What the choice of effort depends on: the panel's response, the rate of its darkest white,
    electrons/s, and the stars' rates (n,), electrons/s.

    `sky_share` is the share of the whole sky that the screen covers. `seen` is how the tracker sees
    the monitor. `centroider` is the one that the bench states; without one (None) errors are the
    worst of all centroiders. `psf` is the PSF with which stars are drawn, and `psf_choice` its
    reasons where the tolerance decides it. An exposure has `exposure_frames`. `cost` gives the time
    of a quantiser by the table, `measured` is the time on the machine that draws (None: not
    measured).

    For a scene that turns, `turning` is how far a star that is drawn as a point is from its place,
    in units of its motion; None for a scene at rest. `path_px` is how far a star moves while its
    row is lit, at CLAIMED_TURN_DEG_S.
    """

    response: Response
    white_e_per_s: float
    rates_e_per_s: FloatArray
    sky_share: float = 0.0
    refresh_hz: float = 60.0
    seen: Seen = AS_USUAL
    centroider: Centroider | None = None
    psf: Psf = USUAL_PSF
    psf_choice: Choice | None = None
    exposure_frames: int = EXPOSURE_FRAMES
    cost: Callable[[type[Quantiser], Psf], LevelCost] = level_cost
    measured: FieldCost | None = None
    turning: float | None = None
    path_px: float = 0.0

    @property
    def panel(self) -> Panel:
        """The panel with the response, and with white as at the darkest place of the screen."""
        return Panel(self.response, self.white_e_per_s)

    @property
    def judges(self) -> tuple[Centroider, ...]:
        """The centroiders by which errors of a star's place are measured."""
        if self.centroider is None:
            return FAMILY
        return (self.centroider,)

    @property
    def stars(self) -> float:
        """The number of stars in an average field that light a pixel."""
        lit = self.rates_e_per_s >= self.response.half_step * self.white_e_per_s
        return self.sky_share * float(np.count_nonzero(lit))

    def tabulated_cost(self, psf: Psf) -> FieldCost:
        """The time of codes by the quantisers' table, measured on two cores without a GPU."""
        cheap, best = (self.cost(QUANTISERS[method], psf) for method in (CHEAP, BEST))
        return FieldCost(
            cheap.a_star_ms * self.stars,
            best.a_star_ms * self.stars,
            "on two cores without a GPU",
            best.why,
        )

    @property
    def refresh_ms(self) -> float:
        """The refresh period, ms."""
        return 1e3 / self.refresh_hz

    def code_stars(self) -> CodeStars:
        """The catalogue's stars, as `worst_errors` needs them."""
        peaks = self.rates_e_per_s * (self.psf.peak_share / self.white_e_per_s)
        still = code_stars(
            self.psf, self.seen, self.exposure_frames, self.judges, self.response, peaks
        )
        return replace(still, path_px=self.path_px)


@dataclass(frozen=True, slots=True)
class Sides:
    """A candidate for sprites: their sides by a star's rate (see `Target.sides`), and the error by
    the light beyond their edges, `choice`.

    Only of stars up to `cut_to_mag` magnitudes below full scale would that light be visible.
    """

    sides: SpriteSides
    choice: Choice
    cut_to_mag: float = math.inf

    def beside(self, codes: CodeErrors) -> Choice:
        """The choice with the errors that it adds to the worst of the codes. They add less than
        they are: sprites cut bright stars, whose codes are less wrong than those of faint stars.
        """
        flux_mag, place_px = codes.brighter_than(self.cut_to_mag)
        more_mag = flux_mag + self.choice.error_mag - codes.flux_mag
        more_px = place_px + self.choice.error_px - codes.place_px
        if not math.isfinite(more_mag) or not math.isfinite(more_px):
            return self.choice
        return replace(self.choice, error_mag=max(more_mag, 0.0), error_px=max(more_px, 0.0))


@dataclass(frozen=True, slots=True)
class Motion:
    """A candidate for paths: the smallest motion within a frame, px, that is drawn as a path."""

    above_px: float
    choice: Choice

    def beside(self, codes: CodeErrors) -> Choice:
        """The choice with the error that it adds to the worst of the codes. A star that moves less
        is drawn as a point, with the codes of a star at rest, which are less wrong.
        """
        if codes.still_px is None or not math.isfinite(codes.place_px):
            return self.choice
        more_px = codes.still_px + self.choice.error_px - codes.place_px
        return replace(self.choice, error_px=max(more_px, 0.0))


@dataclass(frozen=True, slots=True)
class Combination:
    """One candidate of each part, with the codes' time; their errors are not computed here."""

    method: Quantisation
    method_ms: float
    sprites: Sides
    motion: Motion

    @property
    def ms(self) -> float:
        """The time of all parts together, ms."""
        return self.method_ms + self.sprites.choice.ms + self.motion.choice.ms


@dataclass(frozen=True)
class Effort:
    """The effort chosen for a bench's stars, `taken`: the quantisation, the sides of sprites by
    rate, and the smallest motion that is drawn as a path.

    `asked` and `light` are what it was chosen for; `by_cost` says whether the time of a frame took
    part in the choice of the quantisation. Errors are the worst of all choices together, of the
    catalogue's stars at any phase of a pixel; they are computed when they are first asked for.
    """

    asked: RenderSettings
    light: Light
    taken: Combination
    by_cost: bool = False

    @property
    def quantisation(self) -> Quantisation:
        """The quantisation by which codes are chosen."""
        return self.taken.method

    @property
    def sides(self) -> SpriteSides:
        """The sides of sprites by a star's rate."""
        return self.taken.sprites.sides

    @property
    def is_chosen(self) -> bool:
        """Whether the bench lets the tolerance decide a part."""
        return self.asked.effort == "auto" or self.asked.quantisation == "auto"

    @property
    def claimed_turn_deg_s(self) -> float:
        """The fastest turn, deg/s, for which the errors are stated; 0 where no frame turns."""
        if self.light.turning is None:
            return 0.0
        return CLAIMED_TURN_DEG_S

    @property
    def motion_above_px(self) -> float:
        """The smallest motion within a frame, px, that is drawn as a path."""
        return self.taken.motion.above_px

    @cached_property
    def _found(self) -> CodeErrors:
        """The codes' worst errors where these are within the tolerance; else the first errors over
        it, at which the search ends early.
        """
        return worst_errors(self.light.code_stars(), self.quantisation, self._tolerance)

    @property
    def _tolerance(self) -> tuple[float, float]:
        return self.asked.tolerance_mag, self.asked.tolerance_px

    @cached_property
    def codes(self) -> CodeErrors:
        """The worst errors of the codes, also where they are over the tolerance."""
        if self._found.within(self._tolerance):
            return self._found
        return worst_errors(self.light.code_stars(), self.quantisation)

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The choice of each part, with its errors and times, as a report lists them."""
        parts = [
            code_part(self),
            self.taken.sprites.beside(self.codes),
            self.taken.motion.beside(self.codes),
        ]
        if self.light.psf_choice is not None:
            parts.append(psf_part(self.light, self.light.psf_choice))
        return (*parts, depth_part(self))

    @property
    def error_mag(self) -> float:
        """The worst error of a star's light, mag, by all parts together."""
        return sum(choice.error_mag for choice in self.choices)

    @property
    def error_px(self) -> float:
        """The worst error of a star's place, px, by all parts together."""
        return sum(choice.error_px for choice in self.choices)

    @property
    def within(self) -> bool:
        """Whether both errors are within the tolerance. Where they are not, this is known sooner
        than the errors themselves.
        """
        if not self._found.within(self._tolerance):
            return False
        return (
            self.error_mag <= self.asked.tolerance_mag and self.error_px <= self.asked.tolerance_px
        )


def plan_effort(render: RenderSettings, light: Light) -> Effort:
    """The cheapest combination within the tolerance; where none is, the most accurate
    quantisation, with the cheapest sprites and paths that add next to nothing to its errors.

    A part that the bench file fixes has that as its only candidate.
    """
    auto = render.quantisation == "auto"
    methods = _methods(render, light)
    combinations = sorted(_combinations(render, light, methods), key=lambda choice: choice.ms)
    most_accurate = [choice for choice in combinations if choice.method == methods[-1]]
    # The errors of a combination take 0.1 s. The last one need not be tested where it is the only
    # one of its quantisation: it is chosen anyway.
    if len(most_accurate) > 1:
        tested = combinations
    else:
        tested = [choice for choice in combinations if choice.method != methods[-1]]
    stars = light.code_stars() if tested else None
    for choice in tested:
        if stars is not None and _is_within(render, light, stars, choice):
            return Effort(render, light, choice, by_cost=auto and choice.method != CHEAP)
    slight = next(choice for choice in most_accurate if _is_slight(render, choice))
    return Effort(render, light, slight, by_cost=auto)


def _methods(render: RenderSettings, light: Light) -> tuple[Quantisation, ...]:
    """The quantisations to choose among, the cheapest first.

    With `auto`, `exact` is not among them where it would be late in an average field and `round`
    would not.
    """
    if render.quantisation != "auto":
        return (render.quantisation,)
    table = light.tabulated_cost(light.psf)
    known = known_cost(render, light)
    if exact_in_time(table, known, IN_TIME_SHARE * light.refresh_ms):
        return BY_COST
    return BY_COST[:1]


def known_cost(render: RenderSettings, light: Light) -> FieldCost | None:
    """The time of codes on the machine that draws them, as it was measured or as `[render]
    codes_ms` states it; None for neither.
    """
    if light.measured is None and render.codes_ms is not None:
        return FieldCost(*render.codes_ms, "by [render] codes_ms")
    return light.measured


def exact_in_time(table: FieldCost, measured: FieldCost | None, limit_ms: float) -> bool:
    """Whether `auto` may choose `exact`: by the measured time where this is clearly within or over
    the limit, else by the table's time.
    """
    if measured is not None:
        clear = {
            measured.in_time(limit_ms * factor) for factor in (SURELY_IN_TIME, 1.0, SURELY_LATE)
        }
        if len(clear) == 1:
            return clear.pop()
    return table.in_time(limit_ms)


def _combinations(
    render: RenderSettings, light: Light, methods: tuple[Quantisation, ...]
) -> Iterator[Combination]:
    motions = motion_candidates(render, light)
    for method in methods:
        method_ms = codes_ms(render, light, method)
        sprites = side_candidates(render, light, method)
        for sides in sprites:
            for motion in motions:
                yield Combination(method, method_ms, sides, motion)


def _is_within(render: RenderSettings, light: Light, stars: CodeStars, one: Combination) -> bool:
    """Whether the errors of all parts together are within the tolerance."""
    tolerance = render.tolerance_mag, render.tolerance_px
    codes = worst_errors(stars, one.method, tolerance)
    if not codes.within(tolerance):
        return False
    parts = [one.sprites.beside(codes), one.motion.beside(codes)]
    if light.psf_choice is not None:
        parts.append(light.psf_choice)
    mag = codes.flux_mag + sum(part.error_mag for part in parts)
    px = codes.place_px + sum(part.error_px for part in parts)
    return mag <= tolerance[0] and px <= tolerance[1]


def _is_slight(render: RenderSettings, one: Combination) -> bool:
    """Whether the sprites of a combination add next to nothing to the codes' error (SLIGHT of the
    tolerance), or as little as any can, and it draws no motion as a point that the bench draws as a
    path.
    """
    sprites = one.sprites.choice
    motion = one.motion
    share = max(sprites.error_mag / render.tolerance_mag, sprites.error_px / render.tolerance_px)
    is_whole = sprites.error_mag <= MAG_PER_SHARE * MAX_CUT
    return (is_whole or share <= SLIGHT) and motion.above_px <= render.motion_above_px


def _scale(render: RenderSettings, light: Light) -> float:
    """How many times as long as by the table a frame takes on the machine that draws it; 1 where
    that is not known.
    """
    table = light.tabulated_cost(light.psf)
    known = known_cost(render, light)
    if known is None or not table.cheap_ms:
        return 1.0
    return known.cheap_ms / table.cheap_ms


def codes_ms(render: RenderSettings, light: Light, method: Quantisation) -> float:
    """The time, ms, that the codes of an average field's frame take: the frame's time less that of
    its sprites' pixels and of its paths.
    """
    scale = _scale(render, light)
    known = known_cost(render, light)
    whole_ms = light.cost(QUANTISERS[method], light.psf).a_star_ms * light.stars * scale
    if known is not None and method in BY_COST:
        if method == CHEAP:
            whole_ms = known.cheap_ms
        else:
            whole_ms = known.best_ms
    others_ms = scale * light.stars * (PIXEL_MS * light.psf.footprint_px**2 + PATH_MS)
    return max(whole_ms - others_ms, 0.0)


def code_part(effort: Effort) -> Choice:
    """The choice of the codes with its errors, its time, and notes on them."""
    render = effort.asked
    light = effort.light
    method = effort.quantisation
    errors = effort.codes
    cost = known_cost(render, light) or light.tabulated_cost(light.psf)
    ms = codes_ms(render, light, method)
    saved_ms = max(codes_ms(render, light, BEST) - ms, 0.0)
    notes = []
    if errors.centroider is not None:
        if len(light.judges) == 1:
            whom = ""
        else:
            whom = f", the worst of {len(light.judges)} centroiders"
        notes.append(f"as `{errors.centroider}` finds stars{whom}")
    if errors.turns:
        notes.append(f"turning at {CLAIMED_TURN_DEG_S:g} deg/s")
    if not math.isfinite(errors.flux_mag):
        notes.append("the faintest stars of the catalogue show nothing")
    if method == BEST or (render.quantisation == "auto" and len(_methods(render, light)) == 1):
        notes.append(_price(cost, light))
    return Choice("codes", method, errors.flux_mag, errors.place_px, ms, saved_ms, "; ".join(notes))


def _price(cost: FieldCost, light: Light) -> str:
    """A text that says how much of a refresh period `exact` takes, and `round`."""
    best_ms, cheap_ms = (_two_digits(ms) for ms in (cost.best_ms, cost.cheap_ms))
    price_text = f"exact takes {best_ms} ms of {light.refresh_ms:.3g} (round {cheap_ms})"
    price_text += f" for an average field at 1 deg/s {cost.where}"
    return f"{price_text}, {cost.why}" if cost.why else price_text


def _two_digits(number: float) -> str:
    """A number with two digits, or whole from 100 on, as text."""
    if number < 99.5:
        return f"{number:.2g}"
    return f"{number:.0f}"


def side_candidates(render: RenderSettings, light: Light, method: Quantisation) -> list[Sides]:
    """The candidates for sprites, from the smallest to the PSF's whole footprint; at full effort,
    and for a PSF that differs over the field, the whole footprint alone.
    """
    psf = light.psf
    full = psf.footprint_px
    sizes = list(range(full % 2 or 2, full, 2))
    pixels_ms = PIXEL_MS * light.stars * _scale(render, light)
    candidates = []
    if render.effort == "auto" and not psf.by_place:
        for size in sizes:
            sides = _sides(light, method, sizes, size)
            mean_px = _mean_area_px(sides, light.rates_e_per_s, full)
            chosen = f"{min(side.side_px for side in sides)} to {size} px a side, of {full}"
            saved_ms = pixels_ms * (full**2 - mean_px)
            choice = Choice(
                "sprites",
                chosen,
                cut_mag(size, psf),
                cut_px(size, psf),
                pixels_ms * mean_px,
                saved_ms,
            )
            candidates.append(Sides(sides, choice, _cut_to_mag(light, method, size)))
    if render.effort == "auto" and not psf.by_place:
        sides = _sides(light, method, sizes, full)
    else:
        sides = ()
    mean_px = _mean_area_px(sides, light.rates_e_per_s, full)
    smallest = min((side.side_px for side in sides), default=full)
    if smallest < full:
        chosen = f"{smallest} to {full} px a side"
    else:
        chosen = f"{full} px a side"
    saved_ms = pixels_ms * (full**2 - mean_px)
    cut = MAG_PER_SHARE * MAX_CUT
    candidates.append(
        Sides(sides, Choice("sprites", chosen, cut, 0.0, pixels_ms * mean_px, saved_ms))
    )
    return candidates


def _sides(light: Light, method: Quantisation, sizes: list[int], largest: int) -> SpriteSides:
    """The sides of sprites by rate: `largest`, and for fainter stars the smaller `sizes` beyond
    which their light lights no pixel.
    """
    sides = [(math.inf, largest)]
    unlit = UNLIT * QUANTISERS[method].lit_from_e_per_s(light.panel)
    if unlit:
        # The rates fall from entry to entry: the last entry whose rate a star is under counts.
        sides += [
            (unlit / light.psf.outside_share(size), size) for size in sizes[::-1] if size < largest
        ]
    return tuple(SpriteSide(min(rate, 3e38), size) for rate, size in sides[:MAX_SIDES])


def _cut_to_mag(light: Light, method: Quantisation, size_px: int) -> float:
    """How many magnitudes below full scale a star's light beyond a sprite of this size begins to
    light no pixel.
    """
    unlit = UNLIT * QUANTISERS[method].lit_from_e_per_s(light.panel)
    if not unlit:
        return math.inf
    rate = unlit / light.psf.outside_share(size_px)
    return -2.5 * math.log10(rate * light.psf.peak_share / light.white_e_per_s)


def _mean_area_px(sides: SpriteSides, rates_e_per_s: FloatArray, full: int) -> float:
    area = np.full(len(rates_e_per_s), full**2)
    for side in sides:
        area[rates_e_per_s < side.below_e_per_s] = side.side_px**2
    if len(area):
        return float(area.mean())
    return float(full**2)


def cut_mag(size_px: int, psf: Psf) -> float:
    """The flux lost outside a square sprite at the worst phase, magnitudes."""
    return MAG_PER_SHARE * psf.cut_share(size_px)


def cut_px(size_px: int, psf: Psf) -> float:
    """How far a square sprite's edge shifts the centroid at the worst phase, px, both axes
    combined.
    """
    worst = np.zeros(2)
    offsets = np.arange(size_px) - (size_px - 1) // 2
    for fraction in np.linspace(0.0, 1.0, CUT_PHASES) - (0.5 if size_px % 2 else 0.0):
        at = offsets - fraction
        shares = psf.shares(at[None, :], at[:, None])
        moments = np.array([(shares @ at).sum(), (at @ shares).sum()])
        worst = np.maximum(worst, np.abs(moments / shares.sum()))
    return math.hypot(*worst)


def motion_candidates(render: RenderSettings, light: Light) -> list[Motion]:
    """The candidates for paths: one without paths for a scene at rest; else the bench file's
    smallest motion and, with `auto`, shares of the tolerance that are larger.
    """
    floor_px = render.motion_above_px
    if light.turning is None:
        return [Motion(floor_px, Choice("paths", "none: nothing moves within a frame", *NO_ERROR))]
    path_ms = PATH_MS * light.stars * _scale(render, light)
    above_px = [floor_px]
    if render.effort == "auto":
        above_px += [
            share * render.tolerance_px
            for share in MOTION_SHARES
            if share * render.tolerance_px > floor_px
        ]
    candidates = []
    for px in above_px:
        ms = path_ms
        saved_ms = 0.0
        note = CLAIMED
        if px > floor_px:
            # Time is saved only in frames whose motion is between the file's and this one.
            ms = 0.0
            saved_ms = path_ms
            note = f"{CLAIMED}; saves in frames that move less"
        choice = Choice(
            "paths",
            f"from {px:g} px within a frame on",
            0.0,
            px * light.turning,
            ms,
            saved_ms,
            note,
        )
        candidates.append(Motion(px, choice))
    return candidates


def psf_part(light: Light, choice: Choice) -> Choice:
    """The choice of the PSF, with the time that a PSF by colour takes, or that is saved without
    one.
    """
    glass_ms = GLASS_MS_A_STAR * light.stars
    if light.psf.by_colour:
        return replace(choice, ms=glass_ms)
    return replace(choice, saved_ms=glass_ms)


def depth_part(effort: Effort) -> Choice:
    """The choice of the stars that are drawn: all but those too faint to light a pixel."""
    light = effort.light
    rates = light.rates_e_per_s
    limit = QUANTISERS[effort.quantisation].faintest_e_per_s(light.panel, light.psf)
    dark = rates < limit
    if not dark.any():
        return Choice("depth", "all stars of the catalogue", *NO_ERROR)
    share = float(rates[dark].sum() / rates.sum())
    saved_ms = (
        light.sky_share
        * float(dark.sum())
        * light.cost(QUANTISERS[effort.quantisation], light.psf).a_star_ms
    )
    note = f"{int(dark.sum())} of {len(dark)} stars light no pixel, {share:.2%} of all light"
    return Choice("depth", f"from {limit:.3g} electrons/s on", *NO_ERROR, 0.0, saved_ms, note)
