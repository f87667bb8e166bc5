"""The choices of the chain, and which of their combinations are measured: all that could be on a front.

At rest every prediction is the same, and so are points and paths: one of each is measured. Where the camera turns, what is
crude in one respect is combined with small sprites alone: whole sprites would only add time to an error that is not theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hilstar.monitor.quantise import Quantisation
from hilstar.study.chain.motion import Prediction

Sprite = Literal["full", "cut", "coarse"]
Smear = Literal["path", "point"]
QUANTISATIONS: tuple[Quantisation, ...] = ("round", "dither", "temporal", "exact")
SPRITES: tuple[Sprite, ...] = ("full", "cut", "coarse")
COARSER = 10.0
SHALLOWER_MAG = 1.0


@dataclass(frozen=True, slots=True)
class Combination:
    """One choice for each step.

    Depth: `bit_stealing`, and the catalogue's `faintest_v_mag`. `sprite`: `full`, `cut` as `effort = "auto"` does within the
    bench file's tolerance, or `coarse`: the same within COARSER times that. `smear`: stars along their paths, or points.
    """

    quantisation: Quantisation
    bit_stealing: bool
    faintest_v_mag: float
    sprite: Sprite
    smear: Smear = "path"
    prediction: Prediction = "rate"


def combinations(turns: bool, can_steal_bits: bool, faintest_v_mag: float) -> list[Combination]:
    """All combinations that are measured, for a scene that turns or one at rest."""
    found: list[Combination] = []
    shallow = faintest_v_mag - SHALLOWER_MAG
    for stealing in (False, True) if can_steal_bits else (False,):
        for method in QUANTISATIONS:
            found += [Combination(method, stealing, faintest_v_mag, sprite) for sprite in SPRITES]
            if turns:
                crude: list[tuple[Smear, Prediction]] = [("point", "rate"), ("path", "two samples"), ("point", "held")]
                found += [Combination(method, stealing, faintest_v_mag, "cut", *ways) for ways in crude]
        found += [Combination(method, stealing, shallow, "cut") for method in ("round", "exact")]
        if turns:
            found.append(Combination("round", stealing, shallow, "cut", "point", "held"))
    return found
