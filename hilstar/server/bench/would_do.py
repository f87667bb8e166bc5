"""What would bring a bench within its tolerance: one key, or two, tried by the bench's own plan.

The keys stand in the order of what they cost a user: nothing that is seen (bits, bit stealing,
`exact` where it is late), then frames that are right over an exposure only, stars that clip, wider
stars, and stars that are missing. Where no key does alone, pairs of them are tried in that order:
those first whose dearer key costs less.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import msgspec

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import flux_ratio
from hilstar.display.calibration import load_calibration
from hilstar.display.quantise import Quantisation
from hilstar.display.response import Response
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.config import GAUSSIAN, RenderSettings
from hilstar.server.bench.effort import BEST, Effort, Light, plan_effort
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.monitor import calibration_source
from hilstar.server.bench.scene import white_of
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.stars import Stars

BITS = (10, 12, 14, 16)
BRIGHTER_MAG = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)  # by which full scale comes down
WIDER = (1.2, 1.4, 1.7, 2.0)  # times the sprite's sigma
SHALLOWER_MAG = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)  # above the faintest star
DIGITS = 3  # of a value that is proposed
OVER_FRAMES = "temporal"
MAX_PAIRS = 3  # the cheapest; more would not be read, and each takes half a second to find
Value = float | bool | str | tuple[float, float]


@dataclass(frozen=True, slots=True)
class Change:
    """A key of the bench file, and another value for it."""

    key: str
    value: Value


@dataclass(frozen=True, slots=True)
class Remedy:
    """One or two changes of the bench file, and the worst errors that the bench then has.

    An error is infinite where a star still shows nothing.
    """

    changes: tuple[Change, ...]
    error_mag: float
    error_px: float
    within: bool


@dataclass(frozen=True, slots=True)
class Trial:
    """A bench with changes: what of it they may touch."""

    render: RenderSettings
    bits: int
    faintest_v_mag: float
    changes: tuple[Change, ...] = ()

    def but(self, key: str, value: Value, **changed: Any) -> "Trial":
        """The trial with one more change."""
        return replace(self, changes=(*self.changes, Change(key, value)), **changed)

    def rendered(self, key: str, value: Value, **more: Value) -> "Trial":
        """The trial with another value of a key of [render]."""
        changed: dict[str, Value] = {key: value, **more}
        render = msgspec.structs.replace(self.render, **changed)
        return self.but(f"[render] {key}", value, render=render)


Way = Callable[[Trial], Iterator[Trial]]  # a key's changes, the smallest first
Judge = Callable[[Trial], bool]  # whether a bench with changes is within its tolerance


class _Trials:
    """The trials of a bench, and what its plan makes of them."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._stars: Stars = bench_stars(bench.file.config, bench.file.folder)
        self._drive: FloatArray | float = 1.0
        if bench.colours is not None:
            self._stars = bench.colours.on(self._stars)
            if self._stars.primaries is not None:
                self._drive = bench.colours.drive(self._stars.primaries)
        faintest = float(self._stars.v_mag.max(initial=-99.0))
        faintest_v_mag = min(bench.file.config.sky.faintest_v_mag, faintest)
        asked = bench.effort.asked
        self.start = Trial(asked, bench.file.config.monitor.bits, faintest_v_mag)
        self.ways: tuple[Way, ...] = (
            self._more_bits,
            self._stolen_bits,
            self._exact_codes,
            self._codes_over_frames,
            self._brighter,
            wider,
            self._shallower,
        )

    def effort(self, trial: Trial) -> Effort:
        """The plan of a bench with changes."""
        return plan_effort(trial.render, self._light(trial))

    def _light(self, trial: Trial) -> Light:
        light = self._bench.effort.light
        if trial.render.sprite_sigma_px != self.start.render.sprite_sigma_px:
            light = replace(light, psf=GaussianPsf(trial.render.sprite_sigma_px))
        if trial.faintest_v_mag != self.start.faintest_v_mag:
            shown = self._stars.v_mag <= trial.faintest_v_mag
            light = replace(light, rates_e_per_s=self._stars.electrons_per_s[shown])
        white_e_per_s = white_of(trial.render, self._stars, light.psf, self._drive)
        return replace(
            light,
            response=self._response(trial),
            white_e_per_s=white_e_per_s * self._bench.darkest,
        )

    def _response(self, trial: Trial) -> Response:
        start = self.start
        stealing = trial.render.bit_stealing
        if (trial.bits, stealing) == (start.bits, start.render.bit_stealing):
            return self._bench.effort.light.response
        file = self._bench.file
        source = calibration_source(file.config.monitor, file.folder)
        return load_calibration(source, trial.bits, bit_stealing=stealing).response

    def _more_bits(self, trial: Trial) -> Iterator[Trial]:
        if not self._bench.calibration.is_formula:
            return iter(())
        return more_bits(trial, self._exists)

    def _stolen_bits(self, trial: Trial) -> Iterator[Trial]:
        bench = self._bench
        if bench.colours is not None or not bench.calibration.can_steal_bits:
            return
        stolen = trial.rendered("bit_stealing", True)
        if not trial.render.bit_stealing and self._exists(stolen):
            yield stolen

    def _exists(self, trial: Trial) -> bool:
        """Whether there is a response: bits cannot be stolen of many."""
        try:
            self._response(trial)
        except InputError:
            return False
        return True

    def _exact_codes(self, trial: Trial) -> Iterator[Trial]:
        """`exact`, where a slow machine or the file has other codes."""
        if self._bench.effort.quantisation != BEST:
            yield trial.rendered("quantisation", BEST)

    def _codes_over_frames(self, trial: Trial) -> Iterator[Trial]:
        effort = self._bench.effort
        return codes_over_frames(trial, effort.light.exposure_frames, effort.quantisation)

    def _brighter(self, trial: Trial) -> Iterator[Trial]:
        return brighter(trial, float(self._stars.v_mag.max(initial=0.0)))

    def _shallower(self, trial: Trial) -> Iterator[Trial]:
        return shallower(trial, float(self._stars.v_mag.min(initial=99.0)))


