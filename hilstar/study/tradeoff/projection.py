"""The trade-off of projection: where a star falls, by the precision of the arithmetic."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.cameras import ideal_monitor
from hilstar.scene.camera import Camera
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import SPRITE_DTYPE, pack_sprites
from hilstar.study.tradeoff.demo import (
    ATTITUDES,
    NO_LIMIT_V_MAG,
    SIGMA_PX,
    demo_config,
    random_attitudes,
    stars_to,
    turn_to_image,
)
from hilstar.study.tradeoff.table import Figure, Trial, Trials

# float64 places of 2000 px are a few steps of 2.3e-13 px off.
ROUNDING_PX = 1e-12


def projection(stack: ExitStack, quick: bool) -> Trials:
    """Where stars fall, by the precision of it all: error, px, worst and rms over the stars of ATTITUDES random fields."""
    del stack
    camera, vectors = ideal_monitor(demo_config()), stars_to(NO_LIMIT_V_MAG).vectors
    views = [_view(q, camera) for q in random_attitudes(6 if quick else ATTITUDES)]
    truths = [_exact_places(vectors[near], turn, camera) for near, turn in views]
    trials = []
    for name, road in ROADS.items():
        errors = [_place_errors_px(road, vectors[near], turn, truth) for (near, turn), truth in zip(views, truths, strict=True)]
        error, (near, turn) = np.concatenate(errors), views[0]
        work = partial(road.pack, vectors[near], turn, camera)
        # The sprites' own layout says which of them the renderer is handed.
        figures = float(error.max()), float(np.sqrt(np.mean(error**2)))
        trials.append(Trial(name, *figures, work, road.dtype == SPRITE_DTYPE, road is EXACT))
    return Trials(
        "projection",
        f"{len(views[0][0])} stars near the field to sprites, {camera.resolution_px[0]} x {camera.resolution_px[1]}",
        Figure("position error, worst star", "px", ROUNDING_PX),
        Figure("rms", "px"),
        "OpenGL 3.3 takes no float64, and the error of a float32 position grows with the monitor",
        trials,
    )


def _view(q: FloatArray, camera: Camera) -> tuple[IntArray, FloatArray]:
    """The stars near a field, as places in `stars_to(NO_LIMIT_V_MAG)`, and the turn into it."""
    turn = turn_to_image(q, camera)
    return stars_to(NO_LIMIT_V_MAG).grid.near(turn[2], camera.field_radius_rad(0.0)), turn


@dataclass(frozen=True, slots=True)
class Road:
    """From directions to sprites: the precision of the mathematics, and the layout of what is handed on."""

    kind: type[np.floating[Any]]
    dtype: np.dtype[np.void]

    def pack(self, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera) -> tuple[npt.NDArray[np.void], IntArray]:
        """Sprites of stars of one electron per second, in the layout, and which of `vectors` (n, 3) they are."""
        kind = self.kind
        x, y, z = (vectors.astype(kind, copy=False) @ icrs_to_image.T.astype(kind)).T
        scale = kind(camera.focal_length_px) / z
        cx, cy = (kind(c) for c in camera.principal_point_px)
        x, y = x * scale + cx, y * scale + cy
        star, (width, height), side = np.arange(len(vectors)), camera.resolution_px, footprint_px(SIGMA_PX)
        if self.dtype == SPRITE_DTYPE:
            sprites = pack_sprites(x, y, np.ones(len(star)), star, (width, height), side)
            return sprites.data, sprites.star
        margin = side / 2
        seen = (x > -margin) & (x < width + margin) & (y > -margin) & (y < height + margin)
        data = np.empty(np.count_nonzero(seen), dtype=self.dtype)
        data["place_px"][:, 0], data["place_px"][:, 1] = x[seen], y[seen]
        data["electrons_per_s"] = 1.0
        return data, star[seen]


def _layout(place: type[np.floating[Any]]) -> np.dtype[np.void]:
    return np.dtype([("place_px", place, 2), ("electrons_per_s", "<f4")])


EXACT = Road(np.longdouble, _layout(np.longdouble))
ROADS = {
    "extended precision": EXACT,
    "float64, place in float64": Road(np.float64, _layout(np.float64)),
    "float64, place in float32": Road(np.float64, _layout(np.float32)),
    "float32 throughout": Road(np.float32, _layout(np.float32)),
    "float64, whole pixel + float32 fraction": Road(np.float64, SPRITE_DTYPE),
}


def _exact_places(vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera) -> npt.NDArray[np.longdouble]:
    """Places (n, 2), px; NaN for a star that is not seen."""
    return _places(EXACT, vectors, icrs_to_image, camera)


def _places(road: Road, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera) -> npt.NDArray[np.longdouble]:
    data, star = road.pack(vectors, icrs_to_image, camera)
    places = np.full((len(vectors), 2), np.nan, dtype=np.longdouble)
    split = data.dtype == SPRITE_DTYPE
    places[star] = data["pixel"] + data["fraction_px"].astype(np.longdouble) if split else data["place_px"]
    return places


def _place_errors_px(
    road: Road, vectors: FloatArray, icrs_to_image: FloatArray, truth: npt.NDArray[np.longdouble]
) -> FloatArray:
    found = _places(road, vectors, icrs_to_image, ideal_monitor(demo_config()))
    error = np.hypot(*(found - truth).T).astype(np.float64)
    return np.asarray(error[np.isfinite(error)])
