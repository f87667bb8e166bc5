"""The cheapest sprites, paths and codes that keep a bench's errors within its tolerance.

Half of the tolerance is for the codes, a quarter for the sprites' edges and a quarter for motion that is not drawn.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import RenderSettings
from hilstar.bench.least_psf import MAG_PER_SHARE, Choice
from hilstar.monitor.balance import AS_USUAL, Balance, Seen
from hilstar.monitor.phases import UNLIKE, USUAL_PSF, WHITE, fainter, line_places, phase_grid, phase_image, shown_by
from hilstar.monitor.quantise import EXPOSURE_FRAMES, LevelCost, Panel, Quantiser
from hilstar.monitor.quantisers import BY_COST, QUANTISERS, Quantisation
from hilstar.monitor.response import Response
from hilstar.render.backend import MAX_SIDES, SpriteSide, SpriteSides, level_cost
from hilstar.scene.psf import MAX_CUT, Psf
from hilstar.scene.sprites import Sprites
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge
from hilstar.units import flux_ratio

CODES_SHARE, EDGES_SHARE, MOTION_SHARE = 0.5, 0.25, 0.25
PHASES = 12
MAGNITUDES = 5  # at which codes are judged, from white down to the faintest star
# Light beyond a small sprite is under this share of what lights a pixel: only where the wings of stars meet is a code lower
UNLIT = 0.25
CUT_PHASES = 51
IN_TIME_SHARE = 0.5  # share of a refresh period that a frame may take
CHEAP, BEST = BY_COST[0], BY_COST[-1]
# Between these times, in limits, a measured frame leaves the choice as the table has it: two starts of a run then have the same
# codes. Other programs slow frames down, and nothing speeds them up: the upper time is a whole refresh.
SURELY_IN_TIME, SURELY_LATE = 0.8, 2.0


@dataclass(frozen=True, slots=True)
class CodeErrors:
    """The maximum errors of a quantisation, and by whose measure of place; no place where its flux alone is too far off."""

    flux_mag: float
    place_px: float
    centroider: Centroider | None

    def within(self, limit_mag: float, limit_px: float) -> bool:
        """Whether both are within their limits."""
        return self.flux_mag <= limit_mag and self.place_px <= limit_px


@dataclass(frozen=True, slots=True)
class ChosenCodes:
    """A quantisation with its maximum errors, and whether the time of a frame took part in the choice."""

    method: Quantisation
    errors: CodeErrors
    choice: Choice
    by_cost: bool


@dataclass(frozen=True, slots=True)
class ChosenSides:
    """The sides of sprites by rate (see `Target.sides`), and what their edges cost: flux, and the shift of a centroid."""

    sides: SpriteSides
    cut_mag: float
    moved_px: float
    choice: Choice


ENCODING = Choice(
    "encoding", "under the sprites, or all pixels where sprites cover more", "exact", "the cheaper one, frame by frame"
)
PROJECTION = Choice("projection", "perspective", "exact", "a weak one would save nothing, and fails off the middle")


@dataclass(frozen=True, slots=True)
class FieldCost:
    """Milliseconds that a frame of an average field, turning at 1 deg/s, takes by `round` and by `exact`.

    `where` says on which machine, `why` why `exact` takes long ("" where it does not).
    """

    cheap_ms: float
    best_ms: float
    where: str
    why: str = ""

    def in_time(self, limit_ms: float) -> bool:
        """Whether `exact` is drawn within a limit, or `round` is not either."""
        return self.best_ms <= limit_ms or self.cheap_ms > limit_ms


@dataclass(frozen=True, slots=True)
class Effort:
    """The effort for a bench's stars: quantisation, sprite sides by rate (see `Target.sides`), and the smallest motion drawn.

    `error_mag` and `error_px` bound the error of all choices together, at the faintest star and the worst phase. `by_cost` says
    whether the time of a frame took part in the choice of the quantisation.
    """

    quantisation: Quantisation
    sides: SpriteSides
    motion_above_px: float
    error_mag: float
    error_px: float
    choices: tuple[Choice, ...]
    by_cost: bool = False


@dataclass(frozen=True, slots=True)
class Light:
    """The light of a bench: the panel's response, its minimum white (electrons per second), the stars' rates (n,).

    `can_steal_bits` says whether bit stealing would give finer codes, and is not used yet. `sky_share` is the share of the
    whole sky that the screen covers. `seen` is how the tracker sees the monitor, `centroider` what it finds stars by: None
    where the bench does not say, and then all of them judge. `psf` is how stars are drawn. The exposure has
    `exposure_frames`. `cost` is what a quantiser costs by the table, `measured` what it costs where the bench is drawn (None:
    not measured).
    """

    response: Response
    white_e_per_s: float
    rates_e_per_s: FloatArray
    can_steal_bits: bool = False
    sky_share: float = 0.0
    refresh_hz: float = 60.0
    seen: Seen = AS_USUAL
    centroider: Centroider | None = None
    psf: Psf = USUAL_PSF
    exposure_frames: int = EXPOSURE_FRAMES
    cost: Callable[[type[Quantiser], Psf], LevelCost] = level_cost
    measured: FieldCost | None = None

    @property
    def panel(self) -> Panel:
        """The monitor, where the screen is darkest."""
        return Panel(self.response, self.white_e_per_s)

    @property
    def judges(self) -> tuple[Centroider, ...]:
        """The centroiders that judge where codes show a star."""
        return FAMILY if self.centroider is None else (self.centroider,)

    def tabulated_cost(self, psf: Psf) -> FieldCost:
        """The cost of codes by the quantisers' own figures: on two cores without a GPU."""
        lit = self.rates_e_per_s >= self.response.half_step * self.white_e_per_s
        stars = self.sky_share * float(np.count_nonzero(lit))
        cheap, best = (self.cost(QUANTISERS[method], psf) for method in (CHEAP, BEST))
        return FieldCost(cheap.a_star_ms * stars, best.a_star_ms * stars, "on two cores without a GPU", best.why)

    @property
    def refresh_ms(self) -> float:
        """The time between two frames."""
        return 1e3 / self.refresh_hz


