"""The scenes and choices of the study of the chain: five scenes, their motion and packets, the
panel, and the combinations.

At rest all predictions are equal, and so are points and paths: one of each is measured. Where the
camera turns, a crude prediction or smear is combined with cut sprites only: whole sprites would add
time and no accuracy. An exposure sums each row's share of each frame of a panel that lights row by
row. Each quantisation, bit stealing and sprite size has a bench of its own, all with the same
stars.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import random_attitudes
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.quantise import Quantisation
from hilstar.instruments.study.predictors import Movement
from hilstar.optics.scan import Scan
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import assembled
from hilstar.server.bench.config import AttitudeSettings, BenchConfig, RenderSettings, SkySettings
from hilstar.server.bench.config.sky import SpacecraftSettings
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.stars import split_by_rate

# `held`: the newest sample's attitude. `rate`: carried on by the sample's rate. `two samples`: by
# the last two, from a sender that tells no rates.
Prediction = Literal["held", "rate", "two samples"]
PREDICTIONS: tuple[Prediction, ...] = ("rate", "two samples", "held")
Sprite = Literal["full", "cut", "coarse"]
Smear = Literal["path", "point"]
QUANTISATIONS: tuple[Quantisation, ...] = ("round", "dither", "temporal", "exact")
SPRITES: tuple[Sprite, ...] = ("full", "cut", "coarse")
COARSER = 10.0  # times the bench file's tolerance, for the sprites `coarse`
SHALLOWER_MAG = 1.0  # by which the shallower catalogue that is tried ends earlier
FIELDS = 200  # random fields, among which the scenes are chosen
DENSE = 1  # the place of the densest field among the scenes
SEED = 1
ENOUGH = 0.5  # a faint field has at most this share of an average field's stars
# The pixels that a frame lights, as places in its flattened image (n,), and the light of each,
# electrons per second.
Lit = tuple[IntArray, FloatArray]
START_S = 0.0037  # exposure start after a frame's first light, within a refresh
MAX_FRAMES = 16  # refreshes: of a longer exposure only so many are measured
DEG_PER_RAD = math.degrees(1.0)
OWN = {"effort": "auto", "quantisation": "auto"}


def lead_ns(config: BenchConfig) -> int:
    """Time from the start of a frame to the first light of its middle row: a refresh to draw it
    in, then the panel.
    """
    monitor = config.monitor
    return round(
        (monitor.period_ms + monitor.panel_delay_ms + monitor.panel_scanout_ms / 2) * NS_PER_MS
    )


def filled_timeline(
    samples: list[AttitudeSample], prediction: Prediction, settings: AttitudeSettings
) -> Timeline:
    """A timeline with the bench file's settings and these samples, for one kind of prediction."""
    ahead_ms = settings.max_extrapolation_ms or AttitudeSettings().max_extrapolation_ms
    stale_ns = round(settings.stale_after_ms * NS_PER_MS)
    timeline = Timeline(
        Policy(0 if prediction == "held" else round(ahead_ms * NS_PER_MS), stale_ns)
    )
    for sample in samples:
        timeline.add(
            replace(sample, rate_cam_rad_s=None) if prediction == "two samples" else sample
        )
    return timeline


@dataclass(frozen=True, slots=True)
class ChainCombination:
    """One choice for each step.

    Depth: `bit_stealing`, and the catalogue's `faintest_v_mag`. `sprite`: `full`, `cut` as
    `effort = "auto"` does within the bench file's tolerance, or `coarse`: the same within COARSER
    times that. `smear`: stars along their paths, or points.
    """

    quantisation: Quantisation
    bit_stealing: bool
    faintest_v_mag: float
    sprite: Sprite
    smear: Smear = "path"
    prediction: Prediction = "rate"


