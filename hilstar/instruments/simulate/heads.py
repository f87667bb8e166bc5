"""Several heads through their twins: the angles between them, as solved from what each tracker
would see.
"""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.source import Mounting
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply, random_attitude, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.quantise import MASK_TURNS
from hilstar.instruments.simulate.star_finder import (
    Matched,
    crowded,
    inside_by,
    shared,
    star_finder,
)
from hilstar.instruments.simulate.twin import Twin, TwinField
from hilstar.server.bench.bench_file import HeadsFile
from hilstar.tracker.identify import wahba

MIN_STARS = 3  # for a solved attitude
WIDER = 1.5
EDGE_PX = 1.5  # beyond the centroider's window


@dataclass(frozen=True, slots=True)
class HeadsErrors:
    """By how much the angle between two heads is off, arcsec, in each field: solved from linear
    light, and from the codes.
    """

    first: str
    second: str
    linear_arcsec: list[float] = field(default_factory=list)
    codes_arcsec: list[float] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """The same as rms and maximum, None where no field had stars enough in both."""
        return {
            "heads": [self.first, self.second],
            "fields": len(self.codes_arcsec),
            "linear_arcsec": _figures(self.linear_arcsec),
            "codes_arcsec": _figures(self.codes_arcsec),
        }


def _figures(errors: list[float]) -> dict[str, float] | None:
    """The rms and the maximum of errors, None without any."""
    if not errors:
        return None
    rms = np.sqrt(np.mean(np.square(errors)))
    return {"rms": float(rms), "max": max(errors)}


class _Head:
    """One head's twin, its centroider, and how it sits in the body."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        finder = star_finder(twin.bench, twin.monitor_px_per_px)
        # The window's bias repeats with the place within a pixel: a wider one has 0.0004 px of it
        # in place of 0.0009.
        width_px = WIDER * finder.settings.window_sigma_px
        settings = replace(finder.settings, window_sigma_px=width_px)
        self.finder = replace(finder, settings=settings)
        self.mounting = Mounting(twin.config.tracker.q_body_to_cam)

    def solved(
        self, q_icrs_to_body: FloatArray, first_frame: int
    ) -> tuple[FloatArray, FloatArray] | None:
        """The body's attitude as this head's stars have it, from linear light and from codes;
        None with too few stars.
        """
        q_icrs_to_cam = multiply(self.mounting.q_body_to_cam, q_icrs_to_body)
        head_field = self.twin.field(q_icrs_to_cam, first_frame)
        x_px, y_px = head_field.x_px, head_field.y_px
        sky = self.finder.match(head_field.sky_e, x_px, y_px)
        shown = self.finder.match(head_field.shown_e, x_px, y_px)
        stars = np.flatnonzero(self._usable(head_field, sky, shown))
        if len(stars) < MIN_STARS:
            return None
        wanted = self._directions(x_px[stars], y_px[stars])
        # Linear light places all stars alike; codes place bright stars better.
        alike = np.ones(len(stars))
        light = head_field.truth["electrons_per_s"][stars].astype(np.float64)
        attitudes = (self.mounting.q_body_to_cam, q_icrs_to_body)
        linear = body_attitude(*attitudes, self._solved_from(sky, stars), wanted, alike)
        codes = body_attitude(*attitudes, self._solved_from(shown, stars), wanted, light)
        return linear, codes

    def _usable(self, head_field: TwinField, sky: Matched, shown: Matched) -> npt.NDArray[np.bool_]:
        """True for stars (n,) whose centroids in both images are of nothing else: whole in both,
        alone in their windows, drawn and not clipped.
        """
        truth = head_field.truth
        x_px, y_px = head_field.x_px, head_field.y_px
        radius_px = self.finder.settings.radius_px
        margin_px = radius_px + EDGE_PX
        inside = inside_by(margin_px, x_px, y_px, self.twin.camera.resolution_px)
        bench = self.twin.bench
        reach_px = bench.psf.footprint_px / 2 + margin_px * self.twin.monitor_px_per_px
        monitor_px = bench.camera.resolution_px
        inside &= inside_by(reach_px, truth["x_px"], truth["y_px"], monitor_px)
        rates = truth["electrons_per_s"]
        is_crowded = crowded(x_px, y_px, rates, radius_px, self.finder.psf)
        has_both = (sky.index >= 0) & (shown.index >= 0)
        is_matched = has_both & ~shared(sky.index)
        is_whole = truth["drawn"] & ~truth["clipped"]
        return np.asarray(inside & is_matched & is_whole & ~is_crowded)

    def _directions(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) of places on the detector, cam."""
        rays = self.twin.camera.rays(x_px, y_px)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def _solved_from(self, matched: Matched, stars: npt.NDArray[np.intp]) -> FloatArray:
        """Unit vectors (n, 3), cam, to the centroids of stars (n,)."""
        source = matched.index[stars]
        return self._directions(matched.found.x_px[source], matched.found.y_px[source])


def body_attitude(
    q_body_to_cam: FloatArray,
    q_icrs_to_body: FloatArray,
    measured: FloatArray,
    wanted: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """The body's attitude (4,) by directions that a head measured, where stars of the true attitude
    have those wanted, cam, (n, 3) each.
    """
    # turns the camera's true axes into those solved
    q_cam_to_solved = wahba(measured, wanted, weights)
    q_icrs_to_cam = multiply(q_body_to_cam, q_icrs_to_body)
    q_icrs_to_solved = multiply(q_cam_to_solved, q_icrs_to_cam)
    return multiply(conjugate(q_body_to_cam), q_icrs_to_solved)


def verify_heads(
    heads: HeadsFile,
    fields: int,
    rng: np.random.Generator,
    on_field: Callable[[int], None] = lambda done: None,
) -> list[HeadsErrors]:
    """Show `fields` random attitudes of the body on all heads, and solve the angles between each
    two of them.

    Raises InputError (see `Twin`).
    """
    pairs = [HeadsErrors(*two) for two in combinations(heads.names, 2)]
    with ExitStack() as stack:
        twins = [_Head(stack.enter_context(Twin(file))) for file in heads.files]
        for number in range(fields):
            q_icrs_to_body = random_attitude(rng)
            first_frame = int(rng.integers(0, MASK_TURNS))
            solved = [head.solved(q_icrs_to_body, first_frame) for head in twins]
            for pair, (first, second) in zip(pairs, combinations(solved, 2), strict=True):
                if first is None or second is None:
                    continue
                first_linear, first_codes = first
                second_linear, second_codes = second
                pair.linear_arcsec.append(_apart_arcsec(first_linear, second_linear))
                pair.codes_arcsec.append(_apart_arcsec(first_codes, second_codes))
            on_field(number + 1)
    return pairs


def _apart_arcsec(first: FloatArray, second: FloatArray) -> float:
    """The angle between two solutions of one body's attitude."""
    turn_rad = to_rotation_vector(multiply(first, conjugate(second)))
    return float(np.linalg.norm(turn_rad)) * ARCSEC_PER_RAD