def plan_effort(render: RenderSettings, light: Light) -> Effort:
    """The effort of a bench file's settings."""
    codes = choose_codes(render, light)
    method, errors = codes.method, codes.errors
    if render.effort == "full":
        motion_px = render.motion_above_px
        return Effort(
            method, (), motion_px, errors.flux_mag, errors.place_px + motion_px, (codes.choice,), by_cost=codes.by_cost
        )
    sprites, rates = choose_sides(render, light, method), light.rates_e_per_s
    limit = QUANTISERS[method].faintest_e_per_s(light.panel, light.psf)
    dark = rates < limit
    share = float(rates[dark].sum() / rates.sum()) if dark.any() else 0.0
    stars = Choice(
        "stars",
        f"from {limit:.3g} electrons/s on",
        f"the others light no pixel ({share:.2%} of all light)",
        f"{int(dark.sum())} of {len(dark)} stars in the sky are not drawn",
    )
    motion_px = max(render.motion_above_px, MOTION_SHARE * render.tolerance_px)
    paths = Choice(
        "paths",
        f"stars move from {motion_px:g} px within a frame on, in as few sprites as their paths need",
        f"{motion_px:g} px maximum",
        "a slower frame is drawn as points",
    )
    return Effort(
        quantisation=method,
        sides=sprites.sides,
        motion_above_px=motion_px,
        error_mag=errors.flux_mag + sprites.cut_mag,
        error_px=errors.place_px + sprites.moved_px + motion_px,
        choices=(stars, codes.choice, sprites.choice, ENCODING, paths, PROJECTION),
        by_cost=codes.by_cost,
    )


def explain(effort: Effort | None, render: RenderSettings) -> list[str]:
    """One line for each choice, and the total error."""
    if effort is None:
        codes = f"quantisation = {render.quantisation}, as the file has it"
        return [f'effort: full, {codes}; write [render] effort = "auto" or quantisation = "auto" to have it chosen']
    total = f"{effort.error_mag:.4f} mag of {render.tolerance_mag:g}, {effort.error_px:.4f} px of {render.tolerance_px:g}"
    within = effort.error_mag <= render.tolerance_mag and effort.error_px <= render.tolerance_px
    return [
        *(choice.line() for choice in effort.choices),
        f"together, worst case: {total}{'' if within else ': OVER the tolerance'}",
    ]


