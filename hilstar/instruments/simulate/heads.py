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
from hilstar.basics.rotation import conjugate, from_matrix, multiply, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.quantise import MASK_TURNS
from hilstar.instruments.simulate.star_finder import Matched, crowded, shared, star_finder
from hilstar.instruments.simulate.twin import Twin, TwinField
from hilstar.server.bench.bench_file import HeadsFile

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
    if not errors:
        return None
    return {"rms": float(np.sqrt(np.mean(np.square(errors)))), "max": max(errors)}


class _Head:
    """One head's twin, its centroider, and how it sits in the body."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        finder = star_finder(twin.bench, twin.monitor_px_per_px)
        # The window's bias repeats with the place within a pixel: a wider one has 0.0004 px of it
        # in place of 0.0009.
        width_px = WIDER * finder.settings.window_sigma_px
        self.finder = replace(finder, settings=replace(finder.settings, window_sigma_px=width_px))
        self.mounting = Mounting(twin.config.tracker.q_body_to_cam)

    def solved(
        self, q_icrs_to_body: FloatArray, first_frame: int
    ) -> tuple[FloatArray, FloatArray] | None:
        """The body's attitude as this head's stars have it, from linear light and from codes;
        None with too few stars.
        """
        head_field = self.twin.field(
            multiply(self.mounting.q_body_to_cam, q_icrs_to_body), first_frame
        )
        sky, shown = (
            self.finder.match(image_e, head_field.x_px, head_field.y_px)
            for image_e in (head_field.sky_e, head_field.shown_e)
        )
        stars = np.flatnonzero(self._usable(head_field, sky, shown))
        if len(stars) < MIN_STARS:
            return None
        wanted = self._directions(head_field.x_px[stars], head_field.y_px[stars])
        # Linear light places all stars alike; codes place bright stars better.
        alike = np.ones(len(stars))
        light = head_field.truth["electrons_per_s"][stars].astype(np.float64)
        linear, codes = (
            self._body(q_icrs_to_body, self._found(vectors, stars), wanted, weights)
            for vectors, weights in ((sky, alike), (shown, light))
        )
        return linear, codes

    def _usable(self, seen: TwinField, sky: Matched, shown: Matched) -> npt.NDArray[np.bool_]:
        truth, (width, height) = seen.truth, self.twin.camera.resolution_px
        radius_px = self.finder.settings.radius_px
        margin = radius_px + EDGE_PX
        inside = (
            (seen.x_px > margin)
            & (seen.x_px < width - 1 - margin)
            & (seen.y_px > margin)
            & (seen.y_px < height - 1 - margin)
        )
        bench = self.twin.bench
        reach = bench.psf.footprint_px / 2 + margin * self.twin.monitor_px_per_px
        screen_w, screen_h = bench.camera.resolution_px
        x = truth["x_px"]
        y = truth["y_px"]
        inside &= (
            (x > reach) & (x < screen_w - 1 - reach) & (y > reach) & (y < screen_h - 1 - reach)
        )
        near = crowded(seen.x_px, seen.y_px, truth["electrons_per_s"], radius_px, self.finder.psf)
        is_matched = (sky.index >= 0) & (shown.index >= 0) & ~shared(sky.index)
        return np.asarray(inside & is_matched & truth["drawn"] & ~truth["clipped"] & ~near)

    def _directions(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        rays = self.twin.camera.rays(x_px, y_px)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def _found(self, matched: Matched, stars: npt.NDArray[np.intp]) -> FloatArray:
        place = matched.index[stars]
        return self._directions(matched.found.x_px[place], matched.found.y_px[place])

    def _body(
        self, q_icrs_to_body: FloatArray, found: FloatArray, wanted: FloatArray, weights: FloatArray
    ) -> FloatArray:
        q_body_to_cam = self.mounting.q_body_to_cam
        # turns the camera's true axes into those solved
        off = from_matrix(rotation_between(wanted, found, weights))
        return multiply(
            conjugate(q_body_to_cam), multiply(off, multiply(q_body_to_cam, q_icrs_to_body))
        )


def rotation_between(before: FloatArray, after: FloatArray, weights: FloatArray) -> FloatArray:
    """The rotation (3, 3) that takes unit vectors (n, 3) nearest to others: Wahba's problem by
    Markley's SVD (1988).
    """
    u, _, vt = np.linalg.svd((weights[:, None] * after).T @ before)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


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
        seen_by = [_Head(stack.enter_context(Twin(file))) for file in heads.files]
        for number in range(fields):
            q = rng.normal(size=4)
            q_icrs_to_body = q / np.linalg.norm(q)
            first_frame = int(rng.integers(0, MASK_TURNS))
            solved = [head.solved(q_icrs_to_body, first_frame) for head in seen_by]
            for pair, (first_head, other) in zip(pairs, combinations(solved, 2), strict=True):
                if first_head is not None and other is not None:
                    pair.linear_arcsec.append(_apart_arcsec(first_head[0], other[0]))
                    pair.codes_arcsec.append(_apart_arcsec(first_head[1], other[1]))
            on_field(number + 1)
    return pairs


def _apart_arcsec(one: FloatArray, other: FloatArray) -> float:
    """The angle between two solutions of one body's attitude."""
    return (
        float(np.linalg.norm(to_rotation_vector(multiply(one, conjugate(other))))) * ARCSEC_PER_RAD
    )
