"""The trade-off of quantisation: the ways from light to code values."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np

from hilstar.bench.config import Monitor, RenderSettings
from hilstar.monitor.balance import Balance
from hilstar.monitor.phases import WHITE, fainter, measure, phase_grid, shown_by
from hilstar.monitor.quantise import CYCLE_FRAMES, Panel
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Renderer, Target
from hilstar.study.shared.codes import AIMS, FRAME_PX, STARS, WAYS, Way, response_of, star_field
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import flux_ratio

SIGMA_PX = RenderSettings().sprite_sigma_px
PHASES = 32
# float32 rounds a star's electrons by 6e-8, and its brightest pixels by as much again.
ROUNDING_MAG = 1e-7
TAKEN = "exact"  # by `auto`, the default, at this depth


def quantisation(stack: ExitStack, quick: bool) -> Trials:
    """From light to codes at the default depth: flux error, mag, and centroid error, px, of a star at its aim's faint end."""
    del quick  # every error is found at once
    bits = Monitor(resolution_px=FRAME_PX, pixel_pitch_um=1.0).bits
    mag = AIMS[bits][1]
    trials = [_quantised(stack, way, bits) for way in WAYS]
    return Trials(
        "quantisation",
        f"codes of {STARS} stars, {FRAME_PX[0]} x {FRAME_PX[1]}, light to memory",
        Figure(f"flux error of a star {mag:g} mag under white, {bits} bits, worst", "mag", ROUNDING_MAG),
        Figure("centroid error, worst", "px"),
        "it needs no more than one frame and leaves no pattern that a tracker could take for a star",
        trials,
    )


def _quantised(stack: ExitStack, way: Way, bits: int) -> Trial:
    response, mag = response_of(bits, way), AIMS[bits][1]
    sprites, tile = phase_grid(PHASES, SIGMA_PX)
    wanted = linear_image(sprites, (PHASES * tile,) * 2, SIGMA_PX) * flux_ratio(mag)
    cycle, linear = CYCLE_FRAMES if way.whole_cycle else 1, wanted.astype(np.float32)
    shown = shown_by(way.method, cycle, Panel(response, WHITE), linear, fainter(sprites, mag), Balance(SIGMA_PX))
    found = measure(wanted, shown, tile)
    renderer = stack.enter_context(Renderer(Target(FRAME_PX, SIGMA_PX, response, WHITE, way.method)))
    field = star_field(FRAME_PX, renderer.footprint_px)

    def work() -> None:
        renderer.draw(field)
        renderer.codes()

    is_default = (way.method, way.stealing) == (TAKEN, RenderSettings().bit_stealing)
    return Trial(way.name, found.flux_max_mag, found.centroid_max_px, work, is_default)