def choose_codes(render: RenderSettings, light: Light) -> ChosenCodes:
    """The cheapest quantisation whose errors are within the codes' part of the tolerance; the most accurate one if none is.

    `auto` does not take `exact` where that would be late in fields of many stars and `round` would not.
    """
    table = light.tabulated_cost(light.psf)
    known = light.measured
    if known is None and render.codes_ms is not None:
        known = FieldCost(*render.codes_ms, "by [render] codes_ms")
    cost, in_time = known or table, exact_in_time(table, known, IN_TIME_SHARE * light.refresh_ms)
    wanted = (BY_COST if in_time else BY_COST[:1]) if render.quantisation == "auto" else (render.quantisation,)
    limits = CODES_SHARE * render.tolerance_mag, CODES_SHARE * render.tolerance_px
    stars = _code_stars(render, light)
    for method in wanted:
        errors = _code_errors(stars, method, math.inf if method == wanted[-1] else limits[0])
        within = errors.within(*limits)
        if within:
            break
    whom = "" if len(light.judges) == 1 else f", the worst of {len(light.judges)} centroiders"
    whom = f"as `{errors.centroider}` finds stars{whom}, from white to the faintest star"
    error = f"{errors.flux_mag:.4f} mag and {errors.place_px:.4f} px maximum, {whom}"
    auto = render.quantisation == "auto"
    if not within and auto and not in_time:
        price = f"{cost.best_ms:.0f} ms of {light.refresh_ms:.0f} ({CHEAP} {cost.cheap_ms:.0f}) for an average field at 1 deg/s"
        price += f" {cost.where}, {cost.why}" if cost.why else f" {cost.where}"
        error += f' (over {limits[0]:g} mag or {limits[1]:g} px: quantisation = "{BEST}" is nearer and takes {price})'
    elif not within:
        ways = "more bits, bit_stealing or brighter stars" if light.can_steal_bits else "more bits or brighter stars"
        error += f" (over {limits[0]:g} mag or {limits[1]:g} px: {ways} would do)"
    longer = cost.best_ms / cost.cheap_ms if cost.cheap_ms else 1.0
    saving = f"{BEST} takes {longer:.2g} times as long" if method == CHEAP else "nothing saved"
    if method == BEST:
        saving = f"an average field at 1 deg/s takes {cost.best_ms:.2g} ms of {light.refresh_ms:.3g} {cost.where}"
    return ChosenCodes(method, errors, Choice("codes", method, error, saving), auto and not (method == CHEAP and within))


def exact_in_time(table: FieldCost, measured: FieldCost | None, limit_ms: float) -> bool:
    """Whether `auto` may take `exact`: by the measured cost where that is clear of the limit, and else by the table's."""
    if measured is not None:
        clear = {measured.in_time(limit_ms * factor) for factor in (SURELY_IN_TIME, 1.0, SURELY_LATE)}
        if len(clear) == 1:
            return clear.pop()
    return table.in_time(limit_ms)


@dataclass(frozen=True, slots=True)
class _CodeStars:
    """Stars at every sub-pixel phase, from full scale to the faintest of a bench, and the tracker that looks at them.

    `tables` are the response's arrays, by whose content two benches' stars are the same.
    """

    psf: Psf
    seen: Seen
    frames: int
    kinds: tuple[Centroider, ...]
    mags: tuple[float, ...]
    tables: tuple[bytes, ...]
    response: Response = field(compare=False)


def _code_stars(render: RenderSettings, light: Light) -> _CodeStars:
    psf, response = light.psf, light.response
    faintest = float(light.rates_e_per_s.min()) if len(light.rates_e_per_s) else light.white_e_per_s
    deepest = max(0.0, 2.5 * math.log10(light.white_e_per_s / psf.peak_share / faintest))
    mags = tuple(np.linspace(0.0, deepest, MAGNITUDES).tolist())
    arrays = (response.light, response.threshold, *(() if response.rgb is None else (response.rgb,)))
    tables = tuple(array.tobytes() for array in arrays)
    return _CodeStars(psf, light.seen, light.exposure_frames, light.judges, mags, tables, response)


