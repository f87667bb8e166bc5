"""The trade-off of quantisation: the ways from light to code values."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import count

from hilstar.bench.config import Monitor, RenderSettings
from hilstar.monitor.phases import WHITE
from hilstar.render.renderer import Renderer, Target
from hilstar.study.shared.code_errors import JUDGE, code_errors
from hilstar.study.shared.codes import AIMS, FRAME_PX, STARS, WAYS, Way, response_of, star_field
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.tracker.centroiders import FAMILY

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
        Figure("centroid error by a PSF fit, worst", "px"),
        "it needs no more than one frame and leaves no pattern that a tracker could take for a star",
        trials,
        _each_remark(trials),
    )


def _each_remark(trials: list[Trial]) -> str:
    """What other centroiders than the PSF fit find with the method that is taken."""
    taken = next(trial for trial in trials if trial.is_default)
    each = ", ".join(f"{kind} {taken.more[f'max_px_{kind}']:.3f}" for kind in FAMILY)
    return f"by each centroider '{taken.method}' is off by at most: {each} px"


def _quantised(stack: ExitStack, way: Way, bits: int) -> Trial:
    response, mag = response_of(bits, way), AIMS[bits][1]
    found = code_errors(bits, way, PHASES, [mag])[0]
    renderer = stack.enter_context(Renderer(Target(FRAME_PX, SIGMA_PX, response, WHITE, way.method)))
    field = star_field(FRAME_PX, renderer.footprint_px)

    numbers = count()

    def work() -> None:
        renderer.draw(field, next(numbers))
        renderer.codes()

    is_default = (way.method, way.stealing) == (TAKEN, RenderSettings().bit_stealing)
    each = {f"max_px_{kind}": found.max_px(kind) for kind in FAMILY}
    return Trial(way.name, found.flux_max_mag, found.max_px(JUDGE), work, is_default, more=each)