def more_bits(trial: Trial, exists: Callable[[Trial], bool]) -> Iterator[Trial]:
    """More bits, of a response that exists for them."""
    for bits in BITS:
        more = trial.but("[monitor] bits", bits, bits=bits)
        if bits > trial.bits and exists(more):
            yield more


def codes_over_frames(
    trial: Trial, exposure_frames: float, quantisation: Quantisation
) -> Iterator[Trial]:
    """Codes that are right over an exposure of several frames, where a bench has others."""
    if exposure_frames > 1 and quantisation != OVER_FRAMES:
        yield trial.rendered("quantisation", OVER_FRAMES)


def brighter(trial: Trial, faintest_v_mag: float) -> Iterator[Trial]:
    """A full scale of fewer electrons: faint stars take more codes, and more bright ones clip."""
    given = trial.render.flux_at_white_e_per_s
    for mag in BRIGHTER_MAG:
        if given is not None:
            value = float(f"{given * flux_ratio(mag):.{DIGITS}g}")
            yield trial.rendered("flux_at_white_e_per_s", value)
            continue
        value = (trial.render.brightest_v_mag or 0.0) + mag
        if value > faintest_v_mag:
            return
        yield trial.rendered("brightest_v_mag", value)


def wider(trial: Trial) -> Iterator[Trial]:
    """Stars over more pixels, each of which has its own rounding."""
    if trial.render.psf != GAUSSIAN:
        return
    for factor in WIDER:
        x, y = (round(sigma * factor, 2) for sigma in trial.render.sprite_sigma_px)
        yield trial.rendered("sprite_sigma_px", (x, y))


def shallower(trial: Trial, brightest_v_mag: float) -> Iterator[Trial]:
    """A catalogue that ends at brighter stars."""
    for mag in SHALLOWER_MAG:
        value = round(trial.faintest_v_mag - mag, 2)
        if value < brightest_v_mag:
            return
        yield trial.but("[sky] faintest_v_mag", value, faintest_v_mag=value)


def would_do(bench: Bench) -> list[Remedy]:
    """Each key that alone brings a bench within its tolerance, with the smallest change that does.

    Where no key alone does, the cheapest pairs of keys; where no pair does, each key's largest
    change. None for a bench that is within already.
    """
    if bench.effort.within:
        return []
    trials = _Trials(bench)
    remedies = []
    for trial in first_trials(trials.start, trials.ways, lambda one: trials.effort(one).within):
        effort = trials.effort(trial)
        remedies.append(Remedy(trial.changes, effort.error_mag, effort.error_px, effort.within))
    return remedies


def first_trials(start: Trial, ways: Sequence[Way], is_within: Judge) -> list[Trial]:
    """The smallest change of each key that is within alone; else the cheapest pairs of keys; else
    the largest change of each key.
    """
    alone = [_first_within(way(start), is_within) for way in ways]
    trials = [trial for trial in alone if trial is not None]
    if trials:
        return trials
    pairs = _pairs(start, ways, is_within)
    if pairs:
        return pairs
    largest = [_largest(way, start) for way in ways]
    return [trial for trial in largest if trial is not None]


def _pairs(start: Trial, ways: Sequence[Way], is_within: Judge) -> list[Trial]:
    """The first pairs of keys within the tolerance, each with the smallest changes that do."""
    pairs: list[Trial] = []
    by_cost = sorted(combinations(range(len(ways)), 2), key=lambda pair: pair[::-1])
    for cheaper_place, dearer_place in by_cost:
        trial = smallest_pair(start, ways[cheaper_place], ways[dearer_place], is_within)
        if trial is not None:
            pairs.append(trial)
        if len(pairs) == MAX_PAIRS:
            break
    return pairs


def smallest_pair(start: Trial, cheaper: Way, dearer: Way, is_within: Judge) -> Trial | None:
    """Of two keys the smallest change of the dearer one with any of the cheaper, and then of the
    cheaper; None where the largest of both are over the tolerance.
    """
    utmost = _largest(cheaper, start)
    if utmost is None:
        return None
    both = _largest(dearer, utmost)
    if both is None or len({change.key for change in both.changes}) == 1:
        return None  # both are ways to change the codes
    if not is_within(both):
        return None
    changed = _first_within(dearer(utmost), is_within)
    if changed is None:
        return both
    smallest = changed.changes[-1]
    for first in cheaper(start):
        for second in dearer(first):
            if second.changes[-1] == smallest and is_within(second):
                return second
    return changed


def _largest(way: Way, trial: Trial) -> Trial | None:
    some = list(way(trial))
    return some[-1] if some else None


def _first_within(some: Iterator[Trial], is_within: Judge) -> Trial | None:
    return next((trial for trial in some if is_within(trial)), None)