@lru_cache(maxsize=4)
def _looked_at(psf: Psf, seen: Seen) -> tuple[Sprites, FloatArray, Judge]:
    """The stars as bright as white, their light, and the tracker that looks at them."""
    sprites, _ = phase_grid(PHASES, psf, UNLIKE)
    bright = phase_image(sprites, psf)
    return sprites, bright, Judge(bright, line_places(sprites), psf.width_px, seen.blur_px, seen.pixel_px)


@lru_cache(maxsize=16)  # the benches of a campaign, a verdict or a study have few monitors, and this is half of loading one
def _code_errors(stars: _CodeStars, method: Quantisation, limit_mag: float) -> CodeErrors:
    """The maximum errors of a method over phases and magnitudes; where its light is beyond a limit, of its light alone."""
    sprites, bright, judge = _looked_at(stars.psf, stars.seen)
    panel, balance = Panel(stars.response, WHITE), Balance(stars.psf, stars.seen)
    flux_mag, shown = 0.0, []
    for mag in reversed(stars.mags):  # the faintest are off the furthest
        linear = (bright * flux_ratio(mag)).astype(np.float32)
        image = shown_by(method, stars.frames, panel, linear, fainter(sprites, mag), balance)
        flux_mag = max(flux_mag, judge.errors(image, flux_ratio(mag), ()).flux_max_mag)
        if flux_mag > limit_mag:
            return CodeErrors(flux_mag, math.inf, None)
        shown.append(image.copy())
    found = [judge.errors(image, flux_ratio(mag), stars.kinds) for image in shown]
    worst = max(found, key=lambda errors: errors.max_px(errors.worst()))
    kind = worst.worst()
    return CodeErrors(flux_mag, worst.max_px(kind), kind)


def choose_sides(render: RenderSettings, light: Light, method: Quantisation) -> ChosenSides:
    """The smallest sprites whose edges stay within their part of the tolerance."""
    psf = light.psf
    full = psf.footprint_px
    allowed_mag, allowed_px = EDGES_SHARE * render.tolerance_mag, EDGES_SHARE * render.tolerance_px
    sizes = range(0) if psf.by_place else range(full % 2 or 2, full, 2)
    largest = next((s for s in sizes if cut_mag(s, psf) <= allowed_mag and cut_px(s, psf) <= allowed_px), full)
    sides = [(math.inf, largest)]
    if unlit := UNLIT * QUANTISERS[method].lit_from_e_per_s(light.panel):
        # Falling rates: a star under the last of them that it is under gets the smallest sprite.
        sides += [(unlit / psf.outside_share(size), size) for size in sizes[::-1] if size < largest]
    kept = tuple(SpriteSide(min(rate, 3e38), size) for rate, size in sides[:MAX_SIDES])
    rates = light.rates_e_per_s
    area = np.full(len(rates), full**2)
    for side in kept:
        area[rates < side.below_e_per_s] = side.side_px**2
    cut = (cut_mag(largest, psf), cut_px(largest, psf)) if largest < full else (MAG_PER_SHARE * MAX_CUT, 0.0)
    mean = float(area.mean()) if len(area) else float(full**2)
    chosen = f"{min(side.side_px for side in kept)} to {largest} px a side instead of {full}"
    error = f"{cut[0]:.1e} mag and {cut[1]:.1e} px cut"
    return ChosenSides(kept, *cut, Choice("sprites", chosen, error, f"{full**2 / mean:.1f} times fewer pixels"))


def cut_mag(size_px: int, psf: Psf) -> float:
    """The flux lost outside a square sprite at the worst phase, magnitudes."""
    return MAG_PER_SHARE * psf.cut_share(size_px)


def cut_px(size_px: int, psf: Psf) -> float:
    """How far a square sprite's edge shifts the centroid at the worst phase, px, both axes combined."""
    worst, offsets = np.zeros(2), np.arange(size_px) - (size_px - 1) // 2
    for fraction in np.linspace(0.0, 1.0, CUT_PHASES) - (0.5 if size_px % 2 else 0.0):
        at = offsets - fraction
        shares = psf.shares(at[None, :], at[:, None])
        moments = np.array([(shares @ at).sum(), (at @ shares).sum()])
        worst = np.maximum(worst, np.abs(moments / shares.sum()))
    return math.hypot(*worst)
