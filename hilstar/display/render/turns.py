"""The order in which the panels of a target choose their levels, and what each makes up for."""

from collections.abc import Callable

import numpy as np

from hilstar.display.exact import KEPT, KEPT_BEFORE, ExactQuantiser, Turn
from hilstar.display.quantise import Quantiser
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.optics.sprites import FrameLight, by_primary


def turns_of(target: Target) -> list[Turn]:
    """The order in which `exact` chooses the primaries' levels: by falling electrons a step,
    for the last leave least.

    Each makes up for those before it, by the light of the channels; in `temporal` for its own
    light alone.
    """
    panels = target.primaries
    if not panels:
        return [Turn(0, [0.0])]
    step = np.array([panel.response.light[1] * panel.flux_at_white_e_per_s for panel in panels])
    order = np.argsort(-step, kind="stable").tolist()
    alone = getattr(QUANTISERS[target.quantisation], "remembers", False)
    share = target.together / target.together.diagonal() * step[:, None] / step
    # What a primary leaves has in it what it began with: `errors` (3, 3) are its own errors by
    # what each leaves.
    errors = np.zeros_like(share)
    turns = []
    for k in order:
        if alone:
            makes_up = np.zeros(len(panels))
        else:
            makes_up = share[:, k] @ errors
        errors[k] = -makes_up
        errors[k, k] += 1
        is_last = alone or k == order[-1]
        turns.append(Turn(k, makes_up.tolist(), KEPT if is_last else KEPT_BEFORE))
    return turns


def quantisers_of(target: Target) -> dict[int, Quantiser]:
    """NumPy's quantiser of each panel, in the order in which they choose; none without a
    response.
    """
    panel = target.panel()
    kind = QUANTISERS[target.quantisation]
    panels = target.primaries or (() if panel is None else (panel,))
    turns = turns_of(target) if panels else []
    quantisers = {
        turn.plane: kind(panels[turn.plane], target.resolution_px, target.psf, target.seen)
        for turn in turns
    }
    for turn in turns if target.primaries else ():
        quantiser = quantisers[turn.plane]
        if isinstance(quantiser, ExactQuantiser):
            quantiser.kept = turn.kept
            quantiser.given = [(part, quantisers[j]) for j, part in enumerate(turn.makes_up)]
    return quantisers


def levels_by_plane(
    target: Target,
    sprites: FrameLight | None,
    levels: Callable[[int, FrameLight | None], Levels],
) -> Levels:
    """The levels of a frame by those of each primary, if primaries are driven apart, chosen
    in their order.
    """
    by_plane = {}
    for turn in turns_of(target):
        light = sprites
        if target.primaries and sprites is not None:
            light = by_primary(sprites, target.places_px, turn.plane)
        by_plane[turn.plane] = levels(turn.plane, light)
    if not target.primaries:
        return by_plane[0]
    return Levels(np.stack([by_plane[k] for k in range(len(by_plane))], -1))