def combinations(
    turns: bool, can_steal_bits: bool, faintest_v_mag: float
) -> list[ChainCombination]:
    """All combinations that are measured, for a scene that turns or one at rest."""
    chosen: list[ChainCombination] = []
    shallow = faintest_v_mag - SHALLOWER_MAG
    for stealing in (False, True) if can_steal_bits else (False,):
        for method in QUANTISATIONS:
            chosen += [
                ChainCombination(method, stealing, faintest_v_mag, sprite) for sprite in SPRITES
            ]
            if turns:
                crude: list[tuple[Smear, Prediction]] = [
                    ("point", "rate"),
                    ("path", "two samples"),
                    ("point", "held"),
                ]
                chosen += [
                    ChainCombination(method, stealing, faintest_v_mag, "cut", *ways)
                    for ways in crude
                ]
        chosen += [
            ChainCombination(method, stealing, shallow, "cut") for method in ("round", "exact")
        ]
        if turns:
            chosen.append(ChainCombination("round", stealing, shallow, "cut", "point", "held"))
    return chosen


@dataclass(frozen=True, slots=True)
class ChainScene:
    """A field, the rate at which the camera crosses it, and why it is one of the five."""

    name: str
    why: str
    q_icrs_to_cam: FloatArray
    rate_deg_s: float = 0.0


def chosen_fields(star_rates: Sequence[FloatArray]) -> tuple[int, int, int] | None:
    """The numbers of three fields, by the rates (n,) of the stars of each: the one with as many
    stars as most have, the one with the most, and the one whose brightest star is the faintest, of
    those with enough of them; None where no field has a star.
    """
    counts = np.array([len(rates) for rates in star_rates])
    if not counts.any():
        return None
    typical = float(np.median(counts[counts > 0]))
    average = np.argmin(np.abs(counts - typical))
    brightest = np.full(len(star_rates), np.inf)
    for number, rates in enumerate(star_rates):
        if len(rates) >= ENOUGH * typical:
            brightest[number] = rates.max()
    return int(average), int(np.argmax(counts)), int(np.argmin(brightest))


def five_scenes(bench: Bench) -> tuple[ChainScene, ...]:
    """The scenes of a bench, chosen among FIELDS random fields of its sky. Raises InputError
    where it has no stars.
    """
    fields = random_attitudes(FIELDS, np.random.default_rng(SEED))
    star_rates = [bench.sprites(q).data["electrons_per_s"] for q in fields]
    chosen = chosen_fields(star_rates)
    if chosen is None:
        raise InputError(
            f"{bench.file.path}: [sky] leaves no star that the monitor shows; write a larger"
            " faintest_v_mag"
        )
    average, dense, faint = (fields[number] for number in chosen)
    return (
        ChainScene("average field", "what most frames are", average),
        ChainScene("dense field", "the most stars: time", dense),
        ChainScene("faint field", "no bright star: codes have the fewest steps", faint),
        ChainScene("1 deg/s", "a slow turn: prediction and paths begin to matter", average, 1.0),
        ChainScene("10 deg/s", "a fast slew: each star is a long path", average, 10.0),
    )


@dataclass(frozen=True, slots=True)
class PanelExposure:
    """An exposure of the tracker before a panel: its start and length, s, and the frames it sees.

    `weights` (frames, H, 1) are the share of a frame's light that each row contributes; of a panel
    that scans by columns (frames, 1, W).
    """

    begin_s: float
    length_s: float
    numbers: tuple[int, ...]
    light_ns: tuple[int, ...]
    weights: FloatArray

    def middle_ns(self) -> int:
        """The middle of the exposure."""
        return round((self.begin_s + self.length_s / 2) * NS_PER_S)

    def mean(self, light_of: Callable[[int, int], Lit], size_px: tuple[int, int]) -> FloatArray:
        """The mean light (H, W) over the exposure. `light_of` gives a frame's light by number and
        time.
        """
        width, height = size_px
        total = np.zeros(height * width)
        for number, light_ns, weight in zip(self.numbers, self.light_ns, self.weights, strict=True):
            place, light = light_of(number, light_ns)
            if weight.shape[1] == 1:
                at = place // width
            else:
                at = place % width
            total[place] += weight.ravel()[at] * light
        return total.reshape(height, width)

    def at_rest(self, light_of: Callable[[int, int], Lit], size_px: tuple[int, int]) -> FloatArray:
        """The same where all frames are alike, from the first of them."""
        whole = self.weights.sum(axis=0, keepdims=True)
        return replace(
            self, numbers=self.numbers[:1], light_ns=self.light_ns[:1], weights=whole
        ).mean(light_of, size_px)


