"""What happens as a body comes near and fills the field: the time of a frame, the light over white, and that all is finite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.study.bodies.cost import FRAME_NS, frame_ms
from hilstar.study.bodies.scenes import DAY_SIDE_NS, Aim, attitude

# Degrees from the boresight to the body's middle, of the Earth beyond its limb (negative: on it)
NEAR_DEG: dict[str, tuple[float, ...]] = {
    "Moon": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.5, 0.25, 0.0),
    "Sun": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.5, 0.25, 0.0),
    "Earth": (40.0, 20.0, 12.0, 8.0, 5.0, 3.0, 1.0, 0.0, -1.0, -3.0, -8.0, -20.0, -40.0, -70.0),
}
QUICK_DEG = {"Moon": (40.0, 0.5), "Sun": (40.0, 0.5), "Earth": (40.0, 0.0, -70.0)}


@dataclass(frozen=True, slots=True)
class Near:
    """A frame with a body so near its middle: the fastest of some, ms, and in processor time, and without any body.

    `over_white_mag` is how many magnitudes brighter than white the brightest pixel is (below 0: fainter), `finite` says that
    every pixel's light is a number, `white_is_white` that each with more than white has white's code; `stars` those drawn.
    """

    body: str
    off_deg: float
    frame_ms: float
    cpu_ms: float
    without_ms: float
    over_white_mag: float
    finite: bool
    white_is_white: bool
    stars: int


def approach(benches: Mapping[str, Bench], body: str, off_deg: float, rounds: int) -> Near:
    """A body at one place. `benches` has "nothing" and the body's own."""
    bench, nothing = benches[body], benches["nothing"]
    start_ns = DAY_SIDE_NS if body == "Earth" else 0
    q = attitude(bench, Aim(body, off_deg, start_ns))
    times = [(*frame_ms(nothing, q, None), *frame_ms(bench, q, start_ns + k * FRAME_NS)) for k in range(rounds + 1)]
    without_ms, _, with_ms, cpu_ms = np.min(np.array(times[1:]), axis=0).tolist()
    drawn = bench.draw(q, t_ns=start_ns)
    levels = drawn.levels.copy()
    light = bench.renderer.linear()
    brightest, white = float(light.max()), bench.flux_at_white_e_per_s
    return Near(
        body=body,
        off_deg=off_deg,
        frame_ms=with_ms,
        cpu_ms=cpu_ms,
        without_ms=without_ms,
        over_white_mag=2.5 * math.log10(max(brightest, 1e-9) / white),
        finite=bool(np.isfinite(light).all()),
        white_is_white=bool((levels[light > white] == bench.calibration.response.white).all()),
        stars=drawn.star_count,
    )
