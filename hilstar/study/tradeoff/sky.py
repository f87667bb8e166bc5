"""Trade-offs of the sky: where a star falls, how deep the catalogue goes, and how the stars in view are found."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.build import bench_calibration, bench_camera, bench_stars, brightest_peak_e_per_s
from hilstar.bench.config import BenchConfig, RenderSettings, SkySettings, read_config
from hilstar.render.renderer import Renderer, Target
from hilstar.resources import resource_path
from hilstar.rotation import from_radec_roll_deg, normalise, to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import SPRITE_DTYPE, make_sprites, pack_sprites
from hilstar.sky.cells import CELL_DEG, cell_grid
from hilstar.sky.stars import Stars
from hilstar.study.tradeoff.table import Figure, Trial, Trials

SIGMA_PX = RenderSettings().sprite_sigma_px
STAR_COLUMNS = ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s")
ORION = from_radec_roll_deg(84.057, -1.2, 10.0)
LIMITS_V_MAG = (5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0, 10.0)
NO_LIMIT_V_MAG = 20.0
CELLS_DEG = (1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
ATTITUDES = 60
SEED = 1
# float64 places of 2000 px are a few steps of 2.3e-13 px off.
ROUNDING_PX = 1e-12


@cache
def demo_config() -> BenchConfig:
    """The bench of `hilstar demo`."""
    return read_config(resource_path("configs", "demo.toml"))


@cache
def stars_to(faintest_v_mag: float) -> Stars:
    """The demo's stars to a magnitude."""
    config = demo_config()
    sky = msgspec.structs.replace(config.sky, faintest_v_mag=faintest_v_mag)
    return bench_stars(msgspec.structs.replace(config, sky=sky), Path())


def turn_to_image(q: FloatArray, camera: Camera) -> FloatArray:
    """ICRS to image axes, (3, 3), at an attitude."""
    return np.asarray(camera.cam_to_image @ to_matrix(q))


def random_attitudes(count: int) -> list[FloatArray]:
    """Unit quaternions, any attitude as likely as any other; ORION is the first."""
    drawn = np.random.default_rng(SEED).normal(size=(count - 1, 4))
    return [ORION, *normalise(drawn)]


def projection(stack: ExitStack, quick: bool) -> Trials:
    """Where stars fall, by the precision of it all: error, px, worst and rms over the stars of ATTITUDES random fields."""
    del stack
    camera, vectors = bench_camera(demo_config()), stars_to(NO_LIMIT_V_MAG).vectors
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
        Figure("place error, worst star", "px", ROUNDING_PX),
        Figure("rms", "px"),
        "a GPU of OpenGL 3.3 takes no float64, and a float32 place is worse the larger the monitor",
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
    found = _places(road, vectors, icrs_to_image, bench_camera(demo_config()))
    error = np.hypot(*(found - truth).T).astype(np.float64)
    return np.asarray(error[np.isfinite(error)])


def depth(stack: ExitStack, quick: bool) -> Trials:
    """How deep the catalogue goes: light of the whole sky that is lost, %, and stars drawn in the field."""
    del quick
    config, camera = demo_config(), bench_camera(demo_config())
    calibration, white = bench_calibration(config, Path()), brightest_peak_e_per_s(stars_to(NO_LIMIT_V_MAG), SIGMA_PX)
    renderer = stack.enter_context(Renderer(Target(camera.resolution_px, SIGMA_PX, calibration.response, white)))
    everything = stars_to(NO_LIMIT_V_MAG).electrons_per_s.sum()
    default, turn, trials = SkySettings().faintest_v_mag, turn_to_image(ORION, camera), []
    for limit in sorted({*LIMITS_V_MAG, default, NO_LIMIT_V_MAG}):
        stars = stars_to(limit)
        lost = 100 * (1 - stars.electrons_per_s.sum() / everything) if len(stars) < len(stars_to(NO_LIMIT_V_MAG)) else 0.0
        drawn = len(make_sprites(stars, turn, camera, renderer.footprint_px))
        name = "all of Hipparcos" if limit == NO_LIMIT_V_MAG else f"V to {limit:g}"
        work = partial(_frame, renderer, stars, turn, camera)
        trials.append(Trial(name, lost, drawn, work, limit == default, limit == NO_LIMIT_V_MAG))
    return Trials(
        "depth",
        f"a frame of Orion to codes, {camera.resolution_px[0]} x {camera.resolution_px[1]}",
        Figure("light of the catalogue lost", "%", 0.1),
        Figure("sprites in the frame", "stars"),
        "Hipparcos is complete to about V = 7.5",
        trials,
        "stars that Hipparcos lacks are in no figure: it is complete to V = 7.3 to 9, by place and type (ESA SP-1200)",
    )