def exposure_s(bench: Bench) -> float:
    """The tracker's exposure, or MAX_FRAMES refreshes of a longer one."""
    return min(bench.config.tracker.exposure_s, MAX_FRAMES / bench.config.monitor.refresh_hz)


def shortened_line(bench: Bench) -> str | None:
    """The note that only a part of the exposure is measured, or None."""
    whole_s = bench.config.tracker.exposure_s
    measured_s = exposure_s(bench)
    exposure_text = (
        f"exposures of {MAX_FRAMES} refreshes, {measured_s:.3g} s, in the place of [tracker]"
        f" exposure_s = {whole_s:g}"
    )
    return None if measured_s == whole_s else exposure_text


def exposure(bench: Bench, first_frame: int) -> PanelExposure:
    """An exposure of the bench that starts START_S after a frame's middle row lights."""
    period_s = 1 / bench.config.monitor.refresh_hz
    return panel_exposure(
        first_frame, period_s, exposure_s(bench), bench.scan, bench.camera.resolution_px
    )


def panel_exposure(
    first_frame: int, period_s: float, length_s: float, scan: Scan, size: tuple[int, int]
) -> PanelExposure:
    """An exposure before a panel of `size` pixels (width, height), START_S after the middle row of
    a frame lights, less whole refreshes of `period_s`.
    """
    begin_s = first_frame * period_s + START_S % period_s
    before = math.ceil((scan.scanout_s / 2 + scan.hold_s) / period_s) + 1
    numbers = np.arange(
        first_frame - before, first_frame + math.ceil(length_s / period_s) + before + 1
    )
    # How long after the middle row each row lights, (H, 1); each column of a panel that is turned,
    # (1, W).
    turned = bool(scan.down[0])
    along = np.arange(size[0] if turned else size[1], dtype=np.float64)
    middle = np.full(len(along), (size[1 if turned else 0] - 1) / 2)
    if turned:
        late_s = scan.late_s(along, middle, size)[None, :]
    else:
        late_s = scan.late_s(middle, along, size)[:, None]
    lit_s = numbers[:, None, None] * period_s + late_s
    # Weights add up to 1 over a whole number of refreshes: a panel that flashes gives a refresh's
    # light at once.
    if scan.hold_s:
        overlap_s = np.minimum(lit_s + scan.hold_s, begin_s + length_s) - np.maximum(lit_s, begin_s)
        weights = np.maximum(overlap_s, 0.0) / scan.hold_s * (period_s / length_s)
    else:
        weights = ((lit_s >= begin_s) & (lit_s < begin_s + length_s)) * (period_s / length_s)
    used = weights.any(axis=(1, 2))
    frames = tuple(numbers[used].tolist())
    light_ns = tuple(round(number * period_s * NS_PER_S) for number in frames)
    return PanelExposure(begin_s, length_s, frames, light_ns, weights[used])


@dataclass(frozen=True, slots=True)
class Marks:
    """The named combinations: hilstar's defaults, `effort = "auto"`, and the bench file's own."""

    default: ChainCombination
    auto: ChainCombination
    as_filed: ChainCombination


