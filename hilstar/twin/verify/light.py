"""From codes to light: the monitor as it is, and as the bench assumes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.frame import Bench, Frame, FrameFaults
from hilstar.monitor.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.monitor.quantise import Panel, shown_light
from hilstar.monitor.response import Response, table_response

PHASES = 4  # frames of a sequence with which an exposure may begin


def exposure_lights(
    bench: Bench, frame: Frame, first_frame: int, panels: Sequence[Panel], faults: FrameFaults | None = None
) -> list[FloatArray]:
    """The mean light (H, W), electrons per second, of each panel over an exposure that begins with frame `first_frame`.

    With `temporal` that is one of the first PHASES frames of a sequence, which `frame` is the first of.
    """
    if bench.config.render.quantisation != "temporal":
        return [shown_light(frame.levels, panel) for panel in panels]
    before, count = first_frame % PHASES, max(1, round(bench.config.tracker.exposure_s * bench.config.monitor.refresh_hz))
    lights = [np.zeros(frame.levels.shape) for _ in panels]
    for number in range(before + count):
        levels = frame.levels
        if number:
            sprites = bench.frame_sprites(frame.q_icrs_to_cam, t_ns=frame.t_ns, faults=faults)
            levels = bench.draw_sprites(sprites, first_frame + number).levels
        if number >= before:
            for light, panel in zip(lights, panels, strict=True):
                light += shown_light(levels, panel)
    for light in lights:
        light /= count
    return lights


def true_panel(bench: Bench) -> Panel:
    """What really turns the bench's levels into light. Raises InputError for a true calibration that cannot be used."""
    verify = bench.config.verify
    white = verify.true_flux_at_white_e_per_s or bench.flux_at_white_e_per_s
    if verify.true_calibration is None:
        return Panel(bench.calibration.response, white, bench.uniformity)
    true = true_calibration(bench, verify.true_calibration, bit_stealing=bench.config.render.bit_stealing)
    response = levels_of(bench.calibration.response, true.response)
    return Panel(response, white, true.uniformity_map(bench.config.monitor.resolution_px))


def true_calibration(bench: Bench, name: str, *, bit_stealing: bool = False) -> Calibration:
    """The calibration that [verify] true_calibration names. Raises InputError."""
    source: str | Path = name if name in BUILT_IN else bench.file.folder / name
    return load_calibration(source, bench.config.monitor.bits, bit_stealing=bit_stealing)


def levels_of(assumed: Response, true: Response) -> Response:
    """The true light of the assumed levels: with bit stealing another monitor orders its triples differently."""
    if assumed.rgb is None or true.rgb is None:
        return true
    light = {tuple(triple): value for triple, value in zip(true.rgb.tolist(), true.light, strict=True)}
    known = np.array([light.get(tuple(triple), np.nan) for triple in assumed.rgb.tolist()])
    # A triple that the true monitor cannot tell from its neighbour has that one's light.
    places = np.arange(len(known))
    known = np.interp(places, places[np.isfinite(known)], known[np.isfinite(known)])
    return Response(assumed.bits, known, table_response(assumed.bits, known).threshold, true.black, assumed.rgb)