def _frame(renderer: Renderer, stars: Stars, icrs_to_image: FloatArray, camera: Camera) -> None:
    renderer.draw(make_sprites(stars, icrs_to_image, camera, renderer.footprint_px))
    renderer.codes()


def culling(stack: ExitStack, quick: bool) -> Trials:
    """How the stars in view are found among all: stars missed over ATTITUDES fields, and stars looked at in vain."""
    del stack
    camera, stars = bench_camera(demo_config()), stars_to(NO_LIMIT_V_MAG)
    turns = [turn_to_image(q, camera) for q in random_attitudes(10 if quick else ATTITUDES)]
    in_view = [set(stars.hip[_scan(stars, turn, camera)[0]].tolist()) for turn in turns]
    finders: dict[str, tuple[Stars, Finder]] = {
        "scan, every star projected": (stars, _scan),
        "scan of angles": (stars, _scan_angles),
        **{f"cells of {deg:g} deg": (in_cells(stars, deg), _by_cells) for deg in sorted({*CELLS_DEG, CELL_DEG})},
        "cells of 10 deg, by centres only": (in_cells(stars, 10.0, by_centres=True), _by_cells),
    }
    trials = []
    for name, (sorted_stars, finder) in finders.items():
        missed, vain = 0, 0
        for turn, wanted in zip(turns, in_view, strict=True):
            seen, looked_at = finder(sorted_stars, turn, camera)
            missed += len(wanted - set(sorted_stars.hip[seen].tolist()))
            vain += looked_at - len(wanted)
        work = partial(finder, sorted_stars, turns[0], camera)
        own = name == f"cells of {CELL_DEG:g} deg"
        trials.append(Trial(name, missed, vain / len(turns), work, own, finder is _scan))
    return Trials(
        "culling",
        f"{len(stars)} stars to the {len(in_view[0])} sprites of Orion",
        Figure(f"stars missed in {len(turns)} fields", "stars", 0.1),
        Figure("looked at in vain, mean", "stars"),
        "a smaller cell hands on fewer stars where the field is rich, a larger one costs less where it is poor",
        trials,
    )


# Which stars (places in `Stars`) are seen, and how many were looked at.
Finder = Callable[[Stars, FloatArray, Camera], tuple[IntArray, int]]


def in_cells(stars: Stars, cell_deg: float, by_centres: bool = False) -> Stars:
    """The stars in cells of another size; `by_centres` takes a cell for a point."""
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {name: getattr(stars, name)[grid.order] for name in STAR_COLUMNS}
    if by_centres:
        grid = replace(grid, cos_radius=np.ones_like(grid.cos_radius), sin_radius=np.zeros_like(grid.sin_radius))
    return replace(stars, **columns, grid=grid)


def _by_cells(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    """The road of `make_sprites`."""
    near = stars.grid.near(turn[2], camera.field_radius_rad(footprint_px(SIGMA_PX) / 2 + 1))
    return _project(stars, near, turn, camera), len(near)


def _scan(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    return _project(stars, np.arange(len(stars)), turn, camera), len(stars)


def _scan_angles(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    radius_rad = camera.field_radius_rad(footprint_px(SIGMA_PX) / 2 + 1)
    return _project(stars, np.flatnonzero(stars.vectors @ turn[2] >= np.cos(radius_rad)), turn, camera), len(stars)


def _project(stars: Stars, near: IntArray, turn: FloatArray, camera: Camera) -> IntArray:
    x_px, y_px = camera.project(stars.vectors[near] @ turn.T)
    return pack_sprites(x_px, y_px, stars.electrons_per_s[near], near, camera.resolution_px, footprint_px(SIGMA_PX)).star