class Parts(Closing):
    """The benches that draw a bench file's combinations, without bodies. Free them with `close`.

    Raises InputError for a bench file that cannot be studied, MachineError without OpenGL.
    """

    def __init__(self, file: BenchFile) -> None:
        if not file.config.tracker.exposure_s:
            raise InputError(
                f"{file.path}: [tracker] exposure_s = 0 gathers no light; write a longer one"
            )
        sky = msgspec.structs.replace(file.config.sky, bodies=SkySettings().bodies)
        config = msgspec.structs.replace(file.config, sky=sky, spacecraft=SpacecraftSettings())
        self._file = replace(file, config=config)
        self._benches: dict[tuple[tuple[str, Any], ...], Bench] = {}
        stars = bench_stars(config, file.folder)
        if not len(stars):
            raise InputError(
                f"{file.path}: [sky] faintest_v_mag leaves no star; write a larger one"
            )
        self.faintest_v_mag = min(sky.faintest_v_mag, float(stars.v_mag.max().round(2)))
        self._stars = stars
        self._shallow: dict[tuple[float, float], Bench] = {}
        self.own = self._with(OWN)
        self.can_steal_bits = self.own.calibration.can_steal_bits

    def bench(self, combination: ChainCombination) -> Bench:
        """The bench that draws a combination."""
        render = self._file.config.render
        keys: dict[str, Any] = {
            "quantisation": combination.quantisation,
            "bit_stealing": combination.bit_stealing,
            "effort": "full" if combination.sprite == "full" else "auto",
            "motion_above_px": 0.0,
        }
        if combination.sprite == "coarse":
            keys |= {
                "tolerance_mag": COARSER * render.tolerance_mag,
                "tolerance_px": COARSER * render.tolerance_px,
            }
        bench = self._with(keys)
        if combination.faintest_v_mag >= self.faintest_v_mag:
            return bench
        key = id(bench), combination.faintest_v_mag
        if key not in self._shallow:
            sky = msgspec.structs.replace(
                self._file.config.sky, faintest_v_mag=combination.faintest_v_mag
            )
            stars = bench_stars(
                msgspec.structs.replace(self._file.config, sky=sky), self._file.folder
            )
            self._shallow[key] = bench.with_stars(
                split_by_rate(stars, bench.faintest_shown_e_per_s)[0]
            )
        return self._shallow[key]

    def marks(self, movement: Movement) -> Marks:
        """The named combinations of a scene."""
        defaults = RenderSettings()
        plain = {}
        for name in ("effort", "quantisation", "bit_stealing", "motion_above_px"):
            plain[name] = getattr(defaults, name)
        ahead = self._file.config.attitude.max_extrapolation_ms > 0
        return Marks(
            self._chosen(self._with(plain), movement, True),
            self._chosen(self.own, movement, ahead),
            self._chosen(self._with({}), movement, ahead),
        )

    def _chosen(self, bench: Bench, movement: Movement, ahead: bool) -> ChainCombination:
        render = bench.config.render
        motion_px = (
            abs(movement.rate_deg_s)
            * bench.scan.longest_s
            * bench.camera.scales_px_rad()[1]
            / DEG_PER_RAD
        )
        prediction: Prediction = "rate" if ahead or not movement.turns else "held"
        drawn = (
            motion_px > render.motion_above_px and render.motion != "off" and prediction != "held"
        )
        smear: Smear = "path" if drawn or not movement.turns else "point"
        if render.quantisation == "auto":
            raise AssertionError("the effort's plan has chosen")
        sprite: Sprite = "cut" if render.effort == "auto" else "full"
        return ChainCombination(
            render.quantisation, render.bit_stealing, self.faintest_v_mag, sprite, smear, prediction
        )

    def _with(self, keys: dict[str, Any]) -> Bench:
        """The bench with other keys of [render]."""
        key = tuple(sorted(keys.items()))
        if key not in self._benches:
            render = msgspec.structs.replace(self._file.config.render, **keys)
            config = msgspec.structs.replace(self._file.config, render=render)
            bench = assembled(replace(self._file, config=config), self._stars)
            # One camera for all: it keeps the tables of its paths.
            camera = next((other.camera for other in self._benches.values()), bench.camera)
            self._benches[key] = replace(bench, camera=camera)
        return self._benches[key]

    def close(self) -> None:
        """Free the GL contexts."""
        for bench in self._benches.values():
            bench.close()
