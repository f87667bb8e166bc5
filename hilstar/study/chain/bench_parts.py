"""The benches of a study: one for each quantisation, bit stealing and size of sprites, all with the same stars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import msgspec

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import assembled, bench_stars
from hilstar.bench.config import RenderSettings, SkySettings
from hilstar.bench.config.spacecraft import Spacecraft
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.sky.stars import split_by_rate
from hilstar.study.chain.combinations import COARSER, Combination, Smear, Sprite
from hilstar.study.chain.motion import Movement, Prediction

DEG_PER_RAD = math.degrees(1.0)
OWN = {"effort": "auto", "quantisation": "auto"}


@dataclass(frozen=True, slots=True)
class Marks:
    """The combinations that stand for something: hilstar's defaults, `effort = "auto"`, and the bench file as it is."""

    default: Combination
    auto: Combination
    as_filed: Combination


class Parts:
    """The benches of a bench file's combinations, without bodies. Free them with `close`.

    Raises InputError for a bench file that cannot be studied, MachineError without OpenGL.
    """

    def __init__(self, file: BenchFile) -> None:
        if not file.config.tracker.exposure_s:
            raise InputError(f"{file.path}: [tracker] exposure_s = 0 gathers no light; write a longer one")
        sky = msgspec.structs.replace(file.config.sky, bodies=SkySettings().bodies)
        config = msgspec.structs.replace(file.config, sky=sky, spacecraft=Spacecraft())
        self._file = BenchFile(file.path, file.text, config, file.sha256)
        self._benches: dict[tuple[tuple[str, Any], ...], Bench] = {}
        stars = bench_stars(config, file.folder)
        if not len(stars):
            raise InputError(f"{file.path}: [sky] faintest_v_mag leaves no star; write a larger one")
        self.faintest_v_mag = min(sky.faintest_v_mag, float(stars.v_mag.max().round(2)))
        self._stars = stars
        self._shallow: dict[tuple[float, float], Bench] = {}
        self.own = self._with(OWN)
        self.can_steal_bits = self.own.calibration.can_steal_bits

    def bench(self, combination: Combination) -> Bench:
        """The bench that draws a combination."""
        bench = self._with(self._keys(combination))
        if combination.faintest_v_mag >= self.faintest_v_mag:
            return bench
        key = id(bench), combination.faintest_v_mag
        if key not in self._shallow:
            sky = msgspec.structs.replace(self._file.config.sky, faintest_v_mag=combination.faintest_v_mag)
            stars = bench_stars(msgspec.structs.replace(self._file.config, sky=sky), self._file.folder)
            self._shallow[key] = bench.with_stars(split_by_rate(stars, bench.faintest_shown_e_per_s)[0])
        return self._shallow[key]

    def _keys(self, combination: Combination) -> dict[str, Any]:
        """The keys of [render] of a combination."""
        render = self._file.config.render
        keys: dict[str, Any] = {
            "quantisation": combination.quantisation,
            "bit_stealing": combination.bit_stealing,
            "effort": "full" if combination.sprite == "full" else "auto",
            "motion_above_px": 0.0,
        }
        if combination.sprite == "coarse":
            keys |= {"tolerance_mag": COARSER * render.tolerance_mag, "tolerance_px": COARSER * render.tolerance_px}
        return keys

    def marks(self, movement: Movement) -> Marks:
        """What the marked combinations choose for a scene."""
        defaults = RenderSettings()
        plain = {name: getattr(defaults, name) for name in ("effort", "quantisation", "bit_stealing", "motion_above_px")}
        ahead = self._file.config.attitude.max_extrapolation_ms > 0
        return Marks(
            self._chosen(self._with(plain), movement, True),
            self._chosen(self.own, movement, ahead),
            self._chosen(self._with({}), movement, ahead),
        )

    def _chosen(self, bench: Bench, movement: Movement, ahead: bool) -> Combination:
        render = bench.config.render
        motion_px = abs(movement.rate_deg_s) * bench.scan.longest_s * bench.camera.scales_px_rad()[1] / DEG_PER_RAD
        prediction: Prediction = "rate" if ahead or not movement.turns else "held"
        drawn = motion_px > render.motion_above_px and render.motion != "off" and prediction != "held"
        smear: Smear = "path" if drawn or not movement.turns else "point"
        if render.quantisation == "auto":
            raise AssertionError("the effort's plan has chosen")
        sprite: Sprite = "cut" if render.effort == "auto" else "full"
        return Combination(render.quantisation, render.bit_stealing, self.faintest_v_mag, sprite, smear, prediction)

    def _with(self, keys: dict[str, Any]) -> Bench:
        """The bench with other keys of [render]."""
        key = tuple(sorted(keys.items()))
        if key not in self._benches:
            render = msgspec.structs.replace(self._file.config.render, **keys)
            config = msgspec.structs.replace(self._file.config, render=render)
            file = BenchFile(self._file.path, self._file.text, config, self._file.sha256)
            bench = assembled(file, self._stars)
            # One camera for all: what its paths need is found once for each camera.
            camera = next((other.camera for other in self._benches.values()), bench.camera)
            self._benches[key] = replace(bench, camera=camera)
        return self._benches[key]

    def close(self) -> None:
        """Free the GL contexts."""
        for bench in self._benches.values():
            bench.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
